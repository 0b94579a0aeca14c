"""`calibration.fit` and `.align` answer what the package finds, and end when nobody waits."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bead_scan import bead_scan
from in_process import Lab, M, run

import flexdt as fx
from flexdt.protocol import Codec, RpcError
from flexdt.protocol import params as p
from flexdt.server.storage.past_scans import PastScans
from flexdt.twin.calibration.fit.covariance_steps import covariance_by_step
from flexdt.twin.machine.description import profile_of

FRAMES = 25
TRUTH = {"dO_x": 0.9, "dO_y": -0.6, "dO_z": 2.5, "alpha": 33.0, "tau_x": 0.4, "tau_z": -0.3}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    bead_scan(root, TRUTH, FRAMES)
    return root


@pytest.fixture(scope="module")
def own(data: Path) -> Any:
    return fx.calibrate(data / "lego", "lego")


def called(root: Path, method: str, **params: object) -> Any:
    """The answer of a twin server in this process."""
    told = []

    async def body(lab: Lab) -> None:
        client = lab.client()
        told.append(await client.call(method, **params))
        if told[0].get("correction"):
            applied = await client.call("calibration.apply", parameters=told[0]["correction"])
            assert applied["correction"]["parameters"] == pytest.approx(told[0]["correction"])

    run(root, body)
    return told[0]


def test_a_fit_over_the_wire_is_that_of_the_package(data: Path, own: Any) -> None:
    told = called(
        data, "calibration.fit", datasets=["lego"], phantom="lego", steps=4, residuals=True,
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
        off = np.array([frame[k] for frame in told["residuals_px"] if frame[k] is not None])
        assert np.sqrt(np.mean(off**2)) == pytest.approx(stated, abs=1e-4)
    assert [s["frames"] for s in told["steps"]] == [7, 13, 19, 25]
    [tracked] = told["tracks"]["datasets"]
    for frame, off in zip(tracked["frames"], told["residuals_px"], strict=True):
        for seen, after, residual in zip(frame["measured"], frame["after"], off, strict=True):
            if residual is not None:
                assert np.subtract(seen, after) == pytest.approx(residual, abs=2e-3)
    assert {q["code"] for q in told["problems"]} == {f.code for f in own.calibration.findings}


def test_an_alignment_over_the_wire_is_that_of_the_package(data: Path) -> None:
    own = fx.align(data / "lego")
    told = called(data, "calibration.align", name="lego")
    assert told["identifiable"] == own.identifiable
    assert told["refused"] == own.document["refused"]
    assert set(told["parameters"]) == set(own.parameters)


def test_what_is_not_there_is_refused(data: Path, tmp_path: Path) -> None:
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
        free = await client.error("calibration.fit", datasets=["lego"], phantom="lego", free=["up"])
        assert (free.code, "up" in free.message) == (-32602, True)

    run(data, body)


def test_a_fit_that_nobody_waits_for_ends(data: Path) -> None:
    """Its process is ended, and the next fit is answered."""

    async def run() -> bytes:
        scans = PastScans(data, M, profile_of(M, None))
        asked = p.CalibrationFit(datasets=["lego"], phantom="lego")
        try:
            first = asyncio.create_task(scans.ask(asked, "", Codec.JSON))
            while not first.done() and _working() <= before:
                await asyncio.sleep(0.01)
            first.cancel()
            with pytest.raises(asyncio.CancelledError):
                await first
            gone = p.CalibrationFit(datasets=["gone"], phantom="lego")
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
            if parent == os.getpid() and b"flexdt.server.runtime.worker" in words:
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
            ends = (problem.whitened(x + step).ravel(), problem.whitened(x - step).ravel())
            columns.append((ends[1] - ends[0])[mask] / 2e-5)
        rows = np.stack(columns, axis=1)
        told = np.linalg.inv(rows.T @ rows / noise**2 + np.diag(1 / problem.prior_sigma**2))
        degrees = np.array([180 / np.pi if e.unit == "deg" else 1.0
                            for e in fit.certificate.estimates.values()])  # fmt: skip
        p_ = len(degrees)
        assert matrix is not None
        assert np.allclose(
            np.sqrt(np.diag(matrix)), np.sqrt(np.diag(told)[:p_]) * degrees, rtol=0.01
        )
