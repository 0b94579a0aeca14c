"""Any use of the pure scanner, in any order, under the eye of the motion oracle.

Two ways: the seeded campaign of `tests/studies/motion_campaign.py` in its short form, and a
rule machine of hypothesis, which shortens what it finds by itself.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)
from motion_campaign import LENGTH, batch
from motion_rules import (
    MACHINES,
    Episode,
    Request,
    Start,
    draw_correction,
    draw_sample,
    draw_start,
    model,
    replay,
    run_episode,
    script_of,
)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("machine", MACHINES)
def test_no_request_brings_anything_into_contact_or_past_a_limit(
    machine: str, seed: int
) -> None:
    tally = batch(machine, seed, 150)
    for number, start, history, what in tally.first.values():
        pytest.fail(f"episode {number}: {what}\n{script_of(start, history)}")


@pytest.mark.slow
def test_the_two_contacts_that_were_seen_are_none_any_more() -> None:
    """Issue 13: a refused move stopped one of two motors, and a stop braked each by itself."""
    home = {name: axis["home"] for name, axis in model("flexray").data["axes"].items()}
    start = Start("flexray", {**home, "mag_obj": 950.0, "mag_det": 1059.0})
    both = {"targets": {"mag_obj": 450.0, "mag_det": 559.0}}
    refused = [
        Request(0.0, "move", both),
        Request(5.0, "move", {"targets": {"mag_obj": 996.0}}),
    ]
    assert replay(start, refused).found == []
    for slow in ("mag_det", "mag_obj"):
        for wait in np.linspace(0.5, 12.0, 24).tolist():
            history = [
                Request(0.0, "set", {"axis": slow, "acceleration": 5.0}),
                Request(0.0, "move", both),
                Request(wait, "stop"),
            ]
            assert replay(start, history).found == []


def test_coupled_motors_keep_in_step_when_a_move_takes_over_from_a_brake() -> None:
    """Campaign seed 45: the brake's acceleration was read with a millionth of rounding in
    it."""
    axes = {
        "ver_det": 71.4006526125655, "tra_tube": 37.01838205712659,
        "tra_det": -206.62811684883826, "tra_obj": 183.06059367946534,
        "mag_obj": 773.2003232501211, "mag_det": 1059.0, "rot_obj": -283.68172267068735,
        "ver_tube": 0.0,
    }  # fmt: skip
    first = {"mag_det": 353.5566, "tra_det": 175.704, "rot_obj": -216.4411}
    second = {"mag_both": 388.7808, "ver_det": 208.0876, "rot_obj": 82.8205}
    history = [
        Request(0.0, "jog", {"axis": "tra_det", "velocity": -35.5496, "lease_s": 5.9564}),
        Request(0.0, "jog", {"axis": "mag_obj", "velocity": -100.0, "lease_s": 4.14}),
        Request(3.74, "set", {"axis": "tra_det", "speed": 37.34842401144517}),
        Request(1.8, "move", {"targets": first}),
        Request(26.67, "reset"),
        Request(0.0, "jog", {"axis": "mag_both", "velocity": 25.6033, "lease_s": 2.9219}),
        Request(0.0, "move", {"targets": second}),
    ]
    assert replay(Start("rig", axes), history).found == []


@pytest.mark.slow
@pytest.mark.campaign
def test_what_stands_in_a_part_after_a_restart_comes_out_and_never_goes_deeper() -> None:
    """Turned boxes and cylinders: their boxes along the axes part while they themselves do
    not."""
    rng = np.random.default_rng(7)
    tally: Counter[tuple[str, str]] = Counter()
    inside = 0
    for _ in range(60):
        episode = Episode(draw_start(rng, str(rng.choice(MACHINES))))
        size = rng.uniform([60.0, 20.0, 20.0], [400.0, 200.0, 90.0]).tolist()
        kind = str(rng.choice(["box", "cylinder"]))
        sample = {"kind": kind, "size": size, "offset": {"rz": rng.uniform(0.0, 180.0)}}
        episode.do(Request(0.0, "restart", {"sample": sample}))
        if episode.scanner.state(episode.now).safety.state != "blocked":
            continue
        inside += 1
        model = episode.model
        for _ in range(6):
            motor = str(rng.choice(model.motors))
            top = float(model.fastest[model.motors.index(motor)])
            speed = float(rng.uniform(-top, top))
            lease = float(rng.uniform(0.2, 5.0))
            asked = {"axis": motor, "velocity": speed, "lease_s": lease}
            episode.do(Request(float(rng.uniform(0.0, 6.0)), "jog", asked))
        episode.finish()
        assert episode.found == []
        tally += episode.counts
    assert inside >= 10, inside
    assert tally["jog", "accepted"] > 0.2 * tally.total()
    assert tally["jog", "refused"] > 0.1 * tally.total()


seeds = st.integers(0, 2**32 - 1)
waits = st.one_of(st.just(0.0), st.floats(0.0, 0.5), st.floats(0.0, 12.0))
parts = st.floats(0.0, 1.0)


class Use(RuleBasedStateMachine):
    """A scanner and whoever uses it; numbers are shares of what a machine allows."""

    episode: Episode

    @initialize(machine=st.sampled_from(MACHINES), seed=seeds)
    def begin(self, machine: str, seed: int) -> None:
        self.episode = Episode(draw_start(np.random.default_rng(seed), machine))
        self.model = self.episode.model
        self.history: list[Request] = []

    def ask(self, wait: float, verb: str, **args: object) -> None:
        self.history.append(Request(wait, verb, dict(args)))
        self.episode.do(self.history[-1])

    def place(self, motor: str, part: float) -> float:
        i = self.model.motors.index(motor)
        low, high = self.model.lower[i], self.model.upper[i]
        return float(min(max(low + part * (high - low), low), high))

    def axis(self, number: int) -> str:
        axes = [*self.model.motors, *self.model.virtual]
        return axes[number % len(axes)]

    def top(self, axis: str, most: np.ndarray) -> float:
        shares = self.model.moves(axis).items()
        return min(float(most[self.model.motors.index(m)]) / abs(f) for m, f in shares)

    @rule(
        wait=waits,
        places=st.dictionaries(st.integers(0, 7), parts, min_size=1, max_size=4),
    )
    def move(self, wait: float, places: dict[int, float]) -> None:
        motors = self.model.motors
        wanted = {motors[i % len(motors)]: part for i, part in places.items()}
        self.ask(
            wait, "move", targets={m: self.place(m, part) for m, part in wanted.items()}
        )

    @rule(wait=waits, gap=st.floats(-20.0, 200.0), middle=parts)
    def meet(self, wait: float, gap: float, middle: float) -> None:
        """Sample and panel are sent to where they are near each other."""
        near, far = self.model.along("object"), self.model.along("detector")
        assert near is not None
        assert far is not None
        at = self.place(near, middle)
        low, high = self.place(far, 0.0), self.place(far, 1.0)
        self.ask(wait, "move", targets={near: at, far: min(max(at + gap, low), high)})

    @rule(wait=waits, number=st.integers(0, 9), steps=st.floats(-300.0, 300.0))
    def move_by(self, wait: float, number: int, steps: float) -> None:
        self.ask(wait, "move", targets={self.axis(number): steps}, relative=True)

    @rule(
        wait=waits,
        number=st.integers(0, 9),
        speed=st.floats(-1.0, 1.0),
        lease=st.floats(0.05, 6),
    )
    def jog(self, wait: float, number: int, speed: float, lease: float) -> None:
        axis = self.axis(number)
        velocity = speed * self.top(axis, self.model.fastest)
        self.ask(wait, "jog", axis=axis, velocity=velocity, lease_s=lease)

    @rule(wait=waits, number=st.integers(0, 9), share=st.floats(0.01, 1.0))
    def set_acceleration(self, wait: float, number: int, share: float) -> None:
        axis = self.axis(number)
        value = share * self.top(axis, self.model.hardest)
        self.ask(wait, "set", axis=axis, acceleration=value)

    @rule(wait=waits, verb=st.sampled_from(["stop", "estop", "reset", "restart"]))
    def plain(self, wait: float, verb: str) -> None:
        self.ask(wait, verb)

    @rule(wait=waits, seed=seeds, late=st.booleans())
    def put_sample(self, wait: float, seed: int, late: bool) -> None:
        sample = draw_sample(np.random.default_rng(seed)) if seed % 4 else None
        self.ask(wait, "sample", sample=sample, late=late)

    @rule(wait=waits, seed=seeds, late=st.booleans())
    def correct(self, wait: float, seed: int, late: bool) -> None:
        values = draw_correction(np.random.default_rng(seed)) if seed % 3 else None
        self.ask(wait, "correction", correction=values, late=late)

    @precondition(
        lambda self: self.episode.scanner.rest_time(self.episode.now) <= self.episode.now
    )
    @rule(legs=st.lists(st.dictionaries(st.integers(0, 7), parts, min_size=1, max_size=3),
                        min_size=1, max_size=4), late=st.booleans())  # fmt: skip
    def programme(self, legs: list[dict[int, float]], late: bool) -> None:
        motors = self.model.motors
        named = [{motors[i % len(motors)]: p for i, p in leg.items()} for leg in legs]
        self.ask(0.0, "programme", late=late,
                 legs=[{m: self.place(m, p) for m, p in leg.items()} for leg in named])  # fmt: skip

    @rule(wait=waits, verb=st.sampled_from(["pause", "resume", "abort", "take"]))
    def job(self, wait: float, verb: str) -> None:
        self.ask(wait, verb)

    @invariant()
    def nothing_was_found(self) -> None:
        found = getattr(self, "episode", None) and self.episode.found
        assert not found, f"{found}\n{script_of(self.episode.start, self.history)}"

    def teardown(self) -> None:
        if hasattr(self, "episode") and not self.episode.found:
            self.episode.finish()
            assert not self.episode.found, script_of(self.episode.start, self.history)


Use.TestCase.settings = settings(max_examples=25, stateful_step_count=20, deadline=None)
TestUse = pytest.mark.slow(Use.TestCase)


def test_a_stop_in_step_with_a_weaker_motor_stays_within_the_travel() -> None:
    """A seed of the campaign: braked apart but in step, the stronger one left its travel."""
    episode, _ = run_episode(np.random.default_rng([31000007, 4]), "rig", LENGTH)
    assert not episode.found, episode.found


def test_a_stop_leaves_no_room_unmade() -> None:
    """Campaign seed 47: a move was free because tra_obj of a resumed programme would have made
    room; a stop, which counted only what moved already, kept tra_obj where it stood."""
    start = Start(
        "rig",
        {
            "ver_tube": 217.86678096107516,
            "ver_det": 102.72087703210462,
            "tra_tube": -158.14345080716308,
            "tra_det": 118.03113937301299,
            "tra_obj": -12.151978443843598,
            "mag_det": 777.6249330893329,
            "mag_obj": 699.96373820169,
            "rot_obj": 214.30718344367767,
        },
        None,
        None,
        0.0,
    )
    history = [
        Request(
            0.0,
            "programme",
            {
                "legs": [
                    {"mag_obj": 609.2125, "tra_tube": -142.3757, "tra_det": 102.7575},
                    {"tra_det": 392.8107, "ver_tube": 222.4249},
                    {
                        "mag_obj": 664.1566,
                        "tra_tube": -58.7531,
                        "tra_det": -206.5107,
                        "ver_tube": 379.0,
                    },
                    {"mag_obj": 567.9669, "tra_tube": -48.6741, "tra_det": -322.9873},
                    {"mag_obj": 567.5748, "tra_det": -387.607, "ver_tube": 246.21},
                ]
            },
        ),
        Request(
            3.74,
            "move",
            {"targets": {"rot_obj": 304.9128, "tra_det": -398.8573, "mag_det": 1059.0}},
        ),
        Request(23.69, "resume", {}),
        Request(37.78, "move", {"targets": {"mag_obj": 733.9812, "ver_tube": 245.6625}}),
        Request(36.84, "resume", {}),
        Request(1.11, "pause", {}),
        Request(4.39, "resume", {}),
        Request(0.08, "pause", {}),
        Request(
            0.19,
            "programme",
            {
                "legs": [
                    {"mag_det": 691.9258},
                    {"mag_det": 1052.3225, "ver_det": 73.8151},
                    {"mag_det": 663.5261, "ver_det": 9.9417},
                ]
            },
        ),
        Request(8.003932, "move", {"targets": {"mag_both": 22.8235}, "relative": True}),
        Request(
            35.0,
            "programme",
            {
                "legs": [
                    {"tra_tube": -17.9467, "tra_obj": -12.7805, "tra_det": -248.6747},
                    {"ver_det": 4.0, "tra_obj": -150.077, "tra_det": 313.4715},
                ]
            },
        ),
        Request(0.3, "pause", {}),
        Request(0.0, "move", {"targets": {"ver_det": 180.6686, "mag_obj": 278.14}}),
        Request(
            11.71, "jog", {"axis": "mag_both", "velocity": -100.0, "lease_s": 0.3757}
        ),
        Request(
            1.8,
            "move",
            {
                "targets": {
                    "ver_det": -176.6686,
                    "rot_obj": -72.3765,
                    "mag_det": -207.3972,
                },
                "relative": True,
            },
        ),
        Request(13.3, "resume", {}),
        Request(0.12, "pause", {}),
        Request(14.71, "jog", {"axis": "tra_tube", "velocity": 50.0, "lease_s": 3.0849}),
        Request(1.65, "jog", {"axis": "rot_obj", "velocity": -180.0, "lease_s": 1.7673}),
        Request(5.57, "jog", {"axis": "rot_obj", "velocity": 148.721, "lease_s": 0.5192}),
        Request(1.04, "resume", {}),
        Request(0.91, "move", {"targets": {"mag_obj": 931.6667}}),
        Request(1.72, "stop", {}),
    ]
    assert replay(start, history).found == []
