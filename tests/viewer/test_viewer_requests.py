"""What pages ask of the viewer itself: wrong requests harm nobody, too much is refused."""

from __future__ import annotations

import asyncio
import base64
import inspect
import io
import json
import struct
import sys
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from urllib.request import urlopen

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.launch import up
from flexdt.clients.viewer import main as viewer_main
from flexdt.clients.viewer import page as tasks
from flexdt.clients.viewer import viewer as app
from flexdt.clients.viewer.feed import ImageFeed
from flexdt.clients.viewer.page import HIDDEN, MAX_NOTES, Page
from flexdt.clients.viewer.page_methods import METHODS, serve
from flexdt.clients.viewer.shown_images import ShownImage
from flexdt.protocol import METHODS as WIRE
from flexdt.protocol import Connection, Notification, Request, Response
from flexdt.runtime.process_settings import Address, UpSettings, ViewerSettings
from flexdt.runtime.settings import parse

pytestmark = pytest.mark.slow

PATIENCE_S = 240.0
"""Silence after which no answer is expected any more [s]."""
NOWHERE = TwinAddress("127.0.0.1", 1)


TOOK = ('{"took":"state"}', '{"took":"image"}')
"""Acknowledgements, as a page's script sends them."""


async def hear(page: ClientConnection, what: Callable[[Any], bool]) -> Any:
    """The first message that is `what`: decoded JSON, or an image's bytes."""
    now = asyncio.get_running_loop().time
    async with asyncio.timeout(PATIENCE_S) as limit:
        async for message in page:
            limit.reschedule(now() + PATIENCE_S)
            value = message if isinstance(message, bytes) else json.loads(message)
            if isinstance(value, bytes) or value["type"] == "state":
                await page.send(TOOK[isinstance(value, bytes)])
            if what(value):
                return value
    raise AssertionError("the viewer ended the connection")


async def ask(page: ClientConnection, method: str, params: object, id: object = 1) -> Any:
    await page.send(json.dumps({"id": id, "method": method, "params": params}))
    return await answer(page, id)


async def answer(page: ClientConnection, id: object) -> Any:
    told = lambda m: isinstance(m, dict) and m["type"] == "answer" and m["id"] == id  # noqa: E731
    return await hear(page, told)


def on_page(
    port: int, work: Callable[[ClientConnection], Awaitable[Any]], id: str = "a"
) -> Any:
    async def run() -> Any:
        url = f"ws://127.0.0.1:{port}/ws/{id * 12}"
        async with connect(url, max_size=None, proxy=None) as page:
            # States come over the viewer's connection to the twin, answers over the page's own.
            missing = {"state", "session"}
            while missing:
                told = await hear(
                    page, lambda m: isinstance(m, dict) and m["type"] in missing
                )
                if told.get("connected", True):
                    missing.discard(told["type"])
            return await work(page)

    return asyncio.run(run())


WRONG = [
    ("viewer.window", {"low": "a", "high": "b"}),
    ("viewer.window", {"low": 1.0}),
    ("viewer.window", {"low": 2.0, "high": 1.0}),
    ("viewer.window", {"low": float("nan"), "high": 1.0}),
    ("viewer.window", {"low": 0.0, "high": float("inf")}),
    ("viewer.layers", {"no such layer": True}),
    ("viewer.covered", {"view": "iso", "boxes": [[0.0, 1.0, 2.0]]}),
    ("viewer.layers", {"beam": "yes"}),
    ("viewer.layers", {"opacity": []}),
    ("viewer.theme", {"dark": 3}),
    ("viewer.ghost", {"shown": "yes"}),
    ("viewer.thumbnail", {"name": "a", "index": -1}),
    ("viewer.person", {"name": 7}),
    ("viewer.camera", {"view": 7}),
    ("viewer.feed", {"kind": "films"}),
    ("viewer.plan", {"text": 12}),
    ("viewer.recorded", {"name": ["a"]}),
    ("viewer.recorded_image", {"index": -1}),
    ("viewer.compose", {"frames": 10.5}),
    ("viewer.compose", {"frames": 0}),
    ("viewer.compose", {"exposure_ms": None}),
    ("viewer.datasets", {"all": True}),
    ("calibration.fit", {"datasets": "x", "phantom": "lego"}),
    ("calibration.fit", {"datasets": ["x"], "phantom": None}),
    ("calibration.align", {"name": ["a"]}),
    ("viewer.recorded_image", {"index": 0, "virtual": 1}),
    ("viewer.scrub", {"time_s": "soon"}),
    ("viewer.scrub", {"time_s": 2**70}),
    ("viewer.scrub", {"time_s": 1e300}),
    ("viewer.window", {"low": -(2**70), "high": 1.0}),
    ("viewer.plan", {"text": "tube\ud800\txrayon"}),
    ("viewer.recorded", {"name": "a\ud800"}),
    ("viewer.recorded", {"name": "a\x00"}),
    ("viewer.spectrum", {"kV": "90"}),
    ("viewer.spectrum", {"kV": -(2**70)}),
    ("viewer.live", {"name": 5}),
    ("viewer.live", {"name": "a", "side": 129}),
    ("viewer.compose", {"frames": 2**70}),
    ("viewer.compose", {"exposure_ms": 1e-300}),
    ("calibration.fit", {"datasets": ["\udfff"], "phantom": "lego"}),
    ("calibration.fit", {"datasets": ["a"], "phantom": "\ud800"}),
    ("viewer.ray", {"pixel": [1.0, 2**70]}),
    ("viewer.screenshot", {"height": 2**70}),
    ("calibration.apply", {"parameters": {"alpha\ud800": 0.2}}),
    ("calibration.apply", {"parameters": {"alpha": 2**70}}),
    ("viewer.screenshot", {"width": 10**9}),
    ("viewer.export", {"format": "exe"}),
    ("viewer.block", {"name": "a", "what": "below"}),
    ("viewer.voxel", {"name": "a", "at": [0, 0, -1]}),
    ("viewer.compare", {"truth": "hidden"}),
    ("viewer.preset", {"view": "below"}),
    ("viewer.preset", {"aspect": 0.0}),
    ("calibration.apply", {"parameters": {}}),
    ("calibration.apply", {"parameters": {"alpha": "0.2"}}),
]


def test_wrong_parameters_are_told_and_the_radiograph_goes_on(lab: Any) -> None:
    """A window of text once ended the images of everybody for good."""

    async def work(page: ClientConnection) -> None:
        for i, (method, params) in enumerate(WRONG):
            got = await ask(page, method, params, i)
            assert got.get("error", {}).get("code") == -32602, (method, params, got)
            field = got["error"]["message"].split(":")[0].split(".")[0]
            assert field in (*params, "params"), (method, params, got)
        assert {m for m, _ in WRONG} == set(METHODS)
        await ask(page, "viewer.window", {"low": 0.0, "high": 1.0}, "window")
        await hear(page, lambda m: isinstance(m, bytes))
        await ask(page, "viewer.window", {}, "auto")
        await ask(page, "clock.set", {"speed_up": 8}, "clock")
        turned = await ask(
            page, "axes.move", {"targets": {"rot_obj": 3.0}, "relative": True}, "go"
        )
        assert "error" not in turned
        await hear(page, lambda m: isinstance(m, bytes))

    on_page(lab.viewer.port, work)


ABSURD = [
    ("axes.move", {"targets": {"mag_obj\ud800": 1.0}}, "targets"),
    ("axes.move", {"targets": {"mag_obj": 2**70}}, "targets.mag_obj"),
    ("axes.move", {"targets": {"mag_obj": 1.0}, "wait": 2**70}, "wait"),
    ("axes.jog", {"axis": "\ud800", "velocity": 1.0}, "axis"),
    ("tube.set", {"kV": -(2**70)}, "kV"),
    ("sample.set", {"name": "a\udc00b"}, "name"),
    ("script.check", {"text": "\ud800"}, "text"),
    ("clock.set", {"speed_up": 2**70}, "speed_up"),
    ("state.get", {"\ud800": 1}, "params"),
    ("state.get", {"x": 2**70}, "x"),
]


def test_what_the_wire_has_no_bytes_for_is_refused_with_its_field(lab: Any) -> None:
    async def work(page: ClientConnection) -> None:
        for i, (method, params, field) in enumerate(ABSURD):
            got = await ask(page, method, params, i)
            error = got.get("error", {})
            assert error.get("code") == -32602, (method, params, got)
            assert any(field in p["path"] for p in error["data"]["problems"]), (
                field,
                error,
            )
        assert "result" in await ask(page, "state.get", {}, "still there")

    on_page(lab.viewer.port, work)


def test_requests_that_are_none_are_told_and_the_page_goes_on(lab: Any) -> None:
    async def work(page: ClientConnection) -> None:
        for text in (
            '{"id": 1, "method": 7}', '{"id": 1, "method": ["x"]}', '{"id": 1, "many": 1}',
            '{"id": 1, "method": "state.get", "params": [1]}', "3", "\x00",
            f'{{"id": {2**70}, "method": "state.get"}}', f'{{"id": {"9" * 5000}, "method": "x"}}',
            '{"id": "%s", "method": "state.get"}' % ("i" * 1000), '{"id": 1e300, "method": "x"}',
            "[" + "1," * 600_000 + "1]",
        ):  # fmt: skip
            await page.send(text)
            got = await hear(
                page, lambda m: isinstance(m, dict) and m["type"] == "answer"
            )
            assert got["error"]["code"] == -32600, (text[:60], got)
            assert got["id"] == (1 if text.startswith('{"id": 1, "m') else None), text[
                :60
            ]
        got = await ask(page, "\ud800" * 10**6, {}, 1)
        assert got["error"]["code"] == -32601
        assert len(json.dumps(got)) < 2000
        assert "result" in await ask(page, "state.get", {}, "i\ud800")

    on_page(lab.viewer.port, work)


def test_a_page_with_too_many_requests_under_way_is_told_and_still_stops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What overtakes elsewhere overtakes here."""

    async def run() -> list[Any]:
        sent: list[Any] = []
        held = asyncio.Event()

        async def slow(page: Page, params: object) -> object:
            await held.wait()
            return {}

        page = Page("b" * 12, cast(Any, SimpleNamespace()), NOWHERE, {"x": slow})
        page.say = lambda kind, **content: sent.append(content)  # type: ignore[method-assign,assignment]
        waiting = [
            asyncio.create_task(page._handle('{"id": 1, "method": "x"}'))
            for _ in range(64)
        ]
        await asyncio.sleep(0)
        await page._handle('{"id": 2, "method": "x"}')
        await page._handle('{"id": 3, "method": "safety.estop"}')
        held.set()
        await asyncio.gather(*waiting)
        await page._handle('{"id": 4, "method": "x"}')
        return sent

    told = asyncio.run(run())
    assert told[0]["id"] == 2
    assert told[0]["error"]["code"] == -32003
    assert told[1]["id"] == 3
    assert "no connection to the twin" in told[1]["error"]["message"]
    assert "result" in told[-1]
    assert len(told) == 67


def test_a_request_nested_too_deep_is_answered(lab: Any) -> None:
    async def work(page: ClientConnection) -> None:
        for text in (
            "[" * 100_000,
            '{"id": 1, "method": "x", "params": ' + '{"a":' * 100_000,
        ):
            await page.send(text)
            got = await answer(page, None)
            assert got["error"]["code"] == -32600
            assert "deep" in got["error"]["message"]
        await page.send('{"id": [[1]], "method": "state.get"}')
        assert (await answer(page, None))["error"]["code"] == -32600
        assert "result" in await ask(page, "state.get", {}, "still there")

    on_page(lab.viewer.port, work)


def test_a_hostile_mesh_is_not_read_by_the_viewer(lab: Any) -> None:
    """A small GLB that stands for 600 MB of zeros: the twin's reader refuses it."""
    count = 50_000_000
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"byteLength": 12}], "bufferViews": [{"buffer": 0, "byteLength": 12}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3"}],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", 12, 0x004E4942) + bytes(12)
    content = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def peak_mb() -> float:
        status = Path(f"/proc/{lab.viewer.process.pid}/status").read_text()
        return float(status.split("VmHWM:")[1].split()[0]) / 1e3

    async def work(page: ClientConnection) -> None:
        before = peak_mb()
        data = base64.b64encode(content).decode()
        head = {"name": "bomb", "format": "glb", "unit": "m", "total": len(content)}
        got = await ask(page, "sample.upload", {**head, "start": 0, "data": data})
        grown = peak_mb() - before
        assert got["error"]["code"] == -32602, got
        assert grown < 200.0, (before, grown)

    on_page(lab.viewer.port, work)


HUGE = "camera\tset number of frames\t1000000\t\tACK\t\t\r\n" + "".join(
    f"camera\ttake and save image sequence\ta{i}_\t0\tACK\t\t\r\n" for i in range(60)
)


@pytest.mark.timeout(900)
def test_a_plan_that_takes_too_much_is_refused_and_the_pages_go_on(lab: Any) -> None:
    """Sixty million images: planned in a process of its own, with limits."""

    async def work(page: ClientConnection) -> None:
        got = await ask(page, "viewer.plan", {"text": HUGE}, "plan")
        assert got["error"]["code"] == -32008, got
        many = HUGE.replace("1000000", "1000", 1)
        got = await ask(page, "viewer.plan", {"text": many}, "less")
        assert got["result"]["frames"] == 60_000, got
        got = await ask(page, "viewer.plan", {"text": "no script\r\n" * 2000}, "none")
        assert got["error"]["code"] == -32005, got

    on_page(lab.viewer.port, work)


def test_an_image_that_cannot_be_shown_is_not_the_last() -> None:
    shown: list[int] = []

    def take(image: ShownImage, coarse: bool) -> None:
        shown.append(image.seq)
        if image.seq == 1:
            raise RuntimeError("not this one")

    def event(seq: int) -> dict[str, object]:
        pixels = {"dtype": "uint16", "shape": [2, 2], "data": bytes(8)}
        data = {**pixels, "kind": "counts", "cone_vec": [0.0] * 12}
        return {"topic": "projection", "seq": seq, "time": 0.0, "data": data}

    async def run() -> None:
        feed = ImageFeed(NOWHERE, "counts", take)
        feed.start()
        async with asyncio.timeout(PATIENCE_S):
            for params, seq in (
                (event(1), 1),
                ({"data": 3, "seq": 2, "time": 0.0}, 1),
                (event(3), 3),
            ):
                feed._arrived("projection", params)
                while seq not in shown or feed._due.is_set():
                    await asyncio.sleep(0.01)
        await feed.stop()

    asyncio.run(run())


def test_a_task_that_dies_is_told() -> None:
    async def run() -> None:
        died = asyncio.Event()

        async def fail() -> None:
            raise RuntimeError("gone")

        await tasks.watched(fail(), "a test", died.set)
        assert died.is_set()
        unbegun = fail()
        tasks.watched(unbegun, "a test").cancel()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert inspect.getcoroutinestate(unbegun) == inspect.CORO_CLOSED

    asyncio.run(run())


def test_a_viewer_of_which_a_part_has_died_ends_with_a_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So that the supervisor starts it again."""

    class Dying:
        def __init__(self, *_: object, **__: object) -> None:
            self.failed, self.front = asyncio.Event(), SimpleNamespace(port=1)
            self.stopped = False

        async def start(self, *_: object) -> None:
            asyncio.get_running_loop().call_soon(self.failed.set)

        async def stop(self) -> None:
            self.stopped = True

    monkeypatch.setattr(app, "Viewer", Dying)
    options = parse(ViewerSettings, ["--port", "0"])
    out = io.StringIO()
    assert asyncio.run(viewer_main.run(options, out)) == 1
    assert json.loads(out.getvalue())["ready"] == "viewer"


def test_a_page_that_takes_nothing_is_closed() -> None:
    """What must arrive is not dropped without a word."""

    class Stuck:
        closed: tuple[int, str] | None = None

        async def send(self, _: object) -> None:
            await asyncio.Event().wait()

        def __aiter__(self) -> Stuck:
            return self

        async def __anext__(self) -> object:
            await asyncio.Event().wait()

        async def close(self, code: int, reason: str) -> None:
            self.closed = (code, reason)

    async def run() -> None:
        browser = Stuck()
        page = Page("a" * 12, cast(Any, browser), NOWHERE, {})
        served = asyncio.create_task(page.run())
        for i in range(MAX_NOTES + 2):
            page.say("log", data=i)
        async with asyncio.timeout(PATIENCE_S):
            await served
        assert browser.closed is not None
        assert browser.closed[0] == 1013

    asyncio.run(run())


def test_an_internal_error_is_in_the_log_under_its_id(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from flexdt.runtime.log import LOGGER, set_up

    async def broken(page: Page, params: object) -> object:
        raise RuntimeError("quite a secret")

    async def run() -> list[Any]:
        sent: list[Any] = []
        page = Page("b" * 12, cast(Any, SimpleNamespace()), NOWHERE, {"x": broken})
        page.say = lambda kind, **content: sent.append(content)  # type: ignore[method-assign,assignment]
        await page._handle('{"id": 1, "method": "x"}')
        return sent

    before = LOGGER.handlers[:], LOGGER.level, LOGGER.propagate
    set_up(sys.stderr)
    try:
        told = asyncio.run(run())
    finally:
        LOGGER.handlers[:], LOGGER.level, LOGGER.propagate = before
    assert told[0]["error"]["code"] == -32603
    assert "secret" not in json.dumps(told)
    line = json.loads(capsys.readouterr().err)
    assert line["trace"] == told[0]["error"]["data"]["trace"]
    assert "quite a secret" in line["traceback"]


OF_THE_TWIN: list[tuple[str, dict[str, object]]] = [
    ("viewer.ray", {"pixel": [1.0, 2.0]}),
    ("viewer.spectrum", {"kV": 90.0}),
    ("viewer.plan", {"text": "tube\txrayon"}),
    ("viewer.compose", {"frames": 91}),
    ("viewer.scrub", {"time_s": 1.0}),
    ("calibration.apply", {"parameters": {"alpha": 0.2}}),
    ("calibration.fit", {"datasets": ["x"], "phantom": "lego"}),
    ("calibration.align", {"name": "x"}),
]
"""Sound requests to the viewer that it cannot answer before it has seen its twin."""


def test_before_the_link_to_the_twin_is_up_no_answer_is_an_internal_error() -> None:
    unseen: Any = SimpleNamespace(lab=None, state=None, world=None, twin_address=NOWHERE)
    wire = [(name, {}) for name in WIRE if name not in {*HIDDEN, *METHODS}]
    sent: dict[object, dict[str, object]] = {}

    async def run() -> None:
        local = {name: partial(serve, name, unseen) for name in METHODS}
        page = Page("c" * 12, cast(Any, SimpleNamespace()), NOWHERE, local)
        page.say = lambda kind, **content: sent.update({content["id"]: content["error"]})  # type: ignore[method-assign,assignment]
        for name, params in wire + OF_THE_TWIN:
            await page._handle(json.dumps({"id": name, "method": name, "params": params}))

    asyncio.run(run())
    codes = {name: error["code"] for name, error in sent.items()}
    assert codes == dict.fromkeys([name for name, _ in wire + OF_THE_TWIN], -32011)
    assert sent["axes.move"]["message"] == "no connection to the twin: not connected yet"


def comes_in(port: int) -> bool:
    """Whether a page is served; the one before may just be going."""
    try:
        on_page(port, lambda page: ask(page, "state.get", {}), "c")
    except ConnectionClosed:
        return False
    return True


def test_pages_beyond_the_limit_are_told_why_and_figures_count_them(
    lab: Any, wait: Callable[..., Any]
) -> None:
    viewer = lab.another_viewer("--http-port", "0", "--limit", "max_pages=1")
    try:
        pages = f"http://127.0.0.1:{viewer.ready['http_port']}"

        async def second(page: ClientConnection) -> None:
            url = f"ws://127.0.0.1:{viewer.port}/ws/{'f' * 12}"
            async with connect(url, proxy=None) as other:
                with pytest.raises(ConnectionClosed) as closed:
                    await asyncio.wait_for(other.recv(), PATIENCE_S)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1013
            assert "1 pages at most" in closed.value.rcvd.reason
            text = await asyncio.to_thread(
                lambda: urlopen(f"{pages}/metrics").read().decode()
            )
            assert "\nflexdt_pages 1" in text
            assert "\nflexdt_twin_connected 1" in text

        on_page(viewer.port, second)
        health = json.loads(urlopen(f"{pages}/healthz").read())
        assert (health["status"], health["twin"]) == ("ok", "connected")
        wait(lambda: comes_in(viewer.port), "there is room again")
    finally:
        viewer.stop()


def test_an_event_that_nobody_understands_does_not_end_the_link() -> None:
    """A twin that says something odd is heard further."""
    heard: list[object] = []

    def understand(topic: str, params: Any) -> None:
        heard.append(params["data"]["time"])

    async def twin(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        wire = Connection()
        greeted = {"protocol": "1.0", "server": "odd", "machine": "flexray"}
        while data := await reader.read(1 << 16):
            for request in wire.receive_data(data):
                assert isinstance(request, Request)
                result = greeted if request.method == "session.hello" else {}
                writer.write(wire.send(Response(request.id, result)))
                if request.method == "state.subscribe":
                    for odd in ({}, {"time": 3.0}):
                        params = {"topic": "state", "data": odd}
                        writer.write(wire.send(Notification("event", params)))

    async def run() -> None:
        server = await asyncio.start_server(twin, "127.0.0.1", 0)
        address = TwinAddress("127.0.0.1", server.sockets[0].getsockname()[1])
        link = KeptConnection(
            address, "a test", understand, subscription={"topics": ["state"]}
        )
        keeping = asyncio.create_task(link.run())
        async with asyncio.timeout(PATIENCE_S):
            # Its events may come in the same packet as the answer to the subscription.
            while not (heard and link.connected):
                await asyncio.sleep(0.01)
        assert await link.request("session.ping") == {}
        keeping.cancel()
        await asyncio.wait([keeping])
        assert not link.connected
        server.close()

    asyncio.run(run())
    assert heard == [3.0]


def test_up_gives_each_limit_to_the_process_that_has_it() -> None:
    words = ["--limit", "max_pages=3", "--limit", "max_jobs=7", "--log-level", "debug"]
    known = {"projector": Address("127.0.0.1", 1), "twin": Address("127.0.0.1", 2)}
    _, twin, viewer = (s.command(known) for s in up.services(parse(UpSettings, words)))
    assert "max_jobs=7" in twin
    assert "max_pages=3" not in twin
    assert "max_pages=3" in viewer
    assert "max_jobs=7" not in viewer
    assert "debug" in viewer
    parse(ViewerSettings, viewer[1:])
