"""What only a CUDA device can say: speed against ASTRA, FDK from host to host, drawn
geometries.

    python tests/studies/device_check.py --out FOLDER [--budget-s 280]
    python tests/studies/device_check.py --tiny --out FOLDER   # the script itself, in the simulator

Parts run one after the other, each if the time is likely to suffice (`run`);
`device_check.json` is written anew after each, and says of the others that they were not begun.
Ends with status 1 where a drawn geometry is wrong or a part failed, 3 where there is no device.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path[:0] = [
    str(HERE),
    str(HERE.parent / "support"),
    str(HERE.parents[1] / "extensions"),
]
PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "llvmlite",
    "numba-cuda",
    "cuda-bindings",
    "astra-toolbox",
)
Document = dict[str, Any]


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        volumes: name to counts (nz, ny, nx) and the voxel's edge [mm].
        views: few and many views a call.
        panel: (rows, cols).
        pixel_mm: of the panel.
        fdk_grid: of 0.1 mm / voxel, relative to `volumes`.
        fdk_views: of short and long scans.
        geometries: drawn, and the most voxels along an axis.
        rounds: of every timing.
    """

    volumes: dict[str, tuple[tuple[int, int, int], float]]
    views: tuple[int, int]
    panel: tuple[int, int]
    pixel_mm: float
    fdk_grid: tuple[tuple[int, int, int], float]
    fdk_views: tuple[int, int]
    geometries: tuple[int, int]
    rounds: int


FULL = Sizes(
    {"C1": ((498, 240, 160), 0.1), "512^3": ((512,) * 3, 0.1), "1024^3": ((1024,) * 3, 0.05)},
    (36, 360), (760, 956), 0.1496, ((512,) * 3, 0.1), (360, 1434), (400, 40), 3,
)  # fmt: skip
TINY = Sizes(
    {"C1": ((4, 3, 3), 12.0), "512^3": ((3, 4, 3), 12.0), "1024^3": ((3, 3, 3), 9.0)},
    (2, 3), (6, 8), 20.0, ((3, 4, 4), 12.0), (12, 14), (11, 6), 1,
)  # fmt: skip
GEOMETRIES_S = 80.0
"""The geometries may take so long."""
FDK_OBJECTS = {
    "whole": (30.0, 0.0),
    "cut off": (55.0, 0.0),
    "cut off, noise": (55.0, 0.02),
}
"""Radius [mm] of a cylinder of 0.02 / mm about the axis, and sigma of the noise of line
integrals. The panel sees 40 mm."""
FDK_ROUNDS = 2
"""Reconstructions of which the quickest counts."""


class Check:
    """The document, and the time that is left."""

    def __init__(self, out: Path, budget_s: float) -> None:
        """Begin an empty document with a time to keep.

        Args:
            out: where it is written.
            budget_s: seconds from now.
        """
        self._out, self._ends = out, time.monotonic() + budget_s
        self._budget_s = budget_s
        self.document: Document = {}
        self.failed = False

    @property
    def left_s(self) -> float:
        """Seconds that are left."""
        return self._ends - time.monotonic()

    def part(self, name: str, needs_s: float, work: Callable[[], object]) -> Any:
        """Run a part and write the document, with the seconds that it took.

        Args:
            name: in the document.
            needs_s: the part is not begun if less is left.
            work: makes what is kept, which JSON has to hold.

        Returns:
            What it made; None if it is not begun or fails (then `failed` is set).
        """
        found: Any = None
        if self.left_s < needs_s:
            self.document[name] = (
                f"not begun: {self.left_s:.0f} s left, takes {needs_s:.0f}"
            )
        else:
            began = time.monotonic()
            try:
                found = work()
                self.document[name] = found
            except Exception as error:
                self.failed = True
                self.document[name] = f"failed: {error!r}"
                traceback.print_exc()
            self.document.setdefault("seconds", {})[name] = round(
                time.monotonic() - began, 1
            )
        spent_s = self._budget_s - self.left_s
        print(f"{spent_s:5.0f} s  {name}: {json.dumps(self.document[name])}", flush=True)
        self._out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.document, indent=1)
        (self._out / "device_check.json").write_text(text + "\n", "utf-8")
        return found


def machine() -> Document:
    """Device, driver, processor and packages."""
    from flexdt.twin.projection import gpu

    def installed(name: str) -> str | None:
        """The version of a package; None if it is not installed."""
        try:
            return version(name)
        except PackageNotFoundError:
            return None

    command = [
        "nvidia-smi",
        "--query-gpu=name,driver_version,memory.total",
        "--format=csv,noheader",
    ]
    try:
        said = subprocess.run(
            command, capture_output=True, text=True, check=False
        ).stdout.strip()
    except OSError as error:
        said = str(error)
    return {
        "device": gpu.availability().reason,
        "driver": said,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "packages": {name: installed(name) for name in PACKAGES},
    }


def drawn_geometries(sizes: Sizes, left_s: float) -> Document:
    """Compare forward and adjoint of drawn geometries with double precision.

    Args:
        sizes: how many and how large.
        left_s: seconds left; it takes GEOMETRIES_S at most.
    """
    import gpu_geometries

    count, most = sizes.geometries
    return gpu_geometries.campaign(
        range(count),
        1,
        most,
        print,
        twice=sizes is FULL,
        budget_s=min(GEOMETRIES_S, left_s),
    )


def projections(name: str, sizes: Sizes) -> Document:
    """Time the kernels of one volume beside ASTRA's and the bound, and measure their
    errors.

    Args:
        name: of the volume.
        sizes: of panel, volumes and numbers of views.

    Returns:
        By the number of views; ms a view, but for `call_ms` of a whole call.
    """
    from flexdt.measuring import box_of, gpu, voxel_rays
    from flexdt.twin.projection import back, forward
    from flexdt_extensions.bench import device_page as page
    from flexdt_extensions.bench.benchmark import circle, errors, exact_images, noise

    counts, voxel = sizes.volumes[name]
    few, many = sizes.views
    volume = noise(counts, voxel)
    there = volume.to("cuda")
    found: Document = {}
    for views in (1, few, many):
        scan = circle(views, sizes.panel, pitch=sizes.pixel_mm)
        images: Any = forward(there, scan, sizes.panel)
        flat, box = images.reshape(images.size), box_of(there.layout)
        rays, voxels = voxel_rays(scan, there.layout, sizes.panel), there.layout.flat
        ahead = gpu.launcher(box, voxels, rays, flat, sizes.panel, transposed=False)
        entry: Document = {"kernel_ms": page.by_events(ahead) / views}
        if views == 1:
            exact = exact_images(volume, scan, sizes.panel)
            entry["mean_error"], entry["worst_error"] = errors(
                images.copy_to_host(), exact
            )
        if views < many:
            out = np.empty((views, *sizes.panel), np.float32)
            entry["call_ms"] = page.on_the_clock(
                partial(forward, volume, scan, sizes.panel, out)
            )
        if views == few:
            sums = gpu.zeros(voxels.size)
            behind = gpu.launcher(box, sums, rays, flat, sizes.panel, transposed=True)
            entry["adjoint_ms"] = page.by_events(behind) / views
            entry["adjoint_over_forward"] = entry["adjoint_ms"] / entry["kernel_ms"]
            entry["back_there_ms"] = (
                page.on_the_clock(partial(back, images, scan, volume)) / views
            )
            del sums
        if views == many:
            least = page.bound(volume, scan)
            if least is not None:
                entry["part_of_the_bound"] = least / views / entry["kernel_ms"]
        if views == page.COUNTS[page.AGAINST_ASTRA[name][0]]:
            astra = page.astra_ms(volume, scan, "FP3D_CUDA")
            if astra is not None:
                entry["astra_ms"] = astra / views
                entry["share_of_astra"] = entry["kernel_ms"] * views / astra
        found[str(views)] = entry
    return found


def scanned(views: int, what: str, sizes: Sizes) -> np.ndarray[Any, Any]:
    """Line integrals (views, rows, cols) of one of `FDK_OBJECTS`, with its noise."""
    from noise_cost import image_of

    radius_mm, sigma = FDK_OBJECTS[what]
    image = image_of(radius_mm, sizes.panel, sizes.pixel_mm)
    images = np.empty((views, *sizes.panel), np.float32)
    images[:] = image  # in C order: a copy of a broadcast array keeps that of its strides
    if sigma:
        random = np.random.default_rng(0)
        for one in images:
            one += sigma * random.standard_normal(one.shape, np.float32)
    return images


def reconstruction(views: int, what: str, errors: bool, sizes: Sizes) -> Document:
    """Time FDK of a cylinder from host to host, the least of FDK_ROUNDS, and its sigma.

    Args:
        views: how many.
        what: one of FDK_OBJECTS.
        errors: with an estimate of them.
        sizes: of panel and grid.

    Returns:
        Seconds, the middle over its true value, and what was found beside the volume.
    """
    from flexdt.twin.projection import Volume
    from flexdt.twin.reconstruction import fdk
    from flexdt_extensions.bench.benchmark import circle

    counts, voxel = sizes.fdk_grid
    like = Volume(np.zeros(counts, np.float32), voxel)
    scan = circle(views, sizes.panel, pitch=sizes.pixel_mm)
    images = scanned(views, what, sizes)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        times = []
        for _ in range(FDK_ROUNDS):
            began = time.perf_counter()
            volume = fdk(images, scan, like, errors=errors)
            times.append(time.perf_counter() - began)
    seconds = min(times)
    began = time.perf_counter()
    sigma = volume.sigma
    sigma_s = time.perf_counter() - began
    z, y, x = (slice(3 * n // 8, 5 * n // 8 + 1) for n in counts)
    middle = volume.data[z, y, x]
    return {
        "seconds": seconds,
        "middle_over_true": float(middle.mean()) / 0.02,
        "sigma": sigma is not None,
        "sigma_s": sigma_s,
        "accuracy": volume.accuracy is not None,
        "warnings": sorted({str(one.message)[:80] for one in said}),
    }


def run(check: Check, sizes: Sizes) -> None:
    """Do all parts in order; those for which the time is short are left out."""
    check.part("machine", 0.0, machine)
    check.part("geometries", 30.0, lambda: drawn_geometries(sizes, check.left_s - 20.0))
    check.part("C1", 20.0, lambda: projections("C1", sizes))
    check.part("512^3", 25.0, lambda: projections("512^3", sizes))
    short, long = sizes.fdk_views

    def fdk_part(views: int, what: str, errors: bool, needs_s: float) -> Any:
        """Time one reconstruction as a part of the check, if `needs_s` are left."""
        name = f"fdk {views} {what}{' with errors' if errors else ''}"
        return check.part(
            name, needs_s, partial(reconstruction, views, what, errors, sizes)
        )

    # Kernels are compiled in a first call, whose time does not count.
    for what in FDK_OBJECTS:
        few = partial(reconstruction, max(12, short // 10), what, True, sizes)
        check.part(f"fdk first {what}", 10.0, few)
    spent: dict[tuple[str, bool], float] = {}
    for what in FDK_OBJECTS:
        for errors in (False, True):
            found = fdk_part(short, what, errors, 3.0 * spent.get((what, False), 4.0))
            if found is not None:
                spent[what, errors] = found["seconds"]
    for what in FDK_OBJECTS:
        if (what, False) in spent:
            fdk_part(long, what, False, 2.4 * spent[what, False] * long / short + 10.0)
    check.part("1024^3", 45.0, lambda: projections("1024^3", sizes))
    for (what, errors), seconds in sorted(spent.items(), key=lambda item: item[1]):
        if errors:
            fdk_part(long, what, errors, 2.4 * seconds * long / short + 10.0)


def main() -> int:
    """Run all parts that the time allows."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of device_check.json"
    )
    parser.add_argument("--budget-s", type=float, default=280.0, help="seconds in all")
    parser.add_argument(
        "--tiny", action="store_true", help="a few voxels in numba's simulator"
    )
    options = parser.parse_args()
    if options.tiny and os.environ.get("NUMBA_ENABLE_CUDASIM") != "1":
        environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
        os.execve(sys.executable, [sys.executable, *sys.argv], environment)
    check = Check(options.out, options.budget_s)
    from flexdt.twin.projection import gpu
    from flexdt_extensions.bench import device_page

    sizes = FULL
    if options.tiny:
        from device_simulator import as_on_a_device

        from flexdt.measuring import gpu_fdk_kernels

        as_on_a_device()
        gpu_fdk_kernels.THREADS = 8
        gpu.LINEAR = 64
        sizes = TINY
        device_page.by_events = (
            device_page.on_the_clock
        )  # the simulator has no clock of its own
        device_page.COUNTS = (1, *sizes.views)
    device_page.PANEL, device_page.ROUNDS = sizes.panel, sizes.rounds
    if not gpu.availability().present:
        print(f"no device: {gpu.availability().reason}", file=sys.stderr)
        return 3
    run(check, sizes)
    geometries = check.document["geometries"]
    wrong = not isinstance(geometries, dict) or bool(geometries["wrong"])
    return int(check.failed or wrong)


if __name__ == "__main__":
    sys.exit(main())
