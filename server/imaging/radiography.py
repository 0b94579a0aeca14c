"""One image from poses to counts, by the physics that was chosen when the twin started.

`ideal` is the plain model of `flexdt.twin.physics.exposure`: one attenuation for each material, no
distance law. `poly` takes the path through each material, the tube's spectrum, the focal spot and
the panel (see `flexdt.twin.physics`); `mono` is the same chain with photons of one energy.

What is wrong with an image at first sight: too bright, too dark, cut off.

All three are judged on the image without noise and as though X-rays were on, so that users are
warned before a scan.

From nominal poses to line integrals: the one path on which the true geometry is used.

Adds the hidden truth, transforms into the sample's frame, makes sure that the projector has the
sample, and requests the projection. Images are the only results that depend on the truth.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal, Protocol, get_args

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import Channel, chain_through, channels
from flexdt.phantoms.materials import stated_keV
from flexdt.protocol.state_model import ImageFlags
from flexdt.server.imaging.truth import TrueGeometry
from flexdt.server.storage.samples import SampleStore
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.cone_vec import ConeVec, check_cone_vec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings, Sensor
from flexdt.twin.machine.description import Machine
from flexdt.twin.physics import Expected, Panel, TubeModel, panel_of, read_out, tube_of
from flexdt.twin.physics.exposure import Counts, DetectorModel, ExposureSettings, expose, open_beam
from flexdt.twin.physics.radiograph import Radiograph, radiographs
from flexdt.twin.physics.spectrum import voltages
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.scanner.state import Sample


class Projector(Protocol):
    """The part of the projector's client that projections need."""

    async def put_scene(self, name: str, scene: Scene) -> object:
        """Name an analytic scene."""

    async def put_volume(self, name: str, volume: Volume) -> object:
        """Name a volume."""

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], newest_wins: bool = False
    ) -> Float32Array:
        """Line integrals, float32 (n, rows, cols)."""


class Imaging:
    """Line integrals of the sample on the stage.

    Args:
        projector: computes them.
        truth: hidden misalignment.
        samples: what may stand on the stage.
        sensor: the detector.
    """

    def __init__(
        self, projector: Projector, truth: TrueGeometry, samples: SampleStore, sensor: Sensor
    ) -> None:
        self._projector, self._truth, self._samples, self._sensor = (
            projector,
            truth,
            samples,
            sensor,
        )
        self._known: dict[str, Phantom] = {}
        self._taken_apart: dict[str, tuple[Phantom, tuple[Channel, ...]]] = {}
        self._sending = asyncio.Lock()

    async def line_integrals(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        *,
        newest_wins: bool = False,
        times: npt.ArrayLike | None = None,
    ) -> Float32Array:
        """Images of `sample` at n nominal poses, `times` (n,) [s] after the scan's start.

        Returns:
            float32 (n, rows, cols), dimensionless; zeros for an empty stage.

        Raises:
            ProjectorUnavailable: the projector does not answer.
            GeometryError: a geometry no scanner can have.
        """
        if not sample.name:
            return np.zeros((len(poses), *camera.shape), dtype=np.float32)
        volume = await self._volume(sample)
        cone = self._truth.cone_vec(poses, sample.offset, times)
        check_cone_vec(cone, camera.pixels_mm(self._sensor))
        return await self._projector.project(volume, cone, camera.shape, newest_wins=newest_wins)

    async def path_lengths(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        *,
        newest_wins: bool = False,
        times: npt.ArrayLike | None = None,
    ) -> tuple[tuple[Channel, ...], Float32Array, FloatArray]:
        """Paths through each material of `sample` at n nominal poses.

        Returns:
            The materials (m), float32 (m, n, rows, cols) [mm], and the true geometry (n, 12), which
            must not leave the server.

        Raises:
            As `line_integrals`.
        """
        cone = self._truth.cone_vec(poses, sample.offset, times)
        check_cone_vec(cone, camera.pixels_mm(self._sensor))
        channels = await self._channels(sample) if sample.name else ()
        out = np.empty((len(channels), len(poses), *camera.shape), dtype=np.float32)
        for i in range(len(channels)):
            out[i] = await self._projector.project(
                _channel_name(sample, i), cone, camera.shape, newest_wins=newest_wins
            )
        return channels, out, cone.rows

    async def _channels(self, sample: Sample) -> tuple[Channel, ...]:
        """The sample's materials, known to the projector one by one."""
        async with self._sending:
            phantom = self._samples.load(sample.name, sample.material)
            name = _channel_name(sample, 0)
            known = self._taken_apart.get(name)
            if known is not None and known[0] is phantom:
                return known[1]
            found = await asyncio.to_thread(channels, phantom)
            for i, channel in enumerate(found):
                if isinstance(channel.body, Scene):
                    await self._projector.put_scene(_channel_name(sample, i), channel.body)
                elif isinstance(channel.body, Volume):
                    await self._projector.put_volume(_channel_name(sample, i), channel.body)
            self._taken_apart[name] = (phantom, found)
        return found

    async def _volume(self, sample: Sample) -> str:
        """The projector's name for the sample, sent there if it is new or has changed."""
        name = _name(sample)
        async with self._sending:
            phantom = self._samples.load(sample.name, sample.material)
            if self._known.get(name) is not phantom:
                if phantom.is_analytic:
                    await self._projector.put_scene(name, phantom.scene)
                else:
                    volume = await asyncio.to_thread(phantom.volume)
                    await self._projector.put_volume(name, volume)
                self._known[name] = phantom
        return name


def _name(sample: Sample) -> str:
    return sample.name if sample.material is None else f"{sample.name} of {sample.material}"


def _channel_name(sample: Sample, index: int) -> str:
    return f"{_name(sample)}, material {index}"


def binned_mean(images: Float32Array, factor: int) -> Float32Array:
    """Mean over factor x factor pixels; surplus rows and columns are cut off.

    Args:
        images: (..., rows, cols).
        factor: pixels a side.
    """
    if factor == 1:
        return images
    rows, cols = (n // factor for n in images.shape[-2:])
    cut = images[..., : rows * factor, : cols * factor]
    blocks = cut.reshape(*images.shape[:-2], rows, factor, cols, factor)
    mean: Float32Array = blocks.mean(axis=(-3, -1), dtype=np.float32)
    return mean


Physics = Literal["ideal", "mono", "poly"]
PHYSICS: Final[tuple[Physics, ...]] = get_args(Physics)
FORGOTTEN_S: Final = 10.0
"""Time after which an earlier frame has left nothing on the panel."""


def with_spectra(machine: Machine, physics: Physics) -> Machine:
    """The machine, its tube held within the voltages that the physics has spectra for.

    A voltage without a spectrum is then an error wherever one outside the tube's limits is.

    Raises:
        LimitError: the voltage at start has none.
    """
    if physics == "ideal":
        return machine
    tube, (least, most) = machine.tube, voltages()
    low, high = max(least, tube.min_kV), min(most, tube.max_kV)
    if not low <= tube.kV <= high:
        raise LimitError(
            f"physics {physics} has no spectrum for the tube's {tube.kV:g} kV; allowed: {low:g} to "
            f"{high:g} kV",
            {"asked": tube.kV, "allowed": [low, high], "unit": "kV"},
        )
    held = tube.model_copy(update={"min_kV": low, "max_kV": high})
    return machine.model_copy(update={"tube": held})


Before = Sequence[tuple[Radiograph, float]]
"""Earlier frames taken with X-rays on, and the time [s] from their ends to this frame's start."""


@dataclass(frozen=True)
class Radiography:
    """Makes images by one of the three kinds of physics.

    Attributes:
        imaging: projects.
        model: the ideal detector.
        physics: ideal, mono or poly.
        panel, tube: of the other two.
    """

    imaging: Imaging
    model: DetectorModel
    physics: Physics = "ideal"
    panel: Panel = field(default_factory=Panel)
    tube: TubeModel = field(default_factory=TubeModel)

    @classmethod
    def of(
        cls, imaging: Imaging, model: DetectorModel, machine: Machine, physics: Physics = "ideal"
    ) -> Radiography:
        """For a machine's tube and detector."""
        return cls(imaging, model, physics, panel_of(machine.detector), tube_of(machine.tube))

    @property
    def remembers(self) -> bool:
        """Whether a frame depends on earlier frames."""
        return self.physics != "ideal" and self.panel.lag_fraction > 0.0

    def record(self) -> Mapping[str, float]:
        """The figures of detector and tube by name, for data sets."""
        if self.physics == "ideal":
            return {
                name: float(getattr(self.model, name))
                for name in self.model.__dataclass_fields__
                if name != "reference"
            }
        figures: dict[str, float] = {f"physics_{self.physics}": 1.0}
        for name in self.panel.__dataclass_fields__:
            value = getattr(self.panel, name)
            if isinstance(value, tuple):
                high, low = value
                figures |= {f"{name}_high": float(high), f"{name}_low": float(low)}
            else:
                figures[name] = float(value)
        return figures | self.tube.figures()

    async def take(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        exposures: Sequence[ExposureSettings],
        *,
        newest_wins: bool = False,
        times: npt.ArrayLike | None = None,
    ) -> list[Radiograph]:
        """Images of `sample`, one for each of `exposures`.

        Args:
            sample: on the stage.
            poses: n nominal poses: as many for each image, spread over its exposure.
            camera: of all of them.
            exposures: tube and time of each image; taken as if X-rays were on.
            newest_wins: give way to later requests.
            times: of the poses since the scan's start, (n,) [s]; None is the start.

        Raises:
            ProjectorUnavailable: the projector does not answer.
            GeometryError: a geometry no scanner can have.
            LimitError: a voltage without a spectrum.
        """
        count = len(exposures)
        if self.physics == "ideal":
            lines = await self.imaging.line_integrals(
                sample, poses, camera, newest_wins=newest_wins, times=times
            )
            if len(lines) == count:
                return [Radiograph(one) for one in lines]
            return [Radiograph(part) for part in lines.reshape(count, -1, *lines.shape[1:])]
        channels, paths, views = await self.imaging.path_lengths(
            sample, poses, camera, newest_wins=newest_wins, times=times
        )
        mono_keV = stated_keV() if self.physics == "mono" else None
        chain = chain_through(channels, self.panel, self.tube, mono_keV)
        moments = len(poses) // count
        return await asyncio.to_thread(radiographs, chain, paths, views, exposures, moments)

    def dark(self, camera: CameraSettings) -> Radiograph:
        """An image without X-rays."""
        nothing = np.zeros(camera.shape, dtype=np.float32)
        if self.physics == "ideal":
            return Radiograph(nothing)
        return Radiograph(nothing, Expected(nothing, nothing))

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return self.model.full_scale if self.physics == "ideal" else self.panel.full_scale

    @property
    def offset(self) -> float:
        """Count without signal."""
        return self.model.dark_counts if self.physics == "ideal" else self.panel.offset_counts

    def signal(
        self, radiograph: Radiograph, camera: CameraSettings, exposure: ExposureSettings
    ) -> Float32Array:
        """Expected counts above dark as though X-rays were on, not clipped, (rows, cols)."""
        if radiograph.expected is not None:
            return radiograph.expected.mean_e / np.float32(self.panel.electrons_per_count(camera))
        lit = replace(exposure, xrays_on=True)
        return np.exp(-radiograph.shown) * np.float32(open_beam(self.model, lit))

    def counts(
        self,
        radiograph: Radiograph,
        camera: CameraSettings,
        exposure: ExposureSettings,
        rng: np.random.Generator | None,
        before: Before = (),
    ) -> Counts:
        """What the camera saves of a radiograph, uint16 (rows, cols)."""
        expected = radiograph.expected
        if expected is None:
            return expose(self.model, radiograph.integrals, exposure, rng)
        if not exposure.xrays_on:
            expected = self.dark(camera).expected
            assert expected is not None
        left = [
            (earlier.expected.mean_e, gap)
            for earlier, gap in before
            if earlier.expected is not None
        ]
        return read_out(self.panel, expected, camera, exposure, rng, left)


EVERY = 3
"""Pixels are judged on a grid with this step, edges on all their pixels."""
FEW_COUNTS = 10.0
"""Signal above dark below which a pixel counts as starved: its logarithm is mostly noise."""
SHADOW = 0.05
"""Line integral on an edge of the image from which the sample counts as cut off."""


SATURATED, STARVED, CUT_OFF = 1, 2, 4
"""What a pixel's mark is the sum of."""


def marks_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    binning: int = 1,
) -> npt.NDArray[np.uint8]:
    """The same for every pixel: sums of SATURATED, STARVED and CUT_OFF, uint8 (rows, cols).

    Args:
        radiography, radiograph, camera, exposure: as in `flags_of`.
        binning: pixels a side; what holds for any of them holds for their mean.
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)
    marks = np.where(signal >= radiography.full_scale - radiography.offset, SATURATED, 0)
    marks += np.where(signal < FEW_COUNTS, STARVED, 0)
    edge = np.ones(lines.shape, np.bool_)
    edge[1:-1, 1:-1] = False
    marks += np.where(edge & (lines > SHADOW), CUT_OFF, 0)
    rows, cols = (n // binning for n in lines.shape)
    # Surplus rows and columns are cut off, as `binned_mean` does: their marks go to the last kept.
    small = marks[: rows * binning, : cols * binning].astype(np.uint8)
    height, width = small.shape
    small[-1] |= np.bitwise_or.reduce(marks[height - 1 :, :width]).astype(np.uint8)
    small[:, -1] |= np.bitwise_or.reduce(marks[:height, width - 1 :], axis=1).astype(np.uint8)
    blocks = small.reshape(rows, binning, cols, binning)
    return np.asarray(np.bitwise_or.reduce(blocks, axis=(1, 3)), dtype=np.uint8)


def flags_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    time: float | None = None,
) -> ImageFlags:
    """Saturated and starved parts of an image, and the edges at which the sample is cut off.

    Args:
        radiography: how images are made.
        radiograph: the image.
        camera, exposure: its settings.
        time: of its pose [s].
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)[::EVERY, ::EVERY]
    top = radiography.full_scale - radiography.offset
    edges = {
        "left": lines[:, 0],
        "right": lines[:, -1],
        "top": lines[0],
        "bottom": lines[-1],
    }
    return ImageFlags(
        time=time,
        saturated=float(np.mean(signal >= top)),
        starved=float(np.mean(signal < FEW_COUNTS)),
        truncated=[name for name, edge in edges.items() if float(edge.max()) > SHADOW],  # type: ignore[misc]
    )
