"""The fair queue and the volume store by themselves."""

from __future__ import annotations

import threading
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.protocol import RpcError
from flexdt.protocol.projector import VoxelGrid
from flexdt.server.projector.compute import FairQueue
from flexdt.server.projector.volumes import SOLID_BYTES, VolumeStore
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere


@given(st.lists(st.tuples(st.integers(0, 4), st.integers()), max_size=60))
def test_lanes_take_turns_and_keep_their_order(tasks: list[tuple[int, int]]) -> None:
    queue: FairQueue[tuple[int, int]] = FairQueue()
    for lane, value in tasks:
        queue.put(lane, (lane, value))
    assert len(queue) == len(tasks)
    taken = []
    for _ in tasks:
        task = queue.take()
        assert task is not None
        taken.append(task)
    for lane in range(5):
        assert [t for t in taken if t[0] == lane] == [t for t in tasks if t[0] == lane]
    # As long as a lane has work, it is served once in every round of the others.
    left = Counter(lane for lane, _ in tasks)
    round_: set[int] = set()
    for lane, _ in taken:
        if lane in round_:
            assert not [other for other, n in left.items() if n and other not in round_]
            round_ = set()
        round_.add(lane)
        left[lane] -= 1


def test_a_task_put_back_to_the_front_is_next_in_its_lane_but_not_in_the_queue() -> None:
    queue: FairQueue[str] = FairQueue()
    queue.put("scan", "scan 1")
    queue.put("scan", "later")
    queue.put("single", "single")
    assert queue.take() == "scan 1"
    queue.put("scan", "scan 2", front=True)
    assert [queue.take() for _ in range(3)] == ["single", "scan 2", "later"]


def test_a_lane_that_is_not_ready_does_not_hold_up_the_others() -> None:
    blocked = {"slow"}
    queue: FairQueue[str] = FairQueue(lambda lane: lane not in blocked)
    queue.put("slow", "a")
    queue.put("quick", "b")
    assert queue.take() == "b"
    got: list[str | None] = []
    taker = threading.Thread(target=lambda: got.append(queue.take()))
    taker.start()
    blocked.clear()
    queue.wake()
    taker.join(5)
    assert got == ["a"]


def test_removing_and_closing() -> None:
    queue: FairQueue[int] = FairQueue()
    for i in range(6):
        queue.put(i % 2, i)
    assert sorted(queue.remove(lambda task: task > 2)) == [3, 4, 5]
    assert len(queue) == 3
    queue.close()
    assert queue.take() is None


GRID = VoxelGrid(shape=(2, 3, 4), voxel_mm=(1.0, 1.0, 1.0))
DATA = np.arange(24, dtype=np.float32)


def chunk(start: int, end: int) -> memoryview:
    return memoryview(DATA[start:end].tobytes())


def test_chunks_make_a_volume_in_order_only() -> None:
    store = VolumeStore(10_000)
    assert store.chunk("me", "v", GRID, 0, chunk(0, 10)) == (40, None)
    assert store.used == 2 * 96
    with pytest.raises(RpcError, match="expected 40"):
        store.chunk("me", "v", GRID, 44, chunk(11, 12))
    with pytest.raises(RpcError, match="expected 0"):
        store.chunk("you", "v", GRID, 40, chunk(10, 24))
    received, made = store.chunk("me", "v", GRID, 40, chunk(10, 24))
    assert received == 96
    assert made is not None
    volume = made()
    assert isinstance(volume, Volume)
    assert np.array_equal(volume.data, DATA.reshape(2, 3, 4))
    with pytest.raises(RpcError, match="expected 96"):
        store.chunk("me", "w", GRID, 0, memoryview(bytes(100)))


def test_starting_again_forgets_what_had_come() -> None:
    store = VolumeStore(10_000)
    store.chunk("me", "v", GRID, 0, chunk(0, 10))
    store.chunk("me", "v", GRID, 0, chunk(0, 5))
    assert store.used == 2 * 96
    store.forget("me")
    assert store.used == 0


def test_a_namesake_is_replaced_within_the_limit() -> None:
    volume = Volume(DATA.reshape(2, 3, 4), 1.0)
    store = VolumeStore(300)
    store.put("v", volume)
    store.put("v", volume)  # 192 bytes again, in place of the first
    with pytest.raises(RpcError) as caught:
        store.put("w", volume)
    assert caught.value.code == -32008
    assert caught.value.data == {  # says what is left
        "what": "volume 'w'",
        "asked": 192,
        "allowed": 108,
        "unit": "bytes",
        "memory_used": 192,
        "memory_limit": 300,
    }
    with pytest.raises(RpcError):  # both are needed while the new one comes
        store.chunk("me", "v", GRID, 0, chunk(0, 1))
    assert store.remove("v")
    assert not store.remove("v")


def test_scenes_count_too() -> None:
    ball = Solid(Sphere((0.0, 0.0, 0.0), 1.0), "steel", 0.5)
    store = VolumeStore(3 * SOLID_BYTES)
    store.put("s", Scene((ball,) * 3))
    assert store.used == 3 * SOLID_BYTES
    with pytest.raises(RpcError, match="too large"):
        store.put("t", Scene((ball,)))
    assert [v.solids for v in store.describe()] == [3]
