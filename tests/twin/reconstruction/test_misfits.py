"""Images that do not belong to their geometry are named; right ones, made difficult, are not.

Objects are projected along rays of the study's own code, which shares nothing with the
projectors.
"""

from __future__ import annotations

from dataclasses import replace

import bias_bound
import misfits
import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import bias_warnings, fdk
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.bias import Bias
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.consistency.agreement import (
    Contradiction,
    Undetermined,
)
from flexdt.twin.reconstruction.consistency.suspects import suspects

SHAPE = (30, 60)
TURN = np.arange(100) * 3.6


def brick(aside: float = 0.0) -> bias_bound.Scan:
    """A box with two rods and a hole, without any symmetry."""
    scan = ConeVec.circular(
        sod=110.0, sdd=220.0, angles=TURN, shape=SHAPE, pixel=1.6, offset=(aside, 0.0)
    )
    solids = [
        bias_bound.Solid("box", np.zeros(3), np.array([12.0, 8.0, 8.0]), 0.3, 0.02),
        bias_bound.Solid(
            "cylinder", np.array([6.0, 2.0, 0.0]), np.array([2.0, 2.0, 6.0]), 0.0, 0.03
        ),
        bias_bound.Solid(
            "cylinder", np.array([-4.0, -3.0, 1.0]), np.array([2.5, 2.5, 4.0]), 0.0, -0.02
        ),
    ]
    return bias_bound.Scan("", scan, SHAPE, solids, 0.0, 0.0, 0)


def looked_at(kind: str, aside: float = 0.0) -> Bias:
    """What is found where something was done to the brick's images or geometry."""
    scan = brick(aside)
    change, names = {**misfits.WRONG, **dict.fromkeys(misfits.RIGHT, (None, None))}[kind]
    change = change or misfits.RIGHT[kind]
    images, geometry = change(scan.images(), scan.geometry, np.random.default_rng(3))
    case = misfits.Case(
        kind, np.ascontiguousarray(images, np.float32), geometry, scan, names
    )
    bias = misfits.looked_at(case)
    assert bias is not None
    return bias


@pytest.mark.parametrize(
    ("kind", "aside"),
    [
        ("mirrored", 0.0),
        ("backward", 0.0),
        ("interlaced", 0.0),
        ("alphabetical", 0.0),
        ("shifted", 0.0),
        ("other side", 20.0),
        ("mirrored", 20.0),
    ],
)
@pytest.mark.daily(4)
def test_what_contradicts_is_named_and_no_accuracy_is_claimed(
    kind: str, aside: float
) -> None:
    bias = looked_at(kind, aside)
    assert bias.contradiction is not None
    assert misfits.WRONG[kind][1] & set(bias.contradiction.kinds)
    grid = Grid((16, 30, 30), 1.0)
    assert bias.accuracy(grid) is None
    assert bias.bound(grid.blank()) is None
    (told,) = bias_warnings(bias, grid)
    assert told.startswith(
        "no accuracy is claimed: images and geometry contradict each other"
    )


def test_the_offset_is_right_within_half_a_pixel() -> None:
    scan = brick()
    moved = misfits._moved(scan.geometry, -4.0)
    case = misfits.Case("shifted", scan.images(), moved, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert bias.contradiction is not None
    figure = bias.contradiction.figures[bias.contradiction.kinds.index("offset")]
    assert float(figure.split()[1]) == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize("kind", list(misfits.RIGHT))
@pytest.mark.parametrize("aside", [0.0, 20.0])
@pytest.mark.daily(4)
def test_right_images_are_not_told_anything(kind: str, aside: float) -> None:
    assert looked_at(kind, aside).contradiction is None


def steps(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Draw by how many pixels each image is moved along its rows and columns."""
    step = np.zeros((len(TURN), 2), int)
    late = len(TURN) * 2 // 5
    if kind == "swing":
        step[:, 0] = np.round(4.0 * np.sin(3.0 * np.radians(TURN)))
    elif kind == "jump":
        step[late:, 0] = 3
    elif kind == "jitter":
        step[:, 0] = rng.integers(-3, 4, len(TURN))
    elif kind == "fall":
        step[late:, 1] = 3
    return step


@pytest.mark.parametrize("kind", ["swing", "jump", "jitter", "fall"])
def test_movement_between_views_is_named(kind: str) -> None:
    scan = brick()
    moves = steps(kind, np.random.default_rng(8))
    images = np.stack(
        [
            np.roll(image, (down, along), (0, 1))
            for image, (along, down) in zip(scan.images(), moves.tolist(), strict=True)
        ]
    )
    case = misfits.Case(kind, images, scan.geometry, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert bias.contradiction is not None
    assert bias.contradiction.kinds == ("movement",)
    words = bias.contradiction.figures[0].split()
    along, below = float(words[3]), float(words[8])
    assert (below > along) == (kind == "fall")
    assert 1.0 < max(along, below) < 6.0


def test_movement_of_thin_wires_is_seen_by_their_centroids() -> None:
    scan = brick()
    wires = [
        bias_bound.Solid("cylinder", np.array([x, y, 0.0]), np.array([0.4, 0.4, 8.0]), 0, 0.3)
        for x, y in ((9.0, 2.0), (-3.0, 7.0), (-8.0, -6.0), (1.0, -4.0))
    ]  # fmt: skip
    scan = replace(scan, solids=wires, geometry=scan.geometry[::3])
    images = scan.images()
    still = misfits.Case("still", images, scan.geometry, scan, frozenset())
    found = misfits.looked_at(still)
    assert found is not None
    assert found.contradiction is None
    moves = np.round(3.0 * np.sin(5.0 * np.radians(TURN[::3]))).astype(int)
    moved = np.stack([np.roll(a, k, 1) for a, k in zip(images, moves, strict=True)])
    bias = misfits.looked_at(replace(still, images=moved))
    assert bias is not None
    assert bias.contradiction is not None
    assert bias.contradiction.kinds == ("movement",)


def test_an_explanation_that_the_images_refute_is_not_named() -> None:
    """Views too few for the misfit to contradict by itself, a panel 4 px off, and line
    integrals that swing by 40 %: the right offset fits far better, and badly."""
    scan = brick()
    scan = replace(scan, geometry=scan.geometry[::3])
    swing = 1.0 + 0.4 * np.sin(10.0 * np.pi * np.arange(34) / 34)
    images = (scan.images() * swing[:, None, None]).astype(np.float32)
    moved = misfits._moved(scan.geometry, 4.0)
    case = misfits.Case("shifted", images, moved, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert isinstance(bias.contradiction, Contradiction)
    assert not bias.contradiction.kinds
    assert not bias.contradiction.by_misfit_alone
    assert bias.accuracy(Grid((16, 30, 30), 1.0)) is None


def helix(rise: float, hand: float = 1.0) -> ConeVec:
    """Three turns over 3 times the rise; the hand is the sign of the angles."""
    return ConeVec.helical(
        sod=110.0,
        sdd=220.0,
        angles=hand * np.arange(300) * 3.6,
        rise=hand * rise,
        shape=SHAPE,
        pixel=1.6,
    )


def rod(half_mm: float, geometry: ConeVec) -> bias_bound.Scan:
    """A box so high with a rod in its upper and a hole in its lower half."""
    scan = brick()
    times = np.array([1.0, 1.0, half_mm / 8.0])
    sides = np.array([0.0, 0.4, -0.4]) * half_mm
    solids = [
        replace(one, centre=np.array([*one.centre[:2], z]), half=one.half * times)
        for one, z in zip(scan.solids, sides, strict=True)
    ]
    return replace(scan, solids=solids, geometry=geometry)


@pytest.mark.parametrize("rise", [12.0, -12.0])
@pytest.mark.parametrize("half_mm", [11.0, 60.0])
@pytest.mark.daily(4)
def test_a_helix_of_the_other_hand_is_named(half_mm: float, rise: float) -> None:
    """Of an object that ends within the helix, and one that goes on beyond it."""
    scan = rod(half_mm, helix(rise))
    images = scan.images()
    grid = Grid((10, 30, 30), 1.0)
    case = misfits.Case("", images, scan.geometry, scan, frozenset())
    right = misfits.looked_at(case)
    assert right is not None
    assert right.contradiction is None
    assert right.accuracy(grid) is not None
    wrong = misfits.looked_at(replace(case, geometry=helix(rise, -1.0)))
    assert wrong is not None
    assert wrong.contradiction is not None
    assert set(wrong.contradiction.kinds) == {"direction", "columns"}
    assert wrong.accuracy(grid) is None


def test_a_helix_whose_rows_leave_its_volume_is_not_compared() -> None:
    """A turn and a tenth along a longer object: hardly a row stays among known layers."""
    steep = helix(17.0)[:110]
    scan = rod(80.0, steep)
    case = misfits.Case("", scan.images(), steep, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert isinstance(bias.contradiction, Undetermined)
    assert "of a short helix" in str(bias.contradiction)


def drum(rod_mm: float) -> bias_bound.Scan:
    """A cylinder with a rod and a hole in one half, in a beam of 9 degrees: reversed images are
    nearly those of the mirrored body."""
    scan = ConeVec.circular(sod=300.0, sdd=600.0, angles=TURN, shape=SHAPE, pixel=1.6)
    solids = [
        bias_bound.Solid("cylinder", np.zeros(3), np.array([17.0, 17.0, 8.0]), 0.0, 0.02),
        bias_bound.Solid(
            "cylinder",
            np.array([9.0, 3.0, 0.0]),
            np.array([rod_mm, rod_mm, 6.0]),
            0.0,
            0.02,
        ),
        bias_bound.Solid(
            "box", np.array([-2.0, 8.0, 0.0]), np.array([rod_mm, 3.0, 6.0]), 0.4, -0.02
        ),
    ]
    return bias_bound.Scan("", scan, SHAPE, solids, 0.0, 0.0, 0)


@pytest.mark.parametrize("rod_mm", [2.0, 4.0])
@pytest.mark.parametrize("reversed_", [False, True])
def test_accuracy_is_claimed_only_where_the_sense_of_rotation_is_told(
    rod_mm: float, reversed_: bool
) -> None:
    scan = drum(rod_mm)
    images = scan.images()
    if reversed_:
        images = images[np.r_[0, np.arange(len(images) - 1, 0, -1)]]
    case = misfits.Case("", images, scan.geometry, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    accuracy = bias.accuracy(Grid((16, 30, 30), 1.0))
    assert (accuracy is None) == reversed_
    if reversed_:
        assert bias.contradiction is not None
        assert "direction" in bias.contradiction.kinds


@pytest.mark.parametrize("reversed_", [False, True])
def test_what_the_coarse_copy_leaves_undecided_a_finer_one_tells(reversed_: bool) -> None:
    """In a beam of 4.5 degrees 40 nodes do not tell the sense of rotation, 80 do."""
    narrow = ConeVec.circular(sod=600, sdd=1200, angles=TURN, shape=SHAPE, pixel=1.6)
    scan = replace(drum(3.0), geometry=narrow)
    images = scan.images()
    if reversed_:
        images = images[np.r_[0, np.arange(len(images) - 1, 0, -1)]]
    case = misfits.Case("", images, narrow, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert (bias.accuracy(Grid((16, 30, 30), 1.0)) is None) == reversed_
    if reversed_:
        assert bias.contradiction is not None
        assert bias.contradiction.kinds == ("direction",)


@pytest.mark.parametrize("seed", range(3))
def test_the_reverse_order_of_uneven_views_is_named(seed: int) -> None:
    """Some views are lost, so that the reverse order is no opposite rotation."""
    kept = np.sort(np.random.default_rng(seed).choice(len(TURN), 80, replace=False))
    scan = brick()
    images = np.ascontiguousarray(scan.images()[kept][::-1])
    case = misfits.Case("", images, scan.geometry[kept], scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert bias.contradiction is not None
    assert "reversed" in bias.contradiction.kinds


def test_a_mirrored_body_in_a_parallel_beam_is_not_decided() -> None:
    """No image tells the sense of rotation of parallel rays."""
    far = ConeVec.circular(sod=3e5, sdd=3.3e5, angles=TURN, shape=SHAPE, pixel=0.88)
    scan = replace(drum(4.0), geometry=far)
    case = misfits.Case("", scan.images(), far, scan, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert bias.contradiction is not None
    assert "they fit as well if the rotation runs the other way" in str(
        bias.contradiction
    )
    turned = replace(scan, solids=scan.solids[:2])  # mirror images of themselves
    case = misfits.Case("", turned.images(), far, turned, frozenset())
    bias = misfits.looked_at(case)
    assert bias is not None
    assert bias.contradiction is None
    assert bias.accuracy(Grid((16, 30, 30), 1.0)) is not None


def test_a_better_fit_is_told_however_little_is_claimed() -> None:
    """A large claimed error covers no order that fits better."""
    angles = 2.2 * 360.0 / 81.0 * np.arange(81)
    aside = ConeVec.circular(
        sod=110, sdd=220, angles=angles, shape=SHAPE, pixel=1.6, offset=(40.8, 0.0)
    )
    scan = replace(brick(), geometry=aside)
    images, _ = misfits.alphabetical(scan.images(), aside, np.random.default_rng(3))
    bias = misfits.looked_at(misfits.Case("", images, aside, scan, frozenset()))
    assert bias is not None
    assert isinstance(bias.contradiction, Contradiction)
    assert bias.contradiction.kinds == ("names",)
    assert "they fit better if" in str(bias.contradiction)


@pytest.mark.parametrize("draw", range(6))
def test_mirrored_images_are_tried_about_the_middle_of_the_panel(draw: int) -> None:
    """Coarse pixels that do not fill the panel leave its end out. Points of the object are
    at the same places of the explanation's images and of its geometry."""
    rng = np.random.default_rng([59, draw])
    shape = int(rng.integers(41, 120)), int(rng.integers(41, 120))
    offset = tuple(rng.uniform(-30.0, 30.0, 2))
    tilts = tuple(rng.uniform(-4.0, 4.0, 3))
    right = ConeVec.circular(
        sod=400, sdd=700, angles=TURN, shape=shape, pixel=1.1, offset=offset, tilts=tilts
    )
    blank = np.zeros(shape, np.float32)
    coarse = CoarseScan.of(lambda _: blank, right, shape, None).thinned()
    places = rng.uniform(-15.0, 15.0, (5, 3))
    tried = {one.kind: one for one in suspects(coarse, whole=True)}
    for kind, sides in {"columns": (0,), "rows": (1,), "turned": (0, 1)}.items():
        seen = right[coarse.numbers].project_points(places, shape)
        for side in sides:
            seen[..., side] = shape[1 - side] - 1 - seen[..., side]
        coarsely = (seen + 0.5) / coarse.binned[::-1] - 0.5
        size = coarse.images.shape[1:]
        for side in sides:
            coarsely[..., side] = size[1 - side] - 1 - coarsely[..., side]
        found = tried[kind].cone_vec.project_points(places, size)
        np.testing.assert_allclose(found, coarsely, atol=1e-6)


def test_nothing_is_claimed_of_images_that_fit_any_volume() -> None:
    """Ten views, and a panel with hardly a column beyond the axis."""
    scan = brick()
    few = replace(scan, geometry=scan.geometry[::10])
    edge = brick(aside=46.0)
    edge = replace(edge, geometry=edge.geometry[::4])
    for one, cause in ((few, "fewer than 12 views"), (edge, "a panel so far aside")):
        case = misfits.Case("", one.images(), one.geometry, one, frozenset())
        bias = misfits.looked_at(case)
        assert bias is not None
        assert isinstance(bias.contradiction, Undetermined)
        assert cause in str(bias.contradiction)
        assert bias.accuracy(Grid((16, 30, 30), 1.0)) is None


@pytest.mark.parametrize("aside", [0.0, 30.0])
@pytest.mark.parametrize("seed", range(5))
def test_some_views_leave_arcs_out_only_where_all_do(seed: int, aside: float) -> None:
    """FDK weighs the rays of a panel aside otherwise where views leave arcs out."""
    angles = np.random.default_rng([seed, 7]).uniform(0.0, 360.0, 130)
    geometry = ConeVec.circular(
        sod=110, sdd=220, angles=angles, shape=SHAPE, pixel=1.6, offset=(aside, 0.0)
    )
    blank = np.zeros(SHAPE, np.float32)
    scan = CoarseScan.of(lambda _: blank, geometry, SHAPE, None)
    assert circle_of(scan.cone_vec).full == scan.circle.full
    assert circle_of(scan.thinned().cone_vec).full == scan.circle.full


def test_volumes_of_voxels_that_hold_no_region_claim_nothing() -> None:
    scan = brick()
    with pytest.warns(
        UserWarning, match="accuracy is not known: voxels of 30 mm are too large"
    ):
        volume = fdk(scan.images(), scan.geometry, Grid((1, 1, 1), 30.0))
    assert volume.accuracy is None


@pytest.mark.parametrize("kind", ["flats that disagree", "falling beam"])
def test_an_open_beam_that_is_not_the_flat_is_no_truncation(kind: str) -> None:
    """A flat that is 1.25 times as bright as the scan's beam, and a beam that falls by a fifth:
    the bound holds, and says why."""
    scan = brick()
    images = scan.images()
    when = (
        np.linspace(0.0, 1.0, len(images))
        if kind == "falling beam"
        else np.ones(len(images))
    )
    images = images + np.float32(np.log(1.25)) * when[:, None, None].astype(np.float32)
    with pytest.warns(
        UserWarning, match="an open beam beside the object that is not the flat"
    ):
        volume = fdk(images, scan.geometry, Grid((16, 30, 30), 1.0))
    uniform = slice(6, 10), slice(14, 19), slice(13, 17)
    assert volume.bias_bound is not None
    error = abs(float(volume.data[uniform].mean()) - 0.02)
    assert 0.05 * 0.02 < error <= volume.bias_bound[uniform].mean()


@pytest.mark.slow
@pytest.mark.campaign(2)
@pytest.mark.parametrize("count", [10, 40])
@pytest.mark.parametrize(("right", "most"), [(False, 0.15), (True, 0.02)])
def test_the_study_in_its_short_form(right: bool, most: float, count: int) -> None:
    """Drawn scans that chose no constant."""
    good = []
    for number in range(count):
        case = misfits.drawn(4159, number, right=right)
        if case is not None:
            good.append(misfits.judged(case, misfits.looked_at(case))[1])
    assert len(good) > count // 4
    assert np.mean(good) >= 1.0 - most
