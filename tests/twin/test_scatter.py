"""Scatter images against a direct integral, an analog simulation, and their own standard
errors.

The integral and the analog photons are written out here in plain numpy with their own geometry
and their own cross-sections: Klein and Nishina's formula, and F and S read from the shipped
file (the file itself is held against xraydb's independent tables).
"""

from __future__ import annotations

import doctest
from dataclasses import replace
from importlib import import_module, resources

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RectBivariateSpline

from flexdt.twin.attenuation.scattering import cross_sections
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.physics import scatter_kernels
from flexdt.twin.physics.chain import Chain
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.scatter import (
    Beam,
    Object,
    ScatterImage,
    ScatterSettings,
    scan_scatter,
    scatter_image,
)
from flexdt.twin.reconstruction import Grid, fdk, without_scatter
from flexdt.twin.reconstruction.scatter_correction import scatterer_of, subtracted

R2 = 0.0794078767e-22  # classical electron radius squared [mm2], 7.94e-30 m2
AVOGADRO, MC2, HC = 6.02214076e23, 510.99895, 12.39841984
ENERGY = tables().energy_keV
WATER = {"H": 2, "O": 1}
MASS = {"H": 1.008, "C": 12.011, "O": 15.999, "Al": 26.982}
NUMBER = {"H": 1, "C": 6, "O": 8, "Al": 13}
EVEN = np.ones(len(ENERGY))


def stored() -> dict[str, np.ndarray]:
    file = resources.files("flexdt.twin.attenuation") / "data" / "scattering.npz"
    with file.open("rb") as opened, np.load(opened) as arrays:
        return {
            name: np.array(arrays[name]) for name in ("x", "form_factor", "incoherent")
        }


FILE = stored()


def scattered(atoms: dict[str, int], density: float, energy, cosine):  # type: ignore[no-untyped-def]
    """Macroscopic differential cross-sections [1/mm sr], coherent and incoherent."""
    gram_per_mol = sum(n * MASS[s] for s, n in atoms.items())
    molecules = AVOGADRO * density / 1000.0 / gram_per_mol  # in a mm3
    x = energy / HC * np.sqrt((1 - cosine) / 2)
    k = 1 / (1 + energy / MC2 * (1 - cosine))
    thomson = R2 / 2 * (1 + cosine**2)
    klein_nishina = R2 / 2 * k**2 * (k + 1 / k - 1 + cosine**2)
    f2 = s = 0.0
    for symbol, n in atoms.items():
        z = NUMBER[symbol] - 1
        f2 = f2 + n * np.interp(x, FILE["x"], FILE["form_factor"][z]) ** 2
        s = s + n * np.interp(x, FILE["x"], FILE["incoherent"][z])
    return molecules * thomson * f2, molecules * klein_nishina * s


def in_box(p, d, half):  # type: ignore[no-untyped-def]
    """Length of the rays p + t d, t >= 0, in a box about the origin."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - p) / d, (half - p) / d
    near = np.nanmax(np.minimum(a, b), axis=-1)
    far = np.nanmin(np.maximum(a, b), axis=-1)
    return np.maximum(far - np.maximum(near, 0.0), 0.0)


def box(atoms: dict[str, int], density: float, size, voxels: int = 12) -> Object:  # type: ignore[no-untyped-def]
    formula = "".join(f"{s}{n}" for s, n in atoms.items())
    amounts = np.ones((voxels,) * 3 + (1,), np.float32)
    edges = tuple(float(s) / voxels for s in size)
    return Object(
        amounts, edges, (0.0, 0.0, 0.0), (Substance.of(formula, formula, density),)
    )  # type: ignore[arg-type]


def mono(energy: float) -> tuple[Beam, float]:
    at = int(np.argmin(np.abs(ENERGY - energy)))
    return Beam((np.arange(len(ENERGY)) == at) * 1.0, EVEN, EVEN), float(ENERGY[at])


def attenuation(substance: Substance, energy):  # type: ignore[no-untyped-def]
    return np.interp(energy, ENERGY, substance.attenuation())


def test_the_tables_agree_with_independent_ones() -> None:
    """Integrals with Elam's cross-sections; F with Waasmaier and Kirfel's (1995)."""
    xraydb = pytest.importorskip("xraydb")

    for formula, worst in (
        ("C5H8O2", 0.005),
        ("H2O", 0.005),
        ("Al", 0.005),
        ("Fe", 0.012),
    ):
        one = Substance.of(formula, formula, 1.0)
        found = cross_sections((one,))
        for energy in (30.25, 60.25, 150.25):
            at = int(np.searchsorted(ENERGY, energy))
            for kind, values in (("coh", found.coherent), ("incoh", found.incoherent)):
                elam = sum(
                    w * xraydb.mu_elam(s, energy * 1e3, kind=kind)
                    for s, w in one.fractions
                )
                assert values[0, at] == pytest.approx(float(elam) / 10.0, rel=worst)
    for symbol in ("C", "Al", "Fe", "W"):
        z = xraydb.atomic_number(symbol)
        theirs = xraydb.f0(symbol, FILE["x"][FILE["x"] < 2.0])
        ours = FILE["form_factor"][z - 1][: len(theirs)]
        np.testing.assert_allclose(ours, theirs, atol=0.012 * z)


@pytest.mark.parametrize("seed", range(4))
def test_first_order_is_the_integral_over_the_box(seed: int) -> None:
    """A box of random size and material, two energies, a panel anywhere, response in proportion
    to energy: nodes against a midpoint sum over the box."""
    rng = np.random.default_rng([seed, 19])
    atoms, density = [(WATER, 1.0), ({"C": 5, "H": 8, "O": 2}, 1.18), ({"Al": 1}, 2.7)][
        seed % 3
    ]
    size = rng.uniform(8.0, 30.0, 3) * (0.6 if density > 2 else 1.0)
    thing = box(atoms, density, size)
    substance = thing.substances[0]
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    x, y, z = turn.T
    source, centre = -300.0 * y, 150.0 * y + rng.normal(scale=20.0, size=3)
    shape, pitch = (50, 70), 2.0
    view = np.concatenate([source, centre, pitch * x, -pitch * z])
    signal = np.zeros(len(ENERGY))
    picked = np.searchsorted(ENERGY, rng.uniform(25.0, 140.0, 2))
    signal[picked] = rng.uniform(0.3, 1.0, 2)
    image = scatter_image(
        thing,
        view,
        shape,
        Beam(signal, ENERGY, ENERGY),
        ScatterSettings(error=0.005, nodes=35),
    )

    n = 40
    grid = (np.arange(n) + 0.5) / n - 0.5
    p = np.stack(np.meshgrid(*(grid * s for s in size), indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    volume = float(np.prod(size)) / n**3
    inward = p - source
    distance = np.linalg.norm(inward, axis=1)
    d = inward / distance[:, None]
    into = in_box(p, -d, size / 2)
    normal = np.cross(x, z)
    nv, nu = image.single.shape
    for i, j in ((0, 0), (nv // 2, nu // 2), (nv - 1, nu // 3)):
        row, col = i * (shape[0] - 1) / (nv - 1), j * (shape[1] - 1) / (nu - 1)
        node = (
            centre
            + (col - (shape[1] - 1) / 2) * pitch * x
            - (row - (shape[0] - 1) / 2) * pitch * z
        )
        out = node - p
        r = np.linalg.norm(out, axis=1)
        v = out / r[:, None]
        cosine = np.sum(d * v, axis=1)
        outward = in_box(p, v, size / 2)
        total = 0.0
        for at in picked:
            energy = ENERGY[at]
            softer = energy / (1 + energy / MC2 * (1 - cosine))
            coherent, incoherent = scattered(atoms, density, energy, cosine)
            first = np.exp(-attenuation(substance, energy) * into) / distance**2
            arrives = coherent * np.exp(-attenuation(substance, energy) * outward)
            arrives += (
                softer
                / energy
                * incoherent
                * np.exp(-attenuation(substance, softer) * outward)
            )
            slant = np.abs(v @ normal) / r**2
            total += signal[at] * np.sum(first * arrives * slant) * volume
        away = node - source
        open_beam = np.abs(away @ normal) / np.linalg.norm(away) ** 3 * signal.sum()
        assert image.single[i, j] == pytest.approx(total / open_beam, rel=0.02)


def analog(size, atoms, density, energy, source, panel_y, half_panel, photons, rng):  # type: ignore[no-untyped-def]
    """Photons that scatter once and more than once onto the panel y = panel_y, for one
    isotropic photon in a steradian; beam along +y that just holds the box. Also absorbed and
    interacting."""
    substance = box(atoms, density, size).substances[0]
    half = np.asarray(size) / 2
    front = -half[1] - source[1]
    wide = np.array([half[0], half[2]]) / front  # tangents of the beam's edges
    t = rng.uniform(-1, 1, (photons, 2)) * wide
    w = 4 * wide[0] * wide[1] / photons / (1 + (t**2).sum(axis=1)) ** 1.5
    d = np.stack([t[:, 0], np.ones(photons), t[:, 1]], axis=1)
    d /= np.linalg.norm(d, axis=1)[:, None]
    p = source + d * ((-half[1] + 1e-9 - source[1]) / d[:, 1])[:, None]
    e = np.full(photons, energy)
    grid = 1 - np.linspace(0, 1, 400) ** 4 * 2
    energies = np.linspace(5.0, energy, 60)
    shapes = np.array([scattered(atoms, density, k, grid) for k in energies])
    sums = -np.trapezoid(shapes, grid) * 2 * np.pi
    bounds = (shapes * np.sqrt((1 - grid) / 2)).max(axis=(0, 2)) * 1.01
    order = np.zeros(photons, int)
    once = more = absorbed = interacting = 0.0
    while len(p):
        fly = rng.exponential(size=len(p)) / attenuation(substance, e)
        leaves = fly >= in_box(p, d, half)
        hit_t = np.where(
            d[:, 1] > 1e-9, (panel_y - p[:, 1]) / np.maximum(d[:, 1], 1e-9), 0.0
        )
        at = p + d * hit_t[:, None]
        lands = (
            leaves & (d[:, 1] > 1e-9) & (np.abs(at[:, [0, 2]]) < half_panel).all(axis=1)
        )
        once += w[lands & (order == 1)].sum()
        more += w[lands & (order > 1)].sum()
        stay = ~leaves
        p, d, e, w, order = (
            (p + d * fly[:, None])[stay],
            d[stay],
            e[stay],
            w[stay],
            order[stay],
        )
        interacting += w[order == 0].sum()
        # Both processes at once, by rejection from even directions: the sum of their
        # cross-sections over a bound; what is missing to the whole is absorption.
        coherent, incoherent = (np.interp(e, energies, c) for c in sums.T)
        u = rng.uniform(size=len(p)) * attenuation(substance, e)
        gone = u >= coherent + incoherent
        absorbed += w[gone].sum()
        p, d, e, w, order = p[~gone], d[~gone], e[~gone], w[~gone], order[~gone]
        elastic = (u < coherent)[~gone]
        c, open_ = np.zeros(len(p)), np.arange(len(p))
        while len(open_):
            trial = (
                1 - 2 * rng.uniform(size=len(open_)) ** 2
            )  # density of 1 / (4 sqrt((1 - c) / 2))
            both = scattered(atoms, density, e[open_], trial)
            value = np.where(elastic[open_], both[0], both[1]) * np.sqrt((1 - trial) / 2)
            taken = (
                rng.uniform(size=len(open_)) * np.where(elastic[open_], *bounds) < value
            )
            c[open_[taken]] = trial[taken]
            open_ = open_[~taken]
        e = np.where(elastic, e, e / (1 + e / MC2 * (1 - c)))
        side = np.cross(d, rng.normal(size=d.shape))
        side /= np.linalg.norm(side, axis=1)[:, None]
        d = c[:, None] * d + np.sqrt(np.maximum(1 - c**2, 0))[:, None] * side
        order = order + 1
    return once, more, absorbed, interacting


@pytest.mark.slow
@pytest.mark.campaign
def test_forced_detection_counts_what_analog_photons_count() -> None:
    """Water, 60 keV, a near panel: photons on it after one and after more interactions,
    absorbed and interacting, within four standard errors and 2 %."""
    size, source, panel_y, half = (
        (40.0, 40.0, 40.0),
        np.array([0.0, -200.0, 0.0]),
        60.0,
        80.0,
    )
    beam, energy = mono(60.0)
    thing = box(WATER, 1.0, size)
    once, more, absorbed, interacting = np.mean(
        [analog(size, WATER, 1.0, energy, source, panel_y, half, 120_000, np.random.default_rng(k))
         for k in range(4)], axis=0)  # fmt: skip
    shape, pitch = (80, 80), 2.0
    view = [*source, 0, panel_y, 0, pitch, 0, 0, 0, 0, -pitch]
    image = scatter_image(thing, view, shape, beam, ScatterSettings(error=0.003))
    at = (np.arange(80) - 39.5) * pitch
    reach = panel_y - source[1]
    open_beam = pitch**2 * reach / (reach**2 + at[:, None] ** 2 + at**2) ** 1.5
    single = float((image.full(image.single) * open_beam).sum())
    both = float((image.full() * open_beam).sum())
    assert single == pytest.approx(once, rel=0.015)
    assert both - single == pytest.approx(more, rel=0.02)
    # The analog beam just fills the front face; so does the box's shadow, up to the rays that
    # pass its back edges: compare what becomes of photons that interact.
    assert image.balance[1] == pytest.approx(absorbed / interacting, rel=0.02)


def scene(seed: int, error: float = 0.05) -> ScatterImage:
    """PMMA beside aluminium: two materials in one grid, in a spectrum."""
    rng = np.random.default_rng(5)
    amounts = np.zeros((10, 10, 10, 2), np.float32)
    amounts[..., 0] = 1.0
    amounts[2:8, 3:6, 2:5] = (0.0, 1.0)
    amounts[..., 0] *= rng.uniform(0.5, 1.0, (10, 10, 10))
    materials = (
        Substance.of("pmma", "C5H8O2", 1.19),
        Substance.of("aluminium", "Al", 2.7),
    )
    thing = Object(amounts, (2.5, 2.5, 2.5), (0.0, 1.0, 0.0), materials)
    view = [0, -300, 0, 5, 200, 0, 0.8, 0, 0, 0, 0, -0.8]
    beam = Beam.of(Chain(Detector()), 90.0)
    return scatter_image(
        thing, view, (90, 120), beam, ScatterSettings(error=error, seed=seed)
    )


def test_the_image_does_not_depend_on_the_number_of_threads() -> None:
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = scene(1)
        numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
        shared = scene(1)
    finally:
        numba.set_num_threads(before)
    for name in ("mean", "error", "single", "spread", "balance"):
        assert getattr(alone, name).tobytes() == getattr(shared, name).tobytes(), name
    assert not np.array_equal(alone.mean, scene(2).mean)


@pytest.mark.slow
def test_standard_errors_hold_and_photons_and_energy_are_kept() -> None:
    images = [scene(seed) for seed in range(20)]
    truth = scene(1000, 0.008).mean
    pulls = np.array([(one.mean - truth) / one.error for one in images])
    # Neighbouring nodes go together: 20 seeds and a few independent regions.
    assert 0.75 < np.sqrt(np.mean(pulls**2)) < 1.3
    assert np.abs(pulls.mean()) < 0.5
    for one in images:
        assert one.error.mean() / one.mean.mean() <= 0.05
    balances = np.array([one.balance for one in images])
    kept = balances[:, 1] + balances[:, 2]
    energy = (balances[:, 4] + balances[:, 5]) / balances[:, 3]
    for ratio in (kept, energy):
        standard = ratio.std(ddof=1) / np.sqrt(len(ratio))
        assert standard < 0.003
        assert ratio.mean() == pytest.approx(1.0, abs=4 * standard)
    assert (balances[:, 1:3] > 0.1).all()


@pytest.mark.slow
def test_views_between_simulated_ones_are_interpolated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scatter_kernels, "MAX_ORDERS", 1)
    thing = box(WATER, 1.0, (20, 30, 20))
    beam, _ = mono(60.0)
    angle = np.radians(np.arange(0.0, 21.0, 1.0))
    turned = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], turned.shape)
    views = np.concatenate([-300 * turned, 200 * turned, 2 * across, 2 * down], axis=1)
    settings = ScatterSettings(error=0.002, step_deg=5.0, nodes=80)
    scan = scan_scatter(thing, views, (40, 50), beam, settings)
    gaps = np.diff(scan.simulated)
    assert scan.simulated[0] == 0
    assert scan.simulated[-1] == 20
    assert gaps.max() <= 5
    assert len(gaps) <= 5
    exact = scan_scatter(thing, views, (40, 50), beam, replace(settings, step_deg=0.0))
    assert len(exact.images) == 21
    for i in range(21):
        np.testing.assert_allclose(scan[i].signal, exact[i].signal, rtol=0.01)
        if i in scan.simulated:
            np.testing.assert_allclose(scan[i].signal, exact[i].signal, rtol=1e-6)
    # A source that jumps has no views in between.
    jumps = scan_scatter(thing, views[[0, 10, 20]], (40, 50), beam, settings)
    assert jumps.simulated == (0, 1, 2)


HALF, KEV = 20.0, 60.0
PMMA = {"C": 5, "H": 8, "O": 2}
TURN = ConeVec.circular(sod=300, sdd=400, angles=60, shape=(48, 64), pixel=2.0)


def in_cylinder(p, d, radius):  # type: ignore[no-untyped-def]
    """Length of the rays p + t d, t >= 0, in an upright cylinder about the origin."""
    a, b = (d[..., :2] ** 2).sum(axis=-1), (p[..., :2] * d[..., :2]).sum(axis=-1)
    root = np.sqrt(
        np.maximum(b**2 - a * ((p[..., :2] ** 2).sum(axis=-1) - radius**2), 0.0)
    )
    ends = (np.array([[-HALF], [HALF]]) - p[..., 2].ravel()) / d[..., 2].ravel()
    low, high = (f(ends, axis=0).reshape(a.shape) for f in (np.min, np.max))
    near, far = np.maximum((-b - root) / a, low), np.minimum((-b + root) / a, high)
    return np.maximum(far - np.maximum(near, 0.0), 0.0)


def radiograph(row, atoms, density, inside, points, each, counts=(7, 9)):  # type: ignore[no-untyped-def]
    """Transmission and single scatter in a view, by chords and by a sum over points of an
    object.

    Args:
        row: the cone_vec row.
        atoms, density: of the object.
        inside: length in it of the rays p + t d, t >= 0.
        points: (k, 3) in it, each standing for a volume `each`, (k,) [mm3].
        counts: rows and columns of the places between which scatter is interpolated.
    """
    _, energy = mono(KEV)
    formula = "".join(f"{s}{n}" for s, n in atoms.items())
    substance = Substance.of(formula, formula, density)
    response = Detector().charge_of_photons()[0]
    source, centre, u, v = row.reshape(4, 3)
    rows, cols = TURN.of_shape(None)
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))

    def pixel(row, col):  # type: ignore[no-untyped-def]
        return centre + (row - (rows - 1) / 2) * v + (col - (cols - 1) / 2) * u

    every = pixel(*(a[..., None] + 1e-6 for a in np.mgrid[:rows, :cols]))
    way = every - source
    way /= np.linalg.norm(way, axis=-1)[..., None]
    straight = np.exp(-attenuation(substance, energy) * inside(source + 0 * way, way))

    p = points
    inward = p - source
    distance = np.linalg.norm(inward, axis=1)
    d = inward / distance[:, None]
    first = np.exp(-attenuation(substance, energy) * inside(p, -d)) / distance**2
    at_v, at_u = np.linspace(0, rows - 1, counts[0]), np.linspace(0, cols - 1, counts[1])
    nodes = np.empty(counts)
    for i, j in np.ndindex(*counts):
        node = pixel(at_v[i], at_u[j])
        out = node - p
        reach = np.linalg.norm(out, axis=1)
        w = out / reach[:, None]
        cosine = np.sum(d * w, axis=1)
        outward = inside(p, w)
        softer = energy / (1 + energy / MC2 * (1 - cosine))
        coherent, incoherent = scattered(atoms, density, energy, cosine)
        gained = np.interp(softer, ENERGY, response) / np.interp(energy, ENERGY, response)
        arrives = coherent * np.exp(-attenuation(substance, energy) * outward)
        arrives += gained * incoherent * np.exp(-attenuation(substance, softer) * outward)
        away = node - source
        open_beam = np.abs(away @ normal) / np.linalg.norm(away) ** 3
        nodes[i, j] = (
            np.sum(first * arrives * np.abs(w @ normal) / reach**2 * each) / open_beam
        )
    return straight, RectBivariateSpline(at_v, at_u, nodes)(
        np.arange(rows), np.arange(cols)
    )


def cylinder_scan(
    atoms: dict[str, int], density: float, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Transmission and single scatter of a cylinder on the axis, the same in all views."""
    nr, na, nz = 8, 24, 12
    r, angle, z = (
        (np.arange(n) + 0.5) / n * size + low
        for n, size, low in (
            (nr, radius, 0.0),
            (na, 2 * np.pi, 0.0),
            (nz, 2 * HALF, -HALF),
        )
    )
    r, angle, z = (one.ravel() for one in np.meshgrid(r, angle, z, indexing="ij"))
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    each = r * (radius / nr) * (2 * np.pi / na) * (2 * HALF / nz)
    return radiograph(
        TURN.rows[0], atoms, density, lambda p, d: in_cylinder(p, d, radius), points, each
    )


def cupping(line_integrals: np.ndarray, size: float) -> tuple[float, float]:
    """Mean attenuation by FDK near the axis and near the cylinder's rim, in its middle
    layers."""
    found = fdk(line_integrals, TURN, Grid((3, 60, 60), size / 25)).data.mean(axis=0)
    at = (np.arange(60) - 29.5) * size / 25
    radius = np.hypot(at[:, None], at)
    return float(found[radius < 0.25 * size].mean()), float(
        found[(radius > 0.6 * size) & (radius < 0.8 * size)].mean()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("atoms", "density", "radius"), [(PMMA, 1.19, 35.0), ({"Al": 1}, 2.7, 15.0)]
)
@pytest.mark.campaign(1)
def test_subtracted_scatter_leaves_no_cupping(
    atoms: dict[str, int], density: float, radius: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Single scatter summed over the cylinder here, found and subtracted there from the images
    alone, where a photon interacts once."""
    monkeypatch.setattr(scatter_kernels, "MAX_ORDERS", 1)
    straight, scatter = cylinder_scan(atoms, density, radius)
    views = (len(TURN), 1, 1)
    clean = np.tile(-np.log(straight), views)
    measured = np.tile(-np.log(straight + scatter), views)
    formula = "".join(f"{s}{n}" for s, n in atoms.items())
    chain = Chain(
        Detector(), substances=(Substance.of(formula, formula, density),), mono_keV=KEV
    )
    settings = ScatterSettings(nodes=100, step_deg=90.0)
    corrected = without_scatter(measured, TURN, chain, 90.0, settings)
    truth, cupped, flat = (
        np.array(cupping(one, radius)) for one in (clean, measured, corrected)
    )
    assert (cupped / truth)[0] < 0.98 * (cupped / truth)[1]
    np.testing.assert_allclose(flat / truth, 1.0, rtol=0.008)
    assert (flat / truth)[0] == pytest.approx((flat / truth)[1], rel=0.005)
    found = scatterer_of(measured.astype(np.float32), TURN, chain, 90.0, settings)
    assert not found.doubts
    assert found.changes[-1] < 0.01
    # A wrong material is told from how much the object attenuates.
    wrong = Substance.of("Fe", "Fe", 7.874)
    doubts = scatterer_of(
        measured.astype(np.float32),
        TURN,
        replace(chain, substances=(wrong,)),
        90.0,
        settings,
    ).doubts
    assert any("either it is not Fe" in doubt for doubt in doubts)


def test_a_scatter_correction_needs_materials_that_differ() -> None:
    air = np.zeros((len(TURN), 48, 64), np.float32)
    water = Substance.of("water", "H2O", 1.0)
    for substances, why in (
        ((), "no material"),
        ((water, replace(water, name="w")), "alike"),
    ):
        with pytest.raises(LimitError, match=why):
            without_scatter(air, TURN, Chain(Detector(), substances=substances), 90.0)


@given(st.floats(-10.0, 2.0**100, width=32), st.floats(0.0, 1e3, width=32))
def test_any_scatter_is_subtracted_from_any_line_integral(
    integral: float, scatter: float
) -> None:
    """Black pixels, too, whose transmission has no inverse in float32."""
    image = np.full((2, 3), integral, np.float32)
    left = subtracted(image, np.full((2, 3), scatter, np.float32))
    assert np.isfinite(left).all()
    assert (left >= image).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1)])
def test_panels_of_one_row_or_column(shape: tuple[int, int]) -> None:
    beam, _ = mono(60.0)
    thing = box(WATER, 1.0, (20, 30, 20))
    view = [0, -300, 0, 0, 200, 0, 1, 0, 0, 0, 0, -1]
    settings = ScatterSettings(error=0.2, nodes=16)
    full = scatter_image(thing, view, (31, 31), beam, settings).full()
    narrow = scatter_image(thing, view, shape, beam, settings).full()
    assert narrow.shape == shape
    assert narrow.mean() == pytest.approx(full[15, 15], rel=0.5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_line_integrals_that_are_not_finite_are_refused(value: float) -> None:
    """They were found to be air, by which nothing is scattered."""
    scan = ConeVec.circular(sod=300, sdd=500, angles=24, shape=(10, 16), pixel=4)
    chain = Chain(Detector(), substances=(Substance.of("water", "H2O", 1.0),))
    images = np.zeros((24, 10, 16), np.float32)
    images[3, 4, 5] = value
    with pytest.raises(GeometryError, match="not finite"):
        without_scatter(images, scan, chain, 90.0)
    with pytest.raises(GeometryError, match="projections"):
        without_scatter(np.zeros((5, 10, 16)), scan, chain, 90.0)


def test_what_cannot_be_is_refused() -> None:
    beam, _ = mono(60.0)
    thing = box(WATER, 1.0, (20, 30, 20))
    for wrong in ({"error": 0.0}, {"nodes": 3}, {"error": float("nan")}):
        with pytest.raises(LimitError, match="allowed"):
            ScatterSettings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(GeometryError, match="beside the sample"):
        scatter_image(thing, [0, -10, 0, 0, 200, 0, 1, 0, 0, 0, 0, -1], (40, 50), beam)
    with pytest.raises(LimitError, match="no views"):
        scan_scatter(thing, np.zeros((0, 12)), (40, 50), beam)
    nothing = replace(thing, amounts=thing.amounts * 0)
    view = [0, -300, 0, 0, 200, 0, 1, 0, 0, 0, 0, -1]
    assert not scatter_image(nothing, view, (40, 50), beam).full().any()


@pytest.mark.parametrize(
    "name",
    ["flexdt.twin.attenuation.scattering", "flexdt.twin.physics.scatter",
     "flexdt.phantoms.channels", "flexdt.twin.reconstruction.scatter_correction"],
)  # fmt: skip
def test_examples(name: str) -> None:
    result = doctest.testmod(import_module(name))
    assert result.attempted > 0
    assert result.failed == 0
