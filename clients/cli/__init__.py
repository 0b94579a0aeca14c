"""The `flexdt` command: arguments in, client calls, readable text or one JSON document out.

Importing this package imports nothing heavy, so that `flexdt --help` answers at once. Each
command only hands over to a client, a pure function or a process.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line (`argv`, None: the process's arguments) and end the process
    with its exit code; see docs/command-line.md.
    """
    from flexdt.clients.cli.console import waited_for

    words = sys.argv[1:] if argv is None else list(argv)
    with waited_for(words):
        from flexdt.clients.cli.command_tree import run

        code = run(words)
    sys.exit(code)
