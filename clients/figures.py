"""Deprecated import path of `flexdt.library.figures`."""

import warnings

from flexdt.library.figures import *  # noqa: F403

warnings.warn(
    "flexdt.clients.figures is now flexdt.library.figures",
    DeprecationWarning,
    stacklevel=2,
)
