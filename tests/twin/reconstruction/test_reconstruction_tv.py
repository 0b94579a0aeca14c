"""Total variation: the cost of the minimum against an independent solver, the way there, and
what it is for.
"""

from __future__ import annotations

import numpy as np
import pytest
import tv_weights
from circular_scans import circle
from scipy.optimize import minimize

from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.plausibility.contradictions import PlausibilityWarning
from flexdt.twin.projection import Operator, Volume
from flexdt.twin.reconstruction import minimise_tv, tv

LIKE = Volume(np.zeros((4, 5, 6)), (2.0, 2.5, 3.0))
SCAN = circle(5, pixel=3.0)
SHAPE = (6, 8)


@pytest.fixture(autouse=True)
def one_thread():
    """Waking threads would take longer than these small problems."""
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def small():
    """The matrix of a small problem, noisy data, and the strength that a weight of 1e-2
    means."""
    operator = Operator(SCAN, LIKE, SHAPE)
    size = int(np.prod(LIKE.shape))
    units = np.eye(size, dtype=np.float32).reshape(-1, *LIKE.shape)
    matrix = np.array([(operator @ unit).ravel() for unit in units], np.float64).T
    rng = np.random.default_rng(1)
    x = np.zeros(LIKE.shape)
    x[1:3, 1:4, 2:5] = 0.05
    data = (matrix @ x.ravel()).reshape(operator.image_shape) + rng.normal(
        size=(5, *SHAPE)
    ) * 0.05
    return matrix, data, 1e-2 * (matrix.T @ data.ravel()).max()


def variation(x: np.ndarray, soft: float = 0.0) -> tuple[float, np.ndarray]:
    """Sum of sqrt(|scaled differences|^2 + soft^2) and its gradient, by the definition."""
    x = x.reshape(LIKE.shape)
    scale = 2.0 / np.array([3.0, 2.5, 2.0])
    steps = [
        scale[a] * np.diff(x, axis=a, append=x.take([-1], axis=a)) for a in range(3)
    ]  # fmt: skip
    length = np.sqrt(sum(s**2 for s in steps) + soft**2)
    slope = np.zeros_like(x)
    for a, s in enumerate(steps):
        part = scale[a] * s / np.maximum(length, 1e-300)
        slope -= part
        slope += np.roll(part, 1, axis=a)  # the last difference is 0: nothing comes round
    return float(length.sum()), slope.ravel()


def cost(small, x: np.ndarray, soft: float = 0.0) -> tuple[float, np.ndarray]:
    matrix, data, strength = small
    rest = matrix @ x.ravel() - data.ravel()
    value, slope = variation(x, soft)
    return 0.5 * float(rest @ rest) + strength * value, matrix.T @ rest + strength * slope


def test_the_minimum_is_that_of_another_solver(small):
    """L-BFGS on a softened problem brackets the cost: it is at most that of the solution found
    there, and at least the softened minimum less what softening can add (soft a voxel).
    """
    soft = 1e-5
    other = minimize(
        lambda x: cost(small, x, soft), np.full(LIKE.data.size, 0.02), jac=True, method="L-BFGS-B",
        bounds=[(0, None)] * LIKE.data.size, options={"maxiter": 3000, "maxfun": 9999},
    )  # fmt: skip
    lower = other.fun - small[2] * soft * LIKE.data.size
    upper = cost(small, other.x)[0]
    assert upper - lower < 2e-3 * upper
    for subsets in (1, 3):
        found = minimise_tv(
            small[1],
            SCAN,
            LIKE,
            weight=1e-2,
            iterations=300,
            tolerance=1e-6,
            subsets=subsets,
        )
        mine = cost(small, found.volume.data.astype(np.float64))[0]
        assert mine == pytest.approx(found.costs[-1], rel=1e-5)
        assert found.strength == pytest.approx(small[2], rel=1e-5)
        assert lower * (1 - 1e-5) <= mine <= upper * (1 + 1e-4)
        assert found.converged


def test_the_minimum_is_that_of_odl(small):
    odl = pytest.importorskip("odl", reason="the extra `odl` is not installed")
    data = small[1]
    cube = Volume(np.zeros(LIKE.shape), 2.0)
    operator = Operator(SCAN, cube, SHAPE)
    found = minimise_tv(data, SCAN, cube, weight=1e-2, iterations=200, tolerance=1e-6)
    project = operator.odl()
    gradient = odl.Gradient(project.domain, method="forward", pad_mode="symmetric")
    both = odl.BroadcastOperator(project, gradient)
    # ODL's gradient is by mm: times the voxel's 2 mm it gives differences.
    parts = odl.functionals.SeparableSum(
        0.5 * odl.functionals.L2NormSquared(project.range).translated(
            project.range.element(data.astype(np.float32))
        ),
        2.0 * found.strength * odl.functionals.GroupL1Norm(gradient.range, 2),
    )  # fmt: skip
    size = 1.1 * np.hypot(operator.norm(), np.sqrt(3.0))
    x = project.domain.zero()
    odl.solvers.pdhg(
        x, odl.functionals.IndicatorNonnegativity(project.domain), parts, both,
        niter=200, tau=0.03 / size, sigma=1 / (0.03 * size),
    )  # fmt: skip
    theirs = minimise_tv(
        data, SCAN, cube, weight=1e-2, iterations=1, start=cube.like(x.asarray())
    ).costs[0]
    assert found.costs[-1] == pytest.approx(theirs, rel=2e-3)


@pytest.mark.parametrize("subsets", [1, 5])
def test_costs_never_rise_and_the_rule_ends_it(small, subsets):
    seen = []
    found = minimise_tv(
        small[1], SCAN, LIKE, subsets=subsets, tolerance=1e-3, watch=seen.append
    )  # fmt: skip
    assert (np.diff(found.costs) <= 0).all()
    assert found.costs[0] == pytest.approx(0.5 * float(np.sum(small[1] ** 2)), rel=1e-6)
    assert found.converged
    assert len(seen) == found.iterations < 100
    gains = -np.diff(found.costs)[-3:] / np.array(found.costs[-3:])
    assert (gains <= 1e-3).all()
    assert repr(found).startswith(
        f"<Minimised: converged after {found.iterations} iterations"
    )
    short = minimise_tv(small[1], SCAN, LIKE, subsets=subsets, iterations=4)
    assert not short.converged
    assert short.iterations == 4


def test_a_warm_start_begins_where_the_other_ended(small):
    first = minimise_tv(small[1], SCAN, LIKE, iterations=15, tolerance=0)
    second = minimise_tv(
        small[1], SCAN, LIKE, iterations=15, tolerance=0, start=first.volume
    )
    assert second.costs[0] == pytest.approx(first.costs[-1], rel=1e-6)
    assert second.costs[-1] < first.costs[-1]


def test_masks_and_signs(small):
    mask = np.zeros(LIKE.shape)
    mask[1:3, 1:4, 2:5] = 1
    found = tv(small[1], SCAN, LIKE, iterations=10, mask=mask).data
    assert (found[mask == 0] == 0).all()
    assert (found[mask == 1] > 0.02).all()
    with pytest.warns(PlausibilityWarning, match="are negative"):
        dark = tv(-abs(small[1]), SCAN, LIKE, iterations=5)
    assert (dark.data == 0).all()
    assert tv(-small[1], SCAN, LIKE, iterations=5, nonnegative=False).data.min() < -0.02
    free = minimise_tv(small[1], SCAN, LIKE, weight=0.0, iterations=30, tolerance=0)
    wanted = cost((*small[:2], 0.0), np.asarray(free.volume.data, np.float64))[0]
    assert free.costs[-1] == pytest.approx(wanted, rel=1e-5)


def test_few_noisy_views_of_few_materials():
    """What it is for: 20 views of an object of few materials (the study `tv_weights.py`)."""
    by_fdk, by_sirt, default = tv_weights.errors(20, 0.03, 32, weights=(0.01,))
    assert default < 0.4 * by_fdk
    assert default < 0.8 * by_sirt


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [({"weight": -1.0}, LimitError, "weight -1; allowed: 0 or more"),
     ({"tolerance": float("nan")}, LimitError, "tolerance nan"),
     ({"subsets": 0}, LimitError, "subsets 0; allowed: 1"),
     ({"mask": np.ones((2, 2, 2))}, GeometryError, "the mask of shape")],
)  # fmt: skip
def test_arguments_out_of_their_range(small, options, error, text):
    with pytest.raises(error, match=text):
        tv(small[1], SCAN, LIKE, **options)
