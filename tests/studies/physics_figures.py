"""Measure the figures of docs/evidence/physics.json and reconstruction.json that need no peer.

python tests/studies/physics_figures.py
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from flexdt.phantoms import material
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.physics.chain import Chain, expected_signal, weights_of
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.effective import effective_beam
from flexdt.twin.physics.exposure import ExposureSettings, frame_rng
from flexdt.twin.physics.readout import read_out
from flexdt.twin.projection import project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere
from flexdt.twin.reconstruction import Grid, fdk, sirt

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from image_quality import edge_mtf, photon_transfer, region

VIEW = np.array([0, -600, 0, 0, 459, 0, 0.1496, 0, 0, 0, 0, -0.1496], dtype=np.float64)
LISTING_1 = ExposureSettings(90.0, 50.0, 100.0)
BALL, CENTRE, RADIUS, MU = (
    Sphere((6.0, -4.0, 3.0), 5.0),
    np.array([6.0, -4.0, 3.0]),
    5.0,
    0.05,
)


def transmission(chain: Chain, *lengths: float) -> float:
    """Compute the signal behind slabs of the chain's substances, of these lengths [mm],
    over the open beam's.
    """
    paths = np.empty((len(lengths), 3, 3), np.float32)
    paths[:] = np.array(lengths)[:, None, None]
    behind, free = (
        expected_signal(chain, p, VIEW, LISTING_1).mean_e for p in (paths, 0 * paths)
    )
    return float(behind[1, 1] / free[1, 1])


def slabs() -> float:
    """Compute the largest relative error of Beer-Lambert's law for one energy behind
    plastic and steel.
    """
    two = tuple(material(n).substance for n in ("abs", "steel"))
    chain = Chain(Detector(), substances=two, thickest_mm=(50.0, 5.0), mono_keV=50.25)
    mu = [s.attenuation()[90] for s in two]  # the bin about 50.25 keV
    grid = [(a, b) for a in (0.0, 1.0, 20.0, 50.0) for b in (0.0, 1.0, 4.0)]
    return max(
        abs(transmission(chain, a, b) / np.exp(-a * mu[0] - b * mu[1]) - 1)
        for a, b in grid
    )


def wedge() -> dict[str, float]:
    """Compare a few effective energies with the complete spectrum at 90 kV, behind 0 to
    40 mm of aluminium.

    Returns:
        Largest relative error, number of energies, and attenuation [1/mm] of the first
        and the last layer.
    """
    aluminium = material("aluminium").substance
    chain = Chain(Detector(), substances=(aluminium,), thickest_mm=(40.0,))
    signal, noise = weights_of(chain, 90.0)
    thick = np.linspace(0.0, 40.0, 81)
    full = np.exp(-np.outer(thick, aluminium.attenuation())) @ signal / signal.sum()
    beam = effective_beam(signal, noise, (aluminium,), (40.0,))
    few = beam.transmit(thick.astype(np.float32)[None])[0] / beam.signal.sum()
    slope = np.diff(-np.log(full)) / np.diff(thick)
    return {
        "worst_error": float(np.abs(few / full - 1).max()),
        "energies": len(beam.bins),
        "attenuation_first_per_mm": float(slope[0]),
        "attenuation_last_per_mm": float(slope[-1]),
    }


def detector() -> dict[str, object]:
    """Measure photon transfer, flat correction, saturation and sharpness of the simulated
    panel.

    Returns:
        Figures by name, those of photon transfer over the truth.
    """
    panel = Detector(dead_fraction=0.0)
    chain = Chain(panel)
    camera = CameraSettings("HW2SW1High", Roi(0, 0, 1199, 999))

    def flat(exposure: ExposureSettings, number: int) -> np.ndarray:
        """Read out a flat image with the noise of a number."""
        empty = np.zeros((0, *camera.shape), np.float32)
        expected = expected_signal(chain, empty, VIEW, exposure)
        return read_out(panel, expected, camera, exposure, frame_rng(1, number))

    pairs = [
        tuple(flat(ExposureSettings(90.0, 50.0, ms), 10 * k + i) for i in (0, 1))
        for k, ms in enumerate((20.0, 40.0, 60.0, 80.0, 100.0))
    ]
    off = ExposureSettings(90.0, 50.0, 10.0, xrays_on=False)
    curve = photon_transfer(pairs, [(flat(off, 90), flat(off, 91))])
    signal, noise = weights_of(chain, 90.0)
    per_count = panel.gain(camera)
    many = ExposureSettings(90.0, 50.0, 100.0, 100)
    dark, white, air = (
        flat(e, n).astype(float)
        for e, n in ((ExposureSettings(90.0, 50.0, 100.0, 100, xrays_on=False), 95),
                     (many, 96), (LISTING_1, 97))
    )  # fmt: skip
    corrected = (air - dark) / (white - dark)
    return {
        "gain_over_truth": curve.counts_per_quantum
        / float(noise.sum() / signal.sum())
        * per_count,
        "read_noise_over_truth": curve.read_noise_counts
        / (panel.read_noise(camera) / per_count),
        "open_beam_counts": float(air.mean()),
        "open_beam_snr": float(air.mean() / region(air - white).noise),
        "flat_corrected_air": [float(corrected.mean()), float(corrected.std())],
        "brightest": int(flat(ExposureSettings(90.0, 90.0, 2000.0), 98).max()),
        "half_modulation_lp_per_mm": _edge(panel),
    }


def _edge(panel: Detector) -> float:
    """Measure the line pairs a mm at which the panel's own blur (no noise, unbinned)
    leaves half the modulation.
    """
    camera = CameraSettings("HW1SW1High", Roi(0, 0, 199, 199))
    y, x = np.mgrid[:200, :200]
    sharp = np.mean(
        [(x + o > 100.3 + 0.06 * (y - 100)) for o in np.linspace(-0.5, 0.5, 17)], 0
    )
    chain = Chain(
        Detector(**{**panel.__dict__, "gain_sigma": 0.0, "offset_sigma_counts": 0.0})
    )
    expected = expected_signal(
        chain, np.zeros((0, 200, 200), np.float32), VIEW, LISTING_1
    )
    image = type(expected)(
        expected.mean_e * sharp.astype(np.float32), expected.variance_e
    )
    counts = read_out(chain.panel, image, camera, LISTING_1)
    return float(edge_mtf(counts.astype(float)).at(0.5) / panel.pixels.pitch_mm)


def circle(
    n: int, span: float = 360.0, *, aside: float = 0.0, repeat: bool = True
) -> ConeVec:
    """Make `n` views over `span` [deg], the panel moved `aside` [mm]; with `repeat` the
    last view is at the end of the span.
    """
    a = np.deg2rad(np.linspace(0.0, span, n, endpoint=repeat))
    u = np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    away = np.stack([-np.sin(a), np.cos(a), 0 * a], 1)
    return ConeVec.from_vectors(
        -600 * away, 459 * away + aside * u, 0.6 * u, (0, 0, -0.6)
    )


def ball(scan: ConeVec, iterations: int = 0) -> dict[str, object]:
    """Reconstruct a ball by FDK, or by SIRT if iterations are given, with voxels of 0.4
    mm.

    Returns:
        Attenuation over the true one, distance of the centre [voxels], and for SIRT
        whether the residual always fell.
    """
    data = project_scene(Scene((Solid(BALL, "a", MU),)), scan, (120, 130))
    like = Grid((80, 80, 80), 0.4).blank()
    residuals: list[float] = []
    if iterations:
        volume = sirt(data, scan, like, iterations=iterations,
                      watch=lambda s: residuals.append(s.residual)).data  # fmt: skip
    else:
        volume = fdk(data, scan, like, errors=False).data
    at = (np.arange(80) - 39.5) * 0.4
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    distance = np.sqrt((x - 6) ** 2 + (y + 4) ** 2 + (z - 3) ** 2)
    weight = np.where(distance < RADIUS + 1.2, np.clip(volume, 0, MU), 0)
    found = np.array([(weight * g).sum() / weight.sum() for g in (x, y, z)])
    return {
        "attenuation_over_truth": float(volume[distance < 0.8 * RADIUS].mean() / MU),
        "centre_off_voxels": float(np.linalg.norm((found - CENTRE) / 0.4)),
        **({"monotone": bool((np.diff(residuals) < 0).all())} if residuals else {}),
    }


def main() -> None:
    """Print the figures of physics and reconstruction as JSON."""
    figures = {
        "slabs_worst_error": slabs(),
        "wedge": wedge(),
        "detector": detector(),
        "ball_full_turn_last_repeats_first": ball(circle(361)),
        "ball_offset_detector": ball(circle(361, aside=25.0)),
        "ball_short_scan": ball(circle(216, 215.0)),
        "ball_sirt_20_iterations": ball(circle(60), 20),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
