"""Names of visible parts; no name covers another.

Their places are a pure function of boxes in pixels. A name's box goes to the free place
nearest to its point, and a leader joins the two. The names then share these places so
that their leaders are shortest together: none crosses another. `NameTags` draws them in
the views of browsers, whose cameras determine the boxes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

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
NO_BOXES: Final = np.zeros((0, 4))
Name = tuple[str, FloatArray]
"""Words, and the point (3,) that they name [m, world]."""


def laid_out(
    anchors: FloatArray,
    sizes: FloatArray,
    area: tuple[float, float],
    taken: FloatArray = NO_BOXES,
) -> FloatArray:
    """Place the names' boxes.

    From top to bottom, each near its point at a place that covers few others: a covered
    point weighs as much as four rings farther away. Then names are exchanged so that
    leaders do not cross. Places are on rings around a point
    (`RINGS_PX`, `WAYS` directions), inside the area, off `taken`, `GAP_PX` from other boxes; nearer
    and higher ones are preferred. All boxes are treated as large as the largest.

    Args:
        anchors: (n, 2) named points [px]; NaN or outside the picture: no name.
        sizes: (n, 2) widths and heights of the boxes [px].
        area: width and height of the picture [px].
        taken: (m, 4) boxes where no name may be: left, top, right, bottom [px].

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
        low, high = middles[:, None] - 0.5 * size, middles[:, None] + 0.5 * size
        apart &= ((high <= taken[:, :2]) | (low >= taken[:, 2:])).any(2).all(1)
        covered = (
            (np.abs(middles[:, None] - anchors) < 0.5 * size + GAP_PX)
            .all(axis=2)
            .sum(axis=1)
        )
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


def leader_end(anchor: FloatArray, corner: FloatArray, size: FloatArray) -> FloatArray:
    """Find the point of a box nearest to its anchor, (2,)."""
    return np.clip(anchor, corner, corner + size)


def names_of_image(world: World, top_mm: float | None = None) -> list[Name]:
    """List the names X-ray source, sample and detector with their places [m]; "detector"
    is beside the panel's centre.

    The sample's place is above its origin, so that its name does not cover it where the
    camera is near; "detector" is a quarter of the image's width to the side.

    Args:
        world: the machine's pose.
        top_mm: height of the sample's highest point; None is its origin's.
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


class NameTags:
    """Names in the scene of each client, as its own camera sees them."""

    def __init__(self) -> None:
        self._drawn: dict[int, tuple[str, set[str]]] = {}
        """Client -> what its names were placed for, and the words that are drawn."""

    def draw(
        self, client: viser.ClientHandle, names: Sequence[Name], covered: FloatArray
    ) -> None:
        """Put the names where they have room now; nothing is sent while nothing has
        moved.

        No names are drawn in a picture narrower than `LEAST_PX`; names behind the camera
        are left out. Names that no longer have room are removed. A leader joins each name
        to its point. A node keeps its words for good: a browser takes a while to set
        others, and would show those before at the new place.

        Args:
            client: with its camera.
            names: words and points [m, world].
            covered: boxes (m, 4) that its page lays over the picture: left, top, right,
                bottom [px].
        """
        camera = client.camera
        area = float(camera.image_width), float(camera.image_height)
        names = names if area[0] >= LEAST_PX else ()
        eye = camera.position
        ahead = camera.look_at - camera.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, camera.up_direction)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        key = [
            area,
            camera.fov,
            eye.round(4),
            axes.round(4),
            [(w, p.round(4)) for w, p in names],
            covered.round(0),
        ]
        before, drawn = self._drawn.get(client.client_id, ("", set()))
        if before == (seen := str(key)):
            return
        points = np.array([point for _, point in names]).reshape(-1, 3)
        x, y, depth = axes @ (points - eye).T
        depth[depth < 0.02] = np.nan
        scale = 0.5 * area[1] / math.tan(0.5 * camera.fov)
        middle = 0.5 * np.array(area)
        anchors = middle + scale * np.stack([x, y], axis=1) / depth[:, None]
        sizes = np.array(
            [[PAD_PX + LETTER_PX * len(words), LINE_PX] for words, _ in names]
        )
        sizes = sizes.reshape(-1, 2)
        corners = laid_out(anchors, sizes, area, covered)
        there = np.flatnonzero(~np.isnan(corners[:, 0])).tolist()

        def in_space(places: FloatArray, k: int) -> FloatArray:
            flat = np.append((places - middle) * depth[k] / scale, depth[k])
            return np.asarray(eye + flat @ axes)

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
