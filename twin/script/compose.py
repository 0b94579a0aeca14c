"""Compose an Acquila script from a request: distances, frames, exposure, positions.

The text has the scanner's own form (TAB separated, seven columns, CRLF) and follows the
smooth-scan rule: image i of n is taken at i * 360 / (n - 1) after the trigger, and the
run-up holds the acceleration and four images. `motor_targets` brings source, detector and
sample to the beam's middle. Where no motor moves source or detector, the sample moves
instead. The result is checked by planning it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    ROW_DIRECTION,
    FloatArray,
    turn_detector,
)
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Axis, Machine, Profile
from flexdt.twin.machine.travel import check_target
from flexdt.twin.scanner.state import (
    CameraChange,
    TubeSettings,
    changed_camera,
    changed_tube,
)
from flexdt.twin.script.motor_targets import QUANTITIES, MotorTargets, beside_beam
from flexdt.twin.script.planning.planned_images import MARGIN_IMAGES, run_up
from flexdt.twin.script.scan_request import ScanPosition, ScanRequest

MAX_FRAMES: Final = 100_000
_ROUNDED_MM: Final = 1e-4
"""Largest difference from a requested quantity that six decimals may cause [mm]."""
MAX_LATERAL_SHARE: Final = 0.1
"""Largest distance from the beam, as a part of the field of view, that no motor has to correct.

Zero offsets are of that kind, a machine built otherwise is not (assumed).
"""


def compose_script(request: ScanRequest, machine: Machine, profile: Profile) -> str:
    """Compose the text of a script for a requested scan.

    Distances that the request leaves out are tried in the order of `_distances_to_try`:
    the usual ones, then those at home; the first that the machine allows are taken, else
    the last attempt's error is raised. Without placements there is one at that SOD; if it
    is 600 mm a second one at 800 mm, or at home, is added where possible. Exposure is the
    machine's if the request has none.

    Args:
        request: the scan; it is checked before anything is written.
        machine: whose axes, limits and camera these are.
        profile: zero offsets, so that source, detector and sample are centered.

    Returns:
        TAB separated lines with CRLF, as `parse_script` reads them.

    Raises:
        LimitError: a count, distance or speed that the machine does not allow, or a
            motion for which it has no motor; names the one.
    """
    panel = machine.detector
    tube = machine.tube
    if request.exposure_ms is None:
        exposure = panel.exposure_ms
    else:
        exposure = request.exposure_ms
    change: CameraChange = {
        "mode": request.mode,
        "roi": request.roi,
        "exposure_ms": exposure,
    }
    changed_camera(panel, panel.camera, change)
    changed_tube(tube, TubeSettings(tube.kV, tube.power_W), request.kV, request.power_W)
    attempts = list(_distances_to_try(request, MotorTargets(machine, profile)))
    for sod, sdd, height in attempts:
        placed = (
            (ScanPosition(sod),) if request.placements is None else request.placements
        )
        full = _Request(
            **{
                **vars(request),
                "sod_mm": sod,
                "sdd_mm": sdd,
                "height_mm": height,
                "exposure_ms": exposure,
                "placements": placed,
            }
        )
        try:
            _check_counts(full)
            writer = _Writer(machine, profile, full)
            writer.station(sod)
        except LimitError:
            if (sod, sdd, height) == attempts[-1]:
                raise
        else:
            break
    if request.placements is None and writer.request.sod_mm == 600.0:
        for second in (800.0, writer.at_home("object_y")):
            with suppress(LimitError):
                writer.station(second)
                both = dict.fromkeys((*writer.request.placements, ScanPosition(second)))
                writer = replace(
                    writer, request=replace(writer.request, placements=tuple(both))
                )
                break
    return "".join(f"{row}\r\n" for row in writer.rows())


def _distances_to_try(
    request: ScanRequest, places: MotorTargets
) -> Iterator[tuple[float, float, float]]:
    """Yield (SOD, SDD, height) to try [mm]: as requested, else the usual ones, then those
    at home.

    The usual are 600 and 1059 mm, and the sample's height at home (the source's, where no
    motor moves it). Every combination, SOD changing slowest.
    """

    def tried(asked: float | None, *usual: float) -> Iterable[float]:
        """Return the requested value, or (None) the usual ones, each once."""
        if asked is None:
            return dict.fromkeys(usual)
        return (asked,)

    home = places.at_home
    height = home("object_z" if places.has("source_z") else "source_z")
    return product(
        tried(request.sod_mm, 600.0, home("object_y")),
        tried(request.sdd_mm, 1059.0, home("detector_y")),
        tried(request.height_mm, height, home("source_z")),
    )


@dataclass(frozen=True)
class _Request(ScanRequest):
    """A request in which every distance is known."""

    sod_mm: float = 0.0
    sdd_mm: float = 0.0
    height_mm: float = 0.0
    exposure_ms: float = 100.0
    placements: tuple[ScanPosition, ...] = ()


@dataclass(frozen=True)
class _Writer(MotorTargets):
    """Writes the rows of a script; methods named after a kind of scan yield its rows."""

    request: _Request

    def rows(self) -> Iterator[str]:
        """Yield the rows of the whole script: pause, output path, settings, moves with
        the sample out of the beam, dark and flat images, scan of the request's kind,
        X-rays off.
        """
        w = self.request
        out = self.out_of_beam()
        yield _row("scanner", "pause", "0.000000")
        yield _row("scanner", "set output path", w.folder)
        yield from self.settings()
        yield from self.moves(self.station(w.sod_mm) | out)
        yield from self.references()
        kinds = {
            "fly": self.fly,
            "step": self.step,
            "tiled": self.tiled,
            "helical": self.helical,
            "calibration": self.calibration,
        }
        yield from kinds[w.kind]()
        yield _row("tube", "xrayoff")

    def settings(self) -> Iterator[str]:
        """Yield the rows that set tube and camera: voltage, power, mode, exposure and
        ROI.

        Voltage and power are the machine's if the request has none; frames and averages
        are not set here.
        """
        w = self.request
        m = self.machine
        camera = self.camera
        yield _row("tube", "set kV", _decimal(m.tube.kV if w.kV is None else w.kV))
        yield _row(
            "tube",
            "set power",
            _decimal(m.tube.power_W if w.power_W is None else w.power_W),
        )
        yield _row("camera", "set mode", camera.mode)
        yield _row("camera", "set exposure", _decimal(w.exposure_ms))
        yield _row("camera", "set ROI", str(camera.roi))

    def references(self) -> Iterator[str]:
        """Yield one averaged dark image (X-rays off), then one averaged flat image, from
        where the motors stand.

        Files are di000000.tif and io000000.tif; number of frames becomes 1. X-rays stay
        on afterwards.
        """
        w = self.request
        yield _row("camera", "set number of frames", "1")
        yield _row("tube", "xrayoff")
        yield from self.image("di000000.tif", w.darks)
        yield _row("tube", "xrayon")
        yield _row("tube", "REPEAT UNTIL TRUE status_XReady_get")
        yield _row("scanner", "keep xrayon", "TRUE")
        yield from self.image("io000000.tif", w.flats)

    def fly(self) -> Iterator[str]:
        """Yield the sample's move into the beam, then one smooth turn with its run-up."""
        yield from self.go(*self.aside)
        yield from self.turn(360.0, self.request.frames, 0)

    def step(self) -> Iterator[str]:
        """Yield the sample's move back into the beam, then a turn of 360 degrees that
        stops for every image.

        Image i of n is at i * 360 / n, the last angle left out; the settings file is
        written before the first.

        Raises:
            LimitError: an angle outside the rotation's travel.
        """
        w = self.request
        name, rotation = self.rotation
        yield from self.go(*self.aside)
        yield from self.drive(name, rotation.speed, rotation.acceleration)
        yield _row("camera", "set number of averages", str(w.averages))
        yield _row("scanner", "write settings file")
        for i in range(w.frames):
            angle = check_target(self.machine, name, i * 360.0 / w.frames)
            yield _row(name, "move absolute", _decimal(angle))
            yield _row("camera", "take image")
            yield _row("camera", "save image", f"{w.folder}\\scan_{i:06d}.tif")

    def tiled(self) -> Iterator[str]:
        """Yield a smooth turn for each tile, the detector moved by 0.9 of its image's
        width between them, the sample into the beam before.

        The tiles are centered about the beam's middle; numbers of images go on.

        Raises:
            LimitError: a machine without a motor for `detector_x`.
        """
        w = self.request
        camera = self.camera
        self.need("a tiled scan", "detector_x")
        width = camera.shape[1] * camera.pixel_mm(self.machine.detector.pixels)
        for k in range(w.tiles):
            shift = (k - (w.tiles - 1) / 2) * 0.9 * width
            yield from self.go(*self.aside, "detector_x", shift=shift)
            yield from self.turn(360.0, w.frames, k * w.frames)

    def calibration(self) -> Iterator[str]:
        """Yield for each placement the sample's moves into the beam and to its SOD, and a
        smooth turn; numbers of images go on.
        """
        w = self.request
        for k, place in enumerate(w.placements):
            moved = ("object_y",) if "object_y" in self.drivers else ()
            yield from self.go(*self.aside, *moved, place=place)
            yield from self.turn(360.0, w.frames, k * w.frames)

    def helical(self) -> Iterator[str]:
        """Yield the rows of several turns while source and detector rise at constant
        speed.

        The sample is moved into the beam first. Source and detector rise by the request's
        `rise_mm` over all turns, about their usual height, beginning before the trigger
        and ending after the last image. Where no motors raise them, the sample sinks.
        Speeds are set back at the end.

        Raises:
            LimitError: no motors for it, motors that also move something else, or a rise
                that is too fast for the run-up.
        """
        w = self.request
        m = self.machine
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
            message = (
                "has no motors that raise source and detector together, and none "
                "that lowers the sample, which a helical scan needs"
            )
            missing = ["source_z", "detector_z", "object_z"]
            raise self.lacking(message, asked="helical", missing=missing)
        yield from self.go(*self.aside)
        station = self.station(w.sod_mm)
        targets: dict[str, tuple[float, float, float]] = {}
        for quantity in moved:
            motor = self.drivers.get(quantity, "")
            moves = [q for q, factors in m.geometry.items() if motor in factors]
            if list(m.geometry[quantity]) != [motor] or moves != [quantity]:
                message = (
                    "raises or lowers with motors that move something else "
                    "too, so flexdt writes"
                )
                axes = list(m.geometry[quantity])
                raise self.lacking(
                    f"{message} no helical scan for it", asked="helical", axes=axes
                )
            at = station[motor]
            factor = m.geometry[quantity][motor]
            axis = m.axis(motor)
            pace = rise_speed / abs(factor)
            if pace > axis.max_speed or pace / axis.acceleration > lead_s:
                raise LimitError(
                    f"a rise of {w.rise_mm:g} mm in {scan_s:.3g} s needs {pace:.3g} mm/s, "
                    f"which {motor} does not reach within the run-up; lower rise_mm or raise "
                    "frames, exposure or averages",
                    {"asked": pace, "allowed": axis.max_speed, "axis": motor},
                )
            ramp = 0.5 * pace**2 / axis.acceleration
            below = (w.rise_mm / 2 / abs(factor) + pace * lead_s - ramp) * math.copysign(
                1, factor
            )
            if quantity == "object_z":
                below = -below
            low, high = (check_target(m, motor, x) for x in (at - below, at + below))
            targets[motor] = (low, high, pace)
        yield from self.moves({motor: low for motor, (low, _, _) in targets.items()})
        for motor, (_, _, pace) in targets.items():
            yield _row(motor, "set speed", f"{pace:.10f}")
        yield from self.run_up(total, w.frames)
        for motor, (_, high, _) in targets.items():
            yield _row(motor, "move absolute", _decimal(high), wait="no wait")
        yield from self.sweep(total, w.frames, 0)
        for motor in targets:
            yield _row(motor, "set speed", f"{m.axis(motor).speed:.10f}")
        yield from self.drive(name, rotation.speed, rotation.acceleration)

    def turn(self, total: float, frames: int, first: int) -> Iterator[str]:
        """Yield a smooth scan over `total` degrees from angle 0, with its run-up.

        Then speed and acceleration are the axis's own again. `first`: first file's
        number.
        """
        name, rotation = self.rotation
        yield from self.run_up(total, frames)
        yield from self.sweep(total, frames, first)
        yield from self.drive(name, rotation.speed, rotation.acceleration)

    def run_up(self, total: float, frames: int) -> Iterator[str]:
        """Yield the rows before a sweep: the move to the start of the run-up, the scan's
        speed, frames and averages, and the settings file.

        Args:
            total: angle from first to last image [deg].
            frames: number of images.
        """
        name, rotation = self.rotation
        begin = self.turned_to(-self.run_up_deg(total, frames), total)
        yield from self.drive(name, rotation.speed, rotation.acceleration)
        yield _row(name, "move absolute", _decimal(begin))
        yield from self.drive(name, self.turn_speed(total, frames), rotation.acceleration)
        yield _row("camera", "set number of frames", str(frames))
        yield _row("camera", "set number of averages", str(self.request.averages))
        yield _row("scanner", "write settings file")

    def sweep(self, total: float, frames: int, first: int) -> Iterator[str]:
        """Yield the move from the run-up's start to its end after `total` degrees.

        It triggers the image sequence at angle 0, numbered from `first`; `frames` decides
        speed and run-up.
        """
        name = self.rotation[0]
        end = self.turned_to(total + self.run_up_deg(total, frames), total)
        yield _row(name, "move absolute", _decimal(end), "0.000000", "POS")
        yield _row(
            "camera",
            "take and save image sequence",
            f"{self.request.folder}\\scan_",
            str(first),
        )

    def turned_to(self, angle: float, total: float) -> float:
        """Check an end of a turn's motion, run-up included, against the rotation's travel.

        Args:
            angle: target of the rotation [deg].
            total: angle from first to last image [deg].

        Returns the target, within the travel.
        Raises LimitError: beyond the travel; the message names what makes the motion shorter.
        """
        try:
            return check_target(self.machine, self.rotation[0], angle)
        except LimitError as error:
            raise LimitError(
                f"{error}, which {total:g} deg of images and their run-up need; turn by "
                "fewer degrees (fewer turns; a step scan has no run-up), or give each "
                "view more time (raise frames, exposure or averages) for a shorter run-up",
                error.data,
            ) from None

    def turn_speed(self, total: float, frames: int) -> float:
        """Compute the rotation's speed for `frames` images, first and last at the ends of
        `total` degrees [deg/s].

        An image takes exposure times averages. `frames` is at least 2.

        Raises:
            LimitError: faster than the axis turns (`max_speed`).
        """
        name, rotation = self.rotation
        speed = total / (frames - 1) / self.image_s
        if speed > rotation.max_speed:
            raise LimitError(
                f"{frames} frames of {self.image_s * 1000:g} ms over {total:g} deg need "
                f"{speed:.4g} deg/s, but {name} turns at most {rotation.max_speed:g} "
                "deg/s; raise frames, exposure or averages, or take a step scan, which "
                "rests at each angle",
                {"asked": speed, "allowed": rotation.max_speed, "axis": name},
            )
        return speed

    def run_up_deg(self, total: float, frames: int) -> float:
        """Compute the run-up [deg] of `frames` images over `total` degrees: acceleration
        and `MARGIN_IMAGES`.
        """
        speed = self.turn_speed(total, frames)
        return run_up(speed, self.rotation[1].acceleration, self.image_s)

    def go(
        self, *quantities: str, place: ScanPosition | None = None, shift: float = 0.0
    ) -> Iterator[str]:
        """Yield moves of the motors of `quantities`, such as object_y, alone to their
        station.

        `place`: None: the request's SOD; `shift`: of the detector sideways [mm]. Raises
        LimitError.
        """
        if place is None:
            at = ScanPosition(self.request.sod_mm)
        else:
            at = place
        every = self.station(at.sod_mm, at.lateral_mm, shift)
        names = map(self.driver, quantities)
        yield from self.moves({name: every[name] for name in names})

    def station(
        self, sod: float, lateral: float = 0.0, detector_shift: float = 0.0
    ) -> dict[str, float]:
        """Compute the motor targets that put source, detector and sample in their places.

        The middle of the camera's region goes into the beam's middle; where no motor
        brings it there, the sample goes to the region. A quantity without a motor may be
        off by rounding (`_ROUNDED_MM`), sideways and up by `MAX_LATERAL_SHARE` of the
        field of view.

        Args:
            sod: source-object distance [mm].
            lateral: of the sample from the beam's middle [mm].
            detector_shift: of the detector sideways [mm].

        Returns:
            Motor -> target [mm, deg], within its travel.

        Raises:
            LimitError: beyond a travel limit, or a quantity that no motor brings to its
                value.
        """
        w = self.request
        height = w.height_mm
        wanted = {
            "source_x": 0.0,
            "source_z": height,
            "detector_x": detector_shift - self.region[0],
            "detector_z": height - self.region[2],
            "detector_y": w.sdd_mm,
            "object_y": sod,
            "object_x": lateral,
        }
        if not self.has("source_z"):
            wanted["object_z"] = height  # the sample's middle into the beam
        # Where no motor brings the region into the beam's middle, the sample goes to the
        # region.
        for across, k in (("x", 0), ("z", 2)):
            if not self.has(f"detector_{across}") and f"object_{across}" in self.drivers:
                wanted[f"object_{across}"] += self.region[k] * sod / w.sdd_mm
        targets = self.solved(wanted)
        rows, cols = self.camera.shape
        pixel, row_pixel = self.camera.pixels_mm(self.machine.detector.pixels)
        if not self.has("detector_x"):
            wanted["detector_x"] = 0.0  # the region stays where it is
        if not self.has("detector_z"):
            wanted["detector_z"] = height
        for quantity, asked in wanted.items():
            only = self.value(quantity, targets)
            slack = _ROUNDED_MM
            if not self.has(quantity) and quantity not in ("object_y", "detector_y"):
                if quantity.endswith("_z"):
                    size = rows * row_pixel
                else:
                    size = cols * pixel
                slack = (
                    MAX_LATERAL_SHARE
                    * size
                    * (sod / w.sdd_mm if quantity == "object_x" else 1.0)
                )
            if abs(asked - only) <= slack:
                continue
            self.need(f"{asked:g} mm ({only:g} mm is all there is)", quantity)
            message = (
                f"has no motor of its own for {QUANTITIES[quantity]}: "
                f"{asked:g} mm were asked for"
            )
            it_is = f"{message}, it is {only:g} mm"
            raise self.lacking(it_is, asked=asked, allowed=only, missing=quantity)
        return {
            name: check_target(self.machine, name, value)
            for name, value in targets.items()
        }

    def out_of_beam(self) -> dict[str, float]:
        """Compute where the sample is beside the beam, to the freer side, for the flat
        image: motor -> [mm].
        """
        station = self.station(self.request.sod_mm)
        return beside_beam(self.machine, self.profile, self.camera, station)[0]

    def image(self, file: str, averages: int) -> Iterator[str]:
        """Yield one image of `averages` exposures, saved as `file`."""
        yield _row("camera", "set number of averages", str(averages))
        yield _row("camera", "take image")
        yield _row("camera", "save image", f"{self.request.folder}\\{file}")

    def moves(self, targets: dict[str, float]) -> Iterator[str]:
        """Yield the rows that move motors to targets and wait for all of them.

        Several are first started together without waiting, then each move is repeated to wait
        for it.
        `targets`: motor -> target [mm, deg]."""
        if len(targets) > 1:
            for name, value in targets.items():
                yield _row(name, "move absolute", _decimal(value), wait="no wait")
        for name, value in targets.items():
            yield _row(name, "move absolute", _decimal(value))

    def drive(self, name: str, speed: float, acceleration: float) -> Iterator[str]:
        """Yield the rows that set speed and acceleration of an axis."""
        yield _row(name, "set speed", f"{speed:.10f}")
        yield _row(name, "set acceleration", _decimal(acceleration))

    @property
    def camera(self) -> CameraSettings:
        """The machine's camera settings, with the request's mode and region where given."""
        w = self.request
        camera = self.machine.detector.camera
        if w.mode is not None:
            camera = replace(camera, mode=w.mode)
        if w.roi is None:
            return camera
        return replace(camera, roi=w.roi)

    @property
    def region(self) -> FloatArray:
        """Middle of the camera's region relative to the panel's middle, world
        frame (3,) [mm]."""
        across, down = self.camera.roi_shift_mm(self.machine.detector.pixels)
        u, v = turn_detector(
            COLUMN_DIRECTION,
            ROW_DIRECTION,
            0.0,
            0.0,
            math.radians(self.profile.det_roll_deg),
        )
        return across * u + down * v

    @property
    def rotation(self) -> tuple[str, Axis]:
        """The motor that turns the sample, by name and axis.

        Raises:
            LimitError: several do, or one by another factor than 1 or -1.
        """
        factors = self.machine.geometry["angle"]
        name = next(iter(factors))
        if len(factors) > 1 or abs(factors[name]) != 1.0:
            message = f"turns the sample by {factors}; flexdt writes scripts for one motor with a"
            raise self.lacking(
                f"{message} factor of 1 or -1", asked=dict(factors), allowed=[1.0, -1.0]
            )
        return name, self.machine.axis(name)

    @property
    def image_s(self) -> float:
        """Exposure time of an image, averages included [s]."""
        return self.request.exposure_ms * self.request.averages / 1000.0


def _check_counts(request: _Request) -> None:
    """Check the counts and distances of a request against their allowed ranges.

    The first rule that fails is raised; values that are not finite fail. A SOD greater
    than the SDD is among them.

    Args:
        request: what the script is composed for.

    Raises:
        LimitError: names the setting, its value and the allowed ones.
    """
    smooth = request.kind != "step"
    rules: Sequence[tuple[str, float, float, float]] = (
        ("frames", request.frames, 2 if smooth else 1, MAX_FRAMES),
        ("averages", request.averages, 1, 10_000),
        ("darks", request.darks, 1, 10_000),
        ("flats", request.flats, 1, 10_000),
        ("tiles", request.tiles, 1, 100),
        ("placements", len(request.placements), 1, 100),
        ("turns", request.turns, 1e-3, 40.0),
        ("rise_mm", request.rise_mm, 1e-3, 1e6),
        ("height_mm", request.height_mm, -1e6, 1e6),
        ("sdd_mm", request.sdd_mm, 1e-3, 1e6),
        ("sod_mm", request.sod_mm, 1e-3, request.sdd_mm),
        *(
            ("placements", x, -1e6, 1e6)
            for p in request.placements
            for x in vars(p).values()
        ),
    )
    for name, value, low, high in rules:
        if not (math.isfinite(value) and low <= value <= high):
            message = f"{name} is {value:g}; allowed: {low:g} to {high:g}"
            if name == "sod_mm" and value > high:
                message += ", the sdd_mm: are the two swapped?"
            raise LimitError(
                message, {"setting": name, "asked": value, "allowed": [low, high]}
            )


def _row(
    component: str, command: str, first: str = "", second: str = "", wait: str = "ACK"
) -> str:
    """Format one row of seven TAB separated columns."""
    return "\t".join((component, command, first, second, wait, "", ""))


def _decimal(value: float) -> str:
    """Format a number with six decimals."""
    return f"{value:.6f}"
