"""Every wrong argument of a request is named in one answer, whatever else is wrong beside it."""

from __future__ import annotations

import random
from collections.abc import Mapping
from functools import cache
from typing import Any

import pytest
from schemas import Schemas

from flexdt.protocol import METHODS, RpcError, parse_params
from flexdt.protocol.method import AnyMethod
from flexdt.protocol.methods import openrpc_document
from flexdt.protocol.projector import PROJECTOR_METHODS

SERVERS: dict[str, Mapping[str, AnyMethod]] = {
    "twin": METHODS,
    "projector": PROJECTOR_METHODS,
}
CASES = [
    pytest.param(server, name, id=f"{server} {name}")
    for server, methods in SERVERS.items()
    for name, method in methods.items()
    if method.params.model_fields
]


@cache
def published(server: str) -> dict[str, Any]:
    """The document of a server's methods."""
    return openrpc_document(SERVERS[server])


def described(server: str, name: str) -> tuple[Schemas, dict[str, Any], set[str]]:
    """Schemas that a server publishes; those of a method's parameters; which are required."""
    document = published(server)
    [method] = [m for m in document["methods"] if m["name"] == name]
    params = method["params"]
    return (
        Schemas(document["components"]["schemas"]),
        {p["name"]: p["schema"] for p in params},
        {p["name"] for p in params if p["required"]},
    )


def refused(schemas: Schemas, rng: random.Random, schema: Mapping[str, Any]) -> Any:
    """A value that the schema forbids."""
    while True:
        value = schemas.absurd(rng, schema)
        if not schemas.allows(schema, value):
            return value


@pytest.mark.parametrize(("server", "name"), CASES)
def test_every_wrong_argument_is_named_in_one_answer(server: str, name: str) -> None:
    schemas, fields, required = described(server, name)
    rng = random.Random(name)
    for _ in range(20):
        there = [f for f in fields if f in required or rng.random() < 0.5] or [*fields]
        wrong = set(rng.sample(there, rng.randint(1, len(there))))
        params = {
            f: refused(schemas, rng, fields[f]) if f in wrong
            else schemas.draw(rng, fields[f])
            for f in there
        }  # fmt: skip
        with pytest.raises(RpcError) as caught:
            parse_params(SERVERS[server][name], params)
        assert caught.value.code == -32602
        problems = caught.value.data["problems"]
        if len(problems) < 50:  # the most that are named
            named = {p["path"].partition(".")[0].partition("[")[0] for p in problems}
            assert wrong <= named, (params, problems)


@pytest.mark.parametrize(("server", "name"), CASES)
def test_what_is_drawn_from_a_schema_is_allowed_by_it(server: str, name: str) -> None:
    """Else a fuzzer's right messages are wrong ones, and blame what it changed in them."""
    schemas, fields, _ = described(server, name)
    rng = random.Random(name)
    for field, schema in fields.items():
        for _ in range(10):
            value = schemas.draw(rng, schema)
            assert schemas.allows(schema, value), (field, value)
