"""Dark and flat images are looked at when a scan is opened, at every door alike."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import flexdt as fx

VIEWS, SHAPE = 12, (40, 64)
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=VIEWS, pixel=0.2)
RNG = np.random.default_rng(5)
OPENED, OFFSET = 40_000.0, 300.0


def exposed(light: Any) -> np.ndarray[Any, Any]:
    """Counts of this part of the open beam, with the noise of one photon a count."""
    lit = np.broadcast_to(np.asarray(light, float), SHAPE)
    return (RNG.poisson(OPENED * lit) + RNG.normal(OFFSET, 3, SHAPE)).round().astype("u2")


COLUMNS = np.arange(SHAPE[1])
BODY = np.where(np.abs(COLUMNS - 31) < 12, 0.2, 1.0)
FRAMES = [exposed(BODY) for _ in range(VIEWS)]
DARKS = [exposed(0.0) for _ in range(2)]
FLATS = [exposed(1.0) for _ in range(2)]
HALF = exposed(0.5)

CASES = {
    "right": (DARKS, FLATS, None),
    "one of two flats black": (DARKS, [FLATS[0], exposed(0.0)], "the flat images differ by 200 %"),
    "one of two darks lit": ([DARKS[0], HALF], FLATS, "the dark images differ by"),
    "a dark of 20 000 counts": ([HALF], FLATS, "of the projections is darker than the dark image"),
    "flats of half the exposure": (DARKS, [HALF], "the open beam beside the object is 2"),
    "no dark image": ([], FLATS, None),
}  # fmt: skip


def folder(tmp_path: Path, darks: list[Any], flats: list[Any]) -> Any:
    for kind, images in (("di", darks), ("io", flats), ("p", FRAMES)):
        for i, image in enumerate(images):
            tifffile.imwrite(tmp_path / f"{kind}{i:03d}.tif", image, compression="lzw")
    return fx.open(tmp_path, geometry=SCAN)


def arrays(_: Path, darks: list[Any], flats: list[Any]) -> Any:
    dark = np.stack(darks) if darks else None
    return fx.DataSet.from_arrays(np.stack(FRAMES), SCAN, dark=dark, flat=np.stack(flats))


def stack(tmp_path: Path, darks: list[Any], flats: list[Any]) -> Any:
    parts = {"p": FRAMES, "d": darks, "f": flats}
    for name, images in parts.items():
        if images:
            tifffile.imwrite(
                tmp_path / f"{name}.tif", np.stack(images), photometric="minisblack"
            )
    return fx.read_tiffs(
        tmp_path / "p.tif", SCAN, dark="d.tif" if darks else "", flat="f.tif"
    )


DOORS: dict[str, Callable[..., Any]] = {
    "folder": folder,
    "arrays": arrays,
    "stack": stack,
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("case", CASES)
def test_reference_images_are_looked_at(tmp_path: Path, door: str, case: str) -> None:
    darks, flats, told = CASES[case]
    data = DOORS[door](tmp_path, darks, flats)
    said = [w for w in data.warnings if "no dark image" not in w]
    if told is None:
        assert said == []
        assert not data[:4].references
    else:
        assert len(said) == 1
        assert told in said[0]
        assert data[:4].warnings == data.warnings  # a part of the data set


def test_what_opening_told_is_told_once_more_with_a_volume() -> None:
    data = arrays(Path(), DARKS, [FLATS[0], exposed(0.0)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data.reconstruct("fdk", voxel=1.0)
    assert sum("flat images differ by 200 %" in str(w.message) for w in caught) == 1


def test_rows_that_stand_for_views_are_told() -> None:
    """[row, view, column] of as many rows as views fits every shape."""
    height = np.linspace(0.1, 0.9, 24)[None, :, None]  # a cone, seen from the side
    turned = np.broadcast_to(1.0 - height * np.where(np.abs(COLUMNS - 31) < 12, 1, 0),
                             (24, 24, 64))  # fmt: skip
    counts = (50_000 * turned).astype("u2")
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=24, pixel=0.2)
    right = fx.DataSet.from_arrays(counts, scan, dark=0, flat=50_000)
    wrong = fx.DataSet.from_arrays(counts.transpose(1, 0, 2), scan, dark=0, flat=50_000)
    assert not any("[row, view, column]" in w for w in right.warnings)
    assert any("images.transpose(1, 0, 2)" in w for w in wrong.warnings)
    even = fx.DataSet.from_arrays(np.full_like(counts, 40_000), scan, dark=0, flat=50_000)
    assert not any("[row, view, column]" in w for w in even.warnings)


@pytest.mark.parametrize("seed", range(4))
def test_a_log_taken_twice_is_told_as_that(seed: int) -> None:
    """Noise leaves air of small integrals, whose log is large; thick parts become negative."""
    rng = np.random.default_rng(seed)
    thick = 3.0 * np.sqrt(np.clip(1 - ((COLUMNS - 31) / 20.0) ** 2, 0, None))
    once = np.broadcast_to(thick, (VIEWS, *SHAPE)) + rng.normal(0, 0.005, (VIEWS, *SHAPE))
    told = fx.DataSet.from_arrays(-np.log(np.maximum(np.abs(once), 1e-6)), SCAN).warnings
    assert any("was the log taken twice?" in one for one in told)
    assert not any("log" in one for one in fx.DataSet.from_arrays(once, SCAN).warnings)
