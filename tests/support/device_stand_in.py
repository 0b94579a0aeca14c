"""A plugin of pytest: tests run as on a machine with a CUDA device, without one.

    NUMBA_ENABLE_CUDASIM=1 PYTHONPATH=tests/support pytest -p device_stand_in -m 'not slow'
    tests

Projections, their transpose and FDK are computed where `gpu` would send them to a device, by
the processor, with the last bits that a device gives: others than the processor's, and those of
the transpose different at every call, as sums are that atomics add in any order. A test that
compares bytes of such sums, or expects the processor's, fails.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import config

from flexdt.twin.projection import cpu, gpu
from flexdt.twin.projection.kernels import gpu_kernels as kernels
from flexdt.twin.reconstruction import fdk

LAST_BITS = 2.0**-22
"""By how much a number of a device differs, of itself."""
MOVED_FROM = 7
"""Views for which a volume of the host is moved: those of a device beside 16 threads, so that
few views stay on the processor whatever this machine has."""
_draw = np.random.default_rng()


def rounded(values: Any) -> Any:
    """Values as a device rounds them: the same for the same value, and not the processor's."""
    bits = values.view(np.uint32) * np.uint32(2654435761) >> np.uint32(30)
    return values * (1 + LAST_BITS * (bits.astype(np.float32) / 2 - 0.75)).astype(
        np.float32
    )


def added(values: Any) -> Any:
    """Values as atomics add them up: different at every call."""
    bits = _draw.uniform(-LAST_BITS, LAST_BITS, values.shape)
    return values * (1 + bits).astype(np.float32)


def launcher(
    box: Any, voxels: Any, views: Any, images: Any, shape: Any, *, transposed: bool,
    factor: float = 1.0,
) -> Callable[[], None]:  # fmt: skip
    """Do what `gpu.launcher` does by the processor, ray by ray.

    Args:
        box, voxels, views, images, shape, transposed, factor: as of `gpu.launcher`.

    Returns:
        What launches: it overwrites `images` with the projections or, transposed, adds to
        `voxels` (to integers, multiples of 1 / `factor`).
    """

    def launch() -> None:
        """Compute the views, or add what they spread to the voxels."""
        pixels = images._ary.reshape(len(views), *shape)
        if not transposed:
            out = np.empty(pixels.shape, np.float32)
            cpu.project(box._replace(flat=voxels._ary), views, out, fans=False)
            pixels[...] = rounded(out)
            return
        sums = np.zeros(voxels._ary.size, np.float32)
        cpu.spread(
            box._replace(flat=sums), views, np.ascontiguousarray(pixels), fans=False
        )
        exact = voxels._ary.dtype.kind == "i"
        voxels._ary[...] += (
            np.rint(sums * factor).astype(np.int64) if exact else added(sums)
        )

    return launch


class Kernel:
    """A kernel that is a function of numpy's arrays; arguments are the kernel's."""

    def __init__(self, work: Callable[..., None]) -> None:
        self._work = work

    def __getitem__(self, configuration: Any) -> Callable[..., None]:
        return lambda *given: self._work(*(getattr(one, "_ary", one) for one in given))


def combine(kind: int, a: Any, b: Any, number: Any, alone: bool, out: Any) -> None:
    """`gpu_kernels.combine`."""
    if kind == kernels.RATIO:
        out[...] = np.divide(a, b, out=np.zeros_like(a), where=b > number)
    else:
        call = (np.add, np.subtract, np.multiply, np.maximum)[kind]
        out[...] = call(a, number if alone else b)


def fold(kind: int, a: Any, b: Any, parts: Any) -> None:
    """`gpu_kernels.fold`: all in the first part."""
    parts[...] = parts.dtype.type(-np.inf if kind == kernels.LARGEST else 0.0)
    found = (np.vdot(a.astype(float), b), a.sum(dtype=float), a.max(initial=-np.inf))
    parts[0] = found[kind]


class Backprojector:
    """`fdk.OnDevice` by the processor."""

    def __init__(self, like: Any) -> None:
        self._inner = fdk.OnProcessor(like)

    def add(self, views: Any) -> None:
        """See `OnDevice`."""
        self._inner.add(views)

    def volume(self) -> Any:
        """See `OnDevice`."""
        return rounded(self._inner.volume())


def unscale(sums: Any, factor: float, flat: Any) -> None:
    """`gpu_kernels.unscale`."""
    flat += (sums / factor).astype(np.float32)


def pytest_configure(config: Any) -> None:
    """Put the stand-ins in place, before any test is imported."""
    gpu.launcher = launcher
    gpu._probe = lambda: gpu.Availability(True, "a stand-in of a CUDA device")
    fdk.OnDevice = Backprojector
    gpu.VIEWS_A_THREAD = MOVED_FROM / cpu.threads()
    for name, work in (("combine", combine), ("fold", fold), ("unscale", unscale)):
        setattr(kernels, name, Kernel(work))
    kernels.clear = Kernel(lambda values: values.fill(0))


assert config.ENABLE_CUDASIM, (
    "set NUMBA_ENABLE_CUDASIM=1: arrays of a device are the simulator's"
)
