"""A misalignment learned back from images by gradients, and the gradients' cost.

    python examples/learn_geometry.py [--trials 10] [--views 32] [--voxels 80] [--sharp]
    [--peer] python examples/learn_geometry.py --cost 256

Images of random ellipsoids come from a renderer of its own below (closed form, double
precision; --sharp for a jump at the surface, which voxels can only approximate), seen by a
scanner whose detector is shifted and rolled and whose rotation axis is off. The ellipsoids as
voxels are the model. From starts drawn at random, Gauss-Newton finds shift, roll and axis: each
alone, then all three. Errors are in pixels: of the roll at the end of a row, of the axis as it
moves the image. With all three free, the distance between images of points by the found and by
the true geometry counts; the singular values of the Jacobian name the direction that
the images determine least.

With --peer the same task, by the same optimizer (L-BFGS on loss and gradient), for diffdrr
(pip install diffdrr) beside flexdt. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, minimize

import flexdt as fx

NAMES = ("shift", "roll", "axis")
SOD_MM, SDD_MM = 200.0, 400.0
NEAR_PX = (0.03, 0.1, 0.2)


@dataclass(frozen=True)
class Task:
    """Model, images and the true geometry.

    Attributes:
        nominal: geometry without misalignment.
        volume: the object as voxels.
        images: (n, rows, cols) of the true geometry.
        truth: shift, roll and axis [px].
    """

    nominal: fx.ConeVec
    volume: fx.Volume
    images: np.ndarray
    truth: np.ndarray

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Return the geometry (n, 12) with misalignment `values`: shift, roll (at the end
        of a row) and axis, each [px].
        """
        shift, roll, axis = values
        width = self.nominal.shape[2]
        source, centre, u, v = (
            self.nominal.rows[:, i : i + 3].copy() for i in (0, 3, 6, 9)
        )
        angle = roll / (0.5 * width)  # a px at the end of a row
        aside = axis * SOD_MM / SDD_MM * u  # moves the image by a px
        turned = (
            np.cos(angle) * u + np.sin(angle) * v,
            np.cos(angle) * v - np.sin(angle) * u,
        )
        return np.concatenate(
            [source - aside, centre - aside + shift * u, *turned], axis=1
        )

    def operator(self, values: np.ndarray) -> fx.Operator:
        """Return the projector with a misalignment."""
        return fx.Operator(
            fx.ConeVec(self.rows(values), self.nominal.detector_shape), self.volume
        )

    def residual(self, values: np.ndarray) -> np.ndarray:
        """Model minus images."""
        return np.asarray(self.operator(values) @ self.volume, np.float64) - self.images

    def jacobian(self, values: np.ndarray, free: list[int]) -> np.ndarray:
        """Compute the derivative of the images by the free parameters, (pixels, free
        parameters).

        It is the mean of derivatives at points NEAR_PX to both sides: the images of
        voxels have kinks at every hundredth of a pixel, so the derivative in one point
        holds for less than that.

        Args:
            values: shift, roll and axis [px].
            free: indices of the free ones.
        """
        columns = []
        for near in (*NEAR_PX, *(-px for px in NEAR_PX)):
            at = values.copy()
            at[free] += near
            operator = self.operator(at)
            for k in free:
                step = 1e-4 * np.eye(3)[k]
                change = (self.rows(at + step) - self.rows(at - step)) / 2e-4
                columns.append(operator.change(self.volume, change).ravel())
        near_by = np.array(columns, np.float64).reshape(2 * len(NEAR_PX), len(free), -1)
        return np.asarray(near_by.mean(axis=0).T)

    def reprojection(self, values: np.ndarray) -> float:
        """Compute the root mean square distance [px] between the images of 100 points by
        this misalignment and by the true one.
        """
        reach = 0.3 * self.volume.size_mm[0]
        points = np.random.default_rng(0).uniform(-reach, reach, (100, 3))
        shape = self.nominal.detector_shape
        found, true = (
            fx.ConeVec(self.rows(v), shape).project_points(points)
            for v in (values, self.truth)
        )
        return float(np.sqrt(np.mean(np.sum((found - true) ** 2, axis=-1))))


def render(
    ellipsoids: list[tuple], rows: np.ndarray, shape: tuple[int, int], sharp: bool
) -> np.ndarray:
    """Compute line integrals (n, rows, cols) of ellipsoids, exactly.

    With rho^2 = a t^2 + 2 b t + c along a ray the chord is |t - t0| < w, and the
    integrals are 2 w and 4/3 a w^3.

    Args:
        ellipsoids: center, matrix to the unit ball, and value [1/mm] of each.
        rows: (n, 12) cone_vec.
        shape: (rows, cols).
        sharp: whether each has its value everywhere inside; else value * (1 - rho^2) at
            rho of the way to the surface.
    """
    height, width = shape
    c, r = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    images = np.zeros((len(rows), height, width))
    for image, row in zip(images, rows, strict=True):
        source, centre, u, v = row.reshape(4, 3)
        ray = centre + c[None, :, None] * u + r[:, None, None] * v - source
        length = np.linalg.norm(ray, axis=-1)
        for middle, to_ball, value in ellipsoids:
            start, d = to_ball @ (source - middle), ray @ to_ball.T
            a, b = np.sum(d * d, axis=-1), d @ start
            w = np.sqrt(np.maximum(b * b - a * (start @ start - 1.0), 0.0)) / a
            image += value * length * (2.0 * w if sharp else 4.0 / 3.0 * a * w**3)
    return images


def voxels(ellipsoids: list[tuple], grid: fx.Grid, sharp: bool) -> fx.Volume:
    """Voxelise ellipsoids, see `render`, by the mean of some points in each voxel: 4^3 if
    `sharp`, else 2^3.
    """
    fine = 4 if sharp else 2
    steps = ((np.arange(fine) + 0.5) / fine - 0.5) * grid.voxel_mm
    x, y, z = grid.blank().centers()
    data = np.zeros(grid.shape)
    for dz in steps:
        for dy in steps:
            for dx in steps:
                point = np.stack(np.broadcast_arrays(
                    x[None, None, :] + dx, y[None, :, None] + dy, z[:, None, None] + dz
                ), axis=-1)  # fmt: skip
                for middle, to_ball, value in ellipsoids:
                    part = 1.0 - np.sum(((point - middle) @ to_ball.T) ** 2, axis=-1)
                    data += value * ((part > 0) if sharp else np.maximum(part, 0.0))
    return fx.Volume((data / fine**3).astype(np.float32), grid.voxel_mm)


def make(seed: int, views: int, count: int, sharp: bool = False) -> Task:
    """Draw twelve ellipsoids in a cube of 40 mm and a misalignment of up to 2 px each,
    and render the images of the true geometry.

    Args:
        seed: of the draws.
        views: of the circle.
        count: voxels a side of the model; the panel has two thirds as many pixels.
        sharp: as for `render`.
    """
    rng = np.random.default_rng(seed)
    size = 40.0
    ellipsoids = []
    for _ in range(12):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        to_ball = np.diag(1.0 / rng.uniform(0.08, 0.2, 3) / size) @ turn
        ellipsoids.append(
            (rng.uniform(-0.27, 0.27, 3) * size, to_ball, rng.uniform(0.01, 0.04))
        )
    pixels = 2 * count // 3
    nominal = fx.ConeVec.circular(
        sod=SOD_MM,
        sdd=SDD_MM,
        angles=views,
        shape=(pixels, pixels),
        pixel=2.2 * size / pixels,
    )
    truth = rng.uniform(-2.0, 2.0, 3)
    volume = voxels(ellipsoids, fx.Grid((count,) * 3, size / count), sharp)
    task = Task(nominal, volume, np.zeros(0), truth)
    return replace(
        task, images=render(ellipsoids, task.rows(truth), (pixels, pixels), sharp)
    )


def learn(task: Task, free: list[int], start: np.ndarray) -> np.ndarray:
    """Fit the free ones of shift, roll and axis [px] to the images by Gauss-Newton with a
    trust region.

    Args:
        task: model and images.
        free: indices of the free ones; the others are kept at the truth.
        start: all three, where to begin.

    Returns:
        All three values.
    """

    def all_of(values: np.ndarray) -> np.ndarray:
        full = task.truth.copy()
        full[free] = values
        return full

    found = least_squares(
        lambda v: task.residual(all_of(v)).ravel(),
        start[free],
        jac=lambda v: task.jacobian(all_of(v), free),
        xtol=1e-6,
        ftol=1e-10,
    )
    return all_of(found.x)


def trial(seed: int, views: int, count: int, sharp: bool = False) -> dict[str, object]:
    """Learn one object's misalignment from a start up to 3 px off, each parameter alone
    and then all together.

    Returns:
        Error [px] of each one alone; reprojection error at start and end [px], errors and
        seconds of all together; and the weakest direction, with its singular value over
        the largest.
    """
    task = make(seed, views, count, sharp)
    start = task.truth + np.random.default_rng(seed + 1000).uniform(-3.0, 3.0, 3)
    result: dict[str, object] = {}
    for k, name in enumerate(NAMES):
        result[name] = float(abs(learn(task, [k], start)[k] - task.truth[k]))
    begun = time.perf_counter()
    found = learn(task, [0, 1, 2], start)
    result["seconds_joint"] = time.perf_counter() - begun
    result["start_px"] = task.reprojection(start)
    result["joint_px"] = task.reprojection(found)
    result["joint_errors"] = np.abs(found - task.truth).tolist()
    _, sizes, directions = np.linalg.svd(
        task.jacobian(found, [0, 1, 2]), full_matrices=False
    )
    result["weakest"] = (sizes[-1] / sizes[0]).item()
    weak = directions[-1] * np.sign(directions[-1][0])
    result["weak_direction"] = dict(zip(NAMES, weak.round(3).tolist(), strict=True))
    return result


def race(task: Task, start: np.ndarray) -> dict[str, object]:
    """Minimise half the sum of squares by L-BFGS with gradients of flexdt and then of
    diffdrr.

    Args:
        task: model and images.
        start: shift, roll and axis [px].

    Returns:
        Shape, and for each program times [s] of a gradient and of all, loss and gradient
        at the start, evaluations and reprojection error [px].
    """
    import torch
    from diffdrr.renderers import Siddon

    shape = task.nominal.detector_shape
    n, height, width = task.nominal.shape
    c, r = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    density = torch.from_numpy(np.ascontiguousarray(task.volume.data.transpose(2, 1, 0)))
    low = -torch.tensor(task.volume.size_mm) / 2
    edge = task.volume.voxel_xyz[0]
    measured, siddon = (
        torch.from_numpy(task.images.astype(np.float32)),
        Siddon(voxel_shift=0.0),
    )

    def chain(values: np.ndarray, by_rows: np.ndarray) -> np.ndarray:
        """Convert a gradient by the geometry's numbers (n, 12) to one by shift, roll and
        axis.
        """
        steps = 1e-4 * np.eye(3)
        return np.array([
            np.vdot(by_rows, task.rows(values + s) - task.rows(values - s)) / 2e-4 for s in steps
        ])  # fmt: skip

    def ours(values: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute half the sum of squared residuals, and its gradient by the parameters."""
        rest = task.residual(values)
        return 0.5 * float(np.sum(rest**2)), chain(
            values, task.operator(values).gradient(task.volume, rest)
        )

    def theirs(values: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute loss and gradient at `values` by diffdrr's renderer and torch, one view
        after the other.
        """
        rows = torch.tensor(task.rows(values), requires_grad=True)
        total = 0.0
        for i in range(n):
            source, centre, u, v = rows[i].reshape(4, 3)
            across = torch.tensor(np.tile(c, height))[:, None]
            down = torch.tensor(np.repeat(r, width))[:, None]
            target = centre + across * u + down * v
            ends = ((source - low)[None] / edge).float(), ((target - low) / edge).float()
            length = (target - source).norm(dim=-1).float()
            image = siddon(density, ends[0][None], ends[1][None], length[None, None])
            loss = 0.5 * ((image.reshape(height, width) - measured[i]) ** 2).sum()
            loss.backward()
            total += float(loss.detach())
        return total, chain(values, rows.grad.numpy())

    result: dict[str, object] = {"shape": shape}
    for name, function in (("flexdt", ours), ("diffdrr", theirs)):
        function(start)  # compiled and warm
        begun = time.perf_counter()
        value, slope = function(start)
        once = time.perf_counter() - begun
        begun = time.perf_counter()
        found = minimize(
            function, start, jac=True, method="L-BFGS-B", options={"maxiter": 40}
        )
        result[name] = {
            "seconds_loss_and_gradient": once,
            "loss_at_start": value,
            "gradient_at_start": slope.tolist(),
            "seconds": time.perf_counter() - begun,
            "evaluations": int(found.nfev),
            "reprojection_px": task.reprojection(found.x),
        }
    return result


def cost(count: int, repeat: int = 3) -> dict[str, float]:
    """Time forward, back, gradient and change for count^3 random voxels on a panel of 380
    x 478, in turns.

    Returns:
        Name -> least time of `repeat` runs [ms a view].
    """
    data = np.random.default_rng(0).uniform(0, 0.02, (count,) * 3).astype(np.float32)
    volume = fx.Volume(data, 76.8 / count)
    scan = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=6, shape=(380, 478), pixel=0.2992
    )
    operator = fx.Operator(scan, volume)
    images, change = operator @ volume, np.ones((6, 12))
    jobs = {
        "forward": lambda: operator @ volume,
        "back": lambda: operator.T @ images,
        "gradient": lambda: operator.gradient(volume, images),
        "change": lambda: operator.change(volume, change),
    }
    best = dict.fromkeys(jobs, np.inf)
    for _ in range(repeat):
        for name, job in jobs.items():
            begun = time.perf_counter()
            job()
            best[name] = min(
                best[name], (time.perf_counter() - begun) / len(images) * 1e3
            )
    return best


def main() -> None:
    """Print the errors of several trials, and with `--peer` a race with diffdrr, or with
    `--cost` times alone, as JSON.
    """
    parser = argparse.ArgumentParser(
        description="a misalignment learnt back by gradients"
    )
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--voxels", type=int, default=80)
    parser.add_argument("--peer", action="store_true", help="diffdrr on the same task")
    parser.add_argument(
        "--sharp", action="store_true", help="ellipsoids of one value each"
    )
    parser.add_argument(
        "--cost", type=int, metavar="VOXELS", help="only ms a view, for VOXELS^3"
    )
    options = parser.parse_args()
    if options.cost is not None:
        print(json.dumps(cost(options.cost), indent=2))
        return
    size = (options.views, options.voxels, options.sharp)
    trials = [trial(seed, *size) for seed in range(options.trials)]
    keys = (*NAMES, "joint_px", "start_px", "seconds_joint")
    document: dict[str, object] = {
        "worst": {k: max(float(t[k]) for t in trials) for k in keys},  # type: ignore[arg-type]
        "trials": trials,
    }
    if options.peer:
        task = make(0, *size)
        document["peer"] = race(task, task.truth + np.array([2.0, -1.5, 1.0]))
    print(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
