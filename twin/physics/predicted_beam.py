"""Predict the counts of the open beam, and behind the sample, before an image is exposed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, assert_never

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.materials import stated_keV
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.physics import exposure as ideal
from flexdt.twin.physics.chain import Chain, brightest_flux, expected_signal
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.image_quality import pixel_reading
from flexdt.twin.physics.readout import expected_counts, saturating_counts
from flexdt.twin.physics.tube import tube_of

Physics = Literal["ideal", "mono", "poly"]

BRIGHTEST_FILL: Final = 0.9
"""Part of the panel's range that the open beam may fill in a proposed setting."""
LEAST_COUNTS: Final = 20.0 * ideal.FEW_COUNTS
"""Open beam [counts above dark] below which a sample that lets 1/20 through is starved."""


def only_keV(physics: Physics) -> float | None:
    """Return the energy of all photons [keV], `stated_keV` for "mono"; None for physics
    without one energy.
    """
    match physics:
        case "mono":
            return stated_keV()
        case "ideal" | "poly":
            return None
        case _:
            assert_never(physics)


@dataclass(frozen=True)
class OpenBeam:
    """Counts of the open beam's brightest pixel in one read-out.

    Attributes:
        counts: expected, above the dark level, not clipped.
        full_counts: counts above the dark level from which a pixel is saturated.
    """

    counts: float
    full_counts: float

    @property
    def fill(self) -> float:
        """Part of the range; saturated from 1."""
        return self.counts / self.full_counts

    @property
    def saturated(self) -> bool:
        """Whether the brightest pixel reads the largest count."""
        return self.fill >= 1.0

    @property
    def starved(self) -> bool:
        """Whether there is too little light to see through a sample."""
        return self.counts < LEAST_COUNTS


@dataclass(frozen=True)
class CountShares:
    """Parts of the pixels whose counts tell little, 0 to 1.

    Attributes:
        saturated: with the panel's largest count.
        starved: with fewer than `FEW_COUNTS` above dark.
    """

    saturated: float
    starved: float

    @classmethod
    def of(cls, counts: npt.NDArray[np.floating], full_counts: float) -> CountShares:
        """Count the pixels of images. `counts`: expected above dark, not clipped, of any shape;
        `full_counts`: counts above dark from which a pixel is saturated."""
        starved = counts < ideal.FEW_COUNTS
        return cls(float((counts >= full_counts).mean()), float(starved.mean()))


@dataclass(frozen=True)
class PredictedExposure:
    """The predicted exposure of a setting of tube and camera, before its images are made.

    Attributes:
        kV, power_W, exposure_ms: the setting, of one read-out.
        open_beam_fill: counts of the open beam over the panel's range, saturated from 1;
            None where the physics has no spectrum for the voltage.
        shares: of the pixels behind the sample; None where that is not known.
        doubts: objections to the setting, each with a setting that would do.
        unpredicted: reason why `shares` is None, in words; empty if nothing was requested.
    """

    kV: float
    power_W: float
    exposure_ms: float
    open_beam_fill: float | None = None
    shares: CountShares | None = None
    doubts: tuple[str, ...] = ()
    unpredicted: str = ""


def counts_behind(
    chain: Chain,
    camera: CameraSettings,
    exposure: ExposureSettings,
    paths_mm: Float32Array,
    view: npt.ArrayLike,
    pixels_a_side: int = 1,
) -> Float32Array:
    """Predict the counts above dark of camera pixels, (rows, cols), not clipped.

    `pixels_a_side`: of the camera, along each side of a pixel of `paths_mm` (m, rows,
    cols).
    """
    charge = expected_signal(chain, paths_mm, view, exposure).mean_e
    return expected_counts(chain.panel, camera, charge / np.float32(pixels_a_side**2))


def open_beam_of(
    machine: Machine,
    camera: CameraSettings,
    exposure: ExposureSettings,
    view: npt.ArrayLike,
    physics: Physics = "poly",
) -> OpenBeam | None:
    """Predict the open beam's counts above dark in its brightest pixel, and at
    saturation.

    As if X-rays were on; `view`: cone_vec row (12,). mono has the counts of poly. None
    where there is no spectrum for the voltage.
    """
    match physics:
        case "ideal":
            model = ideal.ideal_response(machine)
            counts = ideal.open_beam(model, exposure)
            return OpenBeam(counts, model.full_scale - model.dark_counts)
        case "mono" | "poly":
            return _open_beam_of_a_spectrum(machine, camera, exposure, view)
        case _:
            assert_never(physics)


def _open_beam_of_a_spectrum(
    machine: Machine,
    camera: CameraSettings,
    exposure: ExposureSettings,
    view: npt.ArrayLike,
) -> OpenBeam | None:
    """Predict the open beam with the tube's spectrum; None without one for the voltage."""
    panel = detector_of(machine.detector)
    brightest = brightest_flux(view, camera.shape)
    try:
        reading = pixel_reading(
            Chain(panel, tube_of(machine.tube)), camera, exposure, brightest
        )
    except LimitError:
        return None
    return OpenBeam(reading.signal, saturating_counts(panel))


def open_beam_doubt(
    machine: Machine, exposure: ExposureSettings, beam: OpenBeam
) -> str | None:
    """Describe an open beam that saturates or starves the panel, and the exposure that
    `proposed_setting` names; None if neither.

    Args:
        machine: whose limits hold for the proposal.
        exposure: the setting that `beam` was predicted for.
        beam: its open beam.
    """
    if not (beam.saturated or beam.starved):
        return None
    doubt = f"the open beam has {beam.counts:.3g} counts above dark"
    if beam.saturated:
        fill = f"{beam.fill:.3g} times the largest count"
        doubt = f"the open beam saturates the panel: {fill}"
    proposal = proposed_setting(machine, exposure, beam)
    return f"{doubt}; {proposal} would fill {100 * BRIGHTEST_FILL:.0f} %"


def proposed_setting(machine: Machine, exposure: ExposureSettings, beam: OpenBeam) -> str:
    """Name the exposure, and the power if it changes, that fill `BRIGHTEST_FILL` of the
    panel's range.

    Power is raised before time, up to the tube's, and lowered only below the shortest
    exposure. Beyond the longest exposure the text begins with "not even"; without any
    counts it is "a higher voltage".

    Args:
        machine: whose limits hold.
        exposure: the setting that `beam` was predicted for.
        beam: its open beam.
    """
    if beam.counts <= 0.0:
        return "a higher voltage"
    spec = machine.detector
    tube = machine.tube
    factor = BRIGHTEST_FILL / beam.fill
    power_W = exposure.power_W
    if factor > 1.0:  # more power costs no time
        power_W = min(power_W * factor, max(tube.max_W, power_W))
    time_ms = exposure.exposure_ms * factor * exposure.power_W / power_W
    nearest_ms = min(max(time_ms, spec.min_exposure_ms), spec.max_exposure_ms)
    power_W *= min(time_ms / nearest_ms, 1.0)
    words = f"{nearest_ms:.3g} ms at {power_W:.3g} W"
    if time_ms > spec.max_exposure_ms:
        return f"not even {words}"
    if power_W != exposure.power_W:
        return words
    return f"{nearest_ms:.3g} ms"
