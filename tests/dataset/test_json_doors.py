"""JSON that other programs write: a byte order mark, numbers of thousands of digits, deep nests."""

import json

import pytest

from flexdt.phantoms.files.phantom_files import load_phantom_file
from flexdt.protocol.codec import read_json as read_wire
from flexdt.twin.dataset.flexdt_json import parse_document
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.exchange.number_tables import geometry_text, read_geometry_text
from flexdt.twin.geometry.cone_vec import ConeVec

MARK = "\ufeff"
DOORS = {
    "document": parse_document,
    "geometry": read_geometry_text,
    "phantom": load_phantom_file,
}
SCAN = ScanGeometry(
    ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1), (4, 5)
)


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("digits", [4301, 5000, 100_000])
def test_numbers_of_thousands_of_digits_are_the_files_error(door, digits):
    text = json.dumps({"kind": "x", "schema": 0})[:-1] + f', "n": {"9" * digits}}}'
    with pytest.raises(TwinError, match="thousands of digits"):
        DOORS[door](text, "mine.json")


@pytest.mark.parametrize("door", DOORS)
def test_deep_nests_are_the_files_error(door):
    with pytest.raises(TwinError, match=r"mine\.json"):
        DOORS[door]('{"a":' + "[" * 200_000 + "]" * 200_000 + "}", "mine.json")


@pytest.mark.parametrize("digits", [5, 400, 4000])
@pytest.mark.parametrize("key", ["rows", "columns", "full_scale"])
def test_whole_numbers_that_no_panel_has(digits, key):
    document = json.loads(geometry_text(SCAN))
    document["detector"]["rows"] = document["detector"]["columns"] = 7
    target = document if key == "full_scale" else document["detector"]
    target[key] = int("9" * digits)
    try:
        read_geometry_text(json.dumps(document), "mine.json")
    except TwinError as error:
        assert "mine.json" in error.message  # noqa: PT017


@pytest.mark.parametrize("key", ["rows", "columns"])
def test_a_panel_with_one_side_misses_the_other(key):
    document = json.loads(geometry_text(SCAN))
    document["detector"] = {"rows": 7, "columns": 9}
    del document["detector"][key]
    with pytest.raises(TwinError, match=f"{key} is missing"):
        read_geometry_text(json.dumps(document), "mine.json")


def test_a_byte_order_mark_says_nothing():
    again = read_geometry_text(MARK + geometry_text(SCAN))
    assert (again.cone_vec.rows == SCAN.cone_vec.rows).all()
    assert read_wire((MARK + '{"id": 1}').encode()) == {"id": 1}
    with pytest.raises(TwinError, match="schema"):
        parse_document(MARK + '{"schema": 0}')
    ball = '{"scene": {"name": "b", "solids": []}}'
    told = [_said(load_phantom_file, before + ball) for before in ("", MARK)]
    assert told[0] == told[1]


def _said(door, text):
    try:
        return repr(door(text))
    except TwinError as error:
        return error.message
