"""Words of the command line become values, or usage errors that say what is allowed."""

from __future__ import annotations

import json

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from flexdt.clients.cli import console, option_values, twin_connection
from flexdt.runtime import process_settings


def test_assignments_keep_order_and_signs() -> None:
    assert option_values.assignments(
        ["tra_obj=-12.5", "rot_obj=+3e1", " ver_tube = 40"]
    ) == {
        "tra_obj": -12.5,
        "rot_obj": 30.0,
        "ver_tube": 40.0,
    }


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_finite_number_survives(value: float) -> None:
    assert option_values.assignments([f"a={value!r}"]) == {"a": value}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["tra_obj"], "AXIS=VALUE"),
        (["=3"], "AXIS=VALUE"),
        (["tra_obj="], "AXIS=VALUE"),
        (["tra_obj=far"], "'far' is not a number"),
        (["tra_obj=nan"], "not finite"),
        (["tra_obj=1", "tra_obj=2"], "given twice"),
    ],
)
def test_bad_assignments(words: list[str], says: str) -> None:
    with pytest.raises(typer.BadParameter, match=says):
        option_values.assignments(words)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("127.0.0.1:55000", ("127.0.0.1", 55000)),
        ("scanner.lab", ("scanner.lab", 55000)),
        (":1234", ("127.0.0.1", 1234)),
        ("[::1]:1234", ("::1", 1234)),
        ("[::1]", ("::1", 55000)),
        ("::1", ("::1", 55000)),
    ],
)
def test_server_addresses(word: str, expected: tuple[str, int]) -> None:
    assert twin_connection.server_address(word) == expected


@pytest.mark.parametrize(
    "word", ["host:0", "host:65536", "host:abc", "[::1", "[::1]x", "host:-1"]
)
def test_bad_server_addresses(word: str) -> None:
    with pytest.raises(typer.BadParameter):
        twin_connection.server_address(word)


def test_speed_up() -> None:
    assert process_settings.speed_up("max") == "max"
    assert process_settings.speed_up("2.5") == 2.5
    for word in ("0", "-1", "inf", "fast"):
        with pytest.raises(typer.BadParameter):
            process_settings.speed_up(word)


def test_plain_json_has_no_nan_and_no_arrays() -> None:
    import numpy as np

    text = console.as_json(
        {"a": float("nan"), 1: (np.float32(2), np.arange(2)), "b": True}
    )
    assert json.loads(text) == {
        "a": None,
        "1": [2.0, [0, 1]],
        "b": True,
    }


def test_sizes_for_people() -> None:
    assert console.duration(3.21) == "3.2 s"
    assert console.duration(245) == "4 min 05 s"
    assert console.duration(7380) == "2 h 03 min"
    assert console.size(900) == "900 B"
    assert console.size(1.23e9) == "1.2 GB"
    assert console.table([["a", "1"], ["bbb", "22"]], ["name", "n"]) == (
        "name  n\na     1\nbbb   22"
    )
