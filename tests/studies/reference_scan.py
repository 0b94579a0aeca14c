"""The reference scan of the LEGO phantom (thesis 6.5.1), simulated, reconstructed and measured.

Starts the servers, scans 1434 projections over a turn, reconstructs 160 x 240 x 498 voxels of
0.1 mm (the phantom's short side along y here), finds the five beads in the volume and compares
them with where the phantom has them; then the same from the scanner's two texts alone. Prints
times and peak memory: of the largest process, and of all together (sampled twice a second,
pages that processes share counted once). About 4 GB of disk; `--frames 240 --voxel 0.2` is a
quick one.

    python tests/studies/reference_scan.py --out /tmp/reference --physics poly
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import threading
import time
from pathlib import Path

import numpy as np

from flexdt.clients import TwinClient
from flexdt.clients.cli.commands.job_commands import follow
from flexdt.clients.launch.processes import Servers
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction.reconstruct import (
    VolumeRequest,
    reconstruct_dataset,
)
from flexdt.library.reconstruction.volume_files import read_volume
from flexdt.phantoms import lego_phantom
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.projection import Volume
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

SIZE_MM = (49.8, 16.0, 24.0)
"""z, y, x."""


def bead_centres(volume: Volume, beads: np.ndarray, radius: float) -> np.ndarray:
    """Find the centre of each bead in a volume: the centroid of voxels, weighted by a
    ramp from 0 at a quarter to 1 at three quarters of its brightness, which is the median
    of its 200 brightest voxels.

    Args:
        volume: reconstruction.
        beads: (k, 3) about where they are [mm].
        radius: of a bead [mm].

    Returns:
        (k, 3) [mm].
    """
    data, voxel = volume.data, float(volume.voxel_xyz[0])
    low = np.array(volume.center_mm) - (np.array(data.shape[::-1]) - 1) / 2 * voxel
    out = np.empty_like(beads)
    for i, bead in enumerate(beads):
        at = np.rint((bead - low) / voxel).astype(int)
        reach = int(np.ceil(1.5 * radius / voxel))
        a = np.maximum(at - reach, 0)
        x, y, z = (slice(p, q + reach + 1) for p, q in zip(a, at, strict=True))
        part = np.asarray(data[z, y, x], dtype=float)
        inner = float(np.median(np.sort(part.ravel())[-200:]))
        weight = np.clip((part / inner - 0.25) / 0.5, 0.0, 1.0)
        grid = np.meshgrid(*(np.arange(n) for n in part.shape), indexing="ij")
        mean = np.array([(g * weight).sum() / weight.sum() for g in grid])[::-1]
        out[i] = low + (a + mean) * voxel
    return out


def sharpness(volume: Volume) -> float:
    """Measure the sharpest edge there is: the steepest slope along y across a voxel over
    the brightest value, both as 99.99 % quantiles of every second layer.
    """
    data = np.asarray(volume.data[::2])
    steep = np.abs(np.diff(data, axis=1))
    return float(np.quantile(steep, 0.9999) / np.quantile(data, 0.9999))


def peak_gib(pid: int) -> float:
    """Return the largest peak of resident memory so far among the descendants of a
    process [GiB].
    """
    total = 0.0
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        except OSError:
            continue
        if int(fields["PPid"]) == pid:
            child = int(status.parent.name)
            total = max(total, peak_gib(child))
            if "VmHWM" in fields:
                total = max(total, float(fields["VmHWM"].split()[0]) / 2**20)
    return total


class Together:
    """The most memory that this process and all below it held at one time [GiB].

    Linux only: proportional set sizes, summed every half second by a thread.
    """

    def __init__(self) -> None:
        self.peak_gib = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Together:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stop.wait(0.5):
            self.peak_gib = max(self.peak_gib, sum(map(_held_gib, _family(os.getpid()))))


def _family(pid: int) -> list[int]:
    """List a process and all its descendants, the process first."""
    below: dict[int, list[int]] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue  # it has ended
        below.setdefault(parent, []).append(int(status.parent.name))
    family = [pid]
    for member in family:
        family += below.get(member, [])
    return family


def _held_gib(pid: int) -> float:
    """Return the proportional set size of a process [GiB]; 0 when it has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return next((float(x.split()[1]) / 2**20 for x in lines if x.startswith("Pss:")), 0.0)


def main() -> None:
    """Scan the LEGO phantom, reconstruct it twice, and print times, memory [GiB] and bead
    errors [mm] as JSON.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=1434)
    parser.add_argument("--voxel", type=float, default=0.1)
    parser.add_argument("--physics", default="ideal", choices=("ideal", "mono", "poly"))
    options = parser.parse_args()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    request = ScanRequest("fly", frames=options.frames)
    script = compose_script(request, machine, profile)
    figures: dict[str, object] = {"frames": options.frames, "physics": options.physics}
    with Together() as memory:
        _measure(options, script, figures)
    figures["reader_peak_gib"] = round(
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2
    )
    figures["all_processes_peak_gib"] = round(memory.peak_gib, 2)
    print(json.dumps(figures, indent=1))


def _measure(
    options: argparse.Namespace, script: str, figures: dict[str, object]
) -> None:
    """Make the reference scan unless its folder exists, reconstruct it with its document
    and from its texts alone, and compare the beads.

    Args:
        options: of the command line.
        script: of the scan.
        figures: gets times [s], memory [GiB], bead errors [mm] and sharpness.
    """
    out: Path = options.out
    folder = out / "data" / "reference"
    if not folder.exists():
        settings = {
            "data": (out / "data").absolute(),
            "speed-up": "max",
            "physics": options.physics,
        }
        (out / "data").mkdir(exist_ok=True)
        with (
            Servers(settings, out / "servers.log") as servers,
            TwinClient(*servers.address) as client,
        ):
            client.set_sample("lego")
            begun = time.monotonic()
            job = client.submit_script(script.encode(), name="reference", speed_up="max")
            follow(client, job.job, own=True)
            figures["scan_s"] = round(time.monotonic() - begun, 1)
            figures["servers_peak_gib"] = round(peak_gib(servers.pid), 2)
    shape = tuple(round(s / options.voxel) for s in SIZE_MM)
    phantom = lego_phantom()
    for name, texts in (("flexdt.json", False), ("texts alone", True)):
        data = load_dataset(folder, ignore_document=texts)
        made = reconstruct_dataset(
            data, out / f"{'texts' if texts else 'volume'}.tif",
            VolumeRequest(voxel_mm=options.voxel, shape=shape, png=True),
        )  # fmt: skip
        volume = read_volume(Path(str(made["file"])))
        found = bead_centres(volume, phantom.beads, float(phantom.bead_radius_mm[0]))
        errors = np.linalg.norm(found - phantom.beads, axis=1)
        figures[name] = {
            "reconstruct_s": made["seconds"],
            "bead_errors_mm": np.round(errors, 4).tolist(),
            "sharpness": round(sharpness(volume), 4),
        }


if __name__ == "__main__":
    main()
