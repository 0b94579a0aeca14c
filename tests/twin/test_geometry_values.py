"""Geometries made from distances, moved and exchanged, against formulas written out here."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.geometry import ConeVec
from flexdt.twin.geometry.cone_vec import check_cone_vec
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.panel import Border, Panel, PanelModel
from flexdt.twin.geometry.panel_corners import panel_corners
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.rigid import Rigid
from flexdt.twin.geometry.virtual_panel import stretched
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.projection import Grid, Volume, forward, project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

SCAN = {"sod": 600.0, "sdd": 1059.0, "shape": (76, 96), "pixel": 1.496}


def astra_geom_2vec(
    angles: list[float], origin: float, detector: float, pixel: tuple[float, float]
):  # type: ignore[no-untyped-def]
    """ASTRA's documentation, "3D geometries", cone: written out view by view, v upwards
    there."""
    vectors = []
    for a in angles:
        s, c = math.sin(a), math.cos(a)
        vectors.append(
            [s * origin, -c * origin, 0.0, -s * detector, c * detector, 0.0,
             c * pixel[0], s * pixel[0], 0.0, 0.0, 0.0, pixel[1]]
        )  # fmt: skip
    return np.array(vectors)


@given(
    sod=st.floats(10, 900),
    behind=st.floats(0, 900),
    angles=st.lists(st.floats(-720, 720), min_size=1, max_size=5),
    pixel=st.tuples(st.floats(0.01, 2), st.floats(0.01, 2)),
)
def test_a_circle_is_astras_with_v_downwards(
    sod: float, behind: float, angles: list[float], pixel: tuple[float, float]
) -> None:
    circle = ConeVec.circular(sod=sod, sdd=sod + behind, angles=angles, pixel=pixel)
    expected = astra_geom_2vec([math.radians(a) for a in angles], sod, behind, pixel)
    of_astra = {
        "type": "cone", "DetectorRowCount": 5, "DetectorColCount": 7,
        "DetectorSpacingX": pixel[0], "DetectorSpacingY": pixel[1],
        "DistanceOriginSource": sod, "DistanceOriginDetector": behind,
        "ProjectionAngles": np.radians(angles),
    }  # fmt: skip
    read = ConeVec.from_astra(of_astra)
    assert read.shape == (len(angles), 5, 7)
    assert_allclose(
        read.rows, expected, atol=1e-9
    )  # as ASTRA has it: row 0 is the lowest
    expected[:, 9:12] *= -1
    assert_allclose(circle.rows, expected, atol=1e-9)


def test_a_number_of_views_is_a_full_turn() -> None:
    many = ConeVec.circular(angles=8, **SCAN)
    assert many == ConeVec.circular(angles=[0, 45, 90, 135, 180, 225, 270, 315], **SCAN)
    assert many.shape == (8, 76, 96)
    assert (
        ConeVec.circular(angles=1, **SCAN)
        == many[:1]
        == ConeVec.circular(angles=[0.0], **SCAN)
    )
    for none in (0, [], np.zeros((2, 2)), math.nan):
        with pytest.raises(GeometryError, match="allowed: a number of views from 1"):
            ConeVec.circular(angles=none, **SCAN)
    with pytest.raises(GeometryError) as error:
        ConeVec.circular(angles="all" * 500, **SCAN)
    assert (
        len(error.value.data["asked"]) == 100
    )  # an answer is not as long as any question


def pixel_of(  # type: ignore[no-untyped-def]
    point, angle_deg, *, sod, sdd, shape, pixel, offset=(0.0, 0.0), roll=0.0, height=0.0
):
    """Where a point of the object lands, (column, row): plane trigonometry in the world's
    frame.

    The object has turned clockwise by the angle; x is to the right seen from the source, y
    along the beam, z up. The panel's own axes are turned by roll about the beam, right-handed.
    """
    x, y, z = point
    a = -math.radians(angle_deg)  # clockwise from above
    right = x * math.cos(a) - y * math.sin(a)
    along = sod + x * math.sin(a) + y * math.cos(a)
    side, up = right * sdd / along, (z - height) * sdd / along
    side, down = side - offset[0], -up - offset[1]
    # Right-handed about +y: x turns towards -z, which is down.
    r = math.radians(roll)
    columns, rows = (
        side * math.cos(r) + down * math.sin(r),
        down * math.cos(r) - side * math.sin(r),
    )
    return columns / pixel + (shape[1] - 1) / 2, rows / pixel + (shape[0] - 1) / 2


CASES = [
    {},
    {"offset": (11.0, -7.0)},
    {"height": 4.0},
    {"roll": 9.0},
    {"offset": (-6.0, 5.0), "height": -3.0, "roll": -20.0},
]


@pytest.mark.parametrize("case", CASES)
def test_beads_off_centre_land_where_trigonometry_says(case: dict[str, object]) -> None:
    """Chiral: three beads at different heights, sides and depths; every sign shows."""
    beads = [(9.0, 4.0, 6.0), (-5.0, 11.0, -3.0), (2.0, -8.0, -7.0)]
    angles = [0.0, 25.0, 130.0, 290.0]
    roll = case.get("roll", 0.0)
    rest = {k: v for k, v in case.items() if k != "roll"}
    scan = ConeVec.circular(angles=angles, tilts=(roll, 0, 0), **SCAN, **rest)  # type: ignore[arg-type]
    expected = np.array([[pixel_of(b, a, **SCAN, **case) for b in beads] for a in angles])
    assert_allclose(scan.project_points(beads), expected, atol=1e-9)
    # And in images: the brightest pixel of a bead by itself is the nearest one.
    for k, bead in enumerate(beads):
        scene = Scene((Solid(Sphere(bead, 1.5), "lead", 1.0),))
        for image, (column, row) in zip(
            project_scene(scene, scan), expected[:, k], strict=True
        ):
            found_row, found_column = np.unravel_index(np.argmax(image), image.shape)
            assert_allclose((found_column, found_row), (column, row), atol=0.6)


def test_yaw_and_pitch_of_the_detector_are_right_handed_about_v_and_u() -> None:
    """v points down: growing yaw takes the right-hand columns towards the source... in the
    world at angle 0, rotating +x right-handed about -z gives -y times sine, so nearer to the
    source."""
    small = math.radians(3.0)
    yawed = ConeVec.circular(angles=[0], tilts=(0, 0, 3.0), **SCAN)
    assert_allclose(
        yawed.u[0] / 1.496, [math.cos(small), -math.sin(small), 0], atol=1e-12
    )
    pitched = ConeVec.circular(angles=[0], tilts=(0, 3.0, 0), **SCAN)
    # About u = +x, right-handed: -z goes to +y.
    assert_allclose(
        pitched.v[0] / 1.496, [0, math.sin(small), -math.cos(small)], atol=1e-12
    )


def test_a_helix_rises_with_the_angle() -> None:
    helix = ConeVec.helical(angles=[0, 90, 360, 720], rise=8.0, height=1.0, **SCAN)
    assert_allclose(helix.source[:, 2], [-7.0, -5.0, 1.0, 9.0])
    assert_allclose(helix.detector[:, 2], helix.source[:, 2])
    flat = ConeVec.helical(angles=12, turns=3, rise=0.0, **SCAN)
    assert_allclose(flat.rows, ConeVec.circular(angles=np.arange(12) * 90.0, **SCAN).rows)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"sod": 0.0}, "sod"),
        ({"sdd": 500.0}, "0 < sod <= sdd"),
        ({"sod": math.nan}, "sod is nan.*one finite number"),
        ({"sod": [1.0, 2.0]}, r"sod is \[1.0, 2.0\]; allowed: a number"),
        ({"offset": (1.0, math.nan)}, "2 finite numbers"),
        ({"tilts": (math.inf, 1.0, 2.0)}, "3 finite numbers"),
        ({"angles": 0}, "number of views"),
        ({"angles": 30.0}, "number of views"),
        ({"angles": np.zeros((2, 2))}, r"array of shape 2 x 2"),
        ({"angles": True}, "number of views"),
        ({"angles": [0.0, math.inf]}, "finite"),
        ({"pixel": -1.0}, "pixel"),
        ({"pixel": 0.0}, "pixel"),
        ({"pixel": (0.1, 0.0)}, "pixel"),
        ({"pixel": "wide"}, "pixel is 'wide'"),
        ({"offset": 3.0}, "offset"),
        ({"tilts": (1, 2)}, "tilts"),
        ({"shape": (0, 3)}, "a detector of"),
        (
            {"shape": (1.5, 3)},
            r"shape is \(1.5, 3\); allowed: two values, each a whole number",
        ),
        ({"shape": 7}, r"shape is 7; allowed: two values, each a whole number"),
    ],
)
def test_numbers_that_no_scanner_has_are_named(
    wrong: dict[str, object], said: str
) -> None:
    with pytest.raises(GeometryError, match=said):
        ConeVec.circular(**{"angles": 4, **SCAN, **wrong})  # type: ignore[arg-type]


def test_of_a_long_list_of_numbers_a_hundred_characters_are_given_back() -> None:
    with pytest.raises(GeometryError) as caught:
        ConeVec.circular(**{"angles": 4, **SCAN, "pixel": [0.123] * 60})  # type: ignore[arg-type]
    assert caught.value.data["asked"] == repr([0.123] * 60)[:100]


def test_a_shape_that_contradicts_the_geometrys_own_is_an_error() -> None:
    scan = ConeVec.circular(angles=3, **SCAN)
    volume = Volume(np.ones((4, 4, 4)), 2.0)
    assert (
        forward(volume, scan).shape == forward(volume, scan, (76, 96)).shape == scan.shape
    )
    for use in (
        lambda: forward(volume, scan, (76, 97)),
        lambda: scan.project_points([[0, 0, 0]], (1, 1)),
        lambda: scan.rays((96, 76)),
    ):
        with pytest.raises(GeometryError, match=r"\(76, 96\)"):
            use()
    bare = scan.with_shape(None)
    with pytest.raises(GeometryError, match="shape is not known"):
        forward(volume, bare)
    with pytest.raises(GeometryError, match="shape is not known"):
        bare.shape  # noqa: B018
    assert bare != scan
    assert bare.with_shape((76, 96)) == scan


def test_arrays_of_geometries_and_volumes_are_their_numbers() -> None:
    scan = ConeVec.circular(angles=3, **SCAN)
    assert np.asarray(scan).shape == (3, 12)
    assert np.asarray(scan, dtype=np.float32).dtype == np.float32
    copied = np.array(scan)
    copied[:] = 0.0
    assert scan.rows.any()
    volume = Volume(np.arange(8, dtype=np.float32).reshape(2, 2, 2), np.float32(0.5))
    assert volume.voxel_xyz == (0.5, 0.5, 0.5)
    assert np.asarray(volume).tolist() == volume.data.tolist()
    assert np.asarray(volume).shape == (2, 2, 2)


def test_an_array_for_a_volume_is_an_error_that_says_what_lacks() -> None:
    with pytest.raises(
        GeometryError,
        match=r"array of shape .*; allowed: a Volume.*Volume\(data, voxel_mm\)",
    ):
        forward(np.ones((4, 4, 4)), ConeVec.circular(angles=3, **SCAN))  # type: ignore[arg-type]


def rotations() -> st.SearchStrategy[Rigid]:
    number = st.floats(-50, 50)
    direction = st.tuples(number, number, number).filter(
        lambda d: np.linalg.norm(d) > 1.0
    )
    return st.builds(
        lambda axis, turn, about, shift: Rigid.translate(*shift) @ Rigid.rotate(axis, turn, about),
        direction, st.floats(-360, 360), st.tuples(number, number, number),
        st.tuples(number, number, number),
    )  # fmt: skip


@given(rotations(), rotations(), st.integers(0, 2**32 - 1))
def test_rigid_motions_are_a_group_that_acts_on_geometries(
    a: Rigid, b: Rigid, seed: int
) -> None:
    scan = ConeVec(np.random.default_rng(seed).normal(size=(3, 12)) * 100, (5, 7))
    points = np.random.default_rng(seed + 1).normal(size=(4, 3)) * 10
    near = {"atol": 1e-8}
    assert_allclose((a @ (b @ scan)).rows, ((a @ b) @ scan).rows, **near)
    assert_allclose((a.inverse @ (a @ scan)).rows, scan.rows, **near)
    assert (a @ scan).shape == scan.shape
    # A scene that moves along with the scanner looks as before.
    before, after = scan.project_points(points), (a @ scan).project_points(a @ points)
    sane = np.abs(before) < 1e4
    assert_allclose(after[sane], before[sane], rtol=1e-5, atol=1e-4)
    for value in (a, b, a @ b):
        assert (
            eval(repr(value))
            == value
            == Rigid.from_dict(json.loads(json.dumps(value.to_dict())))
        )


def test_what_is_no_rigid_motion_is_an_error() -> None:
    for turn in (np.diag([1.0, 1.0, -1.0]), np.eye(3) * 1.1, np.zeros((3, 3))):
        with pytest.raises(GeometryError, match="rotation"):
            Rigid(turn, np.zeros(3))
    with pytest.raises(GeometryError, match="turn of shape 2 x 2; allowed: 3 x 3"):
        Rigid(np.eye(2), np.zeros(3))
    with pytest.raises(GeometryError, match="shift is nan, 0, 0; allowed: finite"):
        Rigid.translate(np.nan)
    with pytest.raises(GeometryError, match="axis of shape 2; allowed: 3, or x"):
        Rigid.rotate([1.0, 2.0], 1.0)
    with pytest.raises(GeometryError, match="axis 'w'"):
        Rigid.rotate("w", 1.0)
    with pytest.raises(GeometryError, match="points of shape"):
        Rigid.translate(1.0) @ [1.0, 2.0]


@given(st.integers(1, 4), st.sampled_from([None, (5, 7)]), st.integers(0, 2**32 - 1))
def test_geometries_go_through_json_repr_and_slices(
    n: int, shape: tuple[int, int] | None, seed: int
) -> None:
    scan = ConeVec(np.random.default_rng(seed).normal(size=(n, 12)), shape)
    assert ConeVec.from_dict(json.loads(json.dumps(scan.to_dict()))) == scan
    assert "\n" not in repr(scan)
    if n <= 2:
        assert eval(repr(scan)) == scan
    assert (
        ConeVec.concatenate([scan[:1], scan[1:]])
        == scan
        == ConeVec.concatenate(list(scan))
    )
    assert hash(scan) == hash(scan[:])
    assert "<table>" in scan._repr_html_()


@pytest.mark.parametrize("name", ["g.json", "g.npy", "g.txt", "g.npz", "g.csv", "g.xml"])
def test_files_give_the_geometry_back(name: str, tmp_path: Path) -> None:
    scan = ConeVec.circular(angles=5, tilts=(3, 2, -4), offset=(2, 1), height=3, **SCAN)
    file = tmp_path / name
    scan.save(str(file))
    back = ConeVec.load(str(file), shape=(76, 96), pixel=1.496)
    assert_allclose(back.rows, scan.rows, atol=1e-9)
    assert back.shape == scan.shape
    if name == "g.xml":
        assert ConeVec.from_rtk(file, pixel=1.496, shape=(76, 96)) == back
    if name in ("g.json", "g.npz", "g.csv"):
        with pytest.raises(TwinError, match="76"):
            ConeVec.load(file, shape=(1, 1))
        with pytest.raises(TwinError, match=r"1\.496 mm, not 9 x 9"):
            ConeVec.load(file, pixel=9.0)


def test_files_that_do_not_hold_are_typed_errors(tmp_path: Path) -> None:
    scan = ConeVec.circular(angles=5, **SCAN)
    for name in ("g.png", "g.nxs", "g.nx", "g.h5", "g.hdf5"):
        (tmp_path / name).write_bytes(b"what was there")
        with pytest.raises(TwinError, match=r"\.json, \.xml"):
            scan.save(tmp_path / name)
        with pytest.raises(TwinError, match="nxtomo"):
            scan.save(tmp_path / name, format="nxtomo")
        assert (tmp_path / name).read_bytes() == b"what was there"
    (tmp_path / "g.xml").write_text("{}")
    with pytest.raises(TwinError, match="not valid XML"):
        ConeVec.from_rtk(tmp_path / "g.xml", pixel=1.0)
    with pytest.raises(TwinError, match="pixel"):
        ConeVec.from_rtk(tmp_path / "g.xml", pixel=-1.0)
    with pytest.raises(GeometryError, match="parallel3d"):
        ConeVec.from_astra(
            {"type": "parallel3d", "DetectorRowCount": 1, "DetectorColCount": 1}
        )
    with pytest.raises(GeometryError, match="lacks 'Vectors'"):
        ConeVec.from_astra(
            {"type": "cone_vec", "DetectorRowCount": 1, "DetectorColCount": 1}
        )
    numbers = dict.fromkeys(("DistanceOriginSource", "DistanceOriginDetector"), 5.0)
    with pytest.raises(GeometryError, match="'x'"):
        ConeVec.from_astra({"type": "cone", "DetectorRowCount": 1, "DetectorColCount": 1,
                            "ProjectionAngles": [0.0], "DetectorSpacingX": "x",
                            "DetectorSpacingY": 1.0, **numbers})  # fmt: skip


@pytest.mark.parametrize("document", [{}, {"rows": "x"}, {"rows": [1, 2]}, [], None])
def test_documents_that_hold_no_geometry(document: Any) -> None:
    with pytest.raises(GeometryError):
        ConeVec.from_dict(document)


@pytest.mark.parametrize("factor", [0, -1, 1.5, 77, "x"])
def test_binning_leaves_pixels(factor: Any) -> None:
    with pytest.raises(
        GeometryError, match=r"1 to 76|factor is (1\.5|'x'); allowed: a whole"
    ):
        ConeVec.circular(angles=5, **SCAN).binned(factor)


def test_nothing_cannot_be_stacked() -> None:
    with pytest.raises(GeometryError, match="at least one"):
        ConeVec.concatenate([])


@pytest.mark.parametrize(
    ("shape", "edge"),
    [
        ((1.5, 1, 1), 1.0),
        ((1, 1), 1.0),
        ((2, 2, 2), (1, 1, 2.0)),
        ((2, 2, 2), np.nan),
        (3, 1.0),
    ],
)
def test_grids_have_three_whole_numbers_and_one_edge(shape: Any, edge: Any) -> None:
    with pytest.raises(
        GeometryError, match=r"allowed: .*whole number|voxel_mm is .*: a number"
    ):
        Grid(shape, edge)


class TomosipoCone:
    """The attributes of tomosipo's ConeVectorGeometry; there is no wheel to test with."""

    def __init__(self, shape, src_pos, det_pos, det_v, det_u) -> None:  # type: ignore[no-untyped-def]
        self.det_shape = shape
        self.src_pos, self.det_pos, self.det_v, self.det_u = (
            src_pos,
            det_pos,
            det_v,
            det_u,
        )

    def to_vec(self) -> TomosipoCone:
        return self


def test_tomosipos_vectors_are_z_y_x() -> None:
    x, z = (
        np.array([[0.0, 0.0, 1.496]]),
        np.array([[-1.496, 0.0, 0.0]]),
    )  # written (z, y, x)
    found = ConeVec.from_tomosipo(
        TomosipoCone(
            (76, 96), np.array([[0.0, -600, 0]]), np.array([[0.0, 459, 0]]), z, x
        )
    )
    assert found == ConeVec.circular(angles=[0], **SCAN)


def test_astras_dictionary_goes_both_ways() -> None:
    scan = ConeVec.circular(angles=4, **SCAN)
    assert scan.to_astra()["DetectorRowCount"] == 76
    assert ConeVec.from_astra(scan.to_astra()) == scan
    assert ConeVec.from_astra(scan.rows, (76, 96)) == scan
    with pytest.raises(GeometryError, match="shape is not known"):
        scan.with_shape(None).to_astra()


@pytest.mark.slow
def test_a_plot_shows_sources_and_panels() -> None:
    matplotlib = pytest.importorskip("matplotlib", reason="the extra `plots`")
    matplotlib.use("Agg")
    axes = ConeVec.circular(angles=4, **SCAN).plot()
    assert axes.name == "3d"
    assert len(axes.lines) == 1 + 2 * 4 + 2


def test_binning_by_one_is_no_binning_and_by_all_rows_leaves_one() -> None:
    scan = ConeVec.circular(angles=3, **{**SCAN, "shape": (7, 9)})  # type: ignore[arg-type]
    assert_allclose(scan.binned(1).rows, scan.rows, rtol=1e-15)
    assert scan.binned(1).shape == scan.shape
    coarse = scan.binned(7)  # nine columns: two on the right are cut off
    assert coarse.shape == (3, 1, 1)
    assert_allclose(coarse.u, 7 * scan.u)
    assert_allclose(coarse.detector, scan.detector - scan.u)
    with pytest.raises(GeometryError, match="1 to 7") as caught:
        scan.binned(8)
    assert caught.value.data == {"asked": "8", "allowed": [1, 7]}


def test_a_stage_on_the_turntable_moves_a_point_by_hand() -> None:
    """Raised 2 mm and shifted (3, -4) on a table turned by 90 degrees, with the wobble tau."""
    machine = builtin_machine("micro_ct")
    profile = profile_of(machine)
    camera = machine.detector.camera
    names = {q: next(iter(machine.geometry[q])) for q in ("mount_x", "mount_y", "angle")}
    away = {names["mount_x"]: 3.0, names["mount_y"]: -4.0}
    for angle in (0.0, 90.0, -35.0):
        at = {a: np.array([axis.home]) for a, axis in machine.axes.items()}
        at[names["angle"]] = np.array([angle])
        here = poses(machine, profile, camera, at).cone_vec()
        moved = {a: at[a] + away.get(a, 0.0) for a in at}
        there = poses(machine, profile, camera, moved).cone_vec()
        gone = [sum(machine.geometry[q].values()) * v for q, v in
                (("mount_x", 3.0), ("mount_y", -4.0))]  # fmt: skip
        # The sample's frame goes along: source and panel are seen the other way in it.
        assert_allclose(
            there.source - here.source, [[-gone[0], -gone[1], 0.0]], atol=1e-9
        )
        assert_allclose(
            there.detector - here.detector, [[-gone[0], -gone[1], 0.0]], atol=1e-9
        )
        assert_allclose(there.u, here.u)


def test_motion_of_a_scan_goes_to_its_document_and_back() -> None:
    """In degrees and mm, by hand; nan says that a parameter was found not to move."""
    angles = np.radians([0.0, 0.5, -0.25])
    values = np.stack([[1.0, -2.0, 0.5], angles], axis=1)
    sigma = np.stack([[0.1, 0.2, 0.3], np.full(3, np.nan)], axis=1)
    motion = Motion(("dO_x", "alpha"), values, sigma, (9.0, -1.5))
    document = motion.to_dict()
    assert document["dO_x"] == {"unit": "mm", "values": [1.0, -2.0, 0.5], "sigmas": [0.1, 0.2, 0.3],
                                "evidence": 9.0, "moves": True}  # fmt: skip
    assert document["alpha"]["values"] == pytest.approx([0.0, 0.5, -0.25])
    assert document["alpha"]["sigmas"] == [None, None, None]
    back = Motion.from_dict(json.loads(json.dumps(document)))
    assert (back.names, back.evidence) == (motion.names, motion.evidence)
    assert_allclose(back.values, values, rtol=1e-14)
    assert_allclose(back.sigma, sigma, rtol=1e-14)
    assert repr(motion) == "<Motion: 3 frames, dO_x 3 mm, alpha 0.75 deg>"
    still = Motion(("dO_x",), np.zeros((2, 1)), np.zeros((2, 1)), (0.0,))
    assert still.to_dict()["dO_x"]["moves"] is False


def test_estimates_of_a_motion_are_near_within_a_hundredth_of_a_sigma() -> None:
    values, sigma = (
        np.array([[1.0, 5.0], [-1.0, 5.0]]),
        np.array([[0.1, np.nan], [0.2, np.nan]]),
    )
    motion = Motion(("dO_x", "dO_y"), values, sigma, (1.0, 1.0))
    for i, step, near in ((0, 0.0009, True), (0, 0.0011, False), (1, -0.0019, True),
                          (1, -0.0021, False)):  # fmt: skip
        other = values.copy()
        other[i, 0] += step
        assert motion.near(Motion(motion.names, other, sigma, (1.0, 1.0))) is near
    other = values + (0.0, 1e-9)  # what does not move has no sigma
    assert not motion.near(Motion(motion.names, other, sigma, (1.0, 1.0)))


GOOD = {"values": [1.0, 2.0], "sigmas": [0.1, 0.1], "evidence": 1.0}


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ({"src_ort": GOOD}, "'src_ort' cannot differ from frame to frame; allowed: dO_x"),
        (
            {"dO_x": {**GOOD, "values": [[1.0], [2.0]], "sigmas": [[1.0], [2.0]]}},
            "number a frame",
        ),
        ({"dO_x": {**GOOD, "values": [1.0]}}, "motion of dO_x: values and sigmas"),
        (
            {"dO_x": {**GOOD, "values": [1.0, math.nan]}},
            "motion of dO_x: values and sigmas",
        ),
        ({"dO_x": {**GOOD, "evidence": "much"}}, "motion of dO_x: could not convert"),
        ({"dO_x": {"values": [1.0]}}, "motion of dO_x: 'sigmas'"),
        (
            {"dO_x": GOOD, "dO_y": {**GOOD, "values": [1.0], "sigmas": [1.0]}},
            "different numbers",
        ),
        ({}, "different numbers of frames, or there is none"),
    ],
)
def test_documents_that_hold_no_motion(document: Any, said: str) -> None:
    with pytest.raises(TwinError, match=said):
        Motion.from_dict(document)


@pytest.mark.parametrize("views", [1, 2, 3])
def test_up_to_two_poses_print_as_python_and_more_in_a_line(views: int) -> None:
    machine = builtin_machine()
    at = {a: np.full(views, axis.home) for a, axis in machine.axes.items()}
    at["rot_obj"] = np.arange(views) * 30.0
    found = poses(machine, profile_of(machine), machine.detector.camera, at)
    if views > 2:
        assert repr(found) == "<Poses: 3 views, 0 to 60 deg>"
    else:
        names = {"Poses": Poses, "array": np.array}
        assert eval(repr(found), names) == found


@pytest.mark.parametrize("pixel", [0.03, 4.0])
def test_pixels_are_checked_to_a_millionth_and_axes_to_their_right_angle(
    pixel: float,
) -> None:
    scan = ConeVec.circular(sod=300.0, sdd=900.0, angles=3, pixel=pixel)
    check_cone_vec(scan, pixel)
    check_cone_vec(scan, (pixel * (1 + 0.9e-6), pixel * (1 - 0.9e-6)))
    for pitches, name in (
        ((pixel * (1 + 1.1e-6), pixel), "u"),
        ((pixel, pixel * 1.1), "v"),
    ):
        with pytest.raises(GeometryError, match=rf"row 0: \|{name}\| is {pixel:g}"):
            check_cone_vec(scan, pitches)
    for skew, sound in ((0.9e-6, True), (1.1e-6, False)):
        rows = scan.rows.copy()
        rows[1, 9:] += skew * rows[1, 6:9]
        if sound:
            check_cone_vec(ConeVec(rows), pixel)
        else:
            with pytest.raises(GeometryError, match="row 1: u and v are not orthogonal"):
                check_cone_vec(ConeVec(rows), pixel)


def test_gaps_and_bends_of_a_panel_have_priors_of_their_own() -> None:
    """Two stretches and two of each of seven powers, then two for each border."""
    panel = PanelModel(0.5, (60, 80), (Border(0, 40.0), Border(1, 30.0)))
    assert panel.sigmas.tolist() == [0.5] * 16 + [5.0] * 4


@given(
    st.floats(0.0, 0.05),
    st.lists(st.floats(0.2, 1.0), min_size=2, max_size=6),
)
def test_the_light_of_the_frame_before_is_taken_off(
    lag: float, light: list[float]
) -> None:
    """Frames of a panel that keeps a part of each, which is made here; what remains is of
    second order in the lag."""
    panel = replace(Panel.flat((1, 1)), lag=lag)
    measured = [light[0]]
    for before, now in itertools.pairwise(light):
        measured.append((1.0 - lag) * now + lag * before)
    for i in range(1, len(light)):
        image, before = (
            -np.log([[x]]).astype(np.float32) for x in (measured[i], measured[i - 1])
        )
        found = math.exp(-panel.without_lag(image, before).item())
        assert found == pytest.approx(light[i], abs=2.0 * lag**2 + 1e-6)


def test_only_panels_that_move_are_stretched_and_their_images_stay() -> None:
    scan = ConeVec.circular(angles=4, **SCAN)
    points = np.array([[3.0, -5.0, 7.0], [-20.0, 1.0, 2.0]])
    assert stretched(scan, np.ones(4)) is scan
    times = np.array([1.0, 2.0, 1.0, 1.25])
    longer = stretched(scan, times)
    assert_allclose(longer.source_detector_distance, 1059.0 * times)
    assert_allclose(longer.project_points(points), scan.project_points(points))
    assert_allclose(longer.rows[[0, 2]], scan.rows[[0, 2]], rtol=0.0)


def test_corners_of_a_panel_are_seen_at_the_corners_of_its_image() -> None:
    scan = ConeVec.circular(
        angles=3, **{**SCAN, "pixel": (1.2, 1.6)}, tilts=(2.0, 3.0, 1.0)
    )
    seen = scan.project_points(panel_corners(scan).reshape(-1, 3)).reshape(3, 3, 4, 2)
    expected = [[-0.5, -0.5], [95.5, -0.5], [95.5, 75.5], [-0.5, 75.5]]
    assert_allclose(
        [seen[i, i] for i in range(3)], np.tile(expected, (3, 1, 1)), atol=1e-6
    )


@pytest.mark.parametrize("column", range(12))
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_one_number_of_a_row_that_is_not_finite_is_an_error(
    column: int, wrong: float
) -> None:
    rows = ConeVec.circular(angles=4, **SCAN).rows.copy()
    rows[2, column] = wrong
    with pytest.raises(GeometryError, match="row 2 is not finite"):
        ConeVec(rows)


def test_shifts_begin_at_nothing_and_turns_at_the_origin() -> None:
    assert_allclose(Rigid.translate() @ [0.0, 0.0, 0.0], 0.0)
    for axis in "xyz":
        assert_allclose(Rigid.rotate(axis, 90.0) @ [0.0, 0.0, 0.0], 0.0)
        assert_allclose(Rigid.translate(**{axis: 2.0}) @ np.zeros(3),
                        2.0 * np.eye(3)["xyz".index(axis)])  # fmt: skip
