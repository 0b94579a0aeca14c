"""Corrections on disk: dated, named, never edited; which one is in force, and which was before.

One JSON file a correction under DATA/corrections, and `in_force.json` with the names in the order
in which they were put in force (the last one holds; null and an empty list mean nominal). Files
appear whole or not at all. It refuses to interpret the parameters.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from flexdt.protocol.errors import invalid_params
from flexdt.server.files import file_stem, put_json
from flexdt.twin.errors import MachineFileError, TwinError, UnknownNameError
from flexdt.twin.parameters import Parameters
from flexdt.twin.state import Correction

SCHEMA = 1


class Corrections:
    """All corrections of one data directory.

    Args:
        folder: where they are kept; made when the first is stored.

    Raises:
        MachineFileError: a file in it that does not hold.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._all: dict[str, Correction] = {}
        self._sources: dict[str, str | None] = {}
        for file in sorted(folder.glob("*.json")):
            if file.name != "in_force.json":
                correction, source = _read(file)
                self._all[correction.name] = correction
                self._sources[correction.name] = source
        self._history = self._read_history()

    def all(self) -> list[Correction]:
        """Every correction, oldest first."""
        return sorted(self._all.values(), key=lambda c: c.date)

    def source(self, name: str) -> str | None:
        """What the correction called `name` came from."""
        return self._sources.get(name)

    @property
    def in_force(self) -> Correction | None:
        """The correction in force."""
        name = self._history[-1] if self._history else None
        return None if name is None else self._all[name]

    @property
    def before(self) -> Correction | None:
        """The correction that `revert` puts in force."""
        name = self._history[-2] if len(self._history) > 1 else None
        return None if name is None else self._all[name]

    def get(self, name: str) -> Correction:
        """The correction called `name`.

        Raises:
            UnknownNameError: lists the names there are.
        """
        if name not in self._all:
            raise UnknownNameError(
                f"no correction called {name!r}; there are: {', '.join(self._all) or 'none'}",
                {"asked": name, "allowed": list(self._all)},
            )
        return self._all[name]

    def make(
        self, values: Mapping[str, float], name: str | None, note: str, when: datetime | None = None
    ) -> Correction:
        """A new correction from edge values [mm, deg]; nothing is stored yet.

        Raises:
            UnknownNameError: a name that is not a parameter.
            RpcError: -32602, the name is taken; corrections are never edited.
        """
        date = (when or datetime.now(UTC)).isoformat(timespec="milliseconds")
        parameters = Parameters.from_edge(values)
        chosen = name if name is not None else self._free_name(date)
        if chosen in self._all and self._all[chosen].parameters != parameters:
            raise invalid_params(
                f"a correction called {chosen!r} exists and corrections are never edited",
                [{"path": "name", "message": "taken", "asked": chosen}],
                "another name",
            )
        return self._all.get(chosen) or Correction(chosen, date, parameters, note)

    def put_in_force(self, correction: Correction, source: str | None = None) -> None:
        """Store `correction` (once) and note that it is in force."""
        if correction.name not in self._all:
            document = {
                "schema": SCHEMA,
                "name": correction.name,
                "date": correction.date,
                "parameters": correction.parameters.to_edge(),
                "comment": correction.note,
                "source": source,
            }
            stamp = correction.date.split(".")[0].replace(":", "")
            self._write(f"{stamp} {file_stem(correction.name)}.json", document)
            self._all[correction.name] = correction
            self._sources[correction.name] = source
        self._remember([*self._history, correction.name])

    def withdraw(self) -> None:
        """From now on no correction is in force."""
        if self.in_force is not None:
            self._remember([*self._history, None])

    def revert(self) -> Correction | None:
        """Back to the correction before the one in force; None when there was none."""
        self._remember(self._history[:-1])
        return self.in_force

    def _free_name(self, date: str) -> str:
        base = f"correction-{date[:10]}"
        taken = sum(name.startswith(base) for name in self._all)
        while (name := f"{base}-{taken + 1}") in self._all:
            taken += 1
        return name

    def _remember(self, history: list[str | None]) -> None:
        self._write("in_force.json", {"schema": SCHEMA, "history": history})
        self._history = history

    def _write(self, name: str, document: object) -> None:
        put_json(self._folder, name, document)

    def _read_history(self) -> list[str | None]:
        file = self._folder / "in_force.json"
        try:
            history = json.loads(file.read_text(encoding="utf-8"))["history"]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise MachineFileError(f"{file} does not hold: {error}", {"file": str(file)}) from None
        return [name for name in history if name is None or name in self._all]


def _read(file: Path) -> tuple[Correction, str | None]:
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        source = document.get("source")
        correction = Correction(
            str(document["name"]),
            str(document["date"]),
            Parameters.from_edge({k: float(v) for k, v in document["parameters"].items()}),
            str(document.get("comment", "")),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, TwinError) as error:
        raise MachineFileError(f"{file} does not hold: {error}", {"file": str(file)}) from None
    return correction, None if source is None else str(source)
