"""The page's HTML: `data/index.html`, and in it a box for each layer of the scenes."""

from __future__ import annotations

import html
from importlib import resources
from typing import Final

from flexdt.clients.viewer.scenes.layers import LAYERS, Layer

PAGE: Final = "index.html"
TRANSLUCENT: Final = "translucent.js"
"""First script of every scene of viser, on the page and exported."""
TOKEN_FORM: Final = "token.html"
WRONG_MARK: Final = "<!-- wrong -->"
"""Place of the form's message about a wrong token."""
BOXES: Final = "<!-- a box for each layer -->"
"""Place of the boxes."""


def page_file(name: str) -> bytes:
    """Read a file of the page as browsers get it, boxes of layers filled in.

    Raises FileNotFoundError: none of this name.
    """
    content = (resources.files("flexdt.clients.viewer") / "data" / name).read_bytes()
    if name == PAGE:
        return content.replace(BOXES.encode(), boxes(LAYERS).encode(), 1)
    return content


def token_form(wrong: bool) -> bytes:
    """Make the page (HTML) with the form for the viewer's token.

    Args:
        wrong: whether a wrong one was given; the page then has a message.
    """
    if wrong:
        said = b'<p id="wrong" role="alert">This is not it.</p>'
    else:
        said = b""
    return page_file(TOKEN_FORM).replace(WRONG_MARK.encode(), said, 1)


def boxes(layers: tuple[Layer, ...]) -> str:
    """Make (HTML) a labeled checkbox for each layer, a line each, named "layer-NAME".

    Titles are escaped.
    """
    return "\n        ".join(
        f'<div><label><input type="checkbox" id="layer-{layer.name}" data-layer="{layer.name}">'
        f"{html.escape(layer.title)}</label></div>"
        for layer in layers
    )
