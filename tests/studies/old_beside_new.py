"""The benchmark's cases in two states of the code, in turns: is anything slower than it was?

    python tests/studies/old_beside_new.py COMMIT --only C1,C2,FDK --rounds 3

COMMIT's files are laid out in a temporary folder and run with this environment's libraries.
Each round runs `flexdt bench` there and here, the other way round in every second one, so that
both meet the machine's good and bad moments. The table has the best time of each, in ms a view,
and their ratio. Both benchmarks must know the cases. Exit code 1 where a case takes more than
--most times as long as before (1.25; measure where nothing else runs).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
SAFE = {**os.environ, "PYTHONSAFEPATH": "1"}
"""Older code starts processes that would find the flexdt of the current folder."""
BENCH = ("-m", "flexdt.clients.cli", "bench")
FURTHER = Path("examples", "research", "further_bench.py")
FOLDERS = ("protocol", "twin", "phantoms", "runtime", "server", "clients")


@dataclass(frozen=True)
class Code:
    """A state of the code: its files, and the variables with which Python imports it."""

    files: Path
    environment: Mapping[str, str]

    @classmethod
    def of(cls, commit: str, folder: Path) -> Code:
        """Lay out the files of a commit as one package."""
        source, package = folder / "source", folder / "import" / "flexdt"
        source.mkdir()
        package.mkdir(parents=True)
        archive = subprocess.run(
            ["git", "archive", commit], cwd=ROOT, check=True, capture_output=True
        ).stdout
        subprocess.run(
            ["tar", "--extract", f"--directory={source}"], input=archive, check=True
        )
        if (source / "src").exists():  # newer states hold these links themselves
            package = source / "src" / "flexdt"
            paths = f"{package.parent}{os.pathsep}{source / 'extensions'}"
            return cls(source, {**SAFE, "PYTHONPATH": paths})
        for name in FOLDERS:
            (package / name).symlink_to(source / name)
        for file in (source / "flexdt").glob(
            "*"
        ):  # the public face, which older states have not
            (package / file.name).symlink_to(file)
        (package / "__init__.py").touch()
        paths = f"{package.parent}{os.pathsep}{source / 'extensions'}"
        return cls(source, {**SAFE, "PYTHONPATH": paths})

    def run(self, *words: str | Path) -> str:
        """What Python prints."""
        return subprocess.run(
            [sys.executable, *words],
            env=self.environment, check=True, stdout=subprocess.PIPE, text=True,
        ).stdout  # fmt: skip

    def measured(self, wanted: Sequence[str], out: Path) -> dict[str, float]:
        """Case -> ms a view: by `flexdt bench`, or by the script for what is not a case of
        it."""
        listed = {line.split()[0] for line in self.run(*BENCH, "--list").splitlines()}
        of_bench = [name for name in wanted if name in listed]
        others = [name for name in wanted if name not in listed]
        calls: list[tuple[str | Path, ...]] = []
        if of_bench:
            calls.append((*BENCH, "--only", ",".join(of_bench)))
        if others:
            calls.append((self.files / FURTHER, "--only", *others))
        found = {}
        for number, call in enumerate(calls):
            self.run(*call, "--no-peers", "--out", place := out / str(number))
            cases = json.loads((place / "bench.json").read_text())["cases"]
            found |= {case["name"]: case["ms_per_view"] for case in cases}
        return {name: found[name] for name in wanted}


def main() -> int:
    """Measure in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("commit")
    parser.add_argument("--only", default="C1,C2,C3,C1-tilt,C1x36,C2x10,adjoint-C1,FDK")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--most", type=float, default=1.25)
    chosen = parser.parse_args()
    wanted, slow = chosen.only.split(","), []
    with tempfile.TemporaryDirectory(prefix="flexdt-old-") as name:
        codes = {"old": Code.of(chosen.commit, Path(name)), "new": Code(ROOT, SAFE)}
        best: dict[str, dict[str, float]] = {side: {} for side in codes}
        for turn in range(chosen.rounds):
            for side in sorted(codes, reverse=turn % 2 == 0):
                for case, ms in (
                    codes[side].measured(wanted, Path(name) / f"{side}-{turn}").items()
                ):
                    best[side][case] = min(ms, best[side].get(case, ms))
        print(f"{'case':20} {'old ms':>10} {'new ms':>10} {'new / old':>10}")
        for case, old in best["old"].items():
            new = best["new"][case]
            print(f"{case:20} {old:10.2f} {new:10.2f} {new / old:10.2f}")
            slow += [case] if new > chosen.most * old else []
    print(f"slower than {chosen.most:g} times: {', '.join(slow) or 'none'}")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
