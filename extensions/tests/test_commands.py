"""Commands by entry points: found when installed, and named with what to install when not."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path

import pytest

from flexdt.clients.cli.command_tree import GROUP, KNOWN, run
from flexdt.library.optional import extras

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def flexdt(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run([str(word) for word in words])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return code, captured.out, captured.err

    return call


def test_the_listed_commands_are_those_of_the_distribution() -> None:
    points = metadata.entry_points(group=GROUP)
    ours = {
        p.name.replace(".", " ") for p in points if p.dist.name == "flexdt-extensions"
    }
    assert ours == {*KNOWN}


@pytest.mark.parametrize("name", KNOWN)
def test_help_shows_the_commands_own_options(name: str, flexdt: Run) -> None:
    code, out, _ = flexdt(*name.split(), "--help")
    assert code == 0
    assert f"Usage: flexdt {name} [OPTIONS]" in out
    assert {"evidence": "--data", "job watch": "--stop-when"}.get(name, "--out") in out


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if flexdt were installed alone."""

    def none(**_: object) -> Iterable[object]:
        return ()

    monkeypatch.setattr(extras, "entry_points", none)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    "more", [[], ["--help"], ["x.json", "--out", "y"], ["--jobs", "2"]]
)
@pytest.mark.parametrize("name", KNOWN)
def test_without_the_distribution_one_line_says_what_to_install(
    name: str, more: list[str], flexdt: Run
) -> None:
    code, out, err = flexdt(*name.split(), *more)
    assert (code, out) == (1, "")
    assert err == (
        f"flexdt: `flexdt {name}` needs flexdt-extensions, which is not installed: "
        "pip install ./extensions in a clone of flexdt\n"
    )


@pytest.mark.usefixtures("alone")
def test_without_the_distribution_the_help_page_is_the_same(flexdt: Run) -> None:
    code, out, _ = flexdt("--help")
    assert code == 0
    assert all(f"  {name} " in out for name in KNOWN if " " not in name)
    assert flexdt("no-such-command")[0] == 2


@pytest.mark.parametrize(
    "words",
    [
        ["study", "everything"],
        ["study", "beads", "--fidelity", "perfect"],
        ["study", "real", "--seed", "-1"],
    ],
)
def test_usage_errors_leave_with_2(words: list[str], flexdt: Run) -> None:
    code, out, _ = flexdt(*words)
    assert (code, out) == (2, "")


def test_bench_tells_a_wrong_option_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.clients.cli", "bench", "--only", "foo"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert "no case foo; there are: C1, " in done.stderr
    assert done.stderr.count("\n") == 1


def test_study_in_small(
    flexdt: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command's own part: its document is what run_study gives, and summary.json is it."""
    from flexdt_extensions.studies import study as body

    full = body.run_study

    def small(*words: object, **options: object) -> dict[str, object]:
        return full(*words, counts=(5,), **options)  # type: ignore[arg-type]

    monkeypatch.setattr(body, "run_study", small)
    code, out, _ = flexdt("study", "damping", "--out", tmp_path, "--jobs", 1, "--json")
    assert code == 0
    document = json.loads(out)
    assert document == json.loads((tmp_path / "summary.json").read_text())
    assert (document["experiment"], document["fidelity"]) == ("damping", "points")
    settings = [row["setting"] for row in document["rows"]]
    assert len(settings) == 4
    assert all(
        row["success"] == row["runs"] and row["mae"] < 1e-6 for row in document["rows"]
    )
    code, out, _ = flexdt("study", "damping", "--jobs", 1)
    assert code == 0
    assert "thesis MAE" in out
