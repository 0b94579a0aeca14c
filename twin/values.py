"""Frozen dataclasses that hold arrays, as values: compared by content, written to JSON and
back.

A dataclass compares its fields as a tuple, which NumPy arrays do not support, and pydantic,
which does the conversion, has no schema for arrays. `ArrayValue` supplies the comparison,
`Array` and `Table` the schema.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import PlainSerializer, PlainValidator, TypeAdapter, ValidationError

from flexdt.message_words import problem_words
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray

_ADAPTERS: dict[type[Any], TypeAdapter[Any]] = {}


def _read_array(value: object) -> FloatArray:
    """Copy a value to a float64 array."""
    return np.array(value, dtype=np.float64)


Array = Annotated[
    FloatArray,
    PlainValidator(_read_array),
    PlainSerializer(lambda array: array.tolist(), when_used="json"),
]
"""A float64 array; a list of numbers (of lists) in JSON."""


class ArrayValue:
    """Equality by content for a dataclass declared with `eq=False` that holds arrays.

    Instances cannot be hashed: the mappings among their fields cannot either.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        """Compare all fields by content, arrays exactly and element by element;
        NotImplemented for another type.
        """
        if type(self) is not type(other):
            return NotImplemented
        return all(
            _same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)
        )


class JsonValue:
    """A dataclass that goes to JSON and back, by its annotations."""

    def to_dict(self) -> dict[str, Any]:
        """Return the value as JSON types: dictionaries, lists, texts and numbers."""
        adapter = adapter_of(type(self))
        document: dict[str, Any] = adapter.dump_python(self, mode="json", by_alias=True)
        return document

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Read a value from the document that `to_dict` wrote.

        Raises:
            TwinError: the document has another form; the message names each place.
        """
        try:
            value: Self = adapter_of(cls).validate_json(json.dumps(document))
        except ValidationError as error:
            raise TwinError(*document_errors(cls.__name__, error)) from None
        return value


def document_errors(name: str, error: ValidationError) -> tuple[str, dict[str, object]]:
    """Describe the errors of a document, place by place: (message of an error, its data).

    At most 10, one line each, with `name` and the path of the place.
    """
    lines = [
        f"{name}: {'.'.join(map(str, e['loc'])) or 'document'}: {problem_words(e)}"
        for e in error.errors(include_url=False)[:10]
    ]
    return "\n".join(lines), {"problems": lines}


def adapter_of(cls: type[Any]) -> TypeAdapter[Any]:
    """Return pydantic's converter (TypeAdapter) of a type, made once for each and kept."""
    if cls not in _ADAPTERS:
        _ADAPTERS[cls] = TypeAdapter(cls)
    return _ADAPTERS[cls]


def _same(a: object, b: object) -> bool:
    """Compare two values by content: arrays exactly, mappings by keys and values at every
    level, others with ==.
    """
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(a, b)  # type: ignore[arg-type]
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    return a == b
