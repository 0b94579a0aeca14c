"""Phantom files: bead phantoms of the user's own as TOML or JSON, and saved phantoms.

A bead file names a body and its beads, or asks for a spiral; `Phantom.to_dict` as JSON is read as
well. It takes the text, not a path, and refuses unknown keys, so that a typing error is not lost.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from typing import Final

import numpy as np

from flexdt.phantoms import reading
from flexdt.phantoms.beads import cuboid_with_beads, spiral_positions, worst_overlap
from flexdt.phantoms.model import Phantom
from flexdt.phantoms.pieces import PhantomError
from flexdt.twin.errors import TwinError

MAX_TEXT_BYTES: Final = 256 << 20
EXAMPLE: Final = """\
schema = 1
name = "mine"
description = "two steel beads in a PMMA block"

[body]                          # leave out for beads in air
size_mm = [20, 20, 40]          # along x, y, z; centred on the rotation axis
material = "pmma"

[[bead]]
position_mm = [5, 0, -12]       # object frame: x right, y away from the source, z up at rot_obj = 0
radius_mm = 1
material = "steel"              # the default

[[bead]]
position_mm = [0, 6, 12]
radius_mm = 1
"""
"""A bead file with two beads; `[spiral] beads = 5, radius_mm = 2` may stand for the beads."""


def load_phantom_file(text: str, file: str = "<phantom>") -> Phantom:
    """The phantom of a TOML or JSON text.

    Args:
        text: content; JSON if it starts with a brace.
        file: name for error messages.

    Raises:
        PhantomError: names file, key path, value and what is allowed.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise PhantomError(f"{file}: {len(text)} characters; allowed: {MAX_TEXT_BYTES}")
    try:
        document = json.loads(text) if text.lstrip()[:1] == "{" else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise PhantomError(f"{file}: not valid TOML or JSON: {error}", {"file": file}) from None
    try:
        return Phantom.from_dict(document) if "scene" in document else _bead_file(document)
    except TwinError as error:
        raise PhantomError(f"{file}: {error.message}", {"file": file, **error.data}) from None


def _bead_file(document: Mapping[str, object]) -> Phantom:
    _known(document, ("schema", "name", "description", "body", "bead", "spiral"), "phantom")
    if reading.get(document, "schema", "phantom") != 1:
        raise reading.wrong(document["schema"], "phantom.schema", "1")
    name = reading.string(reading.get(document, "name", "phantom"), "phantom.name")
    body, size = None, None
    if "body" in document:
        _known(document["body"], ("size_mm", "material"), "phantom.body")
        size = reading.lengths(reading.get(document["body"], "size_mm", "phantom.body"), "body")
        body = reading.string(_default(document["body"], "material", "abs"), "body.material")
    if ("bead" in document) == ("spiral" in document):
        raise PhantomError("phantom: give either [[bead]] tables or one [spiral]")
    if "spiral" in document:
        if size is None:
            raise PhantomError("phantom.spiral: a spiral needs a [body] to fit into")
        where = "phantom.spiral"
        _known(document["spiral"], ("beads", "radius_mm", "material"), where)
        count = reading.positive(reading.get(document["spiral"], "beads", where), f"{where}.beads")
        if count != int(count):
            raise reading.wrong(count, f"{where}.beads", "a whole number")
        radius = reading.positive(_default(document["spiral"], "radius_mm", 2.0), where)
        metal = reading.string(_default(document["spiral"], "material", "steel"), where)
        centers = spiral_positions(size, int(count), radius)
        radii, metals = np.full(len(centers), radius), (metal,) * len(centers)
    else:
        beads = reading.each(document["bead"], "phantom.bead", _bead)
        centers = np.array([b[0] for b in beads], dtype=np.float64).reshape(-1, 3)
        radii, metals = np.array([b[1] for b in beads]), tuple(b[2] for b in beads)
    overlap = worst_overlap(centers, radii)
    if overlap is not None and "bead" in document:
        raise PhantomError(
            f"phantom.bead: beads {overlap[0]} and {overlap[1]} overlap by {overlap[2]:.4g} mm; "
            "attenuation is additive, so solids must not overlap",
            {"beads": [overlap[0], overlap[1]], "asked": -overlap[2], "allowed": ">= 0"},
        )
    if size is None:
        x, y, z = (2.0 * np.max(np.abs(centers) + radii[:, None], axis=0)).tolist()
        size = (x, y, z)
    default = f"{len(centers)} beads in {body if body is not None else 'air'}"
    return cuboid_with_beads(
        name,
        size,
        centers,
        radii,
        body_material=body,
        bead_materials=metals,
        description=reading.string(document.get("description", default), "phantom.description"),
    )


def _bead(value: object, where: str) -> tuple[tuple[float, float, float], float, str]:
    _known(value, ("position_mm", "radius_mm", "material"), where)
    return (
        reading.vector(reading.get(value, "position_mm", where), f"{where}.position_mm"),
        reading.positive(reading.get(value, "radius_mm", where), f"{where}.radius_mm"),
        reading.string(_default(value, "material", "steel"), f"{where}.material"),
    )


def _known(value: object, allowed: tuple[str, ...], where: str) -> None:
    for key in reading.mapping(value, where):
        if key not in allowed:
            raise PhantomError(
                f"{where}: unknown key {key!r}; allowed: {', '.join(allowed)}",
                {"path": f"{where}.{key}", "asked": key, "allowed": list(allowed)},
            )


def _default(value: object, key: str, default: object) -> object:
    return reading.mapping(value, "phantom").get(key, default)
