"""Scans with one fault each, drawn: where every ball's shadow really is, and what is believed.

The laboratory is written out here with rotations, rays and conics of its own. The centre of a
ball's outline is found from points of it: the circle at which rays touch the ball is projected,
and the conic through those points has the centre. `causes_named` calibrates the scans.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Rng = np.random.Generator

PIXEL: Final = 0.1496
SHAPE: Final = (760, 956)
SIX: Final = ("dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z")
RANGE: Final = {
    "dO_x": 4.0,
    "dO_y": 4.0,
    "dO_z": 12.0,
    "alpha": 180.0,
    "tau_x": 2.0,
    "tau_z": 2.0,
}


@dataclass(frozen=True)
class Machine:
    """A scanner.

    Attributes:
        pixel: [mm].
        shape: (rows, cols) of the panel.
        sod, sdd: least and largest [mm].
        scale: of phantoms, of their places and of what object and source move by, against
            those that are drawn for FleX-ray.
    """

    pixel: float = PIXEL
    shape: tuple[int, int] = SHAPE
    sod: tuple[float, float] = (540.0, 640.0)
    sdd: tuple[float, float] = (1000.0, 1100.0)
    scale: float = 1.0


FLEX_RAY: Final = Machine()
PANELS: Final[Mapping[str, Machine]] = {
    "flexray": FLEX_RAY,
    "fine": Machine(0.075, (1520, 1912)),
    "demonstration": Machine(0.2992, (380, 478)),
    "coarse": Machine(0.6, (190, 239)),
    "micro": Machine(0.075, (1520, 1912), sod=(27.0, 32.0), scale=0.05),
}
"""Machines by name: the usual one, others of other pixels, and one of a magnification of 36."""
TOUCHING: Final = 8
"""Points of an outline that are projected."""


@dataclass(frozen=True, eq=False)
class World:
    """What is really there.

    Attributes:
        beads, radii: (k, 3), (k,) of the balls that cast shadows [mm].
        offsets: of the scanner [mm, deg]; a value or one for each frame.
        angles: (n,) of the stage [deg].
        spot: (n, 3) of the focal spot [mm].
        shown: (n, k) balls that are in the images.
        sod, sdd, pixel: [mm].
        arc: the object turns by so much while a frame is exposed [deg].
        size: (n,) of the phantom in each frame, as a factor; None: it stays.
        pitch: the stage rises by so much a turn [mm].
        shape: (rows, cols) of the panel.
        scale: see `Machine`.
        rows_turn: the object turns by so much between the readings of the first and the last
            row of a frame, whose angle is that of the middle row [deg].
        loose: (n, k, 3) of the balls from their places in each frame [mm]; None: they stay.
    """

    beads: Array
    radii: Array
    offsets: Mapping[str, float | Array]
    angles: Array
    spot: Array
    shown: npt.NDArray[np.bool_]
    sod: float
    sdd: float
    pixel: float = PIXEL
    arc: float = 0.0
    size: Array | None = None
    pitch: float = 0.0
    shape: tuple[int, int] = SHAPE
    scale: float = 1.0
    rows_turn: float = 0.0
    loose: Array | None = None


@dataclass(frozen=True, eq=False)
class Believed:
    """What calibration is told; `arc` is the part of a step that an exposure lasts, if anybody
    says it, `pitch` the stage's rise a turn [mm]."""

    beads: Array
    radii: Array
    angles: Array
    sod: float
    sdd: float
    pixel: float = PIXEL
    free: tuple[str, ...] = SIX
    held: Mapping[str, float] = field(default_factory=dict)
    priors: Mapping[str, float] = field(default_factory=dict)
    arc: float | None = None
    pitch: float = 0.0

    @property
    def step(self) -> float:
        """Angle between frames [deg]."""
        return float(self.angles[1] - self.angles[0])


@dataclass(frozen=True, eq=False)
class Faulty:
    """A scan with a fault.

    Attributes:
        spots: of each frame (m, 3): column, row, radius [px]; None where the frame is missing.
        truth: of each parameter, the least and the largest value it had [mm, deg]; of roll and
            tilt also with the turn of `turned_by_travel`.
        names: patterns of which each must be found in what is said.
        beside: patterns of what may be said, too.
        silent: to be offered and right without a word is right.
        after: what was done to the spots of the frames, if anything.
        image: `in_images` of the world; where something moves, of its mean over the frames.
        image_ends: their least and largest value in any frame, where something moves.
        pixel: its pixels [mm].
    """

    spots: list[Array | None]
    believed: Believed
    truth: Mapping[str, tuple[float, float]]
    names: tuple[str, ...]
    beside: tuple[str, ...]
    silent: bool
    noise_px: float
    shape: tuple[int, int] = SHAPE
    after: Callable[[list[Array | None]], list[Array | None]] | None = None
    image: Mapping[str, float] = field(default_factory=dict)
    image_ends: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    pixel: float = PIXEL


def frames_of(world: World) -> list[World]:
    """Return the world as it is in each frame, or once if nothing but the stage moves."""
    n = len(world.angles)
    moves = np.ptp(world.spot, axis=0).any()
    moves = moves or any(np.ptp(np.ravel(v)) > 0 for v in world.offsets.values())
    if not moves:
        return [world]
    each = {name: np.broadcast_to(value, (n,)) for name, value in world.offsets.items()}
    return [
        replace(
            world,
            offsets={name: float(value[i]) for name, value in each.items()},
            spot=world.spot[i : i + 1],
        )
        for i in range(n)
    ]


def in_images(world: World) -> dict[str, float]:
    """Compute "axis_column", of the axis in the middle row [px], and "magnification" of a
    short line on the axis along the panel's rows, of the mean place over the frames, at
    the first angle.
    """
    still = {n: float(np.mean(v)) for n, v in world.offsets.items()}
    tau = np.array([still.get("tau_x", 0.0), still.get("tau_z", 0.0), 0.0])
    reach = 0.5 * world.scale
    points = tau + np.array(
        [
            [0, 0, 9.0 * world.scale],
            [0, 0, -9.0 * world.scale],
            [reach, 0, 0],
            [-reach, 0, 0],
            [0, reach, 0],
            [0, -reach, 0],
        ]
    )
    first = replace(
        world, beads=points, radii=np.full(6, 1e-4 * world.scale), offsets=still,
        angles=world.angles[:1], spot=world.spot.mean(axis=0, keepdims=True),
        shown=np.ones((1, 6), dtype=bool), arc=0.0, size=None,
        rows_turn=0.0, loose=None,
    )  # fmt: skip
    ((up, down, *ends),) = shadows(first)[0]
    middle = (world.shape[0] - 1) / 2
    column = down[0] + (up[0] - down[0]) * (middle - down[1]) / (up[1] - down[1])
    # A horizontal line that the panel shows along its rows, of the two that were projected.
    turn = math.radians(float(world.angles[0]) + still.get("alpha", 0.0))
    along = math.cos(turn) * (ends[0] - ends[1]) + math.sin(turn) * (ends[2] - ends[3])
    return {"axis_column": float(column), "magnification": float(np.linalg.norm(along))
            * world.pixel / (2 * reach)}  # fmt: skip


def turned_by_travel(world: World) -> float:
    """Compute the turn about the beam of another scanner, whose stage rises straight and which
    shows what this one does, whose stage goes aside as it rises in a helix [deg].
    """
    rise = world.pitch / 360.0 * world.angles
    aside = np.broadcast_to(world.offsets.get("dO_x", 0.0), rise.shape)
    if not world.pitch or not np.ptp(aside):
        return 0.0
    return -math.degrees(math.atan(np.polyfit(rise, aside, 1)[0]))


def shadows(world: World) -> tuple[Array, Array]:
    """Compute the outlines of the balls' shadows, as means over each exposure.

    The source is near the origin, the beam along +y, z up; a growing angle turns the
    object clockwise seen from above. An outline is the conic through TOUCHING rays that
    touch the ball.

    Returns:
        Centres (n, k, 2), and least distances of centre and outline (n, k) [px].
    """
    if world.rows_turn:
        return _read_by_rows(world)
    if world.arc:
        # Legendre's points and weights of an even turn.
        points, weights = np.polynomial.legendre.leggauss(9)
        some = [
            shadows(replace(world, angles=world.angles + 0.5 * world.arc * p, arc=0.0))
            for p in points
        ]
        both = [
            sum(w * part[i] for w, part in zip(weights / 2, some, strict=True))
            for i in (0, 1)
        ]
        return np.asarray(both[0]), np.asarray(both[1])
    n = len(world.angles)

    def of(name: str) -> Array:
        return np.broadcast_to(
            np.asarray(world.offsets.get(name, 0.0), dtype=float), (n,)
        )

    zero = np.zeros(n)
    tau = np.stack([of("tau_x"), of("tau_z"), zero], axis=1)
    rise = world.pitch / 360.0 * world.angles
    foot = np.stack([of("dO_x"), world.sod + of("dO_z"), of("dO_y") + rise], axis=1) + tau
    spin = Rotation.from_rotvec(
        np.outer(-np.radians(world.angles + of("alpha")), [0, 0, 1])
    )
    lean = Rotation.from_rotvec(np.outer(np.radians(of("axis_tilt_z")), [0, 1, 0]))
    lean = lean * Rotation.from_rotvec(np.outer(np.radians(of("axis_tilt_x")), [1, 0, 0]))
    steps = np.tile(world.pixel * np.array([[1.0, 0, 0], [0, 0, -1.0]]), (n, 1, 1))
    for name, about in (("det_yaw", 1), ("det_pitch", 0), ("det_roll", 2)):
        axis = np.cross(steps[:, 0], steps[:, 1]) if about == 2 else steps[:, about]
        axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        turn = Rotation.from_rotvec(np.radians(of(name))[:, None] * axis)
        steps = np.stack([turn.apply(steps[:, 0]), turn.apply(steps[:, 1])], axis=1)
    panel = (
        np.stack([of("dD_x"), world.sdd + of("dD_z"), of("dD_y")], axis=1) - world.spot
    )
    centres = np.empty((n, len(world.beads), 2))
    radii = np.empty((n, len(world.beads)))
    round_ = 2 * math.pi * np.arange(TOUCHING) / TOUCHING
    for i in range(n):
        beads = world.beads * (1.0 if world.size is None else world.size[i])
        if world.loose is not None:
            beads = beads + world.loose[i]
        at = lean[i].apply(spin[i].apply(beads - tau[i])) + foot[i] - world.spot[i]
        inverse = np.linalg.inv(np.stack([panel[i], *steps[i]], axis=1))
        for k, (ball, r) in enumerate(zip(at, world.radii, strict=True)):
            d2 = ball @ ball
            side = np.cross(ball, [0, 0, 1.0])
            side /= np.linalg.norm(side)
            up = np.cross(side, ball) / math.sqrt(d2)
            wide = r * math.sqrt(1 - r * r / d2)
            touch = ball * (1 - r * r / d2) + wide * (
                np.outer(np.cos(round_), side) + np.outer(np.sin(round_), up)
            )
            s, a, b = inverse @ touch.T
            u, v = a / s, b / s
            # u^2 + B u v + C v^2 + D u + E v + F = 0, of which the gradient vanishes in the
            # middle
            mu, mv = u.mean(), v.mean()
            p, q = u - mu, v - mv
            rows = np.stack([p * q, q * q, p, q, np.ones_like(p)], axis=1)
            (bb, cc, dd, ee, _), *_ = np.linalg.lstsq(rows, -p * p, rcond=None)
            middle = np.linalg.solve([[2, bb], [bb, 2 * cc]], [-dd, -ee])
            centres[i, k] = middle + [mu, mv]
            radii[i, k] = np.sqrt((p - middle[0]) ** 2 + (q - middle[1]) ** 2).min()
    rows, cols = world.shape
    return centres + [(cols - 1) / 2, (rows - 1) / 2], radii


def _read_by_rows(world: World) -> tuple[Array, Array]:
    """Compute shadows of which each is where it is when its own row is read: the time of the
    row follows from the place, and the place from the time, by iteration.
    """
    late = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    some = [
        shadows(replace(world, angles=world.angles + t * world.rows_turn, rows_turn=0.0))
        for t in late
    ]
    places = np.stack([centres for centres, _ in some])
    when = np.zeros(places.shape[1:3])
    for _ in range(6):
        # Lagrange's polynomial through the five.
        weights = np.array(
            [
                np.prod([(when - b) / (a - b) for b in late if b != a], axis=0)
                for a in late
            ]
        )
        here = np.einsum("tnk,tnkc->nkc", weights, places)
        when = here[..., 1] / (world.shape[0] - 1) - 0.5
    return here, some[2][1]


def phantom(rng: Rng, beads: int) -> Array:
    """Balls in a box of 20 x 20 x 44 mm, apart and without a symmetry, (beads, 3) [mm]."""
    while True:
        out = rng.uniform([-10, -10, -22], [10, 10, 22], size=(beads, 3))
        apart = np.linalg.norm(out[:, None] - out, axis=2)[~np.eye(beads, dtype=bool)]
        if apart.min() > 8 and np.ptp(out[:, 2]) > 25:
            return out


def reshaped(beads: Array, change: Array) -> Array:
    """Map balls, (k, 3), by a matrix (3, 3) that leaves their mean where the file has it: the
    place of a phantom of another shape is that of its balls' mean.
    """
    mean = beads.mean(axis=0)
    return np.asarray(mean + (beads - mean) @ change.T)


@dataclass(frozen=True, eq=False)
class Draft:
    """A scan that a fault may change before and after its shadows are made.

    `slow_px` is the standard deviation of errors of single balls [px] that a frame has
    in common with the one before to a part `slow_part`.
    """

    world: World
    believed: Believed
    noise_px: float
    names: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    silent: bool = False
    after: Callable[[list[Array | None]], list[Array | None]] | None = None
    truth: Mapping[str, float] = field(default_factory=dict)
    slow_px: float = 0.0
    slow_part: float = 0.0


def drawn(kind: str, seed: int, panel: str = "flexray") -> Faulty:
    """Draw a scanner, a phantom and a scan with the fault `kind`, of DRAWS, and compute its
    noisy spots.

    Args:
        kind: of the fault.
        seed: of all draws, together with the kind.
        panel: the machine, of PANELS.

    Returns:
        The scan, with what is believed, the true least and greatest value of each
        parameter, and the expected findings.
    """
    machine = PANELS[panel]
    more = b"" if machine is FLEX_RAY else panel.encode()
    rng = np.random.default_rng([seed, *kind.encode(), *more])
    return taken(DRAWS[kind](right_draft(rng, machine), rng), rng)


def right_draft(rng: Rng, machine: Machine = FLEX_RAY) -> Draft:
    """Draw a scanner, a phantom and a full turn without a fault."""
    n, k = int(rng.choice([24, 36, 60])), int(rng.integers(5, 8))
    beads = phantom(rng, k) * machine.scale
    radii = np.full(k, float(rng.uniform(0.8, 1.5))) * machine.scale
    angles = 360.0 * np.arange(n) / n
    offsets = {name: float(rng.uniform(-r, r)) for name, r in RANGE.items()}
    for name in offsets:
        offsets[name] *= 1.0 if name == "alpha" else machine.scale
    sod, sdd = float(rng.uniform(*machine.sod)), float(rng.uniform(*machine.sdd))
    world = World(
        beads,
        radii,
        offsets,
        angles,
        np.zeros((n, 3)),
        np.ones((n, k), dtype=bool),
        sod,
        sdd,
        machine.pixel,
        shape=machine.shape,
        scale=machine.scale,
    )
    return Draft(
        world,
        Believed(beads, radii, angles, sod, sdd, machine.pixel),
        float(rng.uniform(0.005, 0.04)),
    )


def taken(draft: Draft, rng: Rng) -> Faulty:
    """Compute the noisy spots of a draft.

    Spots beyond the panel are left out, those of a frame are in random order.
    """
    centres, sizes = shadows(draft.world)
    if draft.slow_px > 0:
        centres += draft.slow_px * _slow(rng, centres.shape, draft.slow_part)
    spots: list[Array | None] = []
    for place, size, shown in zip(centres, sizes, draft.world.shown, strict=True):
        rows = np.column_stack([place, size])[shown]
        rows[:, :2] += draft.noise_px * rng.normal(size=(len(rows), 2))
        inside = (rows[:, :2] > 0) & (rows[:, :2] < draft.world.shape[::-1])
        inside = inside.all(axis=1)
        spots.append(rng.permutation(rows[inside]))
    if draft.after is not None:
        spots = draft.after(spots)
    each = [in_images(world) for world in frames_of(draft.world)]
    ends = {n: [image[n] for image in each] for n in each[0]}
    scale = float(np.polyfit(draft.believed.angles, draft.world.angles, 1)[0])
    truth = {
        name: (float(np.min(value)), float(np.max(value)))
        for name, value in {
            "angle_scale": scale, **draft.world.offsets, **draft.truth,
        }.items()
    }  # fmt: skip
    if turned := turned_by_travel(draft.world):
        for name in ("det_roll", "axis_tilt_z"):
            low, high = truth.get(name, (0.0, 0.0))
            truth[name] = low + min(turned, 0.0), high + max(turned, 0.0)
    return Faulty(
        spots,
        draft.believed,
        truth,
        draft.names,
        draft.beside,
        draft.silent,
        draft.noise_px,
        shape=draft.world.shape,
        after=draft.after,
        image=in_images(draft.world),
        image_ends={n: (min(values), max(values)) for n, values in ends.items()},
        pixel=draft.world.pixel,
    )


def _slow(rng: Rng, shape: tuple[int, ...], part: float) -> Array:
    """Draw normal errors of standard deviation 1, correlated along the first axis by `part`
    from one to the next (autoregressive of first order).
    """
    errors = rng.normal(size=shape)
    for before, now in itertools.pairwise(errors):
        now *= math.sqrt(1.0 - part**2)
        now += part * before
    return errors


Fault = Callable[[Draft, Rng], Draft]
UNSEEN: Final = {
    "dD_x": 2.0, "dD_y": 2.0, "dD_z": 1.0, "det_roll": 0.3, "det_pitch": 0.3, "det_yaw": 0.3,
    "axis_tilt_x": 0.1, "axis_tilt_z": 0.1,
}  # fmt: skip
"""How far panel and axis usually are from where they are said to be [mm, deg]."""


def _bent(draft: Draft, rng: Rng, after: Callable[..., list[Array | None]]) -> Draft:
    """Distort the panel by a change of the spots, and move it off its stated place as far
    as is usual; `panel_distorted` is expected.

    Args:
        draft: of the scan; its own offsets stay.
        rng: of the panel's place.
        after: changes the spots of all frames.
    """
    offsets = {name: float(rng.normal(0.0, width)) for name, width in UNSEEN.items()}
    world = replace(draft.world, offsets={**offsets, **draft.world.offsets})
    return replace(draft, world=world, after=after, names=("panel_distorted",),
                   beside=(*OTHERS, "priors_narrow"))  # fmt: skip


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1, 1]))


def _nothing(draft: Draft, rng: Rng) -> Draft:
    return replace(draft, silent=True)


def _slow_errors(draft: Draft, rng: Rng) -> Draft:
    """Let places of balls err slowly by 0.5 to 5 times their noise, each by itself."""
    return replace(
        draft,
        silent=True,
        names=("drift|vibration|bead_errors",),
        slow_px=draft.noise_px * float(rng.uniform(0.5, 5.0)),
        slow_part=float(rng.uniform(0.5, 0.9)),
    )


def _low_dose(draft: Draft, rng: Rng) -> Draft:
    return replace(draft, silent=True, noise_px=float(rng.uniform(0.05, 0.09)))


def _offset(
    name: str, low: float, high: float, *names: str, silent: bool = False
) -> Fault:
    """Make a fault that offsets one parameter from what is stated by `low` to `high` [mm,
    deg], to either side.

    Args:
        name: of the parameter.
        low, high: least and largest offset.
        names: parameters of which any is a right finding; without any, `name`.
        silent: whether no finding is right, too.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the offset, and expect a finding of one of the names."""
        value = _sign(rng) * float(rng.uniform(low, high))
        true = draft.believed.held.get(name, 0.0) + value
        world = replace(draft.world, offsets={**draft.world.offsets, name: true})
        pattern = (f"(held_parameter|priors_narrow).*({'|'.join(names or (name,))})",)
        return replace(draft, world=world, names=pattern, silent=silent)

    return fault


def _varying(draft: Draft, name: str, change: Array) -> Draft:
    if name.startswith("dO"):
        change = change * draft.world.scale
    offsets = {**draft.world.offsets, name: draft.world.offsets.get(name, 0.0) + change}
    return replace(draft, world=replace(draft.world, offsets=offsets))


MOVES: Final = r"drift|moves during the scan"
SHAKES: Final = ("vibration|moves",)
OTHERS: Final = ("vibration", "bead_errors", "drift")
"""May be said beside a motion, which looks like them in part."""


def _drift(name: str, low: float, high: float) -> Fault:
    """Make a fault: a parameter drifts evenly over the scan, by `low` to `high` [mm, deg]
    in all, to either side.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the drift, and expect a finding of a drift of that parameter."""
        n = len(draft.world.angles)
        size = _sign(rng) * float(rng.uniform(low, high))
        draft = _varying(draft, name, size * np.linspace(0, 1, n))
        return replace(draft, names=(rf"({MOVES}).*", name), beside=OTHERS)

    return fault


def _jump(name: str, low: float, high: float) -> Fault:
    """Make a fault: a parameter jumps by `low` to `high` [mm, deg], to either side, in
    the middle half of the scan.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw frame and size of the jump, and expect a finding of motion (or, of alpha,
        of an angle step).
        """
        n = len(draft.world.angles)
        at = int(rng.integers(n // 4, 3 * n // 4))
        size = _sign(rng) * float(rng.uniform(low, high))
        draft = _varying(draft, name, size * (np.arange(n) >= at))
        words = r"angle_step|" + MOVES if name == "alpha" else MOVES
        return replace(draft, names=(words,), beside=OTHERS)

    return fault


def _spot_drift(draft: Draft, rng: Rng) -> Draft:
    """Let the focal spot drift aside by 0.05 to 0.3 mm over the scan: it looks like the
    object drifting the other way, and a finding of motion is expected.
    """
    n = len(draft.world.angles)
    way = np.array([_sign(rng) * rng.uniform(0.05, 0.3), 0.0, 0.0]) * draft.world.scale
    world = replace(draft.world, spot=np.linspace(0, 1, n)[:, None] * way)
    # The object seen from a spot that stands still moves by so much; alpha hardly.
    truth = {"dO_x": draft.world.offsets["dO_x"] + np.array([-1.0, 1.0]) * way[0]}
    return replace(draft, world=world, names=(MOVES,), beside=OTHERS, truth=truth)


def _runout(draft: Draft, rng: Rng) -> Draft:
    """Let the axis run out sideways by 0.03 to 0.2 mm, two or three times a turn, and
    expect a finding of motion.
    """
    turn = np.radians(draft.world.angles)
    size = float(rng.uniform(0.03, 0.2))
    periods = int(rng.integers(2, 4))
    phase = float(rng.uniform(0, 6.28))
    draft = _varying(draft, "dO_x", size * np.sin(periods * turn + phase))
    return replace(draft, names=(MOVES,), beside=OTHERS)


def _screw(draft: Draft, rng: Rng) -> Draft:
    """Let the object rise evenly by 0.3 to 1.5 mm over the scan, and expect findings of
    motion and of dO_y.
    """
    draft = _varying(
        draft, "dO_y", rng.uniform(0.3, 1.5) * np.linspace(0, 1, len(draft.world.angles))
    )
    return replace(draft, names=(MOVES, "dO_y"), beside=OTHERS)


def _wobble(draft: Draft, rng: Rng) -> Draft:
    """Lean the axis to and fro by 0.1 to 0.4 deg, twice a turn, and expect a finding of
    wobble or motion.
    """
    turn = np.radians(draft.world.angles)
    size = float(rng.uniform(0.1, 0.4))
    draft = _varying(draft, "axis_tilt_z", size * np.sin(2 * turn))
    return replace(draft, names=("wobble|" + MOVES,), beside=OTHERS)


def _vibration(draft: Draft, rng: Rng) -> Draft:
    """Shift every frame at random along columns and rows, by 0.02 to 0.08 mm rms each,
    and expect a finding of shaking.
    """
    size = float(rng.uniform(0.02, 0.08))
    n = len(draft.world.angles)
    for name in ("dO_x", "dO_y"):
        draft = _varying(draft, name, size * rng.normal(size=n))
    return replace(draft, names=SHAKES, beside=OTHERS)


def _angles(
    change: Callable[[Array, Rng], Array], *names: str, beside: tuple[str, ...] = ()
) -> Fault:
    """Make a fault: the stage's angles are those that `change` makes of the stated ones.

    Args:
        change: (angles [deg], generator) -> angles.
        names: patterns of the expected findings.
        beside: patterns of findings that are allowed, too.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the angles of the stage."""
        angles = change(draft.world.angles, rng)
        return replace(
            draft, world=replace(draft.world, angles=angles), names=names, beside=beside
        )

    return fault


def _gap(angles: Array, rng: Rng) -> Array:
    """Frames are missing in the middle, and the others were numbered on."""
    n = len(angles)
    at, gap = int(rng.integers(n // 4, 3 * n // 4)), int(rng.integers(1, 4))
    return angles + (angles[1] - angles[0]) * gap * (np.arange(n) >= at)


def _stuttered(draft: Draft, rng: Rng) -> Draft:
    """Replace at least two frames, and a twelfth of them, by the one before, as a camera
    that stutters, and expect `frames_repeated`.
    """
    n = len(draft.world.angles)
    again = rng.choice(np.arange(1, n), size=max(2, n // 12), replace=False)

    def after(spots: list[Array | None]) -> list[Array | None]:
        """Replace the spots of these frames by those of the frame before."""
        for i in sorted(again.tolist()):
            spots[i] = spots[i - 1]
        return spots

    return replace(draft, after=after, names=("frames_repeated",))


def _missing_frames(draft: Draft, rng: Rng) -> Draft:
    """Remove each frame with a chance of a fifth, at least one, and expect
    `frames_missing`.
    """
    gone = rng.random(len(draft.world.angles)) < 0.2
    gone[int(rng.integers(len(gone)))] = True

    def after(spots: list[Array | None]) -> list[Array | None]:
        return [None if g else s for s, g in zip(spots, gone.tolist(), strict=True)]

    return replace(draft, after=after, names=("frames_missing",))


def _swapped_frames(draft: Draft, rng: Rng) -> Draft:
    """Swap the spots of two frames that are a quarter to half of a turn apart, and expect
    `frames_inconsistent` with one of their numbers.
    """
    n = len(draft.world.angles)
    a = int(rng.integers(0, n - 1))
    b = (a + int(rng.integers(n // 4, n // 2))) % n

    def after(spots: list[Array | None]) -> list[Array | None]:
        spots[a], spots[b] = spots[b], spots[a]
        return spots

    return replace(draft, after=after, names=(rf"frames_inconsistent.*\b({a}|{b})\b",))


def _beads(
    draft: Draft, beads: Array, *names: str, beside: tuple[str, ...] = ()
) -> Draft:
    """Replace the balls that cast shadows by others of the same radius, all of them in
    every frame.

    Args:
        draft: of the scan.
        beads: (k, 3) [mm].
        names: patterns of the expected findings.
        beside: patterns of findings that are allowed, too.
    """
    radii = np.full(len(beads), draft.world.radii[0])
    shown = np.ones((len(draft.world.angles), len(beads)), dtype=bool)
    world = replace(draft.world, beads=beads, radii=radii, shown=shown)
    return replace(draft, world=world, names=names, beside=beside)


def _lost(count: int) -> Fault:
    """Make a fault: `count` of the beads are missing."""

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the missing beads, and expect them to be named."""
        k = len(draft.world.beads)
        gone = np.sort(rng.choice(k, size=count, replace=False))
        kept = np.delete(draft.world.beads, gone, axis=0)
        return _beads(draft, kept, f"beads_missing.*bead {', '.join(map(str, gone))} ")

    return fault


def _extra(draft: Draft, rng: Rng) -> Draft:
    """Add one or two balls to the beads, and expect `extra_spots`."""
    more = rng.uniform([-10, -10, -22], [10, 10, 22], size=(int(rng.integers(1, 3)), 3))
    beads = np.concatenate([draft.world.beads, more * draft.world.scale])
    return _beads(draft, beads, "extra_spots", beside=OTHERS)


def _displaced(draft: Draft, rng: Rng) -> Draft:
    """Displace one bead by 0.3 to 1.5 mm, and expect a finding of its displacement or
    tolerance.
    """
    beads = draft.world.beads.copy()
    one = int(rng.integers(len(beads)))
    way = rng.normal(size=3)
    beads[one] += way / np.linalg.norm(way) * rng.uniform(0.3, 1.5) * draft.world.scale
    return _beads(
        draft, beads, rf"(bead_displaced|bead_tolerance).*\b{one}\b", beside=OTHERS
    )


def _tolerance(draft: Draft, rng: Rng) -> Draft:
    """Displace all beads at random, by 0.03 to 0.1 mm rms along each axis, and expect a
    finding of the beads' tolerance or errors.
    """
    width = rng.uniform(0.03, 0.1) * draft.world.scale
    beads = draft.world.beads + width * rng.normal(size=draft.world.beads.shape)
    return _beads(
        draft, beads, "bead_tolerance|bead_errors", beside=(*OTHERS, "bead_displaced")
    )


def _tolerance_and_roll(draft: Draft, rng: Rng) -> Draft:
    """Displace all beads as `_tolerance` and roll the detector by 2 to 3 deg, and expect
    a finding of either.
    """
    draft = _tolerance(draft, rng)
    roll = _sign(rng) * float(rng.uniform(2.0, 3.0))
    world = replace(draft.world, offsets={**draft.world.offsets, "det_roll": roll})
    return replace(
        draft, world=world,
        names=("bead_tolerance|bead_errors", r"(held_parameter|priors_narrow).*det_roll"),
    )  # fmt: skip


def _other_phantom(draft: Draft, rng: Rng) -> Draft:
    other = phantom(rng, len(draft.world.beads)) * draft.world.scale
    return _beads(draft, other, "wrong_phantom")


def _mirror_image(draft: Draft, rng: Rng) -> Draft:
    return _beads(draft, draft.world.beads * [-1.0, 1.0, 1.0], "mirrored_phantom")


def _upside_down_phantom(draft: Draft, rng: Rng) -> Draft:
    """Put on its head: turned about a horizontal axis, so not mirrored."""
    return _beads(draft, draft.world.beads * [1.0, -1.0, -1.0], "phantom_upside_down")


def _other_radius(draft: Draft, rng: Rng) -> Draft:
    factor = float(rng.choice([0.7, 1.35]))
    world = replace(draft.world, radii=draft.world.radii * factor)
    return replace(draft, world=world, names=("bead_size",))


def _other_scale(draft: Draft, rng: Rng) -> Draft:
    """Its balls are further apart or nearer than believed, but of the right size."""
    factor = float(rng.choice([0.75, 1.3]))
    return _beads(draft, draft.world.beads * factor, "bead_size|another scale")


def _one_bead(draft: Draft, rng: Rng) -> Draft:
    return _beads(draft, draft.world.beads[:1], "one_bead")


def _no_beads(draft: Draft, rng: Rng) -> Draft:
    world = replace(draft.world, shown=np.zeros_like(draft.world.shown))
    return replace(draft, world=world, names=("no_beads",))


def _symmetric(draft: Draft, rng: Rng) -> Draft:
    """Replace the phantom, also the believed one, by two rings of four balls, which look
    the same after a quarter of a turn, and expect `ambiguous`.
    """
    quarter = 0.5 * math.pi * np.arange(4)
    ring = 9.0 * np.stack([np.cos(quarter), np.sin(quarter), 0 * quarter], axis=1)
    beads = np.concatenate([ring - [0, 0, 14.0], ring + [0, 0, 14.0]]) * draft.world.scale
    draft = _beads(draft, beads, "ambiguous")
    return replace(
        draft,
        believed=replace(draft.believed, beads=beads, radii=draft.world.radii),
    )


def _flipped(axes: tuple[int, ...], *names: str) -> Fault:
    """Make a fault: images are mirrored along some axes.

    Args:
        axes: 0 for columns, 1 for rows.
        names: patterns of the expected findings.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Mirror all spots along the axes."""

        def after(spots: list[Array | None]) -> list[Array | None]:
            """Mirror the spots of all frames, in place."""
            for s in spots:
                assert s is not None
                for a in axes:
                    s[:, a] = draft.world.shape[1 - a] - 1 - s[:, a]
            return spots

        return replace(draft, after=after, names=names)

    return fault


def _distorted(terms: str) -> Fault:
    """Make a fault that distorts the panel's image smoothly, by 0.3 to 1 px at 0.64 of the
    way from its middle to its sides.

    Args:
        terms: "radial", "decentred", or else any polynomial of second and third order.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the distortion's size and coefficients."""
        rows, cols = draft.world.shape
        half = np.array([(cols - 1) / 2, (rows - 1) / 2])
        unit = 305.0 * cols / SHAPE[1]
        size = float(_sign(rng) * rng.uniform(0.3, 1.0))
        one, two = rng.normal(size=2) / math.sqrt(2)
        bent = rng.normal(size=(2, 7))

        def shift(x: Array, y: Array) -> Array:
            """Compute the shift (m, 2) at places x, y from the middle, in that unit."""
            square = x * x + y * y
            if terms == "radial":
                return np.stack([x * square, y * square], axis=1)
            if terms == "decentred":
                across = one * (square + 2 * x * x) + 2 * two * x * y
                return np.stack(
                    [across, two * (square + 2 * y * y) + 2 * one * x * y], axis=1
                )
            powers = [x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
            return np.asarray((bent @ np.array(powers)).T / 2)

        def after(spots: list[Array | None]) -> list[Array | None]:
            """Shift the spots of all frames, in place."""
            for s in spots:
                assert s is not None
                x, y = ((s[:, :2] - half) / unit).T
                s[:, :2] += size * shift(x, y)
            return spots

        return _bent(draft, rng, after)

    return fault


def _tiles_apart(draft: Draft, rng: Rng) -> Draft:
    """Move two tiles of the panel apart by 0.5 to 2 px, which the image leaves out."""
    axis = int(rng.integers(2))
    border = draft.world.shape[1 - axis] * rng.uniform(0.4, 0.6)
    gap = rng.uniform(0.5, 2.0)

    def after(spots: list[Array | None]) -> list[Array | None]:
        """Shift the spots beyond the border, in place."""
        for s in spots:
            assert s is not None
            s[:, axis] -= np.where(s[:, axis] > border, gap, 0.0)
        return spots

    return _bent(draft, rng, after)


def _row_offset(draft: Draft, rng: Rng) -> Draft:
    """Shift all images by 2 to 7 rows, as if the panel were higher or lower: dD_y is so
    much then, and no finding is right, too.
    """
    rows = int(_sign(rng) * rng.integers(2, 8))

    def after(spots: list[Array | None]) -> list[Array | None]:
        """Shift the rows of all spots, in place."""
        for s in spots:
            assert s is not None
            s[:, 1] += rows
        return spots

    return replace(
        draft, after=after, silent=True, truth={"dD_y": rows * draft.world.pixel}
    )


def _binned(draft: Draft, rng: Rng) -> Draft:
    """Change the pixels' true size to half or 1.6 times the stated one, and expect a
    finding of beads' sizes, no beads, an implausible offset, a wrong radius, or other pixels
    (of 1.6 times the size without a usual reason, which would be another size).
    """
    factor = float(rng.choice([0.5, 1.6]))
    pixels = (
        "(the pixels are half|[^:]*or other pixels)" if factor < 1 else "or other pixels"
    )
    return replace(
        draft,
        world=replace(draft.world, pixel=draft.world.pixel * factor),
        names=(
            f"bead_size|no_beads|implausible_offset|wrong_phantom.*(radius|{pixels})",
        ),
    )


def _held(name: str, low: float, high: float) -> Fault:
    """Make a fault: one of the six is stated as exactly known, but off by `low` to `high`
    [mm, deg].
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the error, and hold the parameter."""
        off = _sign(rng) * math.exp(rng.uniform(math.log(low), math.log(high)))
        off *= draft.world.scale
        value = draft.world.offsets[name]
        assert isinstance(value, float)
        believed = replace(
            draft.believed,
            free=tuple(n for n in SIX if n != name),
            held={name: value - off},
            priors={name: 0.0},
        )
        return replace(
            draft, believed=believed, names=(f"(held_parameter|held_unchecked).*{name}",)
        )

    return fault


def _held_zero(*names: str) -> Fault:
    """Make a fault: an offset of the scanner, one of `names`, is stated as exactly 0, but
    is 0.2 to 2 mm or deg.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the offset and its size."""
        name = names[int(rng.integers(len(names)))]
        value = _sign(rng) * float(rng.uniform(0.2, 2.0))
        world = replace(draft.world, offsets={**draft.world.offsets, name: value})
        believed = replace(draft.believed, priors={name: 0.0})
        pattern = f"(held_parameter|held_unchecked).*{name}"
        return replace(draft, world=world, believed=believed, names=(pattern,))

    return fault


def usual(draft: Draft, rng: Rng) -> Draft:
    """Panel and axis are not exactly where they are said to be, as usual."""
    offsets = {name: float(rng.normal(0.0, width)) for name, width in UNSEEN.items()}
    world = replace(draft.world, offsets={**offsets, **draft.world.offsets})
    return replace(draft, world=world, beside=("priors_narrow",))


STRAIN: Final = 1e-3
"""Of what every phantom is strained by, and its scale is off by."""
PITCH: Final = 3e-6
"""Of the pixel pitch over the told one."""


def _of_lengths(draft: Draft, rng: Rng, scale: float) -> Draft:
    """Draw the pixel pitch, and state it and the phantom's scale as true lengths over the told
    ones. The generator's later draws stay as they are.
    """
    pitch = PITCH * float(rng.spawn(1)[0].normal())
    world = replace(draft.world, pixel=draft.world.pixel * (1.0 + pitch))
    return replace(draft, world=world, truth={"phantom": scale, "pixel": pitch})


def _right(draft: Draft, rng: Rng) -> Draft:
    """Draw a phantom and a scanner within their assumed tolerances: the phantom's scale,
    and each of its strains, to 0.1 % rms; findings of strain or narrow priors are
    allowed, none is right, too.
    """
    draft = usual(draft, rng)
    scale = STRAIN * float(rng.normal())
    change = (1.0 + scale) * np.eye(3) + STRAIN * rng.normal(size=(3, 3))
    world = replace(draft.world, beads=reshaped(draft.world.beads, change))
    draft = _of_lengths(replace(draft, world=world), rng, scale)
    return replace(draft, silent=True, names=("phantom_strained|priors_narrow",))


CAUSE_ODDS: Final = 0.1
"""Of each cause, present to absent, as the calibration assumes them; so are the widths here."""
STRAIN_WIDTHS: Final = (2.5e-3, 6e-3, 1.5e-2, 4e-2)
"""Of strains of phantoms of another shape."""
BEAD_SHARES: Final = tuple(2e-4 * 2.0**k for k in range(8))
PANEL_WIDTHS_PX: Final = tuple(0.004 * 2.5**k for k in range(9))
GAP_WIDTHS_PX: Final = (0.1, 0.5, 2.0, 8.0)
LEAST_TILE: Final = 1 / 8
LEAST_SIDE: Final = 4
MAY_MOVE: Final = ("dO_x", "dO_y", "dO_z", "alpha")
MOTION_SIGMAS: Final = (1.0, 4.0, 16.0, 64.0)
MOTION_SHAPES: Final = 8
ARC_WIDTH: Final = 0.5
"""Of the squared share of a step that an exposure lasts, which is never negative."""


def _with_causes(moving: bool) -> Fault:
    """Make a draw of a phantom and a scanner as `as_assumed`, in which each cause that a
    calibration looks for occurs as often and as large as it assumes.

    Args:
        moving: whether the causes include motion. A moving parameter's true value is its mean.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the causes; no finding is right, and so is any."""

        def width(*some: float) -> float:
            """Draw whether a cause is there, and its width; 0 without it."""
            there = rng.uniform() < CAUSE_ODDS / (1.0 + CAUSE_ODDS)
            pick = float(rng.choice(some))
            return pick if there else 0.0

        draft = usual(draft, rng)
        beads = draft.world.beads
        wide = width(*STRAIN_WIDTHS)
        shear = width(*STRAIN_WIDTHS) or STRAIN
        change = shear * rng.normal(size=(3, 3))
        np.fill_diagonal(change, (wide or STRAIN) * rng.normal(size=3))
        common = float(rng.normal())
        # The scale that wide stretches share is theirs, beside the file's own.
        scale = STRAIN * (float(rng.spawn(1)[0].normal()) if wide else common)
        change += (1.0 + scale + wide * common) * np.eye(3)
        draft = _of_lengths(draft, rng, scale)
        place = width(*BEAD_SHARES) * float(np.ptp(beads, axis=0).max())
        beads = reshaped(beads, change) + place * rng.normal(size=beads.shape)
        arc = math.sqrt(min(width(ARC_WIDTH) * abs(rng.normal()), 1.0))
        bent = width(*PANEL_WIDTHS_PX) * rng.normal(size=16)
        gap = width(*GAP_WIDTHS_PX) * rng.normal(size=2)
        axis = int(rng.integers(2))
        border = draft.world.shape[1 - axis] * rng.uniform(LEAST_TILE, 1.0 - LEAST_TILE)
        world = draft.world
        world = replace(world, beads=beads, arc=arc * 360.0 / len(world.angles))
        truth = {n: float(np.ravel(v)[0]) for n, v in world.offsets.items()}
        truth |= draft.truth
        moved = dict(world.offsets)
        for name in MAY_MOVE if moving else ():
            sizes = (
                width(*MOTION_SIGMAS) * draft.noise_px * rng.normal(size=MOTION_SHAPES)
            )
            if sizes.any():
                moved[name] = truth[name] + _motion(world, name, sizes)

        def after(spots: list[Array | None]) -> list[Array | None]:
            """Shift the spots of all frames by the panel's bend and its gap, in place."""
            rows, cols = draft.world.shape
            middle = [(cols - 1) / 2, (rows - 1) / 2]
            beyond = np.concatenate(
                [s[:, axis] >= border for s in spots if s is not None]
            )
            # Where every spot is on one tile, the panel is where that tile is.
            parted = min(beyond.sum(), (~beyond).sum()) >= LEAST_SIDE
            shift = gap if parted else np.zeros(2)
            for s in spots:
                assert s is not None
                x, y = ((s[:, :2] - middle) / (max(rows, cols) / 2)).T
                powers = np.array([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
                affine = np.array([bent[0] * x + bent[1] * y, bent[1] * x - bent[0] * y])
                smooth = affine + bent[2:].reshape(2, 7) @ powers
                s[:, :2] += smooth.T + np.outer(s[:, axis] >= border, shift)
            return spots

        world = replace(world, offsets=moved)
        return replace(draft, world=world, silent=True, after=after, truth=truth)

    return fault


def _motion(world: World, name: str, sizes: Array) -> Array:
    """Compute the change of a parameter in each frame, (n,) [mm, deg]: a ramp and half
    waves, each of a size that it moves all shadows by together.

    Args:
        world: at rest.
        name: of the parameter.
        sizes: (MOTION_SHAPES,) root sum of squares of the shadows' shifts [px].
    """
    n = len(world.angles)
    place = (np.arange(n) + 0.5) / n
    shapes = [place - 0.5]
    shapes += [np.cos(math.pi * wave * place) for wave in range(1, MOTION_SHAPES)]
    step = 1e-3
    value = world.offsets[name]
    ends = [
        shadows(replace(world, offsets={**world.offsets, name: value + d}))[0]
        for d in (step, -step)
    ]
    slope = np.linalg.norm((ends[0] - ends[1]) / (2.0 * step), axis=2)
    slope = np.sqrt(np.sum(slope**2, axis=1))
    parts = [
        size * shape / float(np.linalg.norm(slope * shape))
        for size, shape in zip(sizes, shapes, strict=True)
    ]
    return np.asarray(sum(parts))


def _strained(kind: str) -> Fault:
    """Make a fault that strains the phantom against its file by 0.05 to 1 %.

    Args:
        kind: "x", "y", "z", "shear" (in the horizontal plane) or "lean".
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the strain; below 0.3 % silence is right, too."""
        draft = usual(draft, rng)
        size = _sign(rng) * math.exp(rng.uniform(math.log(5e-4), math.log(1e-2)))
        change = np.eye(3)
        i, j = {"x": (0, 0), "y": (1, 1), "z": (2, 2), "shear": (0, 1), "lean": (0, 2)}[
            kind
        ]
        change[i, j] += size
        if kind == "shear":
            change[1, 0] += size
        world = replace(draft.world, beads=reshaped(draft.world.beads, change))
        # What is within three sigmas of what is assumed of every phantom need not be said.
        return replace(draft, world=world, names=("phantom_strained|bead_tolerance",),
                       silent=abs(size) < 3e-3)  # fmt: skip

    return fault


def _exposed_long(draft: Draft, rng: Rng) -> Draft:
    """Expose while the stage turns, for 0.1 to 1 of a step, and expect a finding of it;
    below 3 deg silence is right, too.
    """
    draft = usual(draft, rng)
    step = draft.believed.step
    share = float(rng.uniform(0.1, 1.0))
    world = replace(draft.world, arc=share * step)
    return replace(draft, world=world, names=("exposure_arc|turns while a frame is exposed",),
                   silent=share * step < 3.0,
                   beside=(*draft.beside, "causes_open", "phantom_strained"))  # fmt: skip


def _exposed_as_said(draft: Draft, rng: Rng) -> Draft:
    """Expose while the stage turns, with the exposure's length in the script."""
    draft = _exposed_long(draft, rng)
    share = draft.world.arc / draft.believed.step
    return replace(draft, believed=replace(draft.believed, arc=share))


def _rows_in_turn(draft: Draft, rng: Rng) -> Draft:
    """Read the rows one after the other while the stage turns, for 0.05 to 1 of a step, and
    expect a finding of it.
    """
    draft = usual(draft, rng)
    share = math.exp(rng.uniform(math.log(0.05), 0.0)) * _sign(rng)
    world = replace(draft.world, rows_turn=share * draft.believed.step)
    return replace(draft, world=world, names=("rows_in_turn|rows are read one after",),
                   beside=(*draft.beside, "causes_open", "bead_tolerance"))  # fmt: skip


def _renumbered(shift: int) -> Fault:
    """Make a fault: from a frame on, images are those of `shift` frames later, -1 where
    one was doubled, 1 where one was lost.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the frame, and expect it or the one before to be named."""
        draft = usual(draft, rng)
        n = len(draft.world.angles)
        at = int(rng.integers(1, n))
        step = draft.believed.step
        angles = draft.world.angles + step * shift * (np.arange(n) >= at)
        world = replace(draft.world, angles=angles)
        code = "frame_numbers" if at < n - 1 else "frames_inconsistent|frame_numbers"
        return replace(draft, world=world, names=(rf"({code}).*\b({at}|{at - 1})\b",))

    return fault


def _exposed_again(draft: Draft, rng: Rng) -> Draft:
    """Expose one frame at the angle of the one before, and expect `frames_inconsistent`
    with its number.
    """
    draft = usual(draft, rng)
    at = int(rng.integers(1, len(draft.world.angles)))
    angles = draft.world.angles.copy()
    angles[at] = angles[at - 1]
    world = replace(draft.world, angles=angles)
    return replace(draft, world=world, names=(rf"frames_inconsistent.*\b{at}\b",))


def _four_tiles(draft: Draft, rng: Rng) -> Draft:
    """Shift the right tiles of a panel of 2 x 2 along the rows and the lower ones along
    the columns, by 0.3 to 2 px, and each a little across that; `panel_distorted` is
    expected.
    """
    rows, cols = draft.world.shape
    column = cols * rng.uniform(0.42, 0.58)
    row = rows * rng.uniform(0.42, 0.58)
    across, down = (float(_sign(rng) * rng.uniform(0.3, 2.0)) for _ in range(2))
    askew = rng.normal(size=(2, 2)) * 0.1

    def after(spots: list[Array | None]) -> list[Array | None]:
        """Shift the spots of the right and of the lower tiles, in place."""
        for s in spots:
            assert s is not None
            right, low = s[:, 0] > column, s[:, 1] > row
            s[:, 0] += across * right + askew[0, 0] * low
            s[:, 1] += down * low + askew[1, 1] * right
        return spots

    return _bent(draft, rng, after)


def _source_moves(axis: int, low: float, high: float, jumps: bool) -> Fault:
    """Make a fault: the focal spot jumps by `low` to `high` [mm] in the middle half of the
    scan, or drifts evenly; it looks like an object that moves, and a finding of motion is
    expected.

    Args:
        axis: 0: aside, 1: along the beam, 2: up.
        low, high: least and largest way.
        jumps: else it drifts.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the frame and the way."""
        draft = usual(draft, rng)
        n = len(draft.world.angles)
        at = int(rng.integers(n // 4, 3 * n // 4))
        course = (np.arange(n) >= at) if jumps else np.linspace(0.0, 1.0, n)
        way = np.zeros(3)
        way[axis] = _sign(rng) * rng.uniform(low, high) * draft.world.scale
        world = replace(draft.world, spot=course[:, None] * way)
        # Seen from a spot that stands still, all else moves by so much.
        name = ("dO_x", "dO_z", "dO_y")[axis]
        ends = np.array([-1.0, 1.0]) * way[axis]
        truth = {name: draft.world.offsets[name] + ends}
        panel = "dD" + name[2:]
        truth[panel] = draft.world.offsets[panel] + ends
        return replace(draft, world=world, names=(MOVES,), beside=OTHERS, truth=truth)

    return fault


def _usual_jump(name: str, low: float, high: float) -> Fault:
    """Make a fault: a parameter jumps by `low` to `high` [mm, deg] in a scan whose panel
    and axis are not exactly where they are said to be.
    """
    jump = _jump(name, low, high)
    return lambda draft, rng: jump(usual(draft, rng), rng)


def _jumps_twice(draft: Draft, rng: Rng) -> Draft:
    """Let the object jump aside twice by 0.05 to 0.3 mm, there and partly back, in the
    middle three fifths of the scan, and expect a finding of motion.
    """
    draft = usual(draft, rng)
    n = len(draft.world.angles)
    first, second = np.sort(rng.choice(np.arange(n // 5, 4 * n // 5), 2, replace=False))
    course = rng.uniform(0.05, 0.3) * (np.arange(n) >= first)
    course -= rng.uniform(0.05, 0.3) * (np.arange(n) >= second)
    draft = _varying(draft, "dO_x", course)
    return replace(draft, names=(MOVES,), beside=OTHERS)


def _grows(draft: Draft, rng: Rng) -> Draft:
    """Let the phantom grow by 0.05 to 0.7 % during the scan, as one that warms up, and
    expect a finding of growth or motion; dO_z may be that of any frame.
    """
    draft = usual(draft, rng)
    size = float(rng.uniform(5e-4, 7e-3))
    n = len(draft.world.angles)
    # All its lengths, so its distance too, are those of any frame.
    world = replace(draft.world, size=1.0 + size * np.linspace(-0.5, 0.5, n))
    dO_z = draft.world.offsets["dO_z"] + 0.5 * size * draft.world.sod * np.array(
        [-1.0, 1.0]
    )
    return replace(draft, world=world, names=(f"{MOVES}|grows",), beside=OTHERS,
                   truth={"dO_z": dO_z})  # fmt: skip


def _other_pitch(draft: Draft, rng: Rng) -> Draft:
    """Make the true pixels 1 to 8 % larger or smaller than the stated ones, and expect a
    finding of the pixel.
    """
    draft = usual(draft, rng)
    factor = 1.0 + _sign(rng) * rng.uniform(0.01, 0.08)
    world = replace(draft.world, pixel=draft.world.pixel * factor)
    return replace(draft, world=world, names=("pixel",), silent=False)


LOOSE: Final = "beads_moved|moves during the scan"
"""Findings of beads that move against each other; what most of them do is a motion, too."""
COURSES: Final = (
    "at_once", "slowly", "and_back", "relaxing", "two_speeds", "swinging", "briefly",
)  # fmt: skip
"""Ways in which something comes loose."""


def _course(frames: int, how: str, rng: Rng) -> Array:
    """Draw the share of a way that is gone in each frame, (n,): all of it from a frame in
    the middle four fifths on, or evenly from there to the last, or there and back; or ever
    slower, or at two speeds, or swinging to and fro, or away for three to six frames.
    """
    first = int(rng.integers(frames // 10 + 1, frames - frames // 10))
    place = np.arange(frames)
    if how == "at_once":
        return (place >= first) * 1.0
    if how == "briefly":
        last = first + int(rng.integers(3, 7))
        return ((place >= first) & (place < last)) * 1.0
    if how == "and_back":
        last = int(rng.integers(first // 2, first))
        return ((place >= last) & (place < first)) * 1.0
    if how == "swinging":
        waves, late = float(rng.uniform(0.5, 2.5)), float(rng.uniform(0.0, 2.0 * math.pi))
        swing = np.sin(2.0 * math.pi * waves * place / frames + late)
        return np.asarray(swing - swing[0])
    first = first // 2
    gone = np.clip((place - first) / (frames - 1 - first), 0.0, 1.0)
    if how == "relaxing":
        return np.asarray(1.0 - np.exp(-gone / float(rng.uniform(0.05, 0.4))))
    if how == "two_speeds":
        turn, share = rng.uniform(0.2, 0.8, 2).tolist()
        return np.interp(gone, [0.0, turn, 1.0], [0.0, share, 1.0])
    return gone


def _way(rng: Rng, scale: float, least: float = 0.02, most: float = 0.5) -> Array:
    """Draw a displacement of `least` to `most` mm times `scale`, (3,)."""
    way = rng.normal(size=3)
    size = math.exp(rng.uniform(math.log(least), math.log(most)))
    return np.asarray(way * scale * size / np.linalg.norm(way))


def _loosened(draft: Draft, moved: Array, turn: float = 0.0) -> Draft:
    """Move balls in the object, and expect a finding of it; the object's place and angle
    may be those of any ball.

    Args:
        draft: of the scan.
        moved: (n, k, 3) [mm].
        turn: largest turn about the vertical axis [deg].
    """
    way = float(np.linalg.norm(moved, axis=2).max())
    near = dict.fromkeys(("dO_x", "dO_y", "dO_z", "tau_x", "tau_z"), way)
    near["alpha"] = abs(turn)
    ends = np.array([-1.0, 1.0])
    truth = {name: draft.world.offsets[name] + off * ends for name, off in near.items()}
    world = replace(draft.world, loose=moved)
    return replace(draft, world=world, names=(LOOSE,), beside=OTHERS, truth=truth)


def _part_slips(side: int, how: str) -> Fault:
    """Make a fault: the balls above or below a height slip against the others, by 0.02 to
    0.5 mm, and turn about the vertical axis by up to a degree.

    Args:
        side: 1: the upper ones, -1: the lower ones.
        how: of COURSES.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the height between two balls, the frame, the way and the turn."""
        draft = usual(draft, rng)
        beads, k = draft.world.beads, len(draft.world.beads)
        order = np.argsort(side * beads[:, 2])
        part = np.zeros(k, dtype=bool)
        part[order[int(rng.integers(2, k - 1)) :]] = True
        way = _way(rng, draft.world.scale)
        turn = float(rng.uniform(-1.0, 1.0)) * float(rng.integers(0, 2))
        middle = beads[part].mean(axis=0)
        spin = Rotation.from_rotvec([0.0, 0.0, math.radians(turn)])
        ends = spin.apply(beads - middle) + middle - beads + way
        course = _course(len(draft.world.angles), how, rng)
        moved = course[:, None, None] * np.where(part[:, None], ends, 0.0)
        return _loosened(draft, moved, turn)

    return fault


def _beads_loose(count: int, how: str, least: float = 0.02, most: float = 0.5) -> Fault:
    """Make a fault: some balls come loose, each by itself.

    Args:
        count: of the balls.
        how: of COURSES.
        least, most: displacement [mm] of a phantom of usual size.
    """

    def fault(draft: Draft, rng: Rng) -> Draft:
        """Draw the balls, and the frame and way of each."""
        draft = usual(draft, rng)
        n, k = draft.world.shown.shape
        moved = np.zeros((n, k, 3))
        for bead in rng.choice(k, count, replace=False):
            way = _way(rng, draft.world.scale, least, most)
            moved[:, bead] = _course(n, how, rng)[:, None] * way
        return _loosened(draft, moved)

    return fault


ROLLS: Final = ("det_roll", "axis_tilt_z")
LEANS: Final = ("dD_y", "det_pitch", "axis_tilt_x")
TURNS: Final = ("dD_x", "det_yaw")
KINDS: Final[Mapping[str, Fault]] = {
    "nothing": _nothing,
    "low_dose": _low_dose,
    "slow_errors": _slow_errors,
    "detector_aside": _offset("dD_x", 0.3, 4.0, *TURNS, silent=True),
    "detector_far_aside": _offset("dD_x", 40.0, 60.0, *TURNS),
    "detector_higher": _offset("dD_y", 0.3, 4.0, *LEANS, silent=True),
    "detector_far_higher": _offset("dD_y", 25.0, 35.0, *LEANS),
    "sdd_off": _offset("dD_z", 0.3, 2.0, silent=True),
    "sdd_far_off": _offset("dD_z", 12.0, 25.0),
    "panel_rolled": _offset("det_roll", 0.1, 0.6, silent=True),
    "panel_far_rolled": _offset("det_roll", 3.0, 6.0, *ROLLS),
    "axis_aslant": _offset("axis_tilt_z", 0.05, 0.2, *ROLLS, silent=True),
    "axis_far_aslant": _offset("axis_tilt_z", 2.5, 4.0, *ROLLS),
    "axis_leans": _offset("axis_tilt_x", 0.05, 0.2, silent=True),
    "axis_far_leans": _offset("axis_tilt_x", 2.0, 4.0, *LEANS),
    "panel_yaws": _offset("det_yaw", 0.1, 0.6, *TURNS, silent=True),
    "panel_far_yaws": _offset("det_yaw", 4.0, 8.0, *TURNS),
    "panel_pitches": _offset("det_pitch", 0.1, 0.6, *LEANS, silent=True),
    "panel_far_pitches": _offset("det_pitch", 5.0, 9.0, *LEANS),
    "drift_across": _drift("dO_x", 0.05, 0.4),
    "drift_along": _drift("dO_z", 0.5, 3.0),
    "screw": _screw,
    "angle_creeps": _angles(
        lambda a, rng: a + np.linspace(0, rng.uniform(0.2, 0.4), len(a)) ** 2, "angles_wrong|alpha",
        beside=OTHERS,
    ),
    "spot_drift": _spot_drift,
    "jump_across": _jump("dO_x", 0.05, 0.4),
    "slip": _jump("alpha", 0.1, 4.0),
    "runout": _runout,
    "wobble": _wobble,
    "vibration": _vibration,
    "angle_jitter": _angles(
        lambda a, rng: a + rng.uniform(0.05, 0.5) * rng.normal(size=len(a)),
        "angles_wrong|vibration.*angle|alpha moves", beside=OTHERS,
    ),
    "endpoint": _angles(lambda a, rng: a * len(a) / (len(a) - 1), "angle_endpoint"),
    "endpoint_other_way": _angles(lambda a, rng: a * (len(a) - 1) / len(a), "angle_endpoint"),
    "angle_factor": _angles(
        lambda a, rng: a * (1 + _sign(rng) * rng.uniform(5e-4, 4e-3)),
        "angle_scale|alpha changes|alpha moves", beside=OTHERS,
    ),
    "short_turn": _angles(lambda a, rng: a * rng.uniform(0.5, 0.6), "angle_scale|angle_turn"),
    "reversed": _angles(lambda a, rng: -a, "angle_reversed"),
    "not_turning": _angles(lambda a, rng: 0 * a, "not_turning"),
    "shuffled": _angles(lambda a, rng: rng.permutation(a), "frame_order|frame_numbers"),
    "gap": _angles(_gap, "frame_numbers|angle_step"),
    "frames_repeated": _stuttered,
    "frames_missing": _missing_frames,
    "frames_swapped": _swapped_frames,
    "bead_lost": _lost(1),
    "beads_lost": _lost(2),
    "bead_extra": _extra,
    "bead_displaced": _displaced,
    "bead_tolerance": _tolerance,
    "tolerance_and_roll": _tolerance_and_roll,
    "other_phantom": _other_phantom,
    "mirror_image": _mirror_image,
    "phantom_upside_down": _upside_down_phantom,
    "other_radius": _other_radius,
    "other_scale": _other_scale,
    "one_bead": _one_bead,
    "no_beads": _no_beads,
    "symmetric": _symmetric,
    "images_mirrored": _flipped((0,), "image_mirrored"),
    "images_upside_down": _flipped((1,), "image_upside_down"),
    "images_turned": _flipped((0, 1), "image_turned"),
    "row_offset": _row_offset,
    "radial": _distorted("radial"),
    "decentred": _distorted("decentred"),
    "bent": _distorted("bent"),
    "tiles_apart": _tiles_apart,
    "binned": _binned,
    "tau_held": _held("tau_x", 0.02, 1.0),
    "height_held": _held("dO_y", 0.2, 2.0),
    "across_held": _held("dO_x", 0.2, 2.0),
    "scanner_held": _held_zero("dD_x", "dD_z", "det_roll", "det_yaw"),
    "as_assumed": _right,
    "strain_x": _strained("x"),
    "strain_y": _strained("y"),
    "strain_z": _strained("z"),
    "strain_shear": _strained("shear"),
    "strain_lean": _strained("lean"),
    "exposed_long": _exposed_long,
    "exposed_as_said": _exposed_as_said,
    "rows_in_turn": _rows_in_turn,
    "frame_doubled": _renumbered(-1),
    "frame_lost": _renumbered(1),
    "exposed_again": _exposed_again,
    "four_tiles": _four_tiles,
    "source_jumps": _source_moves(0, 0.02, 0.3, jumps=True),
    "source_jumps_up": _source_moves(2, 0.02, 0.3, jumps=True),
    "source_jumps_along": _source_moves(1, 0.2, 3.0, jumps=True),
    "source_drifts": _source_moves(0, 0.05, 0.3, jumps=False),
    "source_drifts_up": _source_moves(2, 0.05, 0.3, jumps=False),
    "object_jumps": _usual_jump("dO_x", 0.02, 0.3),
    "object_jumps_up": _usual_jump("dO_y", 0.02, 0.3),
    "object_jumps_along": _usual_jump("dO_z", 0.2, 3.0),
    "object_jumps_twice": _jumps_twice,
    "panel_jumps": _usual_jump("dD_x", 0.02, 0.3),
    "panel_jumps_up": _usual_jump("dD_y", 0.02, 0.3),
    "grows": _grows,
    "other_pitch": _other_pitch,
    "part_slips": _part_slips(1, "at_once"),
}  # fmt: skip
"""Every fault."""
MOVED: Final[Mapping[str, Fault]] = {
    "one_loose": _beads_loose(1, "at_once"),
    "one_creeps": _beads_loose(1, "slowly"),
    "one_and_back": _beads_loose(1, "and_back"),
    "two_loose": _beads_loose(2, "at_once"),
    "two_creep": _beads_loose(2, "slowly"),
    "lower_slips": _part_slips(-1, "at_once"),
    "upper_creeps": _part_slips(1, "slowly"),
    "lower_and_back": _part_slips(-1, "and_back"),
    "one_relaxes": _beads_loose(1, "relaxing"),
    "one_at_two_speeds": _beads_loose(1, "two_speeds"),
    "one_swings": _beads_loose(1, "swinging"),
    "one_briefly": _beads_loose(1, "briefly"),
    "three_creep_far": _beads_loose(3, "slowly", 0.7, 1.5),
    "upper_relaxes": _part_slips(1, "relaxing"),
    "upper_at_two_speeds": _part_slips(1, "two_speeds"),
    "upper_swings": _part_slips(1, "swinging"),
    "upper_briefly": _part_slips(1, "briefly"),
}
"""Further beads that move against each other."""
RIGHT: Final[Mapping[str, Fault]] = {
    "as_assumed": _right,
    "with_causes": _with_causes(moving=False),
    "with_motion": _with_causes(moving=True),
}
"""Scans as a calibration assumes them to be: without further causes, with those of the
phantom, the exposure and the panel, and with motion as well."""
DRAWS: Final = {**KINDS, **RIGHT, **MOVED}
"""Every kind of scan."""
