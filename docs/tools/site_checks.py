"""Check what the site that `make docs` has built must show: `site_checks.py docs/_build/html`.

Sphinx fails on a warning, and says nothing of a notebook without output, of a page that was
not generated or of a figure that has other numbers than the one in the repository.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

DOCS = Path(__file__).parents[1]
NOTEBOOKS = [DOCS / "own-scanner.md"]
"""Pages that the build executes; the story is executed by a weekly job, from the wheel."""
SHOWN = {
    "_generated/wire.html": "state.get",
    "_generated/commands.html": 'id="flexdt-phantom-design"',
    "_generated/python/flexdt.twin.geometry.cone_vec.html": "project_points",
    "reference/python.html": "flexdt.twin.geometry.cone_vec.html",
    # Evidence is rendered.
    "_generated/evidence/calibration.html": 'id="coverage-of-the-joint-95-region"',
    "_generated/evidence/bench.html": "itk-rtk",
}
"""Page -> text that it holds."""


def executed(html: Path) -> Iterator[str]:
    """Faults of notebooks: a cell that is not on its page, an error, no output."""
    for notebook in NOTEBOOKS:
        name = notebook.relative_to(DOCS)
        page = (html / name.with_suffix(".html")).read_text("utf-8")
        text = notebook.read_text("utf-8")
        cells = text.count("{code-cell}") - text.count("[remove-cell]")
        shown = page.count('class="cell_input docutils container"')
        if shown != cells:
            yield f"{name}: {shown} of {cells} cells are on its page"
        if "Traceback" in page:
            yield f"{name}: an error is on its page"
        if cells and "cell_output" not in page:
            yield f"{name}: no output is on its page"


def shown(html: Path) -> Iterator[str]:
    """Pages that lack what they must hold."""
    for page, text in SHOWN.items():
        if text not in (html / page).read_text("utf-8"):
            yield f"{page}: {text!r} is not on it"


def figures(_html: Path) -> Iterator[str]:
    """Figures whose numbers are others than in the repository."""
    made = json.loads((DOCS / "_generated/figures/figures.json").read_text("utf-8"))
    kept = json.loads((DOCS / "images/made/figures.json").read_text("utf-8"))
    if [*made] != [*kept]:
        yield f"figures {', '.join(made)} are made, {', '.join(kept)} are kept"
    for name in made.keys() & kept.keys():
        if not near(made[name], kept[name]):
            yield f"figure {name}: made {made[name]}, kept {kept[name]}"


def near(made: dict[str, float], kept: dict[str, float]) -> bool:
    """Whether the numbers of a figure have the same names and agree to 5 %."""
    return made.keys() == kept.keys() and all(
        abs(made[key] - value) <= max(0.05 * abs(value), 1e-3)
        for key, value in kept.items()
    )


CHECKS: tuple[Callable[[Path], Iterator[str]], ...] = (
    executed,
    shown,
    figures,
)


def main() -> int:
    """Print the faults of a site; 1 where it has one."""
    html = Path(sys.argv[1])
    faults = [fault for check in CHECKS for fault in check(html)]
    print(*faults, sep="\n", end="\n" if faults else "")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
