"""The triangles of a GLB file (glTF 2.0 in one binary file): every body of its scene, in place.

Files are not trusted: whatever the document claims is compared with the bytes that are present
before memory is allocated, and the work is bounded by the triangles that come out. That is why this
reader is our own: trimesh allocates what the document claims, and expands repeated instances.
Only positions, indices and nodes are read. Files that refer to others, compressed or sparse data,
and extensions that change the shape are errors.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray

Faces = npt.NDArray[np.int64]

MAX_JSON_BYTES: Final = 32 << 20
MAX_PARTS: Final = 100_000
"""Primitives in a scene, each counted as often as it stands there."""
HARMLESS: Final = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_")
"""Beginnings of extensions that change how a thing looks, not its shape."""
FARTHEST: Final = 1e12
_FORMS: Final[Mapping[str, tuple[int, Mapping[int, str]]]] = {
    "SCALAR": (1, {5121: "<u1", 5123: "<u2", 5125: "<u4"}),
    "VEC3": (3, {5126: "<f4"}),
}
"""Form of an accessor -> its columns, and component type -> dtype; what this reader needs."""
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


class GlbError(ValueError):
    """The file is not valid; the message gives the place."""


def read_glb(raw: bytes, most_faces: int) -> tuple[FloatArray, Faces]:
    """All triangles of the file's scene, in the scene's frame and the file's unit.

    Args:
        raw: the whole file.
        most_faces: of all bodies together, each counted as often as it stands in the scene.

    Returns:
        Vertices (n, 3) and the vertices' numbers of each triangle (m, 3).

    Raises:
        GlbError: it does not hold together, or is more than allowed.

    Source: glTF 2.0 specification, sections 3.5 to 3.7 and 4.4.
    """
    document, binary = _chunks(raw)
    for name in _list(document, "extensionsRequired"):
        if not isinstance(name, str) or not name.startswith(HARMLESS):
            raise GlbError(f"it needs the extension {str(name)[:80]!r}, which is not read here")
    most = 3 * most_faces
    vertices: list[FloatArray] = [np.zeros((0, 3))]
    faces: list[Faces] = [np.zeros((0, 3), dtype=np.int64)]
    room, parts, many = most_faces, MAX_PARTS, 0
    for matrix, mesh in _bodies(document):
        for primitive in _list(_item(document, "meshes", mesh), "primitives"):
            points, triangles = _primitive(document, binary, primitive, most)
            # Empty ones count as well: work is bounded, whatever is repeated in the document.
            room, parts = room - max(len(triangles), len(points) // 3), parts - 1
            if room < 0 or parts < 0:
                what = f"{most_faces} triangles" if room < 0 else f"{MAX_PARTS} parts"
                raise GlbError(f"it has more than {what}")
            if len(triangles):
                vertices.append(_put(points, matrix))
                mirrored = np.linalg.det(matrix[:3, :3]) < 0.0
                faces.append((triangles[:, ::-1] if mirrored else triangles) + many)
                many += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def _put(points: FloatArray, matrix: FloatArray) -> FloatArray:
    with np.errstate(all="ignore"):
        placed: FloatArray = points @ matrix[:3, :3].T + matrix[:3, 3]
        if not np.abs(placed).max() < FARTHEST:
            raise GlbError("it has vertices that are not finite, or too far away")
    return placed


def _chunks(raw: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk."""
    if len(raw) < 20 or raw[:4] != b"glTF":
        raise GlbError("it does not begin as a GLB file does")
    version, total, size = struct.unpack_from("<III", raw, 4)
    if version != 2:
        raise GlbError(f"it is glTF {version}; version 2 is read here")
    if raw[16:20] != b"JSON" or 20 + size > len(raw):
        raise GlbError("its document is cut off")
    if size > MAX_JSON_BYTES:
        raise GlbError(f"its document has {size} bytes; allowed: {MAX_JSON_BYTES}")
    try:
        document = json.loads(raw[20 : 20 + size].decode("utf-8"))
    except (ValueError, RecursionError):
        raise GlbError("its document is not JSON") from None
    if not isinstance(document, dict):
        raise GlbError("its document is no object")
    at, end = 20 + size, min(total, len(raw))
    while at + 8 <= end:
        length, kind = struct.unpack_from("<I4s", raw, at)
        if at + 8 + length > len(raw):
            raise GlbError("its binary part is cut off")
        if kind == b"BIN\0":
            return document, raw[at + 8 : at + 8 + length]
        at += 8 + length
    return document, b""


def _primitive(
    document: dict[str, Any], binary: bytes, primitive: Any, most: int
) -> tuple[FloatArray, Faces]:
    """Points and triangles, none for points and lines."""
    mode = _count(primitive, "mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise GlbError("a primitive has no POSITION")
    points = _accessor(document, binary, _count(attributes, "POSITION"), "VEC3", most)
    if "indices" in primitive:
        chosen = _accessor(document, binary, _count(primitive, "indices"), "SCALAR", most)
        order = chosen.ravel().astype(np.int64)
    else:
        order = np.arange(len(points), dtype=np.int64)
    if len(order) and int(order.max()) >= len(points):
        raise GlbError(f"a triangle uses vertex {int(order.max())} of {len(points)}")
    return points.astype(np.float64), _triangles(order, mode)


def _accessor(
    document: dict[str, Any], binary: bytes, index: int, form: str, most: int
) -> npt.NDArray[Any]:
    """An accessor's numbers (n, columns), if its bytes are there."""
    where, (columns, types) = f"accessor {index}", _FORMS[form]
    accessor = _item(document, "accessors", index)
    kind = types.get(_count(accessor, "componentType"))
    if kind is None or accessor.get("type") != form:
        raise GlbError(f"{where}: its type is not read here")
    if "bufferView" not in accessor or "sparse" in accessor:
        raise GlbError(f"{where}: its data are not in the file as they are")
    view = _item(document, "bufferViews", _count(accessor, "bufferView"))
    buffer = _item(document, "buffers", _count(view, "buffer"))
    if _count(view, "buffer") != 0 or "uri" in buffer:
        raise GlbError(f"{where}: its data are not in this file")
    dtype = np.dtype(kind)
    row = dtype.itemsize * columns
    count, stride = _count(accessor, "count"), _count(view, "byteStride", row)
    first, size = _count(view, "byteOffset", 0), _count(view, "byteLength")
    start = _count(accessor, "byteOffset", 0)
    if count > most:
        raise GlbError(f"{where}: {count} items; allowed: {most}")
    last = start + (count - 1) * stride + row
    if not row <= stride <= 252 or (count and last > size) or first + size > len(binary):
        raise GlbError(f"{where}: {count} items are more than its bytes hold")
    if count == 0:
        return np.zeros((0, columns), dtype)
    return np.ndarray((count, columns), dtype, binary, first + start, (stride, dtype.itemsize))


def _triangles(order: Faces, mode: int) -> Faces:
    """Triangles (m, 3) of a list of vertices."""
    if mode == _TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == _FAN:
        return np.column_stack((np.full(len(order) - 2, order[0]), order[1:-1], order[2:]))
    strip = np.column_stack((order[:-2], order[1:-1], order[2:]))
    strip[1::2] = strip[1::2, [1, 0, 2]]
    return strip


def _bodies(document: dict[str, Any]) -> Iterator[tuple[FloatArray, int]]:
    """What stands in the scene: where (4, 4), and which mesh."""
    nodes = _list(document, "nodes")
    if "scenes" in document:
        scene = _item(document, "scenes", _count(document, "scene", 0))
        roots = _list(scene, "nodes")
    else:
        held = {c for n in nodes for c in _list(n, "children") if isinstance(c, int)}
        roots = [i for i in range(len(nodes)) if i not in held]
    stack: list[tuple[FloatArray, Any]] = [(np.eye(4), root) for root in reversed(roots)]
    seen: set[int] = set()
    while stack:
        above, index = stack.pop()
        node = _item(document, "nodes", index)
        if index in seen:
            raise GlbError(f"node {index} has two places in the scene")
        seen.add(index)
        with np.errstate(all="ignore"):
            matrix = above @ _placed(node, index)
        if not np.isfinite(matrix).all():
            raise GlbError(f"node {index}: it lies too far away")
        if "mesh" in node:
            yield matrix, _count(node, "mesh")
        stack += [(matrix, child) for child in reversed(_list(node, "children"))]


def _placed(node: dict[str, Any], index: int) -> FloatArray:
    """A node's matrix (4, 4), or its translation, turn and scale."""
    if "matrix" in node:
        return _numbers(node, "matrix", 16, index).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = _numbers(node, "rotation", 4, index).tolist()
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if not norm > 0.0:
            raise GlbError(f"node {index}: its rotation is no quaternion")
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    if "scale" in node:
        matrix[:3, :3] *= _numbers(node, "scale", 3, index)
    if "translation" in node:
        matrix[:3, 3] = _numbers(node, "translation", 3, index)
    return matrix


def _numbers(node: dict[str, Any], key: str, many: int, index: int) -> FloatArray:
    values = _list(node, key)
    if len(values) != many or not all(_finite(v) for v in values):
        raise GlbError(f"node {index}: its {key} is not {many} numbers below {FARTHEST:g}")
    return np.array(values, dtype=np.float64)


def _finite(value: Any) -> bool:
    """A number with which placing things cannot overflow."""
    return isinstance(value, (int, float)) and abs(value) < FARTHEST


def _list(holder: Any, key: str) -> list[Any]:
    value = holder.get(key, []) if isinstance(holder, dict) else None
    if not isinstance(value, list):
        raise GlbError(f"{key} is not a list")
    return value


def _item(document: dict[str, Any], key: str, index: Any) -> dict[str, Any]:
    items = _list(document, key)
    whole = isinstance(index, int) and not isinstance(index, bool)
    if not whole or not 0 <= index < len(items) or not isinstance(items[index], dict):
        raise GlbError(f"there is no {key}[{str(index)[:40]}]")
    item: dict[str, Any] = items[index]
    return item


def _count(holder: Any, key: str, default: int | None = None) -> int:
    """A whole number that is not negative."""
    if not isinstance(holder, dict):
        raise GlbError(f"what should have {key} is no object")
    value = holder.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise GlbError(f"{key} is {str(value)[:40]!r}; it is a whole number, 0 or more")
    return value
