"""Worker processes for twins that follow one another in one process.

A process takes a second to start, most of what a short history of a twin costs, and knows nothing
of the twin that it last worked for but what its caches keep by inode and time of a file.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from flexdt.runtime.workers import Worker, Workers


@contextmanager
def kept_workers() -> Iterator[None]:
    """Let idle workers of a twin that ends serve those that come after it, until the end of
    the context.

    Those that are to be ended for their work, as after too much memory, still are.
    """
    idle: dict[int, list[Worker]] = defaultdict(list)
    start, end = Workers._new, Workers.rest

    def taken(workers: Workers) -> Worker:
        kept = idle[workers.memory_bytes]
        return kept.pop() if kept else start(workers)

    def put_away(workers: Workers) -> None:
        idle[workers.memory_bytes] += workers._idle
        workers._idle.clear()
        end(workers)

    with patch.object(Workers, "_new", taken), patch.object(Workers, "rest", put_away):
        try:
            yield
        finally:
            for kept in idle.values():
                for worker in kept:
                    worker.kill()
