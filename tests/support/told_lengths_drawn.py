"""Scans whose told lengths are drawn, right or wrong: helices, placements, steps of the SOD,
geometries of others.

The laboratory is written out here: rotation matrices, rays, and the centre of a ball's outline
from the conic of its tangent cone. Nothing of the fit is in it, nor of `faults_drawn`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SHAPE: Final = (760, 956)
PIXEL: Final = 0.1496
NOISE_PX: Final = 0.02
KINDS: Final = ("helix", "places", "odd_place", "panel_ways", "steps", "others", "pixel")


@dataclass(frozen=True, eq=False)
class ToldScan:
    """One scan, as it is told.

    Attributes:
        spots: of each frame, (m, 3): column, row, radius [px].
        source, axis, detector: (n, 3) told [mm].
        angles: (n,) told [deg].
        pixel: told [mm].
    """

    spots: list[Array]
    source: Array
    axis: Array
    detector: Array
    angles: Array
    pixel: float


@dataclass(frozen=True, eq=False)
class Told:
    """Scans of one phantom, and what is true.

    Attributes:
        scans: as told.
        beads, radii: of the phantom's file [mm].
        truth: offset -> the least and largest that it had, true less told [mm, deg].
        magnification: true, least and largest, in the first frame of the first scan.
        column: of the axis there, where it crosses the middle row [px].
        wrong: relative error of the told length.
        priors: that the operator states.
    """

    scans: tuple[ToldScan, ...]
    beads: Array
    radii: Array
    truth: dict[str, tuple[float, float]]
    magnification: tuple[float, float]
    columns: tuple[float, ...]
    wrong: float
    priors: dict[str, float] = field(default_factory=dict)


def outline(centre: Array, radius: float, corner: Array, u: Array, v: Array) -> Array:
    """Compute centre and radius of a ball's outline on a plane, (3,): column, row, radius.

    Args:
        centre: of the ball, from the source [mm].
        radius: of the ball [mm].
        corner: of pixel (0, 0), from the source.
        u, v: steps of a column and a row.
    """
    to_world = np.column_stack([u, v, corner])
    cone = np.outer(centre, centre) - (centre @ centre - radius**2) * np.eye(3)
    q = to_world.T @ cone @ to_world
    middle = -np.linalg.solve(q[:2, :2], q[:2, 2])
    level = q[2, 2] + q[:2, 2] @ middle
    semi = np.sqrt(-level / np.linalg.eigvalsh(q[:2, :2]))
    return np.array([*middle, float(np.abs(semi).min())])


def turned(angle_deg: float) -> Array:
    """Return the matrix of a turn that is clockwise from above for growing angles."""
    a = math.radians(angle_deg)
    return np.array(
        [[math.cos(a), math.sin(a), 0.0], [-math.sin(a), math.cos(a), 0.0], [0, 0, 1.0]]
    )


def _phantom(rng: np.random.Generator, count: int) -> Array:
    """Draw beads that lie apart, of unequal heights and directions."""
    while True:
        height = np.linspace(-22.0, 22.0, count) + rng.uniform(-2.0, 2.0, count)
        way = rng.uniform(0.0, 2.0 * np.pi, count)
        reach = rng.uniform(6.0, 15.0, count)
        beads = np.stack([reach * np.cos(way), reach * np.sin(way), height], axis=1)
        apart = np.linalg.norm(beads[:, None] - beads[None], axis=2)
        if apart[np.triu_indices(count, 1)].min() > 6.0:
            return np.asarray(rng.permutation(beads))


def drawn_told(
    kind: str,
    seed: int,
    wrong: float,
    *,
    scans: int = 2,
    strain: float = 1e-3,
    offset: float = 1.0,
) -> Told:
    """Draw scans of which one told length is off by a part `wrong`.

    Args:
        kind: of `KINDS`. A helix's rise; the way from the first place to each other one along
            the beam, or to one of three; the way of the panel between two scans; the SOD's
            steps within one scan; the SOD and SDD of another scanner's geometry; the pixel
            pitch.
        seed: of the draws.
        wrong: true over told, less 1.
        scans: number of places.
        strain: standard deviation of the phantom's scale [1].
        offset: factor on what is not known of detector and tilts.
    """
    rng = np.random.default_rng([seed, *kind.encode()])
    beads = _phantom(rng, int(rng.integers(6, 10)))
    radii = np.full(len(beads), rng.uniform(0.8, 1.2))
    real = beads + strain * rng.normal() * (beads - beads.mean(axis=0))
    sod, sdd = rng.uniform(500.0, 620.0), rng.uniform(950.0, 1100.0)
    true_sod, true_sdd, true_pixel = sod, sdd, PIXEL
    frames = int(rng.choice([24, 36, 48]))
    turns = 1.0
    rise = 0.0
    steps = np.zeros(frames)
    if kind == "helix":
        turns = float(rng.choice([1.0, 2.0, 3.0]))
        rise = float(rng.uniform(15.0, 40.0) * rng.choice([-1.0, 1.0]))
    if kind == "steps":
        count = int(rng.integers(2, 5))
        turns = float(count)
        frames = 16 * count
        steps = np.repeat(np.linspace(0.0, -rng.uniform(80.0, 160.0), count), 16)
    if kind == "others":
        which = rng.integers(3)
        true_sod *= 1.0 + wrong * (which != 1)
        true_sdd *= 1.0 + wrong * (which != 0)
    if kind == "pixel":
        true_pixel *= 1.0 + wrong
    angles = 360.0 * turns * np.arange(frames) / frames
    truth = {
        "dO_x": rng.uniform(-3.0, 3.0),
        "dO_y": rng.uniform(-3.0, 3.0),
        "dO_z": rng.uniform(-6.0, 6.0),
        "alpha": rng.uniform(-180.0, 180.0),
        "tau_x": rng.uniform(-1.5, 1.5),
        "tau_z": rng.uniform(-1.5, 1.5),
        "dD_x": offset * rng.normal() * 1.0,
        "dD_y": offset * rng.normal() * 1.0,
        "dD_z": offset * rng.normal() * 0.5,
        "det_roll": offset * rng.normal() * 0.2,
    }
    places = [0.0]
    if kind == "odd_place":
        scans = 3
    if kind in ("places", "odd_place"):
        places += [
            float(p)
            for p in rng.permutation([-1.0, -0.5, 0.6])[: scans - 1]
            * rng.uniform(120.0, 200.0)
        ]
    if kind == "panel_ways":
        places = [0.0, 0.0]
    further = float(rng.uniform(150.0, 350.0)) if kind == "panel_ways" else 0.0
    told = []
    columns = []
    seen_sods = []
    for i, place in enumerate(places):
        way = steps + place
        height = rise * np.arange(frames) / frames
        more = (
            wrong
            if kind in ("places", "steps") or (kind == "odd_place" and i == 1)
            else 0.0
        )
        true_way = way * (1.0 + more)
        true_height = height * (1.0 + (wrong if kind == "helix" else 0.0))
        axis = np.stack([0 * way, true_sod + true_way, true_height], axis=1)
        stated = np.stack([0 * way, sod + way, height], axis=1)
        spots, column, here = _exposed(
            real,
            radii,
            angles,
            axis,
            true_sdd - i * further * (1.0 + wrong),
            true_pixel,
            truth,
            rng,
        )
        columns.append(column)
        seen_sods.append(here - stated[:, 1])
        told.append(
            ToldScan(
                spots,
                np.zeros((frames, 3)),
                stated,
                np.tile([0.0, sdd - i * further, 0.0], (frames, 1)),
                angles,
                PIXEL,
            )
        )
    ends = {name: (value, value) for name, value in truth.items()}
    along = np.concatenate(seen_sods)
    ends["dO_z"] = (float(along.min()), float(along.max()))
    if kind == "helix":
        extra = wrong * (rise * np.arange(frames) / frames)
        ends["dO_y"] = (truth["dO_y"] + extra.min(), truth["dO_y"] + extra.max())
    far = true_sdd + truth["dD_z"]
    ends["dD_z"] = tuple(sorted((far - sdd, far - sdd - further * wrong)))
    first = true_sod + truth["dO_z"]
    # tau moves the axis, too: dO is of the axis.
    first += truth["tau_z"]
    return Told(
        tuple(told), beads, radii, ends, (far / first, far / first), tuple(columns), wrong
    )


def _exposed(
    beads: Array,
    radii: Array,
    angles: Array,
    axis: Array,
    sdd: float,
    pixel: float,
    truth: dict[str, float],
    rng: np.random.Generator,
) -> tuple[list[Array], float, Array]:
    """Expose every frame; returns spots, the axis's column in the first frame, and dO_z plus
    the SOD in each frame.
    """
    rows, cols = SHAPE
    roll = math.radians(truth["det_roll"])
    # Right-handed about u x v, which points along the beam: u turns down.
    u = pixel * np.array([math.cos(roll), 0.0, -math.sin(roll)])
    v = pixel * np.array([-math.sin(roll), 0.0, -math.cos(roll)])
    centre = np.array([truth["dD_x"], sdd + truth["dD_z"], truth["dD_y"]])
    corner = centre - (cols - 1) / 2 * u - (rows - 1) / 2 * v
    tau = np.array([truth["tau_x"], truth["tau_z"], 0.0])
    shift = np.array([truth["dO_x"], truth["dO_z"], truth["dO_y"]])
    frames = []
    for angle, place in zip(angles, axis, strict=True):
        turn = turned(angle + truth["alpha"])
        at = (beads - tau) @ turn.T + tau + shift + place
        found = np.array(
            [outline(c, r, corner, u, v) for c, r in zip(at, radii, strict=True)]
        )
        found[:, :2] += rng.normal(scale=NOISE_PX, size=found[:, :2].shape)
        reach = found[:, 2] + 2.0
        inside = (
            (found[:, 0] > reach)
            & (found[:, 0] < cols - 1 - reach)
            & (found[:, 1] > reach)
            & (found[:, 1] < rows - 1 - reach)
        )
        gap = np.linalg.norm(found[:, None, :2] - found[None, :, :2], axis=2)
        near = gap < found[:, None, 2] + found[None, :, 2] + 4.0
        np.fill_diagonal(near, val=False)
        frames.append(found[inside & ~near.any(axis=1)])
    points = [axis[0] + shift + tau + [0.0, 0.0, h] for h in (-5.0, 5.0)]
    low, high = (outline(p, 1e-3, corner, u, v) for p in points)
    middle = (rows - 1) / 2
    column = low[0] + (high[0] - low[0]) * (middle - low[1]) / (high[1] - low[1])
    return frames, float(column), axis[:, 1] + shift[1]
