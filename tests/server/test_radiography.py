"""Images by the whole physics: materials taken apart, the spectrum, frames in any order,
lag."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from flexdt.library.reading.folders import load_dataset
from flexdt.phantoms import (
    bead_phantom,
    load_phantom,
    material,
    mesh_phantom,
    voxel_phantom,
)
from flexdt.phantoms.channels import chain_through, channels, scatter_object
from flexdt.protocol import Codec
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods.scanner_messages import TubeSet
from flexdt.protocol.rpc_errors import Code, RpcError
from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.projections import Imaging, TrueGeometry
from flexdt.server.imaging.radiography import (
    CUT_OFF,
    SATURATED,
    STARVED,
    Radiography,
    flags_of,
    marks_of,
    with_spectra,
)
from flexdt.server.scans.acquisition import Acquisition
from flexdt.server.scans.scan_record import BEGINNING, ScanSource, StartConditions
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.motion_methods import set_tube
from flexdt.testing.in_process import DirectProjector
from flexdt.twin.attenuation.materials import stated_keV
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, MachineFileError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import (
    FilterSpec,
    TubeSpec,
    builtin_machine,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.physics.chain import Chain, weights_of
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.exposure import FEW_COUNTS, ExposureSettings
from flexdt.twin.physics.scatter import Beam, ScatterSettings, scatter_image
from flexdt.twin.physics.tube import Filter, TubeModel, tube_spectrum
from flexdt.twin.projection import (
    TriangleMesh,
    Volume,
    forward,
    project_body,
    project_scene,
)
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script.parse import parse_script
from flexdt.twin.script.planning.planner import plan_script

FLEXRAY = Path(__file__).parents[2] / "twin" / "data" / "machines" / "flexray.toml"
M = builtin_machine()
P = builtin_profile(M.default_profile)
MIDDLE = CameraSettings("HW2SW1High", Roi(572, 568, 1371, 967))  # 400 x 200 image pixels
SHARP = TubeModel(spot_mm_per_W=0.0, smallest_spot_mm=0.0)
LISTING_1 = ExposureSettings(90.0, 50.0, 100.0)

FLY = "\r\n".join(
    [
        "camera\tset ROI\t900 700 963 763\t\tACK\t\t",
        "camera\tset exposure\t100.0\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        "camera\tset number of frames\t7\t\tACK\t\t",
        "tube\tset power\t50.0\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tdi000000.tif\t\tACK\t\t",
        "rot_obj\tset speed\t600.0\t\tACK\t\t",
        "rot_obj\tset acceleration\t6000.0\t\tACK\t\t",
        "rot_obj\tmove absolute\t-270.0\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        "rot_obj\tmove absolute\t630.0\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t",
        "",
    ]
)


def radiography(tmp_path: Path, physics: str, **panel: float) -> Radiography:
    imaging = Imaging(
        DirectProjector(),
        TrueGeometry(),
        SampleStore(open_data(tmp_path)),
        M.detector.pixels,
    )
    made = Radiography.of(imaging, M, physics)  # type: ignore[arg-type]
    return replace(made, panel=replace(made.panel, **panel))


def take(
    way: Radiography, sample: str, exposure: ExposureSettings = LISTING_1
) -> Float32Array:
    pose = poses(M, P, MIDDLE, {"rot_obj": [20.0]})
    return asyncio.run(way.take(Sample(sample), pose, MIDDLE, [exposure]))[0].integrals


@pytest.mark.parametrize("name", ["lego", "normal-3", "chiral", "shepp-logan", "tall"])
def test_channels_add_up_to_the_phantom(name: str) -> None:
    """At the energy at which phantoms state attenuation, the parts are the whole."""
    phantom = load_phantom(name)
    view = ConeVec(np.array([[0, -400, 0, 0, 200, 0, 0.9, 0, 0, 0, 0, -0.9]]))
    whole = project_scene(phantom.scene, view, (90, 80))
    total = np.zeros_like(whole)
    for channel in channels(phantom):
        assert isinstance(channel.body, Scene)
        path = project_scene(channel.body, view, (90, 80))
        assert path.min() > -1e-4  # no path is negative: beads take their body's place
        assert path.max() <= channel.thickest_mm * 1.001
        total += path * np.float32(channel.material.mu_per_mm)
    np.testing.assert_allclose(total, whole, atol=1e-4)


def test_a_bead_displaces_its_body() -> None:
    parts = {c.material.name: c.body for c in channels(bead_phantom("normal", 1))}
    assert set(parts) == {"abs", "steel"}
    through = ConeVec(np.array([[8.0, -400, 0, 8.0, 200, 0, 1, 0, 0, 0, 0, -1]]))
    assert project_scene(parts["steel"], through, (1, 1))[0, 0, 0] == pytest.approx(
        4.0, abs=1e-4
    )
    assert project_scene(parts["abs"], through, (1, 1))[0, 0, 0] == pytest.approx(
        36.0, abs=1e-4
    )


def test_the_twins_images_have_the_samples_scatter(tmp_path: Path) -> None:
    """The witness: the same view by `fx.simulate`'s way, other photons, its geometry by
    hand."""
    phantom = load_phantom("lego")
    parts = channels(phantom)
    way = replace(radiography(tmp_path, "mono"), tube=SHARP)
    lit = replace(way, scatter="mc")
    pose = poses(M, P, MIDDLE, {"rot_obj": [20.0]})
    [plain] = asyncio.run(way.take(Sample("lego"), pose, MIDDLE, [LISTING_1]))
    [image] = asyncio.run(lit.take(Sample("lego"), pose, MIDDLE, [LISTING_1]))
    assert plain.expected is not None
    assert image.expected is not None
    chain = chain_through(parts, way.panel, SHARP, stated_keV())
    beam = Beam.of(chain, 90.0)
    # Half the panel's pixels are open beam: what was added there is scatter alone.
    thing = scatter_object(parts, phantom.size_mm, 40_000)
    row = TrueGeometry().cone_vec(pose, Sample("lego").offset).rows[0]
    settings = ScatterSettings(seed=77, error=0.01)
    image_77 = scatter_image(thing, row, MIDDLE.shape, beam, settings, 5)
    empty = ExposureSettings(90.0, 50.0, 100.0)
    [open_beam] = asyncio.run(way.take(Sample(""), pose, MIDDLE, [empty]))
    assert open_beam.expected is not None
    added = (image.expected.mean_e - plain.expected.mean_e) / open_beam.expected.mean_e
    assert added.min() > 0.0
    # Two runs of 3 % and 1 % of the mean scatter.
    np.testing.assert_allclose(added.mean(), image_77.full().mean(), rtol=0.05)
    middle = added[60:140, 150:250].mean() / image_77.full()[60:140, 150:250].mean()
    assert middle == pytest.approx(1.0, abs=0.08)
    assert (image.expected.variance_e > plain.expected.variance_e).all()
    assert "scatter_mc" not in way.record()
    assert lit.record()["scatter_mc"] == 1.0


def test_scatter_of_a_view_does_not_depend_on_the_views_beside_it(tmp_path: Path) -> None:
    way = replace(radiography(tmp_path, "mono"), scatter="mc")
    angles = [3.0, 40.0, 170.0]
    together = asyncio.run(
        way.take(
            Sample("lego"),
            poses(M, P, MIDDLE, {"rot_obj": angles}),
            MIDDLE,
            [LISTING_1] * 3,
        )
    )
    for angle, image in zip(angles, together, strict=True):
        pose = poses(M, P, MIDDLE, {"rot_obj": [angle]})
        [alone] = asyncio.run(way.take(Sample("lego"), pose, MIDDLE, [LISTING_1]))
        assert np.array_equal(alone.integrals, image.integrals)


def test_ideal_physics_has_no_scatter(tmp_path: Path) -> None:
    imaging = Imaging(
        DirectProjector(),
        TrueGeometry(),
        SampleStore(open_data(tmp_path)),
        M.detector.pixels,
    )
    with pytest.raises(
        LimitError, match="scatter mc needs physics mono or poly, not ideal"
    ):
        Radiography.of(imaging, M, "ideal", "mc")


def test_materials_by_formula() -> None:
    own = material("C5H8O2@1.19")
    assert own.mu_per_mm == pytest.approx(material("pmma").mu_per_mm, rel=2e-3)
    assert material("Fe@7.8").substance.attenuation() == pytest.approx(
        material("steel").substance.attenuation()
    )


def test_every_material_of_the_table_has_its_composition() -> None:
    from flexdt.phantoms import materials
    from flexdt.twin.attenuation.substances import tables

    for one in materials().values():
        mu = one.substance.attenuation()
        for energy in (30.0, 50.0, 80.0):
            assert np.interp(energy, tables().energy_keV, mu) == pytest.approx(
                one.mu_at(energy), rel=5e-3
            )


def test_one_energy_is_the_ideal_image_with_another_detector(tmp_path: Path) -> None:
    plain = take(radiography(tmp_path, "ideal"), "lego")
    mono = take(radiography(tmp_path, "mono"), "lego")
    thin = plain < 4.0
    # the focal spot blurs edges; away from them the images agree
    from scipy.ndimage import maximum_filter, minimum_filter

    smooth = maximum_filter(plain, 5) - minimum_filter(plain, 5) < 0.02
    assert (smooth & thin).mean() > 0.5
    np.testing.assert_allclose(mono[smooth & thin], plain[smooth & thin], atol=3e-3)


def test_a_spectrum_is_the_sum_over_its_energies(tmp_path: Path) -> None:
    """Pixels against the full sum over all bins of the spectrum, without effective energies."""
    way = replace(radiography(tmp_path, "poly"), tube=SHARP, rays=1)
    got = take(way, "lego")
    phantom = load_phantom("lego")
    cone = TrueGeometry().cone_vec(
        poses(M, P, MIDDLE, {"rot_obj": [20.0]}), Sample().offset
    )
    mu, paths = [], []
    for channel in channels(phantom):
        assert isinstance(channel.body, Scene)
        mu.append(channel.material.substance.attenuation())
        paths.append(project_scene(channel.body, cone, MIDDLE.shape)[0].ravel()[::37])
    signal, _ = weights_of(Chain(way.panel, way.tube), 90.0)
    through = (
        np.exp(-np.array(paths, dtype=float).T @ np.array(mu)) @ signal / signal.sum()
    )
    np.testing.assert_allclose(np.exp(-got.ravel()[::37]), through, rtol=1e-3)
    assert through.min() < 0.2  # beads were met
    ideal = take(radiography(tmp_path, "ideal"), "lego").ravel()[::37]
    assert np.abs(ideal + np.log(through)).max() > 0.2  # and one energy is not enough


def test_filters_and_focal_spot_are_the_machine_file_s(tmp_path: Path) -> None:
    own = M.model_copy(
        update={
            "tube": TubeSpec(
                max_kV=90.0, max_W=90.0, kV=90.0, power_W=50.0, smallest_spot_mm=0.2,
                filters=(FilterSpec(material="Al@2.70", thickness_mm=0.5),
                         FilterSpec(material="Cu@8.96", thickness_mm=0.25)),
            )
        }
    )  # fmt: skip
    plain = radiography(tmp_path, "poly", dead_fraction=0.0)
    way = replace(plain, tube=Radiography.of(plain.imaging, own, "poly").tube)
    assert plain.tube == TubeModel()  # what ships is the assumed default
    pose = poses(M, P, MIDDLE, {})

    def image(which: Radiography, sample: str) -> Float32Array:
        got = asyncio.run(which.take(Sample(sample), pose, MIDDLE, [LISTING_1]))[0]
        assert got.expected is not None
        return got.expected.mean_e

    # A quarter millimetre of copper, by hand: what comes through, each energy by itself.
    signal, _ = weights_of(Chain(plain.panel, plain.tube), 90.0)
    copper = material("copper").substance.attenuation()
    part = float(np.exp(-0.25 * copper) @ signal / signal.sum())
    assert 0.1 < part < 0.5
    ratio = image(way, "") / image(plain, "")
    np.testing.assert_allclose(ratio, part, rtol=1e-4)
    # and the steepest edge of a bead is softer: 0.2 mm, magnified
    edge, sharp = (np.abs(np.diff(image(w, "lego"), axis=1)).max() for w in (way, plain))
    assert edge < 0.8 * part * sharp
    figures = way.record()
    assert figures["tube_filter_Cu@8.96_mm"] == 0.25
    assert figures["tube_smallest_spot_mm"] == 0.2
    assert TubeModel.of_figures(figures) == way.tube
    assert TubeModel.of_figures({}) == TubeModel()
    with pytest.raises(LimitError, match=r"nothing comes through .*100 mm of Pb"):
        tube_spectrum(20.0, TubeModel((Filter(Substance.parse("Pb@11.3"), 100.0),)))


def test_rays_from_points_of_the_focal_spot_blur_each_depth_as_it_is(
    tmp_path: Path,
) -> None:
    """The witness: transmission averaged over a grid of sources."""
    fwhm, keV = 0.4, stated_keV()
    spot = f"smallest_spot_mm = {fwhm}\nspot_points = 48"
    own = parse_machine(
        re.sub("smallest_spot_mm = .*", spot, FLEXRAY.read_text()), "own.toml"
    )
    way = radiography(tmp_path, "mono")
    made = Radiography.of(way.imaging, own, "mono")
    assert TubeModel.of_figures(made.record()) == made.tube
    seen = CameraSettings("HW2SW1High", Roi(932, 628, 975, 907))  # 22 x 140 image pixels
    pose = poses(M, P, seen, {"mag_obj": [150.0], "rot_obj": [20.0]})
    found, one_blur = (
        asyncio.run(one.take(Sample("lego"), pose, seen, [LISTING_1]))[0].integrals
        for one in (made, replace(made, tube=replace(made.tube, spot_points=1)))
    )
    row = TrueGeometry().cone_vec(pose, Sample("lego").offset).rows[0]
    at = np.linspace(-3.3, 3.3, 23)
    places = np.array([(x, y) for x in at for y in at])
    weight = np.exp(-(places**2).sum(axis=1) / 2)
    edges = np.array([row[i : i + 3] / np.linalg.norm(row[i : i + 3]) for i in (6, 9)])
    moved = np.repeat(row[None], len(places), axis=0)
    moved[:, :3] += fwhm / 2.35482 * places @ edges
    depth = np.zeros((len(places), *seen.shape))
    for part in channels(load_phantom("lego")):
        mu = part.material.substance.attenuation_at(keV)
        depth += mu * project_body(part.body, ConeVec(moved), seen.shape)
    through = np.tensordot(weight / weight.sum(), np.exp(-depth), 1)
    error, plain = (np.abs(np.exp(-image) - through) for image in (found, one_blur))
    assert error.max() < 0.3 * plain.max()
    assert error.mean() < 0.3 * plain.mean()
    several = asyncio.run(made.take(Sample("lego"), poses(M, P, seen, {"mag_obj": [150.0, 300.0],
                          "rot_obj": [20.0, 0.0]}), seen, [LISTING_1] * 2))  # fmt: skip
    assert np.array_equal(several[0].integrals, found)


def test_tube_and_camera_have_their_effect(tmp_path: Path) -> None:
    way = radiography(tmp_path, "poly", dead_fraction=0.0)
    pose = poses(M, P, MIDDLE, {})

    def level(exposure: ExposureSettings) -> float:
        image = asyncio.run(way.take(Sample(), pose, MIDDLE, [exposure]))[0]
        return float(way.counts(image, MIDDLE, exposure, None).mean()) - 100.0

    base = level(LISTING_1)
    dark = level(replace(LISTING_1, xrays_on=False))
    assert 8_000 < base < 14_000
    assert abs(dark) < 10
    assert level(replace(LISTING_1, power_W=25.0)) == pytest.approx(base / 2, rel=0.01)
    assert level(replace(LISTING_1, exposure_ms=50.0)) == pytest.approx(
        base / 2, rel=0.01
    )
    assert level(replace(LISTING_1, kV=60.0)) < 0.75 * base
    far = poses(M, P, MIDDLE, {"mag_det": [700.0]})
    short = replace(LISTING_1, exposure_ms=20.0)
    near = asyncio.run(way.take(Sample(), far, MIDDLE, [short]))[0]
    ratio = 5.0 * (way.counts(near, MIDDLE, short, None).mean() - 100.0) / base
    there = float(poses(M, P, MIDDLE, {}).cone_vec().source_detector_distance[0])
    here = float(far.cone_vec().source_detector_distance[0])
    assert ratio == pytest.approx((there / here) ** 2, rel=0.02)


def frames(
    tmp_path: Path, groups: list[list[int]], **panel: float
) -> dict[str, npt.NDArray[np.uint16]]:
    plan = plan_script(parse_script(FLY), M, P)
    assert not plan.errors
    way = radiography(tmp_path, "poly", **panel)
    made: dict[str, npt.NDArray[np.uint16]] = {}
    acquisition = Acquisition(plan, way, Sample("lego"), 5, made.__setitem__)
    for group in groups:
        asyncio.run(acquisition.produce([plan.exposures[i] for i in group]))
    return made


def test_frames_are_the_same_in_any_order(tmp_path: Path) -> None:
    together = frames(tmp_path, [[0], [1, 2, 3, 4, 5, 6, 7]])
    backwards = frames(tmp_path, [[7], [6], [5], [4], [3], [2], [1], [0]])
    assert len(together) == 8
    assert all(np.array_equal(together[name], backwards[name]) for name in together)
    alone = frames(tmp_path, [[4]])
    name = next(iter(alone))
    assert np.array_equal(alone[name], together[name])


def test_lag_comes_from_the_poses_before(tmp_path: Path) -> None:
    lagging = frames(tmp_path, [[3]], lag_fraction=0.2, lag_s=0.5)
    prompt = frames(tmp_path, [[3]], lag_fraction=0.0)
    more = next(iter(lagging.values())).astype(float) - next(iter(prompt.values()))
    assert more.mean() > 500
    first = frames(tmp_path, [[1]], lag_fraction=0.2, lag_s=0.5)
    plain = frames(tmp_path, [[1]], lag_fraction=0.0)
    assert all(
        np.array_equal(first[n], plain[n]) for n in first
    )  # only a dark came before


def test_traps_give_back_what_they_took(tmp_path: Path) -> None:
    """Long lag against a sum over all earlier frames, whatever of the scan is made first."""
    figures = {
        "long_lag_fraction": 0.1, "long_lag_s": 3.0, "lag_fraction": 0.0,
        "offset_sigma_counts": 0.0, "gain_sigma": 0.0, "dead_fraction": 0.0, "blur_mm": 0.0,
    }  # fmt: skip
    plan = plan_script(parse_script(FLY), M, P)

    def made(groups: list[list[int]], **panel: float) -> list[npt.NDArray[np.float64]]:
        way = radiography(tmp_path, "poly", **{**figures, **panel})
        found: dict[str, npt.NDArray[np.uint16]] = {}
        acquisition = Acquisition(plan, way, Sample("lego"), None, found.__setitem__)
        for group in groups:
            asyncio.run(acquisition.produce([plan.exposures[i] for i in group]))
        return [found[name].astype(float) for name in sorted(found)]

    together = made([[0], [1, 2, 3, 4, 5, 6, 7]])
    backwards = made([[7], [6, 5], [0], [4, 3, 2, 1]])
    assert all(np.array_equal(a, b) for a, b in zip(together, backwards, strict=True))
    prompt = made([[0], [1, 2, 3, 4, 5, 6, 7]], long_lag_fraction=0.0)
    dark = prompt[0].mean()
    for k, frame in enumerate(plan.exposures):
        wanted = prompt[k].copy()
        for earlier, image in zip(plan.exposures[:k], prompt, strict=False):
            if earlier.xrays_on:
                gap = frame.start_s - earlier.start_s - earlier.duration_s
                given = np.exp(-gap / 3.0) - np.exp(-(gap + frame.duration_s) / 3.0)
                wanted += 0.1 * (image - dark) * given
        if frame.xrays_on:
            wanted -= 0.1 * (prompt[k] - dark)
        np.testing.assert_allclose(together[k], wanted, atol=1.5)
    assert abs(together[7] - prompt[7]).max() > 300.0
    assert "long_lag_s" not in radiography(tmp_path, "poly").record()
    assert radiography(tmp_path, "poly", **figures).record()["long_lag_s"] == 3.0


def test_the_machine_file_states_the_traps(tmp_path: Path) -> None:
    detector = M.detector.model_copy(
        update={"long_lag_fraction": 0.004, "long_lag_s": 3.0}
    )
    own = M.model_copy(update={"detector": detector})
    way = radiography(tmp_path, "poly")
    made = Radiography.of(way.imaging, own, "poly")
    assert (made.panel.long_lag_fraction, made.panel.long_lag_s) == (0.004, 3.0)
    assert made.traps
    assert not replace(made, physics="ideal").traps
    assert not way.traps


def test_the_machine_file_gives_a_measured_response(tmp_path: Path) -> None:
    """Behind aluminium, beside a sum over the spectrum with the curve written out."""
    text = FLEXRAY.read_text()
    curve = "response = [[20, 16], [33, 19], [34, 23], [100, 20], [300, 9]]"
    own = parse_machine(text.replace("[detector]", f"[detector]\n{curve}", 1), "own.toml")
    way = radiography(tmp_path, "poly")
    made = Radiography.of(way.imaging, own, "poly")
    assert made.record()["response_34_keV"] == 23.0
    aluminium = Substance.parse("Al@2.70")
    spectrum = tube_spectrum(90.0, made.tube)
    energy, fluence = spectrum.energy_keV, spectrum.fluence
    left = np.zeros_like(energy)
    points = [(0, 0), (20, 16), (33, 19), (34, 23), (100, 20), (300, 9)]
    for (e0, d0), (e1, d1) in itertools.pairwise(points):
        part = (energy > e0) & (energy <= e1)
        left[part] = d0 + (d1 - d0) * (energy[part] - e0) / (e1 - e0)
    behind = fluence * np.exp(-20.0 * aluminium.attenuation())
    chain = Chain(made.panel, made.tube, (aluminium,), (40.0,))
    signal, noise = weights_of(chain, 90.0)
    through = np.exp(-20.0 * aluminium.attenuation())
    assert signal @ through / signal.sum() == pytest.approx(
        behind @ left / (fluence @ left)
    )
    assert (
        noise >= signal**2 / np.maximum(fluence, 1e-300)
    ).all()  # no less than Poisson's
    plain = weights_of(Chain(Detector(), made.tube, (aluminium,), (40.0,)), 90.0)[0]
    assert (
        abs(plain @ through / plain.sum() / (signal @ through / signal.sum()) - 1.0)
        > 0.02
    )


@pytest.mark.parametrize(
    ("curve", "said"),
    [
        ("[[20, 21], [300, 9]]", "at most the photon's energy, 20 keV"),
        ("[[20, 1], [20, 9]]", "at a higher energy than the point before, 20 keV"),
        ("[[20, 1], [30, 9]]", "measured up to the tube's max_kV"),
        ("[[20, -1], [300, 9]]", "allowed: at least 0"),
        ("[[20]]", "response.0"),
    ],
)
def test_responses_that_no_detector_has(curve: str, said: str) -> None:
    text = FLEXRAY.read_text()
    with pytest.raises(MachineFileError, match=re.escape(said)):
        parse_machine(
            text.replace("[detector]", f"[detector]\nresponse = {curve}", 1), "own.toml"
        )


def test_a_resumed_scan_keeps_its_physics() -> None:
    from flexdt.twin.script import StartState

    begin = StartConditions(StartState(positions={}, speeds={}, accelerations={}, camera=MIDDLE,
                                 kV=90.0, power_W=50.0, xrays_on=False),
                      Sample("lego"), 3, 1, "poly", "mc")  # fmt: skip
    again = BEGINNING.validate_python(asdict(begin))
    assert (again.physics, again.scatter) == ("poly", "mc")
    older = {k: v for k, v in asdict(begin).items() if k not in ("physics", "scatter")}
    known = BEGINNING.validate_python(older)
    assert (known.physics, known.scatter) == ("ideal", "off")
    with pytest.raises(ValueError, match="physics"):
        BEGINNING.validate_python({**asdict(begin), "physics": "magic"})


def test_the_data_set_says_what_made_it(tmp_path: Path) -> None:
    figures = radiography(tmp_path, "poly").record()
    assert figures["physics_poly"] == 1.0
    assert figures["scintillator_CsI@4.51"] == 1.0
    assert figures["full_well_e_high"] == 1.6e6
    assert set(radiography(tmp_path, "ideal").record()) >= {
        "i0_counts",
        "read_noise_counts",
    }


@pytest.mark.parametrize(("physics", "weak"), [("ideal", 0.1), ("poly", 0.12)])
def test_flags_say_what_is_wrong_with_an_image(
    tmp_path: Path, physics: str, weak: float
) -> None:
    way = radiography(tmp_path, physics)

    def flags(
        camera: CameraSettings, exposure: ExposureSettings, sample: str, **at: float
    ):
        pose = poses(M, P, camera, {n: [v] for n, v in at.items()})
        image = asyncio.run(way.take(Sample(sample), pose, camera, [exposure]))[0]
        return flags_of(way, image, camera, exposure, 1.5)

    whole = M.detector.camera
    good = flags(whole, LISTING_1, "compact")
    assert (good.saturated, good.truncated, good.time) == (0.0, [], 1.5)
    assert good.starved < 0.01
    bright = flags(whole, replace(LISTING_1, exposure_ms=1000.0), "lego")
    assert 0.5 < bright.saturated < 1.0  # all but the sample
    dim = flags(whole, replace(LISTING_1, exposure_ms=weak, xrays_on=False), "lego")
    assert dim.saturated == 0.0
    assert 0.01 < dim.starved < 0.5
    cut = flags(MIDDLE, LISTING_1, "tall")
    assert set(cut.truncated) == {"top", "bottom"}
    aside = flags(MIDDLE, LISTING_1, "wide")
    assert {"left", "right"} <= set(aside.truncated)


@pytest.mark.parametrize("physics", ["ideal", "poly"])
def test_marks_are_what_the_saved_counts_say(tmp_path: Path, physics: str) -> None:
    way = radiography(tmp_path, physics)

    def look(exposure_ms: float, sample: str):
        exposure = replace(LISTING_1, exposure_ms=exposure_ms)
        pose = poses(M, P, MIDDLE, {})
        image = asyncio.run(way.take(Sample(sample), pose, MIDDLE, [exposure]))[0]
        counts = way.counts(image, MIDDLE, exposure, None).astype(np.int64)
        return image, exposure, counts, marks_of(way, image, MIDDLE, exposure)

    image, exposure, counts, marks = look(1000.0, "lego")
    if physics == "ideal":  # without a fixed pattern the counts are the signal itself
        np.testing.assert_array_equal((marks & SATURATED) > 0, counts == way.full_scale)
    else:
        assert np.mean(((marks & SATURATED) > 0) == (counts == way.full_scale)) > 0.97
    assert 0.1 < np.mean(marks & SATURATED) < 1.0
    *_, counts, marks = look(0.5, "lego")
    few = counts - way.offset
    assert ((marks & STARVED) > 0)[few < FEW_COUNTS - 6].all()
    assert not (marks & STARVED)[few > FEW_COUNTS + 6].any()
    assert (marks & STARVED).any()
    # The limits that are told part pixels as the saved counts do, off by what a rounding is.
    for ms, sample in ((1000.0, "lego"), (0.5, "lego"), (100.0, "compact")):
        image, exposure, counts, _ = look(ms, sample)
        flags = flags_of(way, image, MIDDLE, exposure)
        assert flags.good_counts == (way.offset + 10.0, 2**M.detector.bits - 1)
        assert flags.good_lines is not None
        least, most = flags.good_lines
        lines, above = image.shown, counts - way.offset
        assert np.mean((lines < least) == (counts == way.full_scale)) > 0.97
        assert (above[lines < most] >= 10 - 6).all()
        assert (above[lines > most] <= 10 + 6).all()
    image, exposure, _, marks = look(100.0, "tall")
    cut = (marks & CUT_OFF) > 0
    np.testing.assert_array_equal(cut[0], image.shown[0] > 0.05)
    np.testing.assert_array_equal(cut[-1], image.shown[-1] > 0.05)
    assert cut[0].any()
    assert not cut[1:-1, 1:-1].any()
    # Binned: a pixel has the marks of all it covers; 200 rows in sevens leave some over.
    small = marks_of(way, image, MIDDLE, exposure, 7)
    assert small.shape == (marks.shape[0] // 7, marks.shape[1] // 7)
    assert ((small & CUT_OFF) > 0)[-1].any()
    block = marks[14:21, 140:147]
    assert small[2, 20] == np.bitwise_or.reduce(block, axis=None)


def test_a_twin_started_with_poly_physics_scans_with_it(tmp_path: Path) -> None:
    """All the way: the server's own submissions make images by the physics it was started
    with."""

    async def body() -> None:
        twin = TwinServer(
            M,
            P,
            DirectProjector(),
            open_data(tmp_path),
            speed_up="max",
            seed=lambda: 1,
            physics="poly",
        )
        await twin.start(Sample("lego"))
        try:
            job = await twin.submissions.submit(ScanSource(FLY.encode()), "made", None)
            for _ in range(2000):
                if twin.jobs.status(job).state in ("done", "failed", "aborted"):
                    break
                await asyncio.sleep(0.02)
            assert twin.jobs.status(job).state == "done"
        finally:
            await twin.stop()

    asyncio.run(body())
    data = load_dataset(tmp_path / "made")
    assert data.document is not None
    assert data.document.noise.model["physics_poly"] == 1.0
    # the panel's offset and its pattern, which the ideal detector does not have
    dark = data.dark
    assert dark.std() > 3.0


def _document(report: Encoded) -> Any:
    return json.loads(b"".join(report.pieces))


@pytest.mark.parametrize("kV", [0.0, 10.0, 15.0])
def test_a_voltage_without_a_spectrum_is_refused_before_there_is_a_job(
    tmp_path: Path, kV: float
) -> None:
    text = f"tube\tset kV\t{kV}\t\tACK\t\t\r\n{FLY}".encode()

    async def body() -> None:
        twin = TwinServer(
            M, P, DirectProjector(), open_data(tmp_path), speed_up="max", physics="poly"
        )
        report = _document(await twin.submissions.check(ScanSource(text), Codec.JSON))
        (problem,) = [p for p in report["problems"] if p["severity"] == "error"]
        assert problem["line"] == 1
        assert "tube kV" in problem["message"]
        assert "[20, 90]" in problem["message"]
        with pytest.raises(RpcError) as refused:
            await twin.submissions.submit(ScanSource(text), "low", None)
        assert refused.value.code == Code.SCRIPT_INVALID
        assert not twin.jobs.all()
        with pytest.raises(LimitError, match=r"\[20, 90\]"):
            await set_tube(twin, None, TubeSet(kV=max(kV, 1.0)))  # type: ignore[arg-type]
        assert twin.scanner.tube.kV == 90.0
        plain = TwinServer(
            M, P, DirectProjector(), open_data(tmp_path / "ideal"), speed_up="max"
        )
        assert _document(await plain.submissions.check(ScanSource(text), Codec.JSON))[
            "ok"
        ]

    asyncio.run(body())


def test_a_twin_with_another_physics_is_where_the_last_one_was(tmp_path: Path) -> None:
    """Only a voltage that it has no spectrum for starts anew; the E-stop above all stays."""

    async def body() -> None:
        first = TwinServer(M, P, DirectProjector(), open_data(tmp_path), physics="ideal")
        await first.start(Sample("lego"))
        first.scanner.set_tube(kV=10.0, power_W=30.0)
        first.scanner.place({"mag_obj": 432.0}, first.clock.now())
        first.scanner.estop(first.clock.now())
        await first.stop()
        after = TwinServer(M, P, DirectProjector(), open_data(tmp_path), physics="poly")
        assert after.recall() == Sample("lego")
        assert after.scanner.positions(after.clock.now())["mag_obj"] == 432.0
        assert (after.scanner.tube.kV, after.scanner.tube.power_W) == (90.0, 30.0)
        assert after.scanner.safety.state == "estopped"

    asyncio.run(body())


def test_a_machine_that_starts_without_a_spectrum_is_refused() -> None:
    soft = M.model_copy(update={"tube": M.tube.model_copy(update={"kV": 12.0})})
    assert with_spectra(soft, "ideal") is soft
    with pytest.raises(LimitError, match="12 kV"):
        with_spectra(soft, "poly")
    assert with_spectra(M, "mono").tube.min_kV == 20.0
    assert with_spectra(M, "mono").tube.max_kV == M.tube.max_kV


def test_a_scan_whose_images_cannot_be_made_fails_and_the_next_one_runs(
    tmp_path: Path,
) -> None:
    """As when a scan that was begun with another physics is taken up: nothing checked it
    then."""

    async def body() -> None:
        twin = TwinServer(
            M, P, DirectProjector(), open_data(tmp_path), speed_up="max", physics="ideal"
        )
        await twin.start(Sample("lego"))
        low = f"tube\tset kV\t15.0\t\tACK\t\t\r\n{FLY}".encode()
        honest = twin.submissions.radiography
        try:
            twin.submissions.radiography = replace(honest, physics="poly")
            bad = await twin.submissions.submit(ScanSource(low), "bad", None)
            twin.submissions.radiography = honest
            good = await twin.submissions.submit(ScanSource(FLY.encode()), "good", None)
            for _ in range(6000):
                if good.phase == "done":
                    break
                await asyncio.sleep(0.02)
            assert (bad.phase, good.phase) == ("failed", "done")
            error = twin.jobs.status(bad).error
            assert error is not None
            assert "the voltage of a spectrum is 15;" in str(error["message"])
        finally:
            await twin.stop()

    asyncio.run(body())
    assert not load_dataset(tmp_path / "bad").complete


def test_meshes_and_voxels_are_taken_apart_too() -> None:
    view = ConeVec(np.array([[0, -400, 0, 0, 200, 0, 0.9, 0, 0, 0, 0, -0.9]]))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    mesh = mesh_phantom(
        ball.export(file_type="stl"),
        unit="mm",
        material="C8H8@1.05",
        file_type="stl",
        name="ball",
    )
    (one,) = channels(mesh)
    assert one.material.name == "C8H8@1.05"
    assert isinstance(one.body, TriangleMesh)
    assert project_body(one.body, view, (1, 1))[0, 0, 0] == pytest.approx(20.0, rel=0.01)
    voxels = voxel_phantom(
        np.full((20, 20, 20), 0.05, np.float32), (1.0, 1.0, 1.0), name="cube"
    )
    (water,) = channels(voxels)
    assert "water" in water.assumed
    assert isinstance(water.body, Volume)
    path = forward(water.body, view, (1, 1))[0, 0, 0]
    assert path * water.material.mu_per_mm == pytest.approx(1.0, rel=1e-4)
    assert path <= water.thickest_mm
