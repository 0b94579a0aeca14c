"""A twin server called through its sessions, without sockets or processes, for its tests."""

from __future__ import annotations

import asyncio
import hashlib
import json
import random
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from one_ray import OneRay

from flexdt.protocol import (
    METHODS,
    Codec,
    Connection,
    Message,
    Prepared,
    RpcError,
    parse_params,
)
from flexdt.protocol.messages import Encoded
from flexdt.runtime.files.directory import open_data
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.twin.application import TwinSession
from flexdt.server.twin.core import TwinServer
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.scanner.state import Sample

M = builtin_machine()
P = builtin_profile(M.default_profile)
ROI = [900, 700, 1027, 795]  # 48 x 64 pixels


PATIENCE_S = 60.0
"""For what happens a moment later, on a machine that may be busy."""


class PointProjector(OneRay):
    """Shows one point of the object as one bright pixel, and counts."""

    POINT = np.array([[2.0, -1.0, 0.3]])  # near the height of the source at home

    def __init__(self) -> None:
        """Begin with no views and no names; without a delay or a limit."""
        self.views = 0
        self.names: list[str] = []
        self.down = False
        self.delay_s = 0.0
        self.limit: int | None = None
        """No more views than so many, until it is lifted."""

    async def put(self, name: str, body: object) -> None:
        self.names.append(name)

    async def remove(self, name: str) -> None:
        self.names.remove(name)

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> Float32Array:
        """Return one bright pixel a view, where the point is seen (at the edge if it is
        beyond).

        Its value tells the place within the pixel. It waits `delay_s`, and while `limit`
        views are reached. Rays of a prediction give zeros at once and are not counted.

        Raises:
            ProjectorUnavailable: `down` is set.
            AssertionError: the name is not one that was uploaded.
        """
        assert name in self.names
        if self.down:
            raise ProjectorUnavailable("no projector at test")
        if cone_vec.detector_shape is not None:  # a prediction's rays, no view of a scan
            return np.zeros((len(cone_vec), *shape), dtype=np.float32)
        await asyncio.sleep(self.delay_s)
        while self.limit is not None and self.views >= self.limit:
            await asyncio.sleep(0.001)
        self.views += len(cone_vec)
        out = np.zeros((len(cone_vec), *shape), dtype=np.float32)
        spots = cone_vec.project_points(self.POINT, shape)[:, 0]
        for frame, (column, row) in zip(out, spots, strict=True):
            c, r = (
                int(np.clip(column, 0, shape[1] - 1)),
                int(np.clip(row, 0, shape[0] - 1)),
            )
            frame[r, c] = (
                1.0 + (column % 1.0) + (row % 1.0)
            )  # the sub-pixel place shows too
        return out


class Client:
    """A session with its events."""

    def __init__(self, twin: TwinServer, name: str) -> None:
        """Open a session of the twin; `events` collects what it is sent."""
        self.name = name
        self.events: list[dict[str, Any]] = []
        self.session = TwinSession(twin, self)
        self._wire = Connection(Codec.JSON)

    @property
    def codec(self) -> Codec:
        return Codec.JSON

    def post(self, message: Message | Prepared, slot: str | None = None) -> None:
        self.events.append(json.loads(self._wire.send(message))["params"])

    def close(self, reason: str = "") -> None:
        self.session.close()

    async def call(self, method: str, /, **params: object) -> Any:
        """Call a method as over a connection; the result is checked against the method's
        model.

        Args:
            method: its name.
            params: as on the wire; they are parsed.

        Returns:
            The result as plain values.

        Raises:
            RpcError: the method's own error, or parameters that do not fit.
        """
        m = METHODS[method]
        result = await self.session.handle(m, parse_params(m, params))
        if isinstance(result, Encoded):
            result = m.result.model_validate(json.loads(b"".join(result.pieces)))
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
        """Start the twin server with the chiral phantom on the stage."""
        self.twin = TwinServer(M, P, self.projector, open_data(self.root), **self.options)
        await self.twin.start(Sample("chiral"))
        self.count = 0
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.twin.stop()

    def client(self) -> Client:
        self.count += 1
        return Client(self.twin, f"client-{self.count}")

    async def until(self, condition: Callable[[], bool], what: str = "") -> None:
        """Wait until a condition holds.

        Raises:
            AssertionError: it does not for PATIENCE_S; the text names `what`.
        """
        until = asyncio.get_running_loop().time() + PATIENCE_S
        while not condition():
            assert asyncio.get_running_loop().time() < until, f"never happened: {what}"
            await asyncio.sleep(0.001)

    async def ended(self, client: Client, job: str) -> dict[str, Any]:
        """Wait until a job is done, failed, aborted or incomplete, without a limit; its
        status.
        """
        while True:
            status: dict[str, Any] = await client.call("job.status", job=job)
            if status["state"] in ("done", "failed", "aborted", "incomplete"):
                return status
            await asyncio.sleep(0.002)


def run(
    root: Path,
    body: Callable[[Lab], Awaitable[None]],
    *,
    virtual: bool = False,
    **options: Any,
) -> None:
    """Run `body` with a lab of its own.

    Args:
        root: its data directory.
        body: takes the lab; it may last 2 * PATIENCE_S.
        virtual: on a loop whose time jumps over every wait, its threads' work among it.
        options: of `TwinServer`.

    Raises:
        TimeoutError: the body lasts longer.
    """

    async def main() -> None:
        """Open the lab and run the body in it, with a limit of time."""
        if virtual:
            options["wall"] = asyncio.get_running_loop().time
        async with Lab(root, **options) as lab:
            await asyncio.wait_for(body(lab), 2 * PATIENCE_S)

    factory = partial(SimulatedLoop, random.Random(0)) if virtual else None
    with asyncio.Runner(loop_factory=factory) as runner:
        runner.run(main())


def script(frames: int = 9, speed: float = 22.5, exposure: float = 2000.0) -> str:
    """The text of a fly scan: a dark frame, then `frames` projections on the way from
    -191.25 to 551.25 deg.

    Args:
        frames: how many.
        speed: of the stage [deg/s].
        exposure: of a frame [ms].
    """
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
    """SHA-256 of each TIFF of a folder, by its name; the order is that of the names."""
    return {
        f.name: hashlib.sha256(f.read_bytes()).hexdigest()
        for f in sorted(folder.glob("*.tif"))
    }
