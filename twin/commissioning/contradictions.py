"""What of past scans contradicts what: texts, scripts, images, motors and the machine that ships."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from flexdt.twin.commissioning.past_scan import Finding, PastScan, Stand, near, scripted
from flexdt.twin.dataset.rebuild import MATCH_MM
from flexdt.twin.dataset.scan_settings import ENTRIES, ScanSettings
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.camera import CameraSettings, check_roi
from flexdt.twin.machine.description import Machine

PLACES: Final = {
    "SOD less the motors": "c_obj", "SDD less the motors": "c_det", "det_tan of HC": "det_tan",
    "src_ort of VC": "src_ort", "axs_tan of COR": "axs_tan",
}  # fmt: skip
"""What the figures of a settings text say beside its motors -> the zero offset that it is."""

AGREE: Final = 1e-4
"""How far figures of a text that follow from each other may differ, as a part; they carry six
decimals."""


def contradictions(
    scans: Sequence[tuple[PastScan, Stand | None]], shipped: Machine, fitted: Machine
) -> tuple[Finding, ...]:
    """All of them.

    Args:
        scans: the oldest first.
        shipped: the machine that the fit began with.
        fitted: with the limits, rates and signs that the scans show.
    """
    found: list[Finding] = []
    for scan, stand in scans:
        found += _within(scan, stand, fitted)
        found += _beyond(scan, stand, shipped, fitted)
    return (*found, *_between(scans, fitted), *_changed(shipped, fitted))


def _within(scan: PastScan, stand: Stand | None, machine: Machine) -> Iterator[Finding]:
    """What a scan's texts, script and images say of the same thing."""
    s = scan.settings
    if s is None:
        return
    texts, script = f"{scan.name}: settings text", f"{scan.name}: settings text and script"
    if scan.second is not None:
        for name in ENTRIES:
            one, two = getattr(s, name), getattr(scan.second, name)
            if one not in (None, "") and two not in (None, "") and not near(one, two):
                yield Finding(name, f"{scan.name}: the two settings texts", f"{one} and {two}")
    for about, one, two in _figures(s, stand, machine):
        if one is not None and two is not None and not math.isclose(one, two, rel_tol=AGREE):
            yield Finding(about, texts, f"{about} is stated as {one:g}, and follows as {two:g}")
    if stand is not None and scan.shape not in (None, stand.camera.shape):
        told = f"{stand.camera.roi} in {stand.camera.mode} gives {stand.camera.shape}"
        yield Finding("ROI", f"{scan.name}: settings text and images",
                      f"{told} rows and columns, the images have {scan.shape}")  # fmt: skip
    if scan.images and s.projections not in (None, scan.images):
        yield Finding("projections", f"{scan.name}: settings text and images",
                      f"{s.projections} are stated, {scan.images} are there")  # fmt: skip
    for name, asked in scripted(scan.commands, machine).items():
        axis, read = machine.axes.get(name), getattr(s, name, None)
        if axis is not None and name in s.motors:
            asked = min(max(asked, axis.lower), axis.upper)
            read = axis.settings_sign * s.motors[name].value
        if asked is not None and read is not None and not near(asked, read):
            yield Finding(name, script, f"{name} is {read} in the text, {asked} in the script")


def _figures(
    s: ScanSettings, stand: Stand | None, machine: Machine
) -> Iterator[tuple[str, float | None, float | None]]:
    """What a settings text states, and what follows from its other lines."""
    f = s.figures
    yield "magnification", s.magnification, None if f is None else f.magnification
    yield "voxel size [um]", s.voxel_um, None if f is None else f.voxel_um
    if stand is not None:
        yield "binning", s.binning, stand.camera.binning
        yield "binned pixel", s.binned_pixel_mm, stand.camera.pixel_mm(machine.detector.pixels)


def _beyond(
    scan: PastScan, stand: Stand | None, shipped: Machine, fitted: Machine
) -> Iterator[Finding]:
    """What the machine that ships does not have, and motors beyond the fitted limits."""
    s, panel = scan.settings, shipped.detector
    if s is None:
        return
    with_file = f"{scan.name} and machine {shipped.name}"
    try:
        if s.mode is not None:
            panel.check_mode(s.mode)
        if s.mode is not None and s.roi is not None:
            camera = CameraSettings(s.mode, s.roi, modes=panel.camera.modes)
            check_roi(s.roi, panel.pixels, camera.binning)
    except TwinError as error:
        yield Finding("camera", with_file, error.message)
    pitch = s.original_pixel_mm
    if pitch is not None and abs(pitch - panel.pitch_mm) > 1e-6:
        yield Finding(
            "pixel", with_file, f"unbinned pixels of {pitch:g} mm, not {panel.pitch_mm:g}"
        )
    for what, value, most in (
        ("kV", s.kV, shipped.tube.max_kV), ("power", s.power_W, shipped.tube.max_W)
    ):  # fmt: skip
        if value is not None and value > most:
            yield Finding(what, with_file, f"{value:g}, at most {most:g}")
    for name, axis in fitted.axes.items():
        at = None if stand is None or name not in s.motors else float(stand.positions[name][0])
        if at is not None and not axis.lower - MATCH_MM <= at <= axis.upper + MATCH_MM:
            where = f"at {at:g}, beyond {axis.lower:g} to {axis.upper:g}"
            yield Finding(name, f"{scan.name} and the limits", f"{name} stood {where}")


def _between(scans: Sequence[tuple[PastScan, Stand | None]], machine: Machine) -> Iterator[Finding]:
    """What changes from scan to scan and should not."""
    said: dict[tuple[str, str], dict[object, str]] = {}

    def says(scan: PastScan, about: str, value: object, what: str = "") -> None:
        said.setdefault((about, what), {})[value] = scan.name  # the last that says so

    for scan, stand in scans:
        s = scan.settings
        for name in ("scanner_name", "scanner_type", "serial", "original_pixel_mm"):
            if (value := getattr(s, name, None)) not in (None, ""):
                says(scan, name, value)
        for name, motor in {} if s is None else s.motors.items():
            if name not in machine.geometry.get("angle", {}) and motor.speed is not None:
                says(scan, name, (motor.speed, motor.acceleration), "speed and acceleration")
        for x in scan.log:
            m, name = x.motor, getattr(x.command, "component", "")
            if m is not None:
                limits = (m.lower, m.upper, m.max_speed, m.max_acceleration)
                says(scan, name, limits, "limits and greatest rates of the motor's replies")
        if stand is not None and stand.stated:
            for about, name in PLACES.items():
                value = getattr(stand.profile, name)
                of = said.setdefault((name, about), {})
                same = [v for v in of if isinstance(v, float) and near(v, value)]
                of[same[0] if same else round(value, 4)] = scan.name
    for (about, what), values in said.items():
        if len(values) > 1:
            told = "; ".join(f"{_plain(v)} in {name}" for v, name in values.items())
            yield Finding(about, ", ".join(values.values()), f"{what or about}: {told}")


def _plain(value: object) -> str:
    parts = value if isinstance(value, tuple) else (value,)
    return ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in parts)


def _changed(shipped: Machine, fitted: Machine) -> Iterator[Finding]:
    """What of the axes is not as in the machine that ships."""
    for name, axis in fitted.axes.items():
        old: Mapping[str, object] = shipped.axes[name].model_dump()
        new = axis.model_dump(exclude={"home", "source", "description", "kind"})
        other = [f"{key} {value} for {old[key]}" for key, value in new.items() if value != old[key]]
        if other:
            yield Finding(name, f"the scans and machine {shipped.name}", "; ".join(other))
