"""E-stop, reset, blocked attempts and motion cut short, with a wall as the guard."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from flexdt.twin.errors import CollisionError, GeometryError, LimitError, SafetyError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample, StagePlacement, readout

M = builtin_machine()


@dataclass(frozen=True)
class Touch:
    pair: tuple[str, str]
    time: float
    last_free: Mapping[str, float]
    last_free_time: float
    clearance_mm: float = 0.0


@dataclass(frozen=True)
class Wall:
    """A wall that the sample stage must stay above, but only while tra_obj is above zero."""

    mag_obj_below: float

    def touching(
        self, positions: Mapping[str, float], *, deep: bool = False
    ) -> dict[tuple[str, str], float]:
        near = positions["mag_obj"] < self.mag_obj_below and positions["tra_obj"] >= 0.0
        return {("sample", "wall"): 0.0} if near else {}

    def standing(self, positions: Mapping[str, float]) -> Wall:
        return self

    def __call__(
        self, trajectories: Mapping[str, Trajectory], now: float
    ) -> Touch | None:
        mag_obj_below = self.mag_obj_below
        end = max(now, *(t.end for t in trajectories.values()))
        times = np.linspace(now, end, 4001)
        y = trajectories["mag_obj"].positions(times)
        x = trajectories["tra_obj"].positions(times)
        hit = np.flatnonzero((y < mag_obj_below) & (x >= 0.0))
        if not len(hit):
            return None
        free, touch = float(times[max(0, hit[0] - 1)]), float(times[hit[0]])
        for _ in range(40):
            middle = 0.5 * (free + touch)
            at = {n: t.position(middle) for n, t in trajectories.items()}
            if at["mag_obj"] < mag_obj_below and at["tra_obj"] >= 0.0:
                touch = middle
            else:
                free = middle
        last = {n: t.position(free) for n, t in trajectories.items()}
        return Touch(("sample", "wall"), touch, last, free)


def scanner(below: float = 500.0) -> ScannerTwin:
    profile = builtin_profile(M.default_profile)
    return ScannerTwin(M, profile, guard=Wall(below))


def test_one_motor_halts_at_its_last_free_position_and_the_attempt_is_counted() -> None:
    s = scanner()
    with pytest.raises(
        CollisionError, match=r"sample and wall .*blocked attempt 1 of 3"
    ) as e:
        s.move({"mag_obj": 300.0}, 0.0)
    assert e.value.data["pair"] == ["sample", "wall"]
    halt = s.targets(0.0)["mag_obj"]
    assert 500.0 <= halt < 500.2
    assert halt == e.value.data["halts_at"]["mag_obj"]
    now = s.rest_time(0.0)
    assert s.positions(now)["mag_obj"] == halt
    assert s.safety.blocked_attempts == 1
    s.move({"mag_obj": 600.0}, now)
    assert s.safety.blocked_attempts == 0


def test_the_third_blocked_attempt_in_a_row_aborts_and_only_a_reset_helps() -> None:
    s = scanner()
    for _ in range(3):
        with pytest.raises(CollisionError):
            s.move({"mag_obj": 300.0}, 0.0)
    assert s.safety.state == "blocked"
    assert not s.moving(0.0)
    with pytest.raises(SafetyError, match=r"blocked 3 times in a row.*reset"):
        s.move({"mag_obj": 700.0}, 0.0)
    s.reset(99.0)
    s.move({"mag_obj": 700.0}, 0.0)
    assert s.targets(0.0)["mag_obj"] == 700.0


def test_several_motors_brake_in_time_while_others_go_on() -> None:
    s = scanner()
    with pytest.raises(CollisionError):
        s.move({"mag_obj": 300.0, "tra_obj": 50.0, "rot_obj": 90.0}, 0.0)
    times = np.linspace(0.0, s.rest_time(0.0), 5000)
    path = s.trajectories(0.0)
    assert path["mag_obj"].positions(times).min() >= 500.0
    assert path["mag_obj"].target < 502.0
    assert path["rot_obj"].target > 0.0


def test_a_path_around_the_wall_is_free() -> None:
    s = scanner()
    s.move({"tra_obj": -50.0}, 0.0)
    now = s.rest_time(0.0)
    s.move({"mag_obj": 300.0}, now)
    assert s.targets(now)["mag_obj"] == 300.0


def test_a_jog_runs_as_far_as_it_is_free_and_then_is_an_error() -> None:
    s = scanner()
    s.jog("mag_obj", -50.0, 60.0, 0.0)
    assert 500.0 <= s.targets(0.0)["mag_obj"] < 500.2
    assert s.safety.blocked_attempts == 0
    now = s.rest_time(0.0)
    with pytest.raises(CollisionError):
        s.jog("mag_obj", -50.0, 60.0, now)
    assert s.safety.blocked_attempts == 1


def test_estop_brakes_harder_than_stop_switches_xrays_off_and_refuses_until_reset() -> (
    None
):
    s = scanner()
    s.set_tube(on=True)
    s.move({"mag_det": 200.0}, 0.0)
    s.estop(3.0)
    braking = s.trajectories(3.0)["mag_det"].duration
    assert braking == pytest.approx(50.0 / M.axes["mag_det"].max_acceleration)
    assert not s.tube.on
    for refused in (
        lambda: s.move({"mag_det": 300.0}, 9.0),
        lambda: s.jog("mag_det", 1.0, 1.0, 9.0),
        lambda: s.prepared({}, 9.0),
        lambda: s.set_tube(on=True),
    ):
        with pytest.raises(SafetyError, match="E-stop"):
            refused()
    s.stop(9.0)  # always allowed
    assert s.safety.state == "estopped"
    s.reset(99.0)
    s.move({"mag_det": 300.0}, 9.0)
    assert s.targets(9.0)["mag_det"] == 300.0
    assert not s.tube.on  # nothing starts by itself


def test_settings_are_checked_and_kept_when_refused() -> None:
    s = scanner()
    with pytest.raises(LimitError, match=r"kV 91 is outside \[0, 90\]"):
        s.set_tube(kV=91.0, power_W=10.0)
    assert s.tube.power_W == 50.0
    with pytest.raises(LimitError, match="exposure_ms"):
        s.set_camera(exposure_ms=0.0)
    with pytest.raises(LimitError, match="1535"):
        s.set_camera(roi=Roi(0, 0, 1943, 1536))
    with pytest.raises(LimitError, match="averages"):
        s.set_camera(averages=0)
    s.set_camera(mode="HW1SW1High", averages=2)
    assert s.camera.shape == (1520, 1912)
    assert s.pixel_mm == 0.0748
    for bad in (0.0, -1.0, 51.0, float("nan")):
        with pytest.raises(LimitError, match="speed"):
            s.set_axis("mag_obj", speed=bad)


def test_readouts_of_listing_1() -> None:
    s = scanner(below=0.0)
    at = {"ver_tube": 40.0, "ver_det": 33.696938, "tra_det": 25.319824, "mag_obj": 660.0}
    s.move(at, 0.0)
    r = s.state(1e3).readout
    assert r is not None
    # By hand: SOD 660 + 14.9192, SDD 1059 + 40.0008; voxel = pixel * SOD / SDD.
    assert r.SOD_mm == pytest.approx(674.9192)
    assert r.SDD_mm == pytest.approx(1099.0008)
    assert r.magnification == pytest.approx(1099.0008 / 674.9192)
    assert r.voxel_size_mm == pytest.approx(0.1496 * 674.9192 / 1099.0008)
    assert r.field_of_view_mm[0] == pytest.approx(956 * r.voxel_size_mm)
    assert r.piercing_point_px[0] == pytest.approx(477.5, abs=0.02)
    # ver_tube - 6.2917 = 33.7083 against ver_det 33.6969: the foot is 0.0114 mm above the
    # centre. The axis stands at axs_tan = -0.5405: magnified, in pixels of 0.1496 mm, from the
    # centre.
    assert r.axis_column_px == pytest.approx(
        477.5 + (-0.5405 * r.magnification + 0.0015) / 0.1496, abs=0.02
    )
    assert r.piercing_point_px[1] == pytest.approx(379.5 - 0.011362 / 0.1496, abs=1e-3)


def test_a_correction_replaces_the_last_and_shows_in_cone_vec_and_readout() -> None:
    s = scanner()
    nominal = s.cone_vec(0.0)
    one = NamedCorrection("one", "2026-01-01T00:00:00Z", Offsets(dO_z=3.0))
    s.initialise_stage(Sample(), one, None, 0.0)
    two = replace(one, name="two", parameters=Offsets(dO_z=5.0, tau_x=1.0))
    s.take_stage(s.stage_change(Sample(), two, None, 0.0).certified(), 0.0)
    assert s.cone_vec(0.0) == s.poses(0.0).cone_vec(Offsets(dO_z=5.0, tau_x=1.0))
    before, after = s.poses(0.0).sod[0], s.state(0.0).readout
    assert after is not None
    assert after.SOD_mm == pytest.approx(before + 5.0)
    s.take_stage(s.stage_change(Sample(), None, None, 0.0).certified(), 0.0)
    assert s.cone_vec(0.0) == nominal
    with pytest.raises(GeometryError):
        s.stage_change(
            Sample(), replace(one, parameters=Offsets(dD_z=-3000.0)), None, 0.0
        )
    with pytest.raises(GeometryError, match="behind the source"):
        s.stage_change(Sample(), replace(one, parameters=Offsets(dO_z=-90.0)), None, 0.0)
    assert s.correction is None


def test_a_correction_is_accepted_only_if_every_pose_has_a_geometry() -> None:
    """With a yaw, lateral travel counts along the beam. What is accepted has a readout at
    every corner of the travel, whatever the region of interest; what is refused names a
    pose at which there is none, or the panel needs its region's centre."""
    s, draw, accepted = scanner(), np.random.default_rng(11), 0
    machine, camera = s.machine, s.camera
    ends = {name: (a.lower, a.upper) for name, a in machine.axes.items()}
    tilts = ["det_yaw", "det_pitch", "det_roll", "axis_tilt_x", "axis_tilt_z"]
    for _ in range(60):
        drawn = {name: float(draw.uniform(-8.0, 8.0)) for name in tilts}
        drawn |= {
            "dO_z": float(draw.uniform(-40.0, 40.0)),
            "alpha": float(draw.uniform(-90.0, 90.0)),
        }
        correction = NamedCorrection.from_edge("drawn", "2026-01-01T00:00:00Z", drawn, "")
        corners = {name: draw.choice(end, 100) for name, end in ends.items()}
        refusal: GeometryError | None = None
        try:
            s.require_applicable(correction)
        except GeometryError as error:
            refusal = error
        if refusal is not None:
            pose = refusal.data["pose"]
            assert isinstance(pose, dict)
            assert all(pose[name] in ends[name] for name in pose)
            assert all(f"{name} {x:g}" in refusal.message for name, x in pose.items())
            continue
        accepted += 1
        roi = Roi(0, 0, 63, 63) if draw.random() < 0.5 else camera.roi
        poses = s.poses_at(corners, replace(camera, roi=roi))
        for i in range(len(poses)):
            seen = readout(
                poses[i : i + 1], camera, machine.detector.pixels, correction.parameters
            )
            assert seen is not None
            assert all(np.isfinite(np.ravel(x)).all() for x in vars(seen).values())
    assert 10 < accepted < 50


def test_the_five_requests_that_silenced_a_twin_are_refused_at_the_first() -> None:
    with pytest.raises(GeometryError, match="tra_tube 419, tra_obj -234, mag_obj 70"):
        scanner().require_applicable(
            NamedCorrection.from_edge("yaw", "2026-01-01T00:00:00Z", {"det_yaw": 8.0}, "")
        )


def test_a_readout_follows_whatever_it_is_made_of() -> None:
    """A scanner asked after every change says the same as one that is asked for the first
    time."""
    draw = np.random.default_rng(8)
    asked, time = scanner(), 0.0
    seen = set()
    for _ in range(40):
        match draw.integers(4):
            case 0:
                asked.move({"mag_obj": draw.uniform(100.0, 300.0)}, time)
            case 1:
                asked.move({"rot_obj": draw.uniform(-90.0, 90.0)}, time)
            case 2:
                left, top = (int(n) for n in draw.integers(0, 200, 2))
                asked.set_camera(roi=Roi(left, top, left + 799, top + 599))
            case _:
                offsets = Offsets(
                    dO_z=draw.uniform(-5.0, 5.0), tau_x=draw.uniform(-1.0, 1.0)
                )
                asked.initialise_stage(
                    Sample(),
                    NamedCorrection("c", "2026-01-01T00:00:00Z", offsets),
                    None,
                    time,
                )
        rest = asked.rest_time(time) + 1.0
        for now in (time, time + 1.0, rest):
            fresh = readout(
                asked.poses(now), asked.camera, M.detector.pixels, asked.parameters
            )
            assert asked.state(now).readout == fresh
            seen.add(fresh)
        time = rest
    assert len(seen) > 40


def test_sample_offset_moves_the_geometry_the_other_way() -> None:
    """A point of the sample, placed by hand, has the same shadow as in the sample's own
    frame."""
    s = scanner()
    cone = s.cone_vec(0.0)
    offset = StagePlacement(x=3.0, y=-2.0, z=7.0, rx=90.0, rz=90.0)
    point = np.array([1.0, 2.0, 3.0])
    # R_x(90): (1, -3, 2); R_z(90): (3, 1, 2); plus the shift.
    placed = np.array([3.0 + 3.0, 1.0 - 2.0, 2.0 + 7.0])
    shape = s.camera.shape
    np.testing.assert_allclose(
        offset.to_sample(cone).project_points(point, shape),
        cone.project_points(placed, shape),
        atol=1e-9,
    )
    s.initialise_stage(Sample("lego", offset), None, s.guard, 0.0)
    assert s.state(0.0).sample.offset.rx == 90.0
    with pytest.raises(LimitError, match="finite"):
        StagePlacement(x=float("nan"))
