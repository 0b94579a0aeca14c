"""Phantoms from meshes and grids of the user's own: mesh files, voxel arrays.

Files come from outside: format, size and content are checked before and after parsing,
nothing is unpickled, and references to other files are not followed. A mesh must be
closed.
"""

from __future__ import annotations

import io
import os
import re
import struct
import warnings
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.files.shells import filled_twice
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import Surface, Voxels
from flexdt.phantoms.placement import Place, placed
from flexdt.twin.attenuation.materials import material as material_of
from flexdt.twin.errors import FileError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.input_limits import LIMITS
from flexdt.twin.json_text import parse_json
from flexdt.twin.length_units import UNITS_MM
from flexdt.twin.projection.analytic_solids import ConvexPolyhedron, Scene, Solid, Vector
from flexdt.twin.signatures import public

if TYPE_CHECKING:
    import trimesh

FORMATS: Final = ("stl", "obj", "ply", "glb", "off")
"""Formats of mesh files; the wire has the same names (`MeshFormat` of the protocol)."""
DEFAULT_UNIT: Final[Mapping[str, str]] = {"glb": "m"}
"""Unit of the formats that have one; the others are in mm unless a unit is given."""
MAX_BYTES: Final = LIMITS["stl"].file_bytes
"""Largest mesh file [bytes]."""
MAX_FACES: Final = LIMITS["stl"].parts
MAX_EXTENT_MM: Final = 2000.0
PART_FORMATS: Final = ("glb", "stl")
MAX_PART_BYTES: Final = 32 << 20
MAX_PART_FACES: Final = 300_000
MAX_PART_MM: Final = 20_000.0
"""Largest extent of a machine's part [mm]; browsers draw a dozen parts at once."""
MAX_PLY_HEADER: Final = 1 << 16
MAX_GLB_DOCUMENT: Final = 32 << 20
MAX_PARTS: Final = LIMITS["glb"].parts
"""Largest number of nodes and primitives of a GLB file, each counted as often as the
scene has it.

trimesh walks from the scene's root to each.
"""
HARMLESS_EXTENSIONS: Final = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "EXT_texture_",
)
"""Prefixes of glTF extensions that change how an object looks, not its shape."""
ITEM_BYTES: Final = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
ITEM_COLUMNS: Final = {
    "SCALAR": 1,
    "VEC2": 2,
    "VEC3": 3,
    "VEC4": 4,
    "MAT2": 4,
    "MAT3": 9,
    "MAT4": 16,
}
"""Sizes of glTF's component types and element types (glTF 2.0 specification, 3.6.2)."""
TRIANGLE_FAN: Final = 6
OBJ_PART: Final = re.compile(rb"^[ \t]*(?:usemtl|mtllib|o|g|s)\b[^\n]*", re.MULTILINE)
"""A line of an OBJ file at which a group or a material begins; all are filled with one
material here, and trimesh's work grows with the square of their number."""
STL_HEAD_BYTES: Final = 84
STL_TRIANGLE_BYTES: Final = 50
"""Bytes of a triangle of a binary STL, after a head of `STL_HEAD_BYTES`."""
MAX_PLANES: Final = 128
"""Largest number of planes of a convex mesh that is projected as a solid, not as triangles."""


@public
def mesh_phantom(
    source: bytes | str | os.PathLike[str],
    *,
    unit: str | None = None,
    material: str = "abs",
    file_type: str | None = None,
    name: str | None = None,
    place: Place = "keep",
    at_mm: Vector = (0.0, 0.0, 0.0),
) -> Phantom:
    """Make a phantom filled with one material inside a closed mesh.

    Args:
        source: the bytes of an STL, OBJ, PLY, GLB or OFF file, or its path. Bodies of a
            GLB scene are joined at their places.
        unit: length unit of the file's numbers: um, mm, cm, m, inch; default: that of the
            format, m for GLB, and mm where it has none.
        material: the material.
        file_type: one of `FORMATS`, in either case; default: by the path's suffix (bytes
            need it).
        name: default: the path's stem, or "mesh".
        place: "keep": its coordinates are those of the object's frame; "centred" puts the
            middle of its box on the axis at the reference height. The description says
            by how much it was moved.
        at_mm: moves it from there, along x, y, z of the object's frame [mm].

    Returns:
        A solid between planes when the mesh is convex with few of them, else its
        triangles. Both are projected exactly.

    Raises:
        PhantomError: format, size, unit or content; the message lists the allowed values.
        UnknownNameError: unknown material.

    Example:
        >>> import trimesh
        >>> cube = trimesh.creation.box((5.0, 6.0, 7.0)).export(file_type="stl")
        >>> mesh_phantom(cube, file_type="stl", name="cube").size_mm
        (5.0, 6.0, 7.0)
    """
    if unit is not None and unit not in UNITS_MM:
        raise PhantomError.instead(f"unknown unit {unit!r}", unit, list(UNITS_MM))
    raw, kind, label = _read(source, file_type)
    if unit is None:
        unit = default_unit(kind)
    return filled_mesh(
        _parse(raw, kind),
        unit=unit,
        material=material,
        name=label.rsplit(".", 1)[0] if name is None else name,
        label=label,
        place=place,
        at_mm=at_mm,
    )


def filled_mesh(
    mesh: trimesh.Trimesh,
    *,
    unit: str = "mm",
    material: str = "abs",
    name: str = "mesh",
    label: str = "mesh",
    place: Place = "keep",
    at_mm: Vector = (0.0, 0.0, 0.0),
) -> Phantom:
    """Make a phantom filled with one material inside a closed mesh that has been read already.

    A convex mesh of at most `MAX_PLANES` planes becomes a solid, any other a surface. A
    shell inside another that is
    turned outwards changes nothing; a warning counts such shells. The largest extent must
    be above 0 and at most `MAX_EXTENT_MM`.

    Args:
        mesh: its triangles; not changed.
        unit, material, name, place: as for `mesh_phantom`; the defaults are mm, abs and mesh.
        label: of the mesh, for errors.
        at_mm: place of its middle, or of the origin it keeps, in the object's frame [mm].

    Returns:
        The phantom; its size is that of the box about the object's origin that holds it.

    Raises:
        PhantomError, UnknownNameError: as `mesh_phantom`.
    """
    mu = material_of(material).mu_per_mm
    mesh = _closed(mesh.copy(), label)
    vertices = np.asarray(mesh.vertices, dtype=np.float64) * UNITS_MM[unit]
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    if (high - low).max() > MAX_EXTENT_MM or (high - low).max() <= 0.0:
        raise PhantomError(
            f"{label} measures {(high - low).max():g} mm in unit {unit!r}; allowed: more than 0, "
            f"at most {MAX_EXTENT_MM:g} mm. Is the unit right ({', '.join(UNITS_MM)})?",
            {"asked": float((high - low).max()), "allowed": MAX_EXTENT_MM},
        )
    x, y, z = (2.0 * np.maximum(np.abs(low), np.abs(high))).tolist()
    solid = _convex(mesh, vertices)
    description = (
        f"{len(mesh.faces)} triangles of {label} in {unit}, filled with {material}"
    )
    if twice := filled_twice(vertices, mesh.faces):
        inner = "1 shell lies"
        if twice != 1:
            inner = f"{twice} shells lie"
        warnings.warn(
            f"{label}: {inner} in what others fill, turned outwards, and changes nothing; turn "
            "cavities inwards",
            stacklevel=2,
        )
    made = Phantom(
        name,
        description,
        Scene(() if solid is None else (Solid(solid, material, mu),)),
        (x, y, z),
        surfaces=()
        if solid is not None
        else (Surface(vertices, mesh.faces, material, mu),),
    )
    return placed(made, place, at_mm)


def read_mesh(source: bytes | str | os.PathLike[str]) -> trimesh.Trimesh:
    """Read the triangles of a file, closed, wound outwards, in its own units.

    Raises:
        PhantomError: format, size or content; the message lists the allowed values.
    """
    raw, kind, label = _read(source, None)
    return _closed(_parse(raw, kind), label)


def read_part(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Read the triangles of a machine's part [mm], from a GLB (m) or STL file (mm); they
    may be open.

    Limits are MAX_PART_BYTES, MAX_PART_FACES and an extent above 0 and at most MAX_PART_MM.

    Args:
        path: of the file; its suffix, one of PART_FORMATS, is its format.

    Raises:
        PhantomError: no such file, its format, size or content; the message lists the
            allowed values.
    """
    kind = Path(path).suffix.lstrip(".").lower()
    if kind not in PART_FORMATS:
        raise PhantomError(
            f"{path}: not the mesh of a part; allowed: {', '.join(PART_FORMATS)}"
        )
    raw, _, _ = _read(path, kind)
    if len(raw) > MAX_PART_BYTES:
        raise PhantomError(f"{path} has {len(raw)} bytes; allowed: {MAX_PART_BYTES}")
    mesh = _parse(raw, kind)
    if len(mesh.faces) > MAX_PART_FACES:
        raise PhantomError(
            f"{path}: {len(mesh.faces)} triangles; allowed: {MAX_PART_FACES}"
        )
    mesh.vertices *= UNITS_MM[default_unit(kind)]
    largest = float(mesh.extents.max())
    if not 0.0 < largest <= MAX_PART_MM:
        raise PhantomError(
            f"{path} measures {largest:g} mm; allowed: more than 0, at most "
            f"{MAX_PART_MM:g} mm. "
            "An STL file is taken to be in mm, a GLB file in m"
        )
    return mesh


def default_unit(file_type: str) -> str:
    """Return the default unit of a format."""
    return DEFAULT_UNIT.get(file_type, "mm")


@public
def voxel_phantom(
    data: npt.NDArray[np.float32],
    voxel_mm: float | Vector,
    *,
    name: str = "voxels",
    center_mm: Vector = (0.0, 0.0, 0.0),
    material: str | None = None,
) -> Phantom:
    """Make a phantom from a ready grid.

    The phantom's size is that of the box about the object's origin that holds the grid;
    labels and several materials are not made here.

    Args:
        data: [z, y, x], attenuation [1/mm].
        voxel_mm: voxel edge, one or along x, y, z [mm].
        name: its name.
        center_mm: place of the grid's center in the object's frame [mm].
        material: its material, for its spectrum: a voxel's amount is its
            attenuation over the material's. None: water of varying density.

    Raises:
        PhantomError: shape, values or voxel size (finite, above 0).

    Example:
        >>> voxel_phantom(np.full((4, 6, 8), 0.02, np.float32), 0.5).size_mm
        (4.0, 3.0, 2.0)
    """
    edges = np.asarray(voxel_mm, dtype=np.float64)
    if edges.shape not in ((), (3,)) or not (
        np.isfinite(edges).all() and (edges > 0).all()
    ):
        raise PhantomError(f"voxel size is {voxel_mm} mm; allowed: one or three above 0")
    dx, dy, dz = np.broadcast_to(edges, 3).tolist()
    voxels = Voxels(data, (dx, dy, dz), center_mm, material)
    nz, ny, nx = voxels.data.shape
    cx, cy, cz = (2.0 * abs(c) for c in center_mm)
    return Phantom(
        name,
        f"{nx} x {ny} x {nz} voxels of {dx:g} x {dy:g} x {dz:g} mm",
        Scene(()),
        (nx * dx + cx, ny * dy + cy, nz * dz + cz),
        voxels=voxels,
    )


def _read(
    source: bytes | str | os.PathLike[str], file_type: str | None
) -> tuple[bytes, str, str]:
    """Read a mesh file, or take its bytes; check size and format.

    A file of more than `MAX_BYTES` is not read. Bytes need `file_type`.

    Args:
        source: path or content.
        file_type: format; None: the path's suffix.

    Returns:
        Content, format in lower case, and label for messages: the file's name, or "mesh".

    Raises:
        PhantomError: not readable, its size, or no format that is read.
    """
    if isinstance(source, bytes):
        raw = source
        label = "mesh"
        kind = file_type or ""
    else:
        path = Path(source)
        label = path.name
        kind = file_type or path.suffix.lstrip(".")
        try:
            size = path.stat().st_size
            raw = b""
            if size <= MAX_BYTES:
                raw = path.read_bytes()
        except OSError as error:
            raise FileError.of(error) from None
        _check_size(size, label)
    if kind.lower() not in FORMATS:
        message = f"{label}: {kind or 'no format'!r} is not a mesh format we read"
        raise PhantomError.instead(message, kind, FORMATS)
    _check_size(len(raw), label)
    return raw, kind.lower(), label


def _check_size(size: int, label: str) -> None:
    """Check the size of a file [bytes]. Raises PhantomError: empty or too large."""
    if not 0 < size <= MAX_BYTES:
        raise PhantomError.instead(f"{label} has {size} bytes", size, f"1 to {MAX_BYTES}")


def _parse(raw: bytes, kind: str) -> trimesh.Trimesh:
    """Parse a mesh file with trimesh, claims checked before and content after.

    Any error of the parser becomes a PhantomError; so do vertices that are not finite and
    triangles of unknown vertices.

    Args:
        raw: content.
        kind: one of `FORMATS`.

    Returns:
        The triangles alone, without colors and normals; they may be open.

    Raises:
        PhantomError: not readable, too large, or without triangles.
    """
    import trimesh

    mesh: object
    try:
        if kind in _CHECKS:
            _CHECKS[kind](raw)
        if kind == "obj":
            raw = OBJ_PART.sub(b"", raw)
        # Parts that are too far away are rejected below, as vertices that are not finite.
        with np.errstate(all="ignore" if kind == "glb" else None):
            mesh = trimesh.load(
                io.BytesIO(raw),
                file_type=kind,
                force="mesh",
                process=kind
                != "glb",  # It drops vertices that are not finite without a word.
                skip_materials=True,
            )
    except MemoryError:
        raise PhantomError(
            f"reading this {kind.upper()} file takes too much memory"
        ) from None
    except (
        Exception
    ) as error:  # A third party's parser on a stranger's bytes: anything may come.
        raise PhantomError(
            f"not a readable {kind.upper()} file: {str(error)[:500]}"
        ) from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise PhantomError(f"the {kind.upper()} file holds no triangles")
    if len(mesh.faces) > MAX_FACES:
        count = len(mesh.faces)
        raise PhantomError.instead(f"the mesh has {count} triangles", count, MAX_FACES)
    if len(mesh.vertices) == 0 or not np.isfinite(mesh.vertices).all():
        raise PhantomError("the mesh has vertices that are not finite numbers")
    if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise PhantomError(
            f"a triangle uses a vertex beyond the {len(mesh.vertices)} of the mesh"
        )
    # Its triangles alone: colours and normals of the file may be anything.
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def _check_ply(raw: bytes) -> None:
    """Check that a PLY header is there, small, and claims no more elements than there are bytes.

    The header must end within `MAX_PLY_HEADER` bytes. Each element line has three words; other
    lines are ignored.

    Args:
        raw: content of the file.

    Raises ValueError: names the problem.
    """
    end = raw.find(b"end_header", 0, MAX_PLY_HEADER)
    if not raw.startswith(b"ply") or end < 0:
        raise ValueError(f"no PLY header within {MAX_PLY_HEADER} bytes")
    for line in raw[:end].split(b"\n"):
        words = line.split()
        if words[:1] == [b"element"] and (
            len(words) != 3 or int(words[2]) > len(raw) - end
        ):
            raise ValueError(
                f"{line[:80].decode('ascii', 'replace').strip()!r}: more than it holds"
            )


def _check_glb(raw: bytes) -> None:
    """Check that a GLB file refers to no other, claims no more than it holds, puts each
    node in one place, and has nothing else that `_check_gltf` refuses.

    Only the JSON part is parsed, at most `MAX_GLB_DOCUMENT` bytes.

    trimesh allocates the claimed memory, and copies a mesh to each of its places.

    Args:
        raw: content of the file.

    Raises:
        ValueError: names the problem.
    """
    if len(raw) < 20 or raw[:8] != b"glTF\2\0\0\0" or raw[16:20] != b"JSON":
        raise ValueError("it does not begin as a GLB file (glTF 2.0) does")
    (size,) = struct.unpack_from("<I", raw, 12)
    if size > min(MAX_GLB_DOCUMENT, len(raw) - 20):
        message = (
            f"its document has {size} bytes; allowed: {MAX_GLB_DOCUMENT}, all in the file"
        )
        raise ValueError(message)
    try:
        _check_gltf(
            parse_json(raw[20 : 20 + size].decode(), file="its document"), len(raw)
        )
    except (AttributeError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"its document does not hold together: {error!r}") from None


def _check_gltf(document: Any, total: int) -> None:
    """Check the JSON document of a GLB file: extensions, data in the file, sizes, places,
    number of triangles.

    Also refused: sparse data, a node with two places, triangle fans, more than `MAX_PARTS`
    nodes and parts, and more than 3 `MAX_FACES` corners in all that are drawn. Required
    extensions must begin with one of `HARMLESS_EXTENSIONS`.

    Args:
        document: of the file's JSON part.
        total: size of the file [bytes].

    Raises:
        ValueError: names the first problem.
        AttributeError, LookupError, TypeError: the document lacks a key or has another form.
    """
    for name in document.get("extensionsRequired", []):
        if not name.startswith(HARMLESS_EXTENSIONS):
            raise ValueError(
                f"it needs the extension {name[:80]!r}, which is not read here"
            )
    _check_gltf_data(document, total)
    nodes = document.get("nodes", [])
    _check_gltf_places(document, nodes)
    meshes = document.get("meshes", [])
    drawn = [meshes[node["mesh"]]["primitives"] for node in nodes if "mesh" in node]
    # Counted before they are listed: many nodes may draw one mesh of many parts.
    parts = len(nodes) + sum(len(primitives) for primitives in drawn)
    if parts > MAX_PARTS:
        raise ValueError(f"it has {parts} nodes and parts; allowed: {MAX_PARTS}")
    accessors = document.get("accessors", [])
    corners = sum(_corners(part, accessors) for part in chain.from_iterable(drawn))
    if corners > 3 * MAX_FACES:
        raise ValueError(f"it has more than {MAX_FACES} triangles")


def _check_gltf_data(document: Any, total: int) -> None:
    """Check that the data of a GLB document are in its file, as they are, and claim no
    more than `total` bytes; errors as `_check_gltf`.
    """
    if any("uri" in buffer for buffer in document.get("buffers", [])):
        raise ValueError("its data are not in this file")
    accessors = document.get("accessors", [])
    for i, one in enumerate(accessors):
        if "bufferView" not in one or "sparse" in one:
            raise ValueError(f"accessor {i}: its data are not in the file as they are")
    views = [view["byteLength"] for view in document.get("bufferViews", [])]
    sizes = [
        a["count"] * ITEM_BYTES[a["componentType"]] * ITEM_COLUMNS[a["type"]]
        for a in accessors
    ]
    if min((*views, *sizes), default=0) < 0 or not max(sum(views), sum(sizes)) <= total:
        raise ValueError(f"it claims more than its {total} bytes hold")


def _check_gltf_places(document: Any, nodes: Any) -> None:
    """Check that the scene of a GLB document has each node in one place; errors as
    `_check_gltf`.
    """
    scenes = document.get("scenes", [{}])
    places = [*scenes[document.get("scene", 0)].get("nodes", [])]
    places += [child for node in nodes for child in node.get("children", [])]
    if len(set(places)) < len(places):
        raise ValueError("a node has two places in the scene")


def _corners(part: Any, accessors: Any) -> Any:
    """Count the corners that a part of a GLB document draws: of its indices, or of its
    points if these are more; errors as `_check_gltf`.
    """
    if part.get("mode") == TRIANGLE_FAN:
        raise ValueError("it has triangle fans, which are not read here")
    used = [part["attributes"]["POSITION"]]
    if "indices" in part:
        used.append(part["indices"])
    return max(accessors[i]["count"] for i in used)


def _check_stl(raw: bytes) -> None:
    """Check that a binary STL file has the length that its head announces; text files pass.

    Files shorter than a head, and heads that announce 0 triangles, pass, too.

    Args:
        raw: content of the file.

    Raises ValueError: they differ.
    """
    if len(raw) < STL_HEAD_BYTES or (
        raw.lstrip()[:5] == b"solid" and b"facet" in raw[:1024]
    ):
        return
    count = int.from_bytes(raw[STL_HEAD_BYTES - 4 : STL_HEAD_BYTES], "little")
    announced = STL_HEAD_BYTES + STL_TRIANGLE_BYTES * count
    if announced != len(raw) and count:
        raise ValueError(
            f"its head announces {count} triangles, {announced} bytes; it has {len(raw)} bytes"
        )


_CHECKS: Final = {
    "glb": _check_glb,
    "ply": _check_ply,
    "stl": _check_stl,
}
"""Format -> check of a file's claims before trimesh reads it."""


def _closed(mesh: trimesh.Trimesh, label: str) -> trimesh.Trimesh:
    """Merge vertices, check that the mesh is closed, and wind it outwards.

    Triangles without area and unused vertices are removed. Closed means that each edge
    has two triangles. All are turned if the volume is negative.

    Args:
        mesh: changed in place.
        label: of the mesh, for messages.

    Returns:
        `mesh`, or a new one where neighboring faces had to be turned to agree.

    Raises:
        PhantomError: it is open.
    """
    import trimesh

    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    if not mesh.is_watertight:
        _, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        bad = int(np.count_nonzero(uses != 2))
        raise PhantomError(
            f"{label} is not closed: {bad} edges do not have two triangles each; only a closed "
            "surface has an inside to fill",
            {"open_edges": bad},
        )
    if not mesh.is_winding_consistent:
        mesh = trimesh.Trimesh(mesh.vertices, _wound(mesh.faces), process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def _wound(faces: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Turn faces so that neighbors agree, in each body the way most of its faces already are.

    The mesh must be closed. In a tie either half of a body's faces may be turned.

    Every face has two nodes, as it is and turned; neighbors link those that agree. A
    body then falls into two components, mirror images of each other, and either is a
    consistent choice.

    Args:
        faces: (f, 3).

    Returns:
        The faces (f, 3), some reversed.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(faces)
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(n), 3)
    forward = edges[:, 0] < edges[:, 1]
    order = np.lexsort((edges.max(axis=1), edges.min(axis=1)))
    a, b = order[0::2], order[1::2]  # Closed: every edge comes exactly twice.
    other = np.where(forward[a] != forward[b], 0, n)
    rows = np.concatenate([owner[a], owner[a] + n])
    columns = np.concatenate([owner[b] + other, owner[b] + n - other])
    graph = coo_matrix(
        (np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * n, 2 * n)
    )
    _, component = connected_components(graph, directed=False)
    body = np.minimum(component[:n], component[n:])
    turned = component[:n] > component[n:]
    votes = np.bincount(body, np.where(turned, 1, -1), minlength=2 * n)
    turned ^= votes[body] > 0
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _convex(mesh: trimesh.Trimesh, vertices: FloatArray) -> ConvexPolyhedron | None:
    """Convert a mesh to half-spaces if it is convex and has at most `MAX_PLANES`.

    Planes count once if normals, and offsets over the largest coordinate, agree when
    rounded to 7 decimals.

    Args:
        mesh: closed, outward.
        vertices: its vertices (v, 3) in place [mm].

    Returns:
        The polyhedron; None for any other mesh.
    """
    if not mesh.is_convex:
        return None
    normals = np.asarray(mesh.face_normals, dtype=np.float64)
    offsets = np.einsum("ij,ij->i", normals, vertices[mesh.faces[:, 0]])
    scale = float(np.abs(vertices).max())
    planes = np.column_stack([normals, offsets / scale])
    _, first = np.unique(np.round(planes, 7), axis=0, return_index=True)
    if len(first) > MAX_PLANES:
        return None
    return ConvexPolyhedron(
        tuple((n[0], n[1], n[2]) for n in normals[first].tolist()),
        tuple(offsets[first].tolist()),
    )
