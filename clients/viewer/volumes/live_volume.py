"""A volume that grows while its scan runs, and those of past scans: FDK in a process of
its own.

`python -m flexdt.clients.viewer.volumes.live_volume` loads its libraries and reads a
line, FOLDER, SIDE and perhaps `past`, tabs between them. It follows that data set then
and prints a line of JSON whenever its volume has changed: views so far and of how many,
its size, and now and then the surface of its dense parts, for the scenes. The geometry of
all images is written when a scan begins, so each view has its final weight at once, and
the values of a grown volume are those of the finished one.

With `past` it is the volume of `flexdt reconstruct` from the images at hand.

Further lines are requests: `block NAME` for a volume as a page draws it, `voxel X Y Z`
for exact values, `compare` with the present correction to compare the volume with the
truth of its sample, with a correction and without.

The process has a low priority, during a scan one thread, and ends with its viewer:
neither twin nor viewer waits for it.

A page draws a volume from 16-bit codes of voxels, or of means over cubes of them. It gets
them once, and then scrolls, windows and turns it without requests; single voxels it
requests by `exact`, because codes are rounded.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np

from flexdt.clients.viewer.volumes.grown_surface import (
    FINISHED_CELLS,
    shown_range,
    surface,
)
from flexdt.clients.viewer.volumes.volume_truth import figures, truth_of
from flexdt.library.data_set import DataSet
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction.reconstruct import VolumeRequest, reconstruct_volume
from flexdt.runtime.files.dataset_folder import read_image
from flexdt.twin.dataset.flexdt_json import SampleRecord
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.projection import Volume, as_volume
from flexdt.twin.reconstruction.acquisition.rectify import field_of_view
from flexdt.twin.reconstruction.feldkamp.backprojection import OnProcessor
from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts
from flexdt.twin.scanner.state import NamedCorrection

MAX_VOXELS: Final = 14 << 20
"""Largest number of voxels of a finished volume for a page: 28 MB, and 239 x 239 x 190
voxels of the usual camera mode at full resolution."""
MAX_GROWING_VOXELS: Final = 3 << 20
"""Largest number of voxels of a volume that is sent every second: 6 MB."""
TOP: Final = 65534
"""Codes are 1 + 0..TOP between the least and the greatest value; 0 is a voxel without data."""
MAX_VIEWS: Final = 360
"""Largest number of views; of a longer scan every n-th image is taken."""
LOOK_S: Final = 0.1
TELL_S: Final = 0.4
"""Least interval between two lines [s]."""
SURFACE_INTERVAL_S: Final = 1.2
"""Least interval between two surfaces for the scenes [s]."""

RECONSTRUCTING: Final = {
    "looking at the pixels": 0.18,
    "reading and reconstructing": 0.27,
    "comparing the images": 0.35,
    "finding the accuracy": 0.13,
    "finding the noise": 0.07,
}
"""Stages of a past scan's volume, and their shares of its processor time (11 s; 153 images at
256 columns, of the gear)."""
COMPARING: Final = {
    "computing the truth": 0.45,
    "measuring the volume": 0.15,
    "reconstructing with the other geometry": 0.25,
    "measuring the other volume": 0.15,
}
"""Those of its comparison with the truth (12 s; same scan)."""

Tell = Callable[[dict[str, Any]], None]


def block(data: Float32Array, most: int = MAX_VOXELS) -> tuple[dict[str, Any], bytes]:
    """Encode a volume for a page.

    Code 0 is not a number. Voxels beyond whole cubes are left out. The cubes are the
    smallest with at most `most` means; NaN in a cube makes its mean NaN (code 0). The
    window is `shown_range`.

    Args:
        data: (z, y, x) [1/mm]; not a number where no data cover.
        most: voxels at most; a larger volume becomes means over cubes.

    Returns:
        The head: shape (z, y, x) of the codes, `factor` voxels a side of a cube, the values
        `low` and `high` of codes 1 and TOP + 1, and the `window` to begin with. And the codes,
        little-endian.
    """
    factor = 1
    while np.prod([n // factor for n in data.shape]) > most:
        factor += 1
    nz, ny, nx = (n // factor for n in data.shape)
    cubes = np.empty((nz, ny, nx), np.float32)
    for k in range(nz):
        part = data[k * factor : (k + 1) * factor, : ny * factor, : nx * factor]
        cubes[k] = part.reshape(factor, ny, factor, nx, factor).mean(axis=(0, 2, 4))
    there = np.isfinite(cubes)
    low, high = (float(f(cubes, initial=0.0, where=there)) for f in (np.min, np.max))
    high = max(high, low + 1e-9)
    with np.errstate(invalid="ignore"):  # not a number becomes 0 below
        codes = ((cubes - low) * (TOP / (high - low)) + 1.5).astype("<u2")
    codes[~there] = 0
    head = {
        "shape": [nz, ny, nx],
        "factor": factor,
        "low": low,
        "high": high,
        "window": list(shown_range(cubes)),
    }
    return head, codes.tobytes()


def exact(data: Float32Array, place: tuple[int, int, int]) -> float | None:
    """Read the value of the voxel (x, y, z) [1/mm]; None where no data cover, or
    outside the volume.

    A value that is not finite counts as not covered. Also None for a negative index.
    """
    x, y, z = place
    if not all(0 <= at < n for at, n in zip((z, y, x), data.shape, strict=True)):
        return None
    value = float(data[z, y, x])
    return value if np.isfinite(value) else None


@dataclass
class Held:
    """The volumes of the process by name, (z, y, x), and its facts about them.

    `volume` is the requested one, `sigma` and `bias_bound` its noise and a bound of its
    other errors, `truth` its sample's and `other` the one with the other geometry, once
    they have been compared.
    """

    tell: Tell
    about: dict[str, Any]
    volumes: dict[str, Float32Array] = field(default_factory=dict)
    grid: Volume | None = None
    dataset: DataSet | None = None
    request: VolumeRequest | None = None

    def say(self, **more: Any) -> None:
        """Print a line (`tell`) with the facts known so far and `more`; `more` is not stored."""
        self.tell({"type": "volume", **self.about, **more})

    def keep(self, **more: Any) -> None:
        """Store `more` facts for all later lines and print them, as `say`."""
        self.about |= more
        self.say()

    def hold(self, data: Float32Array, grid: Volume) -> None:
        """Store a volume (nz, ny, nx) and its size for answers.

        The largest voxel side [mm] is sent.
        """
        self.grid = grid
        self.volumes = {"volume": data}
        self.about |= {
            "size": list(data.shape[::-1]),
            "voxel_mm": float(np.max(grid.voxel_mm)),
        }


def grow(
    held: Held, folder: Path, side: int, alive: Callable[[], bool] = lambda: True
) -> None:
    """Reconstruct a data set while it is taken.

    At most `MAX_VIEWS` views are used, binned. The process exits if the viewer has gone.
    At the end the voxels that no view covers are NaN. Progress is printed at most every
    `TELL_S` seconds. The correction of the data set is in its geometry; returns once the
    last image is in.

    Args:
        held: gets the volume, which exists before the first image.
        folder: of the data set.
        side: voxels along x and y, about; along z as many as the panel's height gives.
        alive: whether the viewer still waits.

    Raises:
        TwinError: no circular scan, or images that cannot be read.
    """
    _wait(folder / "flexdt.json", alive)
    data = load_dataset(folder)
    indices = range(0, len(data), max(1, -(-len(data) // MAX_VIEWS)))
    factor = max(1, data.shape[1] // side)
    cone_vec = data.corrected()[np.array(indices)].binned(factor, data.shape)
    shape = data.shape[0] // factor, data.shape[1] // factor
    whole = field_of_view(cone_vec, shape)
    voxel_mm = whole.shape[2] * float(np.max(whole.voxel_mm)) / side
    like = as_volume(field_of_view(cone_vec, shape, voxel_mm))
    target = OnProcessor(like)
    told = 0.0
    drawn = 0.0
    held.hold(target.volume().transpose(2, 0, 1), like)
    held.about |= {"made": made_of(data), "saturated": _saturated(data)}

    def parts() -> Iterator[Float32Array]:
        """Yield line integrals (1, rows, cols), binned, each as soon as its file is
        there.

        Dark and flat images are read when the first projection is there. Waits for each
        file; the process exits (SystemExit) if the viewer has gone. Frames are those of
        `indices`, in order.
        """
        normalise = None
        for index in indices:
            path = data.frames[index].path
            assert path is not None
            _wait(path, alive)
            if normalise is None:  # dark and flat images come before the projections
                normalise = load_dataset(folder).normalisation
            yield binned_mean(normalise(read_image(path, data.shape)), factor)[None]

    def progress(done: float) -> None:
        """Report the number of images at most every TELL_S seconds, with the surface
        every `SURFACE_INTERVAL_S` and at the end; the end is always reported.

        `done` is the share of images from 0 to 1.
        """
        nonlocal told, drawn
        if done < 1.0 and time.monotonic() < told + TELL_S:
            return
        told = time.monotonic()
        views = round(done * len(indices))
        more = {}
        if done == 1.0 or told >= drawn + SURFACE_INTERVAL_S:
            drawn = told
            more["surface"] = surface(target.volume(), like.voxel_mm, like.center_mm)
        held.say(views=views, of=len(indices), **more)

    volume = fdk_parts(parts, cone_vec, shape, like, progress=progress, target=target)
    held.hold(volume.data, like)  # voxels without any view are not a number now
    held.keep(done=1.0, views=len(indices), of=len(indices))


def reconstruct(held: Held, folder: Path, side: int) -> None:
    """Reconstruct the volume of a past scan, as `flexdt reconstruct` does from binned
    images.

    The volume and its surface come first, with the reconstruction's warnings as `doubts` and
    the part of voxels that no view sees; then the accuracy, whose `details` a tooltip shows,
    the sharpness if there are edges, and `sigma` and `bias_bound`, if any. The surface is
    printed with `FINISHED_CELLS` cells and not stored.

    Args:
        held: gets the volume and the progress.
        folder: of the data set.
        side: columns to which images are binned, about.

    Raises:
        TwinError: as `reconstruct_volume`.
    """
    work = Stages(held, "done", RECONSTRUCTING)
    work.begin("looking at the pixels")
    data = load_dataset(folder)
    held.dataset = data
    held.about |= {"made": made_of(data), "saturated": _saturated(data)}
    held.request = VolumeRequest(binning=max(1, round(data.shape[1] / side)))
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        volume = reconstruct_volume(
            data,
            held.request,
            progress=work.reading("reading and reconstructing"),
            errors=True,
        )
    said = [str(doubt.message) for doubt in doubts]
    held.hold(volume.data, volume)  # what shows need not wait for its errors
    held.about |= {
        "views": len(data.present),
        "of": len(data),
        "binning": held.request.binning,
        "geometry": _named(data.correction),
        "doubts": said,
        "uncovered": float(1.0 - np.isfinite(volume.data).mean()),
        **_facts(data),
    }
    work.begin("comparing the images")
    grown = volume.data.transpose(1, 2, 0)
    held.say(surface=surface(grown, volume.voxel_mm, volume.center_mm, FINISHED_CELLS))
    sharpness = volume.sharpness
    work.begin("finding the accuracy")
    accuracy = volume.accuracy
    if accuracy is not None and not any(str(accuracy) in doubt for doubt in said):
        said.append(str(accuracy))
    if sharpness.across is not None:
        said.append(str(sharpness))
    held.about["details"] = "" if accuracy is None else accuracy.details
    work.begin("finding the noise")
    for name in ("sigma", "bias_bound"):
        if (found := getattr(volume, name)) is not None:
            held.volumes[name] = found
    held.about["volumes"] = list(held.volumes)
    work.end()


class Stages:
    """Report how far work of several stages is, by their shares of it.

    Args:
        held: says so, and keeps it with the facts.
        name: of the share that is done, 0 to 1, among the facts.
        shares: stage -> its part of the whole, in order.
    """

    def __init__(self, held: Held, name: str, shares: Mapping[str, float]) -> None:
        """Take the stages; nothing is said before the first one begins."""
        self._held = held
        self._name = name
        self._shares = shares
        self._told = 0.0

    def begin(self, stage: str) -> None:
        """Say that a stage begins: those before it are done."""
        self._say(stage, 0.0)

    def reading(self, stage: str) -> Callable[[float, float], None]:
        """Make a progress callback (done, whole) of a stage; it says so at most every `TELL_S`
        seconds, and the stage that follows once all is done."""
        following = list(self._shares)[list(self._shares).index(stage) + 1]

        def report(done: float, whole: float) -> None:
            if math.isclose(done, whole):
                self.begin(following)
            elif time.monotonic() >= self._told + TELL_S:
                self._say(stage, done / whole)

        return report

    def end(self) -> None:
        """Say that all is done, with no stage."""
        self._held.about.pop("phase", None)
        self._held.keep(**{self._name: 1.0})

    def _say(self, stage: str, part: float) -> None:
        """Say that so much of a stage is done."""
        self._told = time.monotonic()
        before = itertools.takewhile(lambda name: name != stage, self._shares)
        done = sum(self._shares[name] for name in before) + part * self._shares[stage]
        self._held.keep(phase=stage, **{self._name: done / sum(self._shares.values())})


def _named(correction: NamedCorrection | None) -> str:
    if correction is None:
        return "no correction"
    return f"correction “{correction.name}”"


def made_of(data: DataSet) -> dict[str, Any]:
    """Collect what a data set's volume is compared with the stage by: `sample`, `revision`,
    `material`, `offset` (None where it does not say) and `correction`, a name.
    """
    sample = SampleRecord() if data.document is None else data.document.sample
    correction = None if data.correction is None else data.correction.name
    return sample.identity() | {"correction": correction}


def _saturated(data: DataSet) -> float | None:
    return None if data.document is None else data.document.saturated


def _facts(data: DataSet) -> dict[str, Any]:
    """Collect a data set's `sample`, `started` (YYYY-MM-DD HH:MM) and `kV`, for people.

    Texts are "" without the scan's document, `kV` None without settings.
    """
    settings = data.settings
    document = data.document
    return {
        "sample": "" if document is None else document.sample.name,
        "started": "" if document is None else f"{document.started:%Y-%m-%d %H:%M}",
        "kV": None if settings is None else settings.kV,
    }


def compare(held: Held, now: NamedCorrection | None) -> None:
    """Compare a past scan's volume with the truth of its sample, with a correction and
    without.

    Without a correction to compare with only the volume itself is compared; then the
    figures of each are kept by name. The other geometry is the nominal one if the scan
    has a correction, else that of `now`; without both nothing is reconstructed. It has
    the same grid as the volume. `difference` (volume minus truth) is stored, too;
    progress is printed as `comparing` from 0 to 1.

    Args:
        held: gets the volumes `truth` and, where there is a correction, `other`; prints
            the figures.
        now: the correction in force, for a scan that was made without one.

    Raises:
        TwinError: the truth is not known, or there is no volume of a past scan.
    """
    data = held.dataset
    grid = held.grid
    request = held.request
    if data is None or grid is None or request is None:
        raise TwinError(
            "only the finished volume of a past scan is compared with its truth", {}
        )
    voxel_mm = float(np.max(grid.voxel_mm))
    if data.correction is not None:
        other = NOMINAL
    elif now is None:
        other = None
    else:
        other = now.parameters
    stages = dict(list(COMPARING.items())[: None if other is not None else 2])
    work = Stages(held, "comparing", stages)
    work.begin("computing the truth")
    truth = held.volumes.setdefault("truth", truth_of(data, grid))
    held.volumes["difference"] = held.volumes["volume"] - truth
    work.begin("measuring the volume")
    rows = {_named(data.correction): figures(held.volumes["volume"], truth, voxel_mm)}
    if other is not None:
        work.begin("reconstructing with the other geometry")
        same = replace(
            request, voxel_mm=voxel_mm, shape=grid.shape, center_mm=grid.center_mm
        )
        progress = work.reading("reconstructing with the other geometry")
        made = reconstruct_volume(data, same, parameters=other, progress=progress)
        held.volumes["other"] = made.data
        rows[_named(None if data.correction is not None else now)] = figures(
            made.data, truth, voxel_mm
        )
    held.about |= {"compared": rows, "volumes": list(held.volumes)}
    work.end()


def _wait(path: Path, alive: Callable[[], bool]) -> None:
    """Wait until a file is there; SystemExit(0) once the parent ended."""
    while not path.is_file():
        if not alive():
            raise SystemExit(0)
        time.sleep(LOOK_S)


class Served:
    """Standard output of the process: documents and answers, one at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def say(self, document: dict[str, Any]) -> None:
        """Print a document; its surface apart, for the viewer, the rest for pages."""
        self._write(json.dumps(document.pop("surface", None)), json.dumps(document))

    def answer(self, told: object, content: bytes = b"") -> None:
        """Write the answer to a request; answers keep the requests' order.

        Codes are limited to `MAX_VOXELS` of a past scan, `MAX_GROWING_VOXELS` of a
        growing one. Voxel values are None where not covered. A comparison blocks until it
        ends; its error becomes `not_compared`."""
        self._write("answer", str(len(content)), json.dumps(told), content=content)

    def _write(self, *words: str, content: bytes = b"") -> None:
        with self._lock, suppress(OSError):
            sys.stdout.buffer.write("\t".join(words).encode() + b"\n" + content)
            sys.stdout.buffer.flush()


def answer(held: Held, served: Served, asked: list[str]) -> None:
    """Answer one line of standard input.

    "block" sends head and codes of a volume, of at most `MAX_VOXELS` (of one that grows
    `MAX_GROWING_VOXELS`) voxels; "voxel" the values of all volumes there; "compare" an
    empty answer at once and the figures, or an error as `not_compared`, later. Anything
    else, and an unknown volume, gets an empty answer.

    Args:
        held: volumes of the process.
        served: writer of the answers.
        asked: words of the line: `block NAME`, `voxel X Y Z` or `compare JSON`.
    """
    match asked:
        case ["block", name] if name in held.volumes:
            most = MAX_VOXELS if held.about["past"] else MAX_GROWING_VOXELS
            served.answer(*block(held.volumes[name], most))
        case ["voxel", x, y, z]:
            at = int(x), int(y), int(z)
            there = held.volumes.copy()  # its errors may just be coming
            served.answer({name: exact(data, at) for name, data in there.items()})
        case ["compare", now]:
            served.answer({})
            parameters = json.loads(now)
            given = parameters and NamedCorrection(
                parameters["name"],
                "",
                Offsets.from_edge(parameters["parameters"]),
                sides_known=parameters["sides_known"],
            )
            _told(held, lambda: compare(held, given), "not_compared")
        case _:
            served.answer({})


def _told(held: Held, work: Callable[[], object], problem: str = "problem") -> None:
    """Do work, and keep an error of any kind as `problem`, with its type if it is
    unexpected.

    So the page does not wait for ever. TwinError, OSError and ValueError are expected.
    """
    try:
        work()
    except (
        Exception
    ) as error:  # of any kind: the page shows it instead of waiting for ever
        known = isinstance(error, (TwinError, OSError, ValueError))
        held.keep(
            **{problem: str(error) if known else f"{type(error).__name__}: {error}"}
        )


def main() -> None:
    """Run the process: reconstruct in a thread, answer requests from standard input
    meanwhile.

    The first line names the folder, the volume's side, and whether the data set is past
    (complete: all threads) or grows (one thread, ends with the parent). Returns at once
    if standard input is closed. The priority is lowered by 5 and the kernels are loaded
    before the first line is read; then each further line is answered until the input
    ends.
    """
    parent = os.getppid()
    served = Served()
    os.nice(5)  # neither twin nor viewer waits for a volume
    warm()
    if not (line := sys.stdin.readline()):
        return  # the viewer ended without a request
    folder, side, *past = line.rstrip("\n").split("\t")
    about = {"name": Path(folder).name, "side": int(side), "past": bool(past)}
    held = Held(served.say, about)

    def work() -> None:
        """Reconstruct a past data set, or follow a growing one.

        That uses one thread, and ends with the parent process.
        """
        if past:
            reconstruct(held, Path(folder), int(side))
            return
        numba.set_num_threads(1)  # of this thread: the scan has the others
        grow(held, Path(folder), int(side), lambda: os.getppid() == parent)

    threading.Thread(target=_told, args=(held, work), daemon=True).start()
    for line in sys.stdin:
        answer(held, served, line.rstrip("\n").split("\t"))


def warm() -> None:
    """Reconstruct a volume from four images of 4 x 4 pixels, so that the kernels are
    loaded, which takes seconds.
    """
    scan = ConeVec.circular(sod=100, sdd=200, angles=4, shape=(4, 4), pixel=1)
    like = as_volume(field_of_view(scan, (4, 4)))
    fdk_parts(lambda: [np.zeros((4, 4, 4), np.float32)], scan, (4, 4), like)


if __name__ == "__main__":
    main()
