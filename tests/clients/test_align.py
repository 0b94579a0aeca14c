"""`flexdt align`: the axis of scans without a phantom, against ellipsoids whose line integrals
and kinematics are written out here, with scanners drawn by a seed."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path

import align_faults
import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.twin.calibration.without_phantom.plane_pairs import PlanePairs
from flexdt.twin.calibration.without_phantom.tile_gap import (
    averaged_rows,
    local_gaps,
)
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.scanner.state import NamedCorrection

SHAPE, PITCH, SOD, SDD = (100, 120), 1.0, 600.0, 1059.0


@dataclass
class Scanner:
    """The source is the origin, y goes along the beam, z up [mm, rad]."""

    axis_x: float
    panel_x: float
    panel_z: float
    roll: float
    pitch: float
    yaw: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Scanner:
        roll, pitch, yaw = np.radians(rng.normal(0, (0.7, 0.3, 0.3)))
        return cls(
            rng.uniform(-3, 3), rng.normal(0, 0.25), rng.uniform(-4, 4), roll, pitch, yaw
        )

    def panel(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centre, u and v: turned by yaw about -z, pitch about u, roll about u x v."""
        u, v = np.array([1.0, 0, 0]), np.array([0, 0, -1.0])
        for which, angle in (("v", self.yaw), ("u", self.pitch), ("n", self.roll)):
            axis = {"v": v, "u": u, "n": np.cross(u, v)}[which]
            u, v = (
                math.cos(angle) * p
                + math.sin(angle) * np.cross(axis, p)
                + (1 - math.cos(angle)) * (axis @ p) * axis
                for p in (u, v)
            )
        return np.array([self.panel_x, SDD, self.panel_z]), PITCH * u, PITCH * v

    def axis(self) -> tuple[float, float]:
        """The column where the axis crosses the middle row, and the columns it moves each
        row."""
        centre, u, v = self.panel()
        seen = []
        for z in (-9.0, 9.0):
            ray = np.array([self.axis_x, SOD, z])
            seen.append(np.linalg.solve(np.array([u, v, -ray]).T, -centre)[:2])
        (c0, r0), (c1, r1) = seen
        slope = (c1 - c0) / (r1 - r0)
        return c0 - r0 * slope + (SHAPE[1] - 1) / 2, slope

    def row(self) -> float:
        """The row in which the source sees the point of the axis at its own height."""
        centre, u, v = self.panel()
        ray = np.array([self.axis_x, SOD, 0.0])
        return float(
            np.linalg.solve(np.array([u, v, -ray]).T, -centre)[1] + (SHAPE[0] - 1) / 2
        )

    def lines(
        self, bodies: np.ndarray, angles: np.ndarray, aside: np.ndarray | None = None
    ) -> np.ndarray:
        """Line integrals (n, rows, cols) of ellipsoids (k, 7): centre, half axes, 1/mm; frame k
        shows them `aside[k]` columns to the right and rows further down."""
        out = np.zeros((len(angles), *SHAPE), dtype=np.float32)
        for k, angle in enumerate(angles):
            centre, u, v = self.panel()
            c, r = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in SHAPE[::-1]))
            if aside is not None:
                c, r = c - aside[k, 0], r - aside[k, 1]
            rays = centre + c[..., None] * u + r[..., None] * v
            rays = (rays / np.linalg.norm(rays, axis=-1)[..., None]).astype(np.float32)
            for x, y, z, *half, density in bodies:
                # Clockwise seen from above: x turns to -y.
                at = np.array([x * math.cos(angle) + y * math.sin(angle) + self.axis_x,
                               y * math.cos(angle) - x * math.sin(angle) + SOD, z])  # fmt: skip
                a, b = half[:2]
                m = np.array([[math.cos(angle), math.sin(angle)],
                              [-math.sin(angle), math.cos(angle)]])  # fmt: skip
                q = np.diag([0.0, 0.0, 1 / half[2] ** 2])
                q[:2, :2] = m @ np.diag([1 / a**2, 1 / b**2]) @ m.T
                dq = rays @ q.astype(np.float32)
                dd, ds = np.einsum("rci,rci->rc", dq, rays), dq @ at
                root = np.maximum(ds**2 - dd * (at @ q @ at - 1), 0.0)
                out[k] += density * 2 * np.sqrt(root) / dd
        return out


def bodies(rng: np.random.Generator) -> np.ndarray:
    """A body with bubbles and grains in it."""
    inside = np.column_stack(
        [rng.uniform(-11, 11, (7, 2)), rng.uniform(-15, 15, 7), rng.uniform(2, 6, (7, 3)),
         rng.choice([-0.02, 0.03], 7)]
    )  # fmt: skip
    return np.vstack([[[1.0, -2.0, 0, 18, 16, 21, 0.02]], inside])


def data_set(
    lines: np.ndarray, degrees: np.ndarray, photons: float, rng: np.random.Generator,
    ramp: float = 0.0,
) -> fx.DataSet:  # fmt: skip
    flat = rng.poisson(photons, (30, *SHAPE)).mean(axis=0) * 4
    flat *= 1 + ramp * np.linspace(-0.5, 0.5, SHAPE[1])
    counts = rng.poisson(photons * np.exp(-lines)) * 4
    cone = fx.ConeVec.circular(sod=SOD, sdd=SDD, angles=degrees, shape=SHAPE, pixel=PITCH)
    return fx.DataSet.from_arrays(counts, cone, dark=np.zeros(SHAPE), flat=flat)


DEGREES = np.arange(48) * 7.5


@functools.cache
def scan(seed: int) -> tuple[Scanner, np.ndarray]:
    """One of ten scanners, with a body of its own."""
    rng = np.random.default_rng([18, seed])
    scanner = Scanner.drawn(rng)
    return scanner, scanner.lines(bodies(rng), np.radians(DEGREES))


def pulls(found: object, scanner: Scanner) -> tuple[float, float]:
    """Error over sigma of the column and of the axis's direction, by the corrected geometry."""
    assert isinstance(found.document, dict)  # type: ignore[attr-defined]
    data = found.dataset.with_correction(found.correction)  # type: ignore[attr-defined]
    (c0, r0), (c1, r1) = data.geometry.project_points([[0, 0, -9], [0, 0, 9]])[0]
    slope = (c1 - c0) / (r1 - r0)
    column = c0 + ((SHAPE[0] - 1) / 2 - r0) * slope
    told = found.parameters  # type: ignore[attr-defined]
    true_column, true_slope = scanner.axis()
    assert told["axis_column_px"]["value"] == pytest.approx(column, abs=1e-6)
    return (
        (column - true_column) / told["axis_column_px"]["sigma"],
        math.degrees(slope - true_slope) / told["det_roll"]["sigma"],
    )


def aligned(k: int, photons: float, column: float, roll: float) -> tuple[object, Scanner]:
    """What is found in scan `k`, its sigmas [px, deg] below those allowed.

    Images of 100 photons do not exclude a gap of the panel beside the axis (the likelihood of
    one of half a pixel is no less than that of none): the column's sigma has to contain it.
    """
    scanner, lines = scan(k)
    found = data_set(lines, DEGREES, photons, np.random.default_rng(k)).align()
    assert found.identifiable
    sigma = found.parameters["axis_column_px"]["sigma"]
    if photons < 1000 and any("do not exclude that a tile" in w for w in found.warnings):
        assert 0.25 < sigma < 0.4
    else:
        assert sigma < column
    assert found.parameters["det_roll"]["sigma"] < roll
    return found, scanner


@pytest.mark.daily(1)
@pytest.mark.parametrize("k", range(3))
@pytest.mark.campaign
def test_column_and_roll_are_where_they_are(k: int) -> None:
    found, scanner = aligned(k, 1e4, 0.04, 0.06)
    assert np.abs(pulls(found, scanner)).max() < 4
    if "source_row_px" in found.parameters:
        assert abs(row_pull(found, scanner)[1]) < 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("photons", "column", "roll"), [(1e4, 0.04, 0.06), (100, 0.15, 0.3)]
)
@pytest.mark.campaign
def test_column_and_roll_are_where_they_are_within_their_sigmas(
    photons: float, column: float, roll: float
) -> None:
    off, rows = [], []
    for k in range(10):
        found, scanner = aligned(k, photons, column, roll)
        if "source_row_px" in found.parameters:
            rows.append(row_pull(found, scanner))
        off.append(pulls(found, scanner))
        # An open gap widens the sigma, not the error.
        assert abs(off[-1][0]) * found.parameters["axis_column_px"]["sigma"] < column
    assert np.abs(off).max() < 4
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.7).all()
    if photons < 1000:  # the row cannot be told, and nothing is told of it
        assert not rows
    else:
        error, pull = np.array(rows).T
        assert len(rows) >= 6
        assert np.abs(pull).max() < 4
        assert np.sqrt(np.mean(error**2)) < 0.7
        assert np.sqrt(np.mean(pull**2)) < 1.7


def row_pull(found: object, scanner: Scanner) -> tuple[float, float]:
    """Error [px] and error over sigma of the row of the source's plane."""
    told = found.parameters["source_row_px"]  # type: ignore[attr-defined]
    data = found.dataset.with_correction(found.correction)  # type: ignore[attr-defined]
    geometry = data.geometry
    seen = geometry.project_points([[0, 0, geometry.source[0, 2]]])[0, 0, 1]
    assert told["value"] == pytest.approx(seen, abs=1e-6)  # the correction says the same
    error = told["value"] - scanner.row()
    return error, error / told["sigma"]


@pytest.mark.daily(1)
def test_a_pattern_that_stays_on_the_panel_says_nothing_of_the_row() -> None:
    """All frames of a scan share the noise of its flat image: it changes no sum of squares,
    while that of the frames still tells a height from another."""
    scanner = Scanner(0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    lines = scanner.lines(bodies(np.random.default_rng(1)), np.radians(DEGREES))

    def views(at: np.ndarray) -> fx.ConeVec:
        return fx.ConeVec.circular(
            sod=SOD, sdd=SDD, angles=DEGREES, shape=SHAPE, pixel=PITCH,
            offset=(0.0, scanner.panel_z + float(at[0]) * PITCH),
        )  # fmt: skip

    pairs = PlanePairs(lines, lines.mean(axis=0, dtype=np.float64), 1, views, np.zeros(1))
    pattern = np.random.default_rng(5).normal(0, 0.05, (SHAPE[1], SHAPE[0] + 1))
    spoilt = pairs.sums + np.cumsum(pattern, axis=1, dtype=np.float32)
    totals = []
    for height in (0.0, 2.0, 9.0):
        alone, both = (pairs.costs(np.array([height]), s) for s in (None, spoilt))
        totals.append(pairs.total(alone))
        assert pairs.total(both) == pytest.approx(totals[-1], rel=0.01)
    assert (totals[2] > 1.5 * totals[0]).all()


@pytest.mark.parametrize(
    ("high", "wide"), [pytest.param(60.0, 14.0, marks=pytest.mark.slow), (14.0, 45.0)]
)
def test_the_row_is_right_above_and_below_the_panel_and_refused_beside_it(
    high: float, wide: float
) -> None:
    scanner, _ = scan(0)
    body = bodies(np.random.default_rng(3))
    body[0] = [0, 0, 0, wide, wide, high, 0.01]
    lines = scanner.lines(body, np.radians(DEGREES))
    found = data_set(lines, DEGREES, 1e4, np.random.default_rng(1)).align()
    if wide > high:
        assert "source_row_px" in found.document["refused"]
    elif "source_row_px" in found.parameters:
        assert abs(row_pull(found, scanner)[1]) < 4


@pytest.mark.parametrize(
    ("size", "photons"),
    [(0.3, 1e4), pytest.param(0.0, 1e4, marks=pytest.mark.slow),
     pytest.param(0.3, 300, marks=pytest.mark.slow)],
)  # fmt: skip
@pytest.mark.slow
@pytest.mark.campaign(1)
def test_shifts_of_single_frames_are_found_with_their_sigmas(
    size: float, photons: float
) -> None:
    rng, degrees = np.random.default_rng(7), np.arange(120) * 3.0
    scanner = Scanner.drawn(rng)
    aside = rng.normal(0, size, (120, 2))
    lines = scanner.lines(bodies(rng), np.radians(degrees), aside)
    data = data_set(lines, degrees, photons, rng)
    found = data.align(per_frame=True)
    place = [[0.0, 0.0, 0.0]]
    seen = found.dataset.geometry.project_points(place) - data.geometry.project_points(
        place
    )
    turn = np.radians(degrees)
    # The geometry takes up what all frames have in common, the object what turns with it.
    modes = np.column_stack([np.ones(120), np.cos(turn), np.sin(turn)])
    left = seen[:, 0] - aside
    left -= modes @ np.linalg.lstsq(modes, left, rcond=None)[0]
    motion = found.alignment.motion
    assert motion is not None
    sigma = motion.sigma.mean(axis=0) * SDD / SOD / PITCH
    moves = [bool(m["moves"]) for m in motion.to_dict().values()]
    if size == 0.0:
        assert moves == [False, False]
        assert np.abs(seen).max() < 1e-9
        return
    assert moves == [photons > 1000, True]  # with little light only up and down
    for i, known in ((0, 0.06), (1, 0.02)) if photons > 1000 else ((1, 0.1),):
        assert left[:, i].std() < known
        assert 0.4 < left[:, i].std() / sigma[i] < 1.3


@pytest.mark.daily(1)
@pytest.mark.parametrize("k", range(2))
@pytest.mark.parametrize("spoilt", ["ramp", "missing frames", "missed step"])
@pytest.mark.campaign(2)
def test_a_ramp_of_the_flat_field_and_missing_frames_do_not_mislead(
    spoilt: str, k: int
) -> None:
    scanner, lines = scan(k)
    frames = {
        "ramp": np.arange(48),
        "missing frames": np.setdiff1d(np.arange(48), [20, 21, 40]),
        "missed step": np.r_[:31, 30, 31:47],
    }[spoilt]
    degrees = DEGREES if spoilt == "missed step" else DEGREES[frames]
    ramp = 0.01 if spoilt == "ramp" else 0.0
    found = data_set(
        lines[frames], degrees, 1e4, np.random.default_rng(k), ramp=ramp
    ).align()
    assert np.abs(pulls(found, scanner)).max() < 4


@pytest.mark.daily(1)
@pytest.mark.parametrize("k", range(3))
def test_what_slips_aside_and_stays_is_told(k: int) -> None:
    scanner, lines = scan(k)
    aside = (lines + np.roll(lines, 1, axis=2)) / 2
    slipped = np.concatenate([lines[:20], aside[20:]])
    found = data_set(slipped, DEGREES, 1e4, np.random.default_rng(k)).align()
    assert "after frame 19 the images step" in " ".join(found.warnings)
    assert np.abs(pulls(found, scanner)).max() < 4


@pytest.mark.slow
@pytest.mark.parametrize("rays", [1, 3])
@pytest.mark.campaign(1)
def test_flat_ends_along_the_rows_in_images_of_few_rays_a_pixel_do_not_mislead(
    rays: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "SHAPE", (64, 80))
    monkeypatch.setitem(globals(), "PITCH", 0.7)
    off = []
    for seed in (*range(3, 6), *range(8, 14)):
        rng = np.random.default_rng([181, seed])
        scanner = Scanner.drawn(rng)
        scanner.pitch, scanner.yaw = 0.0, 0.0  # leave the ends along the rows
        scanner.roll = math.radians(rng.normal(0, 0.4))
        size = rng.uniform((14, 9, 9), (20, 16, 13))
        middle = np.array([*rng.uniform(-2, 2, 2), rng.uniform(-0.4, 0.4) - size[2] / 2])
        lines = box_lines(scanner, middle - size / 2, middle + size / 2, rays)
        found = data_set(lines, DEGREES, 1.5e4, rng).align()
        if found.identifiable:
            off.append(pulls(found, scanner))
        if "source_row_px" in found.parameters:
            assert abs(row_pull(found, scanner)[1]) < 4
    assert len(off) >= 6
    assert np.abs(off).max() < 4
    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.7).all()


def box_lines(
    scanner: Scanner, low: np.ndarray, high: np.ndarray, rays: int
) -> np.ndarray:
    """Line integrals of a box of 0.02 1/mm; the mean over rays x rays a pixel, (n, rows,
    cols)."""
    centre, u, v = scanner.panel()
    fine = [(np.arange(n * rays) + 0.5) / rays - n / 2 for n in SHAPE[::-1]]
    c, r = np.meshgrid(*fine)
    ray = centre + c[..., None] * u + r[..., None] * v
    out = []
    for angle in np.radians(DEGREES):
        turn = np.array([[math.cos(angle), -math.sin(angle), 0],
                         [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])  # fmt: skip
        start, way = turn @ -np.array([scanner.axis_x, SOD, 0]), ray @ turn.T
        ends = np.stack([(low - start) / way, (high - start) / way])
        inside = ends.max(axis=0).min(axis=-1) - ends.min(axis=0).max(axis=-1)
        chord = np.maximum(inside, 0) * np.linalg.norm(ray, axis=-1)
        out.append(0.02 * chord.reshape(SHAPE[0], rays, SHAPE[1], rays).mean(axis=(1, 3)))
    return np.array(out)


@pytest.mark.slow
@pytest.mark.campaign
def test_what_spoils_scans_misleads_nobody(capsys: pytest.CaptureFixture[str]) -> None:
    assert align_faults.main(["--count", "8", "--seed", "4"]) == 0, (
        capsys.readouterr().out
    )
    assert re.search(r"^all +8 +[5-8] ", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.slow
def test_a_round_body_that_turns_back_is_no_repeated_frame() -> None:
    scanner, degrees = scan(0)[0], np.arange(120) * 3.0
    rod = np.array([[9.0, 4.0, 0, 11, 11, 21, 0.02]])
    lines = scanner.lines(rod, np.radians(degrees))
    found = data_set(lines, degrees, 1.5e4, np.random.default_rng(3)).align()
    assert not found.warnings
    assert np.abs(pulls(found, scanner)).max() < 4


@pytest.mark.slow
def test_an_exact_copy_of_a_frame_is_left_out_by_name() -> None:
    scanner, lines = scan(0)
    data = data_set(lines, DEGREES, 1e4, np.random.default_rng(1))
    counts = data.counts().copy()
    counts[31] = counts[30]
    found = fx.DataSet.from_arrays(
        counts, data.geometry, dark=data.dark, flat=data.flat
    ).align()
    assert "[31] repeat" in " ".join(found.warnings)
    assert np.abs(pulls(found, scanner)).max() < 4


def apart(true: np.ndarray, column: int, width: int) -> np.ndarray:
    """Images whose right tile shows what lies `width` columns further to the right."""
    there = np.arange(SHAPE[1])
    return true[
        ..., np.minimum(there + np.where(there >= column, width, 0), SHAPE[1] - 1)
    ]


@pytest.mark.slow
def test_a_frame_that_is_exposed_again_is_left_out_though_the_beam_flickers() -> None:
    scanner, lines = scan(0)
    lines = np.array(lines)
    lines[32] = lines[31]
    lines += 0.01 * np.random.default_rng(2).normal(size=(len(lines), 1, 1))
    found = data_set(lines, DEGREES, 1e4, np.random.default_rng(1)).align()
    assert "[32] repeat" in " ".join(found.warnings)
    assert np.abs(pulls(found, scanner)).max() < 4


def test_two_gaps_are_refused_by_their_columns() -> None:
    true = np.array(scan(0)[1])
    true += np.random.default_rng(1).normal(0, 0.01, true.shape)
    twice = apart(apart(true, 78, 2), 44, 2).astype(np.float32)
    frames = [averaged_rows(g) for g in twice]
    seen = local_gaps(frames, scan(0)[0].axis()[0])
    assert sorted(gap.column for gap in seen) == [44, 76]
    twice = apart(apart(true, 85, 2), 50, 2).astype(np.float32)
    found = data_set(twice, DEGREES, 1e4, np.random.default_rng(1)).align()
    assert "from columns 50 and 83 on" in found.alignment.refused["axis_column_px"]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
@pytest.mark.campaign(1)
def test_a_gap_between_tiles_is_closed_whether_it_is_found_or_given(seed: int) -> None:
    scanner, lines = scan(seed)
    data = data_set(apart(np.array(lines), 75, 2), DEGREES, 1e4, np.random.default_rng(1))
    found = data.align()
    assert "from column 75 on" in " ".join(found.warnings)
    assert np.abs(pulls(found, scanner)).max() < 4
    panel = Panel.from_json(json.loads(json.dumps(found.document["panel"])))
    assert panel.shift(np.array([[74.0, 9.0], [76.0, 9.0]]))[:, 0] == pytest.approx(
        [0, -2.0], abs=0.1
    )
    assert found.correction.panel == panel
    given = data.with_correction(
        dataclasses.replace(found.correction, parameters=NOMINAL)
    ).align()
    assert "between two tiles" not in " ".join(given.warnings)
    assert given.document["panel"] == found.document["panel"]
    assert np.abs(pulls(given, scanner)).max() < 4
    whole = data_set(np.array(lines), DEGREES, 1e4, np.random.default_rng(1)).align()
    assert "between two tiles" not in " ".join(whole.warnings)
    assert "panel" not in whole.document


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.daily(2)
def test_a_gap_stands_out_beside_a_dead_column(seed: int) -> None:
    rng = np.random.default_rng(seed)
    column, width = int(rng.integers(45, 75)), 2
    true = np.array(scan(seed % 3)[1])
    true += rng.normal(0, 0.01, true.shape)
    true[..., 30] = 3.0
    frames = [averaged_rows(g) for g in apart(true, column, width).astype(np.float32)]
    axis = scan(seed % 3)[0].axis()[0]
    (gap,) = local_gaps(frames, axis)
    assert gap.column == column
    assert abs(gap.width - width) < 2 * gap.sigma
    assert not local_gaps([averaged_rows(g) for g in true.astype(np.float32)], axis)
    assert not local_gaps(frames, axis, [column - 0.5])
    undone = dataclasses.replace(Panel.flat(SHAPE), lag=0.02)
    panel = gap.panel(SHAPE, undone)
    assert panel.shift(np.array([119.0, 0.0]))[0] == pytest.approx(-gap.width)
    assert panel.lag == undone.lag


def test_lag_of_a_calibration_is_undone() -> None:
    """Every frame shows a part of the light of the one before, as a panel with lag does."""
    _, lines = scan(0)
    true, lag = np.array(lines), 0.05
    light = np.exp(-true)
    light[1:] = (1 - lag) * light[1:] + lag * light[:-1].copy()
    geometry = data_set(true, DEGREES, 1e4, np.random.default_rng(1)).geometry
    data = fx.DataSet.from_arrays(-np.log(light), geometry)
    panel = dataclasses.replace(Panel.flat(SHAPE), lag=lag)
    assert Panel.from_json(json.loads(json.dumps(panel.to_json()))).lag == lag
    undone = data.with_correction(NamedCorrection("a", "", NOMINAL, panel=panel))

    def off(one: fx.DataSet, first: int = 0) -> float:
        return float(
            np.sqrt(np.mean((one.stack()[2:] - true[first + 2 : first + len(one)]) ** 2))
        )

    assert off(undone) < 0.1 * off(data)
    assert off(undone[10:20], 10) < 0.1 * off(data)
    assert np.array_equal(
        undone[::2].stack(), data[::2].stack()
    )  # none after the one before
    assert np.array_equal(undone.line_integrals(0), data.line_integrals(0))
    assert np.array_equal(undone.line_integrals(-1), undone.line_integrals(len(data) - 1))
    whole = fx.DataSet.from_arrays(true, geometry)
    volume, lagging, mended = (
        fx.reconstruct(one, shape=(16, 60, 60), voxel=0.8, errors=False).data
        for one in (whole, data, undone)
    )
    left = [np.sqrt(np.mean((v - volume) ** 2)) for v in (lagging, mended)]
    assert left[1] < 0.2 * left[0]


def test_saturated_images_are_named() -> None:
    data = data_set(scan(0)[1], DEGREES, 1e4, np.random.default_rng(1))
    top = int(np.percentile(data.counts(), 60))
    burnt = [np.minimum(a, top) for a in (data.counts(), data.flat)]
    images = dataclasses.replace(
        fx.DataSet.from_arrays(burnt[0], data.geometry, dark=data.dark, flat=burnt[1]),
        full_scale=top,
    )
    assert "are saturated" in " ".join(images.align().warnings)


@pytest.mark.slow
def test_what_a_scan_cannot_tell_is_refused_with_the_reason() -> None:
    _, lines = scan(0)
    rng = np.random.default_rng(1)
    good = data_set(lines, DEGREES, 1e4, rng)
    refused = good.align().document["refused"]
    assert {"SOD", "magnification", "SDD", "det_pitch"} <= set(refused)
    assert "source_row_px" not in refused
    assert all(len(why) > 30 for why in refused.values())
    short = good[:30].align()
    assert not short.identifiable
    assert "of a full turn without a view" in short.document["refused"]["axis_column_px"]
    with pytest.raises(fx.TwinError, match="of a full turn without a view"):
        _ = short.correction
    few = good[::3].align()
    assert "16 directions" in few.document["refused"]["det_roll"]
    empty = data_set(0 * lines, DEGREES, 1e4, rng).align()
    assert not empty.identifiable
    still = lines + 0.3 * np.exp(-np.square(np.arange(SHAPE[1]) - 80.0) / 50)
    fixed = data_set(still, DEGREES, 1e4, rng).align()
    assert "symmetr" in fixed.document["refused"]["axis_column_px"]
    moving = fx.ConeVec.helical(
        sod=SOD, sdd=SDD, rise=8, angles=48, shape=SHAPE, pixel=PITCH
    )
    counts = good.counts()
    helix = fx.DataSet.from_arrays(counts, moving, dark=good.dark, flat=good.flat).align()
    assert "one circle" in helix.document["refused"]["axis_column_px"]


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_the_command_writes_a_correction_that_reconstruct_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scanner, lines = scan(1)
    data_set(lines, DEGREES, 1e4, np.random.default_rng(5)).save(tmp_path / "scan")
    report = tmp_path / "axis.json"
    assert run(["align", str(tmp_path / "scan"), "--out", str(report), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads(report.read_text())
    assert told["identifiable"]
    assert told["parameters"]["det_roll"]["unit"] == "deg"
    column, sigma = (told["parameters"]["axis_column_px"][k] for k in ("value", "sigma"))
    assert abs(column - scanner.axis()[0]) < 4 * sigma
    words = ["--correction", str(report), "--voxel", "1.5", "--shape", "8,30,30"]
    folder = str(tmp_path / "scan")
    assert run(["reconstruct", folder, "--out", str(tmp_path / "v.mha"), *words]) == 0
    given = fx.Volume.load(tmp_path / "v.mha").data
    own = fx.open(folder)
    ours = own.with_correction(own.align().correction).reconstruct(
        "fdk", voxel=1.5, shape=(8, 30, 30)
    )
    np.testing.assert_allclose(given, ours.data, atol=1e-5)
    capsys.readouterr()
    assert run(["align", folder, "--per-frame"]) == 0
    said = capsys.readouterr().out
    assert "not told: SOD" in said
    assert "no motion of dO_x was found" in said
    assert run(["align", folder, "--out", str(tmp_path / "axis.txt")]) == 2
    own[:24].save(tmp_path / "half")
    assert run(["align", str(tmp_path / "half"), "--json"]) == 5
    out, err = capsys.readouterr()
    assert not json.loads(out)["identifiable"]
    assert "full turn" in err
    assert run(["align", str(tmp_path / "half")]) == 5
    assert capsys.readouterr().out.count("of a full turn without a view") == 1
    # The same images as anybody's TIFFs.
    geometry = tmp_path / "scan.json"
    (tmp_path / "scan" / "geometry.json").rename(geometry)
    for file in (tmp_path / "scan").glob("*[!f]"):
        file.unlink()
    assert run(["align", folder]) == 1
    assert "--geometry FILE" in capsys.readouterr().err
    there = ["--geometry", str(geometry)]
    assert run(["align", folder, *there, "--out", str(report)]) == 0
    again = json.loads(report.read_text())["parameters"]["axis_column_px"]
    assert again["value"] == pytest.approx(column, abs=1e-3)
    volume = str(tmp_path / "tiffs.mha")
    assert run(["reconstruct", folder, *there, "--out", volume, *words]) == 0
    np.testing.assert_allclose(fx.Volume.load(volume).data, given, atol=1e-3)
