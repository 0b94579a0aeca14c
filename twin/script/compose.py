"""Compose an Acquila script from a request: distances, frames, exposure, positions.

The text has the scanner's own form (TAB separated, seven columns, CRLF) and follows the smooth-scan
rule: image i of n is taken at i * 360 / (n - 1) after the trigger, and the run-up holds the
acceleration and four images. Motor targets follow from the machine's linear map and the profile's
offsets, so source, detector and sample come out centred. Where no motor moves source or detector,
the sample moves instead. The result is checked by planning it.
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
        sod_mm, sdd_mm: source-object and source-detector distance; None is 600 and 1059 where the
            machine gets there, else its home, or its only one.
        frames: images of one fly scan, of the whole for step and helical.
        exposure_ms, averages: of one image.
        height_mm: of source and detector centre above the origin; None is 20, or as for sod_mm.
        turns, rise_mm: of a helical scan, in total.
        tiles: side by side, for tiled; neighbours share a tenth of the columns.
        placements: for calibration; None is SOD 600 and 800, or what the machine has room for.
        mode, roi: camera; None is the machine's.
        kV, power_W: tube; None is the machine's.
        darks, flats: averages of the dark and of the flat image.
        folder: the scanner's output path; the twin keeps only the file names.
    """

    kind: Kind = "fly"
    sod_mm: float | None = None
    sdd_mm: float | None = None
    frames: int = 361
    exposure_ms: float = 100.0
    averages: int = 1
    height_mm: float | None = None
    turns: float = 3.0
    rise_mm: float = 20.0
    tiles: int = 2
    placements: tuple[ScanPosition, ...] | None = None
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
        LimitError: a count, distance or speed that the machine does not allow, or a motion for
            which it has no motor; says which.
    """
    places = _Places(machine, profile)
    sod = places.usual("object_y", 600.0, request.sod_mm)
    sdd = places.usual("detector_y", 1059.0, request.sdd_mm)
    height = places.usual("source_z", 20.0, request.height_mm)
    placements = request.placements
    if placements is None:
        second = places.usual("object_y", 800.0, sod if sod != 600.0 else None)
        placements = tuple(ScanPosition(s) for s in dict.fromkeys((sod, second)))
    _check_counts(request, sod, sdd, placements)
    full = _Request(**{**vars(request), "sod_mm": sod, "sdd_mm": sdd, "height_mm": height,
                       "placements": placements})  # fmt: skip
    return "".join(f"{row}\r\n" for row in _Writer(machine, profile, full).rows())


@dataclass(frozen=True)
class _Request(ScanRequest):
    """A request in which every distance is known."""

    sod_mm: float = 0.0
    sdd_mm: float = 0.0
    height_mm: float = 0.0
    placements: tuple[ScanPosition, ...] = ()


_OF_STAGES: Final = {
    "object_y": "the source-object distance",
    "detector_y": "the source-detector distance",
    "source_z": "the height of the beam",
    "object_x": "the sample sideways",
    "detector_x": "the detector sideways",
}


@dataclass(frozen=True)
class _Places:
    """Where the motors of a machine bring its stages."""

    machine: Machine
    profile: Profile

    def has(self, *quantities: str) -> bool:
        """Whether motors move all of these."""
        return all(self.machine.geometry.get(quantity) for quantity in quantities)

    def constant(self, quantity: str) -> float:
        """What a quantity is without its motors [mm]."""
        p = self.profile
        offsets = {"source_z": p.src_ort, "detector_x": p.det_tan, "detector_y": p.c_det,
                   "object_x": p.axs_tan, "object_y": p.c_obj,
                   "object_z": self.machine.sample_height_mm}  # fmt: skip
        return offsets.get(quantity, 0.0) + self.machine.fixed.get(quantity, 0.0)

    def motor(self, quantity: str, wanted: float) -> tuple[str, float]:
        """The motor that sets a quantity, and the position that makes it `wanted`.

        Other motors that add to the quantity count as at home.
        """
        factors = self.machine.geometry[quantity]
        name = max(factors, key=lambda n: abs(factors[n]))
        rest = sum(f * self.machine.axis(n).home for n, f in factors.items() if n != name)
        target = (wanted - self.constant(quantity) - rest) / factors[name]
        return name, round(target, 6)

    def usual(self, quantity: str, wanted: float, asked: float | None) -> float:
        """What was asked for, else `wanted` if motors reach it, else where they are at home."""
        if asked is not None:
            return asked
        if self.has(quantity):
            name, target = self.motor(quantity, wanted)
            axis = self.machine.axis(name)
            if axis.lower <= target <= axis.upper:
                return wanted
        factors = self.machine.geometry.get(quantity, {})
        home = sum(factor * self.machine.axis(n).home for n, factor in factors.items())
        return round(self.constant(quantity) + home, 6)

    def need(self, what: str, *quantities: str) -> None:
        """Check that motors move all of `quantities`.

        Raises:
            LimitError: what cannot be done, and which quantity no motor moves.
        """
        for quantity in quantities:
            if not self.has(quantity):
                raise LimitError(
                    f"{self.machine.name} has no motor for {_OF_STAGES[quantity]}, which {what} "
                    "needs",
                    {"asked": what, "missing": quantity},
                )


@dataclass(frozen=True)
class _Writer(_Places):
    request: _Request

    def rows(self) -> Iterator[str]:
        w = self.request
        out = self.out_of_beam()
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
        yield from self.go(*self.aside)
        yield from self.turn(360.0, self.request.frames, 0)

    def step(self) -> Iterator[str]:
        w = self.request
        name, rotation = self.rotation
        yield from self.go(*self.aside)
        yield from self.drive(name, rotation.speed, rotation.acceleration)
        yield _row("camera", "set number of averages", str(w.averages))
        yield _row("scanner", "write settings file")
        for i in range(w.frames):
            yield _row(name, "move absolute", _f(i * 360.0 / w.frames))
            yield _row("camera", "take image")
            yield _row("camera", "save image", f"{w.folder}\\scan_{i:06d}.tif")

    def tiled(self) -> Iterator[str]:
        w, camera = self.request, self.camera
        self.need("a tiled scan", "detector_x")
        width = camera.shape[1] * camera.pixel_mm(self.machine.detector.sensor)
        for k in range(w.tiles):
            shift = (k - (w.tiles - 1) / 2) * 0.9 * width
            yield from self.go(*self.aside, "detector_x", shift=shift)
            yield from self.turn(360.0, w.frames, k * w.frames)

    def calibration(self) -> Iterator[str]:
        w = self.request
        for k, place in enumerate(w.placements):
            moved = ("object_y",) if self.has("object_y") else ()
            yield from self.go(*self.aside, *moved, place=place)
            yield from self.turn(360.0, w.frames, k * w.frames)

    def helical(self) -> Iterator[str]:
        """Source and detector rise at constant speed from before the trigger to after the end.

        Where no motors raise them, the sample sinks.
        """
        w, m = self.request, self.machine
        name, rotation = self.rotation
        total = 360.0 * w.turns
        speed = self.turn_speed(total, w.frames)
        scan_s = total / speed
        lead_s = speed / rotation.acceleration + MARGIN_IMAGES * self.image_s
        rise_speed = w.rise_mm / scan_s
        moved: tuple[str, ...] = ("source_z", "detector_z")
        if not self.has(*moved):
            moved = ("object_z",)
        if not self.has(*moved):
            raise LimitError(
                f"{m.name} has no motors that raise source and detector together, and none that "
                "lowers the sample, which a helical scan needs",
                {"asked": "helical", "missing": ["source_z", "detector_z", "object_z"]},
            )
        yield from self.go(*self.aside)
        station = self.station(w.sod_mm, 0.0, 0.0)
        targets: dict[str, tuple[float, float]] = {}
        for quantity in moved:
            motor = self.motor(quantity, 0.0)[0]
            at, factor = station[motor], m.geometry[quantity][motor]
            axis = m.axis(motor)
            if rise_speed > axis.max_speed or rise_speed / axis.acceleration > lead_s:
                raise LimitError(
                    f"a rise of {w.rise_mm:g} mm in {scan_s:.3g} s needs {rise_speed:.3g} mm/s, "
                    f"which {motor} does not reach within the run-up; lower rise_mm or raise "
                    "frames, exposure or averages",
                    {"asked": rise_speed, "allowed": axis.max_speed, "axis": motor},
                )
            ramp = 0.5 * rise_speed**2 / axis.acceleration
            below = (w.rise_mm / 2 + rise_speed * lead_s - ramp) / factor
            below = -below if quantity == "object_z" else below
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
        names = [self.motor(quantity, 0.0)[0] for quantity in quantities]
        yield from self.moves({name: every[name] for name in names})

    def station(self, sod: float, lateral: float, detector_shift: float) -> dict[str, float]:
        """Motor targets that put everything where it belongs, checked against travel limits."""
        w = self.request
        height = w.height_mm
        wanted = {
            "source_x": 0.0,
            "source_z": height,
            "detector_x": detector_shift - self.column_shift,
            "detector_z": height + self.row_shift,
            "detector_y": w.sdd_mm,
            "object_y": sod,
            "object_x": lateral,
        }
        if not self.has("source_z"):
            wanted["object_z"] = height  # the sample's middle into the beam
        for quantity in ("source_z", "detector_y", "object_y", "object_x"):
            only = self.constant(quantity)
            asked = wanted[quantity]
            if not self.has(quantity) and abs(asked - only) > 1e-6 and asked:
                self.need(f"{asked:g} mm ({only:g} mm is all there is)", quantity)
        moved = [self.motor(q, value) for q, value in wanted.items() if self.has(q)]
        return {name: check_target(self.machine, name, value) for name, value in moved}

    @property
    def aside(self) -> tuple[str, ...]:
        """The quantity by which the sample leaves the beam."""
        return tuple(q for q in ("object_x", "object_z") if self.has(q))[:1]

    def out_of_beam(self) -> dict[str, float]:
        """Where the stage goes for the flat field: as far as the beam asks, to the freer side."""
        w, camera = self.request, self.camera
        if not self.aside:
            raise LimitError(
                f"{self.machine.name} has no motor that takes the sample out of the beam, so a "
                "script cannot take its flat field",
                {"asked": "a flat field", "missing": ["object_x", "object_z"]},
            )
        name, _ = self.motor(self.aside[0], 0.0)
        centre = self.station(w.sod_mm, 0.0, 0.0).get(name, self.machine.axis(name).home)
        axis = self.machine.axis(name)
        across = self.aside[0] == "object_x"
        size = camera.shape[1 if across else 0]
        pixel = camera.pixels_mm(self.machine.detector.sensor)[0 if across else 1]
        away = size * pixel * w.sod_mm / w.sdd_mm / 2 + FREE_MM
        left = centre - axis.lower > axis.upper - centre
        return {name: max(axis.lower, centre - away) if left else min(axis.upper, centre + away)}

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


def _check_counts(
    request: ScanRequest, sod: float, sdd: float, placements: Sequence[ScanPosition]
) -> None:
    smooth = request.kind != "step"
    rules: Sequence[tuple[str, float, float, float]] = (
        ("frames", request.frames, 2 if smooth else 1, MAX_FRAMES),
        ("averages", request.averages, 1, 10_000),
        ("darks", request.darks, 1, 10_000),
        ("flats", request.flats, 1, 10_000),
        ("tiles", request.tiles, 1, 100),
        ("placements", len(placements), 1, 100),
        ("exposure_ms", request.exposure_ms, 1e-3, 1e7),
        ("turns", request.turns, 1e-3, 40.0),
        ("sod_mm", sod, 1e-3, sdd),
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
