"""Images of several exposures and currents, put on one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.nxtomo_writing import DARK, FLAT, PROJECTION


@dataclass(frozen=True, eq=False)
class Scaled:
    """Projections and flat images on one scale, and what was done, in sentences."""

    views: npt.NDArray[Any]
    flats: npt.NDArray[Any]
    told: tuple[str, ...]


def on_one_exposure(
    kinds: Mapping[int, npt.NDArray[Any]],
    keys: npt.NDArray[Any],
    factors: Mapping[str, npt.NDArray[np.float64]],
    name: str,
) -> Scaled:
    """Divide counts above the mean dark image by what they are proportional to.

    Images keep their type where the factors do not differ. Line integrals (projections of
    floats without flat images) are left as they are.

    Args:
        kinds: image key -> images (k, rows, cols).
        keys: image key of each image of the scan, (n,).
        factors: what counts are proportional to -> its value for each image, (n,), above 0
            for projections and flat images.
        name: of the file, for sentences.
    """
    views, flats = kinds[PROJECTION], kinds[FLAT]
    as_they_are = Scaled(views, flats, ())
    if not factors or (not len(flats) and views.dtype.kind == "f"):
        return as_they_are
    product = np.prod(list(factors.values()), axis=0)
    usual = float(np.median(product[keys == PROJECTION]))
    scale = {key: usual / product[keys == key] for key in (PROJECTION, FLAT)}
    dark = kinds[DARK].mean(axis=0) if len(kinds[DARK]) else np.float64(0.0)
    words = " and ".join(factors)
    told = []
    if not np.allclose(scale[FLAT], 1.0, rtol=1e-9):
        flats = dark + (flats - dark) * scale[FLAT][:, None, None]
        least, most = scale[FLAT].min(), scale[FLAT].max()
        figures = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
        told.append(
            f"{name}: flat images differ from the projections in {words}: they are "
            f"multiplied by {figures}"
        )
    if not np.allclose(scale[PROJECTION], 1.0, rtol=1e-9):
        views = _scaled(views, dark, scale[PROJECTION])
        least, most = scale[PROJECTION].min(), scale[PROJECTION].max()
        told.append(
            f"{name}: projections differ in {words}: they are multiplied by {least:.4g} to "
            f"{most:.4g}"
        )
    return Scaled(views, flats, tuple(told))


def _scaled(
    images: npt.NDArray[Any], dark: Any, scale: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    """Multiply what each image (n, rows, cols) has above the dark one, as float32."""
    out = np.empty(images.shape, np.float32)
    for place, image, factor in zip(out, images, scale, strict=True):
        place[:] = dark + (image - dark) * factor
    return out
