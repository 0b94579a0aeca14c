"""Validated reading of JSON-able documents: each reader takes a value and its key path.

Documents are untrusted, so every reader either returns the right type or raises
PhantomError with the path, the value and the allowed ones. `Text`, `Number`, `Lengths`,
`Place` and `packed` make pydantic read the fields of a dataclass so.

`scene_to_dict` and `scene_from_dict` are a scene as such a document and back; shapes are
tagged by kind.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping
from dataclasses import fields as fields_of
from functools import partial
from typing import Annotated, Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BeforeValidator, PlainSerializer, PlainValidator

from flexdt.twin.calibration.bead_model import Tolerance
from flexdt.twin.errors import TwinError, shape_words
from flexdt.twin.projection import analytic_solids as analytic

MAX_ARRAY_BYTES: Final = 4 << 30
MAX_TEXT: Final = 4096
MAX_NUMBER: Final = 1e9
MIN_LENGTH_MM: Final = 1e-9
"""Smallest length [mm]."""
_T = TypeVar("_T")
Reader = Callable[[object, str], Any]
NO_READERS: Final[Mapping[str, Reader]] = {}
NAMED_ALREADY: Final = "it"
"""Key path of a field that pydantic has named already."""
MAX_SOLIDS: Final = 100_000
_KINDS: Final[Mapping[str, type[analytic.Shape]]] = {
    "sphere": analytic.Sphere,
    "box": analytic.Box,
    "cylinder": analytic.Cylinder,
    "ellipsoid": analytic.Ellipsoid,
    "convex": analytic.ConvexPolyhedron,
}
_KIND_OF: Final[Mapping[type[analytic.Shape], str]] = {
    cls: kind for kind, cls in _KINDS.items()
}
_OPTIONAL_FIELDS: Final = ("axis", "axes")


class PhantomError(TwinError):
    """A phantom that cannot be built: value, allowed values and place."""


def wrong(value: object, where: str, allowed: str) -> PhantomError:
    """Make (do not raise) the error for a value that is not `allowed` at a key path."""
    shown = repr(value)
    if len(shown) > 80:
        shown = shown[:77] + "..."
    return PhantomError.instead(f"{where} is {shown}", shown, allowed, path=where)


def mapping(value: object, where: str) -> Mapping[str, object]:
    """Return `value` if it is an object with named fields; raise PhantomError otherwise."""
    if not isinstance(value, Mapping):
        raise wrong(value, where, "an object")
    return value


def get(document: object, key: str, where: str) -> object:
    """Return field `key` of `document`; raise PhantomError if that is no mapping or has no
    `key`.
    """
    given = mapping(document, where)
    if key not in given:
        raise PhantomError(f"{where}.{key} is missing", {"path": f"{where}.{key}"})
    return given[key]


def fields(
    value: object,
    where: str,
    needed: Mapping[str, Reader],
    others: Mapping[str, Reader] = NO_READERS,
) -> dict[str, Any]:
    """Read the fields of an object; a key without a reader is an error.

    `needed` and `others` (may be left out): name -> reader. Returns name -> its result,
    of those given. Raises PhantomError: no object, a missing or unknown key, or a
    reader's error; with the key path `where`.
    """
    readers = {**needed, **others}
    for key in mapping(value, where):
        if key not in readers:
            message = f"{where}: unknown key {key!r}"
            raise PhantomError.instead(message, key, list(readers), path=f"{where}.{key}")
    given = {name: get(value, name, where) for name in needed} | dict(
        mapping(value, where)
    )
    return {name: readers[name](one, f"{where}.{name}") for name, one in given.items()}


def string(value: object, where: str) -> str:
    """Return `value` if it is a text of bounded length; raise PhantomError otherwise."""
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise wrong(value, where, f"a text of at most {MAX_TEXT} characters")
    return value


def number(value: object, where: str) -> float:
    """Return `value` as a float if it is a number from -`MAX_NUMBER` to `MAX_NUMBER`;
    raise PhantomError, with the key path `where`, otherwise.

    Truth values and NaN are no numbers.
    """
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not abs(value) <= MAX_NUMBER
    ):
        raise wrong(value, where, f"a number from {-MAX_NUMBER:g} to {MAX_NUMBER:g}")
    return float(value)


def positive(value: object, where: str) -> float:
    """Return `value` as a float if it is a number from `MIN_LENGTH_MM` to `MAX_NUMBER`;
    raise PhantomError otherwise."""
    length = number(value, where)
    if length < MIN_LENGTH_MM:
        raise wrong(value, where, f"a number from {MIN_LENGTH_MM:g} to {MAX_NUMBER:g}")
    return length


def each(value: object, where: str, read: Callable[[object, str], _T]) -> tuple[_T, ...]:
    """Read a list, each item by `read` with its key path; raise PhantomError for another value."""
    if not isinstance(value, list | tuple):
        raise wrong(value, where, "a list")
    return tuple(read(item, f"{where}[{i}]") for i, item in enumerate(value))


def vector(value: object, where: str) -> analytic.Vector:
    """Return `value` as three finite numbers; raise PhantomError otherwise."""
    return _three(value, where, number)


def lengths(value: object, where: str) -> analytic.Vector:
    """Return `value` as three numbers above 0 [mm]; raise PhantomError otherwise."""
    return _three(value, where, positive)


def spread(value: object, where: str) -> float:
    """Return `value` as a standard deviation, 0 or more; raise PhantomError otherwise."""
    found = number(value, where)
    if found < 0.0:
        raise wrong(value, where, f"a standard deviation from 0 to {MAX_NUMBER:g}")
    return found


def tolerance(value: object, where: str) -> Tolerance:
    """Read how well a phantom is known: its source, and bead_mm (one figure, or a list of one
    for each bead), scale, or both.

    Raises:
        PhantomError: names the key path, the value and the allowed ones.
    """
    if isinstance(value, Tolerance):
        return value

    def beads(own: object, at: str) -> float | tuple[float, ...]:
        """Read the figure of all beads, or those of each."""
        if isinstance(own, list | tuple):
            return each(own, at, spread)
        return spread(own, at)

    given = fields(value, where, {"source": string}, {"bead_mm": beads, "scale": spread})
    try:
        return Tolerance(**given)
    except TwinError as error:
        raise PhantomError(f"{where}: {error.message}", {"path": where}) from None


def tolerance_document(stated: Tolerance) -> dict[str, object]:
    """Return a document of which `tolerance` makes an equal value."""
    own = {"bead_mm": stated.bead_mm, "scale": stated.scale}
    given = {name: value for name, value in own.items() if value is not None}
    return {"source": stated.source, **given}


def unit(value: object, where: str) -> analytic.Vector:
    """Return `value` as a vector (3,); raise PhantomError unless its length is 1 within 1e-6."""
    direction = vector(value, where)
    if abs(math.hypot(*direction) - 1.0) > 1e-6:
        raise wrong(value, where, "a unit vector")
    return direction


def axes(value: object, where: str) -> analytic.Matrix:
    """Return `value` as three unit vectors, orthogonal within 1e-6; raise PhantomError
    otherwise.

    Mirrored axes are allowed.
    """
    rows = each(value, where, unit)
    if len(rows) != 3 or not np.allclose(
        np.array(rows) @ np.array(rows).T, np.eye(3), atol=1e-6
    ):
        raise wrong(value, where, "three orthogonal unit vectors")
    return (rows[0], rows[1], rows[2])


Text = Annotated[str, BeforeValidator(partial(string, where=NAMED_ALREADY))]
Number = Annotated[float, BeforeValidator(partial(number, where=NAMED_ALREADY))]
Place = Annotated[analytic.Vector, BeforeValidator(partial(vector, where=NAMED_ALREADY))]
Lengths = Annotated[
    analytic.Vector, BeforeValidator(partial(lengths, where=NAMED_ALREADY))
]


def packed(dtype: str) -> PlainValidator:
    """Make the validator of an array of `dtype` that `PACK` wrote; nothing is executed.

    The array that it makes is read-only.

    Args:
        dtype: name of the array's type, such as float32.
    """

    def read(value: object) -> npt.NDArray[np.generic]:
        """Decode {dtype, shape, data} to a read-only array; `data` is base64.

        Args:
            value: the document of an array.

        Raises:
            PhantomError: another type than `dtype`, more than `MAX_ARRAY_BYTES`, no
                base64, or data of another length than the shape's.
        """
        if get(value, "dtype", NAMED_ALREADY) != dtype:
            raise wrong(get(value, "dtype", NAMED_ALREADY), "dtype", dtype)
        shape = each(get(value, "shape", NAMED_ALREADY), "shape", _count)
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size > MAX_ARRAY_BYTES:
            raise wrong(shape, "shape", f"at most {MAX_ARRAY_BYTES} bytes")
        try:
            raw = base64.b64decode(str(get(value, "data", NAMED_ALREADY)), validate=True)
        except ValueError as error:
            raise PhantomError(f"data is not base64: {error}") from None
        if len(raw) != size:
            raise wrong(
                f"{len(raw)} bytes",
                "data",
                f"{size} bytes, for shape {shape_words(shape)}",
            )
        return np.frombuffer(raw, dtype=dtype).reshape(shape)

    return PlainValidator(read)


def _pack(array: npt.NDArray[np.generic]) -> dict[str, object]:
    """Encode an array as {dtype, shape, data}: little-endian, C order, base64."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    data = base64.b64encode(little.tobytes()).decode("ascii")
    return {"dtype": little.dtype.str, "shape": list(array.shape), "data": data}


PACK: Final = PlainSerializer(_pack, when_used="json")
"""Serialises an array as `{dtype, shape, data}`, base64 in C order, little-endian."""


def _count(value: object, where: str) -> int:
    """Return `value` if it is a whole number from 0; raise PhantomError otherwise."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise wrong(value, where, "a whole number from 0")
    return value


def _three(
    value: object, where: str, read: Callable[[object, str], float]
) -> analytic.Vector:
    """Read three numbers, each by `read`; raise PhantomError for another count."""
    numbers = each(value, where, read)
    if len(numbers) != 3:
        raise wrong(value, where, "three numbers")
    return (numbers[0], numbers[1], numbers[2])


_READERS: Final[Mapping[str, Reader]] = {
    "center": vector,
    "size": lengths,
    "semi_axes": lengths,
    "radius": positive,
    "height": positive,
    "axis": unit,
    "axes": axes,
    "normals": lambda value, where: each(value, where, unit),
    "offsets": lambda value, where: each(value, where, number),
}
"""Reader of each field of a shape."""


def scene_to_dict(scene: analytic.Scene) -> dict[str, object]:
    """Convert a scene to a JSON-able document: `{solids: [{shape: {kind,
    ...}, material, mu_per_mm}]}`.

    The fields of each shape are as in the dataclass [mm].

    Args:
        scene: solids of any shape.

    Example:
        >>> from flexdt.phantoms import load_phantom
        >>> scene = load_phantom("normal-3").scene
        >>> len(scene_to_dict(scene)["solids"])
        4
    """
    return {
        "solids": [
            {
                "shape": {
                    "kind": _KIND_OF[type(s.shape)],
                    **{f.name: getattr(s.shape, f.name) for f in fields_of(s.shape)},
                },
                "material": s.material,
                "mu_per_mm": s.mu_per_mm,
            }
            for s in scene.solids
        ]
    }


def scene_from_dict(document: object, where: str = "scene") -> analytic.Scene:
    """Make a scene from a document of `scene_to_dict`.

    Raises:
        PhantomError: more than `MAX_SOLIDS` solids, or a missing or wrong value; names
            the key path, the value and the allowed ones.

    Example:
        >>> from flexdt.phantoms import load_phantom
        >>> scene = load_phantom("normal-3").scene
        >>> scene_from_dict(scene_to_dict(scene)) == scene
        True
    """
    solids = get(document, "solids", where)
    if isinstance(solids, list | tuple) and len(solids) > MAX_SOLIDS:
        raise wrong(f"{len(solids)} solids", f"{where}.solids", f"at most {MAX_SOLIDS}")
    return analytic.Scene(each(solids, f"{where}.solids", _solid))


def _solid(document: object, where: str) -> analytic.Solid:
    """Read a solid from its fields shape, material (any name) and mu_per_mm.

    Raises:
        PhantomError: one is missing or wrong, with its key path.
    """
    return analytic.Solid(
        shape_from_dict(get(document, "shape", where), f"{where}.shape"),
        string(get(document, "material", where), f"{where}.material"),
        number(get(document, "mu_per_mm", where), f"{where}.mu_per_mm"),
    )


def shape_from_dict(document: object, where: str) -> analytic.Shape:
    """Make a shape from a document `{kind, ...}`, whose other keys are the fields of the shape's
    class.

    `document`: of one shape; axis and axes may be left out. `where`: its key path.
    Raises PhantomError: an unknown kind, a missing or unknown field, or a wrong value; names the
    key path.
    """
    kind = get(document, "kind", where)
    if not isinstance(kind, str) or kind not in _KINDS:
        raise wrong(kind, f"{where}.kind", ", ".join(_KINDS))
    names = [f.name for f in fields_of(_KINDS[kind])]
    given = {key: one for key, one in mapping(document, where).items() if key != "kind"}
    needed = {name: _READERS[name] for name in names if name not in _OPTIONAL_FIELDS}
    others = {name: _READERS[name] for name in names if name in _OPTIONAL_FIELDS}
    return _KINDS[kind](**fields(given, where, needed, others))
