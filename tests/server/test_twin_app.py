"""The twin server's methods, called through its sessions without sockets or processes."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.protocol import METHODS, Codec, Connection, Message, Prepared, RpcError, parse_params
from flexdt.protocol import image as wire_image
from flexdt.server.core import TwinServer
from flexdt.server.handlers import HANDLERS
from flexdt.server.projector_client import ProjectorUnavailable
from flexdt.server.truth import TrueGeometry
from flexdt.server.twin_app import TwinApp
from flexdt.twin.conventions import Float32Array
from flexdt.twin.geometry import ConeVec
from flexdt.twin.machine import builtin_machine, builtin_profile
from flexdt.twin.parameters import Parameters
from flexdt.twin.state import Sample

M = builtin_machine()
P = builtin_profile(M.default_profile)
ROI = [900, 700, 1027, 795]  # 48 x 64 pixels


class PointProjector:
    """Shows one point of the object as one bright pixel, and counts."""

    POINT = np.array([[2.0, -1.0, 14.0]])  # at the height of the source at home

    def __init__(self) -> None:
        self.views = 0
        self.names: list[str] = []
        self.down = False
        self.delay_s = 0.0
        self.limit: int | None = None
        """No more views than so many, until it is lifted."""

    async def put_scene(self, name: str, scene: object) -> None:
        self.names.append(name)

    async def put_volume(self, name: str, volume: object) -> None:
        self.names.append(name)

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], newest_wins: bool = False
    ) -> Float32Array:
        assert name in self.names
        if self.down:
            raise ProjectorUnavailable("no projector at test")
        await asyncio.sleep(self.delay_s)
        while self.limit is not None and self.views >= self.limit:
            await asyncio.sleep(0.001)
        self.views += len(cone_vec)
        out = np.zeros((len(cone_vec), *shape), dtype=np.float32)
        spots = cone_vec.project_points(self.POINT, shape)[:, 0]
        for frame, (column, row) in zip(out, spots, strict=True):
            c, r = int(np.clip(column, 0, shape[1] - 1)), int(np.clip(row, 0, shape[0] - 1))
            frame[r, c] = 1.0 + (column % 1.0) + (row % 1.0)  # the sub-pixel place shows too
        return out


class Client:
    """A session with its events."""

    def __init__(self, app: TwinApp, name: str) -> None:
        self.name = name
        self.events: list[dict[str, Any]] = []
        self.session = app.open(self)
        self._wire = Connection(Codec.JSON)

    def post(self, message: Message | Prepared, slot: str | None = None) -> None:
        self.events.append(json.loads(self._wire.send(message))["params"])

    def close(self, reason: str = "") -> None:
        self.session.close()

    async def call(self, method: str, /, **params: object) -> Any:
        m = METHODS[method]
        result = await self.session.handle(m, parse_params(m, params))
        if hasattr(result, "model_dump"):
            m.result.model_validate(result.model_dump(mode="python"))
            return result.model_dump(mode="python")
        return result

    async def error(self, method: str, /, **params: object) -> RpcError:
        with pytest.raises(RpcError) as caught:
            await self.call(method, **params)
        return caught.value

    def of(self, topic: str) -> list[dict[str, Any]]:
        return [e for e in self.events if e["topic"] == topic]


class Lab:
    """A twin server with a fake projector; everything but processes and sockets is real."""

    def __init__(self, root: Path, **options: Any) -> None:
        self.root = root
        self.projector = PointProjector()
        self.options = {"speed_up": "max", **options}

    async def __aenter__(self) -> Lab:
        self.twin = TwinServer(M, P, self.projector, self.root, **self.options)
        self.app = TwinApp(self.twin)
        await self.twin.start(Sample("chiral"))
        self.count = 0
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.twin.stop()

    def client(self) -> Client:
        self.count += 1
        return Client(self.app, f"client-{self.count}")

    async def until(self, condition: Callable[[], bool], what: str = "") -> None:
        for _ in range(8000):
            if condition():
                return
            await asyncio.sleep(0.001)
        raise AssertionError(f"never happened: {what}")

    async def ended(self, client: Client, job: str) -> dict[str, Any]:
        while True:
            status: dict[str, Any] = await client.call("job.status", job=job)
            if status["state"] in ("done", "failed", "aborted", "incomplete"):
                return status
            await asyncio.sleep(0.002)


def run(root: Path, body: Callable[[Lab], Awaitable[None]], **options: Any) -> None:
    async def main() -> None:
        async with Lab(root, **options) as lab:
            await asyncio.wait_for(body(lab), 60)

    asyncio.run(main())


def script(frames: int = 9, speed: float = 22.5, exposure: float = 2000.0) -> str:
    rows = [
        f"camera\tset ROI\t{ROI[0]} {ROI[1]} {ROI[2]} {ROI[3]}\t\tACK\t\t",
        f"camera\tset exposure\t{exposure}\t\tACK\t\t",
        f"camera\tset number of frames\t{frames}\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        "tube\tset power\t1.0\t\tACK\t\t",
        f"rot_obj\tset speed\t{speed}\t\tACK\t\t",
        "rot_obj\tmove absolute\t-191.25\t\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tE:\\data\\di000000.tif\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        "rot_obj\tmove absolute\t551.25\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tE:\\data\\scan_\t0\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "",
    ]
    return "\r\n".join(rows)


def digest(folder: Path) -> dict[str, str]:
    return {
        f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in sorted(folder.glob("*.tif"))
    }


def test_every_method_of_the_wire_has_a_handler() -> None:
    assert set(HANDLERS) == set(METHODS)


def test_state_motion_and_geometry_agree(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("session.hello", protocol="1.0", client="test")
        answer = await c.call("axes.move", targets={"mag_obj": 650.0, "rot_obj": 90.0}, wait=True)
        assert answer["duration_s"] == pytest.approx(4.0)  # 90 deg: 45 deg/s after 2 s at 22.5
        state = await c.call("state.get")
        assert state["axes"]["mag_obj"]["position"] == 650.0
        assert state["axes"]["rot_obj"]["moving"] is False
        assert state["axes"]["ver_obj"]["virtual"] is True
        assert state["geometry"]["SOD_mm"] == pytest.approx(650.0 + 14.9192)
        assert state["controller"] == c.name
        g = await c.call("geometry.get")
        # At 90 degrees the object's frame has turned clockwise: the source stands on +x.
        assert g["cone_vec"][0] == pytest.approx(650.0 + 14.9192)
        assert g["detector_shape"] == (760, 956)
        jog = await c.call("axes.jog", axis="mag_obj", velocity=-10.0, lease_s=2.0)
        await lab.until(lambda: not lab.twin.scanner.moving(lab.twin.clock.now()), "jog ends")
        # 10 mm/s at 50 mm/s2: 0.2 s up within the lease, 0.2 s down after it.
        assert jog["duration_s"] == pytest.approx(2.2)
        state = await c.call("state.get")
        assert state["axes"]["mag_obj"]["position"] == pytest.approx(650.0 - 20.0)

    run(tmp_path, body)


def test_errors_have_the_codes_of_the_wire_and_say_what_is_allowed(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        e = await c.error("axes.move", targets={"mag_obj": 5.0})
        assert (e.code, e.data["asked"], e.data["allowed"]) == (-32001, 5.0, [70.0, 996.0])
        e = await c.error("axes.move", targets={"mag_obj": 300.0, "wings": 1.0})
        assert e.code == -32602
        assert "ver_obj" in e.data["allowed"]
        assert (await c.error("axes.set", axis="mag_obj", speed=1e3)).code == -32001
        assert (await c.error("tube.set", kV=91.0)).code == -32001
        assert (await c.error("camera.set", mode="HD")).code == -32001
        assert (await c.error("sample.set", name="unicorn")).code == -32602
        assert (await c.error("sample.set", file="unicorn")).code == -32602
        assert (await c.error("job.status", job="job-9")).code == -32602
        assert (await c.error("calibration.get", name="none")).code == -32602
        assert (await c.error("calibration.apply", parameters={"dQ_x": 1.0})).code == -32602
        for slip in ({"dO_x": 1e9}, {"dS_x": -1e6}, {"angle_scale": 0.0}, {"angle_scale": -1.0},
                     {"det_roll": 90.0}):  # fmt: skip
            refused = await c.error("calibration.apply", parameters=slip)
            assert refused.data["check"] in slip
        assert (await c.error("scene.load", document={"schema": 9})).code == -32602
        assert (await c.error("session.hello", protocol="9.0", client="x")).code == -32602
        lab.projector.down = True
        assert (await c.error("projection.get")).code == -32006
        assert not lab.twin.scanner.moving(lab.twin.clock.now())

    run(tmp_path, body)


def test_one_controller_moves_and_everyone_may_stop(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        a, b = lab.client(), lab.client()
        await a.call("axes.move", targets={"mag_obj": 500.0})  # takes control by itself
        e = await b.error("axes.move", targets={"mag_obj": 600.0})
        assert e.code == -32003
        assert e.data["controller"] == a.name
        assert (await b.call("session.control", action="force"))["yours"]
        assert (await a.error("axes.jog", axis="mag_obj", velocity=1.0)).code == -32003
        assert (await a.call("axes.stop"))["controller"] == b.name
        state = await a.call("safety.estop")
        assert state["safety"]["estop"] is True
        assert (await b.error("axes.move", targets={"mag_obj": 600.0})).code == -32003
        assert (await a.error("safety.reset")).code == -32003  # leaving it is the controller's
        assert (await b.call("safety.reset"))["safety"]["state"] == "ok"
        b.close()
        await a.call("axes.move", targets={"mag_obj": 600.0})  # control was free again
        assert lab.twin.control.holder == a.name

    run(tmp_path, body)


def test_projections_flow_while_an_axis_moves_and_the_last_is_the_final_pose(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        lab.projector.delay_s = 0.01
        c, other = lab.client(), lab.client()
        await c.call("camera.set", roi=ROI)
        await c.call("state.subscribe", topics=["projection", "state"])
        await other.call("state.subscribe", topics=["projection"], max_rate_hz=4.0,
                         projection_kind="counts", projection_binning=2)  # fmt: skip
        await lab.until(lambda: bool(c.of("projection")), "an image at once")
        answer = await c.call("axes.move", targets={"mag_obj": 600.0 - 450.0})
        assert answer["duration_s"] == pytest.approx(10.0)
        await lab.until(
            lambda: lab.twin.scanner.rest_time(0.0) < lab.twin.clock.now(), "the motion ends"
        )
        await asyncio.sleep(0.5)
        images = [e["data"] for e in c.of("projection")]
        distinct = {i["data"] for i in images}
        assert len(distinct) >= 20
        final = await c.call("projection.get")
        assert np.array_equal(wire_image.decode(images[-1]), wire_image.decode(final))
        assert images[-1]["cone_vec"] == final["cone_vec"]
        seqs = [e["seq"] for e in c.of("projection")]
        assert seqs == sorted(set(seqs))
        states = [e["data"]["axes"]["mag_obj"]["position"] for e in c.of("state")]
        assert len(set(states)) > 10
        assert states[-1] == 150.0
        slow = other.of("projection")
        assert 3 <= len(slow) < len(images)
        assert slow[-1]["data"]["shape"] == [24, 32]
        assert slow[-1]["data"]["dtype"] == "uint16"
        before = lab.projector.views
        await asyncio.sleep(0.1)
        assert lab.projector.views == before  # nothing changes, nothing is computed

    run(tmp_path, body, speed_up=5.0)


def test_truth_reaches_images_and_nothing_else(tmp_path: Path) -> None:
    secret = 1.23456789

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["state", "log", "job"])
        await c.call("camera.set", roi=ROI)
        image = wire_image.decode(await c.call("projection.get"))
        nominal = await c.call("geometry.get")
        true = lab.twin.scanner.poses(0.0).cone_vec(Parameters(dD_x=secret))
        spot = true.project_points(PointProjector.POINT, (48, 64))[0, 0]
        assert image[int(spot[1]), int(spot[0])] > 0
        shown = ConeVec(nominal["cone_vec"]).project_points(PointProjector.POINT, (48, 64))[0, 0]
        assert shown[0] - spot[0] == pytest.approx(secret / 0.1496)
        job = await c.call("script.submit", text=script(), name="one")
        assert (await lab.ended(c, job["job"]))["state"] == "done"
        everything = json.dumps(
            [await c.call(m) for m in ("state.get", "geometry.get", "scene.save", "job.list",
                                       "calibration.list", "sample.list")], default=repr
        ) + json.dumps(c.events)  # fmt: skip
        texts = [f.read_text(errors="replace") for f in lab.root.rglob("*")
                 if f.is_file() and f.suffix != ".tif"]  # fmt: skip
        for text in (everything, *texts, repr(lab.twin.imaging), repr(lab.options["truth"])):
            assert "1.2345" not in text
            assert 'dD_x": 1' not in text
        assert len(texts) >= 4

    run(tmp_path, body, truth=TrueGeometry(Parameters(dD_x=secret)))


def test_a_correction_shows_in_geometry_get_and_stands_beside_the_data_set(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        nominal = await c.call("geometry.get")
        first = await c.call("calibration.apply", parameters={"dD_x": 2.0}, name="first")
        assert first["correction"]["parameters"]["dD_x"] == 2.0
        moved = await c.call("geometry.get")
        assert moved["cone_vec"][3] - nominal["cone_vec"][3] == pytest.approx(2.0)
        await c.call("calibration.apply", parameters={"alpha": 1.0}, source="scan 7")
        assert (await c.error("calibration.apply", parameters={"dD_x": 3.0}, name="first")).code \
            == -32602  # fmt: skip
        job = await c.call("script.submit", text=script(), name="corrected")
        await lab.ended(c, job["job"])
        document = json.loads((lab.root / "corrected" / "flexdt.json").read_text())
        assert document["correction"]["parameters"]["alpha"] == pytest.approx(1.0)
        assert document["frames"][1]["cone_vec"][6] == pytest.approx(0.1496)  # nominal: not turned
        assert (await c.call("calibration.revert"))["correction"]["name"] == "first"
        listed = await c.call("calibration.list")
        assert listed["corrections"][0]["name"] == "first"
        assert listed["current"] == "first"

    run(tmp_path, body)

    async def again(lab: Lab) -> None:
        c = lab.client()
        assert (await c.call("calibration.get"))["correction"]["name"] == "first"
        assert (await c.call("calibration.revert"))["correction"] is None
        assert len(list((lab.root / "corrections").glob("*first.json"))) == 1

    run(tmp_path, again)


def test_a_script_becomes_a_data_set_with_the_same_bytes_at_any_speed_up(tmp_path: Path) -> None:
    found: list[dict[str, str]] = []

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["job"])
        for name, speed in (("a", "max"), ("b", 400.0), ("c", 900.0)):
            answer = await c.call(
                "script.submit", text=script(), name=name, speed_up=speed, seed=11
            )
            status = await lab.ended(c, answer["job"])
            assert (status["state"], status["error"]) == ("done", None)
            assert (status["frames_done"], status["frames_total"]) == (9, 9)
            folder = lab.root / name
            assert (folder / "script.txt").read_bytes() == script().encode()
            document = json.loads((folder / "flexdt.json").read_text())
            assert document["complete"] is True
            assert document["noise"]["seed"] == 11
            found.append(digest(folder))
        assert len(found[0]) == 10
        assert found[0] == found[1] == found[2]
        other = await c.call("script.submit", text=script(), name="d", seed=12)
        await lab.ended(c, other["job"])
        assert digest(lab.root / "d")["scan_000000.tif"] != found[0]["scan_000000.tif"]
        phases = [e["data"]["state"] for e in c.of("job") if e["data"]["job"] == "job-1"]
        assert phases[0] == "queued"
        assert phases[-1] == "done"
        assert lab.twin.clock.speed_up == "max"  # a job's speed-up ends with it

    run(tmp_path, body)


def test_moves_are_refused_during_a_scan_and_allowed_in_a_pause(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        reference = await c.call("script.submit", text=script(), name="ref", seed=3, speed_up="max")
        await lab.ended(c, reference["job"])
        lab.projector.limit = lab.projector.views + 3
        job = (await c.call("script.submit", text=script(), name="paused", seed=3))["job"]
        await lab.until(lambda: lab.twin.jobs.running, "it runs")
        for method, params in (
            ("axes.move", {"targets": {"tra_obj": 30.0}}),
            ("axes.jog", {"axis": "tra_obj", "velocity": 1.0}),
            ("sample.set", {"name": "lego"}),
            ("camera.set", {"averages": 2}),
        ):
            e = await c.error(method, **params)
            assert (e.code, e.data["job"]) == (-32003, job)
        await c.call("clock.set", speed_up=20.0)  # on a slow machine it must not run to its end
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).frames_done >= 3, "3 frames"
        )
        status = await c.call("job.pause", job=job)
        assert status["state"] == "paused"
        lab.projector.limit = None
        await c.call("axes.move", targets={"tra_obj": 30.0, "mag_obj": 500.0}, wait=True)
        await c.call("sample.set", name="lego")
        stepped = await c.call("job.step", job=job)
        assert stepped["state"] == "paused"
        assert (await c.call("job.resume", job=job))["state"] == "running"
        status = await lab.ended(c, job)
        assert status["state"] == "done"
        assert digest(lab.root / "paused") == digest(lab.root / "ref")
        state = await c.call("state.get")
        assert state["axes"]["tra_obj"]["position"] == 0.0
        assert (await c.error("job.pause", job=job)).code == -32003

    run(tmp_path, body, speed_up=150.0)


def test_stop_during_a_scan_pauses_it_and_abort_leaves_it_incomplete(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c, watcher = lab.client(), lab.client()
        job = (await c.call("script.submit", text=script(), name="cut"))["job"]
        await lab.until(lambda: lab.twin.jobs.running, "it runs")
        await watcher.call("axes.stop")
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).state == "paused", "it pauses"
        )
        status = await watcher.call("job.abort", job=job)
        assert status["state"] == "aborted"
        document = json.loads((lab.root / "cut" / "flexdt.json").read_text())
        assert document["complete"] is False
        assert "aborted" in document["reason"]
        assert not list((lab.root / "cut").glob(".*"))
        assert lab.twin.jobs.current is None

    run(tmp_path, body, speed_up=50.0)


def test_an_interrupted_scan_is_taken_up_by_name_even_by_another_server(tmp_path: Path) -> None:
    async def first(lab: Lab) -> None:
        c = lab.client()
        await c.call("axes.move", targets={"tra_obj": 12.0, "mag_obj": 500.0}, wait=True)
        await c.call("sample.set", name="normal", offset={"x": 1.0})
        whole = await c.call("script.submit", text=script(), name="whole", seed=5, speed_up="max")
        await lab.ended(c, whole["job"])
        lab.projector.limit = lab.projector.views + 4
        await c.call("script.submit", text=script(), name="cut", seed=5)
        await lab.until(
            lambda: (
                lab.twin.jobs.current is not None
                and lab.twin.jobs.status(lab.twin.jobs.current).frames_done >= 4
            ),
            "4 frames",
        )

    run(tmp_path, first, speed_up=150.0)  # the server is stopped in the midst of it
    cut = tmp_path / "cut"
    document = json.loads((cut / "flexdt.json").read_text())
    assert document["complete"] is False
    there = digest(cut)
    assert 4 <= len(there) < 10
    stamps = {f.name: f.stat().st_mtime_ns for f in cut.glob("*.tif")}

    async def second(lab: Lab) -> None:
        c = lab.client()
        e = await c.error("script.submit", text=script() + "# changed", name="cut")
        assert (e.code, "another" in e.message) == (-32602, True)
        views = lab.projector.views
        job = await c.call("script.submit", text=script(), name="cut")
        assert (await lab.ended(c, job["job"]))["state"] == "done"
        assert lab.projector.views - views == 10 - len(there)  # the dark needs no projection
        assert digest(cut) == digest(tmp_path / "whole")
        assert {n: (cut / n).stat().st_mtime_ns for n in stamps} == stamps
        assert (await c.error("script.submit", text=script(), name="cut")).code == -32602
        assert (await c.error("script.submit", text=script(), name="../x")).code == -32602

    run(tmp_path, second)


def test_a_projector_that_is_gone_pauses_the_job_with_its_code(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        reference = await c.call("script.submit", text=script(), name="ref", seed=3)
        await lab.ended(c, reference["job"])
        lab.projector.down = True
        job = (await c.call("script.submit", text=script(), name="gone", seed=3))["job"]
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).state == "paused", "it pauses"
        )
        status = await c.call("job.status", job=job)
        assert status["error"]["code"] == -32006
        lab.projector.down = False
        c.close()  # the client goes; the scan goes on without it
        await lab.client().call("job.resume", job=job)
        status = await lab.ended(lab.client(), job)
        assert (status["state"], status["error"]) == ("done", None)
        assert digest(lab.root / "gone") == digest(lab.root / "ref")

    run(tmp_path, body)


def test_a_full_disk_pauses_the_job_and_no_partial_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flexdt.server import dataset_writer
    from flexdt.twin.dataset.errors import DiskFullError

    real = dataset_writer.DatasetWriter.put
    full = [True]

    def put(self: Any, name: str, image: Any) -> None:
        if full[0] and name == "scan_000005.tif":
            raise DiskFullError("no room for scan_000005.tif", {"free": 0})
        real(self, name, image)

    monkeypatch.setattr(dataset_writer.DatasetWriter, "put", put)

    async def body(lab: Lab) -> None:
        c = lab.client()
        job = (await c.call("script.submit", text=script(), name="full", seed=3))["job"]
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).state == "paused", "it pauses"
        )
        status = await c.call("job.status", job=job)
        assert status["error"]["code"] == -32001
        assert "no room" in status["error"]["message"]
        assert not (lab.root / "full" / "scan_000005.tif").exists()
        full[0] = False
        await c.call("job.resume", job=job)
        assert (await lab.ended(c, job))["state"] == "done"

    run(tmp_path, body)


def test_a_scan_that_does_not_fit_on_the_disk_is_refused_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flexdt.server import submission

    monkeypatch.setattr(submission, "free_bytes", lambda path: 20 << 20)

    async def body(lab: Lab) -> None:
        c = lab.client()
        lines = ["tube\txrayon\t\t\tACK\t\t", "camera\tset ROI\t0 0 1943 1535\t\tACK\t\t"]
        for i in range(6):  # 1.5 MB each, and 16 MiB for the rest
            lines += [
                "camera\ttake image\t\t\tACK\t\t",
                f"camera\tsave image\tscan_{i:06d}.tif\t\tACK\t\t",
            ]
        e = await c.error("script.submit", text="\r\n".join([*lines, ""]))
        assert e.code == -32001
        assert e.data["allowed"] == 20 << 20
        assert lab.twin.jobs.all() == []

    run(tmp_path, body)


def test_a_bad_script_is_refused_with_all_its_problems_and_nothing_moves(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        bad = script().replace("set exposure\t2000.0", "set exposure\tlong") + (
            "mag_obj\tfly\t3\t\tACK\t\t\r\nwing_obj\tmove absolute\t3\t\tACK\t\t\r\n"
        )
        e = await c.error("script.submit", text=bad)
        assert e.code == -32005
        assert {"line", "column", "message", "code", "severity"} <= set(e.data[0])
        assert len([p for p in e.data if p["severity"] == "error"]) >= 3
        report = await c.call("script.check", text=bad)
        assert report["ok"] is False
        assert lab.twin.jobs.all() == []
        assert lab.twin.clock.now() == 0.0

    run(tmp_path, body)


def test_a_trajectory_is_played_and_checked(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("camera.set", roi=ROI)
        poses = [{"rot_obj": 10.0 * i, "mag_obj": 500.0 + i} for i in range(5)]
        report = await c.call("trajectory.check", poses=poses, exposure_ms=50.0)
        assert (report["ok"], report["frames"]) == (True, 5)
        job = await c.call("trajectory.submit", poses=poses, exposure_ms=50.0, name="played")
        assert (await lab.ended(c, job["job"]))["state"] == "done"
        document = json.loads((lab.root / "played" / "flexdt.json").read_text())
        shown = [f["positions"] for f in document["frames"] if f["kind"] == "projection"]
        assert [(p["rot_obj"], p["mag_obj"]) for p in shown] == [
            (p["rot_obj"], p["mag_obj"]) for p in poses
        ]
        answer = await c.call("trajectory.submit", poses=[{"mag_obj": 1.0}])
        assert "mag_obj" in answer["warnings"][0]  # clamped, as the machine file says

    run(tmp_path, body)


def test_jobs_queue_and_a_queued_one_can_be_aborted(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        lab.projector.limit = 0
        jobs = [(await c.call("script.submit", text=script(), speed_up=800.0))["job"]
                for _ in range(3)]  # fmt: skip
        assert (await c.call("job.abort", job=jobs[1]))["state"] == "aborted"
        lab.projector.limit = None
        assert (await lab.ended(c, jobs[2]))["state"] == "done"
        states = [j["state"] for j in (await c.call("job.list"))["jobs"]]
        assert states == ["done", "aborted", "done"]
        names = [j["name"] for j in (await c.call("job.list"))["jobs"]]
        assert len(set(names)) == 3

    run(tmp_path, body)


def test_a_scan_that_is_being_prepared_can_be_aborted_and_stopped(tmp_path: Path) -> None:
    """Before a scan's first motion there is a while of checking and opening files."""

    async def body(lab: Lab) -> None:
        c, anyone = lab.client(), lab.client()
        await c.call("clock.set", speed_up=1.0)  # the scan waits for a slow move to end
        await c.call("axes.move", targets={"tra_obj": 100.0})
        job = (await c.call("script.submit", text=script()))["job"]
        await lab.until(lambda: lab.twin.jobs.current is not None, "its turn has come")
        assert (await anyone.call("job.abort", job=job))["state"] == "aborted"
        await anyone.call("axes.stop")
        await lab.until(lambda: lab.twin.jobs.current is None, "it has ended")
        state = await c.call("state.get")
        assert state["axes"]["rot_obj"]["target"] == 0.0
        assert state["axes"]["tra_obj"]["target"] < 100.0
        assert (await c.call("job.status", job=job))["state"] == "aborted"

        await c.call("axes.move", targets={"tra_obj": 100.0})
        job = (await c.call("script.submit", text=script()))["job"]
        await lab.until(lambda: lab.twin.jobs.current is not None, "its turn has come")
        await anyone.call("axes.stop")
        await lab.until(lambda: lab.twin.jobs.get(job).phase == "paused", "it pauses")
        status = await c.call("job.status", job=job)
        assert "stop was commanded" in status["error"]["message"]
        state = await c.call("state.get")
        assert state["axes"]["rot_obj"]["position"] == 0.0
        await c.call("clock.set", speed_up="max")
        await c.call("job.resume", job=job)
        assert (await lab.ended(c, job))["state"] == "done"

    run(tmp_path, body)


def test_a_scene_comes_back_whole(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("axes.move", targets={"mag_obj": 500.0, "rot_obj": 33.0}, wait=True)
        await c.call("camera.set", roi=ROI, exposure_ms=70.0)
        await c.call("tube.set", kV=60.0)
        await c.call("sample.set", name="normal", offset={"z": 3.0})
        await c.call("calibration.apply", parameters={"tau_x": 0.5}, name="mine")
        saved = (await c.call("scene.save", name="here"))["document"]
        image = wire_image.decode(await c.call("projection.get"))
        json.dumps(saved)
        await c.call("axes.move", targets={"mag_obj": 700.0, "rot_obj": 0.0}, wait=True)
        await c.call("camera.set", exposure_ms=10.0)
        await c.call("sample.set", name="empty")
        await c.call("calibration.revert")
        assert not wire_image.decode(await c.call("projection.get")).any()
        await c.call("scene.load", document=saved)
        await lab.twin.motion_ended(M.axes)
        again = (await c.call("scene.save", name="here"))["document"]
        assert {**again, "saved": ""} == {**saved, "saved": ""}
        assert np.array_equal(wire_image.decode(await c.call("projection.get")), image)
        for broken in (
            {**saved, "machine": "other"},
            {**saved, "positions": {"mag_obj": 5.0}},
            {**saved, "tube": {"kV": 900.0, "power_W": 1.0}},
            {**saved, "extra": 1},
        ):
            assert (await c.error("scene.load", document=broken)).code in (-32602, -32001)

    run(tmp_path, body)


def test_uploads_come_in_chunks_and_stay_after_a_restart(tmp_path: Path) -> None:
    import trimesh

    data = trimesh.creation.box((10.0, 8.0, 6.0)).export(file_type="stl")
    assert isinstance(data, bytes)
    what = {"name": "my box", "format": "stl", "total": len(data), "material": "pmma"}

    async def body(lab: Lab) -> None:
        c = lab.client()
        half = len(data) // 2
        answer = await c.call("sample.upload", **what, start=0, data=data[:half])
        assert (answer["received"], answer["complete"]) == (half, False)
        e = await c.error("sample.upload", **what, start=half + 9, data=b"x")
        assert e.code == -32001
        await c.call("sample.upload", **what, start=half - 5, data=data[half - 5 : half + 3])
        answer = await c.call("sample.upload", **what, start=half + 3, data=data[half + 3 :])
        assert answer["complete"] is True
        assert answer["sample"]["size_mm"] == pytest.approx((10.0, 8.0, 6.0))
        done = await c.call("sample.set", file="my box")
        assert done["sample"]["material"] == "pmma"
        broken = {"name": "bad", "format": "stl", "total": 4}
        assert (await c.error("sample.upload", **broken, data=b"nope")).code == -32602
        huge = {"name": "huge", "format": "stl", "total": 1 << 40}
        assert (await c.error("sample.upload", **huge, data=b"x")).code == -32008
        voxels = np.zeros((3, 4, 5), dtype="<f4").tobytes()
        grid = {"name": "grid", "kind": "voxels", "format": "raw", "total": len(voxels)}
        answer = await c.call(
            "sample.upload", **grid, shape=[3, 4, 5], voxel_mm=[1.0, 1.0, 2.0], data=voxels
        )
        assert answer["sample"]["size_mm"] == pytest.approx((5.0, 4.0, 6.0))

    run(tmp_path, body)

    async def again(lab: Lab) -> None:
        c = lab.client()
        names = [s["name"] for s in (await c.call("sample.list"))["samples"]]
        assert {"my box", "grid", "lego", "empty"} <= set(names)
        await c.call("sample.set", file="my box", material="aluminium")
        assert (await c.call("projection.get"))["shape"] == [760, 956]

    run(tmp_path, again)


def test_counts_follow_tube_and_binning(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("camera.set", roi=ROI)
        dark = wire_image.decode(await c.call("projection.get", kind="counts"))
        assert dark.dtype == np.uint16
        assert abs(float(np.mean(dark)) - 100.0) < 1.0
        await c.call("tube.set", on=True, kV=90.0, power_W=50.0)
        await c.call("camera.set", exposure_ms=50.0)
        await lab.until(lambda: lab.twin.state().tube.ready, "X-rays ready")
        answer = await c.call("projection.get", kind="counts", binning=4)
        bright = wire_image.decode(answer)
        assert bright.shape == (12, 16)
        assert float(np.median(bright)) == pytest.approx(6100.0, rel=0.01)
        cone = ConeVec(answer["cone_vec"])
        assert float(np.linalg.norm(cone.u)) == pytest.approx(4 * 0.1496)
        await c.call("camera.set", roi=[900, 700, 931, 731])  # 16 x 16 pixels
        assert (await c.error("projection.get", binning=17)).code == -32602

    run(tmp_path, body)


def test_images_stay_dark_until_x_rays_are_ready(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("camera.set", roi=ROI)
        off = (await c.call("state.get"))["tube"]
        assert (off["ready"], off["ready_in_s"]) == (False, None)
        await c.call("clock.set", speed_up=1)
        tube = await c.call("tube.set", on=True)
        takes = M.timing.xrayon_s + M.timing.xray_ready_s
        assert tube["ready"] is False
        assert 0.9 * takes < tube["ready_in_s"] <= takes
        early = wire_image.decode(await c.call("projection.get", kind="counts"))
        state = (await c.call("state.get"))["tube"]
        if not state["ready"]:  # a machine that took seconds over this has nothing to show
            assert float(np.mean(early)) < 200.0
            assert state["ready_in_s"] < takes
        seen = []
        lab.twin.hub.publish = lambda topic, *_, **__: seen.append(topic)  # type: ignore[method-assign]
        lab.twin.hub.wanted = lambda topic: topic == "state"  # type: ignore[method-assign]
        await c.call("clock.set", speed_up="max")
        await lab.until(lambda: lab.twin.state().tube.ready, "X-rays ready")
        await lab.until(lambda: len(seen) >= 2, "a state when X-rays were ready")
        late = wire_image.decode(await c.call("projection.get", kind="counts"))
        assert float(np.mean(late)) > 5000.0
        assert (await c.call("state.get"))["tube"]["ready_in_s"] == 0.0

    run(tmp_path, body)


def test_a_colliding_move_halts_is_counted_and_at_last_needs_a_reset(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        e = await c.error("axes.move", targets={"mag_det": 100.0})
        assert e.code == -32002
        assert len(e.data["pair"]) == 2
        halt = e.data["halts_at"]["mag_det"]
        await lab.twin.motion_ended(M.axes)
        state = await c.call("state.get")
        assert state["axes"]["mag_det"]["position"] == halt
        assert 100.0 < halt < 1059.0
        assert state["safety"]["blocked_attempts"] == 1
        assert 0.0 < state["safety"]["clearance_mm"] < 3.0
        assert set(state["safety"]["pair"]) == set(e.data["pair"])
        for _ in range(2):
            assert (await c.error("axes.move", targets={"mag_det": 100.0})).code == -32002
        assert (await c.call("state.get"))["safety"]["state"] == "aborted"
        assert (await c.error("axes.move", targets={"mag_det": 900.0})).code == -32003
        await c.call("safety.reset")
        await c.call("axes.move", targets={"mag_det": 900.0}, wait=True)
        # A script that would collide is refused with its line before anything moves.
        bad = "\r\nmag_det\tmove absolute\t150.0\t\tACK\t\t\r\n"
        e = await c.error("script.submit", text=bad)
        assert e.code == -32002
        assert e.data["collisions"][0]["line"] == 2
        assert (await c.call("state.get"))["axes"]["mag_det"]["position"] == 900.0

    run(tmp_path, body)


@pytest.mark.parametrize("command", ["axes.stop", "safety.estop"])
@pytest.mark.parametrize("plan", [False, True])
def test_a_waiting_move_is_answered_when_a_stop_has_brought_the_axes_to_rest(
    tmp_path: Path, command: str, plan: bool
) -> None:
    """Not after the minutes that the motion would have taken, and without claiming arrival."""

    async def body(lab: Lab) -> None:
        a, b = lab.client(), lab.client()
        assert (await a.call("axes.move", targets={"mag_obj": 500.0}))["arrived"] is None
        done = await a.call("axes.move", targets={"mag_obj": 600.0}, wait=True, plan=plan)
        assert (done["arrived"], done["warnings"]) == (True, [])
        await a.call("axes.set", axis="mag_obj", speed=1.0)
        await a.call("clock.set", speed_up=1.0)
        asked = a.call("axes.move", targets={"mag_obj": 900.0}, wait=True, plan=plan)
        moving = asyncio.create_task(asked)
        await lab.until(lambda: lab.twin.scanner.moving(lab.twin.clock.now()), "the motion")
        await b.call(command)
        done = await moving
        assert done["duration_s"] > 250.0
        assert done["arrived"] is False
        assert "mag_obj rests at 6" in done["warnings"][-1]
        assert not lab.twin.scanner.moving(lab.twin.clock.now())

    run(tmp_path, body)


def test_a_planned_move_says_its_legs(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        direct = await c.call("axes.move", targets={"mag_obj": 650.0}, plan=True, wait=True)
        assert direct["moves"] == [{"mag_obj": 650.0}]
        assert direct["warnings"] == []
        assert (await c.call("state.get"))["axes"]["mag_obj"]["position"] == 650.0
        # The sample must leave before the detector may come: two legs, in that order.
        targets = {"mag_det": 400.0, "mag_obj": 200.0}
        assert lab.twin.scanner.guard is not None
        lab.twin.scanner.set_axis("mag_obj", speed=2.0)
        around = await c.call("axes.move", targets=targets, plan=True, wait=True)
        assert around["moves"] == [{"mag_obj": 200.0}, {"mag_det": 400.0}]
        assert "would collide on the direct way" in around["warnings"][0]
        state = await c.call("state.get")
        assert {n: state["axes"][n]["position"] for n in targets} == targets
        e = await c.error("axes.move", targets={"mag_det": 100.0, "mag_obj": 600.0}, plan=True)
        assert e.code == -32002
        assert not lab.twin.scanner.moving(lab.twin.clock.now())
        e = await c.error("axes.move", targets={"mag_obj": 5.0}, plan=True)
        assert e.code == -32001

    run(tmp_path, body)


def test_nothing_moves_for_who_lost_control_while_it_was_planned(tmp_path: Path) -> None:
    """Planning takes a while: a stop, or another controller, must end what is being planned."""
    text = "mag_obj\tmove absolute\t300.0\t\tACK\t\t\n"
    asked: list[tuple[str, dict[str, Any]]] = [
        ("axes.move", {"targets": {"mag_det": 400.0, "mag_obj": 200.0}, "plan": True}),
        ("script.submit", {"text": text}),
        ("sample.set", {"name": "normal-3"}),
    ]

    async def body(lab: Lab) -> None:
        a, b = lab.client(), lab.client()
        before = (await a.call("state.get"))["axes"]
        for method, params in asked:
            await a.call("session.control", action="force")
            waiting = asyncio.create_task(a.error(method, **params))
            await asyncio.sleep(0)  # asked, and being planned
            assert not waiting.done()
            await b.call("session.control", action="force")
            assert (await waiting).code == -32003
        await a.call("session.control", action="force")
        waiting = asyncio.create_task(a.error(asked[0][0], **asked[0][1]))
        await asyncio.sleep(0)
        await b.call("axes.stop")
        assert "another command came" in (await waiting).message
        after = await a.call("state.get")
        assert {n: v["target"] for n, v in after["axes"].items()} == {
            n: v["target"] for n, v in before.items()
        }
        assert after["sample"]["name"] != "normal-3"
        assert (await a.call("job.list"))["jobs"] == []

    run(tmp_path, body)


def test_clients_that_leave_take_their_subscriptions_and_control_with_them(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["state", "projection", "job", "log"])
        assert lab.twin.hub.wanted("projection")
        await c.call("session.control", action="acquire")
        await c.call("state.unsubscribe", topics=["log"])
        assert not lab.twin.hub.wanted("log")
        c.close()
        assert not any(lab.twin.hub.wanted(t) for t in ("state", "projection", "job"))
        assert lab.twin.control.holder is None
        document = await lab.client().call("rpc.discover")
        assert {m["name"] for m in document["methods"]} == set(METHODS)

    run(tmp_path, body)
