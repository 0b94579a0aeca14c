"""Analytic scenes and triangle meshes: how fast, and how far from the same integrals in plain
double-precision NumPy. Each function returns entries for the document; none prints.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexdt.server.bench.cases import BINNED, FULL, circle
from flexdt.server.bench.measure import Entry, errors, timed
from flexdt.server.bench.peers import Embree
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import project_mesh, project_scene
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid, Sphere
from flexdt.twin.projection.mesh import TriangleMesh

CHECKED = 300
"""Rays through a mesh that are compared with the reference."""


def bead_scene() -> Scene:
    """A box with five steel beads, the usual calibration phantom."""
    beads = [Sphere((i - 2.0, 2 * i - 4.0, 8.0 * (i - 2)), 1.0) for i in range(5)]
    box = Solid(Box((0, 0, 0), (16.0, 24.0, 49.8)), "abs", 0.02)
    return Scene((box, *(Solid(bead, "steel", 0.3) for bead in beads)))


def scenes() -> list[Entry]:
    """Analytic scenes on both detectors."""
    scene = bead_scene()
    entries = []
    for name, shape in (("scene-C1", BINNED), ("scene-C3", FULL)):
        out = np.empty((1, *shape), np.float32)
        view = circle(1, shape)

        def call(view: ConeVec = view, out: Float32Array = out) -> None:
            project_scene(scene, view, (out.shape[1], out.shape[2]), out)

        entry = timed(name, 1, {"flexdt": call}, "box and five beads, analytic")
        entry["mean_error"], entry["worst_error"] = errors(out, scene_chords(scene, view, shape))
        entries.append(entry)
    return entries


def scene_chords(scene: Scene, view: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """Line integrals of balls and upright boxes in one view, (1, rows, cols): a quadratic and
    three pairs of planes for every ray, in double precision.
    """
    ray = view.pixel_centers(shape)[0] - view.source[0]
    square = np.einsum("rci,rci->rc", ray, ray)
    total = np.zeros(shape)
    for solid in scene.solids:
        match solid.shape:
            case Sphere(center, radius):
                p = view.source[0] - np.array(center)
                b = ray @ p
                root = np.sqrt(np.maximum(b * b - square * (p @ p - radius**2), 0.0))
                enter, leave = (-b - root) / square, (-b + root) / square
            case Box(center, size):
                p = np.array(center) - view.source[0]
                with np.errstate(divide="ignore"):
                    a, b = ((p + side * np.array(size) / 2) / ray for side in (-1, 1))
                enter = np.minimum(a, b).max(axis=2)
                leave = np.maximum(a, b).min(axis=2)
            case _:
                raise TypeError(f"no reference for {type(solid.shape).__name__}")
        inside = np.clip(leave, 0.0, 1.0) - np.clip(enter, 0.0, 1.0)
        total += solid.mu_per_mm * np.sqrt(square) * np.maximum(inside, 0.0)
    return np.asarray(total[None])


def ball_mesh(subdivisions: int) -> TriangleMesh:
    """A ball of 20 * 4^n triangles, 20 mm across."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=10.0)
    return TriangleMesh(ball.vertices, ball.faces)


def meshes(part: frozenset[str]) -> list[Entry]:
    """Triangle meshes, beside embreex if it takes part."""
    entries = []
    view = circle(1, BINNED)
    out = np.empty((1, *BINNED), np.float32)
    for subdivisions in (3, 5):
        mesh = ball_mesh(subdivisions)

        def call(mesh: TriangleMesh = mesh) -> None:
            project_mesh(mesh, view, BINNED, out)

        calls: dict[str, Callable[[], object]] = {"flexdt": call}
        embree = Embree(mesh, view, BINNED) if "embreex" in part else None
        if embree is not None:
            calls["embreex"] = embree.run
        what = f"a ball of {len(mesh.faces)} triangles; errors of {CHECKED} rays"
        entry = timed(f"mesh-{len(mesh.faces)}", 1, calls, what)
        lit = np.argwhere(out[0])
        pixels = lit[np.random.default_rng(0).choice(len(lit), CHECKED, replace=False)]
        exact = mesh_paths(mesh, view, BINNED, pixels)
        at = (0, *pixels.T)
        entry["mean_error"], entry["worst_error"] = errors(out[at], exact)
        if embree is not None:
            entry["peers"]["embreex"]["mean_error"] = errors(embree.images()[at], exact)[0]
        entries.append(entry)
    return entries


def mesh_paths(
    mesh: TriangleMesh, view: ConeVec, shape: tuple[int, int], pixels: np.ndarray[tuple[int, ...]]
) -> FloatArray:
    """Path lengths [mm] of single rays through the same triangles: every triangle asked for every
    ray (Moeller and Trumbore), in double precision.

    Args:
        pixels: (k, 2) row, column.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    one, two, start = b - a, c - a, view.source[0] - a
    across = np.cross(start, one)
    ends = view.pixel_centers(shape)[0]
    result = np.zeros(len(pixels))
    for i, (r, column) in enumerate(pixels):
        ray = ends[r, column] - view.source[0]
        p = np.cross(ray, two)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / np.einsum("ij,ij->i", one, p)
            u = scale * np.einsum("ij,ij->i", start, p)
            v = scale * (across @ ray)
            t = scale * np.einsum("ij,ij->i", two, across)
        hit = np.isfinite(scale) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        # Seen from outside, a triangle that turns its front to the source is an entry.
        away = -np.sign(scale[hit])
        result[i] = float(np.sum(away * np.clip(t[hit], 0.0, 1.0)) * np.linalg.norm(ray))
    return result
