"""A scan's request and start conditions, kept in DATA/jobs so that it can be resumed.

One JSON file a data set that is not complete: the source (script byte for byte, or poses), the
scanner's state at the start, sample, seed, pace. With it any later server makes exactly the
missing images.

Poses of a trajectory are kept as text: 200 000 of them are two strings and no million objects.
"""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Final

from pydantic import Field, TypeAdapter

from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import (
    Changes,
    file_stem,
    read_json,
    read_or_set_aside,
)
from flexdt.runtime.log import log
from flexdt.server.scans.twin_clock import SpeedUp, check_speed_up
from flexdt.server.storage.job_files import RECORDS
from flexdt.twin.dataset.dataset_errors import DatasetWriteError
from flexdt.twin.physics.predicted_beam import Physics
from flexdt.twin.physics.scatter import Scatter
from flexdt.twin.rays_a_pixel import Rays
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import StartState

Poses = list[dict[str, float]]
FOLDER = RECORDS
SCHEMA = 2
MAX_MOMENTS = 64
_EXPOSURE: TypeAdapter[float | None] = TypeAdapter(float | None)
_FLAT: TypeAdapter[bool | dict[str, float]] = TypeAdapter(bool | dict[str, float])


@dataclass(frozen=True)
class PoseList:
    """Poses, each axis -> value [mm or deg].

    Attributes:
        text: JSON, one pose after the other; equal poses have equal texts.
        listing: their comment lines in a data set's script, one each.
    """

    text: bytes
    listing: bytes = field(compare=False, repr=False)

    @classmethod
    def of(cls, poses: Iterable[Mapping[str, float]]) -> PoseList:
        """Make the list from poses: one JSON text, and a listing with a comment line for each."""
        each = [json.dumps(dict(p)) for p in poses]
        listing = "\r\n".join([*(f"# pose {i}: {p}" for i, p in enumerate(each)), ""])
        return cls(f"[{', '.join(each)}]".encode(), listing.encode())

    def decoded(self) -> Poses:
        """Return the poses as lists and dictionaries."""
        poses: Poses = json.loads(self.text)
        return poses


@dataclass(frozen=True)
class ScanSource:
    """A requested scan: a script's bytes, or poses.

    Attributes:
        script: byte for byte, for a script; for poses a text that lists them.
        poses: for a trajectory.
        exposure_ms: of a trajectory's images.
        flat: of a trajectory, as `plan_poses` takes it.
        moments: poses averaged within the exposure of an image taken in motion.
        seed: of the noise; None for a fresh one.
    """

    script: bytes
    poses: PoseList | None = None
    exposure_ms: float | None = None
    moments: int = 1
    seed: int | None = None
    flat: bool | Mapping[str, float] = True

    @classmethod
    def of_poses(
        cls,
        poses: PoseList | Iterable[Mapping[str, float]],
        exposure_ms: float | None,
        moments: int = 1,
        seed: int | None = None,
        flat: bool | Mapping[str, float] = True,
    ) -> ScanSource:
        """Make a scan from a trajectory; its script is a comment on it, and one a pose.

        `poses`: axis -> [mm, deg]; `exposure_ms`: None: the camera's; `moments` averaged
        in an exposure; `flat`: taken, or their pose.
        """
        if not isinstance(poses, PoseList):
            poses = PoseList.of(poses)
        head = f"# trajectory, exposure_ms {exposure_ms}, flat {json.dumps(flat)}\r\n".encode()
        return cls(head + poses.listing, poses, exposure_ms, moments, seed, flat)


@dataclass(frozen=True)
class StartConditions:
    """Conditions at a scan's start, kept so that it can be resumed.

    Attributes:
        rays: along each side of a pixel that an edge reaches; 1 in records of older
            servers.
        revision: content of the sample's upload at that time; None for a shipped phantom,
            and in records of older servers.
    """

    start: StartState
    sample: Sample
    seed: Annotated[int, Field(ge=0, lt=2**63, strict=True)] | None
    moments: Annotated[int, Field(ge=1, le=MAX_MOMENTS, strict=True)]
    physics: Physics = "ideal"
    scatter: Scatter = "off"
    rays: Rays = 1
    revision: str | None = None


BEGINNING: Final = TypeAdapter(StartConditions)
"""Reads the `asdict` form of start conditions; raises ValueError for another form."""


@dataclass(frozen=True)
class JobRecord:
    """The data kept with a data set.

    Attributes:
        source: the requested scan.
        begin: conditions at its start.
        speed_up: the job's; None for the clock's.
        operator: the program that submitted it.
    """

    source: ScanSource
    begin: StartConditions
    speed_up: SpeedUp | None = None
    operator: str = ""

    def write(self, root: Directory, name: str) -> None:
        """Keep it for the data set `name`. Raises DatasetWriteError: the system refuses."""
        with Changes() as changes:
            self.keep(changes, root, name)

    def keep(self, changes: Changes, root: Directory, name: str) -> None:
        """Add the record, as JSON for the data set `name`, to changes that are written
        together.

        The file is in `FOLDER`, named after the data set. Poses are in it, but not their
        `listing`.

        Args:
            changes: files written as one.
            root: data directory.
            name: of the data set.
        """
        source = self.source
        document = {
            "schema": SCHEMA,
            **asdict(self.begin),
            "wish": {
                "script": base64.b64encode(source.script).decode("ascii"),
                "poses": None
                if source.poses is None
                else source.poses.text.decode("ascii"),
                "exposure_ms": source.exposure_ms,
                "flat": source.flat,
            },
            "speed_up": self.speed_up,
            "operator": self.operator,
        }
        changes.put_json(root.folder(FOLDER), f"{file_stem(name)}.json", document)

    @staticmethod
    def remove(root: Directory, name: str) -> None:
        """Delete the record of a complete data set, which is not resumed.

        A missing record is no error. A failure is logged as a warning, as a file that
        stays is harmless.
        """
        try:
            root.folder(FOLDER).discard(f"{file_stem(name)}.json")
        except DatasetWriteError as error:
            log(
                "the record of a complete scan was not deleted",
                logging.WARNING,
                reason=str(error),
            )

    @staticmethod
    def forget(changes: Changes, root: Directory, names: Sequence[str]) -> None:
        """Delete those of data sets, among other changes. Raises DatasetWriteError: the system
        refuses."""
        files = [f"{file_stem(name)}.json" for name in names]
        changes.remove(root.folder(FOLDER), *files)

    @classmethod
    def read(cls, root: Directory, name: str) -> JobRecord:
        """Read the record of the data set `name`; a damaged one is renamed and logged.

        Raises:
            FileNotFoundError: there is no record, or a damaged one.
            OSError: it cannot be read.
        """
        file = f"{file_stem(name)}.json"
        without = "what a scan started from cannot be read; it cannot be resumed"
        found = read_or_set_aside(root.folder(FOLDER), file, cls._of, without)
        if found is None:
            raise FileNotFoundError(f"{file} is not there, or was damaged")
        return found

    @classmethod
    def _of(cls, data: bytes) -> JobRecord:
        """Decode a record from the bytes of its file, also of earlier servers.

        A record without `flat` has no flats.

        Raises:
            ValueError, KeyError, TypeError: another schema, or fields that are missing or
                wrong.
        """
        document: Any = read_json(data)
        if document["schema"] != SCHEMA:
            raise ValueError(f"it has schema {document['schema']}, not {SCHEMA}")
        begin = BEGINNING.validate_python(document)
        source = document["wish"]
        speed_up = document["speed_up"]
        poses = source["poses"]
        if isinstance(poses, list):  # as servers before wrote it
            poses = json.dumps(poses)
        return cls(
            ScanSource(
                base64.b64decode(source["script"], validate=True),
                None if poses is None else PoseList(poses.encode("ascii"), b""),
                _EXPOSURE.validate_python(source["exposure_ms"]),
                begin.moments,
                begin.seed,
                _FLAT.validate_python(
                    source.get("flat", False)
                ),  # servers before took none
            ),
            begin,
            None if speed_up is None else check_speed_up(speed_up),
            str(document["operator"]),
        )
