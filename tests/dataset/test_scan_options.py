"""What a user says of a scan's images means the same at every door."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from image_bytes_of import edf_file, meta_header, npy_file, png_file
from tiff_bytes_of import tiff_file

import flexdt as fx

h5py = pytest.importorskip("h5py")

VIEWS, SHAPE = 8, (12, 16)
ANGLES = np.arange(VIEWS) * 45.0
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=ANGLES, shape=SHAPE, pixel=0.2)
RNG = np.random.default_rng(11)
FRAMES = RNG.integers(500, 30_000, (VIEWS, *SHAPE)).astype("u2")
DARK, FLAT = np.full(SHAPE, 100, "u2"), np.full(SHAPE, 40_000, "u2")


def written(tmp_path: Path) -> Path:
    """A folder of images with all that options may name; dark and flat ones not by our names."""
    folder = tmp_path / "scan"
    folder.mkdir()
    for i, image in enumerate(FRAMES):
        (folder / f"P{i:03d}.TIF").write_bytes(b"")
        tifffile.imwrite(folder / f"P{i:03d}.TIF", image)
    (tmp_path / "dark.edf").write_bytes(edf_file([DARK, DARK]))
    (tmp_path / "white.png").write_bytes(png_file(FLAT))
    (tmp_path / "mean.npy").write_bytes(npy_file(FLAT.astype("f4")))
    (tmp_path / "angles.txt").write_text(
        "angle [deg]\n" + "".join(f"{a}\n" for a in ANGLES)
    )
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["exchange/theta"] = np.radians(ANGLES)
        file["exchange/theta"].attrs["units"] = "rad"
        file["exchange/white"] = FLAT[None]
        file["exchange/data"] = FRAMES
    SCAN.save(tmp_path / "scan.json")
    return folder


def saved(tmp_path: Path) -> Path:
    folder = tmp_path / "saved"
    shutil.rmtree(folder, ignore_errors=True)
    fx.DataSet.from_arrays(FRAMES, SCAN, dark=np.zeros(SHAPE), flat=np.ones(SHAPE)).save(
        folder
    )
    return folder


DOORS: dict[str, Callable[..., Any]] = {
    "open": lambda at, geometry, **said: fx.open(at / "scan", geometry=geometry, **said),
    "read_tiffs": lambda at, geometry, **said: fx.read_tiffs(
        at / "scan", geometry, **said
    ),
    "from_arrays": lambda at, geometry, **said: fx.DataSet.from_arrays(
        FRAMES, geometry, **said
    ),
    "HDF5": lambda at, geometry, **said: fx.read_tiffs(
        f"{at / 'other.h5'}:/exchange/data", geometry, **said
    ),
    "saved": lambda at, geometry, **said: fx.open(saved(at), geometry=geometry, **said),
}
WAYS = {
    "arrays": lambda at: {"dark": DARK, "flat": FLAT},
    "numbers": lambda at: {"dark": 100, "open_beam": 40_000},
    "images": lambda at: {"dark": DARK[None], "open_beam": FLAT},
    "files": lambda at: {"dark": at / "dark.edf", "flat": str(at / "white.png")},
    "patterns": lambda at: {
        "dark": f"{at}/dark.e*",
        "flat": [f"{at}/whi*", at / "mean.npy"],
    },
    "HDF5": lambda at: {"dark": "100", "flat": f"{at / 'other.h5'}:/exchange/white"},
    "floats": lambda at: {"dark": DARK.astype("f4"), "flat": at / "mean.npy"},
}
GEOMETRIES = {
    "value": lambda at: (SCAN, {}),
    "rows": lambda at: (SCAN.rows, {}),
    "file": lambda at: (at / "scan.json", {}),
    "angles": lambda at: (SCAN[:1], {"angles": ANGLES}),
    "angles' text": lambda at: (SCAN[:1], {"angles": str(at / "angles.txt")}),
    "angles in HDF5": lambda at: (
        SCAN[:1],
        {"angles": f"{at / 'other.h5'}:/exchange/theta"},
    ),
}


@pytest.mark.parametrize("door", DOORS)
def test_dark_and_flat_images_and_geometry_are_said_alike(
    tmp_path: Path, door: str
) -> None:
    written(tmp_path)
    expected = np.log(39_900 / (FRAMES - 100.0))
    for name, way in WAYS.items():
        data = DOORS[door](tmp_path, SCAN, **way(tmp_path))
        np.testing.assert_allclose(
            data.line_integrals(), expected, atol=2e-5, err_msg=name
        )
        assert not [w for w in data.warnings if "dark" in w or "flat" in w], name
    for name, way in GEOMETRIES.items():
        geometry, said = way(tmp_path)
        data = DOORS[door](tmp_path, geometry, flat=40_000, dark=100, **said)
        np.testing.assert_allclose(data.geometry.rows, SCAN.rows, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("door", DOORS)
def test_cuts_keep_every_pixel_where_it_was(tmp_path: Path, door: str) -> None:
    """A cut image's pixels lie where those of the whole image do, in each view that is kept."""
    written(tmp_path)
    said = {"flat": 40_000, "dark": 100}
    whole = DOORS[door](tmp_path, SCAN, **said)
    where = whole.geometry.pixel_centers()
    part = DOORS[door](tmp_path, SCAN, crop="2:10,3:15", binning=2, views="1::3", **said)
    assert part.shape == (4, 6)
    assert len(part) == 3
    kept = where[1::3, 2:10, 3:15].reshape(3, 4, 2, 6, 2, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(part.geometry.pixel_centers(), kept, atol=1e-9)
    means = (
        FRAMES[1::3, 2:10, 3:15].reshape(3, 4, 2, 6, 2).astype(float).mean(axis=(2, 4))
    )
    np.testing.assert_allclose(part.counts(), means, atol=0.51)
    np.testing.assert_allclose(
        part.line_integrals(), np.log(39_900 / (part.counts() - 100.0)), atol=2e-5
    )
    same = whole[[1, 4, 7]]
    np.testing.assert_array_equal(same.counts()[:, 2:4, 3], FRAMES[[1, 4, 7]][:, 2:4, 3])
    part.save(tmp_path / "part")
    again = fx.open(tmp_path / "part")
    np.testing.assert_array_equal(again.counts(), part.counts())
    np.testing.assert_allclose(again.geometry.rows, part.geometry.rows, atol=1e-6)


WRONG = [
    ({"flat": "none*"}, "flat is 'none*': there is no such file"),
    ({"flat": 1.0, "open_beam": 2.0}, "flat images and an open beam are two statements"),
    ({"dark": np.zeros((3, 4))}, r"dark images of shape 3 x 4; allowed: 12 x 16"),
    ({"dark": [[[["a"]]]]}, "dark"),
    ({"angles": [1.0, 2.0]}, "2 angles and 8 views"),
    ({"angles": "nothing.txt"}, "angles are 'nothing.txt': there is no such file"),
    ({"crop": "1:5"}, "crop is '1:5'; allowed: ROW:ROW,COLUMN:COLUMN"),
    ({"crop": "5:5,1:2"}, "crop is '5:5,1:2': nothing is left of 12 rows and 16 columns"),
    ({"crop": "0:99,1:2"}, "crop is '0:99,1:2' of images of 12 rows and 16 columns"),
    ({"binning": 13}, "binning is 13; allowed: a whole number from 1 to 12"),
    ({"views": "9:"}, "views are '9:': none of 8"),
    ({"views": "1;2"}, "views are '1;2'; allowed: FIRST:END:STEP"),
    ({"views": [8]}, "there is no view 8; allowed: 0 to 7"),
    (
        {"flat": "FILE:/exchange/none"},
        "has no data set /exchange/none; there are: /exchange/data",
    ),
    ({"flat": "FILE"}, "is an HDF5 file with /exchange/data"),
]


@pytest.mark.parametrize("door", DOORS)
def test_what_cannot_be_is_refused_alike(tmp_path: Path, door: str) -> None:
    written(tmp_path)
    for said, why in WRONG:
        given = {
            key: value.replace("FILE", str(tmp_path / "other.h5"))
            if isinstance(value, str)
            else value
            for key, value in said.items()
        }
        more = {} if {"flat", "open_beam"} & {*said} else {"flat": 40_000}
        with pytest.raises(fx.TwinError) as caught:
            DOORS[door](tmp_path, SCAN, **more, **given)
        assert why in str(caught.value), (door, said, str(caught.value))


@pytest.mark.parametrize("kind", ["u4", "i4", "f4", "f8"])
def test_projections_of_other_kinds_in_files(tmp_path: Path, kind: str) -> None:
    """uint32 beyond 65535 and floats are intensities, below it counts, as in NXtomo."""
    for scale in (1, 3):
        for i, image in enumerate(FRAMES):
            tifffile.imwrite(
                tmp_path / f"p{i}.tif", (scale * image.astype("f8")).astype(kind)
            )
        data = fx.read_tiffs(tmp_path, SCAN, dark=scale * 100, flat=scale * 40_000)
        expected = np.log(39_900 / (FRAMES - 100.0))
        np.testing.assert_allclose(data.line_integrals(), expected, atol=2e-5)


def test_projections_of_other_formats_in_folders(tmp_path: Path) -> None:
    for ending, content in (
        (".png", png_file), (".edf", lambda a: edf_file([a])), (".NPY", npy_file),
        (".mha", lambda a: meta_header(a.shape, "u2") + a.tobytes()),
    ):  # fmt: skip
        folder = tmp_path / ending[1:]
        folder.mkdir()
        for i, image in enumerate(FRAMES):
            (folder / f"p{i}{ending}").write_bytes(content(image))
        data = fx.open(folder, geometry=SCAN, open_beam=65535)
        np.testing.assert_array_equal(data.counts(), FRAMES)
    (tmp_path / "all.raw").write_bytes(FRAMES.tobytes())
    (tmp_path / "all.mhd").write_bytes(meta_header(FRAMES.shape, "u2", "all.raw"))
    stack = fx.open(tmp_path / "all.mhd", geometry=SCAN, open_beam=65535)
    np.testing.assert_array_equal(stack.counts(), FRAMES)


def test_a_simulated_scan_that_is_saved_knows_its_voltage(tmp_path: Path) -> None:
    """`fx.simulate` states the voltage in the folder's text; `material` needs no other word."""
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 2, "material": "pmma"}
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=24, shape=(16, 16), pixel=0.8)
    fx.simulate(ball, scan, tube=fx.Tube(kV=90), noise=1).save(tmp_path / "ball")
    data = fx.open(tmp_path / "ball")
    assert data.settings.kV == 90
    volume = data.reconstruct("fdk", material="pmma", voxel=0.8, errors=False)
    assert volume.data.max() > 0
    unknown = fx.DataSet.from_arrays(data.counts(), scan, dark=data.dark, flat=data.flat)
    with pytest.raises(
        fx.TwinError, match=r"tube=fx\.Tube\(kV=\.\.\.\), or its voltage with --kv"
    ):
        unknown.reconstruct("fdk", material="pmma", errors=False)


def test_a_scan_file_says_the_same_to_commands(tmp_path: Path) -> None:
    """`flexdt calibrate`, `align`, `reconstruct` and `export` open it as any data set."""
    from flexdt.clients.cli.commands.data_commands import scan_of

    written(tmp_path)
    whole = "images = 'scan'\ngeometry = 'scan.json'\n"
    texts = {
        "numbers": "dark = 100\nopen_beam = 40_000\n",
        "files": "dark = 'dark.edf'\nflat = ['white.png', 'mean.npy']\n",
        "HDF5": "dark = 100\nflat = 'other.h5:/exchange/white'\nangles = 'angles.txt'\n",
    }
    file = tmp_path / "my scan.toml"
    for text in texts.values():
        file.write_text(whole + text)
        for data in (fx.open(file), scan_of(file, False, None)):
            assert data.name == "my scan"
            np.testing.assert_allclose(
                data.line_integrals(), np.log(39_900 / (FRAMES - 100.0)), atol=2e-5
            )
    file.write_text(whole + texts["numbers"] + "crop = '2:10,3:15'\nviews = '::2'\n")
    assert fx.open(file).geometry.shape == (4, 8, 12)
    for text, why in (
        ("images = 'scan'\n", 'geometry is missing; allowed: geometry = "PATH"'),
        (
            whole + "falt = 3\n",
            "falt is not known, did you mean flat?; allowed: images, geometry",
        ),
        (whole + "flat = \n", "is not valid TOML"),
        (whole + "shape = 3\n", "shape is 3; allowed: [ROWS, COLUMNS]"),
        (whole + "flat = 'none*'\n", "flat is 'none*': there is no such file"),
    ):
        file.write_text(text)
        with pytest.raises(fx.TwinError) as caught:
            fx.open(file)
        assert why in str(caught.value)


def test_statements_of_the_images_are_a_part_of_the_data_set(tmp_path: Path) -> None:
    """What a TIFF says beside its pixels is used or ignored by name, once for the scan."""
    for i, image in enumerate(FRAMES):
        content = tiff_file(
            [image[::-1]],
            orientation=4,
            more=((65123, 3, [7]), (306, 2, b"2026:01:01 00:00:00\0")),
        )
        (tmp_path / f"p{i}.tif").write_bytes(content)
    data = fx.read_tiffs(tmp_path, SCAN, dark=0, open_beam=65535)
    np.testing.assert_array_equal(data.counts(), FRAMES)
    (turned,) = data.provenance.field("Orientation")
    assert (turned.use.value, turned.consequence) == ("used", "upside down")
    assert data.provenance.field("DateTime")[0].use.value == "ignored"
    assert [one.field for one in data.provenance.unknown] == ["65123"]
    assert data.warnings == ("p0.tif: 1 field not known to flexdt, ignored: 65123",)
