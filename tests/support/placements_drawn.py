"""Several scans of one phantom, drawn: it is taken out, turned and moved between them.

A name is `FAULT@PLACEMENTS`: a fault of `faults_drawn.KINDS`, and one of PLACEMENTS. What is
wrong with the phantom, the panel or the exposure is so in every scan; what moves, and frames
that are lost, doubled or swapped, are of one scan.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from faults_drawn import DRAWS, PANELS, Draft, Faulty, Rng, right_draft, taken, usual

PLACEMENTS: Final[Mapping[str, int]] = {
    "two_placements": 2,
    "three_placements": 3,
    "two_distances": 2,
}
"""Name -> number of scans. Between placements the phantom is taken out; between distances the
stage alone is moved along the beam, as is known."""
OF_ONE_SCAN: Final = frozenset((
    "drift_across", "drift_along", "screw", "angle_creeps", "spot_drift", "jump_across", "slip",
    "runout", "wobble", "vibration", "angle_jitter", "frames_repeated", "frames_missing",
    "frames_swapped", "frame_doubled", "frame_lost", "exposed_again", "source_jumps",
    "source_jumps_up", "source_jumps_along", "source_drifts", "source_drifts_up",
    "object_jumps", "object_jumps_up", "object_jumps_along", "object_jumps_twice",
    "panel_jumps", "panel_jumps_up", "grows",
))  # fmt: skip
"""Faults of a single scan."""
PLACED: Final = (
    "as_assumed", "object_jumps", "object_jumps_along", "slip", "drift_across", "screw",
    "runout", "source_jumps", "source_drifts_up", "panel_jumps", "frame_lost", "frame_doubled",
    "grows", "strain_z", "bead_displaced", "four_tiles", "exposed_long",
)  # fmt: skip
"""Faults that are drawn with PLACEMENTS, one of each sort."""
OF_PLACEMENT: Final = ("dO_y", "alpha", "tau_x", "tau_z")
"""Parameters of the phantom's place on the stage, if the axis stays."""
ASIDE: Final = {"dO_y": 4.0, "alpha": 180.0, "tau_x": 2.0, "tau_z": 2.0}
"""Largest change of them [mm, deg]."""
FURTHER: Final = 60.0
"""Largest way of the stage along the beam [mm]."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Scans of one phantom, one of which may be at fault.

    Attributes:
        scans: of which the first has what is expected of all.
        spoilt: number of the scan that is at fault; None: all are.
        per_scan: parameters with a value in each scan. With them the offsets are those of
            an axis that stays where the phantom is moved.
    """

    scans: tuple[Faulty, ...]
    spoilt: int | None
    per_scan: tuple[str, ...]

    @property
    def truths(self) -> dict[str, tuple[float, float]]:
        """Least and largest value of each parameter, also of those of one scan, NAME@SCAN."""
        out: dict[str, tuple[float, float]] = {}
        for i, scan in enumerate(self.scans):
            for name, ends in scan.truth.items():
                # The axis is at O, and the phantom beside it by -tau.
                beside = {"dO_x": "tau_x", "dO_z": "tau_z"}.get(name)
                more = 0.0
                if self.per_scan and beside is not None:
                    more = sum(scan.truth[beside]) / 2
                low, high = ends[0] + more, ends[1] + more
                if name in self.per_scan:
                    out[f"{name}@{i}"] = (low, high)
                    continue
                before = out.get(name, (low, high))
                out[name] = (min(before[0], low), max(before[1], high))
        return out


def _placed_anew(draft: Draft, rng: Rng) -> Draft:
    """Take the phantom out, and put it onto the stage elsewhere; the axis stays."""
    offsets = dict(draft.world.offsets)
    for name, most in ASIDE.items():
        change = float(rng.uniform(-most, most))
        change *= 1.0 if name == "alpha" else draft.world.scale
        offsets[name] = offsets[name] + change
        if name.startswith("tau"):
            offsets["dO" + name[3:]] = offsets["dO" + name[3:]] - change
    return replace(draft, world=replace(draft.world, offsets=offsets))


def _further(draft: Draft, rng: Rng) -> Draft:
    """Move the stage along the beam."""
    way = float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.0)) * FURTHER
    sod = draft.world.sod + way * draft.world.scale
    return replace(
        draft,
        world=replace(draft.world, sod=sod),
        believed=replace(draft.believed, sod=sod),
    )


def drawn_placed(name: str, seed: int, panel: str = "flexray") -> Placed:
    """Draw scans of one phantom with a fault.

    Args:
        name: `FAULT@PLACEMENTS`.
        seed: of all draws, together with the name.
        panel: the machine, of `faults_drawn.PANELS`.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    fault, _, placements = name.partition("@")
    count = PLACEMENTS[placements]
    draft = usual(right_draft(rng, PANELS[panel]), rng)
    moved = _further if placements == "two_distances" else _placed_anew
    drafts = [draft, *(moved(draft, rng) for _ in range(count - 1))]
    spoilt = int(rng.integers(count)) if fault in OF_ONE_SCAN else None
    key = int(rng.integers(2**62))
    scans = []
    for i, one in enumerate(drafts):
        new = DRAWS[fault](one, np.random.default_rng(key))
        if spoilt not in (None, i):
            new = replace(one, names=new.names, beside=new.beside, silent=new.silent)
        scans.append(taken(new, rng))
    return Placed(
        tuple(scans), spoilt, () if placements == "two_distances" else OF_PLACEMENT
    )


def angles_apart(value: float, ends: tuple[float, float]) -> float:
    """Return an angle [deg] less whole turns, so that it is nearest to a range."""
    middle = (ends[0] + ends[1]) / 2
    return middle + (value - middle + 180.0) % 360.0 - 180.0
