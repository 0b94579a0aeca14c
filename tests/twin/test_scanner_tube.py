"""When X-rays are ready: a function of the twin's clock and of when the tube was switched."""

from __future__ import annotations

import math

import pytest

from flexdt.twin.errors import LimitError, SafetyError
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_profile,
    builtin_profiles,
)
from flexdt.twin.scanner.scanner import ScannerTwin

M = builtin_machine()
P = builtin_profile(builtin_profiles("flexray")[0])
TAKES = M.timing.xrayon_s + M.timing.xray_ready_s


def scanner(now: float = 0.0) -> ScannerTwin:
    return ScannerTwin(M, P, now)


def test_readiness_is_a_closed_form_of_time() -> None:
    s = scanner()
    assert not s.tube.ready(0.0)
    assert s.tube.ready_in_s(0.0) is None
    s.set_tube(on=True, now=10.0)
    assert [s.tube.ready(t) for t in (10.0, 10.0 + TAKES - 1e-6, 10.0 + TAKES, 1e6)] == [
        False, False, True, True,
    ]  # fmt: skip
    assert s.tube.ready_in_s(11.0) == pytest.approx(TAKES - 1.0)
    assert s.tube.ready_in_s(1e6) == 0.0
    # Asking at any time in any order changes nothing.
    assert s.tube.ready_in_s(10.0) == pytest.approx(TAKES)


def test_switching_what_is_on_and_other_settings_do_not_start_again() -> None:
    s = scanner()
    s.set_tube(on=True, now=0.0)
    s.set_tube(on=True, kV=60.0, now=TAKES - 1.0)
    assert s.tube.ready(TAKES)
    s.set_tube(on=False, now=20.0)
    assert not s.tube.ready(20.0)
    s.set_tube(on=True, now=21.0)
    assert s.tube.ready_in_s(21.0) == pytest.approx(TAKES)


def test_a_tube_that_rested_long_warms_up_but_not_for_a_script() -> None:
    rest = M.tube.cold_after_s + 1.0
    s = scanner(5.0)
    s.set_tube(on=True, now=5.0 + rest)
    assert s.tube.ready_in_s(5.0 + rest) == pytest.approx(TAKES + M.tube.warm_up_s)
    s.set_tube(on=False, now=6.0 + rest)
    s.set_tube(on=True, now=6.0 + 2 * rest, warm=True)
    assert s.tube.ready_in_s(6.0 + 2 * rest) == pytest.approx(TAKES)
    brief = scanner()
    brief.set_tube(on=True, now=M.tube.cold_after_s)
    assert brief.tube.ready_in_s(M.tube.cold_after_s) == pytest.approx(TAKES)


def test_a_refused_setting_and_an_e_stop_leave_no_half_switched_tube() -> None:
    s = scanner()
    with pytest.raises(LimitError):
        s.set_tube(on=True, kV=1e4, now=0.0)
    assert not s.tube.on
    s.set_tube(on=True, now=0.0)
    s.estop(3.0)
    assert (s.tube.on, s.tube.since) == (False, 3.0)
    with pytest.raises(SafetyError):
        s.set_tube(on=True, now=4.0)
    s.reset(99.0)
    s.set_tube(on=True, now=5.0)
    assert s.tube.ready_at == pytest.approx(5.0 + TAKES)


def test_without_a_time_the_switch_was_long_ago() -> None:
    s = scanner()
    s.set_tube(on=True)
    assert s.tube.ready(-1e9)
    assert s.tube.ready_at == -math.inf
