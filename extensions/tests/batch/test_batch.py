"""Batches: equal bytes in any order and number of processes, crashes survived, plans judged."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.library.failure import CommandError
from flexdt.twin.calibration import fits_of_scans
from flexdt.twin.calibration.detect.detection import SpotFinder
from flexdt.twin.calibration.detect.refine import Refined
from flexdt.twin.calibration.frame_source import SpotFrames
from flexdt.twin.calibration.pipeline import Scan, calibrate
from flexdt.twin.physics.exposure import expose, ideal_response
from flexdt.twin.projection import project_scene
from flexdt_extensions.batch import work
from flexdt_extensions.batch.batch_plan import Plan, parse, parse_plan, read_plan
from flexdt_extensions.batch.batch_run import figures, run_batch
from flexdt_extensions.batch.work import draw_item, item_bytes, layout, run_item, seed_of
from flexdt_extensions.executors import Slurm, job_script, read_slurm

pytestmark = pytest.mark.timeout(300)

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "batch"
ITEMS = 40
SPHERES: dict[str, Any] = {
    "batch": {"name": "small", "kind": "projections", "items": 8, "seed": 11},
    "phantom": {
        "spheres": {
            "count": {"integers": [1, 3]},
            "radius_mm": {"uniform": [2.0, 4.0]},
            "within_radius_mm": 12.0,
            "within_height_mm": 20.0,
        }
    },
    "geometry": {"sod_mm": {"uniform": [500.0, 700.0]}, "frames": 3},
    "camera": {"shape": [24, 32], "pixel_mm": 2.0},
    "errors": {"dD_x": {"normal": [0.0, 0.5]}},
}


def varied(*changes: tuple[str, Any]) -> dict[str, Any]:
    """The plan above with some keys set (None: gone)."""
    document = json.loads(json.dumps(SPHERES))
    for path, value in changes:
        *parents, last = path.split(".")
        table = document
        for key in parents:
            table = table.setdefault(key, {})
        if value is None:
            table.pop(last)
        else:
            table[last] = value
    return document  # type: ignore[no-any-return]


def toml(document: dict[str, Any]) -> str:
    """Tables and inline values, as far as these plans need them."""
    lines: list[str] = []

    def inline(value: Any) -> str:
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{k} = {inline(v)}" for k, v in value.items()) + " }"
        return json.dumps(value)

    for name, table in document.items():
        lines += [f"[{name}]", *(f"{k} = {inline(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"


@pytest.fixture
def plan_file(tmp_path: Path) -> Callable[..., Path]:
    def made(*changes: tuple[str, Any]) -> Path:
        path = tmp_path / "plan.toml"
        path.write_text(toml(varied(*changes)), encoding="utf-8")
        return path

    return made


def files(folder: Path) -> dict[str, str]:
    """Every file of a batch that must not depend on how it was made -> sha256."""
    found = [p for p in (folder / "data.zarr").rglob("*") if p.is_file()]
    found += [folder / "manifest.json", folder / "items.jsonl"]
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in found
    }


def here(path: Path, out: Path) -> dict[str, Any]:
    """A batch in this process, without the seconds that fresh processes need to start."""
    return run_batch(read_plan(path), out, ThreadPoolExecutor(1))


# -- equal bytes ---------------------------------------------------------------------------------


@pytest.mark.campaign(1)
def test_two_numbers_of_processes_give_equal_manifests_and_chunks(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    path = plan_file(("reconstruct", {"voxel_mm": 2.0, "shape": [8, 12, 12]}))
    for jobs in (1, 3):
        assert (
            run(
                [
                    "batch",
                    str(path),
                    "--out",
                    str(tmp_path / f"j{jobs}"),
                    "--jobs",
                    str(jobs),
                ]
            )
            == 0
        )
    one, three = files(tmp_path / "j1"), files(tmp_path / "j3")
    assert one == three
    assert (
        len([n for n in one if "/c/" in n]) == 8 * 4 + 2
    )  # a chunk an item and array; tables


@pytest.mark.slow
@pytest.mark.campaign
def test_a_killed_batch_goes_on_where_it_was(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    path = plan_file(
        ("batch.items", ITEMS), ("geometry.frames", 12), ("camera.shape", [192, 256])
    )
    out = tmp_path / "killed"
    words = [
        sys.executable,
        "-m",
        "flexdt.clients.cli",
        "batch",
        str(path),
        "--jobs",
        "2",
    ]
    first = subprocess.Popen([*words, "--out", str(out)], stderr=subprocess.DEVNULL,
                             stdout=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
    log = out / "items.jsonl"
    deadline = time.monotonic() + 120
    while not (log.exists() and log.read_bytes().count(b"\n") > 5):
        assert first.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.005)
    os.kill(first.pid, signal.SIGKILL)
    first.wait(30)
    assert not (out / "manifest.json").exists()
    wait_until_alone(first.pid)
    with log.open("ab") as file:
        file.write(b'{"index": 39, "seed')  # a line that the crash cut short
    # A chunk that the crash cut short, as Zarr names it.
    (out / "data.zarr" / "projections" / f"c.{'0' * 32}.partial").write_bytes(b"half")
    done = subprocess.run(
        [*words, "--out", str(out), "--json"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert 5 <= summary["resumed"] < ITEMS
    assert summary["computed"] == ITEMS - summary["resumed"]
    here(path, tmp_path / "whole")
    assert files(out) == files(tmp_path / "whole")
    assert run(["batch", str(path), "--out", str(out)]) == 0  # nothing is missing
    assert json.loads((out / "run.json").read_text())["computed"] == 0
    assert files(out) == files(tmp_path / "whole")


def wait_until_alone(group: int) -> None:
    """Workers of a killed batch end by themselves; nobody else kills them."""
    deadline = time.monotonic() + 60
    while True:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        assert time.monotonic() < deadline, "workers outlived their batch"
        time.sleep(0.05)


def test_any_item_can_be_made_alone(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    import zarr

    path = plan_file()
    here(path, tmp_path / "out")
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    plan = read_plan(path)
    alone = run_item(plan.text, 5)
    assert alone.record == manifest["items"][5]
    root = zarr.open_group(tmp_path / "out" / "data.zarr", mode="r")
    for name, values in alone.arrays.items():
        np.testing.assert_array_equal(root[name][5], values)
        sha256 = hashlib.sha256(np.ascontiguousarray(root[name][5]).tobytes()).hexdigest()
        assert manifest["items"][5]["sha256"][name] == sha256
    truth = root["truth"]
    assert truth.attrs["parameters"] == ["dD_x"]
    drawn = [i["parameters"]["errors"]["dD_x"] for i in manifest["items"]]
    np.testing.assert_array_equal(truth[:, 0], drawn)


def test_what_an_item_weighs_is_what_its_arrays_weigh() -> None:
    plan = parse_plan(varied(("reconstruct", {"voxel_mm": 2.0, "shape": [8, 12, 12]})))
    made = run_item(plan.text, 0)
    assert item_bytes(plan) == sum(a.nbytes for a in made.arrays.values())


def test_seeds_are_numpys_spawned_ones() -> None:
    plan = parse_plan(varied())
    for i, child in enumerate(np.random.SeedSequence(11).spawn(8)):
        ours = seed_of(plan, i)
        assert ours.generate_state(4).tolist() == child.generate_state(4).tolist()
        theirs = child.spawn(2)[1]
        assert (
            seed_of(plan, i, 1).generate_state(4).tolist()
            == theirs.generate_state(4).tolist()
        )
    drawn = [draw_item(plan, i).parameters["sod_mm"] for i in range(8)]
    assert len(set(drawn)) == 8
    other = parse_plan(varied(("batch.seed", 12)))
    assert draw_item(other, 0).parameters["sod_mm"] != drawn[0]


# -- what is in it -------------------------------------------------------------------------------


def test_images_are_the_spheres_chords_seen_with_the_hidden_geometry() -> None:
    """By hand: chord of each ray through each sphere, from cone_vec alone."""
    plan = parse_plan(varied(("images", {"noise": False})))
    made = run_item(plan.text, 2)
    cone, images = made.arrays["cone_vec_true"], made.arrays["projections"]
    assert not np.array_equal(cone, made.arrays["cone_vec_nominal"])
    spheres = made.record["parameters"]["phantom"]["spheres"]
    mu = {s["material"]: draw_item(plan, 2).phantom.scene.solids[i].mu_per_mm
          for i, s in enumerate(spheres)}  # fmt: skip
    rows, cols = 24, 32
    r, c = np.mgrid[0:rows, 0:cols]
    for row, image in zip(cone, images, strict=True):
        source, centre, u, v = (row[i : i + 3] for i in (0, 3, 6, 9))
        x, y = c[..., None] - (cols - 1) / 2, r[..., None] - (rows - 1) / 2
        pixels = centre + x * u + y * v
        ray = pixels - source
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        total = np.zeros((rows, cols))
        for s in spheres:
            to = np.asarray(s["center_mm"]) - source
            off = np.sum(to**2) - (ray @ to) ** 2
            total += (
                mu[s["material"]]
                * 2
                * np.sqrt(np.clip(s["radius_mm"] ** 2 - off, 0, None))
            )
        np.testing.assert_allclose(image, total, atol=2e-4)
    assert images.max() > 0.03


def test_noise_has_the_detectors_size_and_is_the_items_own() -> None:
    clean = run_item(parse_plan(varied(("images", {"noise": False}))).text, 0)
    noisy = run_item(parse_plan(varied(("images", {"noise": True}))).text, 0)
    lines, seen = clean.arrays["projections"], noisy.arrays["projections"]
    item = draw_item(parse_plan(varied()), 0)
    model = ideal_response(item.machine)
    counts = expose(model, lines[0], item.exposure) - model.dark_counts
    variance = counts / model.photons_per_count + model.read_noise_counts**2 + 1 / 12
    pulls = (seen[0] - lines[0]) * counts / np.sqrt(variance)
    assert abs(pulls.mean()) < 5 / math.sqrt(pulls.size)
    assert 0.9 < pulls.std() < 1.1
    assert not np.array_equal(seen[0] - lines[0], seen[1] - lines[1])


def test_the_panels_counts_are_deterministic_and_darker_behind_the_phantom() -> None:
    plan = read_plan(EXAMPLES / "panel.toml")
    made = run_item(plan.text, 0)
    again = run_item(plan.text, 0)
    np.testing.assert_array_equal(made.arrays["projections"], again.arrays["projections"])
    counts = made.arrays["projections"][0]
    assert counts.dtype == np.uint16
    item = draw_item(plan, 0)
    lines = project_scene(
        item.phantom.scene, item.poses.cone_vec(item.truth), item.shape
    )[0]
    thin, thick = np.quantile(lines, [0.1, 0.9])
    assert thick > thin + 0.3
    assert counts[lines >= thick].mean() < 0.85 * counts[lines <= thin].mean()


def test_a_reconstruction_finds_a_sphere_where_it_is() -> None:
    document = varied(
        ("phantom.spheres.count", 1), ("phantom.spheres.radius_mm", 4.0),
        ("geometry.frames", 60), ("images", {"noise": False}), ("errors", {}),
        ("camera", {"shape": [48, 64], "pixel_mm": 1.0}),
        ("reconstruct", {"voxel_mm": 1.0, "shape": [24, 28, 28]}),
    )  # fmt: skip
    made = run_item(parse_plan(document).text, 0)
    volume = made.arrays["volumes"]
    (sphere,) = made.record["parameters"]["phantom"]["spheres"]
    z, y, x = np.meshgrid(
        *(np.arange(n) - (n - 1) / 2 for n in volume.shape), indexing="ij"
    )
    inside = volume > 0.5 * volume.max()
    centre = [float(axis[inside].mean()) for axis in (x, y, z)]
    np.testing.assert_allclose(centre, sphere["center_mm"], atol=0.4)


@pytest.mark.slow
def test_calibrations_err_as_much_as_they_say() -> None:
    plan = read_plan(EXAMPLES / "calibrations.toml")
    records = [run_item(plan.text, i).record for i in range(40)]
    used = [r for r in records if r["identifiable"]]
    assert len(used) > 20
    pulls = np.array(
        [[r["errors"][n] / r["sigmas"][n] for n in r["errors"]] for r in used]
    )
    # 1 for honest sigmas; (runs x 6) values bound the sample's spread well inside this.
    assert 0.7 < pulls.std() < 1.4
    for record in records:
        if not record["identifiable"]:
            assert set(record["errors"].values()) == {None}


@pytest.mark.slow
@pytest.mark.parametrize("priors", [None, "none", {"dD_x": 0.1}])
def test_points_and_images_state_the_same_sigmas(
    priors: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One model of what is known, and one search for causes: of the same positions both state
    the same, but for how beads fade behind the body, which points do not have. What a cause
    may hide depends on how far the errors look like it, so that of other draws of the same
    noise dO_x differs by a factor of two."""
    monkeypatch.setattr(fits_of_scans, "_common", lambda state: None)
    document = json.loads(read_plan(EXAMPLES / "calibrations.toml").text)
    document["calibrate"] |= {"priors": priors, "noise_px": 0.005}
    document["geometry"]["frames"] = 12
    document["phantom"] = {"name": "normal-5"}
    measured: list[Refined] = []

    def calibrated(scans: Any, *args: Any, **options: Any) -> Any:
        (scan,) = scans
        if measured:
            scan = moved(scan, measured[0])
        result = calibrate([scan], *args, **options)
        measured.extend(result.measured)
        return result

    monkeypatch.setattr(work, "calibrate", calibrated)
    sigmas = []
    for fidelity in ("images", "points"):
        document["calibrate"]["fidelity"] = fidelity
        sigmas.append(run_item(parse_plan(document).text, 0).record["sigmas"])
    for name, sigma in sigmas[1].items():
        assert sigma == pytest.approx(sigmas[0][name], rel=0.1), name
    assert (sigmas[0]["dO_x"] > 0.01) == (priors != "none")


def moved(scan: Scan, seen: Refined) -> Scan:
    """The same beads at the positions of a second measurement."""
    looks = []
    for i, look in enumerate(scan.frames.look(SpotFinder())):
        assert scan.index is not None
        assert scan.index[i].tolist() == list(range(len(seen.tracks[i])))
        spots = replace(
            look.detections,
            centers=seen.tracks[i],
            covariances=seen.covariances[i],
            bias=seen.bias[i],
        )
        looks.append(replace(look, detections=spots))
    return replace(scan, frames=SpotFrames(looks))


def test_points_of_much_noise_are_offered() -> None:
    """Their scatter is stated: it is no misfit, however large."""
    document = json.loads(read_plan(EXAMPLES / "calibrations.toml").text)
    document["calibrate"]["noise_px"] = 3.0
    document["phantom"] = {"name": "normal-5"}
    record = run_item(parse_plan(document).text, 0).record
    assert record["identifiable"], record["note"]
    assert 2.0 < record["rms_px"] < 4.0


def test_priors_of_a_plan_are_checked() -> None:
    document = json.loads(read_plan(EXAMPLES / "calibrations.toml").text)
    for priors, said in (
        ({"dO_w": 1.0}, "unknown parameter 'dO_w'"),
        ({"dO_x": 0.0}, "dO_x is free, and its prior is 0"),
        ({"dD_x": -1.0}, "calibrate.priors"),
        ("some", "calibrate.priors"),
    ):
        document["calibrate"]["priors"] = priors
        with pytest.raises(CommandError, match=said):
            parse_plan(document)


def test_figures_of_calibrations_are_those_of_its_items() -> None:
    def item(error: float | None) -> dict[str, Any]:
        sigma = None if error is None else 0.5
        return {"identifiable": error is not None, "errors": {"alpha": error},
                "sigmas": {"alpha": sigma}}  # fmt: skip

    found = figures([item(0.5), item(-2.0), item(None), {"status": "failed"}])
    assert (found["judged"], found["identifiable"]) == (3, 2)
    expected = {"mae": 1.25, "rms_pull": math.sqrt((1 + 16) / 2), "within_95": 0.5}
    assert found["parameters"]["alpha"] == pytest.approx(expected)
    assert figures([{"status": "done"}]) == {}


@pytest.mark.slow
def test_calibrations_from_images() -> None:
    document = json.loads(read_plan(EXAMPLES / "calibrations.toml").text)
    document["calibrate"]["fidelity"] = "images"
    document["phantom"]["cuboid"] |= {"beads": 5}
    document["geometry"]["frames"] = 12
    record = run_item(parse_plan(document).text, 0).record
    assert record["status"] == "done"
    assert record["identifiable"], record
    errors = {name: abs(error) for name, error in record["errors"].items()}
    assert all(error < 3.0 * record["sigmas"][name] for name, error in errors.items())
    assert max(errors["alpha"], errors["tau_x"], errors["tau_z"]) < 0.02


def test_an_item_that_cannot_be_is_named_and_the_others_go_on(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    path = plan_file(("phantom.spheres.count", {"choice": [1, 200]}))
    summary = here(path, tmp_path / "out")
    assert 0 < summary["failed"] < 8
    assert summary["failed"] + summary["done"] == 8
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    failed = [i for i in manifest["items"] if i["status"] == "failed"]
    assert all("found no free place" in i["error"] for i in failed)


def test_a_worker_that_dies_ends_the_run_and_what_is_done_stays(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    class Mortal(ThreadPoolExecutor):
        left = 3

        def submit(self, *args: Any, **kwargs: Any) -> Any:
            if not self.left:
                raise BrokenProcessPool("killed")
            self.left -= 1
            return super().submit(*args, **kwargs)

    path, out = plan_file(), tmp_path / "out"
    with pytest.raises(CommandError, match=r"a worker died .*run the command again"):
        run_batch(read_plan(path), out, Mortal(1))
    assert not (out / "manifest.json").exists()
    assert here(path, out)["done"] == 8
    here(path, tmp_path / "whole")
    assert files(out) == files(tmp_path / "whole")


# -- plans ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([("geometry.sod_mm", {"uniform": [700.0, 500.0]})], "geometry.sod_mm: uniform takes the"),
        ([("geometry.sod_mm", -3.0)], "geometry.sod_mm: values must be above 0"),
        ([("geometry.sod_mm", {"normal": [600.0, 1.0]})], "values must be above 0 (a normal"),
        ([("geometry.sod_mm", 2000.0)], "geometry: sod_mm must stay below sdd_mm"),
        ([("geometry.frames", "many")], "geometry.frames: allowed: a whole number"),
        ([("batch.items", 0)], "batch.items: allowed: at least 1"),
        ([("batch.kind", "movies")], "batch.kind: allowed: 'projections' or"),
        ([("phantom.name", "lego")], "phantom: give one of name, cuboid, spheres"),
        ([("phantom.spheres.count", 1.5)], "phantom.spheres.count: whole numbers are needed"),
        ([("camera.pixel_mm", None)], "camera: shape and pixel_mm go together"),
        ([("errors.dD_q", 1.0)], "errors: unknown parameters ['dD_q']; allowed: dO_x"),
        ([("images", {"physics": "poly"})], "images.physics poly models the machine's panel"),
        ([("speed", {"up": 1})], "speed: there is no such name"),
        ([("geometry.start_deg", {"dice": [1]})], "geometry.start_deg: got {'dice': [1]}; allowed"),
    ],
)  # fmt: skip
def test_a_wrong_plan_is_one_line_with_its_key_path(
    changes: list[tuple[str, Any]],
    expected: str,
    plan_file: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = plan_file(*changes)
    assert run(["batch", str(path), "--out", str(tmp_path / "out")]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert any(expected in line for line in lines), lines
    assert all(line.startswith(f"flexdt: {path}: ") for line in lines)
    assert not (tmp_path / "out").exists()


def test_all_problems_come_at_once() -> None:
    with pytest.raises(CommandError) as caught:
        parse_plan(varied(("batch.items", -1), ("geometry.frames", 0)))
    assert [line.split(": ")[1] for line in caught.value.lines] == [
        "batch.items",
        "geometry.frames",
    ]


def test_no_toml_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.toml").write_text("[batch\n")
    assert run(["batch", str(tmp_path / "plan.toml")]) == 1
    assert "no TOML" in capsys.readouterr().err


def test_another_plans_folder_is_left_alone(
    plan_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    here(plan_file(("batch.items", 1)), out)
    before = files(out)
    assert run(["batch", str(plan_file(("batch.items", 2))), "--out", str(out)]) == 1
    assert "another plan_sha256" in capsys.readouterr().err
    assert files(out) == before
    strange = tmp_path / "strange"
    strange.mkdir()
    (strange / "thesis.pdf").write_bytes(b"%PDF")
    assert run(["batch", str(plan_file()), "--out", str(strange)]) == 1
    assert "no batch of flexdt" in capsys.readouterr().err


def test_draws_stay_within_what_they_say() -> None:
    rng = np.random.default_rng(0)
    for written, low, high in [
        (3.0, 3.0, 3.0),
        ({"uniform": [1.0, 2.0]}, 1.0, 2.0),
        ({"loguniform": [0.1, 10.0]}, 0.1, 10.0),
        ({"integers": [2, 4]}, 2, 4),
        ({"choice": [1.5, 7.5]}, 1.5, 7.5),
    ]:
        draw = parse(written)
        values = [draw.sample(rng) for _ in range(400)]
        assert draw.lowest <= min(values) <= max(values) <= draw.highest
        assert (draw.lowest, draw.highest) == (low, high)
        assert parse(draw.to_plain()) == draw
    middle = np.median(
        [parse({"loguniform": [0.1, 10.0]}).sample(rng) for _ in range(2000)]
    )
    assert 0.8 < middle < 1.25
    drawn = {parse({"integers": [2, 4]}).sample(rng) for _ in range(100)}
    assert drawn == {2, 3, 4}


# -- elsewhere -----------------------------------------------------------------------------------


def test_dask_workers_give_the_same_bytes(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    from distributed import LocalCluster

    path = plan_file(("batch.items", 5))
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=True, dashboard_address=":0"
    ) as c:
        words = ["batch", str(path), "--out", str(tmp_path / "dask"), "--scheduler"]
        assert run([*words, c.scheduler_address]) == 0
    here(path, tmp_path / "here")
    assert files(tmp_path / "dask") == files(tmp_path / "here")


def test_no_scheduler_there_is_said(
    plan_file: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flexdt_extensions.executors.SCHEDULER_S", 1.0)
    words = ["batch", str(plan_file()), "--out", str(tmp_path / "out")]
    assert run([*words, "--scheduler", "tcp://127.0.0.1:1"]) == 4
    assert "no dask scheduler at tcp://127.0.0.1:1" in capsys.readouterr().err


def test_the_slurm_jobs_script(
    plan_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """As far as it can be tried without a cluster: what dask-jobqueue would hand to sbatch."""
    script = job_script(
        Slurm(
            2,
            8,
            "16GiB",
            "02:30:00",
            "gpu",
            "proj-7",
            ("--gres=gpu:1",),
            ("module load py",),
        )
    )
    assert script.startswith("#!")
    for line in ("#SBATCH -p gpu", "#SBATCH -A proj-7", "#SBATCH -t 02:30:00", "#SBATCH --mem=16G",
                 "#SBATCH --cpus-per-task=8", "#SBATCH --gres=gpu:1", "module load py",
                 "export NUMBA_NUM_THREADS=1"):  # fmt: skip
        assert line in script.splitlines(), script
    worker = script.splitlines()[-1]
    assert "--nworkers 8" in worker
    assert "--nthreads 1" in worker
    file = plan_file().with_name("slurm.toml")
    file.write_text('queue = "short"')
    assert run(["batch", str(plan_file()), "--slurm-script", "--slurm", str(file)]) == 0
    assert "#SBATCH -p short" in capsys.readouterr().out
    assert run(["batch", str(plan_file()), "--slurm-script"]) == 2
    assert "needs --slurm FILE" in capsys.readouterr().err


def test_a_file_says_what_to_ask_slurm_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "slurm.toml"
    file.write_text(
        'jobs = 8\ncores = 16\nmemory = "64GiB"\nwalltime = "12:00:00"\nqueue = "gpu"\n'
        'extra = ["--gres=gpu:1"]\nsetup = ["module load py"]\n'
    )
    wanted = read_slurm(file)
    assert (wanted.jobs, wanted.account) == (8, None)
    lines = job_script(wanted).splitlines()
    for asked in (
        "-p gpu",
        "-t 12:00:00",
        "--mem=64G",
        "--cpus-per-task=16",
        "--gres=gpu:1",
    ):
        assert f"#SBATCH {asked}" in lines
    assert "module load py" in lines
    for text, said in (
        ("jobs = 0", "jobs: "), ('cores = "four"', "cores: "), ("queu = 1", "queu: "),
        ("extra = [1]", "extra.0: "), ("jobs = ", "no TOML"),
    ):  # fmt: skip
        file.write_text(text)
        with pytest.raises(CommandError, match=said):
            read_slurm(file)
    example = Path(__file__).resolve().parents[2] / "examples" / "batch" / "slurm.toml"
    assert "#SBATCH --exclusive" in job_script(read_slurm(example)).splitlines()
    words = [
        "reconstruct",
        str(tmp_path),
        "--out",
        str(tmp_path / "v.tif"),
        "--slurm",
        str(file),
    ]
    for more in (["--scheduler", "x:1"], ["--algorithm", "em"], ["--preview"]):
        assert run([*words, *more]) == 2
        assert "--slurm" in capsys.readouterr().err


STAND_IN = {
    # SLURM's `sbatch FILE` and `scancel JOB`: a job is a process group of this machine.
    "sbatch": 'cp "$1" job.sh; setsid bash job.sh > job.log 2>&1 & echo "Submitted batch job $!"',
    "scancel": "for job; do kill -- -$job; done",
}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_reconstruct_by_jobs_of_a_stand_in_for_slurm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The script as dask-jobqueue submits it is run, by a stand-in for a cluster's commands."""
    bin_ = tmp_path / "bin"
    bin_.mkdir()
    for name, text in STAND_IN.items():
        (bin_ / name).write_text(f"#!/bin/bash\n{text}\n")
        (bin_ / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{bin_}:{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    geometry = fx.ConeVec.circular(sod=600, sdd=1000, angles=12, shape=(24, 32), pixel=2)
    fx.simulate(fx.Volume(np.full((8, 8, 8), 0.02, np.float32), 2.0), geometry).save(
        "scan"
    )
    Path("slurm.toml").write_text('jobs = 1\ncores = 2\nmemory = "1GiB"\n')
    words = [
        "reconstruct",
        "scan",
        "--shape",
        "80,12,12",
        "--voxel",
        "2",
        "--json",
        "--out",
    ]
    assert run([*words, "v.mha", "--slurm", "slurm.toml"]) == 0, capsys.readouterr().err
    assert run([*words, "here.mha"]) == 0
    made, here = (fx.Volume.load(f"{n}.mha").data for n in ("v", "here"))
    most = float(np.nanmax(here))  # layers that the panel does not see are NaN
    np.testing.assert_allclose(made, here, rtol=0.0, atol=1e-6 * most)


@pytest.mark.skipif(os.path.exists("/usr/bin/sbatch"), reason="there is a sbatch here")
def test_slurm_where_there_is_none_is_said(
    plan_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "slurm.toml"
    file.write_text("jobs = 2")
    words = ["batch", str(plan_file()), "--out", str(tmp_path / "o"), "--slurm"]
    assert run([*words, str(file)]) == 1
    assert "no sbatch here" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["spheres", "panel", "calibrations", "radiographs"])
def test_the_examples_run(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import zarr

    path = EXAMPLES / f"{name}.toml"
    assert f"flexdt batch extensions/examples/batch/{name}.toml" in path.read_text()
    if name == "calibrations":
        assert run(["batch", str(path), "--out", str(tmp_path / "out"), "--json"]) == 0
        summary = json.loads(capsys.readouterr().out)
    else:
        summary = here(path, tmp_path / "out")
    assert (summary["done"], summary["failed"]) == (summary["items"], 0)
    root = zarr.open_group(tmp_path / "out" / "data.zarr", mode="r")
    plan: Plan = read_plan(path)
    for array, (shape, dtype) in layout(plan).items():
        assert root[array].shape == (plan.batch.items, *shape)
        assert root[array].dtype == np.dtype(dtype)
        assert root[array].metadata.zarr_format == 3
        assert np.isfinite(root[array][-1]).all()


def test_without_the_extra_one_line_says_what_to_install(
    plan_file: Callable[..., Path], tmp_path: Path
) -> None:
    code = (
        "import sys; sys.modules['zarr'] = None\n"
        "from flexdt.clients.cli.command_tree import run\n"
        f"sys.exit(run(['batch', {str(plan_file())!r}, '--out', {str(tmp_path / 'out')!r}]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    size, missing = done.stderr.splitlines()
    assert size.startswith("8 items, ")
    assert "pip install 'flexdt-extensions[batch]'" in missing


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([("images.power_W", 100_000.0)], "power_W 100000 is outside"),
        ([("images.kV", 500.0)], "kV 500 is outside"),
        ([("geometry.sod_mm", 5.0)], "source is inside the box around the sample"),
        ([("geometry.lateral_mm", 900.0)], "no ray that reaches the panel meets it"),
        (
            [("camera", {"mode": "HW4SW1High"}), ("geometry.sod_mm", 20.0)],
            "mag_obj target",
        ),
        (
            [("camera", {"mode": "HW4SW1High"}), ("images.exposure_ms", 90_000.0)],
            "exposure_ms 90000 is outside",
        ),
    ],
)
def test_an_item_that_no_scanner_can_make_fails_with_its_reason(
    changes: list[tuple[str, Any]], said: str
) -> None:
    plan = parse_plan(varied(*changes))
    record = run_item(plan.text, 0).record
    assert record["status"] == "failed"
    assert said in record["error"]


def test_an_item_whose_open_beam_saturates_is_warned_of() -> None:
    bright = parse_plan(
        varied(
            ("camera", {"mode": "HW4SW1High"}), ("images.physics", "poly"),
            ("images.values", "counts"), ("images.exposure_ms", 5000.0), ("geometry.frames", 1),
        )
    )  # fmt: skip
    outcome = run_item(bright.text, 0)
    assert outcome.record["status"] == "done"
    (warning,) = outcome.record["warnings"]
    assert "would fill 90 %" in warning
    assert outcome.arrays["projections"].max() == 16383
