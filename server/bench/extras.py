"""What is measured besides the cases with peers: scenes, meshes, the adjoint, FDK, cold start,
memory, and the way through the projector server.

Each function returns entries for the document; none prints.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from flexdt.server.bench.cases import (
    BINNED,
    C1_SHAPE,
    FULL,
    circle,
    noise,
    peer_cases,
    untuned_cases,
)
from flexdt.server.bench.measure import interleaved
from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection import Volume, back, forward, project_mesh, project_scene, room_like
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.mesh import TriangleMesh
from flexdt.twin.projection.shapes import Box, Scene, Solid, Sphere

Entry = dict[str, Any]


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

        def call(view: ConeVec = view, out: Any = out) -> None:
            project_scene(scene, view, out.shape[1:], out)

        entries.append(_entry(name, 1, {"flexdt": call}, "box and five beads, analytic"))
    return entries


def ball_mesh(subdivisions: int) -> TriangleMesh:
    """A ball of 20 * 4^n triangles, 20 mm across."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=10.0)
    return TriangleMesh(ball.vertices, ball.faces)


def meshes() -> list[Entry]:
    """Triangle meshes, against the analytic ball they approach and against embreex if installed."""
    entries = []
    view = circle(1, BINNED)
    out = np.empty((1, *BINNED), np.float32)
    ball = project_scene(Scene((Solid(Sphere((0, 0, 0), 10.0), "abs", 1.0),)), view, BINNED)
    for subdivisions in (3, 5):
        mesh = ball_mesh(subdivisions)

        def call(mesh: TriangleMesh = mesh) -> None:
            project_mesh(mesh, view, BINNED, out)

        calls: dict[str, Callable[[], object]] = {"flexdt": call}
        embree = _embree(mesh, view, BINNED)
        if embree is not None:
            calls["embreex"] = embree
        what = f"a ball of {len(mesh.faces)} triangles"
        entry = _entry(f"mesh-{len(mesh.faces)}", 1, calls, what)
        entry["worst_against_ball"] = float(np.abs(out - ball).max() / ball.max())
        entries.append(entry)
    return entries


ADJOINT = (
    "C1", "C1x36", "C1-tilt", "C2", "C3", "C2-tilt", "C3-tilt", "cone-60", "cone-60-tilt",
    "tilt-45", "roll-90", "roll-90-tilt", "near", "flat", "anisotropic", "on-axis", "C1x1000",
)  # fmt: skip
"""Cases whose adjoint is measured."""
INTO_NEW = ("C1", "C1-tilt")
"""Those of them in which it is measured without memory given to it, too."""


def adjoint_names() -> list[str]:
    """Names of what `adjoint` measures."""
    return [f"adjoint-{n}" for n in ADJOINT] + [f"adjoint-{n}-new" for n in INTO_NEW]


def adjoint(wanted: Callable[[str], bool]) -> list[Entry]:
    """`back` beside `forward`, and how well they are each other's transpose.

    Both write into memory they are given; in `-new` entries `back` asks for new memory.
    """
    cases = {case.name: case for case in [*peer_cases(), *untuned_cases()]}
    entries = []
    for name in adjoint_names():
        if not wanted(name):
            continue
        new = name.endswith("-new")
        case = cases[name.removeprefix("adjoint-").removesuffix("-new")]
        volume, views = case.volume(), len(case.geometry)
        y = np.random.default_rng(1).random((views, *case.shape), dtype=np.float32)
        out, room = np.empty_like(y), room_like(volume)

        def ahead(volume: Volume = volume, view: ConeVec = case.geometry, out: Any = out) -> None:
            forward(volume, view, out.shape[1:], out)

        def behind(
            volume: Volume = volume,
            view: ConeVec = case.geometry,
            y: Any = y,
            into: Any = None if new else room,
        ) -> None:
            back(y, view, volume, into)

        calls: dict[str, Callable[[], object]] = {"flexdt": behind, "forward": ahead}
        what = "back against forward" + (", into new memory" if new else "")
        entry = _entry(name, views, calls, what)
        left = float(np.vdot(out.astype(np.float64), y))
        spread = back(y, case.geometry, volume, room).data
        right = float(np.vdot(spread.astype(np.float64), volume.data))
        entry["dot_product_error"] = abs(left - right) / abs(left)
        beside = entry["peers"].pop("forward")
        entry["times_forward"] = entry["ms_per_view"] / beside["ms_per_view"]
        entry["ratio"].pop("forward")
        entries.append(entry)
    return entries


def fdk_entry(rtk: bool) -> Entry:
    """FDK of 360 views of 478 x 380 pixels into 256^3, against RTK's."""
    from flexdt.twin.reconstruction import fdk

    shape, views, side = (380, 478), 360, 256
    geometry = circle(views, shape, pitch=0.3)
    scene = Scene((Solid(Sphere((5.0, -3.0, 4.0), 12.0), "abs", 0.02),))
    images = project_scene(scene, geometry, shape)
    grid = Volume(np.zeros((side,) * 3, np.float32), 0.2)
    result: dict[str, Any] = {}

    def ours() -> None:
        result["flexdt"] = fdk(images, geometry, grid).data

    calls: dict[str, Callable[[], object]] = {"flexdt": ours}
    if rtk:
        calls["itk-rtk"] = _rtk_fdk(images, geometry, grid, result)
    what, once = "360 views of 478 x 380 into 256^3", frozenset({"itk-rtk"})
    entry = _entry("FDK", 1, calls, what, once)
    z, y, x = np.meshgrid(*(grid.centers()[i] for i in (2, 1, 0)), indexing="ij", sparse=True)
    inside = (x - 5) ** 2 + (y + 3) ** 2 + (z - 4) ** 2 < 10.0**2
    for name, data in result.items():
        target = entry if name == "flexdt" else entry["peers"][name]
        target["mean_error"] = abs(float(data[inside].mean()) - 0.02) / 0.02
    return entry


def cold_start() -> list[Entry]:
    """A new process until its first image of C1: with kernels on disk, and with none anywhere."""
    code = (
        "import time; t = time.perf_counter(); "
        "from flexdt.server.bench.cases import BINNED, circle; "
        "from flexdt.twin.projection import Volume, forward; import numpy as np; "
        "v = Volume(np.ones((8, 8, 8), np.float32), 0.1); "
        "forward(v, circle(1, BINNED), BINNED); print(time.perf_counter() - t)"
    )
    entries = []
    for name, what in (
        ("cold-cached", "new process, kernels on disk"),
        ("cold-uncached", "new process, everything compiled"),
    ):
        with tempfile.TemporaryDirectory() as folder:
            env = {**os.environ, **({"NUMBA_CACHE_DIR": folder} if "un" in name else {})}
            done = subprocess.run(
                [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
            )
        ms = float(done.stdout) * 1e3
        entries.append(_plain(name, ms, what))
    return entries


def through_server() -> list[Entry]:
    """C1 asked for over TCP beside the same projection in this process."""
    command = [sys.executable, "-m", "flexdt.server.child", "flexdt.server.projector_main"]
    with subprocess.Popen(
        [*command, "--port", "0"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            ready = json.loads(process.stdout.readline())
            return asyncio.run(_through(ready["host"], ready["port"]))
        finally:
            process.terminate()


async def _through(host: str, port: int) -> list[Entry]:
    from flexdt.server.projector_client import ProjectorClient

    volume, view = noise(C1_SHAPE), circle(1, BINNED)
    out = np.empty((1, *BINNED), np.float32)
    remote, direct = [], []
    async with ProjectorClient(host, port, patience_s=120.0) as client:
        await client.put_volume("C1", volume)
        await client.project("C1", view, BINNED)
        forward(volume, view, BINNED, out)
        for _ in range(15):
            start = time.perf_counter()
            images = await client.project("C1", view, BINNED)
            remote.append(time.perf_counter() - start)
            start = time.perf_counter()
            forward(volume, view, BINNED, out)
            direct.append(time.perf_counter() - start)
        await client.remove("C1")
    same = bool(np.array_equal(images, out))
    entry = _plain("server-C1", min(remote) * 1e3, "C1 through the projector server")
    entry["median_ms_per_view"] = float(np.median(remote)) * 1e3
    entry["direct_ms"] = min(direct) * 1e3
    entry["added_ms"] = (min(remote) - min(direct)) * 1e3
    entry["same_bytes"] = same
    return [entry]


def _entry(
    name: str,
    views: int,
    calls: dict[str, Callable[[], object]],
    what: str,
    once: frozenset[str] = frozenset(),
) -> Entry:
    timing = interleaved(calls, once=once)
    ours = timing.pop("flexdt")
    entry = _plain(name, ours.best * 1e3 / views, what)
    entry["views"] = views
    entry["median_ms_per_view"] = ours.median * 1e3 / views
    for peer, seen in timing.items():
        entry["peers"][peer] = {"ms_per_view": seen.best * 1e3 / views, "mean_error": None}
        entry["ratio"][peer] = seen.best / ours.best
    return entry


def _plain(name: str, ms: float, what: str) -> Entry:
    return {
        "name": name,
        "what": what,
        "views": 1,
        "ms_per_view": ms,
        "mean_error": None,
        "worst_error": None,
        "peers": {},
        "ratio": {},
        "threads": threads(),
    }


def _embree(
    mesh: TriangleMesh, view: ConeVec, shape: tuple[int, int]
) -> Callable[[], object] | None:
    """Path lengths through embreex: enter and leave distances from repeated first hits."""
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh as EmbreeMesh
    except ImportError:
        return None
    scene = rtcore_scene.EmbreeScene()
    triangles = mesh.vertices[mesh.faces].astype(np.float32)
    EmbreeMesh(scene, triangles)
    ends = view.pixel_centers(shape)[0].reshape(-1, 3)
    source = view.source[0]
    ray = ends - source
    length = np.linalg.norm(ray, axis=1)
    directions = np.ascontiguousarray((ray / length[:, None]).astype(np.float32))
    origins = np.ascontiguousarray(np.broadcast_to(source, ends.shape).astype(np.float32))
    backward = np.ascontiguousarray(-directions)
    far = np.ascontiguousarray(ends.astype(np.float32))

    def call() -> object:
        # A convex body: the first hit from either side is all there is.
        enter = scene.run(origins, directions, query="DISTANCE")
        leave = scene.run(far, backward, query="DISTANCE")
        return np.where(enter < 1e30, length - enter - leave, 0.0)

    return call


def _rtk_fdk(images: Any, geometry: ConeVec, grid: Volume, result: dict[str, Any]) -> Any:
    import itk
    from itk import RTK as rtk

    from flexdt.server.bench.peers import rtk_geometry, rtk_stack, rtk_volume

    kind = itk.Image[itk.F, 3]
    stack, shape = rtk_stack(images, geometry.rows), rtk_volume(grid)
    keep = rtk_geometry(geometry.rows)

    def call() -> None:
        fdk = rtk.FDKConeBeamReconstructionFilter[kind].New()
        fdk.SetInput(0, shape)
        fdk.SetInput(1, stack)
        fdk.SetGeometry(keep)
        fdk.GetRampFilter().SetTruncationCorrection(0.0)
        fdk.GetRampFilter().SetHannCutFrequency(0.0)
        fdk.Update()
        data = itk.array_from_image(fdk.GetOutput())
        # Back from (-y, z, x).
        result["itk-rtk"] = data[::-1].transpose(1, 0, 2)

    return call


def bandwidth() -> Entry:
    """Bytes a second that plain reading gets from memory, with one thread and with all."""
    from flexdt.server.bench.bandwidth_kernels import read_all

    data = np.ones(2**27, np.float32)
    entry: Entry = {}
    for name, workers in (("one_thread", 1), ("all_threads", threads())):
        read_all(data, workers)
        best = math.inf
        for _ in range(5):
            start = time.perf_counter()
            read_all(data, workers)
            best = min(best, time.perf_counter() - start)
        entry[f"{name}_GB_s"] = data.nbytes / best / 1e9
    return entry
