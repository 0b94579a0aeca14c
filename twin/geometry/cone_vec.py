"""The cone-beam geometry as a value: n rows of twelve numbers, exactly ASTRA's `cone_vec`.

A row is source, detector center, u (step to the next column), v (step to the next row),
in mm and in the object's frame (see `conventions`). A geometry may carry the number of
its detector's pixels; methods that need it take it as an argument otherwise, and an
argument that contradicts it is an error. Files, other programs' objects and figures are
the library's (`flexdt.twin.backends`).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.backends import backend
from flexdt.twin.errors import GeometryError, shape_words
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    ROW_DIRECTION,
    UP,
    FloatArray,
    as_numbers,
    cross,
    rotation_z,
    turn_detector,
)
from flexdt.twin.signatures import File, public

ROW_LENGTH = 12
MIN_SINE = 1e-12
"""Sine of an angle below which two directions count as one."""
FULL_TURN_DEG = 360.0
MAX_COUNTED_VIEWS = 1_000_000
"""Largest number of views that is made of a number alone."""
MAX_PRINTED_VIEWS = 2
"""Largest number of views of a geometry that is printed with every number."""
Shape2 = tuple[int, int]
PITCH_TOLERANCE = 1e-6
"""Largest deviation of |u| and |v| (relative) and of the right angle in `check_cone_vec`."""


@public
@dataclass(frozen=True, eq=False)
class ConeVec:
    """A frozen stack of cone_vec rows, and the shape of the detector if it is known.

    Attributes:
        rows: float64 (n, 12) [mm], read-only: source, detector center, u, v of each view.
        detector_shape: (rows, cols) of the detector, or None.

    Raises:
        GeometryError: the rows do not have twelve finite numbers each, or the detector
            has no pixels.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(760, 956), pixel=0.1496)
        >>> print(repr(scan)[:51])
        <ConeVec: 4 views, 760 x 956 pixels (rows x columns
        >>> scan.shape, scan[::2].shape
        ((4, 760, 956), (2, 760, 956))
        >>> scan == ConeVec(scan.rows, (760, 956)) == ConeVec.from_dict(scan.to_dict())
        True
    """

    rows: FloatArray
    detector_shape: Shape2 | None = None

    def __post_init__(self) -> None:
        """Copy the rows as read-only float64, (n, 12); one row (12,) becomes (1, 12).

        Raises:
            GeometryError: another shape, a row that is not finite (the first is named),
                or a detector shape that is not positive.
        """
        rows = np.array(as_numbers("cone_vec", self.rows), ndmin=2)
        if rows.ndim != 2 or rows.shape[1] != ROW_LENGTH:
            raise GeometryError.of_shape(
                "cone_vec", np.shape(self.rows), ("n", ROW_LENGTH)
            )
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            index = int(np.flatnonzero(~finite)[0])
            raise GeometryError(f"cone_vec row {index} is not finite", {"row": index})
        rows.setflags(write=False)
        object.__setattr__(self, "rows", rows)
        if self.detector_shape is not None:
            object.__setattr__(self, "detector_shape", check_shape(self.detector_shape))

    @classmethod
    def from_vectors(
        cls,
        source: npt.ArrayLike,
        detector: npt.ArrayLike,
        u: npt.ArrayLike,
        v: npt.ArrayLike,
        shape: Shape2 | None = None,
    ) -> ConeVec:
        """Build from four vectors, each (3,) or (n, 3) [mm], broadcast against each
        other.

        Args:
            source, detector, u, v: focal spot, detector center, steps to the next column
                and row.
            shape: detector (rows, cols), or None.

        Returns:
            n views.

        Raises:
            GeometryError: a row that is not finite or not of twelve numbers; vectors that
                do not broadcast raise numpy's ValueError.

        Example:
            >>> c = ConeVec.from_vectors([[0, -9, 0], [9, 0, 0]], [0, 0, 0], [1, 0, 0], [0, 0, -1])
            >>> len(c), c.detector.tolist()
            (2, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        """
        parts: Sequence[npt.NDArray[Any]] = [
            np.atleast_2d(np.asarray(p, dtype=np.float64))
            for p in (source, detector, u, v)
        ]
        if len({part.shape for part in parts}) > 1:
            parts = np.broadcast_arrays(*parts)
        return cls(np.concatenate(parts, axis=1), shape)

    @classmethod
    def circular(
        cls,
        *,
        sod: float,
        sdd: float,
        angles: int | npt.ArrayLike,
        shape: Shape2 | None = None,
        pixel: float | Sequence[float],
        offset: Sequence[float] = (0.0, 0.0),
        tilts: Sequence[float] = (0.0, 0.0, 0.0),
        height: float = 0.0,
    ) -> ConeVec:
        """Make a circular scan about the object frame's z axis from its distances.

        Args:
            sod: focal spot to rotation axis [mm].
            sdd: focal spot to detector [mm].
            angles: a number of views, spread over a full turn from 0 on, or stage angles
                (n,) [deg]. Growing angles turn the object clockwise seen from above, as
                ASTRA's do.
            shape: detector (rows, cols).
            pixel: pitch of the pixels [mm], or (along columns, along rows).
            offset: of the detector's center towards growing columns (right, seen from the
                source) and growing rows (down) [mm].
            tilts: roll, pitch and yaw of the detector [deg], right-handed: yaw about v,
                then pitch about the turned u, then roll about the turned normal u x v.
            height: of focal spot and detector above the object frame's origin [mm].

        Returns:
            A view for each angle.

        Raises:
            GeometryError: names the number that no scanner has.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=[0], pixel=0.15, offset=(2, 1))
            >>> scan.detector.tolist()
            [[2.0, 459.0, -1.0]]
        """
        return cls.helical(
            sod=sod,
            sdd=sdd,
            angles=angles,
            rise=0.0,
            shape=shape,
            pixel=pixel,
            offset=offset,
            tilts=tilts,
            height=height,
        )

    @classmethod
    def helical(
        cls,
        *,
        sod: float,
        sdd: float,
        angles: int | npt.ArrayLike,
        rise: float,
        turns: float = 1.0,
        shape: Shape2 | None = None,
        pixel: float | Sequence[float],
        offset: Sequence[float] = (0.0, 0.0),
        tilts: Sequence[float] = (0.0, 0.0, 0.0),
        height: float = 0.0,
    ) -> ConeVec:
        """Make a helical scan about the object frame's z axis: a circular one that rises.

        Source and detector rise linearly with the accumulated angle, about `height`.

        Args:
            sod, sdd, shape, pixel, offset, tilts: as for `circular`.
            angles: a number of views, spread over `turns` from 0 on, or accumulated stage
                angles (n,) [deg].
            rise: of focal spot and detector, relative to the object, in a full turn [mm];
                negative for a scan that goes down.
            turns: of the stage, where `angles` is a number.
            height: of focal spot and detector half-way between the first and the last
                view [mm].

        Returns:
            A view for each angle.

        Raises:
            GeometryError: names the number that no scanner has: 0 < sod <= sdd, pixels
                and turns above 0, all finite, at least one angle.

        Example:
            >>> scan = ConeVec.helical(sod=600, sdd=1059, angles=[0, 360], rise=8, pixel=0.15)
            >>> scan.source[:, 2].tolist()
            [-4.0, 4.0]
        """
        if not np.isfinite(rise) or not (np.isfinite(turns) and turns > 0):
            request = f"rise {rise:g} mm a turn, {turns:g} turns"
            allowed = "finite, more than 0 turns"
            raise GeometryError.instead(request, [rise, turns], allowed)
        degrees = _stage_angles(angles, turns)
        rises = rise * (degrees - (degrees[0] + degrees[-1]) / 2) / FULL_TURN_DEG
        pitch = _numbers("pixel", pixel, 2, "mm", repeated=True)
        columns, down = _numbers("offset", offset, 2, "mm")
        roll, tilt, yaw = (math.radians(a) for a in _numbers("tilts", tilts, 3, "deg"))
        places = {"sod": sod, "sdd": sdd, "height": height}
        sod, sdd, height = (
            _numbers(name, value, 1, "mm")[0] for name, value in places.items()
        )
        if not 0.0 < sod <= sdd:
            request = f"sod {sod:g} mm and sdd {sdd:g} mm"
            raise GeometryError.instead(request, [sod, sdd], "0 < sod <= sdd")
        if min(pitch) <= 0.0:
            request = f"pixel {pitch[0]:g} x {pitch[1]:g} mm"
            raise GeometryError.instead(request, list(pitch), "more than 0")
        right = np.array(COLUMN_DIRECTION)
        below = np.array(ROW_DIRECTION)
        # At stage angle 0; the object turns clockwise, so these turn the other way in its
        # frame.
        source = np.array([0.0, -sod, height])
        centre = np.array([0.0, sdd - sod, height]) + columns * right + down * below
        u, v = turn_detector(right * pitch[0], below * pitch[1], yaw, tilt, roll)
        turn = rotation_z(np.radians(degrees))
        up = np.multiply.outer(rises, np.array(UP))
        parts = turn @ source + up, turn @ centre + up, turn @ u, turn @ v
        return cls(np.concatenate(parts, axis=1), shape)

    @classmethod
    def from_astra(cls, geometry: Any, shape: Shape2 | None = None) -> ConeVec:
        """Convert ASTRA's geometry: `cone_vec` vectors (n, 12), or a projection geometry.

        Rows are taken as they are. In ASTRA's own `cone` geometry, and in its
        `geom_2vec`, v points upwards, so that row 0 is the lowest.

        Args:
            geometry: vectors (n, 12) [mm], or a dictionary of type `cone` or `cone_vec`.
            shape: detector (rows, cols), for vectors, which do not contain it.

        Raises:
            GeometryError: another type or form.

        Example:
            >>> astra = {"type": "cone_vec", "DetectorRowCount": 76, "DetectorColCount": 96,
            ...          "Vectors": [[0, -600, 0, 0, 459, 0, 0.15, 0, 0, 0, 0, -0.15]]}
            >>> ConeVec.from_astra(astra).shape
            (1, 76, 96)
        """
        converted: ConeVec = _formats().from_astra(geometry, shape)
        return converted

    def to_astra(self) -> dict[str, Any]:
        """Convert to ASTRA's projection geometry of type `cone_vec`; needs
        the detector's shape.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=9, shape=(76, 96), pixel=0.15)
            >>> ConeVec.from_astra(scan.to_astra()) == scan
            True"""
        geometry: dict[str, Any] = _formats().to_astra(self)
        return geometry

    @classmethod
    def from_tomosipo(cls, geometry: Any) -> ConeVec:
        """Convert tomosipo's cone geometry (`ts.cone`, `ts.cone_vec`), or the arguments
        of `ts.cone_vec` by name; its vectors are (z, y, x).

        Args:
            geometry: tomosipo's object, or a mapping with shape, src_pos, det_pos, det_v,
                det_u.

        Raises:
            GeometryError: another geometry.

        Example:
            >>> zyx = {"shape": (76, 96), "src_pos": [[0, -600, 0]], "det_pos": [[0, 459, 0]],
            ...        "det_v": [[-0.15, 0, 0]], "det_u": [[0, 0, 0.15]]}
            >>> ConeVec.from_tomosipo(zyx).shape
            (1, 76, 96)
        """
        converted: ConeVec = _formats().from_tomosipo(geometry)
        return converted

    def to_tomosipo(self) -> Any:
        """Convert to tomosipo's `ts.cone_vec`; needs tomosipo and the detector's shape."""
        return _formats().to_tomosipo(self)

    def to_cil(self) -> Any:
        """Convert to CIL's `AcquisitionGeometry` with a pose a view
        (`create_Cone3D_Flex`), for images as they are, (views, rows, columns); needs CIL
        25 or newer and the detector's shape.

        Raises:
            TwinError: skew pixels, several pixel sizes, no shape; CIL is not installed.
        """
        return _formats().to_cil(self)

    def to_tigre(self, like: Any = None) -> tuple[Any, FloatArray]:
        """Convert to TIGRE's geometry and its angles [rad], for images as they are,
        (views, rows, columns); needs TIGRE and the detector's shape.

        Args:
            like: a `Grid` or `Volume` whose voxels TIGRE takes; None leaves nVoxel,
                dVoxel and sVoxel to you.

        Raises:
            TwinError: skew pixels, several pixel sizes, no shape, a horizontal panel, an
                object that is not between source and panel; TIGRE is not installed.
        """
        converted: tuple[Any, FloatArray] = _formats().to_tigre(self, like)
        return converted

    def to_leap(self, like: Any = None, *, rows_up: bool = False) -> Any:
        """Make LEAP's model with this scan as its modular beam; needs LEAP and
        the detector's shape.

        Args:
            like: a `Grid` or `Volume` whose voxels LEAP takes; None is LEAP's own choice.
            rows_up: for images turned upside down, `images[:, ::-1]`, which LEAP's
                filtered backprojection needs; its iterative methods take images as they
                are.

        Raises:
            TwinError: skew pixels, several pixel sizes, no shape, voxels that are no
                cubes; LEAP is not installed, or refuses the geometry.
        """
        return _formats().to_leap(self, like, rows_up)

    @classmethod
    def from_rtk(
        cls, file: File, *, pixel: float | Sequence[float], shape: Shape2 | None = None
    ) -> ConeVec:
        """Read RTK's circular geometry from its XML file, which contains neither pixel
        size nor shape.

        Args:
            file: the path.
            pixel: pitch of the pixels [mm], or (along columns, along rows).
            shape: detector (rows, cols); None: unknown.

        Raises:
            TwinError: the file is invalid.
            OSError: it cannot be read.

        Example:
            >>> import tempfile
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     scan.to_rtk(f"{folder}/scan.xml")
            ...     back = ConeVec.from_rtk(f"{folder}/scan.xml", pixel=0.15, shape=(76, 96))
            >>> np.allclose(back, scan)
            True
        """
        return cls.load(file, format="rtk", shape=shape, pixel=pixel)

    def to_rtk(self, file: File) -> None:
        """Write RTK's XML file.

        Raises:
            TwinError: nine numbers a view cannot hold this geometry.

        Example:
            >>> import tempfile
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     scan.to_rtk(f"{folder}/scan.xml")
            ...     ConeVec.load(f"{folder}/scan.xml", pixel=0.15).rows.shape
            (4, 12)
        """
        self.save(file, format="rtk")

    @classmethod
    def load(
        cls,
        file: File,
        *,
        format: str | None = None,
        shape: Shape2 | None = None,
        pixel: float | Sequence[float] | None = None,
    ) -> ConeVec:
        """Load a geometry from a file.

        Args:
            file: the path; its ending determines the format unless `format` does: .json
                (flexdt or CTSimU), .npy, .txt (ASTRA's vectors), .npz (tomosipo), .cil,
                .tigre, .leap, .csv, .xml (RTK), .toml (flexDATA).
            format: ctsimu, rtk, astra, tomosipo, cil, tigre, leap, flexdata or csv; None:
                by the file's ending.
            shape: detector (rows, cols), if the file does not contain it.
            pixel: pitch of the pixels [mm], if the file does not contain it.

        Raises:
            TwinError: the file is invalid, or contradicts the arguments.
            OSError: it cannot be read.

        Example:
            >>> import tempfile
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     scan.save(f"{folder}/scan.npy")
            ...     ConeVec.load(f"{folder}/scan.npy", shape=(76, 96)) == scan
            True
        """
        loaded: ConeVec = _formats().load(file, format, shape, pixel)
        return loaded

    def save(self, file: File, *, format: str | None = None) -> None:
        """Write a file that `load` reads; its ending determines the format unless
        `format` does.

        Args:
            file: the path.
            format: as for `load`; None: by the file's ending.

        Raises:
            TwinError: the format cannot carry this geometry, or the ending is not known.

        Example:
            >>> import tempfile
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     scan.save(f"{folder}/scan.json")
            ...     ConeVec.load(f"{folder}/scan.json").shape
            (4, 76, 96)
        """
        _formats().save(self, file, format)

    @classmethod
    def concatenate(cls, parts: Sequence[ConeVec]) -> ConeVec:
        """Stack several geometries, in order; the detector's shape is kept if all share
        it, else unknown (None).

        Raises:
            GeometryError: `parts` is empty.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> ConeVec.concatenate([scan[:1], scan[2:]]).shape
            (3, 76, 96)
        """
        if not parts:
            raise GeometryError(
                "no geometries to stack; allowed: at least one", {"asked": 0}
            )
        shapes = {p.detector_shape for p in parts}
        rows = np.concatenate([p.rows for p in parts], axis=0)
        return cls(rows, shapes.pop() if len(shapes) == 1 else None)

    def __len__(self) -> int:
        """Return the number of views."""
        return int(self.rows.shape[0])

    def __getitem__(self, index: int | slice | npt.NDArray[np.intp]) -> ConeVec:
        """Select views by index, slice or array of indices; one index gives a geometry of
        one view.

        The detector's shape is kept."""
        return ConeVec(self.rows[index], self.detector_shape)

    def __iter__(self) -> Iterator[ConeVec]:
        """Yield each view as a geometry of one view, with the detector's shape."""
        for row in self.rows:
            yield ConeVec(row, self.detector_shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return the rows, (n, 12)."""
        if copy:
            return np.array(self.rows, dtype=dtype)
        return np.asarray(self.rows, dtype=dtype)

    def __eq__(self, other: object) -> bool:
        """Compare type, detector shape and rows, exactly (no tolerance)."""
        return (
            isinstance(other, ConeVec)
            and self.detector_shape == other.detector_shape
            and np.array_equal(self.rows, other.rows)
        )

    def __hash__(self) -> int:
        """Hash detector shape and rows; equal geometries (but for -0 and 0) have equal hashes."""
        return hash((self.detector_shape, self.rows.shape, self.rows.tobytes()))

    def __repr__(self) -> str:
        """Format as one line; up to `MAX_PRINTED_VIEWS` views it evaluates to an equal value.

        Above that it has number of views, detector, and distance of source and detector.
        """
        if len(self) <= MAX_PRINTED_VIEWS:
            shape = ""
            if self.detector_shape is not None:
                shape = f", {self.detector_shape}"
            return f"ConeVec({self.rows.tolist()!r}{shape})"
        facts = self._facts()
        return (
            f"<ConeVec: {facts['views']}, {facts['detector']}, source to detector "
            f"{facts['source to detector']}>"
        )

    def _repr_html_(self) -> str:
        """Format the facts (views, detector, distances) as an HTML table, for notebooks."""
        cells = "".join(
            f"<tr><th>{k}</th><td>{v}</td></tr>" for k, v in self._facts().items()
        )
        return f"<table><caption>ConeVec</caption>{cells}</table>"

    def _facts(self) -> dict[str, str]:
        """Format numbers of views, size and pitch of the detector, and distances for
        printing, under the keys views, detector, source to detector, source to origin.

        Distances are positive, in mm. Values that differ between views are ranges; the
        pitch is columns x rows if those differ. Without a shape the detector has its
        pitch only.
        """
        steps = [_span(np.linalg.norm(step, axis=1)) for step in (self.u, self.v)]
        if steps[0] == steps[1]:
            pitch = steps[0]
        else:
            pitch = " x ".join(steps)
        shape = self.detector_shape
        pixels = "pixels"
        if shape is not None:
            pixels = f"{shape[0]} x {shape[1]} pixels (rows x columns)"
        return {
            "views": f"{len(self)} view{'' if len(self) == 1 else 's'}",
            "detector": f"{pixels} of {pitch} mm",
            "source to detector": f"{_span(np.abs(self.source_detector_distance))} mm",
            "source to origin": f"{_span(np.linalg.norm(self.source, axis=1))} mm",
        }

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON types, `{"rows": [[12 numbers], ...]}` [mm], and
        `detector_shape` where it is known.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> sorted(scan.to_dict()), scan.to_dict()["detector_shape"]
            (['detector_shape', 'rows'], [76, 96])"""
        if self.detector_shape is not None:
            known = {"detector_shape": list(self.detector_shape)}
        else:
            known = {}
        return {"rows": self.rows.tolist(), **known}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> ConeVec:
        """Make a geometry from the document of `to_dict`.

        A document without `detector_shape` gives None. Other keys are ignored.

        Raises:
            GeometryError: the rows do not have twelve finite numbers each, or the shape
                is none.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> ConeVec.from_dict(scan.to_dict()) == scan
            True
        """
        try:
            rows = np.asarray(document["rows"], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            message = f"a geometry's document has rows of twelve numbers: {error!r}"
            raise GeometryError(
                message, {"asked": repr(document)[:100], "allowed": "rows"}
            ) from None
        return cls(rows, document.get("detector_shape"))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n, rows, cols): the shape of the projections.

        Raises:
            GeometryError: the geometry carries no detector shape.
        """
        return len(self), *self.of_shape()

    def of_shape(self, shape: Shape2 | None = None) -> Shape2:
        """Return the detector's (rows, cols): those given, or else the geometry's own.

        A given shape must be positive, and equal the geometry's own if that is known.

        Args:
            shape: (rows, cols); None: those of the geometry.

        Raises:
            GeometryError: neither is known, or they contradict each other.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.of_shape(), ConeVec(scan.rows).of_shape((10, 20))
            ((76, 96), (10, 20))
        """
        own = self.detector_shape
        given = None
        if shape is not None:
            given = check_shape(shape)
        if given is not None and own is not None and given != own:
            raise GeometryError(
                f"detector shape {given}; this geometry is of a detector of "
                f"{own} (rows, columns)",
                {"asked": list(given), "allowed": list(own)},
            )
        known = own if given is None else given
        if known is None:
            raise GeometryError(
                "the detector's shape is not known; give shape=(rows, columns), or a geometry "
                "that carries it: geometry.with_shape((rows, columns))",
                {"asked": None, "allowed": ["rows", "cols"]},
            )
        return known

    def with_shape(self, shape: Shape2 | None) -> ConeVec:
        """Replace the detector's (rows, cols) about the same center, or remove it.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.with_shape(None).detector_shape is None
            True"""
        return replace(self, detector_shape=shape)

    def show(self) -> Any:
        """Show source, panel and sample of each view in a notebook, with a slider for the view.

        All axes have one scale. The page needs no package; `.save("geometry.html")` writes it.

        Returns:
            What a notebook shows.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> "view 3 of 4" in scan.show().html
            True
        """
        return backend("notebook").show_geometry(self)

    def plot(self, axes: Any = None) -> Any:
        """Plot source, detector and rays in three dimensions; needs matplotlib.

        Args:
            axes: matplotlib's 3D axes to draw into; None makes a figure.

        Returns:
            The axes.

        Raises:
            TwinError: matplotlib is not installed.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> type(scan.plot()).__name__
            'Axes3D'
        """
        return backend("plots").plot_geometry(self, axes)

    @property
    def source(self) -> FloatArray:
        """Focal spot of each view, (n, 3) [mm]."""
        return self.rows[:, 0:3]

    @property
    def detector(self) -> FloatArray:
        """Detector center of each view, (n, 3) [mm]."""
        return self.rows[:, 3:6]

    @property
    def u(self) -> FloatArray:
        """Step to the next column of each view, (n, 3) [mm]."""
        return self.rows[:, 6:9]

    @property
    def v(self) -> FloatArray:
        """Step to the next row of each view, (n, 3) [mm]."""
        return self.rows[:, 9:12]

    @property
    def normal(self) -> FloatArray:
        """Unit normal u x v of each view, (n, 3): away from the source
        where v points downwards."""
        n = cross(self.u, self.v)
        return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True), dtype=np.float64)

    @property
    def source_detector_distance(self) -> FloatArray:
        """Distance of the focal spot from the detector plane along `normal`, (n,) [mm]:
        negative where v points upwards, as in ASTRA's `cone`."""
        return np.asarray(np.sum((self.detector - self.source) * self.normal, axis=1))

    def rays(self, shape: Shape2 | None = None) -> FloatArray:
        """Compute the rays of each view as a projector needs them: source, center of the
        first pixel minus source, u and v, (n, 12) [mm].

        The ray to pixel (row, column) is the second of these + column * u + row * v.

        Args:
            shape: detector (rows, cols), if the geometry has none; see `of_shape`.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.rays().shape, scan.rays()[0, 3:6].round(3).tolist()
            ((4, 12), [-7.125, 1059.0, 5.625])
        """
        rows, cols = self.of_shape(shape)
        first = (
            self.detector
            - (cols - 1) / 2 * self.u
            - (rows - 1) / 2 * self.v
            - self.source
        )
        return np.concatenate([self.source, first, self.u, self.v], axis=1)

    def project_points(
        self, points: npt.ArrayLike, shape: Shape2 | None = None
    ) -> FloatArray:
        """Project points through the focal spot onto the detector.

        Points behind the source are projected through it, too; pixels outside the
        detector are returned. Pixels may be skew.

        Args:
            points: (k, 3), or one (3,) [mm], object frame.
            shape: detector (rows, cols), if the geometry has none; see `of_shape`.

        Returns:
            (n, k, 2) pixel coordinates (column, row); pixel centers are integers. A point
            in the plane of the source parallel to the detector gives inf or nan: it has
            no projection.

        Raises:
            GeometryError: points of another shape, or the detector's shape is not known.

        Example:
            >>> cone = ConeVec.from_vectors([0, -500, 0], [0, 500, 0], [0.5, 0, 0], [0, 0, -0.5])
            >>> cone.project_points([[1.0, 0.0, 2.0]], (101, 201))[0, 0].tolist()
            [104.0, 42.0]
        """
        rows, cols = self.of_shape(shape)
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        if p.ndim != 2 or p.shape[1] != 3:
            raise GeometryError.of_shape("points", p.shape, ("k", 3), " [mm]")
        ray = p[None, :, :] - self.source[:, None, :]
        normal = cross(self.u, self.v)
        offset = self.source - self.detector
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = -np.einsum("ni,ni->n", offset, normal)[:, None] / np.einsum(
                "nki,ni->nk", ray, normal
            )
            hit = offset[:, None, :] + scale[:, :, None] * ray
        uu = np.einsum("ni,ni->n", self.u, self.u)
        vv = np.einsum("ni,ni->n", self.v, self.v)
        uv = np.einsum("ni,ni->n", self.u, self.v)
        hu = np.einsum("nki,ni->nk", hit, self.u)
        hv = np.einsum("nki,ni->nk", hit, self.v)
        det = (uu * vv - uv * uv)[:, None]
        column = (vv[:, None] * hu - uv[:, None] * hv) / det + (cols - 1) / 2
        row = (uu[:, None] * hv - uv[:, None] * hu) / det + (rows - 1) / 2
        return np.stack([column, row], axis=-1)

    def piercing_points(self, shape: Shape2 | None = None) -> FloatArray:
        """Compute the foot of the perpendicular from the focal spot on each detector
        plane, (n, 2) pixels (column, row).

        It may be outside the detector; pixel centers are whole numbers.

        Args:
            shape: detector (rows, cols), if the geometry has none; see `of_shape`.

        Raises:
            GeometryError: the detector's shape is not known.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.piercing_points()[0].round(6).tolist()
            [47.5, 37.5]
        """
        foot = self.source + self.normal * self.source_detector_distance[:, None]
        return np.stack(
            [
                one.project_points(point[None, :], shape)[0, 0]
                for one, point in zip(self, foot, strict=True)
            ]
        )

    def pixel_centers(self, shape: Shape2 | None = None) -> FloatArray:
        """Compute the positions of all pixel centers in the object frame, (n, rows, cols,
        3) [mm].

        Args:
            shape: detector (rows, cols), if the geometry has none; see `of_shape`.

        Raises:
            GeometryError: the detector's shape is not known.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.pixel_centers().shape, scan.pixel_centers()[0, 0, 0].round(3).tolist()
            ((4, 76, 96, 3), [-7.125, 459.0, 5.625])
        """
        rows, cols = self.of_shape(shape)
        c = np.arange(cols) - (cols - 1) / 2
        r = np.arange(rows) - (rows - 1) / 2
        return np.asarray(
            self.detector[:, None, None, :]
            + c[None, None, :, None] * self.u[:, None, None, :]
            + r[None, :, None, None] * self.v[:, None, None, :]
        )

    def moved(self, rotation: npt.ArrayLike, translation: npt.ArrayLike) -> ConeVec:
        """Transform to another frame: points p become R p + t, steps u, v become R u, R
        v.

        The detector's shape is kept. Whether R is a rotation is not checked.

        Args:
            rotation: R, (3, 3) or one a view (n, 3, 3).
            translation: t, (3,) or (n, 3) [mm].

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.moved(np.eye(3), [0, 0, 2]).source[0].round(9).tolist()
            [0.0, -600.0, 2.0]
        """
        r = np.broadcast_to(np.asarray(rotation, dtype=np.float64), (len(self), 3, 3))
        t = np.broadcast_to(np.asarray(translation, dtype=np.float64), (len(self), 3))
        turned = [
            np.einsum("nij,nj->ni", r, part) for part in (self.source, self.detector)
        ]
        steps = [np.einsum("nij,nj->ni", r, part) for part in (self.u, self.v)]
        rows = np.concatenate([turned[0] + t, turned[1] + t, *steps], axis=1)
        return ConeVec(rows, self.detector_shape)

    def binned(self, factor: int, shape: Shape2 | None = None) -> ConeVec:
        """Bin the image by `factor`; columns and rows beyond a multiple of it are cut
        off.

        The center moves with the pixels that are cut off. The result has a detector shape
        only if this one has.

        Args:
            factor: pixels per coarse pixel along each side.
            shape: (rows, cols) of the fine image, if the geometry has none; see
                `of_shape`.

        Raises:
            GeometryError: a factor that is no whole number from 1 to the smaller side, or
                the detector's shape is not known.

        Example:
            >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
            >>> scan.binned(2).shape, round(float(np.linalg.norm(scan.binned(2).u[0])), 6)
            ((4, 38, 48), 0.3)
        """
        rows, cols = self.of_shape(shape)
        if factor not in range(1, min(rows, cols) + 1):
            message = f"binning by {factor!r}; allowed: a whole number from 1 to {min(rows, cols)}"
            raise GeometryError(
                message, {"asked": repr(factor), "allowed": [1, min(rows, cols)]}
            )
        shift_u = (cols // factor * factor - cols) / 2
        shift_v = (rows // factor * factor - rows) / 2
        centre = self.detector + shift_u * self.u + shift_v * self.v
        binned_shape = None
        if self.detector_shape is not None:
            binned_shape = (rows // factor, cols // factor)
        return ConeVec.from_vectors(
            self.source, centre, self.u * factor, self.v * factor, binned_shape
        )


def check_shape(shape: Shape2) -> Shape2:
    """Return (rows, cols) as ints after checking that both are positive.

    Raises:
        GeometryError: one is 0 or less.
        TypeError: one is no whole number.
        ValueError: not two of them.
    """
    rows, cols = map(operator.index, shape)
    if rows <= 0 or cols <= 0:
        message = (
            f"a detector of {rows} x {cols} pixels; allowed: rows and columns from 1"
        )
        raise GeometryError(message, {"asked": repr(shape), "allowed": ["rows", "cols"]})
    return rows, cols


def _stage_angles(angles: int | npt.ArrayLike, turns: float = 1.0) -> FloatArray:
    """Return stage angles (n,) [deg]: those given, or a number of them from 0 on, evenly
    spread over `turns`.

    Given angles are returned as float64, not wrapped; `turns` does not change them.

    Args:
        angles: a number of views, or angles (n,) [deg].
        turns: over which a number of views is spread; the end is not a view.

    Raises:
        GeometryError: no views, a number above `MAX_COUNTED_VIEWS`, an array of more
            dimensions, or an angle that is not finite.
    """
    degrees: FloatArray = np.asarray(angles, dtype=np.float64)
    if isinstance(angles, int | np.integer):
        if angles > MAX_COUNTED_VIEWS:
            problem = f"angles: {angles:g} views"
            allowed = f"1 to {MAX_COUNTED_VIEWS}"
            raise GeometryError.instead(problem, int(angles), allowed)
        degrees = np.linspace(
            0.0, FULL_TURN_DEG * turns, max(int(angles), 0), endpoint=False
        )
    if degrees.ndim != 1 or len(degrees) == 0 or not np.isfinite(degrees).all():
        shown = (
            angles
            if np.ndim(angles) == 0
            else f"an array of shape {shape_words(degrees.shape)}"
        )
        message = (
            f"angles: {shown}; allowed: a number of views from 1, or finite angles [deg]"
        )
        raise GeometryError(
            message, {"asked": repr(angles)[:100], "allowed": "views, or (n,) deg"}
        )
    return degrees


def _numbers(
    name: str, value: object, count: int, unit: str, *, repeated: bool = False
) -> tuple[float, ...]:
    """Convert one number or several to a tuple of `count` finite numbers.

    `name`: of the argument, for the message; `value`: one number or several; `count`: number of
    them; `unit`: for the message; `repeated`: whether one number is repeated `count` times.
    Raises GeometryError: another number of them, or one that is not finite.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0 and (repeated or count == 1):
        array = np.full(count, array)
    if array.shape != (count,) or not np.isfinite(array).all():
        wanted = "one finite number"
        if count != 1:
            wanted = f"{count} finite numbers"
        message = f"{name} is {value!r}; allowed: {wanted} [{unit}]"
        raise GeometryError(message, {"asked": repr(value)[:100], "allowed": wanted})
    return tuple(array.tolist())


def _formats() -> Any:
    return backend("geometry files")


def _span(values: FloatArray) -> str:
    """Format the range of values, "low to high", or one number if both read alike; six digits."""
    low = f"{values.min():.6g}"
    high = f"{values.max():.6g}"
    return low if low == high else f"{low} to {high}"


def check_spread(cone_vec: ConeVec) -> ConeVec:
    """Check that each pixel of each view has a ray of its own: u and v span a plane, and
    the source is outside it; return the argument.

    Directions count as parallel, and the source as in the plane, up to a sine of
    `MIN_SINE`.

    Args:
        cone_vec: n views.

    Raises:
        GeometryError: names the first row in which u or v is zero, u and v are parallel,
            or the source is in the detector's plane.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
        >>> check_spread(scan) is scan
        True
    """
    with np.errstate(all="ignore"):
        u, v, beam = (
            part / np.linalg.norm(part, axis=1, keepdims=True)
            for part in (cone_vec.u, cone_vec.v, cone_vec.detector - cone_vec.source)
        )
        normal = cross(u, v)
        flat = ~(np.linalg.norm(normal, axis=1) > MIN_SINE)
        level = ~(np.abs(np.einsum("ni,ni->n", normal, beam)) > MIN_SINE)
    bad = np.flatnonzero(flat | level)
    if len(bad):
        i = int(bad[0])
        problem = "the source lies in the detector's plane"
        if flat[i]:
            problem = "u and v do not span a plane (one is zero, or they are parallel)"
        raise GeometryError(
            f"cone_vec row {i}: {problem}; allowed: pixels that each have a ray of their own",
            {"row": i, "check": "degenerate", "asked": cone_vec.rows[i].tolist()},
        )
    return cone_vec


def check_cone_vec(cone_vec: ConeVec, pixel_mm: float | tuple[float, float]) -> ConeVec:
    """Check the sanity rules of thesis 4.8.3 (pitch, orthogonal sides, SDD above 0);
    return the argument, so it can guard an expression.

    In that order, within `PITCH_TOLERANCE`: lengths of u and v relative to the pitch, and
    the cosine between them.

    Args:
        cone_vec: the geometry to check.
        pixel_mm: the binned pixel pitch that |u| and |v| must have [mm], or a tuple of
            one for each.

    Raises:
        GeometryError: names the check, a row, its value and the allowed one: the first
            wrong row for the pitch, the worst one for the other two.

    Example:
        >>> scan = ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(76, 96), pixel=0.15)
        >>> check_cone_vec(scan, 0.15) is scan
        True
    """
    u = cone_vec.u
    v = cone_vec.v
    lengths = {"|u|": np.linalg.norm(u, axis=1), "|v|": np.linalg.norm(v, axis=1)}
    if isinstance(pixel_mm, tuple):
        pitches = pixel_mm
    else:
        pitches = (pixel_mm, pixel_mm)
    for (name, length), pitch in zip(lengths.items(), pitches, strict=True):
        bad = np.abs(length - pitch) > PITCH_TOLERANCE * pitch
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            raise GeometryError(
                f"cone_vec row {i}: {name} is {length[i]:.9g} mm, the binned pixel "
                f"pitch is {pitch:.9g} mm",
                {"row": i, "check": "pitch", "asked": float(length[i]), "allowed": pitch},
            )
    cosine = np.einsum("ni,ni->n", u, v) / (lengths["|u|"] * lengths["|v|"])
    if (np.abs(cosine) > PITCH_TOLERANCE).any():
        i = int(np.argmax(np.abs(cosine)))
        raise GeometryError(
            f"cone_vec row {i}: u and v are not orthogonal (cosine {cosine[i]:.3g}, allowed "
            f"{PITCH_TOLERANCE:.1g})",
            {"row": i, "check": "orthogonal", "asked": float(cosine[i])},
        )
    distance = cone_vec.source_detector_distance
    if (distance <= 0).any():
        i = int(np.argmin(distance))
        raise GeometryError(
            f"cone_vec row {i}: the source-detector distance is {distance[i]:.6g} "
            "mm; it must be positive",
            {"row": i, "check": "sdd", "asked": float(distance[i]), "allowed": "> 0"},
        )
    return cone_vec
