"""PLY, OFF and GLB: read as trimesh writes them, in the right unit; hostile ones cost
nothing."""

from __future__ import annotations

import json
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from flexdt.phantoms import PhantomError, mesh_phantom
from flexdt.phantoms.files import mesh_files as mesh


def scene() -> trimesh.Scene:
    """Two bodies, turned, mirrored and moved, one of them under another."""
    made = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 3.0), (0.1, 0.0, 0.0))
    made.add_geometry(
        trimesh.creation.box((0.01, 0.02, 0.03)), node_name="a", transform=turn
    )
    mirror = np.diag([-2.0, 1.0, 0.5, 1.0])
    mirror[:3, 3] = (0.05, -0.02, 0.01)
    torus = trimesh.creation.torus(0.02, 0.005)
    made.add_geometry(torus, node_name="b", parent_node_name="a", transform=mirror)
    return made


def glb(document: Any, binary: bytes = b"") -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        binary += b"\0" * (-len(binary) % 4)
        body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def one(**change: Any) -> tuple[dict[str, Any], bytes]:
    """A document with one tetrahedron, as drawn without indices."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
    points = (
        corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3).tobytes()
    )
    document: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 12, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(points)}],
        "buffers": [{"byteLength": len(points)}],
    }  # fmt: skip
    return {**document, **change}, points


@pytest.mark.parametrize("form", ["ply", "off", "glb"])
def test_numbers_are_mm_unless_the_format_has_a_unit(form: str) -> None:
    mesh = trimesh.creation.torus(0.3, 0.1)
    raw = mesh.export(file_type=form)
    raw = raw.encode() if isinstance(raw, str) else raw
    mm = 1000.0 if form == "glb" else 1.0
    p = mesh_phantom(raw, file_type=form, material="aluminium")
    assert p.size_mm == pytest.approx((0.8 * mm, 0.8 * mm, 0.2 * mm), rel=1e-3)
    assert p.mesh().volume == pytest.approx(mesh.volume * mm**3, rel=1e-4)
    said = mesh_phantom(raw, file_type=form, unit="cm", material="aluminium")
    assert said.size_mm == pytest.approx((8.0, 8.0, 2.0), rel=1e-3)
    assert "aluminium" in said.description


def test_an_ascii_ply_and_a_big_endian_one() -> None:
    mesh = trimesh.creation.icosphere(1, 4.0)
    text = mesh.export(file_type="ply", encoding="ascii")
    assert mesh_phantom(text, file_type="ply").mesh().volume == pytest.approx(mesh.volume)
    head = (
        "ply\nformat binary_big_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    body = mesh.vertices.astype(">f4").tobytes()
    body += b"".join(struct.pack(">B3i", 3, *face) for face in mesh.faces.tolist())
    big = mesh_phantom(head + body, file_type="ply")
    assert big.mesh().volume == pytest.approx(mesh.volume, rel=1e-5)


def test_every_body_of_a_glb_scene_stands_in_its_place() -> None:
    made = scene()
    raw = made.export(file_type="glb")
    p = mesh_phantom(raw, file_type="glb", place="keep")
    peer = made.to_mesh()
    got = p.mesh()
    assert got.bounds == pytest.approx(1000.0 * peer.bounds, rel=1e-5)
    assert got.volume == pytest.approx(1e9 * peer.volume, rel=1e-4)
    assert got.center_mass == pytest.approx(1000.0 * peer.center_mass, rel=1e-4)
    assert len(got.split()) == 2


def test_turn_scale_and_shift_of_a_node_are_applied_in_gltf_order() -> None:
    """Scaled along its own x, then turned a quarter about z, then moved."""
    half = 0.5**0.5
    node = {
        "mesh": 0,
        "translation": [5, 0, 0],
        "rotation": [0, 0, half, half],
        "scale": [3, 1, 1],
    }
    p = mesh_phantom(glb(*one(nodes=[node])), file_type="glb", unit="mm", place="keep")
    assert len(p.mesh().faces) == 4
    assert p.mesh().bounds[0] == pytest.approx([4, 0, 0], abs=1e-6)
    assert p.mesh().bounds[1] == pytest.approx([5, 3, 1], abs=1e-6)


def test_strips_are_triangles_with_one_sense_and_fans_are_refused(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="<f4").tobytes()
    for mode, order in ((5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
        binary = square + struct.pack("<4H", *order)
        document, _ = one(
            meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
            accessors=[
                {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                {"bufferView": 1, "componentType": 5123, "count": 4, "type": "SCALAR"},
            ],
            bufferViews=[{"buffer": 0, "byteLength": 48},
                         {"buffer": 0, "byteOffset": 48, "byteLength": 8}],
        )  # fmt: skip
        file = tmp_path / f"{mode}.glb"
        file.write_bytes(glb(document, binary))
        if mode == 6:
            with pytest.raises(PhantomError, match="triangle fans"):
                mesh.read_part(file)
        else:
            a, b, c = np.moveaxis(mesh.read_part(file).triangles, 1, 0)
            assert np.cross(b - a, c - a)[:, 2].tolist() == [1e6, 1e6]


ACCESSOR = {"bufferView": 0, "componentType": 5126, "count": 12, "type": "VEC3"}
LINES = {"primitives": [{"attributes": {}, "mode": 1}] * 3000}
HOSTILE: dict[str, tuple[dict[str, Any], str]] = {
    "a count without bytes": (
        {"accessors": [{"componentType": 5126, "count": 30_000_000, "type": "VEC3"}]},
        "its data are not in the file",
    ),
    "a count beyond its bytes": (
        {"accessors": [{**ACCESSOR, "count": 13}]}, "reshape|12 items|bytes"),
    "a count of 10^30": ({"accessors": [{**ACCESSOR, "count": 10**30}]}, "claims more"),
    "a negative count": ({"accessors": [{**ACCESSOR, "count": -1}]}, "claims more"),
    "a stride of 0": (
        {"bufferViews": [{"buffer": 0, "byteLength": 144, "byteStride": 0}],
         "accessors": [{**ACCESSOR, "count": 3000}]}, "claims more"),
    "a view beyond the file": (
        {"bufferViews": [{"buffer": 0, "byteOffset": 4, "byteLength": 144}]}, "GLB file: "),
    "a file of the server": (
        {"buffers": [{"byteLength": 144, "uri": "file:///etc/passwd"}]}, "not in this file"),
    "sparse data": ({"accessors": [{**ACCESSOR, "sparse": {"count": 1}}]}, "as they are"),
    "an extension that changes the shape": (
        {"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
    "a circle of nodes": (
        {"nodes": [{"mesh": 0, "children": [1]}, {"children": [0]}]}, "two places"),
    "a node in ten places": ({"nodes": [{"children": [1] * 10}, {"mesh": 0}]}, "two places"),
    "ten million empty primitives": (
        {"nodes": [{"mesh": 0}] * 3000, "meshes": [LINES],
         "scenes": [{"nodes": list(range(3000))}]}, "9003000 nodes and parts"),
    "a mesh of four triangles in 400 places of 1 000 allowed": (
        {"nodes": [{"mesh": 0}] * 400, "scenes": [{"nodes": list(range(400))}]},
        "more than 1000 triangles"),
    "no such mesh": ({"nodes": [{"mesh": 7}]}, "does not hold together"),
    "no such node": ({"scenes": [{"nodes": ["a"]}]}, "GLB file: "),
    "not a number": ({"nodes": [{"mesh": 0, "translation": [float("nan"), 0, 0]}]}, "not finite"),
    "an endless place": (
        {"nodes": [{"children": [i + 1], "scale": [1e11] * 3} for i in range(40)]
         + [{"mesh": 0}]}, "not finite"),
    "an image of the server": (
        {"images": [{"uri": "file:///etc/passwd"}], "textures": [{"source": 0}],
         "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
         "buffers": [{"byteLength": 144, "uri": "http://127.0.0.1:9/x.bin"}]}, "not in this file"),
    "views of the same bytes, a thousand times": (
        {"bufferViews": [{"buffer": 0, "byteLength": 144}] * 1000}, "claims more"),
    "lists for objects": ({"accessors": [[]]}, "accessor 0"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_glb_is_refused_before_it_costs_memory(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, message = HOSTILE[name]
    monkeypatch.setattr(mesh, "MAX_FACES", 1000)
    raw = glb(*one(**change))
    tracemalloc.start()
    try:
        with pytest.raises(PhantomError, match=message) as caught:
            mesh_phantom(raw, file_type="glb")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if message != "not finite":
        assert caught.value.message.startswith("not a readable GLB file: ")
    assert peak < 16 << 20


def test_an_honest_document_of_the_same_making_is_read() -> None:
    p = mesh_phantom(glb(*one()), file_type="glb", unit="cm", place="centred")
    assert p.size_mm == pytest.approx((10.0, 10.0, 10.0))


@pytest.mark.parametrize(
    "raw",
    [
        b"glTF",
        glb(b"[]"),
        glb(b"[" * 100_000),
        glb(b"{"),
        glb(one()[0], b"")[:-30],
        glb(*one())[:-30],
        struct.pack("<4sII", b"glTF", 1, 20) + b"\0" * 40,
        struct.pack("<4sIII4s", b"glTF", 2, 0xFFFFFFFF, 0xFFFFFFFF, b"JSON"),
        glb(one()[0]),
    ],
    ids=range(9),
)
def test_broken_glb_files_say_so(raw: bytes) -> None:
    with pytest.raises(PhantomError, match=r"not a readable GLB file: .{10}"):
        mesh_phantom(raw, file_type="glb")


@pytest.mark.parametrize(
    ("raw", "form"),
    [
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n"
         b"end_header\n" + b"\0" * 64, "ply"),
        (b"ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n1\n",
         "ply"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\n"
         b"property list uint int vertex_indices\nend_header\n\xff\xff\xff\xff", "ply"),
        (b"ply\nformat ascii 1.0\n" + b"property list uchar int a\n" * 100_000, "ply"),
        (b"ply\n", "ply"),
        (b"OFF\n4000000000 4000000000 0\n0 0 0\n", "off"),
        (b"OFF\n-1 -1 0\n", "off"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3000000000 0 1 2\n", "off"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 99999999\n", "off"),
        (b"OFF", "off"),
    ],
    ids=range(10),
)  # fmt: skip
def test_hostile_ply_and_off_files_are_refused_before_they_cost_memory(
    raw: bytes, form: str
) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(PhantomError) as caught:
            mesh_phantom(raw, file_type=form)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert caught.value.message
    assert peak < 32 << 20


@pytest.mark.parametrize("place", ["file", "http"])
def test_what_a_glb_refers_to_is_never_opened(place: str, tmp_path: Path) -> None:
    """Neither a file beside it, which holds what the buffer should, nor an address."""
    document, binary = one()
    (tmp_path / "body.bin").write_bytes(binary)
    uri = "body.bin" if place == "file" else "http://127.0.0.1:9/body.bin"
    buffers = [{"byteLength": len(binary), "uri": uri}]
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    looks = {
        "images": [{"uri": uri}],
        "textures": [{"source": 0}],
        "materials": [material],
    }
    file = tmp_path / "part.glb"
    file.write_bytes(glb({**document, "buffers": buffers}))
    opened: list[str] = []

    def watch(event: str, arguments: Any) -> None:
        if watching and event in ("open", "socket.connect", "socket.getaddrinfo"):
            opened.append(f"{event} {arguments}")

    watching = True
    sys.addaudithook(watch)
    try:
        with pytest.raises(PhantomError, match="not in this file"):
            mesh_phantom(file)
        file.write_bytes(glb({**document, **looks}, binary))  # a picture is not looked at
        assert len(mesh_phantom(file, unit="cm").mesh().faces) == 4
    finally:
        watching = False
    assert opened
    assert not [one for one in opened if "body.bin" in one or "socket" in one]
