"""Scans with two faults at once, and of unusual setups: drawn from `faults_drawn`.

A name is `FAULT+FAULT` or `FAULT+FAULT@SETUP`; both faults are those of `faults_drawn.KINDS`,
and the setup is one of SETUPS, which changes the scan before anything is wrong with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from faults_drawn import (
    DRAWS,
    KINDS,
    Array,
    Draft,
    Faulty,
    Rng,
    phantom,
    right_draft,
    taken,
)

ALONE: Final = frozenset(("nothing", "one_bead", "no_beads", "row_offset"))
"""Faults that stand in no pair: they leave nothing to see, or are another fault."""
BEADS_FIRST: Final = (
    "bead_lost", "beads_lost", "bead_extra", "other_phantom", "mirror_image",
    "phantom_upside_down", "other_scale", "symmetric",
)  # fmt: skip
"""Faults that put other balls in the place of the phantom's, before it is strained."""
FRAMES_LAST: Final = ("frames_repeated", "frames_swapped", "frames_missing")
"""Faults of whole frames, after everything that shifts spots in them."""
SHARED: Final[Sequence[frozenset[str]]] = (
    frozenset(BEADS_FIRST),
    frozenset((
        "bead_displaced", "bead_tolerance", "tolerance_and_roll", "bead_lost", "beads_lost",
        "bead_extra", "symmetric", "other_phantom",
    )),
    frozenset((
        "drift_across", "drift_along", "screw", "angle_creeps", "spot_drift", "jump_across",
        "slip", "runout", "wobble", "vibration", "angle_jitter", "source_jumps", "grows",
        "height_held", "across_held",
    )),
    frozenset(k for k in KINDS if k.endswith("_held")),
    frozenset(("exposed_long", "exposed_as_said")),
    frozenset(("binned", "other_pitch", "other_radius", "other_scale")),
    frozenset(k for k in KINDS if k.startswith("images_")),
    frozenset(("detector_aside", "detector_far_aside", "scanner_held")),
    frozenset(("detector_higher", "detector_far_higher")),
    frozenset(("sdd_off", "sdd_far_off", "scanner_held")),
    frozenset(("panel_rolled", "panel_far_rolled", "tolerance_and_roll", "scanner_held")),
    frozenset(("axis_aslant", "axis_far_aslant", "wobble")),
    frozenset(("axis_leans", "axis_far_leans")),
    frozenset(("panel_yaws", "panel_far_yaws", "scanner_held")),
    frozenset(("panel_pitches", "panel_far_pitches")),
    frozenset(("low_dose", "slow_errors")),
)  # fmt: skip
"""Faults of which a scan has one: they set the same quantity, or their truths would mix."""
MILD: Final = (
    "low_dose", "slow_errors", "detector_aside", "detector_higher", "sdd_off", "panel_rolled",
    "axis_aslant", "axis_leans", "panel_yaws", "panel_pitches", "drift_across", "spot_drift",
    "jump_across", "wobble", "vibration", "angle_jitter", "angle_factor", "frames_repeated",
    "frames_missing", "frames_swapped", "bead_lost", "bead_extra", "bead_displaced",
    "bead_tolerance", "radial", "decentred", "bent", "tiles_apart", "tau_held", "as_assumed",
    "strain_x", "strain_y", "strain_z", "strain_shear", "strain_lean", "exposed_long",
    "exposed_as_said", "frame_doubled", "frame_lost", "exposed_again", "four_tiles",
    "source_jumps", "grows", "other_pitch",
)  # fmt: skip
"""Faults of ordinary laboratories, after which a scan may still be offered."""


def together(one: str, other: str) -> bool:
    """Check whether two faults can stand in one scan."""
    if one == other or ALONE & {one, other}:
        return False
    return not any({one, other} <= some for some in SHARED)


PAIRS: Final = tuple(
    f"{one}+{other}"
    for one, other in itertools.combinations(MILD, 2)
    if together(one, other)
)
"""Every pair of two mild faults."""
Setup = Callable[[Draft, Rng], Draft]


def _scan(draft: Draft, angles: Array) -> Draft:
    """Replace the stage's angles [deg], true and stated."""
    n, k = len(angles), len(draft.world.beads)
    world = replace(
        draft.world,
        angles=angles,
        spot=np.zeros((n, 3)),
        shown=np.ones((n, k), dtype=bool),
    )
    return replace(draft, world=world, believed=replace(draft.believed, angles=angles))


def _balls(draft: Draft, beads: Array) -> Draft:
    """Replace the balls, true and stated, by others of the same radius."""
    radii = np.full(len(beads), draft.world.radii[0])
    shown = np.ones((len(draft.world.angles), len(beads)), dtype=bool)
    world = replace(draft.world, beads=beads, radii=radii, shown=shown)
    return replace(
        draft, world=world, believed=replace(draft.believed, beads=beads, radii=radii)
    )


def _few_frames(draft: Draft, rng: Rng) -> Draft:
    """Take a turn of 6 to 15 frames."""
    n = int(rng.integers(6, 16))
    return _scan(draft, 360.0 * np.arange(n) / n)


def _few_beads(draft: Draft, rng: Rng) -> Draft:
    """Use a phantom of three or four balls."""
    return _balls(draft, phantom(rng, int(rng.integers(3, 5))))


def _many_beads(draft: Draft, rng: Rng) -> Draft:
    """Use a phantom of 10 to 14 balls."""
    return _balls(draft, phantom(rng, int(rng.integers(10, 15))))


def _limited_arc(draft: Draft, rng: Rng) -> Draft:
    """Turn by 60 to 270 deg only."""
    n = len(draft.world.angles)
    return _scan(draft, float(rng.uniform(60.0, 270.0)) * np.arange(n) / n)


def _at(draft: Draft, sod: float) -> Draft:
    """Put the stage at a distance from the source [mm]."""
    return replace(
        draft,
        world=replace(draft.world, sod=sod),
        believed=replace(draft.believed, sod=sod),
    )


def _near_edge(draft: Draft, rng: Rng) -> Draft:
    """Magnify so that the outer balls pass the panel's edges."""
    return _at(draft, float(rng.uniform(380.0, 450.0)))


def _half_out(draft: Draft, rng: Rng) -> Draft:
    """Magnify so that about half of the positions are out of view."""
    return _at(draft, float(rng.uniform(230.0, 320.0)))


def _offset_detector(draft: Draft, rng: Rng) -> Draft:
    """Put the panel 20 to 40 mm aside, as is known."""
    aside = float(rng.choice([-1, 1]) * rng.uniform(20.0, 40.0))
    error = float(rng.normal(0.0, 1.0))
    world = replace(draft.world, offsets={**draft.world.offsets, "dD_x": aside + error})
    return replace(
        draft, world=world, believed=replace(draft.believed, held={"dD_x": aside})
    )


def _helix(draft: Draft, rng: Rng) -> Draft:
    """Raise the stage by 4 to 12 mm a turn, as is known, over one or two turns."""
    n = len(draft.world.angles)
    draft = _scan(draft, 360.0 * float(rng.choice([1.0, 2.0])) * np.arange(n) / n)
    pitch = float(rng.choice([-1, 1]) * rng.uniform(4.0, 12.0))
    world = replace(draft.world, pitch=pitch)
    return replace(draft, world=world, believed=replace(draft.believed, pitch=pitch))


SETUPS: Final[Mapping[str, Setup]] = {
    "few_frames": _few_frames,
    "few_beads": _few_beads,
    "many_beads": _many_beads,
    "limited_arc": _limited_arc,
    "near_edge": _near_edge,
    "half_out": _half_out,
    "offset_detector": _offset_detector,
    "helix": _helix,
}
"""Unusual scans, right by themselves."""


def _order(name: str) -> int:
    """Return the place of a fault among those of a scan: balls, the rest, frames."""
    if name in BEADS_FIRST:
        return -1
    return FRAMES_LAST.index(name) + 1 if name in FRAMES_LAST else 0


def _and_then(draft: Draft, name: str, rng: Rng) -> Draft:
    """Add a fault to a draft: what it does to spots comes after what is done already. The
    names that are expected, and whether it may be silent, are the new fault's alone."""
    before = draft.after
    bare = replace(draft, after=None, names=(), beside=(), silent=False)
    new = DRAWS[name](bare, rng)
    after = new.after
    if before is not None and after is not None:
        first, second = before, after

        def after(spots: list[Array | None]) -> list[Array | None]:
            return second(first(spots))

    believed = replace(
        new.believed,
        held={**draft.believed.held, **new.believed.held},
        priors={**draft.believed.priors, **new.believed.priors},
    )
    return replace(
        new,
        believed=believed,
        after=after or before,
        beside=(*draft.beside, *new.beside),
        truth={**draft.truth, **new.truth},
    )


def drawn_together(name: str, seed: int) -> tuple[Faulty, tuple[tuple[str, ...], ...]]:
    """Draw a scan with one or two faults and perhaps an unusual setup.

    Args:
        name: `FAULT`, `FAULT+FAULT`, each with `@SETUP` or without.
        seed: of all draws, together with the name.

    Returns:
        The scan, which expects the findings of both faults, and the patterns of each; those
        of faults that may be silent only where every one may.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    faults, _, setup = name.partition("@")
    draft = right_draft(rng)
    if setup:
        draft = SETUPS[setup](draft, rng)
    causes = []
    draft = replace(draft, silent=True)
    for fault in sorted(faults.split("+"), key=_order):
        draft = _and_then(draft, fault, rng)
        causes.append((draft.names, draft.silent))
    # What may be silent by itself may be silent, or said, beside what must be named.
    must = tuple(names for names, silent in causes if not silent)
    may = tuple(names for names, silent in causes if silent)
    some = must or may
    beside = (*draft.beside, *itertools.chain.from_iterable(may if must else ()))
    every = tuple(itertools.chain.from_iterable(some))
    return taken(replace(draft, names=every, beside=beside, silent=not must), rng), some


def drawn_names(
    count: int, seed: int, kinds: Collection[str] = MILD
) -> list[tuple[str, int]]:
    """Draw names of scans, and the seed of each: three of four are pairs of mild faults, the
    fourth is one alone, and every second has an unusual setup.

    Args:
        count: of the scans.
        seed: of the draws; the scans' seeds count on from it.
        kinds: faults that may be drawn.
    """
    pairs = [p for p in PAIRS if set(p.split("+")) <= set(kinds)]
    alone = [k for k in MILD if k in kinds]
    out = []
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        name = str(rng.choice(pairs if i % 4 else alone))
        if i % 4 < 2:
            name += f"@{rng.choice(list(SETUPS))}"
        out.append((name, seed + i))
    return out
