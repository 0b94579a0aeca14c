"""What the twin server's images show, and what they must not; no sockets, no processes."""

from __future__ import annotations

import asyncio
import json
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import ROI, Lab, M, PointProjector, run, script

from flexdt.protocol import image as wire_image
from flexdt.server.imaging.projections import TrueGeometry
from flexdt.server.twin import live, state_views
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.camera import Roi


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
            lambda: lab.twin.scanner.rest_time(0.0) < lab.twin.clock.now(),
            "the motion ends",
        )
        source = list((await c.call("geometry.get"))["cone_vec"])[:3]
        for heard in (c, other):
            await lab.until(
                lambda heard=heard: (
                    heard.of("projection")[-1]["data"]["cone_vec"][:3] == source
                ),
                "the final pose",
            )
        await lab.until(
            lambda: c.of("state")[-1]["data"]["axes"]["mag_obj"]["position"] == 150.0,
            "at rest",
        )
        images = [e["data"] for e in c.of("projection")]
        distinct = {i["data"] for i in images}
        assert len(distinct) >= 5
        final = await c.call("projection.get")
        assert np.array_equal(wire_image.decode(images[-1]), wire_image.decode(final))
        assert images[-1]["cone_vec"] == final["cone_vec"]
        seqs = [e["seq"] for e in c.of("projection")]
        assert seqs == sorted(set(seqs))
        states = [e["data"]["axes"]["mag_obj"]["position"] for e in c.of("state")]
        assert len(set(states)) >= 5
        assert states[-1] == 150.0
        slow = other.of("projection")
        assert 2 <= len(slow) < len(images)
        assert slow[-1]["data"]["shape"] == [24, 32]
        assert slow[-1]["data"]["dtype"] == "uint16"
        before = -1
        while (
            before != lab.projector.views
        ):  # nothing changes, so in the end nothing is computed
            before = lab.projector.views
            await asyncio.sleep(0.1)

    run(tmp_path, body, virtual=True, speed_up=3.0)


def test_truth_reaches_images_and_nothing_else(tmp_path: Path) -> None:
    secret = 1.23456789

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["state", "log", "job"])
        await c.call("camera.set", roi=ROI)
        image = wire_image.decode(await c.call("projection.get"))
        nominal = await c.call("geometry.get")
        true = lab.twin.scanner.poses(0.0).cone_vec(Offsets(dD_x=secret))
        spot = true.project_points(PointProjector.POINT, (48, 64))[0, 0]
        assert image[int(spot[1]), int(spot[0])] > 0
        shown = ConeVec(nominal["cone_vec"]).project_points(
            PointProjector.POINT, (48, 64)
        )[0, 0]
        assert shown[0] - spot[0] == pytest.approx(secret / 0.1496)
        job = await c.call("script.submit", text=script(), name="one")
        assert (await lab.ended(c, job["job"]))["state"] == "done"
        everything = json.dumps(
            [await c.call(m) for m in ("state.get", "geometry.get", "scene.save", "job.list",
                                       "calibration.list", "sample.list")], default=repr
        ) + json.dumps(c.events)  # fmt: skip
        texts = [f.read_text(errors="replace") for f in lab.root.rglob("*")
                 if f.is_file() and f.suffix != ".tif"]  # fmt: skip
        for text in (
            everything,
            *texts,
            repr(lab.twin.imaging),
            repr(lab.options["truth"]),
        ):
            assert "1.2345" not in text
            assert 'dD_x": 1' not in text
        assert len(texts) >= 4

    run(tmp_path, body, truth=TrueGeometry(Offsets(dD_x=secret)))


def test_an_image_of_another_pose_is_predicted_from_what_is_known(tmp_path: Path) -> None:
    """Where the point lies follows from the machine's pose and the correction; the hidden
    truth, and what stands now, have no part in it. Poses are drawn, settings too."""
    known = {"dD_x": 0.8, "dO_z": -0.4}

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("calibration.apply", parameters=known)
        stands = (await c.call("state.get"))["axes"]
        rng = np.random.default_rng(21)
        for _ in range(5):
            there = {
                "rot_obj": rng.uniform(-360, 360),
                "ver_det": 20 + rng.uniform(-2, 2),
            }
            camera = {
                "roi": ROI,
                "mode": "HW2SW1High",
                "exposure_ms": 50.0,
                "averages": 2,
            }
            told = await c.call("projection.get", positions=there, camera=camera)
            image = wire_image.decode(told)
            poses = lab.twin.scanner.poses_at(
                {
                    n: there.get(n, a["position"])
                    for n, a in stands.items()
                    if n in M.axes
                },
                replace(lab.twin.scanner.camera, mode="HW2SW1High", roi=Roi(*ROI)),
            )
            cone = poses.cone_vec(Offsets.from_edge(known))
            assert told["cone_vec"] == pytest.approx(cone.rows[0].tolist())
            column, row = cone.project_points(PointProjector.POINT, (48, 64))[0, 0]
            spot = np.unravel_index(image.argmax(), image.shape)
            assert spot == (int(np.clip(row, 0, 47)), int(np.clip(column, 0, 63)))
        kV = {"kV": 80.0, "power_W": 10.0, "on": True}
        half, full = [
            wire_image.decode(
                await c.call("projection.get", kind="counts", tube=kV,
                             camera={"roi": ROI, "exposure_ms": ms})
            ).astype(float)
            for ms in (25.0, 50.0)
        ]  # fmt: skip
        dark = wire_image.decode(
            await c.call("projection.get", kind="counts", tube={"on": False},
                         camera={"roi": ROI, "exposure_ms": 50.0})
        ).astype(float)  # fmt: skip
        assert (
            np.abs((full - dark) - 2 * (half - dark)).max() <= 2
        )  # no noise: rounded alone
        assert full.mean() > half.mean() > dark.mean()
        for axis, now in (await c.call("state.get"))["axes"].items():
            assert now["position"] == stands[axis]["position"]
        assert (await c.error("projection.get", positions={"up": 1.0})).code == -32602
        assert (await c.error("projection.get", tube={"kV": 9e3})).code == -32001
        assert (await c.error("projection.get", camera={"mode": "none"})).code in (
            -32001,
            -32602,
        )

    run(tmp_path, body, truth=TrueGeometry(Offsets(dD_x=1.5, dO_z=0.7)))


def test_the_ray_of_a_pixel_ends_in_it(tmp_path: Path) -> None:
    """The point of the fake projector stands in the pixel that sees it, and in no other; so the
    sum over its ray says which pixel was asked for."""

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("camera.set", roi=ROI)
        await c.call("calibration.apply", parameters={"dD_x": 0.8})
        await c.call("sample.set", name="lego", offset={"x": 1.0, "rz": 20.0})
        seen: list[Any] = []

        async def project(name: str, cone: ConeVec, shape: tuple[int, int]) -> Any:
            seen.append((name, cone, shape))
            return np.full((1, *shape), float(len(seen)), np.float32)

        lab.projector.project = project  # type: ignore[method-assign]
        told = (await c.call("projection.ray", pixel=[7.25, 40.5]))["paths_mm"]
        nominal = ConeVec((await c.call("geometry.get"))["cone_vec"])
        assert list(told.values()) == [float(k + 1) for k in range(len(seen))]
        assert set(told) >= {"abs"}
        for _, cone, shape in seen:
            assert shape == (1, 1)
            # From the sample's own frame back to the object's; then the whole image sees the
            # pixel.
            turn = np.radians(20.0)
            back = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0],
                             [0.0, 0.0, 1.0]])  # fmt: skip
            place = back @ cone.detector[0] + [1.0, 0.0, 0.0]
            spot = nominal.project_points(place[None] * (1 - 1e-9), (48, 64))[0, 0]
            assert spot == pytest.approx([7.25, 40.5], abs=1e-5)
            assert back @ cone.source[0] + [1.0, 0.0, 0.0] == pytest.approx(
                nominal.source[0]
            )
        for outside in ([64.0, 3.0], [3.0, 47.6]):
            assert (await c.error("projection.ray", pixel=outside)).code == -32001
        await c.call("sample.set", name="empty")
        assert (await c.call("projection.ray", pixel=[1.0, 1.0]))["paths_mm"] == {}

    run(tmp_path, body, truth=TrueGeometry(Offsets(dD_x=1.5)))


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
        assert document["frames"][1]["cone_vec"][6] == pytest.approx(
            0.1496
        )  # nominal: not turned
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


def test_a_long_list_of_corrections_lets_others_be_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many, turns, made = 300, [0], list[int]()
    view = state_views.correction_view

    def noted(*args: Any) -> Any:
        made.append(turns[0])
        return view(*args)

    async def count() -> None:
        while True:
            turns[0] += 1
            await asyncio.sleep(0.0)

    async def body(lab: Lab) -> None:
        for i in range(many):
            known = lab.twin.corrections.make({"dD_x": 0.01 * i}, f"c{i}", "")
            lab.twin.corrections.know(known, None)
        monkeypatch.setattr(state_views, "correction_view", noted)
        counter = asyncio.create_task(count())
        listed = (await lab.client().call("calibration.list"))["corrections"]
        counter.cancel()
        assert sorted(c["name"] for c in listed) == sorted(f"c{i}" for i in range(many))
        assert max(Counter(made).values()) <= 20

    run(tmp_path, body)


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
        if not state[
            "ready"
        ]:  # a machine that took seconds over this has nothing to show
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


def test_a_scan_s_images_are_not_rendered_in_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each watcher's view of each frame held the loop, unbinned counts for 60 to 80 ms."""
    image_of = live.image_of

    def apart(*args: Any) -> Any:
        assert threading.current_thread() is not threading.main_thread()
        return image_of(*args)

    monkeypatch.setattr(live, "image_of", apart)

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["projection"], projection_kind="counts")
        job = (await c.call("script.submit", text=script(frames=9), name="scan"))["job"]
        assert (await lab.ended(c, job))["state"] == "done"
        await lab.until(lambda: bool(c.of("projection")), "an image of the scan")

    run(tmp_path, body)
