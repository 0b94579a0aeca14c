"""Print the tests that failed in the last run, one a line; exit with 1 if none is known.

Reads pytest's cache. Needs nothing but Python.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

CACHE = Path(".pytest_cache/v/cache/lastfailed")


def main() -> int:
    """Print the names in `CACHE`, relative to the working folder."""
    failed = json.loads(CACHE.read_text(encoding="utf-8")) if CACHE.is_file() else {}
    for name in sorted(failed):
        print(f"  {name}")
    return 0 if failed else 1


if __name__ == "__main__":
    sys.exit(main())
