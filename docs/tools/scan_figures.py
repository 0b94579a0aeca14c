"""Make the figures of the documentation with flexdt itself: slices before and after, and plots.

    python docs/tools/scan_figures.py [--out docs/images/made] [--only NAME ...]

The build of the site makes them anew (`docs/_ext/made_figures.py`); the copies in
`docs/images/made/` are for readers on a forge. Every draw is seeded. `figures.json`, beside the
pictures, holds the numbers that their captions quote.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt

import flexdt as fx

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "docs" / "images" / "made"
SEED = 7
WIDTH_INCH = 7.2
HEIGHT_INCH = 2.5
DPI = 100
COLOURS = 64
"""Levels of a picture in gray, so that a file is small."""

Image = npt.NDArray[np.floating[Any]]
Numbers = dict[str, float]
Figure = Any


def slices(
    images: Mapping[str, Image], low: float, high: float, unit: str = "1/mm"
) -> Figure:
    """Draw images beside each other in one window of gray, with one color bar.

    Args:
        images: title -> image; the first row is drawn lowest.
        low, high: values of black and of white.
        unit: of the values.
    """
    figure, axes = plt.subplots(
        1,
        len(images),
        figsize=(WIDTH_INCH, HEIGHT_INCH),
        layout="constrained",
        squeeze=False,
    )
    for axis, (title, image) in zip(axes[0], images.items(), strict=True):
        drawn = axis.imshow(image, cmap="gray", vmin=low, vmax=high, origin="lower")
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    figure.colorbar(drawn, ax=axes, shrink=0.8, label=unit)
    return figure


def correlation(one: Image, other: Image) -> float:
    """Return Pearson's correlation of two images of one shape at the (cyclic) shift at
    which it is greatest.

    A calibration leaves the object's place in its frame open by its sigmas.
    """
    spectra = [
        np.fft.fft2((image - image.mean()) / image.std()) for image in (one, other)
    ]
    return float(np.fft.ifft2(spectra[0] * spectra[1].conj()).real.max() / one.size)


def before_and_after(images: Mapping[str, Image], truth: Image) -> Numbers:
    """Return the correlations of two images, in order before and after, with the true
    one: correlation_before and correlation_after.
    """
    names = "correlation_before", "correlation_after"
    return {
        name: correlation(one, truth)
        for name, one in zip(names, images.values(), strict=True)
    }


def scan(
    angles: int = 120, shape: tuple[int, int] = (96, 120), **changes: Any
) -> fx.ConeVec:
    """Return a circular scan at the FleX-ray's usual distances, with pixels of 1 mm;
    `changes` replace arguments of `ConeVec.circular`.
    """
    settings = {
        "sod": 600,
        "sdd": 1059,
        "angles": angles,
        "shape": shape,
        "pixel": 1.0,
    } | changes
    return fx.ConeVec.circular(**settings)


def as_seen(images: Image, nominal: fx.ConeVec) -> fx.DataSet:
    """Return line integrals as a data set with the nominal geometry."""
    return fx.DataSet.from_arrays(images.astype(np.float32), nominal)


def pieces() -> fx.phantoms.Phantom:
    """Return an unsymmetrical object of solids without a bead: a body of PMMA with air
    holes and aluminium pins, twelve balls with drawn radii.
    """
    solids: list[dict[str, Any]] = [
        {
            "kind": "cylinder",
            "center": [2, -1, 0],
            "radius": 20,
            "height": 36,
            "material": "pmma",
        }
    ]
    rng = np.random.default_rng(SEED)
    for number in range(12):
        turn = 2 * np.pi * number / 12
        out = (7.0, 14.5)[number % 2]
        place = [2 + out * np.cos(turn), -1 + out * np.sin(turn), 6.0 * (number % 3 - 1)]
        solids.append(
            {
                "kind": "sphere",
                "center": place,
                "radius": rng.uniform(1.2, 2.9),
                "material": ("air", "aluminium")[number % 5 == 0],
                "replaces": "pmma",
            }
        )
    return fx.phantoms.as_phantom(solids)


@cache
def misaligned() -> tuple[fx.DataSet, fx.ConeVec]:
    """Simulate a noisy scan of the LEGO phantom with a shifted, rolled panel; return it
    with the nominal geometry, and the true geometry. Cached.
    """
    fine = {"angles": 72, "shape": (190, 239), "pixel": 0.5984}
    true = scan(**fine, offset=(2.0, 1.0), tilts=(1.5, 0.0, 0.0))
    seen = fx.simulate("lego", true, noise=SEED)
    nominal = scan(**fine)
    data = fx.DataSet.from_arrays(seen.counts(), nominal, dark=seen.dark, flat=seen.flat)
    return data, true


def calibrated() -> tuple[Figure, Numbers]:
    """Show the LEGO phantom before and after a calibration.

    Returns the figure, and by how much its beads are missed at most, before and after
    [px].
    """
    data, true = misaligned()
    calibration = data.calibrate("lego")
    right = data.with_correction(calibration.correction)
    beads = fx.phantoms.load_phantom("lego").beads
    miss = [
        float(np.abs(g.project_points(beads) - true.project_points(beads)).max())
        for g in (data.geometry, right.geometry)
    ]
    grid = {"voxel": 0.5, "shape": (110, 70, 70), "errors": False}
    images = {
        "nominal": data.reconstruct("fdk", **grid).data[:, 35],
        "calibrated": right.reconstruct("fdk", **grid).data[:, 35],
    }
    return slices(images, 0.0, 0.06), {
        "miss_before_px": miss[0],
        "miss_after_px": miss[1],
    }


def aligned() -> tuple[Figure, Numbers]:
    """Show an object without beads before and after an alignment of a rolled, shifted
    panel.

    Returns the figure, and the correlations of both slices with that of the true
    geometry.
    """
    true = scan(180, offset=(2.4, 0.0), tilts=(2.0, 0.0, 0.0))
    images = fx.project(pieces(), true)
    data = as_seen(images, scan(180))
    right = data.with_correction(data.align().correction)
    grid = fx.Grid((40, 90, 90), 0.6)
    truth = fx.fdk(images, true, grid, errors=False).data
    shown = {
        name: fx.fdk(images, one.geometry, grid, errors=False).data[6]
        for name, one in (("nominal", data), ("aligned", right))
    }
    return slices(shown, 0.0, 0.06), before_and_after(shown, truth[6])


def gap() -> tuple[Figure, Numbers]:
    """Show a panel of two tiles with a gap of 2 pixels, before and after a calibration
    finds it.

    Returns the figure, and the correlations of both slices with that of a scan by the
    whole panel.
    """
    fine = {"angles": 90, "pixel": 0.5984}
    wide = scan(shape=(190, 241), **fine)
    seen = fx.simulate("lego", wide, noise=SEED)
    columns = np.delete(np.arange(241), [90, 91])
    # The tile beyond the gap is taken to follow without one: it appears 1 pixel to either side.
    data = fx.DataSet.from_arrays(
        seen.counts()[:, :, columns],
        scan(shape=(190, 239), **fine),
        dark=seen.dark[:, columns],
        flat=seen.flat[:, columns],
    )
    right = data.with_correction(data.calibrate("lego").correction)
    whole = fx.DataSet.from_arrays(seen.counts(), wide, dark=seen.dark, flat=seen.flat)
    grid = {"voxel": 0.4, "shape": (6, 90, 90), "errors": False}
    images = {
        "gap unknown": data.reconstruct("fdk", **grid).data[3],
        "gap calibrated": right.reconstruct("fdk", **grid).data[3],
    }
    numbers = before_and_after(images, whole.reconstruct("fdk", **grid).data[3])
    return slices(images, 0.0, 0.12), numbers


def motion() -> tuple[Figure, Numbers]:
    """Show a stage that rises by 1 mm during the scan, without and with `per_frame`.

    Returns the figure, and the correlations of both slices with that of the true
    geometry.
    """
    still = scan(angles=90, shape=(190, 239), pixel=0.5984)
    rows = still.rows.copy()
    rows[:, [2, 5]] -= np.linspace(0.0, 1.0, len(rows))[:, None]
    rising = fx.ConeVec(rows, still.detector_shape)
    seen = fx.simulate("lego", rising, noise=SEED)
    frames = {"dark": seen.dark, "flat": seen.flat}
    data = fx.DataSet.from_arrays(seen.counts(), still, **frames)
    (followed,) = data.calibrate("lego", per_frame=["dO_y"]).datasets
    grid = {"voxel": 0.4, "shape": (130, 80, 80), "errors": False}
    images = {
        "taken to stand still": data.reconstruct("fdk", **grid).data[:, 40],
        "motion of each frame found": followed.reconstruct("fdk", **grid).data[:, 40],
    }
    truth = fx.DataSet.from_arrays(seen.counts(), rising, **frames).reconstruct(
        "fdk", **grid
    )
    return slices(images, 0.0, 0.06), before_and_after(images, truth.data[:, 40])


def streaks() -> tuple[Figure, Numbers]:
    """Show what few views do to FDK, and to total variation.

    Returns the figure, and the rms differences of FDK and total variation of 20 views
    from FDK of 240 views [1/mm].
    """
    turn = scan(240)
    images = fx.project(pieces(), turn)
    grid = fx.Grid((3, 96, 96), 0.55)
    few = slice(None, None, 12)
    full = fx.fdk(images, turn, grid, errors=False).data[1]
    fdk = fx.fdk(images[few], turn[few], grid, errors=False).data[1]
    tall = fx.Grid((72, 96, 96), 0.55)
    tv = fx.tv(images[few], turn[few], tall, iterations=40, weight=3e-3).data[36]
    shown = {"FDK, 240 views": full, "FDK, 20 views": fdk, "tv, 20 views": tv}
    numbers = {
        "fdk_rms": float(np.sqrt(np.mean((fdk - full) ** 2))),
        "tv_rms": float(np.sqrt(np.mean((tv - full) ** 2))),
    }
    return slices(shown, 0.0, 0.06), numbers


def rings() -> tuple[Figure, Numbers]:
    """Show pixels whose gain the flat image does not have, without and with `rings=True`.

    Returns the figure, and the rms differences of both slices from that without wrong
    gains [1/mm].
    """
    turn = scan(240)
    images = fx.project(pieces(), turn)
    gains = np.random.default_rng(SEED).normal(0.0, 0.03, images.shape[1:])
    data = as_seen(images + gains, turn)
    grid = {"voxel": 0.55, "shape": (3, 84, 84), "errors": False}
    shown = {
        "gains that the flat lacks": data.reconstruct("fdk", **grid).data[1],
        "rings=True": data.reconstruct("fdk", rings=True, **grid).data[1],
    }
    truth = as_seen(images, turn).reconstruct("fdk", **grid).data[1]
    numbers = {
        f"rms_{name}": float(np.sqrt(np.mean((one - truth) ** 2)))
        for name, one in zip(("before", "after"), shown.values(), strict=True)
    }
    return slices(shown, 0.0, 0.06), numbers


def cupping() -> tuple[Figure, Numbers]:
    """Show beam hardening in an aluminium rod, and its correction, as profiles.

    Returns the figure, two slices and their profiles, and by how much the middle's
    attenuation exceeds that near the rim, as a share of it, before and after.
    """
    rod = {"kind": "cylinder", "center": [0, 0, 0], "radius": 12, "height": 40}
    turn = scan(180, shape=(24, 120), pixel=0.5)
    tube = fx.Tube(kV=90)
    data = fx.simulate(rod | {"material": "aluminium"}, turn, tube=tube, noise=SEED)
    grid = {"voxel": 0.3, "shape": (3, 96, 96), "errors": False}
    before = data.reconstruct("fdk", **grid).data[1]
    after = data.reconstruct("fdk", material="aluminium", tube=tube, **grid).data[1]
    figure, axes = plt.subplots(
        1,
        3,
        figsize=(WIDTH_INCH, HEIGHT_INCH),
        layout="constrained",
        width_ratios=[1, 1, 1.5],
    )
    images = {"measured": before, "material='aluminium'": after}
    for axis, (title, image) in zip(axes, images.items(), strict=False):
        axis.imshow(image, cmap="gray", vmin=0.0, vmax=0.16, origin="lower")
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    across = (np.arange(96) - 47.5) * 0.3
    axes[2].plot(across, before[46:50].mean(axis=0), label="measured")
    axes[2].plot(across, after[46:50].mean(axis=0), label="corrected")
    axes[2].set_xlabel("mm")
    axes[2].set_ylabel("1/mm")
    axes[2].legend(fontsize=8)
    inside = np.hypot(*np.meshgrid(across, across))
    ratio = [
        float(one[inside < 3].mean() / one[(inside > 9) & (inside < 11)].mean() - 1)
        for one in (before, after)
    ]
    numbers = {"middle_less_rim_before": ratio[0], "middle_less_rim_after": ratio[1]}
    return figure, numbers


def metal() -> tuple[Figure, Numbers]:
    """Show streaks between two steel pins in PMMA, and the correction inside the
    iterations.

    Returns the figure, three slices, and the mean attenuation between the pins in each
    [1/mm].
    """
    disc: dict[str, Any] = {"kind": "cylinder", "center": [0, 0, 0], "height": 40}
    parts = [disc | {"radius": 14, "material": "pmma"}]
    for x in (-6, 6):
        pin = {
            "center": [x, 0, 0],
            "radius": 1.5,
            "material": "steel",
            "replaces": "pmma",
        }
        parts.append(disc | pin)
    turn = scan(200, shape=(8, 120), pixel=0.5)
    tube = fx.Tube(kV=90)
    detector = fx.Detector(averages=16)
    data = fx.simulate(parts, turn, tube=tube, detector=detector, noise=SEED)
    grid = {"voxel": 0.35, "shape": (4, 96, 96)}
    plain = data.reconstruct("fdk", errors=False, **grid)
    grid["tube"] = tube
    shown = {
        "FDK": plain.data[2],
        "material='pmma'": data.reconstruct(
            "fdk", errors=False, material="pmma", **grid
        ).data[2],
        "sart, material=('pmma', 'steel')": data.reconstruct(
            "sart", material=("pmma", "steel"), iterations=20, **grid
        ).data[2],
    }
    numbers = {
        f"between_pins_{i}": float(one[46:50, 44:52].mean())
        for i, one in enumerate(shown.values())
    }
    return slices(shown, 0.0, 0.05), numbers


def bound() -> tuple[Figure, Numbers]:
    """Show a volume with the noise and the bound of its bias at each place.

    Returns the figure, and the median of `sigma` in the slice [1/mm].
    """
    turn = scan(150, shape=(64, 100), pixel=0.9)
    data = fx.simulate(
        pieces(), turn, tube=fx.Tube(mono_keV=50), noise=SEED, exposure_ms=4
    )
    volume = data.reconstruct("fdk", voxel=0.7, shape=(48, 72, 72))
    middle = 24
    figure, axes = plt.subplots(
        1, 3, figsize=(WIDTH_INCH, HEIGHT_INCH), layout="constrained"
    )
    layers = {
        "attenuation": (volume.data[middle], 0.06),
        "sigma (noise)": (volume.sigma[middle], None),
        "bias_bound": (volume.bias_bound[middle], None),
    }
    for axis, (title, (image, high)) in zip(axes, layers.items(), strict=True):
        drawn = axis.imshow(
            image, cmap="gray" if high else "magma", vmin=0, vmax=high, origin="lower"
        )
        axis.set_title(title, fontsize=9)
        axis.axis("off")
        figure.colorbar(drawn, ax=axis, shrink=0.75, label="1/mm")
    return figure, {"sigma_median": float(np.nanmedian(volume.sigma[middle]))}


def contradiction() -> tuple[Figure, Numbers]:
    """Show images that were read in the alphabetical order of numbers without leading
    zeros.

    Returns the figure, a slice of each order, and their correlation.
    """
    turn = scan(180)
    images = fx.project(pieces(), turn)
    grid = fx.Grid((3, 96, 96), 0.55)
    alphabetical = sorted(range(len(turn)), key=str)
    shown = {
        "images in order": fx.fdk(images, turn, grid, errors=False).data[1],
        "in alphabetical order": fx.fdk(
            images[alphabetical], turn, grid, errors=False
        ).data[1],
    }
    right, wrong = shown.values()
    return slices(shown, 0.0, 0.06), {"correlation": correlation(right, wrong)}


def frames() -> tuple[Figure, Numbers]:
    """Show the images of a data set: dark, flat, one projection, its line integrals.

    Returns the figure, and no numbers.
    """
    data = fx.simulate("lego", scan(4, shape=(190, 239), pixel=0.5984), noise=SEED)
    images = {
        "dark (di000000)": (data.dark, 90, 110),
        "flat (io000000)": (data.flat, 0, 16383),
        "projection (scan_000000)": (data.counts()[0], 0, 16383),
        "line integrals, data[0]": (data[0], 0, 2),
    }
    figure, axes = plt.subplots(1, 4, figsize=(WIDTH_INCH, 2.0), layout="constrained")
    for axis, (title, (image, low, high)) in zip(axes, images.items(), strict=True):
        axis.imshow(image, cmap="gray", vmin=low, vmax=high)
        axis.set_title(title, fontsize=8)
        axis.axis("off")
    return figure, {}


def timeline() -> tuple[Figure, Numbers]:
    """Show a scan script over time: axes, X-rays, exposures, least clearance.

    Returns the figure of the example script step-72.txt, and its duration [s].
    """
    plan = fx.plan(ROOT / "examples" / "scripts" / "step-72.txt", machine="flexray")
    report = plan.check()
    figure = plan.plot(report)
    figure.set_size_inches(WIDTH_INCH, 4.2)
    return figure, {"duration_s": float(plan.duration_s)}


def chain() -> tuple[Figure, Numbers]:
    """Show one radiograph by the three kinds of physics.

    Returns the figure: one energy without noise, and the spectrum at 50 W and at 2 W; and
    no numbers.
    """
    view = scan(1, shape=(190, 239), pixel=0.5984)
    exact = fx.project("lego", view)[0]
    quiet = fx.simulate(
        "lego", view, noise=SEED, tube=fx.Tube(kV=90, power_W=50), exposure_ms=100
    )
    faint = fx.simulate(
        "lego", view, noise=SEED, tube=fx.Tube(kV=90, power_W=2), exposure_ms=100
    )
    images = {
        "50 keV, no noise": exact,
        "spectrum, 50 W": quiet[0],
        "spectrum, 2 W": faint[0],
    }
    drawn = {name: image[::-1] for name, image in images.items()}
    return slices(drawn, 0.0, 1.5, "line integral"), {}


def growth() -> tuple[Figure, Numbers]:
    """Show times of the projector against rays, voxels and threads, from the kept
    benchmark.

    Returns the figure, and no numbers.
    """
    document = json.loads((ROOT / "docs" / "images" / "bench.json").read_text("utf-8"))
    figure, axes = plt.subplots(
        1, 3, figsize=(WIDTH_INCH, HEIGHT_INCH), layout="constrained", sharey=True
    )
    labels = {"rays": "rays", "voxels": "voxels a side", "threads": "threads"}
    for axis, (name, label) in zip(axes, labels.items(), strict=True):
        points = document["growth"][name]
        for series in dict.fromkeys(point["series"] for point in points):
            line = [
                (point["x"], point["ms"]) for point in points if point["series"] == series
            ]
            axis.loglog(*zip(*line, strict=True), marker="o", markersize=3, label=series)
        ticks = sorted({point["x"] for point in points})
        axis.minorticks_off()
        axis.set_xticks(
            ticks, [f"{x:.0e}" if x > 9999 else str(x) for x in ticks], fontsize=6
        )
        axis.set_xlabel(label)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("ms a view")
    return figure, {}


SIDES = (128, 256, 512, 1024, 2048)
"""Voxels a side of the volumes whose cost is estimated."""
FLOAT_BYTES = 4
ADJOINT_OVER_FORWARD = 1.2
"""Time of the adjoint over the forward's, of cases C1 to C3 of the benchmark."""


def sizes() -> tuple[Figure, Numbers]:
    """Show memory of fdk, sirt and tv, and time of FDK and of an iteration, against
    voxels a side, for n views into n^3 voxels.

    Memory is of n x n pixels a view. Times are those of the kept benchmark: FDK scaled
    with views and voxels; an iteration is one forward and one adjoint a view of 956 x 760
    pixels, not extrapolated.

    Returns the figure, and the numbers by name: NAME_n_GiB, fdk_n_s, and iteration_n_s
    where n was measured.
    """
    from flexdt.twin.algorithms import ALGORITHMS

    document = json.loads((ROOT / "docs" / "images" / "bench.json").read_text("utf-8"))
    measured = {case["name"]: case for case in document["cases"]}["FDK"][
        "ms_per_view"
    ] / 1e3
    update_s = measured / (360 * 256**3)
    points = document["growth"]["voxels"]
    forward_ms = {
        point["x"]: point["ms"] for point in points if point["series"] == "level"
    }
    numbers: Numbers = {}
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH_INCH, 2.8), layout="constrained")
    for name in ("fdk", "sirt", "tv"):
        one = ALGORITHMS[name]
        arrays = 2 if one.direct else one.stacks + one.grids
        for n in SIDES:
            numbers[f"{name}_{n}_GiB"] = arrays * n**3 * FLOAT_BYTES / 2**30
        axes[0].loglog(
            SIDES, [numbers[f"{name}_{n}_GiB"] for n in SIDES], marker="o", label=name
        )
    for n in SIDES:
        numbers[f"fdk_{n}_s"] = update_s * n**4
        if n in forward_ms:
            numbers[f"iteration_{n}_s"] = (
                n * forward_ms[n] / 1e3 * (1 + ADJOINT_OVER_FORWARD)
            )
    for key, label in (("fdk", "FDK"), ("iteration", "one iteration")):
        known = [n for n in SIDES if f"{key}_{n}_s" in numbers]
        axes[1].loglog(
            known, [numbers[f"{key}_{n}_s"] for n in known], marker="o", label=label
        )
    for axis, label in zip(axes, ("GiB in memory", "s, two cores"), strict=True):
        axis.minorticks_off()
        axis.set_xticks(SIDES, [str(n) for n in SIDES])
        axis.set_xlabel("voxels a side, and views")
        axis.set_ylabel(label)
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize=8)
    return figure, numbers


def geometry() -> tuple[Figure, Numbers]:
    """Show a circle and a helix as `.plot()` draws them.

    Returns the figure, and no numbers.
    """
    figure = plt.figure(figsize=(WIDTH_INCH, 3.2), layout="constrained")
    helix = fx.ConeVec.helical(
        sod=600, sdd=1059, angles=60, turns=3, rise=40, shape=(95, 120), pixel=1.196
    )
    paths = {"circle, panel aside": scan(60, offset=(40.0, 0.0)), "helix": helix}
    for place, (title, cone) in enumerate(paths.items(), start=1):
        axis = figure.add_subplot(1, 2, place, projection="3d")
        axis.plot(*cone.source.T, ".", markersize=3, label="source")
        axis.plot(*cone.detector.T, ".", markersize=3, label="panel's middle")
        axis.scatter([0], [0], [0], color="black", label="object")
        axis.set_title(title, fontsize=9)
        axis.set_aspect("equal")
        axis.tick_params(labelsize=6)
    axis.legend(fontsize=7)
    return figure, {}


def clearance() -> tuple[Figure, Numbers]:
    """Show the least clearance while a sample nears the source, and where the motion is
    stopped.

    Writes the script beside this module for the time of its check. Returns the figure,
    and the time of the contact [s].
    """
    lines = [
        "tube xrayoff",
        "mag_obj move absolute 600 ACK",
        "mag_det move absolute 500 ACK",
    ]
    text = "\n".join([*lines, "camera take image", "camera save image scan_0.tif"])
    folder = Path(__file__).parent
    script = folder / ".clearance.txt"
    script.write_text(text + "\n")
    try:
        report = fx.plan(script, machine="flexray").check()
    finally:
        script.unlink()
    trace = report.clearance.trace
    figure, axis = plt.subplots(figsize=(WIDTH_INCH, HEIGHT_INCH), layout="constrained")
    axis.plot([point[0] for point in trace], [point[1] for point in trace])
    contact = report.clearance.collisions[0]
    axis.axvline(contact.time_s, color="tab:red")
    axis.annotate(
        f" line {contact.line}: {' and '.join(contact.pair)}",
        (contact.time_s, trace[0][1]),
        color="tab:red",
        fontsize=8,
    )
    axis.set_xlabel("time of the script [s]")
    axis.set_ylabel("least clearance [mm]")
    return figure, {"contact_s": contact.time_s}


FIGURES: dict[str, Callable[[], tuple[Figure, Numbers]]] = {
    "calibrated": calibrated,
    "aligned": aligned,
    "tile-gap": gap,
    "motion": motion,
    "streaks": streaks,
    "rings": rings,
    "cupping": cupping,
    "metal": metal,
    "bound": bound,
    "contradiction": contradiction,
    "frames": frames,
    "timeline": timeline,
    "physics": chain,
    "growth": growth,
    "sizes": sizes,
    "geometry": geometry,
    "clearance": clearance,
}
"""Name of the picture -> what draws it and returns the numbers of its caption."""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG of `COLOURS` colors, and close it."""
    from PIL import Image as Picture

    figure.savefig(path, dpi=DPI, metadata={"Software": None})
    plt.close(figure)
    with Picture.open(path) as drawn:
        drawn.convert("RGB").quantize(COLOURS).save(path, optimize=True)


def make(folder: Path, names: list[str]) -> None:
    """Draw figures of `FIGURES`, by name, into a folder, and renew their numbers in its
    `figures.json`, rounded to four digits; those of other names are kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stored = folder / "figures.json"
    numbers = json.loads(stored.read_text()) if stored.exists() else {}
    for name in names:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # what is wrong with these scans is their subject
            figure, numbers[name] = FIGURES[name]()
        save(figure, folder / f"{name}.png")
    rounded = {
        name: {key: float(f"{value:.4g}") for key, value in numbers[name].items()}
        for name in FIGURES
        if name in numbers
    }
    stored.write_text(json.dumps(rounded, indent=1) + "\n")


def main() -> None:
    """Make all figures, or those of --only, in the folder --out."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--out", type=Path, default=KEPT, metavar="DIR")
    arguments.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES))
    options = arguments.parse_args()
    make(options.out, options.only)


if __name__ == "__main__":
    main()
