"""Phantom files, TOML or JSON: bead phantoms, scenes of several materials, and saved phantoms.

A bead file names a body and its beads, or requests a spiral of beads. A scene file lists solids and
meshes with their materials. The JSON of `Phantom.to_dict` is read as well. Unknown keys are errors,
so that a typing error is noticed.

A file that a client sends is held to what collisions and images can bear. It may say anything of
its size, and its solids may be many: the size is worked out from the content, and solids, triangles
and extent are bounded.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.phantoms import checked_reading as reading
from flexdt.phantoms.beads import cuboid_with_beads, spiral_positions, worst_overlap
from flexdt.phantoms.checked_reading import MAX_SOLIDS, PhantomError, shape_from_dict
from flexdt.phantoms.files.mesh_files import MAX_EXTENT_MM, MAX_FACES, UNITS_MM, mesh_phantom
from flexdt.phantoms.materials import material as material_of
from flexdt.phantoms.phantom import Phantom, assemble
from flexdt.phantoms.pieces import size_about_origin
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.projection import TriangleMesh
from flexdt.twin.projection.analytic_solids import Scene, Solid

CHECKED_ALONG: Final = 96
"""Voxels along the longest side in which `require_replaced` looks."""
ABSENT: Final = 0.25
"""Part of a voxel that may be replaced without being there."""
BEAD_KEYS: Final = ("schema", "name", "description", "body", "bead", "spiral")
SCENE_KEYS: Final = ("schema", "name", "description", "solid", "mesh")


def read_phantom_file(path: Path) -> Phantom:
    """The phantom of a TOML or JSON file; meshes that a scene names lie beside it.

    Raises:
        PhantomError: names file, key path, value and what is allowed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise PhantomError(f"cannot read {path}: {reason}", {"path": str(path)}) from None
    return load_phantom_file(text, str(path), path.parent)


def load_phantom_file(text: str, file: str = "<phantom>", folder: Path | None = None) -> Phantom:
    """The phantom of a TOML or JSON text.

    Args:
        text: content; JSON if it starts with a brace.
        file: name for error messages.
        folder: of the meshes that a scene names; without one, naming a mesh is an error.

    Raises:
        PhantomError: names file, key path, value and what is allowed.
    """
    try:
        document = json.loads(text) if text.lstrip()[:1] == "{" else tomllib.loads(text)
    except (json.JSONDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise PhantomError(f"{file}: not valid TOML or JSON: {error}", {"file": file}) from None
    try:
        return phantom_of(document, folder)
    except TwinError as error:
        raise PhantomError(f"{file}: {error.message}", {"file": file, **error.data}) from None


def phantom_of(document: Mapping[str, object], folder: Path | None = None) -> Phantom:
    """The phantom of a document in any of the three forms; raises as `load_phantom_file`."""
    if "scene" in document:
        return Phantom.from_dict(document)
    if "solid" in document or "mesh" in document:
        return _scene_file(document, folder)
    return _bead_file(document)


def _scene_file(document: Mapping[str, object], folder: Path | None) -> Phantom:
    _known(document, SCENE_KEYS, "phantom")
    if document.get("schema", 1) != 1:
        raise reading.wrong(document["schema"], "phantom.schema", "1")
    name = reading.string(document.get("name", "scene"), "phantom.name")
    told = reading.string(document.get("description", ""), "phantom.description")
    listed = reading.each(document.get("solid", []), "phantom.solid", solids_of)
    if len(listed) > MAX_SOLIDS:
        raise reading.wrong(f"{len(listed)} solids", "phantom.solid", f"at most {MAX_SOLIDS}")
    scene = Scene(tuple(solid for several in listed for solid in several))
    parts = [] if not listed else [Phantom(name, "", scene, size_about_origin(scene))]

    def read(value: object, where: str) -> tuple[Phantom, float]:
        rank = reading.number(_default(value, "priority", 0), f"{where}.priority")
        return _mesh(value, where, folder), rank

    meshes = reading.each(document.get("mesh", []), "phantom.mesh", read)
    ranks = [0.0] * len(parts) + [rank for _, rank in meshes]
    whole = assemble(name, parts + [mesh for mesh, _ in meshes], told, ranks)
    require_replaced(whole, document.get("solid", []))
    return whole


def require_replaced(phantom: Phantom, solids: object) -> None:
    """Check that what solids of a scene file, one or a list of anything, replace is there, once.

    Raises:
        PhantomError: names the material.
    """
    from flexdt.phantoms.voxelise import voxelise

    listed = solids if isinstance(solids, list | tuple) else [solids]
    told = [one["replaces"] for one in listed if isinstance(one, Mapping) and "replaces" in one]
    for name in dict.fromkeys(told):
        there = tuple(one for one in phantom.scene.solids if one.material == name)
        meshes = [one for one in phantom.surfaces if one.material == name]
        edge = max(phantom.size_mm) / CHECKED_ALONG
        least = float(voxelise(Scene(there), meshes, phantom.size_mm, edge, 2).data.min())
        if least < -ABSENT * material_of(name).mu_per_mm:
            raise PhantomError(
                f"{name} is replaced where there is none of it, or twice; allowed: inside solids "
                f"of {name} that are not replaced already",
                {"asked": name, "allowed": "inside it"},
            )


def solids_of(value: object, where: str) -> tuple[Solid, ...]:
    """A solid `{kind, ..., material, replaces}` of a scene file, and the hole it fills."""
    fields = dict(reading.mapping(value, where))
    made_of = material_of(reading.string(reading.get(fields, "material", where), where))
    instead = fields.pop("replaces", None)
    del fields["material"]
    shape = shape_from_dict(fields, where)
    own = Solid(shape, made_of.name, made_of.mu_per_mm)
    if instead is None:
        return (own,)
    gone = material_of(reading.string(instead, f"{where}.replaces"))
    return (Solid(shape, gone.name, -gone.mu_per_mm), own)


def _mesh(value: object, where: str, folder: Path | None) -> Phantom:
    _known(value, ("file", "material", "unit", "position_mm", "priority"), where)
    file = reading.string(reading.get(value, "file", where), f"{where}.file")
    if folder is None:
        raise PhantomError(
            f"{where}.file is {file!r}, but a text by itself has no folder to look in; read the "
            "scene from its file, or send it as `flexdt sample FILE` does, with the mesh inside",
            {"path": f"{where}.file", "asked": file},
        )
    unit = _default(value, "unit", None)
    if unit is not None and unit not in UNITS_MM:
        raise reading.wrong(unit, f"{where}.unit", ", ".join(UNITS_MM))
    at = _default(value, "position_mm", None)
    return mesh_phantom(
        folder / file,
        unit=None if unit is None else str(unit),
        material=reading.string(reading.get(value, "material", where), f"{where}.material"),
        place="keep" if at is None else "center",
        at_mm=(0.0, 0.0, 0.0) if at is None else reading.vector(at, f"{where}.position_mm"),
    )


def _bead_file(document: Mapping[str, object]) -> Phantom:
    _known(document, BEAD_KEYS, "phantom")
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
            said = f"{where}: unknown key {key!r}"
            raise PhantomError.instead(said, key, allowed, path=f"{where}.{key}")


def _default(value: object, key: str, default: object) -> object:
    return reading.mapping(value, "phantom").get(key, default)


MAX_SENT_SOLIDS: Final = 500
"""Each becomes up to 1280 triangles where shapes are drawn and checked for collisions."""


def sent_scene(text: bytes, *, name: str) -> Phantom:
    """The phantom of a text that names no other file.

    Args:
        text: UTF-8, TOML or JSON.
        name: the phantom gets; also for errors.

    Raises:
        PhantomError, UnknownNameError: names the key path, the value and what is allowed.
    """
    try:
        document = text.decode("utf-8")
    except UnicodeDecodeError:
        raise PhantomError(f"{name}: not UTF-8 text", {"asked": name}) from None
    phantom = load_phantom_file(document, name)
    solids, faces = phantom.scene.solids, sum(len(one.faces) for one in phantom.surfaces)
    for what, count, most in (
        ("solids", len(solids), MAX_SENT_SOLIDS),
        ("triangles", faces, MAX_FACES),
    ):
        if count > most:
            raise PhantomError.instead(f"{name} has {count} {what}", count, most)
    if phantom.voxels is not None and not phantom.is_voxels:
        raise PhantomError(f"{name}: voxels cannot be put together with other parts")
    for surface in phantom.surfaces:
        try:
            TriangleMesh(surface.vertices, surface.faces.astype("int64"))
        except GeometryError as error:
            raise PhantomError(f"{name}: {error.message}", error.data) from None
    size = phantom.size_mm
    if not phantom.is_voxels:
        own = size_about_origin(phantom.scene, phantom.surfaces)
        size = (max(size[0], own[0]), max(size[1], own[1]), max(size[2], own[2]))
    if max(size) > MAX_EXTENT_MM:
        said = f"{name} measures {max(size):g} mm about its axis"
        raise PhantomError.instead(said, max(size), f"{MAX_EXTENT_MM:g} mm")
    return replace(phantom, name=name, size_mm=size)
