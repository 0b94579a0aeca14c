"""Several materials, from Python and the command line, to what `sirt` itself makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli import main
from flexdt.twin.attenuation.materials import material, stated_keV
from flexdt.twin.reconstruction import Polychromatic, sirt

pytestmark = pytest.mark.usefixtures("on_processor")

SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=10, shape=(4, 12), pixel=1.0)
GRID = fx.Grid((3, 8, 8), 0.75)
WORDS = ("pmma", "steel")


@pytest.fixture(scope="module")
def data() -> fx.DataSet:
    y, x = np.mgrid[:8, :8] - 3.5
    layer = np.where(x**2 + y**2 < 12, 0.02, 0.0) + np.where(
        (x == 1.5) & (y == 0.5), 0.6, 0.0
    )
    lines = fx.forward(fx.Volume(np.repeat(layer[None], 3, 0), 0.75), SCAN)
    counts = np.rint(40000 * np.exp(-lines)).astype(np.uint16)
    return fx.DataSet.from_arrays(counts, SCAN, flat=np.full((4, 12), 40000), name="pins")


def test_materials_reach_the_iterations(data: fx.DataSet) -> None:
    given = {"voxel": 0.75, "shape": GRID.shape, "iterations": 4, "tube": fx.Tube(kV=90)}
    found = data.reconstruct("sirt", material=WORDS, **given)
    both = Polychromatic.of([material(w).substance for w in WORDS], 90.0, stated_keV())
    lines = data.line_integrals()
    wanted = sirt(lines, SCAN, GRID, iterations=4, hardening=both).data
    np.testing.assert_allclose(found.data, wanted, atol=1e-6)
    without = {name: value for name, value in given.items() if name != "tube"}
    plain = data.reconstruct("sirt", **without).data
    assert np.abs(found.data - plain).max() > 0.02
    one = data.reconstruct("sirt", material=["pmma"], **given).data
    np.testing.assert_array_equal(
        one, data.reconstruct("sirt", material="pmma", **given).data
    )
    single = {**given, "tube": fx.Tube(kV=90, mono_keV=50)}
    np.testing.assert_array_equal(
        data.reconstruct("sirt", material=WORDS, **single).data, plain
    )


@pytest.mark.parametrize(
    ("algorithm", "names", "said"),
    [
        (
            "fdk",
            WORDS,
            "materials pmma, steel with fdk; allowed: one, or several with sirt or",
        ),
        ("tv", WORDS, "with tv"),
        ("sirt", (), "no material"),
        ("sirt", ("pmma", "pmma"), "attenuate alike"),
        ("sirt", ("pmma", "stel"), "unknown material 'stel'"),
    ],
)
def test_what_is_refused(
    data: fx.DataSet, algorithm: str, names: tuple[str], said: str
) -> None:
    with pytest.raises(fx.TwinError, match=said):
        data.reconstruct(algorithm, material=names, tube=fx.Tube(kV=90), voxel=0.75)


def test_the_command_takes_a_list(
    data: fx.DataSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data.save(tmp_path / "pins")
    words = ["reconstruct", str(tmp_path / "pins"), "--out", str(tmp_path / "v.tif"), "--kv", "90",
             "--material", "pmma, steel", "--voxel", "0.75", "--shape", "3,8,8"]  # fmt: skip
    for extra, code in (([], 3), (["--algorithm", "sirt", "--iterations", "4"], 0)):
        with pytest.raises(SystemExit) as ended:
            main([*words, *extra])
        assert (ended.value.code or 0) == code
    assert "several with sirt or sart" in capsys.readouterr().err
    given = {"voxel": 0.75, "shape": GRID.shape, "iterations": 4, "tube": fx.Tube(kV=90)}
    wanted = fx.open(tmp_path / "pins").reconstruct("sirt", material=WORDS, **given)
    np.testing.assert_array_equal(fx.Volume.load(tmp_path / "v.tif").data, wanted.data)
