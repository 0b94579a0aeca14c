"""Names of data sets, and of the files in their folders: one plain component, nothing else.

A name from a script, a client or a foreign document may contain drives, shares, parents, NUL or
device names. Such a name is an error and is never repaired, because a guess could overwrite
something. (Paths in scripts are reduced to bare names when they are planned.)
"""

from __future__ import annotations

import re
from typing import Final

from flexdt.twin.dataset.dataset_errors import DatasetNameError

MAX_NAME: Final = 128
"""Largest number of characters of a name."""
SCAN_SETTINGS: Final = "scan settings.txt"
XRE_SETTINGS: Final = "data settings XRE.txt"
SCRIPT: Final = "script.txt"
DOCUMENT: Final = "flexdt.json"
GEOMETRY: Final = "geometry.json"
UNFINISHED: Final = "unfinished.json"
"""Name of the marker file in a folder that is being saved, or whose saving was
interrupted."""
_FORBIDDEN: Final = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|\ud800-\udfff]')
_DEVICE: Final = re.compile(
    r"(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?:\..*)?", re.IGNORECASE
)


def plain_name(name: str, what: str = "file") -> str:
    """Return `name` unchanged if it is one plain path component.

    The rules are those of `_reason`.

    `name`: as it came; `what`: kind of the named thing, for the message.
    Raises DatasetNameError: the name is not allowed; the message names the rule.
    """
    reason = _reason(name)
    if reason is not None:
        raise DatasetNameError(
            f"{what} name {name[:80]!r} {reason}; allowed: a plain name of at most {MAX_NAME} "
            'characters, without / \\ : * ? " < > | and control characters, not starting with a '
            "dot or ending with a dot or space",
            {"asked": name[:200], "reason": reason},
        )
    return name


def _reason(name: str) -> str | None:
    """Return the first rule that a name breaks, in words, or None if it is allowed.

    Rules, in this order: not empty; at most `MAX_NAME` characters and 255 bytes in UTF-8;
    no forbidden character; no dot at either end, no space around it; no device name of
    Windows.
    """
    if not name:
        return "is empty"
    if len(name) > MAX_NAME or len(name.encode("utf-8", "surrogatepass")) > 255:
        return f"is {len(name)} characters long"
    forbidden = _FORBIDDEN.search(name)
    if forbidden is not None:
        return f"contains {forbidden.group()!r}"
    if name.startswith(".") or name != name.strip() or name.endswith("."):
        return "starts with a dot or ends with a dot or space"
    if _DEVICE.fullmatch(name):
        return "is a device of Windows"
    return None
