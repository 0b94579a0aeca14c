"""`flexdt evidence` on files of the published forms, written here from closed forms of our own."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.io import savemat

from flexdt.clients.cli.entry import run

Array = npt.NDArray[np.float64]
POINTS = np.array([0.0, 0.0, 0.0]) + np.random.default_rng(4).uniform(-55.0, 55.0, (12, 3))


def seen(angle_deg: float, sdd: float, points: Array) -> Array:
    """Where a pinhole at SOD 600 sees points of an object that turns clockwise, (k, 2) [px]."""
    a = np.radians(angle_deg)
    across = points[:, 0] * np.cos(a) + points[:, 1] * np.sin(a)
    deep = 600.0 - points[:, 0] * np.sin(a) + points[:, 1] * np.cos(a)
    scale = sdd / deep / 0.0748
    return np.stack([767.5 + scale * across, 971.5 - scale * points[:, 2]], axis=1)


def needles(folder: Path, sdd: float, sense: float = 1.0) -> None:
    """Two scans as CaTE stores them: a pickled dictionary of frames."""
    rng = np.random.default_rng(2)
    for scan, views, frames in (("pos_2", 3600, range(0, 3600, 400)), ("pert_2", 14, range(7))):
        marks: dict[int, Any] = {}
        for frame in frames:
            places = seen(sense * 360.0 * frame / views, sdd, POINTS) + rng.normal(0, 0.2, (12, 2))
            marks[frame] = {("marker", str(k)): (x, y) for k, (x, y) in enumerate(places)}
        np.save(folder / f"needle_25Sep2020_{scan}_locations.npy", np.array(marks, dtype=object))


def helsinki(folder: Path, place: tuple[float, float] = (9.0, 4.0)) -> None:
    """A fan-beam sinogram of a round Gaussian bump, and its image; the image may be elsewhere."""
    turn = np.arange(0.0, 360.5, 0.5)
    a, c = np.radians(turn)[:, None], (np.arange(560) - 279.5) * 0.2
    # The stage turns clockwise, so in the object's frame source and panel turn the other way.
    source = 410.66 * np.stack([np.sin(a), -np.cos(a)], -1)
    across = np.cos(a) * c - np.sin(a) * 553.74
    along = np.stack([across, np.sin(a) * c + np.cos(a) * 553.74], -1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    to = np.array([9.0, 4.0]) - source
    off = to[..., 0] * along[..., 1] - to[..., 1] * along[..., 0]
    sinogram = 0.02 * np.sqrt(2 * np.pi) * 3.0 * np.exp(-0.5 * (off / 3.0) ** 2)
    at = (np.arange(512) - 255.5) * 0.14832232
    far = (at - place[0]) ** 2 + (at[::-1, None] - place[1]) ** 2
    said = {"distanceSourceOrigin": 410.66, "distanceSourceDetector": 553.74, "angles": turn,
            "pixelSizePost": 0.2, "effectivePixelSizePost": 0.14832232}  # fmt: skip
    scan = {"CtDataFull": {"sinogram": sinogram, "parameters": said}}
    savemat(folder / "htc2022_bump_full.mat", scan)
    image = 0.02 * np.exp(-0.5 * far / 9.0)
    savemat(folder / "htc2022_bump_full_recon_fbp.mat", {"reconFullFbp": image})


def tooth(folder: Path, turn: float = 179.0) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "tooth.h5", "w") as file:
        file["exchange/data"] = np.full((60, 2, 64), 900.0, np.float32)
        file["exchange/data_white"] = np.full((3, 2, 64), 1000.0, np.float32)
        file["exchange/data_dark"] = np.full((3, 2, 64), 100.0, np.float32)
        file["exchange/theta"] = np.linspace(0.0, turn, 60)


def figures(capsys: pytest.CaptureFixture[str]) -> dict[str, bool]:
    document = json.loads(capsys.readouterr().out)
    return {f["what"]: f["agrees"] for case in document["cases"] for f in case["figures"]}


@pytest.mark.filterwarnings("ignore:the object is wider than the panel")  # a flat field
def test_right_data_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    needles(tmp_path, 340.0)
    helsinki(tmp_path)
    tooth(tmp_path)
    assert run(["--json", "evidence", "--data", str(tmp_path)]) == 0
    found = figures(capsys)
    assert len(found) == 8
    assert all(found.values()), found


@pytest.mark.filterwarnings("ignore:the object is wider than the panel")  # a flat field
@pytest.mark.parametrize(
    ("make", "missed"),
    [
        (lambda folder: needles(folder, 352.0), "pos_2: shift of the detector"),
        (lambda folder: needles(folder, 340.0, -1.0), "pos_2: residual"),
        (lambda folder: helsinki(folder, (9.0, -4.0)), "bump: correlation"),
        (lambda folder: tooth(folder, 240.0), "FDK"),
    ],
)
def test_wrong_data_are_told_and_end_with_1(
    make: Any, missed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path)
    assert run(["--json", "evidence", "--data", str(tmp_path)]) == 1
    assert figures(capsys)[missed] is False


def test_what_is_not_at_hand_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evidence", "--data", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("not at hand") == 3
    assert run(["evidence", "cate", "--data", str(tmp_path)]) == 1
    assert "github.com/adriaangraas/CaTE" in capsys.readouterr().err
    assert run(["evidence", "walnut"]) == 1
    assert "allowed: cate, htc2022, tooth" in capsys.readouterr().err


def test_a_pickle_that_is_more_than_numbers_is_not_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Harm:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "harm"),)

    harm = np.array({0: Harm()}, dtype=object)
    np.save(tmp_path / "needle_25Sep2020_pos_2_locations.npy", harm)
    assert run(["evidence", "cate", "--data", str(tmp_path)]) == 1
    assert "posix.mkdir in a file of numbers" in capsys.readouterr().err
    assert not (tmp_path / "harm").exists()


@pytest.mark.skipif("FLEXDT_REAL_DATA" not in os.environ, reason="FLEXDT_REAL_DATA names no folder")
def test_the_real_data_agree() -> None:
    assert run(["evidence", "--data", os.environ["FLEXDT_REAL_DATA"]]) == 0
