"""Forecasts of image quality beside images that were made, and beside published
coefficients."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.library.expose import exposure_of
from flexdt.twin.attenuation.substances import tables
from flexdt.twin.physics.image_quality import AIR, compton_share, mass_energy_transfer
from flexdt.twin.script.planning.plan_values import StartState


def rod(radius: float, material: str = "pmma") -> dict[str, Any]:
    return {"kind": "cylinder", "center": [0, 0, 0], "radius": radius, "height": 60,
            "material": material}  # fmt: skip


@pytest.fixture(scope="module")
def forecast() -> Any:
    return fx.expose(
        rod(15.0), kV=70, power_W=40, exposure_ms=150, images=100, detail="void:0.5"
    )


def scan(radius: float, seed: int) -> fx.DataSet:
    geometry = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=2, shape=(760, 956), pixel=0.1496
    )
    return fx.simulate(
        rod(radius), geometry, tube=fx.Tube(kV=70, power_W=40), noise=seed,
        detector=fx.Detector(exposure_ms=150), material=None,
    )  # fmt: skip


def test_contrast_and_noise_are_those_of_noisy_images(forecast: Any) -> None:
    """A rod thinner by a quarter of a millimetre is the same ray with half a millimetre
    less."""
    strip = np.s_[100:660, 470:486]
    thick, thin = scan(15.0, 1), scan(14.75, 2)
    signal = [np.mean([one.counts(i)[strip] - one.dark[strip] for i in (0, 1)])
              for one in (thick, thin)]  # fmt: skip
    # The two views of a rod are alike, the fixed pattern too: their difference is noise alone.
    difference = thick.counts(0)[strip].astype(float) - thick.counts(1)[strip]
    measured = (signal[1] - signal[0]) / (difference.std() / np.sqrt(2.0))
    assert forecast.asked.cnr == pytest.approx(measured, rel=0.03)


def test_the_histogram_is_that_of_noisy_images(forecast: Any) -> None:
    made = exposure_of(scan(15.0, 3))
    seen, told = made.transmission, forecast.transmission
    assert told.median == pytest.approx(seen.median, rel=0.03)
    assert told.p5 == pytest.approx(seen.p5, rel=0.03)
    edges = np.array(told.edges)
    behind = edges[1:] < 0.8
    shares = [np.array(one.shares)[behind].sum() for one in (told, seen)]
    assert shares[0] == pytest.approx(shares[1], rel=0.03)
    assert shares[0] > 0.1
    assert sum(told.shares) == pytest.approx(1.0)


def test_saturated_and_starved_pixels_are_foreseen() -> None:
    bright = fx.expose(rod(5.0), kV=90, power_W=80, exposure_ms=2000)
    assert bright.saturated > 0.5
    assert bright.starved == 0.0
    split = next(s for s in bright.best if (s.kV, s.filter) == (90.0, ""))
    assert split.averages > 1
    assert split.kerma_mGy == pytest.approx(bright.asked.kerma_mGy, rel=1e-9)
    dark = fx.expose(rod(20.0, "steel"), kV=40, exposure_ms=20)
    assert dark.saturated == 0.0
    share = 2 * 20 * 1059 / 600 / (956 * 0.1496)
    assert dark.starved == pytest.approx(
        share * 0.93, rel=0.1
    )  # 60 of 64 mm in the picture


@pytest.mark.parametrize("bits", [10, 14])
def test_saturation_is_known_of_a_saved_scan_and_else_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bits: int
) -> None:
    geometry = fx.ConeVec.circular(sod=600, sdd=700, angles=3, shape=(20, 30), pixel=1.0)
    with pytest.warns(UserWarning, match="are saturated"):
        scan = fx.simulate(
            rod(2.0), geometry, detector=fx.Detector(bits=bits), exposure_ms=200.0
        )
    share = float((scan.counts() == 2**bits - 1).mean())
    assert share > 0.5
    scan.save(tmp_path / "whole")
    back = fx.open(tmp_path / "whole")
    assert (
        exposure_of(scan).saturated == exposure_of(back).saturated == pytest.approx(share)
    )
    assert scan.warnings
    assert set(back.warnings) == set(scan.warnings)
    plain = fx.DataSet.from_arrays(
        scan.counts(), geometry, dark=scan.dark, flat=scan.flat
    )
    assert exposure_of(plain).saturated is None
    assert run(["expose", str(tmp_path / "whole")]) == 0
    told = capsys.readouterr().err
    assert all(f"{tmp_path / 'whole'}: warning: {one}\n" in told for one in scan.warnings)
    plain.save(tmp_path / "plain")
    assert run(["expose", str(tmp_path / "plain")]) == 0
    assert "saturated unknown" in capsys.readouterr().out
    dull = fx.DataSet.from_arrays(scan.counts(), geometry, dark=scan.flat, flat=scan.dark)
    dull.save(tmp_path / "dull")
    assert run(["expose", str(tmp_path / "dull")]) == 1
    assert "was the tube off?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [{"images": 10.5}, {"averages": 2.5}, {"power_W": 0}, {"exposure_ms": 0}]
)
def test_numbers_that_no_scan_has_are_refused(words: dict[str, float]) -> None:
    with pytest.raises(fx.TwinError, match=f"{next(iter(words))} is .* allowed"):
        fx.expose(rod(5.0), **words)


@pytest.mark.parametrize("none", [[], (), np.zeros(0)])
def test_no_voltage_at_all_is_refused(none: Any) -> None:
    with pytest.raises(
        fx.TwinError, match=r"kV is .*, no voltage; allowed with .*: one or more"
    ):
        fx.expose(rod(5.0), kV=none)


def test_a_voltage_may_be_numpys() -> None:
    assert fx.expose(rod(5.0), kV=np.int64(60), power_W=np.float32(20)).asked.kV == 60.0


def test_proposed_settings_take_the_time_asked_for_the_best_first(forecast: Any) -> None:
    cnr = [one.cnr for one in forecast.best]
    assert cnr == sorted(cnr, reverse=True)
    for one in forecast.best:
        assert one.exposure_ms * one.averages == pytest.approx(150.0)


def test_the_energy_given_to_air_is_the_published_one() -> None:
    """Mass energy-absorption of dry air [cm2/g], NIST (Hubbell and Seltzer 1995), table 4."""
    published = {20: 0.5389, 30: 0.1537, 40: 0.06833, 50: 0.04098, 60: 0.03041, 80: 0.02407,
                 100: 0.02325, 150: 0.02496, 200: 0.02672}  # fmt: skip
    found = np.interp(list(published), tables().energy_keV, mass_energy_transfer(AIR))
    np.testing.assert_allclose(found, list(published.values()), rtol=0.016)
    # Klein and Nishina's mean share at 0.1 MeV is 0.138 (Attix 1986, appendix D.1).
    assert compton_share(100.0)[0] == pytest.approx(0.138, abs=5e-4)


def test_kerma_falls_with_the_square_of_the_distance_and_grows_with_the_charge() -> None:
    near = fx.expose(rod(5.0), kV=60, power_W=20, sod=300, images=10).asked.kerma_mGy
    far = fx.expose(rod(5.0), kV=60, power_W=40, sod=600, images=20).asked.kerma_mGy
    assert far == pytest.approx(near, rel=1e-9)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--kV", "500"], "allowed with flexray: 20 to 90"),
        (["--kV", "nan"], "allowed with flexray"),
        (["--power", "-1"], "power_W is -1"),
        (["--power", "0"], "power_W is 0"),
        (["--exposure", "0"], "exposure_ms is 0"),
        (["--exposure", "1e9"], "exposure_ms is 1e+09"),
        (["--frames", "0"], "images is 0"),
        (["--detail", "void:500"], "a void of at most that"),
        (["--detail", "steel"], "MATERIAL:MM"),
        (["--detail", "steel:-1"], "MATERIAL:MM"),
        (["--filter", "kryptonite:1"], "unknown material 'kryptonite'"),
        (["--sample", "nothing"], "no sample 'nothing'"),
        (["--sod", "2000"], "sod"),
        (["no-such-folder"], "no-such-folder"),
    ],
)
def test_what_cannot_be_is_an_error_with_what_is_allowed(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["expose", *words]) in (1, 3)
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err
    assert "Traceback" not in err


@pytest.mark.slow
@pytest.mark.parametrize("distances", [{}, {"sod": 600.0}, {"sdd": 1059.0}])
def test_a_start_alone_gives_no_distances(distances: dict[str, float]) -> None:
    start = StartState.of(fx.machine("flexray"))
    with pytest.raises(fx.TwinError, match=r"sod is .*; allowed: both of them in mm"):
        fx.expose(rod(15.0), start=start, **distances)


def test_the_command_says_the_same(
    forecast: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run(["expose", "--sample", "chiral", "--kV", "60", "--kV", "90", "--json"]) == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert {one["kV"] for one in document["best"]} == {60.0, 90.0}
    assert document["asked"]["kV"] == 60.0
    assert run(["expose", "--sample", "chiral"]) == 0
    out = capsys.readouterr().out
    assert "transmission: least" in out
    assert "best of" in out


@pytest.mark.parametrize("seed", range(6))
def test_no_choice_of_tube_and_detector_saturates_unless_the_exposure_is_given(
    seed: int,
) -> None:
    """An ordinary geometry and the default tube saturated all pixels, and the volume was
    zero."""
    rng = np.random.default_rng(seed)
    sod = float(rng.uniform(60, 300))
    cone = fx.ConeVec.circular(
        sod=sod, sdd=sod * float(rng.uniform(1.2, 4)), angles=24, shape=(24, 40),
        pixel=float(rng.uniform(0.3, 1.0)),
    )  # fmt: skip
    tube = fx.Tube(
        kV=float(rng.uniform(40, 200)), power_W=float(rng.uniform(2, 90)), spot_mm=0.0
    )
    panel = fx.Detector(bits=int(rng.integers(10, 17)), dead_fraction=0.0)
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 2.0, "material": "pmma"}
    scan = fx.simulate(ball, cone, tube=tube, detector=panel, noise=seed)
    assert not scan.warnings
    assert 0.7 < scan.flat.max() / panel.full_scale < 0.95
    steps: list[float] = []
    longer = {
        "exposure_ms": 30.0 * scan.truth.exposure.exposure_ms,
        "progress": steps.append,
    }
    with pytest.warns(UserWarning, match="100 % of the pixels of the .* saturated"):
        bright = fx.simulate(ball, cone, tube=tube, detector=panel, noise=seed, **longer)
    assert steps == pytest.approx(np.arange(1, 25) / 24)
    assert "2 warnings" in repr(bright)
    with pytest.raises(fx.TwinError, match="hold no line integrals"):
        bright.reconstruct("fdk", voxel=1.0)
