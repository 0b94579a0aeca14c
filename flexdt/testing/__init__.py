"""Test kit for programs that use a scanner: a twin in process, and drawn input.

    from flexdt.testing import twin

    with twin(sample="normal-5") as scanner:
        scanner.client.move({"rot_obj": 90.0}, wait=True)

`flexdt.testing.fixtures` has the same as a fixture of pytest, `flexdt.testing.strategies` draws
machines and geometries with Hypothesis. Names are looked up on first use, so that
importing this package loads nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexdt.testing.in_process import Deadlock as Deadlock
    from flexdt.testing.in_process import InProcessTwin as InProcessTwin
    from flexdt.testing.in_process import twin as twin

__all__ = ["Deadlock", "InProcessTwin", "twin"]


def __getattr__(name: str) -> Any:
    """Load a public name from `in_process` at its first use; other names raise AttributeError."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("flexdt.testing.in_process"), name)
