"""RTK's XML beside the real itk-rtk: its own reader loads ours, and its projector agrees."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.exchange import ScanGeometry, read_rtk, rtk_text
from flexdt.twin.exchange.rtk import TO_RTK
from flexdt.twin.geometry import ConeVec
from flexdt.twin.pose import Poses
from flexdt.twin.projection import Volume, forward
from tests.twin.exchange.scans import CHIRAL, PITCH, SHAPE, some_parameters, some_poses, worst

# Its wrappers warn while they load, and end the process if that warning is made an error.
pytestmark = pytest.mark.filterwarnings("ignore")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    pytest.importorskip(
        "itk.Configuration.RTKConfig", reason="itk-rtk is not installed", exc_type=ImportError
    )
    import itk

    rtk = itk.RTK
    KIND = itk.Image[itk.F, 3]
    LOADED = (rtk.JosephForwardProjectionImageFilter[KIND, KIND],
              rtk.ThreeDCircularProjectionGeometryXMLFileReader)  # fmt: skip


def loaded(file: Path) -> Any:
    """What RTK's own reader makes of a file; it checks the matrices against the nine numbers."""
    reader = LOADED[1].New()
    reader.SetFilename(str(file))
    reader.GenerateOutputInformation()
    return reader.GetOutputObject()


def pixels_by_rtk(geometry: Any, points: FloatArray) -> FloatArray:
    """Where RTK's matrices put points, (n, k, 2) as column and row."""
    out = []
    middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    for i in range(len(geometry.GetGantryAngles())):
        matrix = np.array(itk.array_from_matrix(geometry.GetMatrix(i)))
        image = matrix @ np.concatenate([TO_RTK @ points.T, np.ones((1, len(points)))])
        out.append((image[:2] / image[2]).T / PITCH + middle)
    return np.array(out)


def scan(seed: int) -> ScanGeometry:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, 5, even=False, still=False)
    return ScanGeometry(poses.cone_vec(some_parameters(rng)), SHAPE)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), up=st.booleans())
def test_rtk_reads_ours_and_sees_the_same(
    seed: int, up: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    geometry = scan(seed).rows_up() if up else scan(seed)
    file = tmp_path_factory.mktemp("rtk") / "g.xml"
    file.write_text(rtk_text(geometry))
    expected = geometry.cone_vec.project_points(CHIRAL, SHAPE)
    assert worst(pixels_by_rtk(loaded(file), CHIRAL), expected) < 1e-8
    # Images upside down are RTK's own way to look: distances are positive then.
    assert (loaded(file).GetSourceToIsocenterDistances()[0] > 0) is up


def test_ours_reads_what_rtk_writes(tmp_path: Path) -> None:
    """RTK's circle about its own axis, with offsets and angles, written by RTK."""
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for i in range(6):
        geometry.AddProjection(600.0, 1100.0, 60.0 * i, 3.0, -2.0, 1.5, -0.5, 4.0, -2.5)
    file = tmp_path / "theirs.xml"
    writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetFilename(str(file))
    writer.SetObject(geometry)
    writer.WriteFile()
    back = read_rtk(file.read_text(), (PITCH, PITCH), SHAPE)
    assert worst(back.cone_vec.project_points(CHIRAL, SHAPE), pixels_by_rtk(geometry, CHIRAL)) < (
        1e-8
    )
    again = loaded_text(rtk_text(back), tmp_path)
    for name in ("GetGantryAngles", "GetOutOfPlaneAngles", "GetInPlaneAngles",
                 "GetProjectionOffsetsX", "GetSourceOffsetsY"):  # fmt: skip
        assert np.allclose(getattr(again, name)(), getattr(geometry, name)(), atol=1e-9)


def loaded_text(text: str, folder: Path) -> Any:
    file = folder / "again.xml"
    file.write_text(text)
    return loaded(file)


def joseph(geometry: Any, volume: Volume, views: int) -> Float32Array:
    """RTK's Joseph projector: a volume of ours is [y][z][x] there, y backwards."""
    image = itk.image_from_array(np.ascontiguousarray(volume.data.transpose(1, 0, 2)[::-1]))
    size = volume.voxel_xyz[0]
    nz, ny, nx = volume.shape
    image.SetSpacing([size] * 3)
    image.SetOrigin([-(n - 1) / 2 * size for n in (nx, nz, ny)])
    stack = itk.image_from_array(np.zeros((views, *SHAPE), np.float32))
    stack.SetSpacing([PITCH, PITCH, 1.0])
    stack.SetOrigin([-(SHAPE[1] - 1) / 2 * PITCH, -(SHAPE[0] - 1) / 2 * PITCH, 0.0])
    project = LOADED[0].New()
    project.SetInput(0, stack)
    project.SetInput(1, image)
    project.SetGeometry(geometry)
    project.Update()
    return np.array(itk.array_from_image(project.GetOutput()))


def chiral_volume() -> Volume:
    """Smooth blobs of different weight that no mirror turns into themselves."""
    ticks = (np.arange(80) - 39.5) * 0.5
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    data = np.zeros((80, 80, 80))
    for weight, (px, py, pz) in enumerate(CHIRAL, 1):
        data += weight * np.exp(-((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2) / 18.0)
    return Volume(data.astype(np.float32), 0.5)


def test_its_joseph_projector_sees_a_chiral_phantom_as_ours_does(tmp_path: Path) -> None:
    """Tilted and shifted panel, axis and source; wrong signs or mirrors would move the blobs."""
    poses = Poses(
        np.array([[3.0, 0, 18]]), np.array([[1.0, 600, 20]]), np.array([[2.0, 1050, 22]]),
        np.array([[PITCH, 0, 0]]), np.array([[0, 0, -PITCH]]), np.array([0.2, 1.1, 2.9, 4, 5.8]),
    )  # fmt: skip
    parameters = some_parameters(np.random.default_rng(11), 2.0)
    geometry = ScanGeometry(poses.cone_vec(parameters), SHAPE)
    volume = chiral_volume()
    ours = forward(volume, geometry.cone_vec, SHAPE)
    theirs = joseph(loaded_text(rtk_text(geometry), tmp_path), volume, 5)
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
    flipped = joseph(loaded_text(rtk_text(geometry.rows_up()), tmp_path), volume, 5)
    assert np.abs(flipped[:, ::-1] - theirs).max() < 1e-3 * scale


def test_the_frames_are_turned_not_mirrored() -> None:
    assert abs(np.linalg.det(TO_RTK) - 1.0) < 1e-15
    assert isinstance(scan(0).cone_vec, ConeVec)
