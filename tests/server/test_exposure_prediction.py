"""`exposure.predict` beside images that the twin makes of the same sample."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.phantoms.samples import as_phantom
from flexdt.protocol import METHODS, Codec, RpcError
from flexdt.protocol.methods.image_messages import ExposurePrediction
from flexdt.server.imaging.exposure_quality import BEST, predict
from flexdt.twin.errors import LimitError

ROD = {"kind": "cylinder", "center": [0, 0, 0], "radius": 12.0, "height": 60, "material": "pmma"}


def predicted(**settings: Any) -> ExposurePrediction:
    """As in the worker; through JSON, as on the wire."""
    given = {"kV": 70.0, "images": 100, "sod": 600.0, "sdd": 1059.0, **settings}
    told = b"".join(predict(as_phantom(ROD), fx.machine("flexray"), given, Codec.JSON))
    return ExposurePrediction.model_validate(json.loads(told))


def test_a_prediction_is_what_noisy_images_show() -> None:
    told = predicted(power_W=40.0, exposure_ms=150.0)
    geometry = fx.ConeVec.circular(sod=600, sdd=1059, angles=1, shape=(760, 956), pixel=0.1496)
    made = fx.simulate(
        ROD, geometry, tube=fx.Tube(kV=70, power_W=40), noise=4,
        detector=fx.Detector(exposure_ms=150),
    )  # fmt: skip
    seen = np.exp(-made.line_integrals(0))
    assert told.transmission.median == pytest.approx(float(np.median(seen)), rel=0.03)
    assert told.transmission.p5 == pytest.approx(float(np.quantile(seen, 0.05)), rel=0.03)
    assert sum(told.transmission.shares) == pytest.approx(1.0)
    assert len(told.transmission.edges) == len(told.transmission.shares)
    assert (told.saturated, told.starved) == (0.0, 0.0)
    assert told.frames == 100
    assert told.seconds == pytest.approx(15.0)
    assert len(told.best) == BEST
    cnr = [one.cnr for one in told.best]
    assert cnr == sorted(cnr, reverse=True)


def test_shares_of_saturated_and_starved_pixels_are_told() -> None:
    assert predicted(exposure_ms=5000.0).saturated > 0.5
    assert predicted(kV=25.0, filter="copper:1", exposure_ms=20.0).starved > 0.9
    with pytest.raises(LimitError, match="kV is 5000"):
        predicted(kV=5000.0)


@pytest.mark.slow
def test_a_twin_predicts_its_own_images() -> None:
    with fx.LocalTwin(physics="poly", sample="normal-5") as twin:
        told = twin.predict_exposure(detail="void:0.2")
        images = []
        for angle in range(0, 360, 45):
            twin.move({"rot_obj": float(angle)}, wait=True)
            images.append(twin.projection("line_integral").image)
        seen = np.exp(-np.array(images))
        assert told.sample == twin.state().sample.name
        assert told.transmission.least == pytest.approx(float(seen.min()), rel=0.03)
        for name, q in (("p1", 0.01), ("p5", 0.05), ("median", 0.5)):
            found = getattr(told.transmission, name)
            assert found == pytest.approx(float(np.quantile(seen, q)), rel=0.03)
        longer = twin.predict_exposure(exposure_ms=5000.0)
        assert longer.saturated > 0.5
        for asked, code in (
            ({"kV": 5000.0}, -32001), ({"sample": "nobody"}, -32602), ({"filter": "x:1"}, -32602),
            ({"detail": "void:900"}, -32001), ({"frames": 0}, -32602), ({"kV": 1e9}, -32602),
        ):  # fmt: skip
            with pytest.raises(RpcError) as caught:
                twin.predict_exposure(**asked)
            assert caught.value.code == code, asked
        twin.set_sample("empty")
        with pytest.raises(RpcError, match="nothing stands on the stage"):
            twin.predict_exposure()
    assert METHODS["exposure.predict"].safe
