"""Which of viser's clients shows which view of which page, and their cameras.

Each view is a browser frame under `/scene/PAGE/VIEW`, so the path of a connection identifies
it. But for the beam's eye, a view belongs to its user; only the page's buttons move its camera.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import viser

from flexdt.clients.viewer.front import SCENE_PATH
from flexdt.clients.viewer.scenes.lamps import SKY, light_finely
from flexdt.clients.viewer.scenes.layers import Nodes
from flexdt.clients.viewer.scenes.views import Fitted, Standpoint
from flexdt.clients.viewer.scenes.world import MM
from flexdt.clients.viewer.viser_gate import Scenes, set_camera, set_nodes
from flexdt.twin.geometry.conventions import FloatArray

FAR_RATIO = 1.3
"""Distance of the camera, over the distance at which the ball in view fills the
picture."""
RESTS_S = 0.5
"""Time without motion of the stage after which a close camera belongs to its person again: its
browser has told where that has put it."""
MOVED_SHARE = 1e-4
"""Displacement of a camera, as a part of its distance, from which it counts as another one:
a frame reports to 1e-7, and a person's drag by a pixel is some 1e-3."""


@dataclass(frozen=True)
class Who:
    """A frame of a page."""

    page: str
    view: str


@dataclass(frozen=True)
class Put:
    """A camera as it was put, and the aspect (width over height) of its pane then."""

    camera: Standpoint
    aspect: float


@dataclass
class Aim:
    """What a close camera is aimed at: the sample, wherever it stands.

    Attributes:
        middle: (3,) of the sample when the camera was put last [m].
        radius_mm: of the ball around it.
        arm: place and target of the camera from there [m], while the stage moves; None at
            rest, when a person may move the camera.
        moved_at: when the stage moved last [s].
    """

    middle: FloatArray
    radius_mm: float
    arm: tuple[FloatArray, FloatArray] | None = None
    moved_at: float = 0.0


class SceneClients:
    """The frames that are open.

    Args:
        scenes: whose clients.
    """

    def __init__(self, scenes: Scenes) -> None:
        """Register for viser's clients as they connect and leave.

        No client, camera or theme is known yet. viser calls back in threads of its own.

        Args:
            scenes: viser's server.
        """
        self._scenes = scenes
        self._server = scenes.server
        self._lock = threading.Lock()
        self._who: dict[int, Who] = {}
        self._sent: dict[int, Put] = {}
        """Client -> its camera as put last; a person may have moved it since."""
        self._due: dict[int, list[Standpoint]] = {}
        """Client -> the cameras that it was told and has not reported yet, oldest first."""
        self._at: dict[int, Standpoint] = {}
        """Client -> the camera it reported last, once it has reported one that it was told."""
        self._elsewhere: set[int] = set()
        """Clients that have reported another camera than the one due last: a frame may lose one
        that comes while it opens."""
        self._theme: dict[str, tuple[bool, bool]] = {}
        """Page -> whether its frames are dark, and finely lit."""
        self._shown: dict[int, tuple[int, Nodes]] = {}
        """Client -> number of messages when built, and the state of its nodes."""
        self._aims: dict[int, Aim] = {}
        """Client -> what its close camera is aimed at."""
        self._beam: Standpoint | None = None
        self.cameras: dict[str, Fitted] = {}
        """View -> its points and directions; the beam's eye, which follows the
        machine, has none."""
        self.joined: Callable[[viser.ClientHandle, str], None] = lambda client, page: None
        """Called in one of viser's threads with a new frame and its page."""
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    def of(self, page: str, view: str | None = None) -> list[viser.ClientHandle]:
        """List the connected clients that show `view` (any, if None) of `page`.

        Those that have just left are left out.
        """
        with self._lock:
            ids = [
                i
                for i, w in self._who.items()
                if w.page == page and view in (None, w.view)
            ]
        clients = self._server.get_clients()
        return [clients[i] for i in ids if i in clients]

    def with_names(self) -> list[tuple[viser.ClientHandle, str, str]]:
        """List the clients whose views have names, with their pages and views: the beam's
        eye shows pixels."""
        with self._lock:
            whose = [(i, w) for i, w in self._who.items() if w.view != "beam"]
        clients = self._server.get_clients()
        return [(clients[i], w.page, w.view) for i, w in whose if i in clients]

    def show(self, page: str, nodes: Nodes, plain: Nodes, built: int) -> None:
        """Set the nodes of a page's frames, from one thread only.

        Only nodes that differ from those in the frame are sent; if `built`, the number of
        messages to all clients, is another than at the last call, also from `plain`, as
        built. A frame that has not received all nodes is left for later.
        """
        for client in self.of(page):
            if not self._scenes.heard(id := client.client_id, built):
                continue
            when, stand = self._shown.get(id, (built, plain))
            known = (stand,) if when == built else (stand, plain)
            changed = {
                n: s for n, s in nodes.items() if any(k.get(n) != s for k in known)
            }
            if changed:
                set_nodes(client, changed)
            self._shown[id] = built, nodes

    def page_of(self, client_id: int | None) -> str | None:
        """Return the page that a client belongs to; None for an unknown client or None."""
        with self._lock:
            if client_id is None:
                who = None
            else:
                who = self._who.get(client_id)
        return None if who is None else who.page

    def follow(self, camera: Standpoint) -> None:
        """Move every beam's eye to `camera`, now and when one connects."""
        self._beam = camera
        for client in self._looking("beam"):
            self._put(client, camera)

    def fit(self, anew: bool = False) -> None:
        """Put each view's camera so that it holds its points, and tell frames again what
        they have not reported.

        A camera moves only if its pane has another aspect than when it was put, or the
        points no longer fit its view, and no person has moved it. Views whose pane has no
        known size yet are left out.

        Args:
            anew: put all cameras to their presets, moved or not.
        """
        for view, preset in self.cameras.items():
            for client in self._looking(view):
                with contextlib.suppress(AssertionError):  # its width is not known yet
                    aspect = client.camera.aspect
                    if anew or (
                        self._untouched(client)
                        and not (
                            self._sent[client.client_id].aspect == aspect
                            and preset.fits(self._camera(client), aspect)
                        )
                    ):
                        self._put(client, preset.at(aspect))
        clients = self._server.get_clients()
        for id in self._elsewhere & clients.keys() & self._due.keys():
            self._tell(clients[id], self._camera(clients[id]))

    def reset(self, page: str, view: str) -> None:
        """Set a page's view back to its preset for the client's aspect ratio; nothing
        without a preset.

        Also moves a camera that a person has moved, and nothing if it is there already.
        """
        preset = self.cameras.get(view)
        for client in self.of(page, view):
            self._aims.pop(client.client_id, None)
            if preset is not None:
                self._put(client, preset.at(client.camera.aspect))

    def look(self, page: str, view: str, at: FloatArray, radius_mm: float) -> None:
        """Aim a page's view at the sample: it is seen from its preset's direction, and
        followed (`ride`) until `reset`.

        A view that is not open is left alone.

        Args:
            page: its id.
            view: name of the view.
            at: (3,) center [mm].
            radius_mm: of the ball around it.

        Raises:
            KeyError: the view is open and has no preset.
        """
        for client in self.of(page, view):
            self._aim(client, view, at * MM, radius_mm)

    def _aim(
        self, client: viser.ClientHandle, view: str, middle: FloatArray, radius_mm: float
    ) -> None:
        """Put a camera before a ball, in its view's direction.

        The distance is `FAR_RATIO` times that at which the ball fills the view, more in a
        narrow pane. The camera then counts as moved by a person.
        """
        aspect = client.camera.aspect
        preset = self.cameras[view].at(aspect)
        half = math.sin(preset.fov / 2) * min(1.0, max(aspect, 0.3))
        far = FAR_RATIO * radius_mm * MM / half
        way = np.subtract(preset.position, preset.look_at)
        x, y, z = (middle + far * way / np.linalg.norm(way)).tolist()
        target = tuple(middle.tolist())
        self._tell(client, replace(preset, position=(x, y, z), look_at=target))
        self._aims[client.client_id] = Aim(middle, radius_mm)

    def ride(self, at: FloatArray | None, radius_mm: float) -> None:
        """Move all close cameras along with the sample, as they stand to it.

        They go home to their presets where there is no sample, and look at another one anew.

        Args:
            at: (3,) the sample's place [mm]; None: the stage is empty.
            radius_mm: of the ball around it.
        """
        clients = self._server.get_clients()
        for id, aim in list(self._aims.items()):
            client, who = clients.get(id), self._who.get(id)
            if client is None or who is None:
                del self._aims[id]
            elif at is None:
                self.reset(who.page, who.view)
            elif radius_mm != aim.radius_mm:
                self._aim(client, who.view, at * MM, radius_mm)
            else:
                camera = _carried(self._camera(client), aim, at * MM)
                if camera is not None:
                    self._tell(client, camera)

    def theme(self, page: str, dark: bool, fine: bool) -> None:
        """Set light or dark, plain or fine light, for all frames of a page."""
        self._theme[page] = dark, fine
        for client in self.of(page):
            _theme(client, dark, fine)

    def forget(self, page: str) -> None:
        """Drop a page's clients."""
        self._theme.pop(page, None)

    def _looking(self, view: str) -> list[viser.ClientHandle]:
        """List the connected clients that show a view, of any page.

        In no particular order.
        """
        with self._lock:
            ids = [i for i, w in self._who.items() if w.view == view]
        clients = self._server.get_clients()
        return [clients[i] for i in ids if i in clients]

    def _put(self, client: viser.ClientHandle, camera: Standpoint) -> None:
        """Set a client's camera, unless it was put there last and has not been moved
        since.

        The camera is stored as put, so that a person's move is recognized.
        """
        put = Put(camera, client.camera.aspect)
        if self._sent.get(client.client_id) == put and self._untouched(client):
            return
        self._sent[client.client_id] = put
        self._tell(client, camera)

    def _tell(self, client: viser.ClientHandle, camera: Standpoint) -> None:
        """Set a client's camera; it is due until a report of the client has it, or has one
        that a person has moved."""
        with self._lock:
            due = self._due.setdefault(client.client_id, [])
            if due[-1:] != [camera]:
                due.append(camera)
            self._elsewhere.discard(client.client_id)
        set_camera(client, camera)

    def _reported(self, client: viser.ClientHandle) -> None:
        """Take a client's report of its camera: what was due has arrived, is still on its way
        or lost, or a person has moved the camera.

        Only a person puts a camera where it was neither told to be nor before; a frame that
        opens does so by itself, too.
        """
        now, id = _now(client), client.client_id
        with self._lock:
            due = self._due.get(id, [])
            arrived = [k for k, camera in enumerate(due) if _stands(now, camera)]
            if arrived:
                del due[: arrived[-1] + 1]
            elif id in self._at and not _stands(now, self._at[id]):
                due.clear()
            if due:
                self._elsewhere.add(id)
            else:
                self._due.pop(id, None)
                self._elsewhere.discard(id)
            if arrived or id in self._at:
                self._at[id] = now

    def _untouched(self, client: viser.ClientHandle) -> bool:
        """Check that a client's camera is still where it was put, or on its way there;
        False if it never was put."""
        put = self._sent.get(client.client_id)
        if put is None:
            return False
        return _stands(self._camera(client), put.camera)

    def _camera(self, client: viser.ClientHandle) -> Standpoint:
        """Return the camera that a client is on its way to, or else the one it reported."""
        with self._lock:
            due = self._due.get(client.client_id)
            return due[-1] if due else _now(client)

    def _connected(self, client: viser.ClientHandle) -> None:
        """Register a new client with its page and view, set its camera and theme, and
        call `joined`; in a thread of viser's.

        A client whose path names no page and view is ignored. A view without preset keeps
        viser's camera; a page without theme is light and plain.

        Args:
            client: of viser; its path names page and view.
        """
        path = self._scenes.path_of(client.client_id)
        if path is None:
            match = None
        else:
            match = SCENE_PATH.fullmatch(path)
        if match is None:
            return
        who = Who(match[1], match[2])
        with self._lock:
            self._who[client.client_id] = who
        client.camera.on_update(lambda _: self._reported(client))
        if who.view == "beam" and self._beam is not None:
            self._put(client, self._beam)
        elif who.view in self.cameras:
            self._put(client, self.cameras[who.view].at(client.camera.aspect))
        _theme(client, *self._theme.get(who.page, (False, False)))
        self.joined(client, who.page)

    def _gone(self, client: viser.ClientHandle) -> None:
        """Forget page, camera and layers of a client that has closed.

        The page's theme stays until `forget`.
        """
        with self._lock:
            self._who.pop(client.client_id, None)
            self._sent.pop(client.client_id, None)
            self._due.pop(client.client_id, None)
            self._at.pop(client.client_id, None)
            self._elsewhere.discard(client.client_id)
            self._shown.pop(client.client_id, None)


def _carried(seen: Standpoint, aim: Aim, middle: FloatArray) -> Standpoint | None:
    """Compute where a close camera goes with its sample; None if the sample has not moved
    since.

    Args:
        seen: the camera now.
        aim: what it is aimed at; is brought up to date.
        middle: (3,) of the sample now [m].
    """
    now = time.monotonic()
    if np.allclose(middle, aim.middle, atol=1e-6):
        if now > aim.moved_at + RESTS_S:
            aim.arm = None
        return None
    if aim.arm is None:
        place, target = np.array(seen.position), np.array(seen.look_at)
        aim.arm = place - aim.middle, target - aim.middle
    place, target = (middle + part for part in aim.arm)
    aim.middle, aim.moved_at = middle, now
    (px, py, pz), (tx, ty, tz) = place.tolist(), target.tolist()
    return replace(seen, position=(px, py, pz), look_at=(tx, ty, tz))


def _stands(seen: Standpoint, camera: Standpoint) -> bool:
    """Check that one camera is at the place of another, within `MOVED_SHARE` of that one's
    distance; directions are not compared."""
    reach_m = math.dist(camera.position, camera.look_at)
    return math.dist(camera.position, seen.position) < MOVED_SHARE * reach_m


def _now(client: viser.ClientHandle) -> Standpoint:
    """Return the present camera of a client: position, the point it looks at, up
    direction, and field of view [rad].

    Lengths are in [m].
    """
    c = client.camera
    position, look_at, up = (
        (float(v[0]), float(v[1]), float(v[2]))
        for v in (c.position, c.look_at, c.up_direction)
    )
    return Standpoint(position, look_at, up, float(c.fov))


def _theme(client: viser.ClientHandle, dark: bool, fine: bool) -> None:
    client.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark)
    if fine and client.scene.get_handle_by_name(SKY) is None:
        light_finely(client.scene)
