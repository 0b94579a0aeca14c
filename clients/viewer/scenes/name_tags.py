"""Names of visible parts; no name covers another.

Their places are a pure function of boxes in pixels. A name's box goes to the free place
nearest to its point, and a leader joins the two. The names then share these places so
that their leaders are shortest together: none crosses another. `NameTags` draws them in
the views of browsers, whose cameras determine the boxes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import viser
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes.world import MM, World
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine

WAYS = 24
RINGS_PX = (26.0, 44.0, 66.0, 92.0, 124.0, 164.0, 220.0, 300.0, 420.0)
"""Directions, and distances [px], in which a place is sought, the near ones first."""
GAP_PX = 5.0
"""Least distance between boxes, and to the picture's edge [px]."""
LETTER_PX = 6.6
LINE_PX = 17.0
PAD_PX = 10.0
"""Widest letter, height and margin of viser's labels on a screen [px]."""
LEAST_PX = 260
"""Least width of a view with names [px]."""
LEADER: Final = (40, 150, 235)
STILL_M: Final = 0.5 * MM
"""Way of a point between two looks from which it counts as moving [m]."""
LEAST_DEPTH_M: Final = 0.02
"""Distance before a camera from which points are in its picture [m]."""
NO_BOXES: Final = np.zeros((0, 4))
Name = tuple[str, FloatArray]
"""Words, and the point (3,) that they name [m, world]."""


def laid_out(
    anchors: FloatArray,
    sizes: FloatArray,
    area: tuple[float, float],
    taken: FloatArray = NO_BOXES,
    shown: FloatArray = NO_BOXES,
) -> FloatArray:
    """Place the names' boxes.

    From top to bottom, each near its point at a place that covers few others and little of what
    the picture is about: a covered point, or box of `shown`, weighs as much as four rings farther
    away. Then names are exchanged so that
    leaders do not cross. Places are on rings around a point
    (`RINGS_PX`, `WAYS` directions), inside the area, off `taken`, `GAP_PX` from other boxes; nearer
    and higher ones are preferred. All boxes are treated as large as the largest.

    Args:
        anchors: (n, 2) named points [px]; NaN or outside the picture: no name.
        sizes: (n, 2) widths and heights of the boxes [px].
        area: width and height of the picture [px].
        taken: (m, 4) boxes where no name may be: left, top, right, bottom [px].
        shown: (k, 4) boxes of what the picture is about.

    Returns:
        Top left corners (n, 2) of the boxes [px]; NaN where a name has no room.
    """
    turns = np.arange(WAYS) * 2.0 * math.pi / WAYS
    ways = np.stack([np.cos(turns), -np.sin(turns)], axis=1)
    rings = np.repeat(np.arange(len(RINGS_PX)), WAYS)
    preference = rings + 0.5 * (1.0 + np.tile(ways[:, 1], len(RINGS_PX)))
    size = sizes.max(
        axis=0, initial=0.0
    )  # of every place, so that any name has room in it
    places = np.zeros((0, 2))
    named = np.zeros(0, dtype=int)
    for k in np.argsort(anchors[:, 1]):
        if not ((anchors[k] >= 0.0) & (anchors[k] <= area)).all():
            continue
        middles = np.concatenate([anchors[k] + (r + 0.5 * size) * ways for r in RINGS_PX])
        inside = (
            np.abs(middles - 0.5 * np.array(area)) <= 0.5 * (area - size) - GAP_PX
        ).all(1)
        apart = (
            (np.abs(middles[:, None] - places) >= size + GAP_PX).any(axis=2).all(axis=1)
        )
        low, high = middles - 0.5 * size, middles + 0.5 * size
        beside = (high[:, None] <= taken[:, :2]) | (low[:, None] >= taken[:, 2:])
        apart &= beside.any(axis=2).all(axis=1)
        covered = (
            (np.abs(middles[:, None] - anchors) < 0.5 * size + GAP_PX)
            .all(axis=2)
            .sum(axis=1)
        )
        meets = (high[:, None] > shown[:, :2]) & (low[:, None] < shown[:, 2:])
        covered += meets.all(axis=2).sum(axis=1)
        cost = np.where(inside & apart, preference + 4.0 * covered, np.inf)
        if np.isfinite(cost).any():
            places = np.vstack([places, middles[np.argmin(cost)]])
            named = np.append(named, k)
    # Where two leaders crossed, their names could change places and both would be shorter.
    lengths = np.linalg.norm(places[:, None] - anchors[named], axis=2)
    place, name = linear_sum_assignment(lengths)
    out = np.full((len(anchors), 2), np.nan)
    out[named] = places[place[np.argsort(name)]] - 0.5 * sizes[named]
    return out


@dataclass(frozen=True)
class Sight:
    """A camera, and where points are in its picture.

    Attributes:
        eye: (3,) [m].
        axes: (3, 3), right, down and ahead as rows.
        fov: vertical opening [rad].
        area: width and height of the picture [px].
    """

    eye: FloatArray
    axes: FloatArray
    fov: float
    area: tuple[float, float]

    @classmethod
    def of(cls, client: viser.ClientHandle) -> Self:
        """Take the camera that a client reported last."""
        camera = client.camera
        ahead = camera.look_at - camera.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, camera.up_direction)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        area = float(camera.image_width), float(camera.image_height)
        return cls(camera.position, axes, camera.fov, area)

    @property
    def scale(self) -> float:
        """Pixels between two points as far from each other as from the camera."""
        return 0.5 * self.area[1] / math.tan(0.5 * self.fov)

    def seen(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Project points (n, 3) [m]: their places (n, 2) [px], NaN behind the camera, and
        their depths (n,) [m]."""
        x, y, depth = self.axes @ (points - self.eye).T
        depth[depth < LEAST_DEPTH_M] = np.nan
        flat = self.scale * np.stack([x, y], axis=1) / depth[:, None]
        return 0.5 * np.array(self.area) + flat, depth

    def boxes(self, parts: Sequence[FloatArray]) -> FloatArray:
        """Compute the boxes (m, 4) around parts in the picture: left, top, right, bottom [px].

        A part that has a point behind the camera, or is beside the picture, has none.

        Args:
            parts: points (n, 3) of each [m].
        """
        out = []
        for points in parts:
            at, _ = self.seen(points)
            low, high = at.min(axis=0), at.max(axis=0)
            if (high > 0.0).all() and (low < self.area).all():  # False for NaN
                out.append([*low, *high])
        return np.array(out).reshape(-1, 4)


def leader_end(anchor: FloatArray, corner: FloatArray, size: FloatArray) -> FloatArray:
    """Find the point of a box nearest to its anchor, (2,)."""
    return np.clip(anchor, corner, corner + size)


def names_of_image(world: World, top_mm: float | None = None) -> list[Name]:
    """List the names X-ray source, sample and detector with their places [m].

    The sample's is at its top, `top_mm` (None: its origin), so as not to cover it; the
    detector's a quarter of the image's width aside.
    """
    sample = np.array(world.sample.shift)
    if top_mm is not None:
        sample[2] = top_mm
    image = world.detector + world.u * (0.25 * world.shape[1]) - world.normal
    named = (
        ("X-ray source", world.source),
        ("sample", sample),
        ("detector", image),
    )
    return [(words, at * MM) for words, at in named]


def names_of_parts(
    machine: Machine, poses: Mapping[str, tuple[float, ...]]
) -> list[Name]:
    """List parts that move or have a role, with the place [m] of a corner; from their
    poses (w, x, y, z, place [m]), those without one left out.

    The corner is the upper one towards +x; underscores of names become blanks.
    """
    out = []
    for part in machine.components:
        if (pose := poses.get(part.name)) is not None and (
            part.axis is not None or part.role
        ):
            (x, _, z) = part.size_mm
            middle = np.array(part.center_mm)
            turn = Rotation.from_quat(pose[:4], scalar_first=True)
            at = turn.apply((middle + [x / 2, 0.0, z / 2]) * MM) + pose[4:]
            out.append((part.name.replace("_", " "), np.asarray(at)))
    return out


def _stays(before: FloatArray, now: FloatArray) -> bool:
    """Check that a named point has not moved by more than `STILL_M` since the last call."""
    return float(np.linalg.norm(now - before)) <= STILL_M


class NameTags:
    """Names in the scene of each client, as its own camera sees them."""

    def __init__(self) -> None:
        self._drawn: dict[int, tuple[str, set[str]]] = {}
        """Client -> what its names were placed for, and the words that are drawn."""
        self._points: dict[int, dict[str, FloatArray]] = {}
        """Client -> words and the points that they named at the last call."""

    def leave(self, client: viser.ClientHandle) -> None:
        """Remove the names that are drawn, as they are about to be somewhere else; the next
        `draw` has those that stay."""
        _, drawn = self._drawn.get(client.client_id, ("", set()))
        if not drawn:
            return
        self._drawn[client.client_id] = "", set()
        with client.atomic():
            for gone in drawn:
                client.scene.remove_by_name(f"/names/{gone}")
            client.scene.remove_by_name("/names/leaders")

    def draw(
        self,
        client: viser.ClientHandle,
        names: Sequence[Name],
        covered: FloatArray,
        shown: FloatArray = NO_BOXES,
    ) -> None:
        """Put the names where they have room now; nothing is sent while nothing has
        moved.

        A name leaves while its point moves, and comes back at rest: it would be led to where the
        part was. No names are drawn in a picture narrower than `LEAST_PX`; names behind the camera
        are left out. Names that no longer have room are removed. A leader joins each name
        to its point. A node keeps its words for good: a browser takes a while to set
        others, and would show those before at the new place.

        Args:
            client: with its camera.
            names: words and points [m, world].
            covered: boxes (m, 4) that its page lays over the picture: left, top, right,
                bottom [px].
            shown: boxes (k, 4) of what the picture is about, covered only for want of room.
        """
        sight = Sight.of(client)
        area = sight.area
        before_at = self._points.get(client.client_id, {})
        self._points[client.client_id] = dict(names)
        rest = [(w, p) for w, p in names if _stays(before_at.get(w, p), p)]
        names = rest if area[0] >= LEAST_PX else []
        key = [
            area,
            sight.fov,
            sight.eye.round(4),
            sight.axes.round(4),
            [(w, p.round(4)) for w, p in names],
            covered.round(0),
            shown.round(0),
        ]
        before, drawn = self._drawn.get(client.client_id, ("", set()))
        if before == (seen := str(key)):
            return
        points = np.array([point for _, point in names]).reshape(-1, 3)
        anchors, depth = sight.seen(points)
        sizes = np.array(
            [[PAD_PX + LETTER_PX * len(words), LINE_PX] for words, _ in names]
        )
        sizes = sizes.reshape(-1, 2)
        corners = laid_out(anchors, sizes, area, covered, shown)
        there = np.flatnonzero(~np.isnan(corners[:, 0])).tolist()

        def in_space(places: FloatArray, k: int) -> FloatArray:
            flat = (places - 0.5 * np.array(area)) * depth[k] / sight.scale
            return np.asarray(sight.eye + np.append(flat, depth[k]) @ sight.axes)

        with client.atomic():
            for gone in drawn - {names[k][0] for k in there}:
                client.scene.remove_by_name(f"/names/{gone}")
            lines = []
            for k in there:
                place = in_space(corners[k] + 0.5 * sizes[k], k)
                end = leader_end(anchors[k], corners[k], sizes[k])
                lines.append([in_space(end, k), points[k]])
                words = names[k][0]
                client.scene.add_label(
                    f"/names/{words}", words, position=place, anchor="center-center"
                )
            client.scene.add_line_segments(
                "/names/leaders",
                np.array(lines or np.zeros((1, 2, 3)), np.float32),
                LEADER,
                thickness=2.0,
                thickness_units="screen",
            )
        self._drawn[client.client_id] = seen, {names[k][0] for k in there}
