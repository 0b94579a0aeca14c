"""Variance, sharpness, noise power and quantum efficiency of simulated images beside theory,
and the scintillator's response beside published curves: figures and plots of
docs/physics.md.

    python tests/studies/detector_figures.py [--plots docs/images]

Theory is formulas written here: Poisson photons of the tube's spectrum, each leaving a spread
charge; a Gaussian for the light, a pixel's sinc, and noise folded back at the Nyquist
frequency.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from dataclasses import dataclass
from math import erf, exp, pi, sqrt
from pathlib import Path
from types import ModuleType

import numpy as np

import flexdt as fx
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.physics.detector import FULL_WELL_E, Detector
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.tube import Filter, TubeModel, tube_spectrum

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from image_quality import edge_mtf

KV, POWER_W, TIME_MS, FAR_MM = 90.0, 50.0, 100.0, 1059.0
PIXELS_MM = {"unbinned": 0.0748, "binned 2 x 2": 0.1496}
EXPOSURES_MS = (10.0, 20.0, 40.0, 70.0, 100.0)
BLOCK = 64
RAYS = 8
RIM = 8
"""Pixels at the edges that are left out: light from beyond them is that of the last pixel."""
CSI, GOS = (Substance.of("", *what) for what in (("CsI", 4.51), ("Gd2O2S", 7.34)))

# Mass energy-absorption coefficient [cm2/g]: Hubbell and Seltzer, NISTIR 5632, by way of
# xraylib 4.3.0.
MU_EN_KEV = np.array([20, 25, 30, 40, 60, 70, 80, 100, 120, 150, 200], float)
MU_EN = {
    "CsI": [24.8752, 13.3768, 8.0383, 9.4122, 4.5840, 3.2508, 2.3969, 1.3892, 0.8742, 0.4936,
            0.2392],
    "Gd2O2S": [33.6923, 18.4394, 11.199, 5.0552, 3.9433, 3.0534, 2.4470, 1.5409, 1.0220, 0.6020,
               0.3019],
}  # fmt: skip
# gVirtualXRay's curve for 0.6 mm of CsI (effepivi/gvxr-CMPB, Gate_data/responseDetector.txt): a
# photon's energy and what it deposits [keV]. Nothing escapes there: a photon that interacts
# leaves all it has.
GVXR = np.array([
    (20, 20.0), (25, 24.5), (30, 27.4), (32, 27.9), (34, 33.8), (40, 39.9), (50, 48.5), (60, 53.0),
    (70, 53.1), (80, 50.4), (100, 42.3), (120, 34.9), (150, 26.9), (190, 20.6),
])  # fmt: skip


@dataclass(frozen=True)
class Theory:
    """Of flat images with one pixel size; frequencies in cycles a pixel.

    Attributes:
        pixel_mm: pitch.
        sigma: of the light's spread [pixels].
        photons: that reach a pixel of an image.
        mean_e, variance_e: electrons before the light spreads.
        read_e, count_e: read noise, and electrons of a count.
    """

    pixel_mm: float
    sigma: float
    photons: float
    mean_e: float
    variance_e: float
    read_e: float
    count_e: float

    @classmethod
    def of(cls, pixel_mm: float, ms: float) -> Theory:
        """Compute the theory's figures of flat images at KV, POWER_W and FAR_MM.

        Args:
            pixel_mm: pitch.
            ms: exposure time.
        """
        panel = Detector()
        fluence = (
            tube_spectrum(KV, TubeModel()).fluence * POWER_W / KV * ms / 1000.0
        )  # cm2, 1 m
        fluence = fluence * (1000.0 / FAR_MM) ** 2 * pixel_mm**2 / 100.0
        layer = Substance.of("", "CsI", 4.51 * panel.packing)
        kept = deposited(Filter(layer, panel.scintillator_mm))
        charge = tables().energy_keV * panel.electrons_per_keV
        mean = float(fluence @ (kept.mean * charge))
        variance = float(fluence @ (kept.square * charge**2)) / panel.swank + mean
        well = FULL_WELL_E[0] * (pixel_mm / (2 * panel.pixels.pitch_mm)) ** 2
        return cls(pixel_mm, panel.blur_mm / pixel_mm, float(fluence.sum()), mean, variance,
                   panel.read_noise_e, well / 2.0**panel.bits)  # fmt: skip

    def shared(self, apart: int) -> float:
        """Part of the noise's covariance that pixels so far apart have along one axis: the
        light's spread, twice, over the overlap of two pixels."""
        x, wide = np.linspace(-1.0, 1.0, 4001), self.sigma * sqrt(2.0)
        spread = np.exp(-((x - apart) ** 2) / (2 * wide**2)) / (wide * sqrt(2 * pi))
        return float(np.trapezoid((1.0 - np.abs(x)) * spread, x))

    @property
    def own(self) -> float:
        """`shared(0)` in closed form: the part of a pixel's light that it keeps, squared
        over the pixel.
        """
        wide = self.sigma * sqrt(2.0)
        return erf(1 / (wide * sqrt(2))) - wide * sqrt(2 / pi) * (
            1 - exp(-1 / (2 * wide**2))
        )

    @property
    def variance_counts(self) -> float:
        electrons = self.variance_e * self.own**2 + self.read_e**2
        return electrons / self.count_e**2 + 1.0 / 12.0

    def mtf(self, f: np.ndarray) -> np.ndarray:
        return np.abs(np.sinc(f)) * np.exp(-2.0 * (pi * f * self.sigma) ** 2)

    def noise_power(self, f: np.ndarray) -> np.ndarray:
        """Compute the noise power over the mean squared [mm^2] at frequencies `f` [cycles
        a pixel] along one axis.
        """
        folded = self.shared(0) + sum(
            2.0 * self.shared(n) * np.cos(2 * pi * f * n) for n in range(1, 12)
        )
        white = self.read_e**2 + self.count_e**2 / 12.0
        return (self.variance_e * folded + white) / self.mean_e**2 * self.pixel_mm**2

    def quantum_efficiency(self, f: np.ndarray) -> np.ndarray:
        return self.mtf(f) ** 2 / (self.photons / self.pixel_mm**2 * self.noise_power(f))


def images(pixel_mm: float, ms: float, count: int, side: int, seed: int) -> np.ndarray:
    """Simulate flat images without the fixed pattern, (count, side, side) [counts above
    the dark level].

    Args:
        pixel_mm: pitch.
        ms: exposure time.
        count: images.
        side: pixels; a rim is cut off.
        seed: of the noise.
    """
    geometry = fx.ConeVec.from_vectors(
        np.tile([0.0, -600.0, 0.0], (count, 1)), (0, FAR_MM - 600.0, 0), (pixel_mm, 0, 0),
        (0, 0, -pixel_mm),
    )  # fmt: skip
    aside = {"kind": "sphere", "center": [0, 0, 200], "radius": 1, "material": "pmma"}
    detector = fx.Detector(exposure_ms=ms, gain_sigma=0.0, dead_fraction=0.0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the sample is outside every view")
        scan = fx.simulate(aside, geometry, tube=fx.Tube(kV=KV, power_W=POWER_W), noise=seed,
                           detector=detector, shape=(side + 2 * RIM,) * 2)  # fmt: skip
    inside = scan.counts()[:, RIM:-RIM, RIM:-RIM]
    return np.asarray(inside, float) - detector.offset_counts


def variance_curve(side: int = 256) -> dict[str, list[tuple[float, float, float]]]:
    """Measure the mean, the variance and theory's variance [counts, counts^2] of flat
    images for each of EXPOSURES_MS, by pixel size.
    """
    found = {}
    for name, pixel in PIXELS_MM.items():
        rows = []
        for k, ms in enumerate(EXPOSURES_MS):
            stack = images(pixel, ms, 10, side, 100 + k)
            spread = float(stack.var(axis=0, ddof=1).mean())
            rows.append(
                (float(stack.mean()), spread, Theory.of(pixel, ms).variance_counts)
            )
        found[name] = rows
    return found


def noise_power(
    pixel: float, count: int = 80, side: int = 256
) -> tuple[np.ndarray, np.ndarray]:
    """Measure the noise power of flat images along an axis.

    Returns:
        Frequency [cycles a pixel] and power over the mean squared [mm^2], without the
        lowest frequencies.
    """
    stack = images(pixel, TIME_MS, count, side, 7)
    rest = (stack - stack.mean(axis=0)) * sqrt(count / (count - 1))  # no pattern
    n = side // BLOCK
    blocks = rest.reshape(count, n, BLOCK, n, BLOCK).transpose(0, 1, 3, 2, 4)
    window = np.hanning(BLOCK + 2)[1:-1]
    window = np.outer(
        window, window
    )  # or much of the low frequencies leaks into the high
    power = (np.abs(np.fft.fft2(blocks * window)) ** 2).mean(axis=(0, 1, 2))
    power /= (window**2).sum()
    near = [0, 1, -1]  # next to no change along the other axis
    along = (power[near].mean(axis=0) + power[:, near].mean(axis=1)) / 2.0
    half = slice(2, BLOCK // 2)
    return np.fft.fftfreq(BLOCK)[half], along[half] * pixel**2 / float(stack.mean()) ** 2


def edge(pixel: float, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure the modulation transfer from a sheet of tungsten slanted by 3 degrees.

    Args:
        pixel: pitch [mm].
        rays: along each side of a pixel.

    Returns:
        Frequency [cycles a pixel] and modulation.
    """
    c, s = np.cos(np.deg2rad(3.0)), np.sin(np.deg2rad(3.0))
    geometry = fx.ConeVec.from_vectors(
        [[0, -600, 0]],
        (0, FAR_MM - 600, 0),
        (pixel * c, 0, pixel * s),
        (pixel * s, 0, -pixel * c),
    )
    sheet = {"kind": "box", "center": [50, 400, 0], "size": [100, 0.1, 120],
             "material": "W@19.3"}  # fmt: skip
    sharp = fx.Tube(kV=KV, power_W=POWER_W, spot_mm=0.0)
    detector = fx.Detector(gain_sigma=0.0, dead_fraction=0.0, offset_sigma_counts=0.0)
    scan = fx.simulate(
        sheet, geometry, tube=sharp, detector=detector, shape=(160, 120), rays=rays
    )
    response = edge_mtf(scan.counts(0))
    return response.frequency, response.modulation


def quality() -> dict[str, dict[str, np.ndarray]]:
    """Compute measured and theoretical curves by pixel size: MTF (also with one ray),
    noise power and DQE, over their frequencies.
    """
    found = {}
    for name, pixel in PIXELS_MM.items():
        theory = Theory.of(pixel, TIME_MS)
        f, power = noise_power(pixel)
        at, modulation = edge(pixel, RAYS)
        plain = edge(pixel, 1)[1]
        seen = np.interp(f, at, modulation)
        found[name] = {
            "f": f, "at": at, "pixel": np.array(pixel),
            "mtf": modulation, "mtf_theory": theory.mtf(at), "mtf_one_ray": plain,
            "power": power, "power_theory": theory.noise_power(f),
            "dqe": seen**2 / (theory.photons / pixel**2 * power),
            "dqe_theory": theory.quantum_efficiency(f),
        }  # fmt: skip
    return found


def thin_response(material: str) -> tuple[np.ndarray, np.ndarray]:
    """Mass energy-absorption coefficient that a layer of 0.1 um has here, and the published
    one."""
    substance = {"CsI": CSI, "Gd2O2S": GOS}[material]
    part = deposited(Filter(substance, 1e-4)).mean / (substance.density_g_cm3 * 1e-5)
    return np.interp(MU_EN_KEV, tables().energy_keV, part), np.array(MU_EN[material])


def thick_response() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the energy left in 0.6 mm of CsI [keV] at GVXR's energies: here if nothing
    escaped, here, and published.
    """
    energy = tables().energy_keV
    stopped = energy * -np.expm1(-CSI.attenuation() * 0.6)
    kept = energy * deposited(Filter(CSI, 0.6)).mean
    at, published = GVXR.T
    return np.interp(at, energy, stopped), np.interp(at, energy, kept), published


def figures(found: dict[str, dict[str, np.ndarray]], curve: dict) -> dict[str, object]:
    """Sum up the figures of the page: measured over theory (of the noise power mean and
    standard deviation), largest differences, and our responses over the published ones.

    Args:
        found: curves of `quality`.
        curve: of `variance_curve`.
    """
    made: dict[str, object] = {}
    for name, one in found.items():
        half, ratio = one["at"] <= 0.5, one["power"] / one["power_theory"]
        made[name] = {
            "variance_over_theory": [round(v / t, 4) for _, v, t in curve[name]],
            "mtf_worst_difference": float(np.abs(one["mtf"] - one["mtf_theory"])[half].max()),
            "mtf_worst_difference_below_half_nyquist": float(
                np.abs(one["mtf"] - one["mtf_theory"])[one["at"] <= 0.25].max()
            ),
            "power_over_theory": [float(ratio.mean()), float(ratio.std())],
            "dqe_low": float(one["dqe"][:4].mean()),
            "dqe_low_theory": float(one["dqe_theory"][:4].mean()),
            "dqe_worst_difference_below_half_nyquist": float(
                np.abs(one["dqe"] - one["dqe_theory"])[one["f"] <= 0.25].max()
            ),
        }  # fmt: skip
    for material in MU_EN:
        ours, theirs = thin_response(material)
        made[f"thin {material} over published"] = np.round(ours / theirs, 3).tolist()
    stopped, kept, published = thick_response()
    made["0.6 mm CsI over published"] = {
        "nothing escapes": np.round(stopped / published, 3).tolist(),
        "as modelled": np.round(kept / published, 3).tolist(),
    }
    return made


def draw(found: dict[str, dict[str, np.ndarray]], curve: dict, folder: Path) -> None:
    """Draw the curves of variance, sharpness, noise and DQE over the theory, into
    image-quality.png and detector-response.png of a folder.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams["font.size"] = 9
    figure, axes = plt.subplots(2, 2, figsize=(9, 6.6), layout="constrained")
    for (name, one), colour in zip(
        found.items(), ("tab:blue", "tab:orange"), strict=True
    ):
        per_mm = one["f"] / one["pixel"]
        mean, variance, theory = np.array(curve[name]).T
        axes[0, 0].plot(mean, theory, "-", color=colour, label=f"theory, {name}")
        axes[0, 0].plot(mean, variance, "o", ms=4, color=colour, label="images")
        below = one["at"] <= 0.5
        at = one["at"][below] / one["pixel"]
        axes[0, 1].plot(at, one["mtf_theory"][below], "-", color=colour)
        label = f"{name}, {RAYS} x {RAYS} rays"
        axes[0, 1].plot(at, one["mtf"][below], "o", ms=3, color=colour, label=label)
        axes[0, 1].plot(
            at, one["mtf_one_ray"][below], ":", color=colour, label="one ray a pixel"
        )
        for axis, key in ((axes[1, 0], "power"), (axes[1, 1], "dqe")):
            axis.plot(
                per_mm, one[f"{key}_theory"], "-", color=colour, label=f"theory, {name}"
            )
            axis.plot(per_mm, one[key], "o", ms=3, color=colour, label="images")
    texts = (
        ("mean above dark [counts]", "variance [counts$^2$]", "Variance"),
        ("cycles per mm", "MTF", "Sharpness (lines: theory)"),
        ("cycles per mm", "NPS / mean$^2$ [mm$^2$]", "Noise power"),
        ("cycles per mm", "DQE", "Detective quantum efficiency"),
    )
    for axis, (x, y, title) in zip(axes.flat, texts, strict=True):
        axis.set(xlabel=x, ylabel=y, title=title, ylim=(0, None))
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    figure.savefig(folder / "image-quality.png", dpi=110)
    _draw_response(plt, folder)


def _draw_response(plt: ModuleType, folder: Path) -> None:
    """Draw the energy kept in thin layers and in 0.6 mm of CsI beside the published
    values, into detector-response.png.
    """
    figure, (thin, thick) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    energy = tables().energy_keV
    shown = (energy > 18) & (energy < 205)
    for substance, name, colour in (
        (CSI, "CsI", "tab:blue"),
        (GOS, "Gd2O2S", "tab:orange"),
    ):
        part = deposited(Filter(substance, 1e-4)).mean / (substance.density_g_cm3 * 1e-5)
        thin.semilogy(
            energy[shown], part[shown], "-", color=colour, label=f"{name}, here"
        )
        thin.plot(MU_EN_KEV, MU_EN[name], "o", ms=4, color=colour, label="NIST")
    thin.set(
        xlabel="keV", ylabel="part of the energy kept [cm$^2$/g]", title="Thin layers"
    )
    kept = energy * deposited(Filter(CSI, 0.6)).mean
    stopped = energy * -np.expm1(-CSI.attenuation() * 0.6)
    thick.plot(
        energy[shown], stopped[shown], ":", color="tab:blue", label="if nothing escaped"
    )
    thick.plot(energy[shown], kept[shown], "-", color="tab:blue", label="here")
    thick.plot(
        *GVXR.T, "o", ms=4, color="tab:green", label="gVirtualXRay (nothing escapes)"
    )
    thick.set(xlabel="keV", ylabel="energy kept of a photon [keV]", title="0.6 mm of CsI")
    for axis in (thin, thick):
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    figure.savefig(folder / "detector-response.png", dpi=110)


def main() -> None:
    """Print the figures of the detector as JSON, and draw them if a folder is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plots", type=Path, help="folder for the two drawings")
    options = parser.parse_args()
    found, curve = quality(), variance_curve()
    print(json.dumps(figures(found, curve), indent=1))
    if options.plots is not None:
        draw(found, curve, options.plots)


if __name__ == "__main__":
    main()
