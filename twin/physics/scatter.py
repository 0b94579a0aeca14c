"""Scatter images: signal on the panel after one or more interactions.

The object is a coarse grid of material amounts, the panel a few hundred nodes;
`ScatterImage` interpolates between them, which scatter, being smooth, allows. Everything
is in units of the local open beam's signal, so that the image can be added to a
transmission.

Scatter changes slowly from view to view, so a scan of hundreds of views needs some tens
of simulations; the views in between are interpolated linearly along the way of source and
panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.scattering import cross_sections
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import GeometryError, LimitError, require_within
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import Chain, Scattered, weights_of

BATCHES: Final = 32
"""Number of independent estimates whose spread is the standard error; threads share them."""
FIRST_HISTORIES: Final = 8
"""Histories of each batch before the error is first estimated; their number then doubles."""
MAX_HISTORIES: Final = 1 << 16
"""Largest number of histories of each batch, if the requested error is out of reach."""
MAX_POINTS_PER_STEP: Final = 1 << 12
"""Largest number of Sobol points of a batch in one step."""
LATER_FAN: Final = 2
"""Interactions after the first send their signal to one node in this many."""

Scatter = Literal["off", "mc"]
_BOUNDS = {
    "error": (1e-4, 1.0),
    "nodes": (16, 100_000),
    "voxels": (1, 1 << 24),
    "step_deg": (0.0, 90.0),
    "seed": (0, 2**63 - 1),
}


@dataclass(frozen=True, kw_only=True)
class ScatterSettings:
    """Settings of the scatter simulation.

    Args:
        error: standard error of a node at which the simulation stops, as part of the
            image's mean.
        nodes: of the panel, about; they are spread evenly from corner to corner.
        voxels: of the sample's grid, about.
        step_deg: views closer than this angle apart are interpolated; 0: every view by
            itself.
        collimated: the beam ends at the panel's edges; else it illuminates the sample
            completely.
        seed: another seed draws other photons.

    Raises:
        LimitError: a setting that cannot be used; the message lists the allowed values.

    Example:
        >>> ScatterSettings(error=0.01).step_deg
        5.0
    """

    error: float = 0.03
    nodes: int = 720
    voxels: int = 40_000
    step_deg: float = 5.0
    collimated: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            require_within(f"scatter: {name}", getattr(self, name), low, high)


@dataclass(frozen=True, eq=False)
class Object:
    """The scattering object as voxels.

    Attributes:
        amounts: float32 (z, y, x, m), parts of each substance's own density, >= 0.
        voxel_mm: edges along x, y, z [mm].
        center_mm: (x, y, z) of the grid [mm].
        substances: m materials.
    """

    amounts: Float32Array
    voxel_mm: tuple[float, float, float]
    center_mm: tuple[float, float, float]
    substances: tuple[Substance, ...]

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest x, y, z of the grid [mm]."""
        half = np.array(self.amounts.shape[2::-1]) * self.voxel_mm / 2.0
        middle = np.array(self.center_mm)
        return middle - half, middle + half


@dataclass(frozen=True, eq=False)
class Beam:
    """Spectrum and panel, by the energies of the attenuation tables.

    Attributes:
        signal: (e,) contribution of each energy to the open beam's signal; any unit.
        response: (e,) signal that one photon makes.
        spread: (e,) contribution of one photon to the signal's variance.
    """

    signal: FloatArray
    response: FloatArray
    spread: FloatArray

    @classmethod
    def of(cls, chain: Chain, kV: float) -> Beam:
        """Make the beam of a tube and panel at a voltage [kV]."""
        signal, _ = weights_of(chain, kV)
        return cls(signal, *chain.panel.charge_of_photons())


@dataclass(frozen=True, eq=False)
class ScatterImage:
    """Scattered signal at the nodes of a panel, in units of the local open beam's signal.

    Attributes:
        mean: (v, u) scatter.
        error: (v, u) its standard error.
        single: (v, u) the part of it that was scattered once.
        spread: (v, u) contribution of scatter to the variance, in units of the signal's
            charge.
        shape: the panel's (rows, cols); nodes are spread evenly from corner to corner.
        histories: photons followed.
        balance: interacting photons, absorbed, escaped, and their energies [keV], in
            units of the photons that interact.
    """

    mean: FloatArray
    error: FloatArray
    single: FloatArray
    spread: FloatArray
    shape: tuple[int, int]
    histories: int
    balance: FloatArray

    def full(self, values: FloatArray | None = None) -> Float32Array:
        """Interpolate `mean`, or other nodes, at pixels by cubic splines."""
        return spread_out(self.mean if values is None else values, self.shape)


def spread_out(values: FloatArray, shape: tuple[int, int]) -> Float32Array:
    """Interpolate values at nodes at every pixel, by cubic splines (of lower order for fewer
    than 4 nodes).

    `values`: (v, u) at nodes that reach from the first to the last pixel, evenly; `shape`: the
    panel's (rows, cols).
    Returns float32 (rows, cols).
    """
    from scipy.interpolate import RectBivariateSpline

    rows, cols = shape
    # A single row or column has all its nodes at one place: the first one's value is taken.
    v = np.linspace(0, max(rows - 1, 1), values.shape[0])
    u = np.linspace(0, max(cols - 1, 1), values.shape[1])
    orders = {"kx": min(3, len(v) - 1), "ky": min(3, len(u) - 1)}
    spline = RectBivariateSpline(v, u, values, s=0, **orders)
    return np.asarray(spline(np.arange(rows), np.arange(cols)), dtype=np.float32)


def scatter_image(
    thing: Object,
    view: npt.ArrayLike,
    shape: tuple[int, int],
    beam: Beam,
    settings: ScatterSettings | None = None,
    stream: int = 0,
) -> ScatterImage:
    """Simulate the scatter image of one view by Monte Carlo: histories are doubled until
    the mean error of the nodes is `settings.error` of the mean scatter, or until
    `MAX_HISTORIES` in each of `BATCHES` batches.

    Args:
        thing: the object's voxels, in the frame of `view`.
        view: the cone_vec row (12,) [mm].
        shape: the panel's (rows, cols).
        beam: spectrum and panel.
        settings: of the simulation.
        stream: number of the view: others draw other photons.

    Returns:
        Values at the nodes, in units of the open beam's signal, with their error; zeros
        for an empty object or one beside the panel.

    Raises:
        GeometryError: the source is beside or inside the object's box.

    Example:
        >>> water = Substance.of("water", "H2O", 1.0)
        >>> cube = Object(np.ones((10, 10, 10, 1), np.float32), (3.0,) * 3, (0.0,) * 3, (water,))
        >>> at_60 = (cross_sections(()).energy_keV == 60.25) * 1.0
        >>> view = [0, -400, 0, 0, 200, 0, 1, 0, 0, 0, 0, -1]
        >>> image = scatter_image(cube, view, (60, 80), Beam(at_60, at_60 + 1.0, at_60 + 1.0))
        >>> bool(0.007 < image.full()[30, 40] < 0.010)
        True
    """
    from scipy.stats import qmc

    from flexdt.twin.physics import scatter_kernels as kernels

    if settings is None:
        settings = ScatterSettings()
    row = np.asarray(view, dtype=np.float64)
    source = row[0:3]
    centre = row[3:6]
    u = row[6:9]
    v = row[9:12]
    rows, cols = shape
    nv, nu = _node_counts(
        shape, float(np.linalg.norm(v) / np.linalg.norm(u)), settings.nodes
    )
    sections = cross_sections(thing.substances)
    row_of = np.linspace(0, rows - 1, nv)[:, None, None] - (rows - 1) / 2
    col_of = np.linspace(0, cols - 1, nu)[None, :, None] - (cols - 1) / 2
    nodes = np.ascontiguousarray((centre + row_of * v + col_of * u).reshape(-1, 3))
    normal = np.cross(u, v)
    normal /= np.linalg.norm(normal) * np.sign((centre - source) @ normal)
    away = nodes - source
    distance = np.linalg.norm(away, axis=1)
    per_open = distance**3 / (away @ normal)
    occupied = bool(thing.substances) and thing.amounts.any()
    if occupied:
        lit = _lit(thing, row, shape, settings.collimated)
    else:
        lit = (0.0, 0.0, 0.0, 0.0)
    left, top, right, bottom = lit
    corner = centre + left * u + top * v
    along_u = (right - left) * u
    along_v = (bottom - top) * v
    area = float(np.linalg.norm(np.cross(along_u, along_v)))
    if not area > 0.0:
        blank = np.zeros((nv, nu))
        return ScatterImage(
            blank, blank, blank, blank, shape, 0, np.zeros(kernels.TALLIES)
        )

    bins = np.flatnonzero(beam.signal > 0.0)
    share = beam.signal[bins] / beam.signal.sum()
    chance = _energy_chances(thing, row, sections.total[:, bins], share)
    rng = np.random.Generator(
        np.random.PCG64(np.random.SeedSequence([settings.seed, stream]))
    )
    keys = rng.integers(0, 2**64, BATCHES, dtype=np.uint64)
    sequences = [qmc.Sobol(kernels.DIMENSIONS, rng=one) for one in rng.spawn(BATCHES)]
    images = np.zeros((BATCHES, nv * nu, 3))
    tallies = np.zeros((BATCHES, kernels.TALLIES))
    lower, _ = thing.corners
    step = float(sections.energy_keV[1] - sections.energy_keV[0])
    done = 0
    fans = np.array([nv * nu, max(1, nv * nu // LATER_FAN)])
    each = FIRST_HISTORIES
    while True:
        kernels.histories(
            np.stack([one.random(each) for one in sequences]),
            done,
            keys,
            fans,
            kernels.MAX_ORDERS,
            source,
            corner,
            along_u,
            along_v,
            normal,
            area,
            nodes,
            per_open,
            thing.amounts,
            lower,
            np.array(thing.voxel_mm, dtype=np.float64),
            float(sections.energy_keV[0]),
            step,
            sections.total,
            sections.coherent,
            sections.incoherent,
            sections.root_step,
            sections.form,
            sections.shell,
            sections.cumulated,
            bins,
            np.cumsum(chance) / chance.sum(),
            share / beam.response[bins] / chance,
            beam.response,
            beam.spread,
            images,
            tallies,
        )
        done += each
        batches = images[:, :, :2].sum(axis=2) / done
        mean = batches.mean(axis=0)
        error = batches.std(axis=0, ddof=1) / np.sqrt(BATCHES)
        relative = float(error.mean() / max(mean.mean(), 1e-300))
        if relative <= settings.error or done >= MAX_HISTORIES:
            break
        each = min(done, MAX_POINTS_PER_STEP)  # Sobol's points are even in powers of two
    whole = images.sum(axis=0) / (done * BATCHES)
    charge = float((beam.spread / beam.response)[bins] @ share)
    tally = tallies.sum(axis=0)
    return ScatterImage(
        mean.reshape(nv, nu),
        error.reshape(nv, nu),
        whole[:, kernels.SINGLE].reshape(nv, nu),
        (whole[:, kernels.NOISE] / charge).reshape(nv, nu),
        shape,
        done * BATCHES,
        tally / max(tally[0], 1e-300),
    )


def _energy_chances(
    thing: Object, row: FloatArray, mu: FloatArray, share: FloatArray
) -> FloatArray:
    """Compute the chances to draw each energy: half as in the open beam, half as behind the
    thickest part, where hard photons make most of the signal.

    `thing`: the object; `row`: cone_vec row (12,); `mu`: (materials, s) attenuations; `share`:
    (s,) of each energy in the open beam. Returns (s,), adding up to 1."""
    axis = int(np.argmax(np.abs(np.cross(row[6:9], row[9:12]))))
    columns = thing.amounts.sum(axis=2 - axis, dtype=np.float64) * thing.voxel_mm[axis]
    thickest = columns.reshape(-1, len(mu))[np.argmax(columns.sum(axis=-1))]
    behind = share * np.exp(-thickest @ (mu - mu.min(axis=1, keepdims=True)))
    return np.asarray(0.5 * share + 0.5 * behind / behind.sum())


def _node_counts(shape: tuple[int, int], aspect: float, nodes: int) -> tuple[int, int]:
    """Choose the numbers of nodes along rows and columns, evenly spaced, two at least and
    a pixel apart at most."""
    height = max(shape[0] - 1, 1) * aspect
    width = max(shape[1] - 1, 1)
    nv = round(np.sqrt(nodes * height / width))
    nu = round(np.sqrt(nodes * width / height))
    return min(max(nv, 2), max(shape[0], 2)), min(max(nu, 2), max(shape[1], 2))


def _lit(
    thing: Object, row: FloatArray, shape: tuple[int, int], collimated: bool
) -> tuple[float, float, float, float]:
    """Project the object's box on the panel's plane: least and greatest column and row,
    from its center.

    Args:
        thing: the object with its box [mm].
        row: cone_vec row (12,).
        shape: (rows, cols) of the panel.
        collimated: the beam is limited to the panel, so that the rectangle is cut to it.

    Returns:
        (left, top, right, bottom) [pixels]; of no area where nothing is lit.

    Raises:
        GeometryError: the source is in the box or beside it.
    """
    source = row[0:3]
    centre = row[3:6]
    u = row[6:9]
    v = row[9:12]
    box = np.array(thing.corners)
    corners = np.array(
        [[box[i, 0], box[j, 1], box[k, 2]] for i, j, k in np.ndindex(2, 2, 2)]
    )
    normal = np.cross(u, v)
    depth = (corners - source) @ normal / ((centre - source) @ normal)
    if depth.min() <= 1e-3:
        message = (
            "the X-ray source lies in or beside the sample's box: "
            "its scatter is not simulated"
        )
        raise GeometryError.instead(
            message, source.tolist(), "a sample in front of the source"
        )
    on_panel = source + (corners - source) / depth[:, None] - centre
    plane = np.linalg.lstsq(np.stack([u, v], axis=1), on_panel.T, rcond=None)[0]
    low = plane.min(axis=1)
    high = plane.max(axis=1)
    if collimated:
        edge = np.array([shape[1], shape[0]]) / 2.0
        low = np.maximum(low, -edge)
        high = np.minimum(high, edge)
    high = np.maximum(high, low)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


@dataclass(frozen=True, eq=False)
class ScanScatter:
    """Scatter of the views of a scan.

    Attributes:
        settings: how it was simulated.
        images: of the simulated views.
        simulated: (k,) their indices in the scan, growing.
        way: (n,) how far source and panel have come at each view [rad].
        known: (k,) the same at the simulated ones.
    """

    settings: ScatterSettings
    images: tuple[ScatterImage, ...]
    simulated: tuple[int, ...]
    way: FloatArray
    known: FloatArray

    def __len__(self) -> int:
        return len(self.way)

    def __getitem__(self, index: int) -> Scattered:
        """Interpolate a view's scatter at every pixel; never negative, as splines may be."""
        return Scattered(self.signal(index), self._spread_out(index, "spread"))

    def of_views(self, chosen: npt.NDArray[np.intp]) -> ScanScatter:
        """Select the scatter of some of the views."""
        return replace(self, way=self.way[chosen])

    def signal(self, index: int) -> Float32Array:
        """Interpolate a view's signal alone."""
        return self._spread_out(index, "mean")

    def error(self, index: int) -> Float32Array:
        """Compute the standard error of a view's scatter, float32 (rows, cols), of the
        open beam's signal.

        That of the Monte Carlo alone: interpolation between nodes and views comes on top."""
        squares = self._at(index, self._stack["error"] ** 2, 2)
        return spread_out(np.sqrt(squares), self.images[0].shape)

    @property
    def nodes(self) -> FloatArray:
        """Scatter of the simulated views at the nodes, (k, v, u)."""
        return self._stack["mean"]

    @cached_property
    def _stack(self) -> dict[str, FloatArray]:
        """Arrays mean, error and spread of the simulated views by name, (k, v,
        u).
        """
        names = ("mean", "error", "spread")
        return {
            name: np.array([getattr(one, name) for one in self.images]) for name in names
        }

    def _spread_out(self, index: int, name: str) -> Float32Array:
        """Interpolate an array of a view at every pixel, not below zero."""
        values = spread_out(self._at(index, self._stack[name]), self.images[0].shape)
        return np.maximum(values, np.float32(0.0))

    def _at(self, index: int, values: FloatArray, power: int = 1) -> FloatArray:
        """Interpolate values of the simulated views (k, ...) at view `index` of the scan,
        linearly along the way; at the ends the nearest view's.

        Args:
            index: of the view; negative ones count from the end.
            values: of the simulated views.
            power: of the weights: 2 for variances.

        Raises:
            IndexError: no such view.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        place = self.way[index]
        known = self.known
        after = min(int(np.searchsorted(known, place)), len(known) - 1)
        before = max(after - 1, 0)
        span = known[after] - known[before]
        if span <= 0.0:
            part = 1.0
        else:
            part = min(max((place - known[before]) / span, 0.0), 1.0)
        return np.asarray(
            (1.0 - part) ** power * values[before] + part**power * values[after]
        )


def view_scatter(
    thing: Object,
    view: FloatArray,
    shape: tuple[int, int],
    beam: Beam,
    settings: ScatterSettings,
) -> Scattered:
    """Simulate the scatter of one view at every pixel, independent of others.

    `view`: cone_vec row (12,) [mm], which alone determines its photons; `step_deg` of the
    settings does not count. Raises GeometryError: the source is beside or inside the
    object's box.
    """
    row = np.ascontiguousarray(view, dtype=np.float64)
    stream = int.from_bytes(blake2b(row.tobytes(), digest_size=8).digest(), "little")
    image = scatter_image(thing, row, shape, beam, settings, stream)
    zero = np.float32(0.0)
    return Scattered(
        np.maximum(image.full(), zero), np.maximum(image.full(image.spread), zero)
    )


def scan_scatter(
    thing: Object,
    views: FloatArray,
    shape: tuple[int, int],
    beam: Beam,
    settings: ScatterSettings | None = None,
) -> ScanScatter:
    """Simulate the scatter of a scan, at views at most `step_deg` apart along its way;
    others are interpolated.

    Args:
        thing: the object's voxels, in the frame of `views`.
        views: (n, 12) cone_vec rows [mm].
        shape: the panel's (rows, cols).
        beam: spectrum and panel.
        settings: of the simulation.

    Raises:
        GeometryError: the source is beside or inside the object's box in a view.
        LimitError: no views.
    """
    if settings is None:
        wanted = ScatterSettings()
    else:
        wanted = settings
    rows = np.asarray(views, dtype=np.float64)
    if not len(rows):
        raise LimitError(
            "no views to simulate scatter for", {"asked": 0, "allowed": "> 0"}
        )
    way = way_of(rows)
    simulated = _views_to_simulate(way, np.radians(wanted.step_deg))
    images = tuple(
        scatter_image(thing, rows[i], shape, beam, wanted, i) for i in simulated
    )
    return ScanScatter(wanted, images, tuple(simulated), way, way[list(simulated)])


def way_of(rows: FloatArray) -> FloatArray:
    """Compute the path length of source and panel up to each view, relative to their
    distances, (n,) [rad].

    0 for the first. Of each step the largest of three counts: source's, over its least
    distance from the object's origin; panel's, over its least distance from the source;
    and that of u and v, over the least length of u.

    Args:
        rows: cone_vec of the views, (n, 12).
    """
    source = rows[:, 0:3]
    centre = rows[:, 3:6]
    frame = rows[:, 6:12]
    scales = (
        np.linalg.norm(source, axis=1).min(),
        np.linalg.norm(centre - source, axis=1).min(),
        np.linalg.norm(frame[:, :3], axis=1).min(),
    )
    steps = [
        np.linalg.norm(np.diff(part, axis=0), axis=1) / scale
        for part, scale in zip((source, centre, frame), scales, strict=True)
    ]
    return np.concatenate([[0.0], np.cumsum(np.max(steps, axis=0))])


def _views_to_simulate(way: FloatArray, step: float) -> Sequence[int]:
    """Choose the views to simulate, ascending: first, last, at most `step` of path
    apart.
    """
    chosen = [0]
    for i in range(1, len(way)):
        if i == len(way) - 1 or way[i + 1] - way[chosen[-1]] > step:
            chosen.append(i)
    return chosen
