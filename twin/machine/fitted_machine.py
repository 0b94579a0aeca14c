"""A machine file with the axes and times of a fit, everything else as in the file
it began with."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Mapping

from pydantic import BaseModel

from flexdt.twin.errors import MachineFileError
from flexdt.twin.machine.description import Axis, Machine, Timing, parse_machine

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]\s*(?:#.*)?")
_ANY_HEADER = re.compile(r"\s*\[")
Range = tuple[float, float]


def fitted_text(
    text: str,
    machine: Machine,
    axes: Collection[str],
    parse: Callable[[str, str], Machine] = parse_machine,
) -> str:
    """Write the timing and some axes of `machine` into the machine file `text`.

    Comments are kept. `parse`: reads a file's text, with its meshes. Raises
    MachineFileError: the new text does not parse to `machine`, for instance because its
    axes and times are not tables.
    """
    blocks = {f"axes.{name}": _axis_table(name, machine.axes[name]) for name in axes}
    new_text = _replaced(text, {**blocks, "timing": _timing_table(machine.timing)})
    if parse(new_text, "fitted machine") != machine:
        message = (
            "the base machine's file must write axes as tables [axes.NAME] "
            "and times as [timing]"
        )
        raise MachineFileError(message, {"allowed": ["[axes.NAME]", "[timing]"]})
    return new_text


def _replaced(text: str, blocks: Mapping[str, str]) -> str:
    """Replace tables of `text`, and remove tables timing.*; other comments stay.

    A comment directly before a replaced table is removed, and those within it; one
    separated by an empty line stays. A table timing.* that is in `blocks` is replaced.

    Args:
        text: of a machine file.
        blocks: table's name -> its new text with its header; those that the file lacks
            are appended.

    Returns:
        The new text, with a newline at its end.
    """
    left = dict(blocks)
    out: list[str] = []
    held: list[str] = []
    skipping = False
    for line in text.splitlines():
        if not line.strip() or line.lstrip().startswith("#"):
            held.append(line)
            continue
        if _ANY_HEADER.match(line):
            header = _HEADER.fullmatch(line)
            name = ""
            if header is not None:
                name = header[1].strip()
            skipping = name in blocks or name.startswith("timing.")
            if skipping:
                while held and held[-1].strip():
                    held.pop()
            out += held
            if name in left:
                out += left.pop(name).splitlines()
        elif not skipping:
            out += held
        held = []
        if not skipping:
            out.append(line)
    return "\n".join([*out, *held, *("\n" + block for block in left.values())]) + "\n"


def _axis_table(name: str, axis: Axis) -> str:
    """Format an axis as a TOML table."""
    return "\n".join([f"[axes.{name}]", *_keys(axis)])


def _timing_table(timing: Timing) -> str:
    """Format times as the TOML tables [timing] and [timing.spread], each with "measured,
    log" or "assumed" as a comment.

    Defaults and None are left out; a kind with a spread, and drift, count as measured;
    source has no comment.
    """
    lines = ["[timing]"]
    for line in _keys(timing, {"spread"}):
        kind = line.split("_s = ")[0]
        spread_of_kind = timing.spread.get(kind)
        measured = spread_of_kind is not None or kind.startswith("drift")
        origin = ""
        if not kind.startswith("source"):
            origin = "assumed"
            if measured:
                origin = "measured, log"
        lines.append(line + (f"  # {origin}" if origin else ""))
    lines += ["", "[timing.spread]"]
    for kind, spread in timing.spread.items():
        inner = ", ".join(
            f"{key} = {value!r}" for key, value in spread.model_dump().items()
        )
        lines.append(f"{kind} = {{ {inner} }}")
    return "\n".join(lines)


def _keys(model: BaseModel, beside: set[str] | None = None) -> list[str]:
    """Format a model's values as TOML lines, one for each field, without defaults, None,
    and the fields `beside`.
    """
    values = model.model_dump(exclude_defaults=True, exclude=beside)
    return [
        f"{key} = {json.dumps(value, ensure_ascii=False)}"
        for key, value in values.items()
        if value is not None
    ]
