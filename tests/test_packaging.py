"""The distribution: every package is listed, and a built wheel works far from the
repository."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from collections import Counter
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from setuptools import find_packages

ROOT = Path(__file__).resolve().parents[1]
CODE = ("protocol", "twin", "phantoms", "runtime", "server", "clients")
FOLDERS = ("flexdt", *CODE)
TEXTS = ("pyproject.toml", "setup.py", "README.md", "LICENSE")


def present() -> set[str]:
    inits = (
        init.parent for folder in FOLDERS for init in (ROOT / folder).rglob("__init__.py")
    )
    inside = (init.relative_to(ROOT).parts for init in inits)
    return {".".join(p if p[0] == "flexdt" else ("flexdt", *p)) for p in inside}


def test_the_package_is_seen_whole_through_its_links() -> None:
    """setuptools, type checkers and import-linter walk `src/`, and must find what lies on
    top."""
    walked = find_packages(str(ROOT / "src"))
    assert sorted(walked) == sorted(present())
    for folder in CODE:
        assert (ROOT / "src" / "flexdt" / folder).resolve() == ROOT / folder
    assert find_packages(str(ROOT / "extensions" / "src")) == find_packages(
        str(ROOT / "extensions"), include=["flexdt_extensions*"]
    )


def sources(folder: str) -> list[Path]:
    """The Python files of a folder, but for those of the page's tools."""
    return [p for p in (ROOT / folder).rglob("*.py") if "node_modules" not in p.parts]


def test_a_file_name_means_one_thing_and_no_room_is_crowded() -> None:
    """Only the entry points of the processes share their names."""
    modules = [path for folder in FOLDERS for path in sources(folder)]
    own = [p for p in modules if p.stem not in ("__init__", "__main__", "main")]
    assert sorted({p.name for p in own if sum(q.name == p.name for q in own) > 1}) == []
    rooms = Counter(path.parent for path in modules)
    assert {room.name: n for room, n in rooms.items() if n > 17} == {}


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {
        path.parent
        for folder in FOLDERS
        for path in sources(folder)
        if "data" not in path.relative_to(ROOT).parts
    }
    assert [str(f) for f in sorted(folders) if not (f / "__init__.py").is_file()] == []


def test_all_folders_are_typed() -> None:
    assert all((ROOT / folder / "py.typed").is_file() for folder in FOLDERS)


def checkout(source: Path, *, links: bool = True) -> None:
    """Copy what is tracked of the project; without links each is a text file with its target,
    as Git on Windows makes them."""
    tracked = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, check=True,
    ).stdout.decode().split("\0")  # fmt: skip
    for name in filter(None, tracked):
        path = ROOT / name
        if name.split("/")[0] not in (*FOLDERS, "src", "extensions", *TEXTS):
            continue
        if not (path.exists() or path.is_symlink()):
            continue
        target = source / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink() and not links:
            target.write_text(os.readlink(path))
        else:
            shutil.copy2(path, target, follow_symlinks=False)


def built(out: Path, place: str) -> Path:
    """The wheel of the project in the folder `place` of the repository, made from its sdist."""
    # A copy, because setuptools writes build/ and egg-info beside the sources.
    source = out / "source"
    checkout(source)
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), "."],
        cwd=source / place, check=True, capture_output=True,
    )  # fmt: skip
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("wheel"), ".")


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


def outside(
    installed: Path, tmp_path: Path, *words: str
) -> subprocess.CompletedProcess[str]:
    """Run Python so that flexdt can only come from the installed wheel.

    -S leaves out the editable install's path; the dependencies' folder is named instead.
    """
    dependencies = [p for p in sys.path if p.endswith("site-packages")]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment["PYTHONPATH"] = os.pathsep.join([str(installed), *dependencies])
    return subprocess.run(
        [sys.executable, "-S", *words],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip


def environment_with(folder: Path, *more: Path) -> Path:
    """A new environment with the dependencies of this one, without flexdt; its Python."""
    venv.create(folder, with_pip=False)
    (site,) = folder.glob("lib/python*/site-packages")
    dependencies = [p for p in sys.path if p.endswith("site-packages")]
    (site / "dependencies.pth").write_text(
        "\n".join([*map(str, more), *dependencies]) + "\n"
    )
    return folder / "bin" / "python"


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_the_wheel_holds_only_flexdt(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {
        "flexdt",
        "flexdt_command.py",  # the console script's first module
        next(n.split("/")[0] for n in names if n.endswith(".dist-info/METADATA")),
    }
    assert not [
        n for n in names if "__pycache__" in n or n.endswith((".nbi", ".nbc", ".ts"))
    ]


def building(source: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation",
         "--disable-pip-version-check", "--wheel-dir", str(source / "out"), *words],
        cwd=source, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_a_checkout_without_links_gives_the_same_wheels(
    wheel: Path, tmp_path: Path
) -> None:
    checkout(tmp_path, links=False)
    assert (tmp_path / "src" / "flexdt").is_file()
    done = building(tmp_path, ".", "./extensions")
    assert done.returncode == 0, done.stderr
    (own,) = (tmp_path / "out").glob("flexdt-*.whl")
    linked, copied = (zipfile.ZipFile(each) for each in (wheel, own))
    assert {n: linked.read(n) for n in linked.namelist() if n.endswith(".py")} == {
        n: copied.read(n) for n in copied.namelist() if n.endswith(".py")
    }
    assert sorted(linked.namelist()) == sorted(copied.namelist())
    (more,) = (tmp_path / "out").glob("flexdt_extensions-*.whl")
    assert "flexdt_extensions/__init__.py" in zipfile.ZipFile(more).namelist()


@pytest.mark.parametrize(
    "missing", ["src/flexdt", "flexdt/twin", "src/flexdt_command.py"]
)
def test_a_checkout_that_lacks_a_link_is_refused_in_one_sentence(
    tmp_path: Path, missing: str
) -> None:
    """What builds it, run as setuptools does; an archive may have dropped links altogether."""
    checkout(tmp_path, links=False)
    (tmp_path / missing).write_text("../nothing")
    done = subprocess.run(
        [sys.executable, "setup.py", "--version"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    (told,) = done.stderr.splitlines()
    assert missing in told
    assert "core.symlinks=true" in told


@pytest.mark.slow
def test_the_wheel_of_the_extensions_holds_only_them(tmp_path: Path) -> None:
    files = zipfile.ZipFile(built(tmp_path, "extensions"))
    names = files.namelist()
    (about,) = (
        name.split("/")[0] for name in names if name.endswith(".dist-info/METADATA")
    )
    assert {name.split("/")[0] for name in names} == {"flexdt_extensions", about}
    package = ROOT / "extensions" / "flexdt_extensions"
    modules = {p.relative_to(package.parent).as_posix() for p in package.rglob("*.py")}
    assert {name for name in names if name.endswith(".py")} == modules
    points = files.read(f"{about}/entry_points.txt").decode()
    assert "[flexdt.commands]" in points
    assert f"{about}/licenses/LICENSE" in names


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_nothing_is_left_after_uninstalling(wheel: Path, tmp_path: Path) -> None:
    """Compiled kernels lay beside the package: its empty folder was imported still."""
    python = environment_with(tmp_path / "env")
    pip = [sys.executable, "-m", "pip", "--python", str(python)]
    quiet = ["--quiet", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "install", *quiet, "--no-deps", "--no-index", wheel], check=True
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environment["FLEXDT_CACHE"] = str(tmp_path / "kernels")
    use = (
        "from flexdt.twin.projection.kernels.compiling import serial\n"
        "import flexdt; print(flexdt.__file__); serial(lambda x: x)(1)"
    )
    used = subprocess.run(
        [python, "-c", use],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert used.stdout.startswith(str(tmp_path / "env"))
    subprocess.run([*pip, "uninstall", *quiet, "--yes", "flexdt"], check=True)
    (site,) = (tmp_path / "env").glob("lib/python*/site-packages")
    assert [path.name for path in site.iterdir() if "flexdt" in path.name] == []


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_the_wheel_imports_as_flexdt_and_nothing_else(
    installed: Path, tmp_path: Path
) -> None:
    program = (
        "import importlib, importlib.util, json, pkgutil, sys\n"
        f"folders = {list(CODE)!r}\n"
        "found = []\n"
        "for folder in folders:\n"
        "    top = importlib.import_module('flexdt.' + folder)\n"
        "    found.append(top.__file__)\n"
        "    for m in pkgutil.walk_packages(top.__path__, top.__name__ + '.'):\n"
        # PyTorch's operator needs a library that no test environment must have.
        "        if not m.name.endswith('__main__') and not m.name.endswith('.for_torch'):\n"
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
@pytest.mark.campaign
def test_a_folder_of_its_name_does_not_stand_in_an_installed_flexdts_way(
    installed: Path, tmp_path: Path
) -> None:
    """Who installs without `-e` goes on in the clone, whose folder `flexdt/` Python finds
    first."""
    python = environment_with(tmp_path / "venv", installed)
    (tmp_path / "flexdt").mkdir()
    (tmp_path / "flexdt" / "__init__.py").write_text(
        "raise SystemExit('the wrong one')\n"
    )
    program = tmp_path / "programs" / "program.py"
    program.parent.mkdir()
    program.write_text(
        "import flexdt as fx\n"
        "with fx.LocalTwin() as twin:\n"
        "    print(len(twin.state().axes), fx.__file__)\n"
    )
    done = subprocess.run(
        [python, program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["9", str(installed / "flexdt" / "__init__.py")]


@pytest.mark.parametrize("place", ["inside", "beside", "far"])
def test_an_editable_install_is_found_from_everywhere(place: str, tmp_path: Path) -> None:
    """A clone called `flexdt` is a folder without `__init__.py` that Python meets first."""
    python = environment_with(tmp_path / "venv", ROOT / "src")
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "flexdt").symlink_to(ROOT, target_is_directory=True)
    (tmp_path / "far").mkdir()
    where = {"inside": ROOT, "beside": tmp_path / "beside", "far": tmp_path / "far"}[
        place
    ]
    words = [
        python,
        "-c",
        "import flexdt as fx; print(fx.ConeVec.__name__, fx.TwinClient.__name__)",
    ]
    done = subprocess.run(words, cwd=where, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("ConeVec TwinClient\n", "")


@pytest.mark.slow
def test_the_wheel_carries_its_data(installed: Path) -> None:
    for folder in CODE:
        for path in (ROOT / folder).rglob("data/**/*"):
            if path.is_file() and "__pycache__" not in path.parts and path.name[0] != ".":
                assert (installed / "flexdt" / path.relative_to(ROOT)).is_file(), path


def test_the_demos_script_is_the_example() -> None:
    example = ROOT / "examples" / "scripts" / "lego-fly-180.txt"
    assert (ROOT / "clients" / "data" / example.name).read_bytes() == example.read_bytes()


def test_what_the_interface_names_can_be_imported() -> None:
    """The lines that other people's programs begin with."""
    names = {
        "flexdt.clients": "TwinClient",
        "flexdt.twin.geometry.cone_vec": "ConeVec",
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


@pytest.mark.slow
@pytest.mark.campaign
def test_a_users_type_checker_sees_the_types(tmp_path: Path) -> None:
    """An editable install puts `src/` on the path; type checkers follow it."""
    python = environment_with(tmp_path / "venv", ROOT / "src")
    user = tmp_path / "user" / "program.py"
    user.parent.mkdir()
    user.write_text(
        "from flexdt.clients import TwinClient\n"
        "from flexdt.twin.geometry import ConeVec\n"
        "def rows(geometry: ConeVec) -> None:\n"
        "    reveal_type(geometry.rows)\n"
        "    geometry.no_such_name\n"
        "def state(twin: TwinClient) -> None:\n"
        "    reveal_type(twin.state())\n"
        "import flexdt as fx\n"
        "reveal_type(fx.open('scan').geometry)\n"
        "fx.no_such_name\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"),
         "--python-executable", str(python), user.name],
        cwd=user.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    told = done.stdout.splitlines()
    assert len(told) == 6, done.stdout + done.stderr
    assert "float64" in told[0]
    assert "no_such_name" in told[1]
    assert 'Revealed type is "flexdt.protocol.state_model.State"' in told[2]
    assert 'Revealed type is "flexdt.twin.geometry.cone_vec.ConeVec"' in told[3]
    assert "no_such_name" in told[4]


def test_the_image_is_built_from_every_folder_of_the_package() -> None:
    copied = (ROOT / "docker" / "Dockerfile").read_text()
    assert [f for f in ("src", *FOLDERS) if f"COPY {f} {f}\n" not in copied] == []


def test_one_version_everywhere() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        version = tomllib.load(file)["project"]["version"]
    with (ROOT / "extensions" / "pyproject.toml").open("rb") as file:
        extensions = tomllib.load(file)["project"]
    assert extensions["version"] == version
    [flexdt] = [
        r for r in map(Requirement, extensions["dependencies"]) if r.name == "flexdt"
    ]
    assert version in flexdt.specifier
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert str(citation["version"]) == version
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert f"## {version} ({citation['date-released']})" in changelog


CONDA = {
    "matplotlib": "matplotlib-base",
    "msgpack": "msgpack-python",
    "opencv-python-headless": "py-opencv",
    "prometheus-client": "prometheus_client",
}
"""conda-forge's names of distributions that have another one."""


def test_the_conda_recipe_is_that_of_this_version() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == project["version"]
    name = re.compile(r"[\w-]+")
    wanted = [f"python {project['requires-python']}"]
    for text in project["dependencies"]:
        found = name.match(text)
        assert found is not None
        wanted.append(f"{CONDA.get(found[0], found[0])} {text[found.end() :]}")
    assert recipe["requirements"]["run"] == wanted
    ((command, point),) = project["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [f"{command} = {point}"]


def test_bounds_are_no_tighter_than_those_of_our_dependencies() -> None:
    """rich and websockets are bounded for viser's sake: by its own bounds, and no others."""
    from importlib.metadata import requires

    with (ROOT / "pyproject.toml").open("rb") as file:
        ours = {
            r.name: r
            for r in map(Requirement, tomllib.load(file)["project"]["dependencies"])
        }
    theirs = {r.name: r for r in map(Requirement, requires("viser") or [])}
    for name in ("rich", "websockets", "trimesh", "numpy"):
        upper = {
            (part.operator, part.version.removesuffix(".0").removesuffix(".0"))
            for requirement in (ours[name], theirs[name])
            for part in requirement.specifier
            if part.operator.startswith("<")
        }
        assert len(upper) == 1, (name, upper)


@pytest.mark.parametrize(
    "file", sorted((ROOT / ".github").rglob("*.yml")) + [ROOT / ".pre-commit-config.yaml"],
    ids=lambda p: p.name,
)  # fmt: skip
def test_configurations_for_services_can_be_read(file: Path) -> None:
    assert isinstance(yaml.safe_load(file.read_text()), dict)


def test_the_development_container_can_be_read() -> None:
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert container["postCreateCommand"] == "make install"


def test_a_module_that_is_a_program_begins_below_all_that_it_needs() -> None:
    """A merge left one's beginning above functions that its work calls minutes later."""
    programs = [
        path
        for folder in CODE
        for path in (ROOT / folder).rglob("*.py")
        if "node_modules" not in path.parts
        and "\nif __name__ ==" in path.read_text("utf-8")
    ]
    assert len(programs) >= 5
    for path in programs:
        last = path.read_text("utf-8").rpartition("\nif __name__ ==")[2]
        assert all(line[:1].isspace() or not line for line in last.splitlines()[1:]), path
