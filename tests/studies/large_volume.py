"""How long FDK by workers will take: rates of this machine, and a plan for another.

    python tests/studies/large_volume.py [--nodes N] [--cores C]
        [--read GB/S] [--write GB/S]

Measured here, with all cores: voxel updates of the backprojection, pixels filtered, pixels read
and made line integrals (from files that the system has in memory), and voxels written as Zarr.
The plan multiplies them by what --side, --views, --panel and the slabs of `flexdt reconstruct
--scheduler` ask for. A core of another machine is taken to be one of this machine, and work to
be shared evenly; --read and --write are what all nodes together read and write a second, --gpus
with --updates (voxel updates a second of each) replaces the processors' backprojection. None of
these is measured.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from lab import machine

import flexdt as fx
from flexdt.twin.reconstruction import fdk
from flexdt.twin.reconstruction.feldkamp.filtering import filtered, ramp
from flexdt_extensions.fdk_on_workers import create, put_whole, slabs


def seconds(work: Callable[[], object], least_s: float = 0.0) -> float:
    """Of one call, the least of three (or of as many as take `least_s`), after one before."""
    work()
    found: list[float] = []
    begun = time.perf_counter()
    while len(found) < 3 or time.perf_counter() - begun < least_s:
        at = time.perf_counter()
        work()
        found.append(time.perf_counter() - at)
    return min(found)


def rates(folder: Path) -> dict[str, float]:
    """What this machine does in a second: voxel updates, pixels filtered and read, bytes
    written.

    Args:
        folder: for files.
    """
    rows, cols, views, side = 256, 256, 64, 192
    scan = fx.ConeVec.circular(
        sod=600, sdd=1000, angles=views, shape=(rows, cols), pixel=0.4
    )
    images = np.random.default_rng(1).random((views, rows, cols), dtype=np.float32)
    images[:, :, :64] = images[:, :, -64:] = 0.0  # nothing is cut off
    grid = fx.Grid((side,) * 3, 0.3)
    response = ramp(cols, 0.24)
    filter_s = seconds(lambda: filtered(images, response))
    whole_s = seconds(lambda: fdk(images, scan, grid, errors=False))
    few = fx.ConeVec.circular(sod=600, sdd=1000, angles=4, shape=(1024, 1024), pixel=0.1)
    fx.simulate(fx.Volume(np.full((8, 8, 8), 0.02, np.float32), 2.0), few).save(
        folder / "scan"
    )
    data = fx.open(folder / "scan")
    data.line_integrals(0)  # darks and flats are read once
    read_s = seconds(lambda: [data.line_integrals(i) for i in range(4)])
    slab = fx.Grid((64, 512, 512), 0.3)
    store = folder / "volume.zarr"
    create(store, slab)
    values = np.random.default_rng(2).random(slab.shape, dtype=np.float32)
    write_s = seconds(lambda: put_whole(store, slab, 0, values))
    return {
        "updates": views * side**3 / max(whole_s - filter_s, 1e-9),
        "filtered": images.size / filter_s,
        "read": 4 * 1024**2 / read_s,
        "written": 4 * values.size / write_s,
    }


def main() -> None:
    """Measure rates on this machine, and print how long a large volume would take on a
    cluster.
    """
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--side", type=int, default=4096)
    p.add_argument("--views", type=int, default=3600)
    p.add_argument("--panel", default="4096,4096", metavar="ROWS,COLS")
    p.add_argument("--nodes", type=int, default=64)
    p.add_argument("--cores", type=int, default=64, help="Of a node.")
    p.add_argument("--gpus", type=int, default=0, help="In all.")
    p.add_argument("--updates", type=float, default=5e10, help="Of a GPU (assumed).")
    p.add_argument(
        "--read", type=float, default=20.0, help="GB/s of all nodes (assumed)."
    )
    p.add_argument(
        "--write", type=float, default=10.0, help="GB/s of all nodes (assumed)."
    )
    o = p.parse_args()
    rows, cols = (int(n) for n in o.panel.split(","))
    with tempfile.TemporaryDirectory() as name:
        found = rates(Path(name))
    here = os.cpu_count() or 1
    print(
          f"{machine()}: {found['updates'] / 1e9:.2f} G voxel updates, "
          f"{found['filtered'] / 1e6:.0f} M pixels filtered, {found['read'] / 1e6:.0f} "
          f"M pixels read and made line integrals, {found['written'] / 1e6:.0f} MB written a second"
    )  # fmt: skip
    grid = fx.Grid((o.side,) * 3, 1.0)
    count = len(slabs(grid))
    pixels, times = o.views * rows * cols, min(o.nodes * o.cores, here * 10**6) / here
    updates = o.views * float(o.side) ** 3
    # A slab needs the rows of its own shadow: its part of the panel, and a fifth more
    # (assumed).
    need = {
        "frames from the disk": count * 2 * pixels / (o.read * 1e9),
        "line integrals": count * pixels / found["read"] / times,
        "filter": pixels * min(count, 1 + 0.2 * count) / found["filtered"] / times,
        "backprojection": updates
        / (o.gpus * o.updates if o.gpus else found["updates"] * times),
        "compression": 4 * float(o.side) ** 3 / found["written"] / times,
        "volume to the disk": 4 * float(o.side) ** 3 / (o.write * 1e9),
    }
    print(f"{o.side}^3 from {o.views} views of {rows} x {cols}: {count} slabs of "
          f"{grid.bytes / count / 2**30:.2f} GiB, {count * 2 * pixels / 1e12:.1f} TB read, on "
          f"{o.nodes} nodes of {o.cores} cores, {o.gpus} GPUs")  # fmt: skip
    for what, took in need.items():
        print(f"  {what:22} {took / 3600:8.2f} h")
    print(f"  one after the other    {sum(need.values()) / 3600:8.2f} h; at best, all beside each "
          f"other, {max(need.values()) / 3600:.2f} h")  # fmt: skip


if __name__ == "__main__":
    main()
