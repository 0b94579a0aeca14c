"""Whatever two visitors do, no picture, number or thumbnail stands under a moment that it does not
belong to, and an emergency stop always reaches the twin.

Pictures are compared with the files of the scans and with what the twin computes, ages with a
record of the twin's states that the page does not see.
`CAMPAIGNS=tests/viewer/test_page_moments.py make campaigns` runs 500 histories.
"""

from __future__ import annotations

import json
import random
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import tifffile
from breaking_link import Link, linked
from lab import fly_script
from looking import until

from flexdt.clients.client.client import TwinClient
from flexdt.protocol import RpcError
from flexdt.protocol.state_model import State
from tests.viewer.conftest import Lab, at_rest

pytestmark = pytest.mark.browser
SEEDS = 500
ACTIONS = 7
SMALL: dict[str, Any] = {"mode": "HW4SW1High", "roi": (700, 500, 1212, 1012)}
SAMPLES = ("gear", "lego", "square", "empty")
OLD_S = 1.0
"""Age by the twin's clock from which an image must be marked."""
RATE_S = 0.02
SIGHT = """() => {
  const image = flexdt.store.image;
  const tag = document.getElementById('film-old');
  const places = image && Array.from({ length: 40 }, (_, k) => {
    const [height, width] = image.full;
    const [c, r] = [((k * 37) % 101) / 101 * width | 0, ((k * 53) % 97) / 97 * height | 0];
    return [c, r, flexdt.value(c, r)];
  });
  return {
    image: image && { time: image.time, twin: image.twin, cone: image.cone_vec, kind: image.kind,
      code: image.code, full: image.full, origin: image.origin, places,
      recorded: image.recorded ? { name: image.recorded.name, file: image.recorded.file,
        index: image.recorded.index } : null },
    marked: !tag.hidden, tag: tag.textContent,
    record: document.getElementById('record').hidden ? null
      : document.getElementById('record-name').textContent,
    at: document.getElementById('record-at').textContent,
    title: document.getElementById('geometry-title').textContent,
    stands: document.getElementById('volume-stage').hidden ? null
      : document.getElementById('volume-stands').textContent,
    volume: document.getElementById('volume-title').textContent,
    by_hand: !document.getElementById('by-hand').hidden,
    story: document.querySelector('#story button.primary')?.id,
    thumbs: [...document.querySelectorAll('#thumbs figure')].map((figure) => {
      const canvas = figure.querySelector('canvas');
      const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      return { file: figure.dataset.file, name: figure.title.split(' of ').pop(),
        words: figure.querySelector('figcaption').textContent,
        shape: [canvas.height, canvas.width], grey: [...data].filter((_, k) => k % 4 === 0) };
    }),
  };
}"""
"""What a person sees, and the image below it."""
AGES = """async ([seconds, stalls]) => {
  const seen = [];
  const frame = () => new Promise((done) => requestAnimationFrame(done));
  const begun = performance.now();
  while (performance.now() < begun + 1000 * seconds) {
    if (performance.now() > begun + 1000 * (stalls[0]?.[0] ?? Infinity)) {
      const end = performance.now() + 1000 * stalls.shift()[1];
      while (performance.now() < end);
      await frame();
    }
    await frame();
    const image = flexdt.store.image;
    const tag = document.getElementById('film-old');
    if (image && !image.recorded)
      seen.push([Date.now() / 1000, image.time,
        tag.hidden && document.body.dataset.old !== 'true', image.twin]);
    await new Promise((done) => setTimeout(done, 50));
  }
  return seen;
}"""
"""What is painted; meanwhile the page itself stands still at such times for so long [s]."""


def pictured(state: State) -> object:
    """All that an image shows."""
    correction = None if state.correction is None else state.correction.name
    tube = state.tube
    return (
        {name: round(a.position, 4) for name, a in state.axes.items() if not a.virtual},
        state.sample.model_dump(),
        state.camera.model_dump(),
        (tube.kV, tube.power_W, tube.on and tube.ready, correction),
    )


class Record(threading.Thread):
    """The twin's states as a third person gets them, with our clock."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.port, self.over = port, threading.Event()
        self.states: list[tuple[float, float, object]] = []

    def run(self) -> None:
        with TwinClient(port=self.port, name="observer", wait_s=60.0) as client:
            while not self.over.wait(RATE_S):
                state = client.state()
                self.states.append((time.time(), state.time, pictured(state)))

    def wrong_since(self, image_s: float, now: float) -> float | None:
        """How long an image made at `image_s` has not been true at `now` of our clock, at least,
        in seconds of the twin; None where it is true or that is not known.

        It was made between two states of the record, and shows either: what changes in
        between (a sample, the end of a move) may be on it already.
        """
        known = [row for row in self.states if row[0] <= now]
        before = [row for row in known if row[1] <= image_s]
        after = [row for row in known if row[1] >= image_s]
        if not before or not after:
            return None
        of = (before[-1][2], after[0][2])
        latest = max([image_s, *(row[1] for row in after if row[2] in of)])
        later = [row[1] for row in after if row[1] > latest]
        return known[-1][1] - later[0] if later else None


def unmarked(record: Record, seen: list[Any]) -> list[float]:
    """Ages of the images that passed as of now, those beyond a second alone."""
    ages = [record.wrong_since(image_s, at) for at, image_s, hidden, *_ in seen if hidden]
    return [age for age in ages if age is not None and age > OLD_S]


class History:
    """Two pages over links that break, their twin, and its files."""

    def __init__(self, lab: Lab, pages: list[Any], link: Link, seed: int) -> None:
        self.lab, self.pages, self.link = lab, pages, link
        self.rng = random.Random(seed)
        self.told: list[str] = []
        self.done: set[tuple[str, str, bytes, int]] = set()
        """Thumbnails that were compared with so many images of their scan."""
        self.coarse: dict[tuple[object, ...], Any] = {}
        self.compared = {"thumbnails": 0, "images": 0, "now": 0, "volumes": 0, "stops": 0}

    def twin(self) -> TwinClient:
        return TwinClient(port=self.lab.twin.port, name="Bert", wait_s=60.0)

    def act(self) -> None:
        acts = [
            self.name, self.estop, self.name_and_estop, self.reload, self.lose, self.sample,
            self.scan, self.scan, self.open_volume, self.open_data, self.correct, self.move,
        ]  # fmt: skip
        act = self.rng.choice(acts)
        self.told.append(act.__name__)
        act(self.rng.choice(self.pages))

    def call(self, page: Any, method: str, **params: object) -> Any:
        """A refusal is an answer, too."""
        ask = "([m, p]) => flexdt.call(m, p).then((a) => a, (e) => ({ refused: e.message }))"
        return page.evaluate(ask, [method, params])

    def ready(self, page: Any) -> None:
        page.wait_for_function("window.flexdt?.store.state && flexdt.store.session")

    def name(self, page: Any) -> None:
        page.fill(
            "#person", self.rng.choice(("Ada", "Emmy", "Grete")) + str(len(self.told))
        )

    def estop(self, page: Any) -> None:
        """Pressed, it reaches the twin, whatever the link does."""
        page.evaluate("document.querySelector('#estop').click()")
        with self.twin() as bert:
            until(lambda: bert.state().safety.estop, f"the stop, after {self.told}", 60)
            self.compared["stops"] += 1
            page.locator("#emergency").wait_for()
            assert page.is_disabled("#scan-it")
            bert.control("force")
            bert.reset()
            bert.control("release")

    def name_and_estop(self, page: Any) -> None:
        self.name(page)
        page.click("#estop")
        with self.twin() as bert:
            until(lambda: bert.state().safety.estop, f"the stop, after {self.told}", 60)
            self.compared["stops"] += 1
            bert.control("force")
            bert.reset()
            bert.control("release")

    def reload(self, page: Any) -> None:
        page.reload()
        self.ready(page)

    def lose(self, page: Any) -> None:
        """Lost, and perhaps an emergency stop meanwhile."""
        self.link.cut()
        if self.rng.random() < 0.5:
            self.estop(page)
        for each in self.pages:
            self.ready(each)

    def sample(self, page: Any) -> None:
        self.call(page, "session.control", action="force")
        self.call(page, "sample.set", name=self.rng.choice(SAMPLES))

    def move(self, page: Any) -> None:
        self.call(page, "session.control", action="force")
        to = {"rot_obj": float(self.rng.randint(-90, 90))}
        self.call(page, "axes.move", targets=to)

    def correct(self, page: Any) -> None:
        self.call(page, "session.control", action="force")
        if self.rng.random() < 0.4:
            self.call(page, "calibration.revert")
            return
        by_hand = self.rng.random() < 0.5
        comment = "misaligned by hand" if by_hand else ""
        values = {"dD_x": self.rng.choice((0.1, 0.2))}
        self.call(page, "calibration.apply", parameters=values, comment=comment)

    def scan(self, page: Any) -> None:
        """While it runs both visitors look at it."""
        self.call(page, "session.control", action="force")
        page.evaluate("flexdt.data.open(null).then(() => null)")
        text = fly_script(frames=self.rng.choice((13, 25, 37)))
        answer = self.call(page, "script.submit", text=text, speed_up="max")
        if "job" not in answer:
            return
        with self.twin() as bert:
            while bert.job_status(answer["job"]).state in ("queued", "running"):
                self.look()
        until(lambda: page.locator("#thumbs figure").count(), "thumbnails", 60)

    def open_data(self, page: Any) -> None:
        names = [
            d["name"] for d in self.call(page, "viewer.datasets").get("datasets", [])
        ]
        chosen = self.rng.choice([None, *names])
        page.evaluate("name => flexdt.data.open(name).then(() => null)", chosen)
        if chosen:
            page.select_option("#kind", "counts")
            index = self.rng.randrange(8)
            page.evaluate("k => { const s = document.querySelector('#record-frame'); s.value = k;"
                          " s.dispatchEvent(new Event('input')); }", index)  # fmt: skip

    def open_volume(self, page: Any) -> None:
        names = [
            d["name"] for d in self.call(page, "viewer.datasets").get("datasets", [])
        ]
        if not names:
            return
        emit = "name => import('/link.js').then(({ emit }) => emit('reconstruct', name))"
        page.evaluate(emit, self.rng.choice(names))

    def look(self) -> None:
        """What both see agrees with files and twin."""
        for page in self.pages:
            sight = page.evaluate(SIGHT)
            self.compare_thumbnails(sight)
            self.compare_recorded(sight)
            self.compare_scanned(sight)

    def rest(self) -> None:
        """Once nothing moves, what is unmarked is of now."""
        with self.twin() as bert:
            until(lambda: at_rest(bert), "the motors rest")
            for page in self.pages:
                self.ready(page)

                def agrees(page: Any = page) -> bool:
                    sight = page.evaluate(SIGHT)
                    self.compare_thumbnails(sight)
                    self.compare_recorded(sight)
                    state = bert.state()
                    return (
                        self.is_now(sight, np.asarray(bert.projection().image))
                        and self.is_said(sight, state)
                        and sight["by_hand"] == by_hand(state)
                        and sight["story"]
                        == ("story-scan" if by_hand(state) else "story-bend")
                    )

                until(agrees, f"the page agrees, after {self.told}", 60)

    # -- against files and the wire ----------------------------------------------------------

    def file(self, name: str, file: str) -> Any:
        return tifffile.imread(self.lab.data / name / file).astype(float)

    def small(self, name: str, file: str, rows: int, cols: int) -> Any:
        """An image as coarse as a thumbnail of so many rows and columns; read once."""
        about = (self.lab.data / name / file).stat()
        key = (name, file, rows, cols, about.st_mtime_ns, about.st_size)
        if key not in self.coarse:
            counts = self.file(name, file)
            n = counts.shape[1] // cols
            cut = counts[: rows * n, : cols * n].reshape(rows, n, cols, n)
            self.coarse[key] = cut.mean(axis=(1, 3))
        return self.coarse[key]

    def compare_thumbnails(self, sight: Any) -> None:
        """Each is of its file more than of any other image of its scan."""
        for one in sight["thumbs"][-2:]:
            assert one["words"] == one["file"].rpartition(".")[0]
            grey = np.array(one["grey"], dtype=float).reshape(one["shape"])
            if grey.std() < 2.0:
                continue
            document = json.loads(
                (self.lab.data / one["name"] / "flexdt.json").read_text()
            )
            there = [f["file"] for f in document["frames"] if f["kind"] == "projection"]
            near = [f for f in there if (self.lab.data / one["name"] / f).is_file()]
            if one["file"] not in near:
                near.append(one["file"])
            compared = (one["name"], one["file"], grey.tobytes(), len(near))
            if compared in self.done:
                continue
            self.done.add(compared)
            alike = {
                f: _alike(grey, self.small(one["name"], f, *grey.shape)) for f in near
            }
            best = max(alike.values())
            assert alike[one["file"]] > best - 1e-3, (one["file"], alike, self.told)
            assert alike[one["file"]] > 0.98, (one["file"], alike, self.told)
            self.compared["thumbnails"] += 1

    def compare_recorded(self, sight: Any) -> None:
        """An image of a data set has the values of the file that it is called by, and is shown
        only while that data set is open."""
        image = sight["image"]
        if image is None or image["recorded"] is None:
            return
        about = image["recorded"]
        assert sight["record"] == about["name"], self.told
        if image["kind"] != "counts":
            return
        counts = self.file(about["name"], about["file"])
        for column, row, value in image["places"]:
            assert abs(counts[row, column] - value) < 0.51, (about, self.told)
        stem = about["file"].rpartition(".")[0]
        named = sight["title"].rpartition(", ")[2]
        assert named == stem, (sight["title"], about, self.told)
        self.compared["images"] += 1

    def compare_scanned(self, sight: Any) -> None:
        """A live image that is called by a file has that file's pose."""
        origin = (sight["image"] or {}).get("origin") or {}
        if not origin.get("file") or sight["record"] is not None:
            return
        path = self.lab.data / origin["dataset"] / "flexdt.json"
        frames = json.loads(path.read_text())["frames"]
        frame = frames[origin["index"]]
        assert frame["file"] == origin["file"], self.told
        if json.loads(path.read_text())["correction"] is None:
            cone = np.array(frame["cone_vec"])
            assert np.abs(cone - sight["image"]["cone"]).max() < 1e-3, (origin, self.told)
        self.compared["images"] += 1

    def is_now(self, sight: Any, wanted: Any) -> bool:
        """An unmarked live image has the values of now."""
        image = sight["image"]
        if sight["record"] is not None or image is None or sight["marked"]:
            return sight["record"] is not None or image is None
        if image["kind"] != "line_integral" or image["code"] != "deflate":
            return image["kind"] != "line_integral"
        if tuple(image["full"]) != wanted.shape:
            return False
        self.compared["now"] += 1
        return all(abs(wanted[r, c] - v) < 2e-3 for c, r, v in image["places"])

    def is_said(self, sight: Any, state: State) -> bool:
        """A volume is said to stand on the stage where its document is of the same."""
        if sight["stands"] is None or not sight["volume"].startswith("Volume of "):
            return True
        name = sight["volume"].removeprefix("Volume of ")
        made = json.loads((self.lab.data / name / "flexdt.json").read_text())
        correction = (made["correction"] or {}).get("name")
        now = None if state.correction is None else state.correction.name
        same = made["sample"]["name"] == (state.sample.name or "") and correction == now
        self.compared["volumes"] += 1
        return (sight["stands"] == "stands on the stage") is same


def by_hand(state: State) -> bool:
    return (
        state.correction is not None and state.correction.comment == "misaligned by hand"
    )


def _alike(grey: Any, small: Any) -> float:
    """How well a thumbnail is explained by an image as coarse as it, whatever its window: a
    correlation of what both show."""
    inside = (grey > 5) & (grey < 250)  # the window cuts what is beyond
    if inside.sum() < 50 or small[inside].std() == 0:
        return 1.0
    return float(np.corrcoef(grey[inside], small[inside])[0, 1])


@pytest.fixture(scope="module")
def visitors(chromium: Any) -> Iterator[list[Any]]:
    """Two people's browsers. Each keeps one tab and, as browsers do, the page's program."""
    made = [chromium.new_context(viewport={"width": 1280, "height": 800}) for _ in "AB"]
    yield made
    for context in made:
        context.close()


@pytest.fixture(scope="module")
def link(lab: Lab) -> Iterator[Link]:
    with linked(lab.viewer.port) as made:
        yield made


@pytest.fixture
def two(
    link: Link, visitors: list[Any], console: list[str], twin: TwinClient
) -> Iterator[tuple[list[Any], Link]]:
    twin.control("force")
    twin.set_camera(**SMALL)
    twin.control("release")
    pages = [(context.pages or [context.new_page()])[0] for context in visitors]

    def failed(error: Any) -> None:
        console.append(str(error))

    for page in pages:
        page.set_default_timeout(120_000)
        page.on("pageerror", failed)
        page.goto(f"http://127.0.0.1:{link.port}/?view=none&patience=100")
        page.wait_for_function("window.flexdt?.store.state && flexdt.store.session")
    yield pages, link
    for page in pages:
        if not page.is_closed():
            page.remove_listener("pageerror", failed)
            page.evaluate("localStorage.clear(), sessionStorage.clear()")
            page.goto("about:blank")


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(SEEDS))
def test_nothing_stands_under_a_moment_that_it_does_not_belong_to(
    lab: Lab, two: tuple[list[Any], Link], twin: TwinClient, seed: int
) -> None:
    pages, link = two
    history = History(lab, pages, link, seed)
    for _ in range(ACTIONS):
        history.act()
        history.look()
        history.rest()
    print(seed, history.told, history.compared)


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.parametrize("stalls", [0, 2], ids=["quick page", "page that stands still"])
def test_no_image_passes_as_of_now_for_longer_than_a_second_on_a_slow_link(
    lab: Lab, two: tuple[list[Any], Link], twin: TwinClient, stalls: int
) -> None:
    """250 kB/s and 300 ms, while the stage turns and the sample is changed."""
    (page, other), link = two
    other.close()
    rng = random.Random(82)
    record = Record(lab.twin.port)
    record.start()
    link.bytes_s, link.delay_s = 250e3, 0.15
    seen: list[Any] = []

    def look(seconds: float) -> None:
        times = sorted(rng.uniform(0.3, seconds - 0.5) for _ in range(stalls))
        drawn = [(at, rng.uniform(0.4, 1.6)) for at in times]
        seen.extend(page.evaluate(AGES, [seconds, drawn]))

    try:
        with TwinClient(port=lab.twin.port, name="Bert", wait_s=60.0) as bert:
            bert.control("force")
            bert.set_clock(1.0)
            bert.set_camera(mode="HW2SW1High", roi=(32, 8, 1943, 1527))
            for target, sample in ((90.0, "gear"), (-60.0, "lego"), (30.0, "square")):
                bert.move({"rot_obj": target})
                look(4)
                try:
                    bert.set_sample(sample)
                except RpcError:
                    bert.stop()
                    bert.set_sample(sample)
                look(3)
            bert.control("release")
    finally:
        record.over.set()
        record.join()
        link.bytes_s, link.delay_s = None, 0.0
    late = unmarked(record, seen)
    marked = sum(not hidden for _, _, hidden, *_ in seen)
    print(f"{len(seen)} looks, {marked} marked, {len(late)} unmarked and late {late[:5]}")
    assert len(seen) > 100
    assert late == []
