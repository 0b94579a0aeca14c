"""Deprecated import path of `flexdt.library.machines`."""

import warnings

from flexdt.library.machines import *  # noqa: F403

warnings.warn(
    "flexdt.machines is now flexdt.library.machines", DeprecationWarning, stacklevel=2
)
