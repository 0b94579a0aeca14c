"""A scan of FleX-ray's full size, written piecewise, reconstructed in the memory there is.

    python tests/studies/full_size.py --write FOLDER --reconstruct --fraction 0.5
    python tests/studies/full_size.py --reconstruct FOLDER --memory 2GiB
    python tests/studies/full_size.py --costs
    python tests/studies/full_size.py --plan --memory 8GiB
    python tests/studies/full_size.py --rtk --fraction 0.5

1442 views of 1536 x 1944 pixels: a cylinder with five pins, one of which ends in the middle, in
closed form, with noise. `--fraction` takes so much of each side and of the views; 0.5 is an
eighth of the bytes. Reconstruction is by `flexdt reconstruct`'s function in a process of its
own, which prints peak memory (VmHWM), bytes read and written, how often images were read, and
processor seconds.

`--costs` measures the constants of work in `slab_fdk`, and `WORKING_IMAGES` of `memory_plan`.
`--plan` divides the volume without making it. `--rtk` makes a slab of a sixteenth of the layers
in the middle by flexdt and by itk-rtk (`pip install itk-rtk`), from the same rows, in processes
of their own.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flexdt.clients.cli.console import size
from flexdt.library.data_set import DataSet
from flexdt.library.datasets import image_set
from flexdt.library.datasets.image_set import Arrays
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction.memory_plan import PART_IMAGES, plan_memory
from flexdt.library.reconstruction.reconstruct import (
    VolumeRequest,
    grid_of,
    reconstruct_dataset,
    views_of,
)
from flexdt.library.reconstruction.slab_fdk import StandingImages
from flexdt.runtime.files.dataset_folder import Frame
from flexdt.runtime.process_settings import memory_size
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import fdk_parts, field_of_view, truncation_of

VIEWS, ROWS, COLS, PIXEL_MM = 1442, 1536, 1944, 0.0748
SOD_MM, SDD_MM = 600.0, 1059.0
OPEN, NOISE = 50_000.0, 150.0
BODY = (3.0, -2.0, 30.0, 0.02)
"""Axis (x, y) and radius [mm] and attenuation [1/mm] of the cylinder."""
PINS = ((12.0, 5.0, 1.5, 0.08), (-9.0, 14.0, 0.8, 0.1), (0.0, -20.0, 2.0, 0.05),
        (-18.0, -6.0, 0.5, 0.2), (6.0, 18.0, 1.0, 0.1))  # fmt: skip
"""The same of what is added in pins; the last ends in the plane of the source."""
TOLD = 0.05
"""Part of the work after which figures are told."""
RTK_PART = 16
"""Of the layers, one part is made beside itk-rtk."""


def scan_of(views: int, rows: int, cols: int, pixel: float) -> ConeVec:
    return ConeVec.circular(
        sod=SOD_MM, sdd=SDD_MM, angles=views, shape=(rows, cols), pixel=pixel
    )


class Shadows:
    """Counts of each view, made when they are read."""

    def __init__(
        self,
        scan: ConeVec,
        shape: tuple[int, int],
        body: tuple[float, float, float, float] = BODY,
    ) -> None:
        """Views of a body and PINS, with one image of noise that all of them share.

        Args:
            scan: the geometry.
            shape: rows and columns.
            body: x, y, radius [mm] and attenuation [1/mm].
        """
        self.scan, self.shape, self._things = scan, shape, (body, *PINS)
        self._noise = (
            np.random.default_rng(1).normal(0.0, NOISE, shape).astype(np.float32)
        )

    def __getitem__(self, index: int) -> np.ndarray:
        """Counts (rows, cols) of one view, computed anew each time.

        The last thing of PINS is seen on one half of the rows only. The noise is the
        common image, shifted by the view's number.
        """
        rows, cols = self.shape
        source, panel = self.scan.source[index], self.scan.detector[index]
        u, v = self.scan.u[index], self.scan.v[index]
        rays = (
            panel[:2] + (np.arange(cols) - (cols - 1) / 2)[:, None] * u[:2] - source[:2]
        )
        rise = (np.arange(rows) - (rows - 1) / 2) * v[2]
        longer = np.sqrt(1.0 + rise[:, None] ** 2 / (rays**2).sum(axis=1))
        every = [chord(source[:2], rays, *thing) for thing in self._things]
        whole = np.sum(every[:-1], axis=0)
        half = (rise > 0.0)[:, None] * every[-1]
        light = OPEN * np.exp(-((whole + half) * longer).astype(np.float32))
        return np.round(light + np.roll(self._noise, 97 * index)).astype(np.uint16)


def chord(
    source: np.ndarray, rays: np.ndarray, x: float, y: float, radius: float, mu: float
) -> np.ndarray:
    """Line integrals of an upright cylinder in the plane, of each ray."""
    start, squared = source - (x, y), (rays**2).sum(axis=1)
    middle = rays @ start
    inside = middle**2 - squared * (start @ start - radius**2)
    return mu * 2.0 * np.sqrt(np.maximum(inside, 0.0)) / np.sqrt(squared)


def sizes(fraction: float) -> tuple[int, int, int, float]:
    """Views, rows, columns and pixel [mm] of a fraction of the scan."""
    return (round(VIEWS * fraction), round(ROWS * fraction), round(COLS * fraction),
            PIXEL_MM / fraction)  # fmt: skip


def scan_of_shadows(shadows: Shadows) -> DataSet:
    """A data set whose frames are made when they are read; its dark is zero, its flat
    OPEN.
    """
    scan, shape = shadows.scan, shadows.shape
    frames = tuple(
        Frame(i, f"scan_{i:06d}.tif", None, True, shape) for i in range(len(scan))
    )
    flat = np.full((1, *shape), OPEN, np.uint16)
    arrays = Arrays(shadows, np.zeros_like(flat), flat)  # type: ignore[arg-type]
    return DataSet("full size", frames, shape, scan, arrays=arrays)


def write(folder: Path, fraction: float) -> None:
    """Write a scan to a folder, and print its size and the processor time.

    Args:
        folder: to make.
        fraction: of the full size, in each direction.
    """
    views, rows, cols, pixel = sizes(fraction)
    begun = time.process_time()
    scan_of_shadows(Shadows(scan_of(views, rows, cols, pixel), (rows, cols))).save(folder)
    told = size(2.0 * views * rows * cols)
    print(f"{folder}: {views} views of {rows} x {cols}, {told}, "
          f"{time.process_time() - begun:.0f} CPU s", flush=True)  # fmt: skip


def reconstruct(
    folder: Path, out: Path, memory: int | None, voxel: float | None
) -> dict[str, Any]:
    """Reconstruct a folder in this process, and tell of it meanwhile.

    Args:
        folder: the scan.
        out: of the volume.
        memory: [bytes] to keep to; None for what the machine has.
        voxel: [mm]; None for the pixel at the axis.

    Returns:
        Times, memory, reads and accuracy, for JSON.
    """
    reads, read = [0], image_set.read_image

    def counted(path: Path, shape: tuple[int, int] | None = None) -> np.ndarray:
        reads[0] += path.name.startswith("scan_")
        return read(path, shape)

    image_set.read_image = counted  # type: ignore[assignment]
    data = load_dataset(folder)
    before, begun = counters(), time.perf_counter()
    spoken = 0.0

    def told(done: float, whole: float) -> None:
        """Print time, memory and reads each time that another TOLD of the whole is done."""
        nonlocal spoken
        if done - spoken >= TOLD * whole:
            spoken = done
            print(
                f"{100 * done / whole:.0f} %: {time.process_time():.0f} CPU s, peak "
                f"{size(1024 * status('VmHWM:'))}, read "
                f"{size(counters()['rchar'] - before['rchar'])}, {reads[0]} images",
                file=sys.stderr,
                flush=True,
            )

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = reconstruct_dataset(
            data, out, VolumeRequest(voxel_mm=voxel), memory=memory, progress=told
        )
    used, after = resource.getrusage(resource.RUSAGE_SELF), counters()
    images = 2 * len(data) * math.prod(data.shape)
    return {
        "volume": made["shape"], "volume_bytes": 4 * math.prod(made["shape"]),
        "images_bytes": images, "reads_an_image": reads[0] / len(data),
        "peak_memory": 1024 * status("VmHWM:"), "anonymous_at_the_end": 1024 * status("RssAnon:"),
        "read": after["rchar"] - before["rchar"], "written": after["wchar"] - before["wchar"],
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "wall_s": round(time.perf_counter() - begun, 1), "accuracy": made["accuracy"],
        "warnings": made["warnings"],
    }  # fmt: skip


def counters() -> dict[str, int]:
    lines = Path("/proc/self/io").read_text(encoding="ascii").splitlines()
    return {name: int(value) for name, value in (line.split(": ") for line in lines)}


def status(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))


def costs(fraction: float) -> None:
    """Print the work of a voxel, a filtered and a read pixel, in processor time of this
    machine."""
    _, rows, cols, pixel = sizes(fraction)
    scan, shape = scan_of(PART_IMAGES, rows, cols, pixel), (rows, cols)
    with tempfile.TemporaryDirectory() as folder:
        scan_of_shadows(Shadows(scan, shape)).save(Path(folder, "scan"))
        data = load_dataset(Path(folder, "scan"))
        images = data.line_integrals()
        begun = time.process_time()
        images = data.line_integrals()
        reading = (time.process_time() - begun) / images.size
    whole = grid_of(views_of(data), VolumeRequest())
    few = Grid((whole.shape[0], 8, 8), whole.voxel_mm, whole.center_mm)
    many = Grid((whole.shape[0] // 8, *whole.shape[1:]), whole.voxel_mm, whole.center_mm)
    seconds = []
    for grid in (few, few, many, many):
        begun = time.process_time()
        fdk_parts(lambda: [images], scan, shape, grid)
        seconds.append(time.process_time() - begun)
    filtering = seconds[1] / images.size
    seen = StandingImages.of(scan, shape, None).rows(many.blank())
    filtered = (seen.stop - seen.start) * cols * PART_IMAGES
    voxel = (seconds[3] - filtering * filtered) / (PART_IMAGES * math.prod(many.shape))
    print(
        f"a voxel and view {voxel * 1e9:.3f} ns; a filtered pixel "
        f"{filtering / voxel:.1f} and one "
        f"read {reading / voxel:.1f} times that",
        flush=True,
    )


def held(fraction: float, radius: float) -> None:
    """Print how much FDK of an object of some radius [mm] holds beside the volume."""
    _, rows, cols, pixel = sizes(fraction)
    scan, shape = scan_of(2 * PART_IMAGES, rows, cols, pixel), (rows, cols)
    shadows = Shadows(scan, shape, (*BODY[:2], radius, BODY[3]))
    some = scan_of(2 * PART_IMAGES, 24, 30, 1.0)
    flat = np.zeros((2 * PART_IMAGES, 24, 30), np.float32)
    fdk_parts(lambda: [flat], some, (24, 30), Grid((8, 8, 8), 1.0))  # the kernels' code

    def image(number: int) -> np.ndarray:
        return np.log(OPEN / np.maximum(shadows[number], np.float32(1.0))).astype(
            np.float32
        )

    def parts() -> Iterator[np.ndarray]:
        """Make the images of the scan, PART_IMAGES at a time."""
        for first in range(0, len(scan), PART_IMAGES):
            yield np.stack(
                [image(number) for number in range(first, first + PART_IMAGES)]
            )

    truncation = truncation_of(image, scan, shape)
    grid = Grid((rows, 8, 8), pixel * SOD_MM / SDD_MM)
    resting = 1024 * status("VmRSS:")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # VmHWM begins anew
    fdk_parts(parts, scan, shape, grid, truncation=truncation)
    taken = (1024 * status("VmHWM:") - resting) / (4 * rows * cols)
    print(
        f"an object of {radius:g} mm, {'seen whole' if truncation is None else 'cut off'}: FDK "
        f"holds {taken:.0f} images",
        flush=True,
    )


def plan(fraction: float, memory: int) -> None:
    """Print slabs, bytes on disk and rows that slabs read, and the same of slabs of 512
    MiB.

    Args:
        fraction: of the full size, in each direction.
        memory: to plan for [bytes].
    """
    views, rows, cols, pixel = sizes(fraction)
    scan, shape = scan_of(views, rows, cols, pixel), (rows, cols)
    grid, images = field_of_view(scan, shape), StandingImages.of(scan, shape, None)
    made = plan_memory(grid, views, min(views, 228), rows * cols, memory)
    for slabs in (made.slabs, grid.slabs(512 << 20)):
        seen = [images.rows(grid.slab(*slab).blank()) for slab in slabs]
        read = sum(part.stop - part.start for part in seen) / rows
        print(f"{grid.shape} voxels, {size(grid.bytes)}: {len(slabs)} slabs, whose rows are "
              f"{read:.2f} times those of the images")  # fmt: skip
    print(f"{made.kept} images kept, {size(made.disk_bytes)} on disk", flush=True)


def part_of(fraction: float) -> tuple[ConeVec, tuple[int, int], Grid, slice]:
    """The scan, its rows and columns, the grid of a slab in the middle, and the rows in
    its shadow.
    """
    views, rows, cols, pixel = sizes(fraction)
    scan = scan_of(views, rows, cols, pixel)
    voxel = round(pixel * SOD_MM / SDD_MM, 4)
    grid = Grid((max(rows // RTK_PART, 1), cols, cols), voxel)
    return (
        scan,
        (rows, cols),
        grid,
        StandingImages.of(scan, (rows, cols), None).rows(grid.blank()),
    )


def beside_rtk(who: str, fraction: float, out: Path) -> None:
    """Make the slab in this process, save it, and print time and memory beside making the
    images.

    Args:
        who: "flexdt", or anything else for RTK.
        fraction: of the full size, in each direction.
        out: NumPy file.
    """
    scan, shape, grid, rows = part_of(fraction)
    shadows = Shadows(scan, shape)
    images = np.empty((len(scan), rows.stop - rows.start, shape[1]), np.float32)
    for i, image in enumerate(images):
        image[:] = np.log(OPEN / shadows[i][rows])
    resting, begun = 1024 * status("VmRSS:"), time.process_time()
    if who == "flexdt":
        cone_vec, part, _ = StandingImages.of(scan, shape, None).part(rows)

        def parts() -> Any:
            return (images[k : k + 16] for k in range(0, len(images), 16))

        made = fdk_parts(parts, cone_vec, part, grid).data
    else:
        made = by_rtk(images, scan, shape, grid, rows)
    print(f"{who}: {time.process_time() - begun:.1f} CPU s, "
          f"{size(1024 * status('VmHWM:') - resting)} beside the images", flush=True)  # fmt: skip
    np.save(out, made)


def by_rtk(
    images: np.ndarray, scan: ConeVec, shape: tuple[int, int], grid: Grid, rows: slice
) -> np.ndarray:
    """Reconstruct the slab by RTK.

    RTK's (x, y, z) is our (x, z, -y), and its detector rows grow upwards.

    Args:
        images: of `rows` only.
        scan, shape: the geometry, and rows and columns of whole images.
        grid: the slab.
        rows: which ones.

    Returns:
        The volume in our axes.
    """
    import itk
    from itk import RTK as rtk

    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    angles = np.degrees(np.arctan2(scan.source[:, 0], -scan.source[:, 1]))
    for angle in angles.tolist():
        geometry.AddProjection(SOD_MM, SDD_MM, angle)
    pixel = float(np.linalg.norm(scan.u[0]))
    stack = itk.image_from_array(np.ascontiguousarray(images[:, ::-1]))
    stack.SetSpacing([pixel, pixel, 1.0])
    low = (shape[0] - 1) / 2 - (rows.stop - 1)
    stack.SetOrigin([-(shape[1] - 1) / 2 * pixel, low * pixel, 0.0])
    kind = type(stack)
    empty = rtk.ConstantImageSource[kind].New()
    nz, ny, nx = grid.shape
    empty.SetOrigin([-(n - 1) / 2 * grid.voxel_mm for n in (nx, nz, ny)])
    empty.SetSpacing([grid.voxel_mm] * 3)
    empty.SetSize([nx, nz, ny])
    empty.SetConstant(0.0)
    filters = rtk.FDKConeBeamReconstructionFilter[kind].New()
    filters.SetInput(0, empty.GetOutput())
    filters.SetInput(1, stack)
    filters.SetGeometry(geometry)
    filters.Update()
    return np.asarray(itk.array_from_image(filters.GetOutput())[::-1].transpose(1, 0, 2))


def compare(fraction: float) -> None:
    """Reconstruct by flexdt and by RTK, each in a process of its own, and print how far
    they are apart.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, f"{who}.npy") for who in ("flexdt", "itk-rtk")]
        for file in files:
            again("--part-by", file.stem, "--fraction", str(fraction), "--out", str(file))
        ours, theirs = (np.load(file, mmap_mode="r") for file in files)
        seen = np.isfinite(ours)
        off = float(
            np.abs(ours - theirs, where=seen, out=np.zeros(ours.shape, np.float32)).max()
        )
        print(f"apart by at most {off:.2g} of {float(np.nanmax(ours)):.2g} / mm")


def again(*words: str) -> None:
    """This study in a process of its own, whose peak memory is of one thing."""
    subprocess.run([sys.executable, __file__, *words], check=True)


def main() -> None:
    """Do what the command line asks: write, reconstruct, costs, plan or a comparison with
    RTK.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", type=Path, metavar="FOLDER")
    parser.add_argument(
        "--reconstruct", type=Path, metavar="FOLDER", nargs="?", const=Path()
    )
    parser.add_argument("--memory", type=memory_size, metavar="SIZE")
    parser.add_argument(
        "--voxel", type=float, metavar="MM", help="default: a pixel's at the axis"
    )
    parser.add_argument("--fraction", type=float, default=1.0)
    parser.add_argument(
        "--out", type=Path, help="of the volume; default: beside FOLDER, removed"
    )
    parser.add_argument("--costs", action="store_true")
    parser.add_argument("--plan", action="store_true")
    parser.add_argument("--rtk", action="store_true")
    parser.add_argument(
        "--part-by", choices=("flexdt", "itk-rtk"), help=argparse.SUPPRESS
    )
    parser.add_argument("--held", type=float, metavar="MM", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.part_by is not None:
        beside_rtk(given.part_by, given.fraction, given.out)
        return
    if given.write is not None:
        write(given.write, given.fraction)
    if given.reconstruct is not None:
        folder = given.write if given.reconstruct == Path() else given.reconstruct
        if given.write is not None:  # so that making the images is not in the figures
            words = {"--memory": given.memory, "--voxel": given.voxel}
            more = [str(w) for pair in words.items() if pair[1] is not None for w in pair]
            again("--reconstruct", str(folder), *more)
            return
        out = given.out or folder.with_name(f"{folder.name}.mha")
        print(
            json.dumps(reconstruct(folder, out, given.memory, given.voxel), indent=1),
            flush=True,
        )
        if given.out is None:
            os.remove(out)
    if given.costs:
        costs(given.fraction)
        for radius in (BODY[2], 60.0):
            again("--held", str(radius), "--fraction", str(given.fraction))
    if given.held is not None:
        held(given.fraction, given.held)
    if given.plan:
        plan(given.fraction, given.memory or 8 << 30)
    if given.rtk:
        compare(given.fraction)


if __name__ == "__main__":
    main()
