"""Shells inside others: cavities turned inwards are cavities, and turned outwards are said."""

import warnings

import numpy as np
import pytest
import trimesh

import flexdt as fx
from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.files.mesh_files import mesh_phantom

SCAN = fx.ConeVec.from_vectors(
    [0, -500, 0], [0, 500, 0], [0.5, 0, 0], [0, 0, -0.5], (1, 1)
)


def stl(*bodies):
    return trimesh.util.concatenate(bodies).export(file_type="stl")


def box(side, at=(0, 0, 0), *, inward=False):
    made = trimesh.creation.icosphere(radius=side / 2, subdivisions=2)
    made.apply_translation(at)
    if inward:
        made.invert()
    return made


@pytest.mark.parametrize("inner", [[3.0], [3.0, 1.0], [2.0, 2.0]])
def test_cavities_turned_outwards_are_said(inner):
    places = [(0, 0, 0)] if len(inner) == 1 else [(-2, 0, 0), (2, 0, 0)]
    bodies = [box(side, at) for side, at in zip(inner, places, strict=True)]
    many = "1 shell lies" if len(inner) == 1 else f"{len(inner)} shells lie"
    with pytest.warns(UserWarning, match=many):
        mesh_phantom(stl(box(10), *bodies), file_type="stl")


@pytest.mark.parametrize("bodies", [
    [box(10)], [box(10), box(4, inward=True)], [box(10), box(6, inward=True), box(3)],
    [box(4, (-5, 0, 0)), box(4, (5, 0, 0))], [box(6), box(6, (3, 0, 0))],
])  # fmt: skip
def test_right_shells_are_told_nothing(bodies):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh_phantom(stl(*bodies), file_type="stl")


def test_a_cavity_is_missing_from_the_path():
    solid, hollow = (
        fx.project(mesh_phantom(stl(*bodies), file_type="stl"), SCAN)[0, 0, 0]
        for bodies in ([box(10)], [box(10), box(4, inward=True)])
    )
    assert hollow / solid == pytest.approx(0.6, rel=0.05)


def turned(mesh, every):
    faces = mesh.faces.copy()
    faces[::every] = faces[::every, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


@pytest.mark.parametrize("every", [1, 2, 3, 7])
@pytest.mark.parametrize("bodies", [[box(10)], [box(6, (-4, 0, 0)), box(4, (4, 1, 0))]])
@pytest.mark.parametrize("door", ["stl", "mesh"])
def test_faces_turned_inside_out_cast_the_same_image(every, bodies, door):
    """WebCT#8, stl-to-voxel#63, Slic3r#3245: all of them, or some."""
    scan = fx.ConeVec.circular(sod=50, sdd=80, angles=3, shape=(9, 15), pixel=1.5)
    whole = trimesh.util.concatenate(bodies)
    samples = [whole, turned(whole, every)]
    if door == "stl":
        samples = [mesh_phantom(stl(one), file_type="stl") for one in samples]
    right, found = (fx.project(one, scan) for one in samples)
    assert right.max() > 0.1
    np.testing.assert_allclose(found, right, atol=1e-5 * right.max())


@pytest.mark.parametrize("wrong", [3, 50, -3, -50])
def test_a_binary_stl_of_another_length_says_so(wrong):
    raw = stl(box(10))
    raw = raw + bytes(wrong) if wrong > 0 else raw[:wrong]
    with pytest.raises(PhantomError, match="its head announces 320 triangles"):
        mesh_phantom(raw, file_type="stl")


def test_texts_are_read():
    text = box(10).export(file_type="stl_ascii").encode()
    assert np.allclose(mesh_phantom(text, file_type="stl").size_mm, 10, rtol=0.02)
