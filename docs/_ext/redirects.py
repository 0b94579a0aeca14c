"""Write a page that forwards the reader at each address that a page once had."""

from __future__ import annotations

import posixpath
from pathlib import Path
from typing import Any

MOVED = {
    "how-to": "use",
    "explanation": "understand",
    "machine-fit": "commission",
    "decisions/0024-kernels-shipped-once-more": "decisions/0020-kernels-compiled-at-installation",
}
"""Old page -> page that has its subject now, without the ending."""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Moved</title>
<meta http-equiv="refresh" content="0; url={to}"></head>
<body><p>This page is now <a href="{to}">{to}</a>.</p></body></html>
"""


def write(app: Any, exception: Exception | None) -> None:
    """Write a forwarding page for each of `MOVED` after a build to HTML (Sphinx's hook
    `build-finished`); nothing after an error or for another builder.
    """
    if exception is not None or app.builder.name != "html":
        return
    for old, new in MOVED.items():
        path = Path(app.outdir) / f"{old}.html"
        path.parent.mkdir(parents=True, exist_ok=True)
        target = posixpath.relpath(f"{new}.html", posixpath.dirname(old) or ".")
        path.write_text(PAGE.format(to=target), encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
