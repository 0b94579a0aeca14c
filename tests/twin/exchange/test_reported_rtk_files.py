"""RTK's XML as public reports have it: matrices alone, changed alone, foreign and shared elements.

The matrices are computed here from a cone_vec row and its pixel, by homogeneous coordinates.
"""

import re

import numpy as np
import pytest
from random_scans import SHAPE, some_parameters, some_poses

from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.rtk_xml import NAMES, read_rtk, rtk_text

PITCH = 0.3
ANGLES = NAMES[:3]


def scan(seed):
    rng = np.random.default_rng([651, seed])
    cone = some_poses(rng, 4, even=False, still=False).cone_vec(some_parameters(rng))
    geometry = ScanGeometry(cone, SHAPE)
    return geometry.rows_up() if seed % 2 else geometry


def pitch(geometry):
    return [float(np.linalg.norm(geometry.cone_vec.rows[0, i : i + 3])) for i in (6, 9)]


def matrices(geometry):
    """Where a view's panel shows a point of RTK's frame (x, -z, y of ours) [mm]."""
    turned = np.zeros((4, 4))
    turned[0, 0] = turned[2, 1] = turned[3, 3] = 1.0
    turned[1, 2] = -1.0
    for row in geometry.cone_vec.rows:
        source, centre, u, v = row.reshape(4, 3)
        plane = np.stack(
            [u / np.linalg.norm(u), v / np.linalg.norm(v), centre - source], axis=1
        )
        beam = np.linalg.inv(plane)
        yield np.hstack([beam, -(beam @ source)[:, None]]) @ turned


def alone(text, replaced=None, factor=1.0):
    """RTK's text without its numbers, with its own matrices or with those given."""
    text = re.sub(rf"\s*<({'|'.join(NAMES)})>[^<]*</\1>", "", text)
    if replaced is None:
        return text
    words = (" ".join(map(repr, (factor * one).ravel().tolist())) for one in replaced)
    return re.sub(r"<Matrix>[^<]*", lambda _: f"<Matrix>{next(words)}", text)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("factor", [None, 1.0, -3.7, 1e-4])
def test_matrices_alone_are_read(seed, factor):
    """RTK#651: whatever homogeneous factor they have, and for rows of either sense."""
    geometry = scan(seed)
    text = rtk_text(geometry)
    if factor is None:
        text = alone(text)
    else:
        text = alone(text, matrices(geometry), factor)
    found = read_rtk(text, pitch(geometry), SHAPE)
    np.testing.assert_allclose(found.cone_vec.rows, geometry.cone_vec.rows, atol=1e-7)


@pytest.mark.parametrize(
    "name", [*ANGLES, "SourceToIsocenterDistance", "ProjectionOffsetX"]
)
@pytest.mark.parametrize("view", [0, 3])
def test_a_matrix_that_contradicts_the_numbers_is_refused(name, view):
    """RTK#651: one number of a view changed by a thousandth and by some pixels."""
    geometry = scan(2)
    parts = rtk_text(geometry).split(f"<{name}>")
    value, rest = parts[view + 1].split("<", 1)
    parts[view + 1] = f"{1.02 * float(value) + 1.0}<{rest}"
    with pytest.raises(ExchangeError, match=rf"mine\.xml: view {view}: its Matrix puts"):
        read_rtk(f"<{name}>".join(parts), pitch(geometry), SHAPE, "mine.xml")


@pytest.mark.parametrize("value", [0.0, -300.0, 1e-10])
def test_impossible_distances_are_named_before_the_matrix(value):  # RTK#482
    text = re.sub(
        r"<SourceToIsocenterDistance>[^<]*",
        f"<SourceToIsocenterDistance>{value}", rtk_text(scan(1)),
    )  # fmt: skip
    if value > 0.0:
        text = re.sub(r"(<SourceToDetectorDistance>)[^<]*", r"\g<1>1e-12", text)
    with pytest.raises(ExchangeError, match="allowed: 0 < SourceToIsocenterDistance <="):
        read_rtk(text, pitch(scan(1)), SHAPE)


@pytest.mark.parametrize(
    "change", ["rounded", "no matrix", "numbers of all views first", "foreign of 0"]
)
def test_right_files_of_others_are_read(change):
    """LEAP#161: shared numbers and foreign elements; digits that other programs write."""
    geometry = scan(0)
    text = rtk_text(geometry)
    if change == "rounded":
        text = re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.9g}", text)
    if change == "no matrix":
        text = re.sub(r"\s*<Matrix>[^<]*</Matrix>", "", text)
    if change == "foreign of 0":
        text = text.replace("<Projection>", "<Projection><Tube>0</Tube>", 1)
    if change == "numbers of all views first":
        one = geometry.cone_vec[:1]
        geometry = ScanGeometry(one, SHAPE)
        text = rtk_text(geometry)
        line = re.search(r"<SourceToDetectorDistance>[^/]*/\w+>", text)[0]
        text = text.replace(line, "").replace(
            "  <Projection>", f"  {line}<Projection>", 1
        )
    found = read_rtk(text, pitch(geometry), SHAPE)
    np.testing.assert_allclose(found.cone_vec.rows, geometry.cone_vec.rows, atol=1e-3)


@pytest.mark.parametrize(
    ("matrix", "says"),
    [("1 2 3", "12 finite numbers"), (" ".join(["nan"] * 12), "12 finite numbers"),
     ("1 0 0 0 0 1 0 0 0 0 0 1", "no cone beam"), ("0 " * 12, "no cone beam"),
     ("9 3 0 0 0 9 0 0 0 0 1 -5", "right angle"), ("9 0 0 0 0 4 0 0 0 0 1 -5", "one scale"),
     ("a b", "12 finite")],
)  # fmt: skip
def test_matrices_of_no_cone_beam_are_refused(matrix, says):
    text = alone(rtk_text(scan(0)))
    text = re.sub(r"<Matrix>[^<]*", f"<Matrix>{matrix}", text)
    with pytest.raises(ExchangeError, match=says):
        read_rtk(text, (PITCH, PITCH), SHAPE, "mine.xml")


def test_a_foreign_element_is_named():  # LEAP#161
    text = rtk_text(scan(0)).replace("<Projection>", "<Projection><Tube>3</Tube>", 1)
    found = read_rtk(text, (PITCH, PITCH), SHAPE, "mine.xml")
    assert found.notes == ("mine.xml: 1 field not known to flexdt, ignored: Tube = 3",)


def test_a_number_twice_and_trees_of_others_are_no_contradiction():
    """One number in two spellings agrees; members of an unknown element are all told."""
    text = rtk_text(scan(1))
    name = NAMES[3]
    found = re.search(rf"<{name}>([^<]*)</{name}>", text)
    again = f"{found[0]}<{name}> {float(found[1])!r}e0 </{name}>"
    note = "<Note><p>a</p><p at='x'>b<q>deep</q></p></Note>"
    read = read_rtk(text.replace(found[0], again + note, 1), pitch(scan(1)))
    plain = read_rtk(text, pitch(scan(1)))
    np.testing.assert_array_equal(read.cone_vec.rows, plain.cone_vec.rows)
    told = " ".join(read.notes) + repr(read.provenance)
    for word in ("Note/p", "Note/p[2]@at", "Note/p[2]/q", "deep"):
        assert word in told
    other = f"{found[0]}<{name}>{float(found[1]) + 1.0!r}</{name}>"
    with pytest.raises(ExchangeError, match=name):
        read_rtk(text.replace(found[0], other, 1), pitch(scan(1)))
