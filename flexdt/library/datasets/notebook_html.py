"""Show values in a notebook: tables of facts and small pictures, as HTML."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any, Final

import numpy as np
import numpy.typing as npt

THUMBNAIL_PX: Final = 240
"""Longest side of a small picture."""


def facts_table(caption: str, facts: Mapping[str, object]) -> str:
    """Write facts as an HTML table of two columns, name and value, under a caption; texts
    are escaped.

    Example:
        >>> facts_table("scan", {"frames": 3})
        '<table><caption>scan</caption><tr><th>frames</th><td>3</td></tr></table>'"""
    rows = "".join(
        f"<tr><th>{escape(str(name))}</th><td>{escape(str(value))}</td></tr>"
        for name, value in facts.items()
    )
    return f"<table><caption>{escape(caption)}</caption>{rows}</table>"


def emphasised(text: str) -> str:
    """Write a bold paragraph, escaped."""
    return f"<p><b>{escape(text)}</b></p>"


def values_table(heads: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Write an HTML table with a row of heads; texts are escaped."""
    head = "".join(f"<th>{escape(one)}</th>" for one in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def thumbnail(image: npt.NDArray[Any], alt: str) -> str:
    """Draw an image (rows, cols) small, as an `img` element that holds its PNG, with what
    it is below.

    Args:
        image: every so many pixels of it are drawn, so that no side exceeds THUMBNAIL_PX.
        alt: description of the image.
    """
    from flexdt.library.datasets.pictures import png

    step = -(-max(image.shape) // THUMBNAIL_PX)
    small = np.ascontiguousarray(image[::step, ::step])
    data = base64.b64encode(png(small)).decode("ascii")
    rows, cols = image.shape
    said = f"{alt}: {rows} x {cols} pixels"
    if step > 1:
        said += f", every {step}. one is shown"
    return (
        f'<img alt="{escape(alt)}" width="{THUMBNAIL_PX}" style="image-rendering:pixelated" '
        f'src="data:image/png;base64,{data}"><div>{escape(said)}</div>'
    )
