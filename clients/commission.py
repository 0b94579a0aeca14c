"""`flexdt commission` without its command line: folders of past scans in; a machine, a profile and
what contradicts what out.

The machine is the one that ships and that the texts name, with the signs and rates of the texts,
fitted to the executed scripts; `flexdt.twin.commissioning` says the rest. A scan that cannot be
read is no error: it is named among what could not be judged.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final

from flexdt import machines
from flexdt.clients.calibration.align_dataset import align_dataset
from flexdt.clients.datasets.dataset import load_dataset, read_settings
from flexdt.clients.failure import CommandError
from flexdt.clients.figures import page, table
from flexdt.runtime.files.dataset_folder import list_folder, read_image, read_text
from flexdt.twin.commissioning.contradictions import contradictions
from flexdt.twin.commissioning.past_scan import (
    Finding,
    PastScan,
    Question,
    Stand,
    scripted,
    stand,
)
from flexdt.twin.commissioning.zero_offsets import ZeroOffsets, zero_offsets
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.rebuild import MATCH_MM, named_machine
from flexdt.twin.dataset.xre import parse_xre
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import (
    Axis,
    Machine,
    Profile,
    builtin_machine,
    builtin_machine_text,
    builtin_machines,
    default_profile,
)
from flexdt.twin.machine.fitted_file import fitted_text
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.machine.places import place
from flexdt.twin.script.executed_log import Executed
from flexdt.twin.script.grammar import own_name
from flexdt.twin.script.parse import read_script
from flexdt.twin.script.planning.log_fit import Fit, fit_machine

MOST_NEXT: Final = 3
"""Scans that are proposed: more than a day's work nobody reads."""
ENOUGH: Final = 3
"""Times of a kind of command from which on its range is its own (`docs/machine-fit.md`)."""
OTHER: Final = 2.0
"""By what factor the proposed magnification differs: sigmas of axs_tan and det_tan go with one over
the difference, and most travels have room for it."""
ReadLog = Callable[[Path, Machine], tuple[Executed, ...]]


@dataclass(frozen=True)
class Commissioned:
    """What past scans tell of a machine.

    Attributes:
        shipped: the machine that the fit began with.
        machine, text: the fitted one, and its file.
        fit: of the executed scripts; None without any.
        scans: the oldest first, each with how the machine stood; traffic is the last.
        offsets: the profile, its sigmas and drift.
        findings: what contradicts what.
        questions: what could not be judged.
    """

    shipped: Machine
    machine: Machine
    text: str
    fit: Fit | None
    scans: Sequence[tuple[PastScan, Stand | None]]
    offsets: ZeroOffsets
    findings: Sequence[Finding]
    questions: Sequence[Question]

    def next_scans(self, out: Path) -> list[dict[str, object]]:
        """The scans that settle most of the questions, with their commands."""
        votes = Counter(q.settled_by for q in self.questions if q.settled_by)
        files = f"--machine {out / 'machine.toml'} --profile {out / 'profile.toml'}"
        again = f"flexdt commission FOLDER... --out {out}-2"
        wishes = {
            "ordinary": ("a full turn of any object with structure", "fly --frames 721", ""),
            "magnified": ("the same at another magnification", f"fly {self._farther()}", ""),
            "later": ("the same on another day", "fly --frames 721", ""),
            "beads": ("a bead phantom at two distances", "calibration",
                      "flexdt calibrate FOLDER --phantom NAME --report beads.html"),
            "recorded": ("a scan while its messages are recorded", "calibration",
                         "flexdt follow tcp://SCANNER:50000 --record traffic.txt"),
        }  # fmt: skip
        return [
            {
                "scan": wishes[kind][0],
                "settles": count,
                "of": len(self.questions),
                "commands": [
                    f"flexdt script new --kind {wishes[kind][1]} {files} --out {kind}.txt",
                    wishes[kind][2] or again,
                    *([f"{again} --traffic traffic.txt"] if kind == "recorded" else []),
                ],
            }
            for kind, count in votes.most_common(MOST_NEXT)
        ]

    def _farther(self) -> str:
        """Distances of another magnification than the last scan's, within the travel."""
        stands = [s for _, s in self.scans if s is not None]
        if not stands:
            return "--frames 721"
        at = stands[-1]
        pose = motor_poses(self.machine, at.profile, at.camera, at.positions)
        sod, sdd = float(pose.sod[0]), float(pose.sdd[0])
        most = place(self.machine, "object_y").most + at.profile.c_obj
        sod *= OTHER if OTHER * sod <= min(most, 0.9 * sdd) else 1.0 / OTHER
        return f"--frames 721 --sod {sod:.0f} --sdd {sdd:.0f}"

    def document(self, out: Path) -> dict[str, object]:
        """`commission.json`."""
        return {
            "machine": self.shipped.name,
            "scans": [_told(scan, stand, self.offsets) for scan, stand in self.scans],
            "fit": None if self.fit is None else self.fit.to_dict(),
            "profile": self.offsets.profile.model_dump(),
            "offsets": {name: asdict(line) for name, line in self.offsets.lines.items()},
            "disagreements": [f._asdict() for f in self.findings],
            "not_judged": [q._asdict() for q in self.questions],
            "next": self.next_scans(out),
        }

    def sections(self, out: Path) -> list[tuple[str, Sequence[str], list[list[str]]]]:
        """The report as tables: title, head, rows."""
        lines = self.offsets.lines
        return [
            ("What was read", ("scan", "date", "settings", "script", "images", "axis column [px]"),
             [[s.name, "-" if s.date is None else f"{s.date:%Y-%m-%d}",
               "-" if s.settings is None else "yes",
               f"{len(s.log)} executed lines" if s.log else "yes" if s.commands else "-",
               str(s.images or "-"), _column(self.offsets.columns.get(s.name))]
              for s, _ in self.scans]),
            ("Axes", ("axis", "lower", "upper", "max /s", "max /s2", "source"),
             [[n, *(f"{v:g}" for v in (a.lower, a.upper, a.max_speed, a.max_acceleration)),
               a.source or "as shipped"] for n, a in self.machine.axes.items()]),
            ("Zero offsets and their drift [mm, deg; a year]",
             ("offset", "value", "sigma", "drift", "sigma", "from"),
             [[n, f"{x.value:.4f}", *("-" if v is None else f"{v:.4f}"
                                      for v in (x.sigma, x.per_year, x.drift_sigma)),
               f"{x.scans} scans" if x.scans else "texts"] for n, x in lines.items()]),
            ("What disagrees", ("about", "between", "what"), [list(f) for f in self.findings]),
            ("What could not be judged", ("what", "why"),
             [[q.what, q.why] for q in self.questions]),
            ("Scans that settle the most", ("scan", "settles", "commands"),
             [[str(n["scan"]), f"{n['settles']} of {n['of']}", command]
              for n in self.next_scans(out) for command in n["commands"]]),
        ]  # fmt: skip


def _column(told: tuple[float, float, float] | None) -> str:
    return "-" if told is None else f"{told[0]:.3f} (fitted {told[1]:.3f} +- {told[2]:.3f})"


def _told(scan: PastScan, at: Stand | None, offsets: ZeroOffsets) -> dict[str, object]:
    column = offsets.columns.get(scan.name)
    found = scan.aligned
    return {
        "folder": scan.name,
        "date": None if scan.date is None else scan.date.isoformat(),
        "settings": scan.settings is not None,
        "executed_lines": len(scan.log),
        "script_commands": len(scan.commands),
        "images": scan.images,
        "stated": None if at is None or not at.stated else at.profile.model_dump(),
        "notes": [] if at is None else list(at.notes),
        "align": None if found is None else {n: p._asdict() for n, p in found.parameters.items()},
        "axis_column_px": None if column is None
        else dict(zip(("measured", "fitted", "sigma"), column, strict=True)),
    }  # fmt: skip


def commission(folders: Sequence[Path], traffic: Path | None, read_log: ReadLog) -> Commissioned:
    """What past scans tell of a machine.

    Args:
        folders: of scans, as the scanner or a twin writes them.
        traffic: a recording of `flexdt follow`, or a log.
        read_log: reads an executed script or a recording.

    Raises:
        CommandError: no folder holds anything of a scan.
        TwinError: the scripts' replies contradict each other.
    """
    questions = list[Question]()
    folders = list({folder.resolve(): folder for folder in folders}.values())
    names = [f"{f.parent.name}/{f.name}" if Counter(p.name for p in folders)[f.name] > 1 else f.name
             for f in map(Path.absolute, folders)]  # fmt: skip
    texts = [_texts(f, name, questions) for f, name in zip(folders, names, strict=True)]
    shipped = _shipped(texts, questions)
    read = [_scripts(f, scan, shipped, read_log, questions)
            for f, scan in zip(folders, texts, strict=True)]  # fmt: skip
    paths = dict(zip(names, folders, strict=True))
    read = sorted(read, key=lambda scan: scan.date or datetime.max)
    if traffic is not None:
        log = read_log(traffic, shipped)
        known = any(_same(scan.log, log) for scan in read)
        if known:
            questions.append(Question(traffic.name, "it is of a scan whose log is there already"))
        read += [] if known else [PastScan(traffic.name, None, log=log)]
    if not any(scan.settings or scan.log or scan.images for scan in read):
        where = ", ".join(map(str, folders))
        raise CommandError(f"{where}: no settings text, executed script or radiograph of a scan")
    machine, text, fit = _fitted(read, shipped)
    usual = default_profile(shipped, shipped.name)
    scans = [_measured(paths.get(s.name), s, machine, usual, questions) for s in read]
    offsets = zero_offsets([(s, at) for s, at in scans if at is not None], machine, usual)
    questions += [*offsets.questions, *_unseen(machine, fit)]
    findings = (*contradictions(scans, shipped, machine), *offsets.findings)
    return Commissioned(shipped, machine, text, fit, scans, offsets, findings, questions)


def _texts(folder: Path, name: str, questions: list[Question]) -> PastScan:
    """The scan as its settings texts and the names of its images tell it."""
    content = list_folder(folder)
    warnings = list[str]()
    settings, second, date = None, None, None
    try:
        settings = read_settings(content, warnings)
        if content.xre_settings is not None:
            xre = parse_xre(read_text(folder / content.xre_settings))
            second = xre.settings
            date = datetime.fromisoformat((xre.text("Scan info", "Start") or "")[:19])
    except (DatasetError, ValueError) as error:
        warnings.append(str(error))
    questions += [Question(name, text) for text in warnings]
    first = next(iter(content.projections.values()), None)
    shape = None
    try:
        shape = None if first is None else read_image(folder / first).shape
    except DatasetError as error:
        questions.append(Question(name, error.message))
    started = None if settings is None else settings.started
    return PastScan(name, started or date, settings, second, images=len(content.projections),
                    shape=shape)  # fmt: skip


def _shipped(scans: Sequence[PastScan], questions: list[Question]) -> Machine:
    """The machine that ships and that the texts name; else the one that shares most motors."""
    known = [builtin_machine(name) for name in builtin_machines()]
    texts = [scan.settings for scan in scans if scan.settings is not None]
    named = [m.name for s in texts if (m := named_machine(s, known)) is not None]
    if named:
        return builtin_machine(Counter(named).most_common(1)[0][0])
    motors = {name for s in texts for name in s.motors}
    best = max(known, key=lambda m: (len(motors & set(m.axes)), m.name == machines.DEFAULT_MACHINE))
    why = f"no text names a scanner that ships; what scans do not tell is as in {best.name}"
    questions.append(Question("which scanner it is", why))
    return best


def _scripts(
    folder: Path, scan: PastScan, machine: Machine, read_log: ReadLog, questions: list[Question]
) -> PastScan:
    """The scan with its executed script, or with the script that was submitted."""
    content = list_folder(folder)
    settings = {content.scan_settings, content.xre_settings}
    for name in sorted(content.names - settings):
        if name.lower().endswith((".txt", ".tsv", ".log")):
            try:
                log = read_log(folder / name, machine)
                return replace(scan, log=log, commands=tuple(x.command for x in log))
            except CommandError as error:
                script, problems = read_script((folder / name).read_bytes())
                if script.commands and not any(p.severity == "error" for p in problems):
                    scan = replace(scan, commands=script.commands)
                else:
                    questions.append(Question(scan.name, "; ".join(error.lines)))
    return scan


def _same(one: Sequence[Executed], two: Sequence[Executed]) -> bool:
    return bool(one) and [x.command for x in one] == [x.command for x in two]


def _fitted(scans: Sequence[PastScan], shipped: Machine) -> tuple[Machine, str, Fit | None]:
    """The machine of the texts' signs and rates and of the executed scripts, and its file."""
    axes: dict[str, Axis] = {}
    for name, axis in shipped.axes.items():
        if name not in shipped.geometry.get("angle", {}):
            axes[name] = _stated(axis, name, scans, shipped)
    base = shipped.model_copy(update={"axes": {**shipped.axes, **axes}})
    logs = [
        [x if own_name(getattr(x.command, "component", ""), base.axes) in base.axes
         else replace(x, motor=None) for x in scan.log]
        for scan in scans if scan.log
    ]  # fmt: skip
    fit = None
    if logs:
        names = ", ".join(scan.name for scan in scans if scan.log)
        fit = fit_machine(logs, base, f"measured: {names} ({sum(map(len, logs))} lines)")
    machine = base if fit is None else fit.machine
    changed = [n for n, axis in machine.axes.items() if axis != shipped.axes[n]]
    text = builtin_machine_text(shipped.name)
    if changed or fit is not None:
        text = fitted_text(text, machine, changed, machines.parsed)
    return machine, text, fit


def _stated(axis: Axis, name: str, scans: Sequence[PastScan], machine: Machine) -> Axis:
    """An axis with the rates of the last settings text, and the sign of most of them."""
    told = [(scan, m) for scan in scans
            if scan.settings is not None and (m := scan.settings.motors.get(name))]  # fmt: skip
    signs = Counter[int]()
    for scan, motor in told:
        asked = scripted(scan.commands, machine).get(name)
        if (
            asked is not None
            and abs(asked) > 1.0
            and abs(abs(asked) - abs(motor.value)) <= MATCH_MM
        ):
            signs[1 if asked * motor.value > 0 else -1] += 1
    changes: dict[str, object] = {}
    if signs and (sign := signs.most_common(1)[0][0]) != axis.settings_sign:
        changes["settings_sign"] = sign
    for rate in ("speed", "acceleration"):
        values = [v for _, m in told if (v := getattr(m, rate)) is not None and v > 0.0]
        if values and values[-1] != getattr(axis, rate):
            most = f"max_{rate}"
            changes |= {rate: values[-1], most: max(values[-1], getattr(axis, most))}
    if changes:
        changes["source"] = f"settings texts, n = {len(told)}; limits as shipped"
    return axis.model_copy(update=changes)


def _measured(
    folder: Path | None, scan: PastScan, machine: Machine, usual: Profile,
    questions: list[Question],
) -> tuple[PastScan, Stand | None]:  # fmt: skip
    """The scan with what its images tell, and how the machine stood."""
    if scan.settings is None or folder is None:
        questions += [Question(scan.name, "no settings text: where the motors stood is not known")]
        return scan, None
    at = None
    try:
        at = stand(scan, machine, usual)
        if at is None:
            why = "its text states no motors, camera mode or ROI"
            questions.append(Question(scan.name, why))
        elif not scan.images:
            questions.append(Question(scan.name, "it has no radiographs", "ordinary"))
        else:
            data = load_dataset(folder, machine=machine, profile=at.profile, ignore_document=True)
            found = align_dataset(data).alignment
            if found.offsets is None:
                why = f"align: {found.refused['axis_column_px']}"
                questions.append(Question(scan.name, why, "ordinary"))
            return replace(scan, aligned=found), at
    except TwinError as error:
        questions.append(Question(scan.name, error.message))
    return scan, at


def _unseen(machine: Machine, fit: Fit | None) -> list[Question]:
    """Limits and times of which no executed script tells."""
    seen = {} if fit is None else fit.axes
    spread = {} if fit is None else machine.timing.spread
    out = [Question(f"limits of {name}", "no motor's reply in a log or recording", "recorded")
           for name in machine.axes if name not in seen]  # fmt: skip
    for kind in machine.timing.kinds:
        n = spread[kind].n if kind in spread else 0
        if n < ENOUGH:
            why = f"{n} of at least {ENOUGH} executed commands" if n else "none was executed"
            out.append(Question(f"time of {kind}", why, "recorded"))
    return out


def write_commission(found: Commissioned, out: Path) -> None:
    """Write `machine.toml`, `profile.toml`, `commission.json` and `report.html` into a new folder,
    which appears when all of it is there.

    Raises:
        CommandError: the folder holds something.
        OSError: it cannot be written.
    """
    require_free(out)
    part = out.absolute().with_name(f".{out.absolute().name}.part.{os.getpid()}")
    profile = {k: v for k, v in found.offsets.profile.model_dump().items() if k != "priors"}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in profile.items()]
    priors = [f"{k} = {v!r}" for k, v in found.offsets.profile.priors.items()]
    body = ["<h1>What past scans tell of the machine</h1>"]
    for title, head, rows in found.sections(out):
        body += [f"<h2>{title}</h2>", table(head, rows) if rows else "<p>Nothing.</p>"]
    files: Mapping[str, str] = {
        "machine.toml": found.text,
        "profile.toml": "\n".join([*lines, "", "[priors]", *priors, ""]),
        "commission.json": json.dumps(found.document(out), indent=1, default=str) + "\n",
        "report.html": page("Commissioning", body),
    }
    try:
        part.mkdir(parents=True)
        for name, text in files.items():
            (part / name).write_text(text, encoding="utf-8")
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def require_free(out: Path) -> None:
    """Check that nothing lies where the folder is to be.

    Raises:
        CommandError: something does.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CommandError(f"{out} is there; allowed: a new or an empty folder")
