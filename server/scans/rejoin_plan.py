"""How a scanner gets back onto a plan: the pose to return to, and the programme from there on.

A plan may be left while an axis moves (a fly scan). To rejoin it at plan time tau, each moving
axis goes back to where its run-up would begin, speeds up, and passes the plan's position with
the plan's velocity at one moment common to all; from there the plan's own trajectories
continue. All of it is plain calculation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import Piece, Trajectory
from flexdt.twin.script import ScanPlan

# How a scanner gets back onto a plan: the pose to return to, and the programme from there on.
#
# A plan may be left while an axis moves (a fly scan). To rejoin it at plan time tau, each moving
# axis goes back to where its run-up would begin, speeds up, and passes the plan's position with the
# plan's velocity at one moment common to all; from there the plan's own trajectories continue. All
# of it is plain calculation.


@dataclass(frozen=True)
class Rejoin:
    """The motions that lead to `plan` at plan time `tau`.

    Attributes:
        start: axis -> position at rest from which to begin [mm, deg].
        run_up_s: from that rest to being on the plan.
    """

    plan: ScanPlan
    tau: float
    start: Mapping[str, float]
    run_up_s: float
    _motion: Mapping[str, tuple[float, float, float]]

    def programme(self) -> dict[str, tuple[Trajectory, ...]]:
        """Compute the motion of all axes from rest at `start`: a run-up, then the rest of
        the plan from `tau` on.

        Each run-up has constant acceleration and ends, at `run_up_s`, with the plan's
        position and velocity; a faster axis begins later.

        Returns:
            Axis -> trajectories, on a clock that is 0 when the motion begins [s]; axes
            that stay are left out.
        """
        join = self.run_up_s
        out = {}
        for axis, (position, velocity, acceleration) in self._motion.items():
            run_up: tuple[Trajectory, ...] = ()
            if velocity != 0.0:
                begin = join - abs(velocity) / acceleration
                if velocity > 0:
                    rate = acceleration
                else:
                    rate = -acceleration
                piece = Piece(begin, self.start[axis], 0.0, rate)
                run_up = (Trajectory((piece,), join, position),)
            rest = _remaining(self.plan.trajectories.get(axis, ()), self.tau)
            if run_up or rest:
                out[axis] = run_up + tuple(t.shifted(join - self.tau) for t in rest)
        return out


def rejoin(plan: ScanPlan, tau: float, accelerations: Mapping[str, float]) -> Rejoin:
    """Compute from which pose at rest, and with which run-up, a scanner joins `plan` at time
    `tau`.

    An axis starts behind its position at `tau` by its braking distance. The run-up lasts as long
    as that of the slowest axis.

    `plan`: the scan; `tau`: time on the plan's clock [s]; `accelerations`: axis -> acceleration
    of its run-up [mm/s^2, deg/s^2].
    """
    start = {}
    moving = {}
    run_up = 0.0
    for axis, path in plan.paths.items():
        position, velocity = float(path.positions(tau)), float(path.velocities(tau))
        acceleration = accelerations[axis]
        start[axis] = position - velocity * abs(velocity) / (2.0 * acceleration)
        moving[axis] = (position, velocity, acceleration)
        run_up = max(run_up, abs(velocity) / acceleration)
    return Rejoin(plan, tau, start, run_up, moving)


def _remaining(
    trajectories: tuple[tuple[float, Trajectory], ...], tau: float
) -> tuple[Trajectory, ...]:
    """Select an axis's motion from plan time `tau` [s] on; one under way is cut there.

    `trajectories`: (start [s], trajectory), by time.
    """
    begun = [t for time, t in trajectories if time <= tau]
    later = tuple(t for time, t in trajectories if time > tau)
    if not begun or tau >= begun[-1].end:
        return later
    return (motion.continued(begun[-1], tau), *later)
