"""The twin as the gateway's commands see it: requests, state, the last image, an armed move.

Each gateway has one `ConnectedTwin`, used from one event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Final, TypeVar

from flexdt.clients.client import twin_methods as m
from flexdt.clients.client.flows import Flow, adrive
from flexdt.clients.client.kept_connection import KeptConnection
from flexdt.clients.client.transport import ConnectionLost
from flexdt.clients.client.twin_methods import FINAL_STATES
from flexdt.clients.gateway.saved_images import Image, Recording
from flexdt.clients.gateway.vocabulary import Refusal
from flexdt.protocol.rpc_errors import RpcError
from flexdt.protocol.state_model import AxisState, JobStatus, State
from flexdt.twin.dataset.file_names import SCRIPT
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import Machine, Profile, builtin_machine, profile_of
from flexdt.twin.script.executed_log import MotorReply, motor_cluster

_R = TypeVar("_R")
MAX_SCRIPT: Final = 8 << 20
LIVELY_S: Final = 0.1
"""Interval between requests for the state while something moves or a scan runs [real
s]."""
POLL_S: Final = 0.05
"""Interval between requests for the state while a command runs [real s]."""


@dataclass
class CommandProgress:
    """How far a command has come, as the text of FDB."""

    text: str = ""


@dataclass
class Armed:
    """A move that waits for the image sequence to be taken during it.

    Attributes:
        axis, target, trigger: of the move [mm or deg].
        taken: set when a sequence has taken the move over.
        ended: the text of the move's ACK, from then on.
    """

    axis: str
    target: float
    trigger: float
    taken: asyncio.Event = field(default_factory=asyncio.Event)
    ended: asyncio.Future[str] | None = None


class ConnectedTwin:
    """The twin with the state that commands act on.

    Args:
        link: the connection to the twin.
        root: the data directory for the gateway's own images.
        machine, profile: the twin's, where they are files.
    """

    def __init__(
        self,
        link: KeptConnection,
        root: Path,
        machine: Machine | None = None,
        profile: Profile | None = None,
    ) -> None:
        """Store the connection, the folder of saved images and the machine; nothing is
        recorded, or known of the twin, yet.

        Args:
            link: to the twin.
            root: folder for saved images.
            machine, profile: of the twin; None: those that it names, as far as they ship.
        """
        self.link = link
        self.root = root
        self._machine = machine
        self._profile = profile
        self.image: Image | None = None
        self.armed: Armed | None = None
        self.job: str | None = None
        self.path = ""
        self.recording: Recording | None = None
        self.axes: tuple[str, ...] = ()
        self.sequence: bytes | None = None
        """Script of the sequence that a client takes now; its command has been echoed
        already."""
        self.lively = False
        """Whether something moves or a scan runs, so that the state is polled."""
        self.jobs: dict[str, JobStatus] = {}
        """Jobs that have not ended, or whose end has not been sent."""
        self._news = asyncio.Event()

    def heard(self, topic: str, params: Mapping[str, object]) -> None:
        """Take an event of the twin: keep a job's status, and wake `news`.

        A job first heard of at its end is not kept.
        """
        if topic == "job":
            status = JobStatus.model_validate(params["data"])
            if status.state not in FINAL_STATES or status.job in self.jobs:
                self.jobs[status.job] = status
        self._news.set()

    def told_jobs(self, state: State) -> list[JobStatus]:
        """Return the newest status of each job whose progress is to be sent; drop ended ones.

        Jobs that have ended are returned this once; the order is that of their first status.

        `state`: of the twin; its job is added.
        """
        now = state.job
        if now is not None and self.jobs.get(now.job, now).state not in FINAL_STATES:
            self.jobs[now.job] = now
        found = list(self.jobs.values())
        self.jobs = {s.job: s for s in found if s.state not in FINAL_STATES}
        return found

    async def news(self) -> None:
        """Wait for the twin's next event, or `LIVELY_S` while `lively`.

        Then it waits another `POLL_S`, so that several changes are met at once.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LIVELY_S if self.lively else None):
                await self._news.wait()
        self._news.clear()
        await asyncio.sleep(POLL_S)

    def script_of(self, job: JobStatus) -> bytes | None:
        """Read the script of a job from its data set; None where it is missing or too
        long, or is a client's own sequence.

        Too long is more than `MAX_SCRIPT` bytes. A job without a data set has none.
        """
        path = Path(job.dataset or "") / SCRIPT
        if not path.is_file() or path.stat().st_size > MAX_SCRIPT:
            return None
        script = path.read_bytes()
        if script == self.sequence:
            return None
        return script

    async def ask(
        self, method: str, params: Mapping[str, object] | None = None
    ) -> object:
        """Send a request to the twin and return its result.

        Raises:
            Refusal: the twin answered with an error, or cannot be reached.
        """
        try:
            return await self.link.request(method, dict(params or {}))
        except RpcError as error:
            raise Refusal(_one_line(error)) from error
        except ConnectionLost as error:
            raise Refusal(f"the twin cannot be reached: {error}") from None

    async def run(self, flow: Flow[_R]) -> _R:
        """Run a method of `twin_methods` and return its result; raises as `ask`."""
        return await adrive(flow, lambda asked: self.ask(asked.method, asked.params))

    async def state(self) -> State:
        """Get the twin's present state; updates `axes`."""
        state = await self.run(m.state())
        self.axes = tuple(state.axes)
        return state

    async def until(self, seconds: float, progress: CommandProgress, what: str) -> None:
        """Wait for `seconds` of the twin's clock, reporting the time left in `progress`.

        At speed-up "max" it returns at once. A change of the speed-up takes effect within 0.2 s.
        `seconds`: on the twin's clock; `progress`: its text becomes "WHAT: N s left"; `what`: is
        waited for.
        Raises Refusal: as `ask`.
        """
        state = await self.state()
        end = state.time + seconds
        while state.time < end and state.clock.speed_up != "max":
            progress.text = f"{what}: {end - state.time:.1f} s left"
            left = (end - state.time) / float(state.clock.speed_up)
            await asyncio.sleep(min(max(left, 0.001), 0.2))
            state = await self.state()

    def record(self) -> Recording:
        """Return the current recording; create it at the first use, for the present
        output path, machine and profile.
        """
        if self.recording is None:
            machine, profile = self._scanner()
            self.recording = Recording(
                self.root,
                self.path,
                machine,
                profile,
                datetime.now(UTC),
                version("flexdt"),
            )
        return self.recording

    def begin_recording(self, path: str) -> None:
        """Close the recording and save later images in another folder, `path`.

        The new transcript begins with the last command, which leaves the old one; or, if
        no image was saved yet, with all commands. The folder is made with the first
        image.
        """
        old = self.record()
        fresh = old.folder is None
        if fresh:
            lines = list(old.transcript)
        else:
            lines = old.transcript[-1:]
        if not fresh:
            del old.transcript[-1:]
        old.close()
        self.path = path
        self.recording = None
        self.record().transcript += lines

    def motor_text(self, axis: str, at: AxisState) -> str:
        """Format the reply to a completed move: a motor's cluster, one character a byte.

        A virtual axis, which has no motor, and a motor of a machine that the gateway does
        not know reply with their position. Positions have 10 decimals. Also without speed
        or acceleration only the position is replied. Characters are Latin-1.
        """
        machine = self.machine
        if machine is None:
            known = None
        else:
            known = machine.axes.get(axis)
        if known is None or at.speed is None or at.acceleration is None:
            return f"{at.position:.10f}"
        motor = MotorReply(
            at.position,
            at.target,
            at.speed,
            at.acceleration,
            *at.limits,
            known.max_speed,
            known.max_acceleration,
        )
        return motor_cluster(motor).decode("latin-1")

    @property
    def machine(self) -> Machine | None:
        """The twin's; None where the gateway does not know it."""
        return self._scanner()[0]

    def _scanner(self) -> tuple[Machine | None, Profile | None]:
        """Return machine and profile: those given, else those that the twin names.

        (None, None) without any machine; (machine or None, None) if this package lacks
        the one named or its profile. A given machine or profile comes before the twin's.
        Without a connection and a given machine both are None.
        """
        hello = self.link.hello
        machine = self._machine
        try:
            if machine is None and hello is not None:
                machine = builtin_machine(hello.machine)
            if machine is None:
                return None, None
            return machine, self._profile or profile_of(
                machine, hello.profile if hello else None
            )
        except TwinError:  # neither of them need ship
            return machine, None


def _one_line(error: RpcError) -> str:
    """Format an error of the twin as one line: its message, then the first five errors
    (not warnings) of a script with their lines.

    Joined by "; ". Problems are the data's list, or its `problems`; entries without a
    message are skipped.
    """
    data = error.data
    if isinstance(data, Mapping):
        data = data.get("problems")
    lines = [
        f"line {p.get('line')}: {p['message']}"
        for p in (data if isinstance(data, list) else [])
        if isinstance(p, Mapping)
        and "message" in p
        and p.get("severity", "error") == "error"
    ]
    return "; ".join([error.message, *lines[:5]])
