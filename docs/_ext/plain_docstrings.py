"""Our docstrings are plain text with code in single backticks; Sphinx reads reStructuredText.

Code becomes a literal and characters that would mean something in reStructuredText are escaped,
before napoleon reads the sections. It refuses to change a docstring's words.
"""

from __future__ import annotations

import re
from typing import Any

CODE = re.compile(r"(`[^`\n]+`)")
SPECIAL = re.compile(r"([*|\\])")
TRAILING = re.compile(r"(\w)_(?=\W|$)")
LABEL = re.compile(r"^(\s*)([\w, *\[\]\(\)]+): (.*)$")


def plain(text: str) -> str:
    """Convert one line of a docstring to reStructuredText: code in single backticks
    becomes a literal; elsewhere asterisks, bars, backslashes and trailing underscores are
    escaped.
    """
    parts = CODE.split(text)
    for i, part in enumerate(parts):
        if part.startswith("`") and part.endswith("`") and len(part) > 2:
            parts[i] = f"`{part}`"
        else:
            parts[i] = TRAILING.sub(r"\1\\_", SPECIAL.sub(r"\\\1", part))
    return "".join(parts)


def rewrite(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Convert the lines of a docstring in place (Sphinx's hook
    `autodoc-process-docstring`).
    """
    lines[:] = [plain(line) for line in lines]


def setup(app: Any) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", rewrite, priority=1)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
