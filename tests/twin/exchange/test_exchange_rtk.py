"""RTK's XML beside the real itk-rtk: its own reader loads ours, and its projector agrees."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import CHIRAL, PITCH, SHAPE, some_parameters, some_poses, worst
from rtk_process import ANGLES, Rtk, Seen, joseph, read, rtk_process, write_circle

from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.exchange.rtk_xml import TO_RTK, read_rtk, rtk_text
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection import Volume, forward

# Loading RTK's wrappers takes longer than all that these tests ask of it.
pytestmark = pytest.mark.slow

if find_spec("itk") is None:  # it is used in a process of its own, not imported here
    pytest.skip("itk-rtk is not installed", allow_module_level=True)


@pytest.fixture(scope="module")
def rtk() -> Iterator[Rtk]:
    with rtk_process() as process:
        yield process


def pixels_by_rtk(seen: Seen, points: FloatArray) -> FloatArray:
    """Where RTK's matrices put points, (n, k, 2) as column and row."""
    out = []
    middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    for matrix in seen.matrices:
        image = matrix @ np.concatenate([TO_RTK @ points.T, np.ones((1, len(points)))])
        out.append((image[:2] / image[2]).T / PITCH + middle)
    return np.array(out)


def scan(seed: int) -> ScanGeometry:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, 5, even=False, still=False)
    return ScanGeometry(poses.cone_vec(some_parameters(rng)), SHAPE)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), up=st.booleans())
def test_rtk_reads_ours_and_sees_the_same(rtk: Rtk, seed: int, up: bool) -> None:
    geometry = scan(seed).rows_up() if up else scan(seed)
    seen = rtk(read, rtk_text(geometry))
    expected = geometry.cone_vec.project_points(CHIRAL, SHAPE)
    assert worst(pixels_by_rtk(seen, CHIRAL), expected) < 1e-8
    # Images upside down are RTK's own way to look: distances are positive then.
    assert (seen.distances[0] > 0) is up


def test_ours_reads_what_rtk_writes(rtk: Rtk) -> None:
    """RTK's circle about its own axis, with offsets and angles, written by RTK."""
    text, theirs = rtk(write_circle, 6)
    back = read_rtk(text, (PITCH, PITCH), SHAPE)
    places = back.cone_vec.project_points(CHIRAL, SHAPE)
    assert worst(places, pixels_by_rtk(theirs, CHIRAL)) < 1e-8
    again = rtk(read, rtk_text(back))
    for name in ANGLES:
        assert np.allclose(again.numbers[name], theirs.numbers[name], atol=1e-9)


def by_joseph(rtk: Rtk, geometry: ScanGeometry, volume: Volume) -> Float32Array:
    """RTK's Joseph projector: a volume of ours is [y][z][x] there, y backwards."""
    turned = volume.data.transpose(1, 0, 2)[::-1]
    shape = (len(geometry.cone_vec), *SHAPE)
    return rtk(joseph, rtk_text(geometry), turned, volume.voxel_xyz[0], shape, PITCH)


def chiral_volume() -> Volume:
    """Smooth blobs of different weight that no mirror turns into themselves."""
    ticks = (np.arange(80) - 39.5) * 0.5
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    data = np.zeros((80, 80, 80))
    for weight, (px, py, pz) in enumerate(CHIRAL, 1):
        data += weight * np.exp(-((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2) / 18.0)
    return Volume(data.astype(np.float32), 0.5)


def test_its_joseph_projector_sees_a_chiral_phantom_as_ours_does(rtk: Rtk) -> None:
    """Tilted and shifted panel, axis and source; wrong signs or mirrors would move the
    blobs."""
    poses = Poses(
        np.array([[3.0, 0, 18]]), np.array([[1.0, 600, 20]]), np.array([[2.0, 1050, 22]]),
        np.array([[PITCH, 0, 0]]), np.array([[0, 0, -PITCH]]), np.array([0.2, 1.1, 2.9, 4, 5.8]),
    )  # fmt: skip
    parameters = some_parameters(np.random.default_rng(11), 2.0)
    geometry = ScanGeometry(poses.cone_vec(parameters), SHAPE)
    volume = chiral_volume()
    ours = forward(volume, geometry.cone_vec, SHAPE)
    theirs = by_joseph(rtk, geometry, volume)
    scale = float(ours.max())
    # Interpolation differs (Joseph there, exact lengths here) and halves with the voxel; places
    # do not differ: least squares finds no shift along columns and rows [px].
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.01 * scale
    for one, other in zip(ours, theirs, strict=True):
        down, across = np.gradient(one)
        table = np.stack([-across.ravel(), -down.ravel(), one.ravel()], axis=1)
        shift = np.linalg.lstsq(table, (other - one).ravel(), rcond=None)[0]
        assert np.abs(shift[:2]).max() < 0.03
    # As the images would be if RTK's images were upside down: far from the same.
    assert np.sqrt(np.mean((ours - theirs[:, ::-1]) ** 2)) > 0.1 * scale
    flipped = by_joseph(rtk, geometry.rows_up(), volume)
    assert np.abs(flipped[:, ::-1] - theirs).max() < 1e-3 * scale


def test_the_frames_are_turned_not_mirrored() -> None:
    assert abs(np.linalg.det(TO_RTK) - 1.0) < 1e-15
    assert isinstance(scan(0).cone_vec, ConeVec)
