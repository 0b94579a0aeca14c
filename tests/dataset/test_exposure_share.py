"""The part of a step that an exposure lasts is what the script's times say."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flexdt.library.calibration.exposure_share import exposure_share
from flexdt.twin.dataset.flexdt_json import DatasetDocument

from .conftest import make_record


def share_of(between_s: float, smooth: bool = True, told: bool = True) -> float | None:
    record = make_record(smooth=smooth)
    blocks = tuple(
        replace(block, times_s=np.arange(len(block)) * between_s)
        for block in record.blocks
    )
    document = DatasetDocument.of(replace(record, blocks=blocks)).model_dump(
        by_alias=True
    )
    if not told:
        del document["smooth"]
    data: Any = SimpleNamespace(document=DatasetDocument(**document), settings=None)
    return exposure_share(data)


def test_the_share_of_a_smooth_scan_is_that_of_the_time_between_frames() -> None:
    for between_s in (0.16, 0.2, 0.64):
        assert share_of(between_s) == pytest.approx(2 * 0.08 / between_s)


def test_a_stepped_scan_turns_by_nothing_and_an_old_file_says_nothing() -> None:
    assert share_of(0.2, smooth=False) == 0.0
    assert share_of(0.2, told=False) is None


@pytest.mark.parametrize(("kind", "share"), [("step scan", 0.0), ("smooth scan", None)])
def test_the_scanners_text_says_what_stands_still(kind: str, share: float | None) -> None:
    data: Any = SimpleNamespace(document=None, settings=SimpleNamespace(scan_type=kind))
    assert exposure_share(data) == share
