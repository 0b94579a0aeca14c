"""The journal: an E-stop that was answered is in force after a kill at any moment."""

from __future__ import annotations

import errno
import random
from contextlib import suppress
from pathlib import Path

import pytest
from simulated_disk import Disk, Fault

from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.two_slots import SLOT_BYTES, TwoSlots
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
