"""The twin server's sessions: who may what, states, errors, scenes, uploads; no sockets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from in_process import ROI, Lab, M, run

from flexdt.protocol import METHODS
from flexdt.protocol import image as wire_image
from flexdt.server.twin.handlers import HANDLERS


def test_every_method_of_the_wire_has_a_handler() -> None:
    assert set(HANDLERS) == set(METHODS)
    handlers = list(HANDLERS.values())
    several = {name for name, handler in HANDLERS.items() if handlers.count(handler) > 1}
    assert {name.split(".")[0] for name in several} == {
        "calibration", "dataset", "script", "trajectory",
    }  # fmt: skip


def test_state_motion_and_geometry_agree(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        hello = await c.call("session.hello", protocol="1.0", client="test")
        answer = await c.call(
            "axes.move", targets={"mag_obj": 650.0, "rot_obj": 90.0}, wait=True
        )
        assert answer["duration_s"] == pytest.approx(
            4.0
        )  # 90 deg: 45 deg/s after 2 s at 22.5
        state = await c.call("state.get")
        assert state["axes"]["mag_obj"]["position"] == 650.0
        assert state["axes"]["rot_obj"]["moving"] is False
        assert state["axes"]["ver_obj"]["virtual"] is True
        assert state["geometry"]["SOD_mm"] == pytest.approx(650.0 + 14.9192)
        assert state["controller"] == hello["session"] == f"test #{c.name}"
        g = await c.call("geometry.get")
        # At 90 degrees the object's frame has turned clockwise: the source stands on +x.
        assert g["cone_vec"][0] == pytest.approx(650.0 + 14.9192)
        assert g["detector_shape"] == (760, 956)
        jog = await c.call("axes.jog", axis="mag_obj", velocity=-10.0, lease_s=2.0)
        await lab.until(
            lambda: not lab.twin.scanner.moving(lab.twin.clock.now()), "jog ends"
        )
        # 10 mm/s at 50 mm/s2: 0.2 s up within the lease, 0.2 s down after it.
        assert jog["duration_s"] == pytest.approx(2.2)
        state = await c.call("state.get")
        assert state["axes"]["mag_obj"]["position"] == pytest.approx(650.0 - 20.0)

    run(tmp_path, body)


def test_errors_have_the_codes_of_the_wire_and_say_what_is_allowed(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        e = await c.error("axes.move", targets={"mag_obj": 5.0})
        assert (e.code, e.data["asked"], e.data["allowed"]) == (
            -32001,
            5.0,
            [70.0, 996.0],
        )
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
        assert (
            await c.error("calibration.apply", parameters={"dQ_x": 1.0})
        ).code == -32602
        for slip in ({"dO_x": 1e5}, {"dS_x": -1e5}, {"angle_scale": 0.0}, {"angle_scale": -1.0},
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
        assert (
            await a.error("safety.reset")
        ).code == -32003  # leaving it is the controller's
        assert (await b.call("safety.reset"))["safety"]["state"] == "ok"
        b.close()
        await a.call("axes.move", targets={"mag_obj": 600.0})  # control was free again
        assert lab.twin.control.holder == a.name

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


@pytest.mark.slow
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
        await c.call(
            "sample.upload", **what, start=half - 5, data=data[half - 5 : half + 3]
        )
        answer = await c.call(
            "sample.upload", **what, start=half + 3, data=data[half + 3 :]
        )
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
            "sample.upload",
            **grid,
            shape=[3, 4, 5],
            voxel_mm=[1.0, 1.0, 2.0],
            data=voxels,
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
        assert (
            await lab.client().call("rpc.discover") is document
        )  # making it takes 0.1 s
        assert {m["name"] for m in document["methods"]} == set(METHODS)

    run(tmp_path, body)
