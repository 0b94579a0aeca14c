"""What an input may cost is decided before a parser sees it."""

from __future__ import annotations

import io
import json
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.twin.input_limits import (
    LIMITS,
    InputLimitError,
    parse_toml,
    read_limited,
    require_json,
    require_strips,
)
from flexdt.twin.json_text import parse_json

TREES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=4), inner, max_size=4)
    ),
    max_leaves=20,
)


def values_of(tree: object) -> int:
    """The values of a document, counted by walking it."""
    if isinstance(tree, dict):
        return 1 + sum(map(values_of, tree.values()))
    if isinstance(tree, list):
        return 1 + sum(map(values_of, tree))
    return 1


@given(TREES)
def test_no_document_has_more_values_than_are_counted(tree):
    text = json.dumps(tree)
    counted = 1 + text.count(",") + text.count("[") + text.count("{")
    assert values_of(tree) <= counted
    assert parse_json(text) == tree


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" + "0," * 2_000_001 + "0]", "values"),
        ("[" + "{}," * 1_000_000 + "0]", "values"),
        ('"' + "a" * (64 << 20) + '"', "bytes"),
    ],
    ids=["numbers", "objects", "length"],
)
def test_a_json_text_beyond_its_row_is_refused_unparsed(text, words):
    with pytest.raises(InputLimitError, match=f"{words}; allowed: at most"):
        require_json(text, "f.json")


@pytest.mark.parametrize("form", ["{} = 1", "[{}]", "[[{}]]", "a = {{ {} = 1 }}"])
def test_a_toml_key_has_a_bounded_number_of_parts(form):
    most = LIMITS["toml"].depth
    assert parse_toml(form.format(".".join("k" * most)), "f") is not None
    for part in ("k", '"k"', "'k'", '"a.b"'):
        key = " . ".join([part] * (most + 1))
        with pytest.raises(InputLimitError, match=f"a key of {most + 1} parts"):
            parse_toml(form.format(key), "f")


@pytest.mark.parametrize(
    "text",
    [
        'a = "' + "." * 500 + '"',
        'a = """\n' + "x.y " * 500 + '\n"""',
        "a = '" + "\\." * 500 + "'",
        "# " + "." * 500 + "\na = 1",
        "a = [" + "1.5, " * 500 + "]",
        'a = "\\"' + "." * 100 + '"',
    ],
)
def test_points_in_texts_comments_and_numbers_are_no_parts_of_keys(text):
    assert parse_toml(text, "f") == tomllib.loads(text)


def test_a_toml_text_that_nests_too_deep_is_no_toml():
    with pytest.raises(ValueError, match="nests too deep"):
        parse_toml("a = " + "[" * 100_000, "f")


def test_a_stream_without_an_end_is_read_to_its_limit():
    class Endless(io.RawIOBase):
        asked = 0

        def read(self, size=-1):
            assert size >= 0
            self.asked += size
            return bytes(size)

    endless = Endless()
    with pytest.raises(InputLimitError, match="too long; allowed: at most 4194304 bytes"):
        read_limited(endless, "toml", "/dev/zero")
    assert endless.asked == LIMITS["toml"].file_bytes + 1


def test_strips_of_a_tiff_share_no_bytes():
    require_strips([100, 100], 300, "f.tif")
    with pytest.raises(InputLimitError, match="the 300 bytes it has"):
        require_strips([100] * 16_000, 300, "f.tif")
    with pytest.raises(InputLimitError, match="strips; allowed"):
        require_strips([0] * 1_000_001, 300, "f.tif")
