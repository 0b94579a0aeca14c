"""The plan of a batch: a TOML file as validated, frozen values; errors name key path and value.

The manifest holds the plan with every default written out, so no result depends on a hidden
one.

A plan fixes or draws values: `600.0`, `{ uniform = [500, 800] }`, `{ choice = [...] }`. Each is
a frozen value with `sample(rng)`; the caller owns the generator. Validation errors name the
allowed values.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import numpy as np
from annotated_types import Ge, Gt, Le, Len
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from flexdt.extending import CommandError
from flexdt.twin.calibration import SIX
from flexdt.twin.calibration.fit.priors import NOISE_PX, exact
from flexdt.twin.calibration.pipeline import CalibrationRequest
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.offsets import NAMES
from flexdt_extensions.executors import problems_of, read_toml

Value = float | int | str
Generator = np.random.Generator


@dataclass(frozen=True)
class Draw:
    """A distribution.

    Attributes:
        kind: its name in plans; "fixed" for a bare value.
        values: its numbers or texts.
    """

    kind: str
    values: tuple[Value, ...]

    def sample(self, rng: Generator) -> Any:
        """Draw one value: float, int or str, as the plan has them."""
        return _SAMPLERS[self.kind](self.values, rng)

    @property
    def lowest(self) -> float:
        """No value is below this; -inf if there is no such number."""
        if self.kind == "normal":
            return -math.inf
        return min(float(v) for v in self.values)

    @property
    def highest(self) -> float:
        """No value is above this."""
        if self.kind == "normal":
            return math.inf
        return max(float(v) for v in self.values)

    def to_plain(self) -> object:
        """Convert to the form that plans have in TOML."""
        if self.kind == "fixed":
            return self.values[0]
        return {self.kind: list(self.values)}


_SAMPLERS: Final[Mapping[str, Callable[[Any, Generator], Any]]] = {
    "fixed": lambda v, rng: v[0],
    "uniform": lambda v, rng: float(rng.uniform(v[0], v[1])),
    "loguniform": lambda v, rng: float(
        math.exp(rng.uniform(math.log(v[0]), math.log(v[1])))
    ),
    "normal": lambda v, rng: float(rng.normal(v[0], v[1])),
    "integers": lambda v, rng: int(rng.integers(v[0], v[1], endpoint=True)),
    "choice": lambda v, rng: v[int(rng.integers(len(v)))],
}
KINDS: Final = tuple(k for k in _SAMPLERS if k != "fixed")
_PairRule: TypeAlias = tuple[Callable[[Any, Any], bool], str]
_ORDERED: Final[_PairRule] = (lambda low, high: low <= high, "the lower number first")
_PAIR_RULES: Final[Mapping[str, tuple[_PairRule, ...]]] = {
    "uniform": (_ORDERED,),
    "loguniform": ((lambda low, high: low > 0, "numbers above 0"), _ORDERED),
    "normal": ((lambda mean, sigma: sigma >= 0, "a mean and a standard deviation >= 0"),),
    "integers": (
        (
            lambda low, high: isinstance(low, int) and isinstance(high, int),
            "whole numbers",
        ),
        _ORDERED,
    ),
}
"""Kind that takes two numbers -> what must hold of them, and how an error says it."""


def _number(value: object) -> bool:
    """Return whether a value is a finite number, not a bool."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def parse(value: object) -> Draw:
    """Parse a draw from a value of TOML.

    A `Draw` is returned as it is. "choice" takes one or more texts, or one or more
    numbers, not both; every other kind takes two numbers: "normal" mean and standard
    deviation (0 or more), the others the lower one first, "loguniform" above 0 and
    "integers" whole ones.

    Args:
        value: a number, a text, or a table of one kind and its list.

    Raises:
        ValueError: another form, lists the allowed ones; or values that the kind does not
            take, says which it takes.
    """
    if isinstance(value, Draw):
        return value
    if isinstance(value, str) or _number(value):
        return Draw("fixed", (value,))  # type: ignore[arg-type]
    kind, given = _table(value)
    if kind == "choice":
        if not (all(isinstance(v, str) for v in given) or all(_number(v) for v in given)):
            raise ValueError(
                f"choice takes texts or numbers, not both or others: {given!r}"
            )
        return Draw(kind, tuple(given))
    if len(given) != 2 or not all(_number(v) for v in given):
        raise ValueError(f"{kind} takes two numbers, got {given!r}")
    for holds, taken in _PAIR_RULES[kind]:
        if not holds(*given):
            raise ValueError(f"{kind} takes {taken}, got {given!r}")
    return Draw(kind, tuple(given))


def _table(value: object) -> tuple[str, list[Any]]:
    """Split a table of one of `KINDS` into the kind and its list.

    Raises:
        ValueError: another form, or an empty list.
    """
    if (
        not isinstance(value, Mapping)
        or len(value) != 1
        or next(iter(value)) not in KINDS
    ):
        raise ValueError(
            f"got {value!r}; allowed: a value, or a table with one of {list(KINDS)}"
        )
    ((kind, given),) = value.items()
    if not isinstance(given, list) or not given:
        raise ValueError(f"{kind} takes a list, got {given!r}")
    return kind, given


def _numbers(value: object) -> Draw:
    """Parse a number or a distribution of numbers.

    Raises:
        ValueError: it is neither, or draws texts.
    """
    draw = parse(value)
    if any(isinstance(v, str) for v in draw.values):
        raise ValueError(f"a number is needed, got {draw.to_plain()!r}")
    return draw


def _positive(value: object) -> Draw:
    """Parse a number above 0, or a distribution of such; a normal one is never of such.

    Raises:
        ValueError: it is none.
    """
    draw = _numbers(value)
    if draw.lowest <= 0:
        if draw.kind == "normal":
            also = " (a normal distribution has them)"
        else:
            also = ""
        raise ValueError(f"values must be above 0{also}, got {draw.to_plain()!r}")
    return draw


def _counts(value: object) -> Draw:
    """Parse a whole number above 0, or a choice or interval of such.

    Raises:
        ValueError: it is none.
    """
    draw = _positive(value)
    if draw.kind not in ("fixed", "choice", "integers") or any(
        not isinstance(v, int) for v in draw.values
    ):
        raise ValueError(f"whole numbers are needed, got {draw.to_plain()!r}")
    return draw


def _names(value: object) -> Draw:
    """Parse a text, or a choice of texts.

    Raises:
        ValueError: it is neither.
    """
    draw = parse(value)
    if not all(isinstance(v, str) for v in draw.values):
        raise ValueError(
            f"a name or a choice of names is needed, got {draw.to_plain()!r}"
        )
    return draw


_plain = PlainSerializer(lambda draw: draw.to_plain())
_schema = WithJsonSchema({"description": "a value, or a table with one distribution"})

Number: TypeAlias = Annotated[Draw, BeforeValidator(_numbers), _plain, _schema]
Positive: TypeAlias = Annotated[Draw, BeforeValidator(_positive), _plain, _schema]
Count: TypeAlias = Annotated[Draw, BeforeValidator(_counts), _plain, _schema]
Name: TypeAlias = Annotated[Draw, BeforeValidator(_names), _plain, _schema]


class _Table(BaseModel):
    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
    )


def _fixed(value: float | str) -> Draw:
    return Draw("fixed", (value,))


class Batch(_Table):
    """Kind, number, seed and name of the batch's items."""

    name: Annotated[str, Len(1, 120)]
    kind: Literal["projections", "calibrations"]
    items: Annotated[int, Ge(1), Le(10_000_000)]
    seed: Annotated[int, Ge(0)] = Field(description="of everything that is drawn")
    shard: Annotated[int, Ge(1), Le(100_000)] = Field(
        default=1, description="items a file"
    )


class Cuboid(_Table):
    """A random bead cuboid."""

    width_mm: Positive
    breadth_mm: Positive
    height_mm: Positive
    beads: Count = Draw("fixed", (5,))
    bead_radius_mm: Positive = _fixed(2.0)
    body_material: Name = _fixed("abs")
    bead_material: Name = _fixed("steel")


class Spheres(_Table):
    """Spheres that do not touch, anywhere in a cylinder about the rotation axis."""

    count: Count
    radius_mm: Positive
    within_radius_mm: Annotated[float, Gt(0)]
    within_height_mm: Annotated[float, Gt(0)]
    material: Name = _fixed("pmma")


class PhantomTable(_Table):
    """The scanned phantom: one of three forms."""

    name: Name | None = Field(
        default=None, description="as `flexdt phantom list` has them"
    )
    cuboid: Cuboid | None = None
    spheres: Spheres | None = None

    @model_validator(mode="after")
    def _one(self) -> PhantomTable:
        """Check that exactly one of name, cuboid and spheres is given, and return the
        table.

        Raises:
            ValueError: none or several.
        """
        given = [k for k in ("name", "cuboid", "spheres") if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of name, cuboid, spheres; got {given or 'none'}")
        return self


class Geometry(_Table):
    """Nominal geometry: one turn (or a part of it) about the vertical."""

    sod_mm: Positive = _fixed(600.0)
    sdd_mm: Positive = _fixed(1059.0)
    height_mm: Number = Field(
        default=_fixed(0.0), description="of the sample above the beam"
    )
    lateral_mm: Number = Field(
        default=_fixed(0.0), description="of the axis from the beam"
    )
    frames: Annotated[int, Ge(1), Le(100_000)] = 36
    turn_deg: Annotated[float, Gt(0)] = 360.0
    start_deg: Number = _fixed(0.0)

    @model_validator(mode="after")
    def _order(self) -> Geometry:
        if self.sod_mm.highest >= self.sdd_mm.lowest:
            raise ValueError("sod_mm must stay below sdd_mm in every draw")
        return self


class Camera(_Table):
    """The machine's camera (mode and ROI), or a detector made up of shape and pitch."""

    machine: str = "flexray"
    mode: str | None = None
    roi: Annotated[list[int], Len(4, 4)] | None = Field(
        default=None, description="left, top, right, bottom; inclusive, unbinned"
    )
    shape: Annotated[list[Annotated[int, Ge(1), Le(10_000)]], Len(2, 2)] | None = Field(
        default=None, description="(rows, columns)"
    )
    pixel_mm: Annotated[float, Gt(0)] | None = None

    @model_validator(mode="after")
    def _either(self) -> Camera:
        """Check that shape and pixel_mm are given together, without mode and roi, or not
        at all; return the table.

        Raises:
            ValueError: a mixture.
        """
        if (self.shape is None) != (self.pixel_mm is None):
            raise ValueError("shape and pixel_mm go together")
        if self.shape is not None and (self.mode is not None or self.roi is not None):
            raise ValueError("give mode and roi, or shape and pixel_mm, not both")
        return self


class Images(_Table):
    """How images are made."""

    values: Literal["line_integrals", "counts"] = "line_integrals"
    physics: Literal["ideal", "mono", "poly"] = "ideal"
    noise: bool = True
    kV: Positive = _fixed(90.0)
    power_W: Positive = _fixed(50.0)
    exposure_ms: Positive = _fixed(100.0)
    averages: Annotated[int, Ge(1), Le(10_000)] = 1


class Reconstruct(_Table):
    """A volume of each item, by FDK."""

    voxel_mm: Annotated[float, Gt(0)]
    shape: Annotated[list[Annotated[int, Ge(1), Le(4096)]], Len(3, 3)] = Field(
        description="(z, y, x) voxels"
    )
    geometry: Literal["nominal", "true"] = Field(
        default="nominal", description="nominal shows the artefacts of the hidden errors"
    )
    window: str = "ram-lak"


class Calibrate(_Table):
    """How each calibration is done."""

    fidelity: Literal["points", "images"] = "points"
    free: Annotated[list[str], Len(1, len(NAMES))] = Field(
        default_factory=lambda: list(SIX)
    )
    priors: dict[str, Annotated[float, Ge(0)]] | Literal["none"] | None = Field(
        default=None,
        description="what is known of other parameters [mm, deg, 1], in place of what is assumed; "
        "none: all exactly",
    )
    noise_px: Positive = _fixed(NOISE_PX)
    counts: Positive = Field(
        default=_fixed(5000.0), description="open-beam photons a pixel, for images"
    )
    blur_px: Annotated[float, Ge(0)] = 0.7

    @model_validator(mode="after")
    def _known(self) -> Calibrate:
        """Check the names of free parameters, and the priors; return the table.

        Raises:
            ValueError: an unknown name (lists the allowed ones), or priors that do not
                fit.
        """
        wrong = [n for n in self.free if n not in NAMES]
        if wrong:
            raise ValueError(
                f"free: unknown parameters {wrong}; allowed: {', '.join(NAMES)}"
            )
        try:
            CalibrationRequest(free=tuple(self.free), priors=self.stated_priors)
        except TwinError as error:
            raise ValueError(f"priors: {error.message}") from None
        return self

    @property
    def stated_priors(self) -> Mapping[str, float]:
        """The priors that take the place of the assumed ones; 0 is exactly known."""
        if self.priors == "none":
            return exact(self.free)
        return self.priors or {}


class Plan(_Table):
    """A batch's plan."""

    batch: Batch
    phantom: PhantomTable
    geometry: Geometry = Field(default_factory=Geometry)
    camera: Camera = Field(default_factory=Camera)
    errors: dict[str, Number] = Field(
        default_factory=dict,
        description="hidden misalignment, true minus nominal [mm, deg]",
    )
    images: Images = Field(default_factory=Images)
    reconstruct: Reconstruct | None = None
    calibrate: Calibrate = Field(default_factory=Calibrate)

    @model_validator(mode="after")
    def _fits(self) -> Plan:
        """Check tables against each other, and return the plan.

        Errors must be of known parameters; calibrations have beads and no volumes;
        physics other than ideal needs the machine's panel; volumes need line integrals.

        Raises:
            ValueError: the first that does not hold.
        """
        wrong = [n for n in self.errors if n not in NAMES]
        if wrong:
            raise ValueError(
                f"errors: unknown parameters {wrong}; allowed: {', '.join(NAMES)}"
            )
        calibrations = self.batch.kind == "calibrations"
        if calibrations and self.reconstruct is not None:
            raise ValueError("reconstruct belongs to kind projections")
        if calibrations and self.phantom.spheres is not None:
            raise ValueError(
                "calibrations need beads: give phantom.name or phantom.cuboid"
            )
        if self.images.physics != "ideal" and self.camera.shape is not None:
            raise ValueError(
                f"images.physics {self.images.physics} models the machine's panel: give "
                "camera.mode and camera.roi instead of shape and pixel_mm"
            )
        if self.reconstruct is not None and self.images.values == "counts":
            raise ValueError("reconstruct needs images.values line_integrals")
        return self

    @property
    def text(self) -> str:
        """The plan with all defaults as canonical JSON: equal plans have equal texts."""
        return json.dumps(
            self.model_dump(mode="json"), sort_keys=True, separators=(",", ":")
        )

    @property
    def sha256(self) -> str:
        """Of `text`."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def parse_plan(document: dict[str, Any], name: str = "plan") -> Plan:
    """Validate a document and return its plan.

    Args:
        document: content of the TOML file.
        name: of the file, for messages.

    Raises:
        CommandError: lists every problem with its key path.
    """
    try:
        return Plan.model_validate(document)
    except ValidationError as error:
        raise CommandError(problems_of(name, error)) from None


def read_plan(path: Path) -> Plan:
    """Read a plan from a TOML file.

    Raises:
        CommandError: no TOML, or every problem with its key path.
        OSError: the file cannot be read.
    """
    return parse_plan(read_toml(path), str(path))
