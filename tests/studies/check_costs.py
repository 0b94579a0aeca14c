"""What looking at a scan before it is believed costs: FDK and opening with the checks over the
same without them.

    python tests/studies/check_costs.py [--only fdk|open] [--rounds 7] [--case 0]

FDK: `fdk` of an ellipsoid with four parts, seen whole, cut off by the panel, and with the noise
of photons, as it is and without the examination of its input and the comparison of images with
their geometry. Opening: a folder of 360 TIFFs of 512 x 480 with a geometry, dark and flat images,
as it is and without the examination and the looks at single images. Processor seconds of one
process, in turns; the ratio is the median of the rounds', beside that of the two least times.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
from bias_bound import Scan, Solid

import flexdt as fx

SOD_MM, SDD_MM = 600.0, 1059.0
FIELD_MM = 30.0
"""Half width of the field of view [mm]."""
CASES = (
    (360, (192, 192), 96),
    (360, (128, 128), 96),
    (360, (256, 256), 128),
    (360, (380, 478), 256),
)
"""Views, panel (rows, cols) and voxels a side."""
OBJECTS = {"whole": (0.85, 0.0), "cut off": (1.5, 0.0), "noise": (0.85, 2e4)}
"""Kind -> radius of the body over the field of view, photons of the open beam (0: no noise)."""
FRAMES, FRAME_SHAPE = 360, (512, 480)
OPENINGS = 20
"""Number of openings that are timed together: one takes a few milliseconds."""
FDK_CHECKS = {
    "flexdt.twin.reconstruction.checked_fdk.examine": (),
    "flexdt.twin.reconstruction.bias.compared": None,
    "flexdt.twin.reconstruction.bias.too_few": False,
}
"""Name of each check -> what it gives if it finds nothing."""
OPEN_CHECKS = {
    "flexdt.library.reading.listed_images.examine": (),
    "flexdt.library.reading.listed_images.blank_images": (),
    "flexdt.library.reading.listed_images.first_look": [],
}


@contextmanager
def without(checks: dict[str, object]) -> Iterator[None]:
    """Replace checks by what they give if they find nothing."""
    patches = [
        mock.patch(name, lambda *_, _found=found, **__: _found)
        for name, found in checks.items()
    ]
    for patch in patches:
        patch.start()
    try:
        yield
    finally:
        for patch in patches:
            patch.stop()


def in_turns(
    work: Callable[[], object], checks: dict[str, object], rounds: int
) -> tuple[list[float], list[float]]:
    """Time work without and with the checks, after a round that is not counted.

    Returns:
        Processor seconds of each round, without and with.
    """
    plain, checked = [], []
    for turn in range(-1, rounds):
        with without(checks):
            begun = time.process_time()
            work()
            between = time.process_time()
        again = time.process_time()
        work()
        ended = time.process_time()
        if turn >= 0:
            plain.append(between - begun)
            checked.append(ended - again)
    return plain, checked


def said(plain: list[float], checked: list[float]) -> str:
    """Describe two lists of times of the same rounds."""
    ratios = np.divide(checked, plain)
    return (
        f"{np.median(plain):.3f} and {np.median(checked):.3f} s, "
        f"ratio {np.median(ratios):.3f} (of the least {min(checked) / min(plain):.3f})"
    )


def solids(radius_mm: float) -> list[Solid]:
    """An ellipsoid with four parts, and one of them a hole."""
    body = Solid(
        "ellipsoid", np.zeros(3), radius_mm * np.array([1.0, 0.9, 0.8]), 0.4, 0.02
    )
    at = (
        0.4
        * FIELD_MM
        * np.array([[1, 0.2, 0.3], [-0.4, 0.9, -0.5], [-1, -0.6, 0.2], [0.5, -1, 0]])
    )
    sizes = FIELD_MM * np.array(
        [[0.2, 0.1, 0.15], [0.1, 0.1, 0.3], [0.15, 0.2, 0.1], [0.12, 0.12, 0.12]]
    )
    kinds = ("box", "cylinder", "ellipsoid", "ellipsoid")
    values = (0.02, 0.03, 0.015, -0.02)
    parts = zip(kinds, at, sizes, values, strict=True)
    return [
        body,
        *(Solid(kind, centre, half, 0.7, mu) for kind, centre, half, mu in parts),
    ]


def fdk_costs(rounds: int, cases: Sequence[tuple[int, tuple[int, int], int]]) -> None:
    """Print what the checks of FDK cost, a line for each case and object."""
    for views, shape, side in cases:
        pixel = 2.0 * SDD_MM * np.tan(np.arcsin(FIELD_MM / SOD_MM)) / shape[1]
        scan = fx.ConeVec.circular(
            sod=SOD_MM, sdd=SDD_MM, angles=views, shape=shape, pixel=pixel
        )
        grid = fx.Grid((side, side, side), 2.0 * FIELD_MM / side)
        for kind, (radius, photons) in OBJECTS.items():
            images = Scan(
                kind, scan, shape, solids(radius * FIELD_MM), photons, 0.0, 1
            ).images()
            work = partial(fx.fdk, images, scan, grid, progress=False)
            times = in_turns(work, FDK_CHECKS, rounds)
            what = f"{side}^3 from {views} views of {shape[0]} x {shape[1]}, {kind}"
            print(f"{what}: {said(*times)}", flush=True)


def open_cost(rounds: int) -> None:
    """Print what the checks of opening a folder cost."""
    scan = fx.ConeVec.circular(
        sod=SOD_MM, sdd=SDD_MM, angles=FRAMES, shape=FRAME_SHAPE, pixel=0.25
    )
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 100.0, FRAME_SHAPE)
    counts = np.stack([3e4 + 50.0 * k + np.roll(noise, k) for k in range(FRAMES)])
    flat = np.full(FRAME_SHAPE, 55_000, np.uint16)
    dark = np.full(FRAME_SHAPE, 300, np.uint16)
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder, "scan")
        data = fx.DataSet.from_arrays(
            counts.astype(np.uint16), scan, dark=dark, flat=flat
        )
        data.save(where)
        times = in_turns(
            lambda: [fx.open(where) for _ in range(OPENINGS)], OPEN_CHECKS, rounds
        )
    size = f"{FRAMES} frames of {FRAME_SHAPE[0]} x {FRAME_SHAPE[1]}"
    print(f"opening {size}, {OPENINGS} times: {said(*times)}", flush=True)


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--only", choices=["fdk", "open"])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--case", type=int, help="number of the only one of FDK's")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    if chosen.only != "fdk":
        open_cost(chosen.rounds)
    if chosen.only != "open":
        cases = CASES if chosen.case is None else CASES[chosen.case :][:1]
        fdk_costs(chosen.rounds, cases)


if __name__ == "__main__":
    main()
