"""Circular scans with a panel anywhere, written out by hand for the reconstruction's tests."""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

MU = 0.05
CENTRE = (6.0, -4.0, 3.0)
RADIUS = 5.0
BALL = Scene((Solid(Sphere(CENTRE, RADIUS), "a", MU),))


def turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def circle(
    n: int,
    span_deg: float = 360.0,
    *,
    repeat: bool = False,
    sense: int = 1,
    pixel: float = 0.6,
    aside: float = 0.0,
    yaw: float = 0.0,
    tilt: float = 0.0,
    axis: float = 0.0,
    sod: float = 600.0,
    sdd: float = 1059.0,
    angles: np.ndarray | None = None,
) -> ConeVec:
    """Source on a circle of radius `sod` about z; lengths in mm, `yaw` and `tilt` in rad.

    aside: detector's shift along u; tilt: its roll and its pitch; axis: lateral shift of source
    and detector against the rotation axis; repeat: the last view has the angle `span_deg`;
    angles: of the views [rad], instead of even ones over the span.
    """
    roll = np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    )
    pitch = np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    panel = turn(yaw) @ pitch @ roll * pixel
    parts = [[axis, -sod, 0], [axis + aside, sdd - sod, 0], panel[:, 0], -panel[:, 2]]
    if angles is None:
        angles = np.deg2rad(np.linspace(0, span_deg, n, endpoint=repeat))
    angles = angles * sense
    return ConeVec(
        np.array([np.concatenate([turn(a) @ p for p in parts]) for a in angles])
    )


def ball(geometry: ConeVec, shape: tuple[int, int]) -> np.ndarray:
    """Exact line integrals of the ball."""
    return project_scene(BALL, geometry, shape)


def measure(volume) -> tuple[float, np.ndarray]:
    """Mean attenuation well inside the ball relative to the truth, and the error of its centre
    of mass in voxels.
    """
    nz, ny, nx = volume.shape
    size, centre = volume.voxel_mm, np.array(volume.center_mm)
    z, y, x = np.meshgrid(
        *(
            (np.arange(n) - (n - 1) / 2) * size + c
            for n, c in zip((nz, ny, nx), centre[::-1], strict=True)
        ),
        indexing="ij",
    )
    data = volume.data
    distance = np.sqrt((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2 + (z - CENTRE[2]) ** 2)
    weight = np.where(distance < RADIUS + 3 * size, np.clip(data, 0, MU), 0)
    found = np.array([(weight * axis).sum() / weight.sum() for axis in (x, y, z)])
    inside = data[distance < 0.8 * RADIUS]
    return float(inside.mean() / MU), (found - CENTRE) / size


def lengths(geometry: ConeVec, shape: tuple[int, int], grid) -> np.ndarray:
    """Length of each ray in each voxel of a grid [mm], (n * rows * cols, nz * ny * nx).

    A ray meets a box between the last of the near and the first of the far faces, one voxel at
    a time: nothing of the projectors is used.
    """
    rows, cols = shape
    c, r = np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2
    volume = grid.blank()
    half = np.array(volume.voxel_xyz) / 2
    x, y, z = volume.centers()
    centers = np.stack(np.meshgrid(z, y, x, indexing="ij"), -1)[..., ::-1].reshape(-1, 3)
    out = []
    for row in geometry.rows:
        source, panel, u, v = row.reshape(4, 3)
        ray = (panel + c[None, :, None] * u + r[:, None, None] * v - source).reshape(
            -1, 1, 3
        )
        with np.errstate(divide="ignore"):
            one, other = ((centers + side * half - source) / ray for side in (-1, 1))
        near = np.minimum(one, other).max(axis=2)
        far = np.maximum(one, other).min(axis=2)
        out.append(np.maximum(far - near, 0.0) * np.linalg.norm(ray, axis=2))
    return np.concatenate(out)
