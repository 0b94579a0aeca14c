"""`calibration.fit` and `.align` answer what the package finds, and end when nobody waits."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bead_scan import bead_scan
from in_process import PATIENCE_S, Lab, M

import flexdt as fx
from flexdt.phantoms import load_phantom
from flexdt.protocol import Codec, RpcError
from flexdt.protocol.methods.calibration_messages import CalibrationFit
from flexdt.server.storage.past_scans import PastScans
from flexdt.twin.calibration.fit.fit import covariance_by_step
from flexdt.twin.machine.description import profile_of

pytestmark = pytest.mark.slow

FRAMES = 25
TRUTH = {
    "dO_x": 0.9,
    "dO_y": -0.6,
    "dO_z": 2.5,
    "alpha": 33.0,
    "tau_x": 0.4,
    "tau_z": -0.3,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    bead_scan(root, TRUTH, FRAMES)
    return root


@pytest.fixture(scope="module")
def own(data: Path) -> Any:
    return fx.calibrate(data / "lego", "lego")


Served = Callable[[Callable[[Lab], Awaitable[None]]], None]
"""Runs a body with the twin of all tests, whose worker has loaded what a fit needs."""


@pytest.fixture(scope="module")
def served(data: Path) -> Iterator[Served]:
    with asyncio.Runner() as runner:
        lab = Lab(data)
        runner.run(lab.__aenter__())
        yield lambda body: runner.run(asyncio.wait_for(body(lab), 2 * PATIENCE_S))
        runner.run(lab.__aexit__())


def called(served: Served, method: str, **params: object) -> Any:
    """The answer of a twin server in this process."""
    told = []

    async def body(lab: Lab) -> None:
        client = lab.client()
        told.append(await client.call(method, **params))
        if told[0].get("correction"):
            applied = await client.call(
                "calibration.apply", parameters=told[0]["correction"]
            )
            assert applied["correction"]["parameters"] == pytest.approx(
                told[0]["correction"]
            )
        client.close()

    served(body)
    return told[0]


def test_a_fit_over_the_wire_is_that_of_the_package(served: Served, own: Any) -> None:
    told = called(
        served, "calibration.fit", datasets=["lego"], phantom="lego", steps=4, residuals=True,
        tracks=True,
    )  # fmt: skip
    fit = own.calibration.fit
    assert told["identifiable"]
    assert list(told["parameters"]) == list(fit.values)
    for name, e in told["parameters"].items():
        assert e["value"] == pytest.approx(fit.values[name], abs=1e-5)
        if name in TRUTH:
            assert abs(e["value"] - TRUTH[name]) < 4 * e["sigma"]
    assert np.allclose(told["covariance"], fit.covariance, rtol=1e-3, atol=1e-9)
    beads = told["rms_per_bead_px"]
    for k, stated in enumerate(beads):
        off = np.array(
            [frame[k] for frame in told["residuals_px"] if frame[k] is not None]
        )
        assert np.sqrt(np.mean(off**2)) == pytest.approx(stated, abs=1e-4)
    assert [s["frames"] for s in told["steps"]] == [7, 13, 19, 25]
    [tracked] = told["tracks"]["datasets"]
    for frame, off in zip(tracked["frames"], told["residuals_px"], strict=True):
        for seen, after, residual in zip(
            frame["measured"], frame["after"], off, strict=True
        ):
            if residual is not None:
                assert np.subtract(seen, after) == pytest.approx(residual, abs=2e-3)
    assert {q["code"] for q in told["problems"]} == {
        f.code for f in own.calibration.findings
    }


def marks(
    views: range, truth: dict[str, float], noise_px: float
) -> list[dict[str, object]]:
    """Where the beads stand in the scan's images (SOD 600, SDD 1059, 478 x 380 pixels of 0.2992
    mm, 15 degrees from one to the next), by sines and cosines alone."""
    rng = np.random.default_rng(5)
    told: list[dict[str, object]] = []
    for view in views:
        turn = math.radians(15.0 * view + truth["alpha"])
        for k, (x, y, z) in enumerate(load_phantom("lego").beads.tolist()):
            across = x * math.cos(turn) + y * math.sin(turn) + truth["dO_x"]
            deep = 600.0 + truth["dO_z"] - x * math.sin(turn) + y * math.cos(turn)
            scale = 1059.0 / deep / 0.2992
            column, row = 238.5 + scale * across, 189.5 - scale * (z + truth["dO_y"])
            off = noise_px * rng.normal(size=2)
            told.append({"frame": view, "marker": str(k), "column": column + off[0],
                         "row": row + off[1], "sigma": noise_px})  # fmt: skip
    return told


def test_marks_take_the_place_of_what_is_in_the_images(served: Served) -> None:
    other = {"dO_x": -1.4, "dO_y": 0.8, "dO_z": -3.0, "alpha": 71.0}
    seen = marks(range(0, 25, 3), other, 0.2)
    told = called(served, "calibration.fit", datasets=["lego"], phantom="lego", markers=seen,
                  tracks=True)  # fmt: skip
    assert told["identifiable"]
    assert told["rms_px"] == pytest.approx(0.2, rel=0.3)
    for name, true in other.items():
        e = told["parameters"][name]
        assert e["sigma"] < 2.0
        assert abs(e["value"] - true) < 4 * e["sigma"]
    [tracked] = told["tracks"]["datasets"]
    files = [f"scan_{view:06d}.tif" for view in range(0, 25, 3)]
    assert [frame["file"] for frame in tracked["frames"]] == files
    assert tracked["frames"][1]["measured"][2] == pytest.approx(
        [seen[7]["column"], seen[7]["row"]], abs=1e-3
    )


def test_markers_of_which_nobody_knows_where_they_are(served: Served) -> None:
    other = {"dO_x": -1.4, "dO_y": 0.0, "dO_z": -3.0, "alpha": 0.0}
    seen = marks(range(0, 25, 3), other, 0.2)
    for mark in seen:
        mark["marker"] = f"ball {mark['marker']}"
    beads = load_phantom("lego").beads
    apart = float(np.linalg.norm(beads[1] - beads[3]))
    told = called(
        served, "calibration.fit", datasets=["lego"], phantom="unknown", markers=seen, tracks=True,
        scale=f"ball 1-ball 3={apart:.3f}", residuals=True, steps=2,
    )  # fmt: skip
    assert told["identifiable"]
    assert told["scale"].startswith("ball 1-ball 3 = ")
    for name in ("dO_x", "dO_z"):
        e = told["parameters"][name]
        assert e["sigma"] < 3.0
        assert abs(e["value"] - other[name]) < 4 * e["sigma"]
    found = np.array([m["position_mm"] for m in told["markers"]])
    between = np.linalg.norm(found[:, None] - found, axis=2)
    really = np.linalg.norm(beads[:, None] - beads, axis=2)
    assert np.abs(between - really).max() < 0.5
    assert len(told["residuals_px"]) == 9
    free = called(
        served, "calibration.fit", datasets=["lego"], phantom="unknown", markers=seen
    )
    assert free["scale"] == "free"


def test_marks_that_do_not_hold_are_refused(served: Served) -> None:
    mark: dict[str, Any] = {"frame": 0, "marker": "0", "column": 200.0, "row": 180.0}
    wrong = [
        ([mark, mark], "mark 1: marker '0' in frame 0"),
        ([mark | {"frame": 25}], "allowed: frames 0 to 24"),
        ([mark | {"marker": "5"}], "marker '5' is no bead of 'lego'; allowed: 0 to 4"),
        ([mark, mark | {"marker": "00"}], "allowed: 0 to 4, each once"),
        ([mark | {"marker": "left one"}], "'left one' is no bead"),
        ([mark | {"frame": -1}], "frame"),
        ([mark | {"frame": 0.5}], "frame"),
        ([mark | {"marker": 0}], "marker"),
        ([mark | {"column": "200"}], "column"),
        ([mark | {"row": 1e6}], "row"),
        ([mark | {"sigma": 0}], "sigma"),
        ([mark | {"u": 3}], "u"),
        ([[0, "0", 200.0, 180.0]], "markers"),
        ([], "markers"),
        ([mark] * 10_001, "markers"),
    ]

    async def body(lab: Lab) -> None:
        client = lab.client()
        for markers, says in wrong:
            error = await client.error(
                "calibration.fit", datasets=["lego"], phantom="lego", markers=markers
            )
            assert (error.code, says in f"{error.message} {error.data}") == (
                -32602,
                True,
            ), says
        for phantom, scale, says in (
            ("lego", "0-1=3", "a known phantom states its own size"),
            ("unknown", "0-1", "allowed: A-B=MM"),
            ("unknown", None, "1 markers; allowed: three or more"),
        ):
            asked = {"markers": [mark], "phantom": phantom} | (
                {"scale": scale} if scale else {}
            )
            error = await client.error("calibration.fit", datasets=["lego"], **asked)
            assert (error.code, says in error.message) == (-32602, True), error
        both = await client.error(
            "calibration.fit", datasets=["lego", "lego"], phantom="lego", markers=[mark]
        )
        assert "markers: has no effect" in both.message
        assert "allowed with: one data set" in both.message
        # Too few of them are no error: the answer says that they do not determine anything.
        few = await client.call(
            "calibration.fit",
            datasets=["lego"],
            phantom="lego",
            markers=[mark],
            tracks=True,
        )
        assert not few["identifiable"]
        assert few["verdict"].startswith("Not to be used")

    served(body)


def test_an_alignment_over_the_wire_is_that_of_the_package(
    data: Path, served: Served
) -> None:
    own = fx.align(data / "lego", per_frame=True)
    told = called(served, "calibration.align", name="lego", per_frame=True)
    assert own.identifiable
    assert told["motion"] == own.document["motion"]
    assert told["refused"] == own.document["refused"]
    assert set(told["parameters"]) == set(own.parameters)


def test_what_is_not_there_is_refused(data: Path, served: Served, tmp_path: Path) -> None:
    os.symlink(tmp_path, data / "linked")
    wrong = [
        (["gone"], "lego", "no data set 'gone'"),
        (["lego"], "apple", "no phantom called 'apple'"),
        (["lego"], "gone.toml", "no phantom 'gone.toml'"),
        ([".."], "lego", ""),
        (["lego"], "../lego/flexdt.json", ""),
        (["linked"], "lego", "no data set 'linked'"),
        ([], "lego", ""),
    ]

    async def body(lab: Lab) -> None:
        client = lab.client()
        for names, phantom, says in wrong:
            error = await client.error("calibration.fit", datasets=names, phantom=phantom)
            assert error.code == -32602
            assert says in error.message
        free = await client.error(
            "calibration.fit", datasets=["lego"], phantom="lego", free=["up"]
        )
        assert (free.code, "up" in free.message) == (-32602, True)

    served(body)


def test_a_fit_that_nobody_waits_for_ends(data: Path) -> None:
    """Its process is ended, and the next fit is answered."""

    async def run() -> bytes:
        scans = PastScans(data, M, profile_of(M, None))
        asked = CalibrationFit(datasets=["lego"], phantom="lego")
        try:
            first = asyncio.create_task(scans.ask(asked, "", Codec.JSON))
            while not first.done() and _working() <= before:
                await asyncio.sleep(0.01)
            first.cancel()
            with pytest.raises(asyncio.CancelledError):
                await first
            gone = CalibrationFit(datasets=["gone"], phantom="lego")
            with pytest.raises(RpcError, match="no data set 'gone'"):
                await scans.ask(gone, "", Codec.JSON)
        finally:
            scans.close()
        return b""

    before = _working()  # those of tests before this one, in the same process
    asyncio.run(run())
    assert _working() <= before


def _working() -> set[int]:
    """Worker processes of this process."""
    ours = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except (OSError, ValueError, IndexError):
                continue
            if parent == os.getpid() and b"flexdt.runtime.worker" in words:
                ours.add(int(entry.name))
    return ours


def test_the_steps_are_what_the_first_frames_would_know(own: Any) -> None:
    """Against a numerical derivative of the whitened residuals and a textbook inverse."""
    fit = own.calibration.fit
    steps = covariance_by_step(fit, 3)
    assert [n for n, _ in steps] == [9, 17, 25]
    sizes = [np.linalg.slogdet(m)[1] for _, m in steps if m is not None]
    assert sizes == sorted(sizes, reverse=True)
    problem, noise = fit.problem, fit.certificate.noise
    for frames, matrix in steps:
        x = fit.solution.x
        keep = np.zeros_like(fit.solution.use)
        keep[:frames] = fit.solution.use[:frames]
        mask = np.repeat(keep.ravel(), 2)
        columns = []
        for i in range(len(x)):
            step = np.zeros_like(x)
            step[i] = 1e-5
            ends = (
                problem.whitened(x + step).ravel(),
                problem.whitened(x - step).ravel(),
            )
            columns.append((ends[1] - ends[0])[mask] / 2e-5)
        rows = np.stack(columns, axis=1)
        told = np.linalg.inv(
            rows.T @ rows / noise**2 + np.diag(1 / problem.prior_sigma**2)
        )
        degrees = np.array([180 / np.pi if e.unit == "deg" else 1.0
                            for e in fit.certificate.estimates.values()])  # fmt: skip
        p_ = len(degrees)
        assert matrix is not None
        assert np.allclose(
            np.sqrt(np.diag(matrix)), np.sqrt(np.diag(told)[:p_]) * degrees, rtol=0.01
        )
