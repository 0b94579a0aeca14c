"""`flexdt evidence`: flexdt's results on real, public data, compared with the
published ones."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from flexdt.extending import Answer, CommandError, argument, option, table


def evidence(
    names: list[str] | None = argument(None, "[NAME...]"),
    data: Path = option(Path(), "Look for the data below this folder.", metavar="DIR"),
) -> Answer:
    """Compare real, public data with their published answers.

    NAME: cate, htc2022, tooth, zeiss, carm, delft; all that are at hand where none is
    given. The data are not part of flexdt: each case names their source. Unreadable data
    are reported, and are no missed figure. The command fails if a named case is not at
    hand, and, after all results, if a figure is missed.

    Yields:
        For each case its source and licence, a table of published and own figures, and what
        was not read; then all as document of --json.
    """
    from flexdt_extensions.evidence.real_data import CASES, Figure, NotRead

    unknown = sorted(set(names or ()) - set(CASES))
    if unknown:
        raise CommandError(f"no data {', '.join(unknown)}; allowed: {', '.join(CASES)}")
    files = {name: sorted(data.glob(CASES[name].files)) for name in names or CASES}
    for name in names or ():
        if not files[name]:
            case = CASES[name]
            raise CommandError(
                f"{name}: no {case.files} in {data}; the data: {case.source}"
            )
    document: list[dict[str, Any]] = []
    for name, own in files.items():
        case = CASES[name]
        yield f"{name}: {case.source}, {case.licence}"
        told = list(case.told(own)) if own else []
        figures = [one for one in told if isinstance(one, Figure)]
        rows = [
            (f.what, f.published, f.ours, "yes" if f.agrees else "NO") for f in figures
        ]
        if not own:
            yield f"  not at hand in {data}"
        if rows:
            yield table(rows, ("what", "published", "ours", "agrees"))
        unread = [one for one in told if isinstance(one, NotRead)]
        for one in unread:
            yield f"  not read: {one.what}: {one.why}"
        document.append({"name": name, "source": case.source, "licence": case.licence})
        document[-1]["figures"] = [asdict(figure) for figure in figures]
        document[-1]["not_read"] = [asdict(one) for one in unread]
    yield {"cases": document}
    missed = sum(not f["agrees"] for told in document for f in told["figures"])
    if missed:
        raise CommandError(f"{missed} figures miss what was published")
