"""Work that takes seconds of its own accord: what it goes in, for whoever has a clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

during: Callable[[str], AbstractContextManager[object]] = nullcontext
"""Context manager that reports the work named by its argument; `flexdt.runtime.progress_lines`
replaces it."""
