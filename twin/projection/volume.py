"""A voxel volume as a frozen value, the memory layout that the kernels read, and how far the
values of a reconstructed one may be off, in short.

Voxels are stored data[z, y, x], float32. The kernels want z contiguous, know which voxels are
empty, and never look outside the occupied box; that layout is derived once per volume, on first
use, and kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.backends import backend
from flexdt.twin.errors import GeometryError, NotBuiltError, shape_words
from flexdt.twin.geometry.conventions import Float32Array, FloatArray, as_numbers
from flexdt.twin.projection.portions import PASS_NS, equal_portions
from flexdt.twin.signatures import File, public

WARNING_BOUND: Final = 0.03
"""Relative bound from which on a cause is warned of, if a tenth of the uniform regions exceed it.
The bound is two to four times the actual deviation: about 1 %."""
CAUSES: Final = {
    "angles": "missing or few views",
    "aside": "an offset panel's narrow overlap",
    "cone": "the cone angle",
    "rows": "truncation above or below",
    "beyond": "truncation at the sides",
    "drift": "a drift of the flat",
    "axis": "the axis offset",
    "slip": "a slip along the axis",
    "height": "the panel's height",
    "roll": "the panel's roll",
    "pitch": "the panel's pitch",
    "yaw": "the panel's yaw",
    "distance": "the panel's distance",
    "turn": "the angle scale",
    "lost": "lost or doubled views",
    "gain": "the gain of views",
    "haze": "haze, scatter or beam hardening",
    "clipped": "clipped line integrals",
    "hardening": "beam hardening",
    "lens": "lens distortion",
    "sampling": "the size of pixels",
    "images": "images that no object explains",
    "geometry": "what images leave open",
    "stopping": "iterations that ended early",
    "penalty": "the total variation's penalty",
}
ONE_ENERGY: Final = "one energy"
"""What is taken as stated where no spectrum is known."""
PLURALS: Final = frozenset({"distances", "angles"})
"""Of what is taken as stated."""
NOT_BOUNDED: Final = (
    "accuracy: not bounded, because the object extends beyond the panel's sides: "
    "a denser shell out there makes every value too low, and no image shows it"
)
MIN_DOUBLED_SIGMAS: Final = 2.0
"""Standard errors from which on edges are said to be doubled."""
MIN_TWO_EDGES_PX: Final = 1.0
"""Distance from which on doubled edges are warned of [pixels]: a volume shows two edges."""
MIN_DOUBLED_VOXELS: Final = 0.2
"""Least distance of doubled edges that is told [voxels]: less widens no edge."""
Vector3 = tuple[float, float, float]
IntArray = npt.NDArray[np.int32]
LANE_FLOATS = 16
"""Voxel columns start at multiples of this many floats: one cache line, one wide
register."""


@dataclass(frozen=True)
class Accuracy:
    """Largest errors of an object's uniform regions, noise not included.

    Attributes:
        half: of the attenuation there, in half of them at most: the figure by which
            volumes are compared.
        most: in nine of ten at most.
        cause: main contribution to the others, of `CAUSES`.
        cut_off: the object continues beyond the panel's sides: the figures are estimates,
            not bounds.
        figure: size of the cause with its standard error, where the images tell one.
        taken: what is taken as stated, because the images do not decide it, by how much it
            would change the volume.
        next: the next of the errors that images tell, of `CAUSES`; "" without one.
        next_figure: its size, likewise.
        doubled_mm: distance at which the errors that images tell double edges, at the axis; 0
            of less than `MIN_DOUBLED_VOXELS`.
        edges_mm: width of edges across the axis, at most: as measured (`Sharpness.across`) with
            two standard errors, or as these errors and two standard errors of others double
            them, whichever is more; None where neither was found.
        edges_cause: of `CAUSES`, of the latter; "" of a measured width.
    """

    half: float
    most: float
    cause: str
    cut_off: bool = False
    figure: str = ""
    taken: tuple[str, ...] = ()
    next: str = ""
    next_figure: str = ""
    doubled_mm: float = 0.0
    edges_mm: float | None = None
    edges_cause: str = ""

    def __str__(self) -> str:
        """Return the accuracy sentence, at most 30 words: largest errors [%] of values in nine of
        ten uniform regions and of edges, the largest cause, and the condition that matters most;
        that nothing is bounded if the object is cut off. See docs/glossary.md.
        """
        if self.cut_off:
            return NOT_BOUNDED
        first, *more = self._stated or ("",)
        edges = "" if self.edges_mm is None else f", edges within {self.edges_mm:.2g} mm"
        taken = _as_stated(first, "more" if more else "")
        return f"{self._values}{edges}, mainly {CAUSES[self.cause]}{taken}"

    @property
    def details(self) -> str:
        """All that the sentence is made of, as one longer sentence."""
        figure = f" ({self.figure})" if self.figure else ""
        further = ""
        if self.next:
            further = f", then {CAUSES[self.next]} ({self.next_figure})"
        edges = ""
        if self.edges_mm is not None:
            why = f" ({CAUSES[self.edges_cause]})" if self.edges_cause else ""
            edges = f", edges within {self.edges_mm:.2g} mm{why}"
        doubled = f", doubled by {self.doubled_mm:.2g} mm" if self.doubled_mm else ""
        *first, last = self._stated or ("",)
        values = f"{self._values} ({_percent(self.half)} in half)"
        bound = f"{NOT_BOUNDED}; estimate: " if self.cut_off else ""
        return (
            f"{bound}{values}, mainly {CAUSES[self.cause]}{figure}{further}{edges}{doubled}"
            f"{_as_stated(', '.join(first), last) if first else _as_stated(last)}"
        )

    @property
    def _stated(self) -> tuple[str, ...]:
        """What is taken as stated, but for the energy."""
        return tuple(one for one in self.taken if one != ONE_ENERGY)

    @property
    def _values(self) -> str:
        """The claim about values, in words."""
        energy = f" at {ONE_ENERGY}" if ONE_ENERGY in self.taken else ""
        return f"accuracy{energy}: within {_percent(self.most)} in nine of ten uniform regions"


def _percent(part: float) -> str:
    return f"{min(100.0 * part, 99.0):.2g} %"


def _as_stated(one: str, other: str = "") -> str:
    """Name what is taken as stated, or two such things; "" without."""
    if not one:
        return ""
    if other:
        return f"; if {one} and {other} are as stated"
    return f"; if {one} {'are' if one in PLURALS else 'is'} as stated"


def doubt_words(causes: Sequence[str], doubling: str = "") -> list[str]:
    """Say by which causes values may be off, and by which edges are doubled, as one warning at
    most. How large these are, only `accuracy` says.

    Args:
        causes: of `CAUSES`, of large errors of values.
        doubling: the cause that doubles edges; "" without one.

    Example:
        >>> doubt_words(["cone"])
        ['values may be off: the cone angle; see its accuracy']
    """
    if "beyond" in causes:
        return [f"values may be off; {NOT_BOUNDED}"]
    doubts = ["values may be off"] * bool(causes) + ["edges doubled"] * bool(doubling)
    if not doubts:
        return []
    named = dict.fromkeys([*causes, doubling] if doubling else causes)
    listed = ", ".join(CAUSES[cause] for cause in named)
    return [f"{' and '.join(doubts)}: {listed}; see its accuracy"]


@public
@dataclass(frozen=True)
class Width:
    """Width of edges between 10 and 90 % of the step [mm].

    Attributes:
        mm: of the sharpest quarter of edges, as far as edges differ by more than noise.
        error_mm: its standard error.
        edges: number of them.
    """

    mm: float
    error_mm: float
    edges: int


@public
@dataclass(frozen=True, repr=False)
class Sharpness:
    """How sharp a volume is.

    Attributes:
        across: width of edges whose normals lie in the layers; None without enough edges.
        along: width of edges whose normals lie along the axis; None likewise.
        detail_mm: size of the finest details that two half scans have in common (Fourier
            ring correlation on planes, half-bit criterion); None where it was not
            measured.
        doubled_mm: distance at which opposite views show the same edge: as measured on that
            plane where it is largest, or, if that is more, as the errors that images tell
            double edges (`Accuracy.doubled_mm`); None where neither was found.
        doubled_error_mm: standard error of the measured one; 0 of the other.
        voxel_mm: edge of a voxel; details are at least two, edges about one.
        doubled_cause: of `CAUSES`; "" of a measured distance.

    Example:
        >>> Sharpness(None, None, 0.21, 0.0, 0.01, 0.1).doubled
        False
    """

    across: Width | None
    along: Width | None
    detail_mm: float | None
    doubled_mm: float | None
    doubled_error_mm: float | None
    voxel_mm: float
    doubled_cause: str = ""

    @property
    def doubled(self) -> bool:
        """True if edges are doubled, by `MIN_DOUBLED_SIGMAS` standard errors and by
        `MIN_DOUBLED_VOXELS`.
        """
        if self.doubled_mm is None or self.doubled_error_mm is None:
            return False
        least = max(
            MIN_DOUBLED_SIGMAS * self.doubled_error_mm, MIN_DOUBLED_VOXELS * self.voxel_mm
        )
        return self.doubled_mm > least

    def __repr__(self) -> str:
        """Return the sentence as a value."""
        return f"<{self}>"

    def __str__(self) -> str:
        """Say in one sentence whether edges are doubled, how wide they are (each of two that
        are farther apart), and what details are told.
        """
        apart = self.doubled_mm if self.doubled and self.doubled_mm is not None else 0.0
        said = [
            f"{'each' if apart > width.mm else 'edges'} {width.mm:.2g} mm wide {where}"
            for width, where in ((self.across, "across"), (self.along, "along the axis"))
            if width is not None
        ]
        if self.detail_mm is not None:
            said.append(f"details from {self.detail_mm:.2g} mm")
        if apart:
            why = f" ({CAUSES[self.doubled_cause]})" if self.doubled_cause else ""
            said.insert(0, f"edges doubled by {apart:.2g} mm{why}")
        if not said:
            return "sharpness: not known, no edges"
        return f"sharpness: {', '.join(said)} (voxels of {self.voxel_mm:.2g} mm)"


@public
@dataclass(frozen=True, eq=False)
class Residuals:
    """What a volume, projected again, leaves of its images.

    Attributes:
        images: measured less projected line integrals, (n, rows, cols), of a copy of the
            scan with fewer pixels.
        views: numbers of these n views among the scan's.
        binned: rows and columns of the panel over which a pixel is the mean.
        own: the volume itself was projected; else a coarse one of the field of view,
            because the volume is a part of it.

    Example:
        >>> rest = np.zeros((3, 2, 2), np.float32)
        >>> rest[1] = 0.1
        >>> found = Residuals(rest, np.array([0, 4, 8]), (6, 6), True)
        >>> found.worst(1).tolist()
        [4]
    """

    images: Float32Array
    views: npt.NDArray[np.intp]
    binned: tuple[int, int]
    own: bool

    @property
    def by_view(self) -> FloatArray:
        """Root mean square of each view, (n,)."""
        squares = np.square(self.images, dtype=np.float64)
        return np.asarray(np.sqrt(squares.mean(axis=(1, 2))))

    @property
    def by_pixel(self) -> FloatArray:
        """Root mean square of each pixel over the views, (rows, cols)."""
        squares = np.square(self.images, dtype=np.float64)
        return np.asarray(np.sqrt(squares.mean(axis=0)))

    def worst(self, count: int = 12) -> npt.NDArray[np.intp]:
        """Return the numbers of the views with the largest residuals, worst first."""
        return self.views[np.argsort(-self.by_view, kind="stable")[:count]]

    def plot(self) -> Any:
        """Draw the residual by view and by pixel, and the worst view; needs matplotlib.

        Returns:
            The three axes.
        """
        return backend("plots").plot_residuals(self)

    def movie(self, count: int = 12) -> Any:
        """Make an animation of the worst views, in the order of the scan; needs
        matplotlib. A notebook shows `.to_jshtml()` of it.

        Args:
            count: of views.

        Returns:
            Matplotlib's animation, with `save("file.gif")`.
        """
        return backend("plots").movie_of_residuals(self, count)

    def __repr__(self) -> str:
        """Name the worst view beside the usual one."""
        by_view = self.by_view
        return (
            f"<Residuals of {len(self.views)} views: {np.median(by_view):.3g} (median), "
            f"{by_view.max():.3g} in view {self.worst(1)[0]}>"
        )


@dataclass(frozen=True, eq=False)
class Layout:
    """The occupied box of a volume with z contiguous. Voxel (ix, iy, iz) of the box is
    flat[base + ix * stride_x + iy * stride_y + iz].

    Attributes:
        flat: float32 1-D storage, attenuation [1/mm].
        base, stride_x, stride_y: elements.
        counts: (nx, ny, nz) voxels of the box; any may be 0 when the volume is empty.
        low_mm: object-frame position of the outer corner of voxel (0, 0, 0) of the box [mm].
        voxel_mm: voxel size (x, y, z) [mm].
        spans: int32 (ny * nx * 2): occupied voxels of column (ix, iy) are first <= iz < last,
            at 2 * (iy * nx + ix) and after.
    """

    flat: Float32Array
    base: int
    stride_x: int
    stride_y: int
    counts: tuple[int, int, int]
    low_mm: Vector3
    voxel_mm: Vector3
    spans: IntArray

    @property
    def empty(self) -> bool:
        """True when all voxels are zero."""
        return min(self.counts) == 0

    @cached_property
    def device_copy(self) -> DeviceCopy:
        """The storage on the CUDA device."""
        return DeviceCopy(self.flat)


@dataclass(eq=False)
class DeviceCopy:
    """A storage on the CUDA device, and how much it would have been used there.

    Attributes:
        flat: the storage.
        there: the same on the device, or None.
        views: number of views projected so far.
        single_views: what `single_view` keeps for the volume, or None.
    """

    flat: Float32Array
    there: Any = None
    views: int = 0
    single_views: Any = None

    def uploaded(self) -> Any:
        """Return the storage on the device, moved there at the first call and kept."""
        from flexdt.twin.projection import gpu

        if self.there is None:
            self.there = gpu.upload(self.flat)
        return self.there


def room_like(volume: Volume) -> Float32Array:
    """Create zeros (nz, ny, nx) with z contiguous in memory, which `back` can write into.

    Example:
        >>> room_like(Volume(np.zeros((6, 4, 4)), 0.5)).strides[0]  # bytes: z is contiguous
        4"""
    nz, ny, nx = volume.shape
    stride = math.ceil(nz / LANE_FLOATS) * LANE_FLOATS
    flat = aligned_zeros(ny * nx * stride)
    return flat.reshape(ny, nx, stride)[:, :, :nz].transpose(2, 0, 1)


def blank_layout(volume: Volume, room: Float32Array | None = None) -> Layout:
    """Make the layout of the full grid of `volume`, for an adjoint to write into.

    Nothing is copied.

    Args:
        volume: its grid is used, not its values.
        room: an array of `room_like`, used with its content; None for new zeros.

    Raises:
        GeometryError: room has another shape or memory layout than `room_like` makes.
    """
    nz, ny, nx = volume.shape
    data = room_like(volume) if room is None else room
    steps = [s // data.itemsize for s in data.strides]
    if (
        data.shape != volume.shape
        or data.dtype != np.float32
        or not data.flags.writeable
        or data.strides[0] != data.itemsize
        or steps[2] < nz
        or steps[1] < nx * steps[2]
    ):
        message = (
            f"out is {data.dtype} {shape_words(data.shape)} with strides {data.strides}"
        )
        wanted = (
            f"writeable float32 {shape_words(volume.shape)} with z contiguous in memory"
        )
        raise GeometryError.instead(
            message, list(data.shape), f"{wanted}, as room_like makes it"
        )
    low = [c - size / 2 for c, size in zip(volume.center_mm, volume.size_mm, strict=True)]
    return Layout(
        flat=_flat_alias(data, (ny - 1) * steps[1] + (nx - 1) * steps[2] + nz),
        base=0,
        stride_x=steps[2],
        stride_y=steps[1],
        counts=(nx, ny, nz),
        low_mm=(low[0], low[1], low[2]),
        voxel_mm=volume.voxel_xyz,
        spans=np.zeros(0, np.int32),
    )


@public
@dataclass(frozen=True, eq=False, repr=False)
class Volume:
    """A frozen volume of voxels.

    The array is kept as a read-only view, not copied when it is float32 already. Whoever goes
    on writing into the original array after a projection gets projections of the old content.

    Attributes:
        data: float32 (nz, ny, nx), linear attenuation [1/mm]; index grows with +z, +y, +x.
        voxel_mm: edge lengths (x, y, z) [mm]; a single number is taken for all three.
        center_mm: object-frame position of the volume's center [mm].

    Raises:
        GeometryError: data is not three-dimensional or has an empty side, a voxel size is not
            positive, or a position is not finite.

    Examples:
        >>> volume = Volume(np.full((6, 4, 4), 0.02, np.float32), voxel_mm=0.5)
        >>> volume
        <Volume: 6 x 4 x 4 voxels (z, y, x) of 0.5 mm about (0, 0, 0) mm>
        >>> volume.size_mm, np.asarray(volume).shape
        ((2.0, 2.0, 3.0), (6, 4, 4))
    """

    data: Float32Array
    voxel_mm: float | Vector3
    center_mm: Vector3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check data, voxel sizes and center, and store them: data as a read-only view,
        sizes as (x, y, z).

        Raises:
            GeometryError: data is not three-dimensional, or a size is not positive.
        """
        data = as_numbers("volume data", self.data, np.float32)
        if data.ndim != 3 or 0 in data.shape:
            wanted = ("nz", "ny", "nx")
            raise GeometryError.of_shape(
                "volume data", data.shape, wanted, ", all positive"
            )
        view = data.view()
        view.setflags(write=False)
        object.__setattr__(self, "data", view)
        if np.ndim(self.voxel_mm) == 0 and np.isrealobj(self.voxel_mm):
            size = self.voxel_mm
            object.__setattr__(self, "voxel_mm", _vector((size,) * 3, "voxel_mm")[0])
        object.__setattr__(self, "center_mm", _vector(self.center_mm, "center_mm"))
        if any(size <= 0 for size in self.voxel_xyz):
            message = f"voxel_mm is {self.voxel_mm}"
            sizes = list(self.voxel_xyz)
            raise GeometryError.instead(message, sizes, "positive sizes (x, y, z) in mm")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return the values, (nz, ny, nx)."""
        if copy:
            return np.array(self.data, dtype=dtype)
        return np.asarray(self.data, dtype=dtype)

    def __dlpack__(self, **options: Any) -> Any:
        """Export the values read-only, as for `torch.from_dlpack(volume)`."""
        return self.data.__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        """Return the device of the values: the processor's memory."""
        return self.data.__dlpack_device__()

    def __repr__(self) -> str:
        """Describe the volume in one line: shape (z, y, x), voxel and center [mm]."""
        sizes = [f"{size:g}" for size in self.voxel_xyz]
        if len(set(sizes)) == 1:
            voxel = sizes[0]
        else:
            voxel = " x ".join(sizes)
        centre = ", ".join(f"{c:g}" for c in self.center_mm)
        nz, ny, nx = self.shape
        return f"<Volume: {nz} x {ny} x {nx} voxels (z, y, x) of {voxel} mm about ({centre}) mm>"

    def _repr_html_(self) -> str:
        """Return an HTML table for a notebook: shape, size [mm], least and largest finite
        value [1/mm], the share of voxels that no data determine, and of one of `reconstruct` the
        accuracy and the sharpness.
        """
        size = " x ".join(f"{side:g}" for side in self.size_mm)
        rows = {"size (x, y, z)": f"{size} mm", "values": escape(self._range_words())}
        if (accuracy := self.accuracy) is not None:
            said = escape(str(accuracy).removeprefix("accuracy").lstrip(": "))
            more = escape(accuracy.details)
            rows["accuracy"] = f"<details><summary>{said}</summary>{more}</details>"
        if getattr(self, "_bias", None) is not None:
            rows["sharpness"] = escape(str(self.sharpness).removeprefix("sharpness: "))
        body = "".join(
            f"<tr><th>{escape(name)}</th><td>{said}</td></tr>"
            for name, said in rows.items()
        )
        return f"<table><caption>{escape(repr(self)[1:-1])}</caption>{body}</table>"

    def _range_words(self) -> str:
        """Say the least and the largest finite value, and how many voxels have none."""
        known = [np.isfinite(layer) for layer in self.data]
        share = sum(int(layer.sum()) for layer in known) / self.data.size
        if share == 0.0:
            return "none is known (NaN)"
        ends = [
            (float(layer[mask].min()), float(layer[mask].max()))
            for layer, mask in zip(self.data, known, strict=True)
            if mask.any()
        ]
        words = f"{min(ends)[0]:.4g} to {max(most for _, most in ends):.4g} / mm"
        if share == 1.0:
            return words
        return f"{words}; {100.0 * (1.0 - share):.2g} % of the voxels are not known (NaN)"

    def to(self, device: str) -> Any:
        """Return the volume on a device: "cpu", this volume, or "cuda", a `DeviceVolume`.

        Raises:
            NotBuiltError: another device, or no CUDA device that works.
            TwinError: the device has no room for it, or fails.

        Example:
            >>> volume = Volume(np.zeros((2, 2, 2)), 1.0)
            >>> volume.to("cpu") is volume
            True
        """
        if device == "cpu":
            return self
        from flexdt.twin.projection import gpu

        device_state = gpu.availability()
        if device != "cuda" or not device_state.present:
            if device == "cuda":
                why = f": {device_state.reason}"
            else:
                why = ""
            raise NotBuiltError(
                f"no volumes on device {device!r}{why}; allowed: 'cpu', and 'cuda' where "
                "there is a CUDA device. Projections use it by themselves, too",
                {"asked": device, "allowed": ["cpu", "cuda"]},
            )
        layout = self.layout
        there = replace(layout, flat=gpu.demand(layout.device_copy.uploaded))
        return DeviceVolume(there, self.shape, self.voxel_mm, self.center_mm)

    def plot(
        self,
        axes: Any = None,
        what: str = "data",
        window: Sequence[float] | Volume | None = None,
    ) -> Any:
        """Show the layer in the middle; needs matplotlib.

        Args:
            axes: matplotlib's axes to draw into; None makes a figure.
            what: `data`, or what `reconstruct` found of its errors: `sigma` or
                `bias_bound`.
            window: attenuation of black and of white [1/mm], or a volume whose window is
                taken, so that both can be compared; None: percentiles of the layer.

        Returns:
            The axes.

        Raises:
            TwinError: there is nothing of that name, or no such window.

        Example:
            >>> Volume(np.zeros((6, 4, 4)), voxel_mm=0.5).plot().get_title()
            'z = 0.25 mm'
        """
        return backend("plots").plot_volume(self, axes, what, window)

    def show(self, window: Sequence[float] | None = None) -> Any:
        """Show three slices in a notebook, with a slider for each.

        With ipywidgets (the extra `notebook`) every layer and any window can be chosen;
        without it it is a page of HTML with some layers, which `.save("volume.html")`
        writes.

        Args:
            window: attenuation of black and of white [1/mm]; None: percentiles of the
                volume.

        Returns:
            Display form in a notebook.

        Raises:
            TwinError: the window is not valid.

        Example:
            >>> page = Volume(np.zeros((6, 4, 4)), voxel_mm=0.5).show()
            >>> "z = 0.25 mm" in page.html
            True
        """
        return backend("notebook").show_volume(self, window)

    def to_xarray(self) -> Any:
        """Convert the values to an xarray DataArray (z, y, x) with positions [mm].

        Raises:
            TwinError: xarray is not installed.

        Example:
            >>> Volume(np.zeros((6, 4, 4)), voxel_mm=0.5).to_xarray().dims
            ('z', 'y', 'x')
        """
        return backend("xarray").volume_to_xarray(self)

    def save(self, file: File) -> None:
        """Write the volume; the ending chooses the format: .tif, .nrrd, .mha, .nii.gz,
        .h5, .zarr.

        Raises:
            TwinError: another ending, or the package that writes it is not installed.
            OSError: the file cannot be written.

        Example:
            >>> import tempfile
            >>> volume = Volume(np.zeros((6, 4, 4)), voxel_mm=0.5)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     volume.save(f"{folder}/volume.nrrd")
            ...     Volume.load(f"{folder}/volume.nrrd")
            <Volume: 6 x 4 x 4 voxels (z, y, x) of 0.5 mm about (0, 0, 0) mm>
        """
        backend("volume files").save_volume(self, file)

    @classmethod
    def load(cls, file: File) -> Volume:
        """Load a volume that `save` or `flexdt reconstruct` wrote.

        Raises:
            TwinError: another ending, or it is no such file.
            OSError: it cannot be read.

        Example:
            >>> import tempfile
            >>> volume = Volume(np.zeros((6, 4, 4)), voxel_mm=0.5)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     volume.save(f"{folder}/volume.tif")
            ...     Volume.load(f"{folder}/volume.tif").voxel_mm
            0.5
        """
        volume: Volume = backend("volume files").read_volume(file)
        return volume

    @property
    def sigma(self) -> Float32Array | None:
        """Noise's standard deviation in each voxel, (nz, ny, nx) [1/mm]; None if unknown.

        Computed at each access, but of iterations once (as long as two volumes).
        """
        noise: Any = getattr(self, "_noise", None)  # of `volume_errors.with_errors`
        values: Float32Array | None
        if noise is None:
            values = None
        else:
            values = noise.sigma(self)
        return values

    @property
    def bias_bound(self) -> Float32Array | None:
        """Bound of each voxel's deviation without noise, (nz, ny, nx) [1/mm].

        NaN without data; None if not estimated. Where `accuracy.cut_off` it is an
        estimate.
        """
        bias: Any = getattr(self, "_bias", None)  # of `volume_errors.with_errors`
        bound: Float32Array | None
        if bias is None:
            bound = None
        else:
            bound = bias.bound(self)
        return bound

    @property
    def accuracy(self) -> Accuracy | None:
        """Summary of how far the object's uniform regions may deviate (`reconstruct`).

        None if it was not estimated, or if the images do not fit the geometry.

        Example:
            >>> volume = fx.reconstruct("my-scans/lego")  # doctest: +SKIP
            >>> volume.accuracy  # doctest: +SKIP
            Accuracy(half=0.006, most=0.021, cause='cone', cut_off=False)"""
        bias: Any = getattr(self, "_bias", None)  # of `volume_errors.with_errors`
        summary: Accuracy | None
        if bias is None:
            summary = None
        else:
            summary = bias.accuracy(self, self.sharpness.across)
        return summary

    @cached_property
    def sharpness(self) -> Sharpness:
        """Widths of the volume's edges; by `reconstruct("fdk")` also the finest details
        that two half scans share, and whether opposite views show edges twice. Computed
        at the first access.

        Example:
            >>> print(Volume(np.zeros((6, 4, 4)), voxel_mm=0.5).sharpness)
            sharpness: not known, no edges"""
        found: Sharpness = backend("sharpness").sharpness_of(self)
        return found

    @cached_property
    def residuals(self) -> Residuals | None:
        """What the volume, projected again, leaves of the images (`reconstruct`): by
        view, by pixel, and the worst views; at most 180 views, of pixels binned to at most
        80 a side. None if no copy of the images was made. Computed at the first access."""
        bias: Any = getattr(self, "_bias", None)  # of `volume_errors.with_errors`
        found: Residuals | None = None if bias is None else bias.residuals(self)
        return found

    @property
    def voxel_xyz(self) -> Vector3:
        """Voxel size (x, y, z) [mm]."""
        return edges_xyz(self.voxel_mm)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(nz, ny, nx)."""
        nz, ny, nx = self.data.shape
        return nz, ny, nx

    @property
    def size_mm(self) -> Vector3:
        """Outer size (x, y, z) [mm]."""
        nz, ny, nx = self.shape
        x, y, z = self.voxel_xyz
        return nx * x, ny * y, nz * z

    @property
    def boxes(self) -> FloatArray:
        """Low and high corner of its box, (1, 2, 3) [mm]."""
        half = np.array(self.size_mm) / 2.0
        return np.array([self.center_mm - half, self.center_mm + half])[None]

    def centers(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute object-frame positions of voxel centers along x (nx,), y (ny,), z (nz,)
        [mm].

        Example:
            >>> volume = Volume(np.zeros((6, 4, 4)), voxel_mm=0.5)
            >>> volume.centers()[0].tolist()
            [-0.75, -0.25, 0.25, 0.75]
        """
        nz, ny, nx = self.shape
        x, y, z = (
            np.asarray(c + (np.arange(n) - (n - 1) / 2) * size, dtype=np.float64)
            for c, n, size in zip(
                self.center_mm, (nx, ny, nz), self.voxel_xyz, strict=True
            )
        )
        return x, y, z

    def like(self, data: npt.NDArray[np.floating]) -> Volume:
        """Make a volume of other values (nz, ny, nx) on the same grid, as float32.

        Raises:
            GeometryError: another shape.

        Example:
            >>> volume = Volume(np.zeros((6, 4, 4)), voxel_mm=0.5)
            >>> float(volume.like(np.ones((6, 4, 4))).data.sum())
            96.0
        """
        values = np.asarray(data, dtype=np.float32)
        if values.shape != self.data.shape:
            raise GeometryError.of_shape(
                "data", values.shape, self.shape, ", the volume's"
            )
        return replace(self, data=values)

    def in_order(self, order: tuple[int, int, int]) -> Volume:
        """Return the volume with axis order[0] (0 for x) in the place of x, order[1] in
        that of y, ...

        Nothing is copied; the layouts of these volumes are kept with this one's.

        Example:
            >>> Volume(np.zeros((6, 4, 5)), voxel_mm=0.5).in_order((1, 2, 0)).shape
            (5, 6, 4)
        """
        if order == (0, 1, 2):
            return self
        if order not in self._orders:
            x, y, z = order
            size = self.voxel_xyz
            center = self.center_mm
            self._orders[order] = Volume(
                self.data.transpose(2 - z, 2 - y, 2 - x),
                (size[x], size[y], size[z]),
                (center[x], center[y], center[z]),
            )
        return self._orders[order]

    @cached_property
    def _orders(self) -> dict[tuple[int, int, int], Volume]:
        return {}

    @cached_property
    def layout(self) -> Layout:
        """The occupied box (that of all voxels other than zero) with z contiguous;
        computed once and cached with the volume.

        Shares the volume's memory if z is contiguous there, else holds a copy. An empty
        volume has counts of 0.
        """
        from flexdt.twin.projection.kernels import layout_kernels

        nz, ny, nx = self.shape
        first = np.zeros((ny, nx), np.int32)
        last = np.zeros((ny, nx), np.int32)
        plane, row = (s // self.data.itemsize for s in self.data.strides[1:])
        if self.data.strides[0] == self.data.itemsize and plane > 0 and row > 0:
            flat = _flat_alias(self.data, (ny - 1) * plane + (nx - 1) * row + nz)
            stride_x = row
            stride_y = plane
        else:
            stride_x = math.ceil(nz / LANE_FLOATS) * LANE_FLOATS
            stride_y = nx * stride_x
            flat = aligned_zeros(ny * stride_y)
            bring_over(self.data, flat, stride_x, stride_y)
        for y0, y1 in equal_portions(ny, PASS_NS * nz * nx, 1):
            layout_kernels.occupied(flat, stride_x, stride_y, nz, first, last, y0, y1)
        filled = last > first
        if not filled.any():
            none = np.zeros(0, np.int32)
            origin = (0.0, 0.0, 0.0)
            return Layout(
                flat, 0, stride_x, stride_y, (0, 0, 0), origin, self.voxel_xyz, none
            )
        # Only offsets and counts change.
        ys, xs = (np.flatnonzero(filled.any(axis=axis)) for axis in (1, 0))
        x0 = int(xs[0])
        x1 = int(xs[-1]) + 1
        y0 = int(ys[0])
        y1 = int(ys[-1]) + 1
        z0 = int(first[filled].min())
        z1 = int(last[filled].max())
        box = (slice(y0, y1), slice(x0, x1))
        low = self.boxes[0, 0] + np.array([x0, y0, z0]) * self.voxel_xyz
        ends = np.stack([first[box], last[box]], axis=-1) - z0
        return Layout(
            flat=flat,
            base=x0 * stride_x + y0 * stride_y + z0,
            stride_x=stride_x,
            stride_y=stride_y,
            counts=(x1 - x0, y1 - y0, z1 - z0),
            low_mm=_vector(low, "low_mm"),
            voxel_mm=self.voxel_xyz,
            spans=np.where(filled[box][..., None], ends, 0).astype(np.int32).ravel(),
        )


@dataclass(frozen=True, eq=False)
class DeviceVolume:
    """A volume whose voxels are on the CUDA device, and stay there.

    `forward` of one gives images on the device, `back` of images on the device gives one; `to`
    and the arrays' `copy_to_host` move them to the host. Libraries that take
    `__cuda_array_interface__` (cupy, PyTorch, numba) share the memory.

    Attributes:
        layout: where each voxel is in `layout.flat`, a flat array on the device.
        shape: (nz, ny, nx).
        voxel_mm: as of the `Volume` whose grid it has.
        center_mm: (x, y, z) [mm].
    """

    layout: Layout
    shape: tuple[int, int, int]
    voxel_mm: float | Vector3
    center_mm: Vector3

    @classmethod
    def blank(cls, like: Volume) -> DeviceVolume:
        """Create a volume of zeros on the grid of `like` on the device; raises if the
        device fails.
        """
        from flexdt.twin.projection import gpu

        layout = blank_layout(like)
        there = replace(layout, flat=gpu.demand(lambda: gpu.zeros(layout.flat.size)))
        return cls(there, like.shape, like.voxel_mm, like.center_mm)

    @classmethod
    def sharing(cls, like: Volume, flat: Any, strides: tuple[int, int]) -> DeviceVolume:
        """Wrap voxels on the device, on the grid of `like`; the memory is shared.

        Voxel (z, y, x) is at flat[y * strides[0] + x * strides[1] + z].
        """
        layout = replace(
            blank_layout(like), flat=flat, stride_y=strides[0], stride_x=strides[1]
        )
        return cls(layout, like.shape, like.voxel_mm, like.center_mm)

    @property
    def voxel_xyz(self) -> Vector3:
        """Edge lengths (x, y, z) [mm]."""
        return edges_xyz(self.voxel_mm)

    @property
    def strides(self) -> tuple[int, int, int]:
        """Bytes from voxel to voxel along z, y, x."""
        return 4, 4 * self.layout.stride_y, 4 * self.layout.stride_x

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        memory = self.layout.flat.__cuda_array_interface__  # type: ignore[attr-defined]
        return {**memory, "shape": self.shape, "strides": self.strides}

    def to(self, device: str) -> Any:
        """Return this volume for "cuda", or a `Volume` downloaded from the device for
        "cpu".

        Raises:
            NotBuiltError: another device.
            TwinError: the device fails.
        """
        if device == "cuda":
            return self
        if device != "cpu":
            raise NotBuiltError(
                f"no volumes on device {device!r}; allowed: 'cpu', 'cuda'", {}
            )
        from flexdt.twin.projection import gpu

        flat = gpu.demand(lambda: self.layout.flat.copy_to_host())  # type: ignore[attr-defined]
        data = np.lib.stride_tricks.as_strided(flat, self.shape, self.strides)
        return Volume(data, self.voxel_mm, self.center_mm)


@public
@dataclass(frozen=True)
class Grid:
    """A grid of voxels without values: a description, no voxel is allocated.

    Attributes:
        shape: (nz, ny, nx).
        voxel_mm: edge of a voxel [mm].
        center_mm: (x, y, z) of the grid's center [mm].

    Example:
        >>> Grid((100, 200, 200), 0.1).bytes
        16000000
    """

    shape: tuple[int, int, int]
    voxel_mm: float
    center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check that the grid has voxels of a positive size.

        Raises:
            GeometryError: a number of voxels below 1, or an edge that is not above 0 and
                finite.
        """
        if min(self.shape) < 1 or not (
            math.isfinite(self.voxel_mm) and self.voxel_mm > 0
        ):
            message = f"grid of {shape_words(self.shape)} voxels of {self.voxel_mm} mm"
            wanted = "three whole numbers above 0, and one edge above 0"
            raise GeometryError.instead(
                message, repr((self.shape, self.voxel_mm)), wanted
            )

    @property
    def bytes(self) -> int:
        """Memory of its values as float32."""
        return 4 * math.prod(self.shape)

    def slab(self, first: int, last: int) -> Grid:
        """Return the grid of layers first <= z < last.

        Example:
            >>> Grid((100, 200, 200), 0.1).slab(0, 20)
            Grid(shape=(20, 200, 200), voxel_mm=0.1, center_mm=(0.0, 0.0, -4.0))"""
        x, y, z = self.center_mm
        middle = z + ((first + last) / 2 - self.shape[0] / 2) * self.voxel_mm
        return Grid((last - first, *self.shape[1:]), self.voxel_mm, (x, y, middle))

    def slabs(self, most_bytes: int) -> list[tuple[int, int]]:
        """Cut into slabs of at most `most_bytes` (but at least one layer) each; lists
        (first, last).

        Example:
            >>> Grid((100, 200, 200), 0.1).slabs(8_000_000)
            [(0, 50), (50, 100)]"""
        layers = max(1, most_bytes * self.shape[0] // self.bytes)
        return cut(self.shape[0], math.ceil(self.shape[0] / layers))

    def blank(self) -> Volume:
        """Make a volume of zeros on this grid, which takes no memory.

        Example:
            >>> Grid((6, 4, 4), 0.5).blank()
            <Volume: 6 x 4 x 4 voxels (z, y, x) of 0.5 mm about (0, 0, 0) mm>"""
        zeros = np.broadcast_to(np.zeros((), np.float32), self.shape)
        return Volume(zeros, self.voxel_mm, self.center_mm)


def cut(layers: int, count: int) -> list[tuple[int, int]]:
    """List layers (first, last) of `count` slabs of about equal height."""
    return list(pairwise(round(i * layers / count) for i in range(count + 1)))


def as_volume(volume: Volume | Grid) -> Volume:
    """Return a volume unchanged, a grid as a volume of zeros.

    Example:
        >>> as_volume(Grid((6, 4, 4), 0.5))
        <Volume: 6 x 4 x 4 voxels (z, y, x) of 0.5 mm about (0, 0, 0) mm>"""
    if isinstance(volume, Grid):
        return volume.blank()
    return volume


def aligned_zeros(count: int) -> Float32Array:
    """Create `count` float32 zeros that start on a cache line (pages touched at first
    writing).
    """
    raw = np.zeros(count + LANE_FLOATS, np.float32)
    skip = (-raw.ctypes.data // raw.itemsize) % LANE_FLOATS
    return raw[skip : skip + count]


def bring_over(
    data: Float32Array,
    flat: Float32Array,
    stride_x: int,
    stride_y: int,
    *,
    adding: bool = False,
) -> None:
    """Copy or add data to a layout's memory, in portions of the kernel; elements between
    columns stay.

    Args:
        data: (nz, ny, nx), in any order of its axes.
        flat: changed in place: flat[y * stride_y + x * stride_x + z].
        stride_x: elements from x to x + 1.
        stride_y: elements from y to y + 1.
        adding: data is added to what flat holds.
    """
    from flexdt.twin.projection.kernels import layout_kernels

    data = data.view()
    data.flags.writeable = False  # a kernel is compiled for each type of its arguments
    if (
        data.strides[1] < data.strides[2]
    ):  # blocks are of z and of what is contiguous in data
        data = data.transpose(0, 2, 1)
        stride_x, stride_y = stride_y, stride_x
    nz, ny, nx = data.shape
    for y0, y1 in equal_portions(ny, PASS_NS * nz * nx, 1):
        layout_kernels.transpose(data, flat, stride_x, stride_y, adding, y0, y1)


class _Memory:
    """Memory of an array as numpy's array interface shows it; keeps the array alive."""

    def __init__(self, owner: Float32Array, count: int) -> None:
        """Expose the memory of `owner` as `count` elements, and keep it alive."""
        self.owner = owner
        self.__array_interface__ = {
            "shape": (count,),
            "typestr": owner.dtype.str,
            "data": (owner.ctypes.data, False),
            "version": 3,
        }


def _flat_alias(data: Float32Array, count: int) -> Float32Array:
    """Return `count` floats from the first voxel on, without the read-only mark.

    A kernel that can also write is compiled for plain arrays only. Projection never
    writes into a volume."""
    return np.asarray(_Memory(data, count))


def edges_xyz(voxel_mm: float | Vector3) -> Vector3:
    """Return edge lengths (x, y, z) [mm] of voxels, given as three or as one for all."""
    if isinstance(voxel_mm, (int, float)):
        return _vector((voxel_mm,) * 3, "voxel_mm")
    return _vector(voxel_mm, "voxel_mm")


def _vector(value: object, name: str) -> Vector3:
    """Convert three finite numbers to floats (x, y, z).

    Raises:
        GeometryError: they are not; the message begins with `name`.
    """
    numbers = np.asarray(value, dtype=np.float64)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        wanted = "three finite numbers (x, y, z) in mm"
        raise GeometryError.instead(f"{name} is {value!r}", repr(value), wanted)
    return float(numbers[0]), float(numbers[1]), float(numbers[2])
