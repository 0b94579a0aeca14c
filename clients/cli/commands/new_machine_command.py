"""`flexdt machine new`: a short file for a machine of one's own, on top of one that ships."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Final

import typer

from flexdt.clients.cli import option_values, value_completion
from flexdt.clients.cli.command_settings import MachineNewSettings
from flexdt.clients.cli.option_values import if_given
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.cli.settings_file import chosen
from flexdt.library import machines

USUAL_BASE: Final = "xyzr_cabinet"
"""Machine that a new one begins with."""


def new(
    name: str = argument(..., "NAME"),
    out: Path = option(..., metavar="FILE", written=True),
    base: str | None = option(
        None, metavar="NAME", proposes=value_completion.machine_names
    ),
    detector: str | None = option(None, metavar="COLUMNSxROWS"),
    pitch: str | None = option(None, metavar="MM[xMM]"),
    bits: int | None = option(None),
    sod: str | None = option(None, metavar="MM or MM:MM"),
    sdd: str | None = option(None, metavar="MM or MM:MM"),
    kv: str | None = option(None, metavar="KV or KV:KV"),
    power: float | None = option(None, metavar="W"),
    limit: list[str] | None = option(None, metavar="AXIS=LOWER:UPPER"),
    without: list[str] | None = option(
        None, metavar="AXIS", proposes=value_completion.axis_names
    ),
) -> Answer:
    """Write a short file for a machine of your own; asks for missing values on a terminal.

    Args:
        name: One word.
        out: Write the machine to this file.
        base: Begin with this machine, the most similar.
        detector: Set the detector's unbinned columns and rows.
        pitch: Set the pitch of columns, and of rows.
        bits: Set the bits of a pixel.
        sod: Set source to axis, or least:most.
        sdd: Set source to panel, or least:most.
        kv: Set the largest voltage, or least:most.
        power: Set the largest power.
        limit: Set an axis's travel so.
        without: Leave out this axis.

    Yields:
        The document of --json (file and text), then one line. Nothing is written if the
        machine, or its standing at home, does not hold. A voltage given alone is the
        largest.
    """
    from flexdt.twin.collision.home_check import check_home
    from flexdt.twin.machine.description import (
        builtin_machine,
        builtin_machines,
        parse_machine,
    )
    from flexdt.twin.machine.kinematics import place
    from flexdt.twin.machine.new_machine import Answers, new_machine_text

    base = _ask_or_default(
        f"Most like which of {', '.join(builtin_machines())}", base, USUAL_BASE
    )
    base = base or USUAL_BASE
    like = builtin_machine(base)
    panel = like.detector
    usual = [
        ":".join(f"{end:g}" for end in dict.fromkeys((at.least, at.most)))
        for at in (place(like, "object_y"), place(like, "detector_y"))
    ]
    size = _ask_or_default(
        "Panel, columns x rows", detector, f"{panel.columns}x{panel.rows}"
    )
    pitch = _ask_or_default("Pixel, mm", pitch, f"{panel.pitch_mm:g}")
    sod = _ask_or_default("SOD, mm: one if fixed, or least:greatest", sod, usual[0])
    sdd = _ask_or_default("SDD, mm: one if fixed, or least:greatest", sdd, usual[1])
    kv = _ask_or_default(
        "Tube, kV: at most, or least:most",
        kv,
        f"{like.tube.min_kV:g}:{like.tube.max_kV:g}",
    )
    volts = if_given(kv, partial(option_values.span, what="--kv"))
    pixels = if_given(size, partial(_pair, what="--detector", whole=True))
    lines = [word.partition("=") for word in limit or []]
    answers = Answers(
        name=name,
        base=base,
        scanner=chosen(MachineNewSettings).scanner,
        columns=None if pixels is None else int(pixels[0]),
        rows=None if pixels is None else int(pixels[1]),
        pitch_mm=if_given(pitch, partial(_pair, what="--pitch")),
        bits=bits,
        sod_mm=if_given(sod, partial(option_values.span, what="--sod")),
        sdd_mm=if_given(sdd, partial(option_values.span, what="--sdd")),
        min_kV=volts[0] if volts is not None and ":" in str(kv) else None,
        max_kV=None if volts is None else volts[1],
        max_W=None if power is None else option_values.number(f"{power}", "--power"),
        limits={
            axis: option_values.span(ends, f"--limit {axis}") for axis, _, ends in lines
        },
        without=tuple(without or ()),
    )
    text = new_machine_text(answers)
    made = parse_machine(text, str(out))
    check_home(made, machines.profile(None, made, str(out)), str(out))
    out.write_text(text, encoding="utf-8")
    scanner = machines.machine(base)
    zero = machines.profile(None, scanner, base)
    offsets = ""
    if scanner.default_profile:
        offsets = f" but for the zero offsets, which are 0 and not those of {zero.name}"
    least = f", the tube's least voltage ({made.tube.min_kV:g} kV) included"
    yield {"file": str(out), "text": text}
    yield (
        f"{out}: {len(text.splitlines())} lines; everything else as in {base}{offsets}"
        f"{least if answers.min_kV is None else ''}; see: flexdt machine show {out}"
    )


def _ask_or_default(question: str, given: str | None, usual: str) -> str | None:
    """Return the given value, else a terminal's answer; None for the usual one.

    Without a terminal that is `given`.
    """
    if given is not None or not sys.stdin.isatty():
        return given
    answer: str = typer.prompt(question, default=usual, err=True)
    return None if answer == usual else answer


def _pair(word: str, what: str, *, whole: bool = False) -> tuple[float, float]:
    form = "of the form NUMBERxNUMBER"
    found = option_values.numbers(word, f"{what}:", form, 1, 2, by="x", whole=whole)
    return found[0], found[-1]
