"""Functions that pass their arguments on, with the signature of the function that takes them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
Result = TypeVar("Result")


def with_arguments_of(
    other: Callable[P, object],
) -> Callable[[Callable[..., Result]], Callable[P, Result]]:
    """A decorator that gives a function the parameters of `other`, for `help` and type checkers."""

    def typed(function: Callable[..., Result]) -> Callable[P, Result]:
        result = inspect.signature(function).return_annotation
        shown = inspect.signature(other).replace(return_annotation=result)
        function.__signature__ = shown  # type: ignore[attr-defined]
        return function

    return typed
