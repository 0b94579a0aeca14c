"""`flexdt.json`: everything the scanner's own texts cannot express, as one versioned document.

It holds machine and profile in full, nominal cone_vec, motor positions and time of every frame, the
correction in force, the noise's seed and completeness. Geometry is the uncorrected nominal one;
there is no field for a hidden misalignment. Reading checks the version, types, names and lengths,
and an error names the place.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from flexdt.twin.dataset.dataset_errors import (
    DOCUMENT,
    DatasetFormatError,
    DatasetNameError,
    plain_name,
)
from flexdt.twin.dataset.record import FrameBlock, FrameKind, NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine import kinematics
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.scanner.state import NamedCorrection
from flexdt.twin.values import message_of

SCHEMA: Final = 1
_M = TypeVar("_M", bound=BaseModel)


def _plain(name: str) -> str:
    try:
        return plain_name(name)
    except DatasetNameError as error:
        raise ValueError(error.message) from None


PlainName = Annotated[str, AfterValidator(_plain)]
Row = Annotated[list[float], Field(min_length=12, max_length=12)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class FrameEntry(_Model):
    """One image, taken or still to be taken."""

    file: PlainName
    kind: Literal["dark", "flat", "projection"]
    time_s: float
    """Nominal moment on the scan's clock [s]."""
    exposure_ms: float
    averages: int
    mode: str
    roi: tuple[int, int, int, int]
    xrays_on: bool
    positions: dict[str, float]
    """Motor -> position [mm, deg], script's sign."""
    cone_vec: Row
    """Nominal, uncorrected: source, detector centre, u, v in the object's frame [mm]."""


class DetectorEntry(_Model):
    """The projections' image format."""

    rows: int = Field(gt=0)
    cols: int = Field(gt=0)
    pixel_mm: float = Field(gt=0)
    bits: int
    mode: str
    roi: tuple[int, int, int, int]
    exposure_ms: float
    averages: int


class TubeEntry(_Model):
    """The projections' tube settings."""

    kV: float
    power_W: float


class CorrectionEntry(_Model):
    """The correction in force during the scan; parameters in mm and deg."""

    name: str
    date: str
    note: str = ""
    parameters: dict[str, float]

    @classmethod
    def of(cls, correction: NamedCorrection | None) -> CorrectionEntry | None:
        """The entry of a correction."""
        c = correction
        if c is None:
            return None
        return cls(name=c.name, date=c.date, note=c.note, parameters=c.parameters.to_edge())


class DatasetDocument(_Model):
    """The content of `flexdt.json`."""

    schema_version: Literal[1] = Field(alias="schema")
    flexdt: str = ""
    """Version of the software that wrote it."""
    name: str
    started: datetime
    duration_s: float
    operator: str = ""
    smooth: bool = True
    complete: bool = False
    reason: str = ""
    """Why it is not complete."""
    machine: dict[str, Any]
    profile: dict[str, Any]
    tube: TubeEntry
    detector: DetectorEntry
    sample: SampleRecord = Field(default_factory=SampleRecord)
    noise: NoiseRecord = Field(default_factory=NoiseRecord)
    correction: CorrectionEntry | None = None
    settings_positions: dict[str, float] = Field(default_factory=dict)
    """Motor -> position when the settings texts were written [mm, deg], script's sign."""
    frames: list[FrameEntry]

    @classmethod
    def of(cls, record: ScanRecord) -> DatasetDocument:
        """The document of a scan."""
        camera = record.camera
        rows, cols = camera.shape
        return cls(
            schema=SCHEMA,
            flexdt=record.version,
            name=record.name,
            started=record.started,
            duration_s=record.duration_s,
            operator=record.operator,
            smooth=record.smooth,
            complete=record.complete,
            reason=record.reason,
            machine=record.machine.model_dump(mode="json", by_alias=True),
            profile=record.profile.model_dump(mode="json"),
            tube=TubeEntry(kV=record.kV, power_W=record.power_W),
            detector=DetectorEntry(
                rows=rows,
                cols=cols,
                pixel_mm=camera.pixel_mm(record.machine.detector.pixels),
                bits=record.machine.detector.bits,
                **camera.of_image,
            ),
            sample=record.sample,
            noise=record.noise,
            correction=CorrectionEntry.of(record.correction),
            settings_positions=dict(record.positions),
            frames=[entry for block in record.blocks for entry in _entries(record, block)],
        )

    def to_json(self) -> str:
        """As text: one line for each frame, so that people and diffs can read it."""
        head = self.model_dump(mode="json", by_alias=True, exclude={"frames"})
        text = json.dumps(head, indent=1, ensure_ascii=False)
        lines = [json.dumps(f.model_dump(mode="json"), ensure_ascii=False) for f in self.frames]
        frames = ",\n  ".join(lines)
        return f'{text[:-2]},\n "frames": [\n  {frames}\n ]\n}}\n'

    def cone_vec(self, kind: FrameKind | None = "projection") -> ConeVec:
        """Nominal geometry of the frames of one kind, or of all."""
        rows = [f.cone_vec for f in self.frames if kind is None or f.kind == kind]
        return ConeVec(np.array(rows, dtype=np.float64).reshape(-1, 12))

    def positions(self, kind: FrameKind = "projection") -> dict[str, FloatArray]:
        """Motor -> (n,) positions of the frames of one kind [mm, deg]."""
        chosen = [f.positions for f in self.frames if f.kind == kind]
        return {n: np.array([p[n] for p in chosen]) for n in (chosen[0] if chosen else {})}

    def files(self, kind: FrameKind) -> tuple[str, ...]:
        """File names of one kind, in the order taken."""
        return tuple(f.file for f in self.frames if f.kind == kind)

    def shapes(self, kind: FrameKind = "projection") -> list[tuple[int, int]]:
        """Image (rows, cols) of each frame of one kind.

        Raises:
            LimitError: a camera mode that is none.
        """
        return [self.shape_of(f) for f in self.frames if f.kind == kind]

    def shape_of(self, frame: FrameEntry) -> tuple[int, int]:
        """Image (rows, cols) of one frame; raises as `shapes`."""
        return _camera(frame, self._modes).shape

    @property
    def _modes(self) -> tuple[tuple[str, int], ...]:
        detector = self.machine.get("detector")
        named = detector.get("modes") if isinstance(detector, dict) else None
        return tuple(named.items()) if isinstance(named, dict) else ()

    def poses(self, machine: Machine, profile: Profile, kind: FrameKind = "projection") -> Poses:
        """Nominal poses of the frames of one kind, from their motor positions.

        Raises:
            TwinError: a motor that `machine` does not have, a camera mode that is none.
        """
        chosen = [f for f in self.frames if f.kind == kind]
        parts = []
        for (mode, roi), run in itertools.groupby(chosen, lambda f: (f.mode, f.roi)):
            group = list(run)
            names = group[0].positions
            if any(f.positions.keys() != names.keys() for f in group):
                raise DatasetFormatError("frames do not name the same motors")
            positions = {n: np.array([f.positions[n] for f in group]) for n in names}
            camera = CameraSettings(mode, Roi(*roi), modes=self._modes)
            parts.append(kinematics.motor_poses(machine, profile, camera, positions))
        if not parts:
            camera = _camera(self.detector, self._modes)
            return kinematics.motor_poses(machine, profile, camera, {})[0:0]
        return Poses.concatenate(parts)

    def correction_in_force(self) -> NamedCorrection | None:
        """The correction, in internal units."""
        c = self.correction
        return (
            None if c is None else NamedCorrection.from_edge(c.name, c.date, c.parameters, c.note)
        )

    def machine_of(self, file: str = DOCUMENT) -> Machine:
        """The scanner.

        Raises:
            DatasetFormatError: it does not describe one.
        """
        return _validated(Machine, self.machine, f"{file}: machine")

    def profile_of(self, file: str = DOCUMENT) -> Profile:
        """The zero offsets; raises as `machine_of`."""
        return _validated(Profile, self.profile, f"{file}: profile")


def parse_document(text: str, file: str = DOCUMENT) -> DatasetDocument:
    """Read `flexdt.json`.

    Raises:
        DatasetFormatError: names file, key path, value and what is allowed.
    """
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise DatasetFormatError(f"{file} is not valid JSON: {error}", {"path": file}) from None
    if isinstance(content, dict) and content.get("schema") != SCHEMA:
        raise DatasetFormatError(
            f"{file}: schema is {str(content.get('schema'))[:40]!r}; this version reads {SCHEMA}",
            {"path": file, "asked": repr(content.get("schema"))[:40], "allowed": SCHEMA},
        )
    return _validated(DatasetDocument, content, file)


def _validated(model: type[_M], content: object, file: str) -> _M:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = [
            {
                "path": ".".join(str(part) for part in e["loc"]),
                "message": message_of(e),
                "value": repr(e["input"])[:80],
            }
            for e in error.errors(include_url=False)[:10]
        ]
        lines = [f"{file}: {p['path']}: {p['message']} (value: {p['value']})" for p in problems]
        raise DatasetFormatError("\n".join(lines), {"path": file, "problems": problems}) from None


def _camera(
    entry: FrameEntry | DetectorEntry, modes: tuple[tuple[str, int], ...]
) -> CameraSettings:
    roi = Roi(*entry.roi)
    return CameraSettings(entry.mode, roi, entry.exposure_ms, entry.averages, modes=modes)


def _entries(record: ScanRecord, block: FrameBlock) -> Sequence[FrameEntry]:
    if not len(block):
        return ()
    rows = record.poses_of(block).cone_vec().rows.tolist()
    names = list(block.positions)
    table = np.stack([np.asarray(block.positions[n], dtype=np.float64) for n in names], axis=1)
    return [
        FrameEntry(
            file=file,
            kind=block.kind,
            time_s=time,
            **block.camera.of_image,
            xrays_on=block.xrays_on,
            positions=dict(zip(names, values, strict=True)),
            cone_vec=row,
        )
        for file, time, values, row in zip(
            block.files, np.asarray(block.times_s).tolist(), table.tolist(), rows, strict=True
        )
    ]
