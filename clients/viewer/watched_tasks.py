"""Background tasks that are watched.

asyncio keeps a task's exception until the task is awaited: a failure of a watched one is
logged, reported to the owner of the task, and not followed by a restart.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any

from flexdt.runtime.log import log


def watched(
    work: Coroutine[Any, Any, None], what: str, died: Callable[[], None] = lambda: None
) -> asyncio.Task[None]:
    """Run `work` as a task, which is not started again.

    Args:
        work: the coroutine.
        what: name of the work, for the log.
        died: called when it has failed, not when it was canceled.

    Returns:
        The task; an error of the work is logged, not raised.
    """

    async def run() -> None:
        """Await the work; an exception is logged and `died` called, not raised.

        Cancellation is passed on.
        """
        try:
            await work
        except Exception:
            log(f"{what} failed", logging.ERROR, error=True)
            died()

    task = asyncio.create_task(run())
    task.add_done_callback(
        lambda _: work.close()
    )  # where it was cancelled before it began
    return task
