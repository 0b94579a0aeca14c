"""Whether a machine file describes a machine that can stand at home."""

from __future__ import annotations

import math
from collections.abc import Iterable

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.scene_search import touching
from flexdt.twin.errors import MachineFileError
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.places import place


def check_home(machine: Machine, profile: Profile, file: str) -> None:
    """Check that the machine can stand at home: source, sample, panel in order, nothing touching.

    Args:
        machine: read from `file`.
        profile: its zero offsets.
        file: for the error.

    Raises:
        MachineFileError: file, what is wrong at home, and where.
    """
    sod, sdd = place(machine, "object_y").home, place(machine, "detector_y").home
    if not (math.isfinite(sod) and 0.0 < sod < sdd):
        raise MachineFileError(
            f"{file}: axes: at home SOD is {sod:g} mm and SDD {sdd:g} mm; allowed: 0 < SOD < SDD "
            "(flexdt machine check prints what they are the sum of)",
            {"file": file, "path": "axes", "sod": sod, "sdd": sdd},
        )
    found = touching(build_scene(machine, profile), {})
    if found:
        raise MachineFileError(
            f"{file}: axes: at home {_pairs(found)}; the safety margin is "
            f"{machine.safety_margin_mm:g} mm (another home, other sizes or places; or say in "
            "allowed_contacts that they are mounted on each other)",
            {"file": file, "path": "axes", "pairs": [list(pair) for pair, _ in found]},
        )


def _pairs(found: Iterable[tuple[tuple[str, str], float]]) -> str:
    return ", ".join(
        f"{a} and {b} {f'are {gap:.3g} mm apart' if gap > 0.0 else 'touch'}"
        for (a, b), gap in found
    )
