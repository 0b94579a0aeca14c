"""`flexdt.simulate`: a sample and a geometry in, a data set in memory out; `flexdt.project`.

The images come from the chain that the twin itself uses (`flexdt.twin.physics`): exact paths
through each material, spectrum, panel, noise. Only the geometry is given instead of following
from motors. Views are computed a few at a time, so memory holds the counts and little more.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import (
    Channel,
    attenuating,
    chain_through,
    channels,
    line_integrals,
    scatter_object,
)
from flexdt.phantoms.placement import Place
from flexdt.phantoms.samples import as_phantom
from flexdt.twin import long_work
from flexdt.twin.caller_warnings import warn_caller
from flexdt.twin.errors import GeometryError, LimitError, require_within
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.long_work import Advance, Progress
from flexdt.twin.machine.camera import CameraSettings, PixelGrid, Roi
from flexdt.twin.machine.description import Machine
from flexdt.twin.physics.blur import spot_blur_px
from flexdt.twin.physics.chain import (
    Chain,
    PixelPaths,
    Radiograph,
    beam_of,
    expected_signal,
    flux_of,
    open_noise,
    radiographs,
    without_spot,
)
from flexdt.twin.physics.detector import EXPOSURES_MS, Detector, detector_of
from flexdt.twin.physics.exposure import Counts, ExposureSettings, frame_rng
from flexdt.twin.physics.readout import Expected, read_out
from flexdt.twin.physics.sampled_views import edges_needed, spot_views
from flexdt.twin.physics.scatter import (
    Beam,
    ScanScatter,
    Scatter,
    ScatterSettings,
    scan_scatter,
)
from flexdt.twin.physics.tube import Tube, tube_of
from flexdt.twin.plausibility import Operation, examine, settled, warn_of
from flexdt.twin.projection import Volume, forward, project_body
from flexdt.twin.projection.analytic_solids import Vector
from flexdt.twin.projection.finer_pixels import voxel_rays_a_side
from flexdt.twin.projection.operators import as_cone_vec
from flexdt.twin.projection.pixel_areas import (
    Need,
    area_means,
    needed,
    paths_within,
)
from flexdt.twin.rays_a_pixel import Rays, check_rays
from flexdt.twin.signatures import public

if TYPE_CHECKING:
    from flexdt.library.data_set import DataSet

BATCH_BYTES: Final = 64 << 20
"""Path lengths in memory at a time."""
MAX_SPOT_POINTS: Final = 1024
FILLED_SHARE: Final = 0.8
"""Part of the panel's range that the open beam fills with the default exposure."""
MIN_DOUBTED_PX: Final = 0.25
"""Difference of the spot's blur over a sample from which it is worth a warning [pixels]."""
PITCH_TOLERANCE: Final = 1e-6
"""Relative difference of pitches that count as equal."""


@dataclass(frozen=True, eq=False, repr=False)
class Truth:
    """Sample and settings of a simulated data set.

    Attributes:
        sample: as it was simulated.
        geometry: of the views.
        chain: tube, materials and panel.
        exposure: tube and time of each image.
        camera: mode and region of interest.
        seed: of the noise; None without any.
        parts: the materials and their places.
        scatter: of each view, in units of the open beam; None if it was not simulated.
        rays: along each side of a pixel that an edge reaches, or "auto".
        spot_points: of the focal spot; 1 for one blur of the whole image.
    """

    sample: Phantom
    geometry: ConeVec
    chain: Chain
    exposure: ExposureSettings
    camera: CameraSettings
    seed: int | None
    parts: tuple[Channel, ...]
    scatter: ScanScatter | None = None
    rays: Rays = "auto"
    spot_points: int = 1

    def __repr__(self) -> str:
        """Format the sample's name, the number of views, averages x exposure [ms], kV and
        W.
        """
        lit = self.exposure
        return (
            f"<Truth: {self.sample.name!r}, {len(self.geometry)} views of {lit.averages} x "
            f"{lit.exposure_ms:.4g} ms at {lit.kV:g} kV, {lit.power_W:g} W>"
        )

    def of_views(self, chosen: npt.NDArray[np.intp]) -> Truth:
        """Return the truth of some of the views, by index: geometry and, if there is any,
        scatter are selected, all else is the same."""
        if self.scatter is None:
            scatter = None
        else:
            scatter = self.scatter.of_views(chosen)
        return replace(self, geometry=self.geometry[chosen], scatter=scatter)

    @property
    def assumed(self) -> tuple[str, ...]:
        """Assumptions about the materials."""
        return tuple(dict.fromkeys(p.assumed for p in self.parts if p.assumed))

    def paths_mm(self, views: slice = slice(None)) -> Float32Array:
        """Compute the path of the ray to each pixel's center through each material,
        float32 (materials, n, rows, cols) [mm]."""
        return self._paths(self.geometry[views])

    def _paths(self, cone: ConeVec) -> Float32Array:
        """Compute path lengths through each part (parts, n, rows, cols) [mm]."""
        out = np.empty((len(self.parts), len(cone), *self.camera.shape), np.float32)
        for i, part in enumerate(self.parts):
            out[i] = project_body(part.body, cone, self.camera.shape)
        return out

    def radiographs(self) -> Iterator[Radiograph]:
        """Simulate the noise-free radiograph of each view, in batches that fit the
        memory.

        The signals of several rays in a pixel and of points of the focal spot are averaged,
        and scatter is added.
        With several spot points the images are not blurred by the spot once more. A batch
        takes about `BATCH_BYTES` of path lengths, at least one view.

        Yields:
            One radiograph a view, in order.
        """
        rows, cols = self.camera.shape
        chain = self.chain
        points = self.spot_points
        spot_mm = chain.tube.focal_spot_mm(self.exposure.power_W)
        if points > 1:
            chain = without_spot(chain)
        sides = [
            voxel_rays_a_side(part.body, self.geometry[:1])
            for part in self.parts
            if isinstance(part.body, Volume) and self.rays != 1
        ]
        rays = 1 + max(sides, default=0) ** 2
        each = max(
            1, BATCH_BYTES // (4 * rows * cols * points * rays * max(1, len(self.parts)))
        )
        need = self._need()
        for start in range(0, len(self.geometry), each):
            views = slice(start, min(start + each, len(self.geometry)))
            exposures = [self.exposure] * (views.stop - views.start)
            known = self.scatter
            if known is None:
                added = []
            else:
                added = [known[i] for i in range(views.start, views.stop)]
            cone = self.geometry[views]
            if points > 1:
                cone = ConeVec(spot_views(cone.rows, spot_mm, points))
            paths = self._paths(cone)
            areas = None if need is None else self._areas(cone, need)
            yield from radiographs(
                chain, paths, cone.rows, exposures, points, added, areas
            )

    def _need(self) -> Need | None:
        """Compute what the pixels need for an error below the noise of the exposure; None
        for one ray a pixel."""
        if not self.parts or not len(self.geometry):
            return None
        view = self.geometry.rows[0]
        blur = 0.0
        if self.spot_points == 1:
            spot_mm = self.chain.tube.focal_spot_mm(self.exposure.power_W)
            blur = spot_blur_px(view, spot_mm)
        noise = open_noise(self.chain, view, self.exposure)
        return edges_needed(self.rays, noise, blur, self.spot_points)

    def _areas(self, cone: ConeVec, need: Need) -> PixelPaths:
        """Compute the paths along the rays of the pixels that need several."""
        mu = beam_of(self.chain, self.exposure.kV).mean_mu().tolist()
        parts = [(part.body, x) for part, x in zip(self.parts, mu, strict=True)]
        shape = self.camera.shape
        within = needed(parts, cone, shape, need)
        paths = np.stack([paths_within(body, cone, shape, within) for body, _ in parts])
        return PixelPaths(within, paths)

    def read(self, number: int, expected: Expected, lit: ExposureSettings) -> Counts:
        """Read out an expected image as counts, with the noise of image `number` unless
        noise is off."""
        rng = None if self.seed is None else frame_rng(self.seed, number)
        return read_out(self.chain.panel, expected, self.camera, lit, rng)

    def line_integrals(self) -> Float32Array:
        """Compute noise-free line integrals, float32 (n, rows, cols)."""
        return np.stack([image.integrals for image in self.radiographs()])


@public
def project(
    sample: object,
    geometry: ConeVec | npt.ArrayLike,
    *,
    shape: tuple[int, int] | None = None,
    material: str | Mapping[int, str] | None = None,
    voxel_mm: float | Vector | None = None,
    place: Place = "keep",
    rays: Rays = 1,
    progress: Progress = None,
) -> Float32Array:
    """Project line integrals of attenuation, without tube, noise and detector; see
    `flexdt.simulate`.

    Solids and meshes are exact path lengths times their attenuation at its effective
    energy, voxels exact lengths through each voxel (Siddon). Bodies of one mesh that
    overlap count once.

    Args:
        sample: a Volume, a phantom or its name, a file, a mesh, an array with `voxel_mm`,
            or a list of them, which add up.
        geometry: of the views, in the sample's frame.
        shape: detector (rows, cols), where the geometry has none.
        material: of a mesh or an array; {1: "pmma", 2: "steel"} for an array of labels.
        voxel_mm: edge of an array's voxels [mm].
        place: the sample stays where it is; "centred" puts the middle of its box on the
            axis.
        rays: along each side of a pixel that an edge of the sample reaches, 1 to 16; their
            line integrals are averaged. "auto": so many that such a pixel is within 0.3 %
            of the largest line integral (standard deviation). Of voxels all pixels have
            them, two to a voxel's shadow along each side at most.
        progress: a bar after two seconds; False for no bar, or a function of the fraction
            done.

    Returns:
        float32 (n, rows, cols), dimensionless.

    Warns:
        UserWarning: a geometry that fits no scan of the sample: the source inside it, ...

    Raises:
        TwinError: an invalid sample or geometry; names the allowed values.

    Example:
        >>> import numpy as np
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=4, shape=(5, 5), pixel=2)
        >>> images = project(Volume(np.full((8, 8, 8), 0.02), 1.0), scan)
        >>> images.shape, round(float(images[0, 2, 2]), 3)
        ((4, 5, 5), 0.16)
    """
    cone = as_cone_vec(geometry)
    size = cone.of_shape(shape)
    plain = isinstance(sample, Volume) and material is None and place == "keep"
    body: Any
    if plain:
        body = sample
    else:
        body = as_phantom(sample, material=material, voxel_mm=voxel_mm, place=place)
    findings = examine(
        Operation.PROJECT, cone, size, volume=_attenuation(body), boxes=body.boxes
    )
    warn_of(findings, GeometryError)
    with long_work.during("projecting", progress):
        return _averaged(body, cone, size, check_rays(rays))


def _averaged(
    body: Any, cone: ConeVec, size: tuple[int, int], rays: Rays
) -> Float32Array:
    """Project a volume or a phantom, averaged over the pixels' areas."""
    if isinstance(body, Volume):
        return forward(body, cone, size, rays=rays)
    images = line_integrals(body, cone, size)
    if rays == 1:
        return images
    return area_means(attenuating(body), cone, size, rays, images)


@public
def simulate(
    sample: object,
    geometry: ConeVec | npt.ArrayLike | None = None,
    *,
    tube: Tube | None = None,
    detector: Detector | None = None,
    noise: int | None = None,
    exposure_ms: float | None = None,
    scatter: Scatter | ScatterSettings = "off",
    machine: Machine | str | None = None,
    shape: tuple[int, int] | None = None,
    material: str | Mapping[int, str] | None = None,
    voxel_mm: float | Vector | None = None,
    place: Place = "keep",
    rays: Rays = "auto",
    spot_points: int = 1,
    progress: Progress = None,
) -> DataSet:
    """Simulate a scan: counts, dark and flat images of a sample.

    Args:
        sample: a phantom or its name, a file (phantom, scene, mesh), a Volume, an array
            with `voxel_mm`, a mesh, or a list of them; see
            `flexdt.phantoms.samples.as_phantom`.
        geometry: of the views, in the sample's frame; it gives the pixels' pitch. Without
            one the sample is the path of a CTSimU scenario, which states everything but
            `noise`; `flexdt-extensions` does it.
        tube: default: 90 kV, 50 W; filters and focal spot that it leaves open are the
            machine's.
        detector: default: the machine's, else the twin's panel with the geometry's
            pixels.
        noise: seed, >= 0; None for the expectation. Image i has a random generator of its
            own, counting the dark image (0), the flat image (1) and the projections.
        exposure_ms: of one read-out; None: the detector's or the machine's, or, where
            neither states one, so long that the brightest pixel of the open beam reaches
            80 % of the largest count. `truth` holds it.
        scatter: "mc" adds the radiation that the sample scatters, by Monte Carlo with the
            seed of `noise`; 'first' has been removed, use 'mc'. `ScatterSettings` state
            more. It is in the data set's `truth.scatter`.
        machine: a machine, its name or file, whose tube and detector are taken where
            `tube` and `detector` leave them open.
        shape: detector (rows, cols), where the geometry has none.
        material: of a mesh or an array; {1: "pmma", 2: "steel"} for an array of labels.
        voxel_mm: edge of an array's voxels [mm].
        place: the sample stays where it is; "centred" puts the middle of its box on the
            axis.
        rays: along each side of a pixel that an edge of the sample reaches, 1 to 16, or
            "auto", the default; their signals are averaged, as a
            pixel does. "auto" keeps the error on an edge below the exposure's
            noise (docs/physics.md). With 1 edges along rows or columns come out in
            steps, of which `align` has wider sigmas.
        spot_points: of the focal spot from which rays start, 3 to 1024; their signals are
            averaged, and each depth of the sample is blurred as it is. With 1 all are
            blurred as the rotation axis is, and the data set warns where that matters.
            Ghosts of edges stay where the blur [pixels] is more than about a quarter of
            the points.
        progress: a bar after two seconds; False for no bar, or a function of the fraction
            done.

    Returns:
        The data set in memory; its `truth` has sample and settings.

    Raises:
        TwinError: an invalid sample, geometry, tube or detector; names the allowed
            values.

    Warns:
        UserWarning: doubts about the images, such as saturated pixels, which are in the
            data set's `warnings` too.

    Example:
        >>> geometry = ConeVec.from_vectors([0, -400, 0], [0, 400, 0], [0.5, 0, 0], [0, 0, -0.5])
        >>> ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}
        >>> scan = simulate(ball, geometry, tube=Tube(kV=60), shape=(40, 40), noise=1)
        >>> scan.counts().shape, bool(scan.counts(0)[20, 20] < scan.flat[20, 20])
        ((1, 40, 40), True)
    """
    if geometry is None:
        given = (tube, detector, machine, shape, material, voxel_mm, exposure_ms)
        other = scatter != "off" or spot_points != 1 or given != (None,) * 7
        return _of_scenario(sample, noise, rays, alone=not other)
    from flexdt.library.data_set import DataSet
    from flexdt.library.datasets.image_doubts import image_doubts
    from flexdt.library.machines import machine as machine_of

    rays = check_rays(rays)
    _check_sampling(noise, spot_points)
    cone = as_cone_vec(geometry)
    size = cone.of_shape(shape)
    scanner = machine_of(machine) if isinstance(machine, str) else machine
    settings = Tube() if tube is None else tube
    if detector is None and scanner is None:
        detector = Detector()
    panel, camera = _panel(detector, scanner, size, *_pitch(cone))
    design = settings.model(None if scanner is None else tube_of(scanner.tube))
    with long_work.during("simulating", progress) as advance:
        phantom = as_phantom(sample, material=material, voxel_mm=voxel_mm, place=place)
        findings = examine(
            Operation.SIMULATE,
            cone,
            size,
            volume=_attenuation(phantom),
            boxes=phantom.boxes,
        )
        placed = settled(findings, GeometryError)
        parts = channels(phantom)
        chain = chain_through(parts, panel, design, settings.mono_keV)
        if exposure_ms is not None:
            require_within("exposure_ms", exposure_ms, *EXPOSURES_MS, "ms")
            camera = replace(camera, exposure_ms=float(exposure_ms))
        elif detector is not None and detector.exposure_ms is None:
            unit = settings.exposure(1.0)
            camera = replace(camera, exposure_ms=_chosen_ms(chain, camera, cone, unit))
        exposure = settings.exposure(camera.exposure_ms, camera.averages)
        scattered = None
        if scatter != "off":
            how = scatter
            if not isinstance(how, ScatterSettings):
                how = ScatterSettings(seed=noise or 0)
            grid = scatter_object(parts, phantom.size_mm, how.voxels)
            scattered = scan_scatter(
                grid, cone.rows, size, Beam.of(chain, exposure.kV), how
            )
        truth = Truth(
            phantom,
            cone,
            chain,
            exposure,
            camera,
            noise,
            parts,
            scattered,
            rays,
            spot_points,
        )
        counts, dark, flat = _exposed(truth, advance)
    made = DataSet.from_arrays(
        counts, cone, dark=dark, flat=flat, name=phantom.name, truth=truth
    )
    made = replace(made, full_scale=panel.full_scale)
    doubts = *placed, *image_doubts(made), *_flat_doubt(size, cone), *_spot_doubt(truth)
    for doubt in doubts:
        warn_caller(doubt)
    return replace(made, warnings=(*truth.assumed, *doubts))


def _of_scenario(
    sample: object, noise: int | None, rays: Rays, *, alone: bool
) -> DataSet:
    """Simulate a CTSimU scenario, which `flexdt-extensions` does.

    `sample`: path of the scenario. `noise`: seed; None for none. `rays`: along each side of a
    pixel. `alone`: whether nothing else was given, which the scenario states.
    Raises GeometryError: it is no path, or not alone.
    """
    if not isinstance(sample, str | os.PathLike) or not alone:
        raise GeometryError(
            "no geometry; allowed without one: the path of a CTSimU scenario, and noise",
            {"asked": None},
        )
    from flexdt.library.optional.extras import extension

    scenario = extension("scenario", "a CTSimU scenario")
    made: DataSet = scenario(sample, noise, rays)
    return made


def _exposed(truth: Truth, advance: Advance) -> tuple[Counts, Counts, Counts]:
    """Expose all views, then return their counts (n, rows, cols), and the dark and the
    flat image (rows, cols), uint16.

    The flat image is that of the first view's geometry.

    Args:
        truth: what is simulated.
        advance: takes the fraction done.
    """
    lit = truth.exposure
    size = truth.camera.shape
    nothing = np.zeros(size, np.float32)
    open_paths = np.zeros((len(truth.parts), *size), np.float32)
    open_beam = expected_signal(truth.chain, open_paths, truth.geometry.rows[0], lit)
    unlit = replace(lit, xrays_on=False)
    dark = truth.read(0, Expected(nothing, nothing), unlit)
    flat = truth.read(1, open_beam, lit)
    counts = np.empty((len(truth.geometry), *size), np.uint16)
    for i, image in enumerate(truth.radiographs()):
        assert image.expected is not None
        counts[i] = truth.read(2 + i, image.expected, lit)
        advance((i + 1) / len(counts))
    return counts, dark, flat


def _check_sampling(noise: int | None, spot_points: int) -> None:
    """Check the seed of the noise and the points of the focal spot, in this order.

    Raises:
        LimitError: a seed below 0, or points other than 1 or 3 to `MAX_SPOT_POINTS`.
    """
    if noise is not None and noise < 0:
        raise LimitError.instead(f"noise is {noise}", noise, "a seed >= 0, or None")
    allowed = (1, *range(3, MAX_SPOT_POINTS + 1))
    if spot_points not in allowed:
        raise LimitError(
            f"spot_points is {spot_points}; allowed: 1, or 3 to {MAX_SPOT_POINTS}",
            {"asked": spot_points, "allowed": [1, 3, MAX_SPOT_POINTS]},
        )


def _attenuation(body: Volume | Phantom) -> npt.NDArray[Any] | None:
    """Return the attenuation of a sample's voxels; None for solids and for voxels with
    material labels.
    """
    if isinstance(body, Volume):
        return body.data
    voxels = body.voxels
    if voxels is None or voxels.labels is not None:
        return None
    return voxels.data


def _chosen_ms(
    chain: Chain, camera: CameraSettings, cone: ConeVec, unit: ExposureSettings
) -> float:
    """Compute the exposure that fills `FILLED_SHARE` of the panel's range with the
    brightest open beam, dark charge and offset included [ms]; within `EXPOSURES_MS`.

    Args:
        chain: tube and panel.
        camera: mode and region of interest.
        cone: the views.
        unit: an exposure of 1 ms.

    Raises:
        LimitError: the panel's offset is more than half of its full scale.
    """
    panel = chain.panel
    size = camera.shape
    open_paths = np.zeros((len(chain.substances), *size), np.float32)
    brightest = max(_different(cone), key=lambda row: float(flux_of(row, size).max()))
    beam = expected_signal(chain, open_paths, brightest, unit).mean_e
    # A panel that is half full in the dark has little range left: say so, not an odd exposure.
    require_within(
        "offset_counts", panel.offset_counts, 0.0, 0.5 * panel.full_scale, "counts"
    )
    dark_e_per_ms = panel.dark_charge(camera) / 1000.0
    range_e = (FILLED_SHARE * panel.full_scale - panel.offset_counts) * panel.gain(camera)
    low, high = EXPOSURES_MS
    return min(max(range_e / (float(beam.max()) + dark_e_per_ms), low), high)


def _pitch(cone: ConeVec) -> tuple[float, float]:
    """Return the pixels' edges along u and v [mm]; those of the first view, and equal
    numbers where they differ by less than `PITCH_TOLERANCE`.

    Raises:
        GeometryError: no views, or edges that differ between views by more than
            `PITCH_TOLERANCE` of themselves.
    """
    lengths = np.linalg.norm([cone.u, cone.v], axis=2)
    if not lengths.size:
        raise GeometryError("a geometry without views cannot be simulated", {"asked": 0})
    u, v = lengths[:, 0].tolist()
    for name, values, first in zip("uv", lengths, (u, v), strict=True):
        if np.abs(values - first).max() > PITCH_TOLERANCE * first:
            least = float(values.min())
            most = float(values.max())
            message = f"pixels measure {least:.6g} to {most:.6g} mm along {name}"
            raise GeometryError.instead(message, [least, most], "alike in all views")
    return u, u if abs(v - u) <= PITCH_TOLERANCE * u else v


def _panel(
    detector: Detector | None,
    machine: Machine | None,
    shape: tuple[int, int],
    pitch: float,
    row_pitch: float,
) -> tuple[Detector, CameraSettings]:
    """Make detector and camera settings for a geometry's pixels.

    Without a given one, the machine's: binned by a whole number, with its usual region if
    that has this shape, else one in the middle of the panel.

    Args:
        detector: as given, or None.
        machine: whose detector is used otherwise.
        shape: (rows, cols).
        pitch, row_pitch: pixel edges along columns and rows [mm].

    Raises:
        LimitError: the detector states another pitch, or the machine's has no such pixels
            or too few.
    """
    if detector is not None:
        grid = PixelGrid(
            shape[1], shape[0], pitch, None if row_pitch == pitch else row_pitch
        )
        return detector.of_pixels(grid), detector.camera(shape)
    assert machine is not None
    spec = machine.detector
    binning = max(1, round(pitch / spec.pitch_mm))
    edges = spec.pixels.edges_mm
    if (
        np.abs(binning * np.array(edges) / (pitch, row_pitch) - 1.0).max()
        > PITCH_TOLERANCE
    ):
        raise LimitError(
            f"the geometry's pixels are {pitch:g} x {row_pitch:g} mm; "
            f"allowed with {spec.model}: one whole number times {edges[0]:g} x {edges[1]:g} mm. "
            "Give detector=Detector(...) for another detector",
            {"asked": [pitch, row_pitch], "allowed": list(edges), "unit": "mm"},
        )
    camera = spec.camera
    if (camera.binning, camera.shape) != (binning, shape):
        rows, cols = (n * binning for n in shape)
        if rows > spec.rows or cols > spec.columns:
            raise LimitError(
                f"{shape[0]} x {shape[1]} pixels (rows x columns) of {pitch:g} mm do not fit "
                f"{spec.model}; allowed: {spec.rows // binning} x {spec.columns // binning}",
                {
                    "asked": list(shape),
                    "allowed": [spec.rows // binning, spec.columns // binning],
                },
            )
        left = (spec.columns - cols) // 2
        top = (spec.rows - rows) // 2
        roi = Roi(left, top, left + cols - 1, top + rows - 1)
        if camera.binning == binning:
            mode = spec.mode
        else:
            mode = f"HW{binning}SW1High"
        camera = replace(camera, mode=mode, roi=roi)
    return detector_of(spec), camera


def _flat_doubt(shape: tuple[int, int], cone: ConeVec) -> Iterator[str]:
    """Yield a warning if the flat image, valid for views of one distance, differs between
    views.

    Differences up to 0.1 % pass; at most one text. About 100 views of different distances
    are compared.

    Args:
        shape: (rows, cols).
        cone: the views.
    """
    first = flux_of(cone.rows[0], shape)
    worst = max(
        (
            float(np.abs(flux_of(row, shape) / first - 1.0).max())
            for row in _different(cone)
        ),
        default=0.0,
    )
    if worst > 1e-3:
        yield (
            "the flat image is that of the first view; "
            f"the open beam of other views differs by up to {100.0 * worst:.2g} %"
        )


def _spot_doubt(truth: Truth) -> Iterator[str]:
    """Warn if one blur does not hold for the sample's depth: with one spot point, when
    the blur of its near and far side differ by more than `MIN_DOUBTED_PX`.

    Yields at most one text, which proposes a number of spot points; nothing with several
    points. The first view is examined.
    """
    spot_mm = truth.chain.tube.focal_spot_mm(truth.exposure.power_W)
    half = 0.5 * float(np.hypot(*truth.sample.size_mm[:2]))
    view = truth.geometry.rows[0]
    far, axis, near = (spot_blur_px(view, spot_mm, at) for at in (-half, 0.0, half))
    if truth.spot_points == 1 and near - far > MIN_DOUBTED_PX:
        yield (
            f"the focal spot blurs the whole sample by {axis:.2g} pixels (standard deviation), "
            f"really by {far:.2g} to {near:.2g}, from its far side to its near one: "
            f"spot_points={max(16, 4 * int(np.ceil(min(near, 200.0))))} has each depth as it is"
        )


def _different(cone: ConeVec) -> npt.NDArray[np.float64]:
    """Return rows of about 100 of the views whose distances or foot points differ
    (rounded to 1e-6), those with the extremes among them, (k, 12)."""
    ray = cone.source - cone.detector
    feet = [np.einsum("ij,ij->i", ray, edge) for edge in (cone.u, cone.v)]
    keys = np.column_stack([cone.source_detector_distance, *feet]).round(6)
    _, index = np.unique(keys, axis=0, return_index=True)
    some = index[np.linspace(0, len(index) - 1, 100).astype(int)]
    ends = keys.argmin(axis=0), keys.argmax(axis=0)
    return np.asarray(cone.rows[np.unique(np.concatenate([some, *ends]))])
