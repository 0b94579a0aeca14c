"""Geometry in the formats of other programs, and back: text and numbers in, text and numbers out.

Every reader gives a `ScanGeometry` in the project's frame, every writer takes one (CTSimU's takes
the poses and parameters behind it). What a format cannot carry is an error that says so. It refuses
to touch files: see `flexdt.clients.exchange`.
"""

from flexdt.twin.exchange.ctsimu import Scenario, scenario_document
from flexdt.twin.exchange.ctsimu_read import read_ctsimu
from flexdt.twin.exchange.document import geometry_text, read_geometry_text
from flexdt.twin.exchange.flexdata import flexdata_text, read_flexdata
from flexdt.twin.exchange.model import Circle, ExchangeError, ScanGeometry, circle_of, poses_of
from flexdt.twin.exchange.rtk import read_rtk, rtk_text
from flexdt.twin.exchange.tables import (
    csv_text,
    read_csv,
    read_tomosipo,
    read_vectors_array,
    read_vectors_text,
    tomosipo_arrays,
    vectors_text,
)

__all__ = [
    "Circle",
    "ExchangeError",
    "ScanGeometry",
    "Scenario",
    "circle_of",
    "csv_text",
    "flexdata_text",
    "geometry_text",
    "poses_of",
    "read_csv",
    "read_ctsimu",
    "read_flexdata",
    "read_geometry_text",
    "read_rtk",
    "read_tomosipo",
    "read_vectors_array",
    "read_vectors_text",
    "rtk_text",
    "scenario_document",
    "tomosipo_arrays",
    "vectors_text",
]
