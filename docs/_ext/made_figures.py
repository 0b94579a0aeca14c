"""Make the figures of `docs/tools/scan_figures.py` anew and show these in place of the kept
copies.

Pages name `images/made/NAME.png`, which a forge shows. The site shows what the library makes
during the build. Figures are kept in `_generated/figures/` until the script or flexdt's version
changes.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

SCRIPT = Path(__file__).resolve().parent.parent / "tools" / "scan_figures.py"
MADE = re.compile(r"(!\[[^\]]*\]\()((?:\.\./)*)images/made/(\w[\w-]*\.png\))")


def digest() -> str:
    """Return the key under which made figures are kept."""
    return hashlib.sha256(SCRIPT.read_bytes() + version("flexdt").encode()).hexdigest()


def make(app: Any) -> None:
    """Make the figures in `_generated/figures` by the script, in a process of its own,
    unless those of this script and version exist (hook `builder-inited`).

    Raises:
        CalledProcessError: the script failed.
    """
    folder = Path(app.srcdir) / "_generated" / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    key = folder / "made-by.txt"
    if key.exists() and key.read_text() == digest():
        return
    # Their own back end: the one of notebooks writes nothing to files.
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    subprocess.run([sys.executable, SCRIPT, "--out", folder], check=True, env=environment)
    key.write_text(digest())


def show(app: Any, docname: str, content: list[str]) -> None:
    """Point a page's pictures to the figures that were made (hook `source-read`)."""
    content[0] = MADE.sub(r"\1\2_generated/figures/\3", content[0])


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", make)
    app.connect("source-read", show)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
