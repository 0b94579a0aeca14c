"""TwinClient against a function (both codecs) and against the real TCP shell."""

from __future__ import annotations

import asyncio
import base64
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from in_process_transport import InProcessTransport
from numpy.testing import assert_array_equal

from flexdt.clients import AsyncTwinClient, ConnectionLost, TwinClient
from flexdt.clients.cli.boundary import REFUSED, describe
from flexdt.clients.client.transport import TcpTransport
from flexdt.protocol import (
    METHODS,
    Codec,
    Connection,
    Failure,
    Message,
    Method,
    Request,
    Response,
    RpcError,
    event,
    image,
    parse_params,
)
from flexdt.protocol.fields import Empty, Params
from flexdt.protocol.methods.scanner_messages import SampleUpload
from flexdt.protocol.methods.session_messages import Hello
from flexdt.protocol.rpc_errors import Code, parse_error
from flexdt.runtime.wire_errors import explain
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import serve
from flexdt.twin.errors import TwinError

AXIS = {
    "position": 1.0,
    "target": 1.0,
    "velocity": 0.0,
    "limits": [0, 2],
    "moving": False,
}
STATE: dict[str, Any] = {
    "time": 1.5,
    "axes": {"mag_obj": AXIS},
    "tube": {"on": False, "kV": 90, "power_W": 20},
    "camera": {
        "mode": "HW2SW1High",
        "exposure_ms": 100,
        "roi": [32, 8, 1943, 1527],
        "shape": [760, 956],
        "pixel_mm": 0.1496,
    },
    "sample": {"name": None},
    "geometry": {
        "SOD_mm": 600,
        "SDD_mm": 1059,
        "magnification": 1.765,
        "voxel_size_mm": 0.0848,
        "piercing_point_px": [477.5, 379.5],
        "field_of_view_mm": [81, 64],
    },
    "safety": {"state": "ok", "estop": False},
    "clock": {"time_s": 1.5, "speed_up": "max"},
}
PIXELS = np.arange(12, dtype=np.float32).reshape(3, 4)
CONE = [float(i) for i in range(12)]


def answer(method: str, params: Params) -> dict[str, Any]:
    """A twin in one function: just enough for each result model."""
    match method:
        case "session.hello":
            return {"protocol": "1.0", "server": "fake", "machine": "flexray"}
        case "state.get" | "axes.stop" | "safety.estop" | "safety.reset" | "scene.load":
            return STATE
        case "session.ping":
            return {"time": 2.0}
        case "axes.move":
            return {"duration_s": 3.0, "warnings": ["slow"]}
        case "axes.set":
            raise RpcError(-32001, "too fast", {"asked": 99, "allowed": [0, 50]})
        case "projection.get":
            return {**image.encode(PIXELS), "cone_vec": CONE, "kind": "line_integral"}
        case "projection.ray":
            return {"paths_mm": {"PMMA": 4.5}}
        case "sample.upload":
            assert isinstance(params, SampleUpload)
            end = params.start + len(params.data)
            return {"name": params.name, "received": end, "complete": end == params.total}
        case "script.submit":
            return {"job": "job-1"}
    return {}


class Fake:
    """Answers messages and remembers the calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, Params]] = []
        self.lose_next: str | None = None
        self.transport: InProcessTransport | None = None

    def __call__(self, message: Message) -> Iterable[Message]:
        assert isinstance(message, Request), message
        method = METHODS[message.method]
        params = parse_params(method, message.params)
        self.calls.append((method.name, params))
        if self.lose_next == method.name:
            self.lose_next = None
            assert self.transport is not None
            self.transport.close()
            return []
        try:
            return [Response(message.id, answer(method.name, params))]
        except RpcError as error:
            return [Failure(message.id, error)]


@pytest.fixture(params=[Codec.JSON, Codec.MSGPACK], ids=["json", "msgpack"])
def fake(request: pytest.FixtureRequest) -> Iterator[tuple[Fake, TwinClient]]:
    served = Fake()
    served.transport = InProcessTransport(served, request.param)
    with TwinClient(transport=served.transport) as client:
        yield served, client


def test_results_are_typed_and_images_are_arrays(fake: tuple[Fake, TwinClient]) -> None:
    _, client = fake
    assert client.server.machine == "flexray"
    state = client.state()
    assert state.axes["mag_obj"].limits == (0, 2)
    assert state.camera.roi == (32, 8, 1943, 1527)
    assert client.ping() == 2.0
    assert client.ray(2, 1) == {"PMMA": 4.5}
    taken = client.projection()
    assert_array_equal(taken.image, PIXELS)
    assert taken.image.dtype == np.float32
    assert not taken.image.flags.writeable
    assert taken.cone_vec == tuple(CONE)
    done = client.move({"mag_obj": 600}, wait=True)
    assert (done.duration_s, done.warnings) == (3.0, ["slow"])


@pytest.mark.parametrize(
    ("port", "allowed"),
    [*((number, "from 1 to 65535") for number in (-1, 0, 65536, 99999)),
     *((value, "port is .*; allowed: a whole number") for value in ("55000", True))],
)  # fmt: skip
def test_a_port_that_there_cannot_be_is_refused_at_once(port: Any, allowed: str) -> None:
    with pytest.raises(ValueError, match=allowed):
        TwinClient(port=port)
    with pytest.raises(ValueError, match=allowed):
        AsyncTwinClient(port=port)


def test_errors_carry_code_message_and_data(fake: tuple[Fake, TwinClient]) -> None:
    _, client = fake
    with pytest.raises(RpcError, match="too fast") as caught:
        client.set_axis("mag_obj", speed=99.0)
    assert caught.value.code == -32001
    assert caught.value.data == {"asked": 99, "allowed": [0, 50]}


def test_what_is_not_given_is_not_sent(fake: tuple[Fake, TwinClient]) -> None:
    served, client = fake
    with pytest.raises(RpcError):
        client.set_tube(on=True)  # the fake's answer is no TubeState
    name, params = served.calls[-1]
    assert name == "tube.set"
    assert params.model_fields_set == {"on"}


def test_scripts_travel_byte_for_byte(fake: tuple[Fake, TwinClient]) -> None:
    served, client = fake
    script = b"scanner\tset sample info\t@>\x00\xff\x80\r\n"
    assert client.submit_script(script, name="a").job == "job-1"
    _, params = served.calls[-1]
    assert base64.b64decode(params.data_base64) == script  # type: ignore[attr-defined]


def test_uploads_go_in_chunks_below_a_frame(fake: tuple[Fake, TwinClient]) -> None:
    served, client = fake
    data = np.random.default_rng(0).bytes(9 * 2**20 + 3)
    seen: list[tuple[int, int]] = []
    done = client.upload_mesh(
        data, "part", format="stl", progress=lambda *sent: seen.append(sent)
    )
    assert done.complete
    assert seen[-1] == (len(data), len(data))
    chunks = [p for name, p in served.calls if name == "sample.upload"]
    assert len(chunks) == 3
    assert b"".join(p.data for p in chunks) == data  # type: ignore[attr-defined]
    voxels = np.zeros((2, 3, 4))
    client.upload_voxels(voxels, 0.1, "grid")
    _, last = served.calls[-1]
    assert last.shape == (2, 3, 4)  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="name and a format"):
        client.upload_mesh(b"x", "part")


def test_every_method_of_the_wire_has_a_client_method(
    fake: tuple[Fake, TwinClient],
) -> None:
    served, client = fake
    calls: list[Callable[[], object]] = [
        lambda: client.control("acquire"),
        client.ping,
        client.state,
        lambda: client.subscribe("state").close(),
        lambda: client.move({"mag_obj": 1}),
        lambda: client.jog("mag_obj", 1.0),
        lambda: client.set_axis("mag_obj", speed=1.0),
        client.stop,
        client.estop,
        client.reset,
        lambda: client.set_clock("max"),
        client.set_tube,
        lambda: client.set_camera(roi=(0, 0, 9, 9)),
        lambda: client.set_sample("lego"),
        client.samples,
        client.sample_mesh,
        lambda: client.delete_sample("a"),
        lambda: client.upload_mesh(b"x", "a", format="stl"),
        client.projection,
        lambda: client.ray(1, 1),
        client.geometry,
        client.predict_exposure,
        lambda: client.check_script("tube xrayon"),
        lambda: client.submit_script("tube xrayon"),
        lambda: client.check_trajectory([{"rot_obj": 1}]),
        lambda: client.submit_trajectory([{"rot_obj": 1}]),
        client.job_status,
        client.pause_job,
        client.resume_job,
        client.step_job,
        client.abort_job,
        client.jobs,
        lambda: client.forget_job("job-1"),
        client.datasets,
        lambda: client.dataset("a"),
        lambda: client.dataset_frame("a", 0),
        lambda: client.apply_calibration({"alpha": 1.0}),
        client.calibration,
        client.calibrations,
        client.revert_calibration,
        lambda: client.delete_calibration("a"),
        lambda: client.fit_calibration(["a"], "lego"),
        lambda: client.align_dataset("a"),
        client.save_scene,
        lambda: client.load_scene(SCENE),
        client.discover,
    ]
    for call in calls:
        with suppress(RpcError):  # the fake answers some with too little
            call()
    assert {name for name, _ in served.calls} == set(METHODS)


SCENE: dict[str, object] = {
    "schema": 1,
    "machine": "flexray",
    "profile": "thesis",
    "positions": {"mag_obj": 600.0},
    "tube": {"kV": 90.0, "power_W": 50.0},
    "camera": {
        "mode": "HW2SW1High",
        "roi": [32, 8, 1943, 1527],
        "exposure_ms": 100.0,
        "averages": 1,
        "frames": 1,
    },
    "sample": {"name": ""},
}


def test_a_name_that_is_no_text_is_refused_before_it_is_sent(
    fake: tuple[Fake, TwinClient],
) -> None:
    served, client = fake
    with pytest.raises(
        TypeError, match=r"axes\.move\.targets: the name 3 must be text, not int"
    ):
        client.move({3: 1.0})  # type: ignore[dict-item]
    with pytest.raises(TypeError, match="the name b'x' must be text, not bytes"):
        client.submit_trajectory([{b"x": 1.0}])  # type: ignore[dict-item]
    assert [name for name, _ in served.calls] == ["session.hello"]
    assert client.ping() == 2.0


def test_who_waits_is_told_that_the_server_could_not_read_a_request() -> None:
    def handler(message: Message) -> Iterable[Message]:
        assert isinstance(message, Request)
        if message.method == "session.hello":
            return [Response(message.id, answer(message.method, Empty()))]
        return [Failure(None, parse_error("not MessagePack"))]

    transport = InProcessTransport(handler)
    with (
        TwinClient(transport=transport, timeout_s=60.0) as client,
        pytest.raises(RpcError, match="parse error: not MessagePack"),
    ):
        client.ping()


def test_reads_are_repeated_after_a_lost_connection_and_moves_are_not(
    fake: tuple[Fake, TwinClient],
) -> None:
    served, client = fake
    served.lose_next = "state.get"
    assert client.state().time == 1.5
    served.lose_next = "axes.move"
    with pytest.raises(
        ConnectionLost, match="not known whether it was carried out"
    ) as caught:
        client.move({"mag_obj": 1})
    assert caught.value.sent
    assert [name for name, _ in served.calls].count("axes.move") == 1
    client.move({"mag_obj": 1})  # the next one finds a new connection
    assert [name for name, _ in served.calls].count("session.hello") == 3


def test_subscriptions_deliver_typed_events_and_survive_a_reconnect(
    fake: tuple[Fake, TwinClient],
) -> None:
    served, client = fake
    transport = served.transport
    assert transport is not None

    def tell_when_back() -> None:
        while [name for name, _ in served.calls].count("state.subscribe") < 2:
            time.sleep(0.01)
        transport.push(event("state", 9, 2.0, STATE))

    with client.subscribe("state", "projection", max_rate_hz=20.0) as events:
        transport.push(event("state", 1, 1.5, STATE))
        transport.push(event("job", 1, 1.5, {}))  # not asked for
        picture = {**image.encode(PIXELS), "cone_vec": CONE}
        transport.push(event("projection", 1, 1.6, picture))
        first, second = next(events), next(events)
        assert first.data.axes["mag_obj"].position == 1.0  # type: ignore[union-attr]
        assert (second.topic, second.seq, second.time) == ("projection", 1, 1.6)
        assert_array_equal(second.data.image, PIXELS)  # type: ignore[union-attr]
        transport.close()
        threading.Thread(target=tell_when_back).start()
        assert events.next(timeout_s=60.0).seq == 9
        with pytest.raises(TimeoutError, match="state or projection"):
            events.next(timeout_s=0.01)
    names = [name for name, _ in served.calls]
    assert names.count("state.subscribe") == 2
    assert names[-1] == "state.unsubscribe"


def test_one_rate_and_view_a_topic(fake: tuple[Fake, TwinClient]) -> None:
    """The server keeps the last of a connection: two would silently share it."""
    served, client = fake
    with client.subscribe("projection", "state", projection_binning=8):
        asked = len(served.calls)
        with pytest.raises(
            ValueError, match=r"projection with projection_binning 32.* 8 already"
        ):
            client.subscribe("projection", projection_binning=32)
        with pytest.raises(ValueError, match="state with max_rate_hz 5"):
            client.subscribe("state", max_rate_hz=5.0)
        assert len(served.calls) == asked
        client.subscribe("job", max_rate_hz=5.0).close()
        client.subscribe("projection", projection_binning=8).close()
    client.subscribe("projection", projection_binning=32).close()


def test_a_subscription_that_nobody_reads_keeps_the_newest(
    fake: tuple[Fake, TwinClient],
) -> None:
    served, client = fake
    assert served.transport is not None
    with client.subscribe("state", max_queue=2) as events:
        for seq in range(5):
            served.transport.push(event("state", seq, 0.0, STATE))
        client.ping()  # all events before its answer have been read
        assert [events.next(1.0).seq for _ in range(2)] == [3, 4]
        assert events.dropped == 3


def test_wait_job_reports_progress_until_the_end() -> None:
    states = iter(["queued", "running", "running", "done"])

    def handler(message: Message) -> Iterable[Message]:
        assert isinstance(message, Request)
        if message.method == "job.status":
            return [Response(message.id, {"job": "job-1", "state": next(states)})]
        return [
            Response(message.id, answer(message.method, Hello(protocol="1", client="x")))
        ]

    seen: list[str] = []
    with TwinClient(transport=InProcessTransport(handler)) as client:
        last = client.wait_job("job-1", lambda s: seen.append(s.state), poll_s=0.001)
    assert last.state == "done"
    assert seen == ["queued", "running", "running", "done"]


def test_nobody_there_is_said_in_one_line() -> None:
    with pytest.raises(ConnectionLost, match=r"no server at 127\.0\.0\.1:1 "):
        TwinClient(port=1)


def test_a_lost_connection_is_no_wrong_parameter() -> None:
    said = explain(ConnectionLost("the server ended the connection"))
    assert said.code == Code.LINK_DOWN
    assert said.message.endswith("the server ended the connection")
    assert explain(TwinError("no")).code == Code.INVALID_PARAMS


def test_a_closed_client_says_so() -> None:
    client = TwinClient(transport=InProcessTransport(Fake()))
    client.close()
    with pytest.raises(ConnectionLost, match="closed"):
        client.state()


class _Session:
    def __init__(self, app: _App, peer: Peer) -> None:
        self.app, self.peer = app, peer

    async def handle(self, method: Method, params: Params) -> object:
        self.app.calls.append(method.name)
        if method.name == "axes.move":
            await self.app.moved.wait()
        if method.name == "axes.stop":
            self.app.moved.set()
        if method.name == "state.subscribe":
            self.peer.post(event("state", 1, 0.0, STATE), slot="state")
        return answer(method.name, params)

    def close(self) -> None:
        pass


class _App:
    def __init__(self) -> None:
        self.calls: list[str] = []
        self.moved = asyncio.Event()

    def open(self, peer: Peer) -> _Session:
        return _Session(self, peer)


class _Served:
    """The TCP shell with a fake application, in a thread of its own."""

    def __init__(self, port: int = 0, token: str | None = None) -> None:
        self.app = _App()
        self.port, self.token = port, token
        self.started = threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self.main()))
        self.thread.start()
        assert self.started.wait(10)

    async def main(self) -> None:
        self.app.moved = asyncio.Event()
        self.loop = asyncio.get_running_loop()
        self.over = asyncio.Event()
        server = await serve(self.app.open, port=self.port, token=self.token)
        self.port = server.port
        self.started.set()
        await self.over.wait()
        await server.close()

    def stop(self) -> None:
        self.loop.call_soon_threadsafe(self.over.set)
        self.thread.join()


@contextmanager
def served(port: int = 0, token: str | None = None) -> Iterator[_Served]:
    running = _Served(port, token)
    try:
        yield running
    finally:
        running.stop()


@pytest.mark.parametrize("codec", list(Codec))
def test_over_a_real_socket(codec: Codec) -> None:
    with (
        served() as server,
        TwinClient(
            transport=TcpTransport("127.0.0.1", server.port, codec=codec)
        ) as client,
    ):
        assert_array_equal(client.projection().image, PIXELS)
        with client.subscribe("state") as events:
            assert events.next(60.0).seq == 1


def test_stop_from_another_thread_ends_a_waiting_move() -> None:
    with served() as server, TwinClient(port=server.port) as client:
        done: list[float] = []
        mover = threading.Thread(
            target=lambda: done.append(client.move({"mag_obj": 1}, wait=True).duration_s)
        )
        mover.start()
        while "axes.move" not in server.app.calls:
            time.sleep(0.005)
        client.stop()
        mover.join(60.0)
        assert done == [3.0]


def test_the_server_may_restart_between_calls() -> None:
    with served() as first:
        port = first.port
        client = TwinClient(port=port)
        events = client.subscribe("state")
        assert events.next(5.0).seq == 1
    with served(port):
        assert client.state().time == 1.5
        assert events.next(5.0).seq == 1
        client.close()
    assert list(events) == []


def test_a_wrong_token_is_refused_with_its_code() -> None:
    with served(token="correct horse battery") as server:
        with pytest.raises(RpcError) as caught:
            TwinClient(port=server.port, token="wrong horse battery")
        assert caught.value.code == -32004
        with TwinClient(port=server.port, token="correct horse battery") as client:
            assert client.ping() == 2.0


def broken_server(last: bytes) -> Iterable[tuple[int, list[str]]]:
    """A server that greets, then answers every further request with `last` and ends the
    stream."""
    listening = socket.create_server(("127.0.0.1", 0))
    asked: list[str] = []

    def serve_all() -> None:
        with suppress(OSError):
            while True:
                connected, _ = listening.accept()
                with connected:
                    _serve_broken(connected, last, asked)

    threading.Thread(target=serve_all, daemon=True).start()
    with listening:
        yield listening.getsockname()[1], asked


def _serve_broken(connected: socket.socket, last: bytes, asked: list[str]) -> None:
    wire = Connection()
    while data := connected.recv(1 << 16):
        for request in wire.receive_data(data):
            assert isinstance(request, Request)
            asked.append(request.method)
            if request.method != "session.hello":
                connected.sendall(last)
                return
            connected.sendall(
                wire.send(Response(request.id, answer(request.method, Empty())))
            )


def strange_server(says: bytes, *, ends: bool) -> Iterator[int]:
    """A server that is no twin: answers the first bytes with its own, and may end then."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve_all() -> None:
        with suppress(OSError):
            while True:
                connected, _ = listening.accept()
                with connected:
                    connected.recv(1 << 16)
                    connected.sendall(says)
                    while not ends and connected.recv(1 << 16):
                        pass

    threading.Thread(target=serve_all, daemon=True).start()
    with listening:
        yield listening.getsockname()[1]


PROJECTOR = {"protocol": "1.0", "server": "flexdt projector 9", "machine": ""}
STRANGE = {
    "another program": (
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        True,
        "is not flexdt's protocol",
    ),
    "one that greets": (b"SSH-2.0-OpenSSH_9.6\r\n", False, "is not flexdt's protocol"),
    "one that hangs up": (b"", True, "ended the connection"),
    "one that is silent": (b"", False, "no answer to session.hello within 0.3 s"),
    "a projector": (
        Connection(Codec.MSGPACK).send(Response(1, PROJECTOR)),
        False,
        "it is flexdt projector 9",
    ),
}


@pytest.mark.parametrize("kind", STRANGE)
def test_what_is_no_twin_is_called_so(kind: str) -> None:
    says, ends, why = STRANGE[kind]
    with (
        contextmanager(strange_server)(says, ends=ends) as port,
        pytest.raises(OSError, match=f"^127.0.0.1:{port} is no twin.*{why}") as caught,
    ):
        TwinClient("127.0.0.1", port, timeout_s=0.3 if not (says or ends) else 60.0)
    [line], code = describe(caught.value)  # type: ignore[arg-type]
    assert str(port) in line
    assert code == REFUSED


BROKEN = {
    "half a frame": (
        Connection(Codec.MSGPACK).send(Response(2, {}))[:-3],
        "inside a message",
    ),
    "an answer nobody asked for": (
        Connection(Codec.MSGPACK).send(Response(77, {})),
        "not open",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_server_that_breaks_the_protocol_is_left(kind: str) -> None:
    last, why = BROKEN[kind]
    with contextmanager(broken_server)(last) as (port, asked):
        with (
            TwinClient("127.0.0.1", port, timeout_s=60.0) as client,
            pytest.raises(
                ConnectionLost, match=f"broke the protocol.*{why}.*not known whether"
            ),
        ):
            client.stop()

        async def run() -> None:
            async with AsyncTwinClient("127.0.0.1", port, timeout_s=60.0) as client:
                with pytest.raises(ConnectionLost, match=f"broke the protocol.*{why}"):
                    await client.stop()

        asyncio.run(run())
    assert asked == ["session.hello", "axes.stop"] * 2
