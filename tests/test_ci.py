"""Continuous integration: what the workflows run, and what `.ci/run` says of a test that
fails."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import weekly
import yaml
from doc_pages import pages

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = ROOT / ".github" / "workflows"
PARTS = ["lint", "test", "test-extensions", "studies", "page", "docs"]


def workflow(name: str) -> dict[Any, Any]:
    loaded = yaml.safe_load((WORKFLOWS / name).read_text())
    assert isinstance(loaded, dict)
    return loaded


def commands(job: dict[str, Any]) -> list[str]:
    return [step["run"] for step in job["steps"] if "run" in step]


def targets() -> set[str]:
    return set(
        re.findall(r"^([a-z][a-z -]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    )


def test_each_part_of_ci_is_a_job() -> None:
    loaded = workflow("tests.yml")
    assert {"push", "pull_request"} <= set(loaded[True])  # YAML 1.1 reads `on` as true
    job = loaded["jobs"]["linux"]
    assert job["strategy"]["matrix"]["part"] == PARTS
    assert job["strategy"]["fail-fast"] is False
    assert ".ci/run ${{ matrix.part }}" in commands(job)
    assert set(PARTS) <= targets()


def test_browsers_run_where_debian_has_chromium() -> None:
    """On Ubuntu apt installs a stub that asks for a snap."""
    for path in sorted(WORKFLOWS.glob("*.yml")):
        for name, job in workflow(path.name)["jobs"].items():
            text = json.dumps(job)
            if "chromium" in text or "page" in json.dumps(job.get("strategy")):
                assert re.fullmatch(
                    r"python:3\.\d+-bookworm", job.get("container", "")
                ), name


def test_campaigns_and_resolutions_run_weekly() -> None:
    loaded = workflow("weekly.yml")
    (entry,) = loaded[True]["schedule"]
    minute, hour, day, month, weekday = entry["cron"].split()
    assert minute.isdecimal()
    assert hour.isdecimal()
    assert (day, month) == ("*", "*")
    assert weekday in "0123456"
    jobs = loaded["jobs"]
    assert 'make campaigns CAMPAIGNS="${{ matrix.tests }}"' in commands(jobs["campaigns"])
    kinds = {
        row["resolution"] for row in jobs["resolutions"]["strategy"]["matrix"]["include"]
    }
    assert kinds == {"lowest", "newest"}
    assert "make ${{ matrix.resolution }} PYTHON=python" in commands(jobs["resolutions"])


def test_every_test_module_is_in_a_weekly_job() -> None:
    """Campaigns may be in any module, so that a new one needs no word in the workflow."""
    matrix = workflow("weekly.yml")["jobs"]["campaigns"]["strategy"]["matrix"]["tests"]
    places = [ROOT / name for row in matrix for name in row.split()]
    assert [place for place in places if not place.exists()] == []
    modules = [
        path
        for folder in ("tests", "extensions/tests")
        for path in (ROOT / folder).rglob("test_*.py")
    ]
    assert len(modules) > 300
    left = [p for p in modules if not any(p.is_relative_to(place) for place in places)]
    assert [path.relative_to(ROOT).as_posix() for path in left] == []


STEP_KEYS = {
    "name",
    "run",
    "uses",
    "with",
    "if",
    "env",
    "id",
    "shell",
    "working-directory",
}
MADE = re.compile(r"> (\S+/\S+)")
"""A file that a step writes for later ones."""
EXPRESSION = re.compile(r"\$\{\{.*?\}\}")
"""What a runner replaces before the shell reads a command."""


def steps() -> list[tuple[str, dict[str, Any]]]:
    """Each step of each workflow, with the name of its place."""
    return [
        (f"{path.name}, {name}, step {i}", step)
        for path in sorted(WORKFLOWS.glob("*.yml"))
        for name, job in workflow(path.name)["jobs"].items()
        for i, step in enumerate(job["steps"], 1)
    ]


def test_every_step_of_the_workflows_is_a_sound_command() -> None:
    """Shells read each command, and what it names of this repository is there."""
    made = {file for _, step in steps() for file in MADE.findall(step.get("run", ""))}
    for where, step in steps():
        assert set(step) <= STEP_KEYS, where
        assert ("run" in step) != ("uses" in step), where
        if "run" not in step:
            assert re.fullmatch(r"[\w.-]+/[\w./-]+@(v|release/v)\d+", step["uses"]), where
            continue
        text = EXPRESSION.sub("expression", step["run"])
        read = subprocess.run(
            ["bash", "-n"], input=text, capture_output=True, text=True, check=False
        )
        assert read.returncode == 0, (where, read.stderr)
        for target in re.findall(r"\bmake ([a-z][a-z-]*)", text):
            assert target in {*targets(), "expression"}, (where, target)
        for file in re.findall(
            r"(?:^|\s)((?:\.ci|docker|tests|extensions)/[\w./-]+)", text
        ):
            assert file in made or (ROOT / file).exists(), (where, file)


def test_each_table_of_programs_is_a_weekly_job() -> None:
    loaded = workflow("weekly.yml")["jobs"]
    assert any(
        "$(python3 tests/studies/weekly.py)" in c for c in commands(loaded["table"])
    )
    matrix = loaded["programs"]["strategy"]["matrix"]
    assert matrix == {"job": "${{ fromJSON(needs.table.outputs.jobs) }}"}
    assert ".venv/bin/python tests/studies/weekly.py ${{ matrix.job }}" in commands(
        loaded["programs"]
    )


NEEDS = re.compile(r"`[^`\n]*(?: others/|evidence --data)[^`\n]*`")
"""A command that needs what CI lacks: others' data or programs."""
DATE = re.compile(r"\b20\d\d-\d\d-\d\d\b")


def others_commands() -> list[tuple[str, str, str]]:
    """Each such command of the documentation: page, command, and the row or paragraph around
    it."""
    found = []
    for page, whole in pages().items():
        text = re.sub(r"^```.*?^```", "", whole, flags=re.MULTILINE | re.DOTALL)
        for block in re.split(r"\n\n|\n(?=\|)", text):
            for command in NEEDS.findall(block):
                found.append(
                    (page.relative_to(ROOT).as_posix(), command.strip("`"), block)
                )
    return found


def test_figures_that_ci_cannot_make_are_dated_and_made_weekly() -> None:
    known = others_commands()
    assert len({command for _, command, _ in known}) >= 4
    made_weekly = "\n".join(weekly.jobs()["others"]["commands"])
    for page, command, block in known:
        assert DATE.search(block), (page, command)
        program = re.search(r"\S+\.py|flexdt evidence", command)
        assert program is not None, command
        assert program[0] in made_weekly, (page, command)
        assert program[0] == "flexdt evidence" or (ROOT / program[0]).is_file()


MAKE = """#!/bin/sh
echo "make $*" >> calls
case "$*" in
  "{failing}") exit 2 ;;
  failed) exit {second} ;;
esac
"""
"""Stands in for make: one part fails, and the tests that failed do again or not."""


def run_ci(
    folder: Path,
    *parts: str,
    failing: str = "",
    second: int = 0,
    failed: tuple[str, ...] = (),
) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """Run a copy of `.ci/run` with a make of our own; its outcome, and the calls of make."""
    (folder / ".ci").mkdir()
    for name in ("run", "last_failed.py"):
        (folder / ".ci" / name).write_bytes((ROOT / ".ci" / name).read_bytes())
    (folder / "bin").mkdir()
    (folder / "bin" / "make").write_text(MAKE.format(failing=failing, second=second))
    (folder / "bin" / "apt-get").write_text("#!/bin/sh\n")
    for program in (folder / "bin").iterdir():
        program.chmod(0o755)
    cache = folder / ".pytest_cache" / "v" / "cache"
    cache.mkdir(parents=True)
    if failed:
        (cache / "lastfailed").write_text(json.dumps(dict.fromkeys(failed, True)))
    done = subprocess.run(
        ["bash", folder / ".ci" / "run", *parts],
        env={
            **os.environ,
            "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
            "GITHUB_STEP_SUMMARY": str(folder / "summary"),
        },
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    calls = folder / "calls"
    return done, calls.read_text().splitlines() if calls.exists() else []


FAILED = ("tests/a/test_a.py::test_one[x]", "tests/b/test_b.py::test_two")


def test_a_run_without_failures_makes_each_part_once(tmp_path: Path) -> None:
    done, calls = run_ci(tmp_path, *PARTS[:3])
    assert done.returncode == 0
    assert calls == [f"make {part}" for part in PARTS[:3]]
    assert "FAILED" not in done.stdout
    assert "FLAKY" not in done.stdout


def test_tests_that_pass_at_the_second_run_are_named_before_and_after_it(
    tmp_path: Path,
) -> None:
    done, calls = run_ci(tmp_path, "test", "studies", failing="test", failed=FAILED)
    assert done.returncode == 0
    assert calls == ["make test", "make failed", "make studies"]
    before, _, after = done.stdout.partition("FLAKY")
    assert "make test: FAILED AT FIRST" in before
    for name in FAILED:
        assert name in before
        assert name in after
    assert (tmp_path / "summary").read_text().count(FAILED[0]) == 2


def test_tests_that_fail_twice_end_the_run(tmp_path: Path) -> None:
    done, calls = run_ci(
        tmp_path, "test", "studies", failing="test", second=1, failed=FAILED
    )
    assert done.returncode == 1
    assert calls == ["make test", "make failed"]
    assert FAILED[1] in done.stdout
    assert "FLAKY" not in done.stdout


def test_a_failure_that_is_no_tests_is_not_repeated(tmp_path: Path) -> None:
    done, calls = run_ci(tmp_path, "test", failing="test")
    assert done.returncode == 1
    assert calls == ["make test"]
    assert "no test did" in done.stderr


@pytest.mark.parametrize(("second", "code"), [("assert True", 0), ("assert False", 1)])
def test_what_failed_is_run_again_wherever_it_is_and_nothing_else(
    tmp_path: Path, second: str, code: int
) -> None:
    """pytest's own `--last-failed` runs all of `testpaths` where it meets none of the failed."""
    (tmp_path / "pytest.ini").write_text("[pytest]\ntestpaths = inside\n")
    for folder in ("inside", "outside"):
        (tmp_path / folder).mkdir()
    noted = (
        "from pathlib import Path\n\ndef note():\n    Path('ran').open('a').write('.')\n"
    )
    (tmp_path / "inside" / "test_all.py").write_text(
        f"{noted}\ndef test_other():\n    note()\n"
    )
    outside = tmp_path / "outside" / "test_one.py"
    outside.write_text(
        "import pytest\n@pytest.mark.parametrize('x', ['a b', '[c]'])\n"
        "def test_one(x): assert False\n"
    )

    def python(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *words],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

    assert python("-m", "pytest", "outside").returncode == 1
    outside.write_text(outside.read_text().replace("assert False", second))
    again = python(str(ROOT / ".ci" / "last_failed.py"), "--run")
    assert again.returncode == code
    assert not (tmp_path / "ran").exists()
    assert "2 passed" in again.stdout or "2 failed" in again.stdout
    assert "outside/test_one.py::test_one[a b]" in again.stdout
    names = python(str(ROOT / ".ci" / "last_failed.py"))
    assert names.returncode == 1 - code


@pytest.mark.parametrize("part", ["slow", "tes", "--help"])
def test_an_unknown_part_is_refused_with_those_there_are(
    part: str, tmp_path: Path
) -> None:
    done, calls = run_ci(tmp_path, part)
    assert (done.returncode, calls) == (2, [])
    assert all(name in done.stderr for name in (*PARTS, part))


def test_without_a_part_all_are_run(tmp_path: Path) -> None:
    done, calls = run_ci(tmp_path)
    assert done.returncode == 0, done.stderr
    assert calls == [f"make {part}" for part in PARTS]
