"""HTTP requests drawn by RFC 9112's grammar: none of the lines in their bodies is a message."""

from __future__ import annotations

import json
import string

from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.protocol import Connection, Malformed, Request

BODY = (
    b'{"jsonrpc":"2.0","id":1,"method":"axes.move","params":{"targets":{"rot_obj":90}}}\n'
)
TCHAR = "!#$%&'*+-.^_`|~" + string.digits + string.ascii_letters
tokens = st.one_of(
    st.sampled_from(["GET", "PATCH", "patch", "XYZ", "QUERY"]), st.text(TCHAR, min_size=1)
)
targets = st.one_of(
    st.just("*"),
    st.text(string.ascii_letters + string.digits + "%?&=/.:@{}[]\"'", max_size=40).map(
        "/".__add__
    ),
    st.integers(0, 20_000).map(lambda n: "/" + "a" * n),
)
values = st.text(string.ascii_letters + string.digits + ' "{}[]:,/', max_size=60)
fields = st.lists(st.tuples(st.text(TCHAR, min_size=1), values), max_size=6)
hosts = st.tuples(
    st.sampled_from(["Host", "host", "HOST", "hOsT"]),
    st.sampled_from(["evil.example:55000", "x"]),
)
chunks = st.lists(st.integers(1, 30_000), max_size=5)


def pieces(data: bytes, sizes: list[int]) -> list[bytes]:
    out = []
    for size in sizes:
        out.append(data[:size])
        data = data[size:]
    return [*out, data]


@given(
    tokens,
    targets,
    fields,
    hosts,
    st.integers(0, 6),
    chunks,
    st.sampled_from([64, 2**20]),
)
@settings(deadline=None)
def test_no_line_of_an_http_requests_body_is_a_message(
    method: str,
    target: str,
    others: list[tuple[str, str]],
    host: tuple[str, str],
    place: int,
    sizes: list[int],
    most: int,
) -> None:
    """Whatever the method, wherever Host stands, and where the request line is too long to
    keep."""
    head = [*others[:place], host, *others[place:]]
    lines = [
        f"{method} {target} HTTP/1.1",
        *(f"{name}: {value}" for name, value in head),
        "",
    ]
    wire = Connection(max_message=max(most, len(BODY)))
    data = "".join(line + "\r\n" for line in lines).encode() + BODY * 3
    came = [
        message for piece in pieces(data, sizes) for message in wire.receive_data(piece)
    ]
    assert all(isinstance(message, Malformed) for message in came)
    assert came[-1].fatal  # type: ignore[union-attr]
    assert wire.receive_data(BODY) == []


texts = st.one_of(
    st.text(),
    st.sampled_from(["GET / HTTP/1.1", "Host: x", "\r\nHost: x", "X * HTTP/1.1\r\n"]),
)


@given(
    st.lists(st.dictionaries(texts, texts, max_size=3), min_size=1, max_size=5), chunks
)
@settings(deadline=None)
def test_no_message_is_taken_for_http(
    drawn: list[dict[str, str]], sizes: list[int]
) -> None:
    """Whatever its texts hold, and where it is cut."""
    lines = [
        json.dumps({"jsonrpc": "2.0", "id": i, "method": "x", "params": params})
        for i, params in enumerate(drawn)
    ]
    data = "".join(line + "\n" for line in lines).encode()
    wire = Connection()
    came = [
        message for piece in pieces(data, sizes) for message in wire.receive_data(piece)
    ]
    assert came == [Request(i, "x", params) for i, params in enumerate(drawn)]
