"""`flexdt evidence`: what flexdt makes of real, public data, beside what was published of them."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

from flexdt.extending import Answer, CommandError, argument, option, table


def evidence(
    names: list[str] | None = argument(None, "[NAME...]"),
    data: Path = option(Path(), "Look for the data below this folder.", metavar="DIR"),
) -> Answer:
    """Compare real, public data with their published answers.

    NAME: cate, htc2022, tooth, zeiss, carm, delft; all that are at hand where none is given.
    The data are not part of flexdt: each case says where they come from.
    """
    from flexdt_extensions.evidence.real_data import CASES

    unknown = sorted(set(names or ()) - set(CASES))
    if unknown:
        raise CommandError(f"no data {', '.join(unknown)}; allowed: {', '.join(CASES)}")
    document: list[dict[str, Any]] = []
    for name in names or CASES:
        case = CASES[name]
        files = sorted(data.glob(case.files))
        if names and not files:
            raise CommandError(f"{name}: no {case.files} in {data}; the data: {case.source}")
        try:
            figures = [asdict(figure) for figure in (case.compare(files) if files else ())]
        except (LookupError, OSError, UnpicklingError, ValueError) as error:
            raise CommandError(f"{name}: cannot read {case.files} in {data}: {error}") from None
        document.append({"name": name, "source": case.source, "licence": case.licence})
        document[-1]["figures"] = figures
    yield {"cases": document}
    for told in document:
        yield f"{told['name']}: {told['source']}, {told['licence']}"
        if not told["figures"]:
            yield f"  not at hand in {data}"
            continue
        rows = [[*list(f.values())[:3], "yes" if f["agrees"] else "NO"] for f in told["figures"]]
        yield table(rows, ("what", "published", "ours", "agrees"))
    missed = sum(not f["agrees"] for told in document for f in told["figures"])
    if missed:
        raise CommandError(f"{missed} figures miss what was published")
