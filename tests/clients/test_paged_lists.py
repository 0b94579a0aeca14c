"""Both clients ask for long lists in parts, and give them whole."""

from __future__ import annotations

import pytest

from flexdt.clients.client import twin_methods
from flexdt.testing import twin


def test_lists_longer_than_a_part_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(twin_methods, "PAGE", 3)
    with twin(speed_up="max") as scanner:
        client = scanner.client
        for i in range(7):
            client.wait_job(
                client.submit_trajectory(
                    [{"rot_obj": float(i)}], 100.0, f"s{i}", "max"
                ).job
            )
        assert [job.name for job in client.jobs().jobs] == [f"s{i}" for i in range(7)]
        found = client.samples()
        assert len(found.samples) == found.total
        assert len({s.name for s in found.samples}) == found.total > 3
        assert found.materials
