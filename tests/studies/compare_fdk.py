"""FDK beside itk-rtk's on the same data: a ball and a box, exact projections, one machine.

Needs `pip install itk-rtk`. Prints both times, the mean of each inside the ball over the truth,
and the largest and the root mean square difference of the two volumes [1/mm].

    python tests/studies/compare_fdk.py --views 360 --voxels 256
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import project_scene
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid, Sphere
from flexdt.twin.reconstruction import Grid, fdk

SOD, SDD, PIXEL = 600.0, 1059.0, 0.2992
SHAPE = (380, 478)


def circle(views: int) -> ConeVec:
    """Make a full circle of `views` with SOD, SDD and PIXEL, angles from 0."""
    angle = 2 * np.pi * np.arange(views) / views
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(views)
    across, away = np.stack([c, s, zero], 1), np.stack([-s, c, zero], 1)
    return ConeVec.from_vectors(
        -SOD * away, (SDD - SOD) * away, PIXEL * across, (0, 0, -PIXEL)
    )


def by_rtk(
    data: np.ndarray, views: int, voxels: int, size: float, pixel: float = PIXEL
) -> tuple[np.ndarray, float]:
    """Reconstruct by RTK's FDK, and turn the volume to flexdt's axes: RTK's (x, y, z) is
    our (x, z, -y), and its detector rows grow upwards.

    Args:
        data: (n, rows, cols) line integrals.
        views: n.
        voxels: along each side of the cube.
        size: of a voxel [mm].
        pixel: edge of a pixel [mm].

    Returns:
        The volume (z, y, x), and the time of the reconstruction alone [s].
    """
    import itk  # here, so that --help needs no peer
    from itk import RTK as rtk

    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for i in range(views):
        geometry.AddProjection(SOD, SDD, 360.0 * i / views)
    stack = itk.image_from_array(np.ascontiguousarray(data[:, ::-1]))
    stack.SetSpacing([pixel, pixel, 1.0])
    rows, cols = data.shape[1:]
    stack.SetOrigin([-(cols - 1) / 2 * pixel, -(rows - 1) / 2 * pixel, 0.0])
    kind = type(stack)
    empty = rtk.ConstantImageSource[kind].New()
    empty.SetOrigin([-(voxels - 1) / 2 * size] * 3)
    empty.SetSpacing([size] * 3)
    empty.SetSize([voxels] * 3)
    empty.SetConstant(0.0)
    filters = rtk.FDKConeBeamReconstructionFilter[kind].New()
    filters.SetInput(0, empty.GetOutput())
    filters.SetInput(1, stack)
    filters.SetGeometry(geometry)
    begun = time.perf_counter()
    filters.Update()
    seconds = time.perf_counter() - begun
    return itk.array_from_image(filters.GetOutput())[::-1].transpose(1, 0, 2), seconds


def main() -> None:
    """Reconstruct a ball and a box by flexdt and RTK in turn, and print times [s], the
    ratio of the least ones, RTK's over flexdt's, the differences of the volumes [1/mm],
    and the ball's mean over its true value in each, as JSON.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=360)
    parser.add_argument("--voxels", type=int, default=256)
    parser.add_argument("--repeat", type=int, default=2)
    options = parser.parse_args()
    n, size = options.voxels, 60.0 / options.voxels
    scene = Scene(
        (
            Solid(Sphere((9.0, -6.0, 5.0), 8.0), "a", 0.05),
            Solid(Box((-8.0, 5.0, -6.0), (10.0, 12.0, 14.0)), "a", 0.03),
        )
    )
    scan = circle(options.views)
    data = project_scene(scene, scan, SHAPE)
    like = Grid((n, n, n), size).blank()
    fdk(
        data[:16],
        scan[:: options.views // 16][:16],
        Grid((16, 16, 16), 1.0).blank(),
        errors=False,
    )  # compile
    ours, theirs = [], []
    for _ in range(options.repeat):
        begun = time.perf_counter()
        volume = fdk(data, scan, like, errors=False).data
        ours.append(time.perf_counter() - begun)
        theirs_volume, seconds = by_rtk(data, options.views, n, size)
        theirs.append(seconds)
    inside = _well_inside_the_ball(n, size)
    print(
        json.dumps(
            {
                "flexdt_s": np.round(ours, 2).tolist(),
                "itk-rtk_s": np.round(theirs, 2).tolist(),
                "ratio": round(min(theirs) / min(ours), 2),
                "largest_difference": float(np.abs(volume - theirs_volume).max()),
                "rms_difference": float(np.sqrt(np.mean((volume - theirs_volume) ** 2))),
                "flexdt_ball": round(float(volume[inside].mean()) / 0.05, 5),
                "itk-rtk_ball": round(float(theirs_volume[inside].mean()) / 0.05, 5),
            },
            indent=1,
        )
    )


def _well_inside_the_ball(n: int, size: float) -> np.ndarray:
    at = (np.arange(n) - (n - 1) / 2) * size
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    return (x - 9) ** 2 + (y + 6) ** 2 + (z - 5) ** 2 < 6.5**2


if __name__ == "__main__":
    main()
