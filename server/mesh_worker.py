"""`python -m flexdt.server.mesh_worker FORMAT UNIT MATERIAL NAME`: read a stranger's mesh, apart.

Bytes of the mesh on standard input; on standard output one JSON document, the phantom or what is
wrong. It runs with limits on memory, time and files, so that a hostile file costs its sender an
error and nobody else anything. It refuses to write any file.
"""

from __future__ import annotations

import json
import sys

MEMORY_BYTES = 3 << 30
CPU_S = 120


def limit() -> None:
    """Bound what this process may use, where the system can."""
    try:
        import resource
    except ImportError:  # Windows
        return
    for what, most in (
        (resource.RLIMIT_AS, MEMORY_BYTES),
        (resource.RLIMIT_CPU, CPU_S),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(what)[1]
        value = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (value, value))


def main() -> int:
    """Read, parse, answer."""
    form, unit, material, name = sys.argv[1:5]
    limit()
    sys.dont_write_bytecode = True
    try:
        from flexdt.phantoms import mesh_phantom
        from flexdt.twin.errors import TwinError

        raw = sys.stdin.buffer.read()
        try:
            document: dict[str, object] = mesh_phantom(
                raw, unit=unit, material=material, file_type=form, name=name
            ).to_dict()
        except TwinError as error:
            kind, data = type(error).__name__, error.data
            document = {"error": kind, "message": error.message, "data": data}
        text = json.dumps(document, default=repr)
    except MemoryError:
        text = json.dumps(
            {
                "error": "PhantomError",
                "message": f"reading it takes more than {MEMORY_BYTES >> 20} MiB of memory",
                "data": {"allowed": MEMORY_BYTES},
            }
        )
    sys.stdout.write(text)
    sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
