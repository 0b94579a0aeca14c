"""Small things that once failed in silence or in other people's words, each with its answer."""

from __future__ import annotations

import ast
import inspect
import json
import sys
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli import main
from flexdt.clients.cli.commands.calibrate_commands import show
from flexdt.library.reconstruction.reconstruct import VolumeRequest, reconstruct_dataset
from flexdt.twin.dataset.flexdt_json import parse_document
from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.readout import Expected, read_out
from flexdt.twin.script import ScanPlan

SCAN = fx.ConeVec.circular(sod=60, sdd=100, angles=16, shape=(16, 16), pixel=1.0)


@pytest.mark.usefixtures("on_processor")
def test_fdk_and_iterative_algorithms_take_a_grid() -> None:
    volume = fx.Volume(np.ones((6, 6, 6)), 0.5)
    images = fx.forward(volume, SCAN)
    grid = fx.Grid((6, 6, 6), 0.5)
    for algorithm, options in (
        (fx.fdk, {"errors": False}),
        (fx.back, {}),
        (fx.sirt, {"iterations": 2}),
    ):
        one, two = (algorithm(images, SCAN, like, **options) for like in (grid, volume))
        assert np.array_equal(one.data, two.data)


BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}


EDGES = r"voxel_mm is \(.*; allowed: a number, three values, each a number"


@pytest.mark.parametrize(
    ("call", "told"),
    [
        *((lambda size=size, f=f: f(np.ones((4, 4, 4)), voxel_mm=size), EDGES)
          for size in ((), (1, 1), (1, 1, 1, 1))
          for f in (lambda *a, **b: fx.simulate(*a, SCAN, **b), fx.expose)),
        (lambda: fx.calibrate([], "lego"), "no data sets; allowed: one or more"),
        *((lambda f=f: f(np.zeros((0, 4, 4)), np.zeros((0, 12)), fx.Grid((4, 4, 4), 1)), "views")
          for f in (fx.fdk, fx.sirt, fx.cgls, fx.tv)),
        *((lambda f=f: f(np.ones((16, 16, 16), np.uint16), SCAN, fx.Grid((4, 4, 4), 1)),
           "projections are uint16, as a detector's counts are")
          for f in (fx.fdk, fx.sirt, fx.cgls, fx.tv)),
        *((lambda n=n: fx.reconstruct(fx.simulate(BALL, SCAN), every=n), f"every {n} frames; all")
          for n in (0, -2)),
        (lambda: fx.reconstruct(fx.simulate(BALL, SCAN), every=1.5),
         "every is 1.5; allowed: a whole number"),
    ],
)  # fmt: skip
def test_nothing_at_all_is_refused(call: Callable[[], object], told: str) -> None:
    with pytest.raises(fx.TwinError, match=told):
        call()


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: fx.simulate(SCAN, BALL),
         "geometry is a dict; allowed: a ConeVec, an array of numbers"),
        (lambda: fx.Tube(kV="90"), "kV is '90'; allowed: a number .*, 20 to 240 kV"),
        (lambda: fx.Detector(bits="14"), "bits is '14'; allowed: a whole number .depth, 1 to 16"),
        (lambda: fx.Tube(filters="Al 0.5mm"),
         "filters is 'Al 0.5mm'; allowed: .*FORMULA@DENSITY in g/cm3, thickness"),
        (lambda: fx.Tube(filters=[("Al@2.70", "0.5")]),
         "filters is .*'0.5'.*; allowed: .*a text, a number"),
        (lambda: fx.simulate(BALL, SCAN, exposure_ms="9"),
         "exposure_ms is '9'; allowed: a number or None"),
        (lambda: fx.Volume("part.stl", 1.0), "data is 'part.stl'; allowed: an array of numbers"),
        (lambda: fx.sirt(np.zeros((16, 16, 16)), SCAN, fx.Grid((4, 4, 4), 1.0), iterations="9"),
         "iterations is '9'; allowed: a whole number"),
    ],
)  # fmt: skip
def test_values_of_another_kind_get_a_sentence(
    call: Callable[[], object], told: str
) -> None:
    with pytest.raises(fx.TwinError, match=told):
        call()


def test_positions_outside_the_travel_are_not_a_pose() -> None:
    machine = builtin_machine()
    profile, camera = builtin_profile("thesis"), machine.detector.camera
    with pytest.raises(LimitError, match=r"mag_obj target 5000 mm is outside \["):
        poses(machine, profile, camera, {"mag_obj": 5000.0})
    with pytest.raises(LimitError, match="mag_obj"):
        poses(machine, profile, camera, {"mag_obj": [500.0, 600.0, 5000.0]})
    assert len(poses(machine, profile, camera, {"mag_obj": [500.0, 600.0]})) == 2


def test_a_signal_of_another_panel_is_not_read_out() -> None:
    machine = builtin_machine()
    signal = np.ones((40, 50), np.float32)
    exposure = ExposureSettings(90.0, 50.0, 100.0)
    with pytest.raises(LimitError, match="of shape 40 x 50; allowed: 760 x 956"):
        read_out(
            detector_of(machine.detector),
            Expected(signal, signal),
            machine.detector.camera,
            exposure,
        )


def test_messages_are_ours_and_not_a_librarys() -> None:
    with pytest.raises(fx.TwinError) as wrong:
        ScanPlan.from_dict({"machine": 1})
    assert "Value error" not in str(wrong.value)
    assert "ScanPlan: profile: is missing" in str(wrong.value)
    text = json.dumps({"schema": 1, "frames": [{"file": "../x.tif"}]})
    with pytest.raises(fx.TwinError, match=r"file name '\.\./x\.tif' contains") as wrong:
        parse_document(text)
    assert "Value error" not in str(wrong.value)
    assert "Value error" not in str(wrong.value.data)
    with pytest.raises(fx.TwinError) as wrong:
        parse_machine("name = 3")
    assert "Value error" not in str(wrong.value)


def test_a_calibration_without_a_fit_prints_no_figures() -> None:
    out = "\n".join(show(
        {"verdict": "Not to be used: no beads.", "parameters": {}, "frames": 12, "detections": 3,
         "expected": 60, "rms_px": None, "outliers": [], "seconds": 0.5, "weak": []}
    ))  # fmt: skip
    assert "None" not in out
    assert "12 frames, 3 of 60 beads seen: no fit" in out


def test_calibrate_without_a_phantom_lists_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "nowhere"])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert "--phantom" in err
    assert "lego" in err


def test_a_volume_file_may_be_named_by_text(tmp_path: Path) -> None:
    data = fx.DataSet.from_arrays(
        np.full((16, 16, 16), 500),
        SCAN,
        dark=np.zeros((16, 16)),
        flat=np.full((16, 16), 900),
    )
    out = str(tmp_path / "v.mha")
    assert reconstruct_dataset(data, out, VolumeRequest(shape=(4, 4, 4)))["file"] == out
    assert fx.Volume.load(out).shape == (4, 4, 4)


@pytest.mark.parametrize("name", ["torch", "odl", "cil"])
def test_a_framework_that_is_not_there_is_named_with_its_command(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    operator = fx.Operator(SCAN, fx.Grid((4, 4, 4), 1.0))
    monkeypatch.setitem(sys.modules, name, None)  # type: ignore[arg-type]
    with pytest.raises(
        fx.TwinError, match=rf"{name} is not installed .*: (pip|conda) install"
    ):
        getattr(operator, name)()


def test_what_a_notebook_prints_is_short() -> None:
    plan = fx.plan("rot_obj move absolute 90 ACK")
    forecast = fx.expose("normal-5", kV=90, images=10)
    shown = (
        fx.machine(),
        plan,
        plan.check(),
        forecast,
        fx.phantoms.lego(),
        fx.phantoms.shepp_logan(),
    )
    for value in shown:
        for text in (repr(value), str(value)):
            assert len(text) < 200
            assert "\n" not in text
    assert "'flexray'" in repr(shown[0])
    assert "ok, 0 collisions" in repr(shown[2])


def test_completion_behind_phantoms_offers_what_is_public() -> None:
    names = dir(fx.phantoms)
    assert {"lego", "shepp_logan", "beads", "from_mesh"} <= set(names)
    assert all(callable(getattr(fx.phantoms, name)) for name in names)


def test_a_volume_is_given_to_other_libraries_by_dlpack() -> None:
    volume = fx.Volume(np.arange(24.0).reshape(2, 3, 4), 0.5)
    given = np.from_dlpack(volume)
    assert np.shares_memory(given, volume.data)
    assert np.array_equal(given, volume.data)


@pytest.mark.parametrize("seed", [-1, 1.5, "1"])
def test_a_seed_is_a_whole_number(seed: object) -> None:
    with pytest.raises(
        fx.TwinError, match=r"noise is .*; allowed: .*seed,? >= 0[;,] .*None"
    ):
        fx.simulate("lego", SCAN, noise=seed)  # type: ignore[arg-type]


def test_line_integrals_in_memory_are_a_data_set() -> None:
    integrals = np.random.default_rng(3).uniform(-0.05, 3.0, (16, 16, 16))
    data = fx.DataSet.from_arrays(integrals, SCAN)
    assert (
        np.abs(data.line_integrals() - integrals).max() < 4e-4
    )  # half a count of exp(-3) 60000
    assert data.warnings == ()
    beyond = fx.DataSet.from_arrays(integrals + 20.0 * (integrals > 2.5), SCAN)
    assert any("they are cut" in doubt for doubt in beyond.warnings)
    with pytest.raises(fx.TwinError, match="allowed: finite"):
        fx.DataSet.from_arrays(np.where(integrals > 2.0, np.nan, integrals), SCAN)


@pytest.mark.usefixtures("on_processor")
def test_scipy_takes_an_operator_as_it_is() -> None:
    linalg = pytest.importorskip("scipy.sparse.linalg")
    operator = fx.Operator(SCAN, fx.Grid((5, 6, 7), 0.5))
    made = linalg.aslinearoperator(operator)
    x = np.random.default_rng(1).random((5, 6, 7), np.float32)
    y = np.random.default_rng(2).random((16, 16, 16), np.float32)
    assert made.shape == (16**3, 5 * 6 * 7)
    assert np.array_equal((made @ x.ravel()).reshape(y.shape), operator @ x)
    assert np.array_equal((made.T @ y.ravel()).reshape(x.shape), operator.T @ y)


def test_beads_stand_where_their_positions_say() -> None:
    places = np.array([[0.0, 0.0, 5.0], [8.0, -3.0, -5.0]])
    phantom = fx.phantoms.beads(places, bead_radius_mm=0.5)
    assert np.array_equal(phantom.beads, places)
    assert phantom.size_mm == (17.0, 7.0, 11.0)
    assert len(phantom.scene.solids) == 2
    for wrong in (np.zeros((3, 2)), np.zeros((0, 3)), np.zeros((1, 1, 3)), [1.0, 2.0]):
        with pytest.raises(
            fx.TwinError, match="in place of a cuboid; allowed: the name of a cuboid"
        ):
            fx.phantoms.beads(wrong)


@pytest.mark.slow
def test_a_volume_is_shown_and_handed_to_xarray() -> None:
    xarray = pytest.importorskip("xarray")
    volume = fx.Volume(np.arange(60.0).reshape(3, 4, 5), 0.5, (1.0, 0.0, -2.0))
    array = volume.to_xarray()
    assert isinstance(array, xarray.DataArray)
    assert float(array.sel(z=-2.0, y=-0.75, x=0.5)) == volume.data[1, 0, 1]
    html = volume._repr_html_()
    assert "2.5 x 2 x 1.5 mm" in html
    assert "0 to 59 / mm" in html
    pytest.importorskip("matplotlib").use("agg")
    with pytest.raises(fx.TwinError, match="'sigma' is not there; there is data"):
        volume.plot(what="sigma")
    axes = volume.plot()
    assert np.array_equal(axes.images[0].get_array(), volume.data[1])
    assert axes.get_title() == "z = -2 mm"


def test_what_a_completer_finds_is_public_and_methods_name_their_options() -> None:
    tree = ast.parse(Path(fx.__file__).read_text(encoding="utf-8"))
    static = {
        (alias.asname or alias.name).split(".")[0]
        for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }  # fmt: skip
    assert static
    assert all(name.startswith("_") for name in static)
    for name in ("reconstruct", "calibrate", "align"):
        _, *theirs = inspect.signature(getattr(fx.DataSet, name)).parameters
        _, *ours = inspect.signature(getattr(fx, name)).parameters
        assert theirs == ours


def test_rows_that_point_nowhere_and_rows_that_count_upwards() -> None:
    with pytest.raises(
        fx.TwinError, match=r"cone_vec row 0: .*; allowed: pixels that each have"
    ):
        fx.ConeVec.from_astra(np.zeros((3, 12)))
    cone = {"type": "cone", "DetectorRowCount": 6, "DetectorColCount": 8, "DetectorSpacingX": 0.5,
            "DetectorSpacingY": 0.5, "DistanceOriginSource": 400, "DistanceOriginDetector": 200,
            "ProjectionAngles": [0.0, 1.0, 2.0]}  # fmt: skip
    upwards = fx.ConeVec.from_astra(cone)
    assert "source to detector 600 mm" in repr(upwards)
    assert (upwards.v[:, 2] > 0).all()


@pytest.mark.parametrize(
    ("sample", "scan", "told"),
    [
        ({**BALL, "center": [0, -60, 0]}, SCAN, "the source is inside the box around the sample"),
        ({**BALL, "center": [0, 0, 90]}, SCAN, "the sample is outside every view"),
        ({**BALL, "radius": 1e-3}, SCAN, "less than a pixel of 1 mm"),
        ({**BALL, "radius": 0.01},
         fx.ConeVec.circular(sod=0.05, sdd=100, angles=3, shape=(16, 16), pixel=1.0),
         "the magnification is 2000, above 1000"),
        (BALL, fx.ConeVec(SCAN.rows / 1000, (16, 16)), "are all lengths in mm"),
    ],
)  # fmt: skip
def test_a_geometry_that_fits_no_scan_of_the_sample_is_doubted(
    sample: object, scan: fx.ConeVec, told: str
) -> None:
    for call in (fx.project, fx.simulate):
        with warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always")
            call(sample, scan)
        assert any(told in str(doubt.message) for doubt in doubts)
        assert {doubt.filename for doubt in doubts} == {__file__}


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_scan_of_few_rows_is_aligned_or_told_why_not(rows: int) -> None:
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=90, shape=(rows, 64), pixel=0.25)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = fx.align(fx.simulate(BALL, scan, noise=1))
    assert found.identifiable or found.document["refused"]["axis_column_px"]
    if rows == 1:
        told = found.document["refused"]["det_roll"]
        assert "images of 1 rows and 64 columns" in told
        assert "allowed: 2 rows or more" in told


def test_another_name_of_the_same_thing_is_deprecated() -> None:
    with pytest.warns(
        DeprecationWarning, match="Grid: voxel is called voxel_mm here"
    ) as told:
        grid = fx.Grid((4, 4, 4), voxel=0.5)  # type: ignore[call-arg]
    assert grid == fx.Grid((4, 4, 4), 0.5)
    assert told[0].filename == __file__
    with pytest.warns(
        DeprecationWarning, match="Grid: voxel is called"
    ):  # not once alone
        assert fx.Grid((4, 4, 4), voxel=0.5) == grid  # type: ignore[call-arg]
    for _ in range(2):
        with pytest.warns(DeprecationWarning, match="voxel_mm here"):
            assert fx.Volume(np.zeros((2, 3, 4), np.float32), voxel=0.5).shape == (
                2,
                3,
                4,
            )  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="Grid has no argument 'voxel'"):
        fx.Grid((4, 4, 4), voxel_mm=0.5, voxel=0.5)  # type: ignore[call-arg]


def test_a_detector_comes_back_from_its_json() -> None:
    detector = fx.Detector(exposure_ms=120.0, response=((20.0, 0.9), (60.0, 0.5)))
    document = json.loads(json.dumps(asdict(detector)))
    assert fx.Detector(**document) == detector
    with pytest.raises(fx.TwinError, match="pixels is 3; allowed: a PixelGrid"):
        fx.Detector(pixels=3)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["aluminium", "copper", "steel", "tungsten-carbide"])
def test_materials_of_samples_hold_for_filters_of_tubes_too(name: str) -> None:
    kept = fx.Tube(kV=100, filters=[(name, 0.3)]).model()
    made = fx.phantoms.material(name)
    assert kept.filters[0].substance.attenuation_at(60.0) == pytest.approx(
        made.mu_at(60.0), rel=0.02
    )
    again = type(kept).of_figures(kept.figures())
    assert again.filters[0].substance.density_g_cm3 == made.density_g_cm3
    text = f'base = "flexray"\nname = "filtered"\n[[tube.filters]]\nmaterial = "{name}"\n'
    spec = parse_machine(f"{text}thickness_mm = 0.3\n").tube
    assert spec.filters[0].material == name
    with pytest.raises(
        fx.TwinError, match=r"unknown material 'aluminum'; there are: .*aluminium"
    ):
        fx.Tube(filters=[("aluminum", 0.3)])


def test_the_accuracy_is_told_once(tmp_path: Path) -> None:
    from flexdt.clients.cli.commands.data_commands import _lines_of
    from flexdt.twin.projection.volume import Accuracy

    accuracy = Accuracy(0.02, 0.04, "angles")
    document = {
        "shape": [1, 2, 3], "voxel_mm": 1.0, "frames": 4, "seconds": 1.0, "slices": [],
        "accuracy": asdict(accuracy), "warnings": [],
    }  # fmt: skip
    out = tmp_path / "v.tif"
    out.write_bytes(b"")
    assert sum(str(accuracy) in line for line in _lines_of(document, out)) == 1
    document["warnings"] = [f"doubtful: {accuracy}"]
    assert not any(str(accuracy) in line for line in _lines_of(document, out))


@pytest.mark.filterwarnings("ignore:.*layers of the grid")
def test_a_helix_is_given_the_layers_that_it_fills() -> None:
    from flexdt.library.reconstruction.reconstruct import grid_of, views_of

    helix = fx.ConeVec.helical(
        sod=100, sdd=200, angles=60, turns=3, rise=4.0, shape=(16, 12), pixel=1.0
    )
    flat, counts = np.full((16, 12), 1000), np.full((60, 16, 12), 500)
    data = fx.DataSet.from_arrays(counts, helix, flat=flat)
    views = views_of(data)
    tall, cut = (
        grid_of(views, VolumeRequest(algorithm, voxel_mm=0.5))
        for algorithm in ("sirt", "fdk")
    )
    missing = (tall.shape[0] - cut.shape[0]) * 0.5 / 2
    assert 4.0 <= missing + 0.5 <= 5.5  # a turn's rise, and the taper
    volume = data.reconstruct("fdk", voxel=0.5, errors=False)
    unknown = ~np.isfinite(volume.data).any(axis=(1, 2))
    assert unknown.mean() < 0.25


def test_a_contrast_has_its_time() -> None:
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 8, "material": "aluminium"}
    asked = fx.expose(ball, kV=90, images=10, contrast=3.0)
    assert asked.contrast_ms is not None
    assert "contrast of 3 after" in repr(asked)
    there = fx.expose(ball, kV=90, images=10, exposure_ms=min(asked.contrast_ms, 2000.0))
    if asked.contrast_ms < 2000.0 and there.asked.cnr is not None:
        assert there.asked.cnr == pytest.approx(3.0, rel=0.01)
    with pytest.raises(fx.TwinError, match="contrast is -1; allowed"):
        fx.expose(ball, contrast=-1.0)


@pytest.mark.parametrize(
    "geometry",
    [
        fx.ConeVec.circular(sod=600, sdd=1059, angles=36, shape=(190, 239), pixel=0.6),
        fx.ConeVec.circular(
            sod=60, sdd=900, angles=np.linspace(0, 200, 21), shape=(760, 956), pixel=0.15
        ),
        fx.ConeVec.helical(
            sod=600, sdd=1059, angles=72, rise=30, turns=8, shape=(190, 239), pixel=0.6
        ),
        fx.ConeVec.circular(
            sod=600, sdd=1059, angles=[10.0], shape=(190, 239), pixel=0.6
        ),
    ],
    ids=["flat", "arc", "helix", "one"],
)
def test_the_box_of_a_geometry_lies_within_its_figure(geometry: fx.ConeVec) -> None:
    """A flat box was cut at its left corner."""
    pytest.importorskip("matplotlib").use("Agg")
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    axes = geometry.plot()
    axes.figure.canvas.draw()
    ends = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    corners = np.array([[ends[k, (n >> k) & 1] for k in range(3)] for n in range(8)])
    x, y, _ = proj_transform(*corners.T, axes.get_proj())
    seen = axes.transData.transform(np.stack([x, y], axis=1))
    low, high = axes.bbox.min, axes.bbox.max
    assert (seen >= low).all()
    assert (seen <= high).all()
    axes.figure.clf()
