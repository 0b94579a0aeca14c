"""What a notebook shows of data sets and calibrations, read back by parsers."""

from __future__ import annotations

import base64
import io
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import flexdt as fx


class Page(HTMLParser):
    """Collects cells and images."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.images: list[str] = []
        self.text = ""
        self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("td", "th"):
            self.cells.append("")
            self._in_cell = True
        if tag == "img":
            self.images.append(str(dict(attrs)["src"]))

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th"):
            self._in_cell = False

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._in_cell:
            self.cells[-1] += data


def test_a_data_set_shows_its_facts_its_warnings_and_its_first_image() -> None:
    geometry = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=3, shape=(300, 500), pixel=0.3
    )
    images = np.full((3, 300, 500), 9000, np.uint16)
    images[0, :, 250:] = 3000
    data = fx.DataSet.from_arrays(
        images, geometry, flat=np.full((300, 500), 9500), name="<b>one"
    )
    page = Page(data._repr_html_())
    assert "DataSet <b>one" in page.text, "names are escaped"
    assert "3 of 300 x 500 pixels" in page.cells
    for text in data.warnings:
        assert text in page.cells
    kind, _, encoded = page.images[0].partition(",")
    assert kind == "data:image/png;base64"
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))))
    assert max(picture.shape) <= 240
    assert picture[:, 5].min() > picture[:, -5].max(), "dark is where counts are few"


@pytest.mark.slow
def test_a_calibration_shows_its_verdict_and_what_was_asked() -> None:
    geometry = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=12, shape=(380, 478), pixel=0.2992
    )
    scan = fx.simulate("lego", geometry, noise=1)
    found = fx.calibrate(scan, "lego")
    assert found.verdict == found.document["verdict"]
    assert found.verdict in repr(found) or not found.calibration.identifiable
    page = Page(found._repr_html_())
    assert found.verdict in page.text
    asked = [name for name, one in found.parameters.items() if one["asked"]]
    assert [cell for cell in page.cells if cell in found.parameters] == asked
