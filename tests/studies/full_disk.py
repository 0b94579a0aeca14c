"""Full disks: `full_disk.py --histories 500 --real 10 --seed 1`.

`--histories`: drawn histories of a twin on a simulated disk that becomes full at any write,
with kills (`tests/support/full_disk_histories.py`). `--real`: a real twin on a small file
system of its own (tmpfs, or ext4 in a file with `--ext4`, for root alone), which an observer's
uploads fill as far as they may and another program to the last byte; then settings, motion and
an E-stop, `kill -9` and a restart. The rest of the machine does not see that file system
(`unshare`). Ends with 1 where anything acknowledged was lost, or an upload took the room of the
state.
"""

from __future__ import annotations

import argparse
import errno
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from lab import Refused, Wire, twin

INSIDE = "FLEXDT_TEST_OWN_MOUNTS"
SIZE_MB = 64
PART = 1 << 20
LAST_MB = 3
"""Uploads leave at least so much."""


def one_history(seed: int) -> tuple[int, int, int, str]:
    """Requests, refusals and kills of a drawn history, and what was lost."""
    from full_disk_histories import run_history

    with tempfile.TemporaryDirectory() as folder:
        try:
            seen = run_history(Path(folder), seed)
        except AssertionError as error:
            return 0, 0, 0, f"history {seed}: {error}"
    return seen.asked, seen.refused, seen.kills, ""


def simulated(count: int, seed: int, jobs: int) -> list[str]:
    """Live histories on a simulated full disk, in several processes.

    Args:
        count: how many.
        seed: of the first.
        jobs: processes.

    Returns:
        What was lost, a text for each history that lost something.
    """
    begun = time.process_time()
    with ProcessPoolExecutor(jobs) as pool:
        found = list(pool.map(one_history, range(seed, seed + count)))
    asked, refused, kills = (sum(f[i] for f in found) for i in range(3))
    lost = [f[3] for f in found if f[3]]
    print(f"{count} histories, seeds from {seed}: {asked} requests, {refused} refused for want of "
          f"room, {kills} kills, {len(lost)} lost something acknowledged "
          f"({time.process_time() - begun:.0f} s of this process)", flush=True)  # fmt: skip
    return lost


class SmallDisk:
    """A file system of its own for a data directory."""

    def __init__(self, folder: Path, *, ext4: bool) -> None:
        """Make and mount a file system of SIZE_MB below a folder.

        Args:
            folder: an empty one.
            ext4: in an image by a loop device, which needs root; otherwise tmpfs.
        """
        self.root = folder / "disk"
        self.root.mkdir()
        if ext4:
            image = folder / "image"
            with image.open("wb") as file:
                file.truncate(SIZE_MB << 20)
            subprocess.run(["mkfs.ext4", "-q", "-m", "0", image], check=True)
            subprocess.run(["mount", "-o", "loop", image, self.root], check=True)
        else:
            size = f"size={SIZE_MB}m"
            subprocess.run(
                ["mount", "-t", "tmpfs", "-o", size, "tmpfs", self.root], check=True
            )
        self._fill = self.root / "another-program"

    def free(self) -> int:
        about = os.statvfs(self.root)
        return about.f_bavail * about.f_frsize

    def fill(self) -> None:
        """To the last byte."""
        with self._fill.open("ab", buffering=0) as file:
            for size in (PART, 4096, 1):
                while True:
                    try:
                        file.write(b"x" * size)
                    except OSError as error:
                        if error.errno != errno.ENOSPC:
                            raise
                        break

    def empty(self) -> None:
        self._fill.unlink(missing_ok=True)

    def end(self) -> None:
        subprocess.run(["umount", self.root], check=True)


def fill_by_uploads(port: int) -> int:
    """Upload as an observer until that is refused for want of room.

    Returns:
        How many bytes were taken.

    Raises:
        Refused: an upload was refused for another reason.
        AssertionError: 200 uploads were not refused.
    """
    wire, taken = Wire(port), 0
    for number in range(200):
        voxels = {"shape": [64, 64, 64], "voxel_mm": [0.1, 0.1, 0.1], "kind": "voxels"}
        try:
            wire.call("sample.upload", name=f"fill-{number}", format="raw", total=PART,
                      data="AAAA" * (PART // 3) + "AA==", **voxels)  # fmt: skip
        except Refused as error:
            if "-32001" not in str(error):
                raise
            return taken
        taken += PART
    raise AssertionError("nothing stopped the uploads")


def seen(wire: Wire) -> dict[str, Any]:
    """What is to survive."""
    state = wire.call("state.get")
    return {
        "estop": state["safety"]["estop"],
        "kV": state["tube"]["kV"],
        "exposure": state["camera"]["exposure_ms"],
        "at": round(state["axes"]["rot_obj"]["position"], 6),
        "unsaved": state["unsaved"],
    }


def one_life(disk: SmallDisk, rng: random.Random) -> list[str]:
    """A twin on a disk that is filled; returns what went wrong."""
    wrong, data = [], disk.root / "data"
    process = twin(9, data, "--sample", "empty", "--speed-up", "max")
    try:
        taken = fill_by_uploads(process.port)
        if disk.free() < LAST_MB << 20:
            wrong.append(f"uploads of {taken} bytes left {disk.free()} bytes")
        disk.fill()
        wire = Wire(process.port)
        for _ in range(rng.randint(1, 30)):
            wire.call("tube.set", kV=float(rng.randint(40, 90)))
            wire.call("camera.set", exposure_ms=float(rng.randint(50, 900)))
        wire.call(
            "axes.move", targets={"rot_obj": float(rng.randint(-90, 90))}, wait=True
        )
        time.sleep(1.0)  # positions are written a moment later
        if rng.random() < 0.7:
            wire.call("safety.estop")
            time.sleep(0.5)
        before = seen(wire)
        if before["unsaved"] is not None:
            wrong.append(f"not on the disk: {before['unsaved']}")
        os.kill(process.pid, signal.SIGKILL)
        process.child.wait()
        process = twin(9, data)
        after = seen(Wire(process.port))
        if before != after:
            wrong.append(f"{before} became {after}")
    finally:
        process.end()
    disk.empty()
    return wrong


def real(count: int, seed: int, *, ext4: bool) -> list[str]:
    """Live so many lives of a twin on a real full disk.

    Returns:
        What went wrong, a text for each.
    """
    wrong = []
    for number in range(count):
        with tempfile.TemporaryDirectory() as folder:
            disk = SmallDisk(Path(folder), ext4=ext4)
            try:
                found = one_life(disk, random.Random(seed + number))
            finally:
                disk.end()
        wrong += [f"life {number}: {words}" for words in found]
    print(f"{count} twins on a full {'ext4' if ext4 else 'tmpfs'} of {SIZE_MB} MB, seeds from "
          f"{seed}: {len(wrong)} problems", flush=True)  # fmt: skip
    return wrong


def main() -> int:
    """Live histories on a simulated full disk, and on a real one if asked; 1 where
    something was wrong.

    For a real disk the process starts itself again with mounts of its own.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--histories", type=int, default=20)
    p.add_argument("--real", type=int, default=0, help="twins on a real full disk")
    p.add_argument(
        "--ext4", action="store_true", help="in a file, for root; otherwise tmpfs"
    )
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--jobs", type=int, default=2)
    options = p.parse_args()
    if options.real and INSIDE not in os.environ:
        own = [*([] if options.ext4 else ["--map-root-user"]), "--mount"]
        words = ["unshare", *own, sys.executable, __file__, *sys.argv[1:]]
        os.execvpe("unshare", words, {**os.environ, INSIDE: "1"})
    wrong = (
        simulated(options.histories, options.seed, options.jobs)
        if options.histories
        else []
    )
    if options.real:
        wrong += real(options.real, options.seed, ext4=options.ext4)
    print(*wrong, sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
