"""`exposure.predict` beside images that the twin makes of the same sample."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from in_process import Lab, M, P, run

import flexdt as fx
from flexdt.phantoms.samples import as_phantom
from flexdt.protocol import METHODS, Codec, RpcError
from flexdt.protocol.methods.image_messages import ExposurePrediction
from flexdt.server.imaging.radiography import MAX_PROPOSALS, predict
from flexdt.twin.errors import LimitError
from flexdt.twin.machine.camera import Roi
from flexdt.twin.scanner.state import changed_camera
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

ROD = {
    "kind": "cylinder",
    "center": [0, 0, 0],
    "radius": 12.0,
    "height": 60,
    "material": "pmma",
}


def predicted(**settings: Any) -> ExposurePrediction:
    """As in the worker; through JSON, as on the wire."""
    given = {"kV": 70.0, "images": 100, "sod": 600.0, "sdd": 1059.0, **settings}
    told = b"".join(predict(as_phantom(ROD), fx.machine("flexray"), given, Codec.JSON))
    return ExposurePrediction.model_validate(json.loads(told))


def test_a_prediction_is_what_noisy_images_show() -> None:
    told = predicted(power_W=40.0, exposure_ms=150.0)
    geometry = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=1, shape=(760, 956), pixel=0.1496
    )
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
    assert len(told.best) == MAX_PROPOSALS
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.campaign(1)
def test_prediction_report_and_finished_data_set_are_one(
    tmp_path: Path, seed: int
) -> None:
    """In drawn camera modes, regions and kinds of scan: bytes to the byte, and time."""
    rng = np.random.default_rng(4300 + seed)
    kind = ("fly", "step", "tiled", "helical", "calibration")[seed]
    mode = str(rng.choice(M.detector.mode_names))
    left, top = (int(x) for x in rng.integers(700, 850, 2))  # near enough for the motors
    roi = Roi(
        left, top, left + int(rng.integers(60, 400)), top + int(rng.integers(60, 300))
    )
    frames, exposure = int(rng.integers(40, 60)), float(rng.uniform(300, 500))
    sod, sdd = round(float(rng.uniform(500, 700)), 4), 1059.0
    request = ScanRequest(
        kind, sod, sdd, frames, exposure, mode=mode, roi=roi, kV=70.0, power_W=30.0
    )
    text = compose_script(request, M, P)
    asked: dict[str, Any] = {
        "mode": mode, "frames": frames, "exposure_ms": exposure, "averages": 1, "sod_mm": sod,
        "sdd_mm": sdd, "kV": 70.0, "power_W": 30.0, "kind": kind,
    }  # fmt: skip

    found: list[int] = []

    async def body(lab: Lab) -> None:
        a = lab.client()
        told = await a.call("exposure.predict", roi=list(roi.edges), **asked)
        here = fx.expose(
            ROD, kV=70.0, power_W=30.0, exposure_ms=exposure, mode=mode, roi=roi, images=frames,
            kind=kind, sod=sod, sdd=sdd, profile=P, start=lab.twin.submissions.start(),
        )  # fmt: skip
        report = await a.call("script.check", text=text)
        assert report["ok"], report["problems"]
        assert (here.bytes, here.images) == (told["bytes"], told["frames"])
        assert (report["bytes"], report["frames"]) == (told["bytes"], told["frames"])
        assert here.seconds == told["seconds"] == report["duration_s"]
        answer = await a.call("script.submit", text=text, name="drawn")
        status = await lab.ended(a, answer["job"])
        assert status["state"] == "done"
        assert status["elapsed_s"] == pytest.approx(told["seconds"], rel=1e-6)
        found.extend((told["bytes"], told["frames"]))

    run(tmp_path, body)
    images = [tifffile.imread(f) for f in (tmp_path / "drawn").glob("*.tif")]
    assert sum(i.nbytes for i in images) == found[0]
    rows, cols = (n // changed_camera(M.detector, M.detector.camera, {"mode": mode}).binning
                  for n in (roi.bottom - roi.top + 1, roi.right - roi.left + 1))  # fmt: skip
    assert {i.shape for i in images} == {(rows, cols)}
    assert len(images) - 2 == found[1]
