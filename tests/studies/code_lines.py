"""Code lines by folder, of flexdt, its extensions and the page: no blanks, comments,
docstrings.

    python tests/studies/code_lines.py [ROOT]

A line counts when a token other than a comment lies on it, so a call over five lines counts
five. Strings that stand alone as a statement count as documentation.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

FOLDERS = ("flexdt", "protocol", "twin", "phantoms", "runtime", "server", "clients")
EXTENSIONS = ("extensions/flexdt_extensions",)
PAGE = "clients/viewer/data"
VENDORED = "uplot.js"
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(source: str) -> int:
    """Number of lines of `source` that hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            lines.difference_update(
                range(node.lineno, (node.end_lineno or node.lineno) + 1)
            )
    return len(lines)


def script_lines(source: str) -> int:
    """Number of lines of JavaScript that are neither blank nor comment alone."""
    bare = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    return sum(
        bool(line.strip()) and not line.strip().startswith("//")
        for line in bare.split("\n")
    )


def by_folder(root: Path, folders: Sequence[str] = FOLDERS) -> dict[str, tuple[int, int]]:
    """Folder -> (modules, code lines), relative to `root`, in the order of their names."""
    modules: Counter[str] = Counter()
    lines: Counter[str] = Counter()
    for folder in folders:
        for path in (root / folder).rglob("*.py"):
            if "node_modules" in path.parts:
                continue
            name = path.parent.relative_to(root).as_posix()
            modules[name] += 1
            lines[name] += code_lines(path.read_text(encoding="utf-8"))
    return {name: (modules[name], lines[name]) for name in sorted(modules)}


def main() -> None:
    """Print modules and lines of code of each folder of a clone, and of the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    here = Path(__file__).resolve().parents[2]
    parser.add_argument("root", nargs="?", type=Path, default=here, help="another clone")
    root = parser.parse_args().root
    for what, folders in (("core", FOLDERS), ("extensions", EXTENSIONS)):
        table = by_folder(root, folders)
        for name, (modules, lines) in table.items():
            print(f"{name:44}{modules:5}{lines:8}")
        modules, lines = (sum(column) for column in zip(*table.values(), strict=True))
        print(f"{what:44}{modules:5}{lines:8}\n")
    scripts = (root / PAGE).glob("*.js")
    page = [path.read_text("utf-8") for path in scripts if path.name != VENDORED]
    print(f"{'page':44}{len(page):5}{sum(map(script_lines, page)):8}")


if __name__ == "__main__":
    main()
