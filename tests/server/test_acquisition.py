"""Frames from positions to counts: sub-frame moments, noise numbers, the empty stage."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from one_ray import OneRay

from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.projections import Imaging, TrueGeometry, load_truth
from flexdt.server.imaging.radiography import Radiography
from flexdt.server.scans.acquisition import Acquisition
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import MachineFileError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.physics.exposure import (
    ExposureSettings,
    IdealResponse,
    expose,
    frame_rng,
)
from flexdt.twin.scanner.state import Sample, StagePlacement
from flexdt.twin.script.parse import parse_script
from flexdt.twin.script.planning.planner import plan_script

M = builtin_machine()
P = builtin_profile(M.default_profile)

FLY = "\r\n".join(
    [
        "camera\tset ROI\t900 700 931 731\t\tACK\t\t",
        "camera\tset exposure\t1000.0\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        "camera\tset number of frames\t9\t\tACK\t\t",
        "tube\tset power\t1.0\t\tACK\t\t",
        "rot_obj\tset speed\t45.0\t\tACK\t\t",
        "rot_obj\tmove absolute\t-225.0\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        "rot_obj\tmove absolute\t585.0\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t",
        "",
    ]
)


class AngleProjector(OneRay):
    """Each view's line integral is the stage angle, read back from where the source stands."""

    def __init__(self) -> None:
        self.angles: list[float] = []

    async def put(self, name: str, body: object) -> None:
        pass

    async def remove(self, name: str) -> None:
        pass

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> Float32Array:
        angle = np.degrees(np.arctan2(cone_vec.source[:, 0], -cone_vec.source[:, 1]))
        self.angles += angle.tolist()
        thickness = (np.abs(angle) / 90.0).astype(np.float32)
        return np.broadcast_to(thickness[:, None, None], (len(angle), *shape)).copy()


def scan(
    tmp_path: Path, moments: int, seed: int | None = None
) -> tuple[dict[str, npt.NDArray[np.uint16]], list[float]]:
    plan = plan_script(parse_script(FLY), M, P)
    assert not plan.errors
    projector = AngleProjector()
    store = SampleStore(open_data(tmp_path))
    imaging = Imaging(
        projector, TrueGeometry(Offsets(dO_x=0.5405)), store, M.detector.pixels
    )
    made: dict[str, npt.NDArray[np.uint16]] = {}
    way = Radiography(imaging, IdealResponse())
    acquisition = Acquisition(
        plan, way, Sample("normal"), seed, made.__setitem__, moments
    )
    asyncio.run(acquisition.produce(list(plan.exposures)))
    return made, projector.angles


def test_moments_spread_evenly_over_the_exposure_about_the_nominal_angle(
    tmp_path: Path,
) -> None:
    still, angles = scan(tmp_path, 1)
    assert len(still) == 9
    assert angles[:3] == pytest.approx(
        [0.0, 45.0, 90.0], abs=1e-6
    )  # dO_x undoes axs_tan here
    blurred, angles = scan(tmp_path, 4)
    assert len(angles) == 36
    # Frame 1 stands for 45 degrees and turns 45 degrees while it is exposed: eighths of it.
    moments = [45.0 + 45.0 * k for k in (-3 / 8, -1 / 8, 1 / 8, 3 / 8)]
    assert angles[4:8] == pytest.approx(moments, abs=1e-6)
    i0 = 12_000.0 * (1.0 / 50.0) * 10.0
    mean = np.mean(np.exp(-np.array(moments) / 90.0))
    assert blurred["scan_000001.tif"][0, 0] == round(100.0 + i0 * mean)
    assert still["scan_000001.tif"][0, 0] == round(100.0 + i0 * np.exp(-0.5))


def test_noise_is_numbered_by_the_place_among_all_saved_images(tmp_path: Path) -> None:
    noisy, _ = scan(tmp_path, 1, seed=9)
    flat = np.full(
        (16, 16), np.float32(2.0), dtype=np.float32
    )  # frame 4 stands at 180 degrees
    expected = expose(
        IdealResponse(), flat, ExposureSettings(90.0, 1.0, 1000.0), frame_rng(9, 4)
    )
    assert np.array_equal(noisy["scan_000004.tif"], expected)


def test_an_empty_stage_needs_no_projector_and_offsets_reach_it(tmp_path: Path) -> None:
    projector = AngleProjector()
    store = SampleStore(open_data(tmp_path))
    imaging = Imaging(projector, TrueGeometry(), store, M.detector.pixels)
    plan = plan_script(parse_script(FLY), M, P)
    camera = plan.exposures[0].camera
    from flexdt.twin.machine.kinematics import poses

    pose = poses(M, builtin_profile("thesis"), camera, {"rot_obj": [30.0]})
    blank = asyncio.run(imaging.line_integrals(Sample(), pose, camera))
    assert blank.shape == (1, 16, 16)
    assert not blank.any()
    assert projector.angles == []
    # A sample turned by 10 degrees sees the source 10 degrees less far round.
    asyncio.run(
        imaging.line_integrals(Sample("lego", StagePlacement(rz=10.0)), pose, camera)
    )
    assert projector.angles == pytest.approx([20.0])


def test_binned_mean_cuts_the_surplus() -> None:
    image = np.arange(5 * 7, dtype=np.float32).reshape(5, 7)
    coarse = binned_mean(image, 2)
    assert coarse.shape == (2, 3)
    assert coarse[0, 0] == np.mean([0, 1, 7, 8])
    assert binned_mean(image, 1) is image


def test_a_truth_file_is_checked_without_repeating_its_values(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    good = tmp_path / "truth.toml"
    good.write_text("dO_x = 0.25\nalpha = 1\n")
    assert repr(load_truth(good, data)) == "TrueGeometry(hidden)"
    for text, says in (
        ("dO_q = 7.125", "unknown parameter 'dO_q'"),
        ('dO_x = "7.125"', "must be a number"),
        ("dO_x = = 7.125", "not valid TOML"),
    ):
        bad = tmp_path / "bad.toml"
        bad.write_text(text)
        with pytest.raises(MachineFileError, match=says) as e:
            load_truth(bad, data)
        assert "7.125" not in str(e.value)
        assert "7.125" not in str(e.value.data)
    inside = data / "truth.toml"
    inside.write_text("")
    with pytest.raises(MachineFileError, match="inside the data directory"):
        load_truth(inside, data)
    with pytest.raises(MachineFileError, match="cannot read"):
        load_truth(tmp_path / "none.toml", data)
