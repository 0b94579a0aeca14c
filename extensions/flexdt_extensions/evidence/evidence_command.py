"""`flexdt evidence`: flexdt's results on real, public data, compared with the
published ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexdt.extending import Answer, CommandError, argument, option, table

if TYPE_CHECKING:
    from flexdt_extensions.evidence.real_data import Case, Figure, NotRead


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
        For each case its source and license, a table of published and own figures, and what
        was not read; then all as document of --json.
    """
    from flexdt_extensions.evidence.real_data import CASES

    files = _files_at_hand(names or [], data)
    document: list[dict[str, Any]] = []
    for name, own in files.items():
        case = CASES[name]
        yield f"{name}: {case.source}, {case.licence}"
        figures, unread = _compared(case, own)
        if not own:
            yield f"  not at hand in {data}"
        if figures:
            yield table(
                [_row(one) for one in figures], ("what", "published", "ours", "agrees")
            )
        for one in unread:
            yield f"  not read: {one.what}: {one.why}"
        document.append(
            {
                "name": name,
                "source": case.source,
                "licence": case.licence,
                "figures": [asdict(figure) for figure in figures],
                "not_read": [asdict(one) for one in unread],
            }
        )
    yield {"cases": document}
    missed = sum(not f["agrees"] for told in document for f in told["figures"])
    if missed:
        raise CommandError(f"{missed} figures miss what was published")


def _files_at_hand(names: Sequence[str], data: Path) -> dict[str, list[Path]]:
    """Find the files of the named cases below a folder, or those of all cases.

    Returns:
        Case -> its files; a case that was not named may have none.

    Raises:
        CommandError: an unknown name, or a named case that is not at hand.
    """
    from flexdt_extensions.evidence.real_data import CASES

    unknown = sorted(set(names) - set(CASES))
    if unknown:
        raise CommandError(f"no data {', '.join(unknown)}; allowed: {', '.join(CASES)}")
    files = {name: sorted(data.glob(CASES[name].files)) for name in names or CASES}
    for name in names:
        if not files[name]:
            case = CASES[name]
            raise CommandError(
                f"{name}: no {case.files} in {data}; the data: {case.source}"
            )
    return files


def _compared(case: Case, files: list[Path]) -> tuple[list[Figure], list[NotRead]]:
    """Compute a case's figures from its files, and list what was not read; nothing
    without files.
    """
    from flexdt_extensions.evidence.real_data import Figure, NotRead

    told = list(case.told(files)) if files else []
    return (
        [one for one in told if isinstance(one, Figure)],
        [one for one in told if isinstance(one, NotRead)],
    )


def _row(figure: Figure) -> tuple[object, ...]:
    """Return a row of the table of figures."""
    agrees = "yes" if figure.agrees else "NO"
    return (figure.what, figure.published, figure.ours, agrees)
