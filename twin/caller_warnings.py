"""Warn at the line of the caller's program, however deep the function lies in flexdt."""

from __future__ import annotations

import sys
import warnings
from typing import Final

OWN_PREFIX: Final = "flexdt"
"""Beginning of the names of our packages: `flexdt` and `flexdt_extensions`."""


def warn_caller(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn about a call, at the innermost line that is not in flexdt.

    Python's filters decide whether it is shown, as for any warning.

    Args:
        text: of the warning.
        category: of the warning.
    """
    level = 1
    frame = sys._getframe()
    while frame.f_back is not None:
        if not str(frame.f_globals.get("__name__", "")).startswith(OWN_PREFIX):
            break
        frame = frame.f_back
        level += 1
    warnings.warn(text, category, stacklevel=level)
