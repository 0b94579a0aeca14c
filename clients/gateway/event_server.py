"""The gateway's sockets: events in, replies out, one task for each running command.

Binds a PUB socket (outgoing events) and a SUB socket (incoming events), as the scanner's
software does; clients connect to both. Commands are forwarded to every subscriber, so that a
component that a user runs elsewhere receives its own; if none answers, the reply is ERR. No
event ends the gateway: one that cannot be served is answered with ERR and logged. The gateway
listens on the loopback address only, because the interface cannot authenticate a client.
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections import Counter, deque
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any, Final

import zmq
import zmq.asyncio

from flexdt.clients.gateway.actions import ACTIONS, AT_ONCE
from flexdt.clients.gateway.connected_twin import CommandProgress, ConnectedTwin
from flexdt.clients.gateway.echoes import Echoes
from flexdt.clients.gateway.vocabulary import Refusal, component_type, read_command
from flexdt.protocol.acquila import (
    FIELDS,
    MAX_BYTES,
    AcquilaError,
    AcquilaEvent,
    ComponentType,
    Exchange,
    ReplyType,
    format_event,
    parse_event,
)
from flexdt.runtime.access import AccessError, is_loopback
from flexdt.runtime.log import log
from flexdt.runtime.process import BACKLOG
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import own_name

FAILED: Final = "internal error; the gateway's log has the details"
FOREIGN_S: Final = 2.0
"""Time limit for the RCV of a component elsewhere [real s]."""
LINGER_MS: Final = 200
PAIR_TRIES: Final = 50
MAX_LOGGED: Final = 100
"""Largest number of rejected events, and of failed commands, that are logged."""
MAX_RUNNING: Final = 256
"""Largest number of running commands; twice as many if they stop or abort something."""
MAX_HELD: Final = 64
"""Largest number of unread events that ZeroMQ holds for each sender, of at most 1 MiB
each."""
HANDSHAKE_MS: Final = 3000
"""Time limit for the handshake of a connection [ms]: where 167 come a second, 500 are
open. ZeroMQ's own is 30 s."""
PAUSE_S: Final = 0.1
URGENT_COMMANDS: Final = frozenset({"stop", "abort script"})


class Gateway:
    """The socket interface of one twin.

    Args:
        twin: target of the commands.
        host: loopback address to listen on.
        port: for outgoing events; 0 is any free port.
        inbound: port for incoming events; None is the next one.

    Raises:
        AccessError: `host` can be reached from other machines.
        zmq.ZMQError: a port is taken.
    """

    def __init__(
        self, twin: ConnectedTwin, host: str, port: int, inbound: int | None = None
    ) -> None:
        """Bind both sockets; `run` serves.

        After an error nothing stays open.

        Args:
            twin: connection and state.
            host: address, of this machine alone.
            port: of the PUB socket; 0 for a free one.
            inbound: port of the socket that receives; None is the one after `port`.

        Raises:
            AccessError: other machines can reach `host`.
            OSError: a port is in use.
        """
        check_loopback(host)
        self.twin = twin
        self.host = host
        self._context = zmq.asyncio.Context()
        try:
            self._out, self._in, self.port, self.inbound = self._bind(port, inbound)
        except BaseException:
            self._context.destroy(linger=0)
            raise
        self._tasks: set[asyncio.Task[None]] = set()
        self._locks: dict[str, asyncio.Lock] = {}
        self._awaited: dict[float | str, asyncio.Event] = {}
        self._running: set[tuple[object, int]] = set()
        self._rejected = self._failed = 0
        self._uuids = random.Random()
        self._recent: deque[int] = deque(maxlen=256)
        self._echoes = Echoes(twin.motor_text)
        self._busy: Counter[str] = Counter()
        """Components on which commands of clients run."""

    async def run(self) -> None:
        """Serve until canceled: receive events, and echo changes by others; then cancel
        tasks, close recording and sockets.

        An event that fails is logged, and serving goes on after `PAUSE_S`. Canceled
        tasks answer their commands with ERR; closing waits at most `LINGER_MS` for events
        to be sent.
        """
        echoes = asyncio.get_running_loop().create_task(self._echo())
        self._tasks.add(echoes)
        try:
            while True:
                try:
                    self._receive(await self._in.recv_multipart())
                except Exception:
                    self._log_failure("an event")
                    await asyncio.sleep(
                        PAUSE_S
                    )  # a socket that fails at once fails again at once
        finally:
            for task in list(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            if self.twin.recording is not None:
                self.twin.recording.close()
            self._context.destroy(linger=LINGER_MS)

    def _receive(self, frames: list[bytes]) -> None:
        """Read an event from a message and begin its command; malformed messages are
        rejected with an event, a failure is logged and answered with ERR.

        A message has one frame.
        """
        try:
            if len(frames) != 1:
                raise AcquilaError(f"{len(frames)} frames")
            event = parse_event(frames[0])
        except AcquilaError as error:
            self._reject(str(error))
            return
        try:
            self._take(event)
        except Exception:
            self._log_failure(event.command)
            self._send(event.answer(ReplyType.ERR, FAILED))

    def _take(self, event: AcquilaEvent) -> None:
        """Start a command, or forward a reply.

        A command gets a number if it is anonymous; an echo of a running one is dropped,
        and one too many is answered by ERR. Subscribers see the command as well as its
        replies. The most are `MAX_RUNNING`, twice as many for stop and abort. A command
        for a component elsewhere waits for its answer; all others are run in a task.
        Returns at once.

        Args:
            event: from a client.
        """
        if not event.is_command:
            self._forward(event)
            return
        if event.anonymous:
            event = replace(event, uuid=self._uuids.getrandbits(52) + 1)
        key = (event.uuid, event.tick_count)
        if key in self._running:
            return  # an echo of a command that runs already
        most = MAX_RUNNING * (2 if event.command.lower() in URGENT_COMMANDS else 1)
        if len(self._running) >= most:
            why = f"{most} commands are under way already; wait for one of them to end"
            self._send(event.answer(ReplyType.ERR, why))
            return
        self._running.add(key)
        self._send(event)  # subscribers see commands as well as replies
        kind = component_type(event.component, self.twin.axes)
        if kind is None:
            work = self._await_other_answer(event)
        else:
            work = self._execute(event, kind)
        self._start(self._run_guarded(work, event), key)

    async def _echo(self) -> None:
        """Send clients the commands of others: over the twin's wire, from the viewer, by a
        script. Runs until canceled, also after errors.

        After a refusal or an error it waits `PAUSE_S`. Notes in `twin.lively` whether
        anything moves or a job is known. Components with running commands of clients are
        not echoed. Events are sent in the order: lines of scripts, then changes of the
        state.
        """
        clock = asyncio.get_running_loop().time
        while True:
            await self.twin.news()
            try:
                state = await self.twin.state()
                now = clock()
                own = [name for name, count in self._busy.items() if count]
                for status in self.twin.told_jobs(state):
                    for event in self._echoes.follow(
                        status, self.twin.script_of, state, now
                    ):
                        self._send(event)
                for event in self._echoes.see(state, own, now):
                    self._send(event)
                moving = any(axis.moving for axis in state.axes.values())
                self.twin.lively = moving or bool(self.twin.jobs)
            except Refusal:
                await asyncio.sleep(PAUSE_S)
            except Exception:
                self._log_failure("echo")
                await asyncio.sleep(PAUSE_S)

    async def _run_guarded(
        self, work: Coroutine[Any, Any, None], event: AcquilaEvent
    ) -> None:
        """Await the work of a command; an exception is logged and answered with ERR, not
        raised.

        The reply does not name the exception. Cancellation is passed on.
        """
        try:
            await work
        except Exception:
            self._log_failure(event.command)
            self._send(event.answer(ReplyType.ERR, FAILED))

    async def _execute(self, event: AcquilaEvent, kind: ComponentType) -> None:
        """Run a command of the scanner with its replies: RCV, FDB while it runs, ACK or
        ERR.

        Refusals and errors are answered with ERR, not raised; the control of the twin is
        released before the last reply. If canceled, the command is canceled and
        answered with ERR. The state after the command is stored, so that it is not
        echoed. FDB is sent when the exchange says so, with the progress text; the task is
        waited for between.

        Args:
            event: the command.
            kind: type of its component.
        """
        clock = asyncio.get_running_loop().time
        exchange = Exchange(event, kind, clock())
        self._send(exchange.received(clock()))
        component = own_name(event.component, self.twin.axes)
        self._busy[component] += 1
        progress = CommandProgress()
        task = asyncio.ensure_future(self._carry_out(event, progress))
        try:
            while not task.done():
                await asyncio.wait(
                    {task}, timeout=max(0.0, exchange.next_feedback - clock())
                )
                if not task.done():
                    self._send(exchange.feedback(progress.text, clock()))
            end = exchange.done(task.result())
        except Refusal as error:
            end = exchange.failed(str(error))
        except asyncio.CancelledError:
            task.cancel()
            self._send(exchange.failed("the gateway is ending"))
            raise
        except Exception:
            self._log_failure(event.command)
            end = exchange.failed(FAILED)
        await self._adopt(component)
        await self._release()  # before the last reply: its receiver may want control
        self._send(end)

    async def _carry_out(self, event: AcquilaEvent, progress: CommandProgress) -> str:
        """Carry out a command and return its reply; it waits for earlier commands of its
        component unless it is one of `AT_ONCE`.

        Unknown axes are requested from the twin first. Raises Refusal for an unknown
        command, before any wait.
        """
        if not self.twin.axes:
            await self.twin.state()
        command = read_command(event, self.twin.axes)
        if isinstance(command, AT_ONCE):
            return await self._act(event, command, progress)
        component = own_name(event.component, self.twin.axes)
        lock = self._locks.setdefault(component, asyncio.Lock())
        async with lock:
            return await self._act(event, command, progress)

    async def _act(
        self, event: AcquilaEvent, command: c.Command, progress: CommandProgress
    ) -> str:
        """Run a command's action and return its reply; its line is in the recording's
        transcript meanwhile, and stays unless it fails (or is canceled).

        A command that is not of scripts has no line.
        """
        line = transcript_line(event, command)
        lines = self.twin.record().transcript
        if line is not None:
            lines.append(line)
        try:
            return await ACTIONS[type(command)](self.twin, command, progress)
        except BaseException:
            if line is not None and line in lines:
                lines.remove(line)
            raise

    async def _await_other_answer(self, event: AcquilaEvent) -> None:
        """Wait for another subscriber to answer a command that is not for the scanner.

        Commands with one key share their wait. Nothing is sent if an answer comes:
        `_forward` has done so. The wait is forgotten afterwards.

        Args:
            event: the command; ERR is sent where no answer comes within `FOREIGN_S`.
        """
        key = event.key
        heard = self._awaited.setdefault(key, asyncio.Event())
        try:
            async with asyncio.timeout(FOREIGN_S):
                await heard.wait()
        except TimeoutError:
            known = ", ".join(("scanner", "tube", "camera", *self.twin.axes))
            why = (
                f"no component {event.component[:60]!r} has answered within {FOREIGN_S:g} s; "
                f"the twin has: {known}"
            )
            self._send(event.answer(ReplyType.ERR, why))
        finally:
            self._awaited.pop(key, None)

    def _forward(self, event: AcquilaEvent) -> None:
        """Send on the reply of a component elsewhere, and wake who waits for it.

        An echo of our last 256 events is dropped.
        """
        text = format_event(event)
        if hash(text) in self._recent:
            return
        heard = self._awaited.get(event.key)
        if heard is not None:
            heard.set()
        self._send(event)

    async def _adopt(self, component: str) -> None:
        """Store the state after a client's command, so that it is not echoed, and count
        one command less in the component's busy mark.

        A refusal is ignored, a failure logged. Nothing is stored while the twin is not
        connected; the mark is always taken off.
        """
        try:
            if self.twin.link.connected:
                self._echoes.adopt(await self.twin.state(), component)
        except Refusal:
            return
        except Exception:
            self._log_failure("state.get")
        finally:
            self._busy[component] -= 1
            self._busy += Counter()  # without those that are idle

    async def _release(self) -> None:
        """Release control of the twin if no other command of this gateway runs and the
        twin is connected; a refusal is ignored, a failure logged.

        The present command counts as one of the running ones.
        """
        if len(self._running) <= 1 and self.twin.link.connected:
            try:
                await self.twin.ask("session.control", {"action": "release"})
            except Refusal:
                return
            except Exception:
                self._log_failure("session.control")

    def _send(self, event: AcquilaEvent) -> None:
        """Publish an event without waiting, and remember its hash to recognize its echo.

        Too slow a subscriber does not get it.
        """
        text = format_event(event)
        self._recent.append(hash(text))
        # A PUB socket never blocks: it drops messages that a slow subscriber does not take.
        self._out.send(text.encode("utf-8", "replace"))

    def _reject(self, why: str) -> None:
        """Count a malformed event, log the first `MAX_LOGGED` ones, and answer with ERR
        and the fields of an event.

        Later ones are answered, too. The reply goes to all subscribers.
        """
        self._rejected += 1
        if self._rejected <= MAX_LOGGED:
            log("gateway event refused", logging.WARNING, reason=why)
        fields = ", ".join(FIELDS)
        reply = f"{why}; an event is a JSON object with {fields}"
        self._send(
            AcquilaEvent("gateway", "receive", reply=reply, reply_type=ReplyType.ERR)
        )

    def _log_failure(self, command: str) -> None:
        """Write the exception being handled to the log, up to `MAX_LOGGED` times."""
        self._failed += 1
        if self._failed <= MAX_LOGGED:
            log("gateway command failed", logging.ERROR, error=True, command=command)

    def _start(self, work: Coroutine[Any, Any, None], key: tuple[object, int]) -> None:
        """Run work in a task; when it has ended, drop the task and take `key` from the
        running commands.
        """
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)

        def end(done: asyncio.Task[None]) -> None:
            self._tasks.discard(done)
            self._running.discard(key)

        task.add_done_callback(end)

    def _bind(
        self, port: int, inbound: int | None
    ) -> tuple[zmq.asyncio.Socket, zmq.asyncio.Socket, int, int]:
        """Bind PUB and SUB; if any free port will do, find two neighboring ones.

        SUB has a limit of `MAX_BYTES` a message and `MAX_HELD` messages a sender.

        Args:
            port: of PUB; 0 is any free port.
            inbound: port of SUB; None is the next one.

        Returns:
            PUB, SUB and their ports.

        Raises:
            zmq.ZMQError: a port is in use, or `PAIR_TRIES` pairs were not free.
        """
        for left in reversed(range(PAIR_TRIES if port == 0 and inbound is None else 1)):
            out = self._socket(zmq.PUB)
            out.bind(bind_endpoint(self.host, port))
            here = bound_port(out)
            into = self._socket(zmq.SUB)
            into.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
            into.setsockopt(zmq.RCVHWM, MAX_HELD)
            into.subscribe(b"")
            try:
                into.bind(
                    bind_endpoint(self.host, here + 1 if inbound is None else inbound)
                )
            except zmq.ZMQError:
                out.close(linger=0)
                into.close(linger=0)
                if left == 0:
                    raise
                continue
            return out, into, here, bound_port(into)
        raise AssertionError("unreachable")

    def _socket(self, kind: int) -> zmq.asyncio.Socket:
        """Make a socket of a ZeroMQ kind, with our handshake time limit and backlog, and
        IPv6 if the host has one.
        """
        made = self._context.socket(kind)
        made.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        made.setsockopt(zmq.BACKLOG, BACKLOG)
        if ":" in self.host:
            made.setsockopt(zmq.IPV6, 1)
        return made


def check_loopback(host: str) -> None:
    """Check that `host` is a loopback address.

    Raises:
        AccessError: it is not; lists the allowed ones.
    """
    if not is_loopback(host):
        raise AccessError(
            f"the gateway does not listen on {host!r}: "
            "its interface has no token and no encryption; "
            "allowed: 127.0.0.1, ::1 and localhost, from elsewhere through an SSH tunnel"
        )


def bind_endpoint(host: str, port: int) -> str:
    """Format an address as ZeroMQ's endpoint: IPv6 in brackets; port 0 is any."""
    if ":" in host:
        place = f"[{host}]"
    elif host == "localhost":
        place = "127.0.0.1"
    else:
        place = host
    return f"tcp://{place}:{port or '*'}"


def bound_port(socket: zmq.asyncio.Socket) -> int:
    """Return the port that a socket is bound to."""
    return int(socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])


def transcript_line(event: AcquilaEvent, command: c.Command) -> str | None:
    """Write the command as a tab-separated line of a script; None for a command that is
    not one of scripts.

    Waits for the position (POS) only after a triggered absolute move, else for the
    acknowledgement. Seven columns, of which the last two are empty; blanks in a word are
    joined to one.
    """
    if type(command).__module__ != c.__name__:
        return None
    if isinstance(command, c.MoveAbsolute) and command.trigger is not None:
        wait = "POS"
    else:
        wait = "ACK"
    words = (event.component, event.command, event.arg1, event.arg2, wait, "", "")
    return "\t".join(" ".join(word.split()) for word in words)
