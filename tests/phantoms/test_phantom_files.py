"""Meshes and phantom files from strangers: right ones load, wrong ones get a readable error."""

from __future__ import annotations

import json
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from flexdt.phantoms import (
    Phantom,
    PhantomError,
    load_phantom,
    load_phantom_file,
    mesh_phantom,
    phantom_names,
    voxel_phantom,
)
from flexdt.twin.errors import TwinError, UnknownNameError
from tests.support.phantom_texts import BEAD_FILE


def stl(mesh: trimesh.Trimesh) -> bytes:
    return bytes(mesh.export(file_type="stl"))


@pytest.mark.parametrize("file_type", ["stl", "obj"])
def test_units_scale_and_the_box_is_centred_where_asked(file_type: str) -> None:
    mesh = trimesh.creation.torus(0.6, 0.2)
    mesh.apply_translation((3.0, 4.0, 5.0))
    raw = mesh.export(file_type=file_type)
    raw = raw if isinstance(raw, bytes) else raw.encode()
    p = mesh_phantom(
        raw, unit="cm", file_type=file_type, material="aluminium", place="centred"
    )
    assert p.size_mm == pytest.approx((16.0, 16.0, 4.0), rel=1e-3)
    assert p.mesh().bounds == pytest.approx(np.array([[-8, -8, -2], [8, 8, 2]]), rel=1e-3)
    kept = mesh_phantom(raw, unit="cm", file_type=file_type)
    assert kept.mesh().center_mass == pytest.approx([30, 40, 50], abs=0.05)


def test_a_path_gives_name_and_format(tmp_path: Path) -> None:
    path = tmp_path / "vase.STL"
    path.write_bytes(stl(trimesh.creation.annulus(2.0, 5.0, 10.0)))
    p = mesh_phantom(path)
    assert p.name == "vase"
    assert not p.is_analytic
    assert "abs" in p.description
    with pytest.raises(FileNotFoundError, match=r"there is no file .*missing.stl"):
        mesh_phantom(tmp_path / "missing.stl")


def test_inconsistent_faces_are_turned_the_right_way() -> None:
    mesh = trimesh.creation.icosphere(2, 5.0)
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    p = mesh_phantom(
        stl(trimesh.Trimesh(mesh.vertices, faces, process=False)), file_type="stl"
    )
    assert p.mesh().volume == pytest.approx(mesh.volume, rel=1e-5)


def test_each_body_keeps_its_sense_when_faces_are_turned() -> None:
    """A cavity stays a cavity, and many separate bodies take no time."""
    outer, inner = trimesh.creation.icosphere(2, 6.0), trimesh.creation.icosphere(2, 3.0)
    inner.invert()
    both = trimesh.util.concatenate([outer, inner])
    faces = both.faces.copy()
    faces[::7] = faces[::7, ::-1]
    p = mesh_phantom(
        stl(trimesh.Trimesh(both.vertices, faces, process=False)), file_type="stl"
    )
    assert p.mesh().volume == pytest.approx(both.volume, rel=1e-5)
    grid = [trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix(at))
            for at in np.ndindex(12, 12, 12) for at in [2.0 * np.array(at)]]  # fmt: skip
    many = trimesh.util.concatenate(grid)
    faces = many.faces.copy()
    faces[::12] = faces[::12, ::-1]
    p = mesh_phantom(
        stl(trimesh.Trimesh(many.vertices, faces, process=False)), file_type="stl"
    )
    assert p.mesh().volume == pytest.approx(12**3)


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (exec, ("raise SystemExit('unpickled')",))


def binary_stl(count: int, body: bytes) -> bytes:
    return b"\0" * 80 + struct.pack("<I", count) + body


NAN_FACE = struct.pack("<12fH", *[0.0] * 3, *[float("nan")] * 9, 0)
HUGE_FACES = b"".join(
    struct.pack("<12fH", 0, 0, 0, *(1e30 * np.array(t)).ravel(), 0)
    for t in trimesh.creation.box((1, 1, 1)).triangles
)


@pytest.mark.parametrize(
    ("raw", "kind"),
    [
        (b"", "stl"),
        (b"solid", "stl"),
        (b"\x00" * 84, "stl"),
        (binary_stl(4_000_000_000, b""), "stl"),
        (binary_stl(1, NAN_FACE), "stl"),
        (binary_stl(12, HUGE_FACES), "stl"),
        (b"solid x\nfacet normal 0 0\nvertex a b c\nendfacet\nendsolid", "stl"),
        (b"v 0 0 0\nf 1 2 999999999\n", "obj"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "obj"),
        (b"f\nv\nf 1/2/3/4/5 a b\n", "obj"),
        (pickle.dumps(Bomb()), "stl"),
        (pickle.dumps(Bomb()), "obj"),
        (pickle.dumps(Bomb()), "pkl"),
        (pickle.dumps(Bomb()), "npy"),
        (b"\xff" * 1000, "obj"),
        (stl(trimesh.creation.box((1, 1, 1)))[:-60], "stl"),
    ],
    ids=range(16),
)
def test_hostile_meshes_are_refused_readably(raw: bytes, kind: str) -> None:
    with pytest.raises(PhantomError) as caught:
        mesh_phantom(raw, file_type=kind)
    assert caught.value.message
    json.dumps(caught.value.data)


@pytest.mark.parametrize("solids", [1, 2, 3, 5])
def test_all_solids_of_a_text_file_are_read(solids: int) -> None:
    """trimesh#1053, #1720: not the first alone."""
    boxes = []
    for number in range(solids):
        box = trimesh.creation.box((1.0, 1.0, 1.0))
        box.apply_translation((3.0 * number, 0.0, 0.0))
        boxes.append(trimesh.exchange.stl.export_stl_ascii(box))
    text = "\n".join(boxes).encode()
    phantom = mesh_phantom(text, file_type="stl", place="centred")
    assert phantom.mesh().volume == pytest.approx(solids)
    assert phantom.size_mm[0] == pytest.approx(3.0 * solids - 2.0)


@pytest.mark.parametrize("announced", [11, 13, 10**6])
@pytest.mark.parametrize("trailing", [0, 1, 3])
def test_a_head_that_counts_wrongly_is_told(announced: int, trailing: int) -> None:
    """trimesh#1720: the sentence names both lengths."""
    body = stl(trimesh.creation.box((1, 1, 1)))[84:] + b"\0" * trailing
    said = f"announces {announced} triangles, .* it has {84 + len(body)} bytes"
    with pytest.raises(PhantomError, match=said):
        mesh_phantom(binary_stl(announced, body), file_type="stl")


def test_an_obj_does_not_make_us_read_other_files(tmp_path: Path) -> None:
    """Were the material file opened, its bad content would show up; the mesh loads
    regardless."""
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd /etc/hostname\n")
    mesh = str(trimesh.creation.box((1, 2, 3)).export(file_type="obj"))
    path = tmp_path / "box.obj"
    path.write_text("mtllib secret.mtl\nmtllib ../../../etc/passwd\nusemtl a\n" + mesh)
    assert mesh_phantom(path).size_mm == pytest.approx((1, 2, 3))


def test_wrong_units_and_materials_say_what_is_allowed() -> None:
    raw = stl(trimesh.creation.box((1, 2, 3)))
    with pytest.raises(PhantomError, match="allowed: um, mm, cm, m, inch"):
        mesh_phantom(raw, file_type="stl", unit="furlong")
    with pytest.raises(PhantomError, match="Is the unit right"):
        mesh_phantom(raw, file_type="stl", unit="m")
    with pytest.raises(UnknownNameError, match="steel"):
        mesh_phantom(raw, file_type="stl", material="unobtainium")


def test_the_example_file_loads() -> None:
    p = load_phantom_file(BEAD_FILE)
    assert p.name == "mine"
    assert p.beads.tolist() == [[5, 0, -12], [0, 6, 12]]
    assert p.size_mm == (20, 20, 40)


def test_a_spiral_file_equals_the_cuboid_of_the_table() -> None:
    text = """
schema = 1
name = "again"
[body]
size_mm = [20, 40, 60]
[spiral]
beads = 5
"""
    assert load_phantom_file(text).scene == load_phantom("normal-5").scene


@pytest.mark.parametrize("name", phantom_names())
def test_documents_come_back_equal(name: str) -> None:
    p = load_phantom(name)
    assert Phantom.from_dict(json.loads(json.dumps(p.to_dict()))) == p
    assert load_phantom_file(json.dumps(p.to_dict())) == p


def test_mesh_and_voxel_documents_come_back_equal() -> None:
    mesh = mesh_phantom(stl(trimesh.creation.torus(5.0, 1.0)), file_type="stl")
    grid = voxel_phantom(
        np.random.default_rng(0).random((3, 4, 5), dtype=np.float32), 0.5
    )
    for p in (mesh, grid):
        assert Phantom.from_dict(json.loads(json.dumps(p.to_dict()))) == p


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('name = "mine"\ncolour = "red"', "unknown key 'colour'"),
        ('name = "mine"', "[[bead]]"),
        ('name = 3\n[[bead]]\nposition_mm=[0,0,0]\nradius_mm=1', "phantom.name is 3"),
        ('name = "a"\n[[bead]]\nposition_mm=[0,0]\nradius_mm=1', "three numbers"),
        ('name = "a"\n[[bead]]\nposition_mm=[0,0,nan]\nradius_mm=1', "from -1e+09 to 1e+09"),
        ('name = "a"\n[[bead]]\nposition_mm=[0,0,1]\nradius_mm=0', "from 1e-09 to 1e+09"),
        ('name = "a"\n[[bead]]\nposition_mm=[0,0,1]\nradius_mm=1\nmaterial="x"', "steel"),
        ('name = "a"\n[body]\nsize_mm=[4,4,4]\n[[bead]]\nposition_mm=[0,0,9]\nradius_mm=1',
         "bead 0 at [0.0, 0.0, 9.0] mm with radius 1 mm sticks out"),
        ('name = "a"\n[[bead]]\nposition_mm=[0,0,9]\nradius_mm=1\n'
         '[[bead]]\nposition_mm=[0,0,8]\nradius_mm=2', "beads 0 and 1 overlap by 2 mm"),
        ('name = "a"\n[spiral]\nbeads=5', "needs a [body]"),
        ('name = ', "not valid TOML"),
    ],
)  # fmt: skip
def test_wrong_bead_files_name_file_key_and_allowed(change: str, message: str) -> None:
    with pytest.raises(PhantomError) as caught:
        load_phantom_file("schema = 1\n" + change, "my.toml")
    assert message in caught.value.message
    assert caught.value.message.startswith("my.toml: ")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)
KEYS = list(load_phantom("lego").to_dict())


@given(key=st.sampled_from(KEYS), value=JSON)
def test_garbage_in_a_document_is_a_phantom_error(key: str, value: object) -> None:
    document = {**load_phantom("compact-2").to_dict(), key: value}
    try:
        Phantom.from_dict(document)
    except TwinError as error:
        json.dumps(error.data)


@given(value=JSON)
def test_garbage_documents_are_a_phantom_error(value: object) -> None:
    with pytest.raises(PhantomError):
        Phantom.from_dict(value)
