"""Image quality of a scan before it is made.

A prediction simulates a few views without noise for the histogram of transmission, and takes the
darkest ray for contrast, noise and the choice of voltage and filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.channels import Channel, chain_through, channels
from flexdt.phantoms.materials import material as material_of
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.samples import as_phantom
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile, builtin_machine, profile_of
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.physics.chain import Chain, flux_of, radiographs
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.exposure import FEW_COUNTS, NOTICED, ExposureSettings
from flexdt.twin.physics.image_quality import air_kerma_mGy, contrast_to_noise, pixel_reading
from flexdt.twin.physics.readout import expected_counts, saturating_counts
from flexdt.twin.physics.tube import Filter, tube_of, voltages
from flexdt.twin.projection import project_body
from flexdt.twin.projection.analytic_solids import Vector
from flexdt.twin.scanner.state import CameraChange, changed_camera
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.plan_values import StartState
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.problems import ScriptProblem
from flexdt.twin.script.scan_request import Kind, ScanRequest
from flexdt.twin.signatures import public

VIEWS: Final = 8
"""Views of a turn that are looked at."""
EDGES: Final = np.concatenate([[0.0], np.logspace(-3.95, 0.05, 41), [np.inf]])
"""Bins of transmission: ten a decade, the open beam amid the last, and what lies outside."""
BRIGHTEST: Final = 0.9
"""Part of the panel's range that the open beam may fill in a proposed setting."""
FILTERS: Final = (
    "", "aluminium:0.5", "aluminium:1", "aluminium:2", "copper:0.1", "copper:0.25", "copper:0.5",
    "copper:1",
)  # fmt: skip
"""Proposed filters, beside what the tube has."""
FEW_VIEWS: Final = 3
"""Views of each setting of a plan that are looked at, of at most `SETTINGS`."""
SETTINGS: Final = 4
VOID: Final = "void"


@dataclass(frozen=True)
class Transmission:
    """How much of the open beam the pixels see.

    Attributes:
        least, p1, p5, median: smallest value and quantiles.
        edges: of the bins, (k + 1,); the first begins at 0, the last ends at infinity.
        shares: of the pixels in each bin, (k,).
    """

    least: float
    p1: float
    p5: float
    median: float
    edges: tuple[float, ...]
    shares: tuple[float, ...]

    @classmethod
    def of(cls, values: npt.NDArray[Any]) -> Transmission:
        """Of the pixels of images."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        counts, _ = np.histogram(np.maximum(flat, 0.0), EDGES)
        p1, p5, median = np.quantile(flat, (0.01, 0.05, 0.5)).tolist()
        shares = (counts / flat.size).tolist()
        return cls(float(flat.min()), p1, p5, median, tuple(EDGES.tolist()), tuple(shares))


@dataclass(frozen=True)
class Setting:
    """Tube and camera, and what they give on the darkest ray.

    Attributes:
        kV, filter: voltage, and the filter beside the tube's own ("" for none).
        exposure_ms, averages: of one image; their product is the time asked for.
        cnr: contrast of the detail to the noise, of one pixel of one image.
        kerma_mGy: air kerma of the whole scan on the axis, without a sample.
    """

    kV: float
    filter: str
    exposure_ms: float
    averages: int
    cnr: float
    kerma_mGy: float


@dataclass(frozen=True)
class Forecast:
    """What a scan will look like.

    Attributes:
        transmission: of the views' pixels.
        saturated, starved: parts of the pixels.
        detail: what the contrast is of.
        asked: the setting asked for.
        best: settings of the same power and time, the greatest `cnr` first.
        images: of the scan.
        seconds: that the images take at least; of a kind of scan, all of its script.
        bytes: that they take on disk; of a kind of scan, with its dark and flat images.
        assumed: what is not known and was assumed.
    """

    transmission: Transmission
    saturated: float
    starved: float
    detail: str
    asked: Setting
    best: tuple[Setting, ...]
    images: int
    seconds: float
    bytes: int
    assumed: tuple[str, ...]

    def __repr__(self) -> str:
        """One line."""
        return (
            f"<Forecast: {self.images} images in {self.seconds:.0f} s, "
            f"least transmission {self.transmission.least:.3g}, {self.saturated:.1%} saturated, "
            f"{self.starved:.1%} starved, best at {self.best[0].kV:g} kV>"
        )


@public
def expose(
    sample: object = "lego",
    *,
    kV: float | Sequence[float] | None = None,
    power_W: float | None = None,
    filter: str = "",
    exposure_ms: float | None = None,
    averages: int = 1,
    mode: str | None = None,
    roi: Roi | None = None,
    images: int = 361,
    kind: Kind | None = None,
    sod: float = 600.0,
    sdd: float = 1059.0,
    detail: str = f"{VOID}:0.5",
    machine: Machine | str = "flexray",
    material: str | None = None,
    voxel_mm: float | Vector | None = None,
    profile: Profile | None = None,
    start: StartState | None = None,
) -> Forecast:
    """Predict transmission, contrast to noise, dose, time and size of a circular scan.

    Args:
        sample: as for `flexdt.simulate`.
        kV: voltage; of several the first is the setting asked for and all are tried for the best.
            Default: the machine's, and every 10 kV of its range.
        power_W: power on the anode [W]; default: the machine's.
        filter: MATERIAL:MM beside the filters of the machine file, "" for none.
        exposure_ms: of one read-out; default: the machine's.
        averages: read-outs averaged into an image.
        mode, roi: camera mode and region of interest; default: the machine's.
        images: of the scan.
        kind: of a scan to compose for the machine, whose time, bytes and dose are then the whole
            script's, as `flexdt.check` has them; None counts `images` exposures and nothing else.
        sod, sdd: distances [mm].
        detail: MATERIAL:MM, a detail of so much of that material on the darkest ray, or void:MM,
            so much less of what this ray meets most of.
        machine: a machine (see `flexdt.machine`) or the name of one that ships.
        material, voxel_mm: of a mesh or an array, as for `flexdt.simulate`.
        profile, start: zero offsets and the scanner before a scan of `kind`; default: the
            machine's.

    Returns:
        The forecast. It is as good as the panel's figures, most of which are assumed, and knows no
        scattered radiation.

    Raises:
        TwinError: names the argument, what was asked and what is allowed.

    Example:
        >>> import flexdt as fx
        >>> ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 8, "material": "aluminium"}
        >>> forecast = fx.expose(ball, kV=[50, 90], images=100)
        >>> 0.0 < forecast.transmission.least < 0.3, forecast.best[0].kV
        (True, 90.0)
    """
    scanner = machine if isinstance(machine, Machine) else builtin_machine(machine)
    spec = scanner.detector
    low, high = max(scanner.tube.min_kV, voltages()[0]), min(scanner.tube.max_kV, voltages()[1])
    tried = np.atleast_1d(scanner.tube.kV if kV is None else kV).astype(float).tolist()
    if not tried:
        raise LimitError(
            f"kV is {kV}, no voltage; allowed with {scanner.name}: one or more of {low:g} to "
            f"{high:g}, or None",
            {"asked": [], "allowed": [low, high]},
        )
    power = scanner.tube.power_W if power_W is None else power_W
    time_ms = spec.exposure_ms if exposure_ms is None else exposure_ms
    for what, values, least, most in (
        ("kV", tried, low, high),
        ("power_W", [power], 1e-9, scanner.tube.max_W),
        ("exposure_ms", [time_ms], spec.min_exposure_ms, spec.max_exposure_ms),
        ("averages", [averages], 1, 10**6), ("images", [images], 1, 10**7),
    ):  # fmt: skip
        for value in values:
            counted = what in ("averages", "images")
            if not least <= value <= most or (counted and value != int(value)):
                whole = "whole numbers from " if counted else ""
                raise LimitError(
                    f"{what} is {value:g}; allowed with {scanner.name}: {whole}{least:g} to "
                    f"{most:g}",
                    {"asked": value, "allowed": [least, most]},
                )
    missing, size = _layer("detail", detail)
    wanted = (None if missing == VOID else material_of(missing).substance, size)
    phantom = as_phantom(sample, material=material, voxel_mm=voxel_mm)
    parts = channels(phantom)
    change: CameraChange = {
        "exposure_ms": time_ms, "averages": averages, "mode": mode, "roi": roi,
    }  # fmt: skip
    camera = changed_camera(spec, spec.camera, change)
    cone = ConeVec.circular(
        sod=sod, sdd=sdd, angles=VIEWS, shape=camera.shape, pixel=camera.pixel_mm(spec.pixels)
    )
    lit = ExposureSettings(tried[0], power, camera.exposure_ms, averages)
    rows, cols = camera.shape
    total, seconds = images * 2 * rows * cols, images * averages * camera.exposure_ms / 1e3
    if kind is not None:
        request = ScanRequest(
            kind, sod, sdd, images, camera.exposure_ms, averages, mode=camera.mode, roi=camera.roi,
            kV=lit.kV, power_W=power,
        )  # fmt: skip
        offsets = profile or profile_of(scanner)
        text = compose_script(request, scanner, offsets)
        plan = plan_script(text, scanner, offsets, start=start)
        images, seconds, total = plan.frames, plan.duration_s, plan.bytes
    panel, tube = detector_of(spec), tube_of(scanner.tube)

    def chain(layer: str) -> Chain:
        name, thickness = _layer("filter", layer) if layer else ("", 0.0)
        more = (Filter(material_of(name).substance, thickness),) if layer else ()
        return chain_through(parts, panel, replace(tube, filters=(*tube.filters, *more)))

    layers = {layer: chain(layer) for layer in (filter, *FILTERS)}
    paths, through, saturated, starved = _views(parts, layers[filter], camera, cone, lit)
    view, row, col = np.unravel_index(int(through.argmin()), through.shape)
    flux = flux_of(cone.rows[0], camera.shape)
    ray = _Ray(tuple(paths[:, view, row, col].tolist()), float(flux[row, col]), float(flux.max()))
    other = ray.with_detail(wanted, [part.material.substance for part in parts])

    def setting(layer: str, at: ExposureSettings) -> Setting:
        plain, changed = (
            pixel_reading(layers[layer], camera, at, one.flux, one.paths_mm, one.added)
            for one in (ray, other)
        )
        return Setting(
            at.kV, layer, at.exposure_ms, at.averages,
            contrast_to_noise(plain, changed), air_kerma_mGy(layers[layer], at, sod) * images,
        )  # fmt: skip

    def split(layer: str, voltage: float) -> ExposureSettings:
        """The same time in so many read-outs that the open beam does not saturate."""
        time = lit.exposure_ms * averages
        whole = replace(lit, kV=voltage, exposure_ms=time, averages=1)
        bright = pixel_reading(layers[layer], camera, whole, ray.brightest).signal
        reads = max(1, math.ceil(bright / (BRIGHTEST * saturating_counts(panel))))
        return replace(whole, exposure_ms=time / reads, averages=reads)

    kVs = tried if len(tried) > 1 else np.arange(10.0 * math.ceil(low / 10), high + 1, 10.0)
    found = [setting(layer, split(layer, float(one))) for layer in FILTERS for one in kVs]
    best = [s for s in found if spec.min_exposure_ms <= s.exposure_ms <= spec.max_exposure_ms]
    return Forecast(
        Transmission.of(through),
        saturated,
        starved,
        detail,
        setting(filter, lit),
        tuple(sorted(best, key=lambda one: -one.cnr)),
        images,
        seconds,
        total,
        tuple(dict.fromkeys(part.assumed for part in parts if part.assumed)),
    )


def exposure_problems(plan: ScanPlan, phantom: Phantom) -> tuple[ScriptProblem, ...]:
    """Warnings: the projections of a plan whose pixels will be saturated or starved.

    A few views of each setting of tube and camera are made without noise.
    """
    parts, scanner = channels(phantom), plan.machine
    chain = chain_through(parts, detector_of(scanner.detector), tube_of(scanner.tube))
    found: dict[tuple[ExposureSettings, CameraSettings], tuple[int, list[int]]] = {}
    first = 0
    for group in plan.groups:
        if group.kind == "projection" and group.xrays_on and group.files:
            camera = group.camera
            lit = ExposureSettings(group.kV, group.power_W, camera.exposure_ms, camera.averages)
            _, known = found.setdefault((lit, replace(camera, frames=1)), (group.line, []))
            known.extend(range(first, first + len(group)))
        first += len(group)
    problems: list[ScriptProblem] = []
    for (lit, camera), (line, numbers) in list(found.items())[:SETTINGS]:
        some = np.unique(np.linspace(0, len(numbers) - 1, FEW_VIEWS).astype(int))
        index = [numbers[i] for i in some]
        positions = {name: x[index] for name, x in plan.image_positions.items()}
        cone = motor_poses(scanner, plan.profile, camera, positions).cone_vec()
        _, _, *shares = _views(parts, chain, camera, cone, lit)
        for name, share in zip(("saturated", "starved"), shares, strict=True):
            if share >= NOTICED:
                text = f"about {100 * share:.3g} % of the projections' pixels will be {name}"
                problems.append(ScriptProblem("warning", f"{name}_pixels", line, 1, text))
    return tuple(problems)


def _views(
    parts: Sequence[Channel],
    chain: Chain,
    camera: CameraSettings,
    cone: ConeVec,
    lit: ExposureSettings,
) -> tuple[Float32Array, npt.NDArray[Any], float, float]:
    """Paths (k, n, rows, cols), transmission (n, rows, cols), saturated and starved parts."""
    paths = np.stack([project_body(part.body, cone, camera.shape) for part in parts])
    images = radiographs(chain, paths, cone.rows, [lit] * len(cone))
    through = np.exp(-np.stack([image.integrals for image in images]))
    signal = np.stack([image.expected.mean_e for image in images if image.expected])
    signal = expected_counts(chain.panel, camera, signal)
    saturated = float((signal >= saturating_counts(chain.panel)).mean())
    return paths, through, saturated, float((signal < FEW_COUNTS).mean())


@dataclass(frozen=True)
class _Ray:
    """A ray through the sample: paths, pixel's share of the beam, that of the brightest pixel."""

    paths_mm: tuple[float, ...]
    flux: float
    brightest: float
    added: tuple[Substance, float] | None = None

    def with_detail(
        self, detail: tuple[Substance | None, float], substances: Sequence[Substance]
    ) -> _Ray:
        """The same ray with so much of a substance more, or of what it meets most less."""
        substance, thickness = detail
        if substance is not None:
            return replace(self, added=(substance, thickness))
        weights = [
            s.attenuation().mean() * d for s, d in zip(substances, self.paths_mm, strict=True)
        ]
        most = int(np.argmax(weights))
        if thickness > self.paths_mm[most]:
            raise LimitError(
                f"detail {VOID}:{thickness:g}: the darkest ray meets {self.paths_mm[most]:.3g} "
                f"mm of {substances[most].name}; allowed: a void of at most that",
                {"asked": thickness, "allowed": self.paths_mm[most], "unit": "mm"},
            )
        left = list(self.paths_mm)
        left[most] -= thickness
        return replace(self, paths_mm=tuple(left))


def _layer(what: str, words: str) -> tuple[str, float]:
    """The name and the thickness [mm] of MATERIAL:MM."""
    name, _, size = words.rpartition(":")
    try:
        value = float(size)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= 1e3:
        raise LimitError(
            f"{what} {words!r}: allowed: MATERIAL:MM with 0 < MM <= 1000, such as copper:0.25",
            {"asked": words, "allowed": "MATERIAL:MM"},
        )
    return name, value
