"""Drawn histories of E-stops pressed inside slow writes, with kills: what was said holds.

Threads take their time: those of uploads, jobs and settings seconds or for ever, that of the
journal moments, seconds or for ever, each before its work and after. The disk may be full or
broken, and the power is cut at drawn changes of it. The judge looks at answers alone: a state
whose `unsaved` is null comes back after the kill.
"""

from __future__ import annotations

import asyncio
import errno
import math
import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from in_process import script
from simulation import Client, Crashed, Fault, Simulation

from flexdt.protocol import RpcError
from flexdt.testing.in_process import SimulatedLoop

SOON_S = 0.3
"""Time after which a journal whose disk is fast and whole owes nothing [virtual s]."""
ROUNDS = 4
"""Kills in a history."""
VOXELS = {"kind": "voxels", "format": "raw", "shape": [2, 2, 2], "voxel_mm": [1.0] * 3,
          "total": 32, "data": b"\0\0\x80\x3d" * 8}  # fmt: skip


class SlowLoop(SimulatedLoop):
    """Event loop whose threads take drawn times; the journal's has times of its own."""

    journal_s: float = 0.0
    others_s: float = 0.0
    """Mean time before and after a thread's work [virtual s]; math.inf: it hangs."""

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Run `func` after a while, and tell its result after another."""
        assert self._rng is not None
        own = "journal" in getattr(executor, "_thread_name_prefix", "")
        mean = self.journal_s if own else self.others_s
        done: asyncio.Future[Any] = self.create_future()
        if mean == math.inf:
            return done
        before, after = (self._rng.random() * 2 * mean for _ in range(2))
        self.call_later(before, self._work, done, after, func, args)
        return done

    def _work(
        self,
        done: asyncio.Future[Any],
        after: float,
        func: Callable[..., Any],
        args: tuple[Any, ...],
    ) -> None:
        """Do the work now, and complete the future later, unless it is cancelled."""
        try:
            result, error = func(*args), None
        except Exception as problem:
            result, error = None, problem

        def tell() -> None:
            """Complete the future."""
            if done.done():
                return
            if error is None:
                done.set_result(result)
            else:
                done.set_exception(error)

        self.call_later(after, tell)


@dataclass
class Outcome:
    """Of one history."""

    pressed: int = 0
    said_to_be_safe: int = 0
    """Kills at which nothing was unsaved."""
    unsaved: int = 0
    """Kills at which something was."""
    kinds: tuple[str, ...] = ()


def writes(client: Client, rng: random.Random) -> dict[str, tuple[str, dict[str, Any]]]:
    """Slow writes by name: method and parameters."""
    number = rng.randint(0, 10**6)
    return {
        "upload": ("sample.upload", {"name": "grain", **VOXELS}),
        "forget": ("job.forget", {"days": 0.0}),
        "correction": (
            "calibration.apply",
            {"parameters": {"dD_x": rng.random()}, "name": f"c{number}"},
        ),
        "scan opening": ("script.submit", {"text": script(3), "name": f"s{number}"}),
        "setting": ("tube.set", {"kV": float(rng.randint(40, 90))}),
        "sample": ("sample.set", {"name": rng.choice(["normal", "empty"])}),
    }


def seen(state: Any) -> dict[str, Any]:
    """What of a state has to come back."""
    axes = state["axes"]
    found = {"estop": state["safety"]["estop"]}
    if not any(axis["moving"] for axis in axes.values()):
        found |= {name: round(axis["position"], 9) for name, axis in axes.items()}
    return found


def run_history(root: Path, seed: int) -> Outcome:
    """Live one history.

    Args:
        root: an empty directory.
        seed: of all that is drawn.

    Returns:
        What came of it.

    Raises:
        AssertionError: something that was said to be safe was lost, or a journal whose
            disk is fast and whole went on owing something.
    """
    rng, outcome = random.Random(seed), Outcome()
    with mock.patch("simulation.SimulatedLoop", SlowLoop), Simulation(root, seed) as sim:
        sim.start()
        for _ in range(ROUNDS):
            last = _round(sim, rng, outcome)
            if rng.random() < 0.5:
                sim.kill()
            else:
                sim.cut()
            sim.disk.set(None)
            sim.start()
            if last is None:  # no state was told: the power was cut before
                continue
            after = sim.call(sim.client(), "state.get")
            if last["unsaved"] is not None:
                outcome.unsaved += 1
                continue
            outcome.said_to_be_safe += 1
            found = seen(after)
            expected = seen(last)
            assert {k: found[k] for k in expected} == expected, (seed, outcome)
    return outcome


def _round(sim: Simulation, rng: random.Random, outcome: Outcome) -> Any:
    """Press E-stop inside a slow write, with drawn troubles; return the state told last,
    None if there is none.
    """
    client, other = sim.client(), sim.client()
    loop: Any = sim._loop
    last: Any = None
    with suppress(Crashed):
        sim.call(client, "safety.reset")
        loop.journal_s = rng.choice((0.0, 0.002, 0.002, 0.02, 1.0, math.inf))
        loop.others_s = rng.choice((0.0, 0.02, 1.0, 10.0, math.inf))
        trouble = rng.choice((None, None, errno.EIO, errno.ENOSPC, "power"))
        kind, (method, params) = rng.choice(list(writes(client, rng).items()))
        outcome.kinds += (kind,)
        if trouble == "power":
            sim.disk.set(Fault(rng.randint(0, 15), error=None))
        elif trouble is not None:
            sim.disk.set(Fault(rng.randint(0, 15), error=trouble, lasting=True))
        if rng.random() < 0.5:
            with suppress(RpcError):
                sim.call(client, "axes.move", targets={"rot_obj": rng.uniform(-9.0, 9.0)})
        task = sim.begin(client, method, **params)
        task.add_done_callback(lambda t: t.cancelled() or t.exception())
        sim.advance(rng.choice((0.0, 0.001, 0.02, 0.5, 3.0)))
        for _ in range(rng.randint(1, 3)):
            last = sim.call(other, "safety.estop")
            assert last["safety"]["estop"]
            outcome.pressed += 1
            if rng.random() < 0.3:
                last = None  # cut before its answer, it may be on the disk or not
                last = sim.call(client, "safety.reset")
        if rng.random() < 0.7:
            sim.advance(rng.choice((0.001, 0.02, SOON_S, 2.0)))
            last = sim.call(other, "state.get")
        if loop.journal_s <= 0.02 and trouble in (None, errno.ENOSPC):
            sim.advance(SOON_S)
            assert sim.twin.journal.problem is None, outcome
            last = sim.call(other, "state.get")
            owed = sim.twin.journal.owed()
            assert owed is None, (owed, outcome)
    return last
