"""Components in a machine file: what is refused, and with which words."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

from flexdt.twin.collision.convex_solids import box
from flexdt.twin.collision.stages import sample_bodies, stage_bodies
from flexdt.twin.errors import MachineFileError
from flexdt.twin.machine.description import builtin_machine, parse_machine, profile_of

FLEXRAY = (resources.files("flexdt.twin") / "data/machines/flexray.toml").read_text("utf-8")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('parent = "source_platform"', 'parent = "source_platfrom"',
         r"source_tower.parent: must be a known earlier component: .*value: 'source_platfrom'"),
        ('parent = "source_platform"', 'parent = "detector"',
         "components.source_tower.parent: must be a known earlier component: .*value: 'detector'"),
        ('axis = "tra_tube"', 'axis = "tra_tub"',
         "components.source_tower.axis: must be a known axis: ver_tube, .*value: 'tra_tub'"),
        ('axis = "tra_tube"', 'axis = "tra_det"',
         r"axis: must be a known motor of anchor 'source': tra_tube, ver_tube .*'tra_det'"),
        ('axis = "tra_tube"\nsize_mm = [100.0, 100.0, 1000.0]',
         'axis = "tra_tube"\nsize_mm = [100.0, 100.0, 0.0]', r"size_mm.*greater than 0"),
        ("size_mm = [150.0, 150.0, 20.0]", "size_mm = [150.0, 140.0, 20.0]",
         r"size_mm: must be as wide in x as in y, for a cylinder .*\(150.0, 140.0, 20.0\)"),
        ('role = "panel"', 'role = "plate"', "role"),
        ('["source_tower", "xray_source"]', '["source_tower", "xray"]',
         "allowed_contacts: must be a known component: main_platform, .*value: 'xray'"),
        ('name = "mag_rail_right"', 'name = "mag_rail_left"',
         "components.mag_rail_left.name: must be a name that is used once"),
    ],
)  # fmt: skip
def test_bad_components_are_refused(old: str, new: str, message: str) -> None:
    assert old in FLEXRAY
    with pytest.raises(MachineFileError, match=message):
        parse_machine(FLEXRAY.replace(old, new), "mine.toml")


def test_chains_of_the_flexray() -> None:
    m = builtin_machine()
    named = {c.name: c for c in m.components}
    assert m.chain(named["detector"]) == ("tra_det", "ver_det", "mag_det")
    assert m.chain(named["sample_mount"]) == ("rot_obj", "tra_obj", "mag_obj")
    assert m.chain(named["main_platform"]) == ()


def test_what_a_stage_on_the_turntable_carries_is_as_large_as_its_travel() -> None:
    """By hand, from micro_ct: CX and CY go 5 mm either way; the axis is 150 mm from the source."""
    machine = builtin_machine("micro_ct")
    bodies = {b.name: b for b in stage_bodies(machine, profile_of(machine))}
    [sample] = sample_bodies(machine, profile_of(machine), (box((10.0, 20.0, 30.0)),))
    for body, half, middle in (
        (bodies["turntable"], (60.0, 60.0, 10.0), -80.0),
        (bodies["mount"], (35.0, 30.0, 10.0), -59.0),
        (bodies["pin"], (15.0, 15.0, 9.0), -40.0),
        (sample, (10.0, 15.0, 15.0), 0.0),
    ):
        lower, upper = body.solid.bounds()
        np.testing.assert_allclose(body.origin, [0.0, 150.0, 0.0])
        np.testing.assert_allclose((upper - lower) / 2, half, atol=0.15)  # round ones are prisms
        np.testing.assert_allclose((upper + lower) / 2, [0.0, 0.0, middle], atol=0.15)
        assert body.turns.any()
    assert bodies["panel"].origin.tolist() == [0.0, 300.0, 0.0]
    assert not bodies["panel"].slides.any()
