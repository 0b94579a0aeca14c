"""`python -m flexdt.clients.cli`, for where the `flexdt` command is not on the path."""

from __future__ import annotations

from flexdt.clients.cli.console_script import main

if __name__ == "__main__":
    main()
