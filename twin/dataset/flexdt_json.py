"""A scan's record as one frozen value, and `flexdt.json`, the document of it.

`ScanRecord` is everything the files of a data set are made from. All geometry in it is
nominal (motors and profile); the applied correction is kept with it, and the hidden
misalignment is nowhere in it. Dates are arguments.

`flexdt.json` says what the scanner's own texts cannot express, as one versioned document:
machine and profile in full, nominal cone_vec, motor positions and time of every frame, the
correction in force, the noise's seed and completeness. Reading checks the version, types, names
and lengths, and an error names the place.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    ValidationError,
)

from flexdt.message_words import problem_words
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetNameError
from flexdt.twin.dataset.file_names import DOCUMENT, plain_name
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.input_limits import InputLimitError
from flexdt.twin.json_text import parse_json
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.physics.predicted_beam import PredictedExposure
from flexdt.twin.scanner.state import NamedCorrection, StagePlacement
from flexdt.twin.script import SampleSize, ScanPlan
from flexdt.twin.script.planning.plan import saved_images
from flexdt.twin.values import ArrayValue

POSITION_TOLERANCE = 1e-4
"""Largest difference of positions that count as one [mm, deg]: texts have six
decimals."""

FINITE = ConfigDict(allow_inf_nan=False)
"""Model configuration that allows finite numbers only in flexdt.json."""
FrameKind = Literal["dark", "flat", "projection"]
SCHEMA: Final = 1
_M = TypeVar("_M", bound=BaseModel)
Row = Annotated[list[float], Field(min_length=12, max_length=12)]


@dataclass(frozen=True)
class SampleRecord:
    """The sample's description for the texts; empty where unknown."""

    __pydantic_config__: ClassVar = FINITE

    name: str = ""
    owner: str = ""
    project: str = ""
    comment: str = ""
    diameter_mm: float = 0.0
    height_mm: float = 0.0
    material: str | None = None
    """Of a mesh; None for a sample that states its own."""
    revision: str | None = None
    """Content of an upload; None for a shipped phantom."""
    offset: StagePlacement | None = None
    """Place on the stage during the scan; None where it is not known."""

    def identity(self) -> dict[str, Any]:
        """Return what tells it from another sample, or from itself elsewhere, as JSON:
        `sample` (its name), `revision`, `material` and `offset`."""
        return {
            "sample": self.name,
            "revision": self.revision,
            "material": self.material,
            "offset": None if self.offset is None else asdict(self.offset),
        }


@dataclass(frozen=True)
class NoiseRecord:
    """How counts came about: seed None means no noise was added.

    Attributes:
        seed: frame i's generator is np.random.default_rng([seed, i]).
        model: the detector's figures by name.
    """

    __pydantic_config__: ClassVar = FINITE

    seed: int | None = None
    model: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class FrameBlock(ArrayValue):
    """Saved images of one kind and one camera setting, in the order taken.

    Attributes:
        kind: dark, flat or projection.
        files: n bare file names.
        times_s: (n,) nominal moments on the scan's clock [s].
        camera: settings in force; its averages make one image.
        positions: axis -> (n,) motor positions [mm, deg], script's sign.
        xrays_on: whether the tube was on.
    """

    kind: FrameKind
    files: tuple[str, ...]
    times_s: FloatArray
    camera: CameraSettings
    positions: Mapping[str, FloatArray]
    xrays_on: bool = True

    def __len__(self) -> int:
        return len(self.files)

    def __repr__(self) -> str:
        """Format as one line: number of images, their kind, first and last file."""
        span = ""
        if self.files:
            span = f", {self.files[0]} to {self.files[-1]}"
        return f"<FrameBlock: {len(self)} {self.kind} images{span}>"


@dataclass(frozen=True, eq=False, repr=False)
class ScanRecord(ArrayValue):
    """One scan.

    Attributes:
        name: of the data set.
        machine: the scanner.
        profile: zero offsets in force.
        camera: settings of the projections.
        kV, power_W: tube settings of the projections.
        positions: axis -> value when the settings file was written [mm, deg], script's
            sign.
        speeds, accelerations: axis -> value at that moment.
        blocks: all saved images, in the order taken, done or not.
        smooth: whether the projections were taken in motion.
        started: date of the scan's beginning.
        duration_s: of the scan so far, on the twin's clock.
        complete: whether every image was taken.
        reason: why not, for people.
        sample, noise, correction: see their types.
        operator: who submitted it.
        flat_axis: the motor that took the sample out of the beam, or "".
        version: of the software.
        predicted: counts of the projections' settings, as they were predicted at
            submission.
    """

    name: str
    machine: Machine
    profile: Profile
    camera: CameraSettings
    kV: float
    power_W: float
    positions: Mapping[str, float]
    speeds: Mapping[str, float]
    accelerations: Mapping[str, float]
    blocks: tuple[FrameBlock, ...]
    smooth: bool
    started: datetime
    duration_s: float
    complete: bool = False
    reason: str = ""
    sample: SampleRecord = field(default_factory=SampleRecord)
    noise: NoiseRecord = field(default_factory=NoiseRecord)
    correction: NamedCorrection | None = None
    operator: str = ""
    flat_axis: str = ""
    version: str = ""
    predicted: tuple[PredictedExposure, ...] = ()

    def __repr__(self) -> str:
        """Format as one line: name, machine, number of images, start, and whether it is
        complete.
        """
        return (
            f"<ScanRecord {self.name!r} on {self.machine.name}: {len(self.files)} images, "
            f"{self.started:%Y-%m-%d %H:%M}, {'complete' if self.complete else 'incomplete'}>"
        )

    @classmethod
    def from_plan(
        cls,
        plan: ScanPlan,
        *,
        name: str,
        started: datetime,
        sample: SampleRecord | None = None,
        noise: NoiseRecord | None = None,
        correction: NamedCorrection | None = None,
        operator: str = "",
        version: str = "",
        predicted: tuple[PredictedExposure, ...] = (),
    ) -> ScanRecord:
        """Make the record of a plan that is about to run; `complete` is False.

        Camera and tube are those of the first projection, else of the settings. Previews
        and images without a file are in no block; `smooth` if any projection is taken in
        motion.

        Positions and rates are those at `write settings file`. For a script without that
        command the positions are those at the first projection (at time 0 without one),
        the rates those at the start.

        Args:
            plan: of the scan.
            name: of the data set.
            started: date and time.
            sample: None takes the plan's size.
            noise: seed and figures of the noise; None: no noise.
            correction: in force; None: none.
            operator, version: for the documents.
            predicted: exposures.
        """
        blocks = tuple(
            FrameBlock(g.kind, g.files, g.starts, g.camera, positions, g.xrays_on)
            for g, positions in saved_images(plan)
            if g.kind != "preview"
        )
        first = next((g for g in plan.groups if g.kind == "projection" and g.files), None)
        if plan.settings is None:
            shown = plan.start
        else:
            shown = plan.settings
        positions = shown.positions
        if plan.settings is None:
            at = 0.0
            if first is not None:
                at = first.starts[0]
            positions = {n: float(v) for n, v in plan.positions(at).items()}
        lit = shown if first is None else first
        if sample is None:
            size = plan.sample or SampleSize(0.0)
            lower, upper = size.span_mm
            sample = SampleRecord(diameter_mm=size.diameter_mm, height_mm=upper - lower)
        return cls(
            name=name,
            machine=plan.machine,
            profile=plan.profile,
            camera=lit.camera,
            kV=lit.kV,
            power_W=lit.power_W,
            positions=dict(positions),
            speeds=dict(shown.speeds),
            accelerations=dict(shown.accelerations),
            blocks=blocks,
            smooth=any(
                g.moving for g in plan.groups if g.kind == "projection" and g.files
            ),
            started=started,
            duration_s=plan.duration_s,
            sample=sample,
            noise=noise if noise is not None else NoiseRecord(),
            correction=correction,
            operator=operator,
            flat_axis=_flat_axis(plan.machine, blocks),
            version=version,
            predicted=predicted,
        )

    @property
    def stopped(self) -> datetime:
        """Date of the scan's end so far."""
        return self.started + timedelta(seconds=self.duration_s)

    @property
    def projections(self) -> tuple[FrameBlock, ...]:
        """Blocks of projections."""
        return tuple(b for b in self.blocks if b.kind == "projection")

    @property
    def files(self) -> tuple[str, ...]:
        """Names of all images, in the order taken."""
        return tuple(f for b in self.blocks for f in b.files)

    def count(self, kind: FrameKind) -> int:
        """Count the saved images of a kind."""
        return sum(len(b) for b in self.blocks if b.kind == kind)

    def poses_of(self, block: FrameBlock) -> Poses:
        """Compute nominal poses of a block's images, without limits and correction."""
        return motor_poses(self.machine, self.profile, block.camera, block.positions)

    def cone_vec(self, blocks: Iterable[FrameBlock] | None = None) -> ConeVec:
        """Compute the nominal geometry of all images, or of `blocks`, in order.

        Without a detector shape. GeometryError if all are empty.
        """
        if blocks is None:
            chosen = self.blocks
        else:
            chosen = tuple(blocks)
        return ConeVec.concatenate(
            [self.poses_of(b).cone_vec() for b in chosen if len(b)]
        )

    def angles_deg(self) -> FloatArray:
        """Compute the stage angle of every projection [deg], (n,), not wrapped at 360;
        empty without projections.
        """
        parts = [np.degrees(self.poses_of(b).angle) for b in self.projections if len(b)]
        if parts:
            return np.concatenate(parts)
        return np.zeros(0)

    def sections(self) -> int:
        """Count the sections of projections that one pose and one angle rule of the texts
        cannot join.

        1 if they can, or there is none: all motors but the rotation are where the
        settings file states, and image i of N is at first + i * (last - first) / (N - 1),
        within `POSITION_TOLERANCE`. Else at least 2: one more than the number of images
        before which such a motor moves.
        """
        blocks = [b for b in self.projections if len(b)]
        if not blocks:
            return 1
        turning = self.machine.geometry.get("angle", {})
        still = {
            n: np.concatenate([b.positions[n] for b in blocks])
            for n in self.machine.axes
            if n not in turning
        }
        angles = self.angles_deg()
        rule = np.linspace(angles[0], angles[-1], len(angles))
        if np.abs(angles - rule).max() < POSITION_TOLERANCE and all(
            np.abs(v - self.positions[n]).max() < POSITION_TOLERANCE
            for n, v in still.items()
        ):
            return 1
        steps = np.zeros(len(angles) - 1, dtype=bool)
        for values in still.values():
            steps |= np.abs(np.diff(values)) > POSITION_TOLERANCE
        return max(2, 1 + int(np.count_nonzero(steps)))

    def settings_pose(self) -> Poses:
        """Compute the nominal pose at the time of the settings file, n = 1."""
        return motor_poses(self.machine, self.profile, self.camera, self.positions)


def _flat_axis(machine: Machine, blocks: Sequence[FrameBlock]) -> str:
    """Find the linear motor that takes the sample out of the beam for the flats.

    Compared are the first image of the first flat and of the first projection.

    Args:
        machine: whose turning motors do not count.
        blocks: images with their motor positions.

    Returns the motor that is farthest from its place then; "" if none is more than 1 mm off, or
    flats or projections are missing.
    """
    flats = next((b for b in blocks if b.kind == "flat"), None)
    scans = next((b for b in blocks if b.kind == "projection"), None)
    if flats is None or scans is None:
        return ""
    moved = {
        n: abs(float(flats.positions[n][0] - scans.positions[n][0]))
        for n in flats.positions
        if n not in machine.geometry["angle"]
    }
    best = max(moved, key=lambda n: moved[n], default="")
    return best if best and moved[best] > 1.0 else ""


def _plain(name: str) -> str:
    """Return a file name that is plain; raise ValueError with the rule that it breaks otherwise."""
    try:
        return plain_name(name)
    except DatasetNameError as error:
        raise ValueError(error.message) from None


PlainName = Annotated[str, AfterValidator(_plain)]


class _Model(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="ignore", allow_inf_nan=False, defer_build=True
    )


class FrameEntry(_Model):
    """One image, taken or still to be taken."""

    file: PlainName
    kind: FrameKind
    time_s: float
    """Nominal time on the scan's clock [s]."""
    exposure_ms: float
    averages: int
    mode: str
    roi: tuple[int, int, int, int]
    xrays_on: bool
    positions: dict[str, float]
    """Motor -> position [mm, deg], script's sign."""
    cone_vec: Annotated[Row, FailFast()]
    """Nominal, uncorrected: source, detector center, u, v in the object's frame [mm]."""

    @classmethod
    def all_of(cls, record: ScanRecord, block: FrameBlock) -> Iterator[FrameEntry]:
        """Yield an entry for each image of a block, in order: file, kind, time, camera
        settings, X-rays, positions and nominal cone_vec.
        """
        rows = record.poses_of(block).cone_vec().rows.tolist()
        times = np.asarray(block.times_s).tolist()
        for i, (file, time, row) in enumerate(zip(block.files, times, rows, strict=True)):
            yield cls(
                file=file,
                kind=block.kind,
                time_s=time,
                **block.camera.of_image,
                xrays_on=block.xrays_on,
                positions={
                    name: float(values[i]) for name, values in block.positions.items()
                },
                cone_vec=row,
            )


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
    """The correction applied during the scan; parameters in mm and deg."""

    name: str
    date: str
    note: str = ""
    parameters: dict[str, float]
    sides_known: bool = False

    @classmethod
    def of(cls, correction: NamedCorrection | None) -> CorrectionEntry | None:
        """Convert a correction to its document entry, in mm and deg; None for None."""
        c = correction
        if c is None:
            return None
        return cls(
            name=c.name,
            date=c.date,
            note=c.note,
            parameters=c.parameters.to_edge(),
            sides_known=c.sides_known,
        )


class PredictedEntry(_Model):
    """The prediction for one setting when the scan was submitted."""

    kV: float
    power_W: float
    exposure_ms: float
    open_beam_fill: float | None = None
    """Counts of the open beam over the panel's range, saturated from 1; null: unknown."""
    saturated: float | None = None
    """Share of saturated pixels of the projections; null: unknown."""
    starved: float | None = None
    """Share of starved pixels of the projections; null: unknown."""
    doubts: list[str] = Field(default_factory=list)
    """Warnings of the prediction about the setting."""
    unpredicted: str = ""
    """Reason why the two shares are unknown; empty in older files."""

    @classmethod
    def of(cls, predicted: PredictedExposure) -> PredictedEntry:
        """Make the document's entry of a predicted exposure; shares are rounded to four
        digits.

        The shares of saturated and starved pixels are None if they were not predicted.
        """
        shares = predicted.shares
        return cls(
            kV=predicted.kV,
            power_W=predicted.power_W,
            exposure_ms=predicted.exposure_ms,
            open_beam_fill=_rounded(predicted.open_beam_fill),
            saturated=None if shares is None else _rounded(shares.saturated),
            starved=None if shares is None else _rounded(shares.starved),
            doubts=list(predicted.doubts),
            unpredicted=predicted.unpredicted,
        )


def _rounded(value: float | None) -> float | None:
    """Round to four significant digits; None stays None."""
    if value is None:
        return None
    return float(f"{value:.4g}")


class DatasetDocument(_Model):
    """The content of `flexdt.json`."""

    schema_version: Literal[1] = Field(alias="schema")
    flexdt: str = ""
    """Version of the software that wrote the file."""
    name: str
    started: datetime
    duration_s: float
    operator: str = ""
    smooth: bool = True
    complete: bool = False
    reason: str = ""
    """Reason why the scan is not complete."""
    machine: dict[str, Any]
    profile: dict[str, Any]
    tube: TubeEntry
    detector: DetectorEntry
    sample: SampleRecord = Field(default_factory=SampleRecord)
    noise: NoiseRecord = Field(default_factory=NoiseRecord)
    correction: CorrectionEntry | None = None
    settings_positions: dict[str, float] = Field(default_factory=dict)
    """Motor -> position when the settings texts were written [mm, deg], script's sign."""
    predicted: list[PredictedEntry] = Field(default_factory=list)
    """Counts of each setting of the projections, predicted at submission; empty in older
    files.
    """
    frames: Annotated[list[FrameEntry], FailFast()]
    """The images; the first that does not hold ends their validation."""

    @property
    def saturated(self) -> float | None:
        """Largest predicted share of saturated pixels among its settings; None: unknown."""
        shares = [one.saturated for one in self.predicted if one.saturated is not None]
        return max(shares, default=None)

    @classmethod
    def of(cls, record: ScanRecord) -> DatasetDocument:
        """Make the document of a scan: machine, profile, settings, sample, noise,
        correction, predictions and frames.

        It has an entry for every planned image, saved yet or not; `detector` is the
        record's camera.
        """
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
            predicted=[PredictedEntry.of(one) for one in record.predicted],
            frames=[
                entry
                for b in record.blocks
                if len(b)
                for entry in FrameEntry.all_of(record, b)
            ],
        )

    def to_json(self) -> str:
        """Format the document as indented JSON with one line for each frame, in UTF-8
        characters, with a final newline.
        """
        head = self.model_dump(mode="json", by_alias=True, exclude={"frames"})
        text = json.dumps(head, indent=1, ensure_ascii=False)
        lines = [
            json.dumps(f.model_dump(mode="json"), ensure_ascii=False) for f in self.frames
        ]
        frames = ",\n  ".join(lines)
        return f'{text[:-2]},\n "frames": [\n  {frames}\n ]\n}}\n'

    def cone_vec(self, kind: FrameKind | None = "projection") -> ConeVec:
        """Read the nominal geometry of the frames of one kind, or of all."""
        rows = [f.cone_vec for f in self.frames if kind is None or f.kind == kind]
        return ConeVec(np.array(rows, dtype=np.float64).reshape(-1, 12))

    def positions(self, kind: FrameKind = "projection") -> dict[str, FloatArray]:
        """Collect the motor positions of frames of one kind: motor -> (n,) [mm, deg].

        Motors are the first frame's; KeyError if a later one lacks one.
        """
        chosen = [f.positions for f in self.frames if f.kind == kind]
        return {
            n: np.array([p[n] for p in chosen]) for n in (chosen[0] if chosen else {})
        }

    def files(self, kind: FrameKind) -> tuple[str, ...]:
        """List file names of one kind, in the order taken."""
        return tuple(f.file for f in self.frames if f.kind == kind)

    def shapes(self, kind: FrameKind = "projection") -> list[tuple[int, int]]:
        """List the image shape (rows, cols) of each frame of one kind.

        Raises:
            LimitError: a camera mode does not exist.
        """
        return [self.shape_of(f) for f in self.frames if f.kind == kind]

    def shape_of(self, frame: FrameEntry) -> tuple[int, int]:
        """Return the image shape (rows, cols) of one frame; raises as `shapes`."""
        return self._camera(frame).shape

    def _camera(self, entry: FrameEntry | DetectorEntry) -> CameraSettings:
        """Make camera settings of an entry: mode, region, exposure, averages, and the
        machine's named modes.

        Without modes in the document's machine there are none.
        """
        detector = self.machine.get("detector")
        named = None
        if isinstance(detector, dict):
            named = detector.get("modes")
        if isinstance(named, dict):
            modes = tuple(named.items())
        else:
            modes = ()
        roi = Roi(*entry.roi)
        return CameraSettings(
            entry.mode, roi, entry.exposure_ms, entry.averages, modes=modes
        )

    def poses(
        self, machine: Machine, profile: Profile, kind: FrameKind = "projection"
    ) -> Poses:
        """Compute nominal poses of the frames of one kind from their motor positions.

        The camera is each frame's; frames of one mode and region in a row must name the same
        motors. No correction is applied; limits are not checked.

        `machine`: whose geometry and sensor are used; `profile`: zero offsets; `kind`: of the
        frames.
        Returns n poses, in the order of the frames; none without such frames.
        Raises TwinError: `machine` does not have a motor, or a camera mode does not exist;
        DatasetFormatError: frames name different motors.
        """
        chosen = [f for f in self.frames if f.kind == kind]
        parts = []
        for _, run in itertools.groupby(chosen, lambda f: (f.mode, f.roi)):
            group = list(run)
            names = group[0].positions
            if any(f.positions.keys() != names.keys() for f in group):
                raise DatasetFormatError("frames do not name the same motors")
            positions = {n: np.array([f.positions[n] for f in group]) for n in names}
            parts.append(motor_poses(machine, profile, self._camera(group[0]), positions))
        if not parts:
            return motor_poses(machine, profile, self._camera(self.detector), {})[0:0]
        return Poses.concatenate(parts)

    def correction_in_force(self) -> NamedCorrection | None:
        """Return the correction that was applied, in internal units (mm, rad), or None."""
        c = self.correction
        if c is None:
            return None
        return NamedCorrection.from_edge(
            c.name, c.date, c.parameters, c.note, sides_known=c.sides_known
        )

    def machine_of(self, file: str = DOCUMENT) -> Machine:
        """Read the scanner's description.

        Raises:
            DatasetFormatError: it is not valid; `file` is named.
        """
        return _validated(Machine, self.machine, f"{file}: machine")

    def profile_of(self, file: str = DOCUMENT) -> Profile:
        """Read the profile of zero offsets; raises as `machine_of`."""
        return _validated(Profile, self.profile, f"{file}: profile")


def parse_document(text: str, file: str = DOCUMENT) -> DatasetDocument:
    """Parse and validate the text of `flexdt.json`.

    The schema is checked first; another than `SCHEMA` is refused.

    Args:
        text: its content.
        file: name for error messages.

    Raises:
        DatasetFormatError: names file, key path, value and allowed values.
    """
    try:
        content = parse_json(text, file=file, form=DOCUMENT)
    except InputLimitError as error:
        raise DatasetFormatError(error.message, error.data) from None
    except ValueError as error:
        raise DatasetFormatError(
            f"{file} is not valid JSON: {error}", {"path": file}
        ) from None
    if isinstance(content, dict) and content.get("schema") != SCHEMA:
        raise DatasetFormatError(
            f"{file}: schema is {str(content.get('schema'))[:40]!r}; "
            f"this version reads {SCHEMA}",
            {"path": file, "asked": repr(content.get("schema"))[:40], "allowed": SCHEMA},
        )
    return _validated(DatasetDocument, content, file)


def _validated(model: type[_M], content: object, file: str) -> _M:
    """Validate content of `file` as a model; return the model's value.

    The message has one line for each problem: key path, message, value.

    Args:
        model: its class.
        content: plain data.
        file: name for error messages.

    Raises:
        DatasetFormatError: the content does not fit; names file, key and value, for at
            most 10 problems.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = [
            {
                "path": ".".join(str(part) for part in e["loc"]),
                "message": problem_words(e),
                "value": repr(e["input"])[:80],
            }
            for e in error.errors(include_url=False)[:10]
        ]
        lines = [
            f"{file}: {p['path']}: {p['message']} (value: {p['value']})" for p in problems
        ]
        raise DatasetFormatError(
            "\n".join(lines), {"path": file, "problems": problems}
        ) from None
