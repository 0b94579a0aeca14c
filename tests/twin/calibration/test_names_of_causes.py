"""Every cause of residuals: it is registered, has words, and is found where it is planted."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import replace

import numpy as np
import pytest

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose.table import groups
from flexdt.twin.calibration.diagnose.table.explained import explained
from flexdt.twin.calibration.diagnose.table.group import (
    NAMED_LOG_ODDS,
    Acts,
    Family,
    Known,
)
from flexdt.twin.calibration.diagnose.table.groups import CAUSES, every_family
from flexdt.twin.calibration.diagnose.table.linearised import (
    PER_FRAME,
    Linearised,
    State,
    with_every_column,
)
from flexdt.twin.calibration.diagnose.table.posterior import Search
from flexdt.twin.calibration.diagnose.table.products import Products
from flexdt.twin.calibration.fit.certificate import SOURCES
from flexdt.twin.calibration.fit.fit import FitResult, estimate_geometry
from flexdt.twin.geometry.poses import Poses

BEADS = np.array([[9, 4, -20], [-10, 6, -9], [4, -11, 1], [-3, 10, 12], [11, -2, 21.0]])
SHAPE = (760, 956)
KNOWN = Known((1e-3, 1e-3), None, 1e-3, sampling_px=0.001)
NOISE_PX = 0.01
FRAMES = 16
ALIKE = {
    # A phantom that grows is one that comes nearer; angles off by a factor are a turn.
    "growth": {"motion"},
    "angle scale": {"motion"},
    # Of a few beads, places of all are those of each, and any smooth map is near.
    "strain": {"beads"},
    "bend": {"beads", "strain"},
    "beads": {"bend"},
    # An arc draws a turning phantom in.
    "arc": {"strain"},
    # A rise that is told wrong is an object that rises.
    # Millimetres of the motors against those of the phantom, which may be stretched.
    "told": {"motion", "strain"},
}
"""Cause -> causes that explain the same."""


@pytest.fixture(scope="module")
def fit() -> FitResult:
    """Of a right helix, whose rise is told."""
    turn = np.linspace(0.0, 2.0 * np.pi, FRAMES, endpoint=False)
    stage = np.stack([0 * turn, 0 * turn + 600.0, 2.0 * turn], axis=1)
    poses = Poses.upright([0, 0, 0], stage, [0, 1059, 0], 0.1496, turn)
    tracks = poses.cone_vec().project_points(BEADS, SHAPE)
    tracks = tracks + NOISE_PX * np.random.default_rng(0).normal(size=tracks.shape)
    beads = BeadModel(BEADS, np.full(5, 0.5))
    return estimate_geometry(
        tracks, beads, poses, shape=SHAPE, strain=(1e-3, 1e-3),
        priors={"travel_y": 1e-4, "phantom": 1e-3},
        common_px=0.001 * np.ones((FRAMES, 5, 2, 1)),
    )  # fmt: skip


def table_of(fit: FitResult) -> Linearised:
    _, x = with_every_column(fit.problem, fit.solution.x)
    shift = np.zeros((*fit.problem.seen.shape, 2))
    return Linearised(fit.problem, State(x, {}, shift), KNOWN.floor)


def test_every_module_of_a_cause_is_registered(fit: FitResult) -> None:
    files = [m.name for m in pkgutil.iter_modules(groups.__path__)]
    modules = [importlib.import_module(f"{groups.__name__}.{name}") for name in files]
    assert {module.NAME for module in modules} == {c.name for c in CAUSES}
    assert len(files) == len(CAUSES)
    made = {f.cause for f in every_family(table_of(fit), KNOWN)}
    assert made == {c.name for c in CAUSES}
    assert all(c.words for c in CAUSES)


def test_every_column_of_a_fit_has_its_source_in_words(fit: FitResult) -> None:
    every = with_every_column(fit.problem, fit.solution.x)[0].layout
    names = every.names[fit.problem.layout.parameter_count :]
    assert {name.split()[0] for name in names} == set(SOURCES)


def test_names_of_groups_are_unique_and_rows_have_one_length(fit: FitResult) -> None:
    table = table_of(fit)
    families = every_family(table, KNOWN)
    names = [name for f in families for name in f.names]
    assert len(set(names)) == len(names)
    products = Products(table, families)
    for f in families:
        if f.acts is Acts.FRAMES and f.slopes is not None:
            for g, place in enumerate(f.places):
                moved = [PER_FRAME[i] for i in f.slopes[g % len(f.slopes)]]
                assert isinstance(place, tuple)
                assert moved == list(place[0]), f.names[g]
    for i, f in enumerate(families):
        assert products.own(i).shape[0] == len(f.names) == len(f.places)
        for g in (0, len(f.names) - 1):
            rows = products.rows(i, g)
            assert rows.shape[0] == len(table.values)
            square = rows.T @ rows / products.units[i][g] ** 2
            assert products.own(i)[g] == pytest.approx(square, abs=1e-9)
            columns = products.block(np.arange(len(rows), dtype=float)[:, None])
            crossed = rows.T @ products.columns(columns) / products.units[i][g]
            assert products.cross(i, columns)[g] == pytest.approx(crossed, rel=1e-9)


def middle(family: Family) -> int:
    return len(family.names) // 2


@pytest.mark.parametrize(
    "cause", [c.name for c in CAUSES if c.name not in ("positions", "spots")]
)
def test_a_planted_cause_is_found(cause: str, fit: FitResult) -> None:
    """One group of it shifts the positions by 50 times their noise, or as far as it may."""
    table = table_of(fit)
    families = every_family(table, KNOWN)
    products = Products(table, families)
    rng = np.random.default_rng(3)
    number = next(i for i, f in enumerate(families) if f.cause == cause and not f.always)
    group = middle(families[number])
    rows = products.rows(number, group)
    weights = np.abs(rng.normal(size=rows.shape[1]))
    shift = rows @ weights
    # What the geometry takes up is no evidence.
    base = table.geometry
    rest = shift - base @ np.linalg.lstsq(base, shift, rcond=1e-9)[0]
    size = 50 * NOISE_PX / np.sqrt(np.mean(rest**2))
    shift *= min(size, families[number].widest / weights.max())
    moved = fit.problem.measured + table.shift_of(shift)
    found = explained(replace(fit, problem=replace(fit.problem, measured=moved)), KNOWN)
    alike = {cause, *ALIKE.get(cause, ())}
    every = found.posterior.families
    names = [found.posterior.name(g) for g in found.weights]
    assert {every[f].cause for f, _ in found.weights} & alike, names
    groups_of = [g for p in found.posterior.parts for g in p.groups]
    odds = found.posterior.odds(g for g in groups_of if every[g[0]].cause in alike)
    assert odds > NAMED_LOG_ODDS, names


def test_a_tile_is_found_beside_beads_that_are_out_of_place(fit: FitResult) -> None:
    table = table_of(fit)
    families = every_family(table, KNOWN)
    products = Products(table, families)
    shift = np.zeros((*fit.problem.seen.shape, 2))
    for cause, size in (("beads", 0.3), ("tiles", 0.5)):
        number = next(
            i
            for i, f in enumerate(families)
            if f.cause == cause and f.places[0] is not None and len(f.names) > 1
        )
        rows = products.rows(number, middle(families[number]))
        own = table.shift_of(rows @ np.ones(rows.shape[1]))
        shift += size * own / np.abs(own).max()
    moved = replace(fit.problem, measured=fit.problem.measured + shift)
    found = explained(replace(fit, problem=moved), KNOWN)
    causes = {found.posterior.families[f].cause for f, _ in found.weights}
    assert causes >= {"beads", "tiles"}, causes
    assert found.fit.problem.panel is not None
    assert found.fit.problem.panel.borders


@pytest.mark.parametrize("cause", ["angle scale", "rows", "panel", "spots"])
def test_evidence_differs_as_densities_do(fit: FitResult, cause: str) -> None:
    """Of a model with a group and of one without: the normal densities of the values, written
    out, in directions that columns without a prior leave alone."""
    table = table_of(fit)
    some = [f for f in every_family(table, KNOWN) if f.cause == cause]
    search = Search(table, some, 0.0)
    group = (0, 0)
    noise2 = NOISE_PX**2
    flat = table.precision == 0.0
    left = np.linalg.svd(table.geometry[:, flat])[0][:, flat.sum() :]
    rest = table.geometry[:, ~flat]
    off = left.T @ (table.values - rest @ table.mean[~flat])
    stated = left.T @ rest / np.sqrt(table.precision[~flat])
    own = left.T @ search.products.rows(*group) / search.products.units[0][0]

    def density(width2: float) -> float:
        covariance = noise2 * np.eye(len(off)) + stated @ stated.T + width2 * own @ own.T
        square = off @ np.linalg.solve(covariance, off)
        return float(-0.5 * (np.linalg.slogdet(covariance)[1] + square))

    without, beside = (
        search._evidence(search.solve(widths, noise2, 0), noise2)
        for widths in ({}, {group: noise2})
    )
    gain = density(noise2) - density(0.0)
    assert beside - without == pytest.approx(gain, rel=1e-5, abs=1e-5)
