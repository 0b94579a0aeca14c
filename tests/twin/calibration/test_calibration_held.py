"""What is held and really off is named; what is held where it is stays held."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_images import radiographs
from calibration_scenarios import SHAPE, exact_tracks, scenario, spiral
from scipy import special
from spoilt_scans import careful_scan

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration import SIX, Reading, estimate_geometry
from flexdt.twin.calibration.bead_model import bead_model
from flexdt.twin.calibration.diagnose.fixed_parameters import (
    HELD_SIGMAS,
    held_distance,
    judge_held,
)
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

TRUTH = {
    "dO_x": 0.5,
    "dO_y": -0.2,
    "dO_z": 0.8,
    "alpha": 2.0,
    "tau_x": -0.2,
    "tau_z": 0.5,
}
LEGO = load_phantom("lego")
FRAMES = 24


def points(reading: Reading = Reading.AXIS_AT_O_PLUS_TAU, beads: int = 5):  # type: ignore[no-untyped-def]
    poses, _ = scenario("G0", 36)
    model = spiral((20, 40, 60), beads)
    tracks = exact_tracks(poses, Offsets.from_edge(TRUTH), model)
    tracks = tracks + 0.02 * np.random.default_rng(3).normal(size=tracks.shape)
    return estimate_geometry(tracks, model, poses, shape=SHAPE, reading=reading)


def test_points_say_which_held_parameter_is_off() -> None:
    fit = points()
    found = judge_held(fit, {"tau_x": 0.0, "tau_z": 0.5})
    assert found is not None
    assert found.code == "held_parameter"
    assert "tau_x is held at 0 mm, the data say -0.2" in found.text
    assert "free tau_x too" in found.text
    assert judge_held(fit, {n: TRUTH[n] for n in ("tau_x", "tau_z", "dO_y")}) is None
    assert judge_held(fit, {"det_roll": 1.0}) is None  # not free: nothing is known of it


def test_two_held_parameters_may_contradict_the_data_only_together() -> None:
    fit = points()
    i, j = list(fit.values).index("dO_x"), list(fit.values).index("tau_x")
    sign = np.sign(fit.certificate.correlation[i, j])
    held = {
        "dO_x": fit.values["dO_x"] + 4.5 * fit.sigmas["dO_x"],
        "tau_x": fit.values["tau_x"] - sign * 4.5 * fit.sigmas["tau_x"],
    }
    scores = held_distance(fit, held)
    chance = special.stdtr(fit.certificate.dof, -4.5)
    assert scores["dO_x"] == pytest.approx(-special.ndtri(chance), rel=0.01)
    assert scores[""] > HELD_SIGMAS
    assert judge_held(fit, held) is not None


def test_what_the_data_do_not_determine_is_not_judged() -> None:
    assert judge_held(points(beads=1), {"tau_x": 0.0, "alpha": 0.0}) is None


@pytest.fixture(scope="module")
def scan() -> tuple[Poses, Float32Array]:
    poses, _ = careful_scan(np.random.default_rng(7), FRAMES)
    cone = poses.cone_vec(Offsets.from_edge(TRUTH))
    return poses, radiographs(LEGO, cone, 20_000.0, 5)


def calibrated(
    scan: tuple[Poses, Float32Array], request: CalibrationRequest
) -> Calibration:
    poses, images = scan
    return calibrate([Scan(ArrayFrames(list(images), SHAPE), poses)], LEGO, request)


@pytest.mark.daily(1)
@pytest.mark.parametrize("tolerance", [None, 0.0, 0.005])
@pytest.mark.parametrize(
    ("free", "says"),
    [
        (("dO_x", "dO_y", "dO_z", "alpha"), "free tau_z, tau_x too"),
        (("dO_x", "dO_y", "dO_z", "alpha", "tau_x"), "free tau_z too"),
        (("dO_x",), "tau_z is held at 0 mm, the data say 0."),
    ],
)
@pytest.mark.campaign(4)
def test_a_held_parameter_that_is_off_is_no_confident_answer(
    scan: tuple[Poses, Float32Array],
    free: tuple[str, ...],
    says: str,
    tolerance: float | None,
) -> None:
    """Freed bead positions used to absorb it: hundreds of sigmas off, called identifiable."""
    known = exact(free)
    result = calibrated(
        scan, CalibrationRequest(free=free, bead_tolerance_mm=tolerance, priors=known)
    )
    assert not result.identifiable
    (found,) = [f for f in result.errors if f.code == "held_parameter"]
    assert says in found.text


def test_a_parameter_that_is_not_asked_for_is_not_taken_to_be_exact(
    scan: tuple[Poses, Float32Array],
) -> None:
    """tau lies 0.2 and 0.5 mm from where it is fixed; what is estimated is right all the
    same."""
    fit = calibrated(scan, CalibrationRequest(free=("dO_x", "dO_y", "dO_z", "alpha"))).fit
    assert fit is not None
    for name, true in TRUTH.items():
        assert abs(fit.values[name] - true) < 4 * fit.sigmas[name]
    assert fit.certificate.estimates["tau_x"].prior == 0.3
    assert not fit.certificate.estimates["tau_x"].asked


@pytest.mark.slow
@pytest.mark.campaign
def test_a_cause_that_looks_like_another_is_named_beside_it() -> None:
    """A panel aside looks as one turned about the vertical: the one whose prior is narrower was
    believed, and dO_x was 46 of its sigmas off."""
    poses, _ = careful_scan(np.random.default_rng(7), FRAMES)
    for aside, offered in ((10.0, True), (30.0, False)):
        truth = Offsets.from_edge(TRUTH | {"dD_x": aside})
        images = radiographs(LEGO, poses.cone_vec(truth), 20_000.0, 5)
        result = calibrated((poses, images), CalibrationRequest())
        assert result.identifiable == offered
        assert result.fit is not None
        if offered:
            for name, true in (TRUTH | {"dD_x": aside}).items():
                assert abs(result.fit.values[name] - true) < 4 * result.fit.sigmas[name]
        else:
            assert "det_yaw is known as 0" in result.errors[0].text
            assert "; or " in result.errors[0].text


@pytest.mark.parametrize("reading", list(Reading))
@pytest.mark.parametrize(
    "held", [("tau_x", "tau_z"), ("dO_y", "dO_z", "alpha", "tau_x", "tau_z")]
)
@pytest.mark.daily(2)
def test_a_parameter_held_where_it_is_stays_held(
    scan: tuple[Poses, Float32Array], held: tuple[str, ...], reading: Reading
) -> None:
    start = Offsets.from_edge({n: TRUTH[n] for n in held})
    if reading is Reading.MOUNT_SHIFT:
        start = Offsets.from_edge({n: TRUTH[n] for n in (*held, "tau_x", "tau_z")})
    free = tuple(n for n in SIX if n not in held)
    result = calibrated(scan, CalibrationRequest(free=free, start=start, reading=reading))
    assert result.identifiable
    assert result.findings == ()
    assert result.fit is not None
    assert [n for n, e in result.fit.certificate.estimates.items() if e.asked] == list(
        free
    )
    edge = result.fit.parameters.to_edge()
    for name in free:
        assert abs(edge[name] - TRUTH[name]) < 5 * result.fit.sigmas[name]


def test_the_last_look_at_the_bounds_of_doubt_widens_the_intervals(
    scan: tuple[Poses, Float32Array],
) -> None:
    """Held three sigmas off: too little to be named, enough to move what hangs together with
    it."""
    best = calibrated(scan, CalibrationRequest(priors=exact(SIX))).fit
    assert best is not None
    off = best.values["tau_x"] + 3.5 * best.sigmas["tau_x"]
    free = tuple(n for n in SIX if n != "tau_x")
    start = Offsets.from_edge({"tau_x": off})
    result = calibrated(
        scan, CalibrationRequest(free=free, start=start, priors=exact(free))
    )
    assert result.identifiable
    assert result.fit is not None
    moved = abs(result.fit.values["dO_x"] - best.values["dO_x"])
    assert moved > 2 * best.sigmas["dO_x"]
    assert result.fit.sigmas["dO_x"] > moved


@pytest.mark.slow
def test_a_detector_that_is_elsewhere_is_named() -> None:
    """Ten standard deviations of its prior away: no prior of the scanner says that."""
    poses, _ = careful_scan(np.random.default_rng(7), FRAMES)
    truth = Offsets.from_edge(TRUTH | {"dD_z": 10.0})
    images = radiographs(LEGO, poses.cone_vec(truth), 20_000.0, 5)
    result = calibrated((poses, images), CalibrationRequest())
    assert [f.code for f in result.errors] == ["held_parameter"]
    assert "dD_z is known as 0 +- 1 mm, the images say " in result.errors[0].text
    freed = calibrated((poses, images), CalibrationRequest(free=(*SIX, "dD_z")))
    assert freed.identifiable
    assert freed.fit is not None
    assert abs(freed.fit.values["dD_z"] - 10.0) < 5 * freed.fit.sigmas["dD_z"]
    assert abs(freed.fit.values["dO_z"] - 0.8) < 5 * freed.fit.sigmas["dO_z"]


@pytest.mark.slow
def test_one_bead_can_still_show_where_it_is() -> None:
    """Not all six can be told from one bead; a held one that is wrong is
    named, or what it leaves open is in the sigmas."""
    bead = load_phantom("normal-1")
    model = bead_model(bead)
    poses, _ = careful_scan(np.random.default_rng(7), FRAMES)
    truth = Offsets.from_edge(TRUTH)
    images = radiographs(bead, poses.cone_vec(truth), 20_000.0, 5)
    held = {n: TRUTH[n] for n in ("dO_z", "alpha", "tau_x", "tau_z")}
    for start, good in ((held, True), (held | {"tau_z": 0.0}, False)):
        free = ("dO_x", "dO_y")
        request = CalibrationRequest(
            free=free, start=Offsets.from_edge(start), priors=exact(free)
        )
        frames = ArrayFrames(list(images), SHAPE)
        result = calibrate([Scan(frames, poses)], model, request, scene=bead.scene)
        codes = [f.code for f in result.findings]
        if good:
            assert result.identifiable
            assert "causes_open" not in codes
        elif result.identifiable:  # the turn is open, and in the stated sigmas
            assert "causes_open" in codes
            for name in free:
                off = result.fit.values[name] - TRUTH[name]
                assert abs(off) < 4.0 * result.fit.sigmas[name]
        else:
            assert "held_parameter" in codes


@pytest.mark.slow
def test_what_is_exactly_known_stays_so_where_other_priors_are_widened() -> None:
    """A panel rolled by five of its prior's sigmas; SDD is stated as exact."""
    poses, _ = careful_scan(np.random.default_rng(7), FRAMES)
    truth = Offsets.from_edge({**TRUTH, "det_roll": 1.5})
    images = radiographs(LEGO, poses.cone_vec(truth), 20_000.0, 5)
    result = calibrated((poses, images), CalibrationRequest(priors={"dD_z": 0.0}))
    assert result.identifiable
    assert "priors_narrow" in [f.code for f in result.findings]
    assert result.fit is not None
    estimates = result.fit.certificate.estimates
    assert "dD_z" not in estimates
    assert (estimates["dD_x"].prior or 0.0) > 2.0
    assert abs(estimates["det_roll"].value - 1.5) < 4 * estimates["det_roll"].sigma
