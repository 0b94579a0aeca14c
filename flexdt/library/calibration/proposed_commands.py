"""Commands that a calibration's report proposes: the command that was typed, with what a
finding advises, so that they run on the same scan as they stand.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from flexdt.library.calibration.calibration_options import CalibrationOptions
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.unknown_markers import UNKNOWN
from flexdt.twin.findings import Finding, FindingCode

IN_MEMORY: Final = "DATASET"
"""Stands for a scan in memory, which has no folder to type."""
VALUE: Final = "PHANTOM"
"""Stands for a phantom in memory, which has no file to type."""
STANDS_FOR: Final = {
    IN_MEMORY: "the folder of data.save(FOLDER)",
    VALUE: "the phantom's file",
}
"""Word of a command -> what its reader replaces it by."""
OPTION_OF: Final[Mapping[str, str]] = {"priors": "prior"}
"""Option of the library -> option of the command, where the names differ."""
NEXT: Final[Mapping[FindingCode, tuple[str, str]]] = {
    CalibrationCode.WRONG_PHANTOM: ("flexdt phantom list", "NAME"),
    CalibrationCode.BEAD_SIZE: ("flexdt phantom list", "NAME"),
}
"""Code of a finding that forbids a result -> command to run first, and the word that stands
for another phantom; other findings advise options, or have a report that shows the shadows."""


@dataclass(frozen=True)
class Typed:
    """A calibration as words of the command line.

    Attributes:
        data: folders of its scans.
        phantom: its name or file.
        geometry: files, one for each scan; empty where the scans have their own.
        options: name of the command's option -> its value.
        report: JSON file of the report; None where none was asked for.
    """

    data: tuple[str, ...]
    phantom: str
    geometry: tuple[str, ...] = ()
    options: Mapping[str, str] | None = None
    report: str | None = None

    def command(self, *, phantom: str = "", data: Sequence[str] = (), **more: str) -> str:
        """Return the command, with other options.

        Args:
            phantom: in place of the one that was typed.
            data: in place of those that were typed; each geometry is a place then, too.
            more: option (_ for -) -> value, added or in place of what was typed.
        """
        geometry: Sequence[str] = self.geometry
        options = dict(self.options or {})
        if data:
            options.pop("frames", None)
        if data and geometry:
            geometry = [f"GEOMETRY-{n}" for n in range(1, len(data) + 1)]
        replaced = {name.replace("_", "-"): value for name, value in more.items()}
        pairs = [
            *((name, options.pop(name)) for name in ("frames",) if name in options),
            *(("geometry", file) for file in geometry),
            ("phantom", phantom or self.phantom),
            *(options | replaced).items(),
        ]
        words = [
            *(data or self.data),
            *(word for name, value in pairs for word in (f"--{name}", value)),
        ]
        notes = "; ".join(f"{w}: {STANDS_FOR[w]}" for w in STANDS_FOR if w in words)
        return f"flexdt calibrate {shlex.join(words)}{notes and f'  # {notes}'}"

    def without_beads(self) -> Iterator[str]:
        """Yield the command for each scan that finds its axis without a phantom."""
        for number, scan in enumerate(self.data):
            own = ["--geometry", self.geometry[number]] if self.geometry else []
            yield f"flexdt align {shlex.join([scan, *own])}  # where no phantom is in the scan"

    def use(self) -> str:
        """Return the command that reconstructs with the report: the scan itself if its
        markers were unknown, as they are the sample's own, else a place for the sample's.
        """
        scans = self.data or tuple(
            v for n, v in (self.options or {}).items() if n == "frames"
        )
        geometry = list(self.geometry)
        notes = []
        if self.phantom == UNKNOWN and len(scans) == 1 and scans[0] != IN_MEMORY:
            scan = scans[0]
        else:
            scan = "SAMPLE"
            notes.append("SAMPLE: the folder of your sample's scan")
            if geometry:
                geometry = ["GEOMETRY"]
                notes.append("GEOMETRY: nominal, of that scan")
        words = [scan]
        if geometry:
            words += ["--geometry", geometry[0]]
        words += ["--correction", self.report or "REPORT.json", "--out", "volume.tif"]
        if self.report is None:
            notes.append("REPORT.json: of this command with --report")
        note = f"  # {'; '.join(notes)}" if notes else ""
        return f"flexdt reconstruct {shlex.join(words)}{note}"


def option_words(options: CalibrationOptions) -> dict[str, str]:
    """Write options as those of the command: name -> value; defaults are left out.

    `bound` is a key of the settings file, and marks in memory have no file to type.
    """
    words = {}
    given: Mapping[str, Any] = {**options}
    for name, value in given.items():
        if (
            value is None
            or name == "bound"
            or (name == "markers" and isinstance(value, list | tuple))
        ):
            continue
        if isinstance(value, Mapping):
            text = ",".join(f"{key}={number:g}" for key, number in value.items())
        elif isinstance(value, list | tuple):
            text = ",".join(value)
        elif isinstance(value, float):
            text = f"{value:g}"
        else:
            text = str(value)
        if text and (name, text) != ("reading", "axis"):
            words[OPTION_OF.get(name, name).replace("_", "-")] = text
    return words


def angle_commands(finding: Finding, typed: Typed) -> Iterator[str]:
    """Yield the command that states how a phantom stands that looks alike in several ways,
    with one of the start angles as an example; nothing where none tells it.

    Args:
        finding: that it does, with an angle as its figure [deg].
        typed: the calibration that made it.
    """
    if finding.code is not CalibrationCode.AMBIGUOUS or not finding.remedy:
        return
    stated = {"start": f"alpha={finding.figure:.1f}", "prior": "alpha=5"}
    for option, words in stated.items():
        others = [
            w
            for w in (typed.options or {}).get(option, "").split(",")
            if w not in ("", "none") and w.split("=")[0] != "alpha"
        ]
        stated[option] = ",".join([*others, words])
    yield typed.command(**stated)


def settling_commands(
    finding: Finding, typed: Typed, free: Sequence[str]
) -> Iterator[str]:
    """Yield the commands that would settle a finding: those of its code, else those that
    it advises, else one for a report.

    Args:
        finding: that decides.
        typed: the calibration that made it.
        free: parameters that it estimated.
    """
    if finding.code in NEXT:
        first, other = NEXT[finding.code]
        yield first
        yield typed.command(phantom=other)
        return
    if finding.code is CalibrationCode.NO_BEADS:
        yield from typed.without_beads()
    options = typed.options or {}
    if finding.code is CalibrationCode.AMBIGUOUS:
        yield from angle_commands(finding, typed)
        frames = {name: options[name] for name in ("frames",) if name in options}
        yield replace(typed, options=frames).command(phantom=UNKNOWN)
        return
    if finding.advice.per_frame:
        moving = [name for name in options.get("per-frame", "").split(",") if name]
        yield typed.command(
            per_frame=",".join(dict.fromkeys((*moving, *finding.advice.per_frame)))
        )
    if finding.advice.free:
        more = {"free": ",".join(dict.fromkeys((*free, *finding.advice.free)))}
        held = options.get("prior", "")
        if held not in ("", "none"):
            # A parameter has a prior or is free.
            kept = [
                w for w in held.split(",") if w.split("=")[0] not in finding.advice.free
            ]
            if kept:
                more["prior"] = ",".join(kept)
            else:
                left = {n: value for n, value in options.items() if n != "prior"}
                typed = replace(typed, options=left)
        yield typed.command(**more)
    for name, width in finding.advice.priors:
        held = options.get("prior", "")
        kept = [w for w in held.split(",") if w and w.split("=")[0] not in (name, "none")]
        yield typed.command(prior=",".join([*kept, f"{name}={width:g}"]))
    if not (finding.advice.per_frame or finding.advice.free or finding.advice.priors):
        yield typed.command(report="report.html")
