"""Attacks on real processes, and what each got: `python tests/studies/attacks.py [NAME...]`.

Starts a projector and a twin, tries each attack, checks that the servers live on and that no line
of their logs is an unhandled exception, and prints a table. Exit code 1 when one got through.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
from pathlib import Path

import attack_access
import attack_bytes
import attack_files
import attack_load
import attack_scripts
from attack_ground import Ground, attacks_of
from lab import machine

THEMES = (attack_bytes, attack_load, attack_access, attack_files, attack_scripts)
ATTACKS = [each for theme in THEMES for each in attacks_of(theme)]


def main() -> int:
    wanted = sys.argv[1:]
    failed = 0
    print(f"Attacks on a twin and a projector. {machine()}.\n")
    print("| attack | got |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        g = Ground(Path(folder))
        try:
            for name, run in ATTACKS:
                if wanted and run.__name__ not in wanted:
                    continue
                try:
                    g.free()
                    got = run(g)
                    assert g.twin.alive(), "the twin has died"
                    assert g.projector.alive(), "the projector has died"
                    assert g.wire().call("session.ping")["time"] >= 0.0
                except Exception as error:
                    failed += 1
                    where = traceback.extract_tb(error.__traceback__)[-1]
                    got = f"**GOT THROUGH**: {error!r:.400} at {where.name}: {where.line}"
                print(f"| {name} | {got} |", flush=True)
        finally:
            g.close()
        bad = [
            e for p in (g.twin, g.projector) for e in p.logged("error", "critical", "unstructured")
        ]
        for entry in bad[:5]:
            print("LOG:", str(entry)[-1500:])
    tried = len(wanted) or len(ATTACKS)
    print(f"\n{tried - failed} of {tried} attacks failed; {len(bad)} unhandled exceptions logged.")
    return 1 if failed or bad else 0


if __name__ == "__main__":
    sys.exit(main())
