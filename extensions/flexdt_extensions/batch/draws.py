"""Values that a plan fixes or draws: `600.0`, `{ uniform = [500, 800] }`, `{ choice = [...] }`.

Each is a frozen value with `sample(rng)`; the caller owns the generator. Validation errors name the
allowed values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema

Value = float | int | str
Generator = np.random.Generator


@dataclass(frozen=True)
class Draw:
    """A distribution.

    Attributes:
        kind: its name in plans; "fixed" for a bare value.
        values: its numbers or texts.
    """

    kind: str
    values: tuple[Value, ...]

    def sample(self, rng: Generator) -> Any:
        """One value: float, int or str, as the plan has them."""
        return _SAMPLERS[self.kind](self.values, rng)

    @property
    def lowest(self) -> float:
        """No value is below this; -inf if there is no such number."""
        if self.kind == "normal":
            return -math.inf
        return min(float(v) for v in self.values)

    @property
    def highest(self) -> float:
        """No value is above this."""
        if self.kind == "normal":
            return math.inf
        return max(float(v) for v in self.values)

    def to_plain(self) -> object:
        """As plans write it."""
        return self.values[0] if self.kind == "fixed" else {self.kind: list(self.values)}


_SAMPLERS: Final[Mapping[str, Callable[[Any, Generator], Any]]] = {
    "fixed": lambda v, rng: v[0],
    "uniform": lambda v, rng: float(rng.uniform(v[0], v[1])),
    "loguniform": lambda v, rng: float(math.exp(rng.uniform(math.log(v[0]), math.log(v[1])))),
    "normal": lambda v, rng: float(rng.normal(v[0], v[1])),
    "integers": lambda v, rng: int(rng.integers(v[0], v[1], endpoint=True)),
    "choice": lambda v, rng: v[int(rng.integers(len(v)))],
}
KINDS: Final = tuple(k for k in _SAMPLERS if k != "fixed")


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def parse(value: object) -> Draw:
    """A draw from what TOML holds.

    Raises:
        ValueError: says what is allowed.
    """
    if isinstance(value, Draw):
        return value
    if isinstance(value, str) or _number(value):
        return Draw("fixed", (value,))  # type: ignore[arg-type]
    if not isinstance(value, Mapping) or len(value) != 1 or next(iter(value)) not in KINDS:
        raise ValueError(f"got {value!r}; allowed: a value, or a table with one of {list(KINDS)}")
    ((kind, given),) = value.items()
    if not isinstance(given, list) or not given:
        raise ValueError(f"{kind} takes a list, got {given!r}")
    if kind == "choice":
        if not (all(isinstance(v, str) for v in given) or all(_number(v) for v in given)):
            raise ValueError(f"choice takes texts or numbers, not both or others: {given!r}")
        return Draw(kind, tuple(given))
    if len(given) != 2 or not all(_number(v) for v in given):
        raise ValueError(f"{kind} takes two numbers, got {given!r}")
    low, high = given
    if kind == "normal" and high < 0:
        raise ValueError(f"normal takes a mean and a standard deviation >= 0, got {given!r}")
    if kind == "loguniform" and low <= 0:
        raise ValueError(f"loguniform takes numbers above 0, got {given!r}")
    if kind == "integers" and not all(isinstance(v, int) for v in given):
        raise ValueError(f"integers takes whole numbers, got {given!r}")
    if kind != "normal" and low > high:
        raise ValueError(f"{kind} takes the lower number first, got {given!r}")
    return Draw(kind, (low, high))


def _numbers(value: object) -> Draw:
    draw = parse(value)
    if any(isinstance(v, str) for v in draw.values):
        raise ValueError(f"a number is needed, got {draw.to_plain()!r}")
    return draw


def _positive(value: object) -> Draw:
    draw = _numbers(value)
    if draw.lowest <= 0:
        also = " (a normal distribution has them)" if draw.kind == "normal" else ""
        raise ValueError(f"values must be above 0{also}, got {draw.to_plain()!r}")
    return draw


def _counts(value: object) -> Draw:
    draw = _positive(value)
    if draw.kind not in ("fixed", "choice", "integers") or any(
        not isinstance(v, int) for v in draw.values
    ):
        raise ValueError(f"whole numbers are needed, got {draw.to_plain()!r}")
    return draw


def _names(value: object) -> Draw:
    draw = parse(value)
    if not all(isinstance(v, str) for v in draw.values):
        raise ValueError(f"a name or a choice of names is needed, got {draw.to_plain()!r}")
    return draw


_plain = PlainSerializer(lambda draw: draw.to_plain())
_schema = WithJsonSchema({"description": "a value, or a table with one distribution"})

Number: TypeAlias = Annotated[Draw, BeforeValidator(_numbers), _plain, _schema]
Positive: TypeAlias = Annotated[Draw, BeforeValidator(_positive), _plain, _schema]
Count: TypeAlias = Annotated[Draw, BeforeValidator(_counts), _plain, _schema]
Name: TypeAlias = Annotated[Draw, BeforeValidator(_names), _plain, _schema]
