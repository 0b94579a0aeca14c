"""Real data, their published answers, and flexdt's.

Nothing of the data is in the repository: their licenses are their own. Each case names
its files below the folder of `flexdt evidence --data`, and their origin.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

import flexdt as fx
from flexdt.extending import package

Array = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Figure:
    """One published answer and ours.

    Attributes:
        what: compared quantity.
        published, ours: in words or numbers.
        agrees: whether ours is within the tolerance.
    """

    what: str
    published: str
    ours: str
    agrees: bool


@dataclass(frozen=True)
class NotRead:
    """Data that could not be read; they are no evidence of flexdt's answers.

    Attributes:
        what: file or reader.
        why: in words.
    """

    what: str
    why: str


Told = Figure | NotRead


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
    compare: Callable[[list[Path]], Iterator[Told]]

    def told(self, files: list[Path]) -> Iterator[Told]:
        """Compare these files and yield the figures; an error is a figure as well and
        not raised."""
        return _with_errors(lambda: self.compare(files), self.files)


def _with_errors(make: Callable[[], Iterator[Told]], what: str) -> Iterator[Told]:
    """Yield the figures of `make`, and an error that ends it as one more.

    An error out of flexdt is a missed figure. A reader that is not installed, or an error
    of other packages, is `NotRead`.

    Args:
        make: yields figures.
        what: name of an error's figure.
    """
    try:
        yield from make()
    except Exception as error:  # readers of other projects have errors of their own
        said = f"{type(error).__name__}: {error}".rstrip(": ")
        missing = isinstance(error, fx.TwinError) and (error.data or {}).get("missing")
        if isinstance(missing, str):
            yield NotRead(what, str(error))
        elif any(name.startswith("flexdt.") for name in _modules(error)):
            yield Figure(what, "an answer", said, False)
        else:
            yield NotRead(what, said)


def _modules(error: BaseException) -> Iterator[str]:
    """Yield the names of the modules in an error's traceback, outermost first."""
    at = error.__traceback__
    while at is not None:
        yield str(at.tb_frame.f_globals.get("__name__"))
        at = at.tb_next


class _Numbers(pickle.Unpickler):
    """Reads pickled NumPy numbers and nothing else: a pickle may otherwise run anything.

    CaTE's own objects become bare names of their numbers.
    """

    def find_class(self, module: str, name: str) -> Any:
        """Find a class of a pickle: those of NumPy's arrays, and a plain namespace for CaTE's
        own.

        Raises:
            pickle.UnpicklingError: any other.
        """
        if module.startswith("cate."):
            return SimpleNamespace
        numbers = {
            "numpy": ("_reconstruct", "ndarray", "dtype", "scalar"),
            "_codecs": ("encode",),
        }
        if name in numbers.get(module.split(".")[0], ()):
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"{module}.{name} in a file of numbers")


def _numbers(file: Path) -> Any:
    """Read the pickled dictionary of a NumPy file, as CaTE stores it; only classes that
    `_Numbers` allows are read.
    """
    with file.open("rb") as stream:
        np.lib.format.read_magic(stream)
        np.lib.format.read_array_header_1_0(stream)
        return _Numbers(stream).load().item()


def _fit_to_marks(
    seen: Any, frames: Any, start: fx.ConeVec, *free: str
) -> tuple[Any, Array]:
    """Fit the geometry to CaTE's marks, of unknown positions.

    Priors: dD_y 20 mm, dD_z 1000 mm if it is free; dD_x and dO_z, and a dD_z that is not
    free, are fixed at 0. Marks have no stated error.

    Args:
        seen: frame -> marker -> column and row [px].
        frames: numbers of the frames.
        start: geometry to start from.
        free: names of the free offsets.

    Returns:
        The report, and the markers' positions (k, 3) [mm], in the order of their names.
    """
    marks = [
        (k, str(name), float(column), float(row), None)
        for k, frame in enumerate(frames)
        for name, (column, row) in seen[frame].items()
    ]
    priors = {"dD_x": 0, "dD_y": 20, "dD_z": 1000 if "dD_z" in free else 0, "dO_z": 0}
    found = fx.calibrate(
        None, "unknown", geometry=start, markers=marks, free=free, priors=priors
    )
    document: Any = found.document
    places = {m["name"]: m["position_mm"] for m in document["markers"]}
    return document, np.array([places[name] for name in sorted(places)])


VIEWS: Final[Mapping[str, int]] = {
    "pos_2": 3600,
    "pert_0": 24,
    "pert_2": 14,
    "pert_2++": 24,
}
"""CaTE's scans of 25 September 2020 -> views of a turn."""
SHIFT_MM: Final = -758.0
"""Shift of the detector [mm], against the SDD of 1098 mm that CaTE starts with."""
APART_MM: Final = 0.1
SCALE: Final = 0.003
"""Largest distance of markers between scans, and of their sizes' ratio from 1: marks
of three to ten views determine the SDD to 0.4 % at best."""


def needles(files: list[Path]) -> Iterator[Told]:
    """Compare CaTE: marks in radiographs of the FleX-ray itself, of objects of unknown
    shape.

    A scan whose views are not known, or that fails, is yielded as not read or missed. The
    shift agrees if it is identifiable and within 2 sigma of `SHIFT_MM`, the residual below
    1 px rms, markers within `APART_MM` and `SCALE`.

    Args:
        files: of marks, one for each scan.

    Yields:
        Shift of the detector and residual of each scan; markers of each pair.
    """
    shapes: dict[str, Array] = {}

    def of_scan(file: Path) -> Iterator[Told]:
        """Calibrate one scan and compare the detector's shift and the residual.

        The markers' positions are kept in `shapes`. A scan whose views are not known is
        yielded as not read.

        Args:
            file: of its marks.
        """
        scan = file.name.removeprefix("needle_25Sep2020_").removesuffix("_locations.npy")
        if scan not in VIEWS:
            yield NotRead(file.name, f"views of a turn are known for {', '.join(VIEWS)}")
            return
        seen = _numbers(file)
        frames = sorted(seen)
        turn = [360.0 * f / VIEWS[scan] for f in frames]
        start = fx.ConeVec.circular(
            sod=600, sdd=1098, angles=turn, shape=(1944, 1536), pixel=0.0748
        )
        document, shapes[scan] = _fit_to_marks(seen, frames, start, "dO_x", "dD_z")
        value, sigma = (document["parameters"]["dD_z"][key] for key in ("value", "sigma"))
        if document["identifiable"]:
            ours = f"{value:.2f} +- {sigma:.2f} mm"
        else:
            ours = "refused"
        near = document["identifiable"] and abs(value - SHIFT_MM) <= 2 * sigma
        rms = document["rms_px"]
        yield Figure(f"{scan}: shift of the detector", "about -758 mm", ours, near)
        yield Figure(
            f"{scan}: residual", "hand-made marks", f"{rms:.2f} px rms", rms < 1.0
        )

    for file in files:
        yield from _with_errors(partial(of_scan, file), file.name)
    for one, other in combinations(shapes, 2):
        apart, scale = _distances(shapes[one], shapes[other])
        ours = f"{apart:.3f} mm rms, {100 * (scale - 1):+.2f} % larger"
        near = apart <= APART_MM and abs(scale - 1) <= SCALE
        yield Figure(f"{one} and {other}: markers", "the same", ours, near)


def _distances(one: Array, other: Array) -> tuple[float, float]:
    """Compare two sets of points (k, 3) after the best turn, shift and scale; a mirror
    image counts as a turn.

    Returns:
        Root mean square distance at the first's scale and in its unit, and the second's
        size divided by the first's, which the two scans' SDD determine to a few tenths of
        a per cent.
    """
    from scipy.spatial import procrustes

    first, second = (float(np.linalg.norm(p - p.mean(axis=0))) for p in (one, other))
    return first * float(np.sqrt(procrustes(one, other)[2] / len(one))), second / first


DELFT: Final = "Calibration_needle_phantom_30degsec_table474mm"
PITCH: Final = (302 / 1524, 307 / 1548)
"""Pitch of the pixels of Delft's panels [mm], as its script has them."""


def delft(files: list[Path]) -> Iterator[Told]:
    """Compare three sources about one stage: each calibrated on its own, then their
    arrangement.

    The SDD must be refused (three views are too few), else the figure does not agree.
    The others agree within: residual 1.5 px rms, axis 0.1 mm, panel's height 2 mm,
    markers 0.2 mm rms, turn 0.1 deg, magnification `SCALE`. The stored geometry is read
    from the folder of the first file; its lengths [cm] are of the mirror image.

    Args:
        files: of marks, one for each source; frames with one mark are left out.

    Yields:
        SDD, residual and axis of each source; markers, turn and magnification of each
        pair.
    """
    stored = _numbers(
        files[0].with_name(f"geom_pre_proc_{DELFT}_calibrated_on_26aug2021.npy")
    )
    found: list[tuple[Array, Any, complex, float]] = []
    for k, file in enumerate(files, 1):
        seen = _numbers(file)
        frames = sorted(f for f in seen if len(seen[f]) > 1)
        turn = [(f - frames[0]) * 360 / 773 for f in frames]  # 773 frames are one
        start = fx.ConeVec.circular(
            sod=945, sdd=1215, angles=turn, shape=(1548, 550), pixel=PITCH
        )
        free, _ = _fit_to_marks(seen, frames, start, "dO_x", "dD_z")
        few = not free["identifiable"]
        sigma = free["parameters"]["dD_z"]["sigma"] or np.inf
        ours = f"{'refused' if few else 'an answer'}, sigma {sigma:.0f} mm"
        yield Figure(f"{k}: SDD", "three views are too few", ours, few)
        held, places = _fit_to_marks(seen, frames, start, "dO_x")
        rms = held["rms_px"]
        (aside, up) = (held["parameters"][key] for key in ("dO_x", "dD_y"))
        yield Figure(f"{k}: residual", "hand-made marks", f"{rms:.2f} px rms", rms < 1.5)
        # Theirs are cm; columns grow to the left, seen from the source, and a panel's middle is
        # at half their number: its mirror image is stored.
        source, panel = (
            10 * getattr(stored[k], name) for name in ("_source", "_detector")
        )
        here = complex(source[0], -source[1])
        there = complex(panel[0], -panel[1])
        axis = (here * there.conjugate()).imag / abs(here) + 0.5 * PITCH[0]
        above = panel[2] - source[2] + 0.5 * PITCH[1]
        values = aside["value"], aside["sigma"], up["value"]  # None where refused
        x, sigma, y = np.array(values, float) * [1215 / 945, 1215 / 945, 1.0]
        ours = f"{x:.2f} (sigma {sigma:.2g}), {y:.1f} mm"
        near = abs(x - axis) <= 0.1 and abs(y - above) <= 2.0  # half a pixel; ten
        yield Figure(
            f"{k}: axis aside, panel up", f"{axis:.2f}, {above:.1f} mm", ours, bool(near)
        )
        # From above, turned so that the source, about the axis, is at -90 degrees.
        flat = (places - places.mean(axis=0)) @ [1215 + 1j * x, 1215j - x, 0]
        found.append((places, flat, here, abs(here - there) / abs(here)))
    for (k, one), (m, other) in combinations(enumerate(found, 1), 2):
        apart, larger = _distances(one[0], other[0])
        yield Figure(
            f"{k} and {m}: markers", "the same", f"{apart:.3f} mm rms", apart <= 0.2
        )
        turned, stands = np.angle(
            [other[2] / one[2], np.vdot(other[1], one[1])], deg=True
        )
        more = other[3] / one[3]
        near = abs(stands - turned) <= 0.1 and abs(larger - more) <= SCALE
        theirs, ours = (
            f"{a:.2f} deg, {b:.4f}" for a, b in ((turned, more), (stands, larger))
        )
        yield Figure(f"{k} and {m}: turned, magnified", theirs, ours, bool(near))


def _by_matrix(matrix: Array, shape: tuple[int, ...], pixel: float) -> fx.ConeVec:
    """Convert a projection matrix to a geometry of one view.

    Args:
        matrix: (3, 4), from object [mm] to pixel (column, row); its third row is positive
            in front of the source.
        shape: rows and columns of the detector.
        pixel: width of a pixel [mm].
    """
    rays = np.linalg.inv(matrix[:, :3])
    source = -rays @ matrix[:, 3]
    rays *= pixel / np.linalg.norm(rays[:, 0])
    middle = source + rays @ [(shape[1] - 1) / 2, (shape[0] - 1) / 2, 1.0]
    return fx.ConeVec.from_vectors(
        source, middle, rays[:, 0], rays[:, 1], (shape[0], shape[1])
    )


def _across(view: fx.ConeVec, image: Array, normals: Array) -> Array:
    """Compute Grangeat's derivative of the object's integrals over planes through the source.

    It is that of the integrals of the image, weighted by cosines, over the planes' lines,
    across those and over the squared cosine of the plane. Pixels are square.

    Args:
        view: one view.
        image: (rows, cols) line integrals.
        normals: (k, 3) of the planes.

    Returns:
        (k,).
    """
    from scipy.ndimage import map_coordinates

    _, first, u, v = view.rays()[0].reshape(4, 3)
    foot = view.piercing_points()[0]
    far = abs(view.source_detector_distance[0]) / np.linalg.norm(u)  # px
    off = np.indices(image.shape)[::-1] - foot[:, None, None]
    weighted = image / np.sqrt(1 + (off**2).sum(axis=0) / far**2)
    line = normals @ np.stack([u, v, first + foot @ [u, v]], axis=1)
    line /= np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    x, y, at = line.T[..., None, None]
    along = np.arange(-sum(image.shape), sum(image.shape))
    beside = [[-1.0], [1.0]] - at
    places = [foot[1] + beside * y + along * x, foot[0] + beside * x - along * y]
    low, high = map_coordinates(weighted, places, order=1).sum(axis=2).T
    return np.asarray((1 + (line[:, 2] / far) ** 2) * (high - low) / 2)


def c_arm(files: list[Path]) -> Iterator[Told]:
    """Compare two views of a C-arm by their matrices: planes through both sources have
    one integral.

    Points are projections of random points by flexdt's geometry against the matrix itself:
    they agree within 1e-6 px for both matrices. Planes agree within 2 % as stored; for a
    matrix shifted by 5 px they must differ by more than 10 %, which shows that the check
    can fail.

    Args:
        files: of the two images, with matrices.

    Yields:
        Points and planes, as stored and for the shifted matrix.
    """
    matrices = []
    images = []
    pixel = 1.0
    for file in files:
        head, _, raw = file.read_bytes().partition(b"\n\n")
        said = dict(re.findall(r"^([^#:]+):=? *(.*?) *$", head.decode(), re.MULTILINE))
        columns, rows = map(int, said["sizes"].split())
        images.append(np.frombuffer(raw, "<f4", rows * columns).reshape(rows, columns))
        numbers = said["Projection Matrix"].strip("[]").replace(";", " ").split()
        matrices.append(np.array(numbers, float).reshape(3, 4))
        pixel = float(said["spacings"].split()[0])
    points = np.append(
        np.random.default_rng(0).uniform(-100, 100, (3, 100)), np.ones((1, 100)), 0
    )
    for lower in (0, 5):
        matrices[-1][1] += lower * matrices[-1][2]
        views = [
            _by_matrix(m, i.shape, pixel) for m, i in zip(matrices, images, strict=True)
        ]
        seen = np.array([(m @ points)[:2] / (m @ points)[2] for m in matrices])
        off = np.abs([v.project_points(points[:3].T)[0].T for v in views] - seen).max()
        yield Figure(
            f"points, {lower} px lower", "as by matrix", f"{off:.0e} px off", off < 1e-6
        )
        one, other = (v.source[0] for v in views)
        base = (other - one) / np.linalg.norm(other - one)
        flat = np.cross(base, one + other)
        turn = np.radians(np.linspace(-12.0, 12.0, 241))[:, None]
        normals = np.cos(turn) * flat + np.sin(turn) * np.cross(base, flat)
        here, there = (_across(v, i, normals) for v, i in zip(views, images, strict=True))
        apart = float(np.linalg.norm(here - there) / np.linalg.norm(here))
        ours = (
            f"{100 * apart:.1f} % apart, correlation {np.corrcoef(here, there)[0, 1]:.6f}"
        )
        what, agrees = (
            ("not the same", apart > 0.1) if lower else ("the same", apart < 0.02)
        )
        yield Figure(f"planes of both sources, {lower} px lower", what, ours, agrees)


def helsinki(files: list[Path]) -> Iterator[Told]:
    """Compare HTC 2022: fan-beam reconstructions with the images that their authors
    published.

    A file that cannot be read, or without its published image beside it, is yielded as
    not read. Views of the first turn alone are used.

    Args:
        files: of the sinograms.

    Yields:
        Correlation of each image; at least 0.9999 agrees.
    """
    from scipy.io import loadmat

    def of_scan(file: Path) -> Iterator[Told]:
        """Reconstruct one sinogram by FDK and compare it with the published image.

        It is yielded as not read if the published image is missing; a correlation of at
        least 0.9999 agrees.

        Args:
            file: of the sinogram.
        """
        name = file.name.removeprefix("htc2022_").removesuffix("_full.mat")
        published = file.with_name(f"{file.stem}_recon_fbp.mat")
        if not published.exists():
            yield NotRead(
                file.name, f"no {published.name}, the published image, beside it"
            )
            return
        scan = loadmat(file, simplify_cells=True)["CtDataFull"]
        said = scan["parameters"]
        image = loadmat(published)["reconFullFbp"]
        turn = np.asarray(said["angles"], float)
        once = turn < turn[0] + 360.0 - 1e-6  # the last view is the first one again
        lengths = ("distanceSourceOrigin", "distanceSourceDetector", "pixelSizePost")
        sod, sdd, pixel, voxel = (
            float(said[n]) for n in (*lengths, "effectivePixelSizePost")
        )
        shape = 1, scan["sinogram"].shape[1]
        fan = fx.ConeVec.circular(
            sod=sod, sdd=sdd, angles=turn[once], shape=shape, pixel=pixel
        )
        views = scan["sinogram"][once, None].astype(np.float32)
        ours = fx.fdk(views, fan, fx.Grid((1, *image.shape), voxel)).data[0, ::-1]
        alike = float(np.corrcoef(ours.ravel(), image.ravel())[0, 1])
        yield Figure(f"{name}: correlation", "0.9999", f"{alike:.6f}", alike >= 0.9999)

    for file in files:
        yield from _with_errors(partial(of_scan, file), file.name)


def tooth(files: list[Path]) -> Iterator[Told]:
    """Check that flexdt rejects Tomopy's tooth, half a turn in a parallel beam: `align`
    refuses the axis column, and FDK the short arc (an error naming 180 deg).
    """
    h5py = package("h5py", "HDF5 files", "io")
    with h5py.File(files[0]) as stored:
        scan = stored["exchange"]
        counts = scan["data"][:].astype(np.uint16)
        white = scan["data_white"][:].mean(axis=0)
        dark = scan["data_dark"][:].mean(axis=0)
        turn = scan["theta"][:]  # deg
    far = fx.ConeVec.circular(
        sod=1e5, sdd=1.001e5, angles=turn, shape=counts.shape[1:], pixel=0.01
    )
    data = fx.DataSet.from_arrays(counts, far, dark=dark, flat=white)
    why = data.align().alignment.refused.get("axis_column_px", "")
    yield Figure("align", "to be refused", why or "an answer", bool(why))
    said = _result_text(lambda: fx.reconstruct(data, voxel=0.02))
    yield Figure("FDK", "to be refused", said, "180 deg" in said)


def zeiss(files: list[Path]) -> Iterator[Told]:
    """Check Tomopy's scan of a chip in Zeiss's own format: a parallel beam, too."""
    said = _result_text(lambda: fx.open(files[0])).removeprefix(f"{files[0]}: ")
    yield Figure("open", "to be refused", said, "a parallel beam" in said)


def _result_text(make: Callable[[], Any]) -> str:
    """Call `make` and return its result, or the message of its TwinError, as text; other
    errors are raised.
    """
    try:
        return str(make())
    except fx.TwinError as error:
        return str(error)


CASES: Final[Mapping[str, Case]] = {
    "cate": Case(
        "**/needle_25Sep2020_*_locations.npy",
        "github.com/adriaangraas/CaTE, examples/needles",
        "GPL-3.0 (the repository's)",
        needles,
    ),
    "htc2022": Case(
        "**/htc2022_*_full.mat", "zenodo.org/records/6984868", "CC-BY-4.0", helsinki
    ),
    "tooth": Case("**/tooth.h5", "github.com/tomopy/tomopy", "BSD-3-Clause", tooth),
    "zeiss": Case("**/*chip*.txrm", "github.com/tomopy/tomopy", "BSD-3-Clause", zeiss),
    "carm": Case(
        "**/proj0?0.nrrd", "github.com/aaichert/EpipolarConsistency", "Apache-2.0", c_arm
    ),
    "delft": Case(
        f"**/pre_proc_{DELFT}_cam?.npy",
        "github.com/adriaangraas/fluidized-bed-ct, scripts/calib",
        "GPL-3.0 (the repository's)",
        delft,
    ),
}
