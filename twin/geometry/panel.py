"""Distortion of the panel's picture: a low polynomial in the plane of the panel, and gaps
between its tiles. And its lag: part of the light of the frame before.

A place measured at m [px] belongs to the undistorted place m - d(m), d(m) = sum of
coefficient times term. The terms are the polynomials of degree two and three in both
directions, unequal pixel pitches and a skew; with a gap, everything beyond the border is
shifted. Shifts, a scale and a rotation of the image are not among them: those are offsets
of the scanner.

Terms of degree two look much like a tilted panel. Their prior distinguishes them: each
coefficient is about as large as the data show the others to be. It enters every sigma.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

TERM_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of column and row in the terms of each direction."""
AFFINE_TERMS = ("aspect", "skew")
"""Names of the terms of unequal pitches and skew."""
GAP_SIGMA_PX = 5.0
"""Standard deviation of a tile's shift [px], so wide that the data determine it."""

MAX_LAG = 0.3
"""Largest part of a frame that the next one shows; more is another fault than lag."""
MIN_LIGHT_SHARE = 0.05
"""Least part of a pixel's light that remains after a lag is subtracted from noise."""


@dataclass(frozen=True)
class Border:
    """Where a tile begins: from this column (axis 0) or row (axis 1) on [px]."""

    axis: int
    at: float


@dataclass(frozen=True)
class PanelModel:
    """Terms of a distortion.

    Attributes:
        width_px: standard deviation of every coefficient, the shift [px] at half the
            longer side.
        shape: (rows, cols) of the image.
        borders: of tiles.
    """

    width_px: float
    shape: tuple[int, int]
    borders: tuple[Border, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the m coefficients, in order: affine terms, the column's terms of
        bending, the row's, then two for each tile border.

        For instance column_x2y0, row_from_column_768.
        """
        bent = [f"{way}_x{i}y{j}" for way in ("column", "row") for i, j in TERM_POWERS]
        gaps = [
            f"{way}_from_{('column', 'row')[b.axis]}_{b.at:.0f}"
            for b in self.borders
            for way in ("column", "row")
        ]
        return (*AFFINE_TERMS, *bent, *gaps)

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the coefficients' zero-mean priors, (m,) [px].

        `GAP_SIGMA_PX` for gaps.
        """
        m = len(self.names)
        out = np.full(m, self.width_px)
        out[m - 2 * len(self.borders) :] = GAP_SIGMA_PX
        return out

    def terms(self, places: FloatArray) -> FloatArray:
        """Compute the shifts [px] that each coefficient of 1 causes at places.

        Places are scaled by half the longer side about the middle; from a border on its
        gap shifts by 1.

        Args:
            places: (..., 2), column and row [px].

        Returns:
            (..., 2, m): shifts along columns and rows, for m coefficients in the order of
            `names`.
        """
        rows, cols = self.shape
        middle = np.array([cols - 1, rows - 1]) / 2
        half = max(rows, cols) / 2
        x, y = np.moveaxis((places - middle) / half, -1, 0)
        zero = np.zeros_like(x)
        bent = [x**i * y**j for i, j in TERM_POWERS]
        across = [x, y, *bent, *[zero] * len(bent)]
        down = [-y, x, *[zero] * len(bent), *bent]
        for border in self.borders:
            beyond = (places[..., border.axis] >= border.at).astype(np.float64)
            across += [beyond, zero]
            down += [zero, beyond]
        return np.stack([np.stack(across, axis=-1), np.stack(down, axis=-1)], axis=-2)


@dataclass(frozen=True)
class Panel:
    """A distortion, and the remaining light of the image before.

    Attributes:
        model: its terms.
        coefficients: of them [px].
        lag: part of the light of a frame that the next one shows; 0 where none was found.
    """

    model: PanelModel
    coefficients: tuple[float, ...]
    lag: float = 0.0

    @classmethod
    def flat(cls, shape: tuple[int, int]) -> Panel:
        """Make a panel without distortion, lag and tiles, of `shape` (rows, cols)."""
        model = PanelModel(0.0, shape)
        return cls(model, (0.0,) * len(model.names))

    def shift(self, places: FloatArray) -> FloatArray:
        """Compute measured minus undistorted places [px], at measured places (..., 2):
        column and row.
        """
        if places.ndim > 2:  # row by row: the terms of a whole image take 200 MB
            return np.stack([self.shift(row) for row in places])
        return np.asarray(self.model.terms(places) @ np.array(self.coefficients))

    @cached_property
    def _map(self) -> tuple[Float32Array, Float32Array]:
        """Columns and rows of the distorted image, float32 (rows, cols) both, at which
        the pixels of an undistorted one are measured; computed once.

        Inverted by four fixed-point steps; a pixel in a gap between tiles is interpolated
        between the lines beside it.
        """
        rows, cols = self.model.shape
        places = np.moveaxis(np.mgrid[:rows, :cols][::-1], 0, -1).astype(np.float64)
        out = places
        for _ in range(
            4
        ):  # A distortion is smooth: each time, little is left of the error.
            out = places + self.shift(out)
        for (
            border
        ) in self.model.borders:  # A pixel in a gap is between the lines beside it.
            axis = border.axis
            first = math.ceil(border.at)
            sides = np.stack([places[:, :1] if axis == 0 else places[:1]] * 2)
            sides[0, ..., axis], sides[1, ..., axis] = first - 1, first
            low, high = (sides - self.shift(sides))[..., axis]
            inside = (places[..., axis] > low) & (places[..., axis] < high)
            part = (places[..., axis] - low) / np.maximum(high - low, 1e-9)
            out[..., axis] = np.where(inside, first - 1 + part, out[..., axis])
        return out[..., 0].astype(np.float32), out[..., 1].astype(np.float32)

    def without_lag(self, image: Float32Array, before: Float32Array) -> Float32Array:
        """Subtract from line integrals (rows, cols) the light still shown of the frame
        `before`.

        That is as measured, with its own lag: of 5 % some 0.2 % remain.
        """
        share = self.lag / (1.0 - self.lag)
        shown = np.exp(-image)
        light = (shown - share * np.exp(-before)) / (1.0 - share)
        return np.asarray(
            -np.log(np.maximum(light, MIN_LIGHT_SHARE * shown)), dtype=np.float32
        )

    def undistorted(self, image: Float32Array) -> Float32Array:
        """Resample an image (rows, cols) as a panel without distortion would have taken
        it.

        By Lanczos, its edge repeated; the lag stays. Without distortion it is the image
        itself. Raises TwinError: a shape other than that of the distortion.
        """
        if not any(self.coefficients):
            return image
        if image.shape != self.model.shape:
            raise TwinError.of_shape(
                "an image",
                image.shape,
                self.model.shape,
                ": the panel's distortion is of those",
            )
        import cv2

        out = cv2.remap(
            image, *self._map, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(out, dtype=np.float32)

    def to_json(self) -> dict[str, Any]:
        """Convert to a document with the keys model, shape, borders, coefficients and, if
        any, lag; `from_json` is its inverse.

        Coefficients are by name [px]; the model is always "cubic"; a lag of 0 is left
        out.
        """
        return {
            "model": "cubic",
            "shape": list(self.model.shape),
            "borders": [
                {"axis": ("column", "row")[b.axis], "from": b.at}
                for b in self.model.borders
            ],
            "coefficients": dict(zip(self.model.names, self.coefficients, strict=True)),
            **({"lag": self.lag} if self.lag else {}),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Panel:
        """Make a panel from a document.

        Lag is 0 if absent; the width of the priors is not in the document and becomes 0.
        `model` is not read.

        Args:
            document: shape, borders, coefficients by name and perhaps lag, as `to_json`
                has them.

        Raises:
            TwinError: a key is missing or its value is not of that form; a lag outside 0
                to `MAX_LAG` (excluded).
        """
        try:
            rows, cols = (int(n) for n in document["shape"])
            borders = tuple(
                Border(("column", "row").index(b["axis"]), float(b["from"]))
                for b in document["borders"]
            )
            model = PanelModel(0.0, (rows, cols), borders)
            coefficients = document["coefficients"]
            lag = float(document.get("lag", 0.0))
            if not 0.0 <= lag < MAX_LAG:
                raise ValueError(f"lag {lag:g}; allowed: 0 to {MAX_LAG:g}")
            return cls(
                model, tuple(float(coefficients[name]) for name in model.names), lag
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise TwinError(
                f"the panel's distortion cannot be read ({error}); allowed: the panel of a "
                "calibration's report"
            ) from None
