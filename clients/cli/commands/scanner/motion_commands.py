"""`flexdt move`, `jog`, `stop`, `estop` and `reset`: motion begun and ended.

The twin checks limits; its error is printed as it comes.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import typer

from flexdt.clients.cli import option_values
from flexdt.clients.cli.boundary import REFUSED
from flexdt.clients.cli.connecting import Twin, on_twin
from flexdt.clients.cli.console import duration, note, say, warn
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient
    from flexdt.protocol.state_model import Stopped

JOG_LEASE_S = 1.0
"""How long an axis goes on after this process has died, in real seconds."""
LONGEST_LEASE_S = 10.0
"""The wire's, on the twin's clock."""
JOG_RENEWED = 0.3
"""After which part of a lease the next one is taken."""
JOG_POLL_S = 0.002


@on_twin
def move(
    twin: Twin,
    targets: list[str] = argument(..., "AXIS=VALUE...", "mm or deg, script's sign."),
    relative: bool = option(False, "Move by these values instead of to them.", "--relative"),
    plan: bool = option(False, "Plan a path around obstacles.", "--plan"),
    shortest: bool = option(False, "Turn rot_obj by the shortest way.", "--shortest"),
    no_wait: bool = option(False, "Return without waiting for the arrival.", "--no-wait"),
) -> Answer:
    """Move axes; several start together."""
    wanted = option_values.assignments(targets)
    with twin() as client:
        try:
            done = client.move(
                wanted, relative=relative, plan=plan, shortest=shortest, wait=not no_wait
            )
        except KeyboardInterrupt:
            note("flexdt: the axes keep moving; `flexdt stop` brakes them")
            raise
    warn(done.warnings)
    yield done
    if done.arrived is False:
        raise CommandError("the move did not end at its target; see `flexdt state`", REFUSED)
    verb = "moving, arrives in" if no_wait else "arrived after"
    yield f"{verb} {duration(done.duration_s)} of the twin's clock"


@on_twin
def jog(
    twin: Twin,
    axis: str = argument(..., "AXIS"),
    velocity: str = argument(..., "VELOCITY", "mm/s or deg/s, signed."),
    seconds: str | None = option(
        None, "Stop after so many seconds of the twin's clock.", "--for", metavar="SECONDS"
    ),
) -> None:
    """Move an axis at a velocity until Ctrl-C, or for a time."""
    speed = option_values.number(velocity, "the velocity")
    lasting = math.inf if seconds is None else option_values.number(seconds, "--for")
    if lasting <= 0:
        raise typer.BadParameter(f"--for {seconds}: the seconds must be more than 0")
    with twin() as client:
        note(f"jogging {axis} at {speed:g}; Ctrl-C stops it")
        try:
            _lease(client, axis, speed, lasting)
        except KeyboardInterrupt:
            note("")
        client.jog(axis, 0.0)
        position = client.state().axes[axis]
    say(f"{axis} braking at {position.position:.4f} {position.unit}")


def _lease(client: TwinClient, axis: str, speed: float, seconds: float) -> None:
    """Jog for so many seconds of the twin's clock, lease after lease, at whatever speed it runs."""
    now, left, shown = client.state(), seconds, ""
    while left > 0:
        pace = math.inf if now.clock.speed_up == "max" else now.clock.speed_up
        lease = min(JOG_LEASE_S * pace, LONGEST_LEASE_S, left)
        jogged = client.jog(axis, speed, lease_s=lease)
        if jogged.duration_s == 0.0:
            return  # at the end of its travel
        for warning in jogged.warnings:  # a contact cuts it short
            if warning != shown:
                note(shown := warning)
        if (
            lease == left
        ):  # it ends by itself, to the moment: counted from after its start, not from before
            now = client.state()
            end = now.time + jogged.duration_s
            while now.time < end and now.axes[axis].moving:
                time.sleep(JOG_POLL_S)
                now = client.state()
            return
        begun = now.time
        time.sleep(max(JOG_POLL_S, JOG_RENEWED * lease / pace))
        now = client.state()
        left -= min(lease, now.time - begun)


@on_twin
def stop(twin: Twin) -> Answer:
    """Bring all motors to rest (pauses a running job)."""
    with twin() as client:
        current = client.stop()
    yield current
    yield f"{_rest(current)}; a running job is paused"


@on_twin
def estop(twin: Twin) -> Answer:
    """Emergency stop: everything halts, X-rays off."""
    with twin() as client:
        current = client.estop()
    yield current
    yield f"emergency stop, {_rest(current)}; `flexdt reset` leaves it"


def _rest(state: Stopped) -> str:
    """How the motors come to rest, in words."""
    stopping = state.stopping
    if stopping is None or not stopping.distances:
        return "nothing moves"
    distances = [f"{n} after {d:.3g} {state.axes[n].unit}" for n, d in stopping.distances.items()]
    hit = f"; {' and '.join(stopping.would_hit)} would collide" if stopping.would_hit else ""
    return f"at rest in {stopping.duration_s:.3g} s: {', '.join(distances)}{hit}"


@on_twin
def reset(twin: Twin) -> Answer:
    """Leave the emergency stop."""
    with twin() as client:
        seen = client.state().safety  # what is released; a twin of before has no number for it
        current = client.reset(seen.stop or None)
    why = f": {current.safety.message}" if current.safety.message else ""
    yield current
    yield f"safety: {current.safety.state}{why}"
