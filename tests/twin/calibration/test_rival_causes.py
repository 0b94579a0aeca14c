"""Causes beside their rivals: columns and evidence against closed forms, and drawn scans."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from causes_named import calibrated, scored, worst_error
from faults_drawn import World, drawn, shadows
from scipy.spatial.transform import Rotation

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import Found, Known
from flexdt.twin.calibration.diagnose.table.groups.strain import (
    lean_of,
    strain_words,
    told,
)
from flexdt.twin.calibration.fit.fit import (
    FitResult,
    estimate_geometry,
    image_quantities,
)
from flexdt.twin.calibration.fit.problem import STRAINS, build_problem
from flexdt.twin.geometry.panel import PanelModel
from flexdt.twin.geometry.poses import Poses

BEADS = np.array([[9, 4, -20], [-10, 6, -9], [4, -11, 1], [-3, 10, 12], [11, -2, 21.0]])
SHAPE = (760, 956)
KNOWN = Known((1e-3, 1e-3), None, 1e-3)
NO_FIT = cast("FitResult", None)
"""Words on a shape need no fit."""
SAID = (
    "phantom_strained",
    "exposure_arc",
    "rows_in_turn",
    "panel_distorted",
    "bead_tolerance",
    "causes_open",
)


def upright(frames: int, shift: float = 0.0) -> Poses:
    angle = 2 * math.pi * (np.arange(frames) + shift) / frames
    return Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, angle)


def test_a_strained_phantom_is_estimated_with_its_shape() -> None:
    """Points of beads that are moved about their mean by a matrix here; with distance and angle
    given, it comes back."""
    change = np.eye(3) + 2e-3 * np.random.default_rng(2).normal(size=(3, 3))
    poses = upright(24)
    mean = BEADS.mean(axis=0)
    beads = mean + (BEADS - mean) @ change.T
    tracks = poses.cone_vec().project_points(beads, SHAPE)
    fit = estimate_geometry(
        tracks, BeadModel(BEADS, np.ones(5)), poses, ("dO_x", "tau_x", "tau_z"),
        shape=SHAPE, strain=(1e3, 1e3),
    )  # fmt: skip
    strain = dict(
        zip(
            STRAINS,
            fit.solution.x[fit.problem.layout.strain_columns].tolist(),
            strict=True,
        )
    )
    for i, j in np.ndindex(3, 3):
        term = "xyz"[i] + "xyz"[j]
        found = strain[term] + (1.0 if i == j else 0.0)
        assert found == pytest.approx(change[i, j], abs=1e-7)
    assert fit.beads == pytest.approx(beads, abs=1e-5)


@pytest.mark.parametrize("frames", [12, 24, 60])
def test_the_mean_of_an_arc_is_that_of_its_positions(frames: int) -> None:
    share = 0.7
    fine = (np.arange(400) + 0.5) / 400 - 0.5
    mean = np.mean(
        [
            upright(frames, share * part).cone_vec().project_points(BEADS, SHAPE)
            for part in fine
        ],
        axis=0,
    )  # fmt: skip
    poses, model = upright(frames), BeadModel(BEADS, np.ones(5))
    problem = build_problem(mean, model, poses, free=("dO_x",), shape=SHAPE, arc=True)
    x = problem.start
    x[problem.layout.arc_column] = share**2
    assert problem.predictions(x)[0] == pytest.approx(mean, abs=0.3 / frames**2 * 12)
    assert (
        np.abs(problem.predictions(problem.start)[0] - mean).max()
        > 20 * 0.3 / frames**2 * 12
    )


@pytest.mark.parametrize(
    ("frames", "share"), [(60, 0.2), (60, -0.2), (24, 0.7), (24, -0.7)]
)
def test_each_position_is_that_of_the_time_at_which_its_row_is_read(
    frames: int, share: float
) -> None:
    """Against the place and the time of each bead, found in turn."""
    when = np.zeros((frames, len(BEADS)))
    for _ in range(8):
        seen = np.stack(
            [
                [
                    upright(frames, late).cone_vec().project_points(BEADS, SHAPE)[i, k]
                    for k, late in enumerate(row)
                ]
                for i, row in enumerate(when.tolist())
            ]
        )
        when = share * (seen[..., 1] - (SHAPE[0] - 1) / 2) / SHAPE[0]
    poses, model = upright(frames), BeadModel(BEADS, np.ones(5))
    problem = build_problem(seen, model, poses, free=("dO_x",), shape=SHAPE, rows=True)
    x = problem.start
    x[problem.layout.rows_column] = share
    # What is left grows with the fourth power of the arc: of 5 deg at most.
    assert problem.predictions(x)[0] == pytest.approx(seen, abs=1e-3)
    assert np.abs(problem.predictions(problem.start)[0] - seen).max() > 0.5


def test_rows_that_are_read_over_a_long_turn_are_no_other_phantom() -> None:
    """Of 8.7 deg from the first row to the last, paths bend by .4 px."""
    seen = scored("rows_in_turn", 2)
    assert seen.verdict == "right"
    assert [one.partition(":")[0] for one in seen.said] == ["rows_in_turn"]


@pytest.mark.parametrize("strained", [False, True])
def test_slopes_of_rows_are_those_of_positions(strained: bool) -> None:
    """Against differences of the predicted positions, beside all other columns."""
    frames = 24
    poses, model = upright(frames), BeadModel(BEADS, np.ones(5))
    tracks = poses.cone_vec().project_points(BEADS, SHAPE)
    problem = build_problem(
        tracks, model, poses, free=("dO_x", "alpha"), shape=SHAPE, rows=True, arc=True,
        strain=(1e-3, 1e-3) if strained else (0.0, 0.0), free_beads=strained,
        panel=PanelModel(1.0, SHAPE),
    )  # fmt: skip
    x = problem.start
    x[problem.layout.rows_column] = 0.6
    slopes = problem.jacobian(x)
    assert slopes.shape == (2 * tracks[..., 0].size, len(x))
    step = 1e-4
    for i in range(len(x)):
        ahead, behind = x.copy(), x.copy()
        ahead[i] += step
        behind[i] -= step
        moved = problem.predictions(ahead)[0] - problem.predictions(behind)[0]
        assert slopes[:, i] == pytest.approx(
            moved.ravel() / (2 * step), abs=1e-3, rel=1e-4
        )


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("strain_z", 1), ("strain_x", 2), ("exposed_long", 2), ("as_assumed", 3),
        ("frame_doubled", 4), ("frame_doubled", 1011), ("frame_lost", 5), ("frame_lost", 1008),
        ("rows_in_turn", 109), ("exposed_again", 6), ("tiles_apart", 58000),
        ("bead_tolerance", 73003),
    ],
)  # fmt: skip
def test_a_drawn_cause_is_named_and_what_is_offered_holds(kind: str, seed: int) -> None:
    found = scored(kind, seed)
    assert found.verdict == "right", found
    assert not found.wrong, found


@pytest.mark.slow
@pytest.mark.campaign(4)
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "kind",
    ["strain_x", "strain_y", "strain_z", "strain_shear", "strain_lean", "exposed_long",
     "rows_in_turn", "frame_doubled", "frame_lost", "exposed_again", "four_tiles", "grows",
     "source_jumps"],
)  # fmt: skip
def test_no_drawn_cause_is_offered_wrong(kind: str, seed: int) -> None:
    assert not scored(kind, 500 + seed).wrong


@pytest.mark.parametrize("seed", [3009, 72022])
def test_beads_freed_for_a_tile_are_not_given_up_for_a_loose_prior(seed: int) -> None:
    """Of 2 x 2 tiles one border passes few beads: it was refused as a pitch of 2.6 deg. Where
    it passes none, free beads explain it as well: they were offered 5.2 sigma off."""
    found = scored("four_tiles", seed)
    assert found.offered, found.said
    assert found.worst < 4.0


@pytest.mark.parametrize("seed", range(3))
def test_an_exact_phantom_has_no_cause(seed: int) -> None:
    found = scored("nothing", seed)
    assert found.offered
    assert not [line for line in found.said if line.startswith(SAID)]


@pytest.mark.parametrize("seed", [0, 4])
def test_slow_errors_of_single_beads_are_no_evidence_of_another_cause(seed: int) -> None:
    """They were told as a phantom aslant and as an open cause."""
    found = scored("slow_errors", seed)
    assert found.verdict == "right", found
    assert not found.wrong, found


def test_a_strain_takes_part_in_every_sigma() -> None:
    """Of magnification and distance, as scale and distance look alike."""
    scan = drawn("nothing", 7)
    fit = calibrated(scan).fit
    assert fit is not None
    exact = replace(
        scan.believed, priors={n: 0.0 for n in fit.values if n not in scan.believed.free}
    )
    known = calibrated(replace(scan, believed=exact)).fit
    assert known is not None
    wide, narrow = (image_quantities(f)[0]["magnification"].sigma for f in (fit, known))
    assert 0.8e-3 < wide / image_quantities(fit)[0]["magnification"].value < 1.3e-3
    assert narrow < 0.1 * wide


@pytest.mark.slow
@pytest.mark.campaign(1)
@pytest.mark.parametrize("seed", [1, 0])
def test_a_growth_that_is_followed_as_a_motion_is_not_offered_wrong(seed: int) -> None:
    """The advice of its own report: it was offered 78 and 20 sigmas off, the way of the motion
    taken to be the beam's."""
    scan = drawn("grows", seed)
    said = " ".join(f.text for f in calibrated(scan).findings)
    (asked,) = re.findall(r"--per-frame ([\w,]+)", said)
    result = calibrated(scan, tuple(asked.split(",")))
    assert result.identifiable, result.findings
    assert worst_error(result, scan)[0] < 4.0


def test_a_growth_is_no_cause_that_images_tell_from_a_motion() -> None:
    """A phantom that is a part larger casts the shadows of one that is nearer to the source
    by that part of its distance, to the last digit: both are told, and neither alone."""
    n = 12
    angles = 360.0 * np.arange(n) / n
    size = 1.0 + 7e-3 * np.linspace(-0.5, 0.5, n)
    place = {"dO_x": 3.0, "dO_y": -2.0, "dO_z": 5.0}
    still = World(
        BEADS, np.full(5, 1e-4), {**place, "alpha": 30.0}, angles, np.zeros((n, 3)),
        np.ones((n, 5), dtype=bool), 600.0, 1059.0,
    )  # fmt: skip
    nearer = {name: np.full(n, value) / size for name, value in place.items()}
    nearer["dO_z"] += 600.0 / size - 600.0
    grown = shadows(replace(still, size=size))[0]
    moved = shadows(replace(still, offsets={**nearer, "alpha": 30.0}))[0]
    assert np.abs(grown - shadows(still)[0]).max() > 0.5
    assert grown == pytest.approx(moved, abs=1e-6)


def test_a_jump_of_what_the_camera_reads_is_no_slip_and_offered() -> None:
    """Two columns in the last frames: they were told as frames that are missing, or a slip. The
    axis column was that of the first frame, 90 sigmas from the mean's."""
    scan = drawn("as_assumed", 5)
    few = 4
    spots = [
        frame if frame is None or i < len(scan.spots) - few else frame + [2.0, 0.0, 0.0]
        for i, frame in enumerate(scan.spots)
    ]
    result = calibrated(replace(scan, spots=spots))
    assert result.identifiable, result.findings
    (said,) = (f.text for f in result.findings if f.code is CalibrationCode.DRIFT)
    assert f"at frame {len(spots) - few}: the panel moves aside" in said
    column = scan.image["axis_column"] + 2.0 * few / len(spots)
    true = replace(scan, image=dict(scan.image) | {"axis_column": column})
    worst, where = worst_error(result, true)
    assert worst < 4.0, where


def test_pixels_of_another_pitch_are_named_beside_the_distance() -> None:
    scan = drawn("other_pitch", 1)
    (said,) = (f.text for f in calibrated(scan).errors)
    assert "dD_z" in said
    pitch = re.search(r"the pixels are ([0-9.]+) mm wide instead of 0.1496 mm", said)
    assert pitch is not None
    assert float(pitch[1]) == pytest.approx(scan.pixel, rel=3e-3)


@pytest.mark.parametrize(
    ("strain", "words"),
    [
        ({"zz": 0.003}, "0.3 % taller"),
        ({"zz": -0.003}, "0.3 % less tall"),
        ({"xx": 0.009}, "0.9 % longer along x"),
        ({"xx": 0.004, "yy": 0.004}, "0.4 % less tall"),
        ({"xz": -0.002}, "-0.2 % aslant along x"),
    ],
)
def test_a_phantom_that_is_off_in_one_length_is_told_so(
    strain: dict[str, float], words: str
) -> None:
    mean = np.array([strain.get(name, 0.0) for name in STRAINS])
    assert strain_words(mean, 1e-12 * np.eye(len(mean))) == words


def test_a_rigid_phantom_that_leans_is_no_phantom_of_another_shape() -> None:
    """It was told as "+3.5 % aslant along x, -3.5 % tilted along x"."""
    a, b = 0.035, -0.02
    turn = Rotation.from_rotvec([-b, a, 0.0]).as_matrix() - np.eye(3)
    mean = np.array([turn["xyz".index(n[0]), "xyz".index(n[1])] for n in STRAINS])
    covariance = 1e-10 * np.eye(len(mean))
    leans, rest = lean_of(mean, covariance)
    assert leans == pytest.approx({"+x": a, "-y": -b}, rel=1e-3)
    assert strain_words(rest, covariance, max(leans.values())) == ""
    (said,) = told(Found(NO_FIT, (), (), (mean, covariance), KNOWN))
    assert said.text.startswith(
        "the phantom leans on the stage: by 2 deg towards its +x and by 1.1 deg towards its -y"
    )
    assert "not as its file says" not in said.text
    mean[STRAINS.index("zz")] = 0.02
    (said,) = told(Found(NO_FIT, (), (), (mean, covariance), KNOWN))
    assert "not as its file says: 2 % taller" in said.text


def test_layers_that_slide_on_one_another_are_no_lean() -> None:
    mean = np.zeros(len(STRAINS))
    mean[STRAINS.index("xz")] = 0.02
    assert lean_of(mean, 1e-10 * np.eye(len(mean)))[0] == {}
