"""Poses from the settings texts alone, for data sets without flexdt.json: above all real scans.

The machine is found by its name or its motors, the profile by reproducing the printed SOD, SDD,
COR, VC and HC. Where no profile does, the printed figures are the geometry and only heights
come from the motors. Every such decision is recorded as a note; missing figures are errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.scan_settings import ScanSettings
from flexdt.twin.dataset.stated_geometry import Figures, figures_of, poses_of
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import ZERO, Machine, Profile, profile_of
from flexdt.twin.machine.kinematics import motor_poses

MATCH_MM: Final = 0.01
MATCH_PX: Final = 0.05
"""Largest deviation of a matching profile from the printed figures [px]."""


@dataclass(frozen=True)
class Rebuilt:
    """Geometry computed from texts.

    Attributes:
        poses: nominal, one for each image.
        machine, profile: by which they were computed; None if the figures alone were
            used.
        positions: motor -> (n,) positions [mm, deg], script's sign; empty without a
            machine.
        notes: reasons for the choices, for people.
    """

    poses: Poses
    machine: Machine | None
    profile: Profile | None
    positions: Mapping[str, FloatArray]
    notes: tuple[str, ...]


def angles_deg(settings: ScanSettings, count: int, file: str) -> FloatArray:
    """Compute stage angles of images 0 to count - 1, i * (last - start) / (N - 1),
    (count,) [deg].

    N is "# projections", or else `count`; images beyond it continue. The texts' rot_obj
    is the run-up position and does not enter. Raises DatasetFormatError: no angles are
    stated.
    """
    start = settings.start_angle_deg
    last = settings.last_angle_deg
    if start is None or last is None:
        raise DatasetFormatError(
            f"{file}: no `Start angle` and `Last angle`; angles cannot be known",
            {"path": file, "missing": ["Start angle", "Last angle"]},
        )
    n = count
    if settings.projections is not None:
        n = settings.projections
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
    """Compute poses of images 0 to count - 1 from the scanner's texts.

    Motors and a profile that reproduces the printed figures are used where possible. Else
    the printed figures are the geometry, with heights from motors and offsets where those
    are known. The detector is moved to its physical place first (`physical`).

    Args:
        settings: read from the texts.
        count: number of projections.
        shape: image (rows, cols), from the images.
        machines: candidates; one alone is taken as it is, whatever its name.
        profiles: candidates of any machine; one alone is taken as it is, unchecked.
        file: for error messages.

    Returns:
        Poses; machine (None if unknown) and profile (None if the figures are the
        geometry); motor positions; and notes on all that was assumed.

    Raises:
        DatasetFormatError: no angles; ROI and mode that contradict the images' shape; or
            neither machine and motors nor the figures suffice.
    """
    angles = np.radians(angles_deg(settings, count, file))
    settings, notes = physical(settings, file)
    machine = machines[0] if len(machines) == 1 else named_machine(settings, machines)
    figures = settings.figures
    place = dict[str, float]()
    positions: dict[str, FloatArray] = {}
    height = "the sample's reference height is taken to be the focal spot's"
    if machine is None:
        why = f"scanner {settings.scanner_name or '(unnamed)'!r} is not known"
    elif not set(settings.motors) & set(machine.axes):
        machine = None
        why = "the texts state no motor positions"
    else:
        positions, assumed = _positions(settings, machine, np.degrees(angles))
        notes = [*assumed, *notes]
        camera = _camera(settings, shape, file, machine.detector.camera.modes)
        choice = None
        if camera is not None:
            choice = _profile(machine, profiles, camera, positions, figures)
        if choice is not None and camera is not None:
            profile, why = choice
            notes.append(f"profile {profile.name}{why}")
            nominal = motor_poses(machine, profile, camera, positions)
            return Rebuilt(nominal, machine, profile, positions, tuple(notes))
        nothing = Profile(name=ZERO, machine=machine.name, source="no offsets")
        offsets = _default_profile(machine, profiles) or nothing
        heights = motor_poses(machine, offsets, machine.detector.camera, positions)
        why = (
            "no ROI and mode"
            if camera is None
            else "no profile reproduces the printed figures"
        )
        height = f"heights come from the motors and {offsets.name}"
        place = {
            "source_x": float(heights.source[0, 0]),
            "source_z": float(heights.source[0, 2]),
            "axis_z": float(heights.axis[0, 2]),
        }
    if figures is None:
        raise DatasetFormatError(
            f"{file}: {why}, and not all of SOD, SDD, COR, VC, HC and `Binned pixel size` are "
            "there, so the geometry is unknown; give the machine and a profile",
            {"path": file, "reason": why},
        )
    notes.append(f"{why}, so the printed figures are the geometry; {height}")
    poses = poses_of(figures, shape, angles, **place)
    return Rebuilt(poses, machine, None, positions, tuple(notes))


def physical(settings: ScanSettings, file: str) -> tuple[ScanSettings, list[str]]:
    """Move the detector of the settings to its physical place (mag_det, and as far as
    stated SDD and COR), and note the changes.

    Differences of `mag_det_phys` and `mag_det` up to 1e-6 mm do not count, nor does one
    of them alone.

    Args:
        settings: read from the texts; not changed.
        file: for error messages.

    Returns:
        The settings with the physical place, and the notes; `settings` itself and no
        notes where nothing differs.

    Raises:
        DatasetFormatError: the detector would not be behind the axis.
    """
    read, real = (settings.motors.get(name) for name in ("mag_det", "mag_det_phys"))
    if read is None or real is None or abs(real.value - read.value) < 1e-6:
        return settings, []
    far = real.value - read.value
    sdd = settings.sdd_mm
    cor = settings.cor_px
    hc = settings.hc_px
    if sdd is not None and sdd + far <= 0.0:
        raise DatasetFormatError(
            f"{file}: mag_det_phys {real.value:g} puts the detector behind the source",
            {"path": file, "asked": real.value},
        )
    if sdd is not None and cor is not None and hc is not None:
        cor = hc + (cor - hc) * (sdd + far) / sdd
    note = (
        f"mag_det_phys is {real.value:g} mm, mag_det {read.value:g} mm: the detector "
        f"is taken to be {far:+g} mm from where SDD has it"
    )
    motors = {**settings.motors, "mag_det": real}
    return replace(
        settings, motors=motors, sdd_mm=None if sdd is None else sdd + far, cor_px=cor
    ), [note]


def _profile(
    machine: Machine,
    profiles: Sequence[Profile],
    camera: CameraSettings,
    positions: Mapping[str, FloatArray],
    printed: Figures | None,
) -> tuple[Profile, str] | None:
    """Choose the only profile given, or the machine's first that reproduces the printed
    figures.

    Compared at the first image's positions (`_figures_agree`). Zero offsets are tried
    last, only for a machine without a default; without figures it is the default,
    unchecked.
    `profiles`: of any machine. `positions`: motor -> (n,) [mm, deg]. Returns also the
    reason for the choice; None if no profile fits.
    """
    if len(profiles) == 1:
        return profiles[0], ": as asked"
    if printed is None:
        chosen = _default_profile(machine, profiles)
        if chosen is None:
            return None
        return (chosen, ": the default, no figures to check it by")
    first = {n: v[:1] for n, v in positions.items()}
    zero = () if machine.default_profile else (profile_of(machine),)
    for profile in (*profiles, *zero):
        if profile.machine == machine.name:
            ours = figures_of(motor_poses(machine, profile, camera, first), camera.shape)
            if _figures_agree(ours, printed):
                return profile, " reproduces the printed figures"
    return None


def named_machine(settings: ScanSettings, machines: Sequence[Machine]) -> Machine | None:
    """Find the machine that the texts name, or else the only one whose motors they all
    list.

    Letter case, blanks and signs do not matter. A scanner name or type must be a
    machine's scanner name, type or name, or begin with it; the first such one is taken.
    None if a stated name fits none, or without a name none or several fit.
    """
    stated = {_word(settings.scanner_name), _word(settings.scanner_type)} - {""}
    for machine in machines:
        names = {
            _word(machine.scanner_name),
            _word(machine.scanner_type),
            _word(machine.name),
        }
        if stated & names or any(s.startswith(n) for s in stated for n in names if n):
            return machine
    if stated:
        return None
    complete = [m for m in machines if set(m.axes) <= set(settings.motors)]
    if len(complete) == 1:
        return complete[0]
    return None


def _word(text: str | None) -> str:
    """Reduce a text to its letters and digits in lower case; "" for None."""
    return "".join(c for c in (text or "").lower() if c.isalnum())


def _positions(
    settings: ScanSettings, machine: Machine, angles: FloatArray
) -> tuple[dict[str, FloatArray], list[str]]:
    """Compute motor positions [mm, deg] in the script's sign from the texts.

    A motor that turns the stage gets the `angles` (n,) [deg] over its factor; others that
    the texts lack are at home, with a note each. Returns motor -> (n,), and the notes.
    """
    notes = []
    out = {}
    turning = machine.geometry.get("angle", {})
    for name, axis in machine.axes.items():
        if name in turning:
            out[name] = angles / turning[name]
        elif name in settings.motors:
            out[name] = np.full(
                len(angles), axis.settings_sign * settings.motors[name].value
            )
        else:
            out[name] = np.full(len(angles), axis.home)
            notes.append(
                f"the texts do not say where {name} stood; {axis.home:g} is assumed"
            )
    return out, notes


def _camera(
    settings: ScanSettings,
    shape: tuple[int, int],
    file: str,
    modes: tuple[tuple[str, int], ...],
) -> CameraSettings | None:
    """Make camera settings for images of `shape` from the texts.

    None also if they contradict each other.

    Args:
        settings: with ROI and mode.
        shape: of the images (rows, cols).
        file: for error messages.
        modes: named modes of the machine: name, binning.

    Returns the settings; None if the texts lack ROI or mode, or the mode is unknown.
    Raises DatasetFormatError: ROI and mode give images of another shape.
    """
    if settings.roi is None or settings.mode is None:
        return None
    try:
        camera = CameraSettings(settings.mode, settings.roi, modes=modes)
        stated = camera.shape
    except TwinError:
        return None
    if stated != shape:
        raise DatasetFormatError(
            f"{file}: ROI {settings.roi} in mode {settings.mode} gives images of {stated[1]} x "
            f"{stated[0]} pixels, but the images have {shape[1]} x {shape[0]}",
            {"path": file, "asked": list(shape), "allowed": list(stated)},
        )
    return camera


def _figures_agree(ours: Figures, printed: Figures) -> bool:
    """Return whether figures agree with the printed ones.

    Within `MATCH_MM` (SOD, SDD), `MATCH_PX` (HC, VC, COR), 1e-5 mm of pitch.
    """
    slack = {"sod_mm": MATCH_MM, "sdd_mm": MATCH_MM, "pixel_mm": 1e-5}
    return all(
        abs(value - getattr(printed, name)) < slack.get(name, MATCH_PX)
        for name, value in vars(ours).items()
    )


def _default_profile(machine: Machine, profiles: Sequence[Profile]) -> Profile | None:
    """Find the default profile of a machine among `profiles`.

    Zero offsets where it has none, None where it is missing.
    """
    if not machine.default_profile:
        return profile_of(machine)
    return next(
        (
            p
            for p in profiles
            if (p.machine, p.name) == (machine.name, machine.default_profile)
        ),
        None,
    )
