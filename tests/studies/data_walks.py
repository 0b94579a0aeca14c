"""Count the files and rooms that data walk through.

    python tests/studies/data_walks.py [--json FILE]

Four things that users do are run under a profiler hook, in this process. For each it prints how
many files and rooms (folders) of flexdt take part, and how often the walk climbs back: pairs of
functions in different rooms where the called one's room has called the caller's room, too.

The program uses public names alone, so that it also runs on an older state of the repository.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import flexdt as fx

ROOT = Path(fx.__file__).resolve().parents[1]


class Walk:
    """Files, rooms and crossings of the calls inside a `with` block."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self.crossings: set[tuple[str, str, str, str]] = set()
        self._places: dict[str, str | None] = {}

    def __enter__(self) -> Walk:
        threading.setprofile(self._called)
        sys.setprofile(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    @property
    def rooms(self) -> set[str]:
        """Folders of the files."""
        return {file.rpartition("/")[0] for file in self.files}

    def _place(self, name: str) -> str | None:
        """A source file of the package, relative to the repository; None for any other."""
        if name not in self._places:
            path = Path(name).resolve() if name.endswith(".py") else None
            own = (
                path is not None
                and path.is_relative_to(ROOT)
                and ".venv" not in path.parts
            )
            self._places[name] = (
                path.relative_to(ROOT).as_posix() if own and path else None
            )
        return self._places[name]

    def _called(self, frame: FrameType, event: str, _: Any) -> None:
        """Note a call of the product's code; the profiler calls this.

        The caller is the next frame of the product; calls from tests and within a folder
        cross nothing.
        """
        if event != "call" or frame.f_code.co_name == "<module>":
            return
        file = self._place(frame.f_code.co_filename)
        if file is None or file.startswith(("tests/", "flexdt/testing/")):
            return
        self.files.add(file)
        caller = frame.f_back
        while (
            caller is not None
            and (from_ := self._place(caller.f_code.co_filename)) is None
        ):
            caller = caller.f_back
        if (
            caller is None
            or from_ is None
            or from_.startswith(("tests/", "flexdt/testing/"))
        ):
            return
        rooms = from_.rpartition("/")[0], file.rpartition("/")[0]
        if rooms[0] != rooms[1]:
            self.crossings.add((*rooms, caller.f_code.co_name, frame.f_code.co_name))

    @property
    def climbs(self) -> set[tuple[str, str, str, str]]:
        """Crossings between two rooms that call each other, those of the rarer direction."""
        count = Counter(crossing[:2] for crossing in self.crossings)
        return {c for c in self.crossings if 0 < count[c[1], c[0]] >= count[c[0], c[1]]}


def scan(frames: int) -> fx.DataSet:
    """A small scan of the LEGO phantom on a circle."""
    geometry = fx.ConeVec.circular(
        sod=441.0, sdd=1100.0, angles=frames, shape=(190, 239), pixel=0.598
    )
    return fx.simulate("lego", geometry)


def move_to_image(walk: Walk) -> None:
    """Move a motor, and take a radiograph there."""
    from flexdt.testing import twin

    with twin(sample="lego") as lab, walk:
        lab.client.move({"mag_obj": 500.0}, wait=True)
        lab.client.projection(binning=8)


def script_to_files(walk: Walk) -> None:
    """Submit a scan script, and wait until its data set is complete.

    Raises:
        SystemExit: the job ended otherwise.
    """
    from flexdt.testing import twin

    lines = [
        "tube\tset kV\t90\t\tACK",
        "camera\tset exposure\t100\t\tACK",
        "tube\txrayon\t\t\tACK",
        "tube\tREPEAT UNTIL TRUE status_XReady_get\t\t\tACK",
        "camera\ttake image\t\t\tACK",
        "camera\tsave image\tE:\\walk\\scan_000000.tif\t\tACK",
        "rot_obj\tmove absolute\t10\t\tACK",
        "camera\ttake image\t\t\tACK",
        "camera\tsave image\tE:\\walk\\scan_000001.tif\t\tACK",
        "tube\txrayoff\t\t\tACK",
    ]
    with twin(sample="lego", speed_up="max") as lab, walk:
        job = lab.client.submit_script("\r\n".join(lines) + "\r\n", "walk").job
        state = lab.client.wait_job(job).state
    if state != "done":
        raise SystemExit(f"the script ended as {state}")


def beads_to_correction(walk: Walk) -> None:
    """Calibrate from images of beads."""
    data = scan(24)
    with walk:
        data.calibrate("lego")


def images_to_volume(walk: Walk) -> None:
    """Reconstruct images."""
    data = scan(36)
    with walk:
        data.reconstruct("fdk", voxel=0.5)


WALKS: dict[str, Callable[[Walk], None]] = {
    "move to image": move_to_image,
    "script to TIFF": script_to_files,
    "beads to correction": beads_to_correction,
    "images to volume": images_to_volume,
}


def main() -> None:
    """Walk and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument(
        "--json", type=Path, help="write the counts, and the files of each walk"
    )
    chosen = parser.parse_args()
    found = {}
    for name, walked in WALKS.items():
        walked(Walk())  # compiled and loaded
        walk = Walk()
        walked(walk)
        files = sorted(walk.files)
        found[name] = {
            "files": files,
            "rooms": sorted(walk.rooms),
            "climbs": len(walk.climbs),
        }
        print(
            f"{name:20s} {len(files):4d} files {len(walk.rooms):3d} rooms "
            f"{len(walk.climbs):4d} climbs back"
        )
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
