"""The table of a format: what each of its fields means, and what flexdt makes of it.

A reader states every value of a file to a `Ledger` and takes from it what it needs. What it does
not take, the table explains; what the table does not have, one warning names. So no value of a
file is passed over in silence.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Final, NoReturn

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.provenance import Part, Provenance, Stated, Use, shortened
from flexdt.twin.errors import TwinError

DECIMAL_COMMA: Final = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
"""A number as programs of some countries write it."""
GROUPED: Final = re.compile(r"[-+]?\d{1,3}(,\d{3})+")
"""A number of thousands with commas, or of thousandths with a decimal comma."""
POINT: Final = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")
SPACES: Final = re.compile(r"\s+")
SLASH: Final = re.compile(r" ?/ ?")
OFF: Final = ("", "0", "off", "no", "false", "none")
"""Values of a switch that is off."""


GEOMETRY: Final = Part.GEOMETRY
ANGLES: Final = Part.ANGLES
BEAM: Final = Part.BEAM
DARK: Final = Part.DARK
"""What a field states, for tables."""
MOST_NAMED: Final = 60
"""Unknown fields that one warning names."""


class Role(StrEnum):
    """What flexdt makes of a field."""

    USED = "used"
    NOTED = "ignored"
    """It bears on neither geometry nor images."""
    DROPPED = "not applied"
    """It bears on them and is not applied: a warning, unless its value has no effect."""
    REFUSED = "refused"
    """A scan with it is refused, unless its value has no effect."""


@dataclass(frozen=True)
class Field:
    """A field of a format.

    Attributes:
        name: as files have it, whatever its case and spaces; `*` stands for any text, `?` for
            one character.
        meaning: with the unit, as `flexdt describe` and the docs' page show it.
        role: what flexdt makes of it.
        why: what it is used for, why it is ignored, what follows from its not being applied,
            or why it is refused.
        unit: of a number; empty for none.
        neutral: values without effect, in lower case, for the last two roles; what follows
            them in brackets does not count.
        of: what of the scan it states, whose place another statement may take.
    """

    name: str
    meaning: str
    role: Role
    why: str
    unit: str = ""
    neutral: tuple[str, ...] = OFF
    of: Part = Part.NONE

    def without_effect(self, value: str) -> bool:
        """Return whether a value is one of `neutral`; numbers count as numbers."""
        plain = re.sub(r"\s*\(.*\)$", "", value.strip().strip("\"'").lower())
        if plain in self.neutral:
            return True
        number = as_number(plain)
        return any(as_number(one) == number for one in self.neutral) and not math.isnan(
            number
        )


def used(name: str, meaning: str, by: str, unit: str = "", of: Part = Part.NONE) -> Field:
    """Make a field that the reader takes; `by` says for what."""
    return Field(name, meaning, Role.USED, by, unit, of=of)


def noted(name: str, meaning: str, because: str = "no part of the geometry") -> Field:
    """Make a field that bears on neither geometry nor images."""
    return Field(name, meaning, Role.NOTED, because)


def noted_all(
    names: str,
    meaning: str,
    because: str = "no part of the geometry",
    divider: str | None = None,
    under: str = "",
) -> tuple[Field, ...]:
    """Make fields of one meaning that bear on nothing, from names with a divider."""
    return tuple(
        noted(f"{under}{name}", meaning, because) for name in names.split(divider)
    )


def dropped(
    name: str,
    meaning: str,
    consequence: str,
    unit: str = "",
    neutral: tuple[str, ...] = OFF,
    of: Part = Part.NONE,
) -> Field:
    """Make a field that is not applied, with what follows from that."""
    return Field(name, meaning, Role.DROPPED, consequence, unit, neutral, of)


def refused(
    name: str,
    meaning: str,
    because: str,
    neutral: tuple[str, ...] = OFF,
    of: Part = Part.NONE,
) -> Field:
    """Make a field that makes a scan unreadable, unless another says the same."""
    return Field(name, meaning, Role.REFUSED, because, neutral=neutral, of=of)


@dataclass(frozen=True)
class FormatTable:
    """A format, as far as files of it were seen or described.

    Attributes:
        name: of the format or its maker.
        source: where the facts come from.
        fields: in the order of the docs' page; the first that fits a name counts.
        rule: which of two statements of one thing wins, in a sentence.
        example: the call that opens a file, on the docs' page.
    """

    name: str
    source: str
    fields: tuple[Field, ...]
    rule: str
    example: str = ""

    @cached_property
    def _plain(self) -> Mapping[str, Field]:
        """Fields by plain name, the first of each."""
        plain: dict[str, Field] = {}
        for one in self.fields:
            plain.setdefault(plain_name(one.name), one)
        return plain

    @cached_property
    def _patterns(self) -> Sequence[tuple[str, Field]]:
        """Plain patterns and their fields."""
        return [(plain_name(f.name), f) for f in self.fields if {*"*?"} & {*f.name}]

    def field(self, name: str) -> Field | None:
        """Find the field of a name, whatever its case and spaces; None for an unknown one."""
        plain = plain_name(name)
        found = self._plain.get(plain)
        if found is not None:
            return found
        fits = (f for pattern, f in self._patterns if fnmatch.fnmatchcase(plain, pattern))
        return next(fits, None)


def plain_name(name: str) -> str:
    """Return a field's name in lower case, with single spaces and none about a slash."""
    text = SPACES.sub(" ", name.strip().lower())
    text = text.replace("[", "(").replace("]", ")")  # brackets mean sets in patterns
    return SLASH.sub("/", text)


def as_number(text: str) -> float:
    """Return the number that a text is, with a decimal point or comma; NaN for no number."""
    plain = text.strip()
    if DECIMAL_COMMA.fullmatch(plain):
        plain = plain.replace(",", ".", 1)
    try:
        return float(plain)
    except ValueError:
        return math.nan


def series(values: Sequence[str]) -> str:
    """Return the values of a field in all views as one: itself, or their number and ends."""
    if len(set(values)) <= 1:
        return values[0] if values else ""
    return f"{len(values)} values: {values[0]} to {values[-1]}"


@dataclass
class _Entry:
    """A value while its file is read: `use` is None until something is made of it."""

    name: str
    rule: str
    value: str
    use: Use | None = None
    consequence: str = ""
    known: bool = True


@dataclass
class Ledger:
    """The values of one file while it is read.

    Attributes:
        table: of its format.
        path: for messages.
        warnings: what a user should know, in the order in which it was found.
        error: type of the errors that it raises.
    """

    table: FormatTable
    path: str
    warnings: list[str] = field(default_factory=list)
    error: type[TwinError] = DatasetFormatError
    _entries: list[_Entry] = field(default_factory=list)
    _by_name: dict[str, list[_Entry]] = field(default_factory=dict)

    @property
    def file(self) -> str:
        """The file's name."""
        return re.split(r"[/\\]", self.path)[-1]

    def state(
        self, name: str, value: object, place: str = "", *, listed: bool = False
    ) -> None:
        """Enter a value of the file, in its order, once.

        `place`: where it stands, if that is not the field's `name`; `listed`: a list's
        member.
        """
        entry = _Entry(place or name, name, str(value))
        self._entries.append(entry)
        if listed:
            return
        self._by_name.setdefault(plain_name(name), []).append(entry)

    def state_all(self, values: Iterable[tuple[str, object]]) -> None:
        """Enter values of the file, by name."""
        for name, value in values:
            self.state(name, value)

    def shown(self, name: str, value: str) -> None:
        """Show a value that was entered before it could be read."""
        for entry in self._by_name.get(plain_name(name), ()):
            entry.value = value

    def stated(self, name: str) -> str | None:
        """Return a value without taking it; the first of several, None without one."""
        found = self._by_name.get(plain_name(name))
        return found[0].value if found else None

    def text(self, name: str, default: str | None = None) -> str:
        """Take a value as it stands.

        Args:
            name: of its field.
            default: of a missing or empty value; None makes that an error.

        Raises:
            DatasetFormatError: it is missing without default, or stated twice differently.
        """
        found = self._by_name.get(plain_name(name), [])
        values = list(dict.fromkeys(one.value.strip() for one in found))
        if len(values) > 1:
            self._refuse(name, " and ".join(values[:4]), "one value")
        if not values or not values[0]:
            if default is None:
                self._refuse(name, "missing", "a value")
            self._mark(name, Use.IGNORED, f"it is empty: {default or 'nothing'} is taken")
            return default
        self._mark(name, Use.USED, self._meaning(name))
        return values[0]

    def number(self, name: str, default: float | None = None) -> float:
        """Take a finite number, with a decimal point or comma; arguments as for `text`.

        Raises:
            DatasetFormatError: it is no such number, or as for `text`.
        """
        given = None if default is None else repr(default)
        try:
            text = self.text(name, given)
        except DatasetFormatError as error:
            said = str(error.data.get("asked", "missing"))
            self._refuse(name, said, "a number")
        value = as_number(text)
        if not math.isfinite(value):
            self._refuse(name, text[:60], "a number")
        if GROUPED.fullmatch(text) and self._has_points:
            self._refuse(
                name, text[:60], "a number without a comma, as the others have a point"
            )
        return value

    @property
    def _has_points(self) -> bool:
        """Whether a number of the file has a decimal point, so that a comma is none."""
        return any(POINT.fullmatch(one.value.strip()) for one in self._entries)

    def whole(
        self, name: str, default: int | None = None, least: int | None = None
    ) -> int:
        """Take a whole number, from `least` on; others as for `number`."""
        value = self.number(name, default)
        if not value.is_integer():
            self._refuse(name, f"{value:g}", "a whole number")
        if least is not None and value < least:
            self._refuse(name, f"{value:g}", f"{least} or more")
        return int(value)

    def switch(self, name: str, default: bool = False) -> bool:
        """Take a switch: ON, YES, TRUE and numbers but 0 are on, whatever follows them."""
        text = self.text(name, "on" if default else "off").lower()
        return re.split(r"[\s(]", text)[0] not in OFF

    def set_aside(self, name: str, consequence: str) -> None:
        """Say that a value is contradicted by one that was taken; one warning has both. `name`:
        of its field; `consequence`: both values, and which was taken."""
        self._mark(name, Use.CONTRADICTED, consequence)
        self.warnings.append(f"{self.file}: {consequence}")

    def ignore(self, name: str, because: str) -> None:
        """Ignore a value, without a warning."""
        self._mark(name, Use.IGNORED, because)

    def replaced(self, names: Iterable[str], by: str) -> None:
        """Say that values are contradicted by what the caller gave, such as "geometry="."""
        for name in names:
            self._mark(name, Use.CONTRADICTED, f"{by} takes its place")

    def give(self, parts: Collection[Part], by: str) -> None:
        """Say that the caller gave some parts of the scan, such as by "geometry=": the values
        that state them, whatever their fields, are contradicted.
        """
        for entry in self._entries:
            rule = self.table.field(entry.rule)
            if rule is not None and rule.of in parts:
                entry.use = Use.CONTRADICTED
                entry.consequence = f"{by} takes its place"

    def use(self, name: str, by: str = "") -> None:
        """Say that a value is used."""
        self._mark(name, Use.USED, by or self._meaning(name))

    def use_all(self) -> None:
        """Say that all values whose fields the reader takes by the table are used."""
        for entry in self._entries:
            rule = self.table.field(entry.rule)
            if entry.use is None and rule is not None and rule.role is Role.USED:
                entry.use = Use.USED
                entry.consequence = rule.why or rule.meaning

    def use_place(self, place: str, by: str) -> None:
        """Say that the value at a place of the file is used, whatever its field."""
        for entry in self._entries:
            if entry.name == place.strip("/"):
                entry.use = Use.USED
                entry.consequence = by

    def set_place_aside(self, place: str, consequence: str) -> None:
        """Say that the value at a place is contradicted; one warning has both."""
        for entry in self._entries:
            if entry.name == place.strip("/"):
                entry.use = Use.CONTRADICTED
                entry.consequence = consequence
        self.warnings.append(f"{self.file}: {consequence}")

    def agree(
        self,
        what: str,
        statements: Sequence[tuple[str, float | None]],
        tolerance: float,
        unit: str = "",
    ) -> float | None:
        """Choose between statements of one thing: the first that is there wins.

        Others that differ by more than the tolerance are set aside, with both values.

        Args:
            what: the thing, for people.
            statements: field and value of each, the winner first; None where it is missing.
            tolerance: largest difference of equal values, in their unit.
            unit: of the values.

        Returns:
            The value taken; None without any.
        """
        there = [(name, value) for name, value in statements if value is not None]
        if not there:
            return None
        winner, taken = there[0]
        self.use(winner)
        mark = f" {unit}" if unit else ""
        for name, value in there[1:]:
            if abs(value - taken) <= tolerance:
                self.use(name, f"{what}, as {winner} says")
                continue
            both = f"{name} says {value:.6g}{mark}, {winner} {taken:.6g}{mark}"
            self.set_aside(name, f"{what}: {both}; {winner} is taken")
        return taken

    def finish(self) -> Provenance:
        """Explain what was not taken, warn of it, and return the values with their uses.

        Raises:
            DatasetFormatError: a field that is refused has an effect.
        """
        for entry in self._entries:
            if entry.use is None:
                self._explain(entry)
        self._repeated()
        lost = [one for one in self._entries if not one.known]
        if lost:
            many = f"{len(lost)} field{'s' if len(lost) > 1 else ''} not known to flexdt"
            named = [f"{e.name} = {shortened(e.value, 30)}" for e in lost[:MOST_NAMED]]
            if len(lost) > MOST_NAMED:
                more = f"{len(lost) - MOST_NAMED} more, which data.provenance.unknown has"
                named.append(more)
            self.warnings.append(f"{self.file}: {many}, ignored: {', '.join(named)}")
        return Provenance(self._stated(one) for one in self._entries)

    def _stated(self, entry: _Entry) -> Stated:
        """Return a value with what became of it."""
        rule = self.table.field(entry.rule)
        return Stated(
            entry.name,
            entry.value,
            entry.use or Use.IGNORED,
            entry.consequence,
            self.file,
            entry.known,
            Part.NONE if rule is None else rule.of,
        )

    def _explain(self, entry: _Entry) -> None:
        """Decide by the table what becomes of a value that the reader did not take."""
        rule = self.table.field(entry.rule)
        entry.use = Use.IGNORED
        if rule is None:
            entry.known = False
            entry.consequence = "not known to flexdt"
        elif rule.role is Role.NOTED:
            entry.consequence = f"{rule.meaning}: {rule.why}"
        elif rule.role is Role.USED:
            entry.consequence = "nothing needed it"
        elif rule.without_effect(entry.value):
            entry.consequence = f"{rule.meaning}: without effect at this value"
        elif rule.role is Role.REFUSED:
            allowed = " or ".join(one or "empty" for one in rule.neutral[:3])
            self._refuse(entry.name, entry.value, f"{allowed}; {rule.why}")
        else:
            entry.consequence = f"not applied: {rule.why}"
            said = f"{entry.name} {shortened(entry.value, 40)}"
            self.warnings.append(
                f"{self.file} states {said}, which is not applied: {rule.why}"
            )

    def _repeated(self) -> None:
        """Warn of fields that are stated twice with different values and were not taken."""
        for several in self._by_name.values():
            values = list(dict.fromkeys(one.value.strip() for one in several))
            if len(values) > 1 and several[0].known:
                said = f"{several[0].name} is stated twice: {' and '.join(values[:4])}"
                taken = several[0].use is Use.USED
                end = "the first is taken" if taken else "none is used"
                self.warnings.append(f"{self.file}: {said}; {end}")
                for one in several[taken:]:
                    one.use = Use.CONTRADICTED
                    one.consequence = said

    def _meaning(self, name: str) -> str:
        """Return what a field is used for, by the table."""
        rule = self.table.field(name)
        return "" if rule is None else rule.why or rule.meaning

    def _mark(self, name: str, use: Use, consequence: str) -> None:
        """Note the use of all statements of a field."""
        for entry in self._by_name.get(plain_name(name), ()):
            entry.use = use
            entry.consequence = consequence

    def _refuse(self, name: str, said: str, allowed: str) -> NoReturn:
        """Raise the error of a field, with the file, what it says and what is allowed."""
        message = f"{self.path}: {name} is {shortened(said)}; allowed: {allowed}"
        facts = {"path": self.path, "missing": name, "asked": said}
        raise self.error(message, facts)
