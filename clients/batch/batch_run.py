"""Run a batch: hand the missing items to workers and store outcomes until no item is missing.

`work` computes an item; `executors` provides the workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from itertools import islice
from pathlib import Path
from typing import Any

from flexdt.clients.batch.plan import Plan
from flexdt.clients.batch.store import Store, write
from flexdt.clients.batch.work import Outcome, item_bytes, run_item
from flexdt.clients.failure import CommandError

IN_FLIGHT = 512
"""Items with the workers at a time: enough for a cluster."""
IN_MEMORY = 2 * 2**30
"""Bytes of outcomes that may wait for the store."""

Tell = Callable[[int, int, float], None]


def run_batch(
    plan: Plan,
    out: Path,
    workers: AbstractContextManager[Executor],
    *,
    tell: Tell | None = None,
) -> dict[str, Any]:
    """Compute the missing items of a batch.

    Args:
        plan: of the batch.
        out: its folder; an interrupted batch of the same plan is taken up.
        workers: an executor, entered only if something is missing.
        tell: called with items done, items in all and items a second after each.

    Returns:
        Summary: counts, time, throughput, where things are.

    Raises:
        CommandError: another plan's folder; or a worker died (what is done stays done).
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
    summary = {
        "name": plan.batch.name,
        "kind": plan.batch.kind,
        "out": str(out),
        "plan_sha256": plan.sha256,
        "items_sha256": manifest["items_sha256"],
        "items": plan.batch.items,
        "done": manifest["done"],
        "failed": manifest["failed"],
        "figures": manifest["figures"],
        "resumed": before,
        "computed": made,
        "seconds": round(seconds, 3),
        "items_per_s": round(made / seconds, 3) if made else None,
    }
    write(out / "run.json", summary)
    return summary


def _work(store: Store, pool: Executor, started: float, tell: Tell | None) -> None:
    text, todo = store.plan.text, store.missing()
    in_flight = max(4, min(IN_FLIGHT, IN_MEMORY // item_bytes(store.plan)))
    begun = len(store.records)
    flying: set[Future[Outcome]] = set()
    try:
        while True:
            flying |= {
                pool.submit(run_item, text, i) for i in islice(todo, in_flight - len(flying))
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
            f"a worker died ({error}); {len(store.records)} items are done: run the command again "
            "to go on"
        ) from None
    finally:
        for future in flying:
            future.cancel()
