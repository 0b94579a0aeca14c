"""The plan of a batch: a TOML file as validated, frozen values; errors name key path and value.

The manifest holds the plan with every default written out, so no result depends on a hidden one.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Len
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from flexdt.extending import CommandError
from flexdt.twin.calibration import SIX
from flexdt.twin.geometry.offsets import NAMES
from flexdt_extensions.batch.draws import Count, Draw, Name, Number, Positive
from flexdt_extensions.toml_files import problems_of, read_toml


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False,
                              arbitrary_types_allowed=True)  # fmt: skip


def _fixed(value: float | str) -> Draw:
    return Draw("fixed", (value,))


class Batch(_Table):
    """What to make, and how many."""

    name: Annotated[str, Len(1, 120)]
    kind: Literal["projections", "calibrations"]
    items: Annotated[int, Ge(1), Le(10_000_000)]
    seed: Annotated[int, Ge(0)] = Field(description="of everything that is drawn")
    shard: Annotated[int, Ge(1), Le(100_000)] = Field(default=1, description="items a file")


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
    """What is scanned: one of three."""

    name: Name | None = Field(default=None, description="as `flexdt phantom list` has them")
    cuboid: Cuboid | None = None
    spheres: Spheres | None = None

    @model_validator(mode="after")
    def _one(self) -> PhantomTable:
        given = [k for k in ("name", "cuboid", "spheres") if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of name, cuboid, spheres; got {given or 'none'}")
        return self


class Geometry(_Table):
    """Nominal geometry: one turn (or a part of it) about the vertical."""

    sod_mm: Positive = _fixed(600.0)
    sdd_mm: Positive = _fixed(1059.0)
    height_mm: Number = Field(default=_fixed(0.0), description="of the sample above the beam")
    lateral_mm: Number = Field(default=_fixed(0.0), description="of the axis from the beam")
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
    free: Annotated[list[str], Len(1, len(NAMES))] = Field(default_factory=lambda: list(SIX))
    noise_px: Positive = _fixed(0.1)
    counts: Positive = Field(
        default=_fixed(5000.0), description="open-beam photons a pixel, for images"
    )
    blur_px: Annotated[float, Ge(0)] = 0.7

    @model_validator(mode="after")
    def _known(self) -> Calibrate:
        wrong = [n for n in self.free if n not in NAMES]
        if wrong:
            raise ValueError(f"free: unknown parameters {wrong}; allowed: {', '.join(NAMES)}")
        return self


class Plan(_Table):
    """A batch's plan."""

    batch: Batch
    phantom: PhantomTable
    geometry: Geometry = Field(default_factory=Geometry)
    camera: Camera = Field(default_factory=Camera)
    errors: dict[str, Number] = Field(
        default_factory=dict, description="hidden misalignment, true minus nominal [mm, deg]"
    )
    images: Images = Field(default_factory=Images)
    reconstruct: Reconstruct | None = None
    calibrate: Calibrate = Field(default_factory=Calibrate)

    @model_validator(mode="after")
    def _fits(self) -> Plan:
        wrong = [n for n in self.errors if n not in NAMES]
        if wrong:
            raise ValueError(f"errors: unknown parameters {wrong}; allowed: {', '.join(NAMES)}")
        calibrations = self.batch.kind == "calibrations"
        if calibrations and self.reconstruct is not None:
            raise ValueError("reconstruct belongs to kind projections")
        if calibrations and self.phantom.spheres is not None:
            raise ValueError("calibrations need beads: give phantom.name or phantom.cuboid")
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
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))

    @property
    def sha256(self) -> str:
        """Of `text`."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def parse_plan(document: dict[str, Any], name: str = "plan") -> Plan:
    """A plan from a document.

    Raises:
        CommandError: every problem with its key path.
    """
    try:
        return Plan.model_validate(document)
    except ValidationError as error:
        raise CommandError(problems_of(name, error)) from None


def read_plan(path: Path) -> Plan:
    """A plan from a TOML file.

    Raises:
        CommandError: no TOML, or every problem with its key path.
        OSError: the file cannot be read.
    """
    return parse_plan(read_toml(path), str(path))
