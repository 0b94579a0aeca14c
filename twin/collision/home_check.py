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
    """Check the machine at home and over its travel: source, sample and panel in order,
    nothing touching at home.

    In this order; the first failure is raised: 0 < SOD < SDD at home; then, with the
    profile's offsets, the rotation axis and the panel in front of the focal spot over the
    whole travel; then no pair within the safety margin at home, but those of
    `allowed_contacts`.

    Args:
        machine: read from `file`.
        profile: its zero offsets.
        file: for the error.

    Raises:
        MachineFileError: file, problem and place.
    """

    def wrong(message: str, **data: object) -> MachineFileError:
        """Make the error for the key path `axes` of the file, with `data` added;
        returned, not raised.
        """
        return MachineFileError(
            f"{file}: axes: {message}", {"file": file, "path": "axes", **data}
        )

    stage = place(machine, "object_y")
    panel = place(machine, "detector_y")
    sod = stage.home
    sdd = panel.home
    if not (math.isfinite(sod) and 0.0 < sod < sdd):
        message = f"at home SOD is {sod:g} mm and SDD {sdd:g} mm; allowed: 0 < SOD < SDD"
        more = "(flexdt machine check prints what they are the sum of)"
        raise wrong(f"{message} {more}", sod=sod, sdd=sdd)
    for at, offset in ((stage, profile.c_obj), (panel, profile.c_det)):
        least = at.least + offset
        high = at.most + offset
        if least <= 0.0:
            message = (
                f"{at.name} goes from {least:g} to {high:g} mm over the travel "
                f"({at.total}; zero"
            )
            more = f"offset {offset:g} mm); allowed: above 0 everywhere, in front of the focal spot"
            raise wrong(f"{message} {more}", asked=[least, high], allowed="> 0")
    pairs = touching(build_scene(machine, profile), {})
    if pairs:
        message = f"at home {_pairs(pairs)}; the safety margin is {machine.safety_margin_mm:g} mm"
        more = (
            "another home, other sizes or places; or say in allowed_contacts "
            "that they are mounted"
        )
        raise wrong(
            f"{message} ({more} on each other)", pairs=[list(pair) for pair, _ in pairs]
        )


def _pairs(gaps: Iterable[tuple[tuple[str, str], float]]) -> str:
    """Describe pairs and their gaps [mm], separated by commas: "apart" by a positive gap,
    else "touch".
    """
    return ", ".join(
        f"{a} and {b} {f'are {gap:.3g} mm apart' if gap > 0.0 else 'touch'}"
        for (a, b), gap in gaps
    )
