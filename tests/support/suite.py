"""What every test may rely on, however the suite itself was started."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, settings
from skips import judged

if TYPE_CHECKING:
    from flexdt.clients.launch.processes import Servers

# The tests start some hundred processes. Where bytecode may not be kept, each compiles flexdt, and
# each worker every test and its assertions, anew: 20 s of processor time instead of 7 s.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Idle threads of OpenMP (numba's loops) and OpenBLAS spin until there is more to do. Beside
# another process they take the cores from it: FDK's tests took 138 s of processor time instead
# of 36 s. Set before either library is loaded, and inherited by the workers and by every
# process of a test.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A shell that starts the suite in the background ignores SIGINT, and every process started from
# here would inherit that; the tests of Ctrl-C need it to arrive.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples every time, and none refused for being slow on a busy machine: what fails
# here fails everywhere. `pytest --hypothesis-profile=default` looks for new ones.
settings.register_profile(
    "same", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same")


ROOT = Path(__file__).parents[2]
MEASURED = Path(__file__).with_name("processor_s.json")
"""Test -> mean processor time of its cases [s], of those that take long together; written by
`tests/studies/durations.py --write`."""
BUDGET_S = 0.5
"""Processor time that the cases of one test may take together in `make test`; the others are
slow."""
CI_BUDGET_S = 1.0
"""The same in CI, where one case is always run; the others are `night`."""
MODULE_BUDGET_S = 2.0
"""Processor time that the slow tests of one module may take together in CI, the shortest
first. One is always run, and of one with `campaign(n)` as many cases as it says; the others
are `night`."""


PURE = [ROOT / "tests" / name for name in ("protocol", "twin", "phantoms")]
"""Folders of tests that need no socket, process or file: they run first."""


def spread_out(items: list[pytest.Item]) -> None:
    """Mark the cases of a test by when they run.

    `daily(n)` leaves n cases in `make test` and marks the others `slow`, and so does
    BUDGET_S. `campaign(n)` leaves n cases in CI and marks the other slow ones, and the
    page's, `night`, and so do CI_BUDGET_S and MODULE_BUDGET_S. The n cases are spread evenly
    over the table, so that each kind of case is met.
    """
    mean_s = json.loads(MEASURED.read_text(encoding="utf-8"))
    cases: dict[tuple[Path, str], list[pytest.Item]] = {}
    for item in items:
        name = getattr(item, "originalname", None) or item.name
        cases.setdefault((item.path, name), []).append(item)
    longer: dict[Path, list[tuple[float, list[pytest.Item]]]] = defaultdict(list)
    for (path, name), every in cases.items():
        daily, campaign = (_kept(every, mark) for mark in ("daily", "campaign"))
        _leave(every, daily, "slow")
        quick = [item for item in every if not _is_slow(item)]
        place = path.as_posix().removeprefix(f"{ROOT.as_posix()}/")
        spent = mean_s.get(f"{place}::{name}", 0.0)
        if spent * len(quick) > BUDGET_S:
            _leave(quick, _spread(len(quick), int(BUDGET_S // spent)), "slow")
        _leave(every, campaign, "night", _is_slow)
        in_ci = [item for item in every if item.get_closest_marker("night") is None]
        if spent * len(in_ci) > CI_BUDGET_S:
            count = max(1, int(CI_BUDGET_S // spent))
            _leave(in_ci, _spread(len(in_ci), count), "night", _is_slow)
        slow = [i for i in in_ci if _is_slow(i) and not i.get_closest_marker("night")]
        if slow and campaign is None:
            longer[path].append((spent * len(slow), slow))
    for tests in longer.values():
        _leave_the_longest(tests)


def _leave_the_longest(tests: list[tuple[float, list[pytest.Item]]]) -> None:
    """Mark `night` the slow tests of a module that its budget does not allow in CI."""
    left = MODULE_BUDGET_S
    for number, (spent, every) in enumerate(sorted(tests, key=lambda test: test[0])):
        left -= spent
        if number and left < 0.0:
            _leave(every, set(), "night")


def _is_slow(item: pytest.Item) -> bool:
    """Whether `make test` leaves a case out."""
    return any(item.get_closest_marker(name) for name in ("slow", "browser"))


def _leave(
    every: list[pytest.Item],
    kept: set[int] | None,
    mark: str,
    of: Callable[[pytest.Item], bool] = lambda _: True,
) -> None:
    """Mark all cases but those that are kept, of those that `of` is true of; none without
    numbers to keep."""
    for number, item in enumerate(every):
        if kept is not None and number not in kept and of(item):
            item.add_marker(mark)


def _spread(cases: int, count: int) -> set[int]:
    """Numbers of some cases, evenly spread."""
    return {cases * i // count for i in range(count)}


def _kept(every: list[pytest.Item], name: str) -> set[int] | None:
    """Numbers of the cases that a mark keeps; None without the mark."""
    mark = every[0].get_closest_marker(name)
    if mark is None:
        return None
    return _spread(len(every), mark.args[0] if mark.args else 0)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort modules: the pure core before what is built on it, so that a mistake shows early;
    in each those that may take longest first, then those with slow tests, then by their
    number, so that no worker is left with a long one at the end.

    A browser test outside tests/viewer
    raises UsageError, since `make page` looks there alone.
    """
    spread_out(items)
    for item in items:
        if item.get_closest_marker("browser") and item.path.parent.name != "viewer":
            raise pytest.UsageError(
                f"{item.nodeid}: `make page` looks in tests/viewer alone"
            )
    slow = {item.path for item in items if item.get_closest_marker("slow") is not None}
    count = Counter(item.path for item in items)
    allowed_s: dict[Path, float] = {}
    for item in items:
        if (mark := item.get_closest_marker("timeout")) is not None:
            allowed_s[item.path] = max(mark.args[0], allowed_s.get(item.path, 0.0))
    items.sort(
        key=lambda i: (
            not any(i.path.is_relative_to(folder) for folder in PURE),
            -allowed_s.get(i.path, 0.0),
            i.path not in slow,
            -count[i.path],
        )
    )


BEGUN = pytest.StashKey[float]()
BEGUN_AT = pytest.StashKey[float]()
ENDED = pytest.StashKey[float]()
NEXT = pytest.StashKey[Path | None]()
"""Module of the test that follows a test in its process; None after the last."""


def processor_s() -> float:
    """Processor time of this process and of the children that it has waited for [s]."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[BEGUN] = processor_s()
    item.stash[BEGUN_AT] = time.monotonic()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    item.stash[ENDED] = processor_s()
    item.stash[NEXT] = None if nextitem is None else nextitem.path


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What a test takes of the processor goes into the file of durations, and as `shared_s`
    what a module's servers and browsers had taken when they ended with its last test; those
    that end with the process belong to no module. A skip that CI does not allow is a failure.

    A process that is waited for late has its whole life counted at once, in whatever test
    this falls: no test takes more than all cores do while it runs.
    """
    if call.when == "teardown":
        following = item.stash.get(NEXT, item.path)
        ended = processor_s() if following == item.path else item.stash[ENDED]
        most = (os.cpu_count() or 1) * (time.monotonic() - item.stash[BEGUN_AT])
        spent = {"processor_s": min(ended - item.stash[BEGUN], most)}
        if following not in (item.path, None):
            spent["shared_s"] = processor_s() - ended
        item.user_properties += [(name, round(s, 2)) for name, s in spent.items()]
    return judged((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[
    None, pytest.CollectReport, pytest.CollectReport
]:
    """A module that is skipped where CI does not allow it is an error."""
    return judged((yield))


@dataclass
class SharedServers:
    """Twin and projector under their supervisor, shared by all modules of a worker."""

    running: Servers
    data_dir: Path
    scene: dict[str, Any]
    """As they started."""

    def as_new(self) -> None:
        """Leave no scan, stop, correction or data set behind, and everything where it
        stood.

        Jobs that run are aborted and control is taken by force.
        """
        from flexdt.clients import TwinClient
        from flexdt.clients.client.twin_methods import FINAL_STATES

        with TwinClient(*self.running.address) as twin:
            twin.control("force")
            twin.set_clock("max")
            for job in twin.jobs().jobs:
                if job.state not in FINAL_STATES:
                    twin.abort_job(job.job)
            twin.stop()
            if twin.state().safety.estop:
                twin.reset()
            twin.load_scene(self.scene)
            twin.control("release")
        for folder in self.data_dir.iterdir():
            if (folder / "flexdt.json").exists():
                shutil.rmtree(folder)


@pytest.fixture(scope="session")
def shared_servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedServers]:
    """Start a twin and a projector for all modules of a worker; they stop at its end."""
    from flexdt.clients import TwinClient
    from flexdt.clients.launch.processes import Servers

    data = tmp_path_factory.mktemp("shared") / "data"
    with Servers(
        {"data": data, "speed-up": "max", "sample": "lego"}, data.parent / "servers.log"
    ) as running:
        with TwinClient(*running.address) as twin:
            scene = twin.save_scene()
        yield SharedServers(running, data, scene)


@pytest.fixture
def on_processor() -> Iterator[None]:
    """Keep projections off a CUDA device: for tests that compare the processor's bytes.

    A device rounds otherwise, and its transpose adds in another order at every call.
    """
    from flexdt.twin.projection import gpu

    with gpu.switched_off():
        yield


@pytest.fixture(scope="session")
def rays() -> Iterator[Any]:
    """A projector for twins that a module starts itself; twins leave nothing in it."""
    from lab import projector

    process = projector()
    yield process
    process.end()


@pytest.fixture(scope="module")
def servers(shared_servers: SharedServers) -> Servers:
    """The shared servers, as they were when they started."""
    shared_servers.as_new()
    return shared_servers.running


@pytest.fixture(scope="module")
def data_dir(shared_servers: SharedServers) -> Path:
    """The data directory of `servers`."""
    return shared_servers.data_dir
