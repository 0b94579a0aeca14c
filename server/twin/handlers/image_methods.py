"""projection.get and .ray, geometry.get and exposure.predict."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import assert_never

import numpy as np

from flexdt.protocol import Codec, image
from flexdt.protocol import state_model as w
from flexdt.protocol.connection import MAX_ANSWER, answer_bytes, encoded
from flexdt.protocol.fields import Empty, ImageValue
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods import image_messages as p
from flexdt.protocol.methods.scanner_messages import CameraSet, TubeSet
from flexdt.protocol.rpc_errors import invalid_params, problem, too_large
from flexdt.server.imaging.radiography import marks_of
from flexdt.server.imaging.radiography import predict as forecast
from flexdt.server.twin import state_views
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, answers
from flexdt.server.twin.handlers.motion_methods import camera_change
from flexdt.server.twin.hub import ImageRequest
from flexdt.server.twin.live import Shot, image_of
from flexdt.twin.errors import LimitError, shape_words
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.travel import arrival
from flexdt.twin.scanner.state import (
    EMPTY_STAGE,
    changed_camera,
    changed_tube,
    switched,
)


@answers(p.PROJECTION_GET)
async def get_projection(
    twin: TwinServer, client: Client, params: p.ProjectionGet
) -> Encoded:
    """Compute an image at the present pose, or predict one for other positions, tube or
    camera settings.

    The image at the present pose has the hidden truth and noise. A prediction has the
    public geometry and no noise; one of the three parameters makes the request a
    prediction.

    Returns:
        The image, encoded in a thread for the connection, with marks of its pixels where
        requested.

    Raises:
        RpcError: -32602, the binning is larger than the image; -32008, the answer would
            be too large.
        TwinError: the machine does not have a motor or a setting.
    """
    shot = twin.live.now()
    warnings: list[str] | None = None
    elsewhere = any(x is not None for x in (params.positions, params.tube, params.camera))
    if elsewhere:
        shot, warnings = _predicted_shot(twin, shot, params)
    if params.binning > min(shot.camera.shape):
        raise invalid_params(
            f"binning {params.binning} leaves nothing of {shape_words(shot.camera.shape)} pixels",
            [problem("binning", "too large", params.binning)],
            min(shot.camera.shape),
        )
    codec = client.peer.codec
    _require_room(shot.camera.shape, params, codec)
    radiograph, cone = await twin.live.shoot(shot, predicted=elsewhere)

    def work() -> Encoded:
        """Make and encode the image, with marks if they are requested; runs in a thread.

        Noise is random, not of a seed; a prediction has none.
        """
        view = ImageRequest(params.kind, params.binning)
        way = twin.radiography
        rng = None
        if not elsewhere:
            rng = np.random.default_rng()
        made = image_of(radiograph, cone, shot, view, way, rng)
        if params.marks:
            marks = marks_of(way, radiograph, shot.camera, shot.exposure, params.binning)
            made = made.model_copy(update={"marks": ImageValue(**image.encode(marks))})  # type: ignore[arg-type]
        if warnings:
            made = made.model_copy(update={"warnings": warnings})
        return encoded(made, codec)

    async with twin.live.turn:
        return await asyncio.to_thread(work)


def _predicted_shot(
    twin: TwinServer, shot: Shot, params: p.ProjectionGet
) -> tuple[Shot, list[str]]:
    """Return the shot with the requested positions, tube and camera in place of the
    present ones, and a message for each position that was set to a limit.

    Positions have the rule of a request by itself (`twin/machine/travel.py`).

    X-rays that are switched on need no warm-up. Settings that are not requested stay as
    in `shot`.

    Raises:
        LimitError: a position is beyond the travel; a setting that there is not.
        UnknownNameError: the machine does not have a motor or a setting.
    """
    machine = twin.machine
    there = dict(shot.positions)
    messages = list[str]()
    for motor, position in (params.positions or {}).items():
        machine.axis(motor)
        found = arrival(machine, motor, {motor: position})
        if found.beyond is not None:
            raise found.beyond
        there |= found.motors
        messages += [f"{message}; set to the limit" for message in found.messages]
    asked = params.tube or TubeSet()
    tube = changed_tube(machine.tube, shot.tube, asked.kV, asked.power_W)
    tube = switched(
        machine, tube, tube.on if asked.on is None else asked.on, None, warm=True
    )
    change = camera_change(params.camera or CameraSet())
    camera = changed_camera(machine.detector, shot.camera, change)
    positions = tuple(sorted(there.items()))
    return replace(shot, positions=positions, tube=tube, camera=camera), messages


def _require_room(shape: tuple[int, int], params: p.ProjectionGet, codec: Codec) -> None:
    """Check that an image of (rows, cols) before binning fits into one answer.

    4096 bytes are left for the rest; any codec but MessagePack needs a third more.

    Raises RpcError: -32008, it does not fit; names both sizes [bytes].
    """
    rows, cols = (n // params.binning for n in shape)
    match params.kind:
        case "counts":
            pixel_bytes = 2
        case "line_integral":
            pixel_bytes = 4
        case _:
            assert_never(params.kind)
    size = answer_bytes(rows * cols * (pixel_bytes + params.marks), codec)
    most = MAX_ANSWER[codec] - 4096  # beside the pixels
    if size > most:
        raise too_large("an image", size, most)


@answers(p.PROJECTION_RAY)
async def ray(twin: TwinServer, client: Client, params: p.RayGet) -> p.RayResult:
    """Compute the path lengths [mm] by material on the ray of a pixel, in the public
    geometry at the present pose.

    The pixel is (column, row) and may be fractional; centers are whole numbers, so the
    edge is half a pixel further.

    Raises:
        LimitError: the image has no such pixel.
    """
    scanner, (column, row) = twin.scanner, params.pixel
    rows, cols = scanner.camera.shape
    if not (-0.5 <= column < cols - 0.5 and -0.5 <= row < rows - 0.5):
        asked = {"asked": [column, row], "allowed": [[0, cols - 1], [0, rows - 1]]}
        raise LimitError(
            f"no pixel ({column:g}, {row:g}) in {cols} columns, {rows} rows", asked
        )
    whole = scanner.cone_vec(twin.clock.now())
    off = (column - (cols - 1) / 2) * whole.u + (row - (rows - 1) / 2) * whole.v
    pixel = ConeVec(np.hstack([whole.source, whole.detector + off, whole.u, whole.v]))
    return p.RayResult(paths_mm=await twin.imaging.ray(scanner.sample, pixel))


@answers(p.GEOMETRY_GET)
def get_geometry(twin: TwinServer, client: Client, params: Empty) -> w.GeometryResult:
    """Return the present cone_vec (12 numbers), detector shape (rows, cols) and pixel
    [mm]: nominal plus the correction in force.
    """
    cone = twin.scanner.cone_vec(twin.clock.now())
    return w.GeometryResult(
        cone_vec=cone.rows[0].tolist(),
        detector_shape=twin.scanner.camera.shape,
        pixel_mm=twin.scanner.pixel_mm,
    )


@answers(p.EXPOSURE_PREDICT)
async def predict(twin: TwinServer, client: Client, params: p.ExposurePredict) -> Encoded:
    """Predict the image quality of a circular scan, in a worker process.

    Settings and distances that the request leaves out are the present ones. A named
    sample is read with its own material, be it on the stage or not; without a name it is
    the one on the stage, with the material there.

    Returns:
        The forecast, encoded for the connection.

    Raises:
        LimitError: the stage is empty, or a setting is beyond the machine's limits.
        GeometryError: a distance is left out where the present pose has none.
    """
    sample = twin.scanner.sample
    scanner = twin.scanner
    name = params.sample or sample.name
    if not name or name == EMPTY_STAGE:
        raise LimitError("nothing stands on the stage", {"asked": "exposure.predict"})
    material = None
    if name == sample.name:
        material = sample.material
    sod, sdd = params.sod_mm, params.sdd_mm
    if sod is None or sdd is None:
        here = state_views.geometry_view(scanner.state(twin.clock.now()).readout)
        sod, sdd = sod or here.SOD_mm, sdd or here.SDD_mm
    lit = scanner.tube
    camera = scanner.camera
    settings = {
        "kV": lit.kV if params.kV is None else params.kV,
        "power_W": lit.power_W if params.power_W is None else params.power_W,
        "exposure_ms": params.exposure_ms or camera.exposure_ms,
        "averages": params.averages or camera.averages,
        "mode": params.mode or camera.mode,
        "roi": Roi(*(params.roi or camera.roi.edges)),
        "filter": params.filter,
        "images": params.frames,
        "detail": params.detail,
        "kind": params.kind,
        "profile": scanner.profile,
        "start": twin.submissions.start(),
        "sod": sod,
        "sdd": sdd,
    }
    async with twin.samples.turn:
        phantom = await asyncio.to_thread(twin.samples.load, name, material)
    codec = client.peer.codec
    pieces = await twin.predictors.ask(forecast, phantom, twin.machine, settings, codec)
    return Encoded(tuple(pieces))
