"""Corrections: dated, named and never edited, each a JSON file under DATA/corrections.

The one in force is part of the state: its name, None for nominal. Those before it, for
`revert`, are the names in DATA/corrections/history, in the order in which they were put
in force; where the two disagree (a kill between their writing), the state is right. A
damaged file is set aside; if it was in force, no correction is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Literal

from pydantic import Field, TypeAdapter

from flexdt.protocol.fields import ShortText
from flexdt.protocol.methods import document_messages as p
from flexdt.protocol.rpc_errors import invalid_params, problem
from flexdt.runtime.files import own_documents as documents
from flexdt.runtime.files.directory import Directory
from flexdt.server.storage.scene_document import correction_fields, correction_of
from flexdt.twin.dataset.dataset_errors import DiskFullError
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.offsets import Offsets, require_plausible
from flexdt.twin.scanner.state import NamedCorrection

MAX_HISTORY = 1000
"""Number of corrections through which `revert` can go back."""

History = list[str | None]
HISTORY = "history"
"""File name of the history: a JSON list of names, null for nominal."""
_HISTORY_TYPE: TypeAdapter[History] = TypeAdapter(History)


class CorrectionFile(p.CorrectionPart):
    """A correction as a document."""

    schema_version: Literal[1] = Field(alias="schema")
    source: ShortText | None = None


class Corrections:
    """All corrections of one data directory.

    Args:
        folder: where they are kept; made when the first is stored.
        in_force: the name in force by the state, None for nominal; earlier servers had
            the complete history there.
        most: corrections there may be.
    """

    def __init__(
        self, folder: Directory, in_force: Sequence[str | None] = (), most: int = 10_000
    ) -> None:
        """Read the corrections and their history from a folder; unreadable files are set
        aside, logged.

        A lost correction that was in force is named in `lost`, and none is in force then.

        Args:
            folder: of the corrections.
            in_force: of the state: a whole history, which replaces the file's, or the one
                name in force, which is joined to it.
            most: number of corrections that may be stored.
        """
        self._folder = folder
        self._most = most
        self._all: dict[str, NamedCorrection] = {}
        self._sources: dict[str, str | None] = {}
        self._files: dict[str, str] = {}
        """Name of a correction -> its file."""
        for file in documents.ours(folder):
            without = "a correction cannot be read; without it"
            found = documents.read_or_set_aside(folder, file, _read, without)
            if found is not None:
                self.know(*found)
                self._files.setdefault(found[0].name, file)
        without = "the history of corrections cannot be read; without it"
        before = documents.read_or_set_aside(folder, HISTORY, _read_history, without)
        known = _joined(before or [], list(in_force))
        self.filed = before is not None or len(known) < 2
        """Whether the history has a file; without one it is part of the state."""
        self.lost: str | None = None
        """Name of a correction that was in force and has been lost."""
        if known and known[-1] is not None and known[-1] not in self._all:
            self.lost = known[-1]
            known.append(None)
        self._written: History | None = None
        """History that was written last."""
        self._history: History = [
            name for name in known if name is None or name in self._all
        ]

    @property
    def history(self) -> History:
        """Names in the order in which they were put in force; None is nominal."""
        return self._history

    @history.setter
    def history(self, names: History) -> None:
        self._history = names
        self.filed = self.filed or self._written == names

    def all(self) -> list[NamedCorrection]:
        """List every correction, oldest first."""
        return sorted(self._all.values(), key=lambda c: c.date)

    def source(self, name: str) -> str | None:
        """Return the origin of the correction called `name`."""
        return self._sources.get(name)

    @property
    def in_force(self) -> NamedCorrection | None:
        """The correction in force."""
        return self.last(self.history)

    def last(self, history: History) -> NamedCorrection | None:
        """Return the correction in force after `history`; None if that is empty or ends with
        none."""
        name = history[-1] if history else None
        return None if name is None else self._all[name]

    def get(self, name: str) -> NamedCorrection:
        """Look up the correction called `name`.

        It need not be in force.
        Raises UnknownNameError: lists the names there are.
        """
        if name not in self._all:
            none = "" if self._all else "none"
            problem = f"no correction called {name!r}; there are"
            raise UnknownNameError.among(problem, name, self._all, none)
        return self._all[name]

    def make(
        self,
        values: Mapping[str, float],
        name: str | None,
        note: str,
        when: datetime | None = None,
        *,
        sides_known: bool = False,
    ) -> NamedCorrection:
        """Make a correction from edge values [mm, deg], or return the known one; nothing
        is stored yet.

        Parameters that are left out are nominal. A known name with the same values
        returns the known correction with its own note, date and `sides_known`.

        Args:
            values: parameter -> value [mm, deg].
            name: of the correction; None: "correction-DATE-N".
            note: for people.
            when: its date; None: now.
            sides_known: see `NamedCorrection`.

        Raises:
            UnknownNameError: a name that is not a parameter.
            RpcError: -32602, the name is taken by other values; corrections are never
                edited.
            LimitError: there are as many as may be.
        """
        date = (when or datetime.now(UTC)).isoformat(timespec="milliseconds")
        parameters = Offsets.from_edge(values)
        if name is not None:
            chosen = name
        else:
            chosen = self._free_name(date)
        if chosen in self._all and self._all[chosen].parameters != parameters:
            raise invalid_params(
                f"a correction called {chosen!r} exists and corrections are never edited",
                [problem("name", "taken", chosen)],
                "another name",
            )
        if chosen not in self._all and len(self._all) >= self._most:
            raise LimitError(
                f"there are {len(self._all)} corrections, {self._most} allowed; "
                "calibration.delete makes room",
                {"asked": len(self._all) + 1, "allowed": self._most},
            )
        return self._all.get(chosen) or NamedCorrection(
            chosen, date, parameters, note, sides_known=sides_known
        )

    def after(self, correction: NamedCorrection | None) -> History:
        """Return the history once `correction` (None: none) is in force; changes nothing.

        Only the last `MAX_HISTORY` names stay.
        """
        name = None
        if correction is not None:
            name = correction.name
        if name is None and self.in_force is None:
            return self.history
        return [*self.history, name][-MAX_HISTORY:]

    def store(
        self, changes: documents.Changes, correction: NamedCorrection, source: str | None
    ) -> None:
        """Add the file of a new correction to `changes`; nothing for a known name.

        `get` and `all` do not have it before `know`. `source`: of the correction. Raises
        DatasetWriteError.
        """
        if correction.name in self._all:
            return
        document = CorrectionFile(
            schema=1, source=source, **correction_fields(correction)
        )
        name = _file(correction)
        changes.put_json(self._folder, name, document.model_dump(by_alias=True))

    def know(self, correction: NamedCorrection, source: str | None) -> None:
        """Register a correction and its origin, unless it is known."""
        if correction.name not in self._all:
            self._all[correction.name] = correction
            self._sources[correction.name] = source

    def in_state(self, history: History) -> History:
        """Return what the state has of a history: what is in force, or all without a file."""
        return history[-1:] if self.filed else history

    def store_history(self, changes: documents.Changes, history: History) -> None:
        """Write the history; on a full disk it stays, which costs steps of `revert`.
        Raises DatasetWriteError: the system cannot write.
        """
        with suppress(DiskFullError):
            changes.put(self._folder, HISTORY, json.dumps(history).encode())
            self._written = history

    def without(self, name: str) -> History:
        """Return the history without any entry of the correction called `name`; nothing
        is changed here.

        Raises:
            UnknownNameError: there is no such correction.
            LimitError: it is in force.
        """
        correction = self.get(name)
        if correction is self.in_force:
            raise LimitError(
                f"the correction {name!r} is in force and cannot be deleted",
                {
                    "asked": name,
                    "allowed": "calibration.apply or calibration.revert first",
                },
            )
        return [known for known in self.history if known != name]

    def remove(self, changes: documents.Changes, name: str) -> None:
        """Delete a correction's file, among other changes."""
        changes.remove(self._folder, self._files.get(name) or _file(self._all[name]))

    def forget(self, name: str, history: History) -> None:
        """Remove a known correction from memory; `remove` deletes its file."""
        del self._all[name]
        self._sources.pop(name, None)
        self._files.pop(name, None)
        self.history = history

    def _free_name(self, date: str) -> str:
        """Find an unused name "correction-YYYY-MM-DD-N" for a correction of this date
        (ISO 8601).

        N begins after the number of corrections of that day.
        """
        base = f"correction-{date[:10]}"
        taken = sum(name.startswith(base) for name in self._all)
        while (name := f"{base}-{taken + 1}") in self._all:
            taken += 1
        return name


def _file(correction: NamedCorrection) -> str:
    """Return the file name of a correction: its date to the second, and its encoded name."""
    stamp = correction.date.split(".")[0].replace(":", "")
    return f"{stamp} {documents.file_stem(correction.name)}.json"


def _joined(before: History, in_force: History) -> History:
    """Join the history of the file with that of the state, the last name in force.

    A single name cuts the file's after its last place there, or is appended; none or
    several replace it.
    """
    if len(in_force) != 1:
        return in_force
    [name] = in_force
    places = [i for i, known in enumerate(before) if known == name]
    if places:
        return before[: places[-1] + 1]
    return [*before, name]


def _read_history(data: bytes) -> History:
    """Parse the history, strictly; its last `MAX_HISTORY` names."""
    return _HISTORY_TYPE.validate_python(documents.read_json(data), strict=True)[
        -MAX_HISTORY:
    ]


def _read(data: bytes) -> tuple[NamedCorrection, str | None]:
    """Parse a correction and its origin (or None), and check that it is plausible, whatever the
    length of its shifts.

    Raises ValueError, TwinError: no correction, or an implausible one."""
    document = CorrectionFile.model_validate(documents.read_json(data))
    correction = correction_of(document)
    require_plausible(correction.parameters, math.inf)
    return correction, document.source
