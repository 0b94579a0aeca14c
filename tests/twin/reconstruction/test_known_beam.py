"""A known spectrum tells how much it bends a volume; the correction takes that out of the claim."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.ndimage import uniform_filter

import flexdt as fx
from flexdt.phantoms import as_phantom
from flexdt.twin.attenuation.materials import material
from flexdt.twin.reconstruction.known_beam import Beam

CONE = fx.ConeVec.circular(sod=150, sdd=300, angles=120, shape=(24, 80), pixel=0.54)
WALL = (3.0, 8.0)


def attenuation(name: str, path_mm: float, tube: fx.Tube) -> float:
    """Mean attenuation of a path by the tube's photons, weighted by energy [1/mm]."""
    from flexdt.twin.physics.tube import tube_spectrum

    light = tube_spectrum(tube.kV, tube.model())
    weights = light.fluence * light.energy_keV
    left = np.exp(-path_mm * material(name).substance.attenuation())
    return float(-np.log(left @ weights / weights.sum()) / path_mm)


@pytest.mark.parametrize(
    ("name", "path_mm"), [("pmma", 30.0), ("aluminium", 10.0), ("steel", 1.0)]
)
def test_the_material_of_an_object_is_guessed_by_its_attenuation(
    name: str, path_mm: float
) -> None:
    mu = attenuation(name, path_mm, fx.Tube(kV=90))
    found = Beam(90.0).likely(mu, mu * path_mm).material
    alike = {"pmma": ("pmma", "abs", "water", "wood"), "aluminium": ("aluminium", "bone")}
    assert found in alike.get(name, (name,))


def scan_of(cone: Any) -> Any:
    tube = trimesh.creation.annulus(*WALL, 20.0, sections=128)
    sample = as_phantom(tube, material="aluminium")
    return fx.simulate(sample, cone, tube=fx.Tube(kV=90), progress=False)


@pytest.fixture(scope="module")
def scan() -> Any:
    return scan_of(CONE)


@pytest.fixture(scope="module")
def long_scan() -> Any:
    """As of issue 78: 180 views."""
    return scan_of(
        fx.ConeVec.circular(sod=150, sdd=300, angles=180, shape=(24, 80), pixel=0.54)
    )


CLEAR = 0.9, 1.5
"""Distances of the wall's regions from its surfaces [mm]: those that hold no edge, and those
that are uniform to the accuracy, whose nodes are three from an edge."""


def told(
    data: Any, clear: float = CLEAR[0], **options: Any
) -> tuple[Any, float, list[str]]:
    """Reconstruct; also how much means of 3 x 3 x 3 voxels of the wall differ from one value,
    nine of ten at most."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        volume = data.reconstruct("fdk", progress=False, **options)
    x, y, z = volume.centers()
    away = np.hypot(x, y[:, None])
    wall = (away > WALL[0] + clear) & (away < WALL[1] - clear)
    values = uniform_filter(volume.data, 3)[len(z) // 2][wall]
    off = np.abs(values / np.median(values) - 1.0)
    said = [str(one.message) for one in given]
    return volume.accuracy, float(np.percentile(off, 90.0)), said


@pytest.mark.slow
def test_hardening_of_an_aluminium_tube_is_told_and_gone_after_its_correction(
    scan: Any,
) -> None:
    plain, off, said = told(scan)
    assert off > 0.08
    assert plain.cause == "hardening"
    assert off / 1.5 < plain.most < 1.9 * off
    assert plain.figure.endswith("at 90 kV")
    assert any("beam hardening" in one for one in said)
    assert "one energy" not in str(plain)
    corrected, off, said = told(scan, CLEAR[1], material="aluminium")
    assert off < 0.01
    assert corrected.cause != "hardening"
    assert off < corrected.most < 0.01
    assert "material" in corrected.taken
    assert said == []


@pytest.mark.slow
def test_a_tube_that_no_roll_changes_is_told_of_none(long_scan: Any) -> None:
    """180 views of what all rows show alike, without noise: the error of sampling was hidden by
    smoothing, and a panel rolled by 15 degrees explained the rest."""
    plain, off, _ = told(long_scan)
    assert plain.cause == "hardening"
    assert off / 1.5 < plain.most < 1.9 * off
    assert (plain.next, plain.doubled_mm) == ("", 0.0)
    corrected, off, said = told(long_scan, CLEAR[1], material="aluminium")
    assert off < corrected.most < 0.01
    assert (corrected.cause, corrected.next) == ("sampling", "")
    assert corrected.doubled_mm == 0.0
    assert said == []


@pytest.mark.slow
def test_without_a_spectrum_the_claim_is_for_one_energy(scan: Any) -> None:
    images = np.stack([scan[k] for k in range(len(scan))])
    volume = fx.fdk(images, scan.cone_vec, fx.Grid((9, 40, 40), 0.54), progress=False)
    assert str(volume.accuracy).startswith("accuracy at one energy: within")


@pytest.mark.slow
def test_images_of_one_energy_are_told_of_no_hardening() -> None:
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "aluminium"}
    tube = fx.Tube(kV=90, mono_keV=50.0)
    data = fx.simulate([ball], CONE, tube=tube, progress=False)
    accuracy, _, _ = told(data)
    assert accuracy.cause != "hardening"
    assert not {"one energy", "material"} & set(accuracy.taken)
