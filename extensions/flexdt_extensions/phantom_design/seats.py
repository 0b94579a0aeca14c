"""Places where beads can be glued into a stack of LEGO bricks, or held by a block.

A seat is a position where a bead can be glued: touching the roof of the cavity anywhere on half
the stud pitch, or touching a wall at one of three heights. Seats inside a tube, through a wall
or where a stud of the brick below comes up are left out. Bricks are at least two studs wide.
`bead_search` chooses among the seats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom, PhantomError, material
from flexdt.phantoms.bricks import Brickwork, lego_data
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import FloatArray

MOST_BRICKS: Final = 20
MOST_STUDS: Final = 8


@dataclass(frozen=True, eq=False)
class Seats:
    """Places for beads in a stack, lowest brick first.

    Attributes:
        places: (m, 3) bead centers [mm, object frame].
        brick: (m,) number of the brick, 0 the lowest.
    """

    places: FloatArray
    brick: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.places)


def stack_of(studs: tuple[int, int], bricks: int) -> Brickwork:
    """Make a stack of `bricks` (1 to MOST_BRICKS) with so many `studs` along x and y (2
    to MOST_STUDS each).

    Raises:
        LimitError: too few or too many.
    """
    for what, value, low, high in (
        ("studs along x", studs[0], 2, MOST_STUDS),
        ("studs along y", studs[1], 2, MOST_STUDS),
        ("bricks", bricks, 1, MOST_BRICKS),
    ):
        if not low <= value <= high:
            raise LimitError.instead(f"{value} {what}", value, f"{low} to {high}")
    return Brickwork(studs, bricks)


def tubes_at(work: Brickwork) -> FloatArray:
    """Compute the axes of the tubes inside the bricks, (t, 2) [mm]."""
    pitch = work.measures["stud_pitch_mm"]
    x, y = ((np.arange(n - 1) - (n - 2) / 2.0) * pitch for n in work.studs)
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def seats_of(work: Brickwork, radius_mm: float) -> Seats:
    """List every seat for beads of this radius, lowest brick first.

    Seats are on the half-stud grid and at the walls, clear of the tubes; at the walls on
    three levels, elsewhere under the roof.

    Args:
        work: the stack.
        radius_mm: of the beads.

    Returns:
        Places (m, 3) [mm, object frame], and the brick of each.

    Raises:
        LimitError: no bead of that radius fits.
    """
    v = work.measures
    half = np.asarray(work.size_mm[:2]) / 2.0 - v["wall_mm"] - radius_mm
    step = v["stud_pitch_mm"] / 2.0
    roof = v["brick_height_mm"] - v["roof_mm"] - radius_mm
    levels = (v["stud_height_mm"] + radius_mm, v["brick_height_mm"] / 2.0, roof)
    along: list[FloatArray] = []
    for n, h in zip(work.studs, half, strict=True):
        pitched = np.arange(1 - n, n) * step  # those inside the walls, and the walls
        along.append(np.append(pitched[np.abs(pitched) <= h + 1e-9], [-h, h]))
    rows: list[tuple[float, float, float]] = []
    for x in along[0]:
        for y in along[1]:
            at_wall = math.isclose(abs(x), half[0]) or math.isclose(abs(y), half[1])
            near = np.linalg.norm(tubes_at(work) - [x, y], axis=1)
            if (near < v["tube_outer_diameter_mm"] / 2.0 + radius_mm - 1e-9).any():
                continue
            rows += [
                (float(x), float(y), z) for z in (levels if at_wall else levels[-1:])
            ]
    if not rows or roof < levels[0]:
        raise LimitError(
            f"a bead of radius {radius_mm:g} mm does not fit into the cavity of a brick",
            {
                "asked": radius_mm,
                "allowed": (roof + radius_mm - v["stud_height_mm"]) / 2.0,
            },
        )
    local = np.array(rows)
    count = len(rows)
    places = np.concatenate(
        [local + [0.0, 0.0, work.floor(b)] for b in range(work.bricks)]
    )
    return Seats(places, np.repeat(np.arange(work.bricks), count))


def stack_phantom(
    work: Brickwork,
    name: str,
    beads: npt.ArrayLike,
    radius_mm: float,
    bead_material: str = "steel",
) -> Phantom:
    """Build the phantom of a stack with beads on its seats.

    Args:
        work: the stack.
        name: of the phantom.
        beads: (k, 3) centers, each within 1e-6 mm of a seat [mm, object frame].
        radius_mm: of every bead.
        bead_material: of every bead.

    Raises:
        PhantomError: a bead is on no seat.
    """
    centers = np.asarray(beads, dtype=np.float64).reshape(-1, 3)
    seats = seats_of(work, radius_mm)
    for k, center in enumerate(centers):
        if np.linalg.norm(seats.places - center, axis=1).min() > 1e-6:
            raise PhantomError(
                f"bead {k} at {center.tolist()} mm is not on a seat of the stack",
                {"bead": k, "asked": center.tolist()},
            )
    assumed = lego_data()["assumed"]
    plastic = material(assumed["material"])
    metal = material(bead_material)
    return Phantom(
        name,
        f"{work.bricks} hollow {work.studs[0]} x {work.studs[1]} LEGO bricks of "
        f"{plastic.name} with {len(centers)} {metal.name} beads of {2 * radius_mm:g} mm "
        "diameter where they determine most",
        work.scene(centers, radius_mm, metal),
        work.size_mm,
        centers,
        np.full(len(centers), radius_mm),
        tuple(
            f"{k} = {v}"
            for k, v in assumed.items()
            if not k.startswith(("bead_h", "spir"))
        ),
    )


def grid_seats(size_mm: Sequence[float], radius_mm: float, step_mm: float) -> FloatArray:
    """Make a grid of centers (m, 3) of beads inside a cuboid about the origin that may
    touch its faces [mm]; its step is about `step_mm`, with at least two centers along
    each axis.

    Raises:
        LimitError: the cuboid is smaller than a bead.
    """
    half = np.asarray(size_mm, dtype=np.float64) / 2.0 - radius_mm
    if not (half >= 0).all():
        raise LimitError(
            f"a bead of radius {radius_mm:g} mm does not fit into {list(size_mm)} mm",
            {"asked": radius_mm, "allowed": float(min(size_mm)) / 2.0},
        )
    axes = [np.linspace(-h, h, max(2, round(2.0 * h / step_mm) + 1)) for h in half]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
