"""Each program is run by a test or a weekly job, and each module of tests/support is used; what
`docs/evidence` says is made, is made."""

from __future__ import annotations

import ast
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import weekly

ROOT: Final = Path(__file__).resolve().parents[2]
HOMES: Final = ("tests/studies", "tests/support")
TESTS: Final = ("tests", "extensions/tests")
JOBS: Final = ("Makefile", ".ci", ".github/workflows")
BY_USERS: Final = re.compile(r"(flexdt|pytest|make|git)\b")
"""How a command of the evidence may begin that is no program of the repository."""


def words(tree: ast.Module) -> Iterator[str]:
    """Names that a module imports, and its texts but for docstrings."""
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (f"{alias.name.rpartition('.')[2]}.py" for alias in names)
            case ast.ImportFrom(module=str(module), names=names, level=0):
                yield f"{module.rpartition('.')[2]}.py"
                if module == "tests.support":
                    yield from (f"{alias.name}.py" for alias in names)
            case ast.Call(func=ast.Name(id="run"), args=[ast.Constant(str(name)), *_]):
                yield f"{name}.py"
            case ast.Constant(str(text)) if id(node) not in docstrings:
                yield text


def named(text: str, names: set[str]) -> set[str]:
    """Modules that a text names with their ending, by imports in a script or as pytest's
    plugins; their names without it."""
    found = set(re.findall(r"(?<!\w)(\w+)\.py\b", text))
    found |= set(
        re.findall(r"^from (?:tests\.support\.)?(\w+) import", text, re.MULTILINE)
    )
    return names & (found | ({text} if "_" in text else set()))


def unused(root: Path) -> list[str]:
    """Modules of the homes that no test, job or used module names."""
    modules = {p.stem: p for home in HOMES for p in (root / home).glob("*.py")}
    tests = [
        path
        for folder in TESTS
        for path in (root / folder).rglob("*.py")
        if path.name.startswith("test_") or path.name == "conftest.py"
    ]
    used: set[str] = set()
    for place in JOBS:
        files = [root / place, *(root / place).rglob("*")]
        for file in files:
            if file.is_file():
                used |= named(file.read_text(encoding="utf-8"), {*modules})
    table = root / "tests" / "studies" / "weekly.toml"
    for job in weekly.jobs(table).values() if table.exists() else ():
        for command in job["commands"]:
            used |= named(command, {*modules})
    any_name = "|".join(modules)
    seen = re.compile(
        rf"(?:import |from |support\.|\")(?:{any_name})\b|\b(?:{any_name})\.py"
    )
    left = [*tests, *(modules[name] for name in used)]
    while left:
        source = left.pop().read_text(encoding="utf-8")
        found: set[str] = set()
        for text in words(ast.parse(source)) if seen.search(source) else ():
            found |= named(text, {*modules})
        left += [modules[name] for name in found - used]
        used |= found
    return sorted(
        p.relative_to(root).as_posix() for n, p in modules.items() if n not in used
    )


@pytest.mark.slow
def test_each_program_is_run_and_each_generator_used() -> None:
    assert unused(ROOT) == []


def test_a_program_that_nobody_runs_is_found(tmp_path: Path) -> None:
    texts = {
        "tests/studies/weekly.toml": '[a]\ncommands = ["python tests/studies/table.py"]\n',
        "tests/studies/table.py": "from deep import run\n",
        "tests/studies/alone.py": "import table\n",
        "tests/studies/imported.py": "",
        "tests/studies/called.py": "",
        "tests/support/deep.py": "",
        "tests/support/lonely.py": "",
        "tests/test_a.py": '"""As alone.py does."""\nimport imported\nrun("called", 3)\n',
        "Makefile": "a:\n\tpython tests/support/making.py\n",
        "tests/support/making.py": "",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert unused(tmp_path) == ["tests/studies/alone.py", "tests/support/lonely.py"]


def test_no_two_modules_of_the_homes_have_one_name_and_support_imports_no_program() -> (
    None
):
    programs, support = ({p.stem: p for p in (ROOT / h).glob("*.py")} for h in HOMES)
    assert {*programs} & {*support} == set()
    for name, path in support.items():
        trees = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        imported = {a.name for n in trees if isinstance(n, ast.Import) for a in n.names}
        trees = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        imported |= {
            n.module for n in trees if isinstance(n, ast.ImportFrom) and n.module
        }
        assert imported & {*programs} == set(), name


def evidence_commands() -> list[tuple[str, str]]:
    """Each command of the evidence, with its document: of sections, and of rows that end with
    one."""
    found = []
    for path in sorted((ROOT / "docs" / "evidence").glob("*.json")):
        for section in json.loads(path.read_text(encoding="utf-8"))["sections"]:
            every = [*section["commands"]]
            if section.get("columns", [""])[-1] == "command":
                for row in section["rows"]:
                    every += re.findall(r"`([^`]*)`", row[-1])
            found += [(path.name, command) for command in every]
    return found


def is_made(command: str, table: set[str], tests: str) -> bool:
    """Whether a command of the evidence is a user's or a test's, is in the weekly table, or
    is an example that a test runs.

    Args:
        command: without variables of the environment only where it is a user's.
        table: commands of the weekly jobs.
        tests: texts of all test modules.
    """
    if command in table:
        return True
    plain = re.sub(r"^(time |\w+=\S+ )*", "", command)
    if BY_USERS.match(plain) or "python" not in plain:
        return True
    program = re.search(r"(?:extensions/)?examples/(\w+\.py)", plain)
    return program is not None and program[1] in tests


def test_figures_are_made_by_a_test_a_command_or_a_weekly_job() -> None:
    table = {command for job in weekly.jobs().values() for command in job["commands"]}
    tests = "\n".join(
        path.read_text(encoding="utf-8")
        for folder in TESTS
        for path in (ROOT / folder).rglob("test_*.py")
    )
    commands = evidence_commands()
    assert len(commands) > 200
    assert [one for one in commands if not is_made(one[1], table, tests)] == []
    assert not is_made("python tests/studies/of_nobody.py --count 3", table, tests)
    assert not is_made("N=1 python examples/of_nobody.py", table, "")


def programs_of_the_table() -> list[Any]:
    """Each program of the table, with the commands that run it."""
    found: dict[str, list[str]] = {}
    for job in weekly.jobs().values():
        for command in job["commands"]:
            if program := re.search(r"python (\S+\.py)", command):
                found.setdefault(program[1], []).append(command)
    return [pytest.param(*item, id=Path(item[0]).stem) for item in found.items()]


@pytest.mark.slow
@pytest.mark.campaign(6)
@pytest.mark.parametrize(("program", "commands"), programs_of_the_table())
def test_programs_of_the_table_take_their_options(
    program: str, commands: list[str]
) -> None:
    assert (ROOT / program).is_file()
    if "ArgumentParser" not in (ROOT / program).read_text(encoding="utf-8"):
        return
    told = subprocess.run(
        [sys.executable, program, "--help"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    for command in commands:
        given = shlex.split(command.partition(program)[2])
        for option in (word for word in given if word.startswith("--")):
            assert re.search(rf"{option}\b", told), command
        choices = re.match(r"usage: \S+ .*?\n? *\{([\w,]+)\}", told)
        if choices and given and not given[0].startswith("--"):
            assert given[0] in choices[1].split(","), command


def test_a_job_goes_on_after_a_command_that_fails_and_ends_with_one(
    capfd: pytest.CaptureFixture[str],
) -> None:
    job = {"setup": ["true"], "commands": ["false", "echo here; python --version"]}
    assert weekly.run_job(job) == ["false"]
    said = capfd.readouterr().out
    assert said.index("exit code 1") < said.index("\nhere") < said.rindex("exit code 0")
    assert weekly.run_job({"setup": ["exit 3"], "commands": ["echo begun"]}) == ["exit 3"]
    assert "\nbegun" not in capfd.readouterr().out


def test_the_table_lists_its_jobs_and_what_they_need(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert weekly.main([]) == 0
    names = json.loads(capsys.readouterr().out)
    assert {"page", "reliability"} <= {*names}
    assert "device" not in names
    assert weekly.main(["page", "--packages"]) == 0
    assert "chromium" in capsys.readouterr().out
