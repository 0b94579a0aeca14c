"""The event hub and control, with listeners in memory."""

from __future__ import annotations

import asyncio
import itertools
import json
import random
from typing import Any

import pytest

from flexdt.protocol import Codec, Connection, Message, Prepared, RpcError
from flexdt.server.twin.core import ControlLease
from flexdt.server.twin.hub import Hub, ImageRequest
from flexdt.testing.in_process import SimulatedLoop


class Ear:
    def __init__(self) -> None:
        self.heard: list[tuple[dict[str, Any], str | None]] = []
        self._wire = Connection(Codec.JSON)

    def post(self, message: Message | Prepared, slot: str | None = None) -> None:
        self.heard.append((json.loads(self._wire.send(message))["params"], slot))

    @property
    def values(self) -> list[Any]:
        return [event["data"] for event, _ in self.heard]


def test_topics_sequence_numbers_times_and_slots() -> None:
    async def main() -> None:
        hub = Hub(lambda: 7.5)
        a, b = Ear(), Ear()
        hub.publish("state", 0)
        hub.subscribe(a, ["state", "log"])
        hub.subscribe(b, ["job"])
        hub.publish("state", 1)
        hub.publish("log", "one", slot=None)
        hub.publish("job", {"x": 1}, slot="job-1", time=3.0)
        assert [(e["topic"], e["seq"], e["time"]) for e, _ in a.heard] == [
            ("state", 1, 7.5), ("log", 0, 7.5),
        ]  # fmt: skip
        assert [slot for _, slot in a.heard] == ["state:", None]
        assert b.heard[0][1] == "job:job-1"
        assert b.heard[0][0]["time"] == 3.0
        hub.unsubscribe(a, ["state", "projection"])
        hub.drop(b)
        hub.publish("state", 2)
        hub.publish("job", {})
        assert len(a.heard) == 2
        assert len(b.heard) == 1
        assert not hub.wanted("job")

    asyncio.run(main())


def test_subscriptions_and_views_have_a_limit_and_a_refusal_changes_nothing() -> None:
    async def main() -> None:
        hub = Hub(lambda: 0.0, most=3, most_views=2)
        a, b, c = Ear(), Ear(), Ear()
        hub.subscribe(a, ["state", "projection"], view=ImageRequest("counts", 2))
        again = ImageRequest("counts", 4)  # instead, not besides
        hub.subscribe(a, ["state", "projection"], view=again)
        with pytest.raises(RpcError, match="4 subscriptions") as refused:
            hub.subscribe(b, ["state", "job"])
        assert refused.value.code == -32003
        assert refused.value.data == {"asked": 4, "allowed": 3}
        assert not hub.wanted("job")
        hub.subscribe(b, ["projection"])
        with pytest.raises(RpcError, match="4 subscriptions"):
            hub.subscribe(c, ["log"])
        hub.unsubscribe(a, ["state"])
        with pytest.raises(RpcError, match="3 different views") as refused:
            hub.subscribe(c, ["projection"], view=ImageRequest("counts", 8))
        assert refused.value.data == {"asked": 3, "allowed": 2}
        hub.subscribe(c, ["projection"], view=ImageRequest("counts", 4))
        hub.drop(b)
        hub.subscribe(c, ["projection"], view=ImageRequest("counts", 8))
        hub.publish("projection", lambda view: view.binning)
        assert (a.values, b.values, c.values) == ([4], [], [8])

    asyncio.run(main())


def test_a_rate_limit_sends_the_newest_value_of_each_slot_and_never_the_old_ones() -> (
    None
):
    async def main() -> None:
        hub = Hub(lambda: 0.0)
        slow, fast = Ear(), Ear()
        hub.subscribe(slow, ["state", "job", "log"], max_rate_hz=20.0)
        hub.subscribe(fast, ["state"])
        for i in range(100):
            hub.publish("state", i)
            hub.publish("job", f"a{i}", slot="a")
            hub.publish("job", f"b{i}", slot="b")
            hub.publish("log", i, slot=None)
        until = asyncio.get_running_loop().time() + 60.0
        while len(slow.heard) < 2 + 3 + 100 or len(fast.heard) < 100:
            assert asyncio.get_running_loop().time() < until
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.12)  # more than that never comes
        assert fast.values == list(range(100))
        heard = {t: [e["data"] for e, _ in slow.heard if e["topic"] == t]
                 for t in ("state", "job", "log")}  # fmt: skip
        assert heard["state"] == [0, 99]
        assert heard["job"] == ["a0", "a99", "b99"]
        assert heard["log"] == list(range(100))  # what is said is said

    asyncio.run(main())


@pytest.mark.parametrize("seed", range(20))
def test_numbers_of_a_topic_rise_however_slots_take_turns(seed: int) -> None:
    drawn = random.Random(seed)

    async def main() -> None:
        hub = Hub(lambda: 0.0)
        slow = Ear()
        hub.subscribe(slow, ["job"], max_rate_hz=drawn.choice([5.0, 20.0, 200.0]))
        for _ in range(200):
            hub.publish("job", None, slot=drawn.choice("abcd"))
            if drawn.random() < 0.05:
                await asyncio.sleep(drawn.uniform(0.0, 0.3))
        await asyncio.sleep(1.0)
        numbers = [event["seq"] for event, _ in slow.heard]
        assert len(numbers) > 4
        assert numbers == sorted(set(numbers))

    with asyncio.Runner(loop_factory=SimulatedLoop) as runner:
        runner.run(main())


def test_each_view_is_rendered_once_however_many_listen() -> None:
    async def main() -> None:
        hub = Hub(lambda: 0.0)
        ears = [Ear() for _ in range(6)]
        for i, ear in enumerate(ears):
            hub.subscribe(
                ear,
                ["projection"],
                view=ImageRequest("counts", 2) if i % 2 else ImageRequest(),
            )
        made: list[ImageRequest] = []

        def render(view: ImageRequest) -> object:
            made.append(view)
            return view.kind

        hub.publish("projection", render)
        await asyncio.sleep(0.05)  # events to many go out a few a turn of the loop
        assert sorted(v.kind for v in made) == ["counts", "line_integral"]
        assert [e.values for e in ears] == [["line_integral"], ["counts"]] * 3

    asyncio.run(main())


def test_control_is_taken_implicitly_given_back_and_forced() -> None:
    control = ControlLease()
    control.require("a", "axes.move")
    with pytest.raises(RpcError, match="a is the controller") as e:
        control.require("b", "session.control")
    assert e.value.code == -32003
    control.release("b")
    assert control.holder == "a"
    assert control.force("b") == "a"
    assert control.force("b") is None
    control.release("b")
    control.require("c", "session.control")
    assert control.holder == "c"


def test_kept_events_come_to_the_late_in_order_and_once() -> None:
    async def main() -> None:
        hub = Hub(lambda: 7.5, {"log": 3})
        late = Ear()
        for i in range(5):
            hub.publish("log", i, slot=None, time=float(i))
        hub.publish("job", "not kept", slot=None)
        hub.subscribe(late, ["job", "log"], max_rate_hz=1.0)
        hub.publish("log", 5, slot=None)
        await asyncio.sleep(0.01)
        hub.subscribe(late, ["log"])
        hub.unsubscribe(late, ["log"])
        hub.publish("log", 6, slot=None)
        hub.subscribe(late, ["log"])
        await asyncio.sleep(0.01)
        assert [(e["seq"], e["data"]) for e, _ in late.heard] == [
            (i, i) for i in range(2, 7)
        ]
        assert [e["time"] for e, _ in late.heard][:3] == [2.0, 3.0, 4.0]
        hub.drop(late)
        hub.subscribe(late, ["log"])
        await asyncio.sleep(0.01)
        assert late.values[-3:] == [4, 5, 6], "a connection that ended is a stranger"

    asyncio.run(main())


def test_a_rate_limit_holds_after_every_flush_and_not_only_the_first() -> None:
    loop = SimulatedLoop(random.Random(1))
    hub, times = Hub(lambda: 0.0), []

    class Timed(Ear):
        def post(self, message: Message | Prepared, slot: str | None = None) -> None:
            times.append(loop.time())
            super().post(message, slot)

    ear = Timed()

    async def main() -> None:
        hub.subscribe(ear, ["state"], max_rate_hz=10.0)
        for i in range(100):
            hub.publish("state", i)
            await asyncio.sleep(0.013)
        await asyncio.sleep(1.0)

    loop.run_until_complete(main())
    loop.close()
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert min(gaps) >= 0.1 - 1e-9
    assert max(gaps) <= 0.1 + 1e-9, "and no value waits longer than the interval"
    assert ear.values[-1] == 99


def test_a_snapshot_has_the_number_of_the_last_event_and_counts_as_none() -> None:
    async def main() -> None:
        hub, ear = Hub(lambda: 2.5), Ear()
        hub.snapshot(ear, "state", "nobody has subscribed")
        hub.subscribe(ear, ["state", "job"])
        hub.snapshot(ear, "state", "before any event")
        for i in range(3):
            hub.publish("job", i, slot=None)
        hub.snapshot(ear, "job", lambda view: view.kind, slot="j")
        hub.publish("job", "next", slot=None)
        await asyncio.sleep(0.01)
        assert [(e["topic"], e["seq"], e["data"], slot) for e, slot in ear.heard] == [
            ("state", 0, "before any event", "state:"),
            ("job", 0, 0, None),
            ("job", 1, 1, None),
            ("job", 2, 2, None),
            ("job", 2, "line_integral", "job:j"),
            ("job", 3, "next", None),
        ]
        assert hub.count("job") == 4

    asyncio.run(main())
