"""Real data, what was published of them, and what flexdt makes of them.

Nothing of the data is in the repository: their licences are their own. Each case names its files
below the folder that `flexdt evidence --data` is given, and where they come from.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

import flexdt as fx
from flexdt.extending import package

Array = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Figure:
    """One published answer beside ours.

    Attributes:
        what: was compared.
        published, ours: in words or numbers.
        agrees: whether ours is as near as is asked for.
    """

    what: str
    published: str
    ours: str
    agrees: bool


@dataclass(frozen=True)
class Case:
    """A set of real data.

    Attributes:
        files: that it needs, patterns below the data's folder.
        source, licence: of the data.
        compare: makes the figures of the files.
    """

    files: str
    source: str
    licence: str
    compare: Callable[[list[Path]], Iterator[Figure]]


class _Numbers(pickle.Unpickler):
    """Reads pickled NumPy numbers and nothing else: a pickle may otherwise run anything."""

    def find_class(self, module: str, name: str) -> Any:
        arrays = module.startswith("numpy.") or module == "numpy"
        if (arrays and name in ("_reconstruct", "ndarray", "dtype", "scalar")) or (
            (module, name) == ("_codecs", "encode")
        ):
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"{module}.{name} in a file of numbers")


VIEWS: Final[Mapping[str, int]] = {"pos_2": 3600, "pert_0": 24, "pert_2": 14, "pert_2++": 24}
"""CaTE's scans of 25 September 2020 -> views of a turn."""
SHIFT_MM: Final = -758.0
"""From the SDD of 1098 mm that CaTE starts with."""
APART_MM: Final = 0.1
SCALE: Final = 0.003
"""How far markers may be apart between scans, and how unlike in size: marks of three to ten views
know the SDD to 0.4 % at best."""


def needles(files: list[Path]) -> Iterator[Figure]:
    """CaTE: marks in radiographs of the FleX-ray itself, of objects of unknown shape."""
    shapes: dict[str, Array] = {}
    for file in files:
        scan = file.name.removeprefix("needle_25Sep2020_").removesuffix("_locations.npy")
        with file.open("rb") as stream:
            np.lib.format.read_magic(stream)
            np.lib.format.read_array_header_1_0(stream)
            seen = _Numbers(stream).load().item()
        frames = sorted(seen)
        marks = [
            (k, "/".join(name), float(column), float(row), None)
            for k, frame in enumerate(frames)
            for name, (column, row) in seen[frame].items()
        ]
        start = fx.ConeVec.circular(
            sod=600, sdd=1098, angles=[360.0 * f / VIEWS[scan] for f in frames],
            shape=(1944, 1536), pixel=0.0748,
        )  # fmt: skip
        found = fx.calibrate(
            None, "unknown", geometry=start, markers=marks, free=("dO_x", "dD_z"),
            priors={"dD_x": 0, "dD_y": 20, "dD_z": 1000, "dO_z": 0},
        )  # fmt: skip
        document: Any = found.document
        value, sigma = (document["parameters"]["dD_z"][key] for key in ("value", "sigma"))
        ours = f"{value:.2f} +- {sigma:.2f} mm" if document["identifiable"] else "refused"
        near = document["identifiable"] and abs(value - SHIFT_MM) <= 2 * sigma
        rms = document["rms_px"]
        yield Figure(f"{scan}: shift of the detector", "about -758 mm", ours, near)
        yield Figure(f"{scan}: residual", "hand-made marks", f"{rms:.2f} px rms", rms < 1.0)
        places = {m["name"]: m["position_mm"] for m in document["markers"]}
        shapes[scan] = np.array([places[name] for name in sorted(places)])
    for one, other in combinations(shapes, 2):
        apart, scale = _apart(shapes[one], shapes[other])
        ours = f"{apart:.3f} mm rms, {100 * (scale - 1):+.2f} % larger"
        near = apart <= APART_MM and abs(scale - 1) <= SCALE
        yield Figure(f"{one} and {other}: markers", "the same", ours, near)


def _apart(one: Array, other: Array) -> tuple[float, float]:
    """Root mean square distance of points (k, 3) after the best turn, shift and scale, and the
    second's size in the first's, which the two scans' SDD tell to a few tenths of a per cent.
    """
    from scipy.spatial import procrustes

    first, second = (float(np.linalg.norm(p - p.mean(axis=0))) for p in (one, other))
    return first * float(np.sqrt(procrustes(one, other)[2] / len(one))), second / first


def helsinki(files: list[Path]) -> Iterator[Figure]:
    """HTC 2022: fan-beam sinograms beside the images that their authors published."""
    from scipy.io import loadmat

    for file in files:
        name = file.name.removeprefix("htc2022_").removesuffix("_full.mat")
        scan = loadmat(file, simplify_cells=True)["CtDataFull"]
        said = scan["parameters"]
        image = loadmat(file.with_name(f"{file.stem}_recon_fbp.mat"))["reconFullFbp"]
        turn = np.asarray(said["angles"], float)
        once = turn < turn[0] + 360.0 - 1e-6  # the last view is the first one again
        geometry = fx.ConeVec.circular(
            sod=float(said["distanceSourceOrigin"]), sdd=float(said["distanceSourceDetector"]),
            angles=turn[once], shape=(1, scan["sinogram"].shape[1]),
            pixel=float(said["pixelSizePost"]),
        )  # fmt: skip
        voxel = float(said["effectivePixelSizePost"])
        views = scan["sinogram"][once, None].astype(np.float32)
        ours = fx.fdk(views, geometry, fx.Grid((1, *image.shape), voxel)).data[0, ::-1]
        alike = float(np.corrcoef(ours.ravel(), image.ravel())[0, 1])
        yield Figure(f"{name}: correlation", "0.9999", f"{alike:.6f}", alike >= 0.9999)


def tooth(files: list[Path]) -> Iterator[Figure]:
    """Tomopy's tooth: half a turn in a parallel beam, which flexdt does not take."""
    h5py = package("h5py", "HDF5 files", "io")
    with h5py.File(files[0]) as stored:
        scan = stored["exchange"]
        counts, white = scan["data"][:].astype(np.uint16), scan["data_white"][:].mean(axis=0)
        dark, turn = scan["data_dark"][:].mean(axis=0), scan["theta"][:]  # deg
    far = fx.ConeVec.circular(sod=1e5, sdd=1.001e5, angles=turn, shape=counts.shape[1:], pixel=0.01)
    data = fx.DataSet.from_arrays(counts, far, dark=dark, flat=white)
    why = data.align().alignment.refused.get("axis_column_px", "")
    yield Figure("align", "to be refused", why or "an answer", bool(why))
    try:
        said = str(fx.reconstruct(data, voxel=0.02))
    except fx.TwinError as error:
        said = str(error)
    yield Figure("FDK", "to be refused", said, "180 deg" in said)


CASES: Final[Mapping[str, Case]] = {
    "cate": Case(
        "**/needle_25Sep2020_*_locations.npy", "github.com/adriaangraas/CaTE, examples/needles",
        "GPL-3.0 (the repository's)", needles,
    ),
    "htc2022": Case("**/htc2022_*_full.mat", "zenodo.org/records/6984868", "CC-BY-4.0", helsinki),
    "tooth": Case("**/tooth.h5", "github.com/tomopy/tomopy", "BSD-3-Clause", tooth),
}  # fmt: skip
