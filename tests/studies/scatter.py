"""Scatter against CTSimU's references, its standard errors over seeds, and what a frame costs.

    python tests/studies/scatter.py ctsimu      # 2D-SW-1, ROSI and McRay (needs `ctsimu`)
    python tests/studies/scatter.py table       # scatter to primary of blocks in the FleX-ray
    python tests/studies/scatter.py pulls       # standard errors over 100 seeds
    python tests/studies/scatter.py cost        # seconds for a frame on one core
    python tests/studies/scatter.py cupping     # of cylinders with scatter, and corrected

The scenario of 2D-SW-1 is not public. Spherical wedges, steps and regions are those of the
evaluation's documentation, thicknesses follow from its primary signals, the panel stands at
1000 mm; the outer radius of the aluminium wedge (518 mm) and the inner radius of the iron one
(250 mm) are assumed. One length is fitted to McRay's scatter, for both metals together: the
size of the panel, at which the beam ends.
"""

from __future__ import annotations

import argparse
import pkgutil
import time
from collections.abc import Callable
from itertools import product

import numba
import numpy as np

import flexdt as fx
from flexdt.twin.attenuation.scattering import cross_sections
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.physics.scatter import (
    Beam,
    Object,
    ScatterImage,
    ScatterSettings,
    scatter_image,
)

ENERGY = cross_sections(()).energy_keV
EVEN = np.ones(len(ENERGY))
PANEL_MM = 345.0
"""Of CTSimU's 2D-SW-1; fitted, see above."""
FLEXRAY = (0, -600, 0, 0, 459, 0, 0.1496, 0, 0, 0, 0, -0.1496)
SHAPE = (760, 956)
BLOCKS = (
    ("PMMA 36 mm cube", "C5H8O2", 1.18, (36, 36, 36)),
    ("PMMA 36 mm, 80 wide, 60 high", "C5H8O2", 1.18, (80, 36, 60)),
    ("aluminium 20 mm cube", "Al", 2.7, (20, 20, 20)),
    ("aluminium 60 mm, 20 wide, 60 high", "Al", 2.7, (20, 60, 60)),
    ("water 80 mm, 80 wide, 60 high", "H2O", 1.0, (80, 80, 60)),
)
CYLINDERS = (("pmma", 35.0), ("aluminium", 15.0))
"""Material and radius [mm]."""
GAPS = ((600, 1059), (300, 400))
"""Source to axis and to panel [mm]: FleX-ray's, and a panel that stands close to the object."""


def mono(energy: float) -> Beam:
    """Photons of one energy, each counted as one."""
    at = int(np.argmin(np.abs(ENERGY - energy)))
    return Beam((np.arange(len(ENERGY)) == at) * 1.0, EVEN, EVEN)


def block(formula: str, density: float, size: tuple[float, float, float]) -> Object:
    """A box of 36^3 voxels about the origin."""
    n = 36
    edges = (size[0] / n, size[1] / n, size[2] / n)
    amounts = np.ones((n, n, n, 1), np.float32)
    return Object(
        amounts, edges, (0.0, 0.0, 0.0), (Substance.of(formula, formula, density),)
    )


def ctsimu() -> None:
    """Scatter of the step wedges behind each step, in per cent of the open beam."""
    for name, file, energy, radii in (
        ("Al", "07_Al_noFilter_050keV-mono_Ideal", 50.0, (None, 518.0)),
        ("Fe", "11_Fe_noFilter_100kV-mono_Ideal", 100.0, (250.0, None)),
    ):
        path = f"data/2D-SW-1_scenario{file}.txt"
        data = pkgutil.get_data("ctsimu.evaluation.test2D_SW_1", path)
        assert data is not None
        table = np.loadtxt(data.decode().splitlines(), delimiter="\t")
        references = {
            "ROSI": table[:, 1] - table[:, 9],
            "McRay": table[:, 4] - table[:, 12],
        }
        metal = Substance.of(name, name, {"Al": 2.7, "Fe": 7.874}[name])
        at = int(np.argmin(np.abs(ENERGY - energy)))
        thick = -np.log(table[:9, 12] / 60000.0) / metal.attenuation()[at]
        image = wedge(metal, thick, *radii, mono(energy))
        rows = image.full()
        # Row 0 is in the free beam; 91 rows a strip, of which the evaluation takes the middle.
        found = [
            rows[91 * k + 35 : 91 * k + 56, 445:465].mean() for k in range(9, -1, -1)
        ]
        found = 100.0 * np.array(found)
        print(f"{name} {energy:g} keV: thickest {thick[0]:.2f} mm; error of a node "
              f"{100 * image.error.mean() / image.mean.mean():.2f} %")  # fmt: skip
        print("  here, %   " + " ".join(f"{x:6.3f}" for x in found))
        for who, reference in references.items():
            ratio = found / (100.0 * reference / 60000.0)
            print(f"  / {who:6s}  " + " ".join(f"{x:6.3f}" for x in ratio))


def wedge(
    metal: Substance,
    thick: np.ndarray,
    inner: float | None,
    outer: float | None,
    beam: Beam,
) -> ScatterImage:
    """Nine steps and a free strip, each a tenth of the panel high, as spherical shells about
    the source; the lowest step is the thickest."""
    low = inner or (outer or 0.0) - thick.max()
    high = low + thick.max()
    half = 0.51 * PANEL_MM / 1000.0 * high
    near = 0.995 * low / np.sqrt(1.0 + 2.0 * (PANEL_MM / 2000.0) ** 2)
    nz, ny, nx, sub = 90, 50, 110, 3
    z, y, x = (
        (np.arange(n * s) + 0.5) / (n * s) * (b - a) + a
        for n, s, a, b in (
            (nz, sub, -half, half),
            (ny, sub, near, high),
            (nx, 2, -half, half),
        )
    )
    radius = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
    step = np.floor((z[:, None] / y * 1000.0 / PANEL_MM + 0.5) * 10.0).astype(int)
    here = np.where((step >= 0) & (step < 9), thick[np.clip(step, 0, 8)], 0.0)[:, :, None]
    start = inner if inner else (outer or 0.0) - here
    filled = (radius >= start) & (radius < start + here)
    amounts = filled.reshape(nz, sub, ny, sub, nx, 2).mean(
        axis=(1, 3, 5), dtype=np.float32
    )
    edges = (2.0 * half / nx, (high - near) / ny, 2.0 * half / nz)
    middle = (0.0, (high + near) / 2.0, 0.0)
    thing = Object(np.ascontiguousarray(amounts[..., None]), edges, middle, (metal,))
    pitch = PANEL_MM / 910.0
    view = (0, 0, 0, 0, 1000, 0, pitch, 0, 0, 0, 0, -pitch)
    settings = ScatterSettings(error=0.005, collimated=True, nodes=900)
    return scatter_image(thing, view, (910, 910), beam, settings)


def table() -> None:
    """Scatter at the shadow's centre of blocks at 45 keV."""
    print("FleX-ray, SOD 600, SDD 1059, 45 keV, whole block lit: at the shadow's centre")
    for name, formula, density, size in BLOCKS:
        thing = block(formula, density, size)
        image = scatter_image(
            thing, FLEXRAY, SHAPE, mono(45.0), ScatterSettings(error=0.005)
        )
        scatter = float(image.full()[SHAPE[0] // 2, SHAPE[1] // 2])
        at = int(np.argmin(np.abs(ENERGY - 45.0)))
        depth = thing.substances[0].attenuation()[at] * size[1]
        primary = np.exp(-depth)
        lost = 1.0 - np.log(primary + scatter) / np.log(primary)
        print(f"  {name:34s} S/P {100 * scatter / primary:5.2f} %, S {100 * scatter:.3f} % of the "
              f"open beam, line integral {100 * lost:.2f} % too low")  # fmt: skip


def pulls() -> None:
    """(image - truth) / error at all nodes over 100 seeds, truth from 100 times as many
    photons."""
    thing, beam = block("C5H8O2", 1.18, (36, 36, 36)), mono(45.0)
    view = (0, -600, 0, 20, 459, 10, 0.1496, 0, 0, 0, 0, -0.1496)

    def image(seed: int, error: float) -> ScatterImage:
        settings = ScatterSettings(error=error, seed=seed, nodes=100)
        return scatter_image(thing, view, SHAPE, beam, settings)

    truth = image(10_000, 0.001).mean
    found = [image(seed, 0.03) for seed in range(100)]
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    alone = image(0, 0.03)
    numba.set_num_threads(threads)
    same = all(np.array_equal(getattr(alone, name), getattr(found[0], name))
               for name in ("mean", "error", "spread"))  # fmt: skip
    print(f"1 and {threads} threads: {'the same bytes' if same else 'another image'}")
    pull = np.array([(one.mean - truth) / one.error for one in found])
    print(
        f"100 seeds, {truth.size} nodes: pulls have mean {pull.mean():.3f} "
        f"and standard deviation {pull.std():.3f} "
        "(Student's t with 31 degrees of freedom: 1.034); "
        f"beyond 2: {100 * np.mean(np.abs(pull) > 2):.1f} % (5.4 %)"
    )
    balance = np.mean([one.balance for one in found], axis=0)
    print(f"photons absorbed and escaped over those that interact: {balance[1:3].sum():.4f}; "
          f"energy: {balance[4:].sum() / balance[3]:.4f}")  # fmt: skip


def cost() -> None:
    """Seconds of one core for a frame at 3 %, median of five."""
    numba.set_num_threads(1)
    for name, formula, density, size in BLOCKS:
        thing = block(formula, density, size)
        line = f"  {name:34s}"
        for nodes in (720, 11400):
            settings = ScatterSettings(nodes=nodes)
            scatter_image(thing, FLEXRAY, SHAPE, mono(45.0), settings)
            took = []
            for stream in range(5):
                begun = time.perf_counter()
                image = scatter_image(thing, FLEXRAY, SHAPE, mono(45.0), settings, stream)
                took.append(time.perf_counter() - begun)
            nv, nu = image.mean.shape
            line += (f" | {nu} x {nv}: {np.median(took):5.2f} s, "
                     f"{100 * image.error.mean() / image.mean.mean():.1f} %")  # fmt: skip
        print(line)


def cupping() -> None:
    """Cupping and attenuation of cylinders in scans without scatter, with it and corrected.

    Scatter is simulated with other photons, 100 000 voxels, 1500 nodes and to 1 %; the
    correction takes its own defaults. Cupping: what the mean within a quarter of the radius
    lacks of the mean between 0.7 and 0.85 of it, in the middle layer.
    """
    detector = fx.Detector.ideal(bits=16, response=(), swank=0.9)  # caesium iodide
    truth = ScatterSettings(
        seed=77, error=0.01, voxels=100_000, nodes=1500, step_deg=10.0
    )
    for (sod, sdd), (material, radius), mono_keV in product(
        GAPS, CYLINDERS, (60.0, None)
    ):
        geometry = fx.ConeVec.circular(sod=sod, sdd=sdd, angles=360, shape=(152, 191),
                                       pixel=0.748)  # fmt: skip
        power = 40.0 * (sdd / 1059) ** 2
        tube = fx.Tube(
            kV=120, power_W=power, filters=[("Cu@8.96", 0.25)], mono_keV=mono_keV
        )
        sample = {"kind": "cylinder", "center": [0, 0, 0], "radius": radius, "height": 40,
                  "material": material}  # fmt: skip
        plain, scattered = (
            fx.simulate(sample, geometry, tube=tube, detector=detector, scatter=scatter)
            for scatter in ("off", truth)
        )
        hardened = None if mono_keV else material
        given = {"voxel": radius / 50, "shape": (1, 120, 120), "tube": tube,
                 "material": hardened}  # fmt: skip
        begun = time.perf_counter()
        corrected = scattered.reconstruct(scatter_correction=material, **given)
        took = time.perf_counter() - begun
        assert not scattered.warnings, scattered.warnings
        at = (np.arange(120) - 59.5) / 50
        r = np.hypot(at[:, None], at)
        beam = "60 keV" if mono_keV else "120 kV"
        line = f"  {sod} and {sdd} mm, {material:9s} {2 * radius:g} mm, {beam}:"
        whole = None
        for volume in (
            plain.reconstruct(**given),
            scattered.reconstruct(**given),
            corrected,
        ):
            layer = volume.data[0]
            middle, rim = layer[r < 0.25].mean(), layer[(r > 0.7) & (r < 0.85)].mean()
            whole = middle if whole is None else whole
            line += f" {100 * (1 - middle / rim):6.2f} % ({middle / whole:.4f})"
        ratio = scattered.truth.scatter[0].signal[76, 95] / np.exp(-plain[0][76, 95])
        print(f"{line}; S/P at the centre {100 * ratio:.1f} %; correction {took:.0f} s")


STUDIES: dict[str, Callable[[], None]] = {
    "ctsimu": ctsimu,
    "table": table,
    "pulls": pulls,
    "cost": cost,
    "cupping": cupping,
}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("study", choices=STUDIES)
    STUDIES[parser.parse_args().study]()
