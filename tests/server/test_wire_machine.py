"""Several clients do anything in any order; a small model says what a twin must answer.

A hypothesis state machine over real connections: who controls, the safety state, where the
motors are bound, and the order of events, for every interleaving hypothesis can think of.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from lab import Process, Wire, twin

pytestmark = pytest.mark.timeout(280)


@pytest.fixture(scope="module")
def server(rays: Process, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    data = tmp_path_factory.mktemp("machine")
    process = twin(rays.port, data, "--sample", "empty", "--speed-up", "max")
    yield process
    process.end()
    assert not process.logged("error", "critical", "unstructured")


LIMITS = {"mag_obj": (70.0, 996.0), "rot_obj": (-7200.0, 7200.0)}


def machine(port: int) -> type[RuleBasedStateMachine]:
    class Clients(RuleBasedStateMachine):
        wires = Bundle("wires")

        @initialize()
        def begin(self) -> None:
            self.watch = Wire(port)
            self.open: list[Wire] = []
            self.watch.call("session.control", action="force")
            self.watch.call("safety.reset")
            self.watch.call(
                "axes.move", targets={"mag_obj": 500.0, "rot_obj": 0.0}, wait=True
            )
            self.watch.call("session.control", action="release")
            self.holder: Wire | None = None
            self.estop = False
            self.bound = {"mag_obj": 500.0, "rot_obj": 0.0}

        @rule(target=wires)
        def connect(self) -> Wire:
            wire = Wire(port)
            wire.call("session.hello", protocol="1.0", client="model")
            self.open.append(wire)
            return wire

        @rule(wire=consumes(wires))
        def leave(self, wire: Wire) -> None:
            wire.close()
            self.open.remove(wire)
            if self.holder is wire:
                self.holder = None
                until = time.monotonic() + 60.0  # the server hears of it a moment later
                while self.watch.call("state.get")["controller"] is not None:
                    assert time.monotonic() < until, "control was not given back"
                    time.sleep(0.002)

        def commands(
            self, wire: Wire, method: str, **params: Any
        ) -> dict[str, Any] | None:
            """Ask for something that moves; None where somebody else is the controller."""
            answer = wire.ask(method, **params)
            if self.holder not in (None, wire):
                assert answer["error"]["code"] == -32003, answer
                return None
            self.holder = wire
            return answer

        @rule(
            wire=wires,
            axis=st.sampled_from(sorted(LIMITS)),
            position=st.floats(-8000.0, 8000.0).map(lambda x: round(x, 3)),
        )
        def move(self, wire: Wire, axis: str, position: float) -> None:
            answer = self.commands(wire, "axes.move", targets={axis: position}, wait=True)
            if answer is None:
                return
            low, high = LIMITS[axis]
            if self.estop or not low <= position <= high:
                assert answer["error"]["code"] == (-32003 if self.estop else -32001), (
                    answer
                )
            elif (
                "error" in answer
            ):  # something stands in the way: it halts where it is free
                assert answer["error"]["code"] == -32002, answer
                axes = wire.call("state.get")
                self.bound = {n: axes["axes"][n]["target"] for n in LIMITS}
                if axes["safety"]["state"] != "ok":
                    wire.call("safety.reset")
            else:
                self.bound[axis] = position

        @rule(wire=wires)
        def reset(self, wire: Wire) -> None:
            if self.commands(wire, "safety.reset") is not None:
                self.estop = False

        @rule(wire=wires, action=st.sampled_from(["acquire", "release", "force"]))
        def control(self, wire: Wire, action: str) -> None:
            answer = wire.ask("session.control", action=action)
            if action == "acquire" and self.holder not in (None, wire):
                assert answer["error"]["code"] == -32003
            elif action == "release":
                self.holder = None if self.holder is wire else self.holder
            else:
                self.holder = wire

        @rule(
            wire=wires,
            method=st.sampled_from(["axes.stop", "safety.estop", "session.ping"]),
        )
        def anyone(self, wire: Wire, method: str) -> None:
            wire.call(method)
            self.estop = self.estop or method == "safety.estop"

        @rule(wire=wires)
        def nonsense(self, wire: Wire) -> None:
            assert (
                wire.ask("axes.move", targets={"mag_obj": "far"})["error"]["code"]
                == -32602
            )
            assert wire.ask("no.method")["error"]["code"] == -32601
            wire.socket.sendall(b"{broken\n")
            while (answer := wire.read()).get("method") == "event":
                wire.events.append(answer["params"])
            assert answer["error"]["code"] == -32700

        @rule(wire=wires)
        def subscribe(self, wire: Wire) -> None:
            wire.call("state.subscribe", topics=["state", "job", "log"], max_rate_hz=50.0)

        @invariant()
        def the_twin_agrees(self) -> None:
            state = self.watch.call("state.get")
            assert state["safety"]["estop"] is self.estop
            assert (state["controller"] is None) == (self.holder is None)
            for axis, target in self.bound.items():
                assert state["axes"][axis]["position"] == target
            for wire in self.open:
                last: dict[str, int] = {}
                for event in wire.events:
                    assert event["seq"] >= last.get(event["topic"], 0)
                    last[event["topic"]] = event["seq"]

        def teardown(self) -> None:
            for wire in (*self.open, self.watch):
                wire.close()

    return Clients


@pytest.mark.slow
def test_any_clients_in_any_order(server: Process) -> None:
    run_state_machine_as_test(  # type: ignore[no-untyped-call]
        machine(server.port),
        settings=settings(
            max_examples=25,
            stateful_step_count=25,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
