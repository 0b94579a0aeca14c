"""Fields of the state: the twin fills each, the page shows each or is known not to, and a client
reads the state of a server that lacks one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from in_process import ROI, Lab, run, script
from pydantic import BaseModel

from flexdt.protocol.state_model import (
    AxisState,
    CameraState,
    ClockState,
    Correction,
    GeometryState,
    ImageFlags,
    JobStatus,
    SafetyState,
    SamplePlacement,
    SampleState,
    State,
    TubeState,
)

PAGE = Path(__file__).parents[2] / "clients" / "viewer" / "web" / "wire.d.ts"
NOT_SHOWN = {
    AxisState: {"acceleration"},
    SafetyState: {"blocked_attempts"},
    JobStatus: {"retry_s"},
    ImageFlags: {"truncated"},
}
"""Fields that the page in the browser does not show."""
REQUIRED: dict[type[BaseModel], str] = {
    State: "time axes tube camera sample geometry safety clock",
    AxisState: "position target velocity limits moving",
    TubeState: "on kV power_W",
    CameraState: "mode exposure_ms roi shape pixel_mm",
    SamplePlacement: "",
    SampleState: "name",
    GeometryState: "SOD_mm SDD_mm magnification voxel_size_mm piercing_point_px field_of_view_mm",
    SafetyState: "state estop",
    Correction: "name date parameters",
    ClockState: "time_s speed_up",
    JobStatus: "job state",
    ImageFlags: "saturated starved truncated",
}
"""Fields without a default since version 1.0. Later ones have one: older servers lack them."""


def models(within: object) -> Iterator[type[BaseModel]]:
    """All models of a model's or annotation's fields, itself among them, each once or more."""
    for inner in get_args(within):
        yield from models(inner)
    if isinstance(within, type) and issubclass(within, BaseModel):
        yield within
        for field in within.model_fields.values():
            yield from models(field.annotation)


def values(within: object) -> Iterator[BaseModel]:
    """All models that a value holds, itself among them."""
    if isinstance(within, BaseModel):
        yield within
        yield from (m for value in dict(within).values() for m in values(value))
    elif isinstance(within, dict):
        yield from (m for value in within.values() for m in values(value))


def not_shown() -> dict[type[BaseModel], set[str]]:
    """The fields that the page's modules do not name, by model.

    `wire.d.ts` has the fields that they name (`tests/viewer/test_page_source.py`).
    """
    text = PAGE.read_text("utf-8")
    types = dict(re.findall(r"^export type (\w+) = \{(.*?)\n?\};$", text, re.M | re.S))
    found = {
        model: set(model.model_fields) - set(re.findall(r"(\w+):", types[model.__name__]))
        for model in models(State)
    }
    return {model: names for model, names in found.items() if names}


def test_the_twin_fills_every_field_of_the_state(tmp_path: Path) -> None:
    """A default that nothing fills would be sent for ever."""
    seen: dict[type[BaseModel], set[str]] = {}

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("session.hello", protocol="1.0", client="test")
        await c.call("camera.set", roi=ROI)
        await c.call("calibration.apply", parameters={"dD_x": 0.1}, name="one")
        await c.call("projection.get")
        job = await c.call("script.submit", text=script(2), name="one")
        for one in values(lab.twin.state()):
            seen.setdefault(type(one), set()).update(one.model_fields_set)
        await lab.ended(c, job["job"])

    run(tmp_path, body)
    assert set(seen) == set(models(State))
    assert {
        (model.__name__, field)
        for model, filled in seen.items()
        for field in set(model.model_fields) - filled
    } == set()


def test_the_page_shows_every_field_but_these() -> None:
    assert not_shown() == NOT_SHOWN


def test_fields_that_were_added_have_a_default() -> None:
    assert set(REQUIRED) == set(models(State))
    for model, names in REQUIRED.items():
        fields = model.model_fields
        assert {n for n, f in fields.items() if f.is_required()} == set(names.split())
