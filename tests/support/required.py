"""Packages that `make test` installs: skipped where somebody left them out, never in CI."""

from __future__ import annotations

import importlib
import os
from typing import Any

import pytest


def required(name: str) -> Any:
    """The module, or a skip where it is not installed; under CI=true an ImportError instead."""
    if os.environ.get("CI") == "true":
        return importlib.import_module(name)
    return pytest.importorskip(name, exc_type=ImportError)
