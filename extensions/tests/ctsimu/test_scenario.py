"""CTSimU scenarios to images, beside own images of boxes in places that `ctsimu` itself
finds."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from ctsimu_texts import box, deg, material, mm, point, sample, scenario, vector, write

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt_extensions.ctsimu.ctsimu_scan import read_scenario
from flexdt_extensions.ctsimu.scenario import Rays, ScenarioImages

ctsimu = pytest.importorskip("ctsimu.scenario")

Put = Callable[..., Path]


def rotation(rng: np.random.Generator) -> FloatArray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 2] *= np.linalg.det(q)
    return q


def attenuation(formula: str, density: float, keV: float) -> float:
    """Between the tables' energies [1/mm]."""
    mu = Substance.of("x", formula, density).attenuation()
    return float(np.interp(keV, tables().energy_keV, mu))


def chord(
    source: FloatArray,
    pixel: FloatArray,
    center: FloatArray,
    axes: FloatArray,
    size: FloatArray,
) -> FloatArray:
    """Paths through a box to pixels (..., 3), slab by slab."""
    start, way = (source - center) @ axes, (pixel - source) @ axes
    with np.errstate(divide="ignore"):
        ends = np.sort([(-size / 2 - start) / way, (size / 2 - start) / way], axis=0)
    inside = np.maximum(ends[1].min(axis=-1) - ends[0].max(axis=-1), 0.0)
    return np.asarray(inside * np.linalg.norm(way, axis=-1))


def coordinates(v: Any) -> FloatArray:
    return np.array([v.x(), v.y(), v.z()])


def pose(part: Any) -> tuple[FloatArray, FloatArray]:
    c = part.coordinate_system
    return coordinates(c.center), np.stack(
        [coordinates(x) for x in (c.u, c.v, c.w)], axis=1
    )


def expected(
    document: dict[str, Any],
    sizes: list[FloatArray],
    mu: list[float],
    air: float,
    parts: int = 1,
) -> FloatArray:
    """Transmitted energy of the unbinned pixels, (n, rows, cols), up to one factor for all; the
    mean of parts x parts places in each."""
    seen = ctsimu.Scenario(json_dict=copy.deepcopy(document))
    rows, cols = (int(document["detector"][k]["value"]) for k in ("rows", "columns"))
    pitch = [document["detector"]["pixel_pitch"][a]["value"] for a in "uv"]
    out = np.zeros((seen.n_frames(), rows, cols))
    for i in range(len(out)):
        seen.set_frame(i)
        source, _ = pose(seen.source)
        panel, along = pose(seen.detector)
        stage, turn = pose(seen.stage)
        placed = []
        for one in seen.samples:
            center, axes = pose(one)
            if one.attached_to_stage:
                center, axes = stage + turn @ center, turn @ axes
            placed.append((center, axes))
        y, x = (
            ((np.arange(n * parts) + 0.5) / parts - n / 2) * p
            for n, p in zip((rows, cols), pitch[::-1], strict=True)
        )
        pixel = panel + x[:, None] * along[:, 0] + y[:, None, None] * along[:, 1]
        ray = pixel - source
        far = np.linalg.norm(ray, axis=-1)
        depth = air * far
        for where, size, m in zip(placed, sizes, mu, strict=True):
            depth = depth + (m - air) * chord(source, pixel, *where, size)
        energy = np.exp(-depth) * np.abs(ray @ along[:, 2]) / far**3
        out[i] = energy.reshape(rows, parts, cols, parts).mean(axis=(1, 3))
    return out


def random_case(
    rng: np.random.Generator, folder: Path
) -> tuple[dict[str, Any], Any, Any, float]:
    """Boxes on the stage and in the world, in a beam whose every part is moved and tilted."""
    document = scenario(18, 21, 3)
    sizes = [rng.uniform(8, 25, 3) for _ in range(2)]
    for i, (names, size) in enumerate(zip(("uvw", "xyz"), sizes, strict=True)):
        box(folder, f"box{i}.stl", size)
        center = rng.normal(0, 4, 3) + (
            np.array([250.0, 0, 0]) if names == "xyz" else 0.0
        )
        one = sample(f"box{i}.stl", ("Al", "PMMA")[i], center, rotation(rng), names)
        scale = rng.uniform(0.5, 1.5, 3)
        one["scaling_factor"] = vector(scale, "rst")
        size *= scale
        own = ["rst", "xyz", names][int(rng.integers(3))]
        one["position"]["deviations"] = [
            {"type": "rotation", "axis": vector(rng.normal(size=3), own),
             "pivot": point(rng.normal(0, 5, 3), names),
             "amount": {**deg(10.0), "drifts": [{"value": [0.0, 30.0], "unit": "deg"}]}},
            {"type": "translation", "axis": "r", "amount": mm(float(rng.normal(0, 2)))},
        ]  # fmt: skip
        document["samples"].append(one)
    for name in ("source", "detector", "stage"):
        part = document["geometry"][name]
        part["deviations"] = [
            {"type": "rotation", "axis": "xyzuvw"[rng.integers(6)],
             "amount": deg(float(rng.normal(0, 3))), "known_to_reconstruction": False},
            {"type": "translation", "axis": "y",
             "amount": {**mm(1.0), "drifts": [{"file": "way.csv"}]}},
        ]  # fmt: skip
        part["center"]["z"]["drifts"] = [{"value": rng.normal(0, 2, 3).tolist()}]
    (folder / "way.csv").write_text("0.5\n-1\n0.25\n")
    document["acquisition"] |= {
        "start_angle": deg(float(rng.uniform(0, 90))), "stop_angle": deg(300.0),
        "direction": ["CW", "CCW"][rng.integers(2)],
        "include_final_angle": bool(rng.integers(2)),
    }  # fmt: skip
    mu = [attenuation("Al", 2.7, 60.2), attenuation("C5H8O2", 1.18, 60.2)]
    document["source"]["voltage"]["value"] = 60.2
    air = 0.0
    if rng.integers(2):
        document["environment"]["material_id"] = "heavy gas"
        document["materials"].append(material("heavy gas", "Ar", 0.02))
        air = attenuation("Ar", 0.02, 60.2)
    return document, sizes, mu, air


@pytest.mark.parametrize("seed", range(4))
def test_images_are_those_of_boxes_where_ctsimu_places_them(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    document, sizes, mu, air = random_case(rng, tmp_path)
    bins = [(1, 1), (2, 3), (3, 2), (1, 2)][seed]  # along u and v
    document["acquisition"]["pixel_binning"] = {"u": bins[0], "v": bins[1]}
    made = ScenarioImages(write(tmp_path, document), rays=1)
    monkeypatch.chdir(tmp_path)  # where `ctsimu` looks for the file of drifts
    told = expected(document, sizes, mu, air)
    rows, cols = 18 // bins[1] * bins[1], 21 // bins[0] * bins[0]
    first = expected({**document, "samples": []}, [], [], air)[0].max()
    assert told.min() < 0.5 * first
    assert cols == 21 or bins[0] == 2
    if (
        cols < 21
    ):  # an odd rest is cut off half a pixel on both sides: only its middle is compared
        told = (told[:, :, 1:] + told[:, :, :-1]) / 2.0
    told = 200 + 49800 * told / first
    told = told.reshape(3, rows // bins[1], bins[1], cols // bins[0], bins[0]).mean(
        axis=(2, 4)
    )
    difference = np.abs(np.stack(list(made.projections())) - told)
    if cols < 21:
        assert np.median(difference) < 30.0
    else:
        assert difference.max() < 2.0


@pytest.mark.parametrize("seed", range(4))
def test_edges_have_the_error_that_the_scenarios_noise_allows(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside 24 x 24 places a pixel of the boxes; without any noise, grey values are right
    to a few."""
    rng = np.random.default_rng(seed)
    document, sizes, mu, air = random_case(rng, tmp_path)
    monkeypatch.chdir(tmp_path)
    first = expected({**document, "samples": []}, [], [], air)[0].max()
    told, centres = (
        49800 * expected(document, sizes, mu, air, parts) / first for parts in (24, 1)
    )
    edges = np.abs(told - centres) > 50  # the open beam bends by less within a pixel
    assert edges.sum() > 50

    def error(rays: Rays, ratio: float | None) -> float:
        document["detector"]["noise"]["snr_at_imax"]["value"] = ratio
        images = ScenarioImages(write(tmp_path, document), rays=rays).projections()
        return float((np.stack(list(images)) - 200.0 - told)[edges].std())

    one = error(1, None)
    for ratio in (40.0, 200.0):
        allowed = 49800 / ratio
        assert error("auto", ratio) < min(allowed, 0.7 * one)
    assert error("auto", None) < 0.03 * one
    assert error(3, None) < 0.4 * one


def test_the_command_writes_images_and_metadata_that_ctsimu_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    document = scenario(16, 16, 2)
    document["detector"]["noise"]["snr_at_imax"]["value"] = 100
    document["acquisition"]["dark_field"] = {"number": 1, "ideal": True}
    document["acquisition"]["flat_field"] = {"number": 2, "frame_average": 16}
    document["simulation"] = {"other software": {"photons": 3}}
    document["detector"]["surprise"] = {"value": 3}
    path = write(tmp_path, document)
    monkeypatch.chdir(tmp_path)
    assert run(["simulate", str(path), "--json", "--seed", "4"]) == 0
    out = capsys.readouterr()
    told = json.loads(out.out)
    assert (told["projections"], told["darks"], told["flats"]) == (2, 1, 2)
    (warning,) = told["warnings"]
    said = "1 field not known to flexdt, ignored: detector.surprise = 3"
    assert warning.endswith(said)
    assert said in out.err
    folder = tmp_path / "case"
    names = ["case_0000.tif", "case_0001.tif", "case_dark.tif", "case_flat_0000.tif",
             "case_flat_0001.tif", "case_metadata.json"]  # fmt: skip
    assert sorted(p.name for p in folder.iterdir()) == names
    assert run(["simulate", str(path)]) == 1
    assert "allowed: a new folder" in capsys.readouterr().err
    metadata = pytest.importorskip("ctsimu.scenario.metadata").Metadata()
    metadata.set_from_json(json.loads((folder / "case_metadata.json").read_text()))
    shown = metadata.output.projections
    assert [shown.get(k) for k in ("filename", "number", "max_intensity", "datatype")] == [
        "case_%04d.tif", 2, 50000.0, "uint16"]  # fmt: skip
    assert (shown.dimensions.get("x"), shown.pixelsize.get("y")) == (16, 4.0)
    assert (shown.flat_field.get("filename"), shown.flat_field.get("number")) == (
        "case_flat_%04d.tif", 2)  # fmt: skip
    assert shown.dark_field.get("filename") == "case_dark.tif"
    back = metadata.acquisition_geometry.get("path_to_CTSimU_JSON")
    assert (folder / back).resolve() == path
    seen = tifffile.imread(folder / "case_0001.tif")
    assert seen.shape == (16, 16)
    assert abs(seen.mean() / 46000 - 1) < 0.1
    assert run(["simulate", str(path), "--out", "again", "--seed", "4"]) == 0
    again = (tmp_path / "again" / "case_0001.tif").read_bytes()
    assert again == (folder / "case_0001.tif").read_bytes()


def test_noise_has_the_scenarios_ratio_and_falls_with_frames_and_pixels(
    tmp_path: Path,
) -> None:
    document = scenario(240, 240, 2)
    document["detector"]["pixel_pitch"] = {"u": mm(0.1), "v": mm(0.1)}
    document["detector"]["noise"]["snr_at_imax"]["value"] = 50
    document["acquisition"] |= {
        "frame_average": 4, "pixel_binning": {"u": 2, "v": 3},
        "dark_field": {"number": 1}, "flat_field": {"number": 1, "frame_average": 9},
    }  # fmt: skip
    document["samples"] = [sample("box.stl", "Al", np.zeros(3), np.eye(3), "uvw")]
    box(tmp_path, "box.stl", np.array([20.0, 80.0, 80.0]))
    images = ScenarioImages(write(tmp_path, document), seed=1, rays=1)
    clean = ScenarioImages(images.path, seed=None, rays=1)
    pairs = [(i.astype(float), c) for i, c in zip(images.projections(), clean.projections(),
                                                  strict=True)]  # fmt: skip
    signal = pairs[0][1].mean() - 200
    # Photons are counted: the relative variance grows as the signal falls.
    sigma = 50000 / 50 * np.sqrt(signal / 49800) / np.sqrt(4 * 6)
    for noisy, without in pairs:
        assert (noisy - without).std() == pytest.approx(sigma, rel=0.03)
    flat = images.flats()[0].astype(float) - clean.flats()[0]
    assert flat.std() == pytest.approx(50000 / 50 / np.sqrt(9 * 6), rel=0.03)
    assert images.darks()[0].min() == images.darks()[0].max() == 200
    document["acquisition"]["dark_field"]["correction"] = True
    document["acquisition"]["flat_field"] |= {"correction": True, "ideal": True}
    done = fx.simulate(write(tmp_path, document))
    assert done.counts().mean() == pytest.approx(50000 * signal / 49800, rel=1e-3)
    assert done.flat.min() == 50000
    assert done.dark.max() == 0
    (tmp_path / "noise.tsv").write_text("0\t10\n30000\t40\n60000\t40\n")
    document["detector"]["noise"]["noise_characteristics_file"] = {"value": "noise.tsv"}
    document["acquisition"]["flat_field"] = {"number": 1}
    flat = ScenarioImages(write(tmp_path, document), 1).flats()[0].astype(float)
    assert flat.std() == pytest.approx(50000 / 40 / np.sqrt(6), rel=0.03)


def test_grey_values_by_joules_follow_current_time_and_the_spectrum(
    tmp_path: Path,
) -> None:
    """1e9 photons of 50 keV / (s sr mA), pixels of 4 mm at 400 mm: so many joules."""
    document = scenario(3, 3, 3)
    (tmp_path / "tube.csv").write_text("49.9,0\n50,1e9\n50.1,0\n")
    (tmp_path / "other.csv").write_text("49.9,0\n50,2e9\n50.1,0\n")
    document["source"]["spectrum"] = {
        "monochromatic": False,
        "file": {"value": "tube.csv",
                 "drifts": [{"value": ["tube.csv", "tube.csv", "other.csv"]}]},
    }  # fmt: skip
    document["source"]["current"] |= {"drifts": [{"value": [0, 60, 0], "unit": "uA"}]}
    document["source"]["filters"] = [{"material_id": "Al", "thickness": mm(2.0)}]
    document["detector"]["gray_value"] = {
        "factor": {"value": 4e14, "unit": "1/J"}, "offset": {"value": 40},
    }  # fmt: skip
    images = np.stack(
        list(ScenarioImages(write(tmp_path, document), rays=1).projections())
    )
    through = np.exp(-2.0 * attenuation("Al", 2.7, 50.0))
    joules = 1e9 * 0.12 * 0.5 * (4 / 400) ** 2 * 50 * 1.602176634e-16 * through
    values = 40 + 4e14 * joules * np.array([1.0, 1.5, 2.0])
    assert np.abs(images[:, 1, 1] / values - 1.0).max() < 5e-3
    document["detector"]["gray_value"]["intensity_characteristics_file"] = "curve.tsv"
    (tmp_path / "curve.tsv").write_text(f"0 7\n{joules} 1007\n{2 * joules} 3007\n")
    images = np.stack(
        list(ScenarioImages(write(tmp_path, document), rays=1).projections())
    )
    assert np.abs(images[:, 1, 1] / np.array([1007, 2007, 3007]) - 1.0).max() < 0.01


def test_lag_blur_and_spot(tmp_path: Path) -> None:
    document = scenario(31, 31, 3)
    document["source"]["current"] |= {"drifts": [{"value": [0, 60, 0], "unit": "uA"}]}
    document["detector"]["image_lag"] = {"value": 0.1}
    document["detector"]["gray_value"] = {"imax": {"value": 30000}}
    images = np.stack(
        list(ScenarioImages(write(tmp_path, document), rays=1).projections())
    )
    shown = images[:, 15, 15] / images[0, 15, 15]
    assert shown == pytest.approx(
        [1.0, 1.45, 1.045], abs=1e-3
    )  # 10 % of the frame before
    document = scenario(41, 41, 1)
    document["detector"]["pixel_pitch"] = {"u": mm(0.1), "v": mm(0.1)}
    box(tmp_path, "edge.stl", np.array([10.0, 30.0, 30.0]))
    document["samples"] = [
        sample("edge.stl", "Al", np.array([0, -15.0, 0]), np.eye(3), "uvw")
    ]
    document["source"]["spot"] = {"sigma": {"u": mm(0.25), "v": mm(0.0)}}

    def width() -> float:
        row = next(ScenarioImages(write(tmp_path, document), rays=5).projections())[20]
        spread = np.diff(row.astype(float))[5:-5]
        x = np.arange(len(spread)) * 0.1
        middle = (spread * x).sum() / spread.sum()
        variance = (spread * (x - middle) ** 2).sum() / spread.sum()
        return float(np.sqrt(variance - 0.1**2 / 6))  # pixels, and their differences

    spot = 0.25 * (400 / 250 - 1)
    assert width() == pytest.approx(spot, rel=0.03)
    f = np.linspace(0, 10, 200)
    curve = np.exp(-2 * (np.pi * 0.2 * f) ** 2)
    lines = [f"{a} {b}" for a, b in zip(f, curve, strict=True)]
    (tmp_path / "mtf.tsv").write_text("\n".join(lines))
    document["detector"]["unsharpness"] = {"mtf": {"value": "mtf.tsv"}}
    assert width() == pytest.approx(np.hypot(spot, 0.2), rel=0.03)
    document["detector"]["unsharpness"] = {"basic_spatial_resolution": mm(0.3)}
    pixel = 0.1**2 / 12  # is in the resolution
    wanted = np.sqrt(spot**2 + (0.3 * 0.69) ** 2 - pixel)
    assert width() == pytest.approx(wanted, rel=0.01)


@pytest.mark.slow
def test_scatter_is_added_where_the_scenario_asks_for_it(tmp_path: Path) -> None:
    document = scenario(12, 12, 1)
    box(tmp_path, "block.stl", np.array([40.0, 40.0, 40.0]))
    document["samples"] = [sample("block.stl", "PMMA", np.zeros(3), np.eye(3), "uvw")]
    plain = next(ScenarioImages(write(tmp_path, document), rays=1).projections()).astype(
        float
    )
    document["acquisition"]["scattering"] = True
    more = next(ScenarioImages(write(tmp_path, document), rays=1).projections()) - plain
    assert 0.02 < (more / (plain - 200))[4:8, 4:8].mean() < 0.5
    document["samples"][0]["position"]["center"]["u"]["drifts"] = [{"value": [0, 1]}]
    document["acquisition"]["number_of_projections"] = 2
    with pytest.raises(
        TwinError, match=r"acquisition.scattering is true; allowed: false"
    ):
        ScenarioImages(write(tmp_path, document))


BAD: tuple[tuple[str, Any, str], ...] = (
    ("samples", [{"file": "no.stl"}], r"samples\[0\] is .*position"),
    ("samples", 3, "samples is 3; allowed: a list"),
    ("detector.type", "curved", 'detector.type is "curved"; allowed: ideal or real'),
    ("detector.bit_depth", {"value": 32}, "bit_depth .* allowed: 1 to 16"),
    ("detector.gray_value", None, "gray_value is null; allowed: imax above imin"),
    ("detector.gray_value.imax.drifts", [{"value": [0, 1]}], "imax.drifts .* constant"),
    ("detector.bad_pixel_map", {"file": {"value": "map.raw"}}, "bad_pixel_map.file .* null"),
    ("detector.image_lag", {"value": 1.0}, "image_lag .* below 1"),
    ("detector.noise.snr_at_imax.value", 0, "snr_at_imax .* above 0"),
    ("source.voltage", {"value": 300, "unit": "kV"}, "source.voltage: the energy of photons is"),
    ("source.voltage.unit", "furlong", "source.voltage.unit is \"furlong\"; allowed: kV, V, MV"),
    ("source.current.value", -1, "source.current .* above 0"),
    ("source.target", {"material_id": "Al"}, None),  # read with a computed spectrum alone
    ("source.spectrum.file", {"value": "no.csv"}, "names 'no.csv'"),
    ("source.spot", {"intensity_map": {"file": {"value": "x.tif"}}}, "intensity_map.file"),
    ("source.filters", [{"material_id": "Xy"}], r"filters\[0\].material_id is \"Xy\"; .* Al, PMMA"),
    ("source.window", 2 * [{"material_id": "Al", "thickness": {"value": 1000, "unit": "mm"}}],
     "nothing of the open beam reaches"),
    ("environment.material_id", "Air", "environment.material_id is \"Air\""),
    ("materials", [{"id": "Al", "density": {"value": 2.7},
                    "composition": [{"formula": {"value": "Qq"}}]}], "no element 'Qq'"),
    ("acquisition.scattering", "yes", "scattering is \"yes\"; allowed: true or false"),
    ("acquisition.flat_field", {"number": 0, "correction": True}, "whole number from 1"),
    ("file.file_format_version.major", 0, "format 0.2; allowed: CTSimU Scenario, 1.0 to 1.2"),
)  # fmt: skip


@pytest.mark.parametrize(("place", "value", "says"), BAD, ids=[one[0] for one in BAD])
def test_what_cannot_be_done_is_refused_by_its_place(
    place: str,
    value: Any,
    says: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    document = scenario(3, 3, 2)
    *path, last = place.split(".")
    found = document
    for key in path:
        found = found[key]
    found[last] = value
    code = run(
        ["simulate", str(write(tmp_path, document)), "--out", str(tmp_path / "out")]
    )
    told = capsys.readouterr().err
    if says is None:
        assert code == 0
        return
    assert code == 1
    assert "Traceback" not in told
    assert "internal error" not in told
    assert re.search(says, told), told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["case.json"]


def places(found: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = list(found.items()) if isinstance(found, dict) else list(enumerate(found)) if (
        isinstance(found, list)
    ) else []  # fmt: skip
    return [path, *(p for key, one in items for p in places(one, (*path, key)))]


JUNK: tuple[Any, ...] = (
    None, True, -1, 0, 1e400, 1e30, float("nan"), "", "x", "Al", [], [1, "x"], {}, [[]], [None],
    {"value": None}, {"value": "x"}, {"value": [1]}, {"value": 1, "unit": 7}, {"drifts": 3},
    {"value": 1, "drifts": [{"value": "x"}]}, {"value": 1, "drifts": [{"file": "no"}]},
)  # fmt: skip


def test_spoiled_scenarios_are_read_or_refused(tmp_path: Path) -> None:
    """Any value anywhere: a document or an error that names the file, never another
    exception."""
    rng = np.random.default_rng(5)
    whole, *_ = random_case(rng, tmp_path)
    whole["detector"] |= {
        "type": "real", "unsharpness": {"basic_spatial_resolution": mm(0.1)},
        "scintillator": {"material_id": "Al", "thickness": mm(0.5)},
        "window": {"front": [{"material_id": "Al", "thickness": mm(0.1)}]},
        "image_lag": {"value": 0.1},
    }  # fmt: skip
    whole["source"]["spot"] = {
        "size": {"u": mm(0.1)},
        "sigma": {"u": mm(0.1), "v": mm(0.1)},
    }
    everywhere = [p for p in places(whole) if p]
    refused = unnamed = 0
    for _ in range(300):
        document = copy.deepcopy(whole)
        path = everywhere[rng.integers(len(everywhere))]
        found = document
        for key in path[:-1]:
            found = found[key]
        found[path[-1]] = copy.deepcopy(JUNK[rng.integers(len(JUNK))])
        try:
            read_scenario(json.dumps(document), "spoiled.json", lambda name: "1\n2\n3\n")
        except TwinError as error:
            refused += "spoiled.json" in str(error)
            unnamed += "spoiled.json" not in str(error)
    assert unnamed == 0
    assert 75 < refused < 299


def test_simulate_needs_a_geometry_or_a_scenario() -> None:
    with pytest.raises(TwinError, match="path of a CTSimU scenario"):
        fx.simulate(
            {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}
        )
