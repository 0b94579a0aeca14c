"""Deprecated import path of `flexdt.library.datasets.exchange`."""

import warnings

from flexdt.library.datasets.exchange import *  # noqa: F403

warnings.warn(
    "flexdt.clients.datasets.exchange is now flexdt.library.datasets.exchange",
    DeprecationWarning,
    stacklevel=2,
)
