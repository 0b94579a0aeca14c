"""The journal: an E-stop that was answered is in force after a kill at any moment."""

from __future__ import annotations

import errno
import random
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from estop_histories import run_history
from simulated_disk import Disk, Fault

from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import Keep
from flexdt.runtime.files.two_slots import SLOT_BYTES, TwoSlots
from flexdt.server.storage.journal import Journal, Record
from flexdt.server.storage.memory import StateStore
from flexdt.twin.dataset.dataset_errors import DatasetWriteError


@pytest.mark.parametrize("at", range(6))
@pytest.mark.parametrize("short", [False, True])
def test_a_torn_record_leaves_the_one_before(
    tmp_path: Path, at: int, short: bool
) -> None:
    """Whatever change of the disk the power is cut at: the newest record that was
    written, or the one under way, is read.
    """
    root = tmp_path / "disk"
    root.mkdir()
    rng = random.Random(at)
    disk = Disk(root, rng)
    with disk.watched():
        with Directory(root) as folder:
            slots = TwoSlots(folder, "journal")
            slots.write(1, b"one")
            slots.write(2, b"two")
            disk.set(Fault(at, error=None, short=short))
            number = 2
            with suppress(DatasetWriteError):
                while number < 9:
                    number += 1
                    slots.write(number, bytes([number]) * rng.randint(1, 3000))
            disk.cut()
            slots.close()
        disk.on()
        disk.set(None)
        with Directory(root) as folder:
            slots = TwoSlots(folder, "journal")
            found = slots.read()
            assert found is not None
            assert found[0] in (number - 1, number)
            slots.write(100, b"next")
            again = TwoSlots(folder, "journal").read()
            assert again == (100, b"next")
            slots.close()


def test_a_write_that_fails_takes_its_own_slot_again(tmp_path: Path) -> None:
    """Otherwise a failing disk would tear both records."""
    root = tmp_path / "disk"
    root.mkdir()
    disk = Disk(root, random.Random(0))
    with disk.watched(), Directory(root) as folder:
        slots = TwoSlots(folder, "journal")
        slots.write(1, b"one")
        for number in range(2, 8):
            disk.set(
                Fault(1, errno.EIO, lasting=True)
            )  # the write goes through, its sync does not
            with pytest.raises(DatasetWriteError):
                slots.write(number, b"lost")
            data = (root / "journal").read_bytes()
            (root / "journal").write_bytes(
                data[:SLOT_BYTES] + bytes(SLOT_BYTES)
            )  # as a power cut may
        disk.set(None)
        assert TwoSlots(folder, "journal").read() == (1, b"one")
        slots.close()


def test_a_journal_that_was_removed_is_made_anew(tmp_path: Path) -> None:
    """What is written into a file without a name would be lost without a word."""
    with Directory(tmp_path) as folder:
        slots = TwoSlots(folder, "journal")
        slots.write(1, b"one")
        (tmp_path / "journal").unlink()
        slots.write(2, b"two")
        assert TwoSlots(folder, "journal").read() == (2, b"two")
        slots.write(3, b"three")
        assert TwoSlots(folder, "journal").read() == (3, b"three")
        slots.close()


def run_histories(root: Path, count: int) -> None:
    """Live the first `count` histories."""
    for seed in range(count):
        run_history(root / str(seed), seed)


@pytest.mark.daily(12)
@pytest.mark.campaign(60)
@pytest.mark.parametrize("seed", range(500))
def test_an_estop_inside_a_slow_write_survives_a_kill_at_any_moment(
    seed: int, tmp_path: Path
) -> None:
    outcome = run_history(tmp_path, seed)
    assert outcome.said_to_be_safe + outcome.unsaved > 0


def test_a_lock_shared_with_other_writes_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test's own test: the journal waits for the state's lock, as it was once."""
    put, writing = Journal._put, []

    class Shared(StateStore):
        """Tells the journal whether another write is under way."""

        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            writing.append(self)

    def waits(journal: Journal, record: Record, make: Keep | None = None) -> None:
        if writing and writing[-1]._writing.locked():
            raise OSError(errno.EAGAIN, "it waits")
        put(journal, record, make)

    monkeypatch.setattr(Journal, "_put", waits)
    monkeypatch.setattr("flexdt.server.storage.memory.StateStore", Shared)
    with pytest.raises(AssertionError):
        run_histories(tmp_path, 40)


def test_an_owed_write_that_is_not_told_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test's own test: `unsaved` is set by failures only, as it was once."""
    monkeypatch.setattr(Journal, "owed", lambda journal: None)
    with pytest.raises(AssertionError):
        run_histories(tmp_path, 40)
