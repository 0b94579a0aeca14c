"""Angles that a file lacks are said by its caller, in all the ways in which they can be said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drawn_scans
import numpy as np
import pytest
from turned_balls import along

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

h5py = pytest.importorskip("h5py")
ANGLES = drawn_scans.ANGLES
PLACES = {"NXtomo": "entry/sample/rotation_angle", "Data Exchange": "exchange/theta"}


def written(form: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """A drawn file without its angles, and the arguments that it needs besides."""
    make, _, write = drawn_scans.FORMATS[form]
    draw = make(np.random.default_rng(5))
    draw.drop(PLACES[form])
    return write(folder, draw), draw.open


def a_text(folder: Path) -> str:
    np.savetxt(folder / "angles.txt", ANGLES)
    return "angles.txt"


def a_path(folder: Path) -> str:
    with h5py.File(folder / "turns.h5", "w") as file:
        file["at"] = np.deg2rad(ANGLES)
        file["at"].attrs["units"] = "rad"
    return f"{folder / 'turns.h5'}:/at"


@pytest.mark.parametrize("say", [lambda _: ANGLES, lambda _: [*ANGLES], a_text, a_path])
@pytest.mark.parametrize("form", PLACES)
def test_angles_that_are_said_take_their_place(
    form: str, say: Any, tmp_path: Path
) -> None:
    path, needed = written(form, tmp_path / "scan")
    data = fx.open(path, angles=say(path.parent), **needed)
    expected = along(data.geometry.rows, data.shape)
    assert np.abs(data.line_integrals() - expected).max() < 4e-3 * expected.max()
    some = fx.open(path, angles=say(path.parent), views="::2", **needed)
    np.testing.assert_array_equal(some.geometry.rows, data.geometry.rows[::2])


@pytest.mark.parametrize("form", PLACES)
def test_what_lacks_is_named_with_the_argument_that_gives_it(
    form: str, tmp_path: Path
) -> None:
    path, needed = written(form, tmp_path)
    with pytest.raises(
        DatasetError, match="give angles=DEGREES, one for each projection"
    ):
        fx.open(path, **needed)
    for count in (1, 7, 9, 11):  # NXtomo has 8 projections of 10 images
        with pytest.raises(DatasetError, match=rf"{count} angles for 8 projections"):
            fx.open(path, angles=np.arange(count), **needed)
    if form == "Data Exchange":
        with pytest.raises(
            DatasetError, match=r"distances=\(SOD_MM.* and angles=DEGREES"
        ):
            fx.open(path)


@pytest.mark.parametrize("form", PLACES)
def test_angles_that_are_there_are_turned_as_before(form: str, tmp_path: Path) -> None:
    make, _, write = drawn_scans.FORMATS[form]
    draw = make(np.random.default_rng(5))
    data = fx.open(write(tmp_path, draw), angles=ANGLES + 30.0, **draw.open)
    own = fx.open(tmp_path / data_file(form), **draw.open)
    turned = fx.open(
        tmp_path / data_file(form), geometry=own.geometry, angles=ANGLES + 30.0
    )
    np.testing.assert_allclose(data.geometry.rows, turned.geometry.rows, atol=1e-9)


def data_file(form: str) -> str:
    return "scan.nxs" if form == "NXtomo" else "scan.h5"


def test_angles_of_all_images_and_of_another_place_of_the_file(tmp_path: Path) -> None:
    """Diamond's layouts: images in one entry, angles in another, one for each image."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "d.nxs"
    with h5py.File(path, "w") as file:
        file["entry1/instrument/detector/data"] = np.full((8, 10, 12), 500, "u2")
        file["entry1/instrument/detector/image_key"] = np.array([2, 1] + [0] * 6)
        file["entry1/instrument/detector/x_pixel_size"] = 1e-4
        file["entry2/gts_cs_theta"] = np.r_[0.0, 0.0, np.arange(6) * 45.0]
    with pytest.raises(DatasetError) as refused:
        fx.open(path, distances=(100, 300))
    place = str(refused.value).split('angles="')[1].split('"')[0]
    assert place == "d.nxs:/entry2/gts_cs_theta"
    data = fx.open(path, distances=(100, 300), angles=place)
    assert np.allclose(np.diff(data.angles_deg), 45.0)
    with pytest.raises(DatasetError, match="6, or 8 of all images"):
        fx.open(path, distances=(100, 300), angles=np.arange(7.0))
