"""NXtomo's own figures: images made with each in closed form fit the geometry that is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from turned_balls import PITCH, SDD, SHAPE, SOD, VIEWS, integrals, worst

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

h5py = pytest.importorskip("h5py")
ANGLES = np.arange(VIEWS) * 360.0 / VIEWS
MIDDLE = ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2)
OPEN = 40_000.0
FITS = 2e-3
"""Of counts rounded to whole numbers, relative to the largest line integral."""


def written(
    path: Path,
    lines: Any,
    members: dict[str, Any],
    *,
    flat: float = OPEN,
    views: Any = 1.0,
    dark: float = 100.0,
) -> Path:
    """A file of one dark, one flat image and the projections of line integrals.

    Args:
        path: of the file.
        lines: integrals (n, rows, cols).
        members: place in the entry -> value, or (value, unit).
        flat: counts of the flat image above the dark one.
        views: factor of each projection's counts above the dark one.
        dark: counts of the dark image.
    """
    counts = OPEN * np.exp(-lines) * np.reshape(views, (-1, 1, 1)) + dark
    images = [np.full((1, *SHAPE), dark), np.full((1, *SHAPE), flat + dark), counts]
    with h5py.File(path, "w") as file:
        at = file.create_group("entry/instrument/detector")
        at["data"] = np.concatenate(images).round().astype(np.uint16)
        at["image_key"] = [2, 1] + [0] * len(lines)
        usual = {
            "sample/rotation_angle": (np.r_[0.0, 0.0, ANGLES], "deg"),
            "instrument/detector/x_pixel_size": (PITCH, "mm"),
            "instrument/detector/y_pixel_size": (PITCH, "mm"),
            "instrument/detector/distance": (SDD - SOD, "mm"),
            "instrument/source/distance": (-SOD, "mm"),
        }
        for place, value in (usual | members).items():
            held, unit = value if isinstance(value, tuple) else (value, "")
            file[f"entry/{place}"] = held
            if unit:
                file[f"entry/{place}"].attrs["units"] = unit
    return path


D = "instrument/detector"
CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "plain": (integrals(ANGLES), {}),
    "y_flipped": (integrals(ANGLES)[:, ::-1], {f"{D}/y_flipped": True}),
    "x_flipped": (integrals(ANGLES)[:, :, ::-1], {f"{D}/x_flipped": 1}),
    "both, as words": (
        integrals(ANGLES)[:, ::-1, ::-1],
        {f"{D}/x_flipped": b"True", f"{D}/y_flipped": "yes"},
    ),
    "turned about y": (
        integrals(ANGLES)[:, ::-1],
        {f"{D}/transformations/ry": (180.0, "deg")},
    ),
    "turned about z": (
        integrals(ANGLES)[:, :, ::-1],
        {f"{D}/transformations/rz": (np.pi, "rad")},
    ),
    "axis": (
        integrals(ANGLES, column=29.25),
        {f"{D}/x_rotation_axis_pixel_position": (29.25, "px")},
    ),
    "axis from the middle": (
        integrals(ANGLES, column=MIDDLE[1] - 4.5),
        {f"{D}/x_rotation_axis_pixel_position": -4.5},
    ),
    "axis, mirrored": (
        integrals(ANGLES, column=SHAPE[1] - 1 - 29.25)[:, :, ::-1],
        {f"{D}/x_rotation_axis_pixel_position": 29.25, f"{D}/x_flipped": True},
    ),
    "motor": (
        integrals(ANGLES, column=MIDDLE[1] + 3.0),
        {f"{D}/estimated_cor_from_motor": 3.0},
    ),
    "row": (
        integrals(ANGLES, row=23.0),
        {f"{D}/y_rotation_axis_pixel_position": 23.0},
    ),
    "helix": (
        integrals(ANGLES, heights=np.linspace(-2.0, 3.0, VIEWS)),
        {"sample/z_translation": (np.r_[0, 0, np.linspace(-2.0, 3.0, VIEWS)], "mm")},
    ),
    "one height": (
        integrals(ANGLES),
        {"sample/z_translation": (np.full(VIEWS + 2, 0.153), "m")},
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.daily(6)
def test_images_fit_the_geometry_that_is_read(name: str, tmp_path: Path) -> None:
    lines, members = CASES[name]
    data = fx.open(written(tmp_path / "scan.nx", lines, members))
    assert worst(data) < FITS
    assert len(data.warnings) == 1  # what is assumed
    for place in members:
        [value] = data.provenance.field(place)
        assert value.use == ("ignored" if name == "one height" else "used")


@pytest.mark.parametrize("name", [n for n in CASES if n not in ("plain", "one height")])
@pytest.mark.daily(4)
def test_the_images_would_show_a_figure_that_is_dropped(
    name: str, tmp_path: Path
) -> None:
    lines, _ = CASES[name]
    assert worst(fx.open(written(tmp_path / "scan.nx", lines, {}))) > 0.1


RAMP = np.linspace(1.0, 0.8, VIEWS)


@pytest.mark.parametrize(
    ("members", "counts"),
    [
        ({f"{D}/count_time": (np.r_[1.0, 2.0, np.ones(VIEWS)], "s")},
         {"views": 0.5}),
        ({"control/data": np.r_[0.0, 1.0, RAMP]}, {"views": RAMP}),
        ({f"{D}/count_time": np.r_[1.0, 0.5, RAMP], "control/data": np.r_[0.0, 1, 1 / RAMP]},
         {"flat": OPEN / 2}),
        ({f"{D}/count_time": (1.0, "s"), "control/data": 0.2}, {}),
    ],
)  # fmt: skip
def test_exposure_and_current_scale_the_counts(
    members: dict[str, Any], counts: dict[str, Any], tmp_path: Path
) -> None:
    lines = integrals(ANGLES)
    data = fx.open(written(tmp_path / "scan.nx", lines, members, **counts))
    assert worst(data) < 2 * FITS


def test_what_contradicts_is_told_with_both_values(tmp_path: Path) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({f"{D}/x_rotation_axis_pixel_position": 29.25, f"{D}/field_of_view": "Half"},
         "field_of_view is Half, and the axis stands in column 29.25 of 48"),
        ({f"{D}/x_rotation_axis_pixel_position": 3.0, f"{D}/field_of_view": "Full"},
         "field_of_view is Full, and the axis stands in column 3 of 48"),
        ({f"{D}/field_of_view": "Half"}, "no column of the axis is stated"),
        ({f"{D}/y_flipped": False, f"{D}/transformations/ry": (180.0, "deg")},
         "y_flipped says False, transformations/ry True; y_flipped is taken"),
        ({f"{D}/transformations/ry": (3.0, "deg")}, "a turn of 3 deg: not applied"),
        ({f"{D}/transformations/tx": (3.0, "mm")}, "transformations/tx 3 mm, which is not"),
        ({f"{D}/x_rotation_axis_pixel_position": 29.25,
          f"{D}/estimated_cor_from_motor": -1.0}, "29.25 px"),
        ({"sample/x_translation": np.linspace(0.0, 1.0, VIEWS + 2)},
         "x_translation 14 of float64: 0 to 1, which is not applied"),
        ({f"{D}/rotation_angle": np.r_[0.0, 0.0, -ANGLES]}, "view 11 is at"),
        ({"unknown_thing": 3.5}, "not known to flexdt, ignored: entry/unknown_thing = 3.5"),
        ({f"{D}/count_time": np.ones(3)}, "count_time has 3 values for 14 images"),
        ({"control/data": np.zeros(VIEWS + 2)}, "control/data has values that are not above"),
        ({f"{D}/count_time": np.r_[3.0, np.ones(VIEWS + 1)]}, "subtracted as they are"),
    ]  # fmt: skip
    for k, (members, words) in enumerate(cases):
        data = fx.open(written(tmp_path / f"{k}.nx", integrals(ANGLES), members))
        assert any(words in one for one in data.warnings), (words, data.warnings)


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({f"{D}/x_rotation_axis_pixel_position": 1e4}, "is 10000; allowed: about the 48"),
        ({f"{D}/x_rotation_axis_pixel_position": np.nan}, "is nan; allowed: a number"),
        ({"x_pixel_size": (0.2, "mm")}, "x_pixel_size is 0.75 mm and 0.2 mm"),
        ({f"{D}/x_pixel_size": (0.2, "ell")}, "in 'ell'"),
    ],
)
def test_impossible_figures_are_refused(
    members: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "scan.nx", integrals(ANGLES), members)
    with pytest.raises(DatasetError, match=words):
        fx.open(path)


def test_a_given_geometry_is_that_of_the_images_as_stored(tmp_path: Path) -> None:
    members = {f"{D}/y_flipped": True, "sample/z_translation": np.arange(VIEWS + 2.0)}
    path = written(tmp_path / "scan.nx", integrals(ANGLES), members)
    scan = fx.ConeVec.circular(sod=SOD, sdd=SDD, angles=ANGLES, shape=SHAPE, pixel=PITCH)
    data = fx.open(path, geometry=scan)
    assert worst(data) < FITS
    assert [one for one in data.warnings if "taken for the images as stored" in one]
    assert {one.field for one in data.provenance.of("contradicted")} > {
        "entry/instrument/detector/y_flipped",
        "entry/sample/z_translation",
    }


def test_flexdts_own_file_is_told_nothing(tmp_path: Path) -> None:
    scan = fx.ConeVec.circular(sod=SOD, sdd=SDD, angles=ANGLES, shape=SHAPE, pixel=PITCH)
    data = fx.simulate("lego", scan, noise=1)
    data.to_nxtomo(tmp_path / "scan.nx")
    again = fx.open(tmp_path / "scan.nx")
    assert again.warnings == ()
    assert again.provenance.unknown == ()
    np.testing.assert_array_equal(again.counts(), data.counts())
