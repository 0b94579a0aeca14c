"""What past scans tell of a machine: its zero offsets, their drift, and what contradicts what.

`align` tells the column in which the rotation axis is seen, and texts where the motors stood. A
sideways shift of the axis moves the column in proportion to the magnification, one of the panel
does not: axs_tan, det_tan and axs_tan's drift follow from one weighted least squares, into
which det_tan enters as the texts have it, with its prior. Roll gets a weighted line, and either
drift a prior. Where residuals are larger than their sigmas say, all sigmas grow in proportion
(Birge 1932, doi:10.1103/PhysRev.40.207).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.fit.fit import axis_in_image
from flexdt.twin.calibration.fit.priors import prior_widths
from flexdt.twin.calibration.without_phantom.alignment import AlignEstimate, Alignment
from flexdt.twin.dataset import rebuild, scan_settings, stated_geometry
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import (
    ERROR,
    WARNING,
    Finding,
    FindingCode,
    Findings,
    Place,
    warning,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.machine.camera import CameraSettings, check_roi
from flexdt.twin.machine.description import ZERO, Axis, Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import commands as c
from flexdt.twin.script.executed_log import Executed, MotorReply
from flexdt.twin.script.grammar import image_name, kind_of, own_name, sequence_names

YEAR_S: Final = 365.25 * 86400.0
FOR_A_LINE: Final = 3
"""Dates that a drift needs, and rows beyond the unknowns that outvote a scan: with two there is
nothing to check one by."""
MAX_SIGMAS: Final = 4.0
"""Sigmas from which on a scan contradicts the others, and is left out where enough remain."""
MAX_PRIOR_SHARE: Final = 0.5
"""Share of its prior's width below which scans tell det_tan themselves."""
DRIFT_PRIOR_PER_YEAR: Final = 0.25
"""Prior of a drift [mm or deg a year]: from one published profile of the FleX-ray to the next
det_tan changes by 0.23 mm rms and the roll by 0.15 deg."""
RELATIVE_TOLERANCE: Final = 1e-4
"""By what part statements of one quantity may differ: texts carry six decimals, cameras round
their exposures. Motors and offsets may differ by `rebuild.MATCH_MM`."""
MIN_SHARED_LIMITS: Final = 3
"""Motors whose limits are a shipped machine's, from which on an executed script is of it."""
OFFSETS: Final = ("det_tan", "src_ort", "axs_tan", "c_obj", "c_det", "det_roll_deg")
TELLS: Final = {
    "axs_tan": "ordinary",
    "det_roll_deg": "ordinary",
    "src_ort": "beads",
    "c_obj": "beads",
    "c_det": "beads",
}
"""Offset -> the kind of scan that tells it."""


class CommissionCode(FindingCode):
    """Codes of what contradicts what among past scans; a finding's place is the quantity."""

    DISAGREEMENT = "disagreement", WARNING, "sources state different values of a quantity"
    CAMERA = "camera", WARNING, "a camera's mode or region that the shipped machine lacks"
    OFF_THE_LINE = "off_the_line", WARNING, "a scan far from the line of all scans"
    MACHINE_REFUSED = "machine_refused", ERROR, "the machine file does not hold"


class Question(NamedTuple):
    """What could not be judged, why, and the kind of scan that would settle it ("": none)."""

    what: str
    why: str
    settled_by: str = ""


class Line(NamedTuple):
    """An offset at the last date and its drift, with sigmas [mm or deg; a year].

    Without scans it is the texts'; without three dates there is no drift.
    """

    value: float
    sigma: float | None = None
    per_year: float | None = None
    drift_sigma: float | None = None
    scans: int = 0


@dataclass(frozen=True)
class PastScan:
    """A scan as its folder tells it, each part where it is there.

    Attributes:
        name: of its folder.
        date: when it started.
        settings, second: what `scan settings.txt` and `data settings XRE.txt` say.
        commands, log: its script, and the lines of the executed one.
        images: number of projections; `shape` is the (rows, cols) of the first.
        positions: motor -> (1,) in the script's sign [mm, deg].
        camera: mode and region.
        profile: the zero offsets behind the printed figures.
        aligned: what its projections tell of the geometry.
    """

    name: str
    date: datetime | None = None
    settings: scan_settings.ScanSettings | None = None
    second: scan_settings.ScanSettings | None = None
    commands: tuple[c.Command, ...] = ()
    log: tuple[Executed, ...] = ()
    images: int = 0
    shape: tuple[int, int] | None = None
    positions: Mapping[str, FloatArray] = field(default_factory=dict)
    camera: CameraSettings | None = None
    profile: Profile | None = None
    aligned: Alignment | None = None


def standing(scan: PastScan, machine: Machine) -> PastScan:
    """Return the scan with motor positions, camera and the zero offsets behind its
    printed figures, from its settings text.

    c_obj and c_det are chosen so that the machine's computed SOD and SDD agree with the
    text, then det_tan, src_ort and axs_tan so that HC, VC and COR do; roll is 0.

    Args:
        scan: with the content of its settings text.
        machine: whose motors and camera these are.

    Raises:
        TwinError: its text lacks motors, camera mode, ROI or one of the figures, or
            contradicts itself.
    """
    s = None
    if scan.settings is not None:
        s = rebuild.physical(scan.settings, scan.name)[0]
    f = None if s is None else s.figures
    if (
        s is None
        or s.roi is None
        or s.mode is None
        or not set(s.motors) & set(machine.axes)
    ):
        raise TwinError("no settings text states its motors, camera mode and ROI")
    if f is None or not 0.0 < f.sod_mm < f.sdd_mm:
        raise TwinError("its text does not state SOD, SDD, HC, VC, COR and pixel")
    camera = CameraSettings(s.mode, s.roi, modes=machine.detector.camera.modes)
    zero = Profile(name=ZERO, machine=machine.name, source="figures of the settings text")
    built = rebuild.rebuild(s, 1, camera.shape, [machine], [zero], file=scan.name)
    sod = float(built.poses.sod[0])
    sdd = float(built.poses.sdd[0])
    far = zero.model_copy(update={"c_obj": f.sod_mm - sod, "c_det": f.sdd_mm - sdd})
    at = motor_poses(machine, far, camera, built.positions)
    computed = stated_geometry.figures_of(at, camera.shape)
    across = [
        (g.cor_px - g.hc_px) * computed.pixel_mm * g.sod_mm / g.sdd_mm
        for g in (f, computed)
    ]
    sideways = {
        "det_tan": (computed.hc_px - f.hc_px) * computed.pixel_mm,
        "src_ort": (computed.vc_px - f.vc_px) * computed.pixel_mm,
        "axs_tan": across[0] - across[1],
    }
    profile = far.model_copy(update=sideways)
    return replace(scan, positions=built.positions, camera=camera, profile=profile)


def scripted(scan: PastScan, machine: Machine) -> dict[str, Any]:
    """Read the settings that a scan's script requests.

    A script without projections has only the targets, an empty one nothing; times and
    waits are ignored. Targets are of motors only; of several `write settings file` the
    last before the first projection counts.

    Args:
        scan: with the commands of its script.
        machine: whose axes the script names.

    Returns:
        Axis -> target when the settings file is written; settings of camera and tube, by
        the names of `ScanSettings`, at the first projection; and `projections`, the
        number of all that it saves, in sequences and as single images.
    """
    now: dict[str, Any] = {}
    moved: dict[str, Any] = {}
    first: dict[str, Any] | None = None
    taken = 0
    for k in scan.commands:
        if isinstance(k, c.MoveAbsolute):
            now[own_name(k.component, machine.axes)] = k.target
        elif isinstance(k, c.CameraSetting | c.TubeSetting):
            now |= k.arguments
        elif isinstance(k, c.WriteSettingsFile) and first is None:
            moved = {name: value for name, value in now.items() if name in machine.axes}
        elif isinstance(k, c.TakeSequence | c.SaveImage):
            count = _projections(k, now.get("frames"))
            taken += count
            if count and first is None:
                first = {
                    n: v
                    for n, v in now.items()
                    if n not in machine.axes and n != "frames"
                }
    if first is None:
        return moved
    return first | {"projections": taken} | moved


def _projections(command: c.TakeSequence | c.SaveImage, frames: int | None) -> int:
    """Count the projections that a command saves, by the names of its images.

    Names of dark and flat images, and paths without a name, count 0.

    `command`: saves a sequence or an image. `frames`: number of images of a sequence; None or 0
    is one.
    """
    if isinstance(command, c.TakeSequence):
        names: Sequence[str | None] = sequence_names(
            command.prefix, command.first, frames or 1
        )
    else:
        names = (image_name(command.path),)
    return sum(name is not None and kind_of(name) == "projection" for name in names)


class Scanner(NamedTuple):
    """Which scanner a scan says it is of: the machine that ships, the serial number, and by
    what the machine is known; each "" where nothing says it."""

    machine: str = ""
    serial: str = ""
    by: str = ""


def scanner_of(scan: PastScan, known: Sequence[Machine]) -> Scanner:
    """Identify the scanner of a scan: by its texts, or else by the limits of its motors.

    Only with at least `MIN_SHARED_LIMITS` and half of the log's motors sharing theirs; of
    several machines the one with most.

    Args:
        scan: with its texts and log.
        known: machines that it may be of.

    Returns:
        Name of the machine ("" if unknown), serial number of the texts ("" if none), and
        what identified it.
    """
    texts = [text for text in (scan.settings, scan.second) if text is not None]
    serial = next((text.serial for text in texts if text.serial), "")
    for text in texts:
        named = rebuild.named_machine(text, known)
        if named is not None:
            return Scanner(named.name, serial, "its settings text")
    limits: dict[str, tuple[float, float]] = {}
    for x in scan.log:
        if x.motor is not None and isinstance(x.command, c.MotorCommand):
            limits[x.command.component] = x.motor.lower, x.motor.upper
    nearest = max(known, key=lambda machine: _shared(limits, machine), default=None)
    if nearest is not None and _shared(limits, nearest) >= max(
        MIN_SHARED_LIMITS, len(limits) / 2
    ):
        return Scanner(nearest.name, serial, "the motors' limits in its executed script")
    return Scanner(serial=serial)


def _shared(limits: Mapping[str, tuple[float, float]], machine: Machine) -> int:
    """Count the motors whose limits are those of a machine file, within
    `RELATIVE_TOLERANCE`.

    Names are translated to the machine's. `limits`: motor -> (lower, upper).
    """
    axes = {name: machine.axes.get(own_name(name, machine.axes)) for name in limits}
    return sum(
        axis is not None
        and bool(
            np.allclose(limits[name], (axis.lower, axis.upper), RELATIVE_TOLERANCE, 0.0)
        )
        for name, axis in axes.items()
    )


def other_scanners(scans: Sequence[PastScan], known: Sequence[Machine]) -> str:
    """List folders by scanner, as text for people, where they are of more than one; ""
    otherwise.

    There is more than one if two machines or two serial numbers are named; folders
    without either do not count as another, but are listed.

    Args:
        scans: of which the folders are named.
        known: machines that they may be of.
    """
    scanners = {scan.name: scanner_of(scan, known) for scan in scans}
    serials = {one.serial for one in scanners.values()} - {""}
    machines = {one.machine for one in scanners.values()} - {""}
    if max(len(serials), len(machines)) < 2:
        return ""
    groups: dict[Scanner, list[str]] = {}
    for name, one in scanners.items():
        groups.setdefault(one, []).append(name)
    words = []
    for one, names in groups.items():
        serial = "no serial number"
        if one.serial:
            serial = f"serial number {one.serial}"
        machine = "a scanner that nothing names"
        if one.machine:
            machine = f"{one.machine} (by {one.by})"
        words.append(f"{machine}, {serial}: {', '.join(names)}")
    return "; ".join(words)


def contradictions(
    scans: Sequence[PastScan], shipped: Machine, fitted: Machine
) -> Iterator[Finding]:
    """Yield a finding for each quantity about which texts, scripts, images, replies and
    the shipped machine disagree.

    Lengths agree within `rebuild.MATCH_MM`, others within `RELATIVE_TOLERANCE`, words in
    any case. The shipped machine is compared only in quantities that a scan states, and
    in the signs of all axes. A camera mode or region that the shipped machine does not
    allow is a finding, too.

    Args:
        scans: that are compared.
        shipped: machine of the file.
        fitted: machine with the signs and limits that the scans show; by it the scans are
            read.
    """
    lengths = {*fitted.axes, *(f"{name} of the texts" for name in OFFSETS)}
    opinions: dict[str, list[_Opinion]] = {}
    for about, value, who, name in _statements(scans, shipped, fitted):
        slack = (0.0, rebuild.MATCH_MM) if name in lengths else (RELATIVE_TOLERANCE, 0.0)
        _join(opinions.setdefault(about, []), value, who, slack)
    for about, different in opinions.items():
        if len(different) > 1:
            words = [f"{_plain(x.value)} in {_some(x.held_by)}" for x in different]
            text = "; ".join(words)
            yield warning(CommissionCode.DISAGREEMENT, text, place=Place(name=about))
    for scan in scans:
        problem = _camera_problem(scan, shipped)
        if problem:
            yield warning(
                CommissionCode.CAMERA,
                f"machine {shipped.name}: {problem}",
                place=Place(name=f"camera in {scan.name}"),
            )


class _Statement(NamedTuple):
    """A value that somebody states.

    Attributes:
        about: what it is compared as: a quantity, of one scan or of all.
        value: of the quantity.
        who: states it.
        name: of the quantity, without the scan.
    """

    about: str
    value: Any
    who: str
    name: str


class _Opinion(NamedTuple):
    """A value, and who states one that agrees with it."""

    value: Any
    held_by: list[str]


def _join(
    opinions: list[_Opinion], value: Any, who: str, slack: tuple[float, float]
) -> None:
    """Add a statement to the first opinion with which it agrees within `slack` (relative,
    absolute), else as an opinion of its own.
    """
    for opinion in opinions:
        if _agree(value, opinion.value, slack):
            if who not in opinion.held_by:
                opinion.held_by.append(who)
            return
    opinions.append(_Opinion(value, [who]))


def _statements(
    scans: Sequence[PastScan], shipped: Machine, fitted: Machine
) -> list[_Statement]:
    """List what scans state of themselves, what of the scanner, and what the shipped
    machine states of the same; then the signs of all axes.

    Args:
        scans, shipped, fitted: as for `contradictions`.
    """
    own = [
        _Statement(f"{name} in {scan.name}", value, who, name)
        for scan in scans
        for name, value, who in _own_statements(scan, fitted)
    ]
    common = [
        _Statement(name, value, scan.name, name)
        for scan in scans
        for name, value in _common_statements(scan, fitted)
    ]
    known = {statement.about for statement in (*own, *common)}
    machine = f"machine {shipped.name}"
    stated = [
        _Statement(name, value, machine, name)
        for name, value in _of_machine(shipped)
        if name in known
    ]
    signs = [
        _Statement(f"sign of {name}", axis.settings_sign, who, name)
        for of, who in ((fitted, "the scans' texts"), (shipped, machine))
        for name, axis in of.axes.items()
    ]
    return [*own, *common, *stated, *signs]


def _camera_problem(scan: PastScan, machine: Machine) -> str:
    """Say why a machine does not allow a scan's camera mode or region; "" if it does."""
    try:
        if scan.settings is not None and scan.settings.mode is not None:
            machine.detector.check_mode(scan.settings.mode)
        if scan.camera is not None:
            check_roi(scan.camera.roi, machine.detector.pixels, scan.camera.binning)
    except TwinError as error:
        return error.message
    return ""


def _own_statements(scan: PastScan, machine: Machine) -> Iterator[tuple[str, Any, str]]:
    """Yield (name, value, source) of the same quantities in a scan's settings text,
    script, images, XRE text, figures, and mode with ROI.

    Names are those of `scan_settings.ENTRIES`, motors, and `shape`; empty and missing
    values are skipped. Nothing without a settings text. Positions are in the script's
    sign; scripted targets are cut to the travel.

    Args:
        scan: with texts, script and images.
        machine: whose axes, limits and signs count.
    """
    s = scan.settings
    camera = scan.camera
    if s is None:
        return
    signs = {name: axis.settings_sign for name, axis in machine.axes.items()}
    read = {n: signs[n] * m.value for n, m in s.motors.items() if n in signs}
    requested = scripted(scan, machine)
    for name in requested.keys() & signs.keys():
        requested[name] = min(
            max(requested[name], machine.axes[name].lower), machine.axes[name].upper
        )
    sources: dict[str, Mapping[str, Any]] = {
        "the text": {**vars(s), **read},
        "the script": requested,
    }
    sources["the images"] = {"projections": scan.images or None, "shape": scan.shape}
    if scan.second is not None:
        sources["the XRE text"] = vars(scan.second)
    if s.figures is not None:
        f = s.figures
        sources["its figures"] = {
            "magnification": f.magnification,
            "voxel_um": f.voxel_um,
        }
    if camera is not None:
        pixel = camera.pixel_mm(machine.detector.pixels)
        sources["mode and ROI"] = {
            "shape": camera.shape,
            "binning": camera.binning,
            "binned_pixel_mm": pixel,
        }
    for who, statements in sources.items():
        for name in (*scan_settings.ENTRIES, "shape", *read):
            if statements.get(name) not in (None, ""):
                yield name, statements[name], who


def _common_statements(scan: PastScan, machine: Machine) -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of quantities that should be alike in all scans: scanner,
    pixel, rates, limits, offsets.

    Missing values are skipped. Rates are those of the text, without rotations; limits
    those of the log's replies; offsets those of `scan.profile`, without the roll.

    Args:
        scan: with texts and log.
        machine: whose axes count.
    """
    s = scan.settings
    for name in ("scanner_name", "scanner_type", "serial", "original_pixel_mm"):
        if getattr(s, name, None) not in (None, ""):
            yield name, getattr(s, name)
    turning = machine.geometry.get("angle", {})
    for name, motor in {} if s is None else s.motors.items():
        if name not in turning and motor.speed is not None:
            yield f"rates of {name}", (motor.speed, motor.acceleration)
    for x in scan.log:
        if x.motor is not None and isinstance(x.command, c.MotorCommand):
            yield (
                f"limits of {own_name(x.command.component, machine.axes)}",
                _limits(x.motor),
            )
    for name in OFFSETS[:-1] if scan.profile is not None else ():
        yield f"{name} of the texts", getattr(scan.profile, name)


def _of_machine(machine: Machine) -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of a machine's facts: its unbinned pixel [mm], then rates and
    limits of each motor, named as in `_common_statements`.
    """
    yield "original_pixel_mm", machine.detector.pitch_mm
    for name, axis in machine.axes.items():
        yield f"rates of {name}", (axis.speed, axis.acceleration)
        yield f"limits of {name}", _limits(axis)


def _limits(axis: Axis | MotorReply) -> tuple[float, ...]:
    return axis.lower, axis.upper, axis.max_speed, axis.max_acceleration


def _agree(a: Any, b: Any, slack: tuple[float, float]) -> bool:
    """Return whether two statements agree: numbers and tuples within `slack` (relative,
    absolute), others as texts, case ignored.
    """
    if isinstance(a, int | float | tuple) and isinstance(b, int | float | tuple):
        return bool(np.allclose(a, b, *slack))
    return str(a).lower() == str(b).lower()


def _plain(value: Any) -> str:
    """Format a value as text, floats and tuples rounded to four decimals."""
    return str(np.round(value, 4).tolist() if isinstance(value, float | tuple) else value)


def _some(names: Sequence[str]) -> str:
    """List at most the first three names, separated by commas, and the number of further
    ones.
    """
    return ", ".join(names[:3]) + (
        f" and {len(names) - 3} more" if len(names) > 3 else ""
    )


class ZeroOffsets(NamedTuple):
    """The profile that past scans give, at the last date.

    `lines` are each offset's value and drift, `columns` of each scan the axis's (measured,
    fitted, sigma of the fitted) column [px], `findings` the scans that contradict the others,
    and `questions` what the scans leave open.
    """

    profile: Profile
    lines: Mapping[str, Line]
    columns: Mapping[str, tuple[float, float, float]]
    findings: Findings
    questions: Sequence[Question]


def zero_offsets(
    scans: Sequence[PastScan], machine: Machine, usual: Profile
) -> ZeroOffsets:
    """Estimate zero offsets and their drift from all scans; scans that contradict the
    others are findings.

    Only scans whose images give roll and axis column are fitted. A drift is given only
    with scans of `FOR_A_LINE` dates, and undated ones are then left out. Other offsets
    are the latest text's, else `usual`. Drifts have a prior of `DRIFT_PRIOR_PER_YEAR`,
    det_tan one of the machine's usual width.

    Args:
        scans: the oldest first, those without a date last.
        machine: whose.
        usual: offsets where no text states any.

    Returns:
        The profile, rounded to six decimals; a line (value, sigma, drift) for each
        offset; by scan the axis column measured, that of the line and its sigma [px];
        findings, scans beyond `MAX_SIGMAS`; and questions that further scans would
        answer.
    """
    base = next(
        (scan.profile for scan in reversed(scans) if scan.profile is not None), usual
    )
    last = max((scan.date for scan in scans if scan.date is not None), default=None)
    width = prior_widths(machine, usual)["dD_x"]
    aligned = _aligned(scans, last)
    lines = {name: Line(getattr(base, name)) for name in OFFSETS}
    findings = list[Finding]()
    columns = dict[str, tuple[float, float, float]]()
    if aligned.scans:
        roll = _fit_roll(aligned, base)
        lines["det_roll_deg"] = aligned.line(roll, 0, base.det_roll_deg)
        axis, sides, nominal = _fit_axis(aligned, machine, base, width)
        lines["axs_tan"] = aligned.line(axis, 0, base.axs_tan)
        lines["det_tan"] = aligned.line(axis, 2, base.det_tan)
        findings = [
            *aligned.contradictions(roll, "det_roll_deg"),
            *aligned.contradictions(axis, "axs_tan"),
        ]
        columns = _columns(aligned, axis, sides, nominal)
    profile = _profile(machine, lines, last)
    questions = _open_questions(lines, aligned.drifts, width)
    return ZeroOffsets(profile, lines, columns, Findings(findings), questions)


class _Fit(NamedTuple):
    """Offsets fitted to all aligned scans.

    Attributes:
        at: (k,) values, the second one the drift of the first.
        covariance: (k, k).
        pulls: residual of each scan, also of one left out [sigmas].
    """

    at: FloatArray
    covariance: FloatArray
    pulls: FloatArray


class _AlignedScans(NamedTuple):
    """The scans whose images tell where the axis is.

    Attributes:
        scans: in the order of their dates.
        years: (scans,) since the last date, so at most 0; 0 without a date.
        drifts: whether they are of enough dates to tell a drift.
    """

    scans: Sequence[PastScan]
    years: FloatArray
    drifts: bool

    def estimates(self, name: str) -> list[AlignEstimate]:
        """Each scan's estimate of a parameter of its alignment."""
        return [s.aligned.parameters[name] for s in self.scans if s.aligned is not None]

    def line(self, fit: _Fit, i: int, before: float) -> Line:
        """Make the line of a fitted offset.

        `fit`: of the offset. `i`: number of the offset in it; the first one has the drift.
        `before`: value to which the fit is a correction.
        """
        sigmas = np.sqrt(np.diag(fit.covariance)).tolist()
        line = Line(before + float(fit.at[i]), sigmas[i], scans=len(self.scans))
        if i or not self.drifts:
            return line
        return line._replace(per_year=float(fit.at[1]), drift_sigma=sigmas[1])

    def contradictions(self, fit: _Fit, name: str) -> list[Finding]:
        """Make a finding of each scan beyond `MAX_SIGMAS` from the line of an offset."""
        return [
            warning(
                CommissionCode.OFF_THE_LINE,
                f"{scan.name} is {abs(pull):.1f} sigma from the line of all scans",
                place=Place(name=name),
            )
            for scan, pull in zip(self.scans, fit.pulls.tolist(), strict=True)
            if abs(pull) > MAX_SIGMAS
        ]


def _aligned(scans: Sequence[PastScan], last: datetime | None) -> _AlignedScans:
    """Choose the scans whose images give roll and axis column; undated ones only where
    the others have too few dates for a drift.

    Args:
        scans: all past scans.
        last: the last date; None without one.
    """
    told = [
        s for s in scans if s.aligned is not None and "det_roll" in s.aligned.parameters
    ]
    drifts = len({s.date for s in told if s.date is not None}) >= FOR_A_LINE
    told = [s for s in told if s.date is not None or not drifts]
    years = [
        (s.date - last).total_seconds() / YEAR_S if s.date and last else 0.0 for s in told
    ]
    return _AlignedScans(told, np.array(years), drifts)


def _fit_roll(aligned: _AlignedScans, base: Profile) -> _Fit:
    """Fit the roll of the detector beyond that of `base`, and its drift [deg, a year]."""
    rolls = aligned.estimates("det_roll")
    ones = np.ones(len(aligned.scans))
    return _fit(
        np.vstack([np.column_stack([ones, aligned.years]), [0.0, 1.0]]),
        np.array([*(r.value - base.det_roll_deg for r in rolls), 0.0]),
        np.array([*(r.sigma for r in rolls), DRIFT_PRIOR_PER_YEAR]),
        len(aligned.scans),
    )


def _fit_axis(
    aligned: _AlignedScans, machine: Machine, base: Profile, width: float
) -> tuple[_Fit, FloatArray, FloatArray]:
    """Fit axs_tan, its drift and det_tan beyond those of `base` to the columns of the axis.

    Args:
        aligned: at least one scan.
        machine: that made them.
        base: offsets of the texts.
        width: sigma of det_tan's prior [mm].

    Returns:
        The fit [mm, a year]; how each scan's column changes with its values, (scans, 3)
        [px/mm]; and the columns with the offsets of `base`, (scans,) [px].
    """
    rolls = aligned.estimates("det_roll")
    measured = aligned.estimates("axis_column_px")
    seen = np.array(
        [
            _axis(machine, s, base, r.value)
            for s, r in zip(aligned.scans, rolls, strict=True)
        ]
    )
    nominal = seen[:, 0]
    sides = np.column_stack([seen[:, 1], seen[:, 1] * aligned.years, seen[:, 2]])
    rest = [m.value - at for m, at in zip(measured, nominal, strict=True)]
    fit = _fit(
        np.vstack([sides, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([*rest, 0.0, 0.0]),
        np.array([*(m.sigma for m in measured), DRIFT_PRIOR_PER_YEAR, width]),
        len(aligned.scans),
    )
    return fit, sides, nominal


def _columns(
    aligned: _AlignedScans, axis: _Fit, sides: FloatArray, nominal: FloatArray
) -> dict[str, tuple[float, float, float]]:
    """Collect each scan's column of the axis: measured, fitted, and sigma of the fitted one
    [px].

    Args:
        aligned: the scans.
        axis, sides, nominal: of `_fit_axis`.
    """
    fitted = nominal + sides @ axis.at
    spread = np.sqrt(np.einsum("ij,jk,ik->i", sides, axis.covariance, sides))
    measured = aligned.estimates("axis_column_px")
    return {
        s.name: (m.value, float(at), float(sigma))
        for s, m, at, sigma in zip(aligned.scans, measured, fitted, spread, strict=True)
    }


def _profile(
    machine: Machine, lines: Mapping[str, Line], last: datetime | None
) -> Profile:
    """Make the profile of the lines' values, rounded to six decimals, whose source says how
    many scans each is from; it is named after the last date.
    """
    day = "undated"
    if last is not None:
        day = f"{last:%Y-%m-%d}"
    source = "; ".join(
        f"{n}: {x.scans or 'texts of the'} scans" for n, x in lines.items()
    )
    head = {
        "name": f"commissioned-{day}",
        "machine": machine.name,
        "date": day,
        "source": source,
    }
    return Profile.model_validate(head | {n: round(x.value, 6) for n, x in lines.items()})


def _open_questions(
    lines: Mapping[str, Line], drifts: bool, width: float
) -> list[Question]:
    """List the offsets that scans do not tell, and whether scans of further magnifications
    or dates would.

    Args:
        lines: of all offsets.
        drifts: whether scans tell a drift.
        width: of det_tan's prior [mm].
    """
    questions = [
        Question(n, "no scan's images tell it; it is the texts'", by)
        for n, by in TELLS.items()
        if not lines[n].scans
    ]
    if (lines["det_tan"].sigma or math.inf) > MAX_PRIOR_SHARE * width:
        why = "no scans of different magnification tell the axis"
        questions.append(Question("det_tan apart from axs_tan", why, "magnified"))
    if not drifts:
        why = f"it takes scans of {FOR_A_LINE} dates whose images tell the axis"
        questions.append(Question("drift", why, "later"))
    return questions


def _axis(
    machine: Machine, scan: PastScan, base: Profile, roll: float
) -> tuple[float, ...]:
    """Compute the column of the rotation axis in the middle of the image, and its change
    with axs_tan and det_tan.

    Offsets along the beam and height are the scan's own, if it has a profile; the camera
    likewise, else the machine's.

    Args:
        machine: of the scan.
        scan: with positions and camera.
        base: offsets sideways.
        roll: of the detector [deg].

    Returns:
        Column [px], and its two slopes [px/mm].
    """
    offsets = scan.profile or base
    camera = scan.camera or machine.detector.camera
    middle = (np.array(camera.shape[::-1]) - 1) / 2
    column = []
    for axs, det in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
        moved = {
            "axs_tan": base.axs_tan + axs,
            "det_tan": base.det_tan + det,
            "det_roll_deg": roll,
        }
        poses = motor_poses(
            machine, offsets.model_copy(update=moved), camera, scan.positions
        )
        column.append(float(axis_in_image(poses, NOMINAL, middle)[0]))
    return column[0], column[1] - column[0], column[2] - column[0]


def _fit(sides: FloatArray, values: FloatArray, sigmas: FloatArray, scans: int) -> _Fit:
    """Fit by weighted least squares of rows, of which the first `scans` belong to a scan
    each.

    The scan that contradicts the others most is left out while it does so by more than
    `MAX_SIGMAS` and at least `FOR_A_LINE` degrees of freedom are there. The covariance is
    enlarged where the residuals are above what the sigmas allow.

    Args:
        sides: (m, k) design matrix.
        values: (m,) right-hand sides.
        sigmas: (m,) of the values.
        scans: number of rows that belong to scans.

    """
    a, b = sides / sigmas[:, None], values / sigmas
    used = np.ones(len(b), dtype=bool)
    while True:
        inverse = np.linalg.inv(a[used].T @ a[used])
        at = inverse @ (a[used].T @ b[used])
        rest = b - a @ at
        leverage = np.einsum("ij,jk,ik->i", a, inverse, a)
        spread = np.sqrt(np.maximum(np.where(used, 1.0 - leverage, 1.0 + leverage), 1e-9))
        pulls = (rest / spread)[:scans]
        freedom = int(used.sum()) - a.shape[1]
        far = np.where(used[:scans], np.abs(pulls), 0.0)
        if freedom < FOR_A_LINE or far.max() <= MAX_SIGMAS:
            scatter = float(rest[used] @ rest[used]) / max(freedom, 1)
            return _Fit(at, max(1.0, scatter) * inverse, pulls)
        used[int(far.argmax())] = False
