"""Run a batch: hand the missing items to workers and store outcomes until no item is missing.

`work` computes an item; `executors` provides the workers.

The folder of a batch (`Store`) has arrays as Zarr, a log that survives a crash, and the
manifest made of both.

    OUT/data.zarr       Zarr 3: one array for each kind of result; the first axis counts items
    OUT/items.jsonl     finished items, one line each, written after the arrays; sorted at the end
    OUT/manifest.json   plan, versions, every item's seed, parameters, figures, sha256; at the end
    OUT/run.json        how the last run went: time, workers, throughput

The first three do not depend on when, where and by how many processes they were made. A folder
belongs to one plan and one version of flexdt; anything else is an error.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.extending import CommandError, package, write_whole
from flexdt_extensions.batch.batch_plan import Plan
from flexdt_extensions.batch.work import ItemOutcome, item_bytes, layout, run_item

FORMAT: Final = "flexdt-batch-1"


class Store:
    """The folder of one batch, open for writing.

    Args:
        folder: made if it is not there.
        plan: of the batch.

    Attributes:
        records: of the items that are done, by index.

    Raises:
        CommandError: the folder holds another plan's batch, or no batch of flexdt.
        TwinError: zarr is not installed.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        """Open the results of a batch in a folder, which is made if it is missing, or go
        on with an interrupted one.

        Args:
            folder: of the results.
            plan: of the batch.

        Raises:
            CommandError: the folder holds another batch or other files.
            TwinError: zarr is not installed.
        """
        self.folder = folder
        self.plan = plan
        self._log_path = folder / "items.jsonl"
        self.records: dict[int, dict[str, Any]] = {}
        self._head = {
            "format": FORMAT,
            "flexdt": version("flexdt"),
            "plan_sha256": plan.sha256,
        }
        self._waiting: dict[int, ItemOutcome] = {}
        folder.mkdir(parents=True, exist_ok=True)
        known = self._read()
        self._arrays = self._open(known)
        self._log = self._log_path.open("a", encoding="utf-8", newline="\n")
        if not known:
            self._line(self._head)

    def close(self) -> None:
        """Close the log."""
        self._log.close()

    def missing(self) -> Iterator[int]:
        """Iterate over the items that are not done, in order."""
        return (i for i in range(self.plan.batch.items) if i not in self.records)

    def put(self, outcome: ItemOutcome) -> None:
        """Keep an item; once all items of its shard are kept, write the shard's arrays,
        then its log lines.

        Arrays of failed items are filled with the blank value.
        """
        self._waiting[outcome.index] = outcome
        shard = self._shard(outcome.index)
        if any(i not in self._waiting for i in shard):
            return
        outcomes = [self._waiting.pop(i) for i in shard]
        for name, array in self._arrays.items():
            blank = np.full(array.shape[1:], array.fill_value, array.dtype)
            array[shard.start : shard.stop] = np.stack(
                [o.arrays.get(name, blank) for o in outcomes]
            )
        self._line(*(o.record for o in outcomes))
        self.records |= {o.index: o.record for o in outcomes}

    def _shard(self, index: int) -> range:
        size = self.plan.batch.shard
        start = index - index % size
        return range(start, min(start + size, self.plan.batch.items))

    def finish(self) -> dict[str, Any]:
        """Write tables and manifest, after all items are done, and sort the log by item.

        Returns:
            The manifest: format, version, plan with checksum, arrays, counts, figures,
            items and their checksum.

        Raises:
            KeyError: an item is missing.
        """
        items = [self.records[i] for i in range(self.plan.batch.items)]
        self._tables(items)
        arrays = {
            n: {"shape": list(s), "dtype": d} for n, (s, d) in layout(self.plan).items()
        }
        manifest = {
            **self._head,
            "plan": self.plan.model_dump(mode="json"),
            "arrays": arrays,
            "done": sum(i["status"] == "done" for i in items),
            "failed": sum(i["status"] == "failed" for i in items),
            "figures": figures(items),
            "items_sha256": hashlib.sha256(_canonical(items).encode()).hexdigest(),
            "items": items,
        }
        self._sort_log(items)
        write(self.folder / "manifest.json", manifest)
        return manifest

    # -- helpers -------------------------------------------------------------------------------

    def _sort_log(self, items: list[dict[str, Any]]) -> None:
        """Rewrite the log, head first, in the order of `items`, and open it again for
        appending.
        """
        self._log.close()
        lines = [_canonical(record) + "\n" for record in (self._head, *items)]
        write_whole(self._log_path, "".join(lines))
        self._log = self._log_path.open("a", encoding="utf-8", newline="\n")

    def _line(self, *records: dict[str, Any]) -> None:
        self._log.write("".join(_canonical(record) + "\n" for record in records))
        self._log.flush()
        os.fsync(self._log.fileno())

    def _read(self) -> bool:
        """Read the log of finished items; a line that a crash cut off is dropped.

        Fills `records`, but not with items of a shard whose lines are incomplete: they
        are computed again.

        Returns:
            Whether there was a log of this plan.

        Raises:
            CommandError: the folder belongs to another plan, or to no batch.
        """
        if not self._log_path.exists():
            if any(self.folder.iterdir()):
                raise CommandError(
                    f"{self.folder}: holds files that are no batch of flexdt; choose another folder"
                )
            return False
        whole = self._log_path.read_bytes()
        kept = whole[: whole.rfind(b"\n") + 1]
        if len(kept) < len(whole):
            with self._log_path.open("r+b") as file:
                file.truncate(len(kept))
        lines = kept.splitlines()
        if not lines:
            return False
        found = json.loads(lines[0])
        head = self._head
        if found != head:
            wrong = next(k for k in head if found.get(k) != head[k])
            raise CommandError(
                f"{self.folder}: was begun with another {wrong} ({found.get(wrong)}, now "
                f"{head[wrong]}); choose another folder"
            )
        for line in lines[1:]:
            record = json.loads(line)
            self.records[int(record["index"])] = record
        begun = Counter(self._shard(i) for i in self.records)
        for shard, count in begun.items():
            if count < len(shard):  # its lines were cut off: its items are computed again
                for i in shard:
                    self.records.pop(i, None)
        return True

    def _open(self, known: bool) -> dict[str, Any]:
        """Open the arrays of the batch, or create them.

        With a log, files that a crash left are removed; if an array is missing, or
        without a log, all are created anew. Empty items are nan (0 in uint16).

        Args:
            known: whether the folder has a log of this plan.

        Returns:
            Name -> Zarr array (items, ...).
        """
        zarr = _zarr()
        where = self.folder / "data.zarr"
        wanted = layout(self.plan)
        if known:
            for leftover in where.rglob("*.partial"):  # files that Zarr left at a crash
                leftover.unlink()
            root = zarr.open_group(where, mode="r+", zarr_format=3)
            if all(name in root for name in wanted):
                return {name: root[name] for name in wanted}
        attributes = {"format": FORMAT, "plan_sha256": self.plan.sha256}
        root = zarr.create_group(
            where, overwrite=True, zarr_format=3, attributes=attributes
        )
        return {
            name: root.create_array(
                name,
                shape=(self.plan.batch.items, *shape),
                chunks=(1, *shape),
                dtype=dtype,
                shards=(size, *shape) if (size := self.plan.batch.shard) > 1 else None,
                fill_value=0 if dtype == "<u2" else float("nan"),
                dimension_names=("item", *_AXES[name]),
            )
            for name, (shape, dtype) in wanted.items()
        }

    def _tables(self, items: list[dict[str, Any]]) -> None:
        """Write figures as arrays too, so that readers need not parse the manifest.

        Written are "done", the true errors ("truth") and, of calibrations, values,
        errors, sigmas and "identifiable", each in place of an earlier one; missing
        numbers as `_table` has them. A table without any column is left out.

        Args:
            items: records of all items, in order.
        """
        root = _zarr().open_group(self.folder / "data.zarr", mode="r+", zarr_format=3)
        done = np.array([i["status"] == "done" for i in items])
        tables: dict[str, np.ndarray[Any, Any]] = {"done": done}
        names = sorted(self.plan.errors)
        attributes: dict[str, dict[str, Any]] = {"truth": {"parameters": names}}
        tables["truth"] = _table(
            [i.get("parameters", {}).get("errors", {}) for i in items], names
        )
        if self.plan.batch.kind == "calibrations":
            free = list(self.plan.calibrate.free)
            for name in ("values", "errors", "sigmas"):
                tables[name] = _table([i.get(name, {}) for i in items], free)
                attributes[name] = {"parameters": free}
            tables["identifiable"] = np.array(
                [bool(i.get("identifiable")) for i in items]
            )
        for name, values in tables.items():
            if values.size:
                made = root.create_array(name, data=values, overwrite=True)
                made.attrs.update(attributes.get(name, {}))


def _zarr() -> Any:
    return package("zarr", "a batch", "batch", "flexdt-extensions")


def open_arrays(folder: Path) -> Any:
    """Open the arrays of a batch for reading, by name; raises TwinError where zarr is
    not installed."""
    return _zarr().open_group(folder / "data.zarr", mode="r")


def figures(items: list[dict[str, Any]]) -> dict[str, Any]:
    """Sum up the identifiable calibrations.

    Returns:
        {} without calibrations; else the numbers "judged" and "identifiable", and
        "parameters": name -> mean absolute error ("mae"), root mean square of error over
        stated sigma ("rms_pull"), and share within 1.96 sigma ("within_95"; 0.95 if
        errors are Gaussian and sigmas true).
    """
    judged = [i for i in items if "identifiable" in i]
    used = [i for i in judged if i["identifiable"]]
    if not judged:
        return {}
    parameters: dict[str, Any] = {}
    for name in used[0]["errors"] if used else ():
        errors = np.array([i["errors"][name] for i in used], dtype=np.float64)
        sigmas = np.array([i["sigmas"][name] for i in used], dtype=np.float64)
        pulls = errors / sigmas
        parameters[name] = {
            "mae": float(np.abs(errors).mean()),
            "rms_pull": float(np.sqrt((pulls**2).mean())),
            "within_95": float((np.abs(pulls) <= 1.96).mean()),
        }
    return {"judged": len(judged), "identifiable": len(used), "parameters": parameters}


_AXES: Final = {
    "projections": ("frame", "row", "column"),
    "volumes": ("z", "y", "x"),
    "cone_vec_nominal": ("frame", "component"),
    "cone_vec_true": ("frame", "component"),
}


def _table(rows: list[dict[str, float | None]], names: list[str]) -> np.ndarray[Any, Any]:
    """Make a table (items, names) float64; nan for a missing value."""
    values = [[row.get(name) for name in names] for row in rows]
    return np.array(values, dtype=np.float64).reshape(len(rows), len(names))


def _canonical(value: object) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def write(path: Path, document: object) -> None:
    """Write a JSON file in one step: complete or not at all."""
    write_whole(path, json.dumps(document, indent=1, sort_keys=True) + "\n")


MAX_IN_FLIGHT = 512
"""Largest number of items submitted at a time: enough for a cluster."""
MAX_WAITING_BYTES = 2 * 2**30
"""Largest size of the outcomes that wait for the store [bytes]."""

Tell = Callable[[int, int, float], None]


def run_batch(
    plan: Plan,
    out: Path,
    workers: AbstractContextManager[Executor],
    *,
    tell: Tell | None = None,
) -> dict[str, Any]:
    """Compute the missing items of a batch, write its tables, and return a summary.

    The summary is also written to `run.json`; `items_per_s` is None if nothing was
    missing.

    Args:
        plan: of the batch.
        out: its folder; an interrupted batch of the same plan is continued.
        workers: an executor, entered only if items are missing.
        tell: called with items done, items in all and items a second after each.

    Returns:
        Summary: name, kind, folder, checksums, figures, counts, time [s] and items a
        second.

    Raises:
        CommandError: another plan's folder; or a worker died (completed items stay).
        TwinError: zarr is not installed, no such machine, or no workers.
    """
    store = Store(out, plan)
    try:
        before = len(store.records)
        started = time.perf_counter()
        if before < plan.batch.items:
            with workers as pool:
                _work(store, pool, started, tell)
        seconds = time.perf_counter() - started
        manifest = store.finish()
    finally:
        store.close()
    made = plan.batch.items - before
    told = ("plan_sha256", "items_sha256", "done", "failed", "figures")
    summary = {
        "name": plan.batch.name,
        "kind": plan.batch.kind,
        "out": str(out),
        **{name: manifest[name] for name in told},
        "items": plan.batch.items,
        "resumed": before,
        "computed": made,
        "seconds": round(seconds, 3),
        "items_per_s": round(made / seconds, 3) if made else None,
    }
    write(out / "run.json", summary)
    return summary


def _work(store: Store, pool: Executor, started: float, tell: Tell | None) -> None:
    """Compute the missing items on the pool and store each outcome as it comes.

    At least 4 items are in flight, at most `MAX_IN_FLIGHT`, and of `MAX_WAITING_BYTES` in
    all. At an error the calls that have not begun are canceled.

    Args:
        store: of the batch.
        pool: entered executor.
        started: time of the start, of `time.perf_counter` [s].
        tell: called with items done, items in all and items a second; None for none.

    Raises:
        CommandError: a worker died.
    """
    text = store.plan.text
    todo = store.missing()
    in_flight = max(4, min(MAX_IN_FLIGHT, MAX_WAITING_BYTES // item_bytes(store.plan)))
    begun = len(store.records)
    flying: set[Future[ItemOutcome]] = set()
    try:
        while True:
            flying |= {
                pool.submit(run_item, text, i)
                for i in islice(todo, in_flight - len(flying))
            }
            if not flying:
                return
            done, flying = wait(flying, return_when=FIRST_COMPLETED)
            for future in done:
                store.put(future.result())
                if tell is not None:
                    count = len(store.records)
                    rate = (count - begun) / max(time.perf_counter() - started, 1e-9)
                    tell(count, store.plan.batch.items, rate)
    except BrokenProcessPool as error:
        raise CommandError(
            f"a worker died ({error}); "
            f"{len(store.records)} items are done: run the command again to go on"
        ) from None
    finally:
        for future in flying:
            future.cancel()
