"""docs/command-line.md names every command there is, and none that is not."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from typer.main import get_command

from flexdt.clients.cli.command_tree import build

PAGE = Path(__file__).parents[2] / "docs" / "command-line.md"


def commands(group: Any, prefix: str = "") -> set[str]:
    out: set[str] = set()
    for name, command in group.commands.items():
        sub = getattr(command, "commands", None)
        out |= commands(command, f"{name} ") if sub else {prefix + name}
    return out


def documented() -> set[str]:
    out: set[str] = set()
    for cell in re.findall(r"^\| (`flexdt .*?) \|", PAGE.read_text(), re.MULTILINE):
        group = ""
        for code in re.findall(r"`([^`]+)`", cell):
            words = code.removeprefix("flexdt ").split()
            if code.startswith("flexdt ") and words[0] in ("job", "machine", "phantom", "script"):
                group = words.pop(0) + " "
            elif code.startswith("flexdt "):
                group = ""
            out.add(group + words[0])
    return out


def test_every_command_is_documented_and_every_documented_command_exists() -> None:
    assert documented() == commands(get_command(build()))


def test_every_command_says_what_it_does() -> None:
    def walk(group: Any) -> None:
        for name, command in group.commands.items():
            assert (command.help or "").strip(), name
            if getattr(command, "commands", None):
                walk(command)

    walk(get_command(build()))
