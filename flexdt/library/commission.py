"""`flexdt commission` without its command line: a machine and a profile from past scans,
with their contradictions.

A past scan is a folder, an executed script or a recording of one. The machine is the one that
was named, or the shipped one that the texts name, with the signs and rates of the texts, fitted
to the executed scripts; see `flexdt.twin.commissioning`. A folder that cannot be read is no
error: it is listed as a question.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from flexdt.library import machines
from flexdt.library.calibration.align_dataset import align_dataset
from flexdt.library.failure import CommandError
from flexdt.library.reading.folders import load_dataset, read_settings
from flexdt.library.report_page import heading, page, table
from flexdt.runtime.files.dataset_folder import list_folder, read_image, read_text
from flexdt.runtime.files.limited_files import limited_bytes, limited_text
from flexdt.twin import commissioning as tells
from flexdt.twin.collision.home_check import check_home
from flexdt.twin.commissioning import PastScan, Question
from flexdt.twin.dataset import rebuild
from flexdt.twin.dataset.xre_reading import parse_xre
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import ERROR, Finding, Findings, Place
from flexdt.twin.machine import description as d
from flexdt.twin.machine.fitted_machine import fitted_text
from flexdt.twin.script.commands import Command
from flexdt.twin.script.executed_log import Executed
from flexdt.twin.script.grammar import own_name
from flexdt.twin.script.log_fit import Fit, fit_machine
from flexdt.twin.script.parse import read_script

MAX_NEXT_SCANS: Final = 3
"""Largest number of proposed scans."""
MIN_DURATIONS: Final = 3
"""Durations of a kind of command from which its range is estimated (`docs/commission.md`)."""
NEXT_SCANS: Final = {
    "ordinary": ("a full turn of any object with structure", "fly --frames 721"),
    "magnified": (
        "the same at another magnification",
        "fly --frames 721 --sod {sod:.0f}",
    ),
    "later": ("the same on another day", "fly --frames 721"),
    "beads": ("a bead phantom at two distances, then `flexdt calibrate`", "calibration"),
    "recorded": (
        "a scan with `flexdt follow ADDRESS --record FILE` beside it",
        "calibration",
    ),
}
"""Kind of scan -> its description, and the options of `flexdt script new --kind`."""
NEARER_SOD_RATIO: Final = 0.6
"""Source-object distance of the scan at another magnification over its own: clearly
different, and the sample still clears the source in most scanners."""
MACHINE_FILE: Final = "machine.toml"
PROFILE_FILE: Final = "profile.toml"
ReadLog = Callable[[Path, d.Machine], tuple[Executed, ...]]
Table = tuple[Sequence[str], Sequence[Sequence[Any]]]
T = TypeVar("T")


class Base(NamedTuple):
    """The machine that a fit begins with.

    Attributes:
        machine: gives what scans do not tell.
        text: of its file.
        file: where its meshes are.
        named: whether a person named it; then a motor that it lacks is an error.
    """

    machine: d.Machine
    text: str
    file: str
    named: bool

    @classmethod
    def of(cls, word: str | None, named: bool = True) -> Base:
        """Read a machine by shipped name or file; None is the FleX-ray.

        Raises:
            MachineFileError: the file is invalid.
            UnknownNameError: neither a file nor a shipped name.
        """
        name = word or machines.DEFAULT_MACHINE
        machine = machines.machine(name)
        if machines.is_file(name):
            text = limited_text(Path(name), "toml")
        else:
            text = d.builtin_machine_text(name)
        return cls(machine, text, name, named)


class Fitted(NamedTuple):
    """A machine, the text of its file, and its fit to executed scripts (None without any)."""

    machine: d.Machine
    text: str
    fit: Fit | None

    def tables(self) -> dict[str, Table]:
        """Make the report's tables of the machine: title -> head and rows of axes and times."""
        limits = ("axis", "lower", "upper", "max_speed", "max_acceleration")
        axes = [
            (
                name,
                axis.lower,
                axis.upper,
                axis.max_speed,
                axis.max_acceleration,
                axis.unit,
                axis.source or "as shipped",
            )
            for name, axis in self.machine.axes.items()
        ]
        timing = self.machine.timing
        times: list[Sequence[Any]] = []
        for kind in timing.kinds:
            spread = timing.spread.get(kind)
            measured: tuple[Any, ...] = (None, None, None, "assumed")
            if spread is not None:
                measured = (spread.p5_s, spread.p95_s, spread.n, "measured")
            times.append((kind, timing.seconds(kind), *measured))
        return {
            "axes": ((*limits, "unit", "source"), axes),
            "times": (("command", "median_s", "p5_s", "p95_s", "n", "source"), times),
        }


class Commissioned(NamedTuple):
    """The result of commissioning: the fitted machine, the scans with the oldest first, zero
    offsets, contradictions and questions.
    """

    fitted: Fitted
    scans: Sequence[PastScan]
    offsets: tells.ZeroOffsets
    findings: Findings
    questions: Sequence[Question]

    @property
    def machine(self) -> d.Machine:
        """The fitted machine."""
        return self.fitted.machine

    @property
    def fit(self) -> Fit | None:
        """Its fit to executed scripts; None without any."""
        return self.fitted.fit

    def tables(self, out: Path) -> dict[str, Table]:
        """Make the report's tables.

        Args:
            out: the folder that the commands in them name.

        Returns:
            Title -> head and rows: scans, axes, times, zero_offsets, disagreements,
            not_judged, and next.
        """
        columns = self.offsets.columns
        scans = [
            (
                s.name,
                s.date and s.date.isoformat(),
                len(s.log),
                s.images,
                *columns.get(s.name, (None,) * 3),
            )
            for s in self.scans
        ]
        head = ("scan", "date", "executed_lines", "images")
        return {
            "scans": ((*head, "axis_column_px", "fitted", "sigma"), scans),
            **self.fitted.tables(),
            "zero_offsets": (
                ("offset", *tells.Line._fields),
                [(name, *line) for name, line in self.offsets.lines.items()],
            ),
            "disagreements": (
                ("about", "text"),
                [(str(one.place), one.text) for one in self.findings],
            ),
            "not_judged": (Question._fields, [*self.questions]),
            "next": (("scan", "settles", "command"), self._next_scans(out)),
        }

    def _next_scans(self, out: Path) -> list[Sequence[Any]]:
        """List the at most `MAX_NEXT_SCANS` scans that settle most questions: their
        description, how many each settles, and its command with the files in `out`.
        """
        votes = Counter(q.settled_by for q in self.questions if q.settled_by)
        stated = [s.settings.sod_mm for s in self.scans if s.settings]
        sod = (stated[-1] if stated else None) or 1000.0
        files = f"--machine {out / MACHINE_FILE} --profile {out / PROFILE_FILE}"
        make = f"flexdt script new {files} --out next.txt --kind "
        rows: list[Sequence[Any]] = []
        for kind, settled in votes.most_common(MAX_NEXT_SCANS):
            description, options = NEXT_SCANS[kind]
            words = make + options.format(sod=NEARER_SOD_RATIO * sod)
            rows.append((description, settled, words))
        return rows

    def document(self, out: Path) -> dict[str, object]:
        """Make `commission.json`: the tables, each row an object, and the fit.

        Args:
            out: the folder that its commands name.

        Returns:
            machine, profile, fit, and a list of rows for each title of `tables`.
        """
        rows = {
            title: [dict(zip(head, row, strict=True)) for row in rows]
            for title, (head, rows) in self.tables(out).items()
        }
        return {
            "machine": self.machine.name,
            **rows,
            "profile": self.offsets.profile.model_dump(),
            "fit": None if self.fit is None else self.fit.to_dict(),
        }


def commission(
    sources: Sequence[Path], read_log: ReadLog, base: str | None = None
) -> Commissioned:
    """Estimate a machine and its profile from past scans: rates and signs from their
    texts, times from executed scripts, zero offsets from alignments.

    Scans are sorted by date, those without one last; one given twice counts once, as does an
    executed script that a folder has, too. Limits and times that no executed script has
    (fewer than `MIN_DURATIONS` commands of a kind) are questions.

    Args:
        sources: folders of scans, as the scanner or a twin writes them, executed scripts,
            and recordings of `flexdt follow`.
        read_log: reads an executed script or a recording.
        base: name or file of the machine to begin with; None: the one that the scans show.

    Returns:
        Machine, profile, findings, and questions that a person has to answer.

    Raises:
        CommandError: nothing holds anything of a scan, they are of several scanners, or a
            file is no executed script.
        TwinError: there is no such folder.
        MachineFileError: `base` is invalid, or lacks a motor of an executed script.
    """
    read, unread = _each(dict.fromkeys(sources), _with_texts)
    known = [d.builtin_machine(name) for name in d.builtin_machines()]
    start, doubts = _base(base, read, known, read_log)
    scans, unclear = _each(read, lambda s: _with_script(s, start.machine, read_log))
    scans = sorted(_without_copies(scans), key=lambda s: s.date or datetime.max)
    _require_one_scanner(scans, known)
    if not any(s.settings or s.log or s.images for s in scans):
        where = ", ".join(map(str, sources))
        raise CommandError(
            f"{where}: no settings text, executed script or radiograph of a scan"
        )
    fitted = fit_scans(scans, start, start.file)
    scans, unaligned = _each(scans, lambda s: _with_alignment(s, fitted.machine))
    offsets = tells.zero_offsets(scans, fitted.machine, d.profile_of(start.machine))
    findings = Findings(
        (
            *_machine_errors(fitted.machine, offsets.profile),
            *tells.contradictions(scans, start.machine, fitted.machine),
            *offsets.findings,
        )
    )
    questions = [
        *unread,
        *doubts,
        *unclear,
        *unaligned,
        *offsets.questions,
        *_unrecorded(fitted),
    ]
    return Commissioned(fitted, scans, offsets, findings, questions)


def _each(
    things: Iterable[T], read: Callable[[T], tuple[PastScan, list[Question]]]
) -> tuple[list[PastScan], list[Question]]:
    """Take a step for each scan; returns the scans, and all questions in their order."""
    done = [read(thing) for thing in things]
    return [scan for scan, _ in done], [question for _, own in done for question in own]


def _base(
    word: str | None,
    scans: Sequence[PastScan],
    known: Sequence[d.Machine],
    read_log: ReadLog,
) -> tuple[Base, list[Question]]:
    """Choose the machine to begin with: the one that was named, or the shipped one that most
    texts name, or whose motors have the limits of an executed script; else the FleX-ray.

    Args:
        word: that was named; None for none.
        scans: with their texts.
        known: machines that ship.
        read_log: reads an executed script.

    Returns:
        The machine, and a question where neither a person nor a text names it.
    """
    if word is not None:
        return Base.of(word), []
    named = [
        machine.name
        for s in scans
        if s.settings and (machine := rebuild.named_machine(s.settings, known))
    ]
    if named:
        return Base.of(Counter(named).most_common(1)[0][0], named=False), []
    default = machines.machine()
    found = [
        tells.scanner_of(_with_script(s, default, read_log)[0], known) for s in scans
    ]
    by_limits = next((one for one in found if one.machine), None)
    taken = "the FleX-ray is taken"
    if by_limits is not None:
        taken = f"{by_limits.machine} is taken by {by_limits.by}"
    why = f"no text names one that ships; {taken}"
    taken_name = None if by_limits is None else by_limits.machine
    return Base.of(taken_name, named=False), [Question("which scanner it is", why)]


def _without_copies(scans: Sequence[PastScan]) -> list[PastScan]:
    """Leave out executed scripts and recordings whose commands a folder has, too, or an
    earlier one of them.
    """
    kept: list[PastScan] = []
    files = {scan.name for scan in scans if Path(scan.name).is_file()}
    seen = [_commands(scan) for scan in scans if scan.name not in files]
    for scan in scans:
        if scan.name in files:
            if _commands(scan) in seen:
                continue
            seen.append(_commands(scan))
        kept.append(scan)
    return kept


def _commands(scan: PastScan) -> list[Command]:
    return [x.command for x in scan.log]


def _require_one_scanner(scans: Sequence[PastScan], known: Sequence[d.Machine]) -> None:
    """Refuse scans of several scanners.

    Raises:
        CommandError: names those of each.
    """
    words = tells.other_scanners(scans, known)
    if words:
        raise CommandError(
            f"the folders are of several scanners; allowed: those of one. {words}"
        )


def _unrecorded(fitted: Fitted) -> Iterator[Question]:
    """Yield a question for the limits of each axis, and the time of each kind of command,
    that executed scripts do not tell.
    """
    fit = fitted.fit
    why = f"no executed script tells it, or fewer than {MIN_DURATIONS} commands of one"
    for name in fitted.machine.axes:
        if fit is None or name not in fit.axes:
            yield Question(f"limits of {name}", why, "recorded")
    timing = fitted.machine.timing
    times = {} if fit is None else {kind: x.n for kind, x in timing.spread.items()}
    for kind in timing.kinds:
        if times.get(kind, 0) < MIN_DURATIONS:
            yield Question(f"time of {kind}", why, "recorded")


def _machine_errors(machine: d.Machine, profile: d.Profile) -> Iterator[Finding]:
    """Yield the error that `flexdt machine check` would raise on the machine (it cannot
    stand at home), if there is one.
    """
    try:
        check_home(machine, profile, MACHINE_FILE)
    except TwinError as error:
        yield Finding(
            tells.CommissionCode.MACHINE_REFUSED,
            ERROR,
            f"`flexdt machine check` refuses it: {error.message}",
            place=Place(name=MACHINE_FILE),
        )


def _with_texts(path: Path) -> tuple[PastScan, list[Question]]:
    """Read a scan's settings texts, the names of its images, and the shape of the first
    one.

    In the order: second text, first text, first image; at the first of them that cannot
    be read the rest is left out. A file, which is an executed script, has none.

    Args:
        path: folder of the scan, or file.

    Returns:
        The scan with the readable parts; and each warning, and a text that cannot be read,
        as a question.
    """
    if path.is_file():
        return PastScan(str(path)), []
    content = list_folder(path)
    warnings = list[str]()
    scan = PastScan(str(path), images=len(content.projections))
    try:
        if content.xre_settings is not None:
            xre = parse_xre(read_text(path / content.xre_settings))
            start = xre.text("Scan info", "Start") or ""
            date = datetime.fromisoformat(start[:19]) if start else None
            scan = replace(scan, second=xre.settings, date=date)
        settings = read_settings(content, warnings)
        if settings is not None:
            scan = replace(scan, settings=settings, date=settings.started or scan.date)
        if content.projections:
            first = read_image(path / next(iter(content.projections.values())))
            scan = replace(scan, shape=first.shape)
    except ValueError as error:  # of ours, or a date's
        warnings.append(str(error))
    return scan, [Question(scan.name, text) for text in warnings]


def _with_script(
    scan: PastScan, machine: d.Machine, read_log: ReadLog
) -> tuple[PastScan, list[Question]]:
    """Add the executed script to a scan, or else the script that was submitted.

    The folder's .txt, .tsv and .log files but the settings texts are tried in the order
    of their names; the first executed script ends the search.

    Args:
        scan: whose folder is searched, or which is an executed script itself.
        machine: for the names of motors.
        read_log: reads an executed script.

    Returns:
        The scan, with log and commands, commands alone, or unchanged; and the errors of
        files that are neither, as questions.

    Raises:
        CommandError: the scan is a file, and no executed script.
    """
    path = Path(scan.name)
    if path.is_file():
        return replace(scan, log=read_log(path, machine)), []
    content = list_folder(path)
    questions: list[Question] = []
    for name in sorted(content.names - {content.scan_settings, content.xre_settings}):
        file = content.path / name
        if file.suffix.lower() not in (".txt", ".tsv", ".log"):
            continue
        try:
            log = read_log(file, machine)
        except CommandError as error:
            script, problems = read_script(limited_bytes(file, "log"))
            if not script.commands or problems.errors:
                questions.append(Question(scan.name, "; ".join(error.lines)))
            else:
                scan = replace(scan, commands=script.commands)
            continue
        commands = tuple(x.command for x in log)
        return replace(scan, log=log, commands=commands), questions
    return scan, questions


def fit_scans(scans: Sequence[PastScan], base: Base, file: str) -> Fitted:
    """Fit a machine to the texts' signs and rates and to the executed scripts.

    The file's text is that of the base with the changed axes and times. Rotations keep their
    rates. Executed lines of components that a base lacks which nobody named count without a
    motor.

    Args:
        scans: past scans, the oldest first.
        base: the machine to begin with.
        file: path of a machine file next to which meshes are.

    Returns:
        The machine, the text of its file, and the fit; None without executed scripts.

    Raises:
        MachineFileError: the base was named and lacks a motor, or its file cannot be edited.
    """
    turning = base.machine.geometry.get("angle", {})
    axes = {
        n: a if n in turning else _with_rates(a, n, scans, base.machine)
        for n, a in base.machine.axes.items()
    }
    machine = base.machine.model_copy(update={"axes": axes})
    executed = [s for s in scans if s.log]
    fit = None
    if executed:
        names = ", ".join(Path(s.name).name for s in executed)
        count = sum(len(s.log) for s in executed)
        source = f"measured: {names.encode('utf-8', 'replace').decode()} ({count} lines)"
        logs = [s.log if base.named else _of_axes(s.log, axes) for s in executed]
        fit = fit_machine(logs, machine, source)
        machine = fit.machine
    changed = [
        n
        for n, axis in machine.axes.items()
        if axis != base.machine.axes[n] or (fit is not None and n in fit.axes)
    ]
    text = fitted_text(
        base.text, machine, changed, lambda text, _: machines.parsed(text, file)
    )
    return Fitted(machine, text, fit)


def _of_axes(log: Sequence[Executed], axes: Mapping[str, d.Axis]) -> tuple[Executed, ...]:
    """Return the lines of a log, those of other components than `axes` without a motor."""
    return tuple(
        x
        if own_name(getattr(x.command, "component", ""), axes) in axes
        else replace(x, motor=None)
        for x in log
    )


def _with_rates(
    axis: d.Axis, name: str, scans: Sequence[PastScan], machine: d.Machine
) -> d.Axis:
    """Return an axis with the rates of the last settings text, and the sign of most of
    them.

    Maximum rates are raised to those stated. The sign is compared only where the script
    moved by more than 1 mm or deg, and the text agrees within `MATCH_MM`. Its source
    names the texts; an axis without a difference is returned unchanged.

    Args:
        axis: of the shipped machine.
        name: its motor.
        scans: past scans.
        machine: of the axis.
    """
    stated_motors = [
        (s, m) for s in scans if s.settings and (m := s.settings.motors.get(name))
    ]
    signs = Counter[int]()
    for scan, motor in stated_motors:
        target = tells.scripted(scan, machine).get(name, 0.0)
        if abs(target) > 1.0 and abs(abs(target) - abs(motor.value)) <= rebuild.MATCH_MM:
            signs[1 if target * motor.value > 0 else -1] += 1
    changes: dict[str, Any]
    if signs:
        changes = {"settings_sign": signs.most_common(1)[0][0]}
    else:
        changes = {}
    for rate in ("speed", "acceleration"):
        values = [v for _, m in stated_motors if (v := getattr(m, rate))]
        if values:
            most = max(values[-1], getattr(axis, f"max_{rate}"))
            changes |= {rate: values[-1], f"max_{rate}": most}
    stated = axis.model_copy(update=changes)
    source = f"rates: settings texts, n = {len(stated_motors)}; limits as shipped"
    if stated == axis:
        return axis
    return stated.model_copy(update={"source": source})


def _with_alignment(
    scan: PastScan, machine: d.Machine
) -> tuple[PastScan, list[Question]]:
    """Add the poses of a past scan, and its alignment without a phantom.

    A scan without radiographs, or whose alignment determines no axis, counts as failed.
    The zero offsets are the scan's own profile. An executed script alone is not expected to
    have either.

    Args:
        scan: its texts and profile.
        machine: that made it.

    Returns:
        The scan with poses and alignment, as far as both succeeded; and the failure as a
        question.
    """
    if Path(scan.name).is_file():
        return scan, []
    try:
        scan = tells.standing(scan, machine)
        if not scan.images:
            raise TwinError("it has no radiographs")
        data = load_dataset(
            scan.name, machine=machine, profile=scan.profile, ignore_document=True
        )
        alignment = align_dataset(data).alignment
        if alignment.offsets is None:
            raise TwinError(f"align: {alignment.refused['axis_column_px']}")
    except TwinError as error:
        kind = "ordinary" if scan.profile else ""
        return scan, [Question(scan.name, error.message, kind)]
    return replace(scan, aligned=alignment), []


def write_commission(found: Commissioned, out: Path) -> None:
    """Write `machine.toml`, `profile.toml`, `commission.json` and `report.html` into a
    new folder, which appears when all files are complete and both TOML files are read
    back; after an error nothing is left.

    Args:
        found: the result of `commission`.
        out: the folder.

    Raises:
        MachineFileError: a written file is invalid.
        OSError: it cannot be written.
    """
    part = out.absolute().with_name(f".{out.absolute().name}.part.{os.getpid()}")
    profile = found.offsets.profile.model_dump(exclude={"priors"})
    lines = [
        f"{key} = {json.dumps(value, ensure_ascii=False)}"
        for key, value in profile.items()
    ]
    body: list[str] = [heading("What past scans tell of the machine")]
    for title, (head, rows) in found.tables(out).items():
        body += [heading(title, level=2), table(head, rows)]
    try:
        part.mkdir(parents=True)
        for name, text in (
            (MACHINE_FILE, found.fitted.text),
            (PROFILE_FILE, "\n".join(lines) + "\n"),
            ("commission.json", json.dumps(found.document(out), indent=1) + "\n"),
            ("report.html", page("Commissioning", body)),
        ):
            (part / name).write_text(text, encoding="utf-8")
        machines.profile(part / PROFILE_FILE, machines.machine(part / MACHINE_FILE))
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
