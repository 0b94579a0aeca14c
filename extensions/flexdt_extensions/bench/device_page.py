"""`flexdt bench --device`: a CUDA device against ASTRA on it, the processor and its own
bound, one line for each target of a GPU. Makes one document and one page; needs a device.

Kernels are timed by the device's own events, with all data there; calls by the clock,
from arrays of the host to arrays of the host. ASTRA's data are on the device, too. The
bound is the larger of reading the volume once and of 16 instructions for each voxel that
a ray passes.

ASTRA Toolbox is here as an independent second projector, for cross-checks on a machine
with a GPU. It interpolates (Joseph) where flexdt takes exact lengths, so the two agree to
its interpolation error only. Creating ASTRA's 3D objects without a GPU ends the process,
so `gpu.availability` is checked first.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from flexdt.measuring import box_of, gpu, voxel_rays
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Volume, back, forward
from flexdt_extensions.bench.benchmark import (
    BINNED,
    C1_SHAPE,
    circle,
    errors,
    exact_images,
    interleaved,
    noise,
)
from flexdt_extensions.bench.peers import absent
from flexdt_extensions.bench.scanned_objects import KINDS

SIZES = {"C1": (C1_SHAPE, 0.1), "512^3": ((512,) * 3, 0.1), "1024^3": ((1024,) * 3, 0.05)}
COUNTS = (1, 36, 360)
"""Numbers of views a call."""
PANEL = BINNED
FDK_VIEWS = 1434
ROUNDS = 5
MIN_BACK_S = 2.0
"""Least time of `back` and of the processor's, each [s]."""
INSTRUCTIONS_A_VOXEL = 16
"""Least number of instructions for a voxel that a ray passes."""
AGAINST_ASTRA = {
    "C1": (2, 0.20, 0.15),
    "512^3": (2, 0.45, 0.30),
    "1024^3": (1, 0.40, 0.28),
}
"""Index into COUNTS, and the shares of ASTRA's time that are accepted and wanted."""
OF_THE_BOUND = {"C1": (0.25, 0.45), "512^3": (0.30, 0.50), "1024^3": (0.80, 1.00)}
MAX_CUT_OFF = 1.3
"""Largest ratio of FDK's time for any images to that for a complete object."""
MAX_ERRORS_RATIO = 1.5
"""Largest ratio of FDK's time with `errors` to that without."""
ASTRA = "astra-toolbox"
UNKNOWN_SPEED = "the device does not say how fast it is"
Document = dict[str, Any]


def on_the_clock(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Measure the best of a few calls [ms], the device's work included; the first is
    not counted."""
    return _best(work, rounds, lambda start, end: (end[0] - start[0]) * 1e3)


def by_events(work: Callable[[], object]) -> float:
    """Measure the best of a few launches [ms] by the device's events; the first is not
    counted."""
    return _best(work, ROUNDS, lambda start, end: float(start[1].elapsed_time(end[1])))


def _best(
    work: Callable[[], object], rounds: int, apart: Callable[[Any, Any], float]
) -> float:
    """Call `work` `rounds` + 1 times and return the least time of all calls but the
    first, in the unit of `apart`.

    Args:
        work: call to measure.
        rounds: counted calls.
        apart: time between two pairs (clock [s], device event), before and after a call.
    """
    from numba import cuda

    def now() -> tuple[float, Any]:
        """Wait until the device is idle; return the host's time [s] and an event recorded
        on the device before.
        """
        event = cuda.event()
        event.record()
        cuda.synchronize()
        return time.perf_counter(), event

    def once() -> float:
        start = now()
        work()
        return apart(start, now())

    return min([once() for _ in range(rounds + 1)][1:])


def run_device_bench(tell: Callable[[str], None]) -> Document:
    """Measure all targets on the device, with ASTRA beside it where it loads.

    Args:
        tell: called with a line of text for each result.

    Returns:
        {device, cases, targets}: name, case -> views -> times, and lines of {target,
        accepted, wanted, measured, met}.
    """
    lines: list[Document] = []

    def line(
        what: str, value: float | None, accepted: float, wanted: float, sign: int = 1
    ) -> None:
        """Add a target's line: its limits, the measured value, and whether that is
        wanted, accepted, missed or not measured; print it.

        Args:
            what: name of the target.
            value: measured; None if it could not be, with the reason in the line.
            accepted: limit of "accepted".
            wanted: limit of "wanted".
            sign: 1 where less is better, -1 where more is.
        """
        met = "not measured" if value is None else "missed"
        if value is not None and sign * value <= sign * accepted:
            if sign * value <= sign * wanted:
                met = "wanted"
            else:
                met = "accepted"
        entry = {
            "target": what,
            "accepted": accepted,
            "wanted": wanted,
            "measured": value,
        }
        if value is None:
            entry["why"] = why_no_astra() or UNKNOWN_SPEED
        lines.append({**entry, "met": met})
        tell(row(lines[-1]))

    cases = {name: case(name, tell) for name in SIZES}
    most = COUNTS[-1]
    some = COUNTS[1]
    for name, seen in cases.items():
        top = seen[most]
        middle = seen[some]
        which, accepted, wanted = AGAINST_ASTRA[name]
        views = COUNTS[which]
        beside = seen[COUNTS[which]]
        astra = beside["astra_ms"]
        if astra is None:
            share = None
        else:
            share = beside["kernel_ms"] / astra
        line(f"{name}: forward kernel / ASTRA, {views} views", share, accepted, wanted)
        if top["bound_ms"] is None:
            part = None
        else:
            part = top["bound_ms"] / top["kernel_ms"]
        line(
            f"{name}: part of the bound, {most} views", part, *OF_THE_BOUND[name], sign=-1
        )
        copy = middle["image_bytes"] / 1e6
        kernel = middle["kernel_ms"]
        limits = 1.5 * kernel + copy / 15, max(kernel, copy / 50)
        line(f"{name}: {some} views end to end [ms]", middle["call_ms"], *limits)
        line(f"{name}: adjoint / forward kernel", middle["adjoint_ms"] / kernel, 2.0, 1.5)
        alone = seen[COUNTS[0]]
        for views, entry in ((COUNTS[0], alone), (some, middle)):
            ratio = entry["back_call_ms"] / entry["back_processor_ms"]
            line(f"{name}: back of {views} views / the processor's", ratio, 1.0, 1.0)
        ratio = middle["back_there_ms"] / middle["adjoint_ms"]
        line(f"{name}: back on the device / its kernel", ratio, 1.1, 1.1)
        line(f"{name}: mean error", alone["mean_error"], 3e-7, 2e-7)
        line(f"{name}: worst error", alone["worst_error"], 3e-6, 2e-6)
    first = cases[next(iter(SIZES))]
    line("C1: one view end to end [ms]", first[COUNTS[0]]["call_ms"], 0.4, 0.2)
    further(line, cases)
    named = {name: {str(n): e for n, e in seen.items()} for name, seen in cases.items()}
    return {"device": gpu.availability().reason, "cases": named, "targets": lines}


def case(name: str, tell: Callable[[str], None]) -> dict[int, Document]:
    """Measure one volume for each number of views a call.

    "kernel_ms" and "adjoint_ms" are kernels alone, "call_ms" a call from host to host,
    "back_there_ms" one on the device. "bound_ms" and "astra_ms" may be None. Back
    projection with choice and by the processor is measured for all numbers of views but
    the largest, errors and the processor's projection for the first.

    Args:
        name: of `SIZES`.
        tell: called with a line of text for each number of views.

    Returns:
        Views -> times [ms] of the call, bytes of its images and errors.
    """
    shape, voxel = SIZES[name]
    volume = noise((shape[0], shape[1], shape[2]), voxel)
    there = volume.to("cuda")
    seen = {}
    for views in COUNTS:
        scan = circle(views, PANEL)
        images: Any = forward(there, scan, PANEL)
        out = np.empty((views, *PANEL), np.float32)
        flat = images.reshape(images.size)
        box = box_of(there.layout)
        rays = voxel_rays(scan, there.layout, PANEL)
        voxels = there.layout.flat
        ahead = gpu.launcher(box, voxels, rays, flat, PANEL, transposed=False)
        sums = gpu.zeros(voxels.size)
        behind = gpu.launcher(box, sums, rays, flat, PANEL, transposed=True)
        entry: Document = {
            "kernel_ms": by_events(ahead),
            "adjoint_ms": by_events(behind),
            "call_ms": on_the_clock(partial(forward, volume, scan, PANEL, out)),
            "back_there_ms": on_the_clock(partial(back, images, scan, volume)),
            "image_bytes": out.nbytes,
            "bound_ms": bound(volume, scan),
            "astra_ms": astra_ms(volume, scan, "FP3D_CUDA"),
        }
        if (
            views < COUNTS[-1]
        ):  # as the call chooses by itself, and on the processor, in turns
            work = partial(back, out, scan, volume)
            both = {"back_call_ms": work, "back_processor_ms": gpu.switched_off()(work)}
            times = interleaved(both, budget_s=MIN_BACK_S)
            entry |= {key: spent.best * 1e3 for key, spent in times.items()}
        if views == COUNTS[0]:
            with gpu.switched_off():
                entry["processor_ms"] = on_the_clock(
                    partial(forward, volume, scan, PANEL, out)
                )
            exact = exact_images(volume, scan, PANEL)
            entry["mean_error"], entry["worst_error"] = errors(
                images.copy_to_host(), exact
            )
        seen[views] = entry
        tell(f"{name} {views} views: {entry}")
    return seen


def further(line: Callable[..., None], cases: dict[str, dict[int, Document]]) -> None:
    """Measure FDK and SIRT onto the second volume's grid, and add their targets.

    They are FDK's back projection over ASTRA's (None without it); for each of `KINDS`
    FDK's time from host to host [s], its ratio to the first kind, and that with errors to
    without; then for each kind the time of a SIRT iteration over that of its kernels.

    Args:
        line: adds a target: name, measured, accepted and wanted value.
        cases: name of a size -> number of views -> figures of `case`; that of the second
            size and `COUNTS[1]` views is read, for SIRT.
    """
    from numba import cuda

    from flexdt.measuring import gpu_fdk_kernels, view_table
    from flexdt.twin.reconstruction import fdk, sirt

    name = list(SIZES)[1]
    (nz, ny, nx), voxel = SIZES[name]
    like = Volume(np.zeros((nz, ny, nx), np.float32), voxel)
    scan = circle(COUNTS[-1], PANEL)
    block = gpu_fdk_kernels.BLOCK
    columns = cuda.device_array(len(scan) * PANEL[1] * PANEL[0], np.float32)
    arrays = (
        columns,
        PANEL[1],
        PANEL[0],
        *(cuda.to_device(a) for a in (view_table(scan, PANEL), *np.full((2, 3), voxel))),
    )
    grid = (-(-nz // (block[0] * gpu_fdk_kernels.RUN)), -(-nx // block[1]), ny)
    target = cuda.device_array((ny, nx, nz), np.float32)
    kernel = by_events(
        lambda: gpu_fdk_kernels.backproject[grid, (*block, 1)](*arrays, target)
    )
    astra = astra_ms(like, scan, "BP3D_CUDA")
    share = None if astra is None else kernel / astra
    line("FDK: backprojection / ASTRA BP3D", share, 1.0, 0.65)
    scan = circle(FDK_VIEWS, PANEL)
    first = 0.0
    for kind, images_of in KINDS.items():
        images = images_of(scan, PANEL)
        plain, told = (
            on_the_clock(_quietly(partial(fdk, images, scan, like, errors=errors)), 1)
            / 1e3
            for errors in (False, True)
        )
        first = first or plain
        what = f"FDK of {FDK_VIEWS} views, {kind}"
        line(f"{what}, host to host [s]", plain, 2.0 * MAX_CUT_OFF, MAX_CUT_OFF)
        line(
            f"{what}, over an object seen whole", plain / first, MAX_CUT_OFF, MAX_CUT_OFF
        )
        line(
            f"{what}, with errors / without",
            told / plain,
            MAX_ERRORS_RATIO,
            MAX_ERRORS_RATIO,
        )
    scan = circle(COUNTS[1], PANEL)
    seen = cases[name][COUNTS[1]]
    for kind, images_of in KINDS.items():
        some = images_of(scan, PANEL)
        times = [
            on_the_clock(partial(sirt, some, scan, like, iterations=n), 1) for n in (1, 3)
        ]
        one = (times[1] - times[0]) / 2 / (seen["kernel_ms"] + seen["adjoint_ms"])
        line(
            f"SIRT, {COUNTS[1]} views, {kind}: an iteration / its kernels", one, 2.0, 1.2
        )


def _quietly(call: Callable[[], object]) -> Callable[[], object]:
    """Wrap a call so that all its warnings are dropped."""

    def quiet() -> object:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return call()

    return quiet


def why_no_astra() -> str | None:
    """Return the reason why ASTRA cannot take part, not installed or fails to load; None
    where it can.
    """
    if missing := absent(ASTRA):
        return missing
    try:
        import astra  # noqa: F401
    except ImportError as error:
        return f"{ASTRA} does not load: {error}"
    return None


def astra_ms(volume: Volume, scan: ConeVec, algorithm: str) -> float | None:
    """Measure ASTRA's time [ms] with its data on the device; None where ASTRA does not
    load (`why_no_astra`). Raises GeometryError without a CUDA device.
    """
    try:
        prepared = Resident(volume, scan, PANEL, algorithm)
    except ImportError:
        return None
    try:
        return on_the_clock(prepared.compute)
    finally:
        prepared.close()


def bound(volume: Volume, scan: ConeVec) -> float | None:
    """Compute the least possible time [ms]; None where the device's speed is unknown
    (simulator).

    It is the larger of the time to read the volume once, by a measured copy on the
    device, and of `INSTRUCTIONS_A_VOXEL` for each voxel that a ray passes, at the
    device's nominal clock.

    Args:
        volume: to read once.
        scan: views onto `PANEL`; passed voxels are counted on rays of the first, 16
            pixels apart.
    """
    from numba import config, cuda

    if config.ENABLE_CUDASIM:
        return None
    device = cuda.get_current_device()
    half = cuda.device_array(2**28, np.float32)
    read_ms = (
        by_events(lambda: half.copy_to_device(half))
        / 2
        * volume.data.nbytes
        / half.nbytes
    )
    rays = voxel_rays(scan, volume.layout, PANEL)[:1]
    r, c = np.mgrid[0 : PANEL[0] : 16, 0 : PANEL[1] : 16].reshape(2, -1)
    d = rays[0, 3:6] + c[:, None] * rays[0, 6:9] + r[:, None] * rays[0, 9:12]
    cuts = np.sort(
        np.stack([-rays[0, :3] / d, (volume.layout.counts - rays[0, :3]) / d]), axis=0
    )
    inside = np.maximum(cuts[1].min(axis=1) - cuts[0].max(axis=1), 0.0)
    passed = (
        float((inside * np.abs(d).sum(axis=1)).mean()) * PANEL[0] * PANEL[1] * len(scan)
    )
    each_ms = device.MULTIPROCESSOR_COUNT * 4 * 32 * device.CLOCK_RATE  # kHz
    return float(max(read_ms, INSTRUCTIONS_A_VOXEL * passed / each_ms))


def row(line: Document) -> str:
    """Format a target's line as a row of the page's Markdown table: target, accepted and
    wanted limit, measured ("-" if None), whether met, and why it was not measured.
    """
    if line["measured"] is None:
        value = "-"
    else:
        value = f"{line['measured']:.3g}"
    limits = f"{line['accepted']:.3g} | {line['wanted']:.3g}"
    why = f": {line['why']}" if "why" in line else ""
    return f"| {line['target']} | {limits} | {value} | {line['met']}{why} |"


def page(document: Document) -> str:
    """Format the document of `run_device_bench` as one page of Markdown: device, table of
    targets, and for each case the times by views a call [ms].
    """
    head = "| target | minimum | goal | measured | met |\n|---|---|---|---|---|"
    lines = [f"# {document['device']}", "", head, *map(row, document["targets"]), ""]
    for name, seen in document["cases"].items():
        lines += [f"{name}, by views a call; ms for the whole call:", ""]
        lines += [f"- {views}: {entry}" for views, entry in seen.items()] + [""]
    return "\n".join(lines)


def geometries(
    volume: Volume, cone_vec: ConeVec, shape: tuple[int, int]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Convert volume and views to ASTRA's dictionaries. Safe without a GPU.

    ASTRA's z, y, x order is flexdt's; its volumes are centered where flexdt's are, in mm.

    Returns:
        Volume geometry and projection geometry.
    """
    nz, ny, nx = volume.shape
    low = [c - s / 2 for c, s in zip(volume.center_mm, volume.size_mm, strict=True)]
    high = [c + s / 2 for c, s in zip(volume.center_mm, volume.size_mm, strict=True)]
    space = {
        "GridRowCount": ny,
        "GridColCount": nx,
        "GridSliceCount": nz,
        "option": {
            f"Window{name}{axis}": end[i]
            for i, axis in enumerate("XYZ")
            for name, end in (("Min", low), ("Max", high))
        },
    }
    return space, cone_vec.with_shape(shape).to_astra()


class Resident:
    """A volume and its views on the device, for repeated runs of ASTRA's FP3D_CUDA or
    BP3D_CUDA.

    Voxels are uploaded once and stay, as `forward` keeps them; images come back with every
    call.

    Raises:
        GeometryError: no GPU; asking ASTRA would end the process.
    """

    def __init__(
        self,
        volume: Volume,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        algorithm: str = "FP3D_CUDA",
    ) -> None:
        """Copy the volume to the device, allocate the views and prepare ASTRA's
        algorithm; see the class.

        Raises GeometryError without a CUDA device. Back projection ("BP3D_CUDA") writes
        into the volume.
        """
        found = gpu.availability()
        if not found.present:
            raise GeometryError(f"ASTRA's 3D projector needs a GPU: {found.reason}")
        import astra
        from numba import cuda

        self._astra = astra
        space, panel = geometries(volume, cone_vec, shape)
        self._voxels = cuda.to_device(np.ascontiguousarray(volume.data))
        # ASTRA keeps (rows, n, cols).
        self._views = cuda.device_array((shape[0], len(cone_vec), shape[1]), np.float32)
        self._volume = astra.data3d.link("-vol", space, _link(astra, self._voxels))
        self._images = astra.data3d.link("-sino", panel, _link(astra, self._views))
        options = astra.astra_dict(algorithm)
        if algorithm == "FP3D_CUDA":
            into = "VolumeDataId"
        else:
            into = "ReconstructionDataId"
        options[into] = self._volume
        options["ProjectionDataId"] = self._images
        self._algorithm = astra.algorithm.create(options)

    def compute(self) -> None:
        """Run the algorithm; nothing leaves the device."""
        self._astra.algorithm.run(self._algorithm)

    def run(self) -> Float32Array:
        """Project; float32 (rows, n, cols)."""
        self.compute()
        return np.asarray(self._views.copy_to_host(), dtype=np.float32)

    def close(self) -> None:
        """Give the device's memory back."""
        self._astra.algorithm.delete(self._algorithm)
        self._astra.data3d.delete([self._volume, self._images])


def _link(astra: Any, array: Any) -> Any:
    """Wrap a contiguous array (z, y, x) on the device for ASTRA."""
    z, y, x = array.shape
    pointer = array.device_ctypes_pointer.value
    return astra.pythonutils.GPULink(pointer, x, y, z, array.dtype.itemsize * x)
