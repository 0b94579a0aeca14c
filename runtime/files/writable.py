"""Try an output path before the work whose result goes there."""

from __future__ import annotations

import tempfile
from pathlib import Path

from flexdt.message_words import reason_of


def require_writable(path: Path | None) -> None:
    """Check that a file can be made in an output's folder, or the nearest above it.

    One without a name is made there. Whether an existing file may be replaced is not
    checked. Raises OSError: names `path`, and the reason.
    """
    if path is None:
        return
    if path.is_dir():
        folder = path
    else:
        folder = path.absolute().parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(error.errno, reason_of(error), str(path)) from None
