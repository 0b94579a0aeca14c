"""Build flexdt from a checkout whose links are links, or text files that hold their targets.

Git on Windows and some archives make text files of links (ARCHITECTURE.md, decision 1).
A wheel is then built from a copy in which each is what it names; all else is in pyproject.toml.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent
COPY = HERE / "build" / "without-links"
LEFT_OUT = shutil.ignore_patterns("__pycache__", "node_modules", "*.egg-info")
MISSING = (
    "flexdt cannot be built here: {} is no link and names no folder or file. Clone with"
    " `git clone -c core.symlinks=true`, or install a wheel or an sdist."
)
COPY_ONLY = (
    "flexdt: without links in the checkout only a wheel can be built (`pip install .`): clone with"
    " `git clone -c core.symlinks=true` for an editable installation or an sdist."
)


def named(path: Path) -> Path:
    """Return what a text file in a link's place names.

    Raises:
        SystemExit: it names nothing that is there.
    """
    try:
        target = path.parent / path.read_text("utf-8").strip()
        found = target.resolve(strict=True)
    except (OSError, ValueError):
        raise SystemExit(MISSING.format(path.relative_to(HERE))) from None
    return found


def copied() -> Path:
    """Copy the package with what its links' text files name; return the copy's folder.

    Raises:
        SystemExit: a link is missing, or something else than a wheel is asked for.
    """
    if {"sdist", "editable_wheel", "develop"} & set(sys.argv):
        raise SystemExit(COPY_ONLY)
    shutil.rmtree(COPY, ignore_errors=True)
    package = named(HERE / "src" / "flexdt")
    shutil.copytree(package, COPY / "flexdt", ignore=LEFT_OUT)
    shutil.copyfile(named(HERE / "src" / "flexdt_command.py"), COPY / "flexdt_command.py")
    for path in package.iterdir():
        if path.is_file() and not path.suffix and path.name != "py.typed":
            (COPY / "flexdt" / path.name).unlink()
            shutil.copytree(named(path), COPY / "flexdt" / path.name, ignore=LEFT_OUT)
    return COPY


def folder_of_packages() -> str:
    """Return the folder with the package, relative to this file's."""
    if (HERE / "src" / "flexdt" / "twin" / "__init__.py").is_file():
        return "src"
    return copied().relative_to(HERE).as_posix()


if __name__ == "__main__":
    where = folder_of_packages()
    setup(package_dir={"": where}, packages=find_packages(where))
