"""Data sets as plain data: the scanner's own texts, flexdt.json, and the geometry in them."""

from flexdt.twin.dataset.dataset_errors import (
    DatasetError,
    DatasetExistsError,
    DatasetFormatError,
    DatasetMissingError,
    DatasetNameError,
    DatasetWriteError,
    DiskFullError,
)
from flexdt.twin.dataset.file_names import plain_name
from flexdt.twin.dataset.flexdt_json import DatasetDocument, FrameEntry, parse_document
from flexdt.twin.dataset.record import FrameBlock, NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.dataset.scan_settings import MotorLine, ScanSettings, settings_of
from flexdt.twin.dataset.scan_settings_text import format_scan_settings, parse_scan_settings
from flexdt.twin.dataset.xre import XreSettings, format_xre, parse_xre

__all__ = [
    "DatasetDocument",
    "DatasetError",
    "DatasetExistsError",
    "DatasetFormatError",
    "DatasetMissingError",
    "DatasetNameError",
    "DatasetWriteError",
    "DiskFullError",
    "FrameBlock",
    "FrameEntry",
    "MotorLine",
    "NoiseRecord",
    "SampleRecord",
    "ScanRecord",
    "ScanSettings",
    "XreSettings",
    "format_scan_settings",
    "format_xre",
    "parse_document",
    "parse_scan_settings",
    "parse_xre",
    "plain_name",
    "settings_of",
]
