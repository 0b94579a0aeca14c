"""docs/command-line.md names every command there is; options have help, and are not too
many."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from doc_pages import pages
from typer.main import get_command

from flexdt.clients.cli.command_tree import GROUPS, SECTIONS, build, run
from flexdt.clients.cli.settings_file import TABLES
from flexdt.runtime.settings import parameters, read

MOST_OPTIONS = 217
THEIRS = ("flexdt study", "flexdt batch", "flexdt bench", "flexdt phantom design")
PROCESSES = ("up", "twin", "projector", "viewer", "gateway")
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "command-line.md"


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
            if code.startswith("flexdt ") and words[0] in GROUPS:
                group = words.pop(0) + " "
            elif code.startswith("flexdt "):
                group = ""
            out.add(group + words[0])
    return out


def test_every_command_is_documented_and_every_documented_command_exists() -> None:
    assert documented() == commands(get_command(build()))


def parts() -> Iterator[tuple[str, Any]]:
    """Every command and group with its path."""

    def walk(command: Any, path: str) -> Iterator[tuple[str, Any]]:
        yield path, command
        for name, inner in getattr(command, "commands", {}).items():
            yield from walk(inner, f"{path} {name}")

    return walk(get_command(build()), "flexdt")


def first_sentence(text: str | None) -> str:
    paragraph, *_ = (text or "").strip().split("\n\n")
    return " ".join(paragraph.split())


def test_every_help_page_begins_with_what_the_command_does(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The printed page has the sentence of the list of commands, and each its own: a process
    prints its page itself, and may have another text than the tree."""
    begins = {}
    for path, command in parts():
        assert run([*path.split()[1:], "--help"]) == 0
        usage, page = capsys.readouterr().out.split("\n\n", 1)
        assert usage.startswith(f"Usage: {path} ")
        begins[path] = first_sentence(page)
        assert begins[path] == first_sentence(command.help) != "", path
    assert len({*begins.values()}) == len(begins) > 50


@pytest.mark.parametrize("name", PROCESSES)
def test_a_process_started_as_a_module_has_the_help_of_its_command(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert read(TABLES[name], ["--help"]) is None
    _, page = capsys.readouterr().out.split("\n\n", 1)
    assert first_sentence(page) == first_sentence(
        get_command(build()).commands[name].help
    )


def options(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "option"]


def test_there_are_no_more_options_than_a_person_can_read() -> None:
    """The ceiling may only fall; what nobody sets belongs into the settings file. Help does
    not show what is deprecated."""
    shown = [p for _, command in parts() for p in options(command) if not p.hidden]
    assert len(shown) <= MOST_OPTIONS


def taken(path: str, command: Any) -> set[str]:
    """Flags that a command takes: its own, those of `flexdt` itself, those it passes on."""
    out = {
        flag
        for option in options(command)
        for flag in (*option.opts, *option.secondary_opts)
    }
    out |= {"--help", *getattr(command.callback, "heeds", ())}
    name = path.split()[-1]
    for table in PROCESSES if name == "up" else {name} & set(PROCESSES):
        for f in fields(TABLES[table]):
            out |= {f"--{f.name.replace('_', '-')}", *f.metadata["flags"]}
    return out


def test_options_that_the_pages_name_are_taken() -> None:
    by_name = {
        path.removeprefix("flexdt "): taken(path, command) for path, command in parts()
    }
    found = []
    texts = pages() | {ROOT / "README.md": (ROOT / "README.md").read_text("utf-8")}
    for page, whole in texts.items():
        if page.parent.name == "history":  # names what there was at the time
            continue
        text = whole.replace("\\\n", " ")
        for line in re.findall(r"(?:^|`)flexdt ([^`\n]*)", text, re.MULTILINE):
            words = line.split()
            name = " ".join(words[:2]) if " ".join(words[:2]) in by_name else words[0]
            flags = (
                re.findall(r"(?<![\w-])--[a-zA-Z][\w-]*", line) if name in by_name else ()
            )
            found += [(page.name, name, flag, flag in by_name[name]) for flag in flags]
    assert len(found) > 100
    assert [each for *each, there in found if not there] == []


@pytest.mark.slow
def test_h_is_help_and_every_section_names_commands() -> None:
    for words in (
        ["-h"],
        ["move", "-h"],
        ["job", "-h"],
        ["job", "list", "-h"],
        ["twin", "-h"],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "flexdt.clients.cli", *words],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert done.stdout.startswith("Usage: flexdt"), words
        assert "-h, --help" in done.stdout
    there = set(get_command(build()).commands)
    named = [name for names in SECTIONS.values() for name in names]
    assert len(set(named)) == len(named)
    assert there <= set(named)


def test_every_option_has_a_sentence_of_help() -> None:
    """A capital, at least three words and a full stop; the extensions' commands are theirs."""
    wrong = [
        (path, option.opts[0], option.help)
        for path, command in parts()
        if path not in THEIRS
        for option in [*options(command)]
        if option.name not in ("install_completion", "show_completion")
        if not re.fullmatch(r"[A-Z]\S*( \S+){2,}\.", option.help or "")
    ]
    assert not wrong
    for kind in TABLES.values():
        for name, parameter in parameters(kind).items():
            [option] = parameter.annotation.__metadata__
            assert re.fullmatch(r"[A-Z]\S*( \S+){2,}\.", option.help), name
