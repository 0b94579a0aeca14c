"""Methods that a page calls on its viewer: layers, views, plans, exports. One function each.

Of the twin's commands only a correction passes through here, because it is inspected first;
other requests go to the twin as they are (see `page`).

Parameters are one model each, as strict and bounded as the wire's. Values that depend on the
machine, the data directory or a plan are checked in the methods.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import secrets
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Ge, Le, Len
from pydantic import Field, create_model, model_validator

from flexdt.clients.client.client import AsyncTwinClient
from flexdt.clients.client.flows import Ask
from flexdt.clients.viewer import exports
from flexdt.clients.viewer import scrubbed_plan as plans
from flexdt.clients.viewer.exports import Form
from flexdt.clients.viewer.front import Download
from flexdt.clients.viewer.page import Page, person_name, without_bytes
from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.layers import LAYERS
from flexdt.clients.viewer.scenes.stage_volume import MadeOf
from flexdt.clients.viewer.scenes.views import FREE
from flexdt.clients.viewer.scenes.world import motors
from flexdt.clients.viewer.shown_images import ShownImage, grey, packed, window_of
from flexdt.clients.viewer.viewer import PageMethod, Viewer
from flexdt.clients.viewer.volumes.reconstruction_process import wish
from flexdt.phantoms import is_shipped, load_phantom
from flexdt.protocol import Code, Method, RpcError, parse_params
from flexdt.protocol import image as wire_image
from flexdt.protocol.field_checks import few
from flexdt.protocol.fields import (
    AxisName,
    Deviation,
    Exposure,
    Nothing,
    Params,
    PixelAsked,
    Power,
    ShortText,
    Voltage,
)
from flexdt.protocol.methods.calibration_messages import (
    CalibrationAlign,
    CalibrationApply,
    CalibrationFit,
)
from flexdt.protocol.methods.job_messages import ScriptText
from flexdt.protocol.rpc_errors import busy, link_down
from flexdt.protocol.state_model import State
from flexdt.runtime.wire_errors import explain
from flexdt.twin.dataset.file_names import plain_name
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.physics.tube import tube_of, tube_spectrum
from flexdt.twin.scanner.state import readout_of
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.motor_targets import MotorTargets
from flexdt.twin.script.scan_request import Kind as KindOfScan
from flexdt.twin.script.scan_request import ScanRequest

DISTANCE_DIGITS: Final = 6
"""Decimals of the distances of a composed script [mm]."""
MIN_DIFFERENCE: Final = 0.01
"""Least difference of two positions that are not the same [mm, deg]."""
MAX_COVERED: Final = 16
"""Largest number of boxes over a view."""
MAX_SHARED: Final = 2
"""Largest number of pictures and exports at a time, for all pages: each may take
hundreds of megabytes."""
Kind = Literal["line_integral", "counts"]
View = Literal["iso", "beam", "side", "free"]
Grey = Annotated[float, Ge(-1e6), Le(1e6)]
Side = Annotated[int, Ge(16), Le(4096)]
FileName = Annotated[ShortText, Len(1, 255)]
Index = Annotated[int, Ge(0), Le(10**6)]


def layers_model() -> type[Params]:
    """Make the parameters of `viewer.layers`: layers to show or hide; omitted ones stay."""
    switches: Any = {layer.name: (bool | None, None) for layer in LAYERS}
    opacity: Any = (Annotated[float, Ge(0.05), Le(1)] | None, None)
    return create_model("Layers", __base__=Params, **switches, opacity=opacity)


class Person(Params):
    """The name of the page's user, for the others."""

    name: ShortText = ""


class Theme(Params):
    """Light or dark, and whether a graphics processor can afford `fine` lighting."""

    dark: bool = False
    fine: bool = False


class Camera(Params):
    """A view of the page, and whether to look at the sample from there."""

    view: View = "free"
    sample: bool = False


Px = Annotated[float, Ge(-1e5), Le(1e5)]


Box = Annotated[tuple[Px, Px, Px, Px], Field(strict=False)]


class Covered(Params):
    """Boxes that the page lays over a view: left, top, right, bottom [px, from its upper left]."""

    view: View
    boxes: Annotated[list[Box], Len(0, MAX_COVERED)]


class Preset(Params):
    """A view and its pane's width over its height."""

    view: View = "free"
    aspect: Annotated[float, Ge(0.05), Le(20)] = 1.0


class Ray(Params):
    """A pixel of the live image to see the ray of; none: show it no longer."""

    pixel: PixelAsked | None = None


class Spectrum(Params):
    """A voltage of the tube."""

    kV: Annotated[float, Ge(0), Le(1000)]


class Feed(Params):
    """Which images a page wants."""

    kind: Kind


class Window(Params):
    """Grey values that are drawn black and white; both or none."""

    low: Grey | None = None
    high: Grey | None = None

    @model_validator(mode="after")
    def _both(self) -> Window:
        """Check that both ends or none are given, the lower first.

        Returns the window itself; equal ends are wrong, too.
        Raises ValueError: they are not.
        """
        if (self.low is None) != (self.high is None):
            raise ValueError("give both low and high, or neither")
        if self.low is not None and self.high is not None and self.high <= self.low:
            raise ValueError("high must be above low")
        return self


class Plan(Params):
    """A script; none: forget the last one."""

    text: ScriptText | None = ""


class Recorded(Params):
    """A data set to show instead of live images; none: live images again."""

    name: FileName | None = None


class RecordedImage(Params):
    """An image of the data set that is looked at, and with it the virtual one of its pose."""

    index: Annotated[int, Ge(0), Le(10**7)]
    kind: Kind = "counts"
    virtual: bool = False


class Thumbnail(Params):
    """A saved image of a data set, and its size as a thumbnail [px]."""

    name: FileName
    index: Annotated[int, Ge(0), Le(10**7)]
    side: Annotated[int, Ge(16), Le(256)] = 124


class Live(Params):
    """A data set to reconstruct while it is scanned, and voxels a side; none: no longer."""

    name: FileName | None = None
    side: Literal[128, 192, 256, 512] = 128
    past: bool = False
    """Request the complete volume of a finished scan, not a growing one."""


class Ghost(Params):
    """Whether a volume that does not fit the stage is shown there as a ghost."""

    shown: bool


class Block(Live):
    """Kind of volume: the reconstructed one, its noise, a bound of its bias, its
    sample's truth, their difference, or the one with the other geometry."""

    what: Literal["volume", "sigma", "bias_bound", "truth", "difference", "other"] = (
        "volume"
    )


class Voxel(Live):
    """A voxel of a volume, by its numbers along x, y and z."""

    at: Annotated[list[Index], Len(3, 3)]


class Compose(Params):
    """The scan to compose a script for."""

    kind: KindOfScan = "fly"
    frames: Annotated[int, Ge(1), Le(1_000_000)]
    exposure_ms: Exposure = 100.0
    kV: Voltage | None = None
    power_W: Power | None = None
    voxel_um: Annotated[float, Ge(0.01), Le(1e6)] | None = None
    """Size of the finest details at the axis [um]; None keeps the distances."""
    keep: Annotated[list[AxisName], Len(0, 64)] = Field(default_factory=list)


class Datasets(Params):
    """Data sets to list: words that each has, and how many newer ones are left out."""

    search: Annotated[ShortText, Len(0, 200)] = ""
    start: Index = 0


class Correct(CalibrationApply):
    """A correction; on the wire an empty one is a nominal one, on a page it is a slip."""

    parameters: Annotated[dict[AxisName, Deviation], few(64), Len(1, 64)]


class Scrub(Params):
    """A moment of the plan; none: show it no longer."""

    time_s: Annotated[float, Ge(0), Le(1e9)] | None = None


class Screenshot(Params):
    """Which view, and how large the picture [px]."""

    view: View = "free"
    width: Side = 1600
    height: Side = 1000


class Export(Params):
    """The scene, or a replay of the plan."""

    format: Form = "html"
    replay: bool = False


async def layers(viewer: Viewer, page: Page, params: Params) -> object:
    """Show or hide the layers named in `params` on this page alone, and report them to
    it; returns {}.

    The ranges are drawn now if they are shown. Layers that are None stay, and an opacity
    of None.
    """
    page.shown = page.shown.changed(**params.model_dump())
    if viewer.lab is not None and viewer.state is not None and "ranges" in page.shown:
        viewer.lab.draw_ranges(viewer.state)
    viewer.show_layers()
    page.say("layers", **page.shown.told)
    return {}


async def person(viewer: Viewer, page: Page, params: Person) -> object:
    """Give the page's user another name, over the open connections; control stays; returns {}."""
    await page.link.rename(person_name(params.name))
    return {}


async def theme(viewer: Viewer, page: Page, params: Theme) -> object:
    """Set light or dark, plain or fine, for this page's scenes, also for later ones;
    returns {}.

    If no page is fine, states are drawn less often."""
    page.dark = params.dark
    page.fine = params.fine
    viewer.clients.theme(page.id, page.dark, params.fine)
    return {}


async def camera(viewer: Viewer, page: Page, params: Camera) -> object:
    """Set a view of this page back to its preset, or, with `sample`, have it look at the
    sample (preset while no state is known); returns {}.

    Only clients of this view of this page are moved; without one nothing happens.
    """
    if params.sample and viewer.world is not None:
        viewer.clients.look(
            page.id, params.view, viewer.world.sample.shift, viewer.look.radius_mm
        )
    else:
        viewer.clients.reset(page.id, params.view)
    return {}


async def covered(viewer: Viewer, page: Page, params: Covered) -> object:
    """Note what lies over a view of this page, where no name is put; returns {}."""
    page.covered[params.view] = np.array(params.boxes).reshape(-1, 4)
    return {}


async def preset(viewer: Viewer, page: Page, params: Preset) -> object:
    """Return the first camera of a view in a pane of this page; empty where it is not
    known.

    The fields are those of `Standpoint`. The beam's eye and unknown views have none."""
    fitted = viewer.clients.cameras.get(params.view)
    if fitted is None:
        return {}
    return asdict(fitted.at(params.aspect))


async def feed(viewer: Viewer, page: Page, params: Feed) -> object:
    """Set the page's kind of images: line_integral or counts."""
    page.kind = params.kind
    viewer.refresh_feeds()
    return {}


async def window(viewer: Viewer, page: Page, params: Window) -> object:
    """Set the window [low, high] of the panel for all pages and draw the newest image
    again; either None chooses it automatically. Returns {}.

    Pages' own windows are not changed.
    """
    low = params.low
    high = params.high
    if low is None or high is None:
        viewer.window = None
    else:
        viewer.window = (low, high)
    viewer.feeds["line_integral"].again()
    return {}


async def ray(viewer: Viewer, page: Page, params: Ray) -> object:
    """Show this page the ray of a pixel, and return the materials on it.

    Without a pixel, or before the twin's state is known, the ray is hidden.

    `viewer` and `page`: of the request; `params`: `pixel` (column, row) or None.
    Returns the twin's path lengths through materials, and `length_mm` of the ray from source to
    pixel; {} if it is hidden.
    Raises RpcError: the twin refuses, or there is no scene yet.
    """
    lab = _lab(viewer)
    world = viewer.world
    clients = viewer.clients.of(page.id)
    if params.pixel is None or world is None:
        lab.plan.ray(clients, None)
        return {}
    told: Any = await page.link.request("projection.ray", {"pixel": list(params.pixel)})
    ends = np.array([world.source, world.pixel(*params.pixel)])
    lab.plan.ray(clients, ends)
    return {**told, "length_mm": float(np.linalg.norm(ends[1] - ends[0]))}


async def spectrum(viewer: Viewer, page: Page, params: Spectrum) -> object:
    """Compute the tube's spectrum behind the machine's filters at a voltage.

    Args:
        viewer, page: of the request.
        params: `kV`, the voltage.

    Returns:
        `energy_keV` and relative `photons` behind the filters, one for each energy,
        `mean_keV`, `filters`, and `limits` of voltage [kV], power [W] and exposure [ms].

    Raises:
        RpcError: the twin has not been seen yet.
    """
    machine = _lab(viewer).machine
    tube = tube_of(machine.tube)
    lit = machine.tube
    panel = machine.detector
    behind = tube_spectrum(params.kV, tube)
    layers = [
        {"material": f.substance.name, "thickness_mm": f.thickness_mm}
        for f in tube.filters
    ]
    return {
        "energy_keV": behind.energy_keV.tolist(),
        "photons": behind.fluence.tolist(),
        "mean_keV": behind.mean_keV,
        "filters": layers,
        "limits": {
            "kV": [lit.min_kV, lit.max_kV],
            "power_W": [0.0, lit.max_W],
            "exposure_ms": [panel.min_exposure_ms, panel.max_exposure_ms],
        },
    }


async def plan(viewer: Viewer, page: Page, params: Plan) -> object:
    """Plan a script to scrub through, from the twin's present positions, and draw its
    path.

    Without a known state the path drawn before stays.

    Args:
        viewer, page: of the request.
        params: `text` of the script; None removes plan and drawing from this page.

    Returns:
        The time line, see `scrubbed_plan.document`; {} after removing.

    Raises:
        RpcError: a data set is open on this page, there is no scene yet, or the script
            cannot be planned.
    """
    lab = _lab(viewer)
    text = params.text
    if page.recorded is not None:
        raise RpcError(Code.BUSY, "a data set is open: close it to scrub a plan")
    if text is None:
        page.plan = page.orbit = None
        clients = viewer.clients.of(page.id)
        lab.plan.unghost(clients)
        lab.plan.orbit(clients, None)
        return {}
    made = await plans.make(viewer.planners, text, lab.machine, lab.profile, viewer.state)
    page.plan = made.plan
    if made.path is not None:
        page.orbit = made.path
        lab.plan.orbit(viewer.clients.of(page.id), page.orbit)
    return made.document


async def recorded(viewer: Viewer, page: Page, params: Recorded) -> object:
    """Show this page the images of a data set instead of live ones; without a name live
    ones again.

    Plan and path of the page are replaced by the data set's positions, and the path of
    its projections, if it is of this machine, else removed.

    Args:
        viewer, page: of the request.
        params: `name` of the data set, or None.

    Returns:
        The result of `dataset.get`; {} without a name.

    Raises:
        RpcError: the twin refuses, such as an unknown data set; nothing changes then.
    """
    lab = _lab(viewer)
    name = params.name
    clients = viewer.clients.of(page.id)
    told: Any = None
    if name is not None:
        told = await page.link.request("dataset.get", {"name": name, "points": 1000})
    page.recorded = name
    page.saturated = None if name is None else told["info"]["saturated"]
    page.made = None if name is None else MadeOf.of(told["made"])
    viewer.show_volumes()
    viewer.show_layers()
    page.plan = page.orbit = None
    lab.plan.unghost(clients)
    if name is None:
        for feed in viewer.feeds.values():
            feed.again()
    elif told["same_machine"] and viewer.state is not None:
        page.plan = plans.RecordedPositions.of(told)
        taken = np.array(told["kinds"], dtype=str) == "projection"
        at = {n: np.array(v, dtype=float)[taken] for n, v in told["positions"].items()}
        page.orbit = plans.source_path(at, lab.machine, lab.profile, viewer.state)
    lab.plan.orbit(clients, page.orbit)
    return told or {}


async def recorded_image(viewer: Viewer, page: Page, params: RecordedImage) -> object:
    """Show this page an image of its data set, and in its scenes the machine at that
    moment.

    A virtual image is made only of a projection with known positions; without a usable
    one, also one of another size, `problem` states why and the recorded one is shown
    alone. The ghost is moved only if the page has a plan.

    Args:
        viewer, page: of the request.
        params: index and kind of the image, and whether a virtual one is wanted.

    Returns:
        The image's entries, `geometry`, `tube` and `problem` of the virtual image.

    Raises:
        RpcError: no data set is open, another one was opened meanwhile, or the twin
            refuses.
    """
    lab = _lab(viewer)
    name = page.recorded
    if name is None:
        raise RpcError(
            Code.INVALID_PARAMS, "open a data set first: there is nothing to show"
        )
    asked = {"name": name, "index": params.index, "kind": params.kind}
    told: Any = await page.link.request("dataset.frame", asked)
    names = ("name", "index", "file", "image", "projection", "time_s", "positions")
    about = {key: told[key] for key in names}
    about["problem"] = ""
    about["saturated"] = page.saturated
    pixels = wire_image.decode(told)
    virtual = None
    if params.virtual and told["image"] == "projection" and told["positions"]:
        try:
            virtual, about["virtual_origin"] = await _virtual(page, told)
        except RpcError as error:
            about["problem"] = error.message
    if page.recorded != name:
        raise RpcError(Code.SUPERSEDED, "another data set was opened meanwhile")
    if virtual is not None and virtual.shape != pixels.shape:
        about["problem"] = (
            f"the virtual image has {virtual.shape} pixels, not {pixels.shape}"
        )
        virtual = None
    cone = tuple(told["cone_vec"] or ())
    about["geometry"] = _readout(cone, pixels.shape)
    about["tube"] = told["tube"]
    shot = ShownImage(
        pixels, told["kind"], cone, told["time_s"] or 0.0, params.index, virtual=virtual
    )
    content = await asyncio.to_thread(
        packed, shot, coarse=False, beads=(), facts={"at": time.time(), "recorded": about}
    )
    if page.recorded == name:
        page.show("image", content)
    clients = viewer.clients.of(page.id)
    if page.plan is not None and about["positions"]:
        lab.plan.ghost(clients, about["positions"])
    return about


def _readout(
    cone: Sequence[float], shape: tuple[int, ...]
) -> Mapping[str, object] | None:
    """Compute distances and sizes of a recorded image's nominal geometry; None: it is
    not known.

    None as well where no distances can be computed from it. The axis is taken through the
    object frame's origin.
    """
    if not cone:
        return None
    view = ConeVec(np.array([cone]))
    pitch = float(np.linalg.norm(view.u[0])), float(np.linalg.norm(view.v[0]))
    found = readout_of(view, (shape[0], shape[1]), pitch, np.zeros(3))
    return None if found is None else vars(found)


async def _virtual(page: Page, told: Mapping[str, Any]) -> tuple[Any, Any]:
    """Predict the virtual image at a recorded one's pose and exposure.

    Tube and camera settings that were not recorded are the present ones. `page`: whose
    connection asks the twin; `told`: the recorded image's entries. Returns pixels, and origin or
    None. Raises RpcError: the twin refuses."""
    asked = {name: told[name] for name in ("kind", "positions")}
    for what in ("tube", "camera"):  # unknown settings are the present ones
        asked[what] = {k: v for k, v in told[what].items() if v is not None}
    answer: Any = await page.link.request("projection.get", asked)
    return wire_image.decode(answer), answer.get("origin")


async def thumbnail(viewer: Viewer, page: Page, params: Thumbnail) -> object:
    """Read a saved image of a data set, also of a running scan, as a small picture.

    Returns:
        `name`, `index` and `file` of the image, and `image`: its shape, at most about
        `side` columns, and its counts as 8-bit gray between their percentiles, in base64.

    Raises:
        RpcError: the twin refuses, such as an image that is not there yet.
    """
    columns = 1024 if viewer.state is None else viewer.state.camera.shape[1]
    asked = {
        "name": params.name,
        "index": params.index,
        "binning": min(64, max(1, -(-columns // params.side))),
    }
    told: Any = await page.link.request("dataset.frame", asked)
    small = ShownImage(wire_image.decode(told), "counts", (), 0.0, params.index)
    pixels = await asyncio.to_thread(lambda: grey(small, window_of(small))[:, :, 0])
    data = base64.b64encode(pixels.tobytes()).decode("ascii")
    image = {"shape": list(pixels.shape), "data": data}
    return {"image": image, **{key: told[key] for key in ("name", "index", "file")}}


async def live(viewer: Viewer, page: Page, params: Live) -> object:
    """Start to grow a volume of a data set from its images so far, for all pages that want one;
    without a name, end that for this page. Returns {}.

    If the same volume is growing already, its newest line is sent again.

    Args:
        viewer, page: of the request.
        params: `name` of the data set or None, `side` of the volume, and `past`, which
            requests the complete one.

    Raises RpcError: there is no such data set (links do not count), or the viewer has no --data.
    """
    page.live = page.volume = None
    page.ghost = False
    if params.name is None:
        viewer.show_volumes()
        viewer.ungrow()
        return {}
    folder = _data(viewer) / plain_name(params.name, "data set")
    if folder.is_symlink() or not folder.is_dir():
        raise RpcError(Code.INVALID_PARAMS, f"no data set {params.name!r}")
    page.live = (folder.name, params.past)
    viewer.show_volumes()
    viewer.grower.grow(folder, params.side, params.past)
    return {}


async def ghost(viewer: Viewer, page: Page, params: Ghost) -> object:
    """Show this page's volume as a ghost where it is not of what stands on the stage, or
    no longer; returns {}.
    """
    page.ghost = params.shown
    viewer.show_volumes()
    return {}


async def _of_volume(viewer: Viewer, params: Live, *words: str) -> tuple[Any, bytes]:
    """Send a request to the volume's process.

    `viewer`: the viewer; `params`: name the volume; `*words`: of the request. Returns a head and
    bytes; ({}, b"") where the process has another volume by now, or none. Raises RpcError: the
    viewer has no --data; DatasetNameError: the data set's name is not a plain one."""
    folder = _data(viewer) / plain_name(params.name or "", "data set")
    return await viewer.grower.ask(wish(folder, params.side, params.past), *words) or (
        {},
        b"",
    )


async def volume_block(viewer: Viewer, page: Page, params: Block) -> object:
    """Offer a part of a reconstructed volume to a page.

    A part offered before that was not fetched is dropped. `params`: name the volume, and
    the part: `what`. Returns its head, and url, name and size of the codes to download;
    {} while there is none. Raises RpcError: the viewer has no --data.
    """
    head, codes = await _of_volume(viewer, params, "block", params.what)
    if not codes:
        return {}
    viewer.downloads.pop(page.block, None)  # one that was not fetched is outdated
    offered = _offer(viewer, f"{params.what}.bin", codes)
    page.block = str(offered["url"]).rpartition("/")[2]
    return {**head, **offered}


async def voxel(viewer: Viewer, page: Page, params: Voxel) -> object:
    """Read a voxel's exact values by names of volumes; None where no data cover."""
    return (await _of_volume(viewer, params, "voxel", *map(str, params.at)))[0]


async def volume_compare(viewer: Viewer, page: Page, params: Live) -> object:
    """Start comparing the volume with the truth of its sample, with the correction in
    use; the volume's document brings the figures later.

    Without a correction only the volume itself is compared. Returns {}.
    """
    if viewer.state is None:
        correction = None
    else:
        correction = viewer.state.correction
    if correction is None:
        now = None
    else:
        now = correction.model_dump(include={"name", "parameters", "sides_known"})
    return (await _of_volume(viewer, params, "compare", json.dumps(now)))[0]


async def compose(viewer: Viewer, page: Page, params: Compose) -> object:
    """Compose a script for the requested scan, from the present positions.

    Distances are those of the motors alone: a script moves motors, and the correction in force,
    in which SOD and SDD are a little different, may not lead beyond their travel.

    `viewer` and `page`: of the request. `params`: the scan; axes in `keep` stay where they are.
    Returns `text`, and `moved`: axis -> its present position and the script's, without axes in
    `keep`; empty without a known state.
    Raises RpcError: there is no scene yet; TwinError: the machine cannot make that scan.
    """
    lab = _lab(viewer)
    state = viewer.state
    request = scan_request(params, lab.machine, lab.profile, state)
    text = compose_script(request, lab.machine, lab.profile)
    if state is None:
        return {"text": text, "moved": {}}
    moved = await asyncio.to_thread(_moved, text, lab, state)
    for axis in set(params.keep) & set(moved):
        now, then = (f"{axis}\tmove absolute\t{value:.6f}\t" for value in moved.pop(axis))
        text = text.replace(then, now)
    return {"text": text, "moved": moved}


def scan_request(
    params: Compose, machine: Machine, profile: Profile, state: State | None
) -> ScanRequest:
    """Make the request of a scan: as wished, and for the rest from the twin's state.

    Distances [mm] are rounded; a wished voxel [um] sets the SOD. A voltage or power that
    is None is the present one; mode and region are the present ones.

    Args:
        params: the wish.
        machine, profile: the twin's.
        state: of the twin; None leaves all else to the machine.
    """
    request = ScanRequest(
        kind=params.kind, frames=params.frames, exposure_ms=params.exposure_ms
    )
    if state is None:
        return request
    places = MotorTargets(machine, profile)
    stand = motors(machine, state)
    sod, sdd = (places.value(name, stand) for name in ("object_y", "detector_y"))
    if params.voxel_um is not None:
        sod = params.voxel_um / 1000.0 / state.camera.pixel_mm * sdd
    return replace(
        request,
        sod_mm=round(sod, DISTANCE_DIGITS),
        sdd_mm=round(sdd, DISTANCE_DIGITS),
        mode=state.camera.mode,
        roi=Roi(*state.camera.roi),
        kV=state.tube.kV if params.kV is None else params.kV,
        power_W=state.tube.power_W if params.power_W is None else params.power_W,
    )


def _moved(text: str, lab: LabScene, state: State) -> dict[str, tuple[float, float]]:
    """Compare a script's poses with the present ones; blocks.

    Same is within `MIN_DIFFERENCE` [mm, deg]. Axes that the script moves between
    projections are left out, and all for a script without projections.

    Returns:
        Axis -> (present position, that of the script's projections), for axes whose
        projections are neither there nor at home.
    """
    plan = plans.plan_text(text, lab.machine, lab.profile, state)
    stands = motors(lab.machine, state)
    found = {}
    for axis, there in plans.projection_positions(plan).items():
        if not len(there) or np.ptp(there) > MIN_DIFFERENCE:
            continue
        others = (float(there[0]), lab.machine.axes[axis].home)
        if min(abs(at - stands[axis]) for at in others) > MIN_DIFFERENCE:
            found[axis] = (stands[axis], round(float(there[0]), 6))
    return found


async def datasets(viewer: Viewer, page: Page, params: Datasets) -> object:
    """List data sets, newest first, from `start` on and matching `search`, with
    thumbnails in base64, and whether the sample has beads; the twin's answer.

    A thumbnail is at most 96 pixels a side; None stays None. `beads` is None of samples that do
    not ship.
    """
    asked = {"search": params.search, "start": params.start, "thumbnail": 96}
    told: Any = await page.link.request("dataset.list", asked)
    for info in told["datasets"]:
        if (small := info["thumbnail"]) is not None:
            small["data"] = base64.b64encode(small["data"]).decode("ascii")
        info["beads"] = await asyncio.to_thread(_has_beads, info["sample"] or "")
    return told


@lru_cache(maxsize=256)
def _has_beads(sample: str) -> bool | None:
    return len(load_phantom(sample).beads) > 0 if is_shipped(sample) else None


async def estimate(
    viewer: Viewer, page: Page, params: CalibrationFit | CalibrationAlign
) -> object:
    """Fit a geometry to data sets; nothing is applied.

    It has a connection of its own and no time limit: other requests of the page do not
    wait for it. Bytes in the result become None.

    Raises:
        RpcError: the twin refuses.
    """
    at = viewer.twin_address
    if isinstance(params, CalibrationFit):
        name = "fit"
    else:
        name = "align"
    asked = Ask(f"calibration.{name}", params.model_dump(exclude_none=True), None)
    async with AsyncTwinClient(
        at.host, at.port, at.token, name=f"flexdt viewer ({name})", ssl=at.ssl
    ) as client:
        return without_bytes(await client.core.call(asked))


async def correct(viewer: Viewer, page: Page, params: Correct) -> object:
    """Send a correction to the twin."""
    return await page.link.request(
        "calibration.apply", params.model_dump(exclude_none=True)
    )


async def scrub(viewer: Viewer, page: Page, params: Scrub) -> object:
    """Draw, for this page alone, a ghost of the machine where the plan has it at `time_s`.

    Times beyond the plan's ends give its first or last positions.

    Args:
        viewer, page: of the request.
        params: `time_s`; None removes the ghost.

    Returns `positions` of the plan; None after removing.
    Raises RpcError: the page has no plan, or there is no scene yet.
    """
    lab = _lab(viewer)
    time_s = params.time_s
    if time_s is None:
        lab.plan.unghost(viewer.clients.of(page.id))
        return {"positions": None}
    if page.plan is None:
        raise RpcError(
            Code.INVALID_PARAMS, "plan a script first: there is nothing to scrub"
        )
    positions = plans.positions_at(page.plan, time_s)
    lab.plan.ghost(viewer.clients.of(page.id), positions)
    return {"positions": positions}


async def screenshot(viewer: Viewer, page: Page, params: Screenshot) -> object:
    """Take a picture of one of this page's views, drawn by its first client, and offer
    the PNG to download.

    Raises:
        RpcError: that view is not open, or `MAX_SHARED` pictures or exports are under
            way.
    """
    clients = viewer.clients.of(page.id, params.view)
    if not clients:
        raise RpcError(Code.INVALID_PARAMS, f"the view {params.view!r} is not open")
    with _room(viewer):
        content = await asyncio.to_thread(
            exports.picture, clients[0], params.width, params.height, page.dark
        )
    return _offer(viewer, f"flexdt-{params.view}-{_stamp()}.png", content)


async def export(viewer: Viewer, page: Page, params: Export) -> object:
    """Export the scene, or a replay of this page's plan, as one file: html or viser.

    The scene is seen as in the page's free view, else in any of its views, else from the
    preset. It is made in a thread; the file's name has the time.

    Returns:
        The download's `url` and name.

    Raises:
        RpcError: there is no plan or no state to replay, no scene yet, or `MAX_SHARED`
            pictures or exports are under way.
    """
    lab = _lab(viewer)
    form = params.format
    if not params.replay:
        seen = next(
            iter(viewer.clients.of(page.id, "free") or viewer.clients.of(page.id)), None
        )
        if seen is None:
            camera = FREE
        else:
            camera = exports.standpoint(seen)
        make = partial(
            exports.scene_file,
            viewer.viser,
            camera,
            lab.nodes(viewer.shown_by(page), viewer.near),
            exports.title_of(viewer.state, "scene"),
            exports.beside(viewer.state, viewer.feeds["line_integral"].newest),
        )
    elif page.plan is None or viewer.state is None:
        raise RpcError(
            Code.INVALID_PARAMS, "plan a script first: there is nothing to replay"
        )
    else:
        make = partial(
            exports.replay_file,
            lab.machine,
            lab.profile,
            viewer.state,
            viewer.look,
            page.plan,
            viewer.looks,
            exports.title_of(viewer.state, "replay"),
        )
    with _room(viewer):
        content = await asyncio.to_thread(make, form, page.dark)
    what = "replay" if params.replay else "scene"
    return _offer(viewer, f"flexdt-{what}-{_stamp()}.{form}", content)


@contextlib.contextmanager
def _room(viewer: Viewer) -> Iterator[None]:
    """Count an export while it is made.

    At most `MAX_SHARED` at a time; the count is taken back in any case.

    Raises:
        RpcError: too many are being made.
    """
    if viewer.sharing >= MAX_SHARED:
        raise busy(
            f"{MAX_SHARED} pictures or exports are being made; try again when they are done"
        )
    viewer.sharing += 1
    try:
        yield
    finally:
        viewer.sharing -= 1


def _lab(viewer: Viewer) -> LabScene:
    if viewer.lab is None:
        raise link_down("the twin has not been seen yet")
    return viewer.lab


def _data(viewer: Viewer) -> Path:
    if viewer.data is None:
        raise RpcError(Code.INVALID_PARAMS, "this viewer was started without --data")
    return viewer.data


def _offer(viewer: Viewer, name: str, content: bytes) -> dict[str, object]:
    """Keep a file in memory for download, at most 16 of them (the oldest is dropped);
    returns its url, name and bytes.

    The url has a random key; it is not written to a disk.
    """
    key = secrets.token_hex(16)
    while len(viewer.downloads) >= 16:
        del viewer.downloads[next(iter(viewer.downloads))]
    viewer.downloads[key] = Download(name, content)
    return {"url": f"download/{key}", "name": name, "bytes": len(content)}


def _stamp() -> str:
    return time.strftime("%Y%m%d-%H%M%S")


Answer = Callable[["Viewer", Page, Any], Awaitable[object]]

METHODS: Mapping[str, tuple[type[Params], Answer]] = {
    "calibration.apply": (Correct, correct),
    "calibration.fit": (CalibrationFit, estimate),
    "calibration.align": (CalibrationAlign, estimate),
    "viewer.layers": (layers_model(), layers),
    "viewer.person": (Person, person),
    "viewer.theme": (Theme, theme),
    "viewer.camera": (Camera, camera),
    "viewer.covered": (Covered, covered),
    "viewer.preset": (Preset, preset),
    "viewer.feed": (Feed, feed),
    "viewer.window": (Window, window),
    "viewer.ray": (Ray, ray),
    "viewer.spectrum": (Spectrum, spectrum),
    "viewer.plan": (Plan, plan),
    "viewer.recorded": (Recorded, recorded),
    "viewer.recorded_image": (RecordedImage, recorded_image),
    "viewer.thumbnail": (Thumbnail, thumbnail),
    "viewer.live": (Live, live),
    "viewer.ghost": (Ghost, ghost),
    "viewer.block": (Block, volume_block),
    "viewer.voxel": (Voxel, voxel),
    "viewer.compare": (Live, volume_compare),
    "viewer.compose": (Compose, compose),
    "viewer.datasets": (Datasets, datasets),
    "viewer.scrub": (Scrub, scrub),
    "viewer.screenshot": (Screenshot, screenshot),
    "viewer.export": (Export, export),
}
"""Method -> its parameters, and its function."""


async def serve(
    name: str, viewer: Viewer, page: Page, given: Mapping[str, Any]
) -> object:
    """Answer one request of a page: check its parameters and call the method.

    `name`: of METHODS; `viewer`: the viewer; `page`: that calls; `given`: parameters.
    Returns the method's result.
    Raises RpcError: -32602 with every problem of the parameters, or the method's refusal; its
    TwinErrors are converted.
    """
    model, answer = METHODS[name]
    try:
        return await answer(
            viewer, page, parse_params(Method(name, model, Nothing, name), given)
        )
    except TwinError as error:
        raise explain(error) from None


ANSWERS: Mapping[str, PageMethod] = {name: partial(serve, name) for name in METHODS}
"""Methods of a viewer for its pages."""
