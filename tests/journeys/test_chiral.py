"""Signs and handedness through the whole chain: script, twin, TIFF, reader, backprojection.

Four unequal beads that no mirror image fits. What the reader says about each frame is compared
with a point projection written here from the interface's definition of the world frame and the
published zero offsets of profile cwi-2023-08-21 alone (it uses nothing of flexdt), and the
frames are backprojected over all 48 signed permutations of the axes: only the identity may fit.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import tifffile

from flexdt.clients import TwinClient
from flexdt.clients.launch.processes import Servers
from flexdt.library.reading.folders import load_dataset
from flexdt.twin.projection import Volume, back

Array = npt.NDArray[np.float64]

# Radius 4 along +x, 3 along +y, 2 along +z, 1.5 along -x and below (the phantom's definition).
BEADS = np.array(
    [[14.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 18.0], [-6.0, 2.0, -9.0]]
)
RADII = np.array([4.0, 3.0, 2.0, 1.5])
FRAMES = 13
MOTORS = {"ver_tube": 26.2917, "ver_det": 24.0, "tra_det": 21.0, "mag_det": 1000.0,
          "mag_obj": 585.0, "tra_obj": 3.5, "tra_tube": 2.0}  # fmt: skip
LEFT, TOP, RIGHT, BOTTOM = 420, 250, 1519, 1285
PITCH = 0.0748
BINNING = 2


def independent_pixels(points: Array, angle_deg: float) -> Array:
    """(column, row) of world points at a stage angle, from the interface's frames and
    flexray.md.

    World: +x right seen from the source, +y to the detector, +z up. Growing rot_obj turns the
    object clockwise seen from above. Columns grow to +x, rows downwards.
    """
    m = MOTORS
    source = np.array([m["tra_tube"], 0.0, m["ver_tube"] - 6.2917])
    axis = np.array([m["tra_obj"] - 0.5405, m["mag_obj"] + 14.9192, 20.0])
    phi = math.radians(angle_deg)
    x, y, z = points.T
    turned = np.stack(
        [
            x * math.cos(phi) + y * math.sin(phi),
            -x * math.sin(phi) + y * math.cos(phi),
            z,
        ],
        axis=1,
    )
    ray = turned + axis - source
    at_panel = source + ray * ((m["mag_det"] + 40.0008) / ray[:, 1])[:, None]
    panel_x, panel_z = -m["tra_det"] + 24.1215, m["ver_det"]
    # Unbinned pixel (column, row) counts from the panel's top left corner, pixel centres at +
    # 1/2.
    column = (at_panel[:, 0] - panel_x) / PITCH + 1944 / 2
    row = -(at_panel[:, 2] - panel_z) / PITCH + 1536 / 2
    return np.stack(
        [(column - LEFT) / BINNING - 0.5, (row - TOP) / BINNING - 0.5], axis=1
    )


def angles() -> list[float]:
    """The smooth-scan rule: image i at i * 360 / (N - 1); the last repeats the first."""
    return [i * 360.0 / (FRAMES - 1) for i in range(FRAMES)]


@pytest.fixture(scope="module")
def folder(servers: Servers, data_dir: Path, fly_script: Callable[..., str]) -> Path:
    roi = f"{LEFT} {TOP} {RIGHT} {BOTTOM}"
    with TwinClient(*servers.address) as client:
        client.set_sample("chiral")
        job = client.submit_script(
            fly_script(FRAMES, roi=roi, **MOTORS), name="chiral"
        ).job
        while (status := client.job_status(job)).state in ("queued", "running"):
            time.sleep(0.05)
    assert status.state == "done", status
    return data_dir / "chiral"


def line_integrals(folder: Path) -> Array:
    """From the TIFFs alone: -log of (image - dark) / (flat - dark), (n, rows, cols)."""
    dark = tifffile.imread(folder / "di000000.tif").astype(np.float64)
    flat = tifffile.imread(folder / "io000000.tif").astype(np.float64)
    frames = np.stack(
        [
            tifffile.imread(folder / f"scan_{i:06d}.tif").astype(np.float64)
            for i in range(FRAMES)
        ]
    )
    return -np.log(np.maximum(frames - dark, 1.0) / (flat - dark))


def sample(image: Array, pixels: Array) -> Array:
    """Nearest pixel of each (column, row); all must be in view."""
    columns, rows = np.rint(pixels).astype(int).T
    return np.asarray(image[rows, columns])


def test_image_shape_follows_from_mode_and_roi(folder: Path) -> None:
    expected = ((BOTTOM - TOP + 1) // BINNING, (RIGHT - LEFT + 1) // BINNING)
    assert line_integrals(folder).shape == (FRAMES, *expected)


def test_the_readers_geometry_is_the_independent_one(folder: Path) -> None:
    dataset = load_dataset(folder)
    shape = tifffile.imread(folder / "scan_000000.tif").shape
    ours = dataset.cone_vec.project_points(BEADS, shape)
    for i, angle in enumerate(angles()):
        np.testing.assert_allclose(ours[i], independent_pixels(BEADS, angle), atol=2e-4)


def body_chords(shape: tuple[int, int], angle_deg: float) -> Array:
    """Path length of each pixel's ray in the 40 x 34 x 46 mm body, by slabs, (rows, cols)
    [mm]."""
    m = MOTORS
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    panel = np.stack(
        [
            ((cols + 0.5) * BINNING + LEFT - 1944 / 2) * PITCH - m["tra_det"] + 24.1215,
            np.full(shape, m["mag_det"] + 40.0008),
            -((rows + 0.5) * BINNING + TOP - 1536 / 2) * PITCH + m["ver_det"],
        ],
        axis=-1,
    )
    source = np.array([m["tra_tube"], 0.0, m["ver_tube"] - 6.2917])
    axis = np.array([m["tra_obj"] - 0.5405, m["mag_obj"] + 14.9192, 20.0])
    phi = math.radians(angle_deg)
    back_turn = np.array(
        [[math.cos(phi), -math.sin(phi), 0], [math.sin(phi), math.cos(phi), 0], [0, 0, 1]]
    )
    start, end = (source - axis) @ back_turn.T, (panel - axis) @ back_turn.T
    ray = end - start
    half = np.array([20.0, 17.0, 23.0])
    with np.errstate(divide="ignore"):
        one, two = (-half - start) / ray, (half - start) / ray
    enter, leave = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
    return np.asarray(np.maximum(leave - enter, 0.0) * np.linalg.norm(ray, axis=-1))


def test_every_bead_casts_its_shadow_where_it_must(folder: Path) -> None:
    """The centre of mass of each shadow, the body taken away, bead by bead, frame by frame."""
    checked = 0
    for image, angle in zip(line_integrals(folder), angles(), strict=True):
        chords = body_chords(image.shape, angle)
        beads = image - np.median(image[chords > 10] / chords[chords > 10]) * chords
        predicted = independent_pixels(BEADS, angle)
        reach = RADII / (PITCH * BINNING) * 1040.0 / 600.0
        for k, (column, row) in enumerate(predicted):
            gaps = np.linalg.norm(predicted - predicted[k], axis=1) - 1.3 * (
                reach + reach[k]
            )
            if np.delete(gaps, k).min() < 0:
                continue  # two shadows overlap
            found = shadow_centre(beads, column, row, 1.3 * reach[k])
            np.testing.assert_allclose(found, (column, row), atol=0.2)
            checked += 1
    assert checked > 2 * FRAMES


def shadow_centre(
    beads: Array, column: float, row: float, radius: float
) -> tuple[float, float]:
    """Weighted centre of a disc, above the median of what surrounds it."""
    rows, cols = np.mgrid[: beads.shape[0], : beads.shape[1]]
    distance = np.hypot(cols - column, rows - row)
    disc = distance <= radius
    above = beads[disc] - np.median(beads[(distance > radius) & (distance < radius + 4)])
    return float(above @ cols[disc] / above.sum()), float(
        above @ rows[disc] / above.sum()
    )


def test_backprojection_fits_only_the_unmirrored_phantom(folder: Path) -> None:
    """Value of the backprojection (here: mean over the frames) at the beads, in 48
    orientations."""
    images = line_integrals(folder)
    scores = {}
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            points = BEADS[:, order] * np.array(signs)
            values = [
                sample(image, independent_pixels(points, angle))
                for image, angle in zip(images, angles(), strict=True)
            ]
            scores[order, signs] = float(np.mean(values))
    ranked = sorted(scores, key=lambda key: scores[key], reverse=True)
    assert ranked[0] == ((0, 1, 2), (1.0, 1.0, 1.0))
    assert scores[ranked[0]] > 1.05 * scores[ranked[1]]


def test_volume_is_indexed_z_y_x_in_the_object_frame(folder: Path) -> None:
    """The package's own backprojection of the reader's frames, at voxels found by hand."""
    dataset = load_dataset(folder)
    images = np.stack([dataset.line_integrals(i) for i in range(FRAMES - 1)]).astype(
        np.float32
    )
    voxel = 1.0
    like = Volume(np.zeros((47, 35, 41), np.float32), voxel)
    volume = back(images, dataset.cone_vec[: FRAMES - 1], like).data
    centre = np.array([23, 17, 20])
    for x, y, z in BEADS[:3].astype(int):
        here = volume[tuple(centre + (z, y, x))]
        mirrored = volume[tuple(centre - (z, y, x))]
        assert here > 1.03 * mirrored
