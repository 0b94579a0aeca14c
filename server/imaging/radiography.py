"""One image from poses to counts, by the physics that was chosen when the twin started.

`ideal` is the plain model of `flexdt.twin.physics.exposure`: one attenuation for each
material, no distance law. `poly` takes the path through each material, the tube's
spectrum, the focal spot and the panel (see `flexdt.twin.physics`); `mono` is the same
chain with photons of one energy.

Saturated, starved and truncated images are judged on the image without noise and as
though X-rays were on, so that users are warned before a scan. How good the images of a
scan will be is forecast in a worker process with limits.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, assert_never

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom, exposure_forecast
from flexdt.phantoms.channels import Channel, chain_through
from flexdt.protocol import Codec
from flexdt.protocol.connection import encoded
from flexdt.protocol.methods.image_messages import PREDICTION_LIMITS, ExposurePrediction
from flexdt.protocol.state_model import ImageEdge, ImageFlags
from flexdt.runtime.workers import Workers
from flexdt.server.imaging.projections import Imaging, Pieces, TrueGeometry
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.physics import exposure as ideal
from flexdt.twin.physics import scatter as mc
from flexdt.twin.physics.blur import spot_blur_px
from flexdt.twin.physics.chain import (
    Chain,
    Radiograph,
    Scattered,
    beam_of,
    open_noise,
    radiographs,
    without_spot,
)
from flexdt.twin.physics.detector import Detector, detector_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.predicted_beam import CountShares, Physics, only_keV
from flexdt.twin.physics.readout import Expected, expected_counts, read_out
from flexdt.twin.physics.sampled_views import edges_needed
from flexdt.twin.physics.tube import TubeModel, tube_of, voltages
from flexdt.twin.projection.pixel_areas import Need
from flexdt.twin.rays_a_pixel import Rays
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script.planning.sample_findings import SampleProbe, shares_behind

SCATTER: Final = mc.ScatterSettings()
"""Settings of the scatter simulation."""
MAX_MEMORY_S: Final = 10.0
"""Time after which an earlier frame has no effect on the panel [s]."""
Before = Sequence[tuple[Radiograph, float]]
"""Earlier frames taken with X-rays on, and the time [s] from their ends to
this frame's start."""
MAX_PROPOSALS: Final = 10
"""Number of proposed settings."""
JUDGED_STEP_PX = 3
"""Step of the grid on which pixels are judged; edges are judged on all their pixels."""
CUT_OFF_INTEGRAL = 0.05
"""Line integral at an edge of the image above which the sample counts as cut off."""
# Terms of a pixel's mark; a mark is their sum.
SATURATED = 1
STARVED = 2
CUT_OFF = 4


def counts_photons(physics: Physics) -> bool:
    """Return whether a physics computes photons, instead of line integrals' response."""
    match physics:
        case "ideal":
            return False
        case "mono" | "poly":
            return True
        case _:
            assert_never(physics)


def with_spectra(machine: Machine, physics: Physics) -> Machine:
    """Restrict a machine's tube to the voltages for which the physics has spectra.

    A voltage without a spectrum is then an error wherever one outside the tube's limits
    is.

    Returns:
        The machine with narrower limits; unchanged for physics "ideal".

    Raises:
        LimitError: the voltage at start has none.
    """
    if not counts_photons(physics):
        return machine
    tube = machine.tube
    lowest, highest = voltages()
    low = max(lowest, tube.min_kV)
    high = min(highest, tube.max_kV)
    if not low <= tube.kV <= high:
        message = f"physics {physics} has no spectrum for the tube's {tube.kV:g} kV"
        raise LimitError.instead(message, tube.kV, f"{low:g} to {high:g} kV")
    held = tube.model_copy(update={"min_kV": low, "max_kV": high})
    return machine.model_copy(update={"tube": held})


@dataclass(frozen=True)
class Radiography:
    """Makes images by one of the three kinds of physics.

    Attributes:
        imaging: projects.
        model: of tube and detector, of the first.
        physics: ideal, mono or poly.
        panel, tube: of the other two.
        scatter: the sample's scatter on the panel, of the other two: off or mc.
        rays: along each side of a pixel that an edge reaches, or "auto".
    """

    imaging: Imaging
    model: ideal.IdealResponse
    physics: Physics = "ideal"
    panel: Detector = field(default_factory=Detector)
    tube: TubeModel = field(default_factory=TubeModel)
    scatter: mc.Scatter = "off"
    rays: Rays = "auto"

    @classmethod
    def of(
        cls,
        imaging: Imaging,
        machine: Machine,
        physics: Physics = "ideal",
        scatter: mc.Scatter = "off",
        rays: Rays = "auto",
    ) -> Radiography:
        """Make the radiography of a machine's tube and detector.

        The ideal response, panel and tube are made whatever the physics.

        Raises:
            LimitError: ideal physics has no scatter.
        """
        if not counts_photons(physics) and scatter != "off":
            raise LimitError(
                f"scatter {scatter} needs physics mono or poly, not ideal",
                {"asked": scatter, "allowed": ["off"]},
            )
        panel = detector_of(machine.detector)
        tube = tube_of(machine.tube)
        response = ideal.ideal_response(machine)
        return cls(imaging, response, physics, panel, tube, scatter, rays)

    @property
    def photons(self) -> bool:
        """Whether images count photons."""
        return counts_photons(self.physics)

    @property
    def remembers(self) -> bool:
        """Whether a frame depends on earlier frames."""
        return self.photons and (self.panel.lag_fraction > 0.0 or self.traps)

    @property
    def traps(self) -> bool:
        """Whether a frame depends on all earlier frames."""
        return self.photons and self.panel.long_lag_fraction > 0.0

    def record(self) -> Mapping[str, float]:
        """List the figures of the images' physics by name, for data sets.

        "ideal": the noise model's, without its reference; else markers of physics and
        scatter, and the figures of detector and tube. `rays` along each side of a pixel, or
        the mark `rays_auto`, unless there is one.
        """
        if self.rays == "auto":
            rays = {"rays_auto": 1.0}
        else:
            rays = {"rays": float(self.rays)}
        if not self.photons:
            return {
                name: float(getattr(self.model, name))
                for name in self.model.__dataclass_fields__
                if name != "reference"
            } | rays
        figures = {f"physics_{self.physics}": 1.0, **self.panel.figures(), **rays}
        if self.scatter != "off":
            figures |= {f"scatter_{self.scatter}": 1.0, "scatter_error": SCATTER.error}
        return figures | self.tube.figures()

    async def require_room(self, sample: Sample) -> None:
        """Check that a scan's sample, divided as the physics needs, fits into memory. By parts
        for "ideal", else by materials; raises as `Imaging.require_room`."""
        pieces: Pieces = "material" if self.photons else "part"
        await self.imaging.require_room(sample, pieces)

    async def take(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        exposures: Sequence[ExposureSettings],
        *,
        truth: TrueGeometry | None = None,
    ) -> list[Radiograph]:
        """Compute radiographs of `sample`, without noise, one for each of `exposures`.

        "ideal" gives line integrals, and settings do not matter; "mono" and "poly"
        give expected counts. With an extended focal spot images are made one by one,
        and its size is that of each exposure's power. Scatter is simulated at each
        image's middle pose; an empty stage has none.

        Args:
            sample: on the stage.
            poses: n nominal poses: as many for each image, spread over its exposure; n
                is a multiple of the number of exposures.
            camera: of all of them.
            exposures: tube and time of each image; taken as if X-rays were on.
            truth: instead of the hidden one.

        Returns:
            One radiograph for each exposure, the mean of its poses.

        Raises:
            ProjectorUnavailable: the projector does not answer.
            GeometryError: a geometry no scanner can have.
            LimitError: a voltage without a spectrum.
        """
        count = len(exposures)
        if not self.photons:
            noise = min(self._ideal_noise(one) for one in exposures)
            wanted = edges_needed(self.rays, noise, 0.0)
            lines = await self.imaging.line_integrals(
                sample, poses, camera, truth=truth, need=wanted
            )
            if len(lines) == count:
                return [Radiograph(one) for one in lines]
            return [
                Radiograph(part) for part in lines.reshape(count, -1, *lines.shape[1:])
            ]
        points = self.tube.spot_points
        moments = len(poses) // count
        if points > 1 and count > 1:  # one by one: each holds the paths of all its points
            parts = [slice(i * moments, (i + 1) * moments) for i in range(count)]
            return [
                (await self.take(sample, poses[p], camera, [e], truth=truth))[0]
                for p, e in zip(parts, exposures, strict=True)
            ]
        spot = self.tube.focal_spot_mm(exposures[0].power_W), points

        def need(parts: tuple[Channel, ...]) -> tuple[Need, list[float]] | None:
            """Compute what pixels need, and the attenuation of each material."""
            chain = chain_through(parts, self.panel, self.tube, only_keV(self.physics))
            view = poses[:1].cone_vec().rows[0]
            noise = [open_noise(chain, view, exposure) for exposure in exposures]
            blur = spot_blur_px(view, spot[0]) if points == 1 else 0.0
            wanted = edges_needed(self.rays, min(noise), blur, points)
            if wanted is None:
                return None
            return wanted, beam_of(chain, exposures[0].kV).mean_mu().tolist()

        channels, paths, views, areas = await self.imaging.path_lengths(
            sample, poses, camera, truth=truth, spot=spot, need=need
        )
        chain = chain_through(channels, self.panel, self.tube, only_keV(self.physics))
        if points > 1:
            chain = without_spot(chain)
            moments = moments * points
        added: list[Scattered] = []
        if self.scatter != "off" and channels:
            thing = await self.imaging.scatterer(sample, SCATTER.voxels)
            middles = views[moments // 2 :: moments]
            added = await asyncio.to_thread(
                self._scattered, thing, chain, middles, camera, exposures
            )
        return await asyncio.to_thread(
            radiographs, chain, paths, views, exposures, moments, added, areas
        )

    def _ideal_noise(self, exposure: ExposureSettings) -> float:
        """Compute the noise of an open pixel by the ideal model, relative to its signal;
        infinite without a signal."""
        beam = ideal.open_beam(self.model, replace(exposure, xrays_on=True))
        if beam <= 0.0:
            return math.inf
        photons = self.model.photons_per_count * exposure.averages
        return 1.0 / math.sqrt(beam * photons)

    def _scattered(
        self,
        thing: mc.Object,
        chain: Chain,
        views: FloatArray,
        camera: CameraSettings,
        exposures: Sequence[ExposureSettings],
    ) -> list[Scattered]:
        """Simulate the scatter of each image by its own view (n, 12) alone.

        So a scan that is resumed has the same bytes. `thing`: the sample's voxels.
        """
        beams = {
            kV: mc.Beam.of(chain, kV) for kV in {exposure.kV for exposure in exposures}
        }
        return [
            mc.view_scatter(thing, view, camera.shape, beams[exposure.kV], SCATTER)
            for view, exposure in zip(views, exposures, strict=True)
        ]

    async def predicted_shares(self, sample: Sample, probe: SampleProbe) -> CountShares:
        """Predict the saturated and starved parts of a setting's pixels behind a sample.

        Without noise and scatter.

        `sample`: that the scan is to show; nominal geometry, nothing hidden. `probe`: setting,
        and the rays that are looked at.
        Returns the parts of the rays' counts that are saturated and starved.
        Raises ProjectorUnavailable: the projector does not answer; LimitError: a voltage without
        a spectrum.
        """
        cone = probe.cone_vec
        if not self.photons:
            lines = await self.imaging.nominal_integrals(sample, cone)
            counts = np.exp(-lines) * np.float32(
                ideal.open_beam(self.model, probe.exposure)
            )
            return CountShares.of(counts, self.saturating)
        parts, paths = await self.imaging.nominal_paths(sample, cone)
        chain = chain_through(parts, self.panel, self.tube, only_keV(self.physics))
        return await asyncio.to_thread(shares_behind, chain, probe, paths, cone.rows)

    def dark(self, camera: CameraSettings) -> Radiograph:
        """Make the image without X-rays: zero line integrals.

        With physics other than "ideal" also expected counts, all zero.
        """
        nothing = np.zeros(camera.shape, dtype=np.float32)
        if not self.photons:
            return Radiograph(nothing)
        return Radiograph(nothing, Expected(nothing, nothing))

    @property
    def full_scale(self) -> int:
        """Largest count of an image, by the ideal model or the panel."""
        if not self.photons:
            return self.model.full_scale
        return self.panel.full_scale

    @property
    def offset(self) -> float:
        """Mean count without signal, by the ideal model (dark counts) or the panel."""
        if not self.photons:
            return self.model.dark_counts
        return self.panel.offset_counts

    @property
    def saturating(self) -> float:
        """Counts above dark from which a pixel is saturated."""
        return self.full_scale - self.offset

    def signal(
        self, radiograph: Radiograph, camera: CameraSettings, exposure: ExposureSettings
    ) -> Float32Array:
        """Compute the expected counts above dark as if X-rays were on, (rows, cols).

        Without noise, not clipped. But for "ideal" the exposure is in the radiograph.
        """
        if radiograph.expected is not None:
            return expected_counts(self.panel, camera, radiograph.expected.mean_e)
        lit = replace(exposure, xrays_on=True)
        return np.exp(-radiograph.shown) * np.float32(ideal.open_beam(self.model, lit))

    def counts(
        self,
        radiograph: Radiograph,
        camera: CameraSettings,
        exposure: ExposureSettings,
        rng: np.random.Generator | None,
        before: Before = (),
        trapped: Float32Array | None = None,
    ) -> ideal.Counts:
        """Compute the counts that the camera saves of a radiograph, uint16 (rows, cols).

        X-rays off give a dark image. `rng`: of the noise; None for the expectation.
        `before`: earlier frames, with the time since their end [s]; `trapped`: electrons
        in traps. Ideal physics uses neither.
        """
        expected = radiograph.expected
        if expected is None:
            return ideal.expose(self.model, radiograph.integrals, exposure, rng)
        if not exposure.xrays_on:
            expected = self.dark(camera).expected
            assert expected is not None
        left = [
            (earlier.expected.mean_e, gap)
            for earlier, gap in before
            if earlier.expected is not None
        ]
        return read_out(self.panel, expected, camera, exposure, rng, left, trapped)


def marks_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    binning: int = 1,
) -> npt.NDArray[np.uint8]:
    """Mark every pixel with the sum of SATURATED, STARVED and CUT_OFF.

    Judged without noise. STARVED: fewer than `FEW_COUNTS` above dark. CUT_OFF: on the
    image's edge, with a line integral above `CUT_OFF_INTEGRAL`. Rows and columns that
    do not fill a binned pixel mark the last one.

    Args:
        radiography, radiograph, camera, exposure: as in `flags_of`.
        binning: pixels a side; a mark of any of them is a mark of their mean. At most
            rows and cols.

    Returns:
        uint8 (rows // binning, cols // binning).
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)
    marks = np.where(signal >= radiography.saturating, SATURATED, 0)
    marks += np.where(signal < ideal.FEW_COUNTS, STARVED, 0)
    edge = np.ones(lines.shape, np.bool_)
    edge[1:-1, 1:-1] = False
    marks += np.where(edge & (lines > CUT_OFF_INTEGRAL), CUT_OFF, 0)
    rows, cols = (n // binning for n in lines.shape)
    # Surplus rows and columns are cut off, as `binned_mean` does: their marks go to the
    # last kept.
    small = marks[: rows * binning, : cols * binning].astype(np.uint8)
    height, width = small.shape
    small[-1] |= np.bitwise_or.reduce(marks[height - 1 :, :width]).astype(np.uint8)
    small[:, -1] |= np.bitwise_or.reduce(marks[:height, width - 1 :], axis=1).astype(
        np.uint8
    )
    blocks = small.reshape(rows, binning, cols, binning)
    return np.asarray(np.bitwise_or.reduce(blocks, axis=(1, 3)), dtype=np.uint8)


def flags_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    time: float | None = None,
) -> ImageFlags:
    """Compute the saturated and starved parts of an image, and the edges that cut the
    sample off.

    Judged without noise at every `JUDGED_STEP_PX`-th pixel; parts are 0 to 1. An edge
    ("left", "right", "top", "bottom") is cut where any of its pixels is above
    `CUT_OFF_INTEGRAL`. `good_counts` and `good_lines` are the ranges of counts and of
    line integrals (rounded to 0.01) that are neither starved nor saturated.

    Args:
        radiography: how images are made.
        radiograph: the image.
        camera, exposure: its settings; taken as if X-rays were on.
        time: of its pose [s]; None leaves it out.

    Returns:
        The flags, as they go to clients.
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)[
        ::JUDGED_STEP_PX, ::JUDGED_STEP_PX
    ]
    top = radiography.saturating
    # The signal of an open beam, as a logarithm. Two digits: with more, poly would reveal
    # distances.
    beam = float(
        np.median(
            lines[::JUDGED_STEP_PX, ::JUDGED_STEP_PX] + np.log(np.maximum(signal, 1e-30))
        )
    )
    edges: dict[ImageEdge, Float32Array] = {
        "left": lines[:, 0],
        "right": lines[:, -1],
        "top": lines[0],
        "bottom": lines[-1],
    }
    return ImageFlags(
        time=time,
        saturated=float(np.mean(signal >= top)),
        starved=float(np.mean(signal < ideal.FEW_COUNTS)),
        truncated=[
            name for name, edge in edges.items() if float(edge.max()) > CUT_OFF_INTEGRAL
        ],
        good_counts=(radiography.offset + ideal.FEW_COUNTS, radiography.full_scale),
        good_lines=(
            round(beam - math.log(top), 2),
            round(beam - math.log(ideal.FEW_COUNTS), 2),
        ),
    )


def predictors() -> Workers:
    """Make the worker process that predicts; the caller closes it."""
    limits = PREDICTION_LIMITS
    return Workers(1, int(limits["memory_bytes"]), float(limits["seconds"]))


def predict(
    phantom: Phantom, machine: Machine, settings: dict[str, Any], codec: Codec
) -> list[bytes]:
    """Answer `exposure.predict`, in the worker, as encoded pieces.

    The forecast's `images` are sent as `frames`. At most `MAX_PROPOSALS` of the best; the
    infinite last edge is left out. `settings`: of `expose`. Raises RpcError: an argument
    beyond the machine.
    """
    answer = asdict(exposure_forecast.expose(phantom, machine=machine, **settings))
    answer["transmission"]["edges"] = answer["transmission"]["edges"][
        :-1
    ]  # no infinity in JSON
    answer |= {
        "sample": phantom.name,
        "best": answer["best"][:MAX_PROPOSALS],
        "frames": answer.pop("images"),
    }
    result = ExposurePrediction.model_validate(answer, strict=False)
    return list(encoded(result, codec).pieces)
