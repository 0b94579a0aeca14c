"""Motion of one motor for any sequence of commands at any times, by hypothesis."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import Piece, Trajectory

positions = st.floats(-7200.0, 7200.0)
speeds = st.floats(1e-3, 200.0)
accelerations = st.floats(1e-2, 500.0)
velocities = st.floats(-200.0, 200.0)
clock = st.floats(0.0, 1e5)
fractions = st.floats(0.0, 1.0)


def tolerance(t: Trajectory) -> float:
    """Rounding allowed in a position: a few ulps of time at the motion's speeds, and of
    size."""
    fastest = max(
        abs(p.velocity) + abs(p.acceleration) * (stop - p.start)
        for p, stop in zip(t.pieces, ends(t), strict=True)
    )
    size = max(abs(t.target), *(abs(p.position) for p in t.pieces))
    last = t.end if math.isfinite(t.end) else t.pieces[-1].start
    return 1e-9 + 1e-12 * size + 8 * np.spacing(abs(last)) * fastest


def ends(t: Trajectory) -> list[float]:
    return [*(p.start for p in t.pieces[1:]), t.end]


def check_sound(t: Trajectory, acceleration: float) -> None:
    """Continuous position and velocity over every knot, bounded acceleration, rest at the
    end."""
    assert all(p.acceleration == 0.0 or math.isclose(abs(p.acceleration), acceleration)
               for p in t.pieces)  # fmt: skip
    starts = [p.start for p in t.pieces]
    assert starts == sorted(starts)
    for p, stop, following in zip(t.pieces, ends(t), [*t.pieces[1:], None], strict=True):
        dt = stop - p.start
        x = p.position + dt * (p.velocity + 0.5 * p.acceleration * dt)
        v = p.velocity + p.acceleration * dt
        x1, v1 = (
            (t.target, 0.0)
            if following is None
            else (following.position, following.velocity)
        )
        assert abs(x - x1) <= tolerance(t)
        assert (
            abs(v - v1)
            <= 1e-9 + 1e-12 * abs(v) + 8 * np.spacing(abs(stop)) * acceleration
        )


@settings(max_examples=400, deadline=None)
@given(positions, velocities, positions, speeds, accelerations, clock)
def test_a_move_from_any_state_arrives_exactly(
    x: float, v: float, target: float, speed: float, acceleration: float, now: float
) -> None:
    t = motion.move(x, v, target, speed, acceleration, now)
    check_sound(t, acceleration)
    assert t.position(t.end) == t.position(t.end + 1e6) == target == t.target
    assert t.velocity(t.end) == 0.0
    assert t.start == now
    assert t.position(now) == pytest.approx(x, abs=tolerance(t))
    assert t.velocity(now) == pytest.approx(v, abs=1e-6 + 1e-3 * math.sqrt(acceleration))
    for time in np.linspace(now, t.end, 23):
        assert abs(t.velocity(time)) <= max(speed, abs(v)) * (1 + 1e-9) + 1e-9


@settings(max_examples=300, deadline=None)
@given(positions, positions, speeds, accelerations, clock)
def test_a_move_from_rest_is_the_trapezoid_of_the_textbook(
    x: float, target: float, speed: float, acceleration: float, now: float
) -> None:
    """Duration d / v + v / a, or 2 sqrt(d / a) when too short to reach v; never past its
    ends."""
    t = motion.move(x, 0.0, target, speed, acceleration, now)
    d = abs(target - x)
    if d >= speed * speed / acceleration:
        expected = d / speed + speed / acceleration
    else:
        expected = 2.0 * math.sqrt(d / acceleration)
    assert t.duration == pytest.approx(expected, rel=1e-9, abs=1e-9 + 8 * np.spacing(now))
    path = t.positions(np.linspace(now, t.end, 101))
    low, high = min(x, target) - tolerance(t), max(x, target) + tolerance(t)
    assert (path >= low).all()
    assert (path <= high).all()
    steps = np.diff(path) * math.copysign(1.0, target - x)
    assert (steps >= -2 * tolerance(t)).all()


@settings(max_examples=300, deadline=None)
@given(positions, positions, speeds, accelerations, fractions)
def test_time_reversal(
    x: float, target: float, speed: float, acceleration: float, fraction: float
) -> None:
    """The way back is the way there run backwards."""
    there = motion.move(x, 0.0, target, speed, acceleration, 0.0)
    back = motion.move(target, 0.0, x, speed, acceleration, 0.0)
    assert there.duration == pytest.approx(back.duration, rel=1e-12)
    time = fraction * there.duration
    allowed = 10 * tolerance(there)
    assert there.position(time) == pytest.approx(
        back.position(back.end - time), abs=allowed
    )
    assert there.velocity(time) == pytest.approx(
        -back.velocity(back.end - time), abs=1e-6 * (1 + acceleration)
    )


commands = st.lists(
    st.tuples(
        st.sampled_from(["move", "stop", "jog", "go on"]),
        st.floats(0.0, 30.0),  # time since the last command
        positions,
        velocities,
        st.floats(0.0, 20.0),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=300, deadline=None)
@given(commands, speeds, accelerations)
def test_any_sequence_of_commands_at_any_times(
    script: list[tuple[str, float, float, float, float]],
    speed: float,
    acceleration: float,
) -> None:
    """Position and velocity go on over every retarget; |v| and |a| stay within the limits."""
    t, now, limit = motion.at_rest(0.0), 0.0, speed
    for name, wait, target, wanted, lease in script:
        now += wait
        x, v = t.position(now), t.velocity(now)
        if name == "jog":
            limit = max(limit, abs(wanted))
        before = t
        t = {
            "move": lambda x=x, v=v, to=target, at=now: motion.move(
                x, v, to, speed, acceleration, at
            ),
            "stop": lambda x=x, v=v, at=now: motion.stop(x, v, acceleration, at),
            "jog": lambda x=x, v=v, w=wanted, lease=lease, at=now: motion.jog(
                x, v, w, lease, acceleration, at
            ),
            "go on": lambda t=t, at=now: motion.continued(t, at),
        }[name]()
        check_sound(t, acceleration)
        assert t.position(now) == pytest.approx(x, abs=tolerance(t) + tolerance(before))
        assert t.velocity(now) == pytest.approx(
            v, abs=1e-6 + 1e-3 * math.sqrt(acceleration)
        )
        assert math.isfinite(t.end)
        for time in np.linspace(now, t.end, 11):
            assert abs(t.velocity(time)) <= limit * (1 + 1e-9) + 1e-9
    assert t.position(t.end) == t.target


@settings(max_examples=200, deadline=None)
@given(
    positions,
    velocities,
    positions,
    speeds,
    accelerations,
    st.lists(fractions, max_size=20),
)
def test_many_positions_at_once_equal_single_ones(
    x: float,
    v: float,
    target: float,
    speed: float,
    acceleration: float,
    parts: list[float],
) -> None:
    t = motion.move(x, v, target, speed, acceleration, 3.0)
    times = np.array([t.start - 1.0, *t.knots, t.end, t.end + 1.0,
                      *(t.start + f * t.duration for f in parts)])  # fmt: skip
    assert t.positions(times).tolist() == [t.position(time) for time in times.tolist()]
    assert t.positions(times.reshape(1, -1)).shape == (1, len(times))


@settings(max_examples=300, deadline=None)
@given(positions, velocities, positions, speeds, accelerations, fractions)
def test_time_at_is_the_first_passage(
    x: float, v: float, target: float, speed: float, acceleration: float, fraction: float
) -> None:
    t = motion.move(x, v, target, speed, acceleration, 0.0)
    assume(t.duration > 1e-6)
    passed = t.position(fraction * t.duration)
    at = t.time_at(passed)
    assert at is not None
    assert 0.0 <= at <= fraction * t.duration + 1e-6 + 1e-9 * t.duration
    assert t.position(at) == pytest.approx(passed, abs=1e-6 + 1e-9 * abs(passed))
    # Nowhere earlier: on a fine grid before it the motor is always on one side.
    earlier = t.positions(np.linspace(0.0, max(0.0, at - 1e-6), 50)) - passed
    far = earlier[np.abs(earlier) > 1e-6 + 1e-9 * abs(passed)]
    assert (far > 0).all() or (far < 0).all()
    beyond = max(x, target) + v * v / (2 * acceleration) + 1.0
    assert t.time_at(beyond) is None


@settings(max_examples=200, deadline=None)
@given(positions, velocities, accelerations)
def test_a_stop_takes_v_squared_over_2_a(x: float, v: float, acceleration: float) -> None:
    t = motion.stop(x, v, acceleration, 1.0)
    check_sound(t, acceleration)
    assert t.target == pytest.approx(
        x + v * abs(v) / (2 * acceleration), abs=1e-9, rel=1e-12
    )
    assert t.duration == pytest.approx(abs(v) / acceleration, abs=1e-12)


@settings(max_examples=200, deadline=None)
@given(positions, velocities, velocities, st.floats(0.0, 60.0), accelerations)
def test_a_jog_runs_for_its_lease(
    x: float, v: float, wanted: float, lease: float, acceleration: float
) -> None:
    t = motion.jog(x, v, wanted, lease, acceleration, 2.0)
    check_sound(t, acceleration)
    ramp = abs(wanted - v) / acceleration
    if ramp + 1e-6 < lease:
        late = t.velocity(2.0 + lease - 1e-7)
        assert late == pytest.approx(wanted, abs=1e-6 * (1 + acceleration))
        assert t.end == pytest.approx(2.0 + lease + abs(wanted) / acceleration, abs=1e-6)
    elif ramp > lease + 1e-6:
        reached = v + math.copysign(acceleration * lease, wanted - v)
        assert t.end == pytest.approx(2.0 + lease + abs(reached) / acceleration, abs=1e-6)


@settings(max_examples=200, deadline=None)
@given(positions, velocities, positions, speeds, accelerations, fractions)
def test_what_is_left_of_a_motion_and_the_same_later_follow_it(
    x: float, v: float, target: float, speed: float, acceleration: float, fraction: float
) -> None:
    t = motion.move(x, v, target, speed, acceleration, 0.0)
    at = fraction * t.duration
    rest = motion.continued(t, at)
    early = np.linspace(0.0, at, 20)
    late = np.linspace(at, t.end + 1.0, 20)
    assert_allclose(rest.positions(late), t.positions(late), atol=10 * tolerance(t))
    moved = t.shifted(7.0)
    assert_allclose(
        moved.positions(early + 7.0), t.positions(early), atol=10 * tolerance(t)
    )


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: motion.move(0, 0, 1, 0.0, 1.0, 0), "speed is 0"),
        (lambda: motion.move(0, 0, 1, 1.0, -1.0, 0), "acceleration is -1"),
        (lambda: motion.move(0, 0, 1, math.inf, 1.0, 0), "speed is inf"),
        (lambda: motion.stop(0, 1, math.nan, 0), "acceleration is nan"),
        (lambda: motion.jog(0, 0, 1, 1.0, 0.0, 0), "acceleration is 0"),
    ],
)
def test_speeds_and_accelerations_must_be_positive(
    build: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        build()


def test_a_motor_that_stands_has_one_moment() -> None:
    for still in (motion.at_rest(5.0, 2.0), motion.move(5.0, 0.0, 5.0, 10.0, 10.0, 2.0)):
        assert (still.start, still.end, still.knots) == (2.0, 2.0, (2.0,))


def test_hand_computed_profile() -> None:
    """100 mm at 50 mm/s and 50 mm/s2: 1 s up, 1 s cruise, 1 s down."""
    t = motion.move(0.0, 0.0, 100.0, 50.0, 50.0, 10.0)
    assert t.pieces == (
        Piece(10.0, 0.0, 0.0, 50.0),
        Piece(11.0, 25.0, 50.0, 0.0),
        Piece(12.0, 75.0, 50.0, -50.0),
    )
    assert t.end == 13.0
    assert [t.position(s) for s in (9.0, 10.5, 11.5, 12.5, 13.0)] == [
        0,
        6.25,
        50,
        93.75,
        100,
    ]
    assert t.time_at(50.0) == 11.5
    assert t.moving(12.999)
    assert not t.moving(13.0)


@pytest.mark.daily(10)
@pytest.mark.parametrize("seed", range(60))
def test_speeds_and_laws_are_those_of_many_moments(seed: int) -> None:
    """What a motion says of itself, against differences of its positions."""
    rng = np.random.default_rng(seed)
    legs = [motion.at_rest(0.0, 1.0)]
    for now in (1.0 + np.cumsum(rng.uniform(0.3, 3.0, 4))).tolist():
        x, v = legs[-1].position(now), legs[-1].velocity(now)
        a = float(rng.uniform(5.0, 60.0))
        legs.append(
            [
                lambda x=x, v=v, a=a, now=now: motion.move(
                    x, v, rng.uniform(-80, 80), rng.uniform(4, 40), a, now
                ),
                lambda x=x, v=v, a=a, now=now: motion.jog(
                    x, v, rng.uniform(-30, 30), 1.0, a, now
                ),
                lambda x=x, v=v, a=a, now=now: motion.stop(x, v, a, now),
            ][rng.integers(3)]()
        )
    t = motion.joined(legs)
    step = 1e-4
    times = np.arange(t.start - 0.5, t.end + 0.5, 1e-2)
    # The knots, found from the positions alone: where second differences of them change.
    x = t.positions(times[:, None] + step * np.arange(-1, 2))
    speed = (x[:, 2] - x[:, 0]) / (2 * step)
    change = (x[:, 2] - 2 * x[:, 1] + x[:, 0]) / step**2
    smooth = ~np.isin(np.arange(len(times)), [
        i for k in (*t.knots, t.end) for i in np.flatnonzero(np.abs(times - k) < 2 * step)
    ])  # fmt: skip
    assert t.top_speed == pytest.approx(np.abs(speed).max(), abs=0.7)
    assert t.top_speed >= np.abs(speed[smooth]).max() - 1e-6
    for i in rng.choice(np.flatnonzero(smooth), 40):
        now = float(times[i])
        later = np.abs(change[i:][smooth[i:]]).max()
        assert t.acceleration(now) >= later - 1e-3
        ends = [p.start for p in t.pieces[1:]] + [t.end]
        long = [abs(p.acceleration) for p, end in zip(t.pieces, ends, strict=True)
                if end > now and end - max(p.start, now) > 0.03]  # fmt: skip
        short = [
            abs(p.acceleration)
            for p, end in zip(t.pieces, ends, strict=True)
            if end > now
        ]
        assert (
            max(long, default=0.0) - 1e-3
            <= t.acceleration(now)
            <= max(short, default=0.0)
        )
        v, a, until = t.law(now)
        assert v == pytest.approx(speed[i], abs=1e-5)
        assert a == pytest.approx(change[i], abs=1e-3)
        assert until > now
        inside = (times >= now) & (times <= until - 2 * step) & smooth
        assert_allclose(change[inside], a, atol=1e-3)
        assert_allclose(speed[inside], v + a * (times[inside] - now), atol=1e-5)
        assert (speed[inside] * v >= -1e-5).all() or v == 0.0
        if math.isfinite(until):  # there it turns round, or another piece begins
            assert abs(v + a * (until - now)) < 1e-6 or until in (*t.knots, t.end)
        assert t.moving(now) is (t.start <= now < t.end)


def test_the_time_of_a_position_is_the_first_that_many_moments_show() -> None:
    """Of 200 drawn motions: passed in a ramp, in a cruise, where it turns round, never."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        x, v = rng.uniform(-20, 20, 2)
        way = motion.move(
            x, v, rng.uniform(-40, 40), rng.uniform(2, 30), rng.uniform(3, 40), 5.0
        )
        times = np.linspace(way.start, way.end, 2001)
        at = way.positions(times)
        low, high = at.min(), at.max()
        for place in (*rng.uniform(low, high, 3), low - 0.1, high + 0.1, way.target):
            found = way.time_at(float(place))
            sides = np.sign(at - place)
            passed = np.flatnonzero(sides[1:] * sides[:-1] <= 0)
            if found is None:
                assert len(passed) == 0 or abs(at - place).min() < 1e-9
                continue
            assert way.position(found) == pytest.approx(place, abs=1e-6)
            if len(passed):
                assert found <= times[passed[0] + 1] + 1e-9
        assert way.time_at(low - 0.1) is way.time_at(high + 0.1) is None


@pytest.mark.parametrize("far", [1.0, 1e4, 1e8])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_earlier_of_two_times_keeps_its_digits(far: float, sign: float) -> None:
    """A place that is passed at once, and again long after."""
    soon = 1e-6 / 3.0
    when = Trajectory(
        (Piece(0.0, 0.0, sign * (soon + far), -2.0 * sign),), 2.0 * far, 0.0
    ).time_at(sign * soon * far)
    assert when == pytest.approx(soon, rel=1e-9)
