"""Drawn histories of a twin whose disk becomes full, and is killed: what was acknowledged
stays.

The disk is simulated (`simulated_disk`): what needs a new block or a new name is refused, what
is written in place is not. The judge compares what clients see before and after each kill.
"""

from __future__ import annotations

import errno
import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from in_process import script
from simulation import Client, Fault, Simulation

from flexdt.protocol import RpcError

NO_ROOM, REFUSED = -32001, -32003
MOST_WRITES = 40
"""Changes of the disk, after which it is full."""
STATES = 3
"""Kills in a history."""


@dataclass
class Outcome:
    """Of one history."""

    asked: int = 0
    refused: int = 0
    kills: int = 0


def settings(state: Any) -> dict[str, Any]:
    """What of an answer to `state.get` has to survive a restart, by short names."""
    return {
        "estop": state["safety"]["estop"],
        "kV": state["tube"]["kV"],
        "power": state["tube"]["power_W"],
        "exposure": state["camera"]["exposure_ms"],
        "speed": state["axes"]["tra_obj"]["speed"],
        "sample": state["sample"]["name"],
        "correction": (state["correction"] or {}).get("name"),
        "at": round(state["axes"]["rot_obj"]["position"], 9),
    }


def drawn(rng: random.Random) -> tuple[str, dict[str, Any]]:
    """Draw a request that changes something: its method and parameters."""
    asked: list[tuple[str, dict[str, Any]]] = [
        ("tube.set", {"kV": float(rng.randint(40, 90))}),
        ("camera.set", {"exposure_ms": float(rng.randint(50, 900))}),
        ("axes.set", {"axis": "tra_obj", "speed": float(rng.randint(1, 9))}),
        ("axes.move", {"targets": {"rot_obj": float(rng.randint(-90, 90))}, "wait": True}),
        ("sample.set", {"name": rng.choice(["empty", "normal", "chiral"])}),
        ("safety.estop", {}),
        ("safety.reset", {}),
        ("calibration.revert", {}),
        ("calibration.apply", {"parameters": {"dD_x": rng.random()}}),
        ("script.submit", {"text": script(3)}),
        ("sample.upload", {"name": "grain", "kind": "voxels", "format": "raw", "shape": [1, 1, 1],
                           "voxel_mm": [1.0, 1.0, 1.0], "total": 4, "data": b"\0\0\x80\x3d"}),
    ]  # fmt: skip
    return rng.choice(asked)


def ask(sim: Simulation, client: Client, rng: random.Random, outcome: Outcome) -> None:
    """Ask for something drawn; a full disk may refuse it, and an E-stop in force."""
    method, params = drawn(rng)
    outcome.asked += 1
    try:
        sim.call(client, method, **params)
    except RpcError as error:
        outcome.refused += error.code == NO_ROOM
        if error.code not in (NO_ROOM, REFUSED):
            raise


def run_history(root: Path, seed: int) -> Outcome:
    """Live one history: settings are changed while the disk fills, and the server is
    killed, STATES times.

    Args:
        root: an empty directory.
        seed: of all that is drawn.

    Returns:
        What came of its requests.

    Raises:
        AssertionError: something acknowledged was lost.
    """
    rng, outcome = random.Random(seed), Outcome()
    sim = Simulation(root, seed)
    with sim:
        sim.start()
        client = sim.client()
        for name in ("one", "two"):
            sim.call(
                client, "calibration.apply", parameters={"dD_x": rng.random()}, name=name
            )
        for _ in range(STATES):
            full = Fault(at=rng.randint(0, MOST_WRITES), error=errno.ENOSPC, lasting=True)
            sim.disk.set(full)
            for _ in range(rng.randint(1, 12)):
                ask(sim, client, rng, outcome)
            sim.advance(0.5)
            before = sim.call(client, "state.get")
            jobs = {job["job"] for job in sim.call(client, "job.list")["jobs"]}
            sim.kill()
            outcome.kills += 1
            if rng.random() < 0.5:
                sim.disk.set(None)  # there is room again
            sim.start()
            client = sim.client()
            after = sim.call(client, "state.get")
            known = {job["job"] for job in sim.call(client, "job.list")["jobs"]}
            assert known == jobs, (seed, jobs ^ known)
            unsaved = before["unsaved"]
            assert unsaved is None or "jobs" in unsaved, (seed, unsaved)
            assert settings(after) == settings(before), seed
    return outcome
