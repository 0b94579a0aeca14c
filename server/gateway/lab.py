"""The twin as the gateway's commands see it: requests, state, what the camera holds, what is armed.

One `Lab` a gateway, owned by one event loop. It refuses to know events and sockets.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Final

from flexdt.protocol.errors import RpcError
from flexdt.protocol.state import State
from flexdt.server.gateway.recording import Image, Recording
from flexdt.server.gateway.vocabulary import Refusal
from flexdt.server.viewer.link import LinkDown, TwinLink
from flexdt.twin.errors import TwinError
from flexdt.twin.machine import (
    Machine,
    Profile,
    builtin_machine,
    builtin_machines,
    builtin_profile,
)

POLL_S: Final = 0.05
"""Real seconds between looks at the twin while something is under way."""


@dataclass
class Progress:
    """How far a command is, for FDB."""

    text: str = ""


@dataclass
class Armed:
    """A move that waits for the image sequence that is to be taken during it."""

    axis: str
    target: float
    trigger: float
    taken: asyncio.Event = field(default_factory=asyncio.Event)
    ended: asyncio.Future[str] | None = None


class Lab:
    """What the commands act on.

    Args:
        link: to the twin.
        root: the data directory for what the gateway saves.
        machine, profile: the twin's, where they are files.
    """

    def __init__(
        self,
        link: TwinLink,
        root: Path,
        machine: Machine | None = None,
        profile: Profile | None = None,
    ) -> None:
        self.link, self.root = link, root
        self._machine, self._profile = machine, profile
        self.image: Image | None = None
        self.armed: Armed | None = None
        self.job: str | None = None
        self.path = ""
        self.recording: Recording | None = None
        self.axes: tuple[str, ...] = ()

    async def ask(self, method: str, params: Mapping[str, object] | None = None) -> object:
        """A request to the twin.

        Raises:
            Refusal: the twin's error, or that it cannot be reached.
        """
        try:
            return await self.link.request(method, dict(params or {}))
        except RpcError as error:
            raise Refusal(_told(error)) from error
        except LinkDown as error:
            raise Refusal(f"the twin cannot be reached: {error}") from None

    async def state(self) -> State:
        """The twin's state of this moment."""
        state = State.model_validate(await self.ask("state.get"))
        self.axes = tuple(state.axes)
        return state

    async def until(self, seconds: float, progress: Progress, what: str) -> None:
        """Wait for twin seconds to pass; at full speed there is nothing to wait for."""
        state = await self.state()
        end = state.time + seconds
        while state.time < end and state.clock.speed_up != "max":
            progress.text = f"{what}: {end - state.time:.1f} s left"
            left = (end - state.time) / float(state.clock.speed_up)
            await asyncio.sleep(min(max(left, 0.001), 0.2))
            state = await self.state()

    def record(self) -> Recording:
        """Where images go now."""
        if self.recording is None:
            machine, profile = self._scanner()
            self.recording = Recording(
                self.root, self.path, machine, profile, datetime.now(UTC), version("flexdt")
            )
        return self.recording

    def begin_recording(self, path: str) -> None:
        """Images to come go to another folder; commands since the last image go with them."""
        old = self.record()
        fresh = old.folder is None
        lines = list(old.transcript) if fresh else old.transcript[-1:]
        if not fresh:
            del old.transcript[-1:]
        old.close()
        self.path, self.recording = path, None
        self.record().transcript += lines

    def _scanner(self) -> tuple[Machine | None, Profile | None]:
        hello = self.link.hello or {}
        machine = self._machine
        if machine is None:
            named = str(hello.get("machine", ""))
            known = [builtin_machine(n) for n in builtin_machines()]
            machine = next((m for m in known if named in (m.name, m.scanner_name)), None)
        if machine is None:
            return None, None
        if self._profile is not None:
            return machine, self._profile
        try:
            return machine, builtin_profile(str(hello.get("profile") or machine.default_profile))
        except TwinError:
            return machine, None


def _told(error: RpcError) -> str:
    """An error of the twin as one line; a script's problems with their lines."""
    data = error.data
    if isinstance(data, Mapping):
        data = data.get("problems")
    lines = [
        f"line {p.get('line')}: {p['message']}"
        for p in (data if isinstance(data, list) else [])
        if isinstance(p, Mapping) and "message" in p and p.get("severity", "error") == "error"
    ]
    return "; ".join([error.message, *lines[:5]])
