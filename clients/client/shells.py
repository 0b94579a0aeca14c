"""Turns the functions of `twin_methods` into methods of a client.

`blocking` and `awaited` take a function that makes a flow and return a method that runs it, with
the function's signature, docstring and result type.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from flexdt.clients.client.flows import Flow

_P = ParamSpec("_P")
_R = TypeVar("_R")


class Blocking(Protocol):
    """Runs flows by blocking."""

    def run(self, flow: Flow[_R]) -> _R:
        """Run a flow to its end."""


class Awaiting(Protocol):
    """Runs flows in an event loop."""

    async def run(self, flow: Flow[_R]) -> _R:
        """Run a flow to its end."""


def blocking(make: Callable[_P, Flow[_R]]) -> Callable[Concatenate[Any, _P], _R]:
    """A method that blocks until the flow has ended."""

    @functools.wraps(make)
    def method(self: Blocking, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        return self.run(make(*args, **kwargs))

    return _described(method, make)


def awaited(
    make: Callable[_P, Flow[_R]],
) -> Callable[Concatenate[Any, _P], Coroutine[Any, Any, _R]]:
    """A coroutine method that returns when the flow has ended."""

    @functools.wraps(make)
    async def method(self: Awaiting, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        return await self.run(make(*args, **kwargs))

    return _described(method, make)


_F = TypeVar("_F", bound=Callable[..., Any])


def _described(method: _F, make: Callable[..., Any]) -> _F:
    """Give a method the signature that help() and notebooks show: with self, without Flow."""
    made = inspect.signature(make)
    self = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    returns = made.return_annotation
    if isinstance(returns, str):
        returns = returns.removeprefix("Flow[").removesuffix("]")
    signature = made.replace(
        parameters=[self, *made.parameters.values()], return_annotation=returns
    )
    method.__signature__ = signature  # type: ignore[attr-defined]
    return method
