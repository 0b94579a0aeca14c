"""calibration.* and dataset.*: corrections, fits to data sets, past scans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal

from annotated_types import Ge, Le, Len, MaxLen, MinLen
from pydantic import Field, JsonValue

from flexdt.protocol import fields as f
from flexdt.protocol.field_checks import few
from flexdt.protocol.fields import ImageValue, Integral, Params, Result, Shape2, ShortText
from flexdt.protocol.method import command, read
from flexdt.protocol.state_model import Correction, SamplePlacement

DataSetName = Annotated[ShortText, Len(1, 255)]
ImageKind = Literal["dark", "flat", "projection"]
Parameters = Annotated[list[f.AxisName], MaxLen(17)]
FIT_LIMITS: Final[Mapping[str, float]] = {"seconds": 300, "memory_bytes": 6 << 30}
"""Limits of a calibration from images: time [s] and memory [bytes]."""


class DatasetList(Params):
    """Which data sets of the data directory to list."""

    search: Annotated[ShortText, MaxLen(200)] = ""
    """words; each occurs in name, sample, operator, date, state or a setting"""
    start: Annotated[int, Ge(0), Le(1_000_000), Integral] = 0
    """left out before"""
    count: Annotated[int, Ge(1), Le(200), Integral] = 50
    """listed at most"""
    thumbnail: Annotated[int, Ge(0), Le(256), Integral] = 0
    """longer side of a small image of each [pixels]; 0 for none"""


class DatasetGet(Params):
    """A data set, and the parts of its answer."""

    name: DataSetName
    """of its folder"""
    points: Annotated[int, Ge(2), Le(2000), Integral] = 400
    """largest number of images, evenly chosen, with their poses and times"""
    measure: bool = False
    """include their mean counts and clearances"""
    script: bool = False
    """include its script"""


class DatasetFrame(Params):
    """An image of a data set."""

    name: DataSetName
    """of its folder"""
    index: Annotated[int, Ge(0), Le(10_000_000), Integral]
    """of the image, in the order taken: dark and flat images count"""
    kind: Literal["line_integral", "counts"] = "counts"
    binning: Annotated[int, Ge(1), Le(64), Integral] = 1
    """mean over so many pixels a side"""


class DatasetInfo(Result):
    """Summary of a data set; unknown values are null."""

    name: str
    """of its folder"""
    modified: float
    """when its folder last changed [s since 1970]"""
    started: str | None = None
    duration_s: float | None = None
    """of the twin's clock"""
    state: Literal["complete", "incomplete", "running", "unknown"] = "unknown"
    reason: str = ""
    """why it is incomplete"""
    projections: int = 0
    """that it has, or should have"""
    present: int = 0
    """projections that are there"""
    machine: str | None = None
    sample: str = ""
    operator: str = ""
    kV: float | None = None
    power_W: float | None = None
    exposure_ms: float | None = None
    mode: str | None = None
    shape: Shape2 | None = None
    saturated: float | None = None
    """share of its projections' pixels that are saturated, as predicted"""
    problem: str = ""
    """why the rest is not known"""
    thumbnail: ImageValue | None = None
    """uint8, its projection in the middle, windowed"""


class DatasetListResult(Result):
    """Data sets, the newest first."""

    datasets: list[DatasetInfo]
    total: int
    """data sets that the search finds"""
    unread: int = 0
    """of those, not read yet for lack of time: repeat the request"""
    left_out: int = 0
    """older folders, and folders whose names no data set may have"""


class StatedValue(Result):
    """A value of a file that a data set was read from."""

    field: str
    """where it stands"""
    value: str
    use: Literal["used", "contradicted", "ignored"]
    consequence: str
    """what it is used for, or what its being left aside means"""


class ScannedSample(Result):
    """What stood on the stage during a scan, and the correction in force; compare it with
    the state."""

    sample: str
    """its name; empty for an empty stage, or where the data set does not say"""
    revision: str | None = None
    """of an upload, as in the state"""
    material: str | None = None
    offset: SamplePlacement | None = None
    """null where the data set does not say"""
    correction: str | None = None
    """name"""


class DatasetResult(Result):
    """A data set over time: lists have one entry for each image of `indices`."""

    info: DatasetInfo
    made: ScannedSample
    images: int
    """that it has, or should have, of all kinds"""
    indices: list[int]
    """of the images chosen, in the order taken"""
    files: list[str]
    kinds: list[ImageKind]
    present: list[bool]
    times_s: list[float] | None
    """on the scan's clock"""
    positions: dict[str, list[float | None]]
    """motor -> [mm, deg], script's sign; null where it is not known"""
    same_machine: bool
    """whether this twin has the same axes, parts and zeros"""
    counts: list[float | None] | None = None
    """mean of each image; null where it cannot be read"""
    clearance_mm: list[float | None] | None = None
    """of the nearest parts that may not touch"""
    clearance_of: str = ""
    """objects between which the clearances are"""
    script: str | None = None
    warnings: list[str] = Field(default_factory=list)
    """contradictions of its files and its geometry"""
    provenance: list[StatedValue] = Field(default_factory=list)
    """values of another program's file; none of flexdt's own scans"""


class DatasetFrameResult(ImageValue):
    """An image of a data set, as it was saved, and its nominal geometry."""

    name: str
    index: int
    file: str
    image: ImageKind
    projection: int | None = None
    """its number among the projections, as calibration.fit counts them"""
    kind: Literal["line_integral", "counts"]
    time_s: float | None = None
    exposure_ms: float | None = None
    positions: dict[str, float] | None = None
    cone_vec: list[float] | None = None
    """nominal, without a correction"""
    tube: dict[str, JsonValue] | None = None
    """for projection.get"""
    camera: dict[str, JsonValue] | None = None
    """for projection.get"""


DATASET_LIST = read(
    "dataset.list", DatasetList, DatasetListResult, "data sets, the newest first"
)
DATASET_GET = read(
    "dataset.get", DatasetGet, DatasetResult, "a data set: settings, poses over time"
)
DATASET_FRAME = read(
    "dataset.frame", DatasetFrame, DatasetFrameResult, "an image of a data set"
)


class CalibrationApply(f.Params):
    """A correction to put in force; it replaces the last."""

    parameters: Annotated[dict[f.AxisName, f.Deviation], MaxLen(64), few(64)]
    """name -> value [mm or deg], true minus nominal"""
    name: f.Name | None = None
    comment: f.Comment = ""
    source: f.ShortText | None = None
    sides_known: bool = False
    """found from beads of known places, which determine the direction of rotation"""


class CalibrationDelete(f.Params):
    """Which correction to delete."""

    name: f.Name
    """of a correction that is not in force"""


class CorrectionDeleted(f.Result):
    """The correction that is not known any more; data sets keep theirs."""

    name: str


class CalibrationGet(f.Params):
    """Which correction; the one in force if left out."""

    name: f.Name | None = None


class Mark(f.Params):
    """Where a bead was seen in a projection; pixel (0, 0) is the middle of the upper left
    one."""

    frame: Annotated[int, Ge(0), Le(10_000_000), Integral]
    """projection, counted from 0"""
    marker: f.AxisName
    """number of the bead in its phantom, counted from 0; any name of an unknown one"""
    column: f.Place
    row: f.Place
    sigma: Annotated[float, Ge(1e-3), Le(1e4)] | None = None
    """standard deviation of each [px]; 0.5 if left out"""


class CalibrationFit(f.Params):
    """Data sets of a bead phantom, and the parameters to estimate from them."""

    datasets: Annotated[list[DataSetName], Len(1, 8)]
    """of their folders"""
    phantom: f.Name
    """one that ships, a TOML or JSON file among the data sets, or unknown: markers in
    unknown places, in one data set"""
    free: Annotated[Parameters, MinLen(1)] | None = None
    """estimated parameters; default: dO_x, dO_y, dO_z, alpha, tau_*, of unknown markers dO_x"""
    priors: Annotated[dict[f.AxisName, f.NonNegative], MaxLen(37), few(37)] = Field(
        default_factory=dict
    )
    """name of an offset, told length or cause -> standard deviation [mm, deg or 1]; 0: exactly
    known, of a cause: excluded"""
    exclude: Annotated[list[f.AxisName], MaxLen(9)] = Field(default_factory=list)
    """causes of residuals that cannot be: gap, distortion, shape, beads, arc, rows, angles,
    motion, spots"""
    bead_tolerance: f.NonNegative | None = None
    """standard deviation of the beads' places [mm], which are estimated, too; 0: exact"""
    per_frame: Parameters = Field(default_factory=list)
    """parameters that may also move during the scan"""
    steps: Annotated[int, Ge(0), Le(50), Integral] = 0
    """include covariances after so many parts of the frames"""
    residuals: bool = False
    """include those of every bead in every frame"""
    tracks: bool = False
    """include measured bead positions, and those predicted before and after"""
    markers: Annotated[list[Mark], Len(1, 10_000)] | None = None
    """where beads were seen in the one data set; default: found there"""
    scale: Annotated[f.ShortText, MaxLen(300)] | None = None
    """distance of two unknown markers [mm]: A-B=MM or A-B=MM+-SIGMA"""


class CalibrationAlign(f.Params):
    """A scan of anything over a full turn."""

    name: DataSetName
    """of its folder"""
    per_frame: bool = False
    """look for shifts of single frames too"""


class CorrectionResult(f.Result):
    """The correction in force (or the requested one), if there is one.

    Warnings: parts that its geometry brings within the safety margin at the present pose.
    """

    correction: Correction | None
    warnings: list[str] = Field(default_factory=list)


class Estimated(f.Result):
    """An estimate [mm, deg, px or 1]; None where the images do not determine it or must not be
    trusted."""

    value: float | None
    sigma: float | None
    unit: str


class CalibrationStep(f.Result):
    """Uncertainty of a fit to the first frames alone."""

    frames: int
    covariance: list[list[float]] | None
    """[mm, deg], in the order of `parameters`; None: not all are determined"""


class CalibrationProblem(f.Result):
    """Something about the data; an error forbids the numbers."""

    code: str
    severity: Literal["error", "warning"]
    text: str


class CalibrationFitResult(f.Result):
    """A calibration; nothing is applied. Further fields are those of `flexdt calibrate
    --json`."""

    identifiable: bool
    parameters: dict[str, Estimated]
    correction: dict[str, float] | None = None
    """for calibration.apply"""
    covariance: list[list[float | None]] = Field(default_factory=list)
    rms_px: float | None
    rms_per_bead_px: list[float | None] = Field(default_factory=list)
    residuals_px: list[list[f.Pair | None]] | None = None
    """of each frame and bead: measured minus predicted column and row"""
    steps: list[CalibrationStep] = Field(default_factory=list)
    tracks: dict[str, JsonValue] | None = None
    """as `flexdt calibrate --tracks` writes them"""
    problems: list[CalibrationProblem]


class CalibrationAlignResult(f.Result):
    """The geometry that an ordinary scan determines; nothing is applied."""

    identifiable: bool
    parameters: dict[str, Estimated]
    refused: dict[str, str]
    """parameters that such a scan cannot determine, and why"""
    warnings: list[str]
    correction: dict[str, float] | None = None
    """for calibration.apply"""
    motion: list[dict[str, JsonValue]] | None = None
    """shifts of single frames, as in `flexdt align --json`"""


class CorrectionListResult(f.Result):
    """All corrections, oldest first, and which one is in force."""

    corrections: list[Correction]
    current: str | None = None


CALIBRATION_APPLY = command(
    "calibration.apply", CalibrationApply, CorrectionResult, "put a correction in force"
)
CALIBRATION_GET = read(
    "calibration.get", CalibrationGet, CorrectionResult, "the correction in force"
)
CALIBRATION_LIST = read(
    "calibration.list", f.Empty, CorrectionListResult, "all corrections"
)
CALIBRATION_REVERT = command(
    "calibration.revert", f.Empty, CorrectionResult, "back to the correction before"
)
CALIBRATION_DELETE = command(
    "calibration.delete",
    CalibrationDelete,
    CorrectionDeleted,
    "delete a correction that is not in force",
)
CALIBRATION_FIT = read(
    "calibration.fit",
    CalibrationFit,
    CalibrationFitResult,
    "calibrate from data sets",
    limits=FIT_LIMITS,
)
CALIBRATION_ALIGN = read(
    "calibration.align",
    CalibrationAlign,
    CalibrationAlignResult,
    "align without beads",
    limits=FIT_LIMITS,
)
