"""The benchmark on small problems: the document's shape, the figures' sense, the plot."""

from __future__ import annotations

import json
import re
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import further_bench
import numpy as np
import pytest
from device_simulator import run_simulated
from loaded_script import load

from flexdt.clients.cli.command_tree import run as run_command
from flexdt.twin.projection import forward, gpu
from flexdt_extensions.bench import benchmark as run
from flexdt_extensions.bench import device_page
from flexdt_extensions.bench.benchmark import (
    Case,
    circle,
    errors,
    exact_images,
    interleaved,
    noise,
    peer_cases,
    sorted_crossings,
    untuned_cases,
)
from flexdt_extensions.bench.peers import Peer

SHAPE = (30, 40)
PAGE = load(Path(__file__).parents[3] / "docs" / "tools" / "bench_page.py")


class Doubled:
    """A peer that is wrong by a factor."""

    def __init__(self, volume, geometry, shape) -> None:
        self.arguments = (volume, geometry, shape)

    def run(self) -> None:
        self.result = 2 * forward(*self.arguments)

    def images(self):
        return self.result

    def close(self) -> None:
        del self.arguments


@pytest.fixture
def small(monkeypatch):
    def cases():
        view = circle(2, SHAPE, pitch=0.5, tilt_deg=(1.0, 2.0, 3.0))
        return [Case("C1", lambda: noise((16, 12, 10)), view, SHAPE, True, "small")]

    monkeypatch.setattr(run, "all_cases", cases)
    monkeypatch.setattr(
        run,
        "peers",
        lambda: [
            Peer("doubled", None, False, Doubled),
            Peer("absent", "not installed", False, Doubled),
        ],
    )
    monkeypatch.setenv(
        "NUMBA_DISABLE_CUDA", "0"
    )  # the command sets it: undone after the test


def test_document_has_the_published_shape(small) -> None:
    document = run.run_bench()
    (case,) = document["cases"]
    assert case["name"] == "C1"
    assert case["views"] == 2
    assert 0 < case["ms_per_view"] <= case["median_ms_per_view"]
    assert case["mean_error"] < 3e-7
    assert case["worst_error"] < 3e-6
    assert case["reference_check"] < 1e-6
    assert list(case["peers"]) == ["doubled"]
    # The peer's error is the mean of the images themselves, as a share of the maximum.
    assert 0.01 < case["peers"]["doubled"]["mean_error"] < 1
    assert case["ratio"]["doubled"] > 0
    assert document["machine"]["peers"] == {
        "doubled": "took part",
        "absent": "not installed",
    }
    assert case["measured"] == document["machine"]["measured"]
    json.dumps(document)


def test_json_goes_to_standard_output_alone(small, monkeypatch, capsys, tmp_path) -> None:
    assert run_command(["bench", "--json", "--only", "C1", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["cases"][0]["name"] == "C1"
    head, load, line = printed.err.splitlines()[:3]
    assert "ms of wall time a view" in head
    assert re.match(r"load [\d.]+ on \d+ cores; other processes", load)
    assert line.startswith("C1")
    assert json.loads((tmp_path / "bench.json").read_text())["cases"]
    arguments = [str(tmp_path / "bench.json"), "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["bench_page.py", *arguments])
    PAGE.main()
    assert "| C1 |" in (tmp_path / "bench.md").read_text()
    assert ET.parse(tmp_path / "bench.svg").getroot().tag.endswith("svg")


def test_figure_shows_ratios_and_growth() -> None:
    points = [
        {"series": s, "x": x, "ms": 0.1 * x}
        for s in ("level", "tilted")
        for x in (1, 2, 4)
    ]
    document = {
        "cases": [{"name": "C<1>", "ratio": {"itk-rtk": 12.34}}],
        "growth": {"threads": points},
    }
    text = PAGE.figure(document)
    root = ET.fromstring(text)
    words = "".join(root.itertext())
    assert "12.3" in words
    assert "C<1>" in words
    assert len(root.findall(".//{*}polyline")) == 2
    assert "no peer" in PAGE.figure({"cases": []})


def test_a_page_gets_its_figures_between_the_marks(small) -> None:
    document = run.run_bench()
    page = f"# Title\n{PAGE.BEGIN}\nold\n{PAGE.END}\nthe rest\n"
    renewed = PAGE.into_page(page, document, "images/bench.svg")
    assert "old" not in renewed
    assert renewed.startswith("# Title")
    assert renewed.endswith("the rest\n")
    assert "| C1 |" in renewed
    assert PAGE.into_page(renewed, document, "images/bench.svg") == renewed
    with pytest.raises(ValueError, match="marks"):
        PAGE.into_page("no marks", document, "")


def test_a_page_keeps_what_was_not_run_again(small, monkeypatch, tmp_path) -> None:
    page = tmp_path / "performance.md"
    page.write_text(f"# Title\n{PAGE.BEGIN}\n{PAGE.END}\n", "utf-8")
    monkeypatch.setattr(
        further_bench,
        "growth_with_threads",
        lambda: [{"series": "level", "x": 1, "ms": 7.5}],
    )
    further = ["--no-peers", "--only", "growth-threads"]
    words = ["bench", "--out", str(tmp_path / "out")]
    for main, arguments in (
        (lambda: run_command(sys.argv), ["--only", "C1"]), (further_bench.main, further)
    ):  # fmt: skip
        monkeypatch.setattr(sys, "argv", [*words, *arguments])
        main()
        document = str(tmp_path / "out" / "bench.json")
        monkeypatch.setattr(sys, "argv", ["bench_page.py", document, "--page", str(page)])
        PAGE.main()
    text = page.read_text("utf-8")
    assert "doubled" in text
    assert "| C1 |" in text
    assert "- ms against threads, level: 1: 7.50" in text
    kept = json.loads((tmp_path / "images" / "bench.json").read_text("utf-8"))
    assert [case["name"] for case in kept["cases"]] == ["C1"]
    once_more = {
        **kept,
        "cases": [{**kept["cases"][0], "views": 9}, {"name": "new"}],
        "growth": {},
    }
    together = PAGE.merged(kept, once_more)
    assert [(c["name"], c.get("views")) for c in together["cases"]] == [
        ("C1", 9),
        ("new", None),
    ]
    assert together["growth"] == kept["growth"]


def test_short_calls_get_more_rounds() -> None:
    timing = interleaved(
        {"short": lambda: None, "long": lambda: time.sleep(0.02)}, budget_s=0.2
    )
    assert timing["short"].calls > 100
    assert 3 <= timing["long"].calls <= 15


def test_cases_are_those_of_the_targets() -> None:
    names = [case.name for case in peer_cases()]
    assert names[:8] == [
        "C1",
        "C2",
        "C3",
        "C1x36",
        "C2x10",
        "C1-tilt",
        "C2-tilt",
        "C3-tilt",
    ]
    assert names[8:] == [
        "above-30",
        "above-45",
        "above-60",
        "above-75",
        "row",
        "small-tilt",
    ]
    geometry = {case.name: case.geometry for case in [*peer_cases(), *untuned_cases()]}
    assert len(geometry["C1x36"]) == 36
    c1, tilted = geometry["C1"], geometry["C1-tilt"]
    assert c1.source_detector_distance[0] == pytest.approx(1059)
    assert not c1.v[0, :2].any()
    assert np.linalg.norm(tilted.u[0]) == pytest.approx(0.1496)
    assert abs(tilted.v[0] @ tilted.u[0]) < 1e-12
    above = geometry["above-30"]
    assert above.source[:, 2] == pytest.approx(np.full(8, 300.0))
    assert above.detector[:, 2] == pytest.approx(np.full(8, -229.5))
    on_axis = geometry["on-axis"]
    assert on_axis.source[0] == pytest.approx([0, -600, 0], abs=1e-9)
    corner = on_axis.pixel_centers((760, 956))[0]
    assert corner.shape == (760, 956, 3)


def test_sixty_degrees_are_sixty() -> None:
    case = next(c for c in untuned_cases() if c.name == "cone-60")
    ends = case.geometry.pixel_centers(case.shape)[0]
    a, b = (p - case.geometry.source[0] for p in (ends[0, 0], ends[-1, -1]))
    angle = np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
    assert angle == pytest.approx(60, abs=0.1)


def test_two_exact_methods_agree() -> None:
    volume, view = (
        noise((9, 8, 7), 0.3),
        circle(2, SHAPE, pitch=0.5, tilt_deg=(3.0, 2.0, 1.0)),
    )
    exact = exact_images(volume, view, SHAPE)
    pixels = np.array(
        [[v, r, c] for v in (0, 1) for r in (3, 15, 22) for c in (4, 20, 33)]
    )
    second = sorted_crossings(volume, view, SHAPE, pixels)
    assert second.max() > 0.1
    assert np.abs(exact[tuple(pixels.T)] - second).max() < 1e-6 * second.max()


def test_timing_takes_turns_and_spares_the_slow() -> None:
    order = []
    timing = interleaved(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")},
        once=frozenset({"b"}),
        budget_s=0.0,
    )
    assert order[:3] == ["a", "a", "b"]
    assert timing["b"].calls == 1
    assert timing["a"].calls >= 3
    assert timing["a"].best <= timing["a"].median


def test_errors_are_shares_of_the_maximum() -> None:
    exact = np.array([[0.0, 4.0]], np.float32)
    assert errors(exact + np.float32(0.5), exact) == (0.125, 0.125)


def entry(name, **figures):
    return {"name": name, "mean_error": None, "worst_error": None, "ratio": {}, **figures}


def test_targets_are_judged_from_the_document() -> None:
    document = {
        "cases": [
            entry("C1", ratio={"itk-rtk": 19.0}, mean_error=2e-7, worst_error=4e-6),
            entry("C1x36", ratio={"itk-rtk": 16.0}),
            entry("C1-tilt", ratio={"itk-rtk": 3.0}),
            entry("near", mean_error=1e-7, worst_error=2e-5),
            entry("scene-C1", ms_per_view=1.0),
            entry("FDK", ratio={"itk-rtk": 14.0}, mean_error=0.01),
            entry("adjoint-C1", times_forward=1.2),
            entry("adjoint-C1-new", times_forward=1.9),
            entry("adjoint-on-axis", times_forward=2.2),
        ]
    }
    rows = {
        line.split(" | ")[0].strip("| "): line for line in PAGE.target_table(document)
    }
    assert rows["C1, level"].endswith("| 10.0 x | 20.0 x | 19.0 x | minimum met |")
    assert rows["C2, level"].endswith("| not measured | |")
    # 71 ms against 153 ms: LEAP is 2.15 times as fast as what we are compared with.
    leap = rows["C1, 36 views, against the best LEAP"]
    assert "| 5.0 x |  | 7.4 x (derived" in leap
    assert leap.endswith("minimum met |")
    assert rows["C1, tilted, any processor"].endswith("minimum met |")
    assert rows["C1, tilted, with AVX-512"].endswith("**missed** |")
    assert "2e-07 (worst: C1) | goal met" in rows["mean error, all cases"]
    assert "2e-05 (worst: near) | **missed**" in rows["worst error, all cases"]
    assert rows["bead phantom on C1's detector"].endswith("| 1.0 ms | goal met |")
    assert rows["FDK"].endswith("goal met |")
    assert (
        "1.20 x (worst: adjoint-C1) | minimum met"
        in rows["adjoint against forward, C1 to C3"]
    )
    assert "2.20 x" in rows["adjoint against forward, cases nobody tuned for"]


def test_a_page_says_which_cases_are_of_another_run(small) -> None:
    document = run.run_bench()
    old = {
        **document,
        "cases": [dict(document["cases"][0], name=n) for n in ("A", "B", "C1")],
    }
    for case in old["cases"]:
        case["measured"] = "2001-01-01T00:00+00:00"
    page = PAGE.into_page(f"{PAGE.BEGIN}{PAGE.END}", PAGE.merged(old, document), "")
    assert "These cases come from a different run: C1." in page
    assert "another run" not in PAGE.into_page(f"{PAGE.BEGIN}{PAGE.END}", document, "")


def test_no_peers_means_none(small) -> None:
    document = run.run_bench(with_peers=False)
    assert document["machine"]["peers"] == {}
    assert not document["cases"][0]["peers"]


def test_the_list_names_every_case(capsys) -> None:
    assert run_command(["bench", "--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == run.case_names()


@pytest.mark.skipif(gpu.availability().present, reason="this machine has a device")
def test_the_page_of_a_device_needs_one(capsys) -> None:
    assert run_command(["bench", "--device"]) == 2
    assert "--device needs a CUDA device: no CUDA driver" in capsys.readouterr().err


DEVICE = """
import sys, json
from pathlib import Path
from flexdt.clients.cli import main
from flexdt_extensions.bench import device_page
from flexdt.twin.projection import gpu
from flexdt.twin.projection.kernels import gpu_kernels
from flexdt.twin.reconstruction.kernels import gpu_reconstruction_kernels as gpu_fdk_kernels

gpu_kernels.BLOCK = gpu_fdk_kernels.BLOCK = gpu_fdk_kernels.PLANE = (4, 2)
gpu_fdk_kernels.THREADS = 8
gpu_kernels.FOLDING = (1, 4)
gpu.LINEAR, gpu.VIEWS_A_THREAD, device_page.ROUNDS = 64, 0.0, 1
device_page.BESIDE_S = 0.0
sizes = ((4, 3, 3), 12.0), ((3, 4, 3), 12.0), ((3, 3, 3), 9.0)
device_page.SIZES = dict(zip(("C1", "512^3", "1024^3"), sizes))
device_page.COUNTS, device_page.PANEL, device_page.FDK_VIEWS = (1, 2, 3), (3, 4), 6
plain = device_page.circle
device_page.circle = lambda views, shape: plain(views, shape, pitch=20.0)
real = device_page.on_the_clock
device_page.on_the_clock = lambda work, rounds=1: real(work, 1)
device_page.by_events = real  # the simulator has no clock of its own
device_page.astra_ms = lambda volume, scan, algorithm: 1.0 if algorithm == "FP3D_CUDA" else None
device_page.KINDS = {kind: device_page.KINDS[kind] for kind in ("whole", "noise")}
main(["bench", "--device", "--out", sys.argv[1]])
"""


@pytest.mark.slow
@pytest.mark.campaign
def test_the_page_of_a_device_has_every_target(tmp_path) -> None:
    run_simulated(DEVICE, str(tmp_path))
    document = json.loads((tmp_path / "device.json").read_text("utf-8"))
    lines = {line["target"]: line for line in document["targets"]}
    assert len(lines) == len(document["targets"]) == 3 * 9 + 2 + 2 * 4
    for name in ("C1", "512^3", "1024^3"):
        assert lines[f"{name}: worst error"]["met"] == "wanted"
        assert lines[f"{name}: part of the bound, 3 views"]["met"] == "not measured"
        count = 2 if name == "1024^3" else 3
        seen = document["cases"][name][str(count)]
        share = lines[f"{name}: forward kernel / ASTRA, {count} views"]["measured"]
        assert share == seen["kernel_ms"] / seen["astra_ms"]
        for count in (1, 2):
            seen = document["cases"][name][str(count)]
            ratio = lines[f"{name}: back of {count} views / the processor's"]["measured"]
            assert ratio == seen["back_call_ms"] / seen["back_processor_ms"]
    assert lines["FDK: backprojection / ASTRA BP3D"]["measured"] is None
    for kind in ("whole", "noise"):
        assert lines[f"FDK of 6 views, {kind}, host to host [s]"]["measured"] > 0
        assert lines[f"FDK of 6 views, {kind}, with errors / without"]["measured"] > 0
    assert lines["FDK of 6 views, whole, over an object seen whole"]["measured"] == 1.0
    text = (tmp_path / "device.md").read_text("utf-8")
    assert all(f"| {target} |" in text for target in lines)
    assert re.search(
        r"not measured: (astra-toolbox is not installed|the device does not say)", text
    )


@pytest.mark.parametrize("installed", [False, True])
def test_the_page_of_a_device_says_why_astra_takes_no_part(
    monkeypatch, installed
) -> None:
    missing = "astra-toolbox is not installed"
    monkeypatch.setattr(
        device_page, "absent", lambda name: None if installed else missing
    )
    monkeypatch.setitem(sys.modules, "astra", None)  # as if a library of its did not load
    why = device_page.why_no_astra()
    assert why is not None
    assert why.startswith("astra-toolbox does not load: " if installed else missing)


def test_a_contestant_may_time_itself() -> None:
    timing = interleaved({"own": lambda: 12.5, "none": lambda: None}, budget_s=0.0)
    assert timing["own"].best == 12.5
    assert timing["none"].best < 12.5
