"""The kernels against `Poses.cone_vec` and against finite differences of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenarios import SHAPE, exact_tracks, scenario, spiral
from numpy.testing import assert_allclose

from flexdt.twin.calibration import BeadModel, Centre, Reading
from flexdt.twin.calibration.fit.problem import (
    build_problem,
    layout,
    to_printed_reading,
    whitening,
)
from flexdt.twin.calibration.fit.weak_directions import Direction, advise
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.offsets import NAMES, Offsets

RNG = np.random.default_rng(7)


def random_truth(seed: int) -> Offsets:
    rng = np.random.default_rng(seed)
    edge = {n: float(rng.normal()) for n in NAMES}
    edge["angle_scale"] = 1.0 + 0.01 * float(rng.normal())
    return Offsets.from_edge(edge)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("reading", list(Reading))
def test_kernel_projects_as_cone_vec_does(seed: int, reading: Reading) -> None:
    poses, _ = scenario("G2", 7)
    truth = random_truth(seed)
    model = spiral((20, 40, 60), 4)
    tracks = exact_tracks(poses, truth, model)
    problem = build_problem(
        tracks, model, poses, free=NAMES, shape=SHAPE, start=truth, reading=reading
    )
    predicted, norms = problem.predictions(problem.start)
    assert_allclose(predicted, tracks, atol=1e-9)
    assert norms.max() < 1e-9
    back = problem.parameters(problem.start)[0]
    assert_allclose(
        list(back.to_edge().values()), list(truth.to_edge().values()), atol=1e-12
    )


@pytest.mark.parametrize("centre", list(Centre))
@pytest.mark.parametrize("reading", list(Reading))
def test_jacobian_is_the_derivative(centre: Centre, reading: Reading) -> None:
    poses, _ = scenario("G3", 5)
    truth = random_truth(11)
    model = spiral((30, 30, 30), 3, radius=8.0)  # big balls: a visible sphere-centre bias
    tracks = exact_tracks(poses, truth, model)
    covariance = np.empty((5, 3, 2, 2))
    covariance[:] = [[0.04, 0.01], [0.01, 0.09]]
    problem = build_problem(
        tracks, model, poses, free=NAMES, shape=SHAPE, start=truth, reading=reading,
        centre=centre, free_beads=True, covariances=covariance,
        groups=[0, 0, 1, 1, 1], per_group=("alpha", "dD_x"),
    )  # fmt: skip
    x = problem.start
    analytic = problem.jacobian(x)
    w = problem.whiten

    def whitened(value: np.ndarray) -> np.ndarray:
        p = problem.predictions(value)[0]
        return np.stack(
            [w[..., 0] * p[..., 0] + w[..., 1] * p[..., 1], w[..., 2] * p[..., 1]],
            axis=-1,
        ).ravel()

    for j, name in enumerate(problem.layout.names):
        step = np.zeros_like(x)
        step[j] = 1e-4
        numeric = (
            8 * (whitened(x + step) - whitened(x - step))
            - (whitened(x + 2 * step) - whitened(x - 2 * step))
        ) / (12 * 1e-4)
        assert_allclose(
            analytic[:, j],
            numeric,
            atol=2e-8 * max(1.0, np.abs(numeric).max()),
            err_msg=name,
        )


def test_sphere_centre_bias_against_the_outline_of_a_cone() -> None:
    """The outline's ellipse, from tangent rays by hand, against Centre.OUTLINE."""
    poses, _ = scenario("G0", 1)
    centre, radius = np.array([22.0, -30.0, 25.0]), 6.0
    cone = poses.cone_vec()
    source = cone.source[0]
    axis = centre - source
    distance = np.linalg.norm(axis)
    axis = axis / distance
    half = np.arcsin(radius / distance)
    e1 = np.cross(axis, [0.0, 0.0, 1.0])
    e1 = e1 / np.linalg.norm(e1)
    e2 = np.cross(axis, e1)
    t = np.linspace(0, 2 * np.pi, 720, endpoint=False)[:, None]
    rays = np.cos(half) * axis + np.sin(half) * (np.cos(t) * e1 + np.sin(t) * e2)
    outline = cone.project_points(source + rays * distance, SHAPE)[0]
    # Least-squares conic through the outline; its centre is where the gradient vanishes.
    x, y = (outline - outline.mean(axis=0)).T
    a, b, c, d, e = np.linalg.lstsq(
        np.stack([x * x, x * y, y * y, x, y], axis=1), np.ones_like(x), rcond=None
    )[0]
    middle = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e]) + outline.mean(axis=0)
    model = BeadModel(centre[None], np.array(radius))
    point = cone.project_points(centre[None], SHAPE)
    problem = build_problem(
        point, model, poses, free=("dO_x",), shape=SHAPE, centre=Centre.OUTLINE
    )
    shadow = problem.predictions(problem.start)[0][0, 0]
    assert np.linalg.norm(shadow - point[0, 0]) > 0.01
    assert_allclose(
        shadow, middle, atol=2e-4 * np.linalg.norm(shadow - point[0, 0]) + 1e-6
    )


def test_the_two_readings_convert_exactly() -> None:
    p = random_truth(3)
    mount = to_printed_reading(p, Reading.MOUNT_SHIFT)
    assert mount == replace(p, dO_x=p.dO_x - p.tau_x, dO_z=p.dO_z - p.tau_z)
    assert to_printed_reading(p, Reading.AXIS_AT_O_PLUS_TAU) == p


def test_whitening_makes_unit_variance() -> None:
    c = np.array([[0.5, -0.2], [-0.2, 0.3]])
    w0, w1, w2 = whitening(c[None, None], 1.0, np.ones((1, 1), dtype=bool))[0, 0]
    w = np.array([[w0, w1], [0.0, w2]])
    assert_allclose(w @ c @ w.T, np.eye(2), atol=1e-12)


def test_bad_arguments_are_named() -> None:
    poses, truth = scenario("G0", 4)
    model = spiral((20, 40, 60), 3)
    tracks = exact_tracks(poses, truth, model)
    with pytest.raises(UnknownNameError, match="det_spin"):
        layout(("det_spin",), 1, (), 3, False)
    with pytest.raises(TwinError, match="not among the free"):
        layout(("dO_x",), 2, ("alpha",), 3, False)
    with pytest.raises(TwinError, match="3 x 3 x 2; allowed: 4 x 3 x 2"):
        build_problem(tracks[:3], model, poses, free=("dO_x",), shape=SHAPE)
    with pytest.raises(TwinError, match="positive definite"):
        build_problem(
            tracks,
            model,
            poses,
            free=("dO_x",),
            shape=SHAPE,
            covariances=np.zeros((4, 3, 2, 2)),
        )


def test_the_source_is_held_when_the_gauge_is_open() -> None:
    columns = layout(NAMES, 1, (), 3, False)
    assert "dS_x" not in columns.names
    assert "dS_y" not in columns.names
    assert [name for name, _ in columns.held] == ["dS_x", "dS_y"]
    assert "dS_x" in layout(("dS_x", "dO_x"), 1, (), 3, False).names


def test_advice_for_a_direction_with_beads_in_it_is_about_the_beads() -> None:
    assert "tolerance as a prior" in advise(["dO_z", "bead 0 y", "bead 1 y"], 5)
    assert "further apart" in advise(["dO_z"], 5)
    parts = (("dO_z", 1.0), *((f"bead {k} y", 0.1) for k in range(5)))
    text = Direction(parts, 0.5, "measure").text
    assert "bead 2 y (+0.1 mm) and 2 more per 1 mm" in text
    assert "bead 3" not in text
