"""projection.get, geometry.get and exposure.predict."""

from __future__ import annotations

import asyncio

import numpy as np

from flexdt.protocol import Codec, image
from flexdt.protocol import params as p
from flexdt.protocol import state_model as w
from flexdt.protocol.connection import MAX_ANSWER, encoded
from flexdt.protocol.fields import Empty, ImageValue
from flexdt.protocol.messages import Encoded
from flexdt.protocol.rpc_errors import invalid_params, too_large
from flexdt.server.imaging.exposure_flags import marks_of
from flexdt.server.imaging.exposure_prediction import predicted
from flexdt.server.storage.stored_samples import EMPTY
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client
from flexdt.server.twin.hub import View
from flexdt.server.twin.live import Shot, image_of
from flexdt.twin.errors import LimitError


async def get_projection(twin: TwinServer, client: Client, params: p.ProjectionGet) -> Encoded:
    """An image at the pose of this moment.

    Raises:
        RpcError: -32008, it would be larger than an answer may be.
    """
    shot = Shot.of(twin.scanner, twin.clock.now())
    if params.binning > min(shot.camera.shape):
        raise invalid_params(
            f"binning {params.binning} leaves nothing of {shot.camera.shape} pixels",
            [{"path": "binning", "message": "too large", "asked": params.binning}],
            min(shot.camera.shape),
        )
    codec = client.peer.codec
    _require_room(shot.camera.shape, params, codec)
    radiograph, cone = await twin.live.shoot(shot)

    def work() -> Encoded:
        """Apart: an image is some megabytes."""
        view, way = View(params.kind, params.binning), twin.radiography
        made = image_of(radiograph, cone, shot, view, way, np.random.default_rng())
        if params.marks:
            marks = marks_of(way, radiograph, shot.camera, shot.exposure, params.binning)
            made = made.model_copy(update={"marks": ImageValue(**image.encode(marks))})  # type: ignore[arg-type]
        return encoded(made, codec)

    async with twin.live.turn:
        return await asyncio.to_thread(work)


def _require_room(shape: tuple[int, int], params: p.ProjectionGet, codec: Codec) -> None:
    rows, cols = (n // params.binning for n in shape)
    size = rows * cols * ((2 if params.kind == "counts" else 4) + params.marks)
    size = size if codec is Codec.MSGPACK else size * 4 // 3
    most = MAX_ANSWER[codec] - 4096  # beside the pixels
    if size > most:
        raise too_large("an image", size, most)


def get_geometry(twin: TwinServer, client: Client, params: Empty) -> w.GeometryResult:
    """Nominal plus the correction in force."""
    cone = twin.scanner.cone_vec(twin.clock.now())
    return w.GeometryResult(
        cone_vec=cone.rows[0].tolist(),
        detector_shape=twin.scanner.camera.shape,
        pixel_mm=twin.scanner.pixel_mm,
    )


async def predict(twin: TwinServer, client: Client, params: p.ExposurePredict) -> Encoded:
    """Image quality of a circular scan at the distances of this moment.

    Raises:
        LimitError: nothing stands on the stage, or a setting is beyond the machine's.
    """
    sample, scanner = twin.scanner.sample, twin.scanner
    name = params.sample or sample.name
    if not name or name == EMPTY:
        raise LimitError("nothing stands on the stage", {"asked": "exposure.predict"})
    material = sample.material if name == sample.name else None
    at = twin.state().geometry
    lit, camera = scanner.tube, scanner.camera
    settings = {
        "kV": lit.kV if params.kV is None else params.kV,
        "power_W": lit.power_W if params.power_W is None else params.power_W,
        "exposure_ms": params.exposure_ms or camera.exposure_ms,
        "averages": params.averages or camera.averages,
        "filter": params.filter, "images": params.frames, "detail": params.detail,
        "sod": at.SOD_mm, "sdd": at.SDD_mm,
    }  # fmt: skip
    async with twin.samples.turn:
        phantom = await asyncio.to_thread(twin.samples.load, name, material)
    codec = client.peer.codec
    return await predicted(twin.predictors, phantom, twin.machine, settings, codec)
