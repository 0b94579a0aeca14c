"""What a page asks of its viewer, by name: layers, views, plans, exports. One function each.

It refuses to command the twin but for what it has to look at first, a mesh and a correction; other
requests go out as they are (see `page`).
"""

from __future__ import annotations

import asyncio
import math
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from flexdt.protocol import Code, RpcError
from flexdt.server.viewer import comparing, fitting, plans, uploads
from flexdt.server.viewer.front import Download
from flexdt.server.viewer.page import Page
from flexdt.server.viewer.recording import picture, replay_html, replay_viser, scene_html
from flexdt.twin.camera import Roi
from flexdt.twin.errors import TwinError
from flexdt.twin.parameters import UNITS
from flexdt.twin.script.compose import KINDS as KINDS_OF_SCAN
from flexdt.twin.script.compose import Wish, compose_script

if TYPE_CHECKING:
    from flexdt.server.viewer.app import Lab, Viewer

Params = Mapping[str, Any]
KINDS = ("line_integral", "counts")


async def layers(viewer: Viewer, page: Page, params: Params) -> object:
    """Switch what is drawn, for everybody: layer -> whether."""
    scene = _lab(viewer).scene
    for name, visible in params.items():
        if name == "opacity":
            scene.fade(min(1.0, max(0.05, float(visible))))
        elif name in scene.shown:
            scene.show(name, bool(visible))
        else:
            raise RpcError(Code.INVALID_PARAMS, f"no layer {name!r}", list(scene.shown))
    if viewer.state is not None:
        scene.draw_ranges(viewer.state)
        if viewer.world is not None:
            scene.update(viewer.state, viewer.world)
    for other in viewer.pages.values():
        other.say("layers", shown=scene.shown, opacity=scene.opacity)
    return {}


async def theme(viewer: Viewer, page: Page, params: Params) -> object:
    """Light or dark, for this page's scenes."""
    page.dark = bool(params.get("dark"))
    viewer.clients.theme(page.id, page.dark)
    return {}


async def camera(viewer: Viewer, page: Page, params: Params) -> object:
    """Put a view of this page back to its preset."""
    viewer.clients.reset(page.id, str(params.get("view", "free")))
    return {}


async def feed(viewer: Viewer, page: Page, params: Params) -> object:
    """Which images this page wants: line_integral or counts."""
    kind = params.get("kind")
    if kind not in KINDS:
        raise RpcError(Code.INVALID_PARAMS, f"no images of kind {kind!r}", list(KINDS))
    page.kind = str(kind)
    viewer.refresh_feeds()
    return {}


async def window(viewer: Viewer, page: Page, params: Params) -> object:
    """Window [low, high] of the panel in the scenes, for everybody; none: by itself."""
    low, high = params.get("low"), params.get("high")
    viewer.window = None if low is None or high is None or high <= low else (low, high)
    viewer.feeds["line_integral"].again()
    return {}


async def plan(viewer: Viewer, page: Page, params: Params) -> object:
    """Plan a script to scrub through; none: forget the plan and what this page shows of it."""
    lab, text = _lab(viewer), params.get("text", "")
    if text is None:
        page.plan = page.orbit = None
        clients = list(viewer.clients.of(page.id))
        lab.scene.unghost(clients)
        lab.scene.draw_orbit(clients, None)
        return {}
    planned = await asyncio.to_thread(
        plans.plan_text, str(text), lab.machine, lab.profile, viewer.state
    )
    page.plan = planned
    if viewer.state is not None:
        page.orbit = await asyncio.to_thread(
            plans.orbit, planned, lab.machine, lab.profile, viewer.state
        )
        lab.scene.draw_orbit(list(viewer.clients.of(page.id)), page.orbit)
    return await asyncio.to_thread(plans.document, planned)


async def script(viewer: Viewer, page: Page, params: Params) -> object:
    """The script of a scan that was run, as it was submitted."""
    if viewer.data is None:
        raise RpcError(Code.INVALID_PARAMS, "this viewer was started without --data")
    text = await asyncio.to_thread(plans.script_of, viewer.data, str(params.get("dataset", "")))
    return {"text": text}


async def mesh(viewer: Viewer, page: Page, params: Params) -> object:
    """A chunk of a mesh for the stage; the twin has it after the last."""
    content = page.gathering.take(params)
    if content is None:
        return {"complete": False}
    answer = await uploads.send(page.link.request, params, content)
    warnings = answer.get("warnings") if isinstance(answer, Mapping) else None
    return {"complete": True, "warnings": warnings or []}


async def compose(viewer: Viewer, page: Page, params: Params) -> object:
    """A script for a wish, in the geometry of the moment."""
    lab, state = _lab(viewer), viewer.state
    kind = params.get("kind", "fly")
    if kind not in KINDS_OF_SCAN:
        raise RpcError(Code.INVALID_PARAMS, f"no scans of kind {kind!r}", list(KINDS_OF_SCAN))
    wish = Wish(
        kind=kind,
        frames=_whole(params, "frames", 73),
        exposure_ms=float(params.get("exposure_ms", 100.0)),
    )
    if state is not None:
        wish = replace(
            wish,
            sod_mm=round(state.geometry.SOD_mm, 4),
            sdd_mm=round(state.geometry.SDD_mm, 4),
            mode=state.camera.mode,
            roi=Roi(*state.camera.roi),
            kV=state.tube.kV,
            power_W=state.tube.power_W,
        )
    return {"text": compose_script(wish, lab.machine, lab.profile)}


async def datasets(viewer: Viewer, page: Page, params: Params) -> object:
    """Data sets that can be calibrated from, newest first."""
    folder = viewer.data
    found = [] if folder is None else await asyncio.to_thread(fitting.datasets, folder)
    return {"available": folder is not None, "datasets": found}


async def calibrate(viewer: Viewer, page: Page, params: Params) -> object:
    """Fit the geometry from data sets; nothing is applied."""
    if viewer.data is None:
        raise RpcError(Code.INVALID_PARAMS, "this viewer was started without --data")
    names = [str(n) for n in params.get("datasets", [])]
    document, tracks = await fitting.calibrate(viewer.data, names, str(params.get("phantom", "")))
    page.tracks = tracks
    return {**document, "comparison": comparing.summary(tracks)}


async def correct(viewer: Viewer, page: Page, params: Params) -> object:
    """A correction for the twin; on the wire an empty one is a nominal one, here it is a slip."""
    given = params.get("parameters")
    if not isinstance(given, Mapping) or not given:
        raise RpcError(Code.INVALID_PARAMS, "a correction has parameters", list(UNITS))
    for name, value in given.items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if name not in UNITS or not number or not math.isfinite(value):
            message = f"{name}: {value!r} is no parameter with a number"
            raise RpcError(Code.INVALID_PARAMS, message, list(UNITS))
    return await page.link.request("calibration.apply", dict(params))


async def compared(viewer: Viewer, page: Page, params: Params) -> object:
    """A radiograph of this page's last fit, with its beads before and after."""
    if viewer.data is None or page.tracks is None:
        raise RpcError(Code.INVALID_PARAMS, "calibrate first: there is nothing to compare")
    which, frame = int(params.get("dataset", 0)), int(params.get("frame", 0))
    return await asyncio.to_thread(comparing.view, viewer.data, page.tracks, which, frame)


async def scrub(viewer: Viewer, page: Page, params: Params) -> object:
    """Draw, for this page, where the plan has the machine at `time_s`; none: no longer."""
    lab, time_s = _lab(viewer), params.get("time_s")
    if time_s is None:
        lab.scene.unghost(viewer.clients.of(page.id))
        return {"positions": None}
    if page.plan is None:
        raise RpcError(Code.INVALID_PARAMS, "plan a script first: there is nothing to scrub")
    positions = page.plan.positions(float(time_s))
    lab.scene.ghost(list(viewer.clients.of(page.id)), positions)
    return {"positions": positions}


async def screenshot(viewer: Viewer, page: Page, params: Params) -> object:
    """A picture of one of this page's views, as a download."""
    view = str(params.get("view", "free"))
    clients = list(viewer.clients.of(page.id, view))
    if not clients:
        raise RpcError(Code.INVALID_PARAMS, f"the view {view!r} is not open")
    width, height = (int(params.get(k, d)) for k, d in (("width", 1600), ("height", 1000)))
    content = await asyncio.to_thread(
        picture, clients[0], min(width, 4096), min(height, 4096), page.dark
    )
    return _offer(viewer, f"flexdt-{view}-{_stamp()}.png", content)


async def export(viewer: Viewer, page: Page, params: Params) -> object:
    """The scene, or a replay of this page's plan, as one file: html or viser."""
    lab, form = _lab(viewer), params.get("format", "html")
    if form not in ("html", "viser"):
        raise RpcError(Code.INVALID_PARAMS, f"no format {form!r}", ["html", "viser"])
    if params.get("replay"):
        if page.plan is None or viewer.state is None:
            raise RpcError(Code.INVALID_PARAMS, "plan a script first: there is nothing to replay")
        make = replay_html if form == "html" else replay_viser
        content = await asyncio.to_thread(
            make, lab.machine, lab.profile, viewer.state, viewer.look, page.plan, page.dark
        )
        return _offer(viewer, f"flexdt-replay-{_stamp()}.{form}", content)
    content = await asyncio.to_thread(scene_html, viewer.viser, page.dark, form == "viser")
    return _offer(viewer, f"flexdt-scene-{_stamp()}.{form}", content)


def _lab(viewer: Viewer) -> Lab:
    if viewer.lab is None:
        raise RpcError(Code.INTERNAL, "the twin has not been seen yet")
    return viewer.lab


def _whole(params: Params, name: str, default: int) -> int:
    value = params.get(name, default)
    if value != int(value):
        raise RpcError(Code.INVALID_PARAMS, f"{name}: {value} is no whole number")
    return int(value)


def _offer(viewer: Viewer, name: str, content: bytes) -> dict[str, object]:
    key = secrets.token_hex(16)
    while len(viewer.downloads) >= 16:
        del viewer.downloads[next(iter(viewer.downloads))]
    viewer.downloads[key] = Download(name, content)
    return {"url": f"/download/{key}", "name": name, "bytes": len(content)}


def _stamp() -> str:
    return time.strftime("%Y%m%d-%H%M%S")


Method = Callable[["Viewer", Page, Params], Awaitable[object]]


def _told(method: Method) -> Method:
    """The twin's own errors, as the wire would tell them."""

    async def call(viewer: Viewer, page: Page, params: Params) -> object:
        try:
            return await method(viewer, page, params)
        except TwinError as error:
            raise RpcError(Code.SCRIPT_INVALID, str(error), getattr(error, "data", None)) from None

    return call


METHODS: Mapping[str, Method] = {
    "calibration.apply": _told(correct),
} | {
    f"viewer.{name}": _told(function)
    for name, function in {
        "layers": layers,
        "theme": theme,
        "camera": camera,
        "feed": feed,
        "window": window,
        "plan": plan,
        "script": script,
        "mesh": mesh,
        "compose": compose,
        "datasets": datasets,
        "calibrate": calibrate,
        "compared": compared,
        "scrub": scrub,
        "screenshot": screenshot,
        "export": export,
    }.items()
}
"""Method -> what answers it."""
