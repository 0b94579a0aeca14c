"""JSON schemas as a fuzzer uses them: what they allow, values they allow, values they should
not.

Only the words that the servers' schemas use. Nothing of flexdt is imported.

Why no library: hypothesis-jsonschema 0.23 draws only what is allowed, without `prefixItems` and
what pydantic writes of keys (an eighth of its values was wrong), takes 15 ms a value instead of
0.02, and fails beside Hypothesis 6.170. jsonschema takes 1.0 for an integer and NaN for a
number. schemathesis needs HTTP.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from typing import Any

Schema = Mapping[str, Any]
Path = tuple[str | int, ...]
DEEP: Any = 1.0
for _ in range(150):
    DEEP = [DEEP]
LONG = 10**6

NUMBERS: list[Any] = [
    0, -1, 1, 2**31, -(2**31), 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64, 2**70, -(2**70), 1e300,
    -1e300, 1e308, 1e-300, -1e-300, 5e-324, 1e160, 1e30, 1e16, 1.5, -0.0, math.nan, math.inf,
    -math.inf,
]  # fmt: skip
TEXTS: list[Any] = [
    "", " ", "\x00", "a\x00b", "\x1b[2J", "a\nb", "\x7f", "\u2028", "\ud800", "a\udfff", "../..",
    "/", "\\", "nul", ".", "%s%n", "{}", "é" * 60, "漢" * 30, "😀" * 20, "A" * 101, "A" * 121,
    "A" * 1001, "1e999", "NaN", "null", "__proto__",
]  # fmt: skip
OTHERS: list[Any] = [None, True, False, [], {}, [[]], [None] * 3, {"": 1}, {"a": {"b": {}}}, DEEP,
                     [0] * 1000, {str(i): i for i in range(1000)}]  # fmt: skip


class Schemas:
    """Schemas that refer to each other.

    Args:
        definitions: by name, as in `#/components/schemas/NAME` or `#/$defs/NAME`.
    """

    def __init__(self, definitions: Mapping[str, Schema]) -> None:
        self._definitions = definitions

    def plain(self, schema: Schema) -> Schema:
        """The schema itself, for one that may be a reference."""
        while "$ref" in schema:
            rest = {k: v for k, v in schema.items() if k != "$ref"}
            schema = {**self._definitions[schema["$ref"].rpartition("/")[2]], **rest}
        return schema

    def allows(self, schema: Schema, value: Any) -> bool:
        """Whether `value` is one."""
        s = self.plain(schema)
        if "anyOf" in s:
            return any(self.allows(one, value) for one in s["anyOf"])
        if "const" in s:
            return type(value) is type(s["const"]) and value == s["const"]
        if "enum" in s:
            return any(type(value) is type(one) and value == one for one in s["enum"])
        kind = s.get("type")
        return kind is None or _KINDS[kind](self, s, value)

    def draw(self, rng: random.Random, schema: Schema) -> Any:
        """A value that it allows."""
        s = self.plain(schema)
        if "anyOf" in s:
            return self.draw(rng, rng.choice(s["anyOf"]))
        if "const" in s:
            return s["const"]
        if "enum" in s:
            return rng.choice(s["enum"])
        match s.get("type"):
            case "integer" | "number" as kind:
                low = s.get("minimum", s.get("exclusiveMinimum", 0))
                high = s.get("maximum", s.get("exclusiveMaximum", low + 100))
                drawn = rng.choice(
                    [low + (high - low) * rng.random() ** 6, min(high, max(1, low))]
                )
                return int(drawn) if kind == "integer" else float(drawn)
            case "string":
                return "x" * max(3, s.get("minLength", 0))
            case "boolean":
                return rng.random() < 0.5
            case "array":
                if "prefixItems" in s:
                    return [self.draw(rng, one) for one in s["prefixItems"]]
                count = max(1, s.get("minItems", 0))
                return [self.draw(rng, s.get("items", {})) for _ in range(count)]
            case "object" if "properties" in s:
                need = s.get("required", ())
                return {
                    name: self.draw(rng, one)
                    for name, one in s["properties"].items()
                    if name in need or rng.random() < 0.3
                }
            case "object":
                inner = _members(s)
                names = s.get("required", ("x",))
                member = inner if isinstance(inner, Mapping) else {}
                return {name: self.draw(rng, member) for name in names}
        return None

    def inner(self, schema: Schema, value: Any) -> Iterator[tuple[str | int, Schema]]:
        """The members of `value`, each with its schema."""
        s = self.plain(schema)
        for one in s.get("anyOf", ()):
            if self.allows(one, value):
                s = self.plain(one)
                break
        if isinstance(value, dict):
            properties, more = s.get("properties", {}), _members(s)
            for key in value:
                yield key, properties.get(key, more if isinstance(more, Mapping) else {})
        elif isinstance(value, list):
            first = s.get("prefixItems", [])
            for i in range(min(len(value), 20)):
                yield i, first[i] if i < len(first) else s.get("items", {})

    def absurd(self, rng: random.Random, schema: Schema) -> Any:
        """A value at, beyond or far beyond what it allows, or of another kind."""
        return deepcopy(self._absurd(rng, schema))

    def _absurd(self, rng: random.Random, schema: Schema) -> Any:
        """Draw a value that a schema mostly refuses: another type, an edge, a strange
        number or text.
        """
        kinds = [self.plain(one) for one in self.plain(schema).get("anyOf", [schema])]
        s = rng.choice(kinds)
        if rng.random() < 0.12:
            return rng.choice(OTHERS)
        if rng.random() < 0.08:
            return rng.choice(NUMBERS + TEXTS)
        match s.get("type"):
            case "integer" | "number" as kind:
                edges = [s[k] for k in ("minimum", "maximum", "exclusiveMinimum",
                                        "exclusiveMaximum") if k in s]  # fmt: skip
                if edges and rng.random() < 0.5:
                    edge = rng.choice(edges)
                    if kind == "integer":
                        return rng.choice([edge - 1, edge, edge + 1])
                    return rng.choice([math.nextafter(edge, -math.inf), float(edge), -float(edge),
                                       math.nextafter(edge, math.inf)])  # fmt: skip
                return rng.choice(NUMBERS)
            case "string":
                most, least = s.get("maxLength"), s.get("minLength", 0)
                if rng.random() < 0.002:
                    return "x" * LONG
                if most is not None and most < 10_000 and rng.random() < 0.3:
                    return "x" * rng.choice([most, most + 1, max(0, least - 1), least])
                return rng.choice(TEXTS)
            case "array" | "object":
                return rng.choice(OTHERS)
        return rng.choice([*NUMBERS, *TEXTS, *OTHERS])


def _members(s: Schema) -> Any:
    """What members without a name of their own are: pydantic says so by a pattern of their
    keys."""
    return next(
        iter(s.get("patternProperties", {}).values()), s.get("additionalProperties", True)
    )


def _whole(pattern: str) -> str:
    return pattern.replace("$", r"\Z")


def finite(value: Any) -> bool:
    """Whether `value` is a number that the wire has."""
    return isinstance(value, int) or (isinstance(value, float) and math.isfinite(value))


def _number(schemas: Schemas, s: Schema, value: Any) -> bool:
    """Whether a value is a finite number within the schema's limits; no bool is."""
    return (
        not isinstance(value, bool)
        and finite(value)
        and s.get("minimum", value) <= value <= s.get("maximum", value)
        and ("exclusiveMinimum" not in s or value > s["exclusiveMinimum"])
        and ("exclusiveMaximum" not in s or value < s["exclusiveMaximum"])
    )


def _text(schemas: Schemas, s: Schema, value: Any) -> bool:
    """Whether a value is a text that the schema allows; bytes are if it has an encoding."""
    if isinstance(value, bytes):
        return "contentEncoding" in s
    if not isinstance(value, str) or re.search("[\ud800-\udfff]", value):
        return False
    if "pattern" in s and not re.search(_whole(s["pattern"]), value):
        return False
    return s.get("minLength", 0) <= len(value) <= s.get("maxLength", len(value))


def _array(schemas: Schemas, s: Schema, value: Any) -> bool:
    """Whether a value is a list with as many and such members as the schema allows."""
    if not isinstance(value, list):
        return False
    if not s.get("minItems", 0) <= len(value) <= s.get("maxItems", len(value)):
        return False
    first = s.get("prefixItems", [])
    items = s.get("items", {})
    return all(
        schemas.allows(first[i] if i < len(first) else items, one)
        for i, one in enumerate(value)
    )


def _object(schemas: Schemas, s: Schema, value: Any) -> bool:
    """Whether a value has the fields required and no field that the schema forbids."""
    if not isinstance(value, dict) or not all(
        name in value for name in s.get("required", ())
    ):
        return False
    if not s.get("minProperties", 0) <= len(value) <= s.get("maxProperties", len(value)):
        return False
    properties, more = s.get("properties", {}), _members(s)
    names = s.get("propertyNames", {})
    patterns = [_whole(p) for p in s.get("patternProperties", ())]
    for key, one in value.items():
        if key in properties:
            sound = schemas.allows(properties[key], one)
        elif more is False or not schemas.allows({"type": "string", **names}, key):
            sound = False
        else:
            fits = not patterns or any(re.search(p, key) for p in patterns)
            sound = fits and (more is True or schemas.allows(more, one))
        if not sound:
            return False
    return True


_KINDS: Mapping[str, Callable[[Schemas, Schema, Any], bool]] = {
    # JSON has one kind of number: 1e16 is an integer.
    "integer": lambda m, s, v: (
        (isinstance(v, int) or (isinstance(v, float) and v.is_integer()))
        and _number(m, s, v)
    ),
    "number": _number,
    "string": _text,
    "boolean": lambda m, s, v: isinstance(v, bool),
    "null": lambda m, s, v: v is None,
    "array": _array,
    "object": _object,
}
