"""The viewer as one asyncio program: the twin's states in, scenes and pages out.

Owns the link to the twin, the viser server, the pages and their shared data. Drawing
happens at most 30 times a second (10 times where no page has a graphics processor), always of
the newest state. Commands do not pass through here: each goes out over its page's own
connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

import numpy as np
import viser
from websockets.asyncio.server import ServerConnection

from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.client.transport import ConnectionLost
from flexdt.clients.viewer import scrubbed_plan as plans
from flexdt.clients.viewer.feed import ImageFeed
from flexdt.clients.viewer.front import Download, Front
from flexdt.clients.viewer.page import TRY_AGAIN, Page, without_bytes
from flexdt.clients.viewer.page_cameras import SceneClients
from flexdt.clients.viewer.page_words import of_volume
from flexdt.clients.viewer.scenes import sample_looks, views
from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.layers import Shown
from flexdt.clients.viewer.scenes.name_tags import NO_BOXES, STILL_M, NameTags, Sight
from flexdt.clients.viewer.scenes.sample_looks import NOTHING, MeshCache, SampleLook
from flexdt.clients.viewer.scenes.stage_volume import (
    MadeOf,
    Manner,
    StageDrawing,
    StageVolume,
    same_sample,
)
from flexdt.clients.viewer.scenes.still_pictures import Stills
from flexdt.clients.viewer.scenes.world import World, beads_on, world_of
from flexdt.clients.viewer.shown_images import ShownImage, grey, packed, window_of
from flexdt.clients.viewer.viser_gate import Scenes
from flexdt.clients.viewer.volumes.grown_surface import mesh_of
from flexdt.clients.viewer.volumes.reconstruction_process import LiveReconstruction
from flexdt.clients.viewer.watched_tasks import watched
from flexdt.protocol import RpcError
from flexdt.protocol.state_model import SafetyState, SampleState, State
from flexdt.runtime.access import PublicAddress, ViewerLimits
from flexdt.runtime.log import log
from flexdt.runtime.workers import Workers
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine, Profile, builtin_machine, profile_of

DRAW_HZ: Final = 30.0
PLAIN_DRAW_HZ: Final = 10.0
"""Rate where no page has a graphics processor: pictures follow each other more slowly there,
and each state costs its browser and this process ten milliseconds of the processor."""
ASKED_HZ: Final = 36.0
"""Rate of states requested of the twin [1/s]: slightly more, since late ones are
dropped."""
NOBODY_HZ: Final = 1.0
"""Rate of states and of drawing while no page is open: what nobody sees took 4.8 ms of the
processor thirty times a second, .15 of a core, as long as an axis moved."""
NAMES_S: Final = 0.25
BEAT_S: Final = 0.25
"""Interval between heartbeats to the pages [s]."""
QUIET_S: Final = 0.5
"""Time without a message after which the twin's state is requested [s]; at rest it
sends none."""
SCENES_A_PAGE: Final = 8
"""Largest number of views of a page: four, and those that are just being closed."""
STILL_S: Final = 5.0
"""Longest wait of a picture of the scene for the twin's first state [s]."""
CLOSE_MM: Final = 20.0
"""Clearance below which the page warns [mm]."""

PageMethod = Callable[["Viewer", Page, Mapping[str, Any]], Awaitable[object]]
"""Answers one request of a page from its raw parameters."""


def _wish(rate_hz: float) -> dict[str, object]:
    """Make the subscription of a viewer at a rate of states [1/s]."""
    return {"topics": ["state", "job", "log"], "max_rate_hz": rate_hz}


def nearest(safety: SafetyState) -> dict[str, Any]:
    """Return the nearest parts that may not touch, for pages.

    "close": `CLOSE_MM` or nearer; "mm": None if unknown.
    """
    mm = safety.clearance_mm
    return {
        "mm": mm,
        "pair": safety.pair or [],
        "close": mm is not None and mm < CLOSE_MM,
    }


class Viewer:
    """A viewer: its link to the twin, scenes, pages and exports.

    Args:
        address: of the twin.
        answers: the viewer's own methods by name.
        machine, profile: instead of the ones the twin names (for files).
        token: required of browsers; None for none.
        data: the twin's data directory where it can be read, for slices of running scans.
        limits: for all pages together.
        looks: part of `machine` -> its own mesh.
        public: where browsers find it behind a proxy; None: where it listens.

    Attributes:
        near: components near a contact, which all scenes highlight.
        failed: set when an essential task has failed; the process then ends.
    """

    def __init__(
        self,
        address: TwinAddress,
        answers: Mapping[str, PageMethod],
        machine: Machine | None = None,
        profile: Profile | None = None,
        token: str | None = None,
        data: Path | None = None,
        limits: ViewerLimits | None = None,
        looks: Mapping[str, bytes] | None = None,
        public: PublicAddress | None = None,
    ) -> None:
        """Prepare link, feeds, viser's server and the pages' state; see the class.

        viser's server runs from now on, on a private socket; `start` connects to the twin
        and listens. No page is open yet.
        """
        self.twin_address = address
        self._token = token
        self._public = public
        self._machine = machine
        self._profile = profile
        self.looks = looks
        self.data = data
        self.limits = limits or ViewerLimits()
        self.failed = asyncio.Event()
        self.grower = LiveReconstruction(self._grown)
        self.stage = StageDrawing()
        self.opened = self.drawn = self.sharing = 0
        self._pictured: object = None
        self._placed = asyncio.Event()
        self._stills = Stills()
        self.pages: dict[str, Page] = {}
        self.downloads: dict[str, Download] = {}
        self.lab: LabScene | None = None
        self.state: State | None = None
        self.world: World | None = None
        self.look: SampleLook = NOTHING
        self.window: tuple[float, float] | None = None
        self.wardrobe = MeshCache()
        self.tags = NameTags()
        self.planners = Workers(plans.PLANNERS, plans.PLAN_BYTES, plans.PLAN_S)
        self._local = {name: partial(answer, self) for name, answer in answers.items()}
        self._raw: Mapping[str, Any] | None = None
        self._due = asyncio.Event()
        self._twin_time = 0.0
        self._told = -1
        self._heard_at = time.monotonic()
        self._built = 0
        self.near: Sequence[str] = ()
        self._subject: FloatArray | None = None
        """Middles of source, sample and image at the last state, (3, 3) [m]."""
        self.link = KeptConnection(
            address,
            "flexdt viewer (scene)",
            self._event,
            self._link_changed,
            _wish(NOBODY_HZ),
        )
        self.feeds = {
            kind: ImageFeed(address, kind, self._image, self.failed.set)
            for kind in ("line_integral", "counts")
        }
        self.scenes = Scenes("flexdt")
        self.viser = self.scenes.server
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False)
        self.clients = SceneClients(self.scenes)
        self.clients.joined = self._joined
        self._tasks: list[asyncio.Task[None]] = []
        self._fetching: asyncio.Task[None] | None = None
        self._rate: asyncio.Task[None] | None = None
        self._looked = asyncio.Event()
        """Set when somebody looks, whom the next state must not keep waiting."""
        self.open_pages: set[Page] = set()
        self.front: Front | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def start(self, host: str, port: int, ssl: Any = None) -> None:
        """Start to listen and to work.

        A part that fails sets `failed`. The twin need not be there: the link goes on
        trying.

        Args:
            host, port: to listen on.
            ssl: a server's TLS context; None for plain TCP.

        Raises:
            AccessError: others can reach the address and there is no token.
            OSError: the address is taken.
        """
        self._loop = asyncio.get_running_loop()
        self.front = Front(
            self._page,
            self.scenes.connect,
            self.scenes.html(),
            self.downloads,
            self._token,
            self._public,
            max_scenes=SCENES_A_PAGE * self.limits.max_pages,
            max_pages=self.limits.max_pages,
            still=self.still,
        )
        await self.front.start(host, port, ssl)
        self._tasks = [
            watched(self.link.run(), "the link to the twin", self.failed.set),
            watched(self._draw(), "drawing", self.failed.set),
            watched(self._beat(), "the heartbeat", self.failed.set),
            watched(self._name(), "names in the scenes", self.failed.set),
            watched(self._ask(), "asking a quiet twin", self.failed.set),
        ]

    async def stop(self) -> None:
        """End all tasks, feeds, pages, reconstructions and planners, and viser's server,
        in this order, waiting for each but the planners.

        Errors of tasks that have failed are not raised.
        """
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for feed in self.feeds.values():
            await feed.stop()
        if self.front is not None:
            await self.front.close()
        await self.grower.close()
        self.planners.close()
        await asyncio.to_thread(self.scenes.stop)

    # -- the twin ----------------------------------------------------------------------------

    def _event(self, topic: str, params: Mapping[str, object]) -> None:
        """Take an event of the twin: a state to draw, or a job or log entry to pass to
        all pages.

        Repeated log entries, and those on jobs (which come under their own topic), are
        not passed on. Events without an object as data are ignored. States go to drawing,
        not to the pages here.

        Args:
            topic: of the event.
            params: data and number of the event.
        """
        self._heard_at = time.monotonic()
        data = params.get("data")
        if not isinstance(data, Mapping):
            return
        if topic == "state":
            self._state_came(data)
            return
        if topic == "log":
            # After a lost connection the twin repeats its last entries.
            seq = params.get("seq")
            if not isinstance(seq, int) or seq <= self._told:
                return
            self._told = seq
            if "job" in (
                data.get("data") or {}
            ):  # pages receive jobs under a topic of their own
                return
        for page in self.pages.values():
            page.say(topic, data=without_bytes(data))

    def _state_came(self, data: Mapping[str, Any]) -> None:
        """Keep a state of the twin, and wake the task that draws it.

        A new twin's log entries are passed on again.
        """
        if data["time"] < self._twin_time:  # a new twin, which counts from 0 again
            self._told = -1
        self._twin_time = float(data["time"])
        self._raw = data
        self._due.set()

    async def _ask(self) -> None:
        """Request the state of a twin that sent nothing for `QUIET_S`, for ever: it is at
        rest, or it hangs.

        Skipped while disconnected; a failed request is tried again, a state older than
        the newest is dropped. An answer counts as heard.
        """
        while True:
            await asyncio.sleep(max(0.05, self._heard_at + QUIET_S - time.monotonic()))
            if not self.link.connected or time.monotonic() - self._heard_at < QUIET_S:
                continue
            try:
                state = await self.link.request("state.get")
            except (RpcError, ConnectionLost):
                continue
            if isinstance(state, Mapping) and state["time"] >= self._twin_time:
                self._state_came(state)
            self._heard_at = time.monotonic()

    async def _beat(self) -> None:
        """Send all pages, every `BEAT_S` for ever, how long the twin has been silent [s]:
        a hanging twin does not report it.

        Older beats that were not sent are replaced.
        """
        while True:
            now = time.monotonic()
            beat = json.dumps(
                {"type": "beat", "at": now, "silent_s": now - self._heard_at}
            )
            for page in self.pages.values():
                page.show("beat", beat)
            await asyncio.sleep(BEAT_S)

    async def _name(self) -> None:
        """Keep names where they have room in each view, whatever moves: cameras move
        without an event.

        Once the machine is at rest it is in each picture, too, unless a person has chosen
        another one. It looks every `NAMES_S` seconds, for ever; at rest means the same
        geometry as before. Layers are set again, and pages are told what each picture is
        about, too.
        """
        before: World | None = None
        while True:
            await asyncio.sleep(NAMES_S)
            lab = self.lab
            world = self.world
            if lab is not None and world is not None:
                if before is not None and np.allclose(before.view.rows, world.view.rows):
                    self.clients.fit()
                before = world
                self.show_volumes()
                self.show_layers()
                subject = lab.subject(world)
                for client, id, view in self.clients.with_names():
                    named = lab.named(world, self._shown_by(id))
                    page = self.pages.get(id)
                    over = NO_BOXES if page is None else page.covered.get(view, NO_BOXES)
                    with contextlib.suppress(
                        AssertionError, KeyError
                    ):  # it has just come or gone
                        shown = Sight.of(client).boxes(subject)
                        if page is not None:
                            page.tell_subject(view, shown)
                        await asyncio.to_thread(
                            self.tags.draw, client, named, over, shown
                        )

    async def _drop_names(self, subject: Sequence[FloatArray]) -> None:
        """Take away the names of what has begun to move, in the pictures that show it move."""
        at = np.stack([points.mean(axis=0) for points in subject])
        moved = (
            self._subject is not None
            and float(np.abs(at - self._subject).max()) > STILL_M
        )
        self._subject = at
        if not moved:
            return
        for client, _, _ in self.clients.with_names():
            with contextlib.suppress(
                AssertionError, KeyError
            ):  # it has just come or gone
                await asyncio.to_thread(self.tags.leave, client)

    def show_layers(self) -> None:
        """Set the nodes that each page shows in its frames, as soon as they have
        received all nodes.

        Nothing without the scene of the lab. A frame gets only the differences.
        """
        if (lab := self.lab) is None:
            return
        for page in self.pages.values():
            within = self._manner(page) == "stands"
            nodes = lab.nodes(self.shown_by(page), self.near, within)
            self.clients.show(page.id, nodes, lab.plain, self._built)

    def _shown_by(self, id: str) -> Shown:
        page = self.pages.get(id)
        return Shown() if page is None else self.shown_by(page)

    def shown_by(self, page: Page) -> Shown:
        """Return the layers that a page's scenes draw: the chosen ones, without the present
        sample and its image while the page shows images of another one.
        """
        if self.of_another(page):
            return page.shown.changed(sample=False, panel=False)
        return page.shown

    def of_another(self, page: Page) -> bool:
        """Return whether a page shows images of another sample than the present one."""
        if page.made is None or self.state is None:
            return False
        return not same_sample(page.made, self.state.sample)

    def _link_changed(self) -> None:
        self._heard_at = time.monotonic()
        for page in self.pages.values():
            self._tell_link(page)

    def _tell_link(self, page: Page) -> None:
        """Send a page the state of the connection to the twin: connected, problem,
        address, its hello, and whether any page shows a scene.

        `hello` is None without a connection.
        """
        hello = self.link.hello
        page.say(
            "link",
            connected=self.link.connected,
            problem=self.link.problem,
            twin=str(self.twin_address),
            drawn=bool(self.clients.cameras),
            hello=hello and hello.model_dump(),
        )

    # -- drawing -----------------------------------------------------------------------------

    async def _draw(self) -> None:
        """Draw the newest state at most `DRAW_HZ` times a second (`PLAIN_DRAW_HZ` where no
        page has a graphics processor), for ever; older ones are skipped.

        A failure is logged once, until a state is drawn again. The time of drawing counts
        towards the interval.
        """
        loop = asyncio.get_running_loop()
        sound = True
        while True:
            await self._due.wait()
            self._due.clear()
            begun = loop.time()
            raw = self._raw
            if raw is not None:
                try:
                    await self._take_state(raw)
                    self.drawn += 1
                    sound = True
                except Exception:  # the next one may be better
                    if sound:  # once, not for each of thirty a second
                        log("a state could not be drawn", logging.ERROR, error=True)
                    sound = False
            plain = self.pages and not any(page.fine for page in self.pages.values())
            most_hz = PLAIN_DRAW_HZ if plain else DRAW_HZ
            if not self.pages:
                most_hz = NOBODY_HZ
            pause_s = max(0.0, begun + 0.8 / most_hz - loop.time())
            self._looked.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._looked.wait()

    def _somebody_looks(self) -> None:
        """Ask for states at the rate of the pages that are open, and draw the next one at
        once.
        """
        self._looked.set()
        wish = _wish(ASKED_HZ if self.pages else NOBODY_HZ)
        self._rate = watched(self.link.subscribe(wish), "the rate of states")

    async def _take_state(self, raw: Mapping[str, Any]) -> None:
        """Draw a state: sample, cameras, scene; then send it to the pages with framing,
        nearest parts and time.

        A new machine or sample is built first, and pages get the link's state with a new
        machine. The first state starts the images. All views get new presets, but cameras
        move for a new machine only; the beam's eye always follows. Travel ranges are drawn
        only if a page shows them.

        Args:
            raw: the state as the twin sends it.

        Raises:
            ValueError: it is not valid.
            TwinError: an unknown machine or profile.
        """
        state = State.model_validate(raw)
        before = self.lab
        lab = await self._ready_lab()
        world = world_of(lab.machine, lab.profile, state)
        sample_changed = (
            self.state is None or self.state.sample != state.sample or lab is not before
        )
        first = self.state is None
        self.state = state
        self.world = world
        if sample_changed:
            await self._dress(lab, state)
        rim_mm = views.rim(world, self.look.hulls_m)
        self.clients.cameras = views.presets(world, self.look.radius_mm, rim_mm)
        if first:  # the picture of the scene shows an image, too
            self.feeds["line_integral"].start()
        if lab is not before:
            self.clients.fit(anew=True)
            for page in self.pages.values():
                self._tell_link(page)
        if first:  # images that came before could not be drawn
            for feed in self.feeds.values():
                feed.again()
        near = nearest(state.safety)
        lab.update(state, world)
        await self._drop_names(lab.subject(world))
        if near["close"]:
            self.near = near["pair"]
        else:
            self.near = ()
        if any("ranges" in page.shown for page in self.pages.values()):
            lab.draw_ranges(state)
        self._placed.set()
        self.show_volumes()
        camera, framing = views.beam_view(world)
        self.clients.follow(camera)
        stands = world.sample.shift if state.sample.name else None
        self.clients.ride(stands, self.look.radius_mm)
        text = json.dumps(
            {
                "type": "state",
                "state": without_bytes(raw),
                "framing": framing,
                "across_mm": self.look.across_mm,
                "cone_vec": world.cone_vec.rows[0].tolist(),
                "near": near,
                "at": time.monotonic(),
            }
        )
        for page in self.pages.values():
            page.show("state", text)

    async def _ready_lab(self) -> LabScene:
        """Return the scene of the twin's machine and profile; those given to the viewer
        come first, and "flexray" while no twin is known.

        If they have changed it is built anew in a thread, in place of the former scene's
        nodes, and pages get the layers.

        Raises:
            TwinError: an unknown machine or profile.
        """
        hello = self.link.hello
        machine = self._machine or builtin_machine(
            "flexray" if hello is None else hello.machine
        )
        if hello is None:
            named = None
        else:
            named = hello.profile
        profile = self._profile or profile_of(machine, named)
        if self.lab is None or (self.lab.machine, self.lab.profile) != (machine, profile):
            scene = await asyncio.to_thread(
                LabScene,
                self.viser,
                machine,
                profile,
                self._dragged,
                self.looks,
                self._picked,
            )
            self.lab = scene
            self._built = self.scenes.said
            for page in self.pages.values():
                page.say("layers", **page.shown.told)
        return self.lab

    async def _dress(self, lab: LabScene, state: State) -> None:
        """Show the look of the sample on the stage, and begin to fetch its shape if that
        is missing.

        Building the look is in a thread.
        """
        self.look = await asyncio.to_thread(self.wardrobe.look, state.sample)
        lab.wear(self.look)
        self._built = self.scenes.said
        if self.wardrobe.lacks(state.sample):
            self._fetching = watched(self._fetch(lab, state.sample), "fetching a shape")

    async def _fetch(self, lab: LabScene, sample: SampleState) -> None:
        """Fetch the mesh of an upload, and show it if the sample is still on the stage; a
        box is drawn until then.

        If the twin has none the box stays. A lost connection, a refusal or a mesh that
        cannot be read is logged as a warning; other errors are raised.
        """
        try:
            stl = await sample_looks.fetch(self.link.request, sample)
            if stl is None:
                return
            await asyncio.to_thread(self.wardrobe.add, sample, stl)
        except (ConnectionLost, TwinError, ValueError) as error:
            log(
                "no shape of the sample",
                logging.WARNING,
                sample=sample.name,
                reason=str(error),
            )
            return
        if self.state is not None and self.state.sample == sample:
            await self._dress(lab, self.state)

    def _image(self, image: ShownImage, coarse: bool) -> None:
        """Show one image on the panel and send it to the pages that want its kind; in a
        worker thread.

        Only line integrals are shown on the panel; nothing before the scene is there. If
        no page is open the feeds end. The window is that of all pages, else chosen from
        the image. Coarse images are drawn from every second pixel.

        Args:
            image: to show.
            coarse: at half the resolution, while images follow each other.
        """
        lab = self.lab
        world = self.world
        look = self.look
        if lab is None or world is None:
            return
        beads: list[list[float]] = []
        if len(look.beads):
            # The image's own geometry, so that beads and image are of one moment.
            beads = beads_on(image.cone_vec, look.beads, world, image.pixels.shape)
        content = packed(image, coarse=coarse, beads=beads, facts={"at": time.time()})
        if image.kind == "line_integral":
            window = self.window or window_of(image)
            if coarse:
                small = image.pixels[::2, ::2]
            else:
                small = image.pixels
            shown = ShownImage(small, image.kind, image.cone_vec, image.time, image.seq)
            lab.show_image(grey(shown, window), small, world)
            self._pictured = coarse, window, image.cone_vec
        assert self._loop is not None
        if not self.pages:
            self._loop.call_soon_threadsafe(self.refresh_feeds)
        self._loop.call_soon_threadsafe(self._send_image, image.kind, content)

    def _send_image(self, kind: str, content: bytes) -> None:
        for page in self.pages.values():
            if page.kind == kind and page.recorded is None:
                page.show("image", content)

    async def still(self, asked: Mapping[str, str]) -> bytes | None:
        """Draw the present scene as a JPEG (see `Stills`), once it has been placed or
        `STILL_S` has passed.

        Args:
            asked: the page's query: view, page, and those of `Stills`. The view "sample"
                shows only the parts that turn with it.

        Returns:
            The picture; None if nothing is placed or the view is not known.
        """
        if not self.pages and self._placed.is_set():
            self._placed.clear()  # until the state of now, which the subscription brings
            self._somebody_looks()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STILL_S):
                await self._placed.wait()
        lab = self.lab
        world = self.world
        camera = self.clients.cameras.get(asked.get("view", ""))
        if lab is None or world is None or camera is None:
            return None
        shown = self._shown_by(asked.get("page", ""))
        near = asked.get("view") == "sample"
        stamp = (self._pictured, id(self.look), shown, near, *world.view.rows.flat)
        return await self._stills.picture(
            camera, asked, stamp, lambda: lab.shapes(world, shown, near=near)
        )

    def _grown(self, line: str) -> None:
        """Pass a line of the reconstruction process on to the pages that follow that volume:
        its surface to their scenes, the rest to them.
        """
        surface, about = line.split("\t")
        facts = json.loads(about)
        followers = [
            page
            for page in self.pages.values()
            if page.live == (facts["name"], facts["past"])
        ]
        if (told := json.loads(surface)) is not None and followers:
            made = MadeOf.of(facts["made"])
            volume = StageVolume(facts["name"], *mesh_of(told), made)
            for page in followers:
                page.volume = volume
            self.show_volumes()
        spoken = json.dumps(of_volume(facts))
        for page in followers:
            page.show("volume", spoken)

    def show_volumes(self) -> None:
        """Draw each page's volume in its frames: on the stage, or as a ghost.

        Frames that have not been sent all that is built are left for later.
        """
        for page in self.pages.values():
            clients = [
                client
                for client in self.clients.of(page.id)
                if self.scenes.heard(client.client_id, self._built)
            ]
            self.stage.show(clients, page.volume, self._manner(page))

    def _manner(self, page: Page) -> Manner | None:
        """Choose how a page's volume is drawn now; None: not at all. Beside images of another
        sample none stands on the stage.
        """
        if page.volume is None:
            return None
        return page.volume.manner(
            None if self.of_another(page) else self.state, page.ghost
        )

    def ungrow(self) -> None:
        """Stop the growing volume unless a page still wants it."""
        if not any(page.live for page in self.pages.values()):
            self.grower.stop()

    # -- pages -------------------------------------------------------------------------------

    async def _page(self, id: str, connection: ServerConnection) -> None:
        """Serve a page until it ends, or reject it where too many are open.

        A page in excess is logged and closed with TRY_AGAIN. The user's name is cut at 40
        characters ("a visitor" without one). Of two connections with one id the newer one
        counts. At its end the page's cameras are forgotten, and volume and feeds stopped
        if no other page wants them.

        Args:
            id: of the page.
            connection: to its browser.
        """
        if len(self.open_pages) >= self.limits.max_pages:
            reason = (
                f"it serves {self.limits.max_pages} pages at most, and so many are open"
            )
            log("a page was refused", logging.WARNING, page=id, reason=reason)
            await connection.close(TRY_AGAIN, reason)
            return
        if connection.request:
            asked = parse_qs(urlsplit(connection.request.path).query)
        else:
            asked = {}
        person = asked.get("person", [""])[0]
        page = Page(id, connection, self.twin_address, self._local, person)
        self.opened += 1
        self.open_pages.add(page)
        self.pages[id] = page
        self._tell_link(page)
        if self.data is not None:
            self.grower.warm()
        if self.lab is not None:
            page.say("layers", **page.shown.told)
        self.refresh_feeds()
        self._somebody_looks()
        self._due.set()
        try:
            await page.run()
        finally:
            self.open_pages.discard(page)
            if self.pages.get(id) is page:
                del self.pages[id]
                self.clients.forget(id)
            self.ungrow()
            self.refresh_feeds()
            if not self.pages:
                self._somebody_looks()

    def refresh_feeds(self) -> None:
        """Subscribe to the images that pages show, and to line integrals for the panel if
        there is any page; stop other feeds.

        Running feeds send their newest image again.
        """
        wanted = {page.kind for page in self.pages.values()}
        if self.pages:
            wanted.add("line_integral")
        for kind, feed in self.feeds.items():
            if kind in wanted:
                feed.start()
                feed.again()
            elif feed.running:
                feed.stop()

    def _joined(self, client: viser.ClientHandle, id: str) -> None:
        """Draw a page's plan path in its new view; nothing without a path. Called in one
        of viser's threads.

        An unknown page is ignored."""
        page = self.pages.get(id)
        lab = self.lab
        if page is not None and page.orbit is not None and lab is not None:
            lab.plan.orbit([client], page.orbit)

    def _dragged(self, client: int | None, targets: Mapping[str, float]) -> None:
        """Send a drag of a stage on to its page; called in one of viser's threads."""
        page = self.pages.get(self.clients.page_of(client) or "")
        if page is not None and self._loop is not None:
            self._loop.call_soon_threadsafe(page.drag, dict(targets))

    def _picked(self, client: int | None, part: str, motor: str | None) -> None:
        """Tell a page that a part was clicked in a frame of it; called in one of viser's
        threads."""
        page = self.pages.get(self.clients.page_of(client) or "")
        if page is not None and self._loop is not None:
            self._loop.call_soon_threadsafe(
                partial(page.say, "part", part=part, motor=motor)
            )
