"""Drawn calls of `fx.simulate(...).reconstruct("fdk")`: is a volume ever wrong without a word?

    python tests/studies/silent_errors.py --count 1000 --seed 1

Sample, geometry, tube and exposure are drawn from wide ranges of what a user could sensibly
want. A call is right where the mean of each even region that the volume holds is within 5 % of
the truth. Otherwise there must have been a Python warning or a refusal. Half of the calls use
one energy, where the truth is the tabulated attenuation (NIST XCOM, typed in below). In the
others the truth is an interval: between the slope of attenuation over thickness at the object's
largest chord and the one at no thickness, both measured on plates in one radiograph. Prints
every call that is wrong in silence, and exits with 1 if there is one.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

import flexdt as fx

ENERGIES = (30.0, 40.0, 60.0, 80.0)
"""Photon energies of the tables [keV]."""
ATTENUATION = {
    "water": (1.0, (0.3756, 0.2683, 0.2059, 0.1837)),
    "pmma": (1.19, (0.3032, 0.2350, 0.1924, 0.1751)),
    "aluminium": (2.70, (1.128, 0.5685, 0.2778, 0.2018)),
}
"""Material -> density [g/cm3], mass attenuation with coherent scattering [cm2/g] (NIST
XCOM)."""
TOLERANCE = 0.05
SPARED = 3.0
"""Voxels from an edge that belong to no even region."""
FEWEST = 30
"""Voxels of the smallest region that counts."""


@dataclass(frozen=True)
class Call:
    """One drawn call."""

    solids: list[dict[str, object]]
    geometry: fx.ConeVec
    tube: fx.Tube
    said: str
    noise: int | None
    exposure_ms: float | None
    voxel: float
    options: dict[str, float] = field(default_factory=dict)


def drawn(rng: np.random.Generator) -> Call:
    """A call that somebody could make."""
    material = str(rng.choice(list(ATTENUATION)))
    fill = float(
        rng.choice([rng.uniform(0.3, 0.9), rng.uniform(0.9, 1.3)], p=[0.85, 0.15])
    )
    density, table = ATTENUATION[material]
    depth = float(np.exp(rng.uniform(np.log(0.05), np.log(6.0))))
    radius = depth / (0.2 * density * table[2])
    half = radius / fill
    magnification = float(np.exp(rng.uniform(np.log(1.15), np.log(12.0))))
    sod = float(rng.uniform(3.5 * half, max(8.0 * half, 300.0)))
    sdd = sod * magnification
    rows, columns = (int(rng.integers(24, 56)), int(rng.integers(40, 80)))
    pixel = 2.0 * half * magnification / columns
    tall = 0.5 * rows * pixel / magnification
    turn = rng.choice(
        ["whole", "short", "half", "gap", "part"], p=[0.6, 0.15, 0.08, 0.07, 0.1]
    )
    views = int(rng.integers(60, 160))
    fan = 2.0 * np.degrees(np.arctan(half / sod))
    arc = {"whole": 360.0, "short": 180.0 + fan + 20.0, "half": 180.0, "gap": 360.0,
           "part": float(rng.uniform(60.0, 170.0))}[str(turn)]  # fmt: skip
    angles = float(rng.uniform(0, 360)) + np.arange(views) * arc / views
    if turn == "gap":
        lost = int(rng.integers(2, views // 3))
        first = int(rng.integers(0, views - lost))
        angles = np.delete(angles, np.arange(first, first + lost))
    aside = float(
        rng.choice([0.0, 1.0], p=[0.8, 0.2]) * rng.uniform(-0.45, 0.45) * columns * pixel
    )
    geometry = fx.ConeVec.circular(
        sod=sod,
        sdd=sdd,
        angles=angles,
        shape=(rows, columns),
        pixel=pixel,
        offset=(aside, 0.0),
    )
    middle = (
        rng.uniform(-0.3, 0.3, 3) * np.array([half, half, tall]) * max(0.0, 1.0 - fill)
    )
    solids: list[dict[str, object]] = []
    kind = str(rng.choice(["sphere", "cylinder", "box"]))
    height = 2.0 * tall * float(rng.uniform(0.3, 1.4))
    if kind == "sphere":
        solids.append({"kind": kind, "center": middle.tolist(), "radius": radius})
    elif kind == "cylinder":
        solids.append({"kind": kind, "center": middle.tolist(), "radius": radius,
                       "height": height})  # fmt: skip
    else:
        solids.append({"kind": kind, "center": middle.tolist(),
                       "size": [1.3 * radius, 1.3 * radius, height]})  # fmt: skip
    solids[0]["material"] = material
    tube = (
        fx.Tube(kV=90, mono_keV=float(rng.choice(ENERGIES)))
        if rng.random() < 0.5
        else fx.Tube(kV=float(rng.uniform(40, 120)), power_W=float(rng.uniform(5, 80)))
    )
    exposure = (
        None
        if rng.random() < 0.6
        else float(np.exp(rng.uniform(np.log(1), np.log(5000))))
    )
    said = f"{turn} turn, {len(angles)} views, magnification {magnification:.2f}, fill {fill:.2f}"
    said += (
        f", aside {aside / pixel:.1f} of {columns} columns, {kind} of {material}, {tube}"
    )
    voxel = pixel / magnification
    noise = int(rng.integers(1 << 30)) if rng.random() < 0.7 else None
    return Call(solids, geometry, tube, said, noise, exposure, voxel)


def inside(solid: dict[str, object], places: np.ndarray, spare: float) -> np.ndarray:
    """Places (..., 3; x, y, z) more than `spare` [mm] within a solid."""
    at = places - np.asarray(solid["center"])
    if solid["kind"] == "sphere":
        return np.linalg.norm(at, axis=-1) < float(solid["radius"]) - spare  # type: ignore[arg-type]
    if solid["kind"] == "cylinder":
        round_ = np.hypot(at[..., 0], at[..., 1]) < float(solid["radius"]) - spare  # type: ignore[arg-type]
        return round_ & (np.abs(at[..., 2]) < 0.5 * float(solid["height"]) - spare)  # type: ignore[arg-type]
    return (np.abs(at) < 0.5 * np.asarray(solid["size"]) - spare).all(axis=-1)


def largest_chord(solid: dict[str, object]) -> float:
    """Longest way through a solid across the axis [mm]."""
    if solid["kind"] == "box":
        x, y, _ = solid["size"]  # type: ignore[misc]
        return float(np.hypot(x, y))
    return 2.0 * float(solid["radius"])  # type: ignore[arg-type]


def truth(call: Call) -> tuple[float, float]:
    """Least and largest attenuation that the material can be said to have [1/mm]."""
    solid = call.solids[0]
    material = str(solid["material"])
    if call.tube.mono_keV is not None:
        density, table = ATTENUATION[material]
        mu = 0.1 * density * table[ENERGIES.index(call.tube.mono_keV)]
        return mu, mu
    chord = largest_chord(solid)
    if (
        through(1.0, call) * chord < 0.05
    ):  # it hardens nothing, and counts are whole numbers
        chord = 0.05 / through(1.0, call)
    thin = float(np.clip(0.05 / through(chord, call), 0.02, 0.5)) * chord
    slope = (through(chord, call) - through(0.95 * chord, call)) / (0.05 * chord)
    # Few counts are whole numbers: a slope of those may be above the mean.
    return min(slope, through(chord, call) / chord), through(thin, call) / thin


def through(thick: float, call: Call) -> float:
    """Line integral of a plate [mm] of the call's material in the call's beam."""
    plate = {"kind": "box", "center": [0, 0, 0], "size": [500, thick, 500],
             "material": call.solids[0]["material"]}  # fmt: skip
    away = 20.0 * thick
    far = fx.ConeVec.from_vectors(
        [0, -away, 0], [0, away, 0], [0.01, 0, 0], [0, 0, -0.01]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scan = fx.simulate(plate, far, tube=call.tube, shape=(3, 3))
    return float(scan.line_integrals(0)[1, 1])


@dataclass(frozen=True)
class Judged:
    """What came of a call: right, warned, refused, silent, or nothing to judge."""

    verdict: str
    text: str = ""


def mean_inside(call: Call, noise: int | None) -> float | None:
    """Make a call; the mean of the even region [1/mm], None where it is too small."""
    scan = fx.simulate(call.solids, call.geometry, tube=call.tube, noise=noise,
                       exposure_ms=call.exposure_ms)  # fmt: skip
    volume = scan.reconstruct("fdk")
    data = np.asarray(volume.data)
    x, y, z = (
        center + step * (np.arange(n) - 0.5 * (n - 1))
        for center, step, n in zip(
            volume.center_mm, volume.voxel_xyz, data.shape[::-1], strict=True
        )
    )
    places = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    values = data[inside(call.solids[0], places, SPARED * call.voxel)]
    values = values[np.isfinite(values)]  # voxels that no data cover are NaN
    return float(values.mean()) if values.size >= FEWEST else None


def judged(call: Call) -> Judged:
    """Make the call, and compare."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            found = mean_inside(call, call.noise)
        except fx.TwinError as error:
            return Judged("refused", str(error))
    if found is None:
        return Judged("nothing")
    least, most = truth(call)
    texts = sorted({str(w.message)[:100] for w in heard})
    error = off(found, least, most)
    if error <= TOLERANCE:
        return Judged("right, warned" if texts else "right", "; ".join(texts))
    text = (
        f"{found:.5f} where [{least:.5f}, {most:.5f}]: {100 * error:.1f} % off; {texts}"
    )
    if texts or call.noise is None:
        return Judged("warned" if texts else "SILENT", text)
    # A volume of noise says so to everybody who looks at it. What noise does not do is a bias.
    others = [mean_inside(call, call.noise + k) or 0.0 for k in range(1, 7)]
    biased = off(float(np.mean([found, *others])), least, most) > TOLERANCE
    biased &= abs(float(np.mean(others)) - least) > float(np.std(others))
    return Judged("SILENT" if biased else "noise", text)


def off(found: float, least: float, most: float) -> float:
    """By which part a value lies outside an interval; negative inside."""
    return max(1.0 - found / max(least, 1e-9), found / most - 1.0)


def main() -> int:
    """Draw, judge and count."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="this draw alone")
    parser.add_argument("--every", action="store_true", help="print all draws")
    chosen = parser.parse_args()
    counts: Counter[str] = Counter()
    begun = time.process_time()
    for i in range(chosen.count) if chosen.only is None else [chosen.only]:
        call = drawn(np.random.default_rng([chosen.seed, i]))
        result = judged(call)
        counts[result.verdict] += 1
        if result.verdict == "SILENT" or chosen.every:
            print(f"{i}: {result.verdict}: {call.said}, {call.exposure_ms} ms\n    {result.text}",
                  flush=True)  # fmt: skip
    for verdict, count in counts.most_common():
        print(f"{count:6} {verdict}")
    print(f"{time.process_time() - begun:.0f} CPU s")
    return 1 if counts["SILENT"] else 0


if __name__ == "__main__":
    sys.exit(main())
