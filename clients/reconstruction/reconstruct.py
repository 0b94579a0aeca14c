"""Deprecated import path of `flexdt.library.reconstruction.reconstruct`."""

import warnings

from flexdt.library.reconstruction.reconstruct import *  # noqa: F403

warnings.warn(
    "flexdt.clients.reconstruction.reconstruct is now "
    "flexdt.library.reconstruction.reconstruct",
    DeprecationWarning,
    stacklevel=2,
)
