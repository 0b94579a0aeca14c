"""Grey pictures with a title and a scale bar in mm, for people."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.pictures import round_length

HEAD_ROWS: Final = 26
"""Height of the strip above a picture, which has its title [pixels]."""
FOOT_ROWS: Final = 30
"""Height of the strip below a picture, which has its scale bar [pixels]."""
EDGE_PX: Final = 8
"""Distance of title and scale bar from the left edge [pixels]."""
BAR_ROWS: Final = 3
"""Thickness of the scale bar [pixels]."""
MAX_BAR_SHARE: Final = 0.4
"""Largest length of the scale bar, as a share of the picture's width."""
FONT_SCALE: Final = 0.42
"""Size of the letters, in units of OpenCV's font."""
PAPER_GREY: Final = 255
INK_GREY: Final = 0
"""Grey of text and scale bar on the strips."""


def labelled(
    grey: npt.NDArray[np.uint8], title: str, mm_per_pixel: float
) -> npt.NDArray[np.uint8]:
    """Add a title above a picture and a scale bar with its length below it; the bar is a
    round length of at most `MAX_BAR_SHARE` of the width.

    Args:
        grey: (rows, cols).
        title: of letters of ASCII; is cut off at the right edge.
        mm_per_pixel: length that a pixel of the picture stands for.

    Returns:
        uint8 (HEAD_ROWS + rows + FOOT_ROWS, cols).
    """
    import cv2

    cols = grey.shape[1]
    head = np.full((HEAD_ROWS, cols), PAPER_GREY, np.uint8)
    foot = np.full((FOOT_ROWS, cols), PAPER_GREY, np.uint8)
    length_mm = round_length(MAX_BAR_SHARE * cols * mm_per_pixel)
    length_px = round(length_mm / mm_per_pixel)
    top = (FOOT_ROWS - BAR_ROWS) // 2
    foot[top : top + BAR_ROWS, EDGE_PX : EDGE_PX + length_px] = INK_GREY
    for strip, text, left in (
        (head, title, EDGE_PX),
        (foot, f"{length_mm:g} mm", 2 * EDGE_PX + length_px),
    ):
        base = strip.shape[0] // 2 + 5
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(strip, text, (left, base), font, FONT_SCALE, INK_GREY, 1, cv2.LINE_AA)
    return np.vstack([head, grey, foot])
