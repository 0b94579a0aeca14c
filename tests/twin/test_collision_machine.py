"""Components in a machine file: what is refused, and with which words."""

from __future__ import annotations

from importlib import resources

import pytest

from flexdt.twin.errors import MachineFileError
from flexdt.twin.machine.description import builtin_machine, parse_machine

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
