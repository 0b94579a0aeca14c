"""Shards, and what training reads of them: order, epochs, workers, augmentations."""

from __future__ import annotations

import hashlib
import pickle
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.library.failure import CommandError
from flexdt.twin.errors import LimitError, TwinError
from flexdt_extensions.batch.batch_plan import Plan, parse_plan
from flexdt_extensions.batch.batch_run import Store, run_batch
from flexdt_extensions.batch.training_data import Augment, TrainingData, stream
from flexdt_extensions.batch.work import run_item

pytest.importorskip("zarr", reason="batches are kept as Zarr")


def plan_of(items: int, shard: int, **images: Any) -> Plan:
    """Small radiographs of spheres, of which some find no room."""
    return parse_plan(
        {
            "batch": {"name": "b", "kind": "projections", "items": items, "seed": 3,
                      "shard": shard},
            "phantom": {"spheres": {"count": {"integers": [2, 4]},
                                    "radius_mm": {"uniform": [3.0, 5.9]},
                                    "within_radius_mm": 6.0, "within_height_mm": 30.0}},
            "geometry": {"frames": 2},
            "camera": {"shape": [12, 16], "pixel_mm": 5.0},
            "images": {"noise": False, **images},
        }
    )  # fmt: skip


def here() -> AbstractContextManager[Executor]:
    return ThreadPoolExecutor(2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("batch") / "b"
    summary = run_batch(plan_of(50, 8), out, here())
    assert 0 < summary["failed"] < 25
    return out


def digests(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != "run.json"
    }


def test_a_shard_is_a_file_and_holds_what_items_alone_are(folder: Path) -> None:
    chunks = [
        p for p in (folder / "data.zarr" / "projections" / "c").rglob("*") if p.is_file()
    ]
    assert len(chunks) == 7  # of 8 items, the last of 2
    data = TrainingData(folder)
    plan = plan_of(50, 8)
    for number in (0, 7, len(data) - 1):
        sample = data[number]
        outcome = run_item(plan.text, sample["index"])
        assert set(sample) == {*outcome.arrays, "index"}
        for name, values in outcome.arrays.items():
            np.testing.assert_array_equal(sample[name], values)


def test_any_order_and_any_interruption_give_the_same_files(
    folder: Path, tmp_path: Path
) -> None:
    """Outcomes stored in random order, the log cut anywhere in between, then taken up."""
    plan, rng = plan_of(50, 8), np.random.default_rng(8)
    outcomes = {i: run_item(plan.text, i) for i in range(50)}
    whole = digests(folder)
    for trial in range(5):
        out = tmp_path / str(trial)
        store = Store(out, plan)
        for i in rng.permutation(50)[: rng.integers(20, 50)].tolist():
            store.put(outcomes[i])
        store.close()
        log = out / "items.jsonl"
        kept = log.read_bytes()
        first = kept.index(b"\n") + 1
        log.write_bytes(kept[: rng.integers(first, len(kept) + 1)])
        store = Store(out, plan)
        missing = list(store.missing())
        assert len(missing) in (50, 48) or (50 - len(missing)) % 8 in (0, 2)
        for i in rng.permutation(missing).tolist():
            store.put(outcomes[i])
        store.finish()
        store.close()
        assert digests(out) == whole


def seen(data: TrainingData, rank: int = 0, ranks: int = 1) -> list[int]:
    return [sample["index"] for sample in data.shuffled(rank, ranks)]


def test_an_epoch_is_every_item_once_in_an_order_of_its_own(folder: Path) -> None:
    data = TrainingData(folder, seed=4)
    first, again = seen(data), seen(TrainingData(folder, seed=4))
    assert first == again
    assert sorted(first) == data.indices.tolist() != first
    data.epoch = 1
    second = seen(data)
    assert sorted(second) == sorted(first)
    assert second != first
    assert seen(TrainingData(folder, seed=5)) != first
    # Shards come whole, so that each is read once.
    shards = [i // 8 for i in first]
    assert sum(a != b for a, b in pairwise(shards)) == len(set(shards)) - 1


@pytest.mark.parametrize("ranks", [1, 2, 3, 7, 11])
def test_workers_share_an_epoch_without_repetition(folder: Path, ranks: int) -> None:
    data = TrainingData(folder, seed=1)
    parts = [seen(data, rank, ranks) for rank in range(ranks)]
    together = [i for part in parts for i in part]
    assert sorted(together) == data.indices.tolist()
    assert sum(bool(part) for part in parts) == min(ranks, 7)


def test_a_pickled_one_goes_on_alike(folder: Path) -> None:
    data = TrainingData(folder, Augment(photons=(50.0, 5000.0), shift_px=0.7), seed=2)
    data.epoch = 3
    before = data[5]["projections"]
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(data))[5]["projections"], before
    )


def test_dose_is_the_spread_that_photons_have(folder: Path) -> None:
    """Variance of -ln(counts / photons) is exp(p) / photons, over many epochs of one item."""
    plain = TrainingData(folder)[0]["projections"].astype(float)
    data = TrainingData(folder, Augment(photons=(4000.0, 4000.0)))
    drawn = []
    for data.epoch in range(400):
        drawn.append(data[0]["projections"])
    np.testing.assert_allclose(np.mean(drawn, axis=0), plain, atol=0.02)
    spread = np.var(drawn, axis=0) / (np.exp(plain) / 4000.0)
    assert spread.mean() == pytest.approx(1.0, abs=0.03)
    assert spread.std() < 0.1  # sqrt(2 / 400)
    assert drawn[0].dtype == np.float32


def test_a_shift_moves_image_and_true_geometry_together(folder: Path) -> None:
    """The centre of mass on the panel moves against the panel, which moved by the same."""
    plain, data = (
        TrainingData(folder)[0],
        TrainingData(folder, Augment(shift_px=0.4), seed=6),
    )
    rows, cols = np.mgrid[0:12, 0:16]
    for data.epoch in range(5):
        moved = data[0]
        np.testing.assert_array_equal(
            moved["cone_vec_nominal"], plain["cone_vec_nominal"]
        )
        change = moved["cone_vec_true"] - plain["cone_vec_true"]
        assert np.abs(change[:, [0, 1, 2, *range(6, 12)]]).max() == 0.0
        u, v = plain["cone_vec_true"][:, 6:9], plain["cone_vec_true"][:, 9:12]
        by = [np.einsum("ni,ni->n", change[:, 3:6], w) / np.einsum("ni,ni->n", w, w)
              for w in (u, v)]  # fmt: skip
        assert 0.0 < np.abs(by).max() < 2.0
        for frame in range(2):
            for grid, shift in zip((cols, rows), by, strict=True):
                at = [float((grid * s["projections"][frame]).sum() / s["projections"][frame].sum())
                      for s in (plain, moved)]  # fmt: skip
                assert at[1] - at[0] == pytest.approx(-shift[frame], abs=0.03)


def test_what_cannot_be_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="no finished batch"):
        TrainingData(tmp_path)
    for photons, shift in (
        ((5.0, 1.0), 0.0), ((0.0, 1.0), 0.0), (None, -1.0), (None, np.nan), (0, 0.0),
        ((1e3,), 0.0), (1e3, 0.0), (("a", "b"), 0.0),
    ):  # fmt: skip
        with pytest.raises(LimitError, match="allowed"):
            Augment(photons, shift)
    run_batch(plan_of(2, 1, values="counts"), tmp_path / "counts", here())
    assert TrainingData(tmp_path / "counts")[0]["projections"].dtype == np.uint16
    with pytest.raises(CommandError, match="line integrals"):
        TrainingData(tmp_path / "counts", Augment())
    run_batch(plan_of(2, 1, noise=True), tmp_path / "noisy", here())
    TrainingData(tmp_path / "noisy", Augment(shift_px=0.3))
    with pytest.raises(CommandError, match="have noise"):
        TrainingData(tmp_path / "noisy", Augment(photons=(1e3, 1e4)))


def test_without_pytorch_one_line_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "torch.utils.data", None)
    with pytest.raises(TwinError, match=r"pip install 'flexdt\[torch\]'"):
        stream(TrainingData(folder))


@pytest.mark.parametrize("workers", [0, 2])
def test_pytorch_streams_and_indexes_it(folder: Path, workers: int) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is an extra")
    data = TrainingData(folder, seed=4)
    loader = torch.utils.data.DataLoader(stream(data), batch_size=4, num_workers=workers)
    found = [int(i) for batch in loader for i in batch["index"]]
    assert sorted(found) == data.indices.tolist()
    if workers == 0:
        assert found == seen(data)
    by_number = torch.utils.data.DataLoader(data, batch_size=4, num_workers=workers)
    assert [
        int(i) for batch in by_number for i in batch["index"]
    ] == data.indices.tolist()
