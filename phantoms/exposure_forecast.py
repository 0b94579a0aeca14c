"""Image quality of a scan before it is made.

A prediction simulates a few views without noise for the histogram of transmission, and
takes the darkest ray for contrast, noise and the choice of voltage and filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.channels import Channel, chain_through, channels
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.samples import as_phantom
from flexdt.phantoms.scan_limits import check_tube
from flexdt.twin.attenuation.materials import material as material_of
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, require_within
from flexdt.twin.findings import Findings
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile, builtin_machine, profile_of
from flexdt.twin.physics.chain import Chain, flux_of, radiographs
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.exposure import FEW_COUNTS, ExposureSettings
from flexdt.twin.physics.image_quality import (
    air_kerma_mGy,
    contrast_to_noise,
    pixel_reading,
)
from flexdt.twin.physics.predicted_beam import BRIGHTEST_FILL, CountShares
from flexdt.twin.physics.readout import expected_counts, saturating_counts
from flexdt.twin.physics.tube import Filter, tube_of, voltages
from flexdt.twin.projection import project_body
from flexdt.twin.projection.analytic_solids import Vector
from flexdt.twin.scanner.state import CameraChange, changed_camera
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.planning.beam_view import views
from flexdt.twin.script.planning.open_beam_findings import open_beam_problems
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.plan_values import StartState
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.planning.sample_findings import (
    SampleForecast,
    SampleProbe,
    sample_probes,
    sample_problems,
    shares_behind,
)
from flexdt.twin.script.scan_request import Kind, ScanRequest
from flexdt.twin.signatures import public

SIMULATED_VIEWS: Final = 8
"""Number of views of a turn that are simulated."""
TRANSMISSION_EDGES: Final = np.concatenate(
    [[0.0], np.logspace(-3.95, 0.05, 41), [np.inf]]
)
"""Edges of the bins of transmission: ten a decade, the open beam amid the last,
and the rest."""
FILTERS: Final = (
    "",
    "aluminium:0.5",
    "aluminium:1",
    "aluminium:2",
    "copper:0.1",
    "copper:0.25",
    "copper:0.5",
    "copper:1",
)
"""Filters that are proposed, in addition to the tube's own."""
VOID: Final = "void"
ROSE_CONTRAST: Final = 5.0
"""Contrast, in units of the noise, from which a detail is seen (Rose 1948)."""
TIMES_MS: Final = (1e-3, 1e9)
"""Between these the time of a contrast is looked for."""
TIME_STEPS: Final = 48
"""Halvings of their ratio's logarithm: the time is found to a millionth of it."""


@dataclass(frozen=True)
class Transmission:
    """Distribution of the pixels' part of the open beam.

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
        """Compute least, quantiles and histogram of the transmission of all pixels.

        Quantiles are 1 %, 5 % and the median; the histogram has shares of all pixels
        between `TRANSMISSION_EDGES`, negative values counted as 0.

        Args:
            values: of images, any shape, 1 for an open beam.
        """
        flat = np.asarray(values, dtype=np.float64).ravel()
        counts, _ = np.histogram(np.maximum(flat, 0.0), TRANSMISSION_EDGES)
        p1, p5, median = np.quantile(flat, (0.01, 0.05, 0.5)).tolist()
        shares = (counts / flat.size).tolist()
        return cls(
            float(flat.min()),
            p1,
            p5,
            median,
            tuple(TRANSMISSION_EDGES.tolist()),
            tuple(shares),
        )


@dataclass(frozen=True)
class Setting:
    """A setting of tube and camera, and its contrast and dose on the darkest ray.

    Attributes:
        kV, filter: voltage, and the filter in addition to the tube's own ("" for none).
        exposure_ms, averages: of one image; their product is the requested time.
        cnr: contrast of the detail to the noise, of one pixel of one image; None where
            that pixel is saturated.
        kerma_mGy: air kerma of the scan on the axis, without a sample.
    """

    kV: float
    filter: str
    exposure_ms: float
    averages: int
    cnr: float | None
    kerma_mGy: float


@dataclass(frozen=True)
class Forecast:
    """Forecast of a scan's images.

    Attributes:
        transmission: of the views' pixels.
        saturated, starved: parts of the pixels.
        detail: the detail of the contrast.
        asked: the requested setting.
        best: settings of the same power and time, the greatest `cnr` first.
        images: of the scan.
        seconds: that the images take at least; of a kind of scan, all of its script.
        bytes: that they take on disk; of a kind of scan, with its dark and flat images.
        assumed: assumptions.
        contrast, contrast_ms: the contrast that was asked for, and the exposure of one image
            after which the detail has it at the requested voltage, power and filter [ms];
            more than a read-out holds is averaged. None: it never has.
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
    contrast: float = ROSE_CONTRAST
    contrast_ms: float | None = None

    def __repr__(self) -> str:
        """Format as one line: images, time [s], least transmission, pixel shares, best kV."""
        return (
            f"<Forecast: {self.images} images in {self.seconds:.0f} s, "
            f"least transmission {self.transmission.least:.3g}, {self.saturated:.1%} saturated, "
            f"{self.starved:.1%} starved, best at {self.best[0].kV:g} kV, "
            f"{self.contrast_words()}>"
        )

    def contrast_words(self) -> str:
        """Say how long an image must be exposed for the contrast."""
        if self.contrast_ms is None:
            return f"no exposure gives a contrast of {self.contrast:g}"
        return f"contrast of {self.contrast:g} after {self.contrast_ms:.3g} ms an image"


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
    sod: float | None = None,
    sdd: float | None = None,
    detail: str = f"{VOID}:0.5",
    contrast: float = ROSE_CONTRAST,
    machine: Machine | str = "flexray",
    material: str | None = None,
    voxel_mm: float | Vector | None = None,
    profile: Profile | None = None,
    start: StartState | None = None,
) -> Forecast:
    """Predict transmission, contrast to noise, dose, time and size of a circular scan.

    Transmission and the shares of saturated and starved pixels are of `SIMULATED_VIEWS`
    views over a circle, without noise. For `best`, each of `FILTERS` is tried with each
    voltage, and its exposure is divided into read-outs that the open beam does not
    saturate; those that the machine may not have are left out. They are sorted by
    falling contrast to noise.

    Args:
        sample: as for `flexdt.simulate`.
        kV: voltage; of several the first is the setting asked for and all are tried for
            the best. Default: the machine's, and every 10 kV of its range.
        power_W: power on the anode [W]; default: the machine's.
        filter: MATERIAL:MM beside the filters of the machine file, "" for none.
        exposure_ms: of one read-out; default: the machine's.
        averages: read-outs averaged into an image.
        mode, roi: camera mode and region of interest; default: the machine's.
        images: of the scan.
        kind: of a scan to compose for the machine, whose time, bytes and dose are then
            the whole script's, as `flexdt.check` has them; None counts `images` exposures
            and nothing else.
        sod, sdd: distances [mm]; default: those of the script that flexdt composes for
            the machine (600 and 1059 on the FleX-ray).
        detail: MATERIAL:MM, a detail of so much of that material on the darkest ray, or
            void:MM, so much less of what this ray meets most of.
        contrast: of the detail to the noise of one pixel of one image: the forecast says
            how long an image takes to have it (`contrast_ms`).
        machine: a machine (see `flexdt.machine`) or the name of one that ships.
        material, voxel_mm: of a mesh or an array, as for `flexdt.simulate`.
        profile, start: zero offsets and the scanner before a scan of `kind`; default: the
            machine's. A start without `kind` needs sod and sdd.

    Returns:
        The forecast. It is as good as the panel's figures, most of which are assumed, and
        knows no scattered radiation.

    Raises:
        TwinError: names the argument, its value and what is allowed.

    Example:
        >>> import flexdt as fx
        >>> ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 8, "material": "aluminium"}
        >>> forecast = fx.expose(ball, kV=[50, 90], images=100)
        >>> 0.0 < forecast.transmission.least < 0.3, forecast.best[0].kV
        (True, 90.0)
        >>> fx.expose(ball, kV=90, images=100, contrast=10).contrast_ms > forecast.contrast_ms
        True
    """
    require_within("contrast", contrast, 1e-3, 1e6)
    if isinstance(machine, Machine):
        scanner = machine
    else:
        scanner = builtin_machine(machine)
    spec = scanner.detector
    tried = np.atleast_1d(scanner.tube.kV if kV is None else kV).astype(float).tolist()
    if power_W is None:
        power = scanner.tube.power_W
    else:
        power = power_W
    if exposure_ms is None:
        time_ms = spec.exposure_ms
    else:
        time_ms = exposure_ms
    _check_settings(scanner, tried, power, time_ms, averages, images)
    missing, size = _layer("detail", detail)
    wanted = (None if missing == VOID else material_of(missing).substance, size)
    phantom = as_phantom(sample, material=material, voxel_mm=voxel_mm)
    parts = channels(phantom)
    change: CameraChange = {
        "exposure_ms": time_ms,
        "averages": averages,
        "mode": mode,
        "roi": roi,
    }
    camera = changed_camera(spec, spec.camera, change)
    lit = ExposureSettings(tried[0], power, camera.exposure_ms, averages)
    for one in tried:
        check_tube(scanner, replace(lit, kV=one))
    request = ScanRequest(
        kind or "step",
        sod,
        sdd,
        images,
        camera.exposure_ms,
        averages,
        mode=camera.mode,
        roi=camera.roi,
        kV=lit.kV,
        power_W=power,
    )
    plan: ScanPlan | None = None
    seconds = images * averages * camera.exposure_ms / 1e3
    total = images * 2 * _pixels(camera)
    if kind is not None:
        plan = _plan_of(request, scanner, profile, start)
        images = plan.frames
        seconds = plan.duration_s
        total = plan.bytes
    elif start is None:  # else the distances of a scanner at its start
        distances = ScanRequest(
            "step", sod, sdd, frames=2, exposure_ms=camera.exposure_ms
        )
        plan = _plan_of(distances, scanner, profile, start)
    source_mm, panel_mm = _scan_distances(sod, sdd, plan)
    cone = ConeVec.circular(
        sod=source_mm,
        sdd=panel_mm,
        angles=SIMULATED_VIEWS,
        shape=camera.shape,
        pixel=camera.pixel_mm(spec.pixels),
    )
    layers = _Layers(parts, scanner, filter)
    paths, through, saturated, starved = _views(
        parts, layers.chains[filter], camera, cone, lit
    )
    view, row, col = np.unravel_index(int(through.argmin()), through.shape)
    flux = flux_of(cone.rows[0], camera.shape)
    ray = _Ray(
        tuple(paths[:, view, row, col].tolist()), float(flux[row, col]), float(flux.max())
    )
    other = ray.with_detail(wanted, [part.material.substance for part in parts])
    seen = _SeenDetail(layers, camera, ray, other, source_mm, images)
    low, high = _voltages(scanner)
    if len(tried) > 1:
        kVs = tried
    else:
        kVs = np.arange(10.0 * math.ceil(low / 10), high + 1, 10.0)
    exposures = [
        (layer, seen.unsaturated(layer, replace(lit, kV=float(one))))
        for layer in FILTERS
        for one in kVs
    ]
    best = [
        seen.setting(layer, one) for layer, one in exposures if _is_allowed(scanner, one)
    ]
    return Forecast(
        Transmission.of(through),
        saturated,
        starved,
        detail,
        seen.setting(filter, lit),
        tuple(sorted(best, key=lambda one: -(one.cnr or 0.0))),
        images,
        seconds,
        total,
        tuple(dict.fromkeys(part.assumed for part in parts if part.assumed)),
        contrast,
        seen.time_of(contrast, filter, lit),
    )


def _voltages(machine: Machine) -> tuple[float, float]:
    """Return the least and the greatest voltage [kV] of the tube that has a spectrum."""
    low, high = voltages()
    return max(machine.tube.min_kV, low), min(machine.tube.max_kV, high)


def _check_settings(
    machine: Machine,
    kVs: Sequence[float],
    power_W: float,
    exposure_ms: float,
    averages: float,
    images: float,
) -> None:
    """Check that the machine has these settings.

    In the order of the arguments: at least one voltage, each in the tube's range; power
    up to the tube's; the panel's exposure times; averages whole, 1 to 1e6; images whole,
    1 to 1e7.

    Args:
        machine: with the ranges.
        kVs: voltages.
        power_W: of the tube.
        exposure_ms: of one read-out.
        averages: read-outs of an image.
        images: of the scan.

    Raises:
        LimitError: the first setting that is outside; names it, its value and the range.
    """
    low, high = _voltages(machine)
    spec = machine.detector
    if not kVs:
        raise LimitError(
            f"kV is [], no voltage; allowed with {machine.name}: one or more of {low:g} to "
            f"{high:g}, or None",
            {"asked": [], "allowed": [low, high]},
        )
    for name, values, low_end, high_end in (
        ("kV", kVs, low, high),
        ("power_W", [power_W], 1e-9, machine.tube.max_W),
        ("exposure_ms", [exposure_ms], spec.min_exposure_ms, spec.max_exposure_ms),
        ("averages", [averages], 1, 10**6),
        ("images", [images], 1, 10**7),
    ):
        for value in values:
            counted = name in ("averages", "images")
            if not low_end <= value <= high_end or (counted and value != int(value)):
                integers = "whole numbers from " if counted else ""
                raise LimitError(
                    f"{name} is {value:g}; allowed with {machine.name}: "
                    f"{integers}{low_end:g} to {high_end:g}",
                    {"asked": value, "allowed": [low_end, high_end]},
                )


def _is_allowed(machine: Machine, exposure: ExposureSettings) -> bool:
    """Return whether a machine may have a voltage, power and exposure time."""
    panel = machine.detector
    try:
        check_tube(machine, exposure)
        changed_camera(panel, panel.camera, {"exposure_ms": exposure.exposure_ms})
    except LimitError:
        return False
    return True


def _plan_of(
    request: ScanRequest,
    machine: Machine,
    profile: Profile | None,
    start: StartState | None,
) -> ScanPlan:
    """Compose a script for a request and plan it.

    Raises LimitError: distances or speeds that the machine does not have."""
    offsets = profile or profile_of(machine)
    text = compose_script(request, machine, offsets)
    return plan_script(text, machine, offsets, start=start)


def _scan_distances(
    sod: float | None, sdd: float | None, plan: ScanPlan | None
) -> tuple[float, float]:
    """Return SOD and SDD [mm]: as given, or else those of the planned scan.

    Args:
        sod, sdd: as given; None: not given.
        plan: of a scan of the machine; None: none was composed, as a start was given
            without a kind of scan.

    Raises:
        LimitError: neither gives both.
    """
    if sod is not None and sdd is not None:
        return sod, sdd
    if plan is None:
        raise LimitError(
            f"start without a kind of scan gives no distances: sod is {sod}, sdd is {sdd}; "
            "allowed: both of them in mm, a kind, or no start",
            {"asked": {"sod": sod, "sdd": sdd}, "allowed": ["sod and sdd", "kind"]},
        )
    source_mm, panel_mm = _distances(plan)
    return source_mm if sod is None else sod, panel_mm if sdd is None else sdd


def _distances(plan: ScanPlan) -> tuple[float, float]:
    """Return SOD and SDD [mm] of a plan's first projections."""
    first = next(view for view in views(plan) if view.kind == "projection")
    return float(first.poses.sod[0]), float(first.poses.sdd[0])


def _pixels(camera: CameraSettings) -> int:
    """Count the pixels of an image."""
    rows, cols = camera.shape
    return rows * cols


class _Layers:
    """The chains from tube to counts behind each proposed filter.

    Args:
        parts: materials of the sample.
        machine: its tube and panel.
        asked: the requested filter, MATERIAL:MM or "".
    """

    def __init__(self, parts: Sequence[Channel], machine: Machine, asked: str) -> None:
        """Compute the chain of tube, filter, sample and panel for each filter: `chains`,
        filter -> chain.

        Args:
            parts: of the sample.
            machine: its tube and detector.
            asked: filter MATERIAL:MM, or "" for no added filter; `FILTERS` are added.

        Raises:
            LimitError, UnknownNameError: another text, or an unknown material.
        """
        panel = detector_of(machine.detector)
        tube = tube_of(machine.tube)
        self.panel = panel
        self.chains: dict[str, Chain] = {}
        for layer in (asked, *FILTERS):
            more: tuple[Filter, ...] = ()
            if layer:
                name, thickness_mm = _layer("filter", layer)
                more = (Filter(material_of(name).substance, thickness_mm),)
            filtered = replace(tube, filters=(*tube.filters, *more))
            self.chains[layer] = chain_through(parts, panel, filtered)


@dataclass(frozen=True)
class _SeenDetail:
    """Contrast of a detail on the darkest ray.

    Attributes:
        layers: the filters.
        camera: its mode decides electrons in a count.
        plain, changed: the ray without and with the detail.
        sod_mm: source to axis, where the dose is.
        images: of the scan.
    """

    layers: _Layers
    camera: CameraSettings
    plain: _Ray
    changed: _Ray
    sod_mm: float
    images: int

    def setting(self, layer: str, at: ExposureSettings) -> Setting:
        """Compute contrast to noise of the detail on the darkest ray, and dose, of a
        setting.

        The dose is the air kerma [mGy] at the object's distance, over all images of the
        scan.

        Args:
            layer: name of the filter.
            at: voltage, power and time.

        Returns:
            The setting; its contrast is None where a pixel is saturated.
        """
        chain = self.layers.chains[layer]
        plain, changed = (
            pixel_reading(chain, self.camera, at, one.flux, one.paths_mm, one.added)
            for one in (self.plain, self.changed)
        )
        full = saturating_counts(self.layers.panel)
        seen = max(plain.signal, changed.signal) < full
        return Setting(
            at.kV,
            layer,
            at.exposure_ms,
            at.averages,
            contrast_to_noise(plain, changed) if seen else None,
            air_kerma_mGy(chain, at, self.sod_mm) * self.images,
        )

    def time_of(
        self, contrast: float, layer: str, asked: ExposureSettings
    ) -> float | None:
        """Find the time of one image after which the detail has a contrast [ms].

        Args:
            contrast: to the noise.
            layer: name of the filter.
            asked: voltage and power.

        Returns:
            The time, of all read-outs together; None if `TIMES_MS` has none.
        """

        def reached(time_ms: float) -> bool:
            """Whether an image of so long shows it."""
            whole = replace(asked, exposure_ms=time_ms, averages=1)
            cnr = self.setting(layer, self.unsaturated(layer, whole)).cnr
            return cnr is not None and cnr >= contrast

        low, high = TIMES_MS
        if not reached(high):
            return None
        for _ in range(TIME_STEPS):
            middle = math.sqrt(low * high)
            low, high = (low, middle) if reached(middle) else (middle, high)
        return high

    def unsaturated(self, layer: str, asked: ExposureSettings) -> ExposureSettings:
        """Split a setting's time into as many read-outs as keep the open beam below saturation.

        Without detail and sample, at the brightest pixel, up to `BRIGHTEST_FILL` of saturation;
        the averages become as many.

        `layer`: name of the filter. `asked`: the setting; its total time stays.
        """
        time_ms = asked.exposure_ms * asked.averages
        whole = replace(asked, exposure_ms=time_ms, averages=1)
        chain = self.layers.chains[layer]
        bright = pixel_reading(chain, self.camera, whole, self.plain.brightest).signal
        full = saturating_counts(self.layers.panel)
        reads = max(1, math.ceil(bright / (BRIGHTEST_FILL * full)))
        return replace(whole, exposure_ms=time_ms / reads, averages=reads)


def exposure_problems(plan: ScanPlan, phantom: Phantom) -> Findings:
    """Warn of a plan's projections whose pixels will be saturated or starved.

    Without scatter, by the machine's detector and tube. Problems that the open beam has already
    are left out; () without problems.
    `plan`: of the scan; `phantom`: on the stage, about the axis.
    """
    parts = channels(phantom)
    scanner = plan.machine
    chain = chain_through(parts, detector_of(scanner.detector), tube_of(scanner.tube))
    probes = sample_probes(plan)
    shares = tuple(_shares(parts, chain, probe) for probe in probes)
    return sample_problems(SampleForecast(probes, shares), open_beam_problems(plan))


def _shares(parts: Sequence[Channel], chain: Chain, probe: SampleProbe) -> CountShares:
    """Project the sample's materials along the rays of a probe, and return the shares of
    its pixels that are saturated or starved, as `shares_behind` does.
    """
    cone = probe.cone_vec
    shape = cone.of_shape(None)
    paths = np.zeros((len(parts), len(cone), *shape), np.float32)
    for i, part in enumerate(parts):
        paths[i] = project_body(part.body, cone, shape)
    return shares_behind(chain, probe, paths, cone.rows)


def _views(
    parts: Sequence[Channel],
    chain: Chain,
    camera: CameraSettings,
    cone: ConeVec,
    lit: ExposureSettings,
) -> tuple[Float32Array, npt.NDArray[Any], float, float]:
    """Simulate views: paths (k, n, rows, cols), transmission (n, rows, cols), saturated and
    starved parts.

    Without noise, with X-rays on. Paths are by material [mm]. Both parts are shares of all
    pixels, 0 to 1; starved pixels have less than `FEW_COUNTS` above dark.
    `parts`: the sample's k channels; `chain`: of the machine; `camera`: mode and region; `cone`:
    n views; `lit`: tube and time."""
    paths = np.stack([project_body(part.body, cone, camera.shape) for part in parts])
    images = radiographs(chain, paths, cone.rows, [lit] * len(cone))
    through = np.exp(-np.stack([image.integrals for image in images]))
    signal = np.stack([image.expected.mean_e for image in images if image.expected])
    signal = expected_counts(chain.panel, camera, signal)
    saturated = float((signal >= saturating_counts(chain.panel)).mean())
    return paths, through, saturated, float((signal < FEW_COUNTS).mean())


@dataclass(frozen=True)
class _Ray:
    """A ray through the sample: paths, its pixel's share of the beam, that of
    the brightest pixel."""

    paths_mm: tuple[float, ...]
    flux: float
    brightest: float
    added: tuple[Substance, float] | None = None

    def with_detail(
        self, detail: tuple[Substance | None, float], substances: Sequence[Substance]
    ) -> _Ray:
        """Return the ray with a detail: so much of a substance more, or less of what
        attenuates most.

        Most is by the mean attenuation over all energies times the path.

        Args:
            detail: substance and thickness [mm]; without a substance, a void of that
                thickness.
            substances: of the ray's paths.

        Raises:
            LimitError: a void thicker than the path.
        """
        substance, thickness = detail
        if substance is not None:
            return replace(self, added=(substance, thickness))
        weights = [
            s.attenuation().mean() * d
            for s, d in zip(substances, self.paths_mm, strict=True)
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
    """Parse MATERIAL:MM to name and thickness [mm]; the material is not looked up here.

    Args:
        what: name of the argument, for the message.
        words: the text; the last colon divides it.

    Raises:
        LimitError: no number above 0 and at most 1000 after the colon.
    """
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
