"""What first and second use cost by where compiled kernels are kept, on one core.

    python tests/studies/cache_places.py

Each row runs ten lines of the library (simulate, save, open, reconstruct) in two processes, one
after the other, with the folders of the row and no other; the shared folder is filled first.
Prints processor time [s] of both.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

LINES: Final = """
import resource
import flexdt as fx
scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=24, shape=(95, 120), pixel=1.2)
data = fx.simulate("lego", scan, tube=fx.Tube(kV=90), noise=1)
data.save(FOLDER)
fx.open(FOLDER).reconstruct("fdk", voxel=1.0)
used = resource.getrusage(resource.RUSAGE_SELF)
print(used.ru_utime + used.ru_stime)
"""
SHARED: Final = "import sys; sys.prefix = {prefix!r}\n"
ONE_CORE: Final = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"


def places(folder: Path) -> Iterator[tuple[str, dict[str, str], str]]:
    """Yield name, environment and first lines of each row; folders are made by who may write."""
    nowhere = folder / "file"
    nowhere.touch()
    no = {"XDG_CACHE_HOME": str(nowhere), "FLEXDT_CACHE": str(nowhere / "x")}
    yield "FLEXDT_CACHE", no | {"FLEXDT_CACHE": str(folder / "told")}, ""
    yield "the user's cache", no | {"XDG_CACHE_HOME": str(folder / "home")}, ""
    temporary = folder / "tmp"
    temporary.mkdir()
    yield "TMPDIR", no | {"TMPDIR": str(temporary)}, ""
    shared = folder / "prefix" / "share" / "flexdt" / "kernels"
    shared.mkdir(parents=True)
    for kept in (folder / "told").iterdir():
        (shared / kept.name).write_bytes(kept.read_bytes())
    yield "the installation's", no, SHARED.format(prefix=str(folder / "prefix"))
    tmp_too = {"TMPDIR": str(nowhere)}
    yield "nowhere", no | tmp_too, "import tempfile; tempfile.tempdir = '/dev/null/x'\n"


def used_s(environment: dict[str, str], before: str, folder: Path) -> float:
    """Run the lines in a process of one core; return its processor time [s]."""
    program = before + ONE_CORE + LINES.replace("FOLDER", repr(str(folder)))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout.split()[-1])


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        print(f"{'kept in':20} {'first':>8} {'second':>8}  processor time [s]")
        for number, (name, environment, before) in enumerate(places(folder)):
            taken = [
                used_s(environment, before, folder / f"scan{number}-{turn}")
                for turn in range(2)
            ]
            print(f"{name:20} {taken[0]:8.1f} {taken[1]:8.1f}", flush=True)


if __name__ == "__main__":
    main()
