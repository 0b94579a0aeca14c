"""Geometry in the formats of other programs, and back: text and numbers in, text and numbers out.

Every reader returns a `ScanGeometry` in the project's frame, every writer takes one (CTSimU's takes
the poses and offsets behind it). A geometry that a format cannot represent is an error.
`flexdt.clients.datasets.exchange` reads and writes the files.
"""

from flexdt.twin.exchange.ctsimu import Scenario, scenario_document
from flexdt.twin.exchange.ctsimu_read import read_ctsimu
from flexdt.twin.exchange.flexdata import flexdata_text, read_flexdata
from flexdt.twin.exchange.geometry import Circle, ExchangeError, ScanGeometry, circle_of, poses_of
from flexdt.twin.exchange.geometry_json import geometry_text, read_geometry_text
from flexdt.twin.exchange.number_tables import (
    csv_text,
    read_csv,
    read_tomosipo,
    read_vectors_array,
    read_vectors_text,
    tomosipo_arrays,
    vectors_text,
)
from flexdt.twin.exchange.rtk_xml import read_rtk, rtk_text

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
