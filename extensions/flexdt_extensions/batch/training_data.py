"""A batch's items for training: `TrainingData` by index, `stream` shard by shard, each with
seeds.

Both give dictionaries of arrays, which PyTorch's `DataLoader` collates: `TrainingData` is a
map-style data set as it is, `stream` needs PyTorch.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.extending import CommandError, package
from flexdt.twin.errors import LimitError
from flexdt_extensions.batch.batch_run import open_arrays

Sample = dict[str, Any]


@dataclass(frozen=True)
class Augment:
    """Random physics for each item and epoch, on line integrals.

    Attributes:
        photons: lowest and highest open-beam photons of a pixel (loguniform), whose noise
            is added; None adds none.
        shift_px: standard deviation of the detector's shift along columns and rows, which
            `cone_vec_true` follows and `cone_vec_nominal` does not.

    Raises:
        LimitError: values that are not positive, or not in order.
    """

    photons: tuple[float, float] | None = None
    shift_px: float = 0.0

    def __post_init__(self) -> None:
        """Check the settings.

        `photons` are (low, high); None is allowed.

        Raises:
            LimitError: photons or shift out of their range.
        """
        try:
            low, high = (1.0, 1.0) if self.photons is None else map(float, self.photons)
        except (TypeError, ValueError):
            low = high = 0.0
        if not (0.0 < low <= high < np.inf and 0.0 <= self.shift_px < np.inf):
            raise LimitError(
                f"photons {self.photons!r}, shift_px {self.shift_px:g}; allowed: two positive "
                "numbers, the lower first, and a shift that is not negative",
                {"asked": [self.photons, self.shift_px]},
            )

    def apply(self, sample: Sample, rng: np.random.Generator) -> None:
        """Change a sample's projections, and the geometry they were truly made with.

        All images are shifted by one normal amount along columns and rows [px], which
        `cone_vec_true` follows, and get Poisson noise of one random number of photons
        (drawn evenly in its logarithm; no count becomes half a photon); each only if it
        is set.

        Args:
            sample: arrays by name; `projections` and `cone_vec_true` are replaced.
            rng: of this item and epoch.
        """
        from scipy.ndimage import shift

        images = sample["projections"]
        if self.shift_px:
            columns, rows = rng.normal(0.0, self.shift_px, 2)
            images = shift(images, (0, -rows, -columns), order=1, mode="nearest")
            cone = sample["cone_vec_true"] = sample["cone_vec_true"].copy()
            cone[:, 3:6] += columns * cone[:, 6:9] + rows * cone[:, 9:12]
        if self.photons is not None:
            photons = np.exp(rng.uniform(*np.log(self.photons)))
            counts = rng.poisson(photons * np.exp(-images.astype(np.float64)))
            images = np.log(photons / np.maximum(counts, 0.5))
        sample["projections"] = np.asarray(images, np.float32)


class TrainingData:
    """The items of a finished batch that did not fail.

    Args:
        folder: of the batch.
        augment: None leaves the items as they are.
        seed: of all random draws.

    Attributes:
        epoch: part of the seed; raise it after each pass.

    Raises:
        CommandError: the folder holds no finished batch, or `augment` meets counts or
            noise.
        TwinError: zarr is not installed.

    Example:
        >>> data = TrainingData(Path("spheres"), Augment(photons=(1e3, 1e5)))  # doctest:
        +SKIP
        >>> data[17]["projections"].shape  # doctest: +SKIP
        (24, 48, 64)
    """

    def __init__(
        self, folder: Path | str, augment: Augment | None = None, seed: int = 0
    ) -> None:
        """Read the manifest of a finished batch; `indices` are its items that are done.

        Raises CommandError without a manifest, and where `augment` does not fit: the
        images are counts, or photons would add to their noise.
        """
        self.folder = Path(folder)
        self.augment = augment
        self.seed = seed
        self.epoch = 0
        file = self.folder / "manifest.json"
        if not file.is_file():
            raise CommandError(
                f"{self.folder}: no finished batch; run `flexdt batch` to its end"
            )
        manifest = json.loads(file.read_text(encoding="utf-8"))
        plan = manifest["plan"]
        if augment is not None and plan["images"]["values"] != "line_integrals":
            raise CommandError(
                f"{self.folder}: holds counts; augment needs line integrals"
            )
        if augment is not None and augment.photons and plan["images"]["noise"]:
            raise CommandError(
                f"{self.folder}: its images have noise; photons would add to it. "
                "Make the batch with noise = false, or give Augment(photons=None)"
            )
        self.names = tuple(manifest["arrays"])
        self.shard = int(plan["batch"]["shard"])
        done = [i["status"] == "done" for i in manifest["items"]]
        self.indices = np.flatnonzero(done)

    @cached_property
    def _arrays(self) -> Any:
        return open_arrays(self.folder)

    def __getstate__(self) -> dict[str, Any]:
        """Drop open files, so that it travels to worker processes."""
        return {k: v for k, v in self.__dict__.items() if k != "_arrays"}

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, number: int) -> Sample:
        """Return the item `number` of those done: its arrays by name, and `index`, its
        number in the batch; augmented if asked for.
        """
        index = int(self.indices[number])
        return self._finish(
            index, {name: self._arrays[name][index] for name in self.names}
        )

    def order(self, rank: int = 0, ranks: int = 1) -> npt.NDArray[np.int64]:
        """Return this epoch's order of the shards that one process of several reads;
        no shard twice."""
        shards = np.unique(self.indices // self.shard)
        rng = np.random.default_rng((self.seed, self.epoch))
        return np.asarray(rng.permutation(shards)[rank::ranks])

    def shuffled(self, rank: int = 0, ranks: int = 1) -> Iterator[Sample]:
        """Yield this epoch's samples of a process: shards in `order`, each read once and
        shuffled inside; failed items are left out.

        Args:
            rank: number of the process.
            ranks: number of processes.

        Yields:
            Samples, augmented, with their index; the same for the same seed and epoch.
        """
        for shard in self.order(rank, ranks).tolist():
            first = shard * self.shard
            part = {
                name: self._arrays[name][first : first + self.shard]
                for name in self.names
            }
            here = self.indices[self.indices // self.shard == shard]
            rng = np.random.default_rng((self.seed, self.epoch, shard))
            for index in rng.permutation(here).tolist():
                yield self._finish(
                    index, {n: values[index - first] for n, values in part.items()}
                )

    def _finish(self, index: int, sample: Sample) -> Sample:
        """Augment a sample in place, by draws that depend on seed, epoch and index, and
        return a copy with its index.
        """
        if self.augment is not None:
            rng = np.random.default_rng((self.seed, self.epoch, index, 1))
            self.augment.apply(sample, rng)
        return sample | {"index": index}


def stream(data: TrainingData, rank: int = 0, ranks: int = 1) -> Any:
    """Make PyTorch's `IterableDataset` of `data.shuffled`, dealt among its `DataLoader`'s
    workers.

    Set `data.epoch` before each pass; workers that live on from pass to pass do not see it.

    Args:
        data: the batch.
        rank, ranks: of this process, where several train together.

    Raises:
        TwinError: PyTorch is not installed.
    """
    torch_data = package("torch.utils.data", "a stream", "torch")

    class Stream(torch_data.IterableDataset):  # type: ignore[misc, name-defined]
        def __iter__(self) -> Iterator[Sample]:
            worker = torch_data.get_worker_info()
            one, of = (0, 1) if worker is None else (worker.id, worker.num_workers)
            return data.shuffled(rank * of + one, ranks * of)

        def __reduce__(self) -> tuple[Any, ...]:
            return stream, (data, rank, ranks)

    return Stream()
