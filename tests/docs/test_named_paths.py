"""Paths, modules and commits that the prose names are those of the repository."""

from __future__ import annotations

import re
import subprocess
from inspect import isclass
from pathlib import Path

import pytest
from doc_pages import evidence

import flexdt as fx

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "flexdt/library", "protocol", "twin", "phantoms", "runtime", "server", "clients", "examples",
    "tests", "docker", "docs", ".ci", ".github", "extensions",
)  # fmt: skip
# The changelog names what there was at the time.
PROSE = sorted(
    {*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md"), *ROOT.glob("protocol/*.md")}
    - {ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("_*/**/*.md")}
)
EVIDENCE = evidence()
# Not files of the repository: a secret that its reader makes, and what `make docs` makes.
ELSEWHERE = re.compile(r"docker/token\b|docs/_build\b")
PATH = re.compile(
    rf"(?<![\w./-])((?:{'|'.join(map(re.escape, FOLDERS))})/[\w./*<>-]*[\w/*>])"
)
BARE = re.compile(r"`(\w+\.py)`")
MODULE = re.compile(r"(?<![\w.])flexdt((?:\.[a-z_][a-z_0-9]*)+)")
FILES = {path.name for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}


def named_paths(text: str) -> set[str]:
    return {path for path in PATH.findall(text) if not ELSEWHERE.match(path)}


def modules(text: str) -> set[str]:
    """Longest dotted names under `flexdt` that stand in `text`, as paths without an ending."""
    return {name[1:].replace(".", "/") for name in MODULE.findall(text)}


def is_module(path: str) -> bool:
    """Whether `path` is a module or a package, or a name inside one that is a module."""
    parts = path.split("/")
    package = ROOT / "flexdt"
    if not (package / parts[0]).exists() and not (package / f"{parts[0]}.py").exists():
        return True  # a name of the public face, such as flexdt.open
    for count in range(len(parts), 0, -1):
        whole = package.joinpath(*parts[:count])
        file = whole.with_suffix(".py")
        if file.is_file() or (whole / "__init__.py").is_file():
            rest = parts[count:]
            source = (file if file.is_file() else whole / "__init__.py").read_text()
            return not rest or (
                len(rest) <= 2 and re.search(rf"\b{rest[0]}\b", source) is not None
            )
    return False


@pytest.mark.parametrize(
    "page", [*PROSE, *EVIDENCE], ids=lambda p: p.name.removesuffix(".md")
)
def test_named_paths_and_modules_exist(page: Path) -> None:
    text = EVIDENCE[page] if page in EVIDENCE else page.read_text()
    places = ROOT, page.parent
    paths = {
        p
        for p in named_paths(text)
        if not any(list(o.glob(p.rstrip("/"))) for o in places)
    }
    assert paths == set(), f"{page.relative_to(ROOT)} names what is not in the repository"
    bare = {name for name in BARE.findall(text) if name not in FILES}
    assert bare == set(), f"{page.relative_to(ROOT)} names files that are nowhere"
    assert {m for m in modules(text) if not is_module(m)} == set(), page.relative_to(ROOT)


def test_architecture_names_every_room() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    rooms = {
        path.parent.relative_to(ROOT).as_posix() + "/"
        for folder in FOLDERS[:7]
        for path in (ROOT / folder).glob("*/__init__.py")
        if not path.parent.is_symlink()
    }
    assert len(rooms) > 25
    small = {"phantoms/files/"}
    assert {room for room in rooms - small if f"`{room}`" not in text} == set()


def test_processes_started_by_name_are_in_the_table() -> None:
    """Modules named as strings are invisible to import-linter, so the page lists who names
    them."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    started = re.compile(r"[\"']flexdt\.(?:runtime|server|clients)\.(?:[\w.]*\.main|launch\.up|cli"
                         r"|server|bench|child|worker)[\"']")  # fmt: skip
    naming = {
        path.relative_to(ROOT).as_posix()
        for folder in ("runtime", "server", "clients")
        for path in (ROOT / folder).rglob("*.py")
        if started.search(path.read_text())
    }
    assert len(naming) >= 5
    assert {path for path in naming if f"`{path}`" not in text} == set()


def test_modules_that_look_others_up_by_name_are_in_the_table() -> None:
    """import-linter cannot see these arrows."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    files = [
        path
        for folder in (*FOLDERS[:7], "flexdt/testing")
        for path in (ROOT / folder).rglob("*.py")
        if "node_modules" not in path.parts
    ]
    files += (ROOT / "flexdt").glob("*.py")
    looking = {
        path.relative_to(ROOT).as_posix()
        for path in files
        if re.search(r"\bimport_module\(", path.read_text())
    }
    assert len(looking) >= 8
    assert {path for path in looking if f"`{path}`" not in text} == set()


def test_members_of_public_classes_are_in_the_named_modules() -> None:
    """A reader goes from the table of `flexdt/__init__.py` to a class; a base class in
    another file is a step that ARCHITECTURE has to save."""
    text = (ROOT / "ARCHITECTURE.md").read_text()
    classes = [value for name in fx.__all__ if isclass(value := getattr(fx, name))]
    assert len(classes) > 10
    elsewhere = {
        f"{base.__module__.removeprefix('flexdt.').replace('.', '/')}.py": cls.__name__
        for cls in classes
        for base in cls.__mro__[1:]
        if base.__module__.startswith("flexdt.") and base.__module__ != cls.__module__
        if any(not name.startswith("_") for name in vars(base))
    }
    assert {file: cls for file, cls in elsewhere.items() if file not in text} == {}


def test_commits_given_as_examples_exist() -> None:
    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=False
        )

    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("needs the whole history of a git clone")
    hashes = re.findall(r"`([0-9a-f]{7})`", (ROOT / "CONTRIBUTING.md").read_text())
    assert len(hashes) == 6
    for commit in hashes:
        assert git("cat-file", "-e", f"{commit}^{{commit}}").returncode == 0, commit
