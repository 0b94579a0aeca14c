"""Parameters of the viewer's own methods: one model each, as strict and bounded as the wire's.

Values that depend on the machine, the data directory or a plan are checked in the methods.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, Len
from pydantic import Field, model_validator

from flexdt.protocol.fields import (
    AxisName,
    Deviation,
    Exposure,
    Params,
    PixelAsked,
    Power,
    ShortText,
    Voltage,
    few,
)
from flexdt.protocol.methods.calibration_messages import CalibrationApply
from flexdt.protocol.methods.job_messages import ScriptText
from flexdt.twin.script.compose import Kind as KindOfScan

Kind = Literal["line_integral", "counts"]
View = Literal["iso", "beam", "side", "free"]
Form = Literal["html", "viser"]
"""Of an exported file: an HTML page by itself, or viser's own format."""
Grey = Annotated[float, Ge(-1e6), Le(1e6)]
Side = Annotated[int, Ge(16), Le(4096)]
FileName = Annotated[ShortText, Len(1, 255)]
Index = Annotated[int, Ge(0), Le(10**6)]


class Layers(Params):
    """Layers to show or hide on this page; omitted ones stay as they are."""

    beam: bool | None = None
    axis: bool | None = None
    panel: bool | None = None
    ranges: bool | None = None
    bodies: bool | None = None
    margin: bool | None = None
    sample: bool | None = None
    machine: bool | None = None
    orbit: bool | None = None
    gizmos: bool | None = None
    labels: bool | None = None
    names: bool | None = None
    cabinet: bool | None = None
    opacity: Annotated[float, Ge(0.05), Le(1)] | None = None


class Theme(Params):
    """Light or dark, and whether a graphics processor can afford `fine` lighting."""

    dark: bool = False
    fine: bool = False


class Camera(Params):
    """A view of the page, and whether to look at the sample from there."""

    view: View = "free"
    sample: bool = False


class Ray(Params):
    """A pixel of the live image to see the ray of; none: show it no longer."""

    pixel: PixelAsked | None = None


class Spectrum(Params):
    """A voltage of the tube."""

    kV: Annotated[float, Ge(0), Le(1000)]


class Feed(Params):
    """Which images a page wants."""

    kind: Kind


class Window(Params):
    """Grey values that are drawn black and white; both or none."""

    low: Grey | None = None
    high: Grey | None = None

    @model_validator(mode="after")
    def _both(self) -> Window:
        if (self.low is None) != (self.high is None):
            raise ValueError("give both low and high, or neither")
        if self.low is not None and self.high is not None and self.high <= self.low:
            raise ValueError("high must be above low")
        return self


class Plan(Params):
    """A script; none: forget the last one."""

    text: ScriptText | None = ""


class Recorded(Params):
    """A data set to show instead of live images; none: live images again."""

    name: FileName | None = None


class RecordedImage(Params):
    """An image of the data set that is looked at, and with it the virtual one of its pose."""

    index: Annotated[int, Ge(0), Le(10**7)]
    kind: Kind = "counts"
    virtual: bool = False


class Live(Params):
    """A data set to reconstruct while it is scanned, and voxels a side; none: no longer."""

    name: FileName | None = None
    side: Literal[128, 192, 256, 512] = 128
    past: bool = False
    """The whole volume of a scan that was made, not one that grows."""


class Block(Live):
    """Which of its volumes: the one that was asked for, its noise, a bound of its bias, its
    sample's truth, how far they are apart, or the one with the other geometry."""

    what: Literal["volume", "sigma", "bias_bound", "truth", "difference", "other"] = "volume"


class Voxel(Live):
    """A voxel of a volume, by its numbers along x, y and z."""

    at: Annotated[list[Index], Len(3, 3)]


class Compose(Params):
    """The scan to compose a script for."""

    kind: KindOfScan = "fly"
    frames: Annotated[int, Ge(1), Le(1_000_000)] = 73
    exposure_ms: Exposure = 100.0
    kV: Voltage | None = None
    power_W: Power | None = None
    voxel_um: Annotated[float, Ge(0.01), Le(1e6)] | None = None
    """Of the finest details at the axis; none: the distances stay."""
    keep: Annotated[list[AxisName], Len(0, 64)] = Field(default_factory=list)


class Datasets(Params):
    """Data sets to list: words that each has, and how many newer ones are left out."""

    search: Annotated[ShortText, Len(0, 200)] = ""
    start: Index = 0


class Correct(CalibrationApply):
    """A correction; on the wire an empty one is a nominal one, on a page it is a slip."""

    parameters: Annotated[dict[AxisName, Deviation], few(64), Len(1, 64)]


class Scrub(Params):
    """A moment of the plan; none: show it no longer."""

    time_s: Annotated[float, Ge(0), Le(1e9)] | None = None


class Screenshot(Params):
    """Which view, and how large the picture [px]."""

    view: View = "free"
    width: Side = 1600
    height: Side = 1000


class Export(Params):
    """The scene, or a replay of the plan."""

    format: Form = "html"
    replay: bool = False
