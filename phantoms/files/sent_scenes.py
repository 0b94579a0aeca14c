"""Phantom and scene files from strangers: read, and held to what collisions and images can bear.

A file may say anything of its size, and its solids may be many: the size is worked out from the
content, and solids, triangles and extent are bounded.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from flexdt.phantoms.files.mesh_files import MAX_EXTENT_MM, MAX_FACES
from flexdt.phantoms.files.phantom_files import load_phantom_file
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import PhantomError, size_about_origin
from flexdt.twin.errors import GeometryError
from flexdt.twin.projection import TriangleMesh

MAX_SOLIDS: Final = 500
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
    for what, count, most in (("solids", len(solids), MAX_SOLIDS), ("triangles", faces, MAX_FACES)):
        if count > most:
            raise PhantomError(
                f"{name} has {count} {what}; allowed: {most}", {"asked": count, "allowed": most}
            )
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
        raise PhantomError(
            f"{name} measures {max(size):g} mm about its axis; allowed: {MAX_EXTENT_MM:g} mm",
            {"asked": max(size), "allowed": MAX_EXTENT_MM},
        )
    return replace(phantom, name=name, size_mm=size)
