"""Validated reading of JSON-able documents: each reader takes a value and its key path.

Documents come from outside, so every reader either returns the right type or raises PhantomError
with the path, the value and what is allowed. `Text`, `Number`, `Lengths`, `Place` and `packed` make
pydantic read the fields of a dataclass so.

`scene_to_dict` and `scene_from_dict` are a scene as such a document and back; shapes are tagged by
kind.
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

from flexdt.twin.errors import TwinError
from flexdt.twin.projection import analytic_solids as analytic

MAX_ARRAY_BYTES: Final = 4 << 30
MAX_TEXT: Final = 4096
LARGEST: Final = 1e9
SMALLEST: Final = 1e-9
"""Of lengths [mm]."""
_T = TypeVar("_T")
Reader = Callable[[object, str], Any]
NONE: Final[Mapping[str, Reader]] = {}
IT: Final = "it"
"""The key path of a field that pydantic has named already."""
MAX_SOLIDS: Final = 100_000
_KINDS: Final[Mapping[str, type[analytic.Shape]]] = {
    "sphere": analytic.Sphere,
    "box": analytic.Box,
    "cylinder": analytic.Cylinder,
    "ellipsoid": analytic.Ellipsoid,
    "convex": analytic.ConvexPolyhedron,
}
_KIND_OF: Final[Mapping[type[analytic.Shape], str]] = {cls: kind for kind, cls in _KINDS.items()}
_OPTIONAL: Final = ("axis", "axes")


class PhantomError(TwinError):
    """A phantom that cannot be built: what was asked, what is allowed, where."""


def wrong(value: object, where: str, allowed: str) -> PhantomError:
    """The error for a value that is not what is `allowed` at key path `where`."""
    shown = repr(value)
    shown = shown if len(shown) <= 80 else shown[:77] + "..."
    return PhantomError.instead(f"{where} is {shown}", shown, allowed, path=where)


def mapping(value: object, where: str) -> Mapping[str, object]:
    """`value` as an object with named fields."""
    if not isinstance(value, Mapping):
        raise wrong(value, where, "an object")
    return value


def get(document: object, key: str, where: str) -> object:
    """Field `key` of `document`, which must have it."""
    given = mapping(document, where)
    if key not in given:
        raise PhantomError(f"{where}.{key} is missing", {"path": f"{where}.{key}"})
    return given[key]


def fields(
    value: object, where: str, needed: Mapping[str, Reader], others: Mapping[str, Reader] = NONE
) -> dict[str, Any]:
    """The fields of an object as their readers have them: all that are needed, and of the others
    those that are there. One that nobody reads is an error."""
    readers = {**needed, **others}
    for key in mapping(value, where):
        if key not in readers:
            said = f"{where}: unknown key {key!r}"
            raise PhantomError.instead(said, key, list(readers), path=f"{where}.{key}")
    given = {name: get(value, name, where) for name in needed} | dict(mapping(value, where))
    return {name: readers[name](one, f"{where}.{name}") for name, one in given.items()}


def string(value: object, where: str) -> str:
    """`value` as a text of bounded length."""
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise wrong(value, where, f"a text of at most {MAX_TEXT} characters")
    return value


def number(value: object, where: str) -> float:
    """`value` as a number within what the arithmetic behind bears."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise wrong(value, where, f"a number from {-LARGEST:g} to {LARGEST:g}")
    return float(value)


def positive(value: object, where: str) -> float:
    """`value` as a length above 0."""
    found = number(value, where)
    if found < SMALLEST:
        raise wrong(value, where, f"a number from {SMALLEST:g} to {LARGEST:g}")
    return found


def each(value: object, where: str, read: Callable[[object, str], _T]) -> tuple[_T, ...]:
    """`value` as a list of what `read` reads."""
    if not isinstance(value, list | tuple):
        raise wrong(value, where, "a list")
    return tuple(read(item, f"{where}[{i}]") for i, item in enumerate(value))


def vector(value: object, where: str) -> analytic.Vector:
    """`value` as three finite numbers."""
    return _three(value, where, number)


def lengths(value: object, where: str) -> analytic.Vector:
    """`value` as three numbers above 0."""
    return _three(value, where, positive)


def unit(value: object, where: str) -> analytic.Vector:
    """`value` as a unit vector."""
    found = vector(value, where)
    if abs(math.hypot(*found) - 1.0) > 1e-6:
        raise wrong(value, where, "a unit vector")
    return found


def axes(value: object, where: str) -> analytic.Matrix:
    """`value` as three orthogonal unit vectors."""
    rows = each(value, where, unit)
    if len(rows) != 3 or not np.allclose(np.array(rows) @ np.array(rows).T, np.eye(3), atol=1e-6):
        raise wrong(value, where, "three orthogonal unit vectors")
    return (rows[0], rows[1], rows[2])


Text = Annotated[str, BeforeValidator(partial(string, where=IT))]
Number = Annotated[float, BeforeValidator(partial(number, where=IT))]
Place = Annotated[analytic.Vector, BeforeValidator(partial(vector, where=IT))]
Lengths = Annotated[analytic.Vector, BeforeValidator(partial(lengths, where=IT))]


def packed(dtype: str) -> PlainValidator:
    """How pydantic reads an array of `dtype` that `PACK` wrote; nothing is executed."""

    def read(value: object) -> npt.NDArray[np.generic]:
        if get(value, "dtype", IT) != dtype:
            raise wrong(get(value, "dtype", IT), "dtype", dtype)
        shape = each(get(value, "shape", IT), "shape", _count)
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size > MAX_ARRAY_BYTES:
            raise wrong(shape, "shape", f"at most {MAX_ARRAY_BYTES} bytes")
        try:
            raw = base64.b64decode(str(get(value, "data", IT)), validate=True)
        except ValueError as error:
            raise PhantomError(f"data is not base64: {error}") from None
        if len(raw) != size:
            raise wrong(f"{len(raw)} bytes", "data", f"{size} bytes, for shape {shape}")
        return np.frombuffer(raw, dtype=dtype).reshape(shape)

    return PlainValidator(read)


def _pack(array: npt.NDArray[np.generic]) -> dict[str, object]:
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    data = base64.b64encode(little.tobytes()).decode("ascii")
    return {"dtype": little.dtype.str, "shape": list(array.shape), "data": data}


PACK: Final = PlainSerializer(_pack, when_used="json")
"""An array as `{dtype, shape, data}`, base64 in C order, little-endian."""


def _count(value: object, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise wrong(value, where, "a whole number from 0")
    return value


def _three(value: object, where: str, read: Callable[[object, str], float]) -> analytic.Vector:
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
"""How each field of a shape is read."""


def scene_to_dict(scene: analytic.Scene) -> dict[str, object]:
    """JSON-able document of a scene: `{solids: [{shape: {kind, ...}, material, mu_per_mm}]}`.

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
    """The scene of a document that `scene_to_dict` made.

    Raises:
        PhantomError: names the key path, the value and what is allowed.

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
    return analytic.Solid(
        shape_from_dict(get(document, "shape", where), f"{where}.shape"),
        string(get(document, "material", where), f"{where}.material"),
        number(get(document, "mu_per_mm", where), f"{where}.mu_per_mm"),
    )


def shape_from_dict(document: object, where: str) -> analytic.Shape:
    """The shape of `{kind, ...}`; raises PhantomError naming the key path."""
    kind = get(document, "kind", where)
    if not isinstance(kind, str) or kind not in _KINDS:
        raise wrong(kind, f"{where}.kind", ", ".join(_KINDS))
    names = [f.name for f in fields_of(_KINDS[kind])]
    given = {key: one for key, one in mapping(document, where).items() if key != "kind"}
    needed = {name: _READERS[name] for name in names if name not in _OPTIONAL}
    others = {name: _READERS[name] for name in names if name in _OPTIONAL}
    return _KINDS[kind](**fields(given, where, needed, others))
