"""Delivery of events of the topics state, projection, job and log to their subscribers.

Each event is rendered once per view (an image as line integrals or counts, binned or not)
however many subscribers there are. A subscriber's rate limit keeps the newest value of
each slot; a client that does not read is its own connection's business (see `tcp`). `seq`
counts the events of a topic, so a gap shows skipped events. The last events of some
topics are kept for late subscribers, who get them with their original `seq` and time,
each once. Events to many go out in slices, in order for each, so that no request waits
for hundreds of them.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from flexdt.protocol import Prepared, event
from flexdt.protocol.fields import TopicName
from flexdt.protocol.rpc_errors import busy
from flexdt.server.network.shell_parts import Peer

EVENTS_A_TURN = 4
"""Events posted in one turn of the event loop; requests are handled between turns."""


@dataclass(frozen=True)
class ImageRequest:
    """A subscriber's view of images: kind, and the mean over binning x binning pixels."""

    kind: Literal["line_integral", "counts"] = "line_integral"
    binning: int = 1


Render = Callable[[ImageRequest], object]
"""Computes an event's data for one view; called at most once a view."""


class _Event:
    """One event with its encodings, one a view and codec."""

    def __init__(
        self,
        topic: TopicName,
        seq: int,
        time: float,
        data: object | Render,
        slot: str | None,
    ) -> None:
        """Make an event, number `seq`, at twin time `time` [s].

        `data` may be a function from a view to the content. A newer event of the slot
        replaces a pending one, but not if `slot` is None.
        """
        self.topic = topic
        self.seq = seq
        self.time = time
        self._data = data
        self.slot = None if slot is None else f"{topic}:{slot}"
        self._made: dict[ImageRequest, Prepared] = {}

    def prepared(self, view: ImageRequest) -> Prepared:
        """Return the event's message for a view of the image, made at the first request
        for that view and kept.

        Without a function as `data` all views have the same content.
        """
        if view not in self._made:
            if callable(self._data):
                data = self._data(view)
            else:
                data = self._data
            self._made[view] = Prepared(event(self.topic, self.seq, self.time, data))
        return self._made[view]


@dataclass
class _Subscription:
    """One listener's subscription to a topic."""

    view: ImageRequest
    min_interval_s: float
    next_at: float = 0.0
    timer: asyncio.TimerHandle | None = None
    pending: dict[str | None, _Event] = field(default_factory=dict)


class Hub:
    """Topics with their subscribers.

    Args:
        now: twin time [s], stamped on every event.
        kept: topic -> how many of its last events late subscribers get; they are plain
            data.
        most: subscriptions, one for each topic of each listener.
        most_views: different views, each of which costs a rendering and an encoding an
            event.
    """

    def __init__(
        self,
        now: Callable[[], float],
        kept: Mapping[TopicName, int] | None = None,
        most: int = 2048,
        most_views: int = 16,
    ) -> None:
        """Make a hub without subscriptions; `now` gives the twin's time [s].

        `kept`: topic -> how many past events it keeps; at most `most` subscriptions, and
        `most_views` different image views.
        """
        self._now = now
        self._most = most
        self._most_views = most_views
        self._kept: dict[TopicName, deque[_Event]] = {
            topic: deque(maxlen=count) for topic, count in (kept or {}).items()
        }
        self._last_sent: dict[tuple[Peer, TopicName], int] = {}
        self._seq: dict[TopicName, int] = {}
        self._listeners: dict[TopicName, dict[Peer, _Subscription]] = {}
        self._due_events: deque[tuple[Peer, _Subscription, _Event]] = deque()
        self._room = EVENTS_A_TURN
        self._refilling = False

    def subscribe(
        self,
        listener: Peer,
        topics: Iterable[TopicName],
        max_rate_hz: float | None = None,
        view: ImageRequest | None = None,
    ) -> None:
        """Subscribe `listener` to `topics`, and send it the kept events that it has not had.

        Kept events are those of topics with a history, oldest first, at once and without the
        rate. A second call changes rate and view.

        Args:
            listener: connection.
            topics: of the wire.
            max_rate_hz: of events in slots; None for no limit.
            view: kind and binning of images.

        Raises RpcError: -32003, more subscriptions or views than there may be; nothing has
        changed.
        """
        interval = 0.0
        if max_rate_hz is not None:
            interval = 1.0 / max_rate_hz
        topics = set(topics)
        view = view or ImageRequest()
        self._require_room(listener, topics, view)
        # In a fixed order, which sets do not have: kept events of several topics go out here.
        for topic in sorted(topics):
            # A timer of the earlier subscription would go on at the earlier rate.
            self.unsubscribe(listener, [topic])
            subscription = _Subscription(view, interval)
            self._listeners.setdefault(topic, {})[listener] = subscription
            last_sent = self._last_sent.get((listener, topic), -1)
            for earlier in self._kept.get(topic, ()):
                if earlier.seq > last_sent:
                    self._deliver(listener, subscription, earlier)

    def _require_room(
        self, listener: Peer, topics: set[TopicName], view: ImageRequest
    ) -> None:
        """Check that a listener's subscriptions and view stay within the limits of the
        hub.

        The listener's earlier subscriptions to the same topics do not count.

        Args:
            listener: who subscribes.
            topics: its new subscriptions.
            view: of all of them.

        Raises:
            RpcError: -32003, there would be more; names the number and the limit.
        """
        views = [
            s.view
            for topic, listeners in self._listeners.items()
            for other, s in listeners.items()
            if other is not listener or topic not in topics
        ]
        for what, asked, most in (
            ("subscriptions", len(views) + len(topics), self._most),
            ("different views", len({view, *views}), self._most_views),
        ):
            if asked > most:
                data = {"asked": asked, "allowed": most}
                raise busy(
                    f"there would be {asked} {what}; this server has {most} at most", data
                )

    def unsubscribe(self, listener: Peer, topics: Iterable[TopicName]) -> None:
        """End subscriptions of `listener` to `topics`; topics that it is not subscribed
        to are ignored.

        Its events that wait for the rate are dropped."""
        for topic in topics:
            subscription = self._listeners.get(topic, {}).pop(listener, None)
            if subscription is not None and subscription.timer is not None:
                subscription.timer.cancel()

    def drop(self, listener: Peer) -> None:
        """End a connection's subscriptions, and forget what it has been sent."""
        self.unsubscribe(listener, list(self._listeners))
        for topic in self._kept:
            # Else a server that runs for months keeps an entry of each connection there ever
            # was.
            self._last_sent.pop((listener, topic), None)

    def wanted(self, topic: TopicName) -> bool:
        """Return whether a topic has subscribers, so that nothing is computed in vain."""
        return bool(self._listeners.get(topic))

    def count(self, topic: TopicName) -> int:
        """Count a topic's events."""
        return self._seq.get(topic, 0)

    def views(self, topic: TopicName) -> set[ImageRequest]:
        """Return the views that subscribers of `topic` want."""
        return {s.view for s in self._listeners.get(topic, {}).values()}

    def publish(
        self,
        topic: TopicName,
        data: object | Render,
        slot: str | None = "",
        time: float | None = None,
    ) -> None:
        """Send an event to all subscribers of `topic`.

        Its number counts, and topics with a history keep it, even without subscribers.

        Args:
            topic: which.
            data: plain data or a model, or a function that makes it for a view.
            slot: newer events of the same slot replace this one; None: all are sent, in order.
            time: twin time of the data [s]; now if left out.
        """
        seq = self._seq.get(topic, 0)
        self._seq[topic] = seq + 1
        listeners = self._listeners.get(topic, {})
        kept = self._kept.get(topic)
        if not listeners and kept is None:
            return
        new = _Event(topic, seq, self._now() if time is None else time, data, slot)
        if kept is not None:
            kept.append(new)
        for listener, subscription in list(listeners.items()):
            self._offer(listener, subscription, new)

    def snapshot(
        self,
        listener: Peer,
        topic: TopicName,
        data: object | Render,
        slot: str | None = "",
    ) -> None:
        """Send one subscriber of `topic` the present data, with the last event's number.

        Others, the history, the numbers and the rate are not touched; 0 before the first
        event.
        """
        subscription = self._listeners.get(topic, {}).get(listener)
        if subscription is not None:
            # Not a number of its own: to all other subscribers that would be a gap.
            seq = max(0, self._seq.get(topic, 0) - 1)
            self._deliver(
                listener, subscription, _Event(topic, seq, self._now(), data, slot)
            )

    def _offer(self, listener: Peer, subscription: _Subscription, new: _Event) -> None:
        """Deliver an event now, or keep it until the subscription's rate allows it.

        Only an event with a slot waits; then a newer one of the same slot replaces it. An
        event that is delivered at once begins the next interval.
        """
        loop = asyncio.get_running_loop()
        wait = subscription.next_at - loop.time()
        # While a timer runs, later events wait with it even if the interval is over: sent at
        # once they would overtake the pending ones.
        if new.slot is not None and (wait > 0.0 or subscription.timer is not None):
            # Taken out first: a replaced value would keep its place, before older events.
            subscription.pending.pop(new.slot, None)
            subscription.pending[new.slot] = new
            # One timer for all slots: the rate is the subscription's.
            if subscription.timer is None:
                subscription.timer = loop.call_later(
                    wait, self._flush, listener, subscription
                )
            return
        subscription.next_at = loop.time() + subscription.min_interval_s
        self._deliver(listener, subscription, new)

    def _flush(self, listener: Peer, subscription: _Subscription) -> None:
        """Deliver the pending event of each slot, forget them, and begin the next
        interval.
        """
        subscription.timer = None
        subscription.next_at = (
            asyncio.get_running_loop().time() + subscription.min_interval_s
        )
        pending = subscription.pending
        subscription.pending = {}
        for newest in pending.values():
            self._deliver(listener, subscription, newest)

    def _deliver(self, listener: Peer, subscription: _Subscription, new: _Event) -> None:
        """Post an event at once, or in order if many are due."""
        self._due_events.append((listener, subscription, new))
        self._drain()

    def _drain(self) -> None:
        """Post due events, oldest first, until none is left or this turn's
        `EVENTS_A_TURN` are used up, and schedule `_refill` for the next turn.

        Events of subscriptions that have ended are dropped and do not count. Of topics
        with a history the last number posted to the listener is noted.
        """
        # One allowance for all that is published in a turn, by whomever: a burst of hundreds of
        # events lets requests through after each few.
        while self._due_events and self._room:
            listener, subscription, new = self._due_events.popleft()
            # By identity: who has subscribed anew meanwhile gets no event in the earlier view.
            if self._listeners.get(new.topic, {}).get(listener) is subscription:
                listener.post(new.prepared(subscription.view), new.slot)
                if new.topic in self._kept:
                    self._last_sent[listener, new.topic] = new.seq
                self._room -= 1
        # Also with nothing left to send: the next turn has a whole allowance again. In that
        # turn received bytes are served as well.
        if not self._refilling:
            self._refilling = True
            asyncio.get_running_loop().call_soon(self._refill)

    def _refill(self) -> None:
        """Allow `EVENTS_A_TURN` events in a new turn, and deliver those due."""
        self._room = EVENTS_A_TURN
        self._refilling = False
        if self._due_events:
            self._drain()
