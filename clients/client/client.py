"""`TwinClient` and `AsyncTwinClient`: the twin server's methods, blocking and as
coroutines.

`Core` is a client's connection policy: greet, reconnect with back-off, subscribe again. A
call that only reads is repeated after a reconnect. A call that acts is repeated only if
it was never sent; otherwise the caller gets an error: the outcome is unknown. So no move
is ever repeated silently.

`TwinClient` runs an `AsyncTwinClient` on an event loop in a thread of its own, one for
all clients of the process. So it works in scripts, in threads and in a notebook whose own
event loop is running.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import functools
import inspect
import os
import ssl as tls
import threading
from collections.abc import Callable, Coroutine, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, ParamSpec, Protocol, TypeVar, overload

from flexdt.clients.client import twin_methods as m
from flexdt.clients.client.events import AsyncSubscription, Subscription
from flexdt.clients.client.flows import Ask, Effect, Flow, Tell, adrive, drive, perform
from flexdt.clients.client.transport import (
    ConnectionLost,
    Link,
    NoTwinError,
    TcpTransport,
    Transport,
)
from flexdt.clients.client.twin_methods import Kind, Topic
from flexdt.protocol import METHODS, RpcError, hello_params, parse_result
from flexdt.protocol.methods.session_messages import HelloResult
from flexdt.twin.signatures import public

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
ATTEMPTS: Final = 3

_P = ParamSpec("_P")
_R = TypeVar("_R")


def back_off(first_s: float = FIRST_PAUSE_S) -> Iterator[float]:
    """Yield pauses [s] for ever, each twice the one before, to a limit."""
    pause = first_s
    while True:
        yield pause
        pause = min(2 * pause, LONGEST_PAUSE_S)


class Listener(Protocol):
    """Receives the events of its topics."""

    topics: tuple[str, ...]

    def put(self, params: Mapping[str, object]) -> None:
        """Take an event's params."""

    def connection_lost(self) -> None:
        """Handle the end of the connection; the client may reconnect."""

    def end(self) -> None:
        """End the stream: no more events will come."""


@dataclass(eq=False)
class Core:
    """A client's connection and the state it keeps between calls.

    Attributes:
        transport: to the server.
        name: of this program, for people who look at the server.
        token: where the server requires one.
        timeout_s: for an answer [s].
        reconnect_s: how long to try after a connection has been lost [s].
        wait_s: how long to try the first time, for a server that is just starting [s].
        hello: the server's answer to the newest greeting; None before the first.
        link: the newest connection, which may have ended.
        closed: whether the client has been closed for good.
    """

    transport: Transport
    name: str
    token: str | None
    timeout_s: float
    reconnect_s: float
    wait_s: float
    hello: HelloResult | None = None
    link: Link | None = None
    closed: bool = False
    _listeners: dict[Listener, Mapping[str, object]] = field(default_factory=dict)
    _connecting: asyncio.Lock = field(default_factory=asyncio.Lock)

    async def connected(self) -> Link:
        """Return a live link; connect first if there is none.

        At once if the link is alive; one caller connects at a time and the others wait
        for it. Attempts go on for `wait_s` the first time and `reconnect_s` later.

        Raises:
            ConnectionLost: no server answers, or the client is closed.
            RpcError: the server refuses the client.
        """
        if not self.closed and self.link is not None and self.link.alive:
            return self.link
        async with self._connecting:
            return await self._join()

    async def call(self, asked: Ask) -> object:
        """Call a method of the server and return its result, not yet decoded.

        A call that only reads is sent up to `ATTEMPTS` times over lost connections. A
        call that acts is sent again only if it was not sent; otherwise ConnectionLost
        says that the outcome is unknown. A time limit of None waits for ever; the limit
        counts from each attempt's sending.

        Args:
            asked: method, params and time limit; a negative limit is the client's own.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: the server cannot be reached, or was lost during a call that acts.
            TimeoutError: no answer in time.
        """
        patience = asked.patience_s
        limit = self.timeout_s if patience is not None and patience < 0 else patience
        for attempt in range(ATTEMPTS):
            link = await self.connected()
            try:
                return await link.request(asked.method, asked.params, limit)
            except ConnectionLost as lost:
                if attempt == ATTEMPTS - 1 or self.closed:
                    raise
                if lost.sent and not METHODS[asked.method].safe:
                    raise ConnectionLost(
                        f"{lost} during {asked.method}: it is not known whether it was carried "
                        "out; it was not repeated",
                        sent=True,
                    ) from lost
        raise AssertionError("unreachable")

    async def subscribe(self, listener: Listener, options: Mapping[str, object]) -> None:
        """Send `listener` its topics' events, also after reconnects.

        Options that are None are left out. After a failure the listener is forgotten.

        Raises:
            ValueError: another listener follows one of the topics with other options; the
                server keeps one set of options for each topic of a connection.
        """
        params = {
            "topics": list(listener.topics),
            **{k: v for k, v in options.items() if v is not None},
        }
        self.follow(listener, params)
        try:
            await self.call(Ask("state.subscribe", params))
        except BaseException:
            self._listeners.pop(listener, None)
            raise

    def follow(self, listener: Listener, params: Mapping[str, object]) -> None:
        """Have `listener` subscribed with these params whenever a connection is made.

        Raises ValueError: its rate, kind or binning differ from other listeners' to a
        topic.
        """
        for other, theirs in self._listeners.items():
            if other is listener:
                continue
            for topic in set(listener.topics) & set(other.topics):
                _require_same(topic, params, theirs)
        self._listeners[listener] = params

    async def unsubscribe(self, listener: Listener) -> None:
        """Send it no more events, and unsubscribe at the server from topics without
        another listener.

        Does nothing for an unknown listener; failures of the request are ignored. Nothing
        is sent without a connection.
        """
        self._listeners.pop(listener, None)
        still = {topic for other in self._listeners for topic in other.topics}
        gone = [topic for topic in listener.topics if topic not in still]
        if gone and self.link is not None and self.link.alive:
            # If this fails, the connection has ended and the subscriptions with it.
            with contextlib.suppress(ConnectionLost, TimeoutError, RpcError):
                await self.link.request(
                    "state.unsubscribe", {"topics": gone}, self.timeout_s
                )

    async def close(self) -> None:
        """End all subscriptions and disconnect; the connection is never opened again.

        Listeners get `end` and are forgotten; a second call does nothing.
        """
        self.closed = True
        listeners = list(self._listeners)
        self._listeners.clear()
        for listener in listeners:
            listener.end()
        await self.disconnect()

    async def disconnect(self) -> None:
        """End the connection, if there is one; another may be made, with the same
        subscriptions.

        Waits for the end; `hello` is kept."""
        link = self.link
        self.link = None
        if link is not None:
            await link.close()

    def _deliver(self, params: Mapping[str, object]) -> None:
        """Put an event's params to all listeners of its topic; dropped without one."""
        topic = params.get("topic")
        for listener in list(self._listeners):
            if topic in listener.topics:
                listener.put(params)

    def _notify_end(self) -> None:
        """Tell the listeners that the connection has ended."""
        for listener in list(self._listeners):
            listener.connection_lost()

    async def _join(self) -> Link:
        """Connect, unless another call has done so meanwhile.

        Attempts go on with back-off for `wait_s` the first time, for `reconnect_s` later.
        Only ConnectionLost is retried; the first attempt is made even if the time is 0.
        The error is that of the last attempt.

        Raises:
            ConnectionLost: no server answers in that time, or the client is closed.
            RpcError: the server refuses the client.
        """
        clock = asyncio.get_running_loop().time
        deadline = clock() + (self.wait_s if self.hello is None else self.reconnect_s)
        pauses = back_off()
        while True:
            if self.closed:
                raise ConnectionLost("the client is closed")
            if self.link is not None and self.link.alive:
                return self.link
            try:
                self.link = await self._greet()
            except ConnectionLost:
                pause = next(pauses)
                if clock() + pause > deadline:
                    raise
                await asyncio.sleep(pause)

    async def _greet(self) -> Link:
        """Open a connection, greet the server and subscribe the listeners again.

        Every listener's stored parameters are sent. If the server said why it ends the
        connection, that RpcError is raised instead.

        Returns:
            The link; `hello` is set to the server's answer.

        Raises:
            ConnectionLost: no connection, or the client was closed meanwhile.
            NoTwinError, TimeoutError: another program answers, or is silent.
            RpcError: the server refuses the client; the connection is closed.
        """
        await self.transport.open()
        link = Link(self.transport, self._deliver, self._notify_end)
        try:
            await self.introduce(link)
            for wanted in list(self._listeners.values()):
                await link.request("state.subscribe", wanted, self.timeout_s)
            if self.closed:  # by another thread or task, meanwhile
                raise ConnectionLost("the client is closed")
        except BaseException as error:
            await link.close()
            if isinstance(error, ConnectionLost) and link.calls.reason is not None:
                # The server said why it ends the connection: trying again is no help.
                raise link.calls.reason from None
            raise
        return link

    async def introduce(self, link: Link) -> None:
        """Greet the server with this client's name, check that it is a twin, and keep its
        hello.

        A hello without a machine is that of another program. The error's `sent` is that of
        the lost request.

        Raises:
            ConnectionLost: the server ended the connection.
            NoTwinError: its answer is that of another program.
            TimeoutError: no answer.
            RpcError: the server refuses the client.
        """
        place = self.transport.place
        try:
            params = hello_params(self.name, self.token)
            answer = await link.request("session.hello", params, self.timeout_s)
        except TimeoutError as error:
            raise TimeoutError(f"{place} is no twin, or hangs: {error}") from None
        except ConnectionLost as error:
            if link.calls.violation is not None:
                raise NoTwinError(
                    f"{place} is no twin: what it sends is not flexdt's protocol"
                ) from None
            if link.calls.reason is not None:
                raise
            raise ConnectionLost(
                f"{place} is no twin, or one that ends: {error}", sent=error.sent
            ) from None
        hello = parse_result(HelloResult, answer)
        if not hello.machine:
            raise NoTwinError(f"{place} is no twin: it is {hello.server}")
        self.hello = hello


def _require_same(
    topic: str, asked: Mapping[str, object], known: Mapping[str, object]
) -> None:
    """Check that a topic is followed as before: its rate, and a projection's kind and binning.

    The rate is compared for every topic, kind and binning only for "projection"; None counts as
    a value.

    `topic`: that is subscribed to again; `asked`: parameters of the new subscription; `known`:
    those of the earlier one.
    Raises ValueError: they differ.
    """
    view: tuple[str, ...]
    if topic == "projection":
        view = ("projection_kind", "projection_binning")
    else:
        view = ()
    for name in ("max_rate_hz", *view):
        if asked.get(name) != known.get(name):
            raise ValueError(
                f"{topic} with {name} {asked.get(name)}: this client follows it with "
                f"{known.get(name)} already; use the same, or another client"
            )


SHOWN: Final = ("Progress", "ScanProgress")
"""Annotations of `progress` where a method shows a bar of its own accord."""


class ClientMethod(Generic[_P, _R]):
    """A method made of a function that makes a flow, with its signature and docstring.

    It runs the flow by its client's `run`: so it blocks on a `TwinClient`, and is a coroutine
    on an `AsyncTwinClient`.
    """

    def __init__(self, make: Callable[_P, Flow[_R]]) -> None:
        """Make the blocking and the asynchronous method of a function, with its
        signature.

        Awaited in a coroutine, a call shows no progress bar by default. Only a
        parameter named `progress` whose annotation is in `SHOWN` makes a bar; `help()`
        shows the signature with self and without Flow.

        Args:
            make: returns the flow of a call; see `twin_methods`.
        """
        made = inspect.signature(make)
        shows = (
            "progress" in made.parameters
            and made.parameters["progress"].annotation in SHOWN
        )

        @functools.wraps(make)
        def blocking(self: TwinClient, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
            return self.run(make(*args, **kwargs))

        @functools.wraps(make)
        async def awaited(
            self: AsyncTwinClient, /, *args: _P.args, **kwargs: _P.kwargs
        ) -> _R:
            # Other coroutines run in this thread meanwhile: a bar would mix with their output.
            if shows and "progress" not in made.bind_partial(*args, **kwargs).arguments:
                kwargs["progress"] = False
            return await self.run(make(*args, **kwargs))

        self._methods: dict[bool, Any] = {False: blocking, True: awaited}
        # Signature for help() and notebooks: with self, without Flow.
        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
        returns = str(made.return_annotation).removeprefix("Flow[").removesuffix("]")
        parameters = [own, *made.parameters.values()]
        for method in self._methods.values():
            method.__signature__ = made.replace(
                parameters=parameters, return_annotation=returns
            )

    @overload
    def __get__(self, client: TwinClient, kind: type[TwinClient]) -> Callable[_P, _R]: ...
    @overload
    def __get__(
        self, client: AsyncTwinClient, kind: type[AsyncTwinClient]
    ) -> Callable[_P, Coroutine[Any, Any, _R]]: ...
    def __get__(
        self, client: TwinClient | AsyncTwinClient | None, kind: type[Any]
    ) -> Any:
        return self._methods[inspect.iscoroutinefunction(kind.run)].__get__(client, kind)


class SharedMethods:
    """The methods of the wire; how they wait is the client's. Written by `make web`."""

    control = ClientMethod(m.control)
    ping = ClientMethod(m.ping)
    discover = ClientMethod(m.discover)
    state = ClientMethod(m.state)
    move = ClientMethod(m.move)
    jog = ClientMethod(m.jog)
    set_axis = ClientMethod(m.set_axis)
    stop = ClientMethod(m.stop)
    estop = ClientMethod(m.estop)
    reset = ClientMethod(m.reset)
    set_clock = ClientMethod(m.set_clock)
    set_tube = ClientMethod(m.set_tube)
    set_camera = ClientMethod(m.set_camera)
    samples = ClientMethod(m.samples)
    set_sample = ClientMethod(m.set_sample)
    delete_sample = ClientMethod(m.delete_sample)
    sample_mesh = ClientMethod(m.sample_mesh)
    upload_mesh = ClientMethod(m.upload_mesh)
    upload_scene = ClientMethod(m.upload_scene)
    upload_voxels = ClientMethod(m.upload_voxels)
    projection = ClientMethod(m.projection)
    ray = ClientMethod(m.ray)
    geometry = ClientMethod(m.geometry)
    predict_exposure = ClientMethod(m.predict_exposure)
    check_script = ClientMethod(m.check_script)
    submit_script = ClientMethod(m.submit_script)
    check_trajectory = ClientMethod(m.check_trajectory)
    submit_trajectory = ClientMethod(m.submit_trajectory)
    jobs = ClientMethod(m.jobs)
    job_status = ClientMethod(m.job_status)
    pause_job = ClientMethod(m.pause_job)
    resume_job = ClientMethod(m.resume_job)
    step_job = ClientMethod(m.step_job)
    abort_job = ClientMethod(m.abort_job)
    forget_job = ClientMethod(m.forget_job)
    wait_job = ClientMethod(m.wait_job)
    datasets = ClientMethod(m.datasets)
    dataset = ClientMethod(m.dataset)
    dataset_frame = ClientMethod(m.dataset_frame)
    apply_calibration = ClientMethod(m.apply_calibration)
    calibration = ClientMethod(m.calibration)
    calibrations = ClientMethod(m.calibrations)
    revert_calibration = ClientMethod(m.revert_calibration)
    delete_calibration = ClientMethod(m.delete_calibration)
    fit_calibration = ClientMethod(m.fit_calibration)
    align_dataset = ClientMethod(m.align_dataset)
    save_scene = ClientMethod(m.save_scene)
    load_scene = ClientMethod(m.load_scene)


class AsyncTwinClient(SharedMethods):
    """A connection to a twin server; an async context manager.

    It connects on entering, or with the first call. Errors are `TwinClient`'s. A call that is
    canceled may still be carried out by the server (use `stop` to end a motion).

    Args:
        host, port: of the server.
        token: where the server requires one.
        transport: replaces TCP (for tests); host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer [s]; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost [s].
        wait_s: how long to try the first time [s].
        ssl: TLS context; None for plain TCP.

    Attributes:
        core: the connection, by the policy.

    Example:
        >>> async def turn() -> None:  # doctest: +SKIP
        ...     async with AsyncTwinClient("127.0.0.1", 55000) as twin:
        ...         await twin.move({"rot_obj": 90.0}, wait=True)
    """

    @public
    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        transport: Transport | None = None,
        *,
        name: str = "flexdt.clients",
        timeout_s: float = 30.0,
        reconnect_s: float = 10.0,
        wait_s: float = 0.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        """Prepare a client for `transport`, or for TCP to host and port if None.

        Nothing is sent before `connect`. Arguments: see the class.
        """
        link: Transport
        if transport is None:
            link = TcpTransport(host, port, ssl=ssl)
        else:
            link = transport
        self.core = Core(link, name, token, timeout_s, reconnect_s, wait_s)

    async def connect(self) -> AsyncTwinClient:
        """Connect now; returns the client.

        Raises:
            ConnectionLost: no server answers.
            RpcError: the server refuses the client (-32004), or is another version.
        """
        await self.core.connected()
        return self

    async def __aenter__(self) -> AsyncTwinClient:
        return await self.connect()

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection; this releases control."""
        await self.core.close()

    @property
    def server(self) -> HelloResult:
        """The server's answer to the hello of the newest connection.

        Raises:
            RuntimeError: there has been no connection yet.
        """
        if self.core.hello is None:
            raise RuntimeError("not connected yet: await connect(), or use `async with`")
        return self.core.hello

    async def run(self, flow: Flow[_R]) -> _R:
        """Run a flow of `twin_methods` or yours."""
        return await adrive(flow, self.core.call)

    def subscribe(
        self,
        *topics: Topic,
        max_rate_hz: float | None = None,
        projection_kind: Kind | None = None,
        projection_binning: int | None = None,
        max_queue: int = 256,
    ) -> AsyncSubscription:
        """Return a subscription to `topics` (default: state), for `async with` and `async
        for`.

        Nothing is sent before it is entered or the first event is awaited; the error is
        raised then. Options that are None are the server's.

        Args:
            topics: state, projection, job, log.
            max_rate_hz: most events per second for each topic.
            projection_kind, projection_binning: for the topic projection.
            max_queue: events kept until they are read; the oldest are dropped first.

        Raises:
            ValueError: this client already follows one of the topics with other options.
        """
        core = self.core
        options = {
            "max_rate_hz": max_rate_hz,
            "projection_kind": projection_kind,
            "projection_binning": projection_binning,
        }
        return AsyncSubscription(
            topics or ("state",),
            max_queue,
            lambda made: core.subscribe(made, options),
            core.connected,
            core.unsubscribe,
        )


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    """Start the event loop of all synchronous clients in a thread, once.

    At exit `_end_links` runs.
    """
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="flexdt-clients", daemon=True).start()
    atexit.register(_end_links)
    return loop


def _end_links() -> None:
    """End the connections of clients that were not closed, by canceling all tasks of the
    clients' loop; called as Python exits.

    It waits until they have ended.
    """

    async def cancel() -> None:
        """Cancel all tasks of this loop but this one, and wait for their ends; their
        errors are ignored.
        """
        readers = asyncio.all_tasks() - {asyncio.current_task()}
        for reader in readers:
            reader.cancel()
        await asyncio.gather(*readers, return_exceptions=True)

    _result(cancel())


if hasattr(os, "register_at_fork"):  # a forked process has no thread that runs the loop
    os.register_at_fork(after_in_child=_loop.cache_clear)


def _result(work: Coroutine[Any, Any, _R]) -> _R:
    """Run `work` on the clients' loop and return its result; an error cancels it.

    Never call it from that loop.
    """
    doing = asyncio.run_coroutine_threadsafe(work, _loop())
    try:
        return doing.result()
    except BaseException:
        doing.cancel()
        raise


class TwinClient(SharedMethods):
    """A connection to a twin server; a context manager, usable from several threads.

    Errors of all methods are `RpcError` with code, message and data, or `ConnectionLost`.

    Args:
        host, port: of the server.
        token: where the server requires one.
        transport: replaces TCP (for tests); host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer [s]; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost [s].
        wait_s: how long to try the first time [s].
        ssl: TLS context; None for plain TCP.

    Raises:
        ConnectionLost: no server answers.
        RpcError: the server refuses the client (-32004), or is another version.

    Example:
        >>> with TwinClient("127.0.0.1", 55000) as twin:  # doctest: +SKIP
        ...     twin.move({"mag_obj": 660.0, "rot_obj": 90.0}, wait=True)
        ...     image = twin.projection("counts").image
    """

    @public
    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        transport: Transport | None = None,
        *,
        name: str = "flexdt.clients",
        timeout_s: float = 30.0,
        reconnect_s: float = 10.0,
        wait_s: float = 0.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        """Connect to the twin, blocking until the handshake is done; arguments and
        errors: see the class.

        Options are those of `AsyncTwinClient`, which runs on the clients' shared loop.
        """
        self._client = AsyncTwinClient(
            host,
            port,
            token,
            transport,
            name=name,
            timeout_s=timeout_s,
            reconnect_s=reconnect_s,
            wait_s=wait_s,
            ssl=ssl,
        )
        self._wait(self._client.connect())

    def __repr__(self) -> str:
        return f"<TwinClient: {self._client.core.transport!r}>"

    def __enter__(self) -> TwinClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; this releases control."""
        self._wait(self._client.close())

    @property
    def server(self) -> HelloResult:
        """The server's answer to the hello of the newest connection."""
        return self._client.server

    def run(self, flow: Flow[_R]) -> _R:
        """Run a flow of `twin_methods`, or your own made of them."""
        return drive(flow, self._perform)

    def subscribe(
        self,
        *topics: Topic,
        max_rate_hz: float | None = None,
        projection_kind: Kind | None = None,
        projection_binning: int | None = None,
        max_queue: int = 256,
    ) -> Subscription:
        """Subscribe to `topics` (default: state) and return an iterator over their
        events.

        It subscribes at once, and blocks until the server has answered.

        Args:
            topics: state, projection, job, log.
            max_rate_hz: most events per second for each topic.
            projection_kind, projection_binning: for the topic projection.
            max_queue: events kept until they are read; the oldest are dropped first.

        Raises:
            ValueError: this client already follows one of the topics with other options.
        """
        events = self._client.subscribe(
            *topics,
            max_rate_hz=max_rate_hz,
            projection_kind=projection_kind,
            projection_binning=projection_binning,
            max_queue=max_queue,
        )
        self._wait(events.__aenter__())
        return Subscription(events, self._wait)

    def _perform(self, effect: Effect) -> object:
        """Perform one effect and return its result, blocking until it is done.

        A `Tell` calls its function in this thread.
        """
        if isinstance(
            effect, Tell
        ):  # in the thread that calls, where it may call the client
            return effect.function(*effect.args)
        return self._wait(perform(effect, self._client.core.call))

    def _wait(self, work: Coroutine[Any, Any, _R]) -> _R:
        return _result(work)
