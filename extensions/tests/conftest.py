"""What every test of the extensions may rely on; see `tests/support/suite.py`."""

from suite import (
    data_dir,
    pytest_collection_modifyitems,
    pytest_make_collect_report,
    pytest_runtest_makereport,
    pytest_runtest_setup,
    rays,
    servers,
    shared_servers,
)

__all__ = [
    "data_dir",
    "pytest_collection_modifyitems",
    "pytest_make_collect_report",
    "pytest_runtest_makereport",
    "pytest_runtest_setup",
    "rays",
    "servers",
    "shared_servers",
]
