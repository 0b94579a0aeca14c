"""Print the tests that failed in the last run, one a line; exit with 1 if none is known.

With `--run` they are run, and nothing else. pytest's own `--last-failed` looks only below the
folders it is given by default, and runs every test there if it finds none of the failed ones.

Reads pytest's cache. Needs nothing but Python, `--run` also pytest.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

CACHE = Path(".pytest_cache/v/cache/lastfailed")


def main() -> int:
    """Print the names in `CACHE`, relative to the working folder; run them if asked."""
    failed = json.loads(CACHE.read_text(encoding="utf-8")) if CACHE.is_file() else {}
    names = sorted(failed)
    for name in names:
        print(f"  {name}", flush=True)
    if sys.argv[1:] == ["--run"] and names:
        return subprocess.run(
            [sys.executable, "-m", "pytest", *names], check=False
        ).returncode
    return 0 if failed else 1


if __name__ == "__main__":
    sys.exit(main())
