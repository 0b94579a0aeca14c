"""Components in a machine file: what is refused, and with which words."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

from flexdt.twin.collision.convex_solids import box
from flexdt.twin.collision.stages import sample_bodies, stage_bodies
from flexdt.twin.errors import MachineFileError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_machine, parse_machine, profile_of

FLEXRAY = (resources.files("flexdt.twin") / "data/machines/flexray.toml").read_text(
    "utf-8"
)


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
         'axis = "tra_tube"\nsize_mm = [100.0, 100.0, 0.0]', r"size_mm.*allowed: above 0"),
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
    """By hand, from micro_ct: CX and CY go 5 mm either way; the axis is 150 mm from the
    source."""
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
        np.testing.assert_allclose(
            (upper - lower) / 2, half, atol=0.15
        )  # round ones are prisms
        np.testing.assert_allclose((upper + lower) / 2, [0.0, 0.0, middle], atol=0.15)
        assert body.turns.any()
    assert bodies["panel"].origin.tolist() == [0.0, 300.0, 0.0]
    assert not bodies["panel"].slides.any()


CABINET = 'base = "xyzr_cabinet"\nname = "mine"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[axes.D]\n{axis}[geometry]\ndetector_y = {{ D = 1.0 }}",
         "components.panel.axis: must be carried by every motor that .geometry. "
         "gives the detector.*say axis = 'D'"),
        ("[axes.S]\n{axis}[geometry]\nsource_x = {{ S = 1.0 }}", "components.source.axis.*'S'"),
        ("[axes.S]\n{axis}[geometry]\nobject_y = {{ Z = 1.0, S = 1.0 }}",
         "components.turntable.axis: .*gives the object.*'S'"),
        ("[axes.S]\n{axis}[geometry]\nmount_x = {{ S = 1.0 }}", "components.turntable.axis.*'S'"),
        ('[[components]]\nname = "panel"\nanchor = "world"',
         "components.panel.anchor: must be 'detector', for a panel"),
        ('[[components]]\nname = "mount"\naxis = "R"',
         "components.mount.axis: must be a motor that no part which carries this one has"),
        ('[[components]]\nname = "panel"\ncenter_mm = [40.0, 30.0, 0.0]',
         "components.panel.center_mm: must be such that the box, .* mm, holds the active area"),
        ('[[components]]\nname = "panel"\nsize_mm = [398.0, 60.0, 460.0]', "the active area"),
        ('[[components]]\nname = "source"\ncenter_mm = [0.0, -151.0, 0.0]', "the focal spot"),
        ('[[components]]\nname = "turntable"\ncenter_mm = [61.0, 0.0, -80.0]',
         "components.turntable.center_mm: .*the rotation axis"),
        ('[[components]]\nname = "panel"\nrole = ""',
         "components: must be one component with role = 'panel'"),
        ('[[components]]\nname = "floor"\nrole = "tube"', "one component with role = 'tube'"),
        ('without = ["turntable"]', "one component with role = 'sample_holder'"),
        ('[[components]]\nname = "sample"\nsize_mm = [1.0, 1.0, 1.0]\ncenter_mm = [0.0, 0.0, 0.0]',
         "components.sample.name: must be another name"),
        ('[[components]]\nname = "panel"\nsource = "a"\n[[components]]\nname = "panel"\n'
         "size_mm = [1.0, 1.0, 1.0]\ncenter_mm = [0.0, 0.0, 0.0]",
         "components.panel.name: must be a name that is used once"),
        ('[[components]]\nname = ""\nsize_mm = [1.0, 1.0, 1.0]\ncenter_mm = [0.0, 0.0, 0.0]',
         "components.8.name"),
        ("[geometry]\ndetector_y = {{ Z = -1.0 }}\n[fixed]\ndetector_y = 1600.0\n[[components]]\n"
         'name = "panel"\naxis = "Z"\n[[components]]\nname = "table"\nparent = "panel"\n'
         'anchor = "object"\nsize_mm = [1.0, 1.0, 1.0]\ncenter_mm = [0.0, 0.0, 0.0]',
         "components.table.anchor: must be 'detector', as that of the part that carries it, panel"),
        ("[fixed]\nmount_x = 200.0", "fixed.mount_x: must be left out where no stage"),
        ("[axes.S]\n{axis}[geometry]\nmount_x = {{ S = 1.0 }}\n[[components]]\nname = 'lift'\n"
         "axis = 'S'\n", "components.lift.axis: must be carried by the turntable"),
        ("[axes.S]\n{axis}[geometry]\nmount_x = {{ S = 1.0 }}\nobject_z = {{ }}\n[[components]]\n"
         "name = 'lift'\naxis = 'R'\n[[components]]\nname = 'turntable'\naxis = "
         "'S'\nrole = ''\n"
         "[[components]]\nname = 'x_carriage'\naxis = 'S'\n",
         "components.x_carriage.axis: must be carried by the turntable"),
        ('[[components]]\nname = "source"\nshape = "cylinder"\nsize_mm = [200.0, 200.0, 200.0]\n'
         "center_mm = [80.0, -80.0, 0.0]", "components.source.center_mm: .*the cylinder"),
        ('[[components]]\nname = "panel"\nshape = "cylinder"\nsize_mm = [460.0, 460.0, 460.0]\n'
         "center_mm = [0.0, 230.0, 0.0]", "the cylinder, .* holds the active area"),
        ("[axes.camera]\n{axis}[geometry]\nobject_x = {{ camera = 1.0 }}",
         "axes.camera: must be another name"),
        ('[axes."a\\tb"]\n{axis}[geometry]\nobject_x = {{ "a\\tb" = 1.0 }}', "axes"),
        ('components = ["panel"]', "components must be tables"),
        ("axes = 3", "axes must be a table"),
        ("[fixed]\nobject_x = 1e308", "fixed.object_x"),
        ("[geometry]\nobject_x = {{ X = 1e300 }}", "geometry.object_x.X"),
        ("[detector]\ncolumns = 1" + 400 * "0", "a number is too large"),
        ("schema = " + 5000 * "1", "not valid TOML"),
        ("schema = " + 4000 * "[", "not valid TOML"),
        ("[fixed]\nangle = 30.0", "fixed: must be a known quantity that slides"),
        ("[geometry]\nobject_x = {{ X = 0.0 }}",
         "geometry.object_x.X: must be a number other than 0, or left out"),
    ],
)  # fmt: skip
def test_what_moves_the_image_moves_the_body(text: str, message: str) -> None:
    axis = (
        "lower = 0.0\nupper = 50.0\nhome = 0.0\nspeed = 5.0\nmax_speed = 5.0\n"
        "acceleration = 5.0\nmax_acceleration = 5.0\n"
    )
    with pytest.raises(MachineFileError, match=message):
        parse_machine(
            CABINET + text.replace("{axis}", axis).replace("{{", "{").replace("}}", "}")
        )


def test_nothing_takes_away_what_the_base_has() -> None:
    mine = parse_machine(CABINET + '[[components]]\nname = "z_carriage"\nparent = ""\n')
    assert next(c for c in mine.components if c.name == "z_carriage").parent is None


def drawn_file(rng: np.random.Generator) -> tuple[str, dict[str, dict[str, float]]]:
    """A machine file whose quantities are drawn sums of motors, some shared, and those sums."""
    quantities = ["source_x", "source_z", "object_x", "object_y", "object_z", "detector_x",
                  "detector_y", "detector_z"]  # fmt: skip
    shares: dict[str, dict[str, float]] = {q: {} for q in quantities}
    motors = [f"M{i}" for i in range(int(rng.integers(1, 7)))]
    for motor in motors:
        for quantity in rng.choice(quantities, int(rng.integers(1, 4)), replace=False):
            shares[quantity][motor] = float(rng.choice([-2.0, -1.0, -0.5, 0.5, 1.0, 3.0]))
    fixed = {"object_y": 400.0, "detector_y": 900.0}
    fixed |= {q: float(rng.uniform(-20, 20)) for q in quantities if rng.random() < 0.3}
    fixed["detector_y"] += 600.0
    text = (
        'base = "xyzr_cabinet"\nname = "drawn"\nwithout = ["X", "Y", "Z", "floor", "z_carriage", '
        '"x_carriage", "lift"]\nallowed_contacts = []\n[geometry]\n'
    )
    text += "".join(
        f"{q} = {{ {', '.join(f'{m} = {f}' for m, f in of.items())} }}\n"
        for q, of in shares.items()
    )
    text += "[fixed]\n" + "".join(f"{q} = {v}\n" for q, v in fixed.items())
    for motor in motors:
        text += (
            f"[axes.{motor}]\nlower = -50.0\nupper = 50.0\nhome = 0.0\nspeed = 5.0\n"
            "max_speed = 9.0\nacceleration = 5.0\nmax_acceleration = 9.0\n"
        )
    for anchor, part in (
        ("source", "source"),
        ("object", "turntable"),
        ("detector", "panel"),
    ):
        used = {m for q in quantities if q.startswith(anchor) for m in shares[q]}
        parent = ""
        for motor in sorted(used):
            text += (
                f'[[components]]\nname = "{anchor}_{motor}"\nparent = "{parent}"\n'
                f'axis = "{motor}"\nanchor = "{anchor}"\nsize_mm = [1.0, 1.0, 1.0]\n'
                "center_mm = [0.0, 0.0, -400.0]\n"
            )
            parent = f"{anchor}_{motor}"
        text += f'[[components]]\nname = "{part}"\nparent = "{parent}"\n'
    return text, shares | {"fixed": fixed}


def renamed(text: str) -> str:
    """The same file with parts of its own instead of the base's, after those that carry
    them."""
    base = builtin_machine("xyzr_cabinet")
    parts = {c.name: c for c in base.components}
    for name in ("source", "turntable", "panel"):
        part = parts[name]
        own = f'[[components]]\nname = "own_{name}"\n'
        own += f'axis = "{part.axis or ""}"\nanchor = "{part.anchor}"\nrole = "{part.role}"\n'
        own += f'shape = "{part.shape}"\nsize_mm = {list(part.size_mm)}\n'
        own += f"center_mm = {list(part.center_mm)}\n"
        text = text.replace(f'[[components]]\nname = "{name}"\n', own)
    return text.replace(
        '"lift"]\nallowed', '"lift", "source", "turntable", "mount", "panel"]\nallowed'
    )


@pytest.mark.parametrize("seed", range(40))
def test_bodies_of_drawn_machines_stand_where_own_sums_put_them(seed: int) -> None:
    rng = np.random.default_rng(900 + seed)
    text, shares = drawn_file(rng)
    machine = parse_machine(renamed(text))
    profile = profile_of(machine).model_copy(
        update={
            n: float(rng.uniform(-3, 3))
            for n in ("det_tan", "src_ort", "axs_tan", "c_det")
        }
    )
    at = {m: float(rng.uniform(-50, 50)) for m in machine.axes if m != "R"}
    offset = {"source_z": profile.src_ort, "object_x": profile.axs_tan,
              "detector_x": profile.det_tan, "detector_y": profile.c_det}  # fmt: skip
    bodies = {b.name: b for b in stage_bodies(machine, profile)}
    [sample] = sample_bodies(machine, profile, (box((10.0, 20.0, 30.0)),))
    q = np.array([at.get(n, 0.0) for n in machine.axes])
    for anchor, body in (("source", bodies["own_source"]), ("object", sample),
                         ("detector", bodies["own_panel"])):  # fmt: skip
        expected = [
            shares["fixed"].get(f"{anchor}_{c}", 0.0)
            + offset.get(f"{anchor}_{c}", 0.0)
            + sum(f * at[m] for m, f in shares.get(f"{anchor}_{c}", {}).items())
            for c in "xyz"
        ]
        np.testing.assert_allclose(body.origin + q @ body.slides, expected, atol=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_drawn_machines_with_one_motor_left_behind_are_refused(seed: int) -> None:
    rng = np.random.default_rng(700 + seed)
    text = renamed(drawn_file(rng)[0])
    parse_machine(text)
    lines = text.splitlines()
    carriers = [i for i, line in enumerate(lines) if line.startswith('axis = "M')]
    i = int(rng.choice(carriers))
    lines[i] = 'axis = ""'
    with pytest.raises(MachineFileError, match="must be carried by every motor"):
        parse_machine("\n".join(lines))


def test_what_has_a_role_follows_every_offset() -> None:
    """A correction moves the sample of micro_ct, and pin and mount with it, by the same."""
    machine = builtin_machine("micro_ct")
    profile = profile_of(machine).model_copy(update={"axs_tan": 3.0})
    moved = Offsets(dO_x=4.0, dO_y=1.0, dO_z=-2.0)
    bodies = {b.name: b for b in stage_bodies(machine, profile, moved)}
    [sample] = sample_bodies(machine, profile, (box((1.0, 1.0, 1.0)),), moved)
    np.testing.assert_allclose(bodies["pin"].origin, sample.origin)
    assert abs(sample.origin[0]) == pytest.approx(7.0)


def test_a_motor_of_the_turntables_stage_leaves_the_panel_as_it_is() -> None:
    text = (
        'base = "micro_ct"\nname = "both"\n[geometry]\ndetector_z = { CX = 1.0 }\n'
        "mount_x = { CX = 1.0, CY = 1.0 }\n[fixed]\nmount_x = -300.0\n[axes.CX]\nlower = -2.0\n"
        "upper = 8.0\n[axes.CY]\nlower = 295.0\n"
        'upper = 305.0\nhome = 300.0\n[[components]]\nname = "panel"\naxis = "CX"\n'
    )
    machine = parse_machine(text)
    panel = next(
        b for b in stage_bodies(machine, profile_of(machine)) if b.name == "panel"
    )
    lower, upper = panel.solid.bounds()
    np.testing.assert_allclose([lower[0], upper[0]], [-70.0, 70.0])
    # The sample: 5 mm from its middle, which goes from -2 + 295 - 300 to 8 + 305 - 300 along x.
    [sample] = sample_bodies(machine, profile_of(machine), (box((10.0, 20.0, 30.0)),))
    lower, upper = sample.solid.bounds()
    np.testing.assert_allclose([lower[:2], upper[:2]], [[-12.0, 285.0], [18.0, 315.0]])
