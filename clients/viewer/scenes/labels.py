"""Where names stand in a picture, so that none covers another: a pure function of boxes in pixels.

A name's box goes to the free place nearest to the point that it names, and a leader joins the two.
Where leaders cross, names change places, which shortens both leaders, for as long as any do.

`NameTags` draws them in the views of browsers, whose cameras decide where the boxes are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes.sample import MM
from flexdt.clients.viewer.scenes.world import World
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine

WAYS, RINGS_PX = 24, (26.0, 44.0, 66.0, 92.0, 124.0, 164.0, 220.0, 300.0, 420.0)
"""Directions and distances in which a place is looked for, the near ones first."""
GAP_PX = 5.0
"""Between boxes, and to the picture's edge."""


def laid_out(anchors: FloatArray, sizes: FloatArray, area: tuple[float, float]) -> FloatArray:
    """Top left corners (n, 2) of the names' boxes; NaN where a name has no room.

    Args:
        anchors: (n, 2) what is named [px]; NaN or outside the picture: no name.
        sizes: (n, 2) widths and heights of the boxes [px].
        area: width and height of the picture [px].
    """
    turns = np.arange(WAYS) * 2.0 * math.pi / WAYS
    ways = np.stack([np.cos(turns), -np.sin(turns)], axis=1)
    out = np.full((len(anchors), 2), np.nan)
    for k in np.argsort(anchors[:, 1]):
        if not ((anchors[k] >= 0.0) & (anchors[k] <= area)).all():
            continue
        middles = np.concatenate([anchors[k] + r * ways + 0.5 * sizes[k] * ways for r in RINGS_PX])
        best = math.inf
        for n, corner in enumerate(middles - 0.5 * sizes[k]):
            if not _free(corner, sizes[k], out, sizes, area):
                continue
            covered = ((anchors > corner - GAP_PX) & (anchors < corner + sizes[k] + GAP_PX)).all(1)
            ends = corner + 0.5 * sizes[k], anchors[k]
            through = sum(_cross(*ends, a, b) for a, b in _leaders(anchors, out, sizes))
            cost = n // WAYS + 4.0 * (covered.sum() + through) + 0.5 * (1.0 + ways[n % WAYS, 1])
            if cost < best:
                best, out[k] = cost, corner
    return _uncrossed(anchors, out, sizes, area)


def leader_end(anchor: FloatArray, corner: FloatArray, size: FloatArray) -> FloatArray:
    """The point of a box that is nearest to what it names, (2,)."""
    return np.clip(anchor, corner, corner + size)


def _free(
    corner: FloatArray, size: FloatArray, others: FloatArray, sizes: FloatArray,
    area: tuple[float, float],
) -> bool:  # fmt: skip
    if (corner < GAP_PX).any() or (corner + size > np.asarray(area) - GAP_PX).any():
        return False
    apart = (corner + size + GAP_PX <= others) | (others + sizes + GAP_PX <= corner)
    return bool((apart.any(axis=1) | np.isnan(others[:, 0])).all())


def _leaders(
    anchors: FloatArray, corners: FloatArray, sizes: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    there = np.flatnonzero(~np.isnan(corners[:, 0]))
    return [(corners[k] + 0.5 * sizes[k], anchors[k]) for k in there]


def _uncrossed(
    anchors: FloatArray, corners: FloatArray, sizes: FloatArray, area: tuple[float, float]
) -> FloatArray:
    middles, there = corners + 0.5 * sizes, np.flatnonzero(~np.isnan(corners[:, 0]))
    pairs = [(i, j) for i in there for j in there if i < j]
    changed = True
    while changed:  # it ends: each change makes the sum of the leaders shorter
        changed = False
        for i, j in pairs:
            if not _cross(middles[i], anchors[i], middles[j], anchors[j]):
                continue
            swapped = middles.copy()
            swapped[[i, j]] = middles[[j, i]]
            others = swapped - 0.5 * sizes
            others[[i, j]] = np.nan
            mine, other = (swapped[k] - 0.5 * sizes[k] for k in (i, j))
            fits = _free(mine, sizes[i], others, sizes, area)
            others[i] = mine
            if fits and _free(other, sizes[j], others, sizes, area):
                middles, changed = swapped, True
    return middles - 0.5 * sizes


def _cross(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    """Whether the lines from a to b and from c to d cross."""

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0


LETTER_PX, LINE_PX, PAD_PX = 6.6, 17.0, 10.0
"""Widest letter, height and margin of viser's labels on a screen."""
LEAST_PX = 260
"""A view that is narrower has no names."""
LEADER = (40, 150, 235)
Name = tuple[str, FloatArray]
"""Words, and the point (3,) that they name [m, world]."""


def names_of_image(world: World) -> list[Name]:
    """Source, sample and detector."""
    image = world.detector + world.u * (0.25 * world.shape[1]) - world.normal
    named = ("X-ray source", world.source), ("sample", world.sample.shift), ("detector", image)
    return [(words, at * MM) for words, at in named]


def names_of_parts(machine: Machine, poses: Mapping[str, tuple[float, ...]]) -> list[Name]:
    """Parts that move or have a role, at a corner, from their poses (w, x, y, z, place [m])."""
    out = []
    for part in machine.components:
        if (pose := poses.get(part.name)) is not None and (part.axis is not None or part.role):
            (x, _, z), middle = part.size_mm, np.array(part.center_mm)
            turn = Rotation.from_quat(pose[:4], scalar_first=True)
            at = turn.apply((middle + [x / 2, 0.0, z / 2]) * MM) + pose[4:]
            out.append((part.name.replace("_", " "), np.asarray(at)))
    return out


class NameTags:
    """Names in the scene of each client, as its own camera sees them."""

    def __init__(self) -> None:
        self._drawn: dict[int, object] = {}

    def draw(self, client: viser.ClientHandle, names: Sequence[Name]) -> None:
        """Put the names where they have room now; nothing is sent while nothing has moved."""
        camera = client.camera
        area = float(camera.image_width), float(camera.image_height)
        names = names if area[0] >= LEAST_PX else ()
        eye, ahead = camera.position, camera.look_at - camera.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, camera.up_direction)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        key = [area, camera.fov, eye.round(4), axes.round(4), [(w, p.round(4)) for w, p in names]]
        if self._drawn.get(client.client_id) == (seen := str(key)):
            return
        self._drawn[client.client_id] = seen
        points = np.array([point for _, point in names]).reshape(-1, 3)
        x, y, depth = axes @ (points - eye).T
        depth[depth < 0.02] = np.nan
        scale = 0.5 * area[1] / math.tan(0.5 * camera.fov)
        middle = 0.5 * np.array(area)
        anchors = middle + scale * np.stack([x, y], axis=1) / depth[:, None]
        sizes = np.array([[PAD_PX + LETTER_PX * len(words), LINE_PX] for words, _ in names])
        sizes = sizes.reshape(-1, 2)
        corners = laid_out(anchors, sizes, area)
        there = np.flatnonzero(~np.isnan(corners[:, 0]))

        def in_space(places: FloatArray, k: int) -> FloatArray:
            flat = np.append((places - middle) * depth[k] / scale, depth[k])
            return np.asarray(eye + flat @ axes)

        with client.atomic():
            for old in range(len(there), 64):
                handle: Any = client.scene.get_handle_by_name(f"/names/{old}")
                if handle is None:
                    break
                handle.remove()
            lines = []
            for n, k in enumerate(there.tolist()):
                place = in_space(corners[k] + 0.5 * sizes[k], k)
                end = leader_end(anchors[k], corners[k], sizes[k])
                lines.append([in_space(end, k), points[k]])
                client.scene.add_label(
                    f"/names/{n}", names[k][0], position=place, anchor="center-center"
                )
            client.scene.add_line_segments(
                "/names/leaders", np.array(lines or np.zeros((1, 2, 3)), np.float32), LEADER,
                thickness=2.0, thickness_units="screen",
            )  # fmt: skip
