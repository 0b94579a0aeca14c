"""The examples run as their first lines say, each as a program of its own."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flexdt.clients.launch.processes import Servers

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(name: str, *words: object) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / name), *map(str, words)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [
        line for line in done.stderr.splitlines() if "flexdt: still " not in line
    ] == []
    return done.stdout


def test_drive_from_python(servers: Servers) -> None:
    out = run("drive_from_python.py", *servers.address)
    # SOD 585 + 14.9192, SDD from home 1059 + 40.0008 (profile cwi-2023-08-21).
    assert "SOD 599.919 mm, SDD 1099.001 mm, magnification 1.8319" in out
    assert "projection (760, 956)" in out


@pytest.mark.campaign
def test_several_projectors() -> None:
    out = run("several_projectors.py", "--projectors", 2, "--frames", 24)
    assert out.startswith("26 images: ")  # 24 poses, dark and flat
    assert "bytes equal" in out


def test_submit_a_script_then_read_the_data_set(
    servers: Servers, data_dir: Path, tmp_path: Path, fly_script: Callable[..., str]
) -> None:
    script = tmp_path / "scan.txt"
    script.write_bytes(fly_script(13).encode())
    out = run("submit_a_script.py", script, *servers.address)
    assert out.startswith("13 frames, ")
    folder = Path(out.rpartition("done: data set ")[2].strip())
    assert folder.parent == data_dir
    out = run("read_a_dataset.py", folder)
    assert "13 projections of 200 x 160, complete: True" in out


PROGRAMS = [p for p in sorted(EXAMPLES.glob("*.py")) if "argparse" in p.read_text()]


@pytest.mark.daily(3)
@pytest.mark.parametrize("path", PROGRAMS, ids=lambda p: p.name)
def test_every_program_explains_itself(path: Path) -> None:
    assert "usage:" in run(path.name, "--help")


def named(file: Path) -> set[str]:
    """Examples that a test file's code names: as `name.py`, or by `run("name")`,
    `load("name")`."""
    nodes = list(ast.walk(ast.parse(file.read_text())))
    files = {
        n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)
    }
    stems = {
        f"{n.args[0].value}.py"
        for n in nodes
        if isinstance(n, ast.Call)
        and isinstance(n.func, ast.Name)
        and n.func.id in ("run", "load")
        and n.args
        and isinstance(n.args[0], ast.Constant)
    }
    return files | stems


def test_every_example_is_run_by_a_test() -> None:
    """Named by a test's code as a whole, not mentioned in passing."""
    root = EXAMPLES.parent
    for folder in (root, root / "extensions"):
        tests = (folder / "tests").rglob("test_*.py")
        code = set().union(*(named(file) for file in tests))
        examples = (folder / "examples").glob("*.py")
        assert [p.name for p in examples if p.name not in code] == []


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda p: p.name)
def test_every_example_says_how_to_run_it(path: Path) -> None:
    assert f"python examples/{path.name}" in path.read_text().split('"""')[1]
