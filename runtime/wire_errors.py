"""The twin's exceptions as the wire's errors: one table, most special types first.

Errors that no user caused stay internal, with their traceback in the server's log and
nowhere else.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from flexdt.protocol.rpc_errors import Code, RpcError, internal, link_down
from flexdt.twin import errors as e
from flexdt.twin.dataset.dataset_errors import DatasetExistsError, DatasetWriteError
from flexdt.twin.script import ScriptError


class ProjectorUnavailable(ConnectionError):
    """The projector did not answer within the client's patience."""


CODES: Sequence[tuple[type[e.TwinError], Code]] = (
    (ScriptError, Code.SCRIPT_INVALID),
    (DatasetExistsError, Code.INVALID_PARAMS),
    (DatasetWriteError, Code.LIMIT),
    (e.LimitError, Code.LIMIT),
    (e.CollisionError, Code.COLLISION),
    (e.SafetyError, Code.BUSY),
    (e.NotIdentifiableError, Code.NOT_IDENTIFIABLE),
    (e.TwinError, Code.INVALID_PARAMS),
)


def explain(error: Exception, root: Path | None = None) -> RpcError:
    """Convert `error` to the wire's error.

    An RpcError is returned as it is. A script's error has its problems as data. A lost
    connection is LINK_DOWN. Other TwinErrors get the code of their class in `CODES`.

    Args:
        error: any exception.
        root: data directory, to which paths below it become relative; None: they stay.

    Returns:
        The error; an internal one, without details, for an error that no user can cause.
    """
    if root is not None:
        known = explain(error)
        message = from_root(known.message, root)
        data = from_root(known.data, root)
        return RpcError(known.code, str(message), data)
    match error:
        case RpcError():
            return error
        case ScriptError():
            problems = [p.to_dict() for p in error.problems]
            return RpcError(Code.SCRIPT_INVALID, error.message, problems)
        case e.TwinError() if isinstance(error, ConnectionError):  # a client's is both
            return link_down(str(error))
        case e.TwinError():
            code = next(code for kind, code in CODES if isinstance(error, kind))
            return RpcError(code, error.message, error.data)
        case ProjectorUnavailable():
            return RpcError(
                Code.PROJECTOR_UNAVAILABLE,
                str(error),
                {"allowed": "a running projector server"},
            )
    return internal()


def is_user_error(error: Exception) -> bool:
    """Return whether `explain` gives more than "internal error"."""
    return isinstance(error, RpcError | e.TwinError | ProjectorUnavailable)


def from_root(said: object, root: Path) -> object:
    """Return `said` with paths below the folder `root` replaced by relative ones, in
    nested values, too.

    The folder itself becomes "the data directory". Lists and tuples become lists; keys
    stay.

    Args:
        said: text, mapping or list; other values are returned as they are.
        root: the data directory.
    """
    match said:
        case str():
            below = said.replace(str(root) + os.sep, "")
            return re.sub(
                rf"{re.escape(str(root))}(?![\w-]|\.\w)", "the data directory", below
            )
        case Mapping():
            return {name: from_root(value, root) for name, value in said.items()}
        case list() | tuple():
            return [from_root(value, root) for value in said]
    return said
