"""Small changes to the core that a test must notice: `python tests/studies/mutations.py`.

A mutant is one change of one operator, comparison, condition, constant or sign in one module. Each
runs in a temporary copy of the code against the tests named for its module in `TESTS`; it is killed
when a test fails or the run takes too long, and it survives otherwise. Survivors are printed with
their place, as are those that `mutants_equivalent.toml` explains as equivalent. The draw follows
from the seed and the code. Exit code 1 when fewer than 95 % of the others are killed.
Options: --count N, --seed N, --jobs N, --under PATH..., --list, --timeout S.
"""

from __future__ import annotations

import argparse
import ast
import copy
import itertools
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).parents[2]
PACKAGES = ("protocol", "twin", "phantoms", "server", "clients", "flexdt")
EQUIVALENT = Path(__file__).with_name("mutants_equivalent.toml")
WANTED = 0.95

T, S = "tests/twin", "tests/twin/script"
SCRIPT_TESTS = (
    f"{S}/test_script_reading.py", f"{S}/test_script_planning.py", f"{S}/test_script_fly.py",
    f"{S}/test_script_checking.py", f"{T}/test_values.py", f"{T}/test_script_compose.py",
    f"{S}/test_script_examples.py", f"{S}/test_executed_log.py", f"{S}/test_timing_ranges.py",
)  # fmt: skip
TESTS: dict[str, tuple[str, ...]] = {
    "protocol/acquila.py": ("tests/protocol/test_acquila.py",),
    "protocol": ("tests/protocol",),
    "twin/geometry": (
        f"{T}/test_frames.py", f"{T}/test_frames_off_centre.py", f"{T}/test_frames_astra.py",
        f"{T}/test_geometry_values.py", f"{T}/test_values.py", f"{T}/test_machine.py",
        f"{T}/exchange/test_exchange_refusals.py", f"{T}/calibration/test_calibration_model.py",
        f"{T}/projection/test_projection_hard.py",
    ),
    "twin/machine": (
        f"{T}/test_machine.py", f"{T}/test_frames.py", f"{T}/test_frames_off_centre.py",
        f"{S}/test_script_checking.py", f"{T}/test_scanner_motion.py",
    ),
    "twin/motion": (
        f"{T}/test_braking.py", f"{T}/test_scanner_motion.py", f"{T}/test_motion_properties.py",
        f"{T}/test_joining.py", f"{T}/test_scanner_safety.py", f"{T}/test_motion_oracle.py",
    ),
    "twin/script/compose.py": (f"{T}/test_script_compose.py", f"{S}/test_script_examples.py"),
    "twin/script": SCRIPT_TESTS,
    "twin/dataset": (
        "tests/dataset/test_dataset_texts.py", "tests/dataset/test_dataset_reader.py",
        "tests/dataset/test_dataset_writer.py", "tests/dataset/test_dataset_independent.py",
        f"{T}/test_values.py",
    ),
    "twin/collision": (
        f"{T}/test_collision_sweep.py", f"{T}/test_collision_scene.py",
        f"{T}/test_collision_machine.py", f"{T}/test_collision_use.py",
        f"{S}/test_script_checking.py", f"{T}/test_scanner_safety.py",
    ),
}  # fmt: skip
"""Module or folder -> the tests that cover it, the quickest first; the longest match counts."""

SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
REVERSED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any", "sin": "cos", "cos": "sin"}
SKIPPED = (ast.JoinedStr, ast.Assert, ast.Import, ast.ImportFrom)
"""Texts for people and what only the type checker needs."""


@dataclass(frozen=True)
class Mutant:
    """One change: the `choice`-th one of the `node`-th node of a file."""

    file: str
    node: int
    choice: int
    line: int
    function: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line} ({self.function}): {self.before}  ->  {self.after}"


def variants(node: ast.AST) -> list[ast.AST]:
    """What a node may become."""
    out: list[ast.AST] = []

    def changed(**values: object) -> None:
        other = copy.copy(node)
        for name, value in values.items():
            setattr(other, name, value)
        out.append(other)

    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) | ast.AugAssign(op=op) if type(op) in SWAPS:
            changed(op=SWAPS[type(op)]())
        case ast.Compare(ops=[op]):
            for table in (SWAPS, REVERSED):
                if type(op) in table:
                    changed(ops=[table[type(op)]()])
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            out.append(operand)
        case ast.Constant(value=bool(value)):
            changed(value=not value)
        case ast.Constant(value=int(value)):
            changed(value=value + 1)
        case ast.Constant(value=float(value)):
            changed(value=1.0 if value == 0.0 else value * 1.25)
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            changed(test=ast.UnaryOp(ast.Not(), test))
        case ast.Call(func=ast.Name(id="abs"), args=[operand]):
            out.append(operand)
        case ast.Call(func=ast.Name(id=name)) if name in NAMES:
            changed(func=ast.Name(NAMES[name], ast.Load()))
        case ast.Call(func=ast.Attribute(value=owner, attr=name)) if name in NAMES:
            changed(func=ast.Attribute(owner, NAMES[name], ast.Load()))
    return out


def places(tree: ast.AST, function: str = "module") -> Iterator[tuple[ast.AST, str, ast.AST, str]]:
    """Every expression and statement that runs: (parent, field, node, function), in order."""
    for field, value in ast.iter_fields(tree):
        if field in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for node in value if isinstance(value, list) else [value]:
            if not isinstance(node, ast.AST) or isinstance(node, SKIPPED):
                continue
            inner = function
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                inner = node.name if function == "module" else f"{function}.{node.name}"
            if isinstance(tree, ast.Assign | ast.AnnAssign) and _is_type(tree):
                continue
            yield tree, field, node, inner
            yield from places(node, inner)


def _is_type(statement: ast.Assign | ast.AnnAssign) -> bool:
    """Whether a statement names a type, as in `A = B | None`."""
    value = statement.value
    return isinstance(value, ast.BinOp | ast.Subscript) and all(
        isinstance(n, ast.Name | ast.Attribute | ast.Subscript | ast.BinOp | ast.BitOr | ast.Load
                   | ast.Tuple | ast.Constant)
        and not (isinstance(n, ast.Name) and not (n.id[:1].isupper() or n.id in ("type", "str",
                 "int", "float", "bool", "tuple", "list", "dict", "slice", "npt", "np", "bytes")))
        for n in ast.walk(value)
    )  # fmt: skip


def mutants_of(file: str) -> list[Mutant]:
    """All mutants of a file, in order."""
    found = []
    for index, (_, _, node, function) in enumerate(places(ast.parse((ROOT / file).read_text()))):
        for choice, other in enumerate(variants(node)):
            before, after = (_short(n) for n in (node, other))
            line = getattr(node, "lineno", 0)
            found.append(Mutant(file, index, choice, line, function, before, after))
    return found


def _short(node: ast.AST) -> str:
    shown = node.test if isinstance(node, ast.If | ast.While) else node
    return " ".join(ast.unparse(shown).split())


def mutated(mutant: Mutant, text: bytes) -> str:
    """The text of the mutant's file, made from the original one."""
    tree = ast.parse(text)
    parent, field, node, _ = next(itertools.islice(places(tree), mutant.node, None))
    other = variants(node)[mutant.choice]
    value = getattr(parent, field)
    if isinstance(value, list):
        value[next(i for i, n in enumerate(value) if n is node)] = other
    else:
        setattr(parent, field, other)
    return ast.unparse(ast.fix_missing_locations(tree))


def tests_of(file: str) -> tuple[str, ...]:
    """The tests that cover a file."""
    best = max((p for p in TESTS if file == p or file.startswith(f"{p}/")), key=len)
    return TESTS[best]


class Copy:
    """A copy of the code in which one mutant at a time runs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in (*PACKAGES, "tests", "examples"):
            shutil.copytree(ROOT / name, folder / name)
        shutil.copy2(ROOT / "pyproject.toml", folder)
        for name in PACKAGES[
            :-1
        ]:  # one package, as the wheel has it; it comes before the installed
            (folder / "flexdt" / name).symlink_to(folder / name)
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        used = subprocess.run(
            [sys.executable, "-c", "import flexdt.twin; print(flexdt.twin.__file__)"],
            cwd=folder, env=self.environment, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        if not used.startswith(str(folder)):
            raise RuntimeError(f"the tests would import {used.strip()}, not the copy")

    def run(self, tests: Sequence[str], timeout: float) -> str:
        """ "killed", "timeout" or "survived"."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider",
                   "-k", "not linear_time", *tests]  # fmt: skip
        try:
            done = subprocess.run(
                command, cwd=self.folder, env=self.environment, timeout=timeout,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return "timeout"
        return "killed" if done.returncode else "survived"

    def judge(self, mutant: Mutant, timeout: float) -> str:
        """What becomes of a mutant."""
        path = self.folder / mutant.file
        original, times = path.read_bytes(), path.stat()
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()
        path.write_text(mutated(mutant, original))
        try:
            return self.run(tests_of(mutant.file), timeout)
        finally:
            path.write_bytes(original)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def equivalents() -> dict[tuple[str, str, str, str], str]:
    """(file, function, before, after) -> why no test can tell."""
    table = tomllib.loads(EQUIVALENT.read_text())["mutant"]
    return {(m["file"], m["function"], m["before"], m["after"]): m["why"] for m in table}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=14)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--timeout", type=float, default=300.0, help="of one mutant [s]")
    parser.add_argument("--under", nargs="*", default=[p for p in TESTS if "." not in p])
    parser.add_argument("--trust", action="store_true", help="skip the run without any change")
    parser.add_argument("--list", action="store_true", help="print the draw, run nothing")
    options = parser.parse_args()
    files = sorted(
        {
            str(path.relative_to(ROOT))
            for under in options.under
            for path in ([ROOT / under] if under.endswith(".py") else (ROOT / under).rglob("*.py"))
        }
    )
    everything = [m for file in files for m in mutants_of(file)]
    count = min(options.count, len(everything))
    drawn = random.Random(options.seed).sample(everything, count)
    print(f"{count} of {len(everything)} mutants in {len(files)} files, seed {options.seed}")
    if options.list:
        print("\n".join(str(m) for m in drawn))
        return 0
    known = equivalents()
    fates: dict[Mutant, str] = {}
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="flexdt-mutants-") as folder:
        copies: SimpleQueue[Copy] = SimpleQueue()
        for i in range(options.jobs):
            copies.put(Copy(Path(folder) / str(i)))
        first = copies.get()
        for tests in [] if options.trust else sorted({tests_of(m.file) for m in drawn}):
            if first.run(tests, 10 * options.timeout) != "survived":
                print(f"the tests fail without any change: {' '.join(tests)}")
                return 1
        copies.put(first)

        def judge(mutant: Mutant) -> None:
            place = copies.get()
            try:
                fates[mutant] = place.judge(mutant, options.timeout)
            finally:
                copies.put(place)
            if fates[mutant] == "survived":
                why = known.get((mutant.file, mutant.function, mutant.before, mutant.after))
                fates[mutant] = "survived" if why is None else "equivalent"
                print(f"{fates[mutant]}: {mutant}", f"({why})" if why else "", flush=True)

        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(judge, drawn))
    totals = {f: sum(v == f for v in fates.values())
              for f in ("killed", "timeout", "equivalent", "survived")}  # fmt: skip
    share = (totals["killed"] + totals["timeout"]) / max(1, count - totals["equivalent"])
    print(", ".join(f"{n} {fate}" for fate, n in totals.items()), end="; ")
    print(f"{100 * share:.1f} % of those that differ killed in {time.monotonic() - begun:.0f} s")
    return 0 if share >= WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
