"""The volume store by itself."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.protocol import RpcError
from flexdt.protocol.projector import VoxelGrid
from flexdt.server.projector.volume_store import SOLID_BYTES, VolumeStore
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

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
