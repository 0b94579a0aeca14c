"""What every test may rely on; see `tests/support/suite.py`."""

from suite import data_dir, pytest_collection_modifyitems, servers

__all__ = ["data_dir", "pytest_collection_modifyitems", "servers"]
