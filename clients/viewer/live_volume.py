"""A volume that grows while its scan runs: FDK of the images so far, in a process of its own.

`python -m flexdt.clients.viewer.live_volume FOLDER SIDE [past]` follows a data set and prints a
line of JSON whenever its slices have changed: views so far and of how many, the three middle slices
as 8-bit grey, and points on the surface of what is dense, for the scenes. The geometry of all
images is written when a scan begins, so each view has its final weight at once, and the values of a
grown volume are those of the finished one.

With `past` it is the volume of `flexdt reconstruct` from the images that are there, whose slices
are then read by number.

The process has a low priority and one thread, and ends with its viewer: neither twin nor viewer
waits for it.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.clients.datasets.dataset import load_dataset
from flexdt.clients.viewer.feed import base64_grey
from flexdt.clients.viewer.page import watched
from flexdt.runtime.files.dataset_folder import read_image
from flexdt.runtime.workers import ENVIRONMENT
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import as_volume
from flexdt.twin.reconstruction.fdk import OnProcessor, fdk_parts
from flexdt.twin.reconstruction.rectify import field_of_view

MOST_VIEWS: Final = 360
"""Of a longer scan every n-th image is taken."""
LOOK_S: Final = 0.1
TELL_S: Final = 0.4
"""Between two lines, at least."""
COARSE: Final = 64
"""Cells along the longest side of the grid on which the surface is looked for."""
MOST_POINTS: Final = 12_000
LINE_BYTES: Final = 4 << 20
SIDES: Final = ("top", "front", "side")
NICENESS: Final = 10

Tell = Callable[[dict[str, Any]], None]


def grow(folder: Path, side: int, tell: Tell, alive: Callable[[], bool] = lambda: True) -> None:
    """Reconstruct a data set while it comes into being.

    Args:
        folder: of the data set.
        side: voxels along x and y, about; along z as many as the panel's height gives.
        tell: called with each new document.
        alive: whether somebody still waits.

    Raises:
        TwinError: no circular scan, or images that cannot be read.
    """
    from flexdt.twin.reconstruction import fdk_kernels  # noqa: F401 - compiled while nothing waits

    _wait(folder / "flexdt.json", alive)
    data = load_dataset(folder)
    indices = range(0, len(data), max(1, -(-len(data) // MOST_VIEWS)))
    factor = max(1, data.shape[1] // side)
    cone_vec = data.corrected()[np.array(indices)].binned(factor, data.shape)
    shape = data.shape[0] // factor, data.shape[1] // factor
    whole = field_of_view(cone_vec, shape)
    voxel_mm = whole.shape[2] * float(np.max(whole.voxel_mm)) / side
    like = as_volume(field_of_view(cone_vec, shape, voxel_mm))
    target, told = OnProcessor(like), 0.0

    def parts() -> Iterator[Float32Array]:
        normalise = None
        for index in indices:
            path = data.frames[index].path
            assert path is not None
            _wait(path, alive)
            if normalise is None:  # dark and flat images come before the projections
                normalise = load_dataset(folder).normalisation
            yield binned_mean(normalise(read_image(path, data.shape)), factor)[None]

    def progress(done: float) -> None:
        nonlocal told
        if done < 1.0 and time.monotonic() < told + TELL_S:
            return
        told = time.monotonic()
        views = round(done * len(indices))
        tell(
            {
                "type": "volume",
                "views": views,
                "of": len(indices),
                "name": folder.name,
                "side": side,
                "voxel_mm": voxel_mm,
                **slices(target.volume()),
                "surface": surface(target.volume(), like.voxel_mm, like.center_mm),
            }
        )

    fdk_parts(parts, cone_vec, shape, like, progress=progress, target=target)


def reconstruct(folder: Path, side: int, tell: Tell) -> Callable[[str, int], dict[str, Any]]:
    """The volume of a past scan, as `flexdt reconstruct` makes it of binned images.

    Args:
        folder: of the data set.
        side: columns to which images are binned.
        tell: called with the progress, and with the middle slices in the end.

    Returns:
        A slice by the name of its side and its number from below, the source or the left.

    Raises:
        TwinError: as `reconstruct_volume`.
    """
    from flexdt.clients.reconstruction.reconstruct import VolumeRequest, reconstruct_volume

    data = load_dataset(folder)
    binning, about = max(1, data.shape[1] // side), {"name": folder.name, "side": side}
    steps: dict[str, Any] = {"type": "volume", **about, "past": True}
    request = VolumeRequest(binning=binning)
    volume = reconstruct_volume(data, request, progress=lambda a, b: tell(steps | {"done": a / b}))
    grown = volume.data.transpose(1, 2, 0)
    found = slices(grown)
    size, voxel_mm = (
        dict(zip(SIDES, np.roll(grown.shape, 1).tolist(), strict=True)),
        volume.voxel_xyz,
    )
    shown = {"size": size, "voxel_mm": voxel_mm[0], "binning": binning, **found}
    tell(steps | {"done": 1.0, "views": len(data.present), "of": len(data)} | shown)

    def cut(name: str, index: int) -> dict[str, Any]:
        part = _slice(grown, name, min(index, size[name] - 1))
        data = base64_grey(part, (found["low"], found["high"]))
        return {"shape": list(part.shape), "data": data}

    return cut


def _slice(grown: Float32Array, name: str, k: int) -> Float32Array:
    """Slice `k` of a volume (y, x, z) as it is seen from above (+x to the right, +y up), from the
    source (+x to the right, +z up) or from +x, as the view from the side (+y to the right, +z up).
    """
    if name == "top":
        return grown[::-1, :, k]
    return (grown[k] if name == "front" else grown[:, k]).T[::-1]


def slices(grown: Float32Array) -> dict[str, Any]:
    """The three middle slices of a volume (y, x, z), and the values that are black and white."""
    ny, nx, nz = grown.shape
    middle = {
        name: _slice(grown, name, n // 2) for name, n in zip(SIDES, (nz, ny, nx), strict=True)
    }
    every = np.concatenate([part.reshape(-1) for part in middle.values()])
    known = every[np.isfinite(every)]  # what no view has seen is no number
    low, high = (float(v) for v in np.percentile(known, (1.0, 99.8))) if known.size else (0.0, 0.0)
    high = max(high, low + 1e-9)
    return {
        "low": low,
        "high": high,
        "slices": {
            name: {"shape": list(part.shape), "data": base64_grey(part, (low, high))}
            for name, part in middle.items()
        },
    }


def surface(grown: Float32Array, voxel_mm: Any, center_mm: Any) -> dict[str, Any]:
    """Where what is dense ends, on a coarse grid: `MOST_POINTS` points at most [mm, object frame].

    Dense is what lies above the middle between most cells and the densest. Each is the mean of 27,
    so that the streaks of few views do not count.

    Args:
        grown: (y, x, z).
        voxel_mm, center_mm: of the volume (x, y, z), as `Volume` has them.
    """
    from scipy.ndimage import uniform_filter

    factor = -(-max(grown.shape) // COARSE)
    shape = [n // factor for n in grown.shape]
    cut = grown[tuple(slice(n * factor) for n in shape)]
    blocks = [part for n in shape for part in (n, factor)]
    coarse = uniform_filter(cut.reshape(blocks).mean(axis=(1, 3, 5)), 3)
    usual, densest = np.percentile(coarse, (50.0, 99.8))
    dense = np.pad(coarse > 0.5 * (usual + densest), 1)
    inside = np.all([np.roll(dense, s, axis=k) for k in range(3) for s in (-1, 1)], axis=0)
    found = np.argwhere((dense & ~inside)[1:-1, 1:-1, 1:-1])
    found = found[:: max(1, -(-len(found) // MOST_POINTS))]
    steps = ((found + 0.5) * factor - np.array(grown.shape) / 2)[:, [1, 0, 2]]
    points = np.asarray(center_mm) + steps * np.asarray(voxel_mm)
    data = base64.b64encode(points.astype("<f4").tobytes()).decode("ascii")
    return {"points": data, "size_mm": factor * float(np.max(voxel_mm))}


def points_of(told: Mapping[str, Any]) -> FloatArray:
    """The points (n, 3) of a `surface` [mm, object frame]."""
    points = np.frombuffer(base64.b64decode(told["points"]), "<f4")
    return points.reshape(-1, 3).astype(np.float64)


def _wait(path: Path, alive: Callable[[], bool]) -> None:
    while not path.is_file():
        if not alive():
            raise SystemExit(0)
        time.sleep(LOOK_S)


class LiveReconstruction:
    """The one process of a viewer, for the data set that was asked for last.

    Args:
        tell: gets its lines.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell, self.newest = tell, ""
        self._asked: tuple[str, ...] = ()
        self._task: asyncio.Task[None] | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._wanted: deque[asyncio.Future[dict[str, Any]]] = deque()

    def grow(self, folder: Path, side: int, past: bool = False) -> None:
        """Grow the volume of a data set, unless that is being done; the last line comes again."""
        asked = str(folder.absolute()), str(side), *(["past"] if past else [])
        if asked == self._asked:
            if self.newest:
                self._tell(self.newest)
            return
        self.stop()
        self._asked = asked
        self._task = watched(self._follow(*asked), "a live reconstruction")

    def stop(self) -> None:
        """End what is under way."""
        if self._task is not None:
            self._task.cancel()
        self._task, self._asked, self.newest = None, (), ""
        self._hang_up()

    def _hang_up(self) -> None:
        """Nobody answers any more who has been asked for a slice."""
        self._writer = None
        while self._wanted:
            self._wanted.popleft().cancel()

    async def slice(self, name: str, index: int) -> dict[str, Any] | None:
        """A slice of the volume of a past scan; None while there is none."""
        if self._writer is None or "size" not in self.newest:
            return None
        wanted: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._wanted.append(wanted)
        self._writer.write(f"{name} {index}\n".encode())
        with suppress(asyncio.CancelledError):  # somebody has asked for another volume
            return await wanted
        return None

    async def _follow(self, *asked: str) -> None:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-P", "-m", __name__, *asked,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
            env={**os.environ, **ENVIRONMENT}, limit=LINE_BYTES,
        )  # fmt: skip
        assert process.stdout is not None
        self._writer = process.stdin
        try:
            async for line in process.stdout:
                kind, _, content = line.decode().partition("\t")
                if kind == "slice":
                    if not (wanted := self._wanted.popleft()).done():
                        wanted.set_result(json.loads(content))
                else:
                    self.newest = line.decode()
                    self._tell(self.newest)
            self._hang_up()
            await process.wait()  # to kill what has just ended would take its code from the loop
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()


def main(folder: str, side: str, past: str = "") -> None:
    """The process."""
    parent = os.getppid()
    os.nice(NICENESS)

    def say(document: dict[str, Any]) -> None:
        # The surface is the viewer's, what comes after it goes to pages as it is.
        print(json.dumps(document.pop("surface", None)), json.dumps(document), sep="\t", flush=True)

    try:
        if not past:
            grow(Path(folder), int(side), say, lambda: os.getppid() == parent)
            return
        cut = reconstruct(Path(folder), int(side), say)
        for line in sys.stdin:
            name, index = line.split()
            print("slice", json.dumps(cut(name, int(index))), sep="\t", flush=True)
    except Exception as error:  # whatever it is, the page says it instead of waiting for ever
        known = isinstance(error, (TwinError, OSError, ValueError))
        problem = str(error) if known else f"{type(error).__name__}: {error}"
        with suppress(OSError):
            name = Path(folder).name
            say({"type": "volume", "name": name, "past": bool(past), "problem": problem})


if __name__ == "__main__":
    main(*sys.argv[1:])
