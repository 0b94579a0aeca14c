"""Scenes as JSON-able documents and back, for the wire and for files.

Shapes are tagged by kind. Every field is validated by `checked_reading`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Final

from flexdt.phantoms import checked_reading as reading
from flexdt.phantoms.checked_reading import PhantomError, each, get, number, wrong
from flexdt.twin.projection.analytic_solids import (
    Box,
    ConvexPolyhedron,
    Cylinder,
    Ellipsoid,
    Scene,
    Shape,
    Solid,
    Sphere,
)

MAX_SOLIDS: Final = 100_000

_KINDS: Final[Mapping[str, type[Shape]]] = {
    "sphere": Sphere,
    "box": Box,
    "cylinder": Cylinder,
    "ellipsoid": Ellipsoid,
    "convex": ConvexPolyhedron,
}
_KIND_OF: Final[Mapping[type[Shape], str]] = {cls: kind for kind, cls in _KINDS.items()}

_READERS: Final[Mapping[str, Callable[[object, str], object]]] = {
    "center": reading.vector,
    "size": reading.lengths,
    "semi_axes": reading.lengths,
    "radius": reading.positive,
    "height": reading.positive,
    "axis": reading.unit,
    "axes": reading.axes,
    "normals": lambda value, where: each(value, where, reading.unit),
    "offsets": lambda value, where: each(value, where, number),
}
"""How each field of a shape is read."""

_OPTIONAL: Final = ("axis", "axes")


def scene_to_dict(scene: Scene) -> dict[str, object]:
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
                    **{f.name: getattr(s.shape, f.name) for f in fields(s.shape)},
                },
                "material": s.material,
                "mu_per_mm": s.mu_per_mm,
            }
            for s in scene.solids
        ]
    }


def scene_from_dict(document: object, where: str = "scene") -> Scene:
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
    return Scene(each(solids, f"{where}.solids", _solid))


def _solid(document: object, where: str) -> Solid:
    return Solid(
        shape_from_dict(get(document, "shape", where), f"{where}.shape"),
        reading.string(get(document, "material", where), f"{where}.material"),
        number(get(document, "mu_per_mm", where), f"{where}.mu_per_mm"),
    )


def shape_from_dict(document: object, where: str) -> Shape:
    """The shape of `{kind, ...}`; raises PhantomError naming the key path."""
    kind = get(document, "kind", where)
    if not isinstance(kind, str) or kind not in _KINDS:
        raise wrong(kind, f"{where}.kind", ", ".join(_KINDS))
    given = reading.mapping(document, where)
    names = [f.name for f in fields(_KINDS[kind])]
    unknown = sorted(str(key) for key in given if key not in (*names, "kind"))
    if unknown:
        said = f"{where}: a {kind} has no {', '.join(unknown)}"
        raise PhantomError.instead(said, unknown, names, path=where)
    values: dict[str, Any] = {
        name: _READERS[name](get(given, name, where), f"{where}.{name}")
        for name in names
        if name in given or name not in _OPTIONAL
    }
    return _KINDS[kind](**values)
