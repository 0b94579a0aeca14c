"""A user without a home and without rights, over an installation that belongs to somebody else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt.runtime.kernels import kernel_files

ROOT = Path(__file__).resolve().parents[2]
UID = 54321
LINES = """
import numpy as np
import flexdt as fx
scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=24, shape=(24, 30), pixel=4.8)
data = fx.simulate("lego", scan, tube=fx.Tube(kV=90), noise=1)
data.save("lego-scan")
print(fx.open("lego-scan").reconstruct("fdk", voxel=4.0).shape)
"""
DEMO = "from flexdt.clients.cli import main\nmain(['demo', '--no-viewer'])"


def reached(path: Path) -> bool:
    """Whether any user may go to a file and read it."""
    steps = path.resolve().parents
    return all(step.stat().st_mode & 0o001 for step in steps) and bool(
        path.resolve().stat().st_mode & 0o004
    )


def interpreter() -> Path | None:
    """A Python of this version that any user may run."""
    name = f"python{sys.version_info.major}.{sys.version_info.minor}"
    others = [Path(found) for found in [shutil.which(name, path="/usr/bin")] if found]
    return next((p for p in (Path(sys.executable), *others) if reached(p)), None)


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder where the other user may write, with an environment that only its owner may
    change."""
    python = interpreter()
    if not hasattr(os, "getuid") or os.getuid() != 0:
        pytest.skip("needs root, to become another user")
    if python is None or not reached(ROOT / "pyproject.toml"):
        pytest.skip("no other user can reach this interpreter and this checkout")
    folder = Path(tempfile.mkdtemp(prefix="flexdt-place-"))
    folder.chmod(0o755)
    subprocess.run([python, "-m", "venv", "--without-pip", folder / "env"], check=True)
    (site,) = folder.glob("env/lib/python*/site-packages")
    paths = [str(ROOT / "src"), *(p for p in sys.path if p.endswith("site-packages"))]
    (site / "all.pth").write_text("\n".join(paths) + "\n")
    (folder / "work").mkdir()
    os.chown(folder / "work", UID, UID)
    yield folder
    shutil.rmtree(folder)
    shutil.rmtree(f"{tempfile.gettempdir()}/flexdt-kernels-{UID}", ignore_errors=True)


def as_other_user(
    place: Path, program: str, **more: str
) -> subprocess.CompletedProcess[str]:
    unset = (
        "HOME",
        "XDG_CACHE_HOME",
        "XDG_CONFIG_HOME",
        "FLEXDT_CACHE",
        "NUMBA_CACHE_DIR",
    )
    environment = {
        k: v for k, v in os.environ.items() if k not in unset and "PYTHON" not in k
    }
    return subprocess.run(
        [place / "env" / "bin" / "python", "-c", program],
        env=environment | more,
        user=UID,
        group=UID,
        extra_groups=[],
        cwd=place / "work",
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_ten_lines_run_without_home_and_rights_over_kernels_of_others(
    place: Path,
) -> None:
    """What an administrator has compiled serves: nothing is compiled, nothing written there."""
    shared = place / "shared"
    for item in (i for p in kernel_files.places() for i in kernel_files.items(p.folder)):
        kernel_files.put(
            shared, item.stem, item.read_bytes()[kernel_files.DIGEST_BYTES :]
        )
    before = kernel_files.items(shared)
    first = as_other_user(place, LINES, FLEXDT_CACHE=str(shared))
    assert first.returncode == 0, first.stderr
    shutil.rmtree(place / "work" / "lego-scan")
    done = as_other_user(place, LINES, FLEXDT_CACHE=str(shared))
    assert done.returncode == 0, done.stderr
    assert done.stdout == first.stdout != ""
    assert "compiling" not in done.stderr
    assert kernel_files.items(shared) == before


@pytest.mark.night
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_demonstration_runs_without_home_and_rights(place: Path) -> None:
    done = as_other_user(place, DEMO)
    assert done.returncode == 0, done.stderr
    assert "the truth lies inside the joint 95 % region" in done.stdout
