"""A method of a wire: its parameters and result, how it may be called, and the check of a call.

The twin server's methods are in `methods`, the projector's in `projector`.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Generic, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError

from flexdt.message_words import SUGGESTION, nearest_name, problem_words
from flexdt.protocol.fields import Params, Result
from flexdt.protocol.rpc_errors import Code, RpcError, clip, invalid_params, problem

PROTOCOL: Final = "1.0"
"""Version of the wire: a server serves every client of the same major number (before the
dot)."""

_M = TypeVar("_M", bound=BaseModel)
_P = TypeVar("_P", bound=Params, covariant=True)
_R = TypeVar("_R", bound=Result, covariant=True)


@dataclass(frozen=True)
class Method(Generic[_P, _R]):
    """One method of the wire.

    Attributes:
        name: as on the wire.
        params, result: their models.
        summary: one line for people.
        control: only the controller may call it (a client becomes the controller if there is
            none).
        safe: reads only, so a client may repeat it after a lost connection.
        urgent: handled on arrival, ahead of the connection's earlier requests.
        by_hand: an error while a job runs, and allowed while it is paused.
        bulky: its parameters may be larger than other methods' may.
        limits: on what one call may cost, by name with its unit; beyond them is -32008.
    """

    name: str
    params: type[_P]
    result: type[_R]
    summary: str
    control: bool = False
    safe: bool = False
    urgent: bool = False
    by_hand: bool = False
    bulky: bool = False
    limits: Mapping[str, float] = field(default_factory=dict)


AnyMethod: TypeAlias = Method[Params, Result]


read = partial(Method, safe=True)
"""A method that changes nothing."""
command = partial(Method, control=True)
"""A method of the controller."""
by_hand = partial(Method, control=True, by_hand=True)
"""A method of the controller, while no job runs."""


def compatible(protocol: str) -> bool:
    """Return whether a server of this version serves a client that speaks `protocol`."""
    return protocol.split(".")[0] == PROTOCOL.split(".")[0]


def require_compatible(protocol: str) -> None:
    """Reject a client of another protocol version.

    A compatible one passes without a result.

    Raises RpcError: -32602, with the version of this server.
    """
    if not compatible(protocol):
        raise invalid_params(
            f"protocol {protocol!r} is not spoken here; this server speaks {PROTOCOL}",
            [problem("protocol", "another version", protocol)],
            PROTOCOL,
        )


def parse_params(
    method: Method[_P, Result], given: Mapping[str, object] | list[object] | None
) -> _P:
    """Validate the parameters of a call, given by name, by position, or not at all.

    Missing parameters take their defaults. Raises RpcError: -32602, too many values, or
    every problem (at most 50) with its path and value; unknown names if the model forbids
    them.
    """
    fields = method.params.model_fields
    if isinstance(given, list):
        if len(given) > len(fields):
            raise invalid_params(
                f"{method.name} takes {len(fields)} parameters, got {len(given)}",
                allowed=list(fields),
            )
        given = dict(zip(fields, given, strict=False))
    try:
        return method.params.model_validate({} if given is None else dict(given))
    except ValidationError as error:
        named = {} if given is None else given
        raise _explain(method.name, error, list(fields), named) from None


def parse_result(model: type[_M], given: object) -> _M:
    """Validate a result against its model (for clients) and return it as that model.

    Raises:
        RpcError: -32603, the answer does not fit the model.
    """
    try:
        return model.model_validate(given)
    except ValidationError as error:
        message = f"the server's answer is no {model.__name__}: {error}"
        raise RpcError(Code.INTERNAL, message) from None


def _gravity(problem: Mapping[str, Any]) -> int:
    """Order problems: names that there are not, then values, then what is missing."""
    return {"extra_forbidden": 0, "missing": 2}.get(problem["type"], 1)


def _explain(
    method: str, error: ValidationError, allowed: list[str], given: Container[str]
) -> RpcError:
    """Make the error -32602 of a validation error, with at most 50 problems; returned,
    not raised.

    The message has the first problem and the number of others; texts are clipped to 80
    characters.

    Each problem in the error's data has the keys path, message, asked and, where there
    are limits, allowed.

    Args:
        method: its name on the wire.
        error: of the check of its parameters.
        allowed: names of the method's parameters.
        given: names of those that were given.
    """
    problems: list[dict[str, object]] = []
    # What is missing is often there under the name that is refused.
    for e in sorted(error.errors(), key=_gravity)[:50]:
        problem: dict[str, object] = {
            "path": ".".join(clip(str(part), 80) for part in e["loc"]) or "params",
            "message": problem_words(e),
            "asked": clip(e["input"], 80),
        }
        limits = {
            k: v for k, v in e.get("ctx", {}).items() if isinstance(v, (int, float, str))
        }
        if limits:
            problem["allowed"] = limits
        if e["type"] == "extra_forbidden" and len(e["loc"]) == 1:
            near = nearest_name(str(e["loc"][0]), allowed, given)
            hint = "" if near is None else f"; {SUGGESTION} {near!r}?"
            problem["message"] = f"{problem['message']}{hint}"
        problems.append(problem)
    first = problems[0]
    more = ""
    if error.error_count() > 1:
        more = f" (and {error.error_count() - 1} more)"
    return invalid_params(
        f"{method}: {first['path']}: {first['message']}{more}", problems, allowed
    )
