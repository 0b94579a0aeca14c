"""Angles in the lists beside Nikon's .xtekct: `_ctdata.txt` and `.ang`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexdt.library.reading.foreign_parsing import head_text
from flexdt.library.reading.text_formats.nikon_table import NIKON
from flexdt.runtime.files.dataset_folder import Folder
from flexdt.twin.dataset.format_table import Ledger, as_number
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility.stated_figures import (
    ANGLE_TOLERANCE_DEG,
    ANGLE_TOLERANCE_STEPS,
)


def chosen_angles(
    said: Ledger, path: Path, beside: Folder, planned: FloatArray
) -> tuple[FloatArray, Provenance]:
    """Choose between the angles of the lists beside a file and the planned ones.

    A list is taken if it has one angle for each view. Its zero is InitialAngle, because
    some programs count from the first view; it runs the way of AngularStep, because `.ang`
    counts the other way (TIGRE's reader negates the others).

    Args:
        said: what the file states; AngularStep is set aside if it differs from the list.
        path: of the file.
        beside: its folder.
        planned: angles by InitialAngle and AngularStep [deg].

    Returns:
        Angles (n,) [deg], and what became of the lists' values.
    """
    lists = [_angle_list(one) for one in _lists_beside(path, beside)]
    taken = None
    for one in lists:
        if len(one.angles) != len(planned):
            consequence = f"{one.file}: {len(one.angles)} angles, {len(planned)} views"
            one.ledger.set_aside(one.field, f"{consequence}: it is not used")
        elif taken is None:
            taken = one
            one.ledger.use(one.field)
        else:
            _set_aside_if_other(taken, one, planned)
    if taken is None:
        chosen = planned
    else:
        chosen = taken.along(planned)
        steps = _AngleList(planned, "InitialAngle and AngularStep", "AngularStep", said)
        _set_aside_if_other(taken, steps, planned)
    values = Provenance()
    for one in lists:
        values = values.and_also(one.ledger.finish())
        said.warnings += one.ledger.warnings
    return chosen, values


@dataclass(frozen=True, eq=False)
class _AngleList:
    """Angles of all views [deg] that one place states: its name, field and ledger."""

    angles: FloatArray
    file: str
    field: str
    ledger: Ledger

    def along(self, planned: FloatArray) -> FloatArray:
        """Return the angles from the planned first one on, in the planned sense."""
        turned = np.unwrap(self.angles, period=360.0)
        way = np.sign(turned[-1] - turned[0]) * np.sign(planned[-1] - planned[0])
        return np.asarray(planned[0] + (turned - turned[0]) * (way or 1.0))


def _set_aside_if_other(
    taken: _AngleList, other: _AngleList, planned: FloatArray
) -> None:
    """Set angles aside that differ from those that were taken by more than an encoder's
    error (`ANGLE_TOLERANCE_DEG`, `ANGLE_TOLERANCE_STEPS`).
    """
    off = taken.along(planned) - other.along(planned)
    off = np.abs((off + 180.0) % 360.0 - 180.0)
    step = float(np.median(np.abs(np.diff(planned)))) if len(planned) > 1 else 0.0
    worst = int(np.argmax(off))
    if off[worst] <= max(ANGLE_TOLERANCE_DEG, ANGLE_TOLERANCE_STEPS * step):
        return
    ours, theirs = taken.along(planned)[worst], other.along(planned)[worst]
    other.ledger.set_aside(
        other.field,
        f"the angle of view {worst} is {ours:.5g} deg by {taken.file} and {theirs:.5g} deg "
        f"by {other.file}; {taken.file} is taken",
    )


def _lists_beside(path: Path, beside: Folder) -> list[Path]:
    """List the files with angles beside a .xtekct file, the winner first: `_ctdata.txt`,
    with or without the scan's name before it, then NAME.ang, or the only .ang.
    """
    names = beside.in_order
    measured = [n for n in names if n.lower().endswith("_ctdata.txt")]
    planned = [n for n in names if n.lower().endswith(".ang")]
    found = []
    for several, ending in ((measured, "_ctdata.txt"), (planned, ".ang")):
        own = [n for n in several if n.lower() in (path.stem.lower() + ending, ending)]
        found += own[:1] or (several if len(several) == 1 else [])
    return [path.parent / name for name in found]


def _angle_list(path: Path) -> _AngleList:
    """Read a list of angles, with every value entered in a ledger.

    A line of it is the view's number, its angle [deg] and, in `_ctdata.txt`, its time;
    other lines are heads. Lines are taken in the order of their numbers.

    Args:
        path: of the file.
    """
    kind = "_ctdata.txt" if path.name.lower().endswith("_ctdata.txt") else ".ang"
    ledger = Ledger(NIKON, str(path))
    rows: list[tuple[float, float]] = []
    times = 0
    heads: list[str] = []
    for line in head_text(path).splitlines():
        words = re.split(r"[\s;:]+", line.strip())
        numbers = [as_number(word) for word in words]
        if len(words) < 2 or not np.isfinite(numbers[:2]).all():
            heads = words
        elif heads[:1] == ["Projs"]:
            names = [re.sub(r"\(.*", "", word) for word in heads]
            pairs = zip(names, words, strict=False)
            ledger.state_all((f"{kind}/{name}", value) for name, value in pairs)
        else:
            rows.append((numbers[0], numbers[1]))
            times += len(numbers) > 2
    angles = np.array([angle for _, angle in sorted(rows, key=lambda row: row[0])])
    name = f"{kind}/Angle"
    ends = f", {angles[0]:g} to {angles[-1]:g} deg" if len(angles) else ""
    ledger.state(name, f"{len(angles)} angles{ends}")
    if times:
        ledger.state(f"{kind}/Time", f"{times} times")
    return _AngleList(angles, path.name, name, ledger)
