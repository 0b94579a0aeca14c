"""Lengths that motors, panel and phantom tell are witnesses: none overrules another."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from told_lengths import WRONG_SIGMAS, calibrated, judged
from told_lengths_drawn import drawn_told

from flexdt.twin.calibration.bead_model import BeadModel, Tolerance
from flexdt.twin.calibration.diagnose.table.group import Acts, Family, Known
from flexdt.twin.calibration.diagnose.table.groups import _limited, moving, tiles
from flexdt.twin.calibration.fit import told_ways
from flexdt.twin.calibration.fit.fit import estimate_geometry, image_quantities
from flexdt.twin.calibration.fit.priors import known_scale, known_strain
from flexdt.twin.calibration.fit.told_ways import told_motions
from flexdt.twin.calibration.request import CalibrationRequest, with_stated
from flexdt.twin.calibration.without_phantom.gaps.gap_evidence import GapFound
from flexdt.twin.calibration.without_phantom.symmetry_plane import _gap
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.told_lengths import (
    PLACES,
    TOLD,
    TOLD_MEANINGS,
    TOLD_SOURCES,
    told_by,
)
from flexdt.twin.machine.stated_causes import (
    CAUSE_MEANINGS,
    CAUSES,
    limits_of,
    require_causes,
)

BEADS = np.array([[9, 4, -20], [-10, 6, -9], [4, -11, 1], [-3, 10, 12], [11, -2, 21.0]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "wrong"),
    [
        ("helix", 0, -0.00205),  # 112 sigmas off
        ("places", 1, 0.00125),  # 5.5
        ("steps", 1, 0.0047),  # 93
        ("others", 1, -0.0007),
        ("pixel", 4, -0.0028),
    ],
)
@pytest.mark.campaign(2)
def test_a_wrong_length_is_never_believed(kind: str, seed: int, wrong: float) -> None:
    result = judged(kind, seed, wrong, drawn_told(kind, seed, wrong))
    assert result.offered, result.said
    assert result.worst < WRONG_SIGMAS, result.where


@pytest.mark.slow
def test_witnesses_that_contradict_withhold_and_one_with_room_is_corrected() -> None:
    told = drawn_told("helix", 2, -0.02956)
    refused = calibrated(told)
    assert not refused.identifiable
    (why,) = (f for f in refused.errors if f.code == "held_parameter")
    assert dict(why.advice.priors).keys() == {"travel_y", "phantom"}
    assert "rise" in why.text
    assert "the phantom's scale" in why.text
    found = calibrated(replace(told, priors={"travel_y": 0.03}))
    assert found.identifiable, found.findings
    assert found.fit is not None
    for name in ("dO_x", "dO_z", "tau_x", "tau_z"):
        e = found.fit.certificate.estimates[name]
        assert abs(e.value - told.truth[name][0]) < WRONG_SIGMAS * e.sigma
    (motion,) = told_motions(found.fit)
    assert motion.names == ("dO_y",)
    rise = told.scans[0].axis[:, 2]
    expected = -0.02956 * (rise - rise.mean())
    assert motion.values[:, 0] == pytest.approx(expected, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("scans", [2, 4])
def test_right_places_are_as_sure_of_the_axis_as_the_best_of_them(scans: int) -> None:
    """Two said 1.3 px where one said 0.001 px."""
    told = drawn_told("places", 1, 0.0, scans=scans)
    joint = calibrated(told)
    assert joint.identifiable, joint.findings
    assert joint.fit is not None
    alone = []
    for one in told.scans:
        single = calibrated(replace(told, scans=(one,)))
        assert single.fit is not None
        alone.append(image_quantities(single.fit)[0]["axis_column"].sigma)
    best = min(q["axis_column"].sigma for q in image_quantities(joint.fit))
    assert best < 1.05 * min(alone)


def test_what_a_scan_rests_on() -> None:
    turn = np.linspace(0.0, 6.0, 12)
    still = Poses.upright([0, 0, 0], [0, 500, 0], [0, 900, 0], 0.1, turn)
    one = np.zeros(12, dtype=np.int64)
    assert told_by(still, one) == {"pixel", "phantom"}
    rising = replace(still, axis=still.axis + np.outer(turn, [0, 0, 2.0]))
    assert told_by(rising, one) == {"pixel", "phantom", "travel_y"}
    # Another scanner's geometry has the sample stand, and source and panel move.
    other = replace(
        still,
        source=still.source - np.outer(turn, [0, 0, 2.0]),
        detector=still.detector - np.outer(turn, [0, 0, 2.0]),
    )
    assert told_by(other, one) == {"pixel", "phantom", "travel_y"}
    both = Poses.concatenate([still, replace(still, axis=still.axis - [0, 90.0, 0])])
    two = np.repeat([0, 1], 12)
    places = {"place_x", "place_y", "place_z"}
    assert told_by(both, two) == {"pixel", "phantom", "travel_z", *places}
    assert told_by(both, two, ("dO_z",)) == {"pixel", "phantom", "travel_z"} | places - {
        "place_z"
    }
    far = replace(still, detector=still.detector + [0, 50.0, 0])
    assert "panel_travel_z" in told_by(Poses.concatenate([still, far]), two)
    assert set(TOLD_MEANINGS) == set(TOLD_SOURCES) == set(TOLD)


def test_a_lead_takes_part_of_the_scale_by_its_width() -> None:
    """Two witnesses of one millimetre: the mean is weighed by their variances."""
    turn = np.linspace(0.0, 4.0 * np.pi, 24, endpoint=False)
    rise = np.outer(np.arange(24), [0.0, 0.0, 1.5])
    told = Poses.upright([0, 0, 0], [0, 600, 0] + rise, [0, 1000, 0], 0.15, turn)
    real = replace(told, axis=told.axis + 2e-3 * (rise - rise.mean(axis=0)))
    tracks = real.cone_vec().project_points(BEADS, (760, 956))
    for lead, scale in ((1e-3, 1e-3), (2e-3, 1e-3)):
        fit = estimate_geometry(
            tracks, BEADS, told, ("dO_x", "dO_y", "dO_z", "tau_x", "tau_z"),
            shape=(760, 956), priors={"travel_y": lead, "phantom": scale},
        )  # fmt: skip
        share = lead**2 / (lead**2 + scale**2)
        assert fit.values["travel_y"] == pytest.approx(2e-3 * share, rel=0.02)
        assert fit.values["phantom"] == pytest.approx(-2e-3 * (1.0 - share), rel=0.02)
        expected = lead * scale / np.hypot(lead, scale)
        assert fit.sigmas["phantom"] == pytest.approx(expected, rel=0.02)


def test_what_a_phantoms_file_states_counts() -> None:
    radii = np.ones(5)
    silent = BeadModel(BEADS, radii)
    assert known_scale(silent) == known_strain(silent)[0] == 1e-3
    stated = Tolerance("certificate 7", (0.01, 0.01, 0.02, 0.01, 0.0), 2e-4)
    model = BeadModel(BEADS, radii, stated=stated)
    asked = with_stated(CalibrationRequest(), model)
    assert asked.bead_tolerance_mm == pytest.approx(np.sqrt(7e-4 / 5))
    assert asked.priors == {"phantom": 2e-4}
    # Errors are each bead's own beside a stated scale.
    strain = known_strain(model, (), asked.priors, asked.bead_tolerance_mm)
    assert max(strain) == 0.0
    own = asked.bead_tolerance_mm or 0.0
    assert own * model.spreads[:4] == pytest.approx([0.01, 0.01, 0.02, 0.01])
    assert 0.0 < own * model.spreads[4] < 1e-5
    # A user's word counts more.
    mine = CalibrationRequest(bead_tolerance_mm=0.0)
    assert with_stated(mine, model).priors == {}
    for wrong in (
        {"source": " ", "scale": 1e-3},
        {"source": "x"},
        {"source": "x", "scale": -1.0},
        {"source": "x", "bead_mm": np.nan},
    ):
        with pytest.raises(TwinError):
            Tolerance(**wrong)  # type: ignore[arg-type]
    with pytest.raises(TwinError):
        BeadModel(BEADS, radii, stated=Tolerance("x", (0.1, 0.1)))


def test_align_looks_for_no_gap_in_a_panel_in_one_piece() -> None:
    scan = SimpleNamespace(priors={"gap": 0.0})
    first = SimpleNamespace(turn=object())
    assert _gap(scan, first, None) == GapFound(None, None)  # type: ignore[arg-type]


def test_causes_are_excluded_by_users_and_scanners() -> None:
    assert set(CAUSES) == set(CAUSE_MEANINGS)
    assert limits_of([{"gap": 0.0}, {"gap": 0.5}], {}) == {"gap": 0.5}
    assert limits_of([{"gap": 0.0}, {}], {}) == {}
    assert limits_of([{"dD_x": 1.0}], {"gap": 0.0, "dD_x": 2.0}) == {"gap": 0.0}
    with pytest.raises(UnknownNameError, match="gap"):
        require_causes(["gaps"])
    tile = Family(tiles.NAME, ("a border",), Acts.IMAGE, (1,), 0.0)

    def limited(**limits: float) -> Family | None:
        return _limited(tile, Known((0.0, 0.0), None, 1.0, limits=limits))

    assert limited(gap=0.0) is None
    narrow = limited(gap=0.5)
    assert narrow is not None
    assert narrow.widest == 0.5
    assert limited(rows=0.0) == limited() == tile


@pytest.mark.parametrize(
    ("cause", "unit"), [("angles", math.radians(1.0)), ("motion", 1.0)]
)
def test_courses_are_as_wide_as_an_encoder_or_a_stage_is_stated_to_be(
    cause: str, unit: float
) -> None:
    """Courses that are drawn with the widths that a limit leaves err by it."""
    rng = np.random.default_rng(5)
    courses = rng.normal(size=(3, 1, 40, 6)) * [[[[1.0]]], [[[7.0]]], [[[0.2]]]]
    courses[1, :, 20:] = 0.0  # of another scan
    name = "alpha" if cause == "angles" else "dO_x"
    family = Family(
        moving.NAME, (f"{name} wanders",) * 3, Acts.FRAMES, (None,) * 3, 0.0,
        slopes=np.array([[0]]), courses=courses,
    )  # fmt: skip
    known = Known((0.0, 0.0), None, 1.0, limits={cause: 0.25})
    narrow = _limited(family, known)
    assert narrow is not None
    weights = np.reshape(narrow.widest, (3, 1, 1)) * rng.normal(size=(3, 6, 4000))
    drawn_ = np.einsum("gnc,gcd->gnd", courses[:, 0], weights)
    drawn_ = np.where(courses[:, 0, :, :1] != 0.0, drawn_, np.nan)
    assert np.sqrt(np.nanmean(drawn_**2, axis=(1, 2))) == pytest.approx(
        0.25 * unit, rel=0.05
    )


@pytest.mark.parametrize("other", [0, 1])
def test_a_scan_of_which_nothing_is_doubted_leaves_the_others_theirs(
    monkeypatch: pytest.MonkeyPatch, other: int
) -> None:
    name = f"{PLACES[0]}@{1 - other}"
    problem = SimpleNamespace(
        layout=SimpleNamespace(names=(name,), parameter_count=1),
        prior_sigma=np.array([50.0]),
        poses=None,
        base=(None, None),
        group=np.array([0, 0, 0, 1, 1]),
    )
    fit: Any = SimpleNamespace(
        problem=problem, solution=SimpleNamespace(x=np.array([0.25])), sigmas={name: 0.1}
    )
    still = np.zeros((5, 3))
    monkeypatch.setattr(told_ways, "ways", lambda poses: (still, still))
    motions = told_motions(fit)
    assert [len(motion.values) for motion in motions] == [3, 2]
    assert (motions[1 - other].values == 0.25).all()
    assert (motions[other].values == 0.0).all()
