"""What an NXtomo file may contradict: links, keys, sizes, angles, pixels, entries, blank frames."""

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.geometry.cone_vec import ConeVec

h5py = pytest.importorskip("h5py")
VIEWS, SHAPE = 12, (6, 8)
ANGLES = np.arange(VIEWS) * 30.0
SCAN = ConeVec.circular(sod=100, sdd=200, angles=ANGLES, pixel=0.2)


def entry(file, name="entry", keys=None, images=None, angles=ANGLES, unit="deg", pixel=2e-4,
          length="m"):  # fmt: skip
    keys = [2, 1] + [0] * VIEWS if keys is None else keys
    if images is None:
        images = np.full((len(keys), *SHAPE), 500, np.uint16)
        images[0], images[1] = 10, 1000
        images[2:] += np.arange(len(keys) - 2, dtype=np.uint16)[:, None, None]
    at = file.create_group(f"{name}/instrument/detector")
    at["data"], at["image_key"] = images, np.array(keys)
    if angles is not None:
        turned = np.concatenate([[0.0, 0.0], np.asarray(angles)])
        file[f"{name}/sample/rotation_angle"] = turned
        file[f"{name}/sample/rotation_angle"].attrs["units"] = unit
    if pixel is not None:
        at["x_pixel_size"] = pixel
        at["x_pixel_size"].attrs["units"] = length


def opened(path, geometry=SCAN):
    return fx.open(path, geometry=geometry)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "scan.nx"


@pytest.mark.parametrize(("angles", "unit"), [
    (ANGLES, "deg"), (-ANGLES, "deg"), (ANGLES + 17.0, "deg"), (np.radians(ANGLES), "rad"),
    (ANGLES % 180 + 180 * (ANGLES >= 180), "degree"), (None, "deg"), (0 * ANGLES, "deg"),
])  # fmt: skip
@pytest.mark.parametrize(("pixel", "length"), [
    (2e-4, "m"), (0.2, "mm"), (200.0, "um"), (1e-4, "m"), (None, "m"),
])  # fmt: skip
def test_right_files_are_told_nothing(path, angles, unit, pixel, length):
    with h5py.File(path, "w") as file:
        entry(file, angles=angles, unit=unit, pixel=pixel, length=length)
    assert opened(path).warnings == ()


@pytest.mark.parametrize(("angles", "unit", "sentence"), [
    (ANGLES[[0, 2, 1, *range(3, VIEWS)]], "deg", "another order"),
    (np.radians(ANGLES), "deg", "as radians"),
    (ANGLES * 0.9, "deg", "differ by up to"), (ANGLES.reshape(2, -1).T.ravel(), "deg", "order"),
    (ANGLES / 2, "deg", "differ by up to"),
])  # fmt: skip
def test_angles_that_are_not_the_geometrys_are_said(path, angles, unit, sentence):
    with h5py.File(path, "w") as file:
        entry(file, angles=angles, unit=unit)
    assert any(sentence in doubt for doubt in opened(path).warnings)


@pytest.mark.parametrize(("pixel", "length"), [(2e-4, "mm"), (0.2, "m"), (3e-4, "m")])
def test_pixels_that_are_not_the_geometrys_are_said(path, pixel, length):
    with h5py.File(path, "w") as file:
        entry(file, pixel=pixel, length=length)
    assert any("the file's pixel" in doubt for doubt in opened(path).warnings)


def test_of_several_entries_the_one_that_is_read_is_said(path):
    with h5py.File(path, "w") as file:
        entry(file, "entry0000")
        entry(file, "entry0001")
    assert any(
        "entry0000 is read, not entry0001" in doubt for doubt in opened(path).warnings
    )


@pytest.mark.parametrize("keys", [[2, 1] + [0] * (VIEWS - 1), [2, 1] + [0] * (VIEWS + 4), [0] * 6,
                                  [0] * 8])  # fmt: skip
def test_keys_of_another_length_are_refused(path, keys):
    with h5py.File(path, "w") as file:
        images = np.full((VIEWS + 2, *SHAPE), 500, np.uint16)
        entry(file, keys=keys, images=images, angles=None)
    with pytest.raises(DatasetError, match="image keys"):
        opened(path)


@pytest.mark.parametrize(
    "keys", [[0] * (VIEWS + 2), [2, 2] + [0] * VIEWS, [3, 3] + [0] * VIEWS]
)
def test_flat_images_in_another_file_are_asked_for(path, keys):
    """Savu#400: no flat image, dark ones alone, invalid ones; line integrals need none."""
    views = keys.count(0)
    scan = ConeVec.circular(sod=100, sdd=200, angles=views, pixel=0.2)
    with h5py.File(path, "w") as file:
        entry(file, keys=keys, angles=None)
    data = opened(path, scan)
    assert any("no image has the key of a flat image, 1" in one for one in data.warnings)
    with pytest.raises(DatasetError, match="key 1 of an NXtomo file"):
        data.line_integrals()
    images = np.linspace(0.1, 0.4, VIEWS * 48).reshape(VIEWS, *SHAPE)
    with h5py.File(path, "w") as file:
        entry(file, keys=[0] * VIEWS, angles=None, images=images)
    np.testing.assert_allclose(opened(path).line_integrals(), images, rtol=1e-6)
    flat = np.full((2, *SHAPE), 1000)  # from the other file
    whole = fx.DataSet.from_arrays(data.counts(), scan, dark=data.dark, flat=flat)
    assert np.isfinite(whole.line_integrals()).all()


def test_keys_that_nobody_knows_are_left_out_and_said(path):
    with h5py.File(path, "w") as file:
        entry(file, keys=[2, 1, -1, -1] + [0] * (VIEWS - 2), angles=None)
    data = opened(path, SCAN[2:])
    assert len(data) == VIEWS - 2
    assert any("keys -1" in doubt for doubt in data.warnings)


@pytest.mark.parametrize("kind", ["external", "soft"])
@pytest.mark.parametrize("part", ["data", "image_key"])
def test_links_that_lead_nowhere_are_named(path, kind, part):
    with h5py.File(path, "w") as file:
        entry(file)
        at = file["entry/instrument/detector"]
        del at[part]
        at[part] = (
            h5py.ExternalLink("raw.h5", "/x")
            if kind == "external"
            else h5py.SoftLink("/x")
        )
    with pytest.raises(DatasetError, match="which is not there"):
        opened(path)


@pytest.mark.parametrize("shape", [(60_000, 2000, 2000), (2_000_000, 3000, 3000)])
def test_images_that_were_never_written_are_refused(path, shape):
    with h5py.File(path, "w") as file:
        at = file.create_group("entry/instrument/detector")
        at.create_dataset("data", shape, "u2", chunks=(1, 1000, 1000))
        at["image_key"] = np.zeros(shape[0], np.int8)
    assert path.stat().st_size < 5 << 20
    with pytest.raises(DatasetError, match="claims images of"):
        opened(path)


def test_a_virtual_set_whose_source_is_gone_is_refused(path, tmp_path):
    with h5py.File(tmp_path / "raw.h5", "w") as raw:
        raw["images"] = np.full((VIEWS + 2, *SHAPE), 500, np.uint16)
    with h5py.File(path, "w") as file:
        entry(file)
        at = file["entry/instrument/detector"]
        del at["data"]
        layout = h5py.VirtualLayout((VIEWS + 2, *SHAPE), "u2")
        layout[:] = h5py.VirtualSource("raw.h5", "images", (VIEWS + 2, *SHAPE))
        at.create_virtual_dataset("data", layout)
    assert opened(path).complete
    (tmp_path / "raw.h5").unlink()
    with pytest.raises(DatasetError, match=r"raw\.h5, which is not there"):
        opened(path)


def test_frames_without_anything_recorded_are_said(path):
    images = np.full((VIEWS + 2, *SHAPE), 500, np.uint16)
    images[-3:] = 0
    with h5py.File(path, "w") as file:
        entry(file, images=images)
    data = opened(path)
    assert not data.complete
    assert "3 of 12 images are zero" in data.reason


@pytest.mark.parametrize(
    "junk", [b"", b"\x89HDF\r\n\x1a\n" + b"\x00" * 100, b"not HDF5" * 40]
)
def test_other_bytes_are_the_files_error(path, junk):
    path.write_bytes(junk)
    with pytest.raises(DatasetError, match=r"scan\.nx"):
        opened(path)


@pytest.mark.parametrize(("unit", "scale"), [("m", 1e-3), ("mm", 1.0)])
def test_angles_pixels_and_distances_make_a_geometry(path, unit, scale):
    with h5py.File(path, "w") as file:
        entry(file)
        for place, length in (("source", -100.0), ("detector", 100.0)):
            at = file.require_group(f"entry/instrument/{place}")
            at["distance"] = length * scale
            at["distance"].attrs["units"] = unit
    data = fx.open(path)
    np.testing.assert_allclose(data.geometry.rows, SCAN.rows, atol=1e-9)
    assert "an upright panel is assumed" in str(data.warnings)


def test_angles_and_pixels_need_two_distances(path):
    with h5py.File(path, "w") as file:
        entry(file)
    with pytest.raises(
        DatasetError, match=r"no source distance, detector distance; give distances="
    ):
        fx.open(path)
    data = fx.open(path, distances=(100.0, 200.0))
    np.testing.assert_allclose(data.geometry.rows, SCAN.rows, atol=1e-9)
    folder = fx.open(path.parent, distances=(100.0, 200.0))  # the only scan in its folder
    np.testing.assert_array_equal(folder.counts(), data.counts())


@pytest.mark.parametrize(
    ("lacking", "way"),
    [
        ("angles", r"give angles=DEGREES"),
        ("pixel", r"give geometry=fx\.ConeVec\.circular"),
    ],
)
def test_what_else_is_missing_is_asked_for(path, lacking, way):
    with h5py.File(path, "w") as file:
        entry(file, **{lacking: None})
    with pytest.raises(DatasetError, match=way):
        fx.open(path, distances=(100.0, 200.0))
