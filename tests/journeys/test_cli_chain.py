"""From a wish to a calibrated twin with commands alone: script new, run, calibrate, compare."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers

pytestmark = pytest.mark.slow
TRUTH = {
    "dO_x": 0.61,
    "dO_y": -0.37,
    "dO_z": 1.4,
    "alpha": -2.3,
    "tau_x": 0.2,
    "tau_z": 0.3,
}
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def misaligned(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[Servers, Path]]:
    folder = tmp_path_factory.mktemp("chain")
    truth = folder / "truth.toml"
    truth.write_text("".join(f"{k} = {v}\n" for k, v in TRUTH.items()))
    options = {"data": folder / "data", "truth": truth, "speed-up": "max"}
    with Servers(options, folder / "servers.log") as servers:
        yield servers, folder


@pytest.fixture
def flexdt(misaligned: tuple[Servers, Path], capsys: pytest.CaptureFixture[str]) -> Run:
    server = ["--server", "{}:{}".format(*misaligned[0].address)]

    def call(*words: object, talk: bool = False) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run([*map(str, words), *(server if talk else [])])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return code, captured.out, captured.err

    return call


@pytest.fixture
def dataset(misaligned: tuple[Servers, Path], flexdt: Run) -> Path:
    folder = misaligned[1]
    script = folder / "scan.txt"
    if not script.exists():
        words = ["--kind", "fly", "--frames", 24, "--averages", 10, "--out", script]
        assert flexdt("script", "new", *words)[0] == 0
        code, _, err = flexdt(
            "run", script, "--out", "beads", "--sample", "normal-5", talk=True
        )
        assert code == 0, err
    return folder / "data" / "beads"


def test_calibrate_finds_the_truth_and_pushes_it(
    flexdt: Run, dataset: Path, tmp_path: Path
) -> None:
    page = tmp_path / "r.html"
    code, out, err = flexdt(
        "calibrate", dataset, "--phantom", "normal-5", "--report", page, "--push", "--json",
        talk=True,
    )  # fmt: skip
    assert code == 0, err
    document: dict[str, Any] = json.loads(out)
    assert page.read_text().lstrip().lower().startswith("<!doctype html>")
    for name, true in TRUTH.items():
        found = document["parameters"][name]
        assert abs(found["value"] - true) < 4 * found["sigma"], name
        assert found["images"] < (0.25 if name == "dO_z" else 0.2), name
    state = json.loads(flexdt("state", "--json", talk=True)[1])
    assert state["correction"]["parameters"]["dO_x"] == pytest.approx(
        TRUTH["dO_x"], abs=0.02
    )


def test_a_push_to_nobody_is_refused_before_the_work(
    flexdt: Run, dataset: Path, tmp_path: Path
) -> None:
    report = tmp_path / "r.json"
    code, _, err = flexdt(
        "calibrate", dataset, "--phantom", "normal-5", "--report", report, "--push",
        "--server", "127.0.0.1:1",
    )  # fmt: skip
    assert code == 4
    assert "127.0.0.1:1" in err
    assert not report.exists()


@pytest.mark.campaign(1)
def test_compare_is_within_after_and_not_before(
    flexdt: Run, dataset: Path, tmp_path: Path
) -> None:
    words = ["compare", dataset, "--phantom", "normal-5"]
    code, out, _ = flexdt(*words, "--out", tmp_path, "--json")
    assert code == 0
    document = json.loads(out)
    assert document["before"]["rms_px"] > 5 > 0.5 > document["after"]["rms_px"]
    assert (tmp_path / "report.html").is_file()
    assert len(list(tmp_path.glob("difference_*_after.tif"))) >= 2
    code, _, err = flexdt(*words, "--tolerance", 1e-6)
    assert code == 1
    assert "allowed 1e-06 px" in err


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["calibrate", "{data}", "--phantom", "shepp-logan"], 1, "no beads"),
        (["calibrate", "{data}", "--phantom", "nobody"], 1, "nobody"),
        (["calibrate", "{data}", "--phantom", "normal-5", "--free", "warp"], 1, "warp"),
        (
            ["calibrate", "{data}", "--phantom", "normal-5", "--report", "x.pdf"],
            2,
            ".html",
        ),
        (["calibrate", "/nowhere", "--phantom", "normal-5"], 1, "/nowhere"),
        (["calibrate", "{data}"], 2, "--phantom"),
        (["compare", "/nowhere", "--phantom", "normal-5"], 1, "/nowhere"),
    ],
)
def test_refusals(
    flexdt: Run, dataset: Path, words: list[str], code: int, says: str
) -> None:
    found, out, err = flexdt(*(word.format(data=dataset) for word in words))
    assert found == code, err
    assert says in err
    assert out == ""
