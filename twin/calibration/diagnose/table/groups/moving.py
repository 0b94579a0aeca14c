"""Motion: object, source, panel or angle are elsewhere from frame to frame.

A motion is a ramp, a jump, a wander (half waves that fade with their number, as those of a random
walk do or as those of what slows down), a swing (of a period of its own, which need not be the
turn's, and with an amplitude that may change), or a jitter (each frame by itself), of object,
source or panel along an axis, or of the angle. What moves along the beam moves aside, too, and
what turns back aside goes along the beam: a mount goes in a direction of its own. All have a mean
of zero over the scan: the geometry is that of the mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import legvander

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.frame_numbers import named_turn
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    NEVER,
    OPEN_LOG_ODDS,
    Acts,
    Family,
    Found,
    Known,
    Seen,
)
from flexdt.twin.calibration.diagnose.table.linearised import PER_FRAME, Linearised
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS, to_edge

NAME: Final = "motion"
WORDS: Final = "something that moves during the scan"
MOVERS: Final = {
    "dO_x": {"dO_x": 1.0},
    "dO_y": {"dO_y": 1.0},
    "dO_z": {"dO_z": 1.0},
    "alpha": {"alpha": 1.0},
    "dD_x": {"dD_x": 1.0},
    "dD_y": {"dD_y": 1.0},
    "dD_z": {"dD_z": 1.0},
    "dS_x": {"dS_x": 1.0},
    "dS_y": {"dS_y": 1.0},
    # Seen from a source that comes nearer, object and panel go away.
    "dS_z": {"dO_z": -1.0, "dD_z": -1.0},
}
"""What may move -> the parameters of a frame that stand for it, with their factors."""
JITTERS: Final = ("dO_x", "dO_y", "dO_z", "alpha")
"""What may differ from frame to frame by itself: of others this looks like the object's."""
FOLLOWED: Final = ("dO_x", "dO_y", "dO_z", "alpha")
"""Parameters that are advised to differ between frames where something moves."""
EXACT: Final = math.log(1e-3)
"""Logarithm of the probability that what is stated to be exactly known moves; assumed."""
NOT_ASKED: Final = -math.log(2.0)
"""Logarithm of the odds that something else moves than what is asked for; assumed."""
MOTION_WORDS: Final = {
    "dO_x": "the object moves aside",
    "dO_y": "the object moves up or down",
    "dO_z": "the object moves along the beam",
    "alpha": "the object turns",
    "dS_x": "the source moves aside",
    "dS_y": "the source moves up or down",
    "dS_z": "the source moves along the beam",
    "dD_x": "the panel moves aside",
    "dD_y": "the panel moves up or down",
    "dD_z": "the panel moves along the beam",
}
"""Parameter -> words on its motion."""
ALIKE_MOTION: Final = {
    "dO_x": ("the source moves aside, the other way",),
    "dO_y": ("the source moves up or down, the other way",),
    "dO_z": ("the phantom grows or shrinks",),
}
"""Parameter -> other motions that look like this motion of the object."""
LEAST_FRAMES: Final = 3
MOST_WAVES: Final = 60
"""Half waves in a scan, of a wander."""
MOST_JUMPS: Final = 60
"""Frames before which a jump is looked for."""
SWINGS: Final = (2, 16)
"""Least and most half periods in a scan, of a swing: with fewer it is a drift."""
LEAST_SWINGING: Final = 12
"""Frames of which a swing is told."""
SWELLS: Final = (1.0, 0.7, 0.2, 0.03)
"""Of an amplitude that changes as Legendre's polynomials do: the parts of a swing whose period lies
in the middle between two that are tried."""
ASIDE: Final[Mapping[str, tuple[str, ...]]] = {
    f"{body}_z": (f"{body}_x", f"{body}_y") for body in ("dO", "dS", "dD")
}
"""What moves along the beam -> what else it does by as much: the images do not tell where the beam
is."""
ALONG: Final[Mapping[str, tuple[str, ...]]] = {
    f"{body}_x": (f"{body}_z",) for body in ("dO", "dS", "dD")
}
"""What moves aside -> what else it does by as much, where it turns back: once a turn, both are what
a phantom does that is aside on its mount."""
DIFFERS: Final = "differs between scans"
JUMPING: Final = ("jumps", "jitters", DIFFERS)
"""Ways of motion of which that is no part."""
FIRST_COLUMNS: Final = 8
"""Columns of a course, with which it does: the slow ones."""
LEAVING: Final = ("jumps", "wanders", "slows down", "ramps")
"""Ways of motion after which a thing is elsewhere than before."""
KINDS: Final = 5
"""Smooth kinds of motion, which share the odds."""


class Moves(NamedTuple):
    """What a group of motion is: what moves, how, in which scan, and at which frame, or with how
    many half periods.
    """

    what: str
    how: str
    scan: int
    at: int = -1


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make each kind of motion of all that may move, in each scan, and shifts from scan to
    scan.
    """
    movers = tuple(dict.fromkeys((*MOVERS, *known.asked)))
    many = len(table.scans) > 1
    for number, frames in enumerate(table.scans):
        if len(frames) < LEAST_FRAMES:
            continue
        where = f" in scan {number + 1}" if many else ""
        for how, places, courses in _kinds(len(frames)):
            some = movers
            if how == "jitters":
                some = tuple(dict.fromkeys((*JITTERS, *known.asked)))
            if how in ("ramps", "slows down"):
                # Of even angles this is a factor on them, or looks like one.
                some = tuple(what for what in movers if what != "alpha")
            each = np.stack([_in(table.n, frames, course) for course in courses])
            chance = LOG_CHANCE - math.log(KINDS * len(courses))
            at = [int(frames[i]) if how == "jumps" else i for i in places]
            for names in _alike(some, how, known):
                yield _family(
                    table, [Moves(m, how, number, i) for i in at for m in names], where,
                    each, chance + np.tile(_doubt(names, known), len(courses)), known,
                )  # fmt: skip
    if many:
        group = table.problem.group
        differs = np.where(np.equal.outer(group, np.arange(group.max() + 1)), 1.0, 0.0)
        differs -= np.bincount(group) / len(group)
        own = {n.split("@")[0] for n in table.problem.layout.names if "@" in n}
        # Of scans that stand apart, what is elsewhere along an axis is the place, as wide as
        # it is stated, unless it moves (`apart`): source or panel look alike, and each scan's
        # geometry has its place.
        placed = {n[-1] for n in own if n.startswith("place")}
        shared = tuple(what for what, part in MOVERS.items() if own.isdisjoint(part))
        for names in _alike(shared, DIFFERS, known):
            still = [what != "alpha" and what[-1] in placed for what in names]
            yield _family(
                table, [Moves(name, DIFFERS, -1) for name in names], "",
                differs[None], np.where(still, NEVER, LOG_CHANCE - math.log(KINDS)),
                known,
            )  # fmt: skip


def _kinds(count: int) -> Iterator[tuple[str, list[int], FloatArray]]:
    """Yield the ways in which something moves in a scan of a number of frames: its name, the
    frames or half periods of its courses, -1 without, and the courses, (m, count, c).
    """
    place = (np.arange(count) + 0.5) / count
    waves = np.arange(1, min(count - 1, MOST_WAVES) + 1)
    # A random walk of as many steps: of slow waves this is their number.
    steep = 2.0 * count / math.pi * np.sin(0.5 * math.pi * waves / count)
    half_waves = np.cos(math.pi * place[:, None] * waves)
    yield "wanders", [-1], (half_waves / steep)[None]
    yield "slows down", [-1], (half_waves / steep**2)[None]
    yield "ramps", [-1], (place - 0.5)[None, :, None]
    # Of all half waves alike: frames by themselves, but for their mean.
    every = np.arange(1, count)
    jitter = np.cos(math.pi * place[:, None] * every) * math.sqrt(2.0 / count)
    yield "jitters", [-1], jitter[None]
    if count >= LEAST_SWINGING:
        halves = np.arange(SWINGS[0], min(SWINGS[1], count // 2) + 1)
        phase = math.pi * halves[:, None] * place
        swells = legvander(2.0 * place - 1.0, len(SWELLS) - 1) * SWELLS
        waves_of = np.stack([np.cos(phase), np.sin(phase)], axis=2)
        swings = np.einsum("hnw,nq->hnqw", waves_of, swells).reshape(
            len(halves), count, -1
        )
        yield "swings", halves.tolist(), swings - swings.mean(axis=1, keepdims=True)
    jumps = np.unique(
        np.linspace(1, count - 1, min(count - 1, MOST_JUMPS)).round().astype(int)
    )
    late = (np.arange(count) >= jumps[:, None]) - (1 - jumps[:, None] / count)
    yield "jumps", jumps.tolist(), late[:, :, None]


def apart(courses: Iterable[tuple[object, FloatArray]]) -> dict[str, float]:
    """Name what differs between scans because it jumps, wanders or drifts in one of them.

    `courses`: each group of motion's place, and course over the frames. Returns name ->
    width, the course's range.
    """
    out: dict[str, float] = {}
    for place, course in courses:
        _, move = cast("tuple[object, Moves]", place)
        if move.scan >= 0 and move.how in LEAVING:
            name = f"{move.what} {DIFFERS}"
            out[name] = max(out.get(name, 0.0), float(np.ptp(course)))
    return out


def mover(place: object) -> str:
    """Return what a group moves, of its place; "" where it is no motion."""
    if isinstance(place, tuple) and len(place) > 1 and isinstance(place[1], Moves):
        return place[1].what
    return ""


def _alike(names: tuple[str, ...], how: str, known: Known) -> list[list[str]]:
    """Group movers by the numbers of their parameters, the angle by itself."""
    alike: dict[tuple[tuple[int, ...], bool], list[str]] = {}
    for name in names:
        parts = _parts(name, how, known)
        kind = tuple(len(part) for part in parts), name == "alpha"
        alike.setdefault(kind, []).append(name)
    return list(alike.values())


def _parts(name: str, how: str, known: Known) -> list[dict[str, float]]:
    """Return the parameters of a frame that stand for what moves in a way, with their factors,
    and those of what else it does: nothing that is stated to be exactly known, and of what is
    asked for, only what is asked for as well.
    """
    others = ASIDE.get(name, () if how in JUMPING else ALONG.get(name, ()))
    if name in known.asked:
        others = tuple(o for o in others if o in known.asked)
    exact = _exact(known)
    others = tuple(o for o in others if exact.isdisjoint(MOVERS[o]))
    return [MOVERS.get(one, {one: 1.0}) for one in (name, *others)]


def _exact(known: Known) -> frozenset[str]:
    return known.exact - set(known.asked)


def _doubt(names: Sequence[str], known: Known) -> FloatArray:
    """Return the logarithm of the odds of movers against others, (names,): of what is stated to
    be exactly known, and of what is not asked for where others are.
    """
    exact = _exact(known)
    own = [MOVERS.get(name, {name: 1.0}) for name in names]
    out = np.array([0.0 if exact.isdisjoint(part) else EXACT for part in own])
    if known.asked:
        out += [0.0 if name in known.asked else NOT_ASKED for name in names]
    return out


def _in(n: int, frames: npt.NDArray[np.intp], course: FloatArray) -> FloatArray:
    out = np.zeros((n, course.shape[1]))
    out[frames] = course
    return out


def _family(
    table: Linearised,
    moves: list[Moves],
    where: str,
    courses: FloatArray,
    chance: float | FloatArray,
    known: Known,
) -> Family:
    """Make a family of motions of as many parameters each.

    Args:
        table: of the slopes.
        moves: of each group.
        where: words on the scan.
        courses: (m, n, c) of the frames, each with all movers.
        chance: of each.
        known: what is asked for, and what is exact.
    """
    parts = [_parts(move.what, move.how, known) for move in moves]
    first = parts[: len(parts) // len(courses)]
    names = tuple(
        f"{m.what} {m.how}{f' at {m.at}' if m.at >= 0 else ''}{where}" for m in moves
    )
    every = [tuple(name for one in part for name in one) for part in parts]
    return Family(
        NAME,
        names,
        Acts.FRAMES,
        tuple(zip(every, moves, strict=True)),
        chance,
        slopes=np.array(
            [[PER_FRAME.index(p) for p in part] for part in every[: len(first)]]
        ),
        courses=_side_by_side(courses, first[0]),
    )


def _side_by_side(
    courses: FloatArray, parts: Sequence[Mapping[str, float]]
) -> FloatArray:
    """Give each part of a mover columns of its own for its courses: (m, n, c) to (m, s, n, c') of
    its s parameters.
    """
    columns = [courses, *[courses[:, :, :FIRST_COLUMNS]] * (len(parts) - 1)]
    rows: list[FloatArray] = []
    for i, part in enumerate(parts):
        each = [own if i == j else np.zeros_like(own) for j, own in enumerate(columns)]
        rows += [factor * np.concatenate(each, axis=2) for factor in part.values()]
    return np.stack(rows, axis=1)


def told(found: Found) -> list[Finding]:
    """Tell what moves, how, and by how much: the geometry is that of the mean. A turn that is
    whole steps, or a jump of the angle, is an error.
    """
    if found.known.asked:
        return _followed(found)
    seen = found.of(NAME)
    out = []
    turned = [s for s in seen if _moves(s).what == "alpha"]
    moved = [s for s in seen if _moves(s).what != "alpha"]
    angles = found.fit.problem.poses.angle
    group = found.fit.problem.group
    if turned:
        out.append(_turned(turned, angles, group))
    if moved:
        out.append(_moved(moved, found))
    return out


def _followed(found: Found) -> list[Finding]:
    """Tell what moves beside what was asked for, and what may move instead of it: both are
    followed, so that the motion itself is no fault.
    """
    moving = {_moves(s).what: None for s in found.seen if s.cause == NAME}
    others = [name for name in moving if name not in found.known.asked]
    out = []
    if others:
        how = "instead of" if set(moving).isdisjoint(found.known.asked) else "beside"
        out.append(
            warning(
                CalibrationCode.OTHER_MOTION,
                f"{_in_words(others)} ({', '.join(others)}) {how} {', '.join(found.known.asked)}: "
                "that explains the images far better, and was followed",
            )
        )
    if alike := _instead(frozenset(moving), found.movers):
        out.append(
            warning(
                CalibrationCode.MOTION_OPEN,
                f"the images do not tell for certain what moves, {', '.join(moving) or 'nothing'} "
                f"or otherwise: {' or '.join(alike)}; the intervals contain what they differ by",
            )
        )
    return out


def _instead(moving: frozenset[str], movers: Mapping[frozenset[str], float]) -> list[str]:
    """List words on what may move in place of what was found to, the most probable first; sets
    that only have more are left out.
    """
    least = math.exp(-OPEN_LOG_ODDS) * movers.get(moving, 0.0)
    sets: list[frozenset[str]] = []
    for some in sorted(movers, key=lambda s: -movers[s]):
        more = moving <= some or any(less <= some for less in sets)
        if movers[some] >= least and not more:
            sets.append(some)
    return [_in_words(sorted(some)) for some in sets]


def _in_words(movers: Sequence[str]) -> str:
    return " and ".join(MOTION_WORDS[name] for name in movers) or "nothing moves"


def _moves(seen: Seen) -> Moves:
    place = seen.place
    assert isinstance(place, tuple)
    assert isinstance(place[1], Moves)
    return place[1]


def _reach(seen: Sequence[Seen]) -> tuple[float, FloatArray]:
    """Return the range of what some groups of one mover do together, and its course, internal
    units."""
    course = sum(s.courses[0] for s in seen if s.courses is not None)
    return float(np.ptp(course)), np.asarray(course)


def _moved(seen: Sequence[Seen], found: Found) -> Finding:
    """Tell a motion of object, source or panel, those that do most first."""
    effects: dict[str, float] = {}
    for one in seen:
        what = _moves(one).what
        effects[what] = math.hypot(effects.get(what, 0.0), one.effect_px)
    ordered = sorted(effects, key=lambda what: -effects[what])
    first = [s for s in seen if _moves(s).what == ordered[0]]
    said = []
    for what in ordered:
        reach, _ = _reach([s for s in seen if _moves(s).what == what])
        if effects[what] > 0.3 * effects[ordered[0]]:
            parameter = "dO_z" if what == "dS_z" else what
            said.append(f"{what} by {to_edge(parameter, reach):.3g} {UNITS[parameter]}")
    # What moved in a scan is elsewhere in the next.
    within = [s for s in first if _moves(s).how != DIFFERS]
    main = max(within or first, key=lambda s: s.effect_px)
    group = found.fit.problem.group
    how = _how(first, main, group)
    many = group.max() > 0
    scan = _moves(main).scan
    where = f" of scan {scan + 1}" if many and scan >= 0 else ""
    shakes = _moves(main).how == "jitters"
    words = " and ".join(MOTION_WORDS[what] for what in ordered[:2])
    px = math.sqrt(sum(e**2 for e in effects.values()))
    return warning(
        CalibrationCode.VIBRATION if shakes else CalibrationCode.DRIFT,
        f"{', '.join(said)} moves during the scan{where}, {how}: {words}"
        f"{_looks_alike(ordered[0])}. It moves the images by {px:.2g} px rms; the geometry is "
        f"that of the mean, and --per-frame {','.join(FOLLOWED)} follows it",
        per_frame=FOLLOWED,
    )


def _frame_in_scan(at: int, group: npt.NDArray[np.int64]) -> int:
    """Return the number of a frame in its own scan."""
    return at - int(np.flatnonzero(group == group[at])[0])


def _how(first: Sequence[Seen], main: Seen, group: npt.NDArray[np.int64]) -> str:
    """Write how something moves."""
    move = _moves(main)
    if move.how == "jumps":
        return f"at frame {_frame_in_scan(move.at, group)}"
    if move.how == "jitters":
        return "from frame to frame"
    if move.how == DIFFERS:
        return "from scan to scan"
    _, course = _reach(first)
    some = course[course != 0.0] if (course != 0.0).any() else course
    steady = abs(float(np.corrcoef(some, np.arange(len(some)))[0, 1])) > 0.9
    return "steadily from the first to the last frame" if steady else "to and fro"


def _looks_alike(what: str) -> str:
    """Return words on another motion that looks like one, in brackets after a blank."""
    words = ALIKE_MOTION.get(what, ())
    return (
        f" (or {' or '.join(words)}, which look{'s' * (len(words) == 1)} alike)"
        if words
        else ""
    )


def _turned(
    seen: Sequence[Seen], angles: FloatArray, group: npt.NDArray[np.int64]
) -> Finding:
    """Tell how the object turns otherwise than stated."""
    jumps = [s for s in seen if _moves(s).how == "jumps"]
    main = max(seen, key=lambda s: s.effect_px)
    if jumps and main in jumps:
        move = _moves(main)
        assert main.courses is not None
        course = main.courses[0]
        height = to_edge("alpha", float(course[move.at] - course[move.at - 1]))
        code, text = named_turn(height, angles[group == group[move.at]])
        at = _frame_in_scan(move.at, group)
        where = f" of scan {move.scan + 1}" if group.max() > 0 else ""
        return error(code, f"between frames {at - 1} and {at}{where} {text}")
    _, course = _reach(seen)
    off = np.array([to_edge("alpha", v) for v in course])
    return warning(
        CalibrationCode.ANGLES_WRONG,
        f"the frames' angles differ from the stated ones by {np.std(off):.3g} deg "
        f"rms (up to {np.abs(off).max():.3g}): the geometry is that of their mean, and "
        "--per-frame alpha follows them",
        per_frame=("alpha",),
    )
