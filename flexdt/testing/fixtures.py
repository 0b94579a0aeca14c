"""pytest's fixture: `from flexdt.testing.fixtures import flexdt_twin` in a conftest.py.

Or `pytest_plugins = ["flexdt.testing.fixtures"]` in the one of the root folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt import testing

__all__ = ["flexdt_twin"]


@pytest.fixture
def flexdt_twin(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[testing.InProcessTwin]:
    """Provide a twin in process for each test, its data in `tmp_path`.

    Arguments come by indirect parameters, such as `{"machine": "micro_ct"}`.
    """
    with testing.twin(
        **{"data": tmp_path / "twin", **getattr(request, "param", {})}
    ) as scanner:
        yield scanner
