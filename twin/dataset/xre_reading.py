"""`data settings XRE.txt` as sections of plain texts, and as the content of `scan
settings.txt`.

Unknown keys are kept without interpretation; `enter` states all.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, assert_never

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.file_names import XRE_SETTINGS
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.dataset.scan_settings import ENTRIES, MotorLine, ScanSettings
from flexdt.twin.dataset.scan_settings_text import parse_number, parse_roi


@dataclass(frozen=True)
class XreSettings:
    """The file's content: section -> key -> text without quotes."""

    sections: Mapping[str, Mapping[str, str]]

    def text(self, section: str, key: str) -> str | None:
        """Return the text of the first entry with this section and key, in any case, that
        is not empty; None if there is none.
        """
        return next(
            (v for k, v in self._entries(section) if k.lower() == key.lower() and v), None
        )

    def number(self, section: str, key: str) -> float | None:
        """Return an entry's value as a number; None if absent or empty.

        Case does not matter. Raises DatasetFormatError: no number.
        """
        text = self.text(section, key)
        if text is None:
            return None
        try:
            return parse_number(text)
        except ValueError:
            raise _wrong(section, key, text, "a number") from None

    @property
    def settings(self) -> ScanSettings:
        """The corresponding content of `scan settings.txt`, as far as this file has it.

        Missing entries are None. Numbers of counts are rounded. `cancelled` if
        "Succeeded" is FALSE; the scan type is "smooth scan" or None. Motors have
        positions only.

        Raises:
            DatasetFormatError: a figure is not a number, or a ROI not four whole ones.
        """
        roi = self.text("Camera settings", "ROI")
        motors = {
            name: MotorLine(value)
            for name, _ in self._entries("motor positions")
            if (value := self.number("motor positions", name)) is not None
        }
        succeeded = self.text("Scan info", "Succeeded")
        values: dict[str, Any] = {}
        for field, entry in ENTRIES.items():
            if entry.xre is None:
                continue
            match entry.kind:
                case "text":
                    values[field] = self.text(*entry.xre)
                case "count":
                    number = self.number(*entry.xre)
                    values[field] = None if number is None else round(number)
                case "number" | "mm" | "minutes" | "whole minutes" | "roi":
                    values[field] = self.number(*entry.xre)
                case _:
                    assert_never(entry.kind)
        smooth = (
            self.text("Acquisition settings", "Rotation mode") or ""
        ).lower() == "smooth"
        try:
            values["roi"] = None if roi is None else parse_roi(roi)
        except ValueError:
            raise _wrong(
                "Camera settings", "ROI", str(roi), "four whole numbers"
            ) from None
        return ScanSettings(
            **values,
            motors=motors,
            cancelled=succeeded is not None and succeeded.upper() == "FALSE",
            scan_type="smooth scan" if smooth else None,
        )

    def enter(self, said: Ledger) -> None:
        """Enter every entry in a ledger, as SECTION/KEY."""
        for section, entries in self.sections.items():
            said.state_all((f"{section}/{key}", value) for key, value in entries.items())

    @property
    def one_circle(self) -> bool:
        """True if one pose and one angle rule describe the scan, or if that is not
        stated."""
        sections = self.number("Acquisition settings", "nr of sections")
        return sections is None or sections <= 1.0

    def _entries(self, section: str) -> list[tuple[str, str]]:
        """List the (key, value) entries of all sections of that name, case ignored, in
        the file's order.
        """
        return [
            entry
            for name, entries in self.sections.items()
            if name.lower() == section.lower()
            for entry in entries.items()
        ]


def _wrong(section: str, key: str, text: str, allowed: str) -> DatasetFormatError:
    """Make the error for an entry of the XRE text with a wrong value; returned, not raised."""
    problem = f"{XRE_SETTINGS}: [{section}] {key} is {text[:80]!r}"
    where = {"path": XRE_SETTINGS, "section": section, "key": key}
    return DatasetFormatError.instead(problem, text[:200], allowed, **where)


def parse_xre(text: str, file: str = XRE_SETTINGS) -> XreSettings:
    """Parse `data settings XRE.txt`; of a key given twice in a section the first counts.

    A section that occurs twice is one. Lines before the first section, and lines without
    `=` or `:`, are skipped.

    Args:
        text: its content.
        file: name for error messages.

    Raises:
        DatasetFormatError: there is no `[section]` in it.
    """
    sections: dict[str, dict[str, str]] = {}
    current: dict[str, str] | None = None
    for raw in text.splitlines():
        line = raw.strip()
        header = re.fullmatch(r"\[([^\]]+)\]", line)
        if header is not None:
            current = sections.setdefault(header[1].strip(), {})
            continue
        entry = re.fullmatch(r"([^=:]+?)\s*[=:]\s*(.*)", line)
        if current is not None and entry is not None:
            current.setdefault(entry[1], _unquoted(entry[2]))
    if not sections:
        raise DatasetFormatError(f"{file} holds no [section]", {"path": file})
    return XreSettings(sections)


def _unquoted(text: str) -> str:
    """Strip a value; remove quotes around it with their escapes, or, if unquoted,
    semicolons at its end.
    """
    value = text.strip()
    if len(value) >= 2 and value[0] == '"' and value[-1] == '"':
        return re.sub(r'\\([\\"])', r"\1", value[1:-1])
    return value.rstrip(";").strip()
