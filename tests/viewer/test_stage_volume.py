"""A volume stands on the stage only while it is of what stands there, in its own page's scenes."""

from __future__ import annotations

import random
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flexdt.clients.viewer.scenes.layers import Shown
from flexdt.clients.viewer.scenes.stage_volume import (
    NODE,
    MadeOf,
    StageDrawing,
    StageVolume,
    fits,
)
from flexdt.clients.viewer.viewer import Viewer
from flexdt.protocol.state_model import SampleState, State

CHANGES = {
    "sample": lambda s, c: (s | {"name": "square"}, c),
    "content": lambda s, c: (s | {"revision": "b"}, c),
    "material": lambda s, c: (s | {"material": "iron"}, c),
    "place": lambda s, c: (s | {"offset": s["offset"] | {"rz": 0.5}}, c),
    "correction": lambda s, c: (s, "other"),
    "taken off": lambda s, c: (s | {"name": None, "revision": None}, c),
}
"""What makes another stage of one."""


def state(sample: dict[str, Any], correction: str | None) -> State:
    """As much of a state as is looked at."""
    told = None
    if correction is not None:
        told = (
            State.model_fields["correction"]
            .annotation.__args__[0]
            .model_construct(  # type: ignore[union-attr]
                name=correction
            )
        )
    return State.model_construct(
        sample=SampleState.model_validate(sample), correction=told
    )


def test_a_volume_fits_what_it_was_made_of_and_nothing_else() -> None:
    rng = random.Random(82)
    for _ in range(400):
        offset = {
            "x": 1.5,
            "y": 0.0,
            "z": 0.0,
            "rx": 0.0,
            "ry": 0.0,
            "rz": rng.choice((0.0, 30.0)),
        }
        sample = {"name": "gear", "revision": rng.choice((None, "a")), "material": "abs",
                  "offset": offset}  # fmt: skip
        correction = rng.choice((None, "c"))
        made = MadeOf("gear", sample["revision"], "abs", dict(offset), correction)
        stands, in_force, other = dict(sample), correction, False
        for change in CHANGES.values():
            if rng.random() < 0.2:
                stands, in_force = change(stands, in_force)
                other = True
        assert fits(made, state(stands, in_force)) is not other
    unknown = MadeOf("gear", None, "abs", None, None)
    assert not fits(unknown, state({"name": "gear", "material": "abs"}, None))


@pytest.mark.parametrize("change", [None, *CHANGES])
def test_a_recorded_image_never_stands_beside_another_sample(change: str | None) -> None:
    """A correction makes no other sample; without a data set the chosen layers are drawn."""
    offset = {"x": 1.5, "y": 0.0, "z": 0.0, "rx": 0.0, "ry": 0.0, "rz": 0.0}
    sample = {"name": "gear", "revision": "a", "material": "abs", "offset": offset}
    made = MadeOf("gear", "a", "abs", dict(offset), "c")
    now = CHANGES[change](sample, "c") if change else (sample, "c")
    viewer: Any = SimpleNamespace(state=state(*now))
    viewer.of_another = lambda page: Viewer.of_another(viewer, page)
    page: Any = SimpleNamespace(made=made, shown=Shown(), ghost=False)
    own = change in (None, "correction")
    shown = Viewer.shown_by(viewer, page)
    assert ("sample" in shown, "panel" in shown, "machine" in shown) == (own, own, True)
    # A volume of what stands there now stands beside images of the same alone.
    there, in_force = now
    facts = [there[key] for key in ("revision", "material", "offset")]
    present = MadeOf(there["name"] or "", *facts, in_force)
    page.volume = StageVolume("v", np.zeros((3, 3)), np.array([[0, 1, 2]]), present)
    assert Viewer._manner(viewer, page) == ("stands" if own else None)
    page.made = None
    assert Viewer.shown_by(viewer, page) == page.shown
    assert Viewer._manner(viewer, page) == "stands"


class Scene:
    """A frame's own scene: what is drawn in it by name."""

    def __init__(self) -> None:
        self.nodes: dict[str, Any] = {}
        self.sent = 0

    def get_handle_by_name(self, name: str) -> Any:
        return self if name in self.nodes and not setattr(self, "asked", name) else None

    def remove(self) -> None:
        del self.nodes[self.asked]

    def add_mesh_simple(self, name: str, *_: object, **of: Any) -> None:
        self.nodes[name] = of["color"]
        self.sent += 1

    def add_label(self, name: str, text: str, **_: object) -> None:
        self.nodes[name] = text


class Client:
    """A frame of a page."""

    def __init__(self, id: int) -> None:
        self.client_id, self.scene = id, Scene()

    @contextmanager
    def atomic(self) -> Any:
        yield


@pytest.mark.parametrize("seed", range(20))
def test_each_frame_shows_its_own_page_s_volume_and_is_sent_only_changes(
    seed: int,
) -> None:
    """Frames that are left out for a while, and others that open in their place, too."""
    rng = random.Random(seed)
    frames: list[Any] = [Client(k) for k in range(4)]
    owner = [0, 0, 1, 1]
    made = MadeOf("gear", None, None, None, None)
    volumes = [
        StageVolume(name, np.eye(3), np.array([[0, 1, 2]], dtype=np.int32), made)
        for name in ("scan-1", "scan-2")
    ]
    shown: list[Any] = [(None, None)] * 4
    drawing = StageDrawing()
    sent = [0] * 4
    for _ in range(60):
        page = rng.randrange(2)
        wanted = rng.choice(
            [(None, None), *((v, m) for v in volumes for m in ("stands", "ghost"))]
        )
        if rng.random() < 0.1:
            k = rng.randrange(4)
            frames[k], shown[k], sent[k] = Client(k), (None, None), 0
        ready = [k for k in range(4) if owner[k] == page and rng.random() < 0.7]
        for k in ready:
            sent[k] += wanted not in (shown[k], (None, None))
            shown[k] = wanted
        drawing.show([frames[k] for k in ready], *wanted)
        for k, frame in enumerate(frames):
            volume, manner = shown[k]
            names = [str(v) for v in frame.scene.nodes.values()]
            assert (NODE in frame.scene.nodes) is (volume is not None)
            assert any("ghost: " in n for n in names) is (manner == "ghost")
            if manner == "ghost":
                assert any(volume.name in name for name in names)
            assert frame.scene.sent == sent[k]
