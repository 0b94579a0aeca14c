"""A CTSimU scenario (file formats 1.0 to 1.2) to the geometry of its frames.

Centers, orientations, deviations (about any axis and pivot) and drifts of all of these are
evaluated frame by frame, once as reconstruction knows them and once as they really are. The
object's frame is the stage's (u, v, w). Parallel beams, drifting axes and files older than 1.0
are errors.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt.twin.exchange import (
    CTSIMU,
    ExchangeError,
    Ledger,
    ScanGeometry,
    cone_vec_of,
    read_json,
)
from flexdt.twin.geometry.conventions import FloatArray, rotation_about

MOST: Final = 1_000_000
"""Largest number of frames, rows and columns."""
MAX_MINOR: Final = 2
MM: Final = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "dm": 100.0, "um": 1e-3, "nm": 1e-6}
_RAD: Final = {"rad": 1.0, "deg": math.pi / 180.0}
NUMBER: Final = {None: 1.0}
WORLD = "xyz"
STAGE = "uvw"
_SAMPLE = "rst"
"""A sample's own axes; for source, detector and stage CTSimU takes them for the local ones."""
_AXES: Final = {
    name: (reference, tuple(float(name == other) for other in reference))
    for reference in (WORLD, STAGE, _SAMPLE)
    for name in reference
}
Pose = tuple[FloatArray, ...]
"""Source, panel's center, u, v; center and axes of the stage; all in the world."""
Beside = Callable[[str], str]
"""Text of a file by its name in the scenario."""


@dataclass(frozen=True, eq=False)
class PerFrame:
    """A number per frame, as reconstruction knows it and as it is."""

    known: FloatArray
    real: FloatArray

    def of(self, real: bool) -> FloatArray:
        """Return the real or the known values."""
        return self.real if real else self.known


@dataclass(frozen=True, eq=False)
class _Deviation:
    """A translation or rotation of a part; see `_deviation`.

    Attributes:
        turn: whether it is a rotation.
        reference: coordinate system of the axis: world, stage, or the part's own.
        axis: direction (3,), unit length.
        pivot_reference: coordinate system of the pivot.
        pivot: point on the axis of rotation (3,) [mm].
        amount: for each frame [mm or rad].
        known: whether reconstruction knows it.
    """

    turn: bool
    reference: str
    axis: FloatArray
    pivot_reference: str
    pivot: FloatArray
    amount: PerFrame
    known: bool


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """Source, detector, stage or sample of a scenario, with its motion.

    Attributes:
        center: at the first frame (3,) [mm].
        axes: u, v, w as columns (3, 3).
        moves: drifts of the three coordinates of the center [mm], added to it.
        deviations: in the order in which they are applied.
        on_stage: whether center and axes are in the stage's coordinates, not the world's.
    """

    center: FloatArray
    axes: FloatArray
    moves: tuple[PerFrame, PerFrame, PerFrame]
    deviations: tuple[_Deviation, ...]
    on_stage: bool = False


def read_ctsimu(
    text: str, file: str = "<scenario>", beside: Beside | None = None
) -> ScanGeometry:
    """Read the geometry of a scenario: `cone_vec` as reconstruction knows it, `real`
    where it differs.

    Args:
        text: the scenario.
        file: its name, for errors.
        beside: returns the text of a file of drifts by its name; without it such drifts
            are errors.

    Raises:
        ExchangeError: names file, key and the allowed values.
    """
    reader = ScenarioReader(read_json(text, file, Watched), file, beside)
    return reader.geometry().accounted(reader.account())


class Watched(dict[str, Any]):
    """A JSON object that records which of its keys were read."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.seen: set[str] = set()

    def get(self, key: str, default: Any = None) -> Any:
        """Return a member, which counts as read."""
        self.seen.add(key)
        return super().get(key, default)

    def __getitem__(self, key: str) -> Any:
        self.seen.add(key)
        return super().__getitem__(key)

    def stated(self, where: str = "", field: str = "") -> Iterator[_Stated]:
        """Yield what the document states below a place: each number with its unit and its
        drifts as one value, each text, and lists of numbers as one.
        """
        for key, value in self.items():
            at, name = f"{where}.{key}".lstrip("."), f"{field}/{key}".lstrip("/")
            seen = key in self.seen
            if isinstance(value, Watched) and "value" in value:
                used = seen and {"value", "drifts"} & value.seen != set()
                yield at, name, _shown(value), used
                for inner in value.keys() - _OF_NUMBERS:
                    yield f"{at}.{inner}", f"{name}/{inner}", _shown(value[inner]), False
            elif isinstance(value, Watched) and value:
                yield from value.stated(at, name)
            elif isinstance(value, list) and any(isinstance(v, Watched) for v in value):
                for i, one in enumerate(value):
                    inner_of = Watched({"": one}) if not isinstance(one, Watched) else one
                    yield from inner_of.stated(f"{at}[{i}]", name)
            elif value != [] and value != {}:
                yield at, name, _shown(value), seen


_Stated = tuple[str, str, str, bool]
"""Place, name of the field, value, and whether it was read."""
_OF_NUMBERS: Final = frozenset({"value", "unit", "drifts", "uncertainty"})
"""Members of a number that stand for it."""


def _shown(value: object) -> str:
    """Return a value of the document as text: a number with its unit; null is nothing."""
    if isinstance(value, dict) and set(value) <= {"value", "unit"}:
        unit = value["unit"] if value.get("unit") else ""
        return f"{_shown(value['value'])} {unit}".strip()
    return "" if value is None else value if isinstance(value, str) else json.dumps(value)


class ScenarioReader:
    """Reads the geometry of a scenario; `beside` returns the text of a file by its
    name."""

    def __init__(
        self, document: Mapping[str, Any], file: str, beside: Beside | None = None
    ) -> None:
        """Take a scenario's document, and check its version and number of projections.

        Args:
            document: content of the file.
            file: its name, for messages.
            beside: reads files that it names.

        Raises:
            ExchangeError: another version, or no such number.
        """
        self._document = document
        self._file = file
        self._beside = beside
        self._check_version()
        self._count = self._size("acquisition", "number_of_projections")

    def account(self, images: bool = False) -> Ledger:
        """Enter the values of the document in a ledger, those that were read as used.

        Args:
            images: whether images are made of it, so that what changes them and was not
                read is told.
        """
        said = Ledger(CTSIMU, self._file, error=ExchangeError)
        document = self._document
        for place, name, value, read in (
            document.stated() if isinstance(document, Watched) else ()
        ):
            said.state(name, value, place, listed="[" in place)
            rule = CTSIMU.field(name)
            if read and rule is not None:
                said.use_place(place, "it is read")
            elif (
                images
                and rule is not None
                and rule.role == "used"
                and not rule.without_effect(value)
            ):
                said.set_place_aside(place, f"{place} is {value}, which is not applied")
        return said

    def geometry(self) -> ScanGeometry:
        """Compute the geometry of the scenario's frames, known and real.

        Geometry is that known to reconstruction; the real one is kept beside it, None if
        both are the same.

        Returns:
            Views of the binned pixels in the stage's frame; a note where known and real
            differ.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        source_type = self._at("geometry", "source").get("type", "cone")
        if source_type not in (None, "cone"):
            raise self._error("geometry.source.type", "cone")
        parts = {name: self._part(name) for name in ("source", "detector", "stage")}
        pitch = [self._number(("detector", "pixel_pitch", axis), MM) for axis in "uv"]
        cols, rows = (self._size("detector", name) for name in ("columns", "rows"))
        bins = self._bins(rows, cols)
        if min(pitch) <= 0.0:
            raise self._error("detector.pixel_pitch", "above 0")
        angle = self._angles()
        binned = (pitch[0] * bins[0], pitch[1] * bins[1])
        rows_of = [
            np.array(
                [seen_from(p, *p[4:]) for p in self._poses(parts, angle, binned, real)]
            )
            for real in (False, True)
        ]
        known, real = (cone_vec_of(r, self._file) for r in rows_of)
        same = np.array_equal(known.rows, real.rows)
        name = self._at("file").get("name")
        notes: tuple[str, ...] = ()
        if not same:
            notes = ("some deviations or drifts are unknown to reconstruction",)
        return ScanGeometry(
            known,
            (rows // bins[1], cols // bins[0]),
            None if same else real,
            name if isinstance(name, str) else "",
            notes=notes,
        )

    def _bins(self, rows: int, cols: int) -> tuple[int, int]:
        """Read the numbers of pixels to bin along u and v; 1 where not given.

        Pixels that fill no binned pixel are cut off on both sides, elsewhere.

        Args:
            rows: of the detector.
            cols: of the detector.

        Raises:
            ExchangeError: they are no whole numbers within the detector.
        """
        where = "acquisition.pixel_binning"
        binning = self._at("acquisition").get("pixel_binning")
        if binning is None:
            return 1, 1
        found = [binning.get(a, 1) if isinstance(binning, dict) else None for a in "uv"]
        u, v = (1 if b is None and isinstance(binning, dict) else b for b in found)
        if (
            type(u) is not int
            or type(v) is not int
            or not (1 <= u <= cols and 1 <= v <= rows)
        ):
            raise self._error(
                where, "u and v, whole numbers from 1 to the detector's size"
            )
        return u, v

    def _poses(
        self,
        parts: Mapping[str, PlacedPart],
        angle: FloatArray,
        pitch: Sequence[float],
        real: bool,
    ) -> list[Pose]:
        """Compute source, detector, u, v, and the stage's center and axes, for each frame [mm].

        Args:
            parts: source, detector and stage.
            angle: (n,) of the stage [rad].
            pitch: pixel edges along u and v [mm].
            real: with the deviations unknown to reconstruction.

        Returns:
            Tuples of a frame: source, detector, u, v, stage's center (3,), and its axes
            as columns (3, 3).
        """
        still = np.zeros(self._count)
        out: list[Pose] = []
        for i in range(self._count):
            source, _ = place(parts["source"], still, i, real)
            detector, panel = place(parts["detector"], still, i, real)
            u = panel[:, 0] * pitch[0]
            v = panel[:, 1] * pitch[1]
            out.append((source, detector, u, v, *place(parts["stage"], angle, i, real)))
        return out

    def _angles(self) -> FloatArray:
        """Compute the stage's turn about its w, [rad] per frame; negative for direction
        "CW".

        The last frame is at `stop_angle`, or one step before it if `include_final_angle`
        is false.

        Raises:
            ExchangeError: start exceeds stop, or the direction is neither CW nor CCW.
        """
        acquisition = self._at("acquisition")
        start = self._number(("acquisition", "start_angle"), _RAD)
        stop = self._number(("acquisition", "stop_angle"), _RAD)
        if start > stop:
            raise self._error("acquisition.stop_angle", "not below start_angle")
        final = acquisition.get("include_final_angle", True)
        if final in (True, None):
            steps = self._count - 1
        else:
            steps = self._count
        angles = start + np.arange(self._count) * (stop - start) / max(1, steps)
        direction = acquisition.get("direction") or "CCW"
        if direction not in ("CW", "CCW"):
            raise self._error("acquisition.direction", "CW or CCW")
        return -angles if direction == "CW" else angles

    def _part(self, name: str) -> PlacedPart:
        return self._read_part(self._at("geometry", name), f"geometry.{name}", (WORLD,))

    def _read_part(
        self, part: Mapping[str, Any], where: str, allowed: tuple[str, ...]
    ) -> PlacedPart:
        """Read source, detector, stage (u, w) or sample (r, t), in one of the `allowed`
        references.

        Its vectors need not be of unit length, but at right angles and in the reference
        of the center. Keys of file formats before 1.0 (`centre`, `deviation`) are errors.

        Args:
            part: its object in the scenario.
            where: its place, for errors.
            allowed: references, each the names of three axes.

        Returns:
            The part: center [mm], axes, drifts of the center and deviations, in the
            reference of its center.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        if part.get("deviation") or part.get("centre"):
            raise self._error(
                where, "the form of file format 1.0 and later (center, deviations)"
            )
        center = part.get("center")
        reference = next((r for r in allowed if _has_axes(center, r)), None)
        if not isinstance(center, dict) or reference is None:
            raise self._error(f"{where}.center", " or ".join(map(", ".join, allowed)))
        moves = [self._frames(center[a], f"{where}.center.{a}", MM) for a in reference]
        start = [self._value(center[a], f"{where}.center.{a}", MM) for a in reference]
        named = ("u", "w") if allowed == (WORLD,) else ("r", "t")
        axes = self._axes(part, where, reference, named)
        deviations = part.get("deviations") or []
        if isinstance(deviations, dict):
            deviations = [deviations]
        if not isinstance(deviations, list):
            raise self._error(f"{where}.deviations", "a list")
        rest = [
            PerFrame(m.known - s, m.real - s) for m, s in zip(moves, start, strict=True)
        ]
        return PlacedPart(
            np.array(start),
            axes,
            (rest[0], rest[1], rest[2]),
            tuple(
                self._deviation(d, f"{where}.deviations[{i}]")
                for i, d in enumerate(deviations)
            ),
            reference == STAGE,
        )

    def _axes(
        self,
        part: Mapping[str, Any],
        where: str,
        reference: Sequence[str],
        named: tuple[str, str],
    ) -> FloatArray:
        """Read the two vectors of a part, which need not be of unit length, as its axes.

        Args:
            part: its object in the scenario.
            where: its place, for errors.
            reference: names of the axes in which they have to be given.
            named: letters of the two vectors.

        Returns:
            Orthonormal axes, as columns (3, 3).

        Raises:
            ExchangeError: another reference, or not at right angles.
        """
        first, last = named
        u, w = (
            self._vector(part.get(f"vector_{a}"), f"{where}.vector_{a}") for a in named
        )
        if u[0] != reference or w[0] != reference:
            raise self._error(
                where, f"vector_{first} and vector_{last} in {', '.join(reference)}"
            )
        axes = _orthonormal(u[1], w[1])
        if axes is None:
            raise self._error(where, f"vector_{first} and vector_{last} at right angles")
        return axes

    def _deviation(self, value: object, where: str) -> _Deviation:
        """Read a deviation: a translation [mm] or a rotation [rad] about a pivot.

        It is unknown to the reconstruction only where `known_to_reconstruction` is false.
        The axis is normalized; the default pivot is the part's own center.

        Args:
            value: its object in the scenario.
            where: its place, for errors.

        Returns:
            The deviation, with known and real amounts (n,) [mm or rad].

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        if not isinstance(value, dict) or value.get("type") not in (
            "translation",
            "rotation",
        ):
            raise self._error(where, "an object with type translation or rotation")
        turn = value["type"] == "rotation"
        axis = value.get("axis")
        if isinstance(axis, str) and axis in _AXES:
            reference = _AXES[axis][0]
            direction = np.array(_AXES[axis][1])
        elif isinstance(axis, dict):
            reference, direction = self._vector(axis, f"{where}.axis")
        else:
            raise self._error(f"{where}.axis", "x, y, z, u, v, w or a vector of them")
        pivot_reference = _SAMPLE
        pivot = np.zeros(3)
        if value.get("pivot") is not None:
            pivot_reference, pivot = self._vector(value["pivot"], f"{where}.pivot", MM)
        amount = self._frames(
            value.get("amount"), f"{where}.amount", _RAD if turn else MM
        )
        known = value.get("known_to_reconstruction")
        length = float(np.linalg.norm(direction))
        if length == 0.0:
            raise self._error(f"{where}.axis", "a vector of some length")
        return _Deviation(
            turn,
            reference,
            direction / length,
            pivot_reference,
            pivot,
            amount,
            known is not False,
        )

    def _vector(
        self, value: object, where: str, units: Mapping[Any, float] = NUMBER
    ) -> tuple[str, FloatArray]:
        """Read a vector of three components, x, y, z or u, v, w or those of the sample.

        Args:
            value: from the document.
            where: its path, for messages.
            units: unit -> factor.

        Returns:
            The names of its components, and their values (3,).

        Raises:
            ExchangeError: no such vector, or one with drifts.
        """
        if isinstance(value, dict):
            for reference in (WORLD, STAGE, _SAMPLE):
                if set(reference) <= value.keys():
                    for a in reference:
                        if drifts_of(value[a]):
                            raise self._error(f"{where}.{a}", "a vector without drifts")
                    parts = [
                        self._value(value[a], f"{where}.{a}", units) for a in reference
                    ]
                    return reference, np.array(parts)
        raise self._error(where, "three components x, y, z or u, v, w")

    def _frames(self, value: object, where: str, units: Mapping[Any, float]) -> PerFrame:
        """Read a parameter with its drifts at every frame.

        Drift values, of the document or of a file, are spread over the frames and added;
        those unknown to reconstruction only to the real values.

        Args:
            value: number, or object with value, unit and drifts.
            where: its place, for errors.
            units: unit -> factor.

        Returns:
            Known and real values, (n,) each.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        standard = self._value(value, where, units)
        known = np.full(self._count, standard)
        real = known.copy()
        for i, drift in enumerate(drifts_of(value)):
            at = f"{where}.drifts[{i}]"
            if not isinstance(drift, dict):
                raise self._error(at, "an object with value or file")
            values = drift.get("value")
            if drift.get("file"):
                values = self._numbers(drift["file"], f"{at}.file")[:, 0].tolist()
            if isinstance(values, int | float) and not isinstance(values, bool):
                values = [values]
            if values in (None, []):
                continue
            if not _numeric(values):
                raise self._error(f"{at}.value", "a list of numbers")
            unit = drift.get("unit") or (
                value.get("unit") if isinstance(value, dict) else None
            )
            amounts = np.array(values, dtype=np.float64) * self._factor(unit, units, at)
            over = _fit_to_frames(amounts, self._count)
            real = real + over
            if drift.get("known_to_reconstruction") is not False:
                known = known + over
        return PerFrame(known, real)

    def _numbers(self, name: object, where: str, columns: int = 1) -> FloatArray:
        """Read the first columns of numbers of a named file, separated by commas or
        blanks; lines that begin with # are comments.

        Args:
            name: of the file.
            where: its place in the scenario, for errors.
            columns: number to read; a line may have more.

        Returns:
            (lines, columns).

        Raises:
            ExchangeError: no files can be read here, or the file has a line without that
                many finite numbers.
        """
        if not isinstance(name, str) or self._beside is None:
            raise self._error(where, "values in this file, as no other is read here")
        lines = [
            line.replace(",", " ").split() for line in self._beside(name).splitlines()
        ]
        try:
            table = np.array(
                [
                    [float(x) for x in words[:columns]]
                    for words in lines
                    if words and not words[0].startswith("#")
                ]
            )
        except ValueError:
            table = np.zeros(0)
        if table.ndim != 2 or table.shape[1] < columns or not np.isfinite(table).all():
            raise self._error(f"{where} ({name})", f"lines of {columns} numbers")
        return table

    def _value(self, value: object, where: str, units: Mapping[Any, float]) -> float:
        """Read a number with its unit, converted by `units`.

        Raises:
            ExchangeError: it is no number, or has another unit.
        """
        if isinstance(value, dict):
            entry = value
        else:
            entry = {"value": value}
        number = entry.get("value")
        if not _numeric([number]) or not isinstance(number, int | float):
            raise self._error(where, "a number")
        return float(number) * self._factor(entry.get("unit"), units, where)

    def _factor(self, unit: object, units: Mapping[Any, float], where: str) -> float:
        """Return the factor of a unit; the first of `units` is the default.

        Raises:
            ExchangeError: another unit.
        """
        if units is NUMBER:
            return 1.0
        if unit is None:
            unit = next(iter(units))
        if not isinstance(unit, str) or unit not in units:
            raise self._error(f"{where}.unit", ", ".join(units))
        return units[unit]

    def _number(self, path: Sequence[str], units: Mapping[Any, float]) -> float:
        value: object = self._at(*path[:-1]).get(path[-1])
        return self._value(value, ".".join(path), units)

    def _size(self, *path: str) -> int:
        """Read a whole number from 1 to MOST at a path.

        Raises:
            ExchangeError: it is none.
        """
        value = self._number(path, NUMBER)
        if not value.is_integer() or not 1 <= value <= MOST:
            raise self._error(".".join(path), f"a whole number from 1 to {MOST}")
        return int(value)

    def _at(self, *path: str) -> Mapping[str, Any]:
        """Return the object at a path of the document.

        Raises:
            ExchangeError: there is none.
        """
        found: Any = self._document
        for i, key in enumerate(path):
            if isinstance(found, dict):
                found = found.get(key)
            else:
                found = None
            if not isinstance(found, dict):
                raise self._error(".".join(path[: i + 1]), "an object")
        return found  # type: ignore[no-any-return]

    def _check_version(self) -> None:
        """Check that the document is a CTSimU Scenario of format 1.0 to 1.MAX_MINOR.

        Raises:
            ExchangeError: it is not.
        """
        about = self._at("file")
        version = about.get("file_format_version")
        said = version if isinstance(version, dict) else {}
        major = said.get("major")
        minor = said.get("minor")
        fits = major == 1 and isinstance(minor, int) and minor <= MAX_MINOR
        if about.get("file_type") != "CTSimU Scenario" or not fits:
            asked = f"file_type {about.get('file_type')!r}, format {major}.{minor}"
            allowed = f"CTSimU Scenario, 1.0 to 1.{MAX_MINOR}"
            raise ExchangeError.instead(
                f"{self._file}: {asked}", asked, allowed, path="file"
            )

    def _error(self, where: str, allowed: str) -> ExchangeError:
        """Make (not raise) the error on the value at `where`: what it is, and what is
        allowed.
        """
        asked = self._stated_text(where)
        return ExchangeError.instead(
            f"{self._file}: {where} is {asked}", asked, allowed, path=where
        )

    def _stated_text(self, where: str) -> str:
        """Return the value at a path of the document as JSON, cut after 60 characters
        (then " ..."); "null" if nothing is there.
        """
        found: Any = self._document
        for key in re.findall(r"[^.\[\]]+", where.partition(" ")[0]):
            if isinstance(found, list) and key.isdigit() and int(key) < len(found):
                found = found[int(key)]
            else:
                if isinstance(found, dict):
                    found = found.get(key)
                else:
                    found = None
        text = json.dumps(found)
        if len(text) <= 60:
            return text
        return f"{text[:60]} ..."


def seen_from(pose: Pose, center: FloatArray, axes: FloatArray) -> FloatArray:
    """Convert a pose to a cone_vec row (12,) in another frame, whose center and axes
    are the world's."""
    source, detector, u, v = pose[:4]
    return np.concatenate(
        [axes.T @ x for x in (source - center, detector - center, u, v)]
    )


def place(
    part: PlacedPart,
    turn: FloatArray,
    frame: int,
    real: bool,
    stage: tuple[FloatArray, FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Compute center and axes of a part in one frame.

    They are in the world, or for a sample on the stage in the stage's (u, v, w). The part
    is turned first, then deviated in order, then moved by its drifts.

    Args:
        part: center, axes, deviations and drifts.
        turn: (n,) of the part about its w [rad].
        frame: number of the frame.
        real: include deviations and drifts that are unknown to reconstruction.
        stage: center and axes of the stage, for a sample.

    Returns:
        Center (3,) [mm], and axes as columns (3, 3).
    """
    center = part.center.copy()
    axes = part.axes
    if turn[frame] != 0.0:
        axes = rotation_about(axes[:, 2], float(turn[frame])) @ axes

    def coordinate_system(reference: str) -> tuple[FloatArray, FloatArray]:
        """Return origin [mm] and axes of a coordinate system (world, stage or else the
        part's own), as deviations of this part use it.
        """
        if reference == WORLD and part.on_stage and stage is not None:
            return -stage[1].T @ stage[0], stage[1].T
        if reference == WORLD or (reference == STAGE and part.on_stage):
            return np.zeros(3), np.eye(3)
        return center, axes

    for deviation in part.deviations:
        if not real and not deviation.known:
            continue
        amount = float(deviation.amount.of(real)[frame])
        axis = coordinate_system(deviation.reference)[1] @ deviation.axis
        if not deviation.turn:
            center = center + amount * axis
            continue
        origin, base = coordinate_system(deviation.pivot_reference)
        pivot = origin + base @ deviation.pivot
        rotation = rotation_about(axis, amount)
        center = pivot + rotation @ (center - pivot)
        axes = rotation @ axes
    return center + np.array([m.of(real)[frame] for m in part.moves]), axes


def _has_axes(center: object, reference: Sequence[str]) -> bool:
    """Return whether a center states a coordinate along each axis of a reference."""
    return isinstance(center, dict) and set(reference) <= center.keys()


def _orthonormal(u: FloatArray, w: FloatArray) -> FloatArray | None:
    """Return the axes u, v = w x u, w, of unit length, as columns (3, 3); None if u and w
    are not at right angles, or one is zero.
    """
    lengths = np.linalg.norm(u), np.linalg.norm(w)
    if min(lengths) == 0.0 or abs(u @ w) > 1e-6 * lengths[0] * lengths[1]:
        return None
    u = u / lengths[0]
    w = w / lengths[1]
    v = np.cross(w, u)
    return np.stack([u, v / np.linalg.norm(v), w], axis=1)


def _fit_to_frames(values: FloatArray, count: int) -> FloatArray:
    """Fit drift values to the frames, (count,): the first at the first frame, the last at
    the last, linearly between; a single one, or the first of several for a single frame,
    is repeated.
    """
    if len(values) == 1 or count == 1:
        return np.full(count, values[0])
    if len(values) == count:
        return values
    at = np.arange(count) * (len(values) - 1) / (count - 1)
    return np.interp(at, np.arange(len(values)), values)


def drifts_of(value: object) -> list[Any]:
    """List the drifts of a parameter ("drifts" or, in older documents, "drift"; one alone
    as a list); empty without any.
    """
    if isinstance(value, dict):
        found = value.get("drifts")
    else:
        found = None
    if found is None and isinstance(value, dict):
        found = value.get("drift")
    if found is None:
        return []
    return found if isinstance(found, list) else [found]


def _numeric(values: object) -> bool:
    """Return whether `values` is a list of finite numbers, without bools; True for an
    empty list.
    """
    return isinstance(values, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
        for v in values
    )
