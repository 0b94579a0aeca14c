"""Poses from the settings texts alone, for data sets without flexdt.json: real scans first of all.

The machine is found by its name or its motors, the profile by which one reproduces the printed SOD,
SDD, COR, VC and HC. Where no profile does, the printed figures are the geometry and only heights
come from the motors. Every such decision is a note. It refuses to invent figures that are missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.camera import CameraSettings, Roi
from flexdt.twin.conventions import FloatArray
from flexdt.twin.dataset.errors import DatasetFormatError
from flexdt.twin.dataset.figures import Figures, figures_of, poses_of
from flexdt.twin.dataset.settings import ScanSettings
from flexdt.twin.errors import TwinError
from flexdt.twin.kinematics import poses
from flexdt.twin.machine import Machine, Profile
from flexdt.twin.pose import Poses

MATCH_MM: Final = 0.01
MATCH_PX: Final = 0.05
"""How close a profile must come to the printed figures (they carry six decimals; motors less)."""


@dataclass(frozen=True)
class Rebuilt:
    """Geometry from texts.

    Attributes:
        poses: nominal, one for each image.
        machine, profile: what they were built with; None where the figures alone were used.
        positions: motor -> (n,) positions [mm, deg], script's sign; empty without a machine.
        notes: how it was decided, for people.
    """

    poses: Poses
    machine: Machine | None
    profile: Profile | None
    positions: Mapping[str, FloatArray]
    notes: tuple[str, ...]


def angles_deg(settings: ScanSettings, count: int, file: str) -> FloatArray:
    """Stage angle of images 0 to count - 1 by the smooth-scan rule: i * (last - start) / (N - 1).

    Args:
        settings: gives N ("# projections"), start and last angle; rot_obj there is the run-up
            position and does not enter.
        count: number of images wanted.
        file: for error messages.

    Raises:
        DatasetFormatError: the texts state no angles.
    """
    start, last = settings.start_angle_deg, settings.last_angle_deg
    if start is None or last is None:
        raise DatasetFormatError(
            f"{file}: no `Start angle` and `Last angle`; angles cannot be known",
            {"path": file, "missing": ["Start angle", "Last angle"]},
        )
    n = settings.projections if settings.projections is not None else count
    step = (last - start) / (n - 1) if n > 1 else 0.0
    return np.asarray(start + step * np.arange(count), dtype=np.float64)


def rebuild(
    settings: ScanSettings,
    count: int,
    shape: tuple[int, int],
    machines: Sequence[Machine],
    profiles: Sequence[Profile],
    *,
    file: str = "scan settings.txt",
) -> Rebuilt:
    """Poses of images 0 to count - 1.

    Args:
        settings: read from the texts.
        count: number of projections.
        shape: image (rows, cols), from the images.
        machines: candidates; one alone is taken as it is.
        profiles: candidates of any machine; one alone is taken as it is.
        file: for error messages.

    Raises:
        DatasetFormatError: neither machine and motors nor the figures suffice.
    """
    angles = np.radians(angles_deg(settings, count, file))
    machine = machines[0] if len(machines) == 1 else _machine(settings, machines)
    figures = settings.figures
    if machine is None:
        return _from_figures(settings, figures, shape, angles, file)
    positions, notes = _positions(settings, machine, np.degrees(angles))
    camera = _camera(settings, machine, shape, file)
    if camera is None:
        return _from_figures(settings, figures, shape, angles, file)
    own = [p for p in profiles if p.machine == machine.name]
    if len(profiles) == 1 or figures is None:
        profile = profiles[0] if len(profiles) == 1 else _default(machine, own)
        if profile is not None:
            why = "as asked" if len(profiles) == 1 else "the machine's default; no figures to check"
            notes.append(f"profile {profile.name}: {why}")
            found = poses(machine, profile, camera, positions)
            return Rebuilt(found, machine, profile, positions, tuple(notes))
        return _from_figures(settings, figures, shape, angles, file)
    for profile in own:
        pose = poses(machine, profile, camera, {n: v[:1] for n, v in positions.items()})
        if _agree(figures_of(pose, shape), figures):
            notes.append(f"profile {profile.name} reproduces the printed figures")
            found = poses(machine, profile, camera, positions)
            return Rebuilt(found, machine, profile, positions, tuple(notes))
    profile = _default(machine, own)
    heights = poses(machine, profile or _zero(machine), camera, positions)
    notes.append(
        f"no profile of {machine.name} reproduces the printed figures, so these are used; only "
        f"heights come from the motors ({profile.name if profile else 'no offsets'})"
    )
    built = poses_of(
        figures,
        shape,
        angles,
        source_x=float(heights.source[0, 0]),
        source_z=float(heights.source[0, 2]),
        axis_z=float(heights.axis[0, 2]),
    )
    return Rebuilt(built, machine, None, positions, tuple(notes))


def _machine(settings: ScanSettings, machines: Sequence[Machine]) -> Machine | None:
    """The candidate whose scanner name or type the texts name and whose motors they have."""
    said = {_word(settings.scanner_name), _word(settings.scanner_type)} - {""}
    for machine in machines:
        names = {_word(machine.scanner_name), _word(machine.scanner_type), _word(machine.name)}
        if said & names or any(s.startswith(n) for s in said for n in names if n):
            return machine
    if said:
        return None
    complete = [m for m in machines if set(m.axes) <= set(settings.motors)]
    return complete[0] if len(complete) == 1 else None


def _word(text: str | None) -> str:
    return "".join(c for c in (text or "").lower() if c.isalnum())


def _positions(
    settings: ScanSettings, machine: Machine, angles: FloatArray
) -> tuple[dict[str, FloatArray], list[str]]:
    """Motor positions in the script's sign; the rotation follows the angle rule."""
    notes = []
    out = {}
    turning = machine.geometry.get("angle", {})
    for name, axis in machine.axes.items():
        if name in turning:
            out[name] = angles / turning[name]
        elif name in settings.motors:
            out[name] = np.full(len(angles), axis.settings_sign * settings.motors[name].value)
        else:
            out[name] = np.full(len(angles), axis.home)
            notes.append(f"the texts do not say where {name} stood; {axis.home:g} is assumed")
    return out, notes


def _camera(
    settings: ScanSettings, machine: Machine, shape: tuple[int, int], file: str
) -> CameraSettings | None:
    """Camera settings that give images of `shape`; None if the texts do not state them."""
    if settings.roi is None or settings.mode is None:
        return None
    roi = Roi(settings.roi.left, settings.roi.top, settings.roi.right, settings.roi.bottom)
    try:
        camera = CameraSettings(settings.mode, roi)
        stated = camera.shape
    except TwinError:
        return None
    if stated != shape:
        raise DatasetFormatError(
            f"{file}: ROI {roi} in mode {settings.mode} gives images of {stated[1]} x {stated[0]} "
            f"pixels, but the images have {shape[1]} x {shape[0]}",
            {"path": file, "asked": list(shape), "allowed": list(stated)},
        )
    return camera


def _agree(ours: Figures, printed: Figures) -> bool:
    return (
        max(abs(ours.sod_mm - printed.sod_mm), abs(ours.sdd_mm - printed.sdd_mm)) < MATCH_MM
        and abs(ours.pixel_mm - printed.pixel_mm) < 1e-5
        and max(
            abs(ours.hc_px - printed.hc_px),
            abs(ours.vc_px - printed.vc_px),
            abs(ours.cor_px - printed.cor_px),
        )
        < MATCH_PX
    )


def _from_figures(
    settings: ScanSettings,
    figures: Figures | None,
    shape: tuple[int, int],
    angles: FloatArray,
    file: str,
) -> Rebuilt:
    if figures is None:
        raise DatasetFormatError(
            f"{file}: the scanner {settings.scanner_name or '(unnamed)'!r} is not known and not "
            "all of SOD, SDD, COR, VC, HC and `Binned pixel size` are there; give the machine",
            {"path": file, "asked": settings.scanner_name or ""},
        )
    note = (
        f"scanner {settings.scanner_name or '(unnamed)'!r} is not known: geometry is the printed "
        "figures, the sample's reference height is taken to be the focal spot's"
    )
    return Rebuilt(poses_of(figures, shape, angles), None, None, {}, (note,))


def _default(machine: Machine, profiles: Sequence[Profile]) -> Profile | None:
    return next((p for p in profiles if p.name == machine.default_profile), None)


def _zero(machine: Machine) -> Profile:
    return Profile(name="zero", machine=machine.name, source="no offsets")
