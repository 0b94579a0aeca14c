"""Soft matter beside dense parts, from the twin's own scan: `python
tests/studies/soft_beside_dense.py [--objects 4] [--rays auto,1,3,8] [--frames 240]`.

Drawn objects, each a soft cylinder of 0.02/mm with four dense spheres and rods (5 to 20 times as
much) in it, stand on the stage of a twin in this process with the physics of a server's start
("ideal"). It scans them with each number of rays, without noise, and its data set is reconstructed
by `reconstruct` as it stands. Compared with the soft part's value: single voxels, and means over
9 x 9 x 9 voxels (as the finding was: "14 % in a region of 729 voxels"), all of soft voxels at
least three voxels from an edge, in layers near the beam's plane. What 8 x 8 rays in each pixel at
an edge leave is the algorithm's, not the images'. Ends with 1 where the regions' p90 by "auto" is
beyond `MOST`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from scipy import ndimage

import flexdt as fx
from flexdt.phantoms import as_phantom
from flexdt.testing import twin
from flexdt.twin.projection import Scene, Solid
from flexdt.twin.projection.analytic_solids import Cylinder, Sphere
from flexdt.twin.rays_a_pixel import check_rays

MOST = 1.0
"""Largest p90 of regions by "auto" [%]."""
SOFT = 0.02
"""Attenuation of the soft part [1/mm]."""
REGION = 9
"""Voxels along a side of a region."""
AWAY = 3
"""Voxels from an edge, at least."""
SIDE = 128
"""Pixels of an image along each side."""
ROI = "846 640 1101 895"
"""Pixels of the panel around the axis, at home."""
FIRST = -30.0
"""Where the turntable begins; images are taken from 0 on [deg]."""
VOXEL = 0.0837
"""Of a pixel at the axis, at home [mm]."""
LAYERS = 24
"""Layers of a volume."""

Array = npt.NDArray[np.float64]
Body = tuple[Array, float, float, float]
"""Middle [mm], radius [mm], half height [mm] (0: a sphere), attenuation added [1/mm]."""


def drawn(seed: int) -> list[Body]:
    """Draw an object: the soft cylinder first, then dense parts within it."""
    rng = np.random.default_rng([seed, 7979])
    radius = 0.4 * SIDE * VOXEL
    places: list[Array] = []
    while len(places) < 4:
        place = rng.uniform(-0.7, 0.7, 3) * radius * np.array([1.0, 1.0, 0.15])
        apart = all(np.hypot(*(place - p)[:2]) > 0.35 * radius for p in places)
        if apart and np.hypot(*place[:2]) < 0.7 * radius:
            places.append(place)
    dense = []
    for i, place in enumerate(places):
        size, mu = rng.uniform(0.06, 0.14) * radius, SOFT * rng.uniform(4.0, 19.0)
        dense.append((place, size, 4 * size if i % 2 else 0.0, mu))
    return [(np.zeros(3), radius, 3 * radius, SOFT), *dense]


def scene(bodies: list[Body]) -> Scene:
    """The object as the twin takes it; parts within the soft one add to it."""
    solids = []
    for middle, radius, half, mu in bodies:
        x, y, z = middle.tolist()
        shape = (
            Cylinder((x, y, z), radius, 2 * half, (0.0, 0.0, 1.0))
            if half
            else Sphere((x, y, z), radius)
        )
        solids.append(Solid(shape, "a", mu))
    return Scene(tuple(solids))


def soft_voxels(
    bodies: list[Body], x: Array, y: Array, z: Array
) -> npt.NDArray[np.bool_]:
    """Voxels of the soft part alone, at least `AWAY` from an edge."""
    (_, outer, _, _), *dense = bodies
    margin = AWAY * VOXEL
    out = np.hypot(x, y) < outer - margin
    for middle, radius, half, _ in dense:
        across = np.hypot(x - middle[0], y - middle[1])
        if half:
            near = (across < radius + margin) & (np.abs(z - middle[2]) < half + margin)
        else:
            near = np.hypot(across, z - middle[2]) < radius + margin
        out = out & ~near
    return out


def script(frames: int) -> str:
    """A fly scan of one turn."""
    step = 360.0 / frames
    rows = [
        f"camera\tset ROI\t{ROI}\t\tACK\t\t",
        "camera\tset exposure\t1000\t\tACK\t\t",
        f"camera\tset number of frames\t{frames}\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        "tube\tset power\t1.0\t\tACK\t\t",
        f"rot_obj\tset speed\t{step:.9f}\t\tACK\t\t",
        f"rot_obj\tmove absolute\t{FIRST}\t\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tE:\\data\\di000000.tif\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        "tra_obj\tmove absolute\t100\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tE:\\data\\io000000.tif\t\tACK\t\t",
        "tra_obj\tmove absolute\t0\t\tACK\t\t",
        f"rot_obj\tmove absolute\t{360.0 + 5 * step:.6f}\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tE:\\data\\scan_\t0\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "",
    ]
    return "\r\n".join(rows)


def scanned(bodies: list[Body], rays: str, frames: int, folder: Path) -> Path:
    """Let a twin scan an object, and give the folder of its data set."""
    with twin(seed=None, speed_up="max", data=folder) as lab:
        radiography = lab.server.radiography
        if rays != "auto":
            checked = check_rays(int(rays))
            object.__setattr__(radiography, "rays", checked)
        assert str(radiography.rays) == rays
        lab.client.upload_scene(as_phantom(scene(bodies)), "drawn")
        lab.client.set_sample(file="drawn")
        job = lab.client.submit_script(script(frames), name="scan")
        ended = lab.client.wait_job(job.job)
        assert ended.state == "done", ended
    return folder / "scan"


def errors(folder: Path, bodies: list[Body]) -> tuple[Array, Array]:
    """Errors of single soft voxels and of regions' means, relative to the soft value [%]."""
    data = fx.open(folder)
    volume = fx.reconstruct(
        data,
        voxel=VOXEL,
        shape=(LAYERS, SIDE, SIDE),
        center=(0.0, 0.0, 0.0),
        errors=False,
    )
    along = volume.centers()
    z, y, x = np.meshgrid(*reversed(along), indexing="ij")
    soft = soft_voxels(bodies, x, y, z)
    off = 100.0 * (volume.data / SOFT - 1.0)
    inside = ndimage.uniform_filter(soft.astype(np.float64), REGION) > 1 - 1e-9
    half = REGION // 2
    for axis in range(3):  # the filter repeats what is at the ends
        ends = [slice(None)] * 3
        for end in (slice(0, half), slice(-half, None)):
            ends[axis] = end
            inside[tuple(ends)] = False
    means = ndimage.uniform_filter(off.astype(np.float64), REGION)
    return np.abs(off[soft]), np.abs(means[inside])


def main() -> int:
    """Print the table.

    Returns:
        1 where the p90 of regions by "auto" is beyond `MOST`.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=4)
    parser.add_argument("--rays", default="auto,1,3,8")
    parser.add_argument("--frames", type=int, default=240)
    given = parser.parse_args()
    worst = 0.0
    print("rays  voxels p50   p90   regions p50   p90   worst [%]  regions", flush=True)
    for rays in given.rays.split(","):
        found: list[tuple[Array, Array]] = []
        for seed in range(given.objects):
            bodies = drawn(seed)
            with tempfile.TemporaryDirectory() as kept:
                folder = scanned(bodies, rays, given.frames, Path(kept))
                found.append(errors(folder, bodies))
        voxels, regions = (np.concatenate(part) for part in zip(*found, strict=True))
        p90 = float(np.percentile(regions, 90))
        if rays == "auto":
            worst = p90
        print(
            f"{rays:5} {np.median(voxels):10.2f} {np.percentile(voxels, 90):6.2f} "
            f"{np.median(regions):12.3f} {p90:6.3f} {regions.max():7.3f}     {len(regions)}",
            flush=True,
        )
    return int(worst > MOST)


if __name__ == "__main__":
    sys.exit(main())
