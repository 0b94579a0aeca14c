"""The author's code and logs: his model against one written by hand, his phantoms, his 242
fits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import bead_model
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.errors import UnknownNameError
from flexdt_extensions.studies.experiment_4 import (
    GROUPS,
    authors_fit,
    binary_centroids,
    counts,
    explained,
    logged,
    physical_truth,
    real_runs,
    scan_names,
    spots,
)
from flexdt_extensions.studies.experiments import author, thesis
from flexdt_extensions.studies.study import authors, run_study

LEGO = bead_model(load_phantom("lego"))


def by_hand(
    name: str, values: list[float], mount: complex, turn: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Spots (n, k, 2) written in Unity's plane as complex numbers x + i z, projected by
    hand."""
    real = author()["real"]
    scan = real["scans"][name]
    sx, sy, sz = scan["source"]
    ox, oy, oz = (o + d for o, d in zip(scan["object"], values[:3], strict=True))
    dx, dy, dz = (
        d + a for d, a in zip(scan["detector"], real["detector_added"], strict=True)
    )
    out = np.empty((len(turn), len(LEGO.beads), 2))
    for i, (a, o) in enumerate(zip(turn, offset, strict=True)):
        for k, (x, y, z) in enumerate(LEGO.beads):
            # Growing angles turn the phantom clockwise seen from above (x right, z away).
            w = complex(ox, oz) + complex(x, y) * np.exp(-1j * a) + mount * np.exp(1j * o)
            scale = (dz - sz) / (w.imag - sz)
            out[i, k, 0] = (sx + (w.real - sx) * scale - dx) / 0.1496 + 477.5
            out[i, k, 1] = -(sy + (oy + z - sy) * scale - dy) / 0.1496 + 379.5
    return out


def test_physical_spots_turn_phantom_and_mount_together() -> None:
    values = [-0.4, 4.2, 15.2, -1.3, 14.0, -13.0]
    turn = 2.0 * math.pi * np.floor(np.linspace(0, 359, 7)) / 359
    mount = complex(*values[4:])
    expected = by_hand("Scan4", values, mount, turn + math.radians(values[3]), -turn)
    assert_allclose(spots("Scan4", np.array(values), 7, LEGO), expected, atol=1e-9)


@pytest.mark.parametrize("name", ["Scan1", "Scan9"])
def test_the_authors_model_turns_the_mount_against_the_phantom(name: str) -> None:
    """Spots of his model, by hand, are fitted without a rest; the values are those put in."""
    values = [-0.3, 4.0, 12.0, 7.0, 9.0, 5.0]
    start = author()["real"]["scans"][name]["start_deg"]
    phi = np.radians(start) + 2.0 * math.pi * np.arange(24) / 24
    seen = by_hand(name, values, complex(*values[4:]), phi + math.radians(values[3]), phi)
    fit = authors_fit(name, seen, LEGO)
    assert fit.cost < 1e-12
    assert_allclose(fit.x, values, atol=1e-6)


def test_binary_centroids_are_those_of_a_mask() -> None:
    rng = np.random.default_rng(17)
    centres = rng.uniform(20.0, 40.0, size=(4, 3, 2))
    columns, rows = np.meshgrid(np.arange(64), np.arange(64))
    for radius in (1.5, 9.0, 11.97):
        found = binary_centroids(centres, radius)
        for index in np.ndindex(4, 3):
            x, y = centres[index]
            inside = (columns - x) ** 2 + (rows - y) ** 2 <= radius**2
            assert_allclose(
                found[index], [columns[inside].mean(), rows[inside].mean()], atol=1e-9
            )


def test_all_242_logs_are_there_and_agree_with_the_thesis() -> None:
    assert len(scan_names()) * len(counts()) == 242
    for number, name in enumerate(scan_names(), start=1):
        fits = author()["real"]["scans"][name]["fits"]
        assert tuple(fit[0] for fit in fits) == counts()
        for used, before, after, iterations in fits:
            row = thesis()[f"table_A_{number + 4}_scan_{number}"][str(used)]
            assert 100.0 * (1.0 - after / before) == pytest.approx(
                row["cost_reduction_pct"], abs=0.011
            )
            values, rms, logged_iterations = logged(name, used)
            assert values.tolist() == [row[n] for n in SIX]
            assert rms == pytest.approx(math.sqrt(after / (10 * used)))
            assert logged_iterations == iterations


def test_logged_fits_follow_from_the_sign_and_the_angles() -> None:
    """One truth for scans 7 to 11, from N = 360 alone, predicts another scan and N."""
    truth = physical_truth(GROUPS[1], LEGO)
    runs, curve = real_runs("Scan10", LEGO, truth, used=(36,))
    (row,) = explained([curve])
    assert row["fits"] == row["within"] == 1
    assert row["alpha_largest_deg"] < 1.0
    assert abs(row["rms_largest_pct"]) < 5.0
    assert max(row["off_mm"][n] for n in ("dO_x", "tau_x", "tau_z")) < 0.2
    for r in curve["by_projections"].values():
        assert 25 <= r["simulated_iterations"] <= 60  # the logs have 25 to 53
        assert r["ours_rms_px"] < 0.1 < r["simulated_rms_px"]
    assert all(run.success for run in runs)
    # Right angles and the right sign leave nothing; the mount's sign shows in the logs' tau_z.
    right, _ = real_runs("Scan10", LEGO, truth, exact=True, used=(36,))
    assert right[0].mae < 1e-6
    assert truth.values[5] < -10.0 < 10.0 < logged("Scan10", 36)[0][5]


@pytest.mark.parametrize(("beads", "expected"), [
    (1, [[7, -17, -27]]),
    (2, [[7, -17, -27], [7, -17, 27]]),
    (3, [[7, -17, -27], [-7, 17, 0], [7, -17, 27]]),
    (5, [[7, -17, -27], [-7, -7, -13.5], [-7, 17, 0], [7, 7, 13.5], [7, -17, 27]]),
])  # fmt: skip
def test_the_authors_beads_stand_on_a_loop(
    beads: int, expected: list[list[float]]
) -> None:
    """20 x 40 x 60 mm, 3 mm inside the faces: the loop is 96 mm round."""
    assert_allclose(authors(f"normal-{beads}").beads, expected, atol=1e-12)


def test_the_authors_phantoms_and_scenarios_are_a_variant() -> None:
    document = run_study("beads", counts=(10,), jobs=1, variant="author")
    rows = {r["setting"]: r for r in document["rows"]}
    # Two beads stand one above the other: a turn about both is no change (rank 5).
    assert rows["1"]["unidentifiable"] == rows["2"]["unidentifiable"] == 5
    assert all(rows[k]["success"] == 5 for k in "34567")
    sizes = {n: authors(f"{n}-3").size_mm for n in author()["cuboids"]}
    assert sizes["compact"] == (10, 10, 20)
    assert np.ptp(authors("coplanar-3").beads[:, 2]) == 0.0
    for experiment in ("real", "basin", "detector"):
        with pytest.raises(UnknownNameError, match="'author'; allowed: printed"):
            run_study(experiment, variant="author")
