"""What a page shows of the scene is its person's own; and how its frames are lit."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import pytest
from looking import Picture, changed, drawn, settled, still

from flexdt.clients.viewer.page_cameras import SceneClients, Who
from flexdt.clients.viewer.scenes.layers import Nodes


class OneFrame:
    """viser with a single client, which has what was built and what it alone was told."""

    def __init__(self) -> None:
        self.client_id, self.nodes = 1, dict[str, dict[str, Any]]()
        self._websock_connection = self.camera = self
        self.said, self.behind = 0, False

    def build(self, nodes: Nodes, names: Collection[str]) -> None:
        self.said += 1
        self.nodes |= {name: dict(nodes[name]) for name in names}

    def heard(self, client_id: int, said: int) -> bool:
        return not self.behind

    def queue_message(self, message: Any) -> None:
        told = getattr(message, "updates", None)
        self.nodes[message.name] |= {"visible": message.visible} if told is None else told

    def get_clients(self) -> dict[int, Any]:
        return {1: self}

    atomic = contextlib.nullcontext
    server = property(lambda self: self)

    def on_client_connect(self, call: Any) -> None: ...

    on_client_disconnect = on_client_connect


@pytest.mark.parametrize("seed", range(20))
def test_a_frame_shows_what_its_page_wants_whatever_is_built_anew(seed: int) -> None:
    """Choices, parts built anew and frames that lag, in any order."""
    rng, frame = np.random.default_rng(seed), OneFrame()
    clients = SceneClients(frame)  # type: ignore[arg-type]
    clients._who[1] = Who("page", "iso")
    names = [f"/n{k}" for k in range(6)]
    plain: Nodes = {n: {"visible": k > 1, "opacity": 0.5} for k, n in enumerate(names)}
    frame.build(plain, names)
    wanted = {n: dict(some) for n, some in plain.items()}
    for _ in range(200):
        match rng.integers(4):
            case 0:
                wanted[rng.choice(names)] = {
                    "visible": bool(rng.integers(2)), "opacity": float(rng.choice([0.5, 1.0])),
                }  # fmt: skip
            case 1:
                frame.build(plain, [n for n in names if rng.integers(2)])
            case 2:
                frame.behind = not frame.behind
        clients.show(
            "page", {n: dict(some) for n, some in wanted.items()}, plain, frame.said
        )
        if not frame.behind:
            assert frame.nodes == wanted


def of(page: Any) -> Any:
    return page.locator(".view[data-view=iso]")


STILL = "fetch(`/still.jpg?view=iso&w=300&h=200&page=${window.pageId}`)"
MANY_PX = 3000


def apart(now: Picture, before: Picture) -> int:
    """Pixels that differ beside the sample's own picture, which comes when it comes."""
    return changed(now[:, :450], before[:, :450])


def filled(now: Picture) -> bool:
    """Whether the scene shows something, beside the sample's own picture."""
    return drawn(now[:, :450])


@pytest.mark.browser
def test_what_is_shown_is_each_persons_own(open_page: Callable[..., Any]) -> None:
    """In the live scene and in the viewer's own picture; and the browser remembers it."""
    mine, other = (open_page("iso", (900, 600)) for _ in range(2))
    # Names come when their places are known: without them a picture changes by choice alone.
    for page in (mine, other):
        page.click("#tabs [data-tab=setup]")
        page.click("#layer-names")
    length = f"{STILL}.then((r) => r.arrayBuffer()).then((b) => b.byteLength)"
    before = [settled(of(page), filled) for page in (mine, other)]
    assert mine.evaluate(length) == other.evaluate(length)
    mine.click("#layer-machine")
    settled(of(mine), lambda now: apart(now, before[0]) > MANY_PX)
    assert apart(still(of(other)), before[1]) < MANY_PX / 20
    assert other.is_checked("#layer-machine")
    assert mine.evaluate(length) != other.evaluate(length)
    mine.reload()
    mine.wait_for_function("window.flexdt?.store.layers.machine === false")
    # The image comes when it comes, so the other page is what this one is compared with, from
    # the same place: a camera that still holds all stays where an earlier state put it.
    of(other).locator(".home").click()
    settled(of(mine), lambda now: apart(now, still(of(other))) > MANY_PX)
    mine.click("#layer-machine")
    settled(of(mine), lambda now: apart(now, still(of(other))) < MANY_PX / 20)
    for page in (mine, other):
        page.close()


def darker(now: Picture, before: Picture) -> int:
    """Pixels that have lost light of all colours."""
    return int((before - now > 10.0)[:, :450].all(axis=2).sum())


@pytest.mark.browser
@pytest.mark.campaign
def test_where_a_graphics_processor_draws_parts_cast_shadows(
    open_page: Callable[..., Any],
) -> None:
    """And the rest is lit from all around. Here, without one, the address asks for it."""
    plain, fine = (
        open_page("iso", (900, 600), light=light) for light in ("plain", "fine")
    )
    before = settled(of(plain), filled)
    # Shadows cover some 4000 pixels, more or less as cameras stand; two plain pages differ in 150.
    settled(of(fine), lambda now: min(darker(now, before), darker(before, now)) > 1000)
    for page in (plain, fine):
        page.close()
