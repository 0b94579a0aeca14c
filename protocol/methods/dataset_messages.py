"""dataset.*: past scans."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, Len, MaxLen
from pydantic import Field, JsonValue

from flexdt.protocol.fields import ImageValue, Params, Result, Shape2, ShortText
from flexdt.protocol.method import read

DataSetName = Annotated[ShortText, Len(1, 255)]


class DatasetList(Params):
    """Which data sets of the data directory to list."""

    search: Annotated[ShortText, MaxLen(200)] = Field(
        default="",
        description="words; each occurs in name, sample, operator, date, state or a setting",
    )
    start: Annotated[int, Ge(0), Le(1_000_000)] = Field(default=0, description="left out before")
    count: Annotated[int, Ge(1), Le(200)] = Field(default=50, description="listed at most")
    thumbnail: Annotated[int, Ge(0), Le(256)] = Field(
        default=0, description="longer side of a small image of each [pixels]; 0 for none"
    )


class DatasetGet(Params):
    """A data set, and what to say of it."""

    name: DataSetName = Field(description="of its folder")
    points: Annotated[int, Ge(2), Le(2000)] = Field(
        default=400, description="images at most, evenly chosen, of which poses and times are told"
    )
    measure: bool = Field(default=False, description="tell their mean counts and clearances, too")
    script: bool = Field(default=False, description="tell its script, too")


class DatasetFrame(Params):
    """An image of a data set."""

    name: DataSetName = Field(description="of its folder")
    index: Annotated[int, Ge(0), Le(10_000_000)] = Field(
        description="of the image, in the order taken: dark and flat images count"
    )
    kind: Literal["line_integral", "counts"] = "counts"
    binning: Annotated[int, Ge(1), Le(64)] = Field(
        default=1, description="mean over so many pixels a side"
    )


ImageKind = Literal["dark", "flat", "projection"]


class DatasetInfo(Result):
    """A data set in a few words; what is not known of it is null."""

    name: str = Field(description="of its folder")
    modified: float = Field(description="when its folder last changed [s since 1970]")
    started: str | None = None
    duration_s: float | None = Field(default=None, description="of the twin's clock")
    state: Literal["complete", "incomplete", "running", "unknown"] = "unknown"
    reason: str = Field(default="", description="why it is incomplete")
    projections: int = Field(default=0, description="that it has, or should have")
    present: int = Field(default=0, description="projections that are there")
    machine: str | None = None
    sample: str = ""
    operator: str = ""
    kV: float | None = None
    power_W: float | None = None
    exposure_ms: float | None = None
    mode: str | None = None
    shape: Shape2 | None = None
    problem: str = Field(default="", description="why the rest is not known")
    thumbnail: ImageValue | None = Field(
        default=None, description="uint8, its projection in the middle, windowed"
    )


class DatasetListResult(Result):
    """Data sets, the newest first."""

    datasets: list[DatasetInfo]
    total: int = Field(description="data sets that the search finds")
    unread: int = Field(default=0, description="of those, not read yet for lack of time: ask again")
    left_out: int = Field(
        default=0, description="older folders, and folders whose names no data set may have"
    )


class DatasetResult(Result):
    """A data set over time: lists have one entry for each image of `indices`."""

    info: DatasetInfo
    images: int = Field(description="that it has, or should have, of all kinds")
    indices: list[int] = Field(description="of the images chosen, in the order taken")
    files: list[str]
    kinds: list[ImageKind]
    present: list[bool]
    times_s: list[float] | None = Field(description="on the scan's clock")
    positions: dict[str, list[float | None]] = Field(
        description="motor -> [mm, deg], script's sign; null where it is not known"
    )
    same_machine: bool = Field(description="whether this twin has the same axes, parts and zeros")
    counts: list[float | None] | None = Field(
        default=None, description="mean of each image; null where it cannot be read"
    )
    clearance_mm: list[float | None] | None = Field(
        default=None, description="of the nearest parts that may not touch"
    )
    clearance_of: str = Field(default="", description="what the clearances are of")
    script: str | None = None


class DatasetFrameResult(ImageValue):
    """An image of a data set, as it was saved, and its nominal geometry."""

    name: str
    index: int
    file: str
    image: ImageKind
    projection: int | None = Field(
        default=None, description="its number among the projections, as calibration.fit counts them"
    )
    kind: Literal["line_integral", "counts"]
    time_s: float | None = None
    exposure_ms: float | None = None
    positions: dict[str, float] | None = None
    cone_vec: list[float] | None = Field(default=None, description="nominal, without a correction")
    tube: dict[str, JsonValue] | None = Field(default=None, description="for projection.get")
    camera: dict[str, JsonValue] | None = Field(default=None, description="for projection.get")


DATASET_LIST = read("dataset.list", DatasetList, DatasetListResult, "data sets, the newest first")
DATASET_GET = read("dataset.get", DatasetGet, DatasetResult,
                   "a data set: settings, poses over time")  # fmt: skip
DATASET_FRAME = read("dataset.frame", DatasetFrame, DatasetFrameResult, "an image of a data set")
