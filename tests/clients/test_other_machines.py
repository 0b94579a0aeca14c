"""The shipped machines that are not the FleX-ray do the main job: scan, calibrate, reconstruct.

The witness is kinematics of this file's own, written from the comments of the machine files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from bead_scan import bead_in_volume, bead_scan_on

from flexdt.clients.launch.processes import LocalTwin
from flexdt.library.calibration.calibrate import calibrate_datasets
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction.reconstruct import (
    VolumeRequest,
    reconstruct_dataset,
)
from flexdt.library.reconstruction.volume_files import read_volume
from flexdt.phantoms import lego_phantom
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_machine_text,
    parse_machine,
    profile_of,
)
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import Kind, ScanRequest

TRUTH = {
    "dO_x": 0.8123456, "dO_y": -0.5234567, "dO_z": 1.5345678, "alpha": 12.0456789,
    "tau_x": 0.4567890, "tau_z": -0.3678901,
}  # fmt: skip
BEADS = lego_phantom().beads
Motors = Mapping[str, float]
Place = Callable[[np.ndarray, Motors, Mapping[str, float]], np.ndarray]
NONE = dict.fromkeys(TRUTH, 0.0)


def cabinet(b: np.ndarray, m: Motors, o: Mapping[str, float]) -> np.ndarray:
    """Where a point of the sample stands, seen from the source: across, ahead, up [mm].

    The turntable turns clockwise seen from above; X moves it to the right, Z away, Y up.
    """
    a = math.radians(m["R"] + o["alpha"])
    x, y = b[0] - o["tau_x"], b[1] - o["tau_z"]
    return np.array(
        [
            m["X"] + o["dO_x"] + o["tau_x"] + x * math.cos(a) + y * math.sin(a),
            m["Z"] + o["dO_z"] + o["tau_z"] - x * math.sin(a) + y * math.cos(a),
            m["Y"] + o["dO_y"] + b[2],
        ]
    )


def micro(b: np.ndarray, m: Motors, o: Mapping[str, float]) -> np.ndarray:
    """The axis stands 150 mm from the source; CX and CY move the sample on the turntable."""
    on_table = b + np.array([m["CX"], m["CY"], 0.0])
    return cabinet(on_table, {"R": m["R"], "X": 0.0, "Z": 150.0, "Y": m["Y"]}, o)


def pixel(
    place: np.ndarray, sdd: float, pitch: tuple[float, float], roi: Roi
) -> np.ndarray:
    """(column, row) of a point on a panel that faces the source, unbinned, from the ROI's pixel
    0.

    Rows grow downwards. The beam meets the middle of the whole panel, whose edges are at
    -0.5 and its number of pixels - 0.5.
    """
    across, up = sdd * place[0] / place[1], sdd * place[2] / place[1]
    return np.array([across / pitch[0] - roi.left, -up / pitch[1] - roi.top])


MACHINES: dict[str, tuple[Place, float, tuple[int, int], float]] = {
    "xyzr_cabinet": (cabinet, 1000.0, (2000, 2000), 0.2),
    "micro_ct": (micro, 300.0, (2240, 2368), 0.05),
}
"""Own kinematics, SDD, unbinned panel (columns, rows), pitch."""


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("row_pitch", [None, 0.13])
def test_points_are_projected_where_own_kinematics_puts_them(
    name: str, row_pitch: float | None
) -> None:
    place, sdd, (cols, rows), pitch = MACHINES[name]
    text = f'base = "{name}"\n'
    if row_pitch is not None:
        text += f"[detector]\nrow_pitch_mm = {row_pitch}\n"
        text += '[[components]]\nname = "panel"\nsize_mm = [460.0, 40.0, 460.0]\n'
        text += "center_mm = [0.0, 20.0, 0.0]\n"
    machine = parse_machine(text)
    rng = np.random.default_rng(17)
    for _ in range(20):
        at = {n: float(rng.uniform(a.lower, a.upper)) for n, a in machine.axes.items()}
        at |= {"Z": float(rng.uniform(200, 800))} if "Z" in at else {}
        offsets = {n: float(rng.uniform(-1, 1)) for n in TRUTH}
        roi = Roi(
            *(int(v) for v in (*rng.integers(0, 300, 2), *rng.integers(900, 1900, 2)))
        )
        mode, binning = [("1x1", 1), ("2x2", 2)][int(rng.integers(2))]
        mode = mode if name == "xyzr_cabinet" else {"1x1": "full", "2x2": "binned"}[mode]
        camera = machine.detector.camera
        camera = type(camera)(mode, roi, modes=camera.modes)
        assert camera.binning == binning
        cone = poses(machine, profile_of(machine), camera, at)
        points = rng.uniform(-20, 20, (5, 3))
        found = cone.cone_vec(Offsets.from_edge(offsets)).project_points(
            points, camera.shape
        )[0]
        for b, got in zip(points, found, strict=True):
            fine = pixel(place(b, at, offsets), sdd, (pitch, row_pitch or pitch), roi)
            fine += [(cols - 1) / 2, (rows - 1) / 2]
            coarse = (fine - (binning - 1) / 2) / binning  # the centre of a binned pixel
            np.testing.assert_allclose(got, coarse, atol=1e-6)


REQUESTS = {
    "xyzr_cabinet": ScanRequest(
        sod_mm=300.0, frames=25, averages=4, mode="4x4", roi=Roi(600, 400, 1399, 1599)
    ),
    "micro_ct": ScanRequest(frames=25, averages=28, mode="preview"),
}


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.daily(1)
def test_a_machine_scans_calibrates_and_reconstructs(name: str, tmp_path: Path) -> None:
    place, sdd, (cols, rows), pitch = MACHINES[name]
    machine = builtin_machine(name)
    folder, plan = bead_scan_on(machine, REQUESTS[name], tmp_path, TRUTH)
    text = (folder / "scan settings.txt").read_text(encoding="latin-1")
    flat_axis = next(
        row for row in text.splitlines() if "Axis for flat field movement" in row
    )
    assert flat_axis.split()[-1] == ("X" if "X" in machine.axes else "Y")
    outcome = calibrate_datasets([load_dataset(folder)], "lego")
    assert outcome.document["identifiable"] is True
    for parameter, value in TRUTH.items():
        found = outcome.document["parameters"][parameter]  # type: ignore[index]
        assert abs(found["value"] - value) < 5 * found["sigma"] + 1e-6
    # The geometry that was found puts the beads where they really are in the images.
    correction = Offsets.from_edge(outcome.document["correction"])  # type: ignore[arg-type]
    data = load_dataset(folder)
    shape = data.shape
    seen = data.poses.cone_vec(correction).project_points(BEADS, shape)
    camera = plan.exposures[-1].camera
    images = [e for e in plan.exposures if e.kind == "projection"]
    off = []
    for image, spots in zip(images, seen, strict=True):
        for b, spot in zip(BEADS, spots, strict=True):
            fine = pixel(
                place(b, image.positions, TRUTH), sdd, (pitch, pitch), camera.roi
            )
            fine += [(cols - 1) / 2, (rows - 1) / 2]
            off.append(spot - (fine - (camera.binning - 1) / 2) / camera.binning)
    assert np.abs(off).max() < 0.05
    # And a volume in that geometry has the beads where the phantom has them.
    request = VolumeRequest(voxel_mm=0.25, shape=(220, 120, 120))
    reconstruct_dataset(data, tmp_path / "v.tif", request, parameters=correction)
    volume = read_volume(tmp_path / "v.tif")
    for bead in BEADS:
        place, brightest = bead_in_volume(volume, bead, reach=4)
        assert np.linalg.norm(place - bead) < 0.1
    assert brightest > 3 * float(np.median(volume.data))


@pytest.mark.parametrize(("name", "turning"), [("xyzr_cabinet", "R"), ("micro_ct", "R")])
@pytest.mark.parametrize("kind", ["fly", "step", "tiled", "helical", "calibration"])
def test_every_kind_of_script_plans_or_says_why_not(
    name: str, turning: str, kind: Kind
) -> None:
    machine = builtin_machine(name)
    request = ScanRequest(kind=kind, frames=61, exposure_ms=1000.0)
    if kind == "tiled":
        with pytest.raises(
            LimitError, match=rf"{name} has no motor for the detector sideways"
        ):
            compose_script(request, machine, profile_of(machine))
        return
    script = compose_script(request, machine, profile_of(machine))
    plan = plan_script(parse_script(script), machine, profile_of(machine))
    assert not plan.errors
    images = [e for e in plan.exposures if e.kind == "projection"]
    angles = np.array([e.positions[turning] for e in images])
    heights = np.array([e.positions["Y"] for e in images])
    if (
        kind == "helical"
    ):  # as the source would rise by 20 mm in three turns, the sample sinks
        np.testing.assert_allclose(np.diff(heights), -20.0 / 60, atol=1e-3)
        assert heights.mean() == pytest.approx(0.0, abs=1e-3)
        assert angles[-1] == pytest.approx(3 * 360.0, abs=1e-3)
    else:
        np.testing.assert_allclose(heights, 0.0, atol=1e-6)
    flat = next(e for e in plan.exposures if e.kind == "flat")
    aside = "X" if "X" in machine.axes else "Y"
    assert abs(flat.positions[aside]) > 89.0


def test_what_no_motor_does_is_said() -> None:
    machine = builtin_machine("micro_ct")
    cases = {
        "sod_mm": (
            200.0,
            r"no motor for the source-object distance.*200 mm \(150 mm is all",
        ),
        "sdd_mm": (
            500.0,
            r"no motor for the source-detector distance.*500 mm \(300 mm is all",
        ),
        "height_mm": (20.0, r"no motor for the height of the beam.*20 mm \(0 mm is all"),
    }
    for key, (value, said) in cases.items():
        with pytest.raises(LimitError, match=said):
            compose_script(ScanRequest(**{key: value}), machine, profile_of(machine))  # type: ignore[arg-type]
    bare = parse_machine(
        'base = "micro_ct"\nwithout = ["Y"]\n[[components]]\nname = "lift"\nparent = "floor"\n'
    )
    with pytest.raises(
        LimitError, match="no motor that takes the sample out of the beam"
    ):
        compose_script(ScanRequest(), bare, profile_of(bare))
    lateral = parse_machine('base = "xyzr_cabinet"\nwithout = ["Y"]\n')
    request = ScanRequest(kind="helical", frames=61, exposure_ms=1000.0)
    with pytest.raises(LimitError, match="none that lowers the sample"):
        compose_script(request, lateral, profile_of(lateral))


@pytest.mark.slow
def test_servers_run_a_machine_with_a_fixed_detector(tmp_path: Path) -> None:
    """A fixed detector passed `check` and ended `flexdt up` in a KeyError."""
    name = "micro_ct"
    machine = tmp_path / "mine.toml"
    machine.write_text(
        builtin_machine_text(name).replace(f'name = "{name}"', 'name = "mine"', 1)
    )
    with LocalTwin(machine=machine, sample="lego") as twin:
        state = twin.state()
        assert state.geometry is not None
        assert state.geometry.SDD_mm == MACHINES[name][1]
        image = twin.projection("line_integral", binning=8).image
        assert image.max() > 0.1
        script = compose_script(
            REQUESTS[name], builtin_machine(name), profile_of(builtin_machine(name))
        )
        assert twin.check_script(script).ok
