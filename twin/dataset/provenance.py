"""What became of each figure that a scan's files state: used, contradicted or ignored, by name."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Final, Self

from flexdt.twin.signatures import public

VALUE_WIDTH: Final = 60
"""Characters of a value that a table shows."""


class Use(StrEnum):
    """What became of a value of a file."""

    USED = "used"
    """It is in the geometry or the images."""
    CONTRADICTED = "contradicted"
    """Another statement of the same thing, of the file or the caller, was taken."""
    IGNORED = "ignored"
    """It is in nothing."""


class Part(StrEnum):
    """What of a scan a value states, as far as a user may say it otherwise."""

    GEOMETRY = "geometry"
    """Places of source, panel and axis, and how images lie on the panel."""
    ANGLES = "angles"
    BEAM = "open beam"
    DARK = "dark"
    NONE = ""


@dataclass(frozen=True)
class Stated:
    """One value of a file.

    Attributes:
        field: where it stands, such as "AngularStep" or "entry/sample/rotation_angle".
        value: as the file has it; of an array its shape and ends.
        use: what became of it.
        consequence: what it is used for, or what its being left aside means.
        file: name of the file.
        known: whether the format's table has the field.
        of: what of the scan it states.
    """

    field: str
    value: str
    use: Use
    consequence: str
    file: str = ""
    known: bool = True
    of: Part = Part.NONE

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form of `describe --json` and saved data sets."""
        return {**asdict(self), "use": self.use.value, "of": self.of.value}

    @classmethod
    def from_dict(cls, members: Mapping[str, object]) -> Self:
        """Make it of its JSON form.

        Raises:
            ValueError: a use or a part of another name.
            KeyError: a member is missing.
        """
        return cls(
            str(members["field"]),
            str(members["value"]),
            Use(str(members["use"])),
            str(members["consequence"]),
            str(members.get("file", "")),
            bool(members.get("known", True)),
            Part(str(members.get("of", ""))),
        )


@public
class Provenance(tuple[Stated, ...]):
    """Every value of a scan's files with its use, in the order of the files; a tuple.

    Printed as a table. Empty for images and geometry that came from memory.

    Example:
        >>> from flexdt.twin.dataset.provenance import Stated, Use
        >>> said = Stated("SrcToObject", "120", Use.USED, "source to axis", "part.xtekct")
        >>> dose = Stated("Dose", "3", Use.IGNORED, "not known to flexdt", "part.xtekct", False)
        >>> Provenance([said, dose])
        field        value  use      consequence
        SrcToObject  120    used     source to axis
        Dose         3      ignored  not known to flexdt
        >>> [one.field for one in Provenance([said, dose]).unknown]
        ['Dose']
    """

    __slots__ = ()

    def of(self, use: Use | str) -> Provenance:
        """Keep the values of one use: used, contradicted or ignored."""
        return Provenance(one for one in self if one.use == Use(use))

    @property
    def unknown(self) -> Provenance:
        """Values of fields that no table has."""
        return Provenance(one for one in self if not one.known)

    def field(self, name: str) -> Provenance:
        """Keep the values of a field, by its name or the last part of it."""
        return Provenance(
            one for one in self if one.field == name or one.field.endswith(f"/{name}")
        )

    def replaced(self, parts: Collection[Part], by: str) -> Provenance:
        """Mark the values of some parts as contradicted by what the caller gave.

        `by`: such as "angles=".
        """
        return Provenance(
            replace(one, use=Use.CONTRADICTED, consequence=f"{by} takes its place")
            if one.of in parts
            else one
            for one in self
        )

    def and_also(self, more: Iterable[Stated]) -> Provenance:
        """Append values of another file."""
        return Provenance((*self, *more))

    def to_list(self) -> list[dict[str, object]]:
        """Return the JSON form."""
        return [one.to_dict() for one in self]

    @classmethod
    def from_list(cls, members: Iterable[Mapping[str, object]]) -> Provenance:
        """Make it of its JSON; raises as `Stated.from_dict`."""
        return cls(Stated.from_dict(one) for one in members)

    @property
    def rows(self) -> list[tuple[str, str, str, str]]:
        """The table's heads, and the cells of each value; a long value is cut."""
        heads = ("field", "value", "use", "consequence")
        return [
            heads,
            *((s.field, shortened(s.value), s.use.value, s.consequence) for s in self),
        ]

    @property
    def lines(self) -> list[str]:
        """The table, a line a value, with a head; [] without values."""
        if not self:
            return []
        rows = self.rows
        widths = [max(len(row[k]) for row in rows) for k in range(3)]
        texts = []
        for row in rows:
            padded = [cell.ljust(w) for cell, w in zip(row[:3], widths, strict=True)]
            texts.append("  ".join((*padded, row[3])).rstrip())
        return texts

    def __repr__(self) -> str:
        """Return the table; of an empty one a sentence."""
        return "\n".join(self.lines) or "<Provenance: no file>"


def shortened(value: str, width: int = VALUE_WIDTH) -> str:
    """Return a value in one line, cut after `width` characters."""
    text = " ".join(value.split())
    return text if len(text) <= width else f"{text[: width - 3]}..."
