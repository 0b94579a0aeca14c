"""Phantom files, TOML or JSON: bead phantoms, scenes of several materials, and saved phantoms.

A bead file names a body and its beads, or requests a spiral of beads. A scene file lists
solids and meshes with their materials. The JSON of `Phantom.to_dict` is read as well.
Unknown keys are errors, so that a typing error is noticed.

A file from a client is limited to content that collisions and images can bear. Its stated
size is not trusted, and its solids may be many: the size is worked out from the content,
and solids, triangles and extent are bounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.phantoms import checked_reading as reading
from flexdt.phantoms.beads import cuboid_with_beads, spiral_positions, worst_overlap
from flexdt.phantoms.checked_reading import MAX_SOLIDS, PhantomError, shape_from_dict
from flexdt.phantoms.files.mesh_files import MAX_EXTENT_MM, MAX_FACES, mesh_phantom
from flexdt.phantoms.phantom import Phantom, assemble
from flexdt.phantoms.pieces import size_about_origin
from flexdt.twin.attenuation.materials import material as material_of
from flexdt.twin.errors import FileError, GeometryError, TwinError
from flexdt.twin.input_limits import InputLimitError, parse_toml, read_limited
from flexdt.twin.json_text import BYTE_ORDER_MARK, parse_json
from flexdt.twin.length_units import UNITS_MM
from flexdt.twin.projection import TriangleMesh
from flexdt.twin.projection.analytic_solids import Scene, Solid, Vector

CHECKED_VOXELS_ALONG: Final = 96
"""Number of voxels along the longest side in which `require_replaced` looks."""
MAX_ABSENT_SHARE: Final = 0.25
"""Part of a voxel that may be replaced without being there."""
MAX_SENT_SOLIDS: Final = 500
"""Largest number of solids of a file that a client sends.

Each becomes up to 1280 triangles where shapes are drawn and checked for collisions.
"""


def read_phantom_file(path: Path) -> Phantom:
    """Read the phantom of a TOML or JSON file; meshes that a scene names are beside it.

    The text is UTF-8; TOML or JSON follows from the content, not from the suffix.

    Raises:
        PhantomError: names file, key path, value and allowed values.
    """
    try:
        with path.open("rb") as stream:
            text = read_limited(stream, "json", str(path)).decode("utf-8")
    except InputLimitError as error:
        raise PhantomError(error.message, error.data) from None
    except OSError as error:
        raise FileError.of(error) from None
    except UnicodeDecodeError:
        said = f"cannot read {path}: not UTF-8 text"
        raise PhantomError(said, {"path": str(path)}) from None
    return load_phantom_file(text, str(path), path.parent)


def load_phantom_file(
    text: str, file: str = "<phantom>", folder: Path | None = None
) -> Phantom:
    """Parse the phantom of a TOML or JSON text.

    A byte order mark is removed. Errors of the phantom become PhantomErrors with the
    file's name.

    Args:
        text: content; JSON if it starts with a brace.
        file: name for error messages.
        folder: of the meshes that a scene names; without one, naming a mesh is an error.

    Raises:
        PhantomError: names file, key path, value and allowed values.
    """
    try:
        text = text.removeprefix(BYTE_ORDER_MARK)
        if text.lstrip()[:1] == "{":
            document = parse_json(text, file=file)
        else:
            document = parse_toml(text, file)
    except InputLimitError as error:
        raise PhantomError(error.message, {"file": file, **error.data}) from None
    except ValueError as error:
        raise PhantomError(
            f"{file}: not valid TOML or JSON: {error}", {"file": file}
        ) from None
    try:
        return phantom_of(document, folder)
    except TwinError as error:
        raise PhantomError(
            f"{file}: {error.message}", {"file": file, **error.data}
        ) from None


def phantom_of(document: Mapping[str, object], folder: Path | None = None) -> Phantom:
    """Make the phantom of a document: `Phantom.to_dict`'s, a scene or a bead file.

    `folder`: of meshes that a scene file names. Raises TwinError: with the key path.
    """
    if "scene" in document:
        return Phantom.from_dict(document)
    if "solid" in document or "mesh" in document:
        return _scene_file(document, folder)
    return _bead_file(document)


def _version(value: object, where: str) -> object:
    """Return the version of a document if it can be read; raise PhantomError otherwise."""
    if value != 1:
        raise reading.wrong(value, where, "1")
    return value


def _scene_file(document: Mapping[str, object], folder: Path | None) -> Phantom:
    """Make the phantom of a scene: solids and meshes with their priorities.

    All solids have priority 0, a mesh the one it states. Without a name it is "scene".

    Args:
        document: of the file.
        folder: where its meshes are; None: none may be named.

    Raises:
        PhantomError: more than `MAX_SOLIDS` entries of solid, as its parts, or as
            `require_replaced`.
    """
    given = reading.fields(
        document,
        "phantom",
        {},
        {
            "schema": _version,
            "name": reading.string,
            "description": reading.string,
            "solid": partial(reading.each, read=solids_of),
            "mesh": partial(reading.each, read=partial(_mesh, folder=folder)),
        },
    )
    name = given.get("name", "scene")
    listed = given.get("solid", ())
    if len(listed) > MAX_SOLIDS:
        raise reading.wrong(
            f"{len(listed)} solids", "phantom.solid", f"at most {MAX_SOLIDS}"
        )
    scene = Scene(tuple(solid for several in listed for solid in several))
    if listed:
        parts = [(Phantom(name, "", scene, size_about_origin(scene)), 0.0)]
    else:
        parts = []
    parts += given.get("mesh", ())
    description = given.get("description", "")
    ranks = [rank for _, rank in parts]
    phantom = assemble(name, [part for part, _ in parts], description, ranks)
    require_replaced(phantom, document.get("solid", []))
    return phantom


def require_replaced(phantom: Phantom, solids: object) -> None:
    """Check that the material that solids of a scene file replace is there, once.

    Solids and meshes of that material are voxelised with `CHECKED_VOXELS_ALONG` voxels
    along the longest side; none may be below minus `MAX_ABSENT_SHARE` of the material's
    attenuation. Solids of the document without `replaces` are ignored.

    Args:
        phantom: of the scene's meshes and solids.
        solids: of the document, a list or one entry.

    Raises:
        PhantomError: names the first material of which more is replaced than there is.
    """
    from flexdt.phantoms.voxelise import voxelise

    if isinstance(solids, list | tuple):
        listed = solids
    else:
        listed = [solids]
    replaced = [
        one["replaces"]
        for one in listed
        if isinstance(one, Mapping) and "replaces" in one
    ]
    for name in dict.fromkeys(replaced):
        present = tuple(one for one in phantom.scene.solids if one.material == name)
        meshes = [one for one in phantom.surfaces if one.material == name]
        edge = max(phantom.size_mm) / CHECKED_VOXELS_ALONG
        least = float(
            voxelise(Scene(present), meshes, phantom.size_mm, edge, 2).data.min()
        )
        if least < -MAX_ABSENT_SHARE * material_of(name).mu_per_mm:
            raise PhantomError(
                f"{name} is replaced where there is none of it, or twice; "
                f"allowed: inside solids of {name} that are not replaced already",
                {"asked": name, "allowed": "inside it"},
            )


def solids_of(value: object, where: str) -> tuple[Solid, ...]:
    """Read a solid `{kind, ..., material, replaces}` of a scene file.

    Whether the other material is there is not checked here.

    `value`: entry of the document; `where`: its place, for messages.
    Returns the solid alone or, if it replaces another material, two: first the same shape with
    minus the other's attenuation, then the solid.
    Raises PhantomError, UnknownNameError: names the key path, the value and the allowed ones.
    """
    fields = dict(reading.mapping(value, where))
    made_of = material_of(reading.string(reading.get(fields, "material", where), where))
    instead = fields.pop("replaces", None)
    del fields["material"]
    shape = shape_from_dict(fields, where)
    filled = Solid(shape, made_of.name, made_of.mu_per_mm)
    if instead is None:
        return (filled,)
    replaced = material_of(reading.string(instead, f"{where}.replaces"))
    return (Solid(shape, replaced.name, -replaced.mu_per_mm), filled)


def _mesh(value: object, where: str, folder: Path | None) -> tuple[Phantom, float]:
    """Read the mesh of a scene file and its priority.

    With a position the mesh is centered there, without one it stays as it is in its file.
    The unit is the format's unless stated; the priority 0.

    Args:
        value: entry of the document.
        where: its place, for messages.
        folder: where the mesh's file is; None: none may be named.

    Returns:
        The mesh's phantom, as of `mesh_phantom`, and priority.

    Raises:
        PhantomError: names the field, its value and the allowed ones.
    """
    given = reading.fields(
        value,
        where,
        {"file": reading.string, "material": reading.string},
        {"unit": _unit, "position_mm": reading.vector, "priority": reading.number},
    )
    if folder is None:
        raise PhantomError(
            f"{where}.file is {given['file']!r}, but a text by itself has no folder to look in; "
            "read the scene from its file, "
            "or send it as `flexdt sample FILE` does, with the mesh inside",
            {"path": f"{where}.file", "asked": given["file"]},
        )
    at = given.get("position_mm")
    mesh = mesh_phantom(
        folder / given["file"],
        unit=given.get("unit"),
        material=given["material"],
        place="keep" if at is None else "centred",
        at_mm=at or (0.0, 0.0, 0.0),
    )
    return mesh, given.get("priority", 0.0)


def _unit(value: object, where: str) -> object:
    """Return the name of a length unit; raise PhantomError for another."""
    if value not in UNITS_MM:
        raise reading.wrong(value, where, ", ".join(UNITS_MM))
    return value


def _bead_file(document: Mapping[str, object]) -> Phantom:
    """Make the phantom of a bead file: a body with beads, or with a spiral of them.

    Without a body the beads are in air and the size is that around them about the origin.
    Exactly one of beads and spiral must be given, and a tolerance may be. Only listed
    beads are checked for overlap. The default description counts the beads and names the
    body's material or air.

    Args:
        document: of the file.

    Raises:
        PhantomError: beads and a spiral, neither of them, a spiral without a body, or
            beads that overlap.
        LimitError: beads that do not fit into the body.
    """
    given = reading.fields(
        document,
        "phantom",
        {"schema": _version, "name": reading.string},
        {
            "description": reading.string,
            "body": _body,
            "bead": _beads,
            "spiral": _spiral,
            "tolerance": reading.tolerance,
        },
    )
    if ("bead" in given) == ("spiral" in given):
        raise PhantomError("phantom: give either [[bead]] tables or one [spiral]")
    size, body = given.get("body", (None, None))
    if "spiral" in given:
        if size is None:
            raise PhantomError("phantom.spiral: a spiral needs a [body] to fit into")
        count, radius, metal = given["spiral"]
        centers = spiral_positions(size, count, radius)
        radii = np.full(count, radius)
        metals = (metal,) * count
    else:
        beads: tuple[tuple[Vector, float, str], ...] = given["bead"]
        metals = tuple(metal for *_, metal in beads)
        centers = np.array([at for at, *_ in beads]).reshape(-1, 3)
        radii = np.array([radius for _, radius, _ in beads])
    overlap = worst_overlap(centers, radii)
    if overlap is not None and "bead" in given:
        raise PhantomError(
            f"phantom.bead: beads {overlap[0]} and {overlap[1]} overlap by "
            f"{overlap[2]:.4g} mm; "
            "attenuation is additive, so solids must not overlap",
            {"beads": [overlap[0], overlap[1]], "asked": -overlap[2], "allowed": ">= 0"},
        )
    if size is None:
        size = tuple((2.0 * np.max(np.abs(centers) + radii[:, None], axis=0)).tolist())
    description = given.get("description", f"{len(centers)} beads in {body or 'air'}")
    phantom = cuboid_with_beads(
        given["name"],
        size,
        centers,
        radii,
        body_material=body,
        bead_materials=metals,
        description=description,
    )
    return replace(phantom, tolerance=given.get("tolerance"))


def _body(value: object, where: str) -> tuple[Vector, str]:
    """Read the body of a bead file: size [mm] and material (`abs` if left out).

    Other keys are an error.
    """
    given = reading.fields(
        value, where, {"size_mm": reading.lengths}, {"material": reading.string}
    )
    return given["size_mm"], given.get("material", "abs")


def _beads(value: object, where: str) -> tuple[tuple[Vector, float, str], ...]:
    """Read the beads of a bead file: position [mm], radius [mm], material (steel if left out) of
    each.

    Raises PhantomError: no list, a missing or another key, or a wrong value; names the key path.
    """

    def read(one: object, at: str) -> tuple[Vector, float, str]:
        """Read one bead: position [mm], radius [mm], material (steel if left out)."""
        needed = {"position_mm": reading.vector, "radius_mm": reading.positive}
        given = reading.fields(one, at, needed, {"material": reading.string})
        return given["position_mm"], given["radius_mm"], given.get("material", "steel")

    return reading.each(value, where, read)


def _spiral(value: object, where: str) -> tuple[int, float, str]:
    """Read the spiral of a bead file.

    `value`: entry of the document; `where`: its place, for messages.
    Returns number of beads, radius [mm] (2 if left out), material (steel if left out).
    Raises PhantomError: names the field, its value and the allowed ones; the number must be
    whole and above 0, the radius above 0.
    """
    others = {"radius_mm": reading.positive, "material": reading.string}
    given = reading.fields(value, where, {"beads": reading.positive}, others)
    if given["beads"] != int(given["beads"]):
        raise reading.wrong(given["beads"], f"{where}.beads", "a whole number")
    return (
        int(given["beads"]),
        given.get("radius_mm", 2.0),
        given.get("material", "steel"),
    )


def sent_scene(text: bytes, *, name: str) -> Phantom:
    """Parse the phantom of a text that names no other file, and check its size, and that
    its meshes are closed.

    Limits are `MAX_SENT_SOLIDS`, `MAX_FACES` triangles and `MAX_EXTENT_MM`; voxels must
    be alone. The size is at least the stated one; that of voxels is the stated one.

    Args:
        text: UTF-8, TOML or JSON.
        name: the phantom gets; also for errors.

    Returns:
        The phantom, named `name`, with the extent of all its parts.

    Raises:
        PhantomError, UnknownNameError: names the key path, the value and the allowed
            ones; another size or number, or an open mesh.
    """
    try:
        document = text.decode("utf-8")
    except UnicodeDecodeError:
        raise PhantomError(f"{name}: not UTF-8 text", {"asked": name}) from None
    phantom = load_phantom_file(document, name)
    solids = phantom.scene.solids
    faces = sum(len(one.faces) for one in phantom.surfaces)
    for kind, count, allowed in (
        ("solids", len(solids), MAX_SENT_SOLIDS),
        ("triangles", faces, MAX_FACES),
    ):
        if count > allowed:
            raise PhantomError.instead(f"{name} has {count} {kind}", count, allowed)
    if phantom.voxels is not None and not phantom.is_voxels:
        raise PhantomError(f"{name}: voxels cannot be put together with other parts")
    for surface in phantom.surfaces:
        try:
            TriangleMesh(surface.vertices, surface.faces.astype("int64"))
        except GeometryError as error:
            raise PhantomError(f"{name}: {error.message}", error.data) from None
    size = phantom.size_mm
    if not phantom.is_voxels:
        extent = size_about_origin(phantom.scene, phantom.surfaces)
        size = (max(size[0], extent[0]), max(size[1], extent[1]), max(size[2], extent[2]))
    if max(size) > MAX_EXTENT_MM:
        message = f"{name} measures {max(size):g} mm about its axis"
        raise PhantomError.instead(message, max(size), f"{MAX_EXTENT_MM:g} mm")
    return replace(phantom, name=name, size_mm=size)
