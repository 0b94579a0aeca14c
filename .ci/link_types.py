"""Lay out the repository's folders as the two packages they install as, for static tools.

    python .ci/link_types.py [--site-packages FOLDER]

The folders of the repository are mapped to `flexdt.*` by an import hook (an editable install),
which only a running Python can follow. mypy, pyright and import-linter read folders, so
`.typing/flexdt` holds a link to each of them, and `.typing/flexdt_extensions` is one. A `.pth` file
in the environment's site-packages names `.typing`, and a user's type checker, in whatever folder it
runs, finds the packages there.
Links to folders need no update when a module is added to one.
"""

from __future__ import annotations

import argparse
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("protocol", "twin", "phantoms", "runtime", "server", "clients")
EXTENSIONS = Path("extensions", "flexdt_extensions")
PATH_FILE = "flexdt-types.pth"


def lay_out(root: Path = ROOT) -> Path:
    """Make `.typing/flexdt` hold links to the six folders and to each file of `flexdt/`.

    `.typing/flexdt_extensions` is a link to the second package.
    """
    package = root / ".typing" / "flexdt"
    package.mkdir(parents=True, exist_ok=True)
    face = (path for path in (root / "flexdt").iterdir() if path.name != "__pycache__")
    targets = {path.name: path for path in (*face, *(root / folder for folder in FOLDERS))}
    for link in package.iterdir():
        if link.is_symlink() and not (link.name in targets and link.exists()):
            link.unlink()
    for name, target in targets.items():
        link = package / name
        if not link.is_symlink():
            # Relative, so that a repository that was moved keeps its links.
            link.symlink_to(Path("..", "..") / target.relative_to(root), target.is_dir())
    second = package.parent / EXTENSIONS.name
    if (root / EXTENSIONS).is_dir() and not second.is_symlink():
        second.symlink_to(Path("..") / EXTENSIONS, target_is_directory=True)
    return package.parent


def main() -> None:
    """Lay out the links and name their folder in the environment's site-packages."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--site-packages", type=Path, default=sysconfig.get_path("purelib"))
    chosen = parser.parse_args()
    (Path(chosen.site_packages) / PATH_FILE).write_text(f"{lay_out()}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
