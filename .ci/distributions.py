"""Build wheels and source archives of both distributions and try them where nothing else is.

    python .ci/distributions.py [--out dist] [--python 3.11 3.12 3.13] [--story]

Builds from a clone of what is committed, so that no stray file gets in. For each Python that this
machine has, a clean environment gets the two wheels, and one more the two source archives; in
each `flexdt --version`, `flexdt doctor` and a scan from mesh to volume are run. `--story` also
executes the story's notebooks on each (`tests/studies/story_from_wheel.py`). Ends with a table,
and with 1 where something failed; a Python that is not there is named and is no failure.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
DISTRIBUTIONS: Final = (".", "extensions")
TRIED: Final = """
import flexdt as fx, trimesh
trimesh.creation.box((12.0, 8.0, 10.0)).export("part.stl")
scan = fx.ConeVec.circular(sod=400, sdd=800, angles=36, shape=(24, 30), pixel=2.0)
data = fx.simulate("part.stl", scan, material="aluminium", tube=fx.Tube(kV=80), noise=1)
data.save("scan")
volume = fx.open("scan").reconstruct("fdk", voxel=1.0, errors=False)
assert 0.05 < volume.data[12, 14:17, 14:17].mean() < 0.3, volume
import flexdt_extensions.batch
assert "site-packages" in fx.__file__, fx.__file__
"""
"""A part's way to a volume, with nothing but what was installed."""


def ran(*words: object, cwd: Path | None = None) -> None:
    """Run a command quietly; its output is shown if it fails."""
    done = subprocess.run(
        [*map(str, words)], cwd=cwd, check=False, capture_output=True, text=True
    )
    if done.returncode:
        print(done.stdout[-4000:], done.stderr[-4000:], sep="\n", file=sys.stderr)
        raise subprocess.CalledProcessError(done.returncode, [*map(str, words)])


def built(out: Path) -> list[Path]:
    """Build both distributions from a clone, and return wheels and source archives."""
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("flexdt*"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "clone"
        ran("git", "clone", "-q", ROOT, clone)
        for part in DISTRIBUTIONS:
            ran(sys.executable, "-m", "uv", "build", "-q", "--out-dir", out, clone / part)
    return sorted(out.glob("flexdt*"))


def python_of(version: str) -> str | None:
    """Find an interpreter of a version; None if this machine has none."""
    found = shutil.which(f"python{version}")
    own = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    if own:
        return str(own[-1])
    return found


def tried(python: str, files: list[Path]) -> None:
    """Install files into a clean environment, and use what they bring."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        ran(sys.executable, "-m", "uv", "venv", "-q", "--python", python, where / "env")
        own = where / "env" / "bin" / "python"
        install = [sys.executable, "-m", "uv", "pip", "install", "-q", "--python", own]
        ran(*install, *files)
        ran(own.with_name("flexdt"), "--version", cwd=where)
        ran(own.with_name("flexdt"), "doctor", cwd=where)
        ran(own, "-c", TRIED, cwd=where)


def main() -> int:
    """Build, try, and print what held."""
    parser = argparse.ArgumentParser(description="both distributions, built and tried")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--python", nargs="+", default=["3.11", "3.12", "3.13"])
    parser.add_argument("--story", action="store_true")
    options = parser.parse_args()
    files = built(options.out.resolve())
    print(*(f"{file.name}  {file.stat().st_size >> 10} kB" for file in files), sep="\n")
    wheels = [file for file in files if file.suffix == ".whl"]
    archives = [file for file in files if file.suffix == ".gz"]
    failed = 0
    for version in options.python:
        python = python_of(version)
        if python is None:
            print(f"Python {version}: not on this machine")
            continue
        kinds = [("wheels", wheels)]
        if version == options.python[0]:
            kinds.append(("source archives", archives))
        for kind, several in kinds:
            try:
                tried(python, several)
                print(f"Python {version}: {kind} installed and used", flush=True)
            except subprocess.CalledProcessError as error:
                failed += 1
                print(f"Python {version}: {kind}: {error}", flush=True)
        if options.story:
            story = ROOT / "tests" / "studies" / "story_from_wheel.py"
            (wheel,) = (file for file in wheels if file.name.startswith("flexdt-"))
            words = [sys.executable, story, "--wheel", wheel, "--python", python]
            failed += subprocess.run([*map(str, words)], check=False).returncode
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
