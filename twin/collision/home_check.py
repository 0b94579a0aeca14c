"""Check of a machine file: whether the machine can be at home and travel."""

from __future__ import annotations

import math
from collections.abc import Iterable

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.first_contact import touching
from flexdt.twin.errors import MachineFileError
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import place


def check_home(machine: Machine, profile: Profile, file: str) -> None:
    """Check the machine at home: source, sample, panel in order, nothing touching.

    Checked in that order; the first failure is raised. Pairs closer than the safety
    margin count as touching, those of `allowed_contacts` do not.

    No motor may take the rotation axis or the panel behind the source.

    Args:
        machine: read from `file`.
        profile: its zero offsets.
        file: for the error.

    Raises:
        MachineFileError: file, problem and place.
    """

    def wrong(what: str, **data: object) -> MachineFileError:
        """Make the error of a machine file's axes; returned, not raised."""
        return MachineFileError(
            f"{file}: axes: {what}", {"file": file, "path": "axes", **data}
        )

    stage = place(machine, "object_y")
    panel = place(machine, "detector_y")
    sod = stage.home
    sdd = panel.home
    if not (math.isfinite(sod) and 0.0 < sod < sdd):
        what = f"at home SOD is {sod:g} mm and SDD {sdd:g} mm; allowed: 0 < SOD < SDD"
        more = "(flexdt machine check prints what they are the sum of)"
        raise wrong(f"{what} {more}", sod=sod, sdd=sdd)
    for at, offset in ((stage, profile.c_obj), (panel, profile.c_det)):
        least = at.least + offset
        high = at.most + offset
        if least <= 0.0:
            what = f"{at.name} goes from {least:g} to {high:g} mm over the travel ({at.total}; zero"
            more = f"offset {offset:g} mm); allowed: above 0 everywhere, in front of the focal spot"
            raise wrong(f"{what} {more}", asked=[least, high], allowed="> 0")
    found = touching(build_scene(machine, profile), {})
    if found:
        what = f"at home {_pairs(found)}; the safety margin is {machine.safety_margin_mm:g} mm"
        more = (
            "another home, other sizes or places; or say in allowed_contacts that they "
            "are mounted"
        )
        raise wrong(
            f"{what} ({more} on each other)", pairs=[list(pair) for pair, _ in found]
        )


def _pairs(found: Iterable[tuple[tuple[str, str], float]]) -> str:
    """Describe pairs and their gaps [mm]: "apart" by a positive gap, else "touch"."""
    return ", ".join(
        f"{a} and {b} {f'are {gap:.3g} mm apart' if gap > 0.0 else 'touch'}"
        for (a, b), gap in found
    )
