"""Scripts that the page has composed: they begin where motors stand, whatever is in force."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flexdt.clients.viewer.page_methods import Compose, scan_request
from flexdt.clients.viewer.scenes.world import placed
from flexdt.protocol.state_model import State
from flexdt.server.twin.state_views import camera_view
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script.compose import compose_script

MACHINE = builtin_machine()
PROFILE = builtin_profile(MACHINE.default_profile)
CAMERA = MACHINE.detector.camera
HOME = {name: axis.home for name, axis in MACHINE.axes.items()}
CASES = 12


def stands(at: dict[str, float], correction: Offsets) -> State:
    """A state as the page's methods look at it: readouts are those of the correction."""
    view = placed(MACHINE, PROFILE, CAMERA, {**HOME, **at}, correction).cone_vec
    geometry = SimpleNamespace(
        SOD_mm=float(np.linalg.norm(view.rows[0, :3])),
        SDD_mm=float(view.source_detector_distance[0]),
    )
    axes = {n: SimpleNamespace(position=p) for n, p in {**HOME, **at}.items()}
    camera = camera_view(CAMERA, MACHINE)
    tube = SimpleNamespace(kV=90.0, power_W=20.0)
    some: Any = SimpleNamespace(geometry=geometry, axes=axes, camera=camera, tube=tube)
    return cast(State, some)


@pytest.mark.parametrize("seed", range(CASES))
def test_a_correction_does_not_move_the_detector(seed: int) -> None:
    """Also with the detector at the end of its travel, which a calibration once left."""
    rng = np.random.default_rng(seed)
    axis = MACHINE.axes["mag_det"]
    low, high = axis.lower, axis.upper
    detector = [high, low + 500.0, float(rng.uniform(low + 500.0, high))][seed % 3]
    at = {"mag_det": detector, "mag_obj": float(rng.uniform(150.0, 400.0))}
    correction = Offsets.from_edge(
        {"dD_y": float(rng.normal()), "dO_y": float(rng.normal()), "alpha": 1.0}
    )
    request = scan_request(
        Compose(kind="fly", frames=73), MACHINE, PROFILE, stands(at, correction)
    )
    text = compose_script(request, MACHINE, PROFILE)
    lines = [line.split("\t") for line in text.split("\r\n") if "move absolute" in line]
    for name, wanted in at.items():
        told = [float(line[2]) for line in lines if line[0] == name]
        assert told
        assert max(abs(value - wanted) for value in told) < 1e-5
