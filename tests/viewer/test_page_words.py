"""No sentence of the library reaches the page: every refusal in the code, and those that servers
give to a page that asks for what cannot be."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt.clients.viewer.page_words import FALLBACK, for_reader, of_volume

ROOT = Path(__file__).parents[2]
ROOMS = (
    "twin",
    "server",
    "runtime",
    "protocol",
    "phantoms",
    "flexdt/library",
    "clients/viewer",
)
LIBRARY = (
    r"\bfx\.", r"`", r"--\w", r"\bpip\b", r"\.py\b", r"\bflexdt (open|check|align|reconstruct)\b",
    r"/(tmp|home|work|data|srv|var)/", r"Traceback", r"\bnumpy\b", r"\bdataset\.get\b",
    r"session\.control", r"job\.\w+ ",
)  # fmt: skip
"""What a reader of the page can do nothing with; written down apart from the page's rules."""
PLACES = ("gear", "/srv/lab/data/scan-3", "scan_000004.tif", "12", "'x'")
"""What stands where a message has a value."""


def texts(node: ast.AST, value: str) -> str | None:
    """A message's text with `value` for each of its values; None for another expression."""
    match node:
        case ast.Constant(value=str() as text):
            return text
        case ast.JoinedStr(values=parts):
            found = [texts(part, value) for part in parts]
            return "".join(value if part is None else part for part in found)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            both = texts(left, value), texts(right, value)
            return None if None in both else "".join(part or "" for part in both)
    return None


def refusals() -> Iterator[tuple[str, str]]:
    """Every message that some error of the code is made with, and where."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            if "__pycache__" in path.parts:
                continue
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if not isinstance(node, ast.Call):
                    continue
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if not re.search(r"Error$|^busy$|^link_down$|^too_large$", name):
                    continue
                for argument in node.args:
                    for value in PLACES:
                        if text := texts(argument, value):
                            yield f"{path.relative_to(ROOT)}:{node.lineno}", text


def test_every_refusal_of_the_code_is_said_in_words_of_the_page() -> None:
    said: dict[str, str] = {}
    count = 0
    empty = 0
    for where, text in refusals():
        count += 1
        told = for_reader(text)
        empty += told == FALLBACK
        if not told.strip() or any(re.search(word, told) for word in LIBRARY):
            said[where] = told
    assert count > 1000
    assert said == {}
    assert empty < count / 20  # a cause is left nearly always


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("/srv/lab/data/scan-3: what the sample 'my part' is made of is not known here; known: "
         "the phantoms of flexdt, in scans of the twin", "What my part is made of is not known"),
        ("scan-3 has no flat images: give `flat` of fx.read_tiffs", "This scan has no flat images"),
        ("this viewer was started without --data", "its viewer cannot read the scans"),
        ("rot_obj target 10000 deg is outside [-7200, 7200] deg",
         "rot_obj target 10000 deg is outside [-7200, 7200] deg"),
        ("camera exposure_ms -3 is outside [1, 60000] ms",
         "exposure -3 ms is outside 1 to 60000 ms"),
        ("/srv/lab/data/scan-3 cannot be read", "scan-3 cannot be read."),
        ("use fx.open(FOLDER)", FALLBACK),
    ],
)  # fmt: skip
def test_known_refusals(text: str, wanted: str) -> None:
    assert wanted in for_reader(text)


def test_a_volume_says_its_doubts_in_words_of_the_page() -> None:
    facts = {
        "name": "a",
        "doubts": ["use fx.open(FILE)", "few views"],
        "problem": "/srv/a/b is gone",
    }
    told = of_volume(facts)
    assert told == {
        "name": "a",
        "doubts": [FALLBACK, "few views"],
        "problem": "b is gone.",
    }
