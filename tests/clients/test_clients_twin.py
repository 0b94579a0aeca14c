"""Both clients against a real twin: every method, concurrent awaits, restarts, notebooks."""

from __future__ import annotations

import asyncio
import inspect
import io
import itertools
import json
import re
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.clients import AsyncTwinClient, ConnectionLost, TwinClient
from flexdt.clients.client import twin_methods as methods
from flexdt.clients.client.flows import Ask, Flow
from flexdt.clients.client.transport import TcpTransport
from flexdt.clients.launch.processes import Servers
from flexdt.protocol import METHODS, Codec, Message, Request, RpcError

pytestmark = [pytest.mark.timeout(300), pytest.mark.slow]

POSE = {"tra_obj": 0.5405, "mag_obj": 585.0, "mag_det": 1000.0}
CUBE = b"""solid corner
facet normal 0 0 -1
outer loop
vertex 0 0 0
vertex 0 5 0
vertex 5 0 0
endloop
endfacet
facet normal 0 -1 0
outer loop
vertex 0 0 0
vertex 5 0 0
vertex 0 0 5
endloop
endfacet
facet normal -1 0 0
outer loop
vertex 0 0 0
vertex 0 0 5
vertex 0 5 0
endloop
endfacet
facet normal 1 1 1
outer loop
vertex 5 0 0
vertex 0 5 0
vertex 0 0 5
endloop
endfacet
endsolid corner
"""


class Shell:
    """Calls either client's methods; an event loop runs only while one of its calls is
    awaited."""

    def __init__(self, kind: str, address: tuple[str, int], codec: Codec) -> None:
        self.sent: set[str] = set()
        self.runner: asyncio.Runner | None = None
        self.client: Any
        transport = TcpTransport(*address, codec=codec)
        send = transport.send

        async def spy(message: Message) -> None:
            self.note(message)
            await send(message)

        transport.send = spy  # type: ignore[method-assign]
        if kind == "blocking":
            self.client = TwinClient(transport=transport)
        else:
            self.runner = asyncio.Runner()
            self.client = AsyncTwinClient(transport=transport)
            self.wait(self.client.connect())

    def note(self, message: Message) -> None:
        assert isinstance(message, Request)
        self.sent.add(message.method)

    def wait(self, value: Any) -> Any:
        if self.runner is None or not inspect.isawaitable(value):
            return value

        async def waited() -> Any:
            return await value

        return self.runner.run(waited())

    def __getattr__(self, name: str) -> Callable[..., Any]:
        method = getattr(self.client, name)
        return lambda *args, **kwargs: self.wait(method(*args, **kwargs))

    def end(self) -> None:
        self.wait(self.client.close())
        if self.runner is not None:
            self.runner.close()


@pytest.fixture(params=["blocking", "asyncio"])
def shell(request: pytest.FixtureRequest, servers: Servers) -> Iterator[Shell]:
    made = Shell(request.param, servers.address, Codec.MSGPACK)
    yield made
    made.end()


@pytest.mark.daily(1)
def test_both_clients_do_every_method_of_the_wire(shell: Shell, tmp_path: Path) -> None:
    twin = shell
    assert twin.control("acquire").yours
    start = twin.ping()
    assert {m["name"] for m in twin.discover()["methods"]} == set(METHODS)
    events = shell.client.subscribe("state", "job", max_rate_hz=50.0)
    first = shell.wait(events.next(60.0))
    assert (first.topic, set(first.data.axes) >= set(POSE)) == ("state", True)

    twin.set_clock("max")
    twin.set_tube(kV=90.0, power_W=20.0, on=True)
    assert twin.set_camera(mode="HW2SW1High", exposure_ms=50.0, roi=(800, 620, 1199, 939),
                           averages=1, frames=1).shape == (160, 200)  # fmt: skip
    assert "normal" in {s.name for s in twin.samples().samples}
    told: list[tuple[int, int]] = []
    assert twin.upload_mesh(CUBE, "corner", format="stl", material="abs",
                            progress=lambda *sent: told.append(sent)).complete  # fmt: skip
    assert told == [(len(CUBE), len(CUBE))]
    assert twin.upload_voxels(np.full((4, 5, 6), 0.02), 0.5, "grid").complete
    assert twin.set_sample(file="corner").sample.name == "corner"
    assert twin.delete_sample("grid").bytes == 4 * 4 * 5 * 6
    assert len(twin.sample_mesh()) == 84 + 4 * 50  # a binary STL of four triangles
    assert twin.set_sample("normal-5", offset={"z": 1.0}).sample.offset.z == 1.0
    assert twin.set_axis("mag_obj", speed=20.0).speed == 20.0
    twin.move(POSE, wait=True)
    assert twin.move({"rot_obj": 30.0}, relative=True, wait=True).duration_s > 0
    twin.jog("rot_obj", 5.0, 0.1)
    twin.stop()
    twin.move({"rot_obj": 0.0}, wait=True)
    state = twin.state()
    assert state.axes["mag_obj"].position == POSE["mag_obj"]
    assert state.time > start

    assert all(mm >= 0.0 for mm in twin.ray(0, 0).values())
    taken = twin.projection("line_integral", binning=2)
    assert (taken.image.shape, taken.image.dtype) == ((80, 100), np.float32)
    assert taken.image.max() > 0.1
    np.testing.assert_allclose(taken.cone_vec[:6], twin.geometry().cone_vec[:6])

    assert (
        0.0 < twin.predict_exposure(frames=3, detail="void:0.1").transmission.least < 1.0
    )

    poses = [{"rot_obj": float(a)} for a in (0, 5, 10)]
    assert twin.check_trajectory(poses, 50.0).frames == 3
    job = twin.submit_trajectory(poses, 50.0, f"walk-{twin.ping():.6f}", seed=3).job
    seen: list[str] = []
    done = twin.wait_job(job, lambda s: seen.append(s.state), poll_s=0.02, timeout_s=60.0)
    assert (done.state, done.frames_done, seen[-1]) == ("done", 3, "done")
    assert twin.job_status(job).state == "done"
    assert job in {j.job for j in twin.jobs().jobs}
    assert done.name in {d.name for d in twin.datasets().datasets}
    assert twin.dataset(done.name).info.projections == 3
    assert twin.dataset_frame(done.name, 0)[0].shape == (160, 200)
    job_events = (shell.wait(events.next(60.0)) for _ in itertools.count())
    told_done = (e.data for e in job_events if e.topic == "job" and e.data.job == job)
    assert next(status for status in told_done if status.state == "done").frames_done == 3
    shell.wait(events.close())

    bad = twin.check_script("tube\tset kV\tmany\t\tACK\t\t\r\n")
    assert not bad.ok
    bright = (
        "camera\tset exposure\t60000\t\tACK\t\t\r\ntube\txrayon\t\t\tACK\t\t\r\n"
        "camera\ttake image\t\t\tACK\t\t\r\ncamera\tsave image\tscan_0.tif\t\tACK\t\t\r\n"
    )
    assert "saturated_open_beam" in {p.code for p in twin.check_script(bright).problems}
    with pytest.raises(RpcError) as caught:
        twin.submit_script(b"warp drive\r\n")
    assert caught.value.code == -32005
    slow = [{"rot_obj": float(a)} for a in range(200)]
    long = twin.submit_trajectory(slow, 50.0, f"long-{twin.ping():.6f}", 2.0).job
    wait_for(lambda: twin.job_status(long).state == "running")
    assert twin.pause_job(long).job == long
    wait_for(lambda: twin.job_status(long).state == "paused")
    assert twin.step_job(long).job == long
    wait_for(lambda: twin.job_status(long).state == "paused")
    assert twin.resume_job(long).job == long
    assert twin.abort_job(long).job == long
    wait_for(lambda: twin.job_status(long).state in methods.FINAL_STATES)
    assert twin.forget_job(long).jobs == [long]

    name = f"mine-{twin.ping():.6f}"
    assert (
        twin.apply_calibration({"dD_x": 0.1}, name, comment="a test").correction.name
        == name
    )
    assert twin.calibration().parameters["dD_x"] == 0.1
    assert name in {c.name for c in twin.calibrations().corrections}
    twin.revert_calibration()
    assert twin.delete_calibration(name).name == name
    for asked in (
        lambda: twin.fit_calibration(["gone"], "lego"),
        lambda: twin.fit_calibration(
            ["gone"], "lego", markers=[(0, "0", 3.0, 4.0, None)]
        ),
        lambda: twin.align_dataset("gone"),
    ):
        with pytest.raises(RpcError, match="no data set 'gone'"):
            asked()
    with pytest.raises(
        ValueError, match=r"mark 1 is \(0, '1', 3.0\); allowed: \(frame, marker, "
    ):
        twin.fit_calibration(
            ["gone"], "lego", markers=[(0, "0", 3.0, 4.0, None), (0, "1", 3.0)]
        )  # type: ignore[list-item]
    document = twin.save_scene("all of it")
    assert (
        twin.load_scene(json.loads(json.dumps(document))).axes["mag_obj"].position
        == 585.0
    )
    assert twin.estop().safety.estop
    assert not twin.reset().safety.estop
    assert not twin.control("release").yours
    assert shell.sent >= set(METHODS) - {"session.hello"}


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_two_clients_have_the_same_methods_and_signatures() -> None:
    made = [
        name for name, made in vars(methods).items()
        if inspect.isfunction(made) and not name.startswith("_")
        and made.__module__ == methods.__name__
    ]  # fmt: skip
    assert len(made) > 30
    for name in made:
        theirs = [
            inspect.signature(getattr(c, name)) for c in (TwinClient, AsyncTwinClient)
        ]
        assert theirs[0] == theirs[1], name
        assert next(iter(theirs[0].parameters)) == "self"
        assert "Flow" not in str(theirs[0].return_annotation), name
        assert inspect.iscoroutinefunction(getattr(AsyncTwinClient, name)), name
        assert getattr(TwinClient, name).__doc__ == getattr(methods, name).__doc__
    public = [
        {n for n in vars(c) if not n.startswith("_")}
        for c in (TwinClient, AsyncTwinClient)
    ]
    assert public[1] - public[0] == {"connect"}
    assert public[0] <= public[1]


def test_progress_may_be_a_coroutine_function(servers: Servers) -> None:
    seen: list[object] = []

    async def told(*values: object) -> None:
        await asyncio.sleep(0)
        seen.append(values)

    async def main() -> None:
        async with AsyncTwinClient(*servers.address) as twin:
            await twin.upload_mesh(
                CUBE, "told", format="stl", material="abs", progress=told
            )
            poses = [{"rot_obj": float(a)} for a in range(3)]
            job = (
                await twin.submit_trajectory(poses, 50.0, f"told-{await twin.ping():.6f}")
            ).job
            assert (await twin.wait_job(job, told, poll_s=0.02)).state == "done"

    asyncio.run(main())
    assert seen[0] == (len(CUBE), len(CUBE))
    assert seen[-1][0].state == "done"  # type: ignore[index]


def test_hundreds_of_awaits_share_one_connection(servers: Servers) -> None:
    async def main() -> None:
        async with AsyncTwinClient(*servers.address) as twin:
            await twin.set_camera(mode="HW2SW1High", roi=(800, 620, 1199, 939))
            await twin.set_sample("normal-5")
            await twin.set_clock(20.0)
            # A motion that is waited for, and all the others beside it.
            await twin.set_axis("rot_obj", speed=30.0)
            moving = asyncio.create_task(
                twin.move({"rot_obj": 90.0}, relative=True, wait=True)
            )
            asked = [twin.ping() if i % 2 else twin.geometry() for i in range(300)]
            pictures = [twin.projection(binning=b) for b in (1, 2, 4, 8)]
            answers = await asyncio.gather(*asked)
            with pytest.raises(TypeError, match="must be text, not int"):
                await twin.move({3: 1.0})  # type: ignore[dict-item]
            shapes = [p.image.shape for p in await asyncio.gather(*pictures)]
            assert all(isinstance(a, float) == bool(i % 2) for i, a in enumerate(answers))
            assert shapes == [(160, 200), (80, 100), (40, 50), (20, 25)]
            assert (await moving).duration_s > 0
            await twin.set_clock("max")

    asyncio.run(main())


async def until_moving(address: tuple[str, int], moving: asyncio.Task[Any]) -> None:
    """Seen over a connection of its own: the server answers one connection's requests in
    order."""
    async with AsyncTwinClient(*address) as watcher:
        while not (await watcher.state()).axes["rot_obj"].moving:
            assert not moving.done(), moving.result()
            await asyncio.sleep(0.01)


def test_a_cancelled_call_leaves_the_connection_in_order(servers: Servers) -> None:
    async def main() -> None:
        async with AsyncTwinClient(*servers.address) as twin:
            await twin.set_clock(1.0)
            moving = asyncio.create_task(
                twin.move({"rot_obj": 30.0}, relative=True, wait=True)
            )
            await until_moving(servers.address, moving)
            moving.cancel()
            with pytest.raises(asyncio.CancelledError):
                await moving
            assert not (await twin.stop()).safety.estop
            await twin.set_clock("max")

    asyncio.run(main())


def test_the_blocking_client_works_inside_a_running_event_loop(servers: Servers) -> None:
    async def cell() -> tuple[int, ...]:
        with TwinClient(*servers.address) as twin, twin.subscribe("state") as events:
            assert events.next(60.0).topic == "state"
            twin.move({"rot_obj": 1.0}, relative=True, wait=True)
            return twin.projection(binning=8).image.shape

    assert len(asyncio.run(cell())) == 2


def test_a_projection_shows_itself_in_a_notebook(servers: Servers) -> None:
    from IPython.core.formatters import DisplayFormatter
    from PIL import Image

    with TwinClient(*servers.address) as twin:
        twin.set_sample("normal-5")
        twin.move(POSE, wait=True)
        taken = twin.projection(binning=4)
    shown, _ = DisplayFormatter().format(taken)
    picture = np.asarray(Image.open(io.BytesIO(shown["image/png"])))
    assert picture.shape == taken.image.shape
    dense, empty = taken.image.argmax(), taken.image.argmin()
    assert picture.flat[dense] < 10  # dense parts are dark
    assert picture.flat[empty] > 245
    assert shown["text/plain"].startswith("<Projection ")
    np.testing.assert_array_equal(np.asarray(taken), taken.image)
    assert np.asarray(taken, dtype=np.float64).dtype == np.float64


def test_a_notebook_uses_both_clients(servers: Servers) -> None:
    """A real kernel, whose event loop runs: blocking calls, top-level await, a picture."""
    import nbformat
    from nbclient import NotebookClient

    host, port = servers.address
    cells = [
        "from flexdt.clients import AsyncTwinClient, TwinClient\n"
        f"twin = TwinClient({host!r}, {port})\n"
        "twin.move({'rot_obj': 5.0}, wait=True)\n"
        "twin.projection(binning=8)",
        f"async with AsyncTwinClient({host!r}, {port}) as other:\n"
        "    position = (await other.state()).axes['rot_obj'].position\n"
        "position",
        "twin.close()",
    ]
    notebook = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell(c) for c in cells]
    )
    NotebookClient(
        notebook, timeout=240, startup_timeout=240, kernel_name="python3"
    ).execute()
    picture, position, _ = (cell.outputs for cell in notebook.cells)
    assert picture[0].data["image/png"]
    assert picture[0].data["text/plain"].startswith("<Projection ")
    assert position[0].data["text/plain"] == "5.0"


# -- restarts ------------------------------------------------------------------------------------


class Twin:
    """A twin alone on a port, without a projector."""

    def __init__(self, folder: Path, port: int = 0, *options: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flexdt.server.twin.main", "--port", str(port),
             "--data", str(folder), "--projector", "127.0.0.1:1", *options],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the twin did not start"
        self.port = int(json.loads(line)["port"])

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate(timeout=90)


def restarting(folder: Path, first: Twin) -> tuple[threading.Thread, list[Twin]]:
    """Kill the twin and start another on its port, meanwhile."""
    made: list[Twin] = []
    first.kill()
    thread = threading.Thread(target=lambda: made.append(Twin(folder, first.port)))
    thread.start()
    return thread, made


@pytest.mark.campaign(1)
def test_both_clients_survive_a_killed_and_restarted_server(tmp_path: Path) -> None:
    first = Twin(tmp_path)
    made: list[Twin] = []
    client = TwinClient(port=first.port, reconnect_s=60.0)
    events = client.subscribe("state")
    assert events.next(60.0).topic == "state"

    async def main() -> None:
        async with AsyncTwinClient(port=first.port, reconnect_s=60.0) as twin:
            async with twin.subscribe("state") as theirs:
                assert (await theirs.next(10.0)).topic == "state"
                thread, started = await asyncio.to_thread(restarting, tmp_path, first)
                # Many at once find the connection gone; one of them makes a new one.
                times = await asyncio.gather(*(twin.ping() for _ in range(20)))
                assert len(times) == 20
                seen = theirs.dropped
                assert (await theirs.next(30.0)).topic == "state"
                assert theirs.dropped == seen
                await asyncio.to_thread(thread.join)
                made.extend(started)
            with pytest.raises(StopAsyncIteration):
                await theirs.next(1.0)

    try:
        asyncio.run(main())
        assert client.ping() >= 0
        assert events.next(30.0).topic == "state"
        client.close()
    finally:
        for twin in made:
            twin.kill()
        with suppress(OSError):
            first.kill()


def test_an_acting_call_that_went_out_is_not_repeated_by_either(tmp_path: Path) -> None:
    """Killed while a motion is being waited for: nobody knows, so the caller is told."""
    twin = Twin(tmp_path)

    async def main() -> str:
        async with AsyncTwinClient(port=twin.port, reconnect_s=0.2) as client:
            moving = asyncio.create_task(client.move({"rot_obj": 90.0}, wait=True))
            await until_moving(("127.0.0.1", twin.port), moving)
            twin.kill()
            with pytest.raises(ConnectionLost) as caught:
                await moving
            assert caught.value.sent
            with pytest.raises(ConnectionLost, match="no server at"):
                await client.state()
            return str(caught.value)

    assert "not known whether it was carried out" in asyncio.run(main())


def test_an_asynchronous_client_says_when_nobody_is_there() -> None:
    async def main() -> None:
        client = AsyncTwinClient(port=1)
        with pytest.raises(RuntimeError, match="not connected yet"):
            _ = client.server
        with pytest.raises(ConnectionLost, match=r"no server at 127\.0\.0\.1:1 "):
            await client.state()
        await client.close()
        with pytest.raises(ConnectionLost, match="closed"):
            await client.state()

    asyncio.run(main())


# -- flows of one's own --------------------------------------------------------------------------


def test_a_flow_of_ones_own_runs_on_both(shell: Shell) -> None:
    def turn_there_and_back() -> Flow[float]:
        before = yield from methods.state()
        yield from methods.move({"rot_obj": 20.0}, relative=True, wait=True)
        yield from methods.move({"rot_obj": -20.0}, relative=True, wait=True)
        after = yield from methods.state()
        return after.axes["rot_obj"].position - before.axes["rot_obj"].position

    assert shell.run(turn_there_and_back()) == pytest.approx(0.0, abs=1e-9)


def test_errors_arrive_where_a_flow_may_catch_them(shell: Shell) -> None:
    def tries() -> Flow[int]:
        try:
            yield from methods.move({"mag_obj": 1e5})
        except RpcError as error:
            return error.code
        return 0

    assert shell.run(tries()) == -32001
    assert next(methods.state()) == Ask("state.get", {}, -1.0)


# -- the page ------------------------------------------------------------------------------------


TWO_FRAMES = (
    "camera\tset ROI\t900 700 999 779\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\di000000.tif\t\tACK\t\t\r\n"
    "tube\txrayon\t\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\io000000.tif\t\tACK\t\t\r\n"
    "scanner\twrite settings file\t\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\scan_000000.tif\t\tACK\t\t\r\n"
    "rot_obj\tmove absolute\t50\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\scan_000001.tif\t\tACK\t\t\r\n"
    "tube\txrayoff\t\t\tACK\t\t\r\n"
)
"""A dark image, a flat one and two projections."""


def test_the_pages_programmes_run(
    servers: Servers,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.txt").write_text(TWO_FRAMES, newline="")
    page = (Path(__file__).resolve().parents[2] / "docs" / "clients.md").read_text(
        "utf-8"
    )
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(block.replace("55000", str(servers.address[1])), {})
    first, *rest = capsys.readouterr().out.splitlines()
    assert first.startswith("(")
    assert float(rest[-1]) == pytest.approx(90.0)


# -- token and TLS -------------------------------------------------------------------------------


def test_the_asynchronous_client_brings_token_and_certificate(tmp_path: Path) -> None:
    tls = Path(__file__).resolve().parents[1] / "data" / "tls"
    (tmp_path / "token").write_text("correct horse battery staple\n")
    options = ("--token-file", str(tmp_path / "token"),
               "--tls-cert", str(tls / "test-only-cert.pem"),
               "--tls-key", str(tls / "test-only-key.pem"))  # fmt: skip
    server = Twin(tmp_path / "data", 0, *options)
    trusted = ssl.create_default_context(cafile=str(tls / "test-only-cert.pem"))

    async def main() -> None:
        token = "correct horse battery staple"
        async with AsyncTwinClient("localhost", server.port, token, ssl=trusted) as twin:
            assert (await twin.state()).time >= 0
        with pytest.raises(RpcError) as caught:
            await AsyncTwinClient(
                "localhost", server.port, "wrong", ssl=trusted
            ).connect()
        assert caught.value.code == -32004
        strict = ssl.create_default_context()
        with pytest.raises(ConnectionLost, match="certificate"):
            await AsyncTwinClient("localhost", server.port, token, ssl=strict).connect()

    try:
        asyncio.run(main())
    finally:
        server.kill()
