"""A layer of the list is at every door; the page and its first picture have one background."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stdout
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import viser
from pydantic import ValidationError

from flexdt.clients.viewer import page_html, page_methods
from flexdt.clients.viewer.scenes import layers
from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.still import GROUND
from flexdt.clients.viewer.scenes.world import placed
from flexdt.protocol.state_model import State
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, profile_of

DUMMY = layers.Layer("dummy", "a <dummy> & more", True, ("/floor",))
MACHINE = builtin_machine()
PROFILE = profile_of(MACHINE)


class Boxes(HTMLParser):
    """Names and words of the boxes of layers in a page."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.found: dict[str, str] = {}
        self._open = ""
        self.feed(page.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        told = dict(attrs)
        if tag == "input" and (told.get("id") or "").startswith("layer-"):
            assert told["type"] == "checkbox"
            self._open = str(told["data-layer"])
            self.found[self._open] = ""

    def handle_endtag(self, tag: str) -> None:
        self._open = "" if tag == "label" else self._open

    def handle_data(self, data: str) -> None:
        if self._open:
            self.found[self._open] += data


@pytest.fixture
def with_dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one list with one more layer, in each module that imports it."""
    more = (*layers.LAYERS, DUMMY)
    for module in (layers, page_html, page_methods):
        monkeypatch.setattr(module, "LAYERS", more)


@pytest.fixture
def empty_lab() -> Any:
    """An empty lab in a server of viser's."""
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0)
    yield lambda: LabScene(server, MACHINE, PROFILE)
    with redirect_stdout(io.StringIO()):
        server.stop()


def test_the_page_has_a_box_for_each_layer_in_order() -> None:
    boxes = Boxes(page_html.page_file("index.html")).found
    assert list(boxes.items()) == [(layer.name, layer.title) for layer in layers.LAYERS]
    assert page_html.page_file("scene.css") != b""


@pytest.mark.usefixtures("with_dummy")
def test_a_layer_of_the_list_is_at_every_door(empty_lab: Any) -> None:
    """The page's boxes and facts, the method's parameters, the scene's nodes."""
    assert Boxes(page_html.page_file("index.html")).found["dummy"] == DUMMY.title
    model = page_methods.layers_model()
    assert model.model_validate({"dummy": False}).model_dump()["dummy"] is False
    with pytest.raises(ValidationError):
        model.model_validate({"dumb": False})
    shown = layers.Shown()
    told = cast("dict[str, bool]", shown.told["shown"])
    assert told["dummy"] is True
    scene = empty_lab()
    hidden = scene.nodes(shown.changed(dummy=False))
    assert scene.plain["/floor"] == {"visible": True}
    assert hidden == {**scene.plain, "/floor": {"visible": False}}


def test_the_first_picture_shows_what_its_page_shows(empty_lab: Any) -> None:
    """Each of these layers alone, with X-rays on; the others of the list it does not draw."""
    scene, camera = empty_lab(), CameraSettings("HW2SW1High", Roi(32, 8, 1943, 1527))
    at = {name: axis.home for name, axis in MACHINE.axes.items()} | {"mag_det": 1059.0}
    world = placed(MACHINE, PROFILE, camera, at)
    axes = {name: SimpleNamespace(position=value) for name, value in at.items()}
    state = SimpleNamespace(axes=axes, tube=SimpleNamespace(on=True, ready=True))
    scene.update(cast(State, state), world)
    nothing = layers.Shown(frozenset())
    assert scene.shapes(world, nothing) == []
    for name, count in (("panel", 1), ("beam", 1), ("sample", 0), ("axis", 0)):
        assert len(scene.shapes(world, nothing.changed(**{name: True}))) == count, name
    for name in ("machine", "cabinet"):
        assert scene.shapes(world, nothing.changed(**{name: True})), name


def test_the_first_picture_has_the_background_of_the_scenes() -> None:
    """Its upper colour is one of the gradient's inner part, its lower one that of the rim."""
    css = page_html.page_file("scene.css").decode()
    gradients = re.findall(
        r"radial-gradient\(.*?, (#\w{6}) 0%, (#\w{6}) 55%, (#\w{6}) 100%\)", css
    )
    assert len(gradients) == 2
    for dark, stops in zip((False, True), gradients, strict=True):
        inner, middle, rim = (
            np.array([int(s[k : k + 2], 16) for k in (1, 3, 5)]) for s in stops
        )
        above, below = np.array(GROUND[dark])
        assert (below == rim).all()
        assert ((above - inner) * (above - middle) <= 0).all()
