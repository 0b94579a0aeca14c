"""Small changes to the core that a test must notice: `python tests/studies/mutations.py`.

Each mutant (see `mutants.py`) runs in a copy of the code against the tests that execute its
line, in a process forked from this one, which holds the third-party libraries but nothing of
flexdt. It is killed when a test fails or takes far too long, and it survives otherwise; so do
those whose line no test executes. Survivors are printed, as are those that
`mutants_equivalent.toml` explains as equivalent. Exit code 1 when fewer than 95 % of the others
are killed.

Which tests execute which lines is found once, with coverage.py, and again for test files that
have changed; of a source file that has changed, the tests that execute any line of it are
taken. Tests that fail without any change in the copy, and `slow` ones, do not count. Compiled
kernels cannot be traced, so files with kernels are not drawn from. Lines and fates are kept in
the folder --work: an interrupted campaign goes on where it ended, and the draw is the same
wherever the code is. Options: --count N, --seed N, --jobs N, --under PATH..., --seconds S,
--list, --again, --work DIR.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
import tomllib
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import coverage
import pytest
from mutants import Mutant, draw, mutants_of, mutated

ROOT = Path(__file__).parents[2]
PACKAGES = ("protocol", "twin", "phantoms", "runtime", "server", "clients")
EQUIVALENT = Path(__file__).with_name("mutants_equivalent.toml")
UNDER = ("protocol", "twin/geometry", "twin/machine", "twin/motion", "twin/script", "twin/dataset",
         "twin/collision")  # fmt: skip
TESTS = (
    "protocol/test_*.py", "cli/test_cli_machine_new.py", "cli/test_cli_check*.py",
    "dataset/test_*.py", "clients/test_bad_pixels.py", "clients/test_square_pixels.py",
    "face/test_papercuts.py", "face/test_plans.py",
    "twin/script/test_*.py", "twin/test_[!ceps]*.py",
    "twin/test_camera_modes.py", "twin/test_predicted_*.py",
    "twin/test_collision_*.py", "twin/test_scanner_*.py", "twin/test_script_*.py",
    "twin/exchange/test_exchange_r*.py", "twin/calibration/test_calibration_m*.py",
    "twin/calibration/test_panel_distortion.py",
    "twin/projection/test_projection_hard.py",
)  # fmt: skip
"""In `tests/`: what covers the code under mutation and takes seconds, not minutes."""
LIBRARIES = (
    "cv2", "fcl", "hypothesis.extra.numpy", "matplotlib", "msgpack", "numba", "pydantic",
    "pytest_timeout", "rich", "scipy.ndimage", "scipy.optimize", "scipy.spatial", "ssl", "tifffile",
    "trimesh", "typer", "xdist", "xml.etree.ElementTree", "zarr",
)  # fmt: skip
"""What most tests import and no mutant changes: a child begins with it."""
WANTED = 0.95
FILE_S = 30.0
"""Of one test file while its lines are found; tests that come later do not count."""

MEMORY = 12 << 30
"""Address space of a child [bytes]."""

Lines = dict[str, Any]
"""Of one test file: the processor seconds of its tests; the tests of each line as bits of a
number, where the last bit stands for what the whole file does; the files it imports, with
digests."""


def digest(path: Path) -> str:
    """Return a short digest of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


class _WithoutTexts(ast.NodeTransformer):
    """Leave out docstrings, of attributes too."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else node


def code_digest(path: Path) -> str:
    """Return a short digest of what a Python file does: docstrings, comments and line
    breaks do not change it."""
    tree = _WithoutTexts().visit(ast.parse(path.read_text()))
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16]


class Copy:
    """A copy of the code, in which one child at a time works."""

    def __init__(self, folder: Path) -> None:
        """Make the copy, or bring it up to date; what was compiled is kept."""
        self.folder = folder
        wanted = {"pyproject.toml": ROOT / "pyproject.toml"} | {
            str(path.relative_to(ROOT)): path
            for name in (*PACKAGES, "flexdt", "tests", "examples")
            for path in (ROOT / name).rglob("*")
            if path.is_file() and "__pycache__" not in path.parts
        }
        for path in folder.rglob("*"):
            name = str(path.relative_to(folder))
            if path.is_file() and "__pycache__" not in path.parts and name not in wanted:
                path.unlink()
        for name, path in wanted.items():
            there = folder / name
            if not there.exists() or there.stat().st_mtime_ns != path.stat().st_mtime_ns:
                there.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, there)
        for name in PACKAGES:  # one package, as the wheel has it
            link = folder / "flexdt" / name
            link.unlink(missing_ok=True)
            link.symlink_to(folder / name)

    def put(self, mutant: Mutant) -> None:
        """Put a mutant in place. Its time differs from all earlier ones, for what is
        compiled."""
        path = self.folder / mutant.file
        self.original = path.read_bytes(), path.stat().st_mtime_ns
        path.write_text(mutated(mutant, self.original[0].decode()))
        os.utime(path, ns=(time.time_ns(), time.time_ns() + 10**12))

    def take_back(self, mutant: Mutant) -> None:
        """Put the original back."""
        (self.folder / mutant.file).write_bytes(self.original[0])
        os.utime(self.folder / mutant.file, ns=(self.original[1],) * 2)


def in_children(
    jobs: Iterable[tuple[Any, float]],
    copies: Iterable[Copy],
    work: Callable[[Any, Copy], int],
    before: Callable[[Any, Copy], None] = lambda job, copy: None,
) -> Iterator[tuple[Any, Copy, int]]:
    """Do each job in a child process of its own, in a copy that no other has meanwhile.

    A child that takes ten times its seconds is killed. All children are when this is
    closed.

    Args:
        jobs: each with the seconds that it should take.
        copies: as many children at a time.
        work: does it; returns the exit status.
        before: is called here, before the child begins.

    Yields:
        Job, copy and status of `waitpid`, as they end.
    """
    free, live, left = list(copies), dict[int, tuple[Any, Copy, float]](), iter(jobs)
    try:
        while True:
            while free and (job := next(left, None)) is not None:
                copy = free.pop()
                before(job[0], copy)
                pid = os.fork()
                if pid == 0:
                    _child(copy, partial(work, job[0], copy))
                live[pid] = job[0], copy, time.monotonic() + 10 * job[1]
            if not live:
                return
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid:
                job, copy, _ = live.pop(pid)
                free.append(copy)
                yield job, copy, status
                continue
            for pid, (_, _, end) in live.items():
                if time.monotonic() > end:
                    os.killpg(pid, signal.SIGKILL)
            time.sleep(0.01)
    finally:
        for pid in live:
            os.killpg(pid, signal.SIGKILL)


def _child(copy: Copy, work: Callable[[], int]) -> None:
    """Become a process group of its own that works in a copy, and end the process; it
    never returns.

    Output goes to the copy's log; memory is limited to MEMORY. The exit status is what
    `work` returns, 3 if it raises.
    """
    code = 3
    try:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.chdir(copy.folder)
        log = os.open("log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1), os.dup2(log, 2)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        os.environ["PYTHONPATH"] = sys.path[0] = str(copy.folder)
        code = work()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def tests_in(file: str, plugin: object, *options: str) -> int:
    """Run tests of one file of the copy in this process; pytest's exit code."""
    return int(pytest.main(
        ["-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning",
         "-m", "not slow and not browser", "-k", "not linear_time", *options, file],
        plugins=[plugin],
    ))  # fmt: skip


class Chosen:
    """A plugin: only some tests, the quickest first."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted((i for i in items if i.nodeid in self.seconds),
                          key=lambda i: self.seconds[i.nodeid])  # fmt: skip


class Traced:
    """A plugin: which test executes which lines of the files under mutation."""

    def __init__(self, file: str, folder: Path) -> None:
        """Begin to measure the lines that are executed.

        Args:
            file: of the tests.
            folder: the copy of the code.
        """
        self.file, self.folder = file, folder
        self.coverage = coverage.Coverage(
            data_file=None,
            config_file=False,
            include=[str(folder / name / "*") for name in ("protocol", "twin")],
        )
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self.test = file
        self.coverage.start()
        self.coverage.switch_context(file)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Note what one test executes and how long it takes; caches are cleared before
        it.

        After FILE_S of the processor's time the session stops.
        """
        for module in list(
            sys.modules.values()
        ):  # what an earlier test left must run again
            if str(getattr(module, "__file__", "")).startswith(str(self.folder)):
                for value in list(vars(module).values()):
                    if hasattr(value, "cache_clear"):
                        value.cache_clear()
        self.test, begun = item.nodeid, time.process_time()
        self.coverage.switch_context(self.test)
        if time.process_time() > FILE_S:
            item.session.shouldstop = "enough"
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.process_time() - begun
            self.coverage.switch_context(self.file)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Any:
        """What tests share counts for all of the file."""
        if fixturedef.scope != "function":
            self.coverage.switch_context(self.file)
        try:
            return (yield)
        finally:
            self.coverage.switch_context(self.test)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not report.passed:
            self.failed.add(report.nodeid)

    def result(self) -> Lines:
        """Stop, and return the digests of files used, the seconds of tests, and lines
        with their tests.

        Tests are bits of a hexadecimal number; the last stands for what no test alone
        executed. Tests that failed are left out.
        """
        self.coverage.stop()
        tests = [name for name in self.seconds if name not in self.failed]
        bit = {name: 1 << i for i, name in enumerate(tests)} | {
            self.file: 1 << len(tests)
        }
        data = self.coverage.get_data()
        own = {
            m.__file__ for m in list(sys.modules.values()) if getattr(m, "__file__", None)
        }
        used = [Path(os.path.realpath(f)).relative_to(self.folder)
                for f in own if os.path.realpath(f).startswith(f"{self.folder}/")]  # fmt: skip
        return {
            "digests": {
                str(f): digest(self.folder / f) for f in used if f.suffix == ".py"
            },
            "seconds": {name: round(self.seconds[name], 3) for name in tests},
            "lines": {
                str(Path(path).relative_to(self.folder)): {
                    line: hex(sum(bit.get(name, 0) for name in set(names)))
                    for line, names in data.contexts_by_lineno(path).items()
                }
                for path in data.measured_files()
            },
        }


class Tests:
    """Which tests execute which lines of the code as it is."""

    def __init__(self, known: Path, copies: list[Copy], digests: dict[str, str]) -> None:
        """Read what is known, and trace test files that are new or changed.

        Args:
            known: JSON file, written again after each test file.
            copies: in which tests run.
            digests: of the files under mutation.
        """
        self.digests = digests
        entries: dict[str, Lines] = (
            json.loads(known.read_text()) if known.exists() else {}
        )
        files = sorted(
            {str(p.relative_to(ROOT)) for t in TESTS for p in (ROOT / "tests").glob(t)}
        )
        self.entries = {
            file: entry for file, entry in entries.items()
            if file in files and entry["digests"].get(file) == digest(ROOT / file)
        }  # fmt: skip
        new = [(f, 2 * FILE_S) for f in files if f not in self.entries]
        for count, (file, copy, status) in enumerate(in_children(new, copies, _trace)):
            found = copy.folder / "lines.json"
            if status == 0 and found.exists():
                self.entries[file] = json.loads(found.read_text())
            else:
                print(f"no lines of {file}: {(copy.folder / 'log').read_text()[-2000:]}")
            tests = len(self.entries.get(file, {"seconds": ()})["seconds"])
            print(f"lines of {count + 1}/{len(new)} {file}: {tests} tests", flush=True)
            known.write_text(json.dumps(self.entries))
        for (
            copy
        ) in copies:  # what was compiled in one copy need not be compiled in the next
            for other in copies:
                for path in copy.folder.rglob("__pycache__/*.nb?"):
                    there = other.folder / path.relative_to(copy.folder)
                    there.parent.mkdir(exist_ok=True)
                    if not there.exists() or there.stat().st_size < path.stat().st_size:
                        shutil.copy2(path, there)
        self.weight = {file: _weight(entry) for file, entry in self.entries.items()}

    def of(self, mutant: Mutant, most_s: float) -> list[tuple[str, dict[str, float]]]:
        """The tests of a mutant by file, with their seconds, those likely to kill it soon
        first.

        Args:
            mutant: which.
            most_s: seconds of all together.
        """
        ranked = []
        for file, entry in self.entries.items():
            lines, shared = (
                entry["lines"].get(mutant.file, {}),
                1 << len(entry["seconds"]),
            )
            bits = shared if lines and not mutant.inside else 0
            same = entry["digests"].get(mutant.file) == self.digests[mutant.file]
            for line in map(str, mutant.lines) if same else lines:
                bits |= int(lines.get(line, "0"), 16)
            weight = 0.01 + self.weight[file].get(os.path.dirname(mutant.file), 0.0)
            for i, (test, seconds) in enumerate(entry["seconds"].items()):
                own = bool(bits & 1 << i)
                if own or bits & shared:
                    # Whoever imports a module first runs its own lines, and tests them no
                    # better.
                    last = mutant.inside and not own
                    ranked.append((last, (0.02 + seconds) / weight, file, test, seconds))
        chosen: dict[str, dict[str, float]] = {}
        for _, _, file, test, seconds in sorted(ranked):
            most_s -= seconds
            if most_s < 0.0:
                break
            chosen.setdefault(file, {})[test] = seconds
        return list(chosen.items())


def _weight(entry: Lines) -> dict[str, float]:
    """How much of what the tests of a file execute lies in which folder."""
    shared = 1 << len(entry["seconds"])
    counts: dict[str, int] = {}
    for file, lines in entry["lines"].items():
        called = sum(int(bits, 16) != shared for bits in lines.values())
        counts[os.path.dirname(file)] = counts.get(os.path.dirname(file), 0) + called
    return {folder: n / max(1, sum(counts.values())) for folder, n in counts.items()}


def _trace(file: str, copy: Copy) -> int:
    """Find the lines of a test file."""
    sys.dont_write_bytecode = False
    found = copy.folder / "lines.json"
    found.unlink(missing_ok=True)
    traced = Traced(file, copy.folder)
    tests_in(file, traced)
    found.write_text(json.dumps(traced.result()))
    return 0


def judge(job: tuple[Mutant, list[tuple[str, dict[str, float]]]], copy: Copy) -> int:
    """1 as soon as a test fails; a file that takes far too long ends the process."""
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    for file, seconds in job[1]:
        signal.setitimer(signal.ITIMER_PROF, 10.0 + 3 * sum(seconds.values()))
        if tests_in(file, Chosen(seconds), "-x") not in (0, 5):
            return 1
    return 0


Explained = dict[tuple[str, str, str, str, int], str]
"""Names of equivalent mutants -> why no test can tell."""


def equivalents(by_file: dict[str, list[Mutant]]) -> Explained:
    """Find the mutants that `mutants_equivalent.toml` explains.

    An entry without `repeat` means all mutants with its four texts; those of files that
    are not mutated are left out.

    Args:
        by_file: all mutants of the files that are.

    Raises:
        SystemExit: an entry about a mutant that its file no longer has, or about a file
            that is gone.
    """
    explained: Explained = {}
    for entry in tomllib.loads(EQUIVALENT.read_text())["mutant"]:
        texts = tuple(entry[key] for key in ("file", "function", "before", "after"))
        if texts[0] not in by_file and (ROOT / texts[0]).exists():
            continue
        found = [
            m for m in by_file.get(texts[0], ())
            if m.name[:4] == texts and entry.get("repeat", m.repeat) == m.repeat
        ]  # fmt: skip
        if not found:
            sys.exit(f"{EQUIVALENT.name}: the code has no mutant {', '.join(texts)}")
        explained |= {m.name: entry["why"] for m in found}
    return explained


def fate_of(mutant: Mutant, status: int, known: Explained) -> str:
    """What the end of a child means."""
    if os.WIFSIGNALED(status):
        late = os.WTERMSIG(status) in (signal.SIGPROF, signal.SIGKILL)
        return "timeout" if late else "killed"
    if status:
        return "killed"
    return "equivalent" if mutant.name in known else "survived"


def share(fates: Iterable[str]) -> float:
    """Of the mutants that differ, how many are killed."""
    counts = Counter(fates)
    differ = counts.total() - counts["equivalent"]
    return (counts["killed"] + counts["timeout"]) / max(1, differ)


def table(fates: dict[Mutant, str]) -> str:
    """Fates by folder."""
    folders = {m: m.file.rsplit("/", 1)[0] for m in fates}
    rows = []
    for name in (*sorted(set(folders.values())), ""):
        its = Counter(fate for m, fate in fates.items() if folders[m].startswith(name))
        words = ", ".join(
            f"{its[f]} {f}" for f in ("killed", "timeout", "survived", "equivalent")
        )
        rows.append(f"{name or 'all':24} {words}: {100 * share(its.elements()):.1f} %")
    return "\n".join(rows)


def main() -> int:
    """Draw mutants, judge those not judged yet, and print the table.

    Returns:
        0 if at least WANTED of them are killed, or the draw is only printed.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=14)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--under", nargs="*", default=UNDER)
    parser.add_argument(
        "--seconds",
        type=float,
        default=40.0,
        help="of a processor, for the tests of one mutant",
    )
    parser.add_argument("--list", action="store_true", help="print the draw, run nothing")
    parser.add_argument("--again", action="store_true", help="judge survivors once more")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "mutations")
    options = parser.parse_args()
    files = sorted(
        str(path.relative_to(ROOT)) for under in options.under
        for path in ([ROOT / under] if under.endswith(".py") else (ROOT / under).rglob("*.py"))
        if "numba" not in path.read_text()
    )  # fmt: skip
    by_file = {file: mutants_of(file, (ROOT / file).read_text()) for file in files}
    everything = [mutant for mutants in by_file.values() for mutant in mutants]
    known = equivalents(by_file)
    digests = {file: digest(ROOT / file) for file in files}
    codes = {file: code_digest(ROOT / file) for file in files}
    drawn = draw(everything, options.count, options.seed)
    print(
        f"{len(drawn)} of {len(everything)} mutants in {len(files)} files, seed {options.seed}"
    )
    if options.list:
        print("\n".join(str(m) for m in drawn))
        return 0
    for threads in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[threads] = "1"
    for library in LIBRARIES:
        importlib.import_module(library)
    signal.signal(
        signal.SIGTERM, signal.default_int_handler
    )  # children end with this process
    begun = time.monotonic()
    copies = [Copy(options.work / f"copy-{i}") for i in range(options.jobs)]
    tests = Tests(options.work / "lines.json", copies, digests)
    book = options.work / "fates.jsonl"
    earlier = {}
    for line in book.read_text().splitlines() if book.exists() else ():
        name, code, fate = json.loads(line)
        earlier[(*name, code)] = fate
    fates: dict[Mutant, str] = {}
    for mutant in drawn:
        fate = earlier.get((*mutant.name, codes[mutant.file]))
        if fate == "survived":
            fate = fate_of(mutant, 0, known)
        if fate is not None and not (options.again and fate == "survived"):
            fates[mutant] = fate
    print(f"{len(fates)} are known, after {time.monotonic() - begun:.0f} s", flush=True)
    chosen = [(m, tests.of(m, options.seconds)) for m in drawn if m not in fates]
    jobs = [((m, t), 60.0 + 10 * sum(sum(f.values()) for _, f in t)) for m, t in chosen]
    ran = in_children(jobs, copies, judge, lambda job, copy: copy.put(job[0]))
    with book.open("a") as written:
        for count, ((mutant, _), copy, status) in enumerate(ran, 1):
            copy.take_back(mutant)
            fate = fates[mutant] = fate_of(mutant, status, known)
            shown = "survived" if fate == "equivalent" else fate
            written.write(json.dumps([mutant.name, codes[mutant.file], shown]) + "\n")
            written.flush()
            if fate in ("survived", "equivalent"):
                print(f"{fate}: {mutant} {known.get(mutant.name, '')}", flush=True)
            if count % 50 == 0:
                print(f"{len(fates)} of {len(drawn)}: {100 * share(fates.values()):.1f} % killed "
                      f"after {time.monotonic() - begun:.0f} s", flush=True)  # fmt: skip
    for mutant, fate in fates.items():
        if fate == "survived" and not any(m == mutant for m, _ in chosen):
            print(f"survived: {mutant}")
    print(table(fates), f"after {time.monotonic() - begun:.0f} s")
    return 0 if share(fates.values()) >= WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
