"""Deprecated import path of `flexdt.library.reading.folders`."""

import warnings

from flexdt.library.reading.folders import *  # noqa: F403

warnings.warn(
    "flexdt.clients.datasets.dataset is now flexdt.library.reading.folders",
    DeprecationWarning,
    stacklevel=2,
)
