"""One item of a batch: plan and index in, arrays and figures out. Any process can do it alone.

An item that fails becomes an outcome that states the reason. No files are read or written.

The plan's draws take their values from the item's own seed: item i draws from
`SeedSequence(seed).spawn(items)[i]`, which any process can make by itself, so items come out
the same in any order and with any number of processes.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Final, assert_never

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom, bead_phantom, load_phantom, material, stated_keV
from flexdt.phantoms.channels import chain_through, channels, line_integrals
from flexdt.phantoms.scan_limits import (
    check_distances,
    check_placement,
    check_tube,
    open_beam_doubts,
)
from flexdt.twin.calibration import (
    BeadModel,
    FitResult,
    bead_model,
    spot_radii,
    visible_beads,
)
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, SpotFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, builtin_machine
from flexdt.twin.physics import (
    Chain,
    ExposureSettings,
    detector_of,
    expected_signal,
    expose,
    ideal_response,
    open_beam,
    read_out,
    tube_of,
)
from flexdt.twin.projection import Scene, Solid, Sphere, Volume, project_body
from flexdt.twin.reconstruction import fdk
from flexdt_extensions.batch.batch_plan import Cuboid, Plan, Spheres, parse_plan

VALUES = 0
NOISE = 1
SHAPES = 2
"""Streams of an item's seed: scalar draws in the plan's order, noise, the phantom's parts."""
MAX_TRIES: Final = 2000
"""Largest number of places tried for a sphere before a phantom counts as impossible."""


def seed_of(plan: Plan, index: int, *stream: int) -> np.random.SeedSequence:
    """Return the seed of item `index`, or of one of its streams."""
    return np.random.SeedSequence(plan.batch.seed, spawn_key=(index, *stream))


@dataclass(frozen=True, eq=False)
class Item:
    """One item, ready to be computed.

    Attributes:
        index: number in the batch.
        phantom: the scanned one.
        poses: nominal.
        truth: hidden offsets, true minus nominal.
        shape: detector (rows, cols).
        machine, camera: None for a made-up detector's camera.
        exposure: tube and time.
        noise_px, counts: of calibrations.
        parameters: everything drawn, JSON-able.
    """

    index: int
    phantom: Phantom
    poses: Poses
    truth: Offsets
    shape: tuple[int, int]
    machine: Machine
    camera: CameraSettings | None
    exposure: ExposureSettings
    noise_px: float
    counts: float
    parameters: dict[str, Any]


def draw_item(plan: Plan, index: int) -> Item:
    """Draw all values of item `index` of a plan, its phantom and its poses.

    Of projections the phantom's placement and the tube are checked, and with a machine's
    camera the distances.

    Args:
        plan: of the batch.
        index: number of the item; with the plan's seed it determines all draws.

    Raises:
        TwinError: a draw that no phantom or machine can be, e.g. beads that do not fit.
    """
    rng = np.random.default_rng(seed_of(plan, index, VALUES))
    g = plan.geometry
    images = plan.images
    calibrate = plan.calibrate
    drawn: dict[str, Any] = {
        name: getattr(g, name).sample(rng)
        for name in ("sod_mm", "sdd_mm", "height_mm", "lateral_mm", "start_deg")
    }
    drawn |= {
        name: getattr(images, name).sample(rng)
        for name in ("kV", "power_W", "exposure_ms")
    }
    drawn |= {
        name: getattr(calibrate, name).sample(rng) for name in ("noise_px", "counts")
    }
    errors = {name: float(plan.errors[name].sample(rng)) for name in sorted(plan.errors)}
    phantom, described = _phantom(plan, index, rng)
    machine = builtin_machine(plan.camera.machine)
    camera, shape, pixel, shift = _camera(plan, machine)
    turn = math.radians(g.turn_deg) * np.arange(g.frames) / g.frames
    poses = Poses.upright(
        [0, 0, 0],
        [drawn["lateral_mm"], drawn["sod_mm"], drawn["height_mm"]],
        [shift[0], drawn["sdd_mm"], -shift[1]],
        pixel,
        math.radians(drawn["start_deg"]) + turn,
    )
    exposure = ExposureSettings(
        drawn["kV"], drawn["power_W"], drawn["exposure_ms"], plan.images.averages
    )
    parameters = {"phantom": described, **drawn, "errors": errors}
    if plan.batch.kind == "projections":
        true = poses.cone_vec(Offsets.from_edge(errors))
        check_placement(phantom, true, shape)
        check_tube(machine, exposure)
        if camera is not None:
            check_distances(machine, camera, exposure, drawn["sod_mm"], drawn["sdd_mm"])
    return Item(
        index,
        phantom,
        poses,
        Offsets.from_edge(errors),
        shape,
        machine,
        camera,
        exposure,
        float(drawn["noise_px"]),
        float(drawn["counts"]),
        parameters,
    )


def detector_shape(plan: Plan) -> tuple[int, int]:
    """Return (rows, cols) of every image of a plan.

    Raises:
        TwinError: no such machine, mode or ROI.
    """
    return _camera(plan, builtin_machine(plan.camera.machine))[1]


def _camera(
    plan: Plan, machine: Machine
) -> tuple[CameraSettings | None, tuple[int, int], float, tuple[float, float]]:
    """Determine the camera of a plan.

    With shape and pixel size in the plan it is a made-up detector; else the machine's
    camera with the plan's mode and ROI, if given.

    Args:
        plan: its camera table and averages.
        machine: of the plan.

    Returns:
        Camera (None for a made-up detector), shape (rows, cols), pixel [mm], and shift of
        the ROI from the panel's center along columns and rows [mm].

    Raises:
        TwinError: the ROI is not on the sensor.
    """
    wanted = plan.camera
    if wanted.shape is not None and wanted.pixel_mm is not None:
        return None, (wanted.shape[0], wanted.shape[1]), wanted.pixel_mm, (0.0, 0.0)
    standard = machine.detector.camera
    sensor = machine.detector.pixels
    if wanted.roi is None:
        roi = standard.roi
    else:
        roi = Roi(*wanted.roi)
    camera = replace(
        standard,
        mode=wanted.mode or standard.mode,
        roi=roi,
        averages=plan.images.averages,
    )
    if not (
        0 <= roi.left <= roi.right < sensor.columns
        and 0 <= roi.top <= roi.bottom < sensor.rows
    ):
        raise TwinError(
            f"camera.roi {list(roi.edges)} does not lie on the sensor of {sensor.columns} x "
            f"{sensor.rows} pixels",
            {
                "asked": list(roi.edges),
                "allowed": [0, 0, sensor.columns - 1, sensor.rows - 1],
            },
        )
    return camera, camera.shape, camera.pixel_mm(sensor), camera.roi_shift_mm(sensor)


def _phantom(
    plan: Plan, index: int, rng: np.random.Generator
) -> tuple[Phantom, dict[str, Any]]:
    """Draw an item's phantom as the plan says: one by name, a cuboid with beads, or
    spheres.

    Args:
        plan: of the batch.
        index: number of the item; seeds the spheres' parts.
        rng: of the other values.

    Returns:
        The phantom, and the drawn values by name for the manifest.
    """
    table = plan.phantom
    if table.name is not None:
        name = table.name.sample(rng)
        return load_phantom(name), {"name": name}
    if table.cuboid is not None:
        return _draw_cuboid(table.cuboid, rng)
    assert table.spheres is not None
    parts = np.random.default_rng(seed_of(plan, index, SHAPES))
    return _spheres(table.spheres, rng, parts)


def _draw_cuboid(
    table: Cuboid, rng: np.random.Generator
) -> tuple[Phantom, dict[str, Any]]:
    """Draw a cuboid with beads on a spiral from the plan's table; returns it and the
    drawn values by name.
    """
    values = {name: getattr(table, name).sample(rng) for name in type(table).model_fields}
    size = tuple(float(values[f"{side}_mm"]) for side in ("width", "breadth", "height"))
    made = bead_phantom(
        size,
        int(values["beads"]),
        bead_radius_mm=float(values["bead_radius_mm"]),
        body_material=values["body_material"],
        bead_material=values["bead_material"],
    )
    return made, {"name": made.name, **values}


def _spheres(
    table: Spheres, rng: np.random.Generator, parts: np.random.Generator
) -> tuple[Phantom, dict[str, Any]]:
    """Draw random spheres that do not touch, in a cylinder, whose size is the phantom's.

    Args:
        table: numbers, radii, materials and the cylinder.
        rng: of the number of spheres.
        parts: of radii, materials and places.

    Returns:
        The phantom, and its description for the manifest.

    Raises:
        TwinError: a sphere found no free place in `MAX_TRIES` tries.
    """
    wide = table.within_radius_mm
    high = table.within_height_mm / 2.0
    solids: list[Solid] = []
    listed: list[dict[str, Any]] = []
    for number in range(int(table.count.sample(rng))):
        radius = float(table.radius_mm.sample(parts))
        made_of = material(table.material.sample(parts))
        center = _draw_place(radius, wide, high, [s.shape for s in solids], parts)
        if center is None:
            raise TwinError(
                f"sphere {number + 1} of {radius:.3g} mm found no free place in a cylinder of "
                f"{wide:g} mm radius and {2 * high:g} mm height in {MAX_TRIES} tries",
                {"asked": radius, "allowed": [wide, high]},
            )
        solids.append(Solid(Sphere(center, radius), made_of.name, made_of.mu_per_mm))
        listed.append(
            {"center_mm": list(center), "radius_mm": radius, "material": made_of.name}
        )
    size = (2.0 * wide, 2.0 * wide, 2.0 * high)
    phantom = Phantom(
        f"spheres-{len(solids)}", "random spheres", Scene(tuple(solids)), size
    )
    return phantom, {"name": phantom.name, "spheres": listed}


def _draw_place(
    radius: float, wide: float, high: float, others: list[Any], rng: np.random.Generator
) -> tuple[float, float, float] | None:
    """Draw a place for a ball, uniform in a cylinder and clear of other balls.

    Args:
        radius: of the ball [mm].
        wide: radius of the cylinder [mm].
        high: half its height [mm].
        others: spheres that are there.
        rng: generator.

    Returns:
        The center [mm]; None for a ball that does not fit into the cylinder, or if none
        was found in MAX_TRIES.
    """
    if radius > wide or radius > high:
        return None
    for _ in range(MAX_TRIES):
        distance = (wide - radius) * math.sqrt(rng.uniform())
        turn = rng.uniform(0.0, 2.0 * math.pi)
        at = (
            distance * math.cos(turn),
            distance * math.sin(turn),
            rng.uniform(-(high - radius), high - radius),
        )
        if all(math.dist(at, o.center) >= radius + o.radius for o in others):
            return at
    return None


Array = npt.NDArray[Any]
Counts = npt.NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class ItemOutcome:
    """Result of an item.

    Attributes:
        index: number in the batch.
        record: its line in the manifest: seed, parameters, status, figures, sha256 of
            each array.
        arrays: name -> values, with the shapes of `layout`.
    """

    index: int
    record: dict[str, Any]
    arrays: Mapping[str, Array] = field(default_factory=dict)


def layout(plan: Plan) -> dict[str, tuple[tuple[int, ...], str]]:
    """List the arrays of every item of a plan: name -> (shape, dtype).

    Projections are uint16 (counts) or float32; volumes only if the plan reconstructs;
    calibrations have geometries alone.

    Raises:
        TwinError: no such machine, mode or ROI.
    """
    frames = plan.geometry.frames
    out: dict[str, tuple[tuple[int, ...], str]] = {
        "cone_vec_nominal": ((frames, 12), "<f8"),
        "cone_vec_true": ((frames, 12), "<f8"),
    }
    if plan.batch.kind == "projections":
        match plan.images.values:
            case "counts":
                dtype = "<u2"
            case "line_integrals":
                dtype = "<f4"
            case _:
                assert_never(plan.images.values)
        out["projections"] = ((frames, *detector_shape(plan)), dtype)
        if plan.reconstruct is not None:
            z, y, x = plan.reconstruct.shape
            out["volumes"] = ((z, y, x), "<f4")
    return out


def item_bytes(plan: Plan) -> int:
    """Compute the size of one item's arrays before compression [bytes]."""
    return sum(
        math.prod(shape) * np.dtype(dtype).itemsize
        for shape, dtype in layout(plan).values()
    )


@lru_cache(maxsize=4)
def _plan(text: str) -> Plan:
    return parse_plan(json.loads(text))


def run_item(text: str, index: int) -> ItemOutcome:
    """Draw and compute one item; a TwinError becomes an outcome with status "failed" and
    its text, without arrays.

    Args:
        text: the plan, as `Plan.text`.
        index: number of the item.

    Returns:
        The outcome. Its record has seed, drawn parameters, status, figures, warnings of
        the exposure and the SHA-256 of each array; an "error" among the figures is
        "failed", too, with arrays.
    """
    plan = _plan(text)
    record: dict[str, Any] = {
        "index": index,
        "seed": {"entropy": plan.batch.seed, "spawn_key": [index]},
    }
    try:
        item = draw_item(plan, index)
        record["parameters"] = item.parameters
        doubts = _open_beam_doubts(plan, item)
        arrays, figures = _MAKERS[plan.batch.kind](plan, item)
    except TwinError as error:
        return ItemOutcome(index, {**record, "status": "failed", "error": str(error)})
    kept: dict[str, Array] = {
        "cone_vec_nominal": item.poses.cone_vec().rows,
        "cone_vec_true": item.poses.cone_vec(item.truth).rows,
        **arrays,
    }
    wanted = layout(plan)
    kept = {
        name: np.ascontiguousarray(kept[name], dtype=wanted[name][1]) for name in wanted
    }
    sums = {
        name: hashlib.sha256(values.tobytes()).hexdigest()
        for name, values in kept.items()
    }
    if doubts:
        figures = {**figures, "warnings": doubts}
    status = "failed" if "error" in figures else "done"
    return ItemOutcome(
        index, {**record, "status": status, **figures, "sha256": sums}, kept
    )


def _open_beam_doubts(plan: Plan, item: Item) -> list[str]:
    """List warnings where the open beam's counts saturate or starve the panel, in the
    first view.

    [] unless the batch makes projections with counts or noise by a machine's camera.
    """
    counted = plan.images.values == "counts" or plan.images.noise
    if plan.batch.kind != "projections" or item.camera is None or not counted:
        return []
    view = item.poses.cone_vec(item.truth).rows[0]
    return open_beam_doubts(
        item.machine, item.camera, item.exposure, view, plan.images.physics
    )


# -- projections -----------------------------------------------------------------------------------


def _projections(plan: Plan, item: Item) -> tuple[dict[str, Array], dict[str, Any]]:
    """Compute an item's projections and, if the plan has it, their reconstruction.

    FDK uses the true or the nominal geometry, as the plan says, without estimating
    errors.

    Args:
        plan: of the batch.
        item: drawn.

    Returns:
        `projections` (frames, rows, cols) and `volumes` (z, y, x); no figures.
    """
    cone = item.poses.cone_vec(item.truth)
    match plan.images.physics:
        case "ideal":
            images = _ideal(plan, item, cone)
        case "mono" | "poly":
            images = _physical(plan, item, cone)
        case _:
            assert_never(plan.images.physics)
    arrays: dict[str, Array] = {"projections": images}
    if plan.reconstruct is not None:
        want = plan.reconstruct
        z, y, x = want.shape
        like = Volume(np.zeros((z, y, x), np.float32), want.voxel_mm)
        match want.geometry:
            case "true":
                geometry = cone
            case "nominal":
                geometry = item.poses.cone_vec()
            case _:
                assert_never(want.geometry)
        arrays["volumes"] = fdk(
            images, geometry, like, window=want.window, errors=False
        ).data
    return arrays, {}


def _rng(plan: Plan, item: Item, frame: int) -> np.random.Generator | None:
    if not plan.images.noise:
        return None
    return np.random.default_rng(seed_of(plan, item.index, NOISE, frame))


def _ideal(plan: Plan, item: Item, cone: ConeVec) -> Array:
    """Simulate an item's images by the ideal response, with noise if the plan has it.

    Line integrals without noise do not pass the detector; noisy ones are the logarithm of
    counts.

    Args:
        plan: says whether counts or line integrals are made.
        item: phantom, exposure and detector.
        cone: true geometry of n views.

    Returns:
        (n, rows, cols).
    """
    lines = line_integrals(item.phantom, cone, item.shape)
    if plan.images.values == "line_integrals" and not plan.images.noise:
        return lines
    model = ideal_response(item.machine)
    counts = [
        expose(model, image, item.exposure, _rng(plan, item, i))
        for i, image in enumerate(lines)
    ]
    match plan.images.values:
        case "counts":
            return np.stack(counts)
        case "line_integrals":
            bright = np.float32(open_beam(model, item.exposure))
            dark = np.float32(model.dark_counts)
            return np.stack([_logarithm(c, dark, bright) for c in counts])
        case _:
            assert_never(plan.images.values)


def _logarithm(
    counts: Counts, dark: np.float32, bright: np.float32 | Float32Array
) -> Float32Array:
    """Compute -ln((counts - dark) / open beam); no count above dark is taken as half a
    one."""
    above = np.maximum(counts.astype(np.float32) - dark, np.float32(0.5))
    return np.asarray(-np.log(above / bright), dtype=np.float32)


def _physical(plan: Plan, item: Item, cone: ConeVec) -> Array:
    """Make images with spectrum, panel and noise, as counts or as line integrals.

    Line integrals are of a noisy image and a noise-free open beam of the same pose.

    Args:
        plan: of the batch.
        item: with a machine's camera.
        cone: true geometry.

    Returns:
        Images (frames, rows, cols).
    """
    assert item.camera is not None
    parts = channels(item.phantom)
    panel = detector_of(item.machine.detector)
    tube = tube_of(item.machine.tube)
    mono_keV: float | None
    match plan.images.physics:
        case "mono":
            mono_keV = stated_keV()
        case "ideal" | "poly":
            mono_keV = None
        case _:
            assert_never(plan.images.physics)
    chain = chain_through(parts, panel, tube, mono_keV)
    paths = np.stack([project_body(part.body, cone, item.shape) for part in parts])
    nothing = Chain(panel, tube, mono_keV=chain.mono_keV)
    empty = np.empty((0, *item.shape), dtype=np.float32)
    images: list[Array] = []
    for i, row in enumerate(cone.rows):
        expected = expected_signal(chain, paths[:, i], row, item.exposure)
        counts = read_out(
            panel, expected, item.camera, item.exposure, _rng(plan, item, i)
        )
        match plan.images.values:
            case "counts":
                images.append(counts)
            case "line_integrals":
                # As the laboratory does it: an open-beam image of the same pose, free of noise.
                beam = expected_signal(nothing, empty, row, item.exposure)
                flat = read_out(panel, beam, item.camera, item.exposure)
                dark = np.float32(panel.offset_counts)
                bright = np.maximum(flat.astype(np.float32) - dark, np.float32(0.5))
                images.append(_logarithm(counts, dark, bright))
            case _:
                assert_never(plan.images.values)
    return np.stack(images)


# -- calibrations ----------------------------------------------------------------------------------


def _calibrations(plan: Plan, item: Item) -> tuple[dict[str, Array], dict[str, Any]]:
    """Calibrate an item, from noisy bead points or from rendered images.

    Both go through the same calibration, with all causes that it looks for. Noise depends
    on the item's seed. Images are rendered with noise, and their beads detected; of points
    the beads are known.

    Args:
        plan: of the batch.
        item: drawn.

    Returns:
        No arrays, and the figures of `_compare_with_truth`.
    """
    model = bead_model(item.phantom)
    free = tuple(plan.calibrate.free)
    request = CalibrationRequest(free=free, priors=plan.calibrate.stated_priors)
    match plan.calibrate.fidelity:
        case "points":
            scan = _seen_points(plan, item, model)
            result = calibrate([scan], model, replace(request, second_look=False))
        case "images":
            scan = _rendered(plan, item, model)
            result = calibrate([scan], model, request, scene=item.phantom.scene)
        case _:
            assert_never(plan.calibrate.fidelity)
    note = "; ".join(f.text for f in result.errors)
    return {}, _compare_with_truth(result.fit, item, free, result.identifiable, note)


def _rendered(plan: Plan, item: Item, model: BeadModel) -> Scan:
    """Render the images of an item's scan, with noise of the item's seed."""
    from flexdt_extensions.studies.rendered_runs import Rendering, render

    camera = Rendering(counts=item.counts, blur_px=plan.calibrate.blur_px)
    key = [int(v) for v in seed_of(plan, item.index, NOISE).generate_state(4)]
    scene = item.phantom.scene
    frames = render(scene, model, item.poses, item.truth, camera, key, item.shape)
    return Scan(frames, item.poses)


def _seen_points(plan: Plan, item: Item, model: BeadModel) -> Scan:
    """Project the centers of an item's beads, and add noise.

    Args:
        plan: of the batch.
        item: with the noise of a coordinate [px].
        model: k beads.

    Returns:
        The scan, the bead of each spot known; beads that are not entirely on the panel are
        not seen.
    """
    cone = item.poses.cone_vec(item.truth)
    tracks = cone.project_points(model.beads, item.shape)
    rng = np.random.default_rng(seed_of(plan, item.index, NOISE))
    noisy = tracks + item.noise_px * rng.normal(size=tracks.shape)
    radii = spot_radii(model, cone)
    sizes = np.tile(np.array(item.shape, dtype=np.float64), (len(item.poses), 1))
    seen = visible_beads(model, item.poses, sizes, item.truth)
    looks = [
        FrameSpots(
            Detections.of_points(spots[there], item.noise_px, size[there], item.shape),
            FrameState.USABLE,
        )
        for spots, size, there in zip(noisy, radii, seen, strict=True)
    ]
    index = np.where(seen, np.cumsum(seen, axis=1) - 1, -1)
    return Scan(SpotFrames(looks), item.poses, index=index)


def _compare_with_truth(
    fit: FitResult | None,
    item: Item,
    free: tuple[str, ...],
    identifiable: bool,
    note: str,
) -> dict[str, Any]:
    """Compare a fit with the truth, in edge units, for the parameters that the data
    determine.

    Args:
        fit: None where nothing was fitted.
        item: its truth.
        free: estimated parameters.
        identifiable: whether the data determine them; else values are None.
        note: findings as text.

    Returns:
        `identifiable`, `values`, `errors` (value less truth) and `sigmas` by parameter,
        `rms_px`, `iterations`, `note` and, without a fit, `error`.
    """
    truth = item.truth.to_edge()
    if fit is None:
        estimates = {}
    else:
        estimates = fit.certificate.estimates
    values = {}
    errors = {}
    sigmas = {}
    for name in free:
        if identifiable:
            found = estimates.get(name)
        else:
            found = None
        if found is None:
            value = None
        else:
            value = _finite(found.value)
        values[name] = value
        errors[name] = None if value is None else value - truth[name]
        sigmas[name] = None if found is None else _finite(found.sigma)
    return {
        "identifiable": bool(identifiable),
        "values": values,
        "errors": errors,
        "sigmas": sigmas,
        "rms_px": None if fit is None else _finite(fit.certificate.rms_px),
        "iterations": 0 if fit is None else int(fit.iterations),
        "note": note,
        **({"error": note or "nothing was fitted"} if fit is None else {}),
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


_MAKERS = {"projections": _projections, "calibrations": _calibrations}
