"""What the README shows with `nc`, done with plain sockets: no flexdt code on this side."""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.slow

Plain = Any


def test_move_an_axis_take_a_projection(plain: Plain) -> None:
    plain.call("sample.set", name="normal-5")
    plain.call("camera.set", mode="HW2SW1High", roi=[32, 8, 1943, 1527])
    plain.call(
        "axes.move", targets={"rot_obj": 0, "tra_obj": 0, "mag_obj": 600}, wait=True
    )
    before = plain.call("projection.get", kind="line_integral", binning=4)
    moved = plain.call("axes.move", targets={"rot_obj": 90}, wait=True)
    assert moved["duration_s"] > 1.0
    after = plain.call("projection.get", kind="line_integral", binning=4)
    images = [
        np.frombuffer(base64.b64decode(p["data"]), p["dtype"]).reshape(p["shape"])
        for p in (before, after)
    ]
    assert images[0].shape == (190, 239)
    assert images[0].max() > 1.0
    # 20 mm wide at 0 deg, 40 mm at 90 deg: the shadow is about twice as wide.
    widths = [int((image > 0.2).any(axis=0).sum()) for image in images]
    assert 1.7 < widths[1] / widths[0] < 2.3
    assert plain.call("state.get")["axes"]["rot_obj"]["position"] == 90.0


def test_cone_vec_turns_with_the_stage_and_comes_back(plain: Plain) -> None:
    plain.call("axes.move", targets={"rot_obj": 0}, wait=True)
    first = np.array(plain.call("geometry.get")["cone_vec"])
    plain.call("axes.move", targets={"rot_obj": 90}, wait=True)
    quarter = np.array(plain.call("geometry.get")["cone_vec"])
    # The stage turned clockwise from above, so in the object's frame the source went round
    # counter-clockwise by 90 degrees: (x, y) -> (-y, x).
    np.testing.assert_allclose(
        quarter[[0, 1, 2]], [-first[1], first[0], first[2]], atol=1e-9
    )
    plain.call("axes.move", targets={"rot_obj": 360}, wait=True)
    np.testing.assert_allclose(plain.call("geometry.get")["cone_vec"], first, atol=1e-9)


def test_submit_a_script_and_read_the_files(
    plain: Plain, fly_script: Callable[..., str], data_dir: Path
) -> None:
    text = fly_script(9)
    report = plain.call("script.check", text=text)
    assert report["ok"] is True
    assert report["frames"] == 9
    job = plain.call("script.submit", text=text, name="by-hand")["job"]
    status = plain.wait(job)
    assert (status["state"], status["frames_done"]) == ("done", 9)
    folder = data_dir / "by-hand"
    names = sorted(p.name for p in folder.iterdir())
    assert names == sorted(
        ["di000000.tif", "io000000.tif", *(f"scan_{i:06d}.tif" for i in range(9)),
         "scan settings.txt", "data settings XRE.txt", "script.txt", "flexdt.json"]
    )  # fmt: skip
    assert (folder / "script.txt").read_bytes() == text.encode()


def test_a_script_with_binary_arguments_survives_byte_for_byte(
    plain: Plain, fly_script: Callable[..., str], data_dir: Path
) -> None:
    blob = b"scanner\tset sample info\t@>\x00\x01\xff\xfe sweets \x00\x00\t\tACK\t\t\r\n"
    data = blob + fly_script(3, exposure_ms=400).encode()
    job = plain.call(
        "script.submit", data_base64=base64.b64encode(data).decode(), name="binary"
    )["job"]  # fmt: skip
    assert plain.wait(job)["state"] == "done"
    kept = (data_dir / "binary" / "script.txt").read_bytes()
    assert hashlib.sha256(kept).digest() == hashlib.sha256(data).digest()


def test_a_batch_is_answered_as_one(plain: Plain) -> None:
    plain.send(
        '[{"jsonrpc":"2.0","id":"a","method":"geometry.get"},'
        '{"jsonrpc":"2.0","id":"b","method":"no.such"},'
        '{"jsonrpc":"2.0","method":"state.get"}]'
    )
    answers = {a["id"]: a for a in plain.receive()}
    assert set(answers) == {"a", "b"}
    assert len(answers["a"]["result"]["cone_vec"]) == 12
    assert answers["b"]["error"]["code"] == -32601


def test_bad_input_gets_its_code_and_the_connection_lives(plain: Plain) -> None:
    plain.send('{"jsonrpc": "2.0", "id": 1, "method": ')
    assert plain.receive()["error"]["code"] == -32700
    assert plain.ask("axes.move", targets={"mag_obj": "far"})["error"]["code"] == -32602
    error = plain.ask("axes.move", targets={"mag_obj": 5000})["error"]
    assert error["code"] == -32001
    assert "5000" in error["message"]
    assert plain.ask("axes.move", targets={"warp": 1})["error"]["code"] == -32602
    error = plain.ask(
        "script.submit", text="\n".join(["tra_obj move sideways ACK"] * 10)
    )["error"]
    assert error["code"] == -32005
    lines = [p["line"] for p in _problems(error["data"])]
    assert sorted(set(lines)) == list(range(1, 11))
    assert plain.call("session.ping")["time"] >= 0


def _problems(data: Any) -> list[dict[str, Any]]:
    return data["problems"] if isinstance(data, dict) else data


def test_a_watcher_sees_projections_flow_while_an_axis_moves(
    plain: Plain, servers: Any, connect: Callable[..., Plain]
) -> None:
    """During a move at least 20 distinct projections arrive; the last is the final pose's."""
    plain.call("clock.set", speed_up=1)
    plain.call("sample.set", name="normal-5")
    plain.call("axes.move", targets={"rot_obj": 0, "tra_obj": 0, "mag_obj": 600})
    plain.call("clock.set", speed_up="max")
    plain.call("axes.move", targets={"rot_obj": 0}, wait=True)
    plain.call("clock.set", speed_up=1)
    watcher = connect(servers.address)
    watcher.call("state.subscribe", topics=["projection"], projection_binning=4)
    plain.call(
        "axes.set", axis="rot_obj", speed=4.0
    )  # a busy machine projects twice a second
    moved = plain.call("axes.move", targets={"rot_obj": 96}, wait=False)
    assert moved["duration_s"] > 9.5
    seen: dict[bytes, int] = {}
    end = plain.call("axes.move", targets={"rot_obj": 96}, wait=True)
    assert end["arrived"] is True
    final = plain.call("projection.get", kind="line_integral", binning=4)
    last = None
    while last is None or last["cone_vec"] != final["cone_vec"]:
        event = watcher.receive()["params"]
        assert event["topic"] == "projection"
        last = event["data"]
        seen[hashlib.sha256(last["data"].encode()).digest()] = event["seq"]
    assert len(seen) >= 20
    assert last["data"] == final["data"]
    plain.call("clock.set", speed_up="max")


def test_the_other_encoding_on_the_same_port(
    servers: Any, connect: Callable[..., Plain]
) -> None:
    """A first byte of 0x00: length-prefixed MessagePack, images as raw bytes."""
    import msgpack

    client = connect(servers.address)
    payload = msgpack.packb(
        {"jsonrpc": "2.0", "id": 7, "method": "projection.get", "params": {"binning": 8}}
    )
    client.socket.sendall(struct.pack(">I", len(payload)) + payload)
    (length,) = struct.unpack(">I", client.file.read(4))
    answer = msgpack.unpackb(client.file.read(length))
    assert answer["id"] == 7
    image = answer["result"]
    assert isinstance(image["data"], bytes)
    assert len(image["data"]) == 4 * image["shape"][0] * image["shape"][1]
