"""projection.*, geometry.get and exposure.predict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal

from annotated_types import Ge, Le, MaxLen
from pydantic import Field

from flexdt.protocol import fields as f
from flexdt.protocol.method import read
from flexdt.protocol.methods.document_messages import Averages, Frames
from flexdt.protocol.methods.scanner_messages import CameraSet, TubeSet
from flexdt.protocol.state_model import GeometryResult, ImageFlags, SamplePlacement

LayerText = Annotated[f.ShortText, MaxLen(100)]
ScanKind = Literal["fly", "step", "tiled", "helical", "calibration"]
PREDICTION_LIMITS: Final[Mapping[str, float]] = {"seconds": 60, "memory_bytes": 4 << 30}
"""Limits of a prediction of image quality: time [s] and memory [bytes]."""


class ProjectionGet(f.Params):
    """Kind of image, at the current pose and settings, or at other ones.

    An image at other ones is predicted: from the geometry of `geometry.get`, without noise.
    """

    kind: Literal["line_integral", "counts"] = "line_integral"
    binning: Annotated[int, Ge(1), Le(32), f.Integral] = 1
    """mean over so many pixels a side, beyond the camera's mode"""
    marks: bool = False
    """include which pixels are saturated, starved or cut off"""
    positions: f.Targets | None = None
    """motor -> [mm, deg] there, within its travel; others stay"""
    tube: TubeSet | None = None
    """as though set so"""
    camera: CameraSet | None = None
    """as though set so"""


class RayGet(f.Params):
    """A pixel of the image of this moment."""

    pixel: f.PixelAsked
    """(column, row); (0, 0) is the center of the top left one"""


class ExposurePredict(f.Params):
    """A scan to predict; missing parameters are the present ones."""

    sample: f.Name | None = None
    """default: the one on the stage"""
    kV: f.Voltage | None = None
    power_W: f.Power | None = None
    filter: LayerText = ""
    """MATERIAL:MM beside the machine's own"""
    exposure_ms: f.Exposure | None = None
    averages: Averages | None = None
    mode: f.ShortText | None = None
    roi: f.RoiAsked | None = None
    frames: Frames = 361
    """of the scan, or of each of its turns"""
    kind: ScanKind | None = None
    """of a script, of which time and bytes are then; default: images"""
    sod_mm: f.Distance | None = None
    """default: the present one"""
    sdd_mm: f.Distance | None = None
    """default: the present one"""
    detail: LayerText = "void:0.5"
    """MATERIAL:MM or void:MM on the darkest ray, to be seen"""


class ImageOrigin(f.Result):
    """Sample and settings of an image; compare them with the state."""

    sample: str | None
    """name of the sample in it; null for an empty stage"""
    revision: str | None = None
    """of an upload, as in the state"""
    material: str | None = None
    offset: SamplePlacement
    lit: bool
    """whether X-rays were on and ready"""
    kV: float
    power_W: float
    mode: str
    exposure_ms: float
    averages: int
    roi: f.Roi
    correction: str | None = None
    """name of the one that its geometry has"""
    dataset: str | None = None
    """of a running scan's image: its data set"""
    index: int | None = None
    """and its number there, as in dataset.frame"""
    file: str | None = None
    """and its file there"""


class Projection(f.ImageValue):
    """An image and the geometry it was made with (nominal plus correction)."""

    cone_vec: list[float] = Field(min_length=12, max_length=12)
    kind: Literal["line_integral", "counts"] = "line_integral"
    time: float | None = None
    """of the pose, on the twin's clock [s]"""
    flags: ImageFlags | None = None
    origin: ImageOrigin | None = None
    """its sample and settings"""
    marks: f.ImageValue | None = None
    """uint8, as large as the image, on request: sum of 1 saturated, 2 starved, 4 sample
    cut off at this pixel of the edge; judged as though X-rays were on"""
    warnings: list[str] | None = None
    """of positions beyond the travel that were set to the limit"""


class RayResult(f.Result):
    """Materials on the ray of a pixel, in the geometry of geometry.get."""

    paths_mm: dict[str, float]
    """material -> path through it"""


class TransmissionShares(f.Result):
    """How much of the open beam the pixels see, in a few views of a turn."""

    least: float
    p1: float
    """1 % of the pixels see less"""
    p5: float
    median: float
    edges: list[float]
    """of the bins; the last one has no upper edge"""
    shares: list[float]
    """of the pixels in each bin"""


class PredictedSetting(f.Result):
    """Settings of tube and camera, and the contrast on the darkest ray."""

    kV: float
    filter: str
    exposure_ms: float
    averages: int
    cnr: float | None
    """contrast of the detail to the noise of a pixel of one image; null where it is
    saturated"""
    kerma_mGy: float
    """air kerma of the scan on the axis, without a sample"""


class ExposurePrediction(f.Result):
    """Predicted image quality of a circular scan, without scattered radiation."""

    sample: str
    transmission: TransmissionShares
    saturated: float = Field(ge=0, le=1)
    """part of the pixels"""
    starved: float = Field(ge=0, le=1)
    """part of the pixels"""
    detail: str
    asked: PredictedSetting
    best: list[PredictedSetting]
    """of the same power and time, the best first"""
    frames: int
    seconds: float
    """that the frames take at least; of a kind, all of the scan"""
    bytes: int
    """of the frames; of a kind, with dark and flat images"""
    assumed: list[str]
    """assumptions about the sample"""


PROJECTION_GET = read(
    "projection.get",
    ProjectionGet,
    Projection,
    "an image at the current pose, or another",
)
PROJECTION_RAY = read(
    "projection.ray", RayGet, RayResult, "paths through materials on the ray of a pixel"
)
GEOMETRY_GET = read(
    "geometry.get", f.Empty, GeometryResult, "cone_vec, detector shape and pixel pitch"
)
EXPOSURE_PREDICT = read(
    "exposure.predict",
    ExposurePredict,
    ExposurePrediction,
    "transmission, contrast to noise and dose of a scan",
    limits=PREDICTION_LIMITS,
)
