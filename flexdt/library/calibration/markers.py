"""Calibration from markers: marked by hand, found by another program, or of unknown positions.

A file of markers has the pixel of each in each frame. The columns of a CSV file are named
in its first line: frame (counted from 0), marker, column, row and, if it is known, sigma
[px]; a marker that was not seen has no line. A NumPy file holds (frames, markers, 2)
pixels, nan where unseen. Pixel (0, 0) is the middle of the first one, row 0 is the upper
one.
"""

from __future__ import annotations

import csv
import io
import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.calibration.exposure_share import exposure_share
from flexdt.library.datasets.image_set import Images, ImageSet
from flexdt.phantoms import Phantom
from flexdt.runtime.files.array_files import read_arrays
from flexdt.runtime.files.dataset_folder import read_text
from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections, SpotFinder
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.calibration.fit.priors import prior_widths
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.calibration.frame_source import (
    Frames,
    FrameSpots,
    FrameState,
    SpotFrames,
)
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.calibration.unknown_markers import (
    ANYWHERE_MM,
    Index,
    centred,
    link,
    triangulate,
)
from flexdt.twin.errors import FileError, TwinError
from flexdt.twin.findings import Findings, error
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.input_limits import LIMITS, InputLimitError
from flexdt.twin.projection.analytic_solids import Scene

ASSUMED_SIGMA_PX: Final = 0.5
"""Assumed: standard deviation of a marker's position where the file states none [px]."""
MAX_PLACE_PX: Final = 1e5
"""A coordinate of a marker is at most so large [px]."""
MAX_SIGMA_PX: Final = 1e4
"""And its standard deviation."""
FREE_SCALE: Final = 0.05
"""Relative uncertainty of SOD where no distance of two markers is known, assumed."""
MAX_SCALE_MM: Final = 1e5
"""A known distance is at most so long."""
SCALE_FORM: Final = (
    "A-B=MM or A-B=MM+-SIGMA, the distance of markers A and B, such as 0-3=41.5+-0.02"
)
COLUMN_NAMES: Final = {
    "frame": ("frame", "view", "image", "projection"),
    "marker": ("marker", "bead", "point", "id"),
    "column": ("column", "col", "x", "u"),
    "row": ("row", "y", "v"),
}
"""Column of a CSV file -> names that it may have."""


Mark = tuple[int, str, float, float, float | None]
"""A marker's place in a frame: frame (counted from 0), marker, column, row and sigma
[px], None for `ASSUMED_SIGMA_PX`."""


@dataclass(frozen=True, eq=False)
class Markers:
    """Where markers were seen.

    Attributes:
        names: of the k markers.
        tracks: (n, k, 2) pixels (column, row), nan where unseen.
        sigma: (n, k) standard deviation of each coordinate [px].
    """

    names: tuple[str, ...]
    tracks: FloatArray
    sigma: FloatArray

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(n, k) whether it was seen."""
        return np.asarray(np.isfinite(self.tracks).all(axis=2), dtype=np.bool_)


@dataclass(frozen=True)
class Scale:
    """A known distance of two markers [mm], and its standard deviation."""

    a: str
    b: str
    mm: float
    sigma_mm: float = 0.05

    @classmethod
    def of(cls, text: str) -> Scale:
        """Parse A-B=MM, or A-B=MM+-SIGMA.

        Spaces around the names are removed; without +-SIGMA sigma is the class's default.

        Raises:
            TwinError: the text has another form, a name is empty, or a size is not above
                0 and at most `MAX_SCALE_MM`.
        """
        pair, _, size = text.rpartition("=")
        a, dash, b = pair.partition("-")
        mm, _, sigma = size.partition("+-")
        try:
            scale = cls(
                a.strip(), b.strip(), float(mm), float(sigma) if sigma else cls.sigma_mm
            )
        except ValueError:
            scale = cls(a, b, math.nan)
        sizes = (scale.mm, scale.sigma_mm)
        if not (
            dash
            and scale.a
            and scale.b
            and all(0 < size <= MAX_SCALE_MM for size in sizes)
        ):
            raise TwinError.instead(f"scale {text!r}", text, SCALE_FORM)
        return scale


def read_markers(source: str | PathLike[str] | Sequence[Mark], views: int) -> Markers:
    """Read the markers of a file (.npy: NumPy, else CSV), or collect given marks.

    `views`: number of frames. Returns markers by name; without marks there are none.
    Raises TwinError: cannot be read or invalid; names the line.
    """
    if not isinstance(source, str | PathLike):
        return _gathered((_mark(f"mark {i}", row) for i, row in enumerate(source)), views)
    path = Path(source)
    if path.suffix.lower() == ".npy":
        return _of_array(path, views)
    return _of_table(path, views)


def _of_array(path: Path, views: int) -> Markers:
    """Read markers of a NumPy file.

    Markers are named 0, 1, ...; their sigma is assumed.

    Args:
        path: of an array (views, markers, 2) of pixels, nan where unseen.
        views: that the scan has.

    Raises:
        TwinError: unreadable, another shape, or pixels too far away.
    """
    try:
        tracks = read_arrays(path)["array"].astype(np.float64, casting="same_kind")
    except InputLimitError:
        raise
    except KeyError:
        raise TwinError(f"cannot read {path}: it holds several arrays") from None
    except OSError as error:
        raise FileError.of(error) from None
    except (TypeError, ValueError):
        said = f"cannot read {path}: it is no NumPy file of numbers, or a damaged one"
        raise TwinError(said) from None
    if tracks.ndim != 3 or tracks.shape[0] != views or tracks.shape[2] != 2:
        raise TwinError.of_shape(
            f"{path}: array", tracks.shape, (f"{views} frames", "markers", 2)
        )
    if (np.abs(tracks) > MAX_PLACE_PX).any():
        farthest = float(np.nanmax(np.abs(tracks)))
        allowed = f"{MAX_PLACE_PX:g}, nan where unseen"
        raise TwinError.instead(f"{path}: pixels up to {farthest:g}", farthest, allowed)
    names = tuple(str(k) for k in range(tracks.shape[1]))
    return Markers(names, tracks, np.full(tracks.shape[:2], ASSUMED_SIGMA_PX))


def _of_table(path: Path, views: int) -> Markers:
    """Read markers of a CSV file whose first line names its columns.

    The head's words are those of `COLUMN_NAMES`, in either case and any order. Empty
    lines are skipped; an empty column or row is nan; without a sigma column sigma is
    None.

    Args:
        path: of the file.
        views: that the scan has.

    Raises:
        TwinError: unreadable, a column that the head lacks, or an invalid line; names the
            line.
    """
    try:
        rows = list(csv.reader(io.StringIO(read_text(path, LIMITS["table"].file_bytes))))
    except csv.Error as error:
        raise TwinError(f"cannot read {path}: {error}") from None
    if rows:
        head = [word.strip().lower() for word in rows[0]]
    else:
        head = []
    at = {
        n: next((head.index(w) for w in words if w in head), -1)
        for n, words in COLUMN_NAMES.items()
    }
    if -1 in at.values():
        message = f"{path}, line 1: columns {', '.join(head) or 'none'}"
        raise TwinError.instead(
            message, head, "frame, marker, column, row and, optionally, sigma"
        )
    if "sigma" in head:
        width = head.index("sigma")
    else:
        width = -1
    marks: list[tuple[str, Mark]] = []
    for line, row in enumerate(rows[1:], start=2):
        if not any(word.strip() for word in row):
            continue
        try:
            frame = int(row[at["frame"]])
            name = row[at["marker"]].strip()
            x, y = (float(row[at[n]] or "nan") for n in ("column", "row"))
            if width >= 0:
                sigma = float(row[width])
            else:
                sigma = None
        except (ValueError, IndexError):
            raise TwinError(
                f"{path}, line {line}: {','.join(row)!r} is not {head}"
            ) from None
        marks.append((f"{path}, line {line}", (frame, name, x, y, sigma)))
    return _gathered(marks, views)


def _mark(where: str, row: Mark) -> tuple[str, Mark]:
    """Check and convert the types of a mark; a name that is a number becomes its text.

    Args:
        where: place in its file, for messages.
        row: frame, marker, column, row [px] and sigma.

    Returns:
        `where` and the mark.

    Raises:
        TwinError: it has another form.
    """
    try:
        frame, name, column, line, sigma = row
        if sigma is None:
            stated = None
        else:
            stated = float(sigma)
        return where, (
            operator.index(frame),
            str(name),
            float(column),
            float(line),
            stated,
        )
    except (TypeError, ValueError):
        allowed = "(frame, marker, column, row, sigma), sigma None where it is not known"
        raise TwinError.instead(f"{where} is {row!r}", repr(row), allowed) from None


def _gathered(marks: Iterable[tuple[str, Mark]], views: int) -> Markers:
    """Collect marks into a table, markers in the order of their names.

    Without a sigma `ASSUMED_SIGMA_PX` is taken; decimal names come first, by number.
    Marks that are missing are nan.

    Args:
        marks: each with its place in the source, for messages.
        views: that the scan has.

    Raises:
        TwinError: a frame that the scan has not, a sigma that is not above 0 and at most
            `MAX_SIGMA_PX`, a pixel beyond `MAX_PLACE_PX`, or a marker twice in one frame.
    """
    seen: dict[tuple[int, str], tuple[float, float, float]] = {}
    for where, (frame, name, x, y, stated) in marks:
        if stated is None:
            sigma = ASSUMED_SIGMA_PX
        else:
            sigma = stated
        if (
            not 0 <= frame < views
            or (frame, name) in seen
            or not 0 < sigma <= MAX_SIGMA_PX
        ):
            raise TwinError.instead(
                f"{where}: marker {name!r} in frame {frame}, sigma {sigma:g} px",
                [frame, name, sigma],
                f"frames 0 to {views - 1}, each marker once in each, "
                f"sigma above 0 to {MAX_SIGMA_PX:g}",
            )
        if any(abs(v) > MAX_PLACE_PX for v in (x, y)):
            message = f"{where}: pixel ({x:g}, {y:g})"
            raise TwinError.instead(message, [x, y], f"up to {MAX_PLACE_PX:g}")
        seen[frame, name] = x, y, sigma
    labels = {name for _, name in seen}
    names = tuple(sorted(labels, key=lambda n: (not n.isdecimal(), n.zfill(9))))
    tracks = np.full((views, len(names), 2), np.nan)
    sigmas = np.full(tracks.shape[:2], ASSUMED_SIGMA_PX)
    for (frame, name), (x, y, sigma) in seen.items():
        tracks[frame, names.index(name)] = x, y
        sigmas[frame, names.index(name)] = sigma
    return Markers(names, tracks, sigmas)


def seen_alone(data: Images, markers: Markers) -> tuple[list[Images], Markers]:
    """Select the frames in which at least one marker was marked.

    Returns:
        The data set of these frames, in a list of one, and their markers.

    Raises:
        TwinError: no marker was marked.
    """
    some = np.flatnonzero(markers.seen.any(axis=1))
    if not len(some):
        raise TwinError(
            "no marker is marked in any frame: there is nothing to calibrate from"
        )
    return [data[some]], replace(
        markers, tracks=markers.tracks[some], sigma=markers.sigma[some]
    )


def spots_of(markers: Markers, shape: tuple[int, int]) -> tuple[list[FrameSpots], Index]:
    """Convert markers to spots of each frame, all complete and of equal contrast.

    Radii are NaN.

    `markers`: k markers in n frames; `shape`: (rows, cols).
    Returns the frames' spots, and (n, k) the number of each marker's spot, -1 where unseen.
    """
    seen = markers.seen
    looks = []
    index = np.full(seen.shape, -1, dtype=np.int64)
    for i, row in enumerate(seen):
        k = int(row.sum())
        index[i, row] = np.arange(k)
        spots = markers.tracks[i, row], markers.sigma[i, row], np.nan, shape
        looks.append(FrameSpots(Detections.of_points(*spots), FrameState.USABLE))
    return looks, index


def calibrate_known(
    data: ImageSet, markers: Markers, phantom: Phantom, request: CalibrationRequest
) -> Calibration:
    """Calibrate from the marked beads of a phantom; marker "3" is its bead 3, counted
    from 0.

    Args:
        data: the scan.
        markers: pixels of the beads.
        phantom: whose beads are marked.
        request: the parameters to estimate.

    Raises:
        TwinError: a marker is no bead of the phantom, or two name the same one ("3" and
            "03").
    """
    beads = len(phantom.beads)
    odd = [n for n in markers.names if not n.isdecimal() or int(n) >= beads]
    numbers = [int(n) for n in markers.names if n not in odd]
    odd += [n for n in markers.names if n not in odd and numbers.count(int(n)) > 1]
    if odd:
        raise TwinError.instead(
            f"marker {odd[0]!r} is no bead of {phantom.name!r}",
            odd[0],
            f"0 to {beads - 1}, each once, or phantom unknown",
        )
    looks, index = spots_of(markers, data.shape)
    every = np.full((len(data), beads), -1, dtype=np.int64)
    every[:, numbers] = index
    return _calibrated(data, looks, every, phantom, request)


@dataclass(frozen=True, eq=False)
class _Located:
    """k markers of unknown positions, located by their spots in n frames.

    Attributes:
        names: of the markers.
        looks: spots of each frame.
        index: (n, k) spot of each marker in each frame, -1 where unseen.
        at: offsets with which they were located.
        model: their positions and radii in the object's frame.
    """

    names: tuple[str, ...]
    looks: Sequence[FrameSpots]
    index: Index
    at: Offsets
    model: BeadModel


def calibrate_unknown(
    data: ImageSet,
    images: Frames | None,
    markers: Markers | None,
    request: CalibrationRequest,
    scale: Scale | None = None,
    detector: SpotFinder | None = None,
) -> tuple[Calibration, dict[str, object]]:
    """Calibrate from three or more markers of unknown positions.

    The markers define the object's frame: its height, turn and place on the axis (dO_y,
    alpha, tau_x, tau_z) are the start's. Images determine only the ratio of their scale
    and the axis' distance: `scale` states it, a prior on dO_z, or a free dO_z; else dO_z
    has a wide prior, `FREE_SCALE` times the SOD.

    Args:
        images: frames, None for markers without images.
        markers: None: detected in the images.
        scale: a known distance of two of them.

    Returns the calibration, and the document: markers, and scale as a text.
    Raises TwinError: fewer than three markers, one seen from too few directions, neither
    images nor markers, or a scale with dO_z free or markers that are not there.
    """
    sod = float(np.median(data.poses.sod))
    if markers is not None:
        images = None
        found = _locate_marked(data, markers, request.start)
    elif images is not None:
        found = _locate_detected(data, images, detector or SpotFinder(), request.start)
    else:
        raise TwinError("neither images nor markers: there is nothing to calibrate from")
    want = _free_of_frame(request, found.at, sod)
    if scale is None:
        stated = _scale_origin(request)
        calibration = _calibrated(
            data, found.looks, found.index, found.model, want, images
        )
    else:
        stated = f"{scale.a}-{scale.b} = {scale.mm:g} +- {scale.sigma_mm:g} mm"
        calibration = _calibrate_scaled(data, images, found, want, scale)
    calibration = _turning_back(calibration, data, markers)
    return calibration, {
        "markers": _described(calibration, found.names, found.index),
        "scale": stated,
    }


def _locate_detected(
    data: ImageSet, images: Frames, detector: SpotFinder, start: Offsets
) -> _Located:
    """Detect markers in the images, and link their spots by the geometry; they are named 0, 1,
    ...

    `data`: geometry; `images`: its frames; `detector`: finds spots; `start`: offsets to begin
    with.
    Raises TwinError: as `link`."""
    looks = images.look(detector)
    spots = [look.detections for look in looks]
    index, places, at = link(spots, data.poses, start)
    names = tuple(str(k) for k in range(len(places)))
    model = BeadModel(places, _radii(looks, index, data.poses), 0.0, "unknown")
    return _Located(names, looks, index, at, model)


def _locate_marked(data: ImageSet, markers: Markers, start: Offsets) -> _Located:
    """Triangulate markers from their pixels; their radii, which nobody states, are 1 um.

    `data`: geometry; `markers`: their pixels; `start`: offsets to begin with.
    Raises TwinError: fewer than three markers, or as `triangulate`.
    """
    looks, index = spots_of(markers, data.shape)
    names = markers.names
    if len(names) < 3:
        raise TwinError.instead(f"{len(names)} markers", len(names), "three or more")
    at = centred(markers.tracks, data.poses, data.shape, start)
    places = triangulate(markers.tracks, data.poses.cone_vec(at), data.shape)
    model = BeadModel(places, np.full(len(names), 1e-3), 0.0, "unknown")
    return _Located(names, looks, index, at, model)


def _free_of_frame(
    request: CalibrationRequest, at: Offsets, sod: float
) -> CalibrationRequest:
    """Complete a request for markers, which define the object's frame: the parameters
    that the frame takes up are exact, dO_z has a wide prior unless it is free or has one,
    and beads may be anywhere.

    Args:
        request: of the user.
        at: offsets with which the markers were located; a free dO_x without a prior
            begins there.
        sod: source to axis [mm].
    """
    known = {n: 0.0 for n in SIX if n not in ("dO_x", "dO_z") and n not in request.free}
    if "dO_z" not in request.free:
        known["dO_z"] = FREE_SCALE * sod
    start = request.start
    if "dO_x" in request.free and "dO_x" not in request.priors:
        start = replace(start, dO_x=at.dO_x)
    return replace(
        request,
        start=start,
        priors=known | dict(request.priors),
        bead_tolerance_mm=ANYWHERE_MM,
        known_sizes=False,
    )


def _scale_origin(request: CalibrationRequest) -> str:
    """Return where the scale comes from without a known distance."""
    if "dO_z" in request.priors:
        return "from the prior on dO_z"
    return "estimated" if "dO_z" in request.free else "free"


def _calibrate_scaled(
    data: ImageSet,
    images: Frames | None,
    found: _Located,
    request: CalibrationRequest,
    scale: Scale,
) -> Calibration:
    """Calibrate with a known distance of two markers: markers and axis are scaled and
    fitted until the distance holds to a tenth of its sigma, up to four times.

    Args:
        data: geometry, and names.
        images: its frames; None for markers without images.
        found: the markers.
        request: the parameters to estimate.
        scale: the known distance.

    Raises:
        TwinError: dO_z is free, or the distance is of one marker or one that is not
            there.
    """
    pair = [_numbered(found.names, n) for n in (scale.a, scale.b)]
    if pair[0] == pair[1] or "dO_z" in request.free:
        raise TwinError.instead(
            f"scale {scale.a}-{scale.b} with {', '.join(request.free)} free",
            [scale.a, scale.b, *request.free],
            "two markers, and dO_z not free (the scale says where the axis is)",
        )
    poses = data.poses
    width = float(np.median(poses.sod)) * scale.sigma_mm / scale.mm
    start = request.start
    model = found.model
    ratio = scale.mm / _distance(model.beads, pair)
    for _ in range(4):
        # Everything smaller by a factor and nearer by it gives the same images.
        away = (poses.axis - poses.source)[0] + [start.dO_x, start.dO_z, start.dO_y]
        dx, dz, dy = ((ratio - 1.0) * away).tolist()
        start = replace(
            start, dO_x=start.dO_x + dx, dO_y=start.dO_y + dy, dO_z=start.dO_z + dz
        )
        model = replace(
            model, beads=model.beads * ratio, bead_radius_mm=model.bead_radius_mm * ratio
        )
        scaled = replace(request, start=start, priors={**request.priors, "dO_z": width})
        calibration = _calibrated(data, found.looks, found.index, model, scaled, images)
        if calibration.fit is None:
            break
        model = replace(model, beads=calibration.fit.beads)
        ratio = scale.mm / _distance(model.beads, pair)
        if abs(ratio - 1.0) < 0.1 * scale.sigma_mm / scale.mm:
            break
    return calibration


def _distance(places: FloatArray, pair: Sequence[int]) -> float:
    """Return the distance of two of the places (k, 3) [mm]."""
    return float(np.linalg.norm(places[pair[0]] - places[pair[1]]))


def _turning_back(
    calibration: Calibration, data: ImageSet, markers: Markers | None
) -> Calibration:
    """Add an error if markers do not move, or fit twice as well with the stage reversed.

    "not_turning": the largest move is below 6 median sigmas. "angle_reversed": the rms of
    the reversed fit is below half of the calibration's. Unchanged also without a fit.

    Without perspective both directions would fit, with each marker as far behind the axis
    as before.

    Args:
        calibration: with its fit.
        data: the scan.
        markers: their pixels; None checks nothing.

    Returns:
        The calibration, with the error as its first finding if there is one.
    """
    if markers is None or calibration.fit is None:
        return calibration
    moved = float(
        np.nanmax(np.nanmax(markers.tracks, axis=0) - np.nanmin(markers.tracks, axis=0))
    )
    if moved < 6.0 * float(np.median(markers.sigma)):
        off = error(
            CalibrationCode.NOT_TURNING,
            f"the markers move by {moved:.2g} px at most in all frames: the "
            "object does not turn although the angles say so",
        )
        return replace(calibration, findings=Findings((off, *calibration.findings)))
    stated_px, reversed_px = (
        _alone_px(data, markers, replace(data.poses, angle=sign * data.poses.angle))
        for sign in (1.0, -1.0)
    )
    if not reversed_px < 0.5 * stated_px:
        return calibration
    off = error(
        CalibrationCode.ANGLE_REVERSED,
        f"the markers fit to {reversed_px:.2g} px instead "
        f"of {stated_px:.2g} if the stage turns the other way "
        "than the angles say, or if the images are mirrored",
    )
    return replace(calibration, findings=Findings((off, *calibration.findings)))


def _alone_px(data: ImageSet, markers: Markers, poses: Poses) -> float:
    """Compute the misfit of markers anywhere to poses, with nothing else that could explain
    it, root mean square [px]."""
    at = centred(markers.tracks, poses, data.shape, NOMINAL)
    places = triangulate(markers.tracks, poses.cone_vec(at), data.shape)
    fit = estimate_geometry(
        markers.tracks,
        places,
        poses,
        ("dO_x", "det_roll"),
        shape=data.shape,
        start=at,
        free_beads=True,
        bead_tolerance_mm=ANYWHERE_MM,
        priors={"det_roll": 1.0},
        bound=math.inf,
    )
    return fit.certificate.rms_px


def _calibrated(
    data: ImageSet,
    looks: Sequence[FrameSpots],
    index: Index,
    model: BeadModel | Phantom,
    request: CalibrationRequest,
    images: Frames | None = None,
) -> Calibration:
    """Calibrate from spots whose beads are known.

    Without images there is no second detection, bead sizes are not known, and the
    misfit's limit is at least 3 median sigmas of the spots.

    Args:
        data: the scan.
        looks: spots of each frame.
        index: (frames, beads) spot of each bead, -1 where unseen.
        model: positions of the beads.
        request: the parameters to estimate.
        images: for a second detection; None: widths come from the markers' sigmas.
    """
    priors = prior_widths(data.machine, data.profile)
    scan = Scan(
        SpotFrames(looks, images),
        data.poses,
        data.name,
        priors,
        index,
        exposure_share(data),
    )
    if images is None:
        sigma = (
            np.concatenate([look.detections.covariances[:, 0, 0] for look in looks])
            ** 0.5
        )
        most = max(request.misfit_px, 3.0 * float(np.median(sigma)))
        request = replace(request, second_look=False, known_sizes=False, misfit_px=most)
    return calibrate([scan], model, request, scene=Scene(()))


def _numbered(names: Sequence[str], name: str) -> int:
    if name not in names:
        raise TwinError.instead(f"scale: no marker {name!r}", name, [*names])
    return names.index(name)


def _radii(looks: Sequence[FrameSpots], index: Index, poses: Poses) -> FloatArray:
    """Compute the radii (k,) [mm] of balls whose spots have the observed sizes.

    `index`: (n, k) spot of each marker, -1 without. Medians; NaN if no frame shows one.
    """
    scale = np.linalg.norm(poses.u, axis=1) * poses.sod / poses.sdd
    return np.array(
        [
            np.median(
                [
                    scale[i] * looks[i].detections.radii_px[j]
                    for i, j in enumerate(column)
                    if j >= 0
                ]
            )
            for column in index.T.tolist()
        ]
    )


def _described(
    calibration: Calibration, names: Sequence[str], index: Index
) -> list[dict[str, object]]:
    """List the markers of a calibration.

    Args:
        calibration: with its fit.
        names: of the k markers.
        index: (n, k) spot of each marker in each frame, -1 without.

    Returns:
        name, position_mm (in the object's frame), frames and rms_px (None if unknown) of
        each; empty without a fit.
    """
    if calibration.fit is None:
        return []
    rms = calibration.fit.certificate.rms_per_bead
    return [
        {
            "name": name,
            "position_mm": [round(v, 5) for v in place],
            "frames": int((index[:, k] >= 0).sum()),
            "rms_px": round(float(rms[k]), 4) if math.isfinite(rms[k]) else None,
        }
        for k, (name, place) in enumerate(
            zip(names, calibration.fit.beads.tolist(), strict=True)
        )
    ]
