"""A few files that ask for much, by the library; all kinds and doors are a study's
(`tests/studies/bombs.py`)."""

from __future__ import annotations

import random
import resource
from collections.abc import Iterator

import pytest
from bombs_drawn import KINDS

import flexdt as fx

MOST_BYTES = 4 << 30
"""Of address space beyond what the process has."""


@pytest.fixture
def little_memory() -> Iterator[None]:
    """The process may take no more than `MOST_BYTES` of address space more."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as used:
        pages = int(used.read().split()[0])
    most = pages * resource.getpagesize() + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", sorted({*KINDS} - {"table_long", "script_long", "npz_inflated"})
)
@pytest.mark.usefixtures("little_memory")
def test_a_file_that_asks_for_much_gets_a_sentence(kind, tmp_path):
    bomb = KINDS[kind](random.Random(kind), tmp_path)
    try:
        exec(bomb.library, {"fx": fx, "P": str(bomb.path)})
    except (fx.TwinError, OSError) as error:
        said = str(error)
        assert 0 < len(said.splitlines()) <= 51
        assert len(said) < 10_000
        assert "defect" not in said
    else:
        assert bomb.harmless
