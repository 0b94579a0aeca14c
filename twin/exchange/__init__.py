"""Geometry in the formats of other programs, and back: text and numbers in, text and numbers
out.

Every reader returns a `ScanGeometry` in the project's frame, every writer takes one. A geometry
that a format cannot represent is an error. `flexdt.library.datasets.exchange` reads and writes
the files.
"""

from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.exchange.geometry import (
    SAME_MM,
    ExchangeError,
    ScanGeometry,
    require_panel,
)
from flexdt.twin.exchange.geometry_tables import CTSIMU
from flexdt.twin.exchange.number_tables import cone_vec_of, read_json

__all__ = [
    "CTSIMU",
    "SAME_MM",
    "ExchangeError",
    "Ledger",
    "ScanGeometry",
    "cone_vec_of",
    "read_json",
    "require_panel",
]
