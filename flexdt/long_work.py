"""Work that takes seconds of its own accord: what it goes in, for whoever has a clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

during: Callable[[str], AbstractContextManager[object]] = nullcontext
"""Called with what is done, and entered while it is; `flexdt.progress_lines` puts its own here."""
