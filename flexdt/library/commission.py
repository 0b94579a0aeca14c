"""`flexdt commission` without its command line: a machine and a profile from folders of
past scans, with their contradictions.

The machine is the shipped one that the texts name, with the signs and rates of the texts,
fitted to the executed scripts; see `flexdt.twin.commissioning`. A scan that cannot be
read is no error: it is listed as a question.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from flexdt.library import machines
from flexdt.library.calibration.align_dataset import align_dataset
from flexdt.library.failure import CommandError
from flexdt.library.reading.folders import load_dataset, read_settings
from flexdt.library.report_page import heading, page, table
from flexdt.runtime.files.dataset_folder import list_folder, read_image, read_text
from flexdt.twin import commissioning as tells
from flexdt.twin.collision.home_check import check_home
from flexdt.twin.commissioning import PastScan, Question
from flexdt.twin.dataset import rebuild
from flexdt.twin.dataset.xre_reading import parse_xre
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import ERROR, Finding, Findings, Place
from flexdt.twin.machine import description as d
from flexdt.twin.machine.fitted_machine import fitted_text
from flexdt.twin.script.executed_log import Executed
from flexdt.twin.script.grammar import own_name
from flexdt.twin.script.log_fit import Fit, fit_machine
from flexdt.twin.script.parse import read_script

MAX_NEXT_SCANS: Final = 3
"""Largest number of proposed scans."""
MIN_DURATIONS: Final = 3
"""Durations of a kind of command from which its range is estimated (`docs/machine-fit.md`)."""
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
Table = tuple[Sequence[str], list[Sequence[Any]]]


class Commissioned(NamedTuple):
    """The result of commissioning: the fitted machine and its file, `fit` of the executed
    scripts (None without any), the scans with the oldest first, zero offsets,
    contradictions and questions.
    """

    machine: d.Machine
    text: str
    fit: Fit | None
    scans: Sequence[PastScan]
    offsets: tells.ZeroOffsets
    findings: Findings
    questions: Sequence[Question]

    def tables(self, out: Path) -> dict[str, Table]:
        """Make the report's tables.

        Args:
            out: the folder that the commands in them name.

        Returns:
            Title -> head and rows: scans, axes, zero_offsets, disagreements, not_judged,
            and next, the at most `MAX_NEXT_SCANS` scans that settle most questions, with
            their commands.
        """
        votes = Counter(q.settled_by for q in self.questions if q.settled_by)
        sod = (
            next((s.settings.sod_mm for s in self.scans[::-1] if s.settings), None)
            or 1000.0
        )
        files = f"--machine {out / 'machine.toml'} --profile {out / 'profile.toml'}"
        make = f"flexdt script new {files} --out next.txt --kind "
        columns = self.offsets.columns
        return {
            "scans": (
                (
                    "scan",
                    "date",
                    "executed_lines",
                    "images",
                    "axis_column_px",
                    "fitted",
                    "sigma",
                ),
                [
                    (
                        s.name,
                        s.date and s.date.isoformat(),
                        len(s.log),
                        s.images,
                        *columns.get(s.name, (None,) * 3),
                    )
                    for s in self.scans
                ],
            ),
            "axes": (
                ("axis", "lower", "upper", "max_speed", "max_acceleration", "source"),
                [
                    (
                        n,
                        a.lower,
                        a.upper,
                        a.max_speed,
                        a.max_acceleration,
                        a.source or "as shipped",
                    )
                    for n, a in self.machine.axes.items()
                ],
            ),
            "zero_offsets": (
                ("offset", *tells.Line._fields),
                [(name, *line) for name, line in self.offsets.lines.items()],
            ),
            "disagreements": (
                ("about", "text"),
                [(str(one.place), one.text) for one in self.findings],
            ),
            "not_judged": (Question._fields, [*self.questions]),
            "next": (
                ("scan", "settles", "command"),
                [
                    (
                        NEXT_SCANS[kind][0],
                        n,
                        make + NEXT_SCANS[kind][1].format(sod=NEARER_SOD_RATIO * sod),
                    )
                    for kind, n in votes.most_common(MAX_NEXT_SCANS)
                ],
            ),
        }

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
    folders: Sequence[Path], traffic: Path | None, read_log: ReadLog
) -> Commissioned:
    """Estimate a machine and its profile from past scans: rates and signs from their
    texts, times from executed scripts, zero offsets from alignments.

    The machine to begin with is the shipped one that most texts name; else the one whose
    motors have the limits of an executed script; else the FleX-ray. Where no text names
    one, that is a question; so are limits and times that no executed script has (fewer
    than `MIN_DURATIONS` commands of a kind). Scans are sorted by date, those without one
    last; a folder given twice counts once.

    Args:
        folders: of scans, as the scanner or a twin writes them.
        traffic: a recording of `flexdt follow`, or a log; lines that a folder has too
            count once.
        read_log: reads an executed script or a recording.

    Returns:
        Machine, profile, findings, and questions that a person has to answer.

    Raises:
        CommandError: no folder holds anything of a scan, or they are of several scanners.
        TwinError: there is no such folder.
    """
    open_questions = list[Question]()
    ask = open_questions.append
    read = [_texts(folder, ask) for folder in dict.fromkeys(folders)]
    known = [d.builtin_machine(name) for name in d.builtin_machines()]
    named = [
        m.name
        for s in read
        if s.settings and (m := rebuild.named_machine(s.settings, known))
    ]
    shipped = machines.machine(Counter(named).most_common(1)[0][0] if named else None)
    if not named:
        by_limits = [
            one
            for s in read
            if (
                one := tells.scanner_of(_script(s, shipped, read_log, _nothing), known)
            ).machine
        ]
        if by_limits:
            taken = f"{by_limits[0].machine} is taken by {by_limits[0].by}"
        else:
            taken = "the FleX-ray is taken"
        ask(Question("which scanner it is", f"no text names one that ships; {taken}"))
        shipped = machines.machine(by_limits[0].machine if by_limits else None)
    scans = sorted(
        (_script(s, shipped, read_log, ask) for s in read),
        key=lambda s: s.date or datetime.max,
    )
    if traffic is not None:
        log = read_log(traffic, shipped)
        commands = [x.command for x in log]
        if all([x.command for x in s.log] != commands for s in scans):
            scans.append(PastScan(str(traffic), log=log))
    if words := tells.other_scanners(scans, known):
        raise CommandError(
            f"the folders are of several scanners; allowed: those of one. {words}"
        )
    if not any(s.settings or s.log or s.images for s in scans):
        where = ", ".join(map(str, folders))
        raise CommandError(
            f"{where}: no settings text, executed script or radiograph of a scan"
        )
    machine, text, fit = _fit_machine(scans, shipped)
    scans = [_with_alignment(s, machine, ask) for s in scans]
    offsets = tells.zero_offsets(scans, machine, d.profile_of(shipped))
    unseen = [f"limits of {n}" for n in machine.axes if fit is None or n not in fit.axes]
    if fit:
        times = {k: x.n for k, x in machine.timing.spread.items()}
    else:
        times = {}
    unseen += [
        f"time of {k}" for k in machine.timing.kinds if times.get(k, 0) < MIN_DURATIONS
    ]
    why = f"no executed script tells it, or fewer than {MIN_DURATIONS} commands of one"
    rest = [
        *offsets.questions,
        *(Question(subject, why, "recorded") for subject in unseen),
    ]
    findings = Findings(
        (
            *_machine_errors(machine, offsets.profile),
            *tells.contradictions(scans, shipped, machine),
            *offsets.findings,
        )
    )
    questions = [*open_questions, *rest]
    return Commissioned(machine, text, fit, scans, offsets, findings, questions)


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


def _nothing(question: Question) -> None:
    """Ignore questions: scripts are read a second time, with the machine to which they
    belong.
    """


def _texts(folder: Path, ask: Callable[[Question], None]) -> PastScan:
    """Read a scan's settings texts, the names of its images, and the shape of the first
    one.

    In the order: second text, first text, first image; at the first of them that cannot
    be read the rest is left out.

    Args:
        folder: of the scan.
        ask: takes each warning, and a text that cannot be read, as a question.

    Returns:
        The scan with the readable parts.
    """
    content = list_folder(folder)
    warnings = list[str]()
    scan = PastScan(str(folder), images=len(content.projections))
    try:
        if content.xre_settings is not None:
            xre = parse_xre(read_text(folder / content.xre_settings))
            start = xre.text("Scan info", "Start") or ""
            if start:
                date = datetime.fromisoformat(start[:19])
            else:
                date = None
            scan = replace(scan, second=xre.settings, date=date)
        settings = read_settings(content, warnings)
        if settings is not None:
            scan = replace(scan, settings=settings, date=settings.started or scan.date)
        if content.projections:
            first = read_image(folder / next(iter(content.projections.values())))
            scan = replace(scan, shape=first.shape)
    except ValueError as error:  # of ours, or a date's
        warnings.append(str(error))
    for text in warnings:
        ask(Question(scan.name, text))
    return scan


def _script(
    scan: PastScan, machine: d.Machine, read_log: ReadLog, ask: Callable[[Question], None]
) -> PastScan:
    """Add the executed script to a scan, or else the script that was submitted.

    The folder's .txt, .tsv and .log files but the settings texts are tried in the order
    of their names; the first executed script ends the search.

    Args:
        scan: whose folder is searched.
        machine: for the names of motors.
        read_log: reads an executed script.
        ask: takes the errors of files that are neither, as questions.

    Returns:
        The scan, with log and commands, commands alone, or unchanged.
    """
    content = list_folder(Path(scan.name))
    for name in sorted(content.names - {content.scan_settings, content.xre_settings}):
        path = content.path / name
        if path.suffix.lower() in (".txt", ".tsv", ".log"):
            try:
                log = read_log(path, machine)
                return replace(scan, log=log, commands=tuple(x.command for x in log))
            except CommandError as error:
                script, problems = read_script(path.read_bytes())
                if not script.commands or problems.errors:
                    ask(Question(scan.name, "; ".join(error.lines)))
                else:
                    scan = replace(scan, commands=script.commands)
    return scan


def _fit_machine(
    scans: Sequence[PastScan], shipped: d.Machine
) -> tuple[d.Machine, str, Fit | None]:
    """Fit a machine to the texts' signs and rates and to the executed scripts.

    The file's text is the shipped one with the changed axes. Rotations keep their rates;
    executed lines of other components count without a motor.

    Args:
        scans: past scans.
        shipped: the machine to begin with.

    Returns:
        The machine, the text of its file, and the fit; None without executed scripts.
    """
    turning = shipped.geometry.get("angle", {})
    axes = {
        n: a if n in turning else _with_rates(a, n, scans, shipped)
        for n, a in shipped.axes.items()
    }
    machine = shipped.model_copy(update={"axes": axes})
    fit = None
    logs = [
        [
            x
            if own_name(getattr(x.command, "component", ""), axes) in axes
            else replace(x, motor=None)
            for x in s.log
        ]
        for s in scans
        if s.log
    ]
    if logs:
        names = ", ".join(Path(s.name).name for s in scans if s.log)
        fit = fit_machine(
            logs, machine, f"measured: {names} ({sum(map(len, logs))} lines)"
        )
        machine = fit.machine
    changed = [n for n, axis in machine.axes.items() if axis != shipped.axes[n]]
    text = fitted_text(
        d.builtin_machine_text(shipped.name), machine, changed, machines.parsed
    )
    return machine, text, fit


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
    scan: PastScan, machine: d.Machine, ask: Callable[[Question], None]
) -> PastScan:
    """Add the poses of a past scan, and its alignment without a phantom.

    A scan without radiographs, or whose alignment determines no axis, counts as failed.
    The zero offsets are the scan's own profile.

    Args:
        scan: its texts and profile.
        machine: that made it.
        ask: called with the failure as a question.

    Returns:
        The scan with poses and alignment, as far as both succeeded.
    """
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
        return replace(scan, aligned=alignment)
    except TwinError as error:
        ask(Question(scan.name, error.message, "ordinary" if scan.profile else ""))
        return scan


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
            (MACHINE_FILE, found.text),
            (PROFILE_FILE, "\n".join(lines) + "\n"),
            ("commission.json", json.dumps(found.document(out), indent=1) + "\n"),
            ("report.html", page("Commissioning", body)),
        ):
            (part / name).write_text(text, encoding="utf-8")
        machines.profile(part / PROFILE_FILE, machines.machine(part / MACHINE_FILE))
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
