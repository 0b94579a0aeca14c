"""CIL, TIGRE and LEAP: where their own definitions put each pixel, written down once more here.

`tests/studies/exchange_peers.py` runs the three programs' own code on drawn geometries; they
are not on the package index.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import SHAPE, some_parameters, some_poses, worst
from scipy.spatial.transform import Rotation

import flexdt as fx
from flexdt.twin.errors import GeometryError
from flexdt.twin.exchange.cil_arrays import cil_arrays, read_cil
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.leap_arrays import leap_arrays, read_leap
from flexdt.twin.exchange.tigre_arrays import read_tigre, tigre_arrays
from flexdt.twin.geometry.conventions import FloatArray

SEEDS = st.integers(0, 2**32 - 1)
SAME = 1e-9
"""mm, and px: pixels of the drawn scans are of 0.1 mm and more."""
CORNERS = np.array([[0, 0], [0, SHAPE[1] - 1], [SHAPE[0] - 1, 0], [5, 7]])
"""Pixels (row, column) that are compared."""
Arrays = Mapping[str, Any]
Seen = tuple[FloatArray, FloatArray]
"""Sources (n, 3) and pixels' centres (n, 4, 3) [mm]."""


def scan(seed: int) -> ScanGeometry:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, int(rng.integers(1, 9)), even=False, still=bool(seed % 2))
    one = ScanGeometry(poses.cone_vec(some_parameters(rng)), SHAPE)
    return one.rows_up() if seed % 3 == 0 else one


def from_middle() -> FloatArray:
    return CORNERS - (np.array(SHAPE) - 1) / 2


def own(geometry: ScanGeometry) -> Seen:
    c, at = geometry.cone_vec, from_middle()
    steps = at[:, 1, None] * c.u[:, None] + at[:, 0, None] * c.v[:, None]
    return c.source, c.detector[:, None] + steps


def by_cil(a: Arrays) -> Seen:
    """Data begin at `origin`; direction_x points right and direction_y up."""
    columns, rows = a["num_pixels"]
    assert str(a["origin"]) == "top-left"
    right = (CORNERS[:, 1] - (columns - 1) / 2) * a["pixel_size"][0]
    up = ((rows - 1) / 2 - CORNERS[:, 0]) * a["pixel_size"][1]
    across = right[:, None] * a["detector_direction_x_set"][:, None]
    along = up[:, None] * a["detector_direction_y_set"][:, None]
    return a["source_position_set"], a["detector_position_set"][:, None] + across + along


def by_leap(a: Arrays) -> Seen:
    """s = width (column - centre) along colVectors, t likewise along rowVectors."""
    s = (CORNERS[:, 1] - (a["numCols"] - 1) / 2) * a["pixelWidth"]
    t = (CORNERS[:, 0] - (a["numRows"] - 1) / 2) * a["pixelHeight"]
    assert len(a["sourcePositions"]) == a["numAngles"]
    across, along = (
        s[:, None] * a["colVectors"][:, None],
        t[:, None] * a["rowVectors"][:, None],
    )
    return a["sourcePositions"], a["moduleCenters"][:, None] + across + along


def by_tigre(a: Arrays) -> Seen:
    """A panel about x = 0 turns about x, y and z, goes to DSO - DSD, is offset, and turns with
    the source about z; the volume is where the frame is, moved by offOrigin."""
    n = len(a["angles"])
    each = {name: np.broadcast_to(a[name], (n, a[name].shape[-1]) if a[name].ndim == 2
                                  or (name[:3] != "DSO" and name != "DSD") else (n,))
            for name in ("DSO", "DSD", "offOrigin", "offDetector", "rotDetector")}  # fmt: skip
    counts, pitch = a["nDetector"], a["dDetector"]
    sources, pixels = [], []
    for view in range(n):
        down = (CORNERS[:, 0] - (counts[0] - 1) / 2) * pitch[0]
        right = (CORNERS[:, 1] - (counts[1] - 1) / 2) * pitch[1]
        flat = np.column_stack([np.zeros(len(CORNERS)), right, down])
        turned = Rotation.from_euler("xyz", each["rotDetector"][view]).apply(flat)
        far = each["DSD"][view] - each["DSO"][view]
        placed = turned + [
            -far,
            each["offDetector"][view][1],
            each["offDetector"][view][0],
        ]
        about = Rotation.from_euler("z", a["angles"][view])
        moved = each["offOrigin"][view][::-1]
        sources.append(about.apply([each["DSO"][view], 0, 0]) - moved)
        pixels.append(about.apply(placed) - moved)
    return np.array(sources), np.array(pixels)


PEERS: dict[
    str, tuple[Callable[..., Any], Callable[..., ScanGeometry], Callable[..., Seen]]
] = {
    "cil": (cil_arrays, read_cil, by_cil),
    "tigre": (tigre_arrays, read_tigre, by_tigre),
    "leap": (leap_arrays, read_leap, by_leap),
}


@pytest.mark.parametrize("peer", PEERS)
@settings(max_examples=50, deadline=None)
@given(seed=SEEDS)
def test_pixels_are_where_the_peer_says_and_come_back(peer: str, seed: int) -> None:
    write, read, places = PEERS[peer]
    geometry = scan(seed)
    arrays = write(geometry)
    for ours, theirs in zip(own(geometry), places(arrays), strict=True):
        assert worst(ours, theirs) < SAME
    back = read(arrays)
    assert back.shape == SHAPE
    assert worst(back.cone_vec.rows, geometry.cone_vec.rows) < SAME


def test_a_circle_is_written_once() -> None:
    """TIGRE's weights of FDK read offsets that hold for all views; the circle's has no turn
    left but the rows' sense."""
    turn = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=7, shape=SHAPE, pixel=0.15, offset=(3, 1), height=2
    )
    arrays = tigre_arrays(ScanGeometry(turn, SHAPE))
    found = {name: np.round(value, 9).tolist() for name, value in arrays.items()}
    assert found["DSO"] == [600]
    assert found["DSD"] == [1059]
    assert found["offOrigin"] == [-2, 0, 0]
    assert found["offDetector"] == [-1, 3]
    assert found["rotDetector"] == [0, round(np.pi, 9), 0]
    assert np.allclose(np.degrees(arrays["angles"]), np.arange(7) * 360 / 7 - 90)


STILL = ScanGeometry(some_poses(np.random.default_rng(1)).cone_vec(), SHAPE)


def changed(values: Mapping[tuple[int, int], float]) -> ScanGeometry:
    rows = STILL.cone_vec.rows.copy()
    for place, value in values.items():
        rows[place] += value
    return ScanGeometry(fx.ConeVec(rows), SHAPE)


@pytest.mark.parametrize("peer", PEERS)
def test_what_cannot_be_held_is_refused_with_the_figure(peer: str) -> None:
    write = PEERS[peer][0]
    with pytest.raises(ExchangeError, match=r"cosine in view 2 is 0\.\d+"):
        write(changed({(2, 9): 0.1}))
    rows = STILL.cone_vec.rows.copy()
    rows[3, 6:12] *= 1.01
    with pytest.raises(
        ExchangeError, match=r"one pixel size; its change in view 3 is 0\.01"
    ):
        write(ScanGeometry(fx.ConeVec(rows), SHAPE))
    with pytest.raises(ExchangeError, match="shape, which is unknown"):
        write(ScanGeometry(STILL.cone_vec))


def test_tigre_refuses_what_its_angles_cannot_hold() -> None:
    flat = fx.ConeVec.from_vectors(
        [0, 0, 500.0], [2.0, -4, -300], [0.6, 0.8, 0], [0.8, -0.6, 0]
    )
    with pytest.raises(ExchangeError, match=r"lie flat; .* in view 0 is 1; "):
        tigre_arrays(ScanGeometry(flat, SHAPE))
    behind = fx.ConeVec.circular(sod=600, sdd=1059, angles=3, shape=SHAPE, pixel=0.15)
    moved = fx.ConeVec(behind.rows + np.array([0, 700.0, 0] * 2 + [0.0] * 6)[None])
    with pytest.raises(ExchangeError, match=r"that it is behind in view 0 is 100"):
        tigre_arrays(ScanGeometry(moved[:1], SHAPE))


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("COR", np.array([0.2]), "COR is 0.2"),
        ("DSD", np.array([1.0, 2.0]), "DSD of shape 2;"),
        ("offOrigin", np.full(3, np.nan), "not finite"),
        ("nDetector", np.array([0, 9]), "whole numbers"),
        ("dDetector", np.array([0.0, 9]), "above 0"),
        ("angles", np.array("x"), "angles"),
    ],
)
def test_bad_tigre(name: str, value: Any, says: str) -> None:
    arrays = {**tigre_arrays(STILL), name: value}
    with pytest.raises(ExchangeError, match=says):
        read_tigre(arrays)


# Objects of the peers, by modules that stand for them.


class Standing:
    """Records what is called with what."""

    def __init__(self) -> None:
        self.calls: dict[str, tuple[Any, ...]] = {}
        self.right = True

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **more: Any) -> bool:
            self.calls[name] = (*arguments, *more.values())
            return self.right

        return call


def stand(monkeypatch: pytest.MonkeyPatch, name: str, **members: Any) -> None:
    for part in (name.split(".", maxsplit=1)[0], name):
        monkeypatch.setitem(sys.modules, part, ModuleType(part))
    for member, value in members.items():
        setattr(sys.modules[name], member, value)


TURN = fx.ConeVec.circular(
    sod=600, sdd=1059, angles=5, shape=SHAPE, pixel=0.15, tilts=(1, 2, 3)
)
GRID = fx.Grid((4, 5, 6), 0.5, (1.0, 2.0, 3.0))


def test_objects_of_cil(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Standing()
    factory = SimpleNamespace(
        create_Cone3D_Flex=lambda *a: made.calls.update(poses=a) or made
    )
    stand(monkeypatch, "cil.framework", AcquisitionGeometry=factory)
    assert TURN.to_cil() is made
    assert worst(made.calls["poses"][0], TURN.source) == 0.0
    assert worst(made.calls["poses"][3], -TURN.v / 0.15) < 1e-12
    counts, sizes, origin = made.calls["set_panel"]
    assert (counts, origin) == ([SHAPE[1], SHAPE[0]], "top-left")
    assert np.allclose(sizes, 0.15)


def test_objects_of_tigre(monkeypatch: pytest.MonkeyPatch) -> None:
    stand(monkeypatch, "tigre", geometry=lambda mode: SimpleNamespace(mode=mode))
    geometry, angles = TURN.to_tigre(GRID)
    assert (geometry.mode, len(angles)) == ("cone", 5)
    assert geometry.nVoxel.tolist() == [4, 5, 6]
    assert geometry.sVoxel.tolist() == [2.0, 2.5, 3.0]
    bare, _ = TURN.to_tigre()
    assert not hasattr(bare, "nVoxel")
    # The volume's centre is at (1, 2, 3) of the object's frame, written z, y, x.
    assert np.allclose(geometry.offOrigin - bare.offOrigin, [3, 2, 1])
    with pytest.raises(GeometryError, match="like: a str; allowed: a Grid or a Volume"):
        TURN.to_tigre("512")


def test_objects_of_leap(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Standing()
    stand(monkeypatch, "leapctype", tomographicModels=lambda: made)
    assert TURN.to_leap() is made
    assert "set_default_volume" in made.calls
    *counts, source, _, rows, columns = made.calls["set_modularbeam"]
    assert counts[:3] == [5, *SHAPE]
    assert all(type(number) in (int, float) for number in counts)
    assert source.dtype == np.float32
    assert rows[0, 2] < -0.9 < 0.9 < columns[0, 0]
    TURN.to_leap(GRID, rows_up=True)
    assert made.calls["set_modularbeam"][-2][0, 2] > 0.9
    assert made.calls["set_volume"] == (6, 5, 4, 0.5, 0.5, 1.0, 2.0, 3.0)
    made.right = False
    with pytest.raises(ExchangeError, match="LEAP refuses"):
        TURN.to_leap()


@pytest.mark.parametrize("name", ["cil", "tigre", "leap"])
def test_a_peer_that_is_missing_says_which_file_it_reads(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = {"cil": "cil.framework", "tigre": "tigre", "leap": "leapctype"}[name]
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ExchangeError, match=rf"cannot be imported .*FILE\.{name}"):
        getattr(TURN, f"to_{name}")()
