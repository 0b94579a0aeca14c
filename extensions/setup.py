"""Build flexdt-extensions from a checkout with links or without; all else is in pyproject.toml."""

from __future__ import annotations

from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent

if __name__ == "__main__":
    where = "src" if (HERE / "src" / "flexdt_extensions").is_dir() else "."
    setup(
        package_dir={"": where},
        packages=find_packages(where, include=["flexdt_extensions*"]),
    )
