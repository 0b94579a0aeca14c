"""Machines whose motors count in other units than mm and degrees, and histories on them.

The same requests, in the units of each, must come to the same positions of the parts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from motion_histories import drawn_machine

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import (
    Machine,
    builtin_machine,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample

UNITS: dict[str, tuple[float, float]] = {
    "micrometres": (1e-3, 1.0),
    "metres": (1e3, 1.0),
    "degrees of 1e-4": (1.0, 1e-4),
    "counts of 0.1 um and 1e-4 deg": (1e-4, 1e-4),
}
"""Name -> mm of a linear motor's unit, deg of a turning one's."""
RATES = ("speed", "max_speed", "acceleration", "max_acceleration")
PLACES = ("lower", "upper", "home", "arrival_tolerance")


def in_units(machine: Machine, mm: float, deg: float) -> Machine:
    """The same machine, its motors counting in units of `mm` and `deg`."""
    size = {n: deg if a.unit == "deg" else mm for n, a in machine.axes.items()}
    axes = {
        n: a.model_copy(update={f: getattr(a, f) / size[n] for f in (*PLACES, *RATES)})
        for n, a in machine.axes.items()
    }
    geometry = {
        quantity: {n: factor * size[n] for n, factor in of.items()}
        for quantity, of in machine.geometry.items()
    }
    virtual = {
        name: v.model_copy(update={"constant": v.constant / size[v.of]})
        for name, v in machine.virtual_axes.items()
    }
    return machine.model_copy(
        update={"axes": axes, "geometry": geometry, "virtual_axes": virtual}
    )


def drawn_base(rng: np.random.Generator) -> Machine:
    """The shipped scanner, or a machine drawn anew, whose motors brake harder than they
    move off.
    """
    if rng.random() < 0.5:
        return builtin_machine()
    return parse_machine(drawn_machine(rng), "drawn.toml")


@dataclass
class Told:
    """What a history came to: where parts stood after each request [mm, deg], the name of
    its refusal, and whatever else was raised.
    """

    places: list[dict[str, float]] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    raised: list[str] = field(default_factory=list)


def history(seed: int, mm: float, deg: float, steps: int = 25) -> Told:
    """Moves towards each other, jogs, stops, and changes of the stage, some in motion.

    Args:
        seed: draws machine and requests, in mm and deg.
        mm, deg: units of the motors.
        steps: requests.
    """
    rng = np.random.default_rng(seed)
    base = drawn_base(rng)
    machine = in_units(base, mm, deg)
    size = {n: deg if a.unit == "deg" else mm for n, a in machine.axes.items()}
    profile = builtin_profile(base.default_profile)
    guard = SceneGuard(build_scene(machine, profile, ()))
    s, now, told = ScannerTwin(machine, profile, 0.0, guard=guard), 0.0, Told()
    linear = [n for n, a in base.axes.items() if a.unit == "mm"]
    pair = [n for q in ("object_y", "detector_y") for n in base.geometry[q]][:2]

    def targets() -> Mapping[str, float]:
        """Draw motors, and for each a place in its travel or an end of it."""
        some = pair if rng.random() < 0.6 else rng.choice(list(base.axes), 2).tolist()
        drawn = {}
        for name in some:
            axis = base.axes[name]
            low, high = (axis.lower, axis.upper) if name in linear else (-180.0, 180.0)
            drawn[name] = (
                float(rng.choice([low, high, rng.uniform(low, high)])) / size[name]
            )
        return drawn

    for _ in range(steps):
        kind = str(rng.choice(["move", "move", "stop", "estop", "jog", "stage"]))
        part, wait = float(rng.uniform(0.05, 0.9)), float(rng.uniform(0.0, 1.5))
        sent = targets()
        name = str(rng.choice(list(base.axes)))
        fast = float(rng.uniform(-1.0, 1.0)) * base.axes[name].max_speed / size[name]
        refusal = ""
        try:
            if kind in ("move", "stop", "estop"):
                s.move(sent, now)
            if kind in ("stop", "estop"):
                now += part * (s.rest_time(now) - now)
                getattr(s, kind)(now)
            if kind == "jog":
                s.jog(name, fast, 0.3, now)
            if kind == "stage":
                s.take_stage(s.stage_change(Sample(), None, guard, now).certified(), now)
        except TwinError as error:
            refusal = type(error).__name__
        except Exception as error:  # what no request may meet
            told.raised.append(f"{kind}: {type(error).__name__}: {error}")
        if s.safety.state != "ready":
            s.reset(now)
        now += min(1.0, wait) * (s.rest_time(now) - now)
        told.refused.append(refusal)
        told.places.append({n: x * size[n] for n, x in s.positions(now).items()})
    return told
