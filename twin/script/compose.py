"""Compose an Acquila script from a request: distances, frames, exposure, positions.

The text has the scanner's own form (TAB separated, seven columns, CRLF) and follows the smooth-scan
rule: image i of n is taken at i * 360 / (n - 1) after the trigger, and the run-up holds the
acceleration and four images. Motor targets follow from the machine's linear map and the profile's
offsets, so source, detector and sample come out centred. The result is checked by planning it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Axis, Machine, Profile, check_target
from flexdt.twin.script.planning.smooth_scan import MARGIN_IMAGES, run_up

Kind = Literal["fly", "step", "tiled", "helical", "calibration"]

KINDS: Final[tuple[Kind, ...]] = ("fly", "step", "tiled", "helical", "calibration")
FREE_MM: Final = 60.0
"""How far beyond the field of view the sample goes for the flat field (assumed: any sample)."""

MAX_FRAMES: Final = 100_000


@dataclass(frozen=True)
class ScanPosition:
    """The sample's position in one scan of a calibration series: SOD and lateral offset [mm]."""

    sod_mm: float
    lateral_mm: float = 0.0


@dataclass(frozen=True)
class ScanRequest:
    """The scan to compose a script for, in the edge's units.

    Attributes:
        kind: fly (one smooth turn), step (stop for every image), tiled (fly scans with the detector
            side by side), helical (several turns while source and detector rise), calibration (one
            fly scan for each of `placements`).
        sod_mm, sdd_mm: source-object and source-detector distance.
        frames: images of one fly scan, of the whole for step and helical.
        exposure_ms, averages: of one image.
        height_mm: of source and detector centre above the origin.
        turns, rise_mm: of a helical scan, in total.
        tiles: side by side, for tiled; neighbours share a tenth of the columns.
        placements: for calibration.
        mode, roi: camera; None is the machine's.
        kV, power_W: tube; None is the machine's.
        darks, flats: averages of the dark and of the flat image.
        folder: the scanner's output path; the twin keeps only the file names.
    """

    kind: Kind = "fly"
    sod_mm: float = 600.0
    sdd_mm: float = 1059.0
    frames: int = 361
    exposure_ms: float = 100.0
    averages: int = 1
    height_mm: float = 20.0
    turns: float = 3.0
    rise_mm: float = 20.0
    tiles: int = 2
    placements: tuple[ScanPosition, ...] = (ScanPosition(600.0), ScanPosition(800.0))
    mode: str | None = None
    roi: Roi | None = None
    kV: float | None = None
    power_W: float | None = None
    darks: int = 10
    flats: int = 10
    folder: str = "E:\\flexdt\\scan"


def compose_script(request: ScanRequest, machine: Machine, profile: Profile) -> str:
    """The text of a script for a requested scan.

    Args:
        request: the scan; it is checked before anything is written.
        machine: whose axes, limits and camera these are.
        profile: zero offsets, so that source, detector and sample are centred.

    Raises:
        LimitError: a count, distance or speed that the machine does not allow; says which.
    """
    _check_counts(request)
    return "".join(f"{row}\r\n" for row in _Writer(request, machine, profile).rows())


@dataclass(frozen=True)
class _Writer:
    request: ScanRequest
    machine: Machine
    profile: Profile

    def rows(self) -> Iterator[str]:
        w = self.request
        centre = self.motor("object_x", 0.0, self.profile.axs_tan)
        out = {centre[0]: self.out_of_beam(*centre)}
        yield _row("scanner", "pause", "0.000000")
        yield _row("scanner", "set output path", w.folder)
        yield from self.settings()
        yield from self.moves(self.station(w.sod_mm, 0.0, 0.0) | out)
        yield from self.references()
        yield from {
            "fly": self.fly,
            "step": self.step,
            "tiled": self.tiled,
            "helical": self.helical,
            "calibration": self.calibration,
        }[w.kind]()
        yield _row("tube", "xrayoff")

    def settings(self) -> Iterator[str]:
        w, m = self.request, self.machine
        camera = self.camera
        yield _row("tube", "set kV", _f(m.tube.kV if w.kV is None else w.kV))
        yield _row("tube", "set power", _f(m.tube.power_W if w.power_W is None else w.power_W))
        yield _row("camera", "set mode", camera.mode)
        yield _row("camera", "set exposure", _f(w.exposure_ms))
        yield _row("camera", "set ROI", str(camera.roi))

    def references(self) -> Iterator[str]:
        """Dark and flat with the sample out of the beam; X-rays stay on."""
        w = self.request
        yield _row("camera", "set number of frames", "1")
        yield _row("tube", "xrayoff")
        yield from self.image("di000000.tif", w.darks)
        yield _row("tube", "xrayon")
        yield _row("tube", "REPEAT UNTIL TRUE status_XReady_get")
        yield _row("scanner", "keep xrayon", "TRUE")
        yield from self.image("io000000.tif", w.flats)

    def fly(self) -> Iterator[str]:
        yield from self.go("object_x")
        yield from self.turn(360.0, self.request.frames, 0)

    def step(self) -> Iterator[str]:
        w = self.request
        name, rotation = self.rotation
        yield from self.go("object_x")
        yield from self.drive(name, rotation.speed, rotation.acceleration)
        yield _row("camera", "set number of averages", str(w.averages))
        yield _row("scanner", "write settings file")
        for i in range(w.frames):
            yield _row(name, "move absolute", _f(i * 360.0 / w.frames))
            yield _row("camera", "take image")
            yield _row("camera", "save image", f"{w.folder}\\scan_{i:06d}.tif")

    def tiled(self) -> Iterator[str]:
        w, camera = self.request, self.camera
        width = camera.shape[1] * camera.pixel_mm(self.machine.detector.sensor)
        for k in range(w.tiles):
            shift = (k - (w.tiles - 1) / 2) * 0.9 * width
            yield from self.go("object_x", "detector_x", shift=shift)
            yield from self.turn(360.0, w.frames, k * w.frames)

    def calibration(self) -> Iterator[str]:
        w = self.request
        for k, place in enumerate(w.placements):
            yield from self.go("object_x", "object_y", place=place)
            yield from self.turn(360.0, w.frames, k * w.frames)

    def helical(self) -> Iterator[str]:
        """Source and detector rise at constant speed from before the trigger to after the end."""
        w, m = self.request, self.machine
        name, rotation = self.rotation
        total = 360.0 * w.turns
        speed = self.turn_speed(total, w.frames)
        scan_s = total / speed
        lead_s = speed / rotation.acceleration + MARGIN_IMAGES * self.image_s
        rise_speed = w.rise_mm / scan_s
        source = self.motor("source_z", w.height_mm, self.profile.src_ort)
        panel = self.motor("detector_z", w.height_mm + self.row_shift, 0.0)
        yield from self.go("object_x")
        targets: dict[str, tuple[float, float]] = {}
        for motor, at in (source, panel):
            axis = m.axis(motor)
            if rise_speed > axis.max_speed or rise_speed / axis.acceleration > lead_s:
                raise LimitError(
                    f"a rise of {w.rise_mm:g} mm in {scan_s:.3g} s needs {rise_speed:.3g} mm/s, "
                    f"which {motor} does not reach within the run-up; lower rise_mm or raise "
                    "frames, exposure or averages",
                    {"asked": rise_speed, "allowed": axis.max_speed, "axis": motor},
                )
            ramp = 0.5 * rise_speed**2 / axis.acceleration
            below = w.rise_mm / 2 + rise_speed * lead_s - ramp
            targets[motor] = (
                check_target(m, motor, at - below),
                check_target(m, motor, at + below),
            )
        yield from self.moves({motor: low for motor, (low, _) in targets.items()})
        for motor in targets:
            yield _row(motor, "set speed", f"{rise_speed:.10f}")
        yield from self.run_up(total, w.frames)
        for motor, (_, high) in targets.items():
            yield _row(motor, "move absolute", _f(high), wait="no wait")
        yield from self.sweep(total, w.frames, 0)
        for motor in targets:
            yield _row(motor, "set speed", f"{m.axis(motor).speed:.10f}")
        yield from self.drive(name, rotation.speed, rotation.acceleration)

    def turn(self, total: float, frames: int, first: int) -> Iterator[str]:
        """A smooth scan of `frames` images over `total` degrees from angle 0, and its run-up."""
        name, rotation = self.rotation
        yield from self.run_up(total, frames)
        yield from self.sweep(total, frames, first)
        yield from self.drive(name, rotation.speed, rotation.acceleration)

    def run_up(self, total: float, frames: int) -> Iterator[str]:
        name, rotation = self.rotation
        yield from self.drive(name, rotation.speed, rotation.acceleration)
        yield _row(name, "move absolute", _f(-self.run_up_deg(total, frames)))
        yield from self.drive(name, self.turn_speed(total, frames), rotation.acceleration)
        yield _row("camera", "set number of frames", str(frames))
        yield _row("camera", "set number of averages", str(self.request.averages))
        yield _row("scanner", "write settings file")

    def sweep(self, total: float, frames: int, first: int) -> Iterator[str]:
        name = self.rotation[0]
        end = check_target(self.machine, name, total + self.run_up_deg(total, frames))
        yield _row(name, "move absolute", _f(end), "0.000000", "POS")
        yield _row(
            "camera", "take and save image sequence", f"{self.request.folder}\\scan_", str(first)
        )

    def turn_speed(self, total: float, frames: int) -> float:
        """Speed of a smooth scan [deg/s].

        Raises:
            LimitError: faster than the axis turns.
        """
        name, rotation = self.rotation
        speed = total / (frames - 1) / self.image_s
        if speed > rotation.max_speed:
            raise LimitError(
                f"{frames} frames of {self.image_s * 1000:g} ms over {total:g} deg need "
                f"{speed:.4g} deg/s, but {name} turns at most {rotation.max_speed:g} deg/s; raise "
                "frames, exposure or averages",
                {"asked": speed, "allowed": rotation.max_speed, "axis": name},
            )
        return speed

    def run_up_deg(self, total: float, frames: int) -> float:
        speed = self.turn_speed(total, frames)
        return run_up(speed, self.rotation[1].acceleration, self.image_s)

    def go(
        self, *quantities: str, place: ScanPosition | None = None, shift: float = 0.0
    ) -> Iterator[str]:
        """Move only the motors of `quantities` to their station."""
        at = ScanPosition(self.request.sod_mm) if place is None else place
        every = self.station(at.sod_mm, at.lateral_mm, shift)
        names = [self.motor(quantity, 0.0, 0.0)[0] for quantity in quantities]
        yield from self.moves({name: every[name] for name in names})

    def station(self, sod: float, lateral: float, detector_shift: float) -> dict[str, float]:
        """Motor targets that put everything where it belongs, checked against travel limits."""
        p, w = self.profile, self.request
        height = w.height_mm
        wanted = (
            ("source_x", 0.0, 0.0),
            ("source_z", height, p.src_ort),
            ("detector_x", detector_shift - self.column_shift, p.det_tan),
            ("detector_z", height + self.row_shift, 0.0),
            ("detector_y", w.sdd_mm, p.c_det),
            ("object_y", sod, p.c_obj),
            ("object_x", lateral, p.axs_tan),
        )
        moved = [self.motor(*q) for q in wanted if self.machine.geometry.get(q[0])]
        return {name: check_target(self.machine, name, value) for name, value in moved}

    def motor(self, quantity: str, wanted: float, offset: float) -> tuple[str, float]:
        """The motor that sets a quantity, and the position that makes it `wanted`.

        Other motors that add to the quantity count as at home.
        """
        factors = self.machine.geometry[quantity]
        name = max(factors, key=lambda n: abs(factors[n]))
        rest = sum(f * self.machine.axis(n).home for n, f in factors.items() if n != name)
        base = self.machine.sample_height_mm if quantity == "object_z" else 0.0
        return name, round((wanted - offset - base - rest) / factors[name], 6)

    def out_of_beam(self, name: str, centre: float) -> float:
        """Where the stage goes for the flat field: as far as the beam asks, to the freer side."""
        w, camera = self.request, self.camera
        axis = self.machine.axis(name)
        pixel = camera.pixel_mm(self.machine.detector.sensor)
        away = camera.shape[1] * pixel * w.sod_mm / w.sdd_mm / 2 + FREE_MM
        left = centre - axis.lower > axis.upper - centre
        return max(axis.lower, centre - away) if left else min(axis.upper, centre + away)

    def image(self, file: str, averages: int) -> Iterator[str]:
        yield _row("camera", "set number of averages", str(averages))
        yield _row("camera", "take image")
        yield _row("camera", "save image", f"{self.request.folder}\\{file}")

    def moves(self, targets: dict[str, float]) -> Iterator[str]:
        """Moves that start together; asking each again waits until all have arrived."""
        if len(targets) > 1:
            for name, value in targets.items():
                yield _row(name, "move absolute", _f(value), wait="no wait")
        for name, value in targets.items():
            yield _row(name, "move absolute", _f(value))

    def drive(self, name: str, speed: float, acceleration: float) -> Iterator[str]:
        yield _row(name, "set speed", f"{speed:.10f}")
        yield _row(name, "set acceleration", _f(acceleration))

    @property
    def camera(self) -> CameraSettings:
        w, camera = self.request, self.machine.detector.camera
        camera = camera if w.mode is None else replace(camera, mode=w.mode)
        return camera if w.roi is None else replace(camera, roi=w.roi)

    @property
    def column_shift(self) -> float:
        return self.camera.roi_shift_mm(self.machine.detector.sensor)[0]

    @property
    def row_shift(self) -> float:
        return self.camera.roi_shift_mm(self.machine.detector.sensor)[1]

    @property
    def rotation(self) -> tuple[str, Axis]:
        name = next(iter(self.machine.geometry["angle"]))
        return name, self.machine.axis(name)

    @property
    def image_s(self) -> float:
        return self.request.exposure_ms * self.request.averages / 1000.0


def _check_counts(request: ScanRequest) -> None:
    smooth = request.kind != "step"
    rules: Sequence[tuple[str, float, float, float]] = (
        ("frames", request.frames, 2 if smooth else 1, MAX_FRAMES),
        ("averages", request.averages, 1, 10_000),
        ("darks", request.darks, 1, 10_000),
        ("flats", request.flats, 1, 10_000),
        ("tiles", request.tiles, 1, 100),
        ("placements", len(request.placements), 1, 100),
        ("exposure_ms", request.exposure_ms, 1e-3, 1e7),
        ("turns", request.turns, 1e-3, 40.0),
        ("sod_mm", request.sod_mm, 1e-3, request.sdd_mm),
    )
    for name, value, least, most in rules:
        if not (math.isfinite(value) and least <= value <= most):
            raise LimitError(
                f"{name} is {value:g}; allowed: {least:g} to {most:g}",
                {"setting": name, "asked": value, "allowed": [least, most]},
            )


def _row(component: str, command: str, first: str = "", second: str = "", wait: str = "ACK") -> str:
    return "\t".join((component, command, first, second, wait, "", ""))


def _f(value: float) -> str:
    return f"{value:.6f}"
