"""The order of image files by the numbers in their names, and errors in it.

Names hold whole numbers, decimals, negative numbers or angles (`p_0.25`, `a-10`, `x_180deg`).
How they are written is found from all names together: 1.10 follows 1.9 where 1.1 is there, too.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Final

import numpy as np

from flexdt.twin.findings import Finding, Findings, error, warning
from flexdt.twin.plausibility.contradictions import PlausibilityCode

NUMBER: Final = re.compile(r"(?P<sign>[-+]?)(?P<whole>\d+)(?P<part>\.\d+)?")
SCIENTIFIC: Final = re.compile(r"\d\.\d+[eE][-+]\d{2}(?!\d)")
"""A number with a power of ten, as `%e` writes it."""
DECIMAL: Final = "0123456789"
HEXADECIMAL: Final = "0123456789abcdefABCDEF"
SIGNED_AFTER: Final = frozenset("_ =(,")
"""Characters, or the name's beginning, after which a hyphen is a minus sign."""
MAX_OTHERS_SHARE: Final = 0.1
"""Largest share of names (or two names) that may differ in form from the rest by
mistake."""
MIN_EVEN_SHARE: Final = 0.8
"""Least share of equal steps between numbers for which a missing number is a gap."""
MAX_NAMES_SHOWN: Final = 3
"""Number of names in a message."""
Key = tuple[str | float, ...]
"""Texts and numbers of a name in turn, beginning with a text."""


@dataclass(frozen=True)
class Ordered:
    """Names in order.

    Attributes:
        names: in the order of their numbers.
        findings: errors in them.
        others: of `names`, those that are written otherwise than the rest.
    """

    names: tuple[str, ...]
    findings: Findings = field(default_factory=Findings)
    others: tuple[str, ...] = ()


def ordered(names: Sequence[str]) -> Ordered:
    """Put the names of image files in the order of their numbers, and find errors in it.

    Repeated names count once. Names that differ by one evenly spaced number of fixed
    width are returned sorted, without findings (`_numbered`). Else a first duplicate and
    a gap are reported; names of another form than most are listed in `others` and ignored
    for gaps, without a finding (`other_name` makes one).

    Args:
        names: file names, with or without an ending.

    Example:
        >>> ordered(["p_0.5.tif", "p_0.25.tif", "p_-1.tif"]).names
        ('p_-1.tif', 'p_0.25.tif', 'p_0.5.tif')
        >>> ordered(["a10.tif", "a9.tif"]).names
        ('a9.tif', 'a10.tif')
    """
    known = sorted(set(names))
    if (evenly := _numbered(known) or _hexadecimal(known)) is not None:
        return evenly
    keys = _keys(known)
    sorted_names = tuple(sorted(known, key=lambda name: (keys[name], name)))
    others = _written_otherwise(sorted_names, keys)
    rest = [name for name in sorted_names if name not in others]
    found = [*_duplicates(sorted_names, keys), *_gaps(rest, keys)]
    return Ordered(sorted_names, Findings(found), others)


def _numbered(names: list[str]) -> Ordered | None:
    """Sort names quickly if they differ only by a whole number in even steps.

    `names`: sorted, unique. None for fewer than two, unequal lengths, several differing
    parts, or a number next to a sign, point or another number.
    """
    split = _split(names, DECIMAL)
    if split is None:
        return None
    before, parts, after = split
    if before.endswith(("-", "+", ".")) or NUMBER.match(after[:2].lstrip(".")):
        return None
    if not all(map(str.isdigit, parts)):
        return None
    return _even(names, [*map(int, parts)])


def _hexadecimal(names: list[str]) -> Ordered | None:
    """Sort names that differ only by a hexadecimal number of fixed width whose steps are even.

    Args:
        names: sorted, without repetition.

    Returns the names in that order, without findings. None for other names, and where no number
    or every number has a letter.
    """
    split = _split(names, HEXADECIMAL)
    if split is None:
        return None
    _, parts, _ = split
    plain = sum(map(str.isdigit, parts))
    if not 0 < plain < len(names) or any(part.strip(HEXADECIMAL) for part in parts):
        return None
    return _even(names, [int(part, 16) for part in parts])


def _split(names: list[str], digits: str) -> tuple[str, list[str], str] | None:
    """Split names of one length around the number in which they differ.

    Args:
        names: sorted, without repetition.
        digits: of which the number is, after its first decimal ones.

    Returns the text before it, the numbers, and the text after it. None for fewer than two
    names, unequal lengths, or several differing parts.
    """
    if len(names) < 2 or len({*map(len, names)}) != 1:
        return None
    first = names[0]
    at = next(i for i, (a, b) in enumerate(zip(first, names[-1], strict=True)) if a != b)
    before = first[:at].rstrip(DECIMAL)
    after = first[len(before) :].lstrip(digits)
    if not all(n.startswith(before) and n.endswith(after) for n in names):
        return None
    return before, [n[len(before) : len(n) - len(after)] for n in names], after


def _even(names: list[str], numbers: list[int]) -> Ordered | None:
    """Return names as they are if their numbers, two at least, rise in even steps, else
    None.
    """
    step, rest = divmod(numbers[-1] - numbers[0], len(numbers) - 1)
    if rest or step <= 0 or numbers != [*range(numbers[0], numbers[-1] + 1, step)]:
        return None
    return Ordered(tuple(names))


def other_name(others: Sequence[str], names: Sequence[str]) -> Finding:
    """Make the warning on names that are written otherwise than those of the other images; its
    figure is their number.

    `others`: the names in question; the first `MAX_NAMES_SHOWN` are named. `names`: all names,
    at least one of them not in `others`; the first such is the example."""
    like = next(name for name in names if name not in others)
    listed = ", ".join(others[:MAX_NAMES_SHOWN])
    cause = f"{listed} {_is(others)} named otherwise than the rest, such as {like}"
    remedy = "frames=PATTERN says which are projections"
    return warning(PlausibilityCode.OTHER_NAME, cause, remedy, figure=float(len(others)))


def duplicate(one: str, other: str) -> Finding:
    """Make the refusal (a finding, not raised) that two files have one number, so that
    the meant one is unknown; its figure is 2.
    """
    cause = f"{one} and {other} have one number: which of them is meant is not known"
    return error(
        PlausibilityCode.DUPLICATE, cause, "allowed: one file a number", figure=2.0
    )


def _is(names: Sequence[str]) -> str:
    if len(names) == 1:
        return "is"
    return "are"


def _keys(names: Sequence[str]) -> dict[str, Key]:
    """Compute sort keys of names: their text without the numbers, and the numbers.

    An ending that begins with a letter (`.tif`) is removed first. Hyphens count as signs
    where that makes the texts of more names equal, points as decimal points where
    `_decimal` decides so. Powers of ten that all names have are written out before.

    Returns:
        Name -> key.
    """
    stems = {name: re.sub(r"\.[A-Za-z]\w*$", "", name) for name in names}
    if all(SCIENTIFIC.search(stem) for stem in stems.values()):
        stems = {
            name: SCIENTIFIC.sub(lambda found: f"{Decimal(found[0]):f}", stem)
            for name, stem in stems.items()
        }
    plain = {
        name: _key(stem, signed=False, decimals=False) for name, stem in stems.items()
    }
    signs = {
        name: _key(stem, signed=True, decimals=False) for name, stem in stems.items()
    }
    # A hyphen that only some names have is a sign; one that all have separates.
    signed = len(_texts(signs)) < len(_texts(plain))
    whole = signs if signed else plain
    decimal = {
        name: _key(stem, signed=signed, decimals=True) for name, stem in stems.items()
    }
    if _decimal(decimal, whole, stems):
        return decimal
    return whole


def _texts(keys: dict[str, Key]) -> set[str]:
    return {_text(key) for key in keys.values()}


def _text(key: Key) -> str:
    """Return a name with # in place of each of its numbers."""
    return "#".join(map(str, key[::2]))


def _numbers(key: Key) -> tuple[float, ...]:
    return tuple(float(number) for number in key[1::2])


def _key(stem: str, *, signed: bool, decimals: bool) -> Key:
    """Split a file's stem into texts and numbers, in turns.

    The first and the last part are texts, perhaps "". A hyphen at the beginning or after
    one of `SIGNED_AFTER` is always a sign; a plus sign likewise, and dropped.

    Args:
        stem: name without its ending.
        signed: a hyphen before any number is its sign; otherwise it stays in the text.
        decimals: a point between digits is a decimal point; otherwise it separates two
            numbers, and is a text of its own.
    """
    parts: list[str | float] = []
    at = 0
    for match in NUMBER.finditer(stem):
        if match.start():
            before = stem[match.start() - 1]
        else:
            before = ""
        sign = match["sign"]
        whole = match["whole"]
        part = match["part"] or ""
        minus = sign and (signed or not before or before in SIGNED_AFTER)
        if decimals:
            value = float(whole + part)
        else:
            value = float(whole)
        parts.append(stem[at : match.start()] + ("" if minus else sign))
        parts.append(-value if minus and sign == "-" else value)
        if part and not decimals:
            parts += [".", float(part[1:])]
        at = match.end()
    return (*parts, stem[at:])


def _decimal(
    decimal: dict[str, Key], whole: dict[str, Key], stems: dict[str, str]
) -> bool:
    """Decide whether points in names are decimal points and not separators.

    If decimal points make more names equal (1.1 and 1.10), only when they make more texts
    equal. Else True if all fractions have one width or none of several digits ends in 0.
    """
    if len(set(decimal.values())) < len(set(whole.values())):
        return len(_texts(decimal)) < len(_texts(whole))
    parts = [
        m["part"][1:] for s in stems.values() for m in NUMBER.finditer(s) if m["part"]
    ]
    if not parts:
        return False
    widths = {len(part) for part in parts}
    return len(widths) == 1 or not any(len(p) > 1 and p.endswith("0") for p in parts)


def _written_otherwise(names: Sequence[str], keys: dict[str, Key]) -> tuple[str, ...]:
    """Return the few names whose text (without numbers) differs from that which most share.

    `names`: in order; `keys`: their sort keys.
    Returns the names, in order; empty unless at least four share one text and the others are at
    most two or `MAX_OTHERS_SHARE` of all.
    """
    texts = Counter(_text(keys[name]) for name in names)
    usual, most = texts.most_common(1)[0] if texts else ("", 0)
    few = [name for name in names if _text(keys[name]) != usual]
    if most < 4 or not 0 < len(few) <= max(2.0, MAX_OTHERS_SHARE * len(names)):
        return ()
    return tuple(few)


def _duplicates(names: Sequence[str], keys: dict[str, Key]) -> Iterator[Finding]:
    """Yield a refusal of the first two names with equal keys, as `7.tif`, `007.tif`."""
    seen: dict[Key, str] = {}
    for name in names:
        key = keys[name]
        if key in seen and _numbers(key):
            yield duplicate(seen[key], name)
            return
        seen[key] = name


def _gaps(names: Sequence[str], keys: dict[str, Key]) -> Iterator[Finding]:
    """Yield at most one warning if numbers are missing between others of one step.

    Nothing for fewer than 4 names, several texts, none or several numbers that vary,
    steps that are not multiples of the median step, or less than `MIN_EVEN_SHARE` of
    steps equal to it. "Gap" is the finding's kind; its figure is the number of missing
    images, and only the first gap is named.

    Args:
        names: in order.
        keys: their sort keys.
    """
    if len(names) < 4 or len({_text(keys[name]) for name in names}) != 1:
        return
    table = np.array([_numbers(keys[name]) for name in names], dtype=np.float64)
    varying = np.flatnonzero(np.ptp(table, axis=0) > 0)
    if len(varying) != 1:
        return
    steps = np.diff(table[:, varying[0]])
    usual = float(np.median(steps))
    wide = np.flatnonzero(steps > 1.5 * usual)
    if usual > 0:
        alike = np.abs(steps / usual - np.round(steps / usual)) < 1e-3
    else:
        alike = steps < 0
    if (
        len(wide)
        and alike.all()
        and (np.abs(steps - usual) < 0.01 * usual).mean() >= MIN_EVEN_SHARE
    ):
        at = int(wide[0])
        lost = int(np.sum(np.round(steps[wide] / usual) - 1))
        cause = (
            f"{lost} {'image is' if lost == 1 else 'images are'} missing between "
            f"{names[at]} and "
            f"{names[at + 1]}{' and elsewhere' if len(wide) > 1 else ''}"
        )
        remedy = "views are taken in the order of the images that are there"
        yield warning(PlausibilityCode.GAP, cause, remedy, figure=float(lost))
