"""projection.get and geometry.get."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flexdt.protocol import image
from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol import state as w
from flexdt.protocol.errors import invalid_params
from flexdt.protocol.fields import Empty, ImageValue
from flexdt.server.core import TwinServer
from flexdt.server.handlers.table import Client, Handler
from flexdt.server.hub import View
from flexdt.server.live import Shot, image_of
from flexdt.server.seen import marks_of


async def get_projection(twin: TwinServer, client: Client, params: p.ProjectionGet) -> r.Projection:
    """An image at the pose of this moment."""
    shot = Shot.of(twin.scanner, twin.clock.now())
    if params.binning > min(shot.camera.shape):
        raise invalid_params(
            f"binning {params.binning} leaves nothing of {shot.camera.shape} pixels",
            [{"path": "binning", "message": "too large", "asked": params.binning}],
            min(shot.camera.shape),
        )
    radiograph, cone = await twin.live.shoot(shot)
    view = View(params.kind, params.binning)
    made = image_of(radiograph, cone, shot, view, twin.radiography, np.random.default_rng())
    if not params.marks:
        return made
    marks = marks_of(twin.radiography, radiograph, shot.camera, shot.exposure, params.binning)
    return made.model_copy(update={"marks": ImageValue(**image.encode(marks))})  # type: ignore[arg-type]


def get_geometry(twin: TwinServer, client: Client, params: Empty) -> w.GeometryResult:
    """Nominal plus the correction in force."""
    cone = twin.scanner.cone_vec(twin.clock.now())
    return w.GeometryResult(
        cone_vec=cone.rows[0].tolist(),
        detector_shape=twin.scanner.camera.shape,
        pixel_mm=twin.scanner.pixel_mm,
    )


TABLE: Mapping[str, Handler] = {
    "projection.get": get_projection,
    "geometry.get": get_geometry,
}
