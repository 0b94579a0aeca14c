"""Refusals in the words of somebody who reads the page.

The wire and the library speak to programmers: of functions, options, folders of the server. Each
such sentence has the page's own in `SENTENCES`; whatever else names something that a page does
not have is left out, and what remains is said.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

SENTENCES: Final[tuple[tuple[str, str], ...]] = (
    (
        r"what the sample '(?P<what>[^']*)' is made of is not known",
        "What {what} is made of is not known, so there is no truth to compare with: only samples "
        "that come with flexdt have one.",
    ),
    (
        r"only the finished volume of a past scan is compared",
        "Only the volume of a finished scan is compared: press Reconstruct in the Data tab first.",
    ),
    (
        r"(no|without|needs|has no) (an? )?(flat|bright)|`flat`|flat images? (are|is) missing"
        r"|open beam",
        "This scan has no flat images, which say how bright the open beam is: scan it again with "
        "a script that takes some (Write makes one).",
    ),
    (
        r"started without --data",
        "This page shows no volumes: its viewer cannot read the scans.",
    ),
    (r"pip install", "A part of flexdt is not installed on the server: ask who runs it."),
    (
        r"the twin has not been seen yet|Connect call failed|connection (was )?(lost|refused)",
        "The twin does not answer: what is pressed now does not reach it.",
    ),
    (
        r"^(tube|camera) (?P<what>[^\W_]+)\w* (?P<asked>\S+) is outside "
        r"\[(?P<low>\S+), (?P<high>\S+)\](?P<unit>.*)$",
        "{what} {asked}{unit} is outside {low} to {high}{unit}",
    ),
)
"""What a refusal says somewhere -> the page's sentence in its place."""

FOREIGN: Final = re.compile(
    r"`|\bfx\.|\bflexdt [a-z]|\bflexdt[._][a-z]|--[a-z]|\b\w+\([^)]*\)(?=[\s.,;:]|$)|\w+/\w+/"
    r"|\b(numpy|tifffile|pydantic|asyncio|h5py|cv2|OpenCV|Traceback|Errno|TypeError|ValueError)\b"
    r"|\b[a-z]+\.(get|set|submit|check|fit|apply|control|estop|frame|list|upload|stop|move)\b"
    r"|\b(DATASET|FOLDER|FILE|PATH)\b"
)
"""What a page does not have: code, commands, options, the wire's methods, folders."""
PATH: Final = re.compile(
    r"(?<![\w.:/])(?:[A-Za-z]:)?[\\/](?:[^\s\\/:;,\"']+[\\/])+([^\s\\/:;,\"']+)"
)
"""A path of the server, and its last name."""
FALLBACK: Final = "This is not possible here; the server's log says more."
MARKS: Final = re.compile(r"(?<=[.;])\s+|\s+\((?=[^)]*\))")


def for_reader(text: str) -> str:
    """Put a refusal into the page's words.

    A known sentence is replaced, folders of the server become their last name, and parts between
    full stops, semicolons and brackets that still name what a page does not have are left out.

    >>> for_reader("scan-3 has no image 7; ask dataset.get first")
    'scan-3 has no image 7.'
    """
    text = re.sub(r"^[a-z]+\.[a-z_]+: ", "", text)  # the wire's method
    for pattern, words in SENTENCES:
        if found := re.search(pattern, text):
            return words.format(**found.groupdict())
    if not FOREIGN.search(text) and not PATH.search(text):
        return text
    kept = []
    for part in MARKS.split(PATH.sub(r"\1", text)):
        if FOREIGN.search(part):
            continue
        kept.append(part.rstrip(" ;,:)") if part.count("(") < part.count(")") else part)
    said = " ".join(kept).rstrip(" ;,:.(")
    return f"{said}." if said else FALLBACK


SPOKEN: Final = ("problem", "not_compared")
"""Facts of a volume that are sentences for people; `doubts` is a list of them."""


def of_volume(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Put what a volume's facts say to people into the page's words; other facts stay."""
    told = dict(facts)
    for name in SPOKEN:
        if isinstance(told.get(name), str):
            told[name] = for_reader(told[name])
    if "doubts" in told:
        told["doubts"] = [for_reader(doubt) for doubt in told["doubts"]]
    return told
