"""The distribution: every package is listed, and a built wheel works far from the repository."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("protocol", "twin", "phantoms", "server", "clients")


def listed() -> dict[str, list[str]]:
    with (ROOT / "pyproject.toml").open("rb") as file:
        tool = tomllib.load(file)["tool"]["setuptools"]
    return {"packages": tool["packages"], "folders": list(tool["package-dir"])}


def present() -> set[str]:
    return {
        "flexdt." + ".".join(init.parent.relative_to(ROOT).parts)
        for folder in FOLDERS
        for init in (ROOT / folder).rglob("__init__.py")
    }


def test_every_package_is_listed_and_every_listed_package_is_there() -> None:
    assert sorted(listed()["packages"]) == sorted(present())


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {
        path.parent
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
        if "data" not in path.relative_to(ROOT).parts
    }
    assert [str(f) for f in sorted(folders) if not (f / "__init__.py").is_file()] == []


def test_all_five_are_typed() -> None:
    assert all((ROOT / folder / "py.typed").is_file() for folder in FOLDERS)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    # A copy, because setuptools writes build/ and egg-info beside the sources.
    source = out / "source"
    tracked = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, check=True,
    ).stdout.decode().split("\0")  # fmt: skip
    for name in filter(None, tracked):
        if name.split("/")[0] in (*FOLDERS, "pyproject.toml", "README.md", "LICENSE"):
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / name).is_file():
                target.write_bytes((ROOT / name).read_bytes())
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), "."],
        cwd=source, check=True, capture_output=True,
    )  # fmt: skip
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel alone in a folder; dependencies come from this environment."""
    target = tmp_path_factory.mktemp("installed")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index",
         "--disable-pip-version-check", "--target", str(target), str(wheel)],
        check=True, capture_output=True,
    )  # fmt: skip
    return target


def outside(installed: Path, tmp_path: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python so that flexdt can only come from the installed wheel.

    -S leaves out the editable install's import hook; the dependencies' folder is named instead.
    """
    dependencies = [p for p in sys.path if p.endswith("site-packages")]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment["PYTHONPATH"] = os.pathsep.join([str(installed), *dependencies])
    return subprocess.run(
        [sys.executable, "-S", *words],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_the_wheel_holds_only_flexdt(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {
        "flexdt",
        next(n.split("/")[0] for n in names if n.endswith(".dist-info/METADATA")),
    }
    assert not [n for n in names if "__pycache__" in n or n.endswith((".nbi", ".nbc"))]


@pytest.mark.slow
def test_the_wheel_imports_as_flexdt_and_nothing_else(installed: Path, tmp_path: Path) -> None:
    program = (
        "import importlib, importlib.util, json, pkgutil, sys\n"
        f"folders = {list(FOLDERS)!r}\n"
        "found = []\n"
        "for folder in folders:\n"
        "    top = importlib.import_module('flexdt.' + folder)\n"
        "    found.append(top.__file__)\n"
        "    for m in pkgutil.walk_packages(top.__path__, top.__name__ + '.'):\n"
        "        if not m.name.endswith('__main__'):\n"
        "            found.append(importlib.import_module(m.name).__file__)\n"
        "bare = [f for f in folders if importlib.util.find_spec(f) is not None]\n"
        "print(json.dumps({'files': found, 'bare': bare}))\n"
    )
    done = outside(installed, tmp_path, "-c", program)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.splitlines()[-1])
    assert answer["bare"] == []
    assert len(answer["files"]) > len(present())
    assert [f for f in answer["files"] if not f.startswith(str(installed))] == []


@pytest.mark.slow
def test_the_installed_command_answers(installed: Path, tmp_path: Path) -> None:
    done = outside(installed, tmp_path, str(installed / "bin" / "flexdt"), "--help")
    assert done.returncode == 0, done.stderr
    assert "Usage: flexdt" in done.stdout


@pytest.mark.slow
def test_the_wheel_carries_its_data(installed: Path) -> None:
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("data/**/*"):
            if path.is_file() and "__pycache__" not in path.parts and path.name[0] != ".":
                assert (installed / "flexdt" / path.relative_to(ROOT)).is_file(), path


def test_the_demos_script_is_the_example() -> None:
    example = ROOT / "examples" / "scripts" / "lego-fly-360.txt"
    assert (ROOT / "clients" / "data" / example.name).read_bytes() == example.read_bytes()


def test_what_the_interface_names_can_be_imported() -> None:
    """The lines that other people's programs begin with."""
    names = {
        "flexdt.clients": "TwinClient",
        "flexdt.twin.geometry": "ConeVec",
        "flexdt.twin.projection": "Volume forward back",
        "flexdt.twin.reconstruction": "fdk sirt cgls",
        "flexdt.twin.script": "parse_script plan_script",
        "flexdt.twin.calibration": "detect_beads identify_beads fit_geometry identifiability",
        "flexdt.phantoms": "bead_phantom lego_phantom load_phantom",
    }
    for module, wanted in names.items():
        found = importlib.import_module(module)
        for name in wanted.split():
            assert callable(getattr(found, name))
