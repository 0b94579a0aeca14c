"""Handles that drag stages along the directions in which their motors move.

A drag becomes motor targets, clamped to their limits. The twin plans and sweeps them as usual,
and the stage follows at its own speed. A drag counts as a command of the page whose frame it is
in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import viser

from flexdt.clients.viewer.scenes.world import MM, World, motors
from flexdt.protocol.state_model import State
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine

COORDINATES: Final = ("x", "y", "z")
SIZE_M: Final = 0.16
STAGES: Final = ("source", "object", "detector")
UPRIGHT: Final = (1.0, 0.0, 0.0, 0.0)
HALF_TURN: Final = (0.0, 0.0, 0.0, 1.0)
"""Quaternions (w, x, y, z) of handles at rest: along the world's axes, and turned about z."""

Drag = Callable[[int | None, Mapping[str, float]], None]
"""Called with viser's client and the targets axis -> value."""


@dataclass
class _Handle:
    stage: str
    control: Any
    dragging: bool = False
    begun: FloatArray = field(default_factory=lambda: np.zeros(3))
    start: dict[str, float] = field(default_factory=dict)


class Gizmos:
    """One handle a stage.

    Args:
        server: to draw in.
        machine: with the stages.
        drag: called with each drag.
    """

    def __init__(self, server: viser.ViserServer, machine: Machine, drag: Drag) -> None:
        """Add a handle for each stage (source, object, detector).

        `drag` gets motors' targets [mm, deg], and viser's client id.
        """
        self._machine = machine
        self._drag = drag
        self._positions: dict[str, float] = {}
        self._at: dict[str, tuple[float, ...]] = {}
        self._handles = [self._add(server, stage) for stage in STAGES]

    def update(self, state: State, world: World) -> None:
        """Store the motors' positions and put each handle at its stage's point, except
        one that is being dragged.
        """
        self._positions = motors(self._machine, state)
        at = {"source": world.source, "object": world.axis, "detector": world.detector}
        self._at = {stage: tuple((point * MM).tolist()) for stage, point in at.items()}
        for handle in self._handles:
            self._rest(handle)

    def _rest(self, handle: _Handle) -> None:
        """Put a handle back to its stage's place, its arrows within every view; nothing while
        it is dragged or the place is unknown.

        The arrow along the beam points to the object from either side of it. Place and turn
        are sent only if they differ.
        """
        at = self._at.get(handle.stage)
        if handle.dragging or at is None:
            return
        beyond = at[1] > self._at["object"][1]
        for name, value in (("position", at), ("wxyz", HALF_TURN if beyond else UPRIGHT)):
            if tuple(getattr(handle.control, name)) != value:
                setattr(handle.control, name, value)

    def _add(self, server: viser.ViserServer, stage: str) -> _Handle:
        """Add the handle of a stage, with arrows for its motors.

        Only arrows of coordinates that a motor moves are active, and rotations for the
        object alone. Returns the handle.

        Args:
            server: to draw in.
            stage: source, object or detector.
        """
        active = [bool(self._machine.geometry.get(f"{stage}_{c}")) for c in COORDINATES]
        turns = stage == "object" and bool(self._machine.geometry.get("angle"))
        control = server.scene.add_transform_controls(
            f"/gizmos/{stage}",
            scale=SIZE_M,
            active_axes=(active[0], active[1], active[2]),
            disable_sliders=True,
            disable_rotations=not turns,
            depth_test=False,
            line_width=3.0,
        )
        handle = _Handle(stage, control)

        # Plain functions would run in threads, in any order.
        async def follow(event: Any) -> None:
            """Follow the phases of a drag: begin, move and end; afterwards the handle is
            put back unless dragged.

            `event` has the phase "start", "end", or any other for a move.
            """
            match event.phase:
                case "start":
                    self._begin(handle)
                case "end":
                    handle.dragging = False
                case _:
                    self._moved(handle, event)
            self._rest(
                handle
            )  # no state may follow: the stage is there already, or the move was rejected

        control.on_update(follow)
        return handle

    def _begin(self, handle: _Handle) -> None:
        handle.dragging = True
        handle.begun = np.array(handle.control.position, dtype=float)
        handle.start = dict(self._positions)

    def _moved(self, handle: _Handle, event: Any) -> None:
        """Convert the handle's shift and turn to motor targets and pass them on.

        Ignored before the drag has begun; only motors that the stage has get targets. The
        turn takes the shorter way. The shift is converted to [mm], the turn about z to
        degrees from -180 to 180; no targets, no call.

        Args:
            handle: being dragged.
            event: of viser, with its client.
        """
        # The last update of a drag may come after its end, and counts from where the drag
        # began.
        if not handle.start:
            return
        shift = (np.array(handle.control.position, dtype=float) - handle.begun) / MM
        targets: dict[str, float] = {}
        for i, coordinate in enumerate(COORDINATES):
            self._aim(targets, handle, f"{handle.stage}_{coordinate}", float(shift[i]))
        if handle.stage == "object":
            w, _, _, z = np.array(handle.control.wxyz, dtype=float)
            turned = math.degrees(2.0 * math.atan2(z, w))
            turned = (turned + 180.0) % 360.0 - 180.0
            self._aim(targets, handle, "angle", -turned)  # growing angles turn clockwise
        if targets:
            self._drag(event.client_id, targets)

    def _aim(
        self, targets: dict[str, float], handle: _Handle, quantity: str, change: float
    ) -> None:
        """Set the target of the motor that changes a quantity, within its limits.

        Not if it depends on none or several motors, or changes by less than 0.001.
        `change`: since the drag began [mm, deg]; `targets` is added to.
        """
        factors = self._machine.geometry.get(quantity, {})
        if len(factors) != 1 or abs(change) < 1e-3:
            return
        ((motor, factor),) = factors.items()
        axis = self._machine.axes[motor]
        target = handle.start.get(motor, axis.home) + change / factor
        targets[motor] = min(axis.upper, max(axis.lower, target))
