"""One item of a batch: the values that the plan's draws take for the item's own seed.

Item i draws from `SeedSequence(seed).spawn(items)[i]`, which any process can make by itself, so
items come out the same in any order and with any number of processes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt.clients.batch.plan import Cuboid, Plan, Spheres
from flexdt.phantoms import Phantom, bead_phantom, load_phantom
from flexdt.phantoms.materials import material
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import COLUMN_DIRECTION, ROW_DIRECTION
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, builtin_machine
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere, Vector

VALUES, NOISE, SHAPES = 0, 1, 2
"""Streams of an item's seed: scalar draws in the plan's order, noise, the phantom's parts."""
TRIES: Final = 2000
"""How often a sphere is placed anew before a phantom counts as impossible."""


def seed_of(plan: Plan, index: int, *stream: int) -> np.random.SeedSequence:
    """The seed of item `index`, or of one of its streams."""
    return np.random.SeedSequence(plan.batch.seed, spawn_key=(index, *stream))


@dataclass(frozen=True, eq=False)
class Item:
    """One item, ready to be computed.

    Attributes:
        index: which.
        phantom: what is scanned.
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
    """What item `index` of a plan is.

    Raises:
        TwinError: a draw that no phantom or machine can be, e.g. beads that do not fit.
    """
    rng = np.random.default_rng(seed_of(plan, index, VALUES))
    g, images, calibrate = plan.geometry, plan.images, plan.calibrate
    drawn: dict[str, Any] = {
        name: getattr(g, name).sample(rng)
        for name in ("sod_mm", "sdd_mm", "height_mm", "lateral_mm", "start_deg")
    }
    drawn |= {name: getattr(images, name).sample(rng) for name in ("kV", "power_W", "exposure_ms")}
    drawn |= {name: getattr(calibrate, name).sample(rng) for name in ("noise_px", "counts")}
    errors = {name: float(plan.errors[name].sample(rng)) for name in sorted(plan.errors)}
    phantom, described = _phantom(plan, index, rng)
    machine = builtin_machine(plan.camera.machine)
    camera, shape, pixel, shift = _camera(plan, machine)
    u, v = np.multiply(COLUMN_DIRECTION, pixel), np.multiply(ROW_DIRECTION, pixel)
    turn = math.radians(g.turn_deg) * np.arange(g.frames) / g.frames
    poses = Poses(
        np.zeros(3),
        np.array([drawn["lateral_mm"], drawn["sod_mm"], drawn["height_mm"]]),
        np.array([0.0, drawn["sdd_mm"], 0.0]) + shift[0] * u / pixel + shift[1] * v / pixel,
        u,
        v,
        math.radians(drawn["start_deg"]) + turn,
    )
    exposure = ExposureSettings(
        drawn["kV"], drawn["power_W"], drawn["exposure_ms"], plan.images.averages
    )
    parameters = {"phantom": described, **drawn, "errors": errors}
    return Item(
        index, phantom, poses, Offsets.from_edge(errors), shape, machine, camera, exposure,
        float(drawn["noise_px"]), float(drawn["counts"]), parameters,
    )  # fmt: skip


def detector_shape(plan: Plan) -> tuple[int, int]:
    """(rows, cols) of every image of a plan.

    Raises:
        TwinError: no such machine, mode or ROI.
    """
    return _camera(plan, builtin_machine(plan.camera.machine))[1]


def _camera(
    plan: Plan, machine: Machine
) -> tuple[CameraSettings | None, tuple[int, int], float, tuple[float, float]]:
    wanted = plan.camera
    if wanted.shape is not None and wanted.pixel_mm is not None:
        return None, (wanted.shape[0], wanted.shape[1]), wanted.pixel_mm, (0.0, 0.0)
    standard, sensor = machine.detector.camera, machine.detector.sensor
    roi = standard.roi if wanted.roi is None else Roi(*wanted.roi)
    camera = CameraSettings(wanted.mode or standard.mode, roi, averages=plan.images.averages)
    if not (
        0 <= roi.left <= roi.right < sensor.columns and 0 <= roi.top <= roi.bottom < sensor.rows
    ):
        raise TwinError(
            f"camera.roi {list(roi_tuple(roi))} does not lie on the sensor of {sensor.columns} x "
            f"{sensor.rows} pixels",
            {"asked": list(roi_tuple(roi)), "allowed": [0, 0, sensor.columns - 1, sensor.rows - 1]},
        )
    return camera, camera.shape, camera.pixel_mm(sensor), camera.roi_shift_mm(sensor)


def roi_tuple(roi: Roi) -> tuple[int, int, int, int]:
    """Its four edges."""
    return roi.left, roi.top, roi.right, roi.bottom


def _phantom(plan: Plan, index: int, rng: np.random.Generator) -> tuple[Phantom, dict[str, Any]]:
    table = plan.phantom
    if table.name is not None:
        name = table.name.sample(rng)
        return load_phantom(name), {"name": name}
    if table.cuboid is not None:
        return _cuboid(table.cuboid, rng)
    assert table.spheres is not None
    parts = np.random.default_rng(seed_of(plan, index, SHAPES))
    return _spheres(table.spheres, rng, parts)


def _cuboid(table: Cuboid, rng: np.random.Generator) -> tuple[Phantom, dict[str, Any]]:
    values = {name: getattr(table, name).sample(rng) for name in type(table).model_fields}
    size = tuple(float(values[f"{side}_mm"]) for side in ("width", "breadth", "height"))
    made = bead_phantom(
        size, int(values["beads"]), bead_radius_mm=float(values["bead_radius_mm"]),
        body_material=values["body_material"], bead_material=values["bead_material"],
    )  # fmt: skip
    return made, {"name": made.name, **values}


def _spheres(
    table: Spheres, rng: np.random.Generator, parts: np.random.Generator
) -> tuple[Phantom, dict[str, Any]]:
    wide, high = table.within_radius_mm, table.within_height_mm / 2.0
    solids: list[Solid] = []
    listed: list[dict[str, Any]] = []
    for number in range(int(table.count.sample(rng))):
        radius = float(table.radius_mm.sample(parts))
        made_of = material(table.material.sample(parts))
        center = _place(radius, wide, high, [s.shape for s in solids], parts)
        if center is None:
            raise TwinError(
                f"sphere {number + 1} of {radius:.3g} mm found no free place in a cylinder of "
                f"{wide:g} mm radius and {2 * high:g} mm height in {TRIES} tries",
                {"asked": radius, "allowed": [wide, high]},
            )
        solids.append(Solid(Sphere(center, radius), made_of.name, made_of.mu_per_mm))
        listed.append({"center_mm": list(center), "radius_mm": radius, "material": made_of.name})
    size = (2.0 * wide, 2.0 * wide, 2.0 * high)
    phantom = Phantom(f"spheres-{len(solids)}", "random spheres", Scene(tuple(solids)), size)
    return phantom, {"name": phantom.name, "spheres": listed}


def _place(
    radius: float, wide: float, high: float, others: list[Any], rng: np.random.Generator
) -> Vector | None:
    if radius > wide or radius > high:
        return None
    for _ in range(TRIES):
        distance = (wide - radius) * math.sqrt(rng.uniform())
        turn = rng.uniform(0.0, 2.0 * math.pi)
        at = (distance * math.cos(turn), distance * math.sin(turn),
              rng.uniform(-(high - radius), high - radius))  # fmt: skip
        if all(math.dist(at, o.center) >= radius + o.radius for o in others):
            return at
    return None
