"""Drawn files of seven makers: read right, refused for the true cause, or every figure named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drawn_scans import FORMATS, UNKNOWN, drawn
from turned_balls import along

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

EACH = 44
FITS = 4e-3
"""Of counts in whole numbers, relative to the largest line integral."""


@pytest.mark.parametrize("seed", range(EACH))
@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.daily(12)
@pytest.mark.campaign(48)
def test_no_figure_of_a_drawn_file_is_dropped_in_silence(
    form: str, seed: int, tmp_path: Path
) -> None:
    if "N" in form or "Exchange" in form:
        pytest.importorskip("h5py")
    path, draw = drawn(form, seed, tmp_path)
    if draw.refused:
        with pytest.raises(DatasetError) as refused:
            fx.open(path, **draw.open)
        said = str(refused.value).lower()
        assert any(word.lower() in said for word in draw.refused), refused.value
        return
    data = fx.open(path, **draw.open)
    told = "\n".join(data.warnings)
    assert UNKNOWN in told
    assert any(UNKNOWN in one.field for one in data.provenance.unknown)
    for words in draw.named:
        assert any(word in told for word in words), (words, told)
    fields = " ".join(one.field for one in data.provenance)
    assert [name for name, _ in draw.said if name not in fields] == []
    if draw.fits:
        expected = along(data.geometry.rows, data.shape)
        off = np.abs(data.line_integrals() - expected).max() / expected.max()
        assert off < FITS, (draw, told)
