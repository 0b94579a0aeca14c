"""Names of images come back in their true order, however they are listed and written
(TeraStitcher#30, Suite2P#116)."""

import random

import pytest

from flexdt.twin.findings import Severity
from flexdt.twin.plausibility.image_order import ordered

TRUE = {
    "decimals": [f"p_{x}.tif" for x in (0, 0.25, 0.5, 0.75, 1, 1.25)],
    "even decimals": [f"p_{x:.2f}.tif" for x in (0, 0.25, 0.5, 9.75, 10)],
    "negative": [f"p_{x}.tif" for x in (-20, -10, -9.5, 0, 9, 10)],
    "negative without a separator": [f"angle{x}.tif" for x in (-20, -10, 0, 10, 100)],
    "hyphens": [f"proj-{x}.tif" for x in (1, 2, 9, 10, 11)],
    "bare": [f"{x}.tif" for x in (-20, -10, 0, 10)],
    "degrees": [f"s_{x}deg.tif" for x in (0, 9, 10, 100)],
    "fields": [f"v1.{x}.tif" for x in (1, 2, 9, 10, 11)],
    "two numbers": [f"f_{x}_{y}.tif" for x in (1, 2) for y in (1, 2, 10)],
    "dates": [f"img_2024-05-01_{i}.tif" for i in (1, 2, 10)],
    "signs": [f"a_{x:+06.1f}.tif" for x in (-10.5, -1, 0, 1, 10.5)],
    "hexadecimal": [f"p_{x:02x}.tif" for x in range(0, 40)],
    "hexadecimal by threes": [f"frame{x:04X}_a.tif" for x in range(5, 90, 3)],
    "powers of ten": [f"p_{x:.3e}.tif" for x in (0.25, 0.5, 1, 9.5, 10, 100, 359)],
    "negative powers": [f"a_{x:+.1e}.tif" for x in (-200, -10, -0.5, 0.5, 20)],
    "texts": ["1b.tif", "2a.tif", "10c.tif"],
    "whole": [f"scan_{i:06d}.tif" for i in range(12)],
}


@pytest.mark.parametrize("kind", TRUE)
def test_order(kind):
    rng = random.Random(kind)
    for _ in range(20):
        listed = rng.sample(TRUE[kind], len(TRUE[kind]))
        found = ordered(listed)
        assert list(found.names) == TRUE[kind]
        assert not found.findings
        assert not found.others


@pytest.mark.parametrize(
    "names",
    [["scan_1.tif", "scan_2.tif", "scan_02.tif"], ["a_0.5.tif", "a_0.50.tif", "a_1.tif"],
     [f"scan_{i:03d}.tif" for i in range(9)] + ["scan_004.tiff"]],
)  # fmt: skip
def test_two_files_of_one_number_are_named(names):
    found = ordered(names).findings
    assert [(one.code, one.severity) for one in found] == [("duplicate", Severity.ERROR)]
    assert sum(name in found[0].message for name in names) == 2


@pytest.mark.parametrize("lost", [1, 4, 7])
@pytest.mark.parametrize("step", [1, 3])
def test_gaps_are_said(lost, step):
    names = [f"scan_{step * i:03d}.tif" for i in range(12) if i != lost]
    assert [one.code for one in ordered(names).findings] == ["gap"]


def test_one_that_is_named_otherwise():
    names = [f"X_{x:03d}.tif" for x in range(0, 181, 10)]
    assert ordered([*names, "X_180deg.tif"]).others == ("X_180deg.tif",)
    assert ordered([*names, "preview.tif"]).others == ("preview.tif",)
