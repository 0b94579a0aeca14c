"""Batches: each item in its lane, the answers together in the order of the items.

An answer is encoded when it is made. Where all together become too large, the others are
refused without being made.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from flexdt.protocol import messages as m
from flexdt.protocol import rpc_errors as errors
from flexdt.server.network import loop_turns
from flexdt.server.network.shell_parts import Frozen

Item = m.Single | Frozen
Lane = Callable[[Item], int]


class Batch:
    """The remaining items of a batch, the urgent ones first, and the answers so far.

    Args:
        items: in the order in which they came.
        lane: of an item; lower lanes go first.
        most: bytes of all answers together.
    """

    def __init__(self, items: Sequence[Item], lane: Lane, most: int) -> None:
        """Queue a batch's items by lane, the most urgent lane first, in their order
        within a lane.

        Args:
            items: of the batch, in the order of their answers.
            lane: gives the lane of an item.
            most: size that all answers together may have [bytes].
        """
        by_lane = sorted(enumerate(items), key=lambda each: lane(each[1]))
        self._left = deque(by_lane)
        self._lane = lane
        self._served = 0
        self._bodies: dict[int, list[bytes]] = {}
        self._size = 0
        self._most = most
        self.too_large = errors.too_large(
            "the answers to a batch", f"more than {most}", most
        )

    @property
    def full(self) -> bool:
        """Whether the answers are too large already."""
        return self._size > self._most

    def next_item(self, *, urgent_alone: bool = False) -> Item | None:
        """Take out the next item, urgent ones first, and remember its place in the batch.

        Returns None if none is left, or, with `urgent_alone`, the next is ordinary (it
        stays).
        """
        if not self._left:
            return None
        index, item = self._left[0]
        if urgent_alone and self._lane(item) == loop_turns.ORDINARY:
            return None
        self._left.popleft()
        self._served = index
        return item

    def keep(
        self,
        answer: m.Response | m.Failure | None,
        encode: Callable[[m.Response | m.Failure], list[bytes]],
    ) -> None:
        """Keep the answer to the item that was taken out last; None for a notification.

        One that would make the batch too large becomes an error, which counts with the
        size of that answer.
        """
        if answer is None:
            return
        body = encode(answer)
        size = sum(map(len, body))
        if self._size + size > self._most:
            body = encode(m.Failure(answer.id, self.too_large))
        self._bodies[self._served] = body
        self._size += size

    def bodies(self) -> list[list[bytes]]:
        """Return the answers in the order of their items."""
        return [body for _, body in sorted(self._bodies.items())]


@dataclass(frozen=True)
class Split:
    """A batch that stays in the queue while its urgent items are served.

    Attributes:
        raw: its bytes in the queue, held here so that no other message has their
            identity.
        batch: the items, and their answers.
        urgent_done: set once the urgent ones have been served.
    """

    raw: bytes
    batch: Batch
    urgent_done: asyncio.Event = field(default_factory=asyncio.Event)
