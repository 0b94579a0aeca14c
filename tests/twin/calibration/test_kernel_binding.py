"""`evaluate` says what `Poses.cone_vec` says, and every flipped sign in it is caught.

Offsets meet geometry twice: in `Poses.cone_vec`, for everything that is projected, and in the
fit's compiled kernel, which needs derivatives. Random off-nominal cases bind the second to the
first for all seventeen parameters and the told lengths, values and derivatives.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexdt.twin.calibration.fit import fit_kernels
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NAMES, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.told_lengths import PARAMETERS

SHAPE = (60, 80)
FRAMES, BEADS = 3, 2
BIAS = 0.8
HUBER = 1.5
UNUSED = (1, 1)  # frame, bead
COUNT = len(PARAMETERS)


@dataclass(frozen=True, eq=False)
class Case:
    """Poses without any symmetry, all seventeen offsets, beads, a distorted panel, and
    observations nearby."""

    poses: Poses
    offsets: Offsets
    told: np.ndarray
    pivot: float
    middle: np.ndarray
    beads: np.ndarray
    radius: np.ndarray
    measured: np.ndarray
    whiten: np.ndarray
    terms: np.ndarray
    panel: np.ndarray


def case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(5, FRAMES, 3))
    poses = Poses(
        source=5.0 * noise[0],
        axis=[30.0, 500.0, -20.0] + 8.0 * noise[1],
        detector=[-15.0, 1000.0, 12.0] + 8.0 * noise[2],
        u=[0.9, 0.2, -0.3] + 0.1 * noise[3],
        v=[-0.2, 0.3, -1.1] + 0.1 * noise[4],
        angle=rng.uniform(-9.0, 9.0, FRAMES),
        mount=np.random.default_rng([seed, 1]).uniform(-6.0, 6.0, (FRAMES, 3))
        * [1.0, 1.0, 0.0],
    )
    values = rng.uniform(0.1, 0.4, len(NAMES)) * rng.choice([-1.0, 1.0], len(NAMES))
    lengths = [
        i
        for i, name in enumerate(NAMES)
        if name[0] in "dt" and not name.startswith("det")
    ]
    values[lengths] *= 20.0
    values[-1] = 1.0 + 0.1 * values[-1]
    case = Case(
        poses, Offsets(*values), 0.1 * rng.uniform(0.5, 1.0, COUNT - len(NAMES)),
        float(seed % 2), np.random.default_rng([seed, 2]).uniform(-30.0, 30.0, 3),
        rng.uniform(-30.0, 30.0, (BEADS, 3)),
        rng.uniform(20.0, 40.0, BEADS), np.empty(0), rng.uniform(0.2, 0.7, (FRAMES, BEADS, 3)),
        rng.normal(size=(FRAMES, BEADS, 2, 2)), np.array([0.7, -1.2]),
    )  # fmt: skip
    # Residuals on both sides of the Huber threshold.
    off = rng.normal(size=(FRAMES, BEADS, 2)) * [[[1.0], [20.0]]]
    return replace(case, measured=expected(case) + off)


def cone_of(case: Case, x: np.ndarray) -> ConeVec:
    p = Offsets(*x[: len(NAMES)])
    if case.pivot == 0.0:  # the other reading of eq. 5.4: the axis stays where it is
        p = replace(p, dO_x=p.dO_x - p.tau_x, dO_z=p.dO_z - p.tau_z)
    told = dict(zip(PARAMETERS[len(NAMES) :], x[len(NAMES) :], strict=True))
    return as_told(case.poses, told).cone_vec(p)


def as_told(poses: Poses, told: dict[str, float]) -> Poses:
    """Poses where told lengths are off by parts, and places by millimetres."""
    # Unity's x, y, z are the world's x, z, y.
    grown = 1.0 + np.array([told[f"travel_{a}"] for a in "xzy"])
    panel = 1.0 + np.array([told[f"panel_travel_{a}"] for a in "xzy"])
    place = np.array([told[f"place_{a}"] for a in "xzy"])

    def stretched(points: np.ndarray, factor: np.ndarray) -> np.ndarray:
        ways = points - poses.source
        return poses.source + ways.mean(axis=0) + factor * (ways - ways.mean(axis=0))

    return replace(
        poses,
        axis=stretched(poses.axis, grown) + place,
        detector=stretched(poses.detector, panel),
        u=poses.u * (1.0 + told["pixel"]),
        v=poses.v * (1.0 + told["pixel"]),
    )


def expected(case: Case, x: np.ndarray | None = None) -> np.ndarray:
    """Spots from the detector's centre [px], (frames, beads, 2), by way of `Poses.cone_vec`."""
    x = columns_of(case) if x is None else x
    grown = 1.0 + x[PARAMETERS.index("phantom")]
    beads = case.middle + grown * (x[COUNT:-2].reshape(-1, 3) - case.middle)
    cone = cone_of(case, x[:COUNT])
    rows, cols = SHAPE
    middle = np.array([(cols - 1) / 2, (rows - 1) / 2])
    points = cone.project_points(beads, SHAPE) - middle
    normal = np.cross(cone.u, cone.v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    depth = np.einsum("nkj,nj->nk", beads[None] - cone.source[:, None], normal)
    # The foot of the perpendicular: the projection of any point straight ahead of the source.
    foot = np.stack(
        [
            cone[i : i + 1].project_points((cone.source + normal)[i : i + 1], SHAPE)[0, 0]
            - middle
            for i in range(FRAMES)
        ]
    )
    stretch = BIAS * (case.radius / depth) ** 2
    return points + stretch[..., None] * (points - foot[:, None]) + case.terms @ x[-2:]


def columns_of(case: Case) -> np.ndarray:
    return np.concatenate(
        [astuple(case.offsets), case.told, case.beads.ravel(), case.panel]
    )


def differences(case: Case) -> np.ndarray:
    """Derivatives of `expected`, (frames, beads, 2, columns), to fourth order in the step."""
    x = columns_of(case)
    out = []
    for i in range(len(x)):
        h = np.zeros_like(x)
        h[i] = 1e-3
        near = expected(case, x + h) - expected(case, x - h)
        far = expected(case, x + 2 * h) - expected(case, x - 2 * h)
        out.append((8 * near - far) / (12 * 1e-3))
    return np.stack(out, axis=-1)


@dataclass(frozen=True, eq=False)
class Reference:
    """What the kernel must give for a case."""

    case: Case
    predicted: np.ndarray
    rows: np.ndarray
    norms: np.ndarray
    cost: float
    grad: np.ndarray
    hess: np.ndarray


def reference(case: Case) -> Reference:
    predicted = expected(case)
    w0, w1, w2 = np.moveaxis(case.whiten, -1, 0)
    zero = np.zeros_like(w0)
    whiten = np.stack([np.stack([w0, w1], -1), np.stack([zero, w2], -1)], -2)
    rows = whiten @ differences(case)
    r = np.einsum("nkij,nkj->nki", whiten, predicted - case.measured)
    length = np.linalg.norm(r, axis=-1)
    used = np.ones_like(length, dtype=bool)
    used[UNUSED] = False
    weight = np.where(used, np.minimum(1.0, HUBER / length), 0.0)
    cost = np.where(length <= HUBER, 0.5 * length**2, HUBER * (length - 0.5 * HUBER))[
        used
    ].sum()
    return Reference(
        case, predicted, np.where(used[..., None, None], rows, 0.0),
        np.where(used, length, -1.0), float(cost),
        np.einsum("nk,nkij,nki->j", weight, rows, r),
        np.einsum("nk,nkij,nkil->jl", weight, rows, rows),
    )  # fmt: skip


def check(kernels: object, want: Reference) -> None:
    """Compare a kernel's outputs with the reference."""
    case, poses = want.case, want.case.poses

    def ways(points: np.ndarray) -> np.ndarray:
        return (points - poses.source) - (points - poses.source).mean(axis=0)

    geometry = np.column_stack(
        [
            poses.source,
            poses.axis,
            poses.detector,
            poses.u,
            poses.v,
            poses.angle,
            poses.mount[:, :2],
            ways(poses.axis),
            ways(poses.detector),
        ]
    )
    columns = COUNT + 3 * BEADS + 2
    use = np.ones((FRAMES, BEADS), dtype=bool)
    use[UNUSED] = False
    for mode in (2, 1):
        predicted = np.empty((FRAMES, BEADS, 2))
        norms = np.empty((FRAMES, BEADS))
        jac = np.zeros((2 * FRAMES * BEADS, columns))
        hess, grad = np.zeros((columns, columns)), np.zeros(columns)
        data = fit_kernels.Data(
            geometry, np.zeros(FRAMES, np.int64), case.pivot, case.middle, case.radius,
            np.full((FRAMES, BEADS), BIAS), case.measured, case.whiten,
            np.arange(COUNT), np.arange(COUNT)[None], COUNT,
            case.terms,
        )  # fmt: skip
        cost = kernels.evaluate(  # type: ignore[attr-defined]
            data, np.array([[*astuple(case.offsets), *case.told]]), case.beads, case.panel,
            use, HUBER, mode, predicted, norms, jac, hess, grad,
        )  # fmt: skip
        assert_allclose(predicted, want.predicted, rtol=1e-9, atol=1e-9)
        assert_allclose(norms, want.norms, rtol=1e-9, atol=1e-9)
        assert_allclose(cost, want.cost, rtol=1e-9)
        if mode == 2:
            scale = np.abs(want.rows).max(axis=(0, 1, 2))
            assert_allclose(
                jac.reshape(want.rows.shape) / scale, want.rows / scale, atol=1e-8
            )
        else:
            scale = np.sqrt(np.diag(want.hess))
            assert_allclose(grad / scale, want.grad / scale, atol=1e-7)
            assert_allclose(hess / np.outer(scale, scale), want.hess / np.outer(scale, scale),
                            atol=1e-7)  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
def test_values_and_derivatives_are_those_of_cone_vec(seed: int) -> None:
    check(fit_kernels, reference(case(seed)))


FUNCTIONS = (
    "_dot", "_cross", "_wave", "_unit", "_turned", "panel_rows", "panel_slopes",
    "object_columns", "object_slopes", "evaluate",
)  # fmt: skip
OPPOSITE = {ast.Add: ast.Sub, ast.Sub: ast.Add}


def flips(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Every sign in the geometry of the kernel: (its line, the node that has it).

    A sign is a + or -, a minus before a value, or an offset `p[NAME]` that is added without
    one. Arithmetic of indices (inside brackets and `range`) has none, nor has a cosine's
    argument.
    """

    def walk(node: ast.AST) -> Iterator[ast.AST]:
        if isinstance(node, ast.Compare):
            return  # p[ROLL] != 0.0
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("range", "math.cos"):
            return  # a cosine does not see the sign of its argument
        yield node
        children = (
            [node.value]
            if isinstance(node, ast.Subscript)
            else ast.iter_child_nodes(node)
        )
        for child in children:
            yield from walk(child)

    for function in tree.body:
        if isinstance(function, ast.FunctionDef) and function.name in FUNCTIONS:
            for node in walk(function):
                operator = type(getattr(node, "op", None))
                offset = (
                    isinstance(node, ast.Subscript) and ast.unparse(node.value) == "p"
                )
                if operator in (ast.Add, ast.Sub, ast.USub) or offset:
                    yield ast.unparse(node), node


class Negated(ast.NodeTransformer):
    """The tree with one sign turned round."""

    def __init__(self, target: ast.AST) -> None:
        self.target = target

    def visit(self, node: ast.AST) -> ast.AST:
        if node is not self.target:
            return self.generic_visit(node)
        match node:
            case ast.BinOp(left, op, right):
                return ast.BinOp(left, OPPOSITE[type(op)](), right)
            case ast.AugAssign(target, op, value):
                return ast.AugAssign(target, OPPOSITE[type(op)](), value)
            case ast.UnaryOp(_, operand):
                return operand
        return ast.UnaryOp(ast.USub(), node)


def module_of(tree: ast.Module) -> object:
    """The kernels as plain Python: a hundred compilations would take an hour."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            node.decorator_list = []
    names: dict[str, object] = {}
    exec(compile(ast.fix_missing_locations(tree), "flipped kernels", "exec"), names)
    return SimpleNamespace(**names)


@pytest.mark.slow
def test_every_flipped_sign_is_caught() -> None:
    source = inspect.getsource(fit_kernels)
    wanted = [reference(case(seed)) for seed in (0, 1)]
    for want in wanted:
        check(module_of(ast.parse(source)), want)  # as it stands it agrees
    total = sum(1 for _ in flips(ast.parse(source)))
    assert total > 120
    survivors = []
    for i in range(total):
        tree = ast.parse(source)
        text, node = list(flips(tree))[i]
        kernels = module_of(Negated(node).visit(tree))
        try:
            for want in wanted:
                check(kernels, want)
        except (AssertionError, IndexError, ValueError, ZeroDivisionError):
            continue
        survivors.append(f"line {getattr(node, 'lineno', 0)}: {text}")
    print(f"{total - len(survivors)} of {total} flipped signs are caught")
    assert survivors == []
