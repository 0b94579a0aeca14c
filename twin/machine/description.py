"""The scanner as data: a validated description from TOML, so another scanner is another file.

It holds axes with limits, speeds and accelerations, the couplings between them, the
components and their parents, detector, tube, timing, and the calibration profiles (zero
offsets by date). A file may begin with a machine that ships and contain only the
differences. An error names file, key path, value and allowed values.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from importlib import resources
from itertools import product
from typing import Annotated, Any, Final, Literal, TypeVar, assert_never

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from flexdt.message_words import problem_words
from flexdt.twin.errors import LimitError, MachineFileError, TwinError, UnknownNameError
from flexdt.twin.geometry.told_lengths import PARAMETERS, PHANTOM
from flexdt.twin.input_limits import NAMED_PROBLEMS, InputLimitError, parse_toml
from flexdt.twin.machine.camera import (
    MODE_FORM,
    CameraSettings,
    PixelGrid,
    Roi,
    binning_of,
    check_roi,
    no_mode,
    without_number,
)
from flexdt.twin.machine.stated_causes import CAUSES

Positive = Annotated[float, Field(gt=0, le=1e6)]
Length = Annotated[float, Field(ge=-1e6, le=1e6)]
Binning = Annotated[int, Field(ge=1, le=64)]
Factor = Annotated[float, Field(ge=-1e6, le=1e6)]
Pace = Annotated[float, Field(ge=1e-6, le=1e6)]
Vector3 = tuple[Length, Length, Length]
_M = TypeVar("_M", bound=BaseModel)
QUANTITIES = (
    "source_x",
    "source_z",
    "object_x",
    "object_y",
    "object_z",
    "detector_x",
    "detector_y",
    "detector_z",
    "angle",
    "mount_x",
    "mount_y",
)
"""Quantities that motors move, world frame: object_y is the SOD, detector_y the SDD.

angle is the stage's. mount_x and mount_y are those of a stage on the turntable: they turn
with the sample and are along the world's x and y at angle 0.
"""
_COMPONENTS_OF_SCRIPTS = ("camera", "tube", "scanner")
"""Words of scripts that are not allowed as names of axes."""
NOT_MODELLED = (
    "not modeled (docs/limits.md): source and detector that turn about the sample (C-arms, "
    "gantries), stages that tilt, curved panels, parallel beams"
)
"""Scanners that a machine file cannot describe, for error messages."""
SAMPLE: Final = "sample"
"""Name of the sample's pieces in pairs of bodies; not allowed for a component."""
_AREA_SLACK_MM: Final = 0.5
"""Amount by which the panel's body may be smaller than the active area on each side [mm].

The FleX-ray's table has whole millimeters.
"""
MAX_POINTS: Final = 256
"""Largest number of corners of a convex part."""
MAX_TIME_S: Final = 1e6
"""Longest time of a command [s]."""
ZERO: Final = "zero"
"""Name of the profile without offsets."""
_CONTAINED_PLACES: Final = {
    "tube": "the focal spot, which is its 0, 0, 0",
    "sample_holder": "the rotation axis, which is its x = y = 0",
    "sample_mount": "the rotation axis, which is its x = y = 0",
    "panel": "the active area, whose center is its 0, 0, 0",
}
"""Role of a component -> place that its body must contain, for error messages."""
Corners = Callable[[str], Sequence[Vector3]]
"""Reads a mesh file by the name that a machine file gives it: corners of a convex body
around the mesh [mm, its own frame], at most `MAX_POINTS`."""
Raw = dict[str, Any]
_ONE_DETECTOR: Final = "a machine has one tube and one flat panel, [tube] and [detector]"
_KEY_LIMITS: Final = {
    "beam": "the beam is a cone from one focal spot; parallel and fan beams are not modeled",
    "tube": _ONE_DETECTOR,
    "source": _ONE_DETECTOR,
    "detector": _ONE_DETECTOR,
    "shape": "curved panels and line detectors are not modeled",
    "unit": 'linear axes are in mm, axes with kind = "rotation" in deg',
    "kind": "axes slide or turn about the vertical; what tilts is not modeled",
}
"""Key of a machine file -> limitation by docs/limits.md, for error messages."""


def _one_word(name: str) -> str:
    """Return a name if it is one word of 1 to 100 printable characters without
    whitespace; raise PydanticCustomError otherwise.
    """
    if not (
        0 < len(name) <= 100 and name.isprintable() and not any(c.isspace() for c in name)
    ):
        raise PydanticCustomError(
            "word", "must be one word, 1 to 100 printable characters"
        )
    return name


Name = Annotated[str, AfterValidator(_one_word)]
"""One word: scripts separate their columns by tabs, and people theirs by spaces."""


class _Frozen(BaseModel):
    # Built at the first value: a model takes 8 ms, and few imports have one.
    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True
    )


class Axis(_Frozen):
    """One motor, in the sign of scripts and wire; mm or deg, per second."""

    kind: Literal["linear", "rotation"] = "linear"
    lower: float = Field(ge=-1e9)
    upper: float = Field(le=1e9)
    home: float
    speed: Pace
    max_speed: Pace
    acceleration: Pace
    max_acceleration: Pace
    settings_sign: Literal[1, -1] = 1
    """Sign of this axis in `scan settings.txt` relative to the script's."""
    arrival_tolerance: float = Field(0.0, ge=0)
    description: str = ""
    source: str = ""
    """Where limits and rates come from."""

    @property
    def unit(self) -> str:
        """Unit of its positions at the edge: mm or deg."""
        match self.kind:
            case "linear":
                return "mm"
            case "rotation":
                return "deg"
            case _:
                assert_never(self.kind)

    @model_validator(mode="after")
    def _ordered(self) -> Axis:
        """Check that lower is at most upper, home is within both, and speed and
        acceleration are at most their maxima.

        Returns the axis unchanged.

        Raises:
            PydanticCustomError: names the first wrong field, its value and the allowed
                ones.
        """
        _refuse_if(
            self.lower > self.upper, "upper", self.upper, f"at least lower, {self.lower}"
        )
        allowed = f"within lower and upper, [{self.lower}, {self.upper}]"
        _refuse_if(not self.lower <= self.home <= self.upper, "home", self.home, allowed)
        allowed = f"at most max_speed, {self.max_speed}"
        _refuse_if(self.speed > self.max_speed, "speed", self.speed, allowed)
        allowed = f"at most max_acceleration, {self.max_acceleration}"
        _refuse_if(
            self.acceleration > self.max_acceleration,
            "acceleration",
            self.acceleration,
            allowed,
        )
        return self


class VirtualAxis(_Frozen):
    """An axis without a motor: its reading is constant + factor * other; it moves several."""

    constant: float
    of: str
    factor: float
    moves: dict[str, float]
    """Motor -> mm of that motor per mm of this axis."""
    description: str = ""

    @model_validator(mode="after")
    def _reads_what_it_moves(self) -> VirtualAxis:
        """Check that factor and shares are not 0, and that the axis reads a motor that it
        moves, with a share of 1 / factor (within 1e-6 of their product).

        Returns the axis unchanged.

        Raises:
            PydanticCustomError: names the first wrong field, its value and the allowed
                ones.
        """
        _refuse_if(self.factor == 0.0, "factor", self.factor, "a number other than 0")
        allowed = f"shares of motors, {self.of!r} (the `of`) among them"
        _refuse_if(self.of not in self.moves, "moves", self.moves, allowed)
        for motor, share in self.moves.items():
            _refuse_if(
                share == 0.0,
                f"moves.{motor}",
                share,
                "a number other than 0, or left out",
            )
        share = self.moves[self.of]
        allowed = (
            f"1 / factor, {1.0 / self.factor:g}, so that the axis gets where it is sent"
        )
        _refuse_if(
            abs(self.factor * share - 1.0) > 1e-6, f"moves.{self.of}", share, allowed
        )
        return self


class DetectorSpec(_Frozen):
    """The table `[detector]` of a machine file: the machine's own figures of the flat
    panel, and the camera settings in force at start. `physics.detector_of` makes the
    detector of it."""

    model: str
    shape: Literal["flat"] = "flat"
    """Curved panels are not modeled."""
    columns: int = Field(gt=0)
    rows: int = Field(gt=0)
    pitch_mm: Positive
    """From column to column."""
    row_pitch_mm: Positive | None = None
    """From row to row; None: the same."""
    bits: int = Field(ge=8, le=16)
    """Images are 16 bit files, so a deeper converter has no place to go."""
    modes: dict[str, Binning] = Field(default_factory=dict)
    """Binning of the camera modes whose names are not HWaSWb{High,Low}."""
    hardware_binning: tuple[Binning, ...] = (1, 2, 4)
    """Factors a of the modes HWaSWb{High,Low}; the default is the Dexela
    1512NDT's (data sheet)."""
    software_binning: tuple[Binning, ...] = (1, 2, 4)
    """Factors b (default assumed)."""
    gains: tuple[Literal["High", "Low"], ...] = ("High", "Low")
    """Full wells that they end with."""
    mode: str
    roi: tuple[int, int, int, int]
    exposure_ms: Positive = 100.0
    min_exposure_ms: float = Field(1.0, ge=1e-6)
    max_exposure_ms: float = Field(60_000.0, gt=0, le=1e7)
    long_lag_fraction: float = Field(0.0, ge=0, lt=1)
    """Part of the charge that traps keep for later images."""
    long_lag_s: Positive = 10.0
    """Time constant with which they give it back."""
    response: tuple[tuple[Positive, Annotated[float, Field(ge=0)]], ...] = ()
    """Measured: photon energy and the energy that a photon leaves on average [keV];
    straight between the points, and from the first one to nothing at 0. None:
    computed for CsI."""

    @property
    def pixels(self) -> PixelGrid:
        """Its unbinned pixels."""
        return PixelGrid(self.columns, self.rows, self.pitch_mm, self.row_pitch_mm)

    @property
    def camera(self) -> CameraSettings:
        """Camera settings at start: mode, region and exposure of the file; one exposure an
        image."""
        modes = tuple(self.modes.items())
        return CameraSettings(self.mode, Roi(*self.roi), self.exposure_ms, modes=modes)

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Names of the camera modes that exist, each once: the one at start, the
        machine's own, then HWaSWb{High,Low} of all factors and gains.
        """
        every = product(self.hardware_binning, self.software_binning, self.gains)
        names = [f"HW{a}SW{b}{gain}" for a, b, gain in every]
        return tuple(dict.fromkeys([self.mode, *self.modes, *names]))

    def check_mode(self, mode: str) -> str:
        """Return a camera mode that exists, unchanged; only names in `modes` have to agree
        in case and prefixed number. Raises LimitError: lists the modes."""
        unnumbered = {
            without_number(name) for name in self.mode_names if name not in self.modes
        }
        if mode.strip() not in self.modes and without_number(mode) not in unnumbered:
            raise no_mode(mode, self.mode_names)
        return mode

    @model_validator(mode="after")
    def _fits(self) -> DetectorSpec:
        """Check that the mode has a binning, that the ROI is on the panel, that the
        exposure is within its range, and that the response is physical.

        The energy that a photon leaves is at most its own; photon energies rise from
        above 0. The mode at start always counts as one of `mode_names`. Returns the
        detector unchanged.

        Raises:
            PydanticCustomError: names the first wrong field, its value and the allowed
                ones.
        """
        try:
            binning = binning_of(self.mode, self.modes)
        except LimitError:
            raise _refused(
                "mode", self.mode, ", ".join([*self.modes, MODE_FORM])
            ) from None
        try:
            check_roi(Roi(*self.roi), self.pixels, binning)
        except LimitError as error:
            raise _refused("roi", self.roi, error.message) from None
        least, longest = self.min_exposure_ms, self.max_exposure_ms
        _refuse_if(
            not least <= self.exposure_ms <= longest,
            "exposure_ms",
            self.exposure_ms,
            f"from min_exposure_ms to max_exposure_ms, [{least:g}, {longest:g}]",
        )
        for i, (energy, left) in enumerate(self.response):
            allowed = f"at most the photon's energy, {energy:g} keV"
            _refuse_if(left > energy, f"response.{i}", [energy, left], allowed)
            before = self.response[i - 1][0] if i else 0.0
            allowed = f"at a higher energy than the point before, {before:g} keV"
            _refuse_if(energy <= before, f"response.{i}", [energy, left], allowed)
        return self


class FilterSpec(_Frozen):
    """A layer between anode and sample."""

    material: str
    """By name, as samples have it, or FORMULA@DENSITY [g/cm3], such as Cu@8.96."""
    thickness_mm: float = Field(gt=0, le=100)

    @field_validator("material")
    @classmethod
    def _known(cls, text: str) -> str:
        """Check that a material is known; return its text unchanged. Raises UnknownNameError: no
        material of that name; LimitError: a formula or density that is not possible."""
        from flexdt.twin.attenuation.materials import material

        material(text)
        return text


class TubeSpec(_Frozen):
    """The X-ray tube's limits and settings at start."""

    name: str = "xraysource"
    min_kV: float = Field(0.0, ge=0)
    max_kV: float = Field(gt=0, le=1e4)
    max_W: float = Field(gt=0, le=1e6)
    kV: Positive
    power_W: Positive
    cold_after_s: float = Field(28_800.0, ge=0)
    """Off for longer than this, the tube warms up when it is next switched on
    (assumed: 8 h)."""
    warm_up_s: float = Field(300.0, ge=0)
    """How long that takes [s] (assumed: makers of microfocus tubes require some minutes)."""
    filters: tuple[FilterSpec, ...] = Field(
        default_factory=lambda: (
            FilterSpec.model_construct(material="Al@2.70", thickness_mm=0.5),
        )
    )
    """Layers in the path of the beam (assumed: instead of window and inherent filtration)."""
    spot_mm_per_W: float = Field(0.001, ge=0, le=1)
    """Focal spot a watt, full width at half maximum (assumed: usual for microfocus tubes)."""
    smallest_spot_mm: float = Field(0.007, ge=0, le=10)
    """Focal spot at little power (assumed)."""
    spot_points: int = Field(1, ge=1, le=1024)
    """Of the focal spot, from which rays start: each depth of the sample has its own
    blur. With 1 all of it is blurred as the rotation axis is."""

    @model_validator(mode="after")
    def _starts_within(self) -> TubeSpec:
        """Check that the initial kV is within min_kV and max_kV, the initial power at most
        max_W, and spot_points not 2.

        Returns the tube unchanged.
        Raises PydanticCustomError: names the first wrong field, its value and the allowed ones.
        """
        allowed = f"from min_kV to max_kV, [{self.min_kV:g}, {self.max_kV:g}]"
        _refuse_if(not self.min_kV <= self.kV <= self.max_kV, "kV", self.kV, allowed)
        allowed = f"at most max_W, {self.max_W:g}"
        _refuse_if(self.power_W > self.max_W, "power_W", self.power_W, allowed)
        _refuse_if(self.spot_points == 2, "spot_points", 2, "1, or 3 to 1024")
        return self


def _box_around(points: Iterable[Vector3]) -> tuple[Vector3, Vector3]:
    """Compute size and center of the upright box around points, at least one: (x, y, z)
    each [mm]."""
    (x, x_), (y, y_), (z, z_) = ((min(c), max(c)) for c in zip(*points, strict=True))
    return (x_ - x, y_ - y, z_ - z), ((x + x_) / 2, (y + y_) / 2, (z + z_) / 2)


class Component(_Frozen):
    """A convex part of the machine on its kinematic chain; upright in world axes, mm.

    A part moves with its own motor and with those of its parents. `center_mm` is its
    center with every quantity of `geometry` at zero; along the directions in which its
    chain moves it, or in which `fixed` has its anchor's place, it is therefore measured
    from the focal spot, the rotation axis or the panel's center (see `anchor`), along the
    others from the world's origin.
    """

    name: Name
    parent: str | None = None
    axis: str | None = None
    """The motor that moves this part relative to its parent (None: rigidly mounted)."""
    shape: Literal["box", "cylinder", "hull"] = "box"
    """`cylinder` is upright: size x is its diameter (y the same), z its height. `hull` is
    the convex hull of `points_mm`, for parts with a mesh."""
    mesh: str = ""
    """A GLB or STL file beside the machine file: how the part looks. `points_mm` contain it."""
    mesh_at_mm: Vector3 = (0.0, 0.0, 0.0)
    """Place of the mesh's origin, measured as `center_mm` is."""
    points_mm: tuple[Vector3, ...] = Field((), max_length=MAX_POINTS)
    size_mm: tuple[Positive, Positive, Positive]
    center_mm: Vector3
    anchor: Literal["world", "source", "object", "detector"] = "world"
    """Whose quantities of `geometry` (and zero offsets) the motors of its chain move."""
    role: Literal["", "sample_holder", "sample_mount", "panel", "tube"] = ""
    """Function of the part: focal spot (`tube`), active area (`panel`), or carrier
    of the sample."""
    source: str = ""

    @field_validator("parent", "axis", mode="before")
    @classmethod
    def _none(cls, name: object) -> object:
        """Convert "", which removes the base's value, to None: TOML has no null."""
        return None if name == "" else name

    @model_validator(mode="after")
    def _round(self) -> Component:
        """Check that size, center and points agree with the shape.

        A cylinder is as wide in x as in y. A hull, and no other shape, has points; size
        and center are exactly those of the box around them. Returns the component
        unchanged.

        Raises:
            PydanticCustomError: names the field, its value and the allowed ones.
        """
        if self.shape == "cylinder" and self.size_mm[0] != self.size_mm[1]:
            raise _refused(
                "size_mm", self.size_mm, "as wide in x as in y, for a cylinder"
            )
        if (self.shape == "hull") != bool(self.points_mm):
            raise _refused(
                "points_mm", len(self.points_mm), "there for a hull, and for it alone"
            )
        if self.points_mm and _box_around(self.points_mm) != (
            self.size_mm,
            self.center_mm,
        ):
            raise _refused("size_mm", self.size_mm, "those of the box around points_mm")
        return self


class Spread(_Frozen):
    """How a measured time varies [s]: nine of ten are between `p5_s` and `p95_s`,
    from n times."""

    p5_s: float = Field(ge=0)
    p95_s: float = Field(ge=0, le=MAX_TIME_S)
    n: int = Field(ge=1)


class Timing(_Frozen):
    """Assumed or measured times of commands, beside motion and exposure [s].

    A kind of command is a field's name without `_s`. A kind in `spread` is measured.

    Example:
        >>> Timing(source="assumed", save_image_s=0.1).seconds("save_image")
        0.1
    """

    source: str
    xrayon_s: float = Field(0.0, ge=0)
    xray_ready_s: float = Field(0.0, ge=0)
    xrayoff_s: float = Field(0.0, ge=0)
    xrayoff_again_s: float = Field(0.0, ge=0)
    """Where the script itself has switched them off before."""
    set_tube_s: float = Field(0.0, ge=0)
    set_camera_s: float = Field(0.0, ge=0)
    set_motor_s: float = Field(0.0, ge=0)
    take_image_overhead_s: float = Field(0.0, ge=0)
    save_image_s: float = Field(0.0, ge=0)
    sequence_overhead_s: float | None = Field(None, ge=0)
    """None: as for one image."""
    write_settings_s: float = Field(0.0, ge=0)
    move_s: float = Field(0.0, ge=0)
    """Wait of the script for a move beyond its motion."""
    move_standing_s: float = Field(0.0, ge=0)
    """The same for an axis that is at its target already."""
    command_s: float = Field(0.0, ge=0)
    """Of all other commands, such as a pause beyond its length."""
    drift: float = Field(0.0, ge=0)
    """Relative change of all times together that is possible in the next scan."""
    spread: dict[str, Spread] = Field(default_factory=dict)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of commands that have a time here, assumed or measured, without "_s", in
        the fields' order.
        """
        return tuple(
            name[:-2]
            for name in Timing.model_fields
            if name.endswith("_s") and getattr(self, name) is not None
        )

    def seconds(self, kind: str) -> float:
        """Return the time of one of `kinds` [s]."""
        value: float = getattr(self, f"{kind}_s")
        return value

    @property
    def sequence(self) -> str:
        """Kind whose time a sequence of images takes beyond its exposures:
        sequence_overhead, or, if that is None, take_image_overhead.
        """
        if self.sequence_overhead_s is None:
            return "take_image_overhead"
        return "sequence_overhead"

    @model_validator(mode="after")
    def _spreads_hold(self) -> Timing:
        """Check that each kind with a spread has a time, from its p5_s to its p95_s.

        Returns the times unchanged.

        Raises:
            PydanticCustomError: names the first wrong kind, its value and the allowed
                ones.
        """
        _require(self.spread, self.kinds, "spread", "kind of command")
        for kind, spread in self.spread.items():
            middle = self.seconds(kind)
            allowed = f"from p5_s to p95_s, [{spread.p5_s:g}, {spread.p95_s:g}]"
            _refuse_if(
                not spread.p5_s <= middle <= spread.p95_s, f"{kind}_s", middle, allowed
            )
        return self


class EStop(_Frozen):
    """Effect of an E-stop on the motors: the stop categories of IEC 60204-1."""

    category: Literal[0, 1] = 1
    """1: brake along the path with all that the motors can, then power off. 0: power off
    at once, and the motors coast."""
    coasting: dict[str, Positive] = Field(default_factory=dict)
    """Motor -> deceleration without power [mm/s2, deg/s2]; every motor's, for category 0."""


OF_SCANNER: Final = (*(name for name in PARAMETERS if name != PHANTOM), *CAUSES)
"""Offsets, told lengths and causes whose priors a scanner may state."""


def _known_offsets(priors: dict[str, float]) -> dict[str, float]:
    """Return priors, name -> standard deviation, unchanged if all name what a scanner has;
    raise PydanticCustomError for the first that does not."""
    for name in priors:
        if name not in OF_SCANNER:
            allowed = f"a known offset, told length or cause: {', '.join(OF_SCANNER)}"
            raise _refused(name, priors[name], allowed)
    return priors


Priors = Annotated[
    dict[str, Annotated[float, Field(ge=0)]], AfterValidator(_known_offsets)
]
"""Offset, told length or cause (`stated_causes`) -> standard deviation of the knowledge before
a calibration [mm, deg; 1 for angle_scale, ways and pitch]; 0 is exactly known, a cause of 0
cannot be, and those left out are as `flexdt.twin.calibration.fit.priors` assumes."""


class Profile(_Frozen):
    """Dated zero offsets from motor readings to geometry [mm, deg]; never
    edited, only added."""

    name: str
    machine: str
    date: str = ""
    source: str
    det_tan: float = 0.0
    src_ort: float = 0.0
    axs_tan: float = 0.0
    c_obj: float = 0.0
    c_det: float = 0.0
    det_roll_deg: float = 0.0
    priors: Priors = Field(default_factory=dict)
    """Standard deviations that remain with these offsets, where they differ
    from the machine's."""


class Machine(_Frozen):
    """The description of a scanner."""

    schema_version: Literal[1] = Field(alias="schema")
    name: Name
    scanner_name: str
    scanner_type: str
    serial: str = ""
    description: str = ""
    on_limit: Literal["clamp", "reject"] = "clamp"
    max_blocked_attempts: int = Field(3, ge=1)
    safety_margin_mm: float = Field(1.0, ge=0)
    estop: EStop = Field(default_factory=EStop)
    sample_height_mm: Length = 0.0
    """Height of the sample's reference point above the origin at object_z = 0."""
    default_profile: str = ""
    """Zero offsets; without a name there are none."""
    beam: Literal["cone"] = "cone"
    detector: DetectorSpec
    tube: TubeSpec
    axes: dict[Name, Axis]
    virtual_axes: dict[Name, VirtualAxis] = Field(default_factory=dict)
    geometry: dict[str, dict[str, Factor]]
    """Quantity -> motor -> factor: each of QUANTITIES is a linear sum of motors."""
    fixed: dict[str, Length] = Field(default_factory=dict)
    """Quantity -> its constant part [mm, deg]: its place, if no motor moves it."""
    timing: Timing
    priors: Priors = Field(default_factory=dict)
    """How well the offsets of this scanner are known before a calibration."""
    components: tuple[Component, ...] = ()
    allowed_contacts: tuple[tuple[str, str], ...] = ()
    """Pairs of components that are mounted on or run along each other."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        populate_by_name=True,
        defer_build=True,
    )

    def __repr__(self) -> str:
        """One line."""
        return f"<Machine {self.name!r}: {self.scanner_name}, {', '.join(self.axes)}>"

    __str__ = __repr__

    @model_validator(mode="after")
    def _consistent(self) -> Machine:
        """Check the relations between tables: quantities, axes and their kinds, fixed
        places, response, names, chains, roles, E-stop, contacts.

        Quantities of `geometry` and `fixed` are known (`angle` is not fixed); their
        factors are not 0 and of linear axes, of rotation axes for `angle`; a fixed
        mount_x or mount_y has a motor. A measured response reaches the tube's max_kV.
        Names of axes and virtual axes differ, case ignored, from each other, from the
        tube's and from `_COMPONENTS_OF_SCRIPTS`. See `_check_chains` and `_check_roles`.
        Category 0 of the E-stop has a deceleration for every motor. The first violation
        is raised. Returns the machine unchanged.

        Raises:
            PydanticCustomError: names the key, its value and the allowed ones.
        """
        _require(self.geometry, QUANTITIES, "geometry", "quantity", f"; {NOT_MODELLED}")
        slides = [quantity for quantity in QUANTITIES if quantity != "angle"]
        _require(self.fixed, slides, "fixed", "quantity that slides", f"; {NOT_MODELLED}")
        for quantity, factors in self.geometry.items():
            _require(factors, self.axes, f"geometry.{quantity}", "axis")
            kind = "linear"
            if quantity == "angle":
                kind = "rotation"
            for name, factor in factors.items():
                allowed = "a number other than 0, or left out"
                _refuse_if(factor == 0.0, f"geometry.{quantity}.{name}", factor, allowed)
                allowed = f"driven by {kind} axes alone; {NOT_MODELLED}"
                _refuse_if(
                    self.axes[name].kind != kind, f"geometry.{quantity}", name, allowed
                )
        for quantity in ("mount_x", "mount_y"):
            if quantity in self.fixed and not self.geometry.get(quantity):
                allowed = "left out where no stage on the turntable moves along it"
                raise _refused(f"fixed.{quantity}", self.fixed[quantity], allowed)
        response = self.detector.response
        if response and response[-1][0] < self.tube.max_kV:
            allowed = f"measured up to the tube's max_kV, {self.tube.max_kV:g} keV"
            raise _refused("detector.response", response[-1], allowed)
        taken = [*_COMPONENTS_OF_SCRIPTS, self.tube.name.lower()]
        for name in (*self.axes, *self.virtual_axes):
            allowed = (
                "another name: scripts, which tell no case apart, say it of other things"
            )
            _refuse_if(name.lower() in taken, f"axes.{name}", name, allowed)
            taken.append(name.lower())
        for name, virtual in self.virtual_axes.items():
            _require([virtual.of], self.axes, f"virtual_axes.{name}.of", "axis")
            _require(virtual.moves, self.axes, f"virtual_axes.{name}.moves", "axis")
        self._check_chains()
        self._check_roles()
        _require(self.estop.coasting, self.axes, "estop.coasting", "axis")
        missing = [name for name in self.axes if name not in self.estop.coasting]
        if self.estop.category == 0 and missing:
            every = f"a deceleration for every motor, {', '.join(missing)} too"
            raise _refused("estop.coasting", dict(self.estop.coasting), every)
        names = [c.name for c in self.components]
        for pair in self.allowed_contacts:
            _require(pair, names, "allowed_contacts", "component")
        return self

    def _check_chains(self) -> None:
        """Check the kinematic chains of the components.

        A name is used once and is not `SAMPLE`; parents come first; a part's axis is a motor of
        the machine that drives its anchor and occurs once in its chain; a part carried by a
        moved one has its anchor; a stage on the turntable (mount_x, mount_y) is carried by all
        motors of the angle. The first violation is raised.

        Raises PydanticCustomError: names the component's key, its value and the allowed ones.
        """
        names = [c.name for c in self.components]
        for component in self.components:
            self._check_links(component, names)
        for component in self.components:
            where = f"components.{component.name}"
            self._check_anchor(component, where)
            self._check_turntable(component, where)
            chain = self.chain(component)
            twice = next((motor for motor in chain if chain.count(motor) > 1), None)
            allowed = "a motor that no part which carries this one has already"
            _refuse_if(twice is not None, f"{where}.axis", twice, allowed)

    def _check_links(self, component: Component, names: list[str]) -> None:
        """Check that a component's name is used once, its parent stands earlier in
        `names`, and its axis is a motor of the machine.
        """
        name = component.name
        where = f"components.{name}"
        _refuse_if(
            names.count(name) > 1, f"{where}.name", name, "a name that is used once"
        )
        allowed = "another name: it is the sample's"
        _refuse_if(name == SAMPLE, f"{where}.name", name, allowed)
        if component.parent is not None:
            # Parents come first, so that a chain can never be a circle.
            earlier = names[: names.index(name)]
            _require([component.parent], earlier, f"{where}.parent", "earlier component")
        if component.axis is not None:
            _require([component.axis], self.axes, f"{where}.axis", "axis")

    def _check_anchor(self, component: Component, where: str) -> None:
        """Check that all motors of a component's chain drive its anchor, and that a
        moved carrier has the same anchor.
        """
        driving = self._motors_of(component.anchor)
        message = f"motor of anchor {component.anchor!r}"
        _require(self.chain(component), driving, f"{where}.axis", message)
        carrier = next((c for c in self.components if c.name == component.parent), None)
        if carrier is None or not self.chain(carrier):
            return
        allowed = (
            f"{carrier.anchor!r}, as that of the part that carries it, {carrier.name}"
        )
        differs = carrier.anchor != component.anchor
        _refuse_if(differs, f"{where}.anchor", component.anchor, allowed)

    def _check_turntable(self, component: Component, where: str) -> None:
        """Check that a stage on the turntable (mount_x, mount_y) is carried by all motors
        of the angle.
        """
        chain = self.chain(component)
        centring = [i for i, motor in enumerate(chain) if self._on_turntable(motor)]
        if component.anchor != "object" or not centring:
            return
        turns = self.geometry.get("angle", {})
        turning = [chain.index(motor) if motor in chain else -1 for motor in turns]
        allowed = (
            f"carried by the turntable ({', '.join(turns)}), as mount_x and mount_y are"
        )
        outside = min(turning, default=-1) < centring[-1]
        _refuse_if(outside, f"{where}.axis", component.axis, allowed)

    def _check_roles(self) -> None:
        """Check that focal spot, active area, holder and mount are where the X-ray
        geometry has them.

        Tube, sample_holder and panel have exactly one component each, unless the machine
        has no components at all; a sample_mount may be missing or occur more than once.
        Each is at its own anchor, carried by all motors of that anchor, and large enough
        to contain its place (within 1e-6 mm, a panel within `_AREA_SLACK_MM`). Otherwise
        a motor of `geometry` would move the image and leave the body behind, and a
        collision would count as free.

        The first violation is raised.

        Raises:
            PydanticCustomError: names the component's key, its value and the allowed
                ones.
        """
        across, up = self.detector.pixels.size_mm
        for role, anchor, half in (
            ("tube", "source", (0.0, 0.0, 0.0)),
            ("sample_holder", "object", (0.0, 0.0)),
            ("sample_mount", "object", (0.0, 0.0)),
            ("panel", "detector", (across / 2, 0.0, up / 2)),
        ):
            parts = [part for part in self.components if part.role == role]
            if self.components and len(parts) != 1 and role != "sample_mount":
                allowed = (
                    f"one component with role = {role!r}; "
                    "or no components and no check at all"
                )
                raise _refused("components", [part.name for part in parts], allowed)
            for part in parts:
                where = f"components.{part.name}"
                if part.anchor != anchor:
                    raise _refused(
                        f"{where}.anchor", part.anchor, f"{anchor!r}, for a {role}"
                    )
                chain = self.chain(part)
                left = [motor for motor in self._motors_of(anchor) if motor not in chain]
                if left:
                    allowed = (
                        f"carried by every motor that [geometry] gives the {anchor}, "
                        "so that it goes where the X-ray geometry goes: say axis = "
                        f"{left[0]!r} of it or of a part that carries it"
                    )
                    raise _refused(f"{where}.axis", part.axis, allowed)
                slack = 1e-6
                if role == "panel":
                    slack = _AREA_SLACK_MM
                reach = [abs(c) + r for c, r in zip(part.center_mm, half, strict=False)]
                if part.shape == "cylinder":
                    reach[:2] = [math.hypot(reach[0], reach[1]), 0.0]
                if any(
                    b > side / 2 + slack
                    for b, side in zip(reach, part.size_mm, strict=False)
                ):
                    held = _CONTAINED_PLACES[role]
                    allowed = (
                        f"such that the {part.shape}, {part.size_mm} mm, holds {held}"
                    )
                    raise _refused(f"{where}.center_mm", part.center_mm, allowed)

    def _on_turntable(self, motor: str) -> bool:
        """Return whether a motor moves a stage that turns with the sample."""
        return any(motor in self.geometry.get(q, {}) for q in ("mount_x", "mount_y"))

    def _motors_of(self, anchor: str) -> list[str]:
        """List the motors that drive a coordinate of `anchor`, in the order of `QUANTITIES`;
        those of the object include the motors of angle, mount_x and mount_y. A motor that drives
        two coordinates is listed twice."""
        quantities = [q for q in QUANTITIES if q.startswith(f"{anchor}_")]
        quantities += ["angle", "mount_x", "mount_y"] if anchor == "object" else []
        return [motor for q in quantities for motor in self.geometry.get(q, {})]

    def chain(self, component: Component) -> tuple[str, ...]:
        """List the motors that carry `component`, from its own to the outermost; () if it
        stands still.
        """
        parents = {c.name: c for c in self.components}
        motors: list[str] = []
        part: Component | None = component
        while part is not None:
            motors += [part.axis] if part.axis is not None else []
            if part.parent is not None:
                part = parents[part.parent]
            else:
                part = None
        return tuple(motors)

    def has(self, axis: str) -> bool:
        """Return whether a motor or virtual axis has that name."""
        return axis in self.axes or axis in self.virtual_axes

    def moves(self, axis: str) -> Mapping[str, float]:
        """Return motor -> mm or deg of it per unit of `axis`.

        Raises:
            UnknownNameError: no such axis.
        """
        if axis in self.axes:
            return {axis: 1.0}
        if axis not in self.virtual_axes:
            raise unknown_axis(axis, self)
        return self.virtual_axes[axis].moves

    def counts(self, motor: str) -> float:
        """Return by how many units a motor moves the farthest part by 1 mm or deg."""
        shares = (abs(of.get(motor, 0.0)) for of in self.geometry.values())
        return 1.0 / (max(shares, default=0.0) or 1.0)

    def axis(self, name: str) -> Axis:
        """Look up a motor.

        Raises UnknownNameError: lists the machine's axes.
        """
        if name not in self.axes:
            raise unknown_axis(name, self)
        return self.axes[name]


def _refused(at: str, value: object, allowed: str) -> PydanticCustomError:
    """Make the error of a value, reported at `at`, relative to the model's own key; returned,
    not raised. The message is "must be" and `allowed`."""
    context = {"at": at, "value": value, "allowed": allowed}
    return PydanticCustomError("refused", "must be {allowed}", context)


def _refuse_if(wrong: bool, at: str, value: object, allowed: str) -> None:
    """Raise the error of `_refused` for a value at key `at`, if `wrong`."""
    if wrong:
        raise _refused(at, value, allowed)


def unknown_axis(name: str, machine: Machine) -> UnknownNameError:
    """Make the error for a name that is no axis of `machine`; returned, not raised.

    Motors and virtual axes are listed as allowed.
    """
    allowed = [*machine.axes, *machine.virtual_axes]
    return UnknownNameError.among(
        f"unknown axis {name!r}; {machine.name} has", name, allowed
    )


def parse_machine(
    text: str, file: str = "<machine>", corners: Corners | None = None
) -> Machine:
    """Parse and validate a machine description, with its base and meshes.

    `base = NAME` inherits everything else from a shipped machine, except its zero offsets
    and the axes and components that `without` lists. Tables are merged by key, components
    by name; a quantity of `geometry` and `timing` are replaced.
    `corners`: reads the meshes that it names; None: they are an error.

    Raises:
        MachineFileError: TOML or content is invalid, a motor moves nothing, or none turns
            the sample.
    """
    machine = _parse(Machine, lambda own: _inherited(_meshed(own, corners)), text, file)
    driving = {name for factors in machine.geometry.values() for name in factors}
    idle = [name for name in machine.axes if name not in driving]
    if idle or not machine.geometry.get("angle"):
        path = "geometry.angle"
        if idle:
            path = f"axes.{idle[0]}"
        allowed = "motors that turn the sample"
        if idle:
            allowed = "in [geometry] with what it moves"
        raise MachineFileError(
            f"{file}: {path}: must be {allowed}; {NOT_MODELLED}",
            {"file": file, "path": path},
        )
    return machine


def parse_profile(text: str, file: str = "<profile>") -> Profile:
    """Parse a calibration profile from TOML; errors as `parse_machine`."""
    return _parse(Profile, dict, text, file)


@lru_cache
def builtin_machine(name: str = "flexray") -> Machine:
    """Load a machine that ships with the package.

    Raises:
        UnknownNameError: lists the shipped machines.
    """
    return parse_machine(_data("machines", name), f"{name}.toml")


@lru_cache
def builtin_profile(name: str) -> Profile:
    """Load a calibration profile that ships with the package.

    Raises:
        UnknownNameError: lists the shipped profiles.
    """
    return parse_profile(_data("profiles", name), f"{name}.toml")


def builtin_machine_text(name: str) -> str:
    """Read the file of a machine that ships, with its comments; errors as `builtin_machine`."""
    return _data("machines", name)


def profile_of(machine: Machine, name: str | None = None) -> Profile:
    """Load the shipped profile `name` (None, "": the machine's default), or zero offsets.

    Whether it is of this machine is not checked. Raises UnknownNameError: none such.
    """
    chosen = name or machine.default_profile
    if chosen in ("", ZERO) and not machine.default_profile:
        return Profile(name=ZERO, machine=machine.name, source="no offsets")
    return builtin_profile(chosen)


def default_profile(machine: Machine, file: str) -> Profile:
    """Load the shipped profile that `machine` names as its own, or make one of zero
    offsets if it names none.

    Args:
        machine: whose.
        file: where it was read, for the error.

    Raises:
        MachineFileError: no profile of that name ships; file, key, value, allowed.
    """
    if not machine.default_profile:
        return profile_of(machine)
    try:
        return builtin_profile(machine.default_profile)
    except UnknownNameError as error:
        raise MachineFileError(
            f"{file}: default_profile: {error.message}; a file can be said instead",
            {**error.data, "file": file, "path": "default_profile"},
        ) from None


def builtin_machines() -> tuple[str, ...]:
    """List shipped machines."""
    return _names("machines")


def builtin_profiles(machine: str | None = None) -> tuple[str, ...]:
    """List the names of the shipped profiles, sorted, of a machine or all."""
    names = _names("profiles")
    return tuple(
        n for n in names if machine is None or builtin_profile(n).machine == machine
    )


def _names(kind: str) -> tuple[str, ...]:
    """List the names of the shipped TOML files of a kind ("machines" or "profiles"),
    sorted, without ".toml".
    """
    folder = resources.files("flexdt.twin") / "data" / kind
    return tuple(
        sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml"))
    )


def _data(kind: str, name: str) -> str:
    """Read the text of a shipped TOML file.

    `kind`: "machines" or "profiles"; `name`: of the machine or profile.
    Raises UnknownNameError: there is none; lists the allowed names.
    """
    if name not in _names(kind):
        message = f"no {kind[:-1]} called {name!r} ships with flexdt; there are"
        raise UnknownNameError.among(message, name, _names(kind))
    path = resources.files("flexdt.twin") / "data" / kind / f"{name}.toml"
    return path.read_text(encoding="utf-8")


def _meshed(own: Raw, corners: Corners | None) -> Raw:
    """Replace the meshes of components by their convex bodies, in place.

    The corners are moved by `mesh_at_mm`, if it is given; shape becomes "hull" with size
    and center of their box. Components without a mesh stay.

    Args:
        own: content of a machine file; it is changed.
        corners: reads the corners of a mesh file; None: no files may be read.

    Returns:
        `own` itself.

    Raises:
        UnknownNameError: a shape, size, center or points beside a mesh; a `mesh_at_mm`
            that is not three numbers; a name that is no text; no reader; or the reader's
            error. Names the component and its problem.
    """
    parts = own.get("components", [])
    if parts:
        meshed = [p for p in parts if isinstance(p, dict) and "mesh" in p]
    else:
        meshed = []
    for part in meshed:
        where = f"components.{part.get('name')}"
        name = part["mesh"]
        keys = [
            key for key in ("shape", "size_mm", "center_mm", "points_mm") if key in part
        ]
        if keys:
            raise UnknownNameError(
                f"{where}.{keys[0]}: must be left out: the mesh says it"
            )
        at = part.get("mesh_at_mm", (0.0, 0.0, 0.0))
        number = lambda v: isinstance(v, (int, float)) and not isinstance(v, bool)  # noqa: E731
        if not isinstance(at, Sequence) or len(at) != 3 or not all(map(number, at)):
            raise UnknownNameError(
                f"{where}.mesh_at_mm: must be three numbers (value: {at!r})"
            )
        if not isinstance(name, str) or corners is None:
            allowed = "left out: no files are read here"
            if corners:
                allowed = "a file's name"
            raise UnknownNameError(f"{where}.mesh: must be {allowed} (value: {name!r})")
        try:
            hull = corners(name)
        except TwinError as error:
            raise UnknownNameError(f"{where}.mesh: {error.message}") from None
        points = [tuple(float(v + a) for v, a in zip(p, at, strict=True)) for p in hull]
        size, center = _box_around(points)  # type: ignore[arg-type]
        part.update(shape="hull", points_mm=points, size_mm=size, center_mm=center)
    return own


def _inherited(own: Raw) -> Raw:
    """Merge a machine's content into that of its base, less the axes and components of
    `without`.

    Without base and `without` the content is returned as it is. A content with a name of
    its own loses the base's default profile; bases may have bases. See `_drop` and
    `_merged`.

    Args:
        own: content of a machine file; `base` and `without` are removed from it.

    Returns:
        The complete content.

    Raises:
        UnknownNameError: no such base, no base but `without`; components that are no
            tables, or a value where the base has a table; or a removed name that the base
            does not have.
    """
    name = own.pop("base", None)
    without = own.pop("without", [])
    if name is None and not without:
        return own
    if not isinstance(name, str):
        raise UnknownNameError(
            f"base must be the name of a machine that ships (value: {name!r})"
        )
    base = _inherited(tomllib.loads(_data("machines", name)))
    for key, value in own.items():
        parts = value if isinstance(value, list) else [0]
        if key == "components" and not all(isinstance(part, dict) for part in parts):
            raise UnknownNameError(
                f"components must be tables, [[components]] (value: {value!r})"
            )
        if isinstance(base.get(key), dict) and not isinstance(value, dict):
            allowed = f"must be a table, [{key}]{_limit(key)}"
            raise UnknownNameError(f"{key} {allowed} (value: {value!r})")
    if "name" in own:
        base["default_profile"] = ""  # the base's zero offsets are of that machine alone
    for removed in without if isinstance(without, list) else [without]:
        _drop(base, removed)
    return _merged(base, own)


def _drop(base: Raw, name: object) -> None:
    """Remove an axis or a component from a machine's content, and from all that names it.

    Parts that the removed component carried go to its parent; parts that the removed
    motor moved are mounted rigidly; a virtual axis that reads it goes, too, and others
    lose their share of it.

    Args:
        base: content of a machine file; changed in place.
        name: of the axis or component.

    Raises:
        UnknownNameError: the base has no such axis or component.
    """
    parts: list[Raw] = base.get("components", [])
    axes = [base["axes"], base.get("virtual_axes", {})]
    known = [n for table in axes for n in table] + [c["name"] for c in parts]
    if name not in known:
        raise UnknownNameError(
            f"without: must be axes and components of {base['name']}: {', '.join(known)} "
            f"(value: {name!r})"
        )
    for table in axes:
        table.pop(name, None)
    for quantity in base["geometry"].values():
        quantity.pop(name, None)
    for virtual, entry in list(axes[1].items()):
        entry["moves"].pop(name, None)
        if entry["of"] == name:
            del axes[1][virtual]
    base["components"] = _without_part(parts, name)
    pairs = base.get("allowed_contacts", [])
    base["allowed_contacts"] = [pair for pair in pairs if name not in pair]


def _without_part(parts: list[Raw], name: object) -> list[Raw]:
    """Return the components less one of that name; its parts go to its parent, and parts
    on an axis of that name are mounted rigidly.
    """
    removed = next((c for c in parts if c["name"] == name), {})
    parent = {key: removed[key] for key in ("parent",) if key in removed}
    left = []
    for part in parts:
        if part["name"] == name:
            continue
        changed = dict(part)
        if changed.get("axis") == name:
            del changed["axis"]
        if changed.get("parent") == name:
            del changed["parent"]
            changed |= parent
        left.append(changed)
    return left


def _merged(base: Raw, own: Raw, whole: tuple[str, ...] = ("timing",)) -> Raw:
    """Merge a machine's content into that of its base, key by key, in a new table.

    In `geometry` each quantity is replaced whole, elsewhere a table `moves`, and those of
    `whole`; components are merged by name. Merged tables say in `source` which values
    come from the file (`_credit`).
    """
    out = dict(base)
    for key, value in own.items():
        old = out.get(key)
        if key == "components" and isinstance(old, list) and isinstance(value, list):
            out[key] = _merged_parts(old, value)
        elif isinstance(old, dict) and isinstance(value, dict) and key not in whole:
            out[key] = _merged(
                old, value, tuple(value) if key == "geometry" else ("moves",)
            )
            _credit(out[key], old, value)
        else:
            out[key] = value
    return out


def _merged_parts(old: list[Raw], own: list[Raw]) -> list[Raw]:
    """Merge components by name: values of the file replace those of the base key by key.

    Of two components of one name in the file the first is merged and the other kept, so that the
    check of names finds them. Each merged component says in `source` which values come from the
    file (`_credit`).

    `old`: of the base machine; `own`: of the file, which go before those.
    Returns the base's components in their order, then the file's new ones.
    """
    first = {
        part["name"]: part for part in reversed(own) if isinstance(part.get("name"), str)
    }
    known = [part["name"] for part in old]
    taken = [first[name] for name in known if name in first]
    merged = [{**part, **first.get(part["name"], {})} for part in old]
    for part, before in zip(merged, old, strict=True):
        _credit(part, before, first.get(part["name"], {}))
    return merged + [part for part in own if not any(part is other for other in taken)]


def _credit(merged: Raw, old: Raw, own: Raw) -> None:
    """Write into `merged["source"]` which keys come from this file; else the base's
    source.

    Without values here, a source here or none in the base, nothing is done.
    """
    if own and isinstance(old.get("source"), str) and "source" not in own:
        keys = ", ".join(key for key in own if key != "name")
        merged["source"] = (
            f"{keys}: this file; else {old['source'] or 'as the base has it'}"
        )


def _parse(model: type[_M], prepared: Callable[[Raw], Raw], text: str, file: str) -> _M:
    """Parse and validate TOML, and collect all problems into one error.

    A text that is no TOML, or nests too deep, and too large numbers are such errors, too.
    An error of `prepared` is raised alone, before the validation.

    Args:
        model: type of the result.
        prepared: converts the content before it is validated; may raise UnknownNameError.
        text: TOML.
        file: name for error messages.

    Returns:
        A value of `model`.

    Raises:
        MachineFileError: one line for each problem: file, key path, message and value;
            data has file and, after a validation, problems (path, message, value).
    """
    try:
        content = parse_toml(text, file)
    except InputLimitError as error:
        raise MachineFileError(error.message, {"file": file, **error.data}) from None
    except ValueError as error:
        raise MachineFileError(
            f"{file}: not valid TOML: {error}", {"file": file}
        ) from None
    try:
        return model.model_validate(prepared(content))
    except UnknownNameError as error:
        raise MachineFileError(f"{file}: {error.message}", {"file": file}) from None
    except OverflowError as error:
        raise MachineFileError(
            f"{file}: a number is too large: {error}", {"file": file}
        ) from None
    except ValidationError as error:
        lines = []
        data = []
        for e in error.errors(include_url=False)[:NAMED_PROBLEMS]:
            at = e.get("ctx", {}).get("at")
            path = ".".join(str(p) for p in (*e["loc"], *([] if at is None else [at])))
            if e["type"] == "missing":
                lines.append(f"{file}: {path}: is missing")
                data.append({"path": path, "message": "is missing"})
                continue
            if at is None:
                value = e["input"]
            else:
                value = e["ctx"]["value"]
            message = "there is no such key"
            if e["type"] != "extra_forbidden":
                message = problem_words(e)
            if e["type"] in ("extra_forbidden", "literal_error", "model_type"):
                message += _limit(path)
            lines.append(f"{file}: {path}: {message} (value: {value!r})")
            data.append({"path": path, "message": message, "value": repr(value)})
        if error.error_count() > NAMED_PROBLEMS:
            lines.append(f"{file}: and {error.error_count() - NAMED_PROBLEMS} more")
        raise MachineFileError(
            "\n".join(lines), {"file": file, "problems": data}
        ) from None


def _limit(path: str) -> str:
    """Return the limitation of the twin that a key comes from, or "".

    It ends the error's message.
    """
    last = path.rpartition(".")[2].lower()
    limit = next(
        (text for key, text in _KEY_LIMITS.items() if last.startswith(key)), None
    )
    if limit:
        return f"; {limit} (docs/limits.md)"
    return ""


def _require(
    names: Iterable[str], allowed: Iterable[str], where: str, what: str, more: str = ""
) -> None:
    """Raise the error of `_refused` for the first of `names` that is not allowed.

    `where`: key path; `what`: noun, such as "axis".
    """
    valid = list(allowed)
    for name in names:
        if name not in valid:
            known = ", ".join(valid) or "there is none"
            raise _refused(where, name, f"a known {what}: {known}{more}")
