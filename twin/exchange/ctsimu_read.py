"""A CTSimU scenario (file formats 1.0 to 1.2) to the geometry of its frames.

Centres, orientations, deviations about any axis and pivot and drifts of all amounts are evaluated
frame by frame, once as reconstruction knows them and once as they really are. The object's frame is
the stage's (u, v, w). Parallel beams, drifts in separate files, drifting axes and files older than
1.0 are errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.geometry_json import read_json
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.geometry.conventions import FloatArray, rotation_about

MAX_FRAMES: Final = 1_000_000
MAX_MINOR: Final = 2
_MM: Final = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "dm": 100.0, "um": 1e-3, "nm": 1e-6}
_RAD: Final = {"rad": 1.0, "deg": math.pi / 180.0}
_NONE: Final = {None: 1.0}
_WORLD, _LOCAL = "xyz", "uvw"
_SAMPLE = "rst"
"""A sample's own axes; for source, detector and stage CTSimU takes them for the local ones."""
_AXES: Final = {
    name: (reference, tuple(float(name == other) for other in reference))
    for reference in (_WORLD, _LOCAL)
    for name in reference
} | {name: (_LOCAL, tuple(float(name == other) for other in _SAMPLE)) for name in _SAMPLE}


@dataclass(frozen=True, eq=False)
class _Frames:
    """A number per frame, as reconstruction knows it and as it is."""

    known: FloatArray
    real: FloatArray

    def of(self, real: bool) -> FloatArray:
        return self.real if real else self.known


@dataclass(frozen=True, eq=False)
class _Deviation:
    turn: bool
    reference: str
    axis: FloatArray
    pivot_reference: str
    pivot: FloatArray
    amount: _Frames
    known: bool


@dataclass(frozen=True, eq=False)
class _Part:
    center: FloatArray
    axes: FloatArray
    moves: tuple[_Frames, _Frames, _Frames]
    deviations: tuple[_Deviation, ...]


def read_ctsimu(text: str, file: str = "<scenario>") -> ScanGeometry:
    """The geometry of a scenario: `cone_vec` as reconstruction knows it, `real` where it differs.

    Raises:
        ExchangeError: names file, key and what is allowed.
    """
    return _Reader(read_json(text, file), file).geometry()


class _Reader:
    def __init__(self, document: Mapping[str, Any], file: str) -> None:
        self._document, self._file = document, file
        self._check_version()
        self._count = self._whole("acquisition", "number_of_projections")
        if not 1 <= self._count <= MAX_FRAMES:
            raise self._error("acquisition.number_of_projections", f"from 1 to {MAX_FRAMES}")

    def geometry(self) -> ScanGeometry:
        source_type = self._at("geometry", "source").get("type", "cone")
        if source_type not in (None, "cone"):
            raise self._error("geometry.source.type", "cone")
        parts = {name: self._part(name) for name in ("source", "detector", "stage")}
        pitch = [self._number(("detector", "pixel_pitch", axis), _MM) for axis in "uv"]
        cols, rows = (self._size(name) for name in ("columns", "rows"))
        bins = self._bins(rows, cols)
        if min(pitch) <= 0.0:
            raise self._error("detector.pixel_pitch", "above 0")
        angle = self._angles()
        rows_of = [
            self._rows(parts, angle, (pitch[0] * bins[0], pitch[1] * bins[1]), real)
            for real in (False, True)
        ]
        known, real = (cone_vec_of(r, self._file) for r in rows_of)
        same = np.array_equal(known.rows, real.rows)
        name = self._at("file").get("name")
        return ScanGeometry(
            known,
            (rows // bins[1], cols // bins[0]),
            None if same else real,
            name if isinstance(name, str) else "",
            notes=() if same else ("some deviations or drifts are unknown to reconstruction",),
        )

    def _bins(self, rows: int, cols: int) -> tuple[int, int]:
        """Pixels to bin along u and v; what fills no binned pixel is cut off on both sides."""
        where = "acquisition.pixel_binning"
        binning = self._at("acquisition").get("pixel_binning")
        if binning is None:
            return 1, 1
        found = [binning.get(a, 1) if isinstance(binning, dict) else None for a in "uv"]
        u, v = (1 if b is None and isinstance(binning, dict) else b for b in found)
        if type(u) is not int or type(v) is not int or not (1 <= u <= cols and 1 <= v <= rows):
            raise self._error(where, "u and v, whole numbers from 1 to the detector's size")
        return u, v

    def _rows(
        self,
        parts: Mapping[str, _Part],
        angle: FloatArray,
        pitch: tuple[float, float],
        real: bool,
    ) -> FloatArray:
        out = np.empty((self._count, 12))
        still = np.zeros(self._count)
        for i in range(self._count):
            source, _ = _place(parts["source"], still, i, real)
            detector, panel = _place(parts["detector"], still, i, real)
            center, axes = _place(parts["stage"], angle, i, real)
            u, v = panel[:, 0] * pitch[0], panel[:, 1] * pitch[1]
            vectors = (source - center, detector - center, u, v)
            out[i] = np.concatenate([axes.T @ vector for vector in vectors])
        return out

    def _angles(self) -> FloatArray:
        """The stage's turn about its w, [rad] per frame."""
        acquisition = self._at("acquisition")
        start = self._number(("acquisition", "start_angle"), _RAD)
        stop = self._number(("acquisition", "stop_angle"), _RAD)
        if start > stop:
            raise self._error("acquisition.stop_angle", "not below start_angle")
        final = acquisition.get("include_final_angle", True)
        steps = self._count - 1 if final in (True, None) else self._count
        angles = start + np.arange(self._count) * (stop - start) / max(1, steps)
        direction = acquisition.get("direction") or "CCW"
        if direction not in ("CW", "CCW"):
            raise self._error("acquisition.direction", "CW or CCW")
        return -angles if direction == "CW" else angles

    def _part(self, name: str) -> _Part:
        where = f"geometry.{name}"
        part = self._at("geometry", name)
        if part.get("deviation") or part.get("centre"):
            raise self._error(where, "the form of file format 1.0 and later (center, deviations)")
        center = part.get("center")
        if not isinstance(center, dict) or not set(_WORLD) <= center.keys():
            raise self._error(f"{where}.center", "x, y and z")
        moves = [self._frames(center[a], f"{where}.center.{a}", _MM) for a in _WORLD]
        start = [self._value(center[a], f"{where}.center.{a}", _MM) for a in _WORLD]
        u, w = (self._vector(part.get(f"vector_{a}"), f"{where}.vector_{a}") for a in "uw")
        if u[0] != _WORLD or w[0] != _WORLD:
            raise self._error(where, "vector_u and vector_w in x, y and z")
        axes = _orthonormal(u[1], w[1])
        if axes is None:
            raise self._error(where, "vector_u and vector_w at right angles")
        deviations = part.get("deviations") or []
        if isinstance(deviations, dict):
            deviations = [deviations]
        if not isinstance(deviations, list):
            raise self._error(f"{where}.deviations", "a list")
        rest = [_Frames(m.known - s, m.real - s) for m, s in zip(moves, start, strict=True)]
        return _Part(
            np.array(start),
            axes,
            (rest[0], rest[1], rest[2]),
            tuple(self._deviation(d, f"{where}.deviations[{i}]")
                  for i, d in enumerate(deviations)),
        )  # fmt: skip

    def _deviation(self, value: object, where: str) -> _Deviation:
        if not isinstance(value, dict) or value.get("type") not in ("translation", "rotation"):
            raise self._error(where, "an object with type translation or rotation")
        turn = value["type"] == "rotation"
        axis = value.get("axis")
        if isinstance(axis, str) and axis in _AXES:
            reference, direction = _AXES[axis][0], np.array(_AXES[axis][1])
        elif isinstance(axis, dict):
            reference, direction = self._vector(axis, f"{where}.axis")
        else:
            raise self._error(f"{where}.axis", "x, y, z, u, v, w or a vector of them")
        pivot_reference, pivot = _LOCAL, np.zeros(3)
        if value.get("pivot") is not None:
            pivot_reference, pivot = self._vector(value["pivot"], f"{where}.pivot", _MM)
        amount = self._frames(value.get("amount"), f"{where}.amount", _RAD if turn else _MM)
        known = value.get("known_to_reconstruction")
        length = float(np.linalg.norm(direction))
        if length == 0.0:
            raise self._error(f"{where}.axis", "a vector of some length")
        return _Deviation(turn, reference, direction / length, pivot_reference, pivot, amount,
                          known is not False)  # fmt: skip

    def _vector(
        self, value: object, where: str, units: Mapping[Any, float] = _NONE
    ) -> tuple[str, FloatArray]:
        if isinstance(value, dict):
            for reference in (_WORLD, _LOCAL, _SAMPLE):
                if set(reference) <= value.keys():
                    for a in reference:
                        if _drifts(value[a]):
                            raise self._error(f"{where}.{a}", "a vector without drifts")
                    parts = [self._value(value[a], f"{where}.{a}", units) for a in reference]
                    return (_WORLD if reference == _WORLD else _LOCAL), np.array(parts)
        raise self._error(where, "three components x, y, z or u, v, w")

    def _frames(self, value: object, where: str, units: Mapping[Any, float]) -> _Frames:
        """A parameter with its drifts at every frame."""
        standard = self._value(value, where, units)
        known = np.full(self._count, standard)
        real = known.copy()
        for i, drift in enumerate(_drifts(value)):
            at = f"{where}.drifts[{i}]"
            if not isinstance(drift, dict) or drift.get("file"):
                raise self._error(at, "drifts with values in this file")
            values = drift.get("value")
            if isinstance(values, int | float) and not isinstance(values, bool):
                values = [values]
            if values in (None, []):
                continue
            if not _numeric(values):
                raise self._error(f"{at}.value", "a list of numbers")
            unit = drift.get("unit") or (value.get("unit") if isinstance(value, dict) else None)
            amounts = np.array(values, dtype=np.float64) * self._factor(unit, units, at)
            over = _interpolated(amounts, self._count)
            real = real + over
            if drift.get("known_to_reconstruction") is not False:
                known = known + over
        return _Frames(known, real)

    def _value(self, value: object, where: str, units: Mapping[Any, float]) -> float:
        entry = value if isinstance(value, dict) else {"value": value}
        number = entry.get("value")
        if not _numeric([number]) or not isinstance(number, int | float):
            raise self._error(where, "a number")
        return float(number) * self._factor(entry.get("unit"), units, where)

    def _factor(self, unit: object, units: Mapping[Any, float], where: str) -> float:
        if units is _NONE:
            return 1.0
        if unit is None:
            unit = next(iter(units))
        if unit not in units:
            raise self._error(f"{where}.unit", ", ".join(units))
        return units[unit]

    def _number(self, path: Sequence[str], units: Mapping[Any, float]) -> float:
        value: object = self._at(*path[:-1]).get(path[-1])
        return self._value(value, ".".join(path), units)

    def _size(self, name: str) -> int:
        value = self._number(("detector", name), _NONE)
        if not value.is_integer() or not 1 <= value <= 1e6:
            raise self._error(f"detector.{name}", "a whole number above 0")
        return int(value)

    def _whole(self, *path: str) -> int:
        value = self._at(*path[:-1]).get(path[-1])
        if isinstance(value, dict):
            value = value.get("value")
        if isinstance(value, bool) or not isinstance(value, int):
            raise self._error(".".join(path), "a whole number")
        return value

    def _at(self, *path: str) -> Mapping[str, Any]:
        found: Any = self._document
        for i, key in enumerate(path):
            found = found.get(key) if isinstance(found, dict) else None
            if not isinstance(found, dict):
                raise self._error(".".join(path[: i + 1]), "an object")
        return found  # type: ignore[no-any-return]

    def _check_version(self) -> None:
        about = self._at("file")
        version = about.get("file_format_version")
        said = version if isinstance(version, dict) else {}
        major, minor = said.get("major"), said.get("minor")
        fits = major == 1 and isinstance(minor, int) and minor <= MAX_MINOR
        if about.get("file_type") != "CTSimU Scenario" or not fits:
            raise ExchangeError(
                f"{self._file}: file_type {about.get('file_type')!r}, format {major}.{minor}; "
                f"allowed: CTSimU Scenario, 1.0 to 1.{MAX_MINOR}",
                {"path": "file", "allowed": ["1.0", f"1.{MAX_MINOR}"]},
            )

    def _error(self, where: str, allowed: str) -> ExchangeError:
        return ExchangeError(
            f"{self._file}: {where} does not hold; allowed: {allowed}",
            {"path": where, "allowed": allowed},
        )


def _place(part: _Part, turn: FloatArray, frame: int, real: bool) -> tuple[FloatArray, FloatArray]:
    """Centre (3,) and axes u, v, w as columns (3, 3) of a part in one frame, in the world."""
    center, axes = part.center.copy(), part.axes
    if turn[frame] != 0.0:
        axes = rotation_about(axes[:, 2], float(turn[frame])) @ axes
    for deviation in part.deviations:
        if not real and not deviation.known:
            continue
        amount = float(deviation.amount.of(real)[frame])
        axis = deviation.axis if deviation.reference == _WORLD else axes @ deviation.axis
        if not deviation.turn:
            center = center + amount * axis
            continue
        pivot = deviation.pivot
        if deviation.pivot_reference == _LOCAL:
            pivot = center + axes @ pivot
        rotation = rotation_about(axis, amount)
        center, axes = pivot + rotation @ (center - pivot), rotation @ axes
    return center + np.array([m.of(real)[frame] for m in part.moves]), axes


def _orthonormal(u: FloatArray, w: FloatArray) -> FloatArray | None:
    lengths = np.linalg.norm(u), np.linalg.norm(w)
    if min(lengths) == 0.0 or abs(u @ w) > 1e-6 * lengths[0] * lengths[1]:
        return None
    u, w = u / lengths[0], w / lengths[1]
    v = np.cross(w, u)
    return np.stack([u, v / np.linalg.norm(v), w], axis=1)


def _interpolated(values: FloatArray, count: int) -> FloatArray:
    """Drift values over the frames: the first at the first frame, the last at the last."""
    if len(values) == 1 or count == 1:
        return np.full(count, values[0])
    if len(values) == count:
        return values
    at = np.arange(count) * (len(values) - 1) / (count - 1)
    return np.interp(at, np.arange(len(values)), values)


def _drifts(value: object) -> list[Any]:
    found = value.get("drifts") if isinstance(value, dict) else None
    if found is None and isinstance(value, dict):
        found = value.get("drift")
    if found is None:
        return []
    return found if isinstance(found, list) else [found]


def _numeric(values: object) -> bool:
    return isinstance(values, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values
    )
