"""The methods' handlers: short functions that translate between wire and twin."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType

from flexdt.protocol import METHODS
from flexdt.server.twin.handlers import (
    calibration_methods,
    image_methods,
    job_methods,
    motion_methods,
    sample_methods,
    session_methods,
)
from flexdt.server.twin.handlers.handler import Handler


def table(*modules: ModuleType) -> Mapping[str, Handler]:
    """Method name -> what answers it: the functions of `modules` that `answers` marks.

    Raises:
        TypeError: a method of the wire has no handler, or two; or a handler's method is not one.
    """
    functions = [function for module in modules for function in vars(module).values()]
    pairs = [(m.name, f) for f in functions for m in getattr(f, "answered", ())]
    names = sorted(name for name, _ in pairs)
    if names != sorted(METHODS):
        odd = {name for name in {*names, *METHODS} if names.count(name) != 1 or name not in METHODS}
        raise TypeError(f"not one handler for each method of the wire: {', '.join(sorted(odd))}")
    return dict(pairs)


HANDLERS = table(
    session_methods, motion_methods, sample_methods, image_methods, job_methods,
    calibration_methods,
)  # fmt: skip
"""Method name -> what answers it."""
