"""A thread that watches a dask cluster during the work, and prints the reason of a
wait."""

from __future__ import annotations

import threading
from collections.abc import Collection
from typing import Any, Final

from flexdt.extending import CommandError, note
from flexdt_extensions.slurm_jobs import Tend

EVERY_S: Final = 10.0
"""Interval between looks at the workers, and so between lines of a wait [s]."""
LOOK_S: Final = 10.0
"""Time after which a look that is not answered is given up, so that the end waits no longer [s]."""


class ClusterWatch(threading.Thread):
    """Looks at a cluster's workers until it is closed.

    Args:
        client: of dask.
        tend: called at each look; acts on the workers and prints.

    Attributes:
        error: that ended the work, which then ends with canceled futures.
    """

    def __init__(self, client: Any, tend: Tend) -> None:
        """Prepare a thread that watches a dask client; `tend` is called at intervals, and may
        end the jobs.
        """
        super().__init__(name="cluster watch", daemon=True)
        self._client = client
        self._tend = tend
        self._over = threading.Event()
        self.error: CommandError | None = None

    def __enter__(self) -> ClusterWatch:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join()

    def run(self) -> None:
        """Call `tend` every `EVERY_S` with the present workers and print its lines, until
        closed.

        A look that the scheduler does not answer is left out: it may be busy. Whether it is
        lost the waiting for results learns by itself. A CommandError ends the watch: it is
        kept in `error`, and the client is closed, which ends the waiting.
        """
        while not self._over.wait(EVERY_S):
            try:
                lines = self._tend(self._workers())
            except CommandError as error:
                self.error = error
                self._client.close()  # ends the waiting with cancelled futures
                return
            except OSError:
                continue
            for line in lines:
                note(line)

    def _workers(self) -> Collection[str]:
        known = self._client.run_on_scheduler(_names, callback_timeout=LOOK_S)
        return [str(name) for name in known]


def _names(dask_scheduler: Any = None) -> list[str]:
    """Names of the workers; runs on the scheduler."""
    return [str(worker.name) for worker in dask_scheduler.workers.values()]
