"""A fit with what its residuals show: the table made again until it stays, and its certificate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.table.group import Acts, Family, Known
from flexdt.twin.calibration.diagnose.table.groups import (
    bead_places,
    every_family,
    moving,
    spots,
    strain,
    tiles,
    told,
)
from flexdt.twin.calibration.diagnose.table.linearised import (
    Linearised,
    State,
    image_shape,
    motion_of,
    moved,
    with_every_column,
)
from flexdt.twin.calibration.diagnose.table.posterior import (
    Further,
    Group,
    Model,
    Posterior,
    Search,
)
from flexdt.twin.calibration.fit.certificate import Certificate, Rival, certify, widened
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import (
    STRAINS,
    STRETCHES,
    ColumnLayout,
    FitProblem,
    edge_factors,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border, PanelModel

MOST_TABLES: Final = 10
"""Tables that are made one after another, at most."""
SETTLED_PART: Final = 0.1
"""Root mean square change of the predicted positions, in standard deviations of their noise, at
which a table stays."""
HALVINGS: Final = 30
"""Of a step that leaves what is possible; after so many nothing of it is left in float64."""
LEAST_RIVAL: Final = 1e-4
"""Least probability of an explanation that is kept by itself."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A fit, and what its residuals show.

    Attributes:
        fit: of the geometry with the groups of `posterior.best`.
        posterior: over what is there.
        table: the last one.
        weights: group of the best model -> its weights, in their own unit.
        strain: of the phantom, (10,) in the order of STRAINS, and its covariance.
        moves_px: group -> root mean square of the shift that it makes, less what the geometry
            would take up of it [px].
        held: groups of the best model that are assumed.
        search: of the last table.
        further: what groups would add to the best model.
        state: what the best model makes of it.
    """

    fit: FitResult
    posterior: Posterior
    table: Linearised
    weights: dict[Group, FloatArray]
    strain: tuple[FloatArray, FloatArray] | None
    moves_px: dict[Group, float]
    held: frozenset[Group]
    search: Search
    further: Mapping[int, Further]
    state: State

    def of(self, cause: str) -> list[Group]:
        """List the groups of a cause that the best model has."""
        families = self.posterior.families
        return [g for g in self.weights if families[g[0]].cause == cause]

    def course(self, group: Group) -> FloatArray:
        """Return the course of each slope of a group over the frames, (s, n)."""
        family = self.posterior.families[group[0]]
        assert family.courses is not None
        assert family.slopes is not None
        own = family.courses[group[1] // len(family.slopes)]
        return np.asarray(own @ self.weights[group])


def explained(fit: FitResult, known: Known) -> Explained:
    """Explain the residuals of a fit by groups of columns.

    Args:
        fit: determined; without groups.
        known: statements on the phantom and the positions.
    """
    plain = told.with_pitch(fit.problem, known.pitch)
    _, x = with_every_column(plain, fit.solution.x)
    state = State(x, {}, np.zeros((*plain.seen.shape, 2)))
    widths: dict[str, float] = {}
    factor = 0
    noise2 = 0.0
    before: set[tuple[frozenset[str], int]] = set()
    for turn in range(MOST_TABLES):
        table = Linearised(plain, state, known.floor)
        some = every_family(table, known)
        search = Search(table, some, plain.expected_spread)
        at = {
            name: (i, g)
            for i, f in enumerate(some)
            if not f.always
            for g, name in enumerate(f.names)
        }
        start = {
            at[name]: width * float(search.products.units[at[name][0]][at[name][1]]) ** 2
            for name, width in widths.items()
            if name in at
        }
        model = search.model(start, noise2 or table.spread**2, factor)
        if turn or not start:
            model, further = search.climbed(model)
        names = frozenset(_name(some, g) for g in model.widths)
        step = table.geometry @ model.solved.mean[: table.parameters]
        change = math.sqrt(float(step @ step) / max(table.count, 1.0))
        state = _stepped(search, model, state)
        widths = {
            _name(some, g): w / float(search.products.units[g[0]][g[1]]) ** 2
            for g, w in model.widths.items()
        }
        noise2 = model.noise2
        factor = model.factor
        settled = change < SETTLED_PART * math.sqrt(noise2) or change < known.floor**2
        # Tables that name one of two in turn go on for ever; the mixture has both.
        if settled and (not names or (names, factor) in before):
            break
        before.add((names, factor))
    held = {
        at[name]: 0.0
        for name in _never_exact(table, known)
        if name in at and at[name] not in model.widths
    }
    for name, width in moving.apart(_courses(search, model)).items():
        if width > 0.0 and name in at and at[name] not in model.widths:
            held[at[name]] = width
    for group, width in held.items():
        model = search.with_open(model, further, group, width)
        further = search.further(model)
    if held:
        state = _stepped(search, model, table.state)
    posterior = search.mixture(model, further)
    return _made(fit, search, posterior, further, state, frozenset(held), known)


def _never_exact(table: Linearised, known: Known) -> tuple[str, ...]:
    """Name the groups that are there however little the residuals show of them: places of so
    few beads that any displacement is a strain. No phantom has its beads exactly in place."""
    few = table.k <= bead_places.MOST_STRAINED and known.bead_tolerance_mm is None
    return (bead_places.ALL,) if few else ()


def _name(families: Sequence[Family], group: Group) -> str:
    return families[group[0]].names[group[1]]


def _group_weights(
    search: Search, mean: FloatArray, groups: Sequence[Group]
) -> dict[Group, FloatArray]:
    """Split the weights of a model, in the groups' own units."""
    out = {}
    at = search.base_count
    for f, g in groups:
        count = search.products.own(f).shape[1]
        out[f, g] = mean[at : at + count] / search.products.units[f][g]
        at += count
    return out


def _courses(search: Search, model: Model) -> Iterator[tuple[object, FloatArray]]:
    """Yield the place of each group of motion of a model, and its course over the frames."""
    groups = tuple(model.widths)
    for (f, g), weights in _group_weights(search, model.solved.mean, groups).items():
        family = search.products.families[f]
        if family.cause == moving.NAME:
            assert family.courses is not None
            assert family.slopes is not None
            course = family.courses[g // len(family.slopes)][0] @ weights
            yield family.places[g], course


def _stepped(search: Search, model: Model, before: State) -> State:
    """Return the state that a model makes of the one before; of a step that would bring a bead
    behind the source, half, a quarter and so on.
    """
    mean = model.solved.mean
    for _ in range(HALVINGS):
        state = _state(search, mean, tuple(model.widths), before)
        problem, x = moved(search.table.plain, state)
        if np.isfinite(problem.evaluate(x, problem.seen, 0)[0]):
            return state
        mean = mean / 2.0
    return before


def _state(
    search: Search, mean: FloatArray, groups: Sequence[Group], before: State
) -> State:
    """Return the state that the weights of a model make.

    Args:
        search: its table.
        mean: weights of all columns of the model.
        groups: of the model.
        before: the state with which the table was made.
    """
    table = search.table
    families = search.products.families
    x = table.problem.start
    x[: table.parameters] = before.x[: table.parameters] + mean[: table.parameters]
    frames: dict[str, FloatArray] = {}
    shift = np.zeros((*table.problem.seen.shape, 2))
    stated = [((f, 0), mean[own]) for f, own in search.always]
    for (f, g), weights in [*stated, *_group_weights(search, mean, groups).items()]:
        family = families[f]
        place = family.places[g]
        if family.acts is Acts.COLUMNS:
            x[np.asarray(place, dtype=np.intp)] += family.at_places(weights)
        elif family.acts is Acts.FRAMES:
            assert family.courses is not None
            assert isinstance(place, tuple)
            assert family.slopes is not None
            courses = family.courses[g // len(family.slopes)] @ weights
            for name, course in zip(place[0], courses, strict=True):
                frames[name] = frames.get(name, 0.0) + course
        elif not family.always:
            shift += table.shift_of(search.products.rows(f, g) @ weights)
    found = tuple(families[f].places[g] for f, g in groups)
    return State(x, frames, shift, found, tiles.torn(table, found))


def _made(
    fit: FitResult,
    search: Search,
    posterior: Posterior,
    further: Mapping[int, Further],
    state: State,
    held: frozenset[Group],
    known: Known,
) -> Explained:
    """Make the fit with the groups of the best model, with the posterior's covariance."""
    table = search.table
    best = posterior.best
    groups = tuple(best.widths)
    weights = _group_weights(search, best.solved.mean, groups)
    count = table.parameters
    certificate = fit.certificate
    solution = fit.solution
    problem = fit.problem
    strained = fit.strain_prior
    tolerance = fit.bead_prior_mm
    own = math.sqrt(best.noise2)
    if groups:
        # Errors of the spots themselves stay residuals: other fits are compared by them.
        for f, g in groups:
            if search.products.families[f].cause == spots.NAME:
                rows = search.products.rows(f, g)
                own_shift = table.shift_of(rows @ weights[f, g])
                state = replace(state, shift=state.shift - own_shift)
        whole = replace(problem, seen=problem.seen & (table.weight > 0))
        problem, x = _with_groups(whole, search, posterior, state)
        use = problem.seen & (table.lengths <= 5.0 * max(own, known.floor))
        solution = replace(solution, x=x, use=use)
        certificate = certify(problem, x, use, max(own, 1e-4), known.sampling_px,
                              certificate.spectrum.bound)  # fmt: skip
        named = {posterior.name(g): best.widths[g] for g in groups}
        if any(name in named for name in strain.SHAPES):
            strained = tuple(
                max(fit.strain_prior[i], _own_width(search, posterior, name))
                for i, name in enumerate(strain.SHAPES)
            )  # type: ignore[assignment]
        tolerance = max([tolerance, *(
            _largest(search, posterior, (f, g))
            for f, g in _on(posterior, table.problem.layout.bead_columns)
            if np.ptp(np.asarray(posterior.families[f].places[g])) > 2  # of many beads
        )])  # fmt: skip
    factor = edge_factors(problem.layout.names[:count])
    unit = np.outer(factor, factor)
    rivals = _rivals(posterior, factor, best.solved.mean[:count])
    wide = sum(r.weight * (r.covariance + np.outer(r.off, r.off)) for r in rivals)
    freedom = max(table.count + search.freedom - count, 1.0)
    certificate = _stated(
        replace(certificate, dof=freedom, enlargement=1.0),
        np.asarray(wide),
        told.at_told_pitch(best.solved.covariance[:count, :count], problem, known) * unit,
        rivals,
    )
    groups_at = problem.parameters(solution.x)
    made = replace(
        fit,
        parameters=groups_at[0],
        group_parameters=groups_at,
        beads=problem.spread(solution.x)[1],
        certificate=certificate,
        problem=problem,
        solution=solution,
        bead_prior_mm=tolerance,
        strain_prior=strained,
    )
    return Explained(
        made, posterior, table, weights, _strain(search, posterior),
        {g: _effect(search, best, g, weights[g]) for g in groups}, held, search,
        further, state,
    )  # fmt: skip


def _own_width(search: Search, posterior: Posterior, name: str) -> float:
    """Return the width of a named group of the best model in its own unit; 0 without it."""
    for (f, g), width in posterior.best.widths.items():
        if posterior.name((f, g)) == name:
            return math.sqrt(width) / float(search.products.units[f][g])
    return 0.0


def _rivals(
    posterior: Posterior, factor: FloatArray, at: FloatArray
) -> tuple[Rival, ...]:
    """List the explanations about the best one's values, those of little weight as one."""
    unit = np.outer(factor, factor)
    kept = []
    rest = 0.0
    small = np.zeros_like(unit)
    for part in posterior.parts:
        off = (part.mean - at) * factor
        covariance = part.covariance * unit
        if part.weight >= LEAST_RIVAL:
            kept.append(Rival(part.weight, off, covariance))
        else:
            rest += part.weight
            small += part.weight * (covariance + np.outer(off, off))
    if rest > 0.0:
        kept.append(Rival(rest, np.zeros(len(at)), small / rest))
    return tuple(kept)


def _stated(
    certificate: Certificate,
    wide: FloatArray,
    own: FloatArray,
    rivals: tuple[Rival, ...],
) -> Certificate:
    """Return a certificate that states another covariance.

    `certificate`: of the fit by itself; `wide`: (p, p) of the mixture, edge units; `own`: (p, p)
    of the best model; `rivals`: its explanations.
    """
    out = widened(certificate, wide - certificate.covariance)
    sigma = np.sqrt(np.maximum(np.diag(own), 0.0))
    return replace(
        out,
        rivals=rivals if len(rivals) > 1 else (),
        own=dict(zip(out.estimates, sigma.tolist(), strict=True)),
    )


def _with_groups(
    plain: FitProblem, search: Search, posterior: Posterior, state: State
) -> tuple[FitProblem, FloatArray]:
    """Return the problem of a fit with those columns that groups of the best model have, and
    the values of its columns; what the other groups do is taken out of its positions, so that
    its poses are those of each scan's mean.
    """
    every, x = moved(plain, state)
    if state.frames:
        still = replace(
            every, poses=motion_of(_of_scans(plain, state)).applied(plain.poses)
        )
        motion = every.predictions(x)[0] - still.predictions(x)[0]
        every = replace(still, measured=every.measured - motion)
    names = {posterior.name(g) for g in posterior.best.widths}
    old = plain.layout
    count = old.parameter_count
    layout = every.layout
    bent = "panel" in names
    borders = tuple(
        border
        for g in posterior.best.widths
        if posterior.families[g[0]].cause == tiles.NAME
        and isinstance(border := posterior.families[g[0]].places[g[1]], Border)
    )
    free_beads = old.bead_column >= 0 or bool(_on(posterior, layout.bead_columns))
    strained = old.strain_column >= 0 or any(n in names for n in strain.SHAPES)
    arc, rows = (old_ >= 0 or n in names for n, old_ in
                 (("arc", old.arc_column), ("rows", old.rows_column)))  # fmt: skip
    panel = None
    terms: FloatArray = np.zeros(0)
    shape = image_shape(plain)
    if shape is not None and (bent or borders):
        width = _own_width(search, posterior, "panel")
        panel = PanelModel(max(width, 1e-4), shape, borders)
        gaps = np.concatenate([np.zeros(0), *(
            _gap(search, posterior, b) for b in borders
        )])  # fmt: skip
        terms = np.concatenate([x[layout.panel_column :], gaps])
    keep = [
        *range(count),
        *(range(*_ends(layout.bead_columns)) if free_beads else ()),
        *(range(*_ends(layout.strain_columns)) if strained else ()),
        *([layout.arc_column] if arc else ()),
        *([layout.rows_column] if rows else ()),
    ]
    columns = _layout_of(old, [layout.names[i] for i in keep], panel)
    assert every.turning is not None
    turning = None
    if arc or rows:
        turning = every.turning[..., [arc, *[rows] * (every.turning.shape[3] - 1)]]
    widths = _widths(plain, search, posterior, keep, layout.names)
    # A tile is a column of the problem now.
    shifted = every.measured
    if borders and panel is not None:
        gap_terms = panel.terms(plain.measured + plain.origin[:, None, :])[
            ..., -2 * len(borders) :
        ]
        shifted = (
            every.measured
            + gap_terms @ terms[-2 * len(borders) :] * every.seen[..., None]
        )
    means = np.concatenate(
        [plain.prior_mean[:count], plain.model.beads.ravel() if free_beads else [],
         np.zeros(len(keep) - count - 3 * len(plain.model) * free_beads + len(terms))]
    )  # fmt: skip
    problem = replace(
        every,
        layout=columns,
        measured=np.ascontiguousarray(shifted),
        panel=panel,
        turning=turning,
        prior_mean=means,
        prior_sigma=np.concatenate([widths, panel.sigmas if panel else []]),
    )
    return problem, np.concatenate([x[keep], terms])


def _of_scans(plain: FitProblem, state: State) -> dict[str, FloatArray]:
    """Return the deviations of frames that all frames of a scan share, as in `State`."""
    group = plain.group
    count = np.bincount(group)
    return {
        name: (np.bincount(group, off) / count)[group]
        for name, off in state.frames.items()
    }


def _ends(columns: slice) -> tuple[int, int]:
    return columns.start, columns.stop


def _layout_of(
    old: ColumnLayout, names: Sequence[str], panel: PanelModel | None
) -> ColumnLayout:
    """Return a layout with the parameters of another, and further columns.

    Args:
        old: of the parameters.
        names: of all columns but the panel's.
        panel: its terms follow.
    """

    def first(begin: str) -> int:
        """Return the first column whose name begins so; -1 without."""
        return next((i for i, n in enumerate(names) if n.split(" ")[0] == begin), -1)

    terms = () if panel is None else tuple(f"panel {term}" for term in panel.names)
    return replace(
        old,
        names=(*names, *terms),
        bead_column=first("bead"),
        strain_column=first("strain"),
        arc_column=first("arc"),
        rows_column=first("rows"),
        panel_column=len(names),
    )


def _widths(
    plain: FitProblem,
    search: Search,
    posterior: Posterior,
    keep: Sequence[int],
    names: Sequence[str],
) -> FloatArray:
    """Return the widths of the priors of kept columns: of the fit, else of the groups."""
    out = []
    own = dict(zip(plain.layout.names, plain.prior_sigma.tolist(), strict=True))
    groups = {
        "bead": max((_largest(search, posterior, g) for g in
                     _on(posterior, search.table.problem.layout.bead_columns)), default=0.0),
        "arc": _own_width(search, posterior, "arc"),
        "rows": _own_width(search, posterior, "rows"),
    }  # fmt: skip
    shapes = [_own_width(search, posterior, name) for name in strain.SHAPES]
    for at in keep:
        name = names[at]
        kind = name.split(" ")[0]
        if kind == "strain":
            first = STRAINS.index(name.split(" ")[1]) < STRETCHES
            width = math.hypot(own.get(name, 0.0), shapes[0 if first else 1])
        elif kind in groups:
            width = math.hypot(own.get(name, 0.0), groups[kind])
        else:
            width = own[name]
        out.append(max(width, 1e-9))
    return np.array(out)


def _on(posterior: Posterior, columns: slice) -> list[Group]:
    """List the groups of the best model that act on some columns of the fit."""
    return [
        (f, g)
        for f, g in posterior.best.widths
        if posterior.families[f].acts is Acts.COLUMNS
        and columns.start
        <= int(np.min(np.asarray(posterior.families[f].places[g], dtype=np.intp)))
        < columns.stop
    ]


def _largest(search: Search, posterior: Posterior, group: Group) -> float:
    """Return the largest standard deviation of the columns on which a group acts."""
    root = posterior.families[group[0]].root
    size = 1.0 if root is None else float(np.linalg.norm(root, axis=1).max())
    return size * _own_width(search, posterior, posterior.name(group))


def _gap(search: Search, posterior: Posterior, border: Border) -> FloatArray:
    """Return the shift of a tile, (2,) [px]."""
    weights = _group_weights(
        search, posterior.best.solved.mean, tuple(posterior.best.widths)
    )
    for (f, g), weight in weights.items():
        place = posterior.families[f].places[g]
        if isinstance(place, Border) and place == border:
            return weight
    raise AssertionError(border)


def _strain(search: Search, posterior: Posterior) -> tuple[FloatArray, FloatArray] | None:
    """Return the phantom's strain in the best model, in the order of STRAINS, and its
    covariance; None if it has its stated shape.
    """
    solved = posterior.best.solved
    first = search.table.problem.layout.strain_columns.start
    sums = np.zeros((len(STRAINS), len(solved.mean)))
    at = search.base_count
    parts = [((f, 0), own, 1.0) for f, own in search.always]
    for f, g in posterior.best.widths:
        count = search.products.own(f).shape[1]
        unit = float(search.products.units[f][g])
        parts.append(((f, g), slice(at, at + count), 1.0 / unit))
        at += count
    shapes = [p for p in parts if posterior.families[p[0][0]].cause == strain.NAME]
    for (f, g), own, scale in shapes:
        family = posterior.families[f]
        rows = np.asarray(family.places[g], dtype=np.intp) - first
        sums[rows, own] = family.at_places(scale * np.eye(own.stop - own.start))
    if not shapes:
        return None
    return sums @ solved.mean, sums @ solved.covariance @ sums.T


def _effect(search: Search, best: Model, group: Group, weights: FloatArray) -> float:
    """Compute the root mean square shift of the positions by a group, less what the geometry
    takes up of it within its priors [whitened].
    """
    table = search.table
    rows = search.products.rows(*group) @ weights
    base = table.geometry
    normal = base.T @ base + best.noise2 * np.diag(table.precision)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True)
    rest = rows - base @ (scale * (inverse @ (scale * (base.T @ rows))))
    return math.sqrt(float(rest @ rest) / max(table.count, 1.0))
