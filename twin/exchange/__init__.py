"""Geometry in the formats of other programs, and back: text and numbers in, text and numbers out.

Every reader returns a `ScanGeometry` in the project's frame, every writer takes one (CTSimU's takes
the poses and offsets behind it). A geometry that a format cannot represent is an error.
`flexdt.clients.datasets.exchange` reads and writes the files.
"""

from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry
from flexdt.twin.exchange.number_tables import read_json

__all__ = ["ExchangeError", "ScanGeometry", "read_json"]
