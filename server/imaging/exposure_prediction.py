"""Image quality of a scan of a sample, predicted in a worker process with limits."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

from flexdt.phantoms import Phantom
from flexdt.phantoms.exposure_forecast import expose
from flexdt.protocol import Codec
from flexdt.protocol.connection import encoded
from flexdt.protocol.methods.image_messages import PREDICTION_LIMITS, ExposurePrediction
from flexdt.runtime.workers import Workers
from flexdt.twin.machine.description import Machine

BEST: Final = 10
"""Settings that are proposed."""


def predictors() -> Workers:
    """The process that predicts; to be closed in the end."""
    limits = PREDICTION_LIMITS
    return Workers(1, int(limits["memory_bytes"]), float(limits["seconds"]))


def predict(
    phantom: Phantom, machine: Machine, settings: dict[str, Any], codec: Codec
) -> list[bytes]:
    """In the worker: the answer to `exposure.predict`, encoded; `settings` are `expose`'s.

    Raises:
        RpcError: an argument that the machine does not allow.
    """
    told = asdict(expose(phantom, machine=machine, **settings))
    told["transmission"]["edges"] = told["transmission"]["edges"][:-1]  # no infinity in JSON
    told |= {"sample": phantom.name, "best": told["best"][:BEST], "frames": told.pop("images")}
    result = ExposurePrediction.model_validate(told, strict=False)
    return list(encoded(result, codec).pieces)
