"""On the path of a server that `faults.py writes` starts: its data directory fails as it is
told.

FLEXDT_TEST_FAULT is a JSON document: root, at, error, lasting, short (see
`simulated_disk.Fault`). The file `.NAME-failed` beside the data directory NAME tells that it
did.
"""

import json
import os
import random
import sys
from pathlib import Path

if "FLEXDT_TEST_FAULT" in os.environ:
    sys.path.append(str(Path(__file__).parents[2] / "support"))
    from simulated_disk import Disk, Fault

    class Telling(Disk):
        """Leaves a mark when it has failed."""

        def _change(self, kind, path):  # type: ignore[no-untyped-def]
            """Change as the disk does; where it fails, leave a mark beside the root and
            raise.
            """
            try:
                return super()._change(kind, path)
            except OSError:
                self.root.with_name(f".{self.root.name}-failed").touch()
                raise

    asked = json.loads(os.environ["FLEXDT_TEST_FAULT"])
    disk = Telling(Path(asked.pop("root")), random.Random(0))
    disk.set(Fault(**asked))
    watched = disk.watched()  # kept: without it the patches would go
    watched.__enter__()
