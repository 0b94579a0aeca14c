"""Targets of calibration, our figures and the thesis's, in one table.

`python tests/studies/calibration_targets.py FOLDER...` reads the documents of `flexdt
study --out`, `robustness.py --out` and `calibration_speed.py --json` under the folders.
`--run points` (seconds) or `--run images` (hours) first runs the studies that are missing,
into the first folder. A figure that is missing is listed with the command that makes it.
Exit code 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

Document = Mapping[str, Any]
Reading = tuple[str, bool, str]
"""Our figure, whether it meets the target, and the thesis's figure, as text."""


@dataclass(frozen=True)
class Target:
    """One line of the table.

    Attributes:
        text: the target in words.
        source: key of the document it is read from.
        command: makes that document.
        read: the document to the figures.
    """

    text: str
    source: str
    command: str
    read: Callable[[Document], Reading]


def _rows(document: Document, without: tuple[str, ...] = ()) -> list[Document]:
    return [row for row in document["rows"] if row["setting"] not in without]


def _span(values: Sequence[float | None]) -> str:
    """Format the least and largest of some numbers, "-" if all are None."""
    some = [v for v in values if v is not None]
    if not some:
        return "-"
    low, high = min(some), max(some)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _thesis(rows: Sequence[Document]) -> str:
    return f"MAE {_span([row['thesis_mae'] for row in rows])}"


def _solved(limit: float, without: tuple[str, ...] = ()) -> Callable[[Document], Reading]:
    """Make the reader of a target: all runs recovered, the largest MAE below a limit, at
    most eight iterations.

    Args:
        limit: of the MAE.
        without: settings that are left out.

    Returns:
        Document -> (figures, whether they are met, the thesis's figures).
    """

    def read(document: Document) -> Reading:
        """Read the figures of a study's rows."""
        rows = _rows(document, without)
        runs, good = sum(r["runs"] for r in rows), sum(r["success"] for r in rows)
        worst = max((r["mae_max"] for r in rows if r["mae_max"] is not None), default=1.0)
        most = max((r["iterations_max"] for r in rows if r["iterations_max"]), default=99)
        met = good == runs and worst < limit and most <= 8
        steps = _span([row["thesis_iterations"] for row in rows])
        return (
            f"{good}/{runs}, MAE at most {worst:.1g}, at most {most} iterations",
            met,
            f"{_thesis(rows)}, {steps} iterations",
        )

    return read


def _refused(document: Document) -> Reading:
    """Read how many runs with one bead were reported unidentifiable; met if all were."""
    (row,) = (r for r in document["rows"] if r["setting"] == "1")
    text = f"{row['unidentifiable']}/{row['runs']} reported unidentifiable"
    return (
        text,
        row["unidentifiable"] == row["runs"],
        f"{_thesis([row])}, given as numbers",
    )


def _in_images(
    row_limit: float, run_limit: float | None
) -> Callable[[Document], Reading]:
    """Make the reader of a target of rendered images: MAE of each row at most
    `row_limit`, of each run at most `run_limit` (None: any).

    All other runs must succeed; those of setting "1" (one bead or placement) must be
    unidentifiable or weak.
    """

    def read(document: Document) -> Reading:
        """Read the largest MAE of a row and of a run, and whether the target is met."""
        alone = ("1",)  # one bead, or one placement: reported apart
        rows = _rows(document, alone)
        mae = max((r["mae"] for r in rows if r["mae"] is not None), default=1.0)
        worst = max((r["mae_max"] for r in rows if r["mae_max"] is not None), default=1.0)
        good = all(r["success"] == r["runs"] for r in rows)
        rest = all(
            r["unidentifiable"] + r["weak"] >= r["runs"] for r in _only(document, alone)
        )
        met = (
            good
            and rest
            and mae <= row_limit
            and (run_limit is None or worst <= run_limit)
        )
        return f"MAE of a row {mae:.1g}, of a run {worst:.1g}", met, _thesis(rows)

    return read


def _only(document: Document, settings: tuple[str, ...]) -> list[Document]:
    return [row for row in document["rows"] if row["setting"] in settings]


def _placements(document: Document) -> Reading:
    """Read the figures for one, two and eight placements: one must be weak, the MAE of
    two at most 0.01, of eight at most 0.005.
    """
    rows = {r["setting"]: r for r in document["rows"]}
    one, two, eight = rows["1"], rows["2"], rows["8"]
    sigma = max(one["mean_sigma"].values())
    met = one["weak"] == one["runs"] and two["mae"] <= 0.01 and eight["mae"] <= 0.005
    return (
        f"G = 1: {one['weak']}/{one['runs']} weak, largest sigma {sigma:.2g}; "
        f"G = 2: {two['mae']:.2g}; G = 8: {eight['mae']:.2g}",
        met,
        "MAE " + ", ".join(f"{r['thesis_mae']:g}" for r in (one, two, eight)),
    )


def _bookkeeping(document: Document) -> Reading:
    """Read how much of figure 6.4's change is left: met below 30 % of the thesis's, and
    with right angles below 0.05 deg.
    """
    f = document["figure_6_4"]
    text = f"{f['left']:.2f} deg left of {f['thesis']:.2f}; with right angles {f['ours']:.4f} deg"
    met = f["left"] < 0.3 * f["thesis"] and f["ours"] < 0.05
    return text, met, f"changes by {f['thesis']:.2f} deg rms"


def _covered(document: Document) -> Reading:
    share = document["share_pct"]
    text = f"{share:.1f} % of {document['offered']}"
    return text, 93.0 <= share <= 97.0, "no uncertainty given"


def _spoilt(document: Document) -> Reading:
    """Read how many spoilt data sets had a wrong answer: met if none, and if at least
    half of the sets were offered one.
    """
    sets, offered = document["sets"], document["offered"]
    wrong = document["confident_wrong"]
    text = f"{wrong} of {offered} offered, {sets} sets"
    return text, wrong == 0 and 2 * offered >= sets, "not tried"


def _speed(case: str, limit_s: float) -> Callable[[Document], Reading]:
    """Make the reader of a time: met if the best one of a case is at most `limit_s`."""

    def read(document: Document) -> Reading:
        """Read the best time of the case."""
        best = document[case]["best_s"]
        return f"{1e3 * best:.3g} ms", best <= limit_s, "under twenty minutes on a GPU"

    return read


def _study(experiment: str, fidelity: str) -> tuple[str, str]:
    source = f"{experiment}-{fidelity}"
    return source, f"flexdt study {experiment} --fidelity {fidelity} --out DIR/{source}"


_ROBUST = "python tests/studies/robustness.py --out DIR"
_BENCH = (
    "python tests/studies/calibration_speed.py DATASET --phantom lego --json > "
    "DIR/bench.json"
)
TARGETS: Final = (
    Target("exact points, K = 2 to 7: all recovered, MAE < 1e-9, <= 8 iterations",
           *_study("beads", "points"), _solved(1e-9, ("1",))),
    Target("exact points, K = 1: all reported unidentifiable",
           *_study("beads", "points"), _refused),
    Target("exact points, seven phantoms: the same",
           *_study("phantoms", "points"), _solved(1e-9)),
    Target("exact points, Algorithm 2 with every damping: the same",
           *_study("damping", "points"), _solved(1e-9)),
    Target("detector at 0.1 px: G = 1 weak, G = 2 <= 0.01, G = 8 <= 0.005",
           *_study("detector", "noisy"), _placements),
    Target("figure 6.4: the dependence on N explained",
           *_study("real", "noisy"), _bookkeeping),
    *(
        Target(f"images without noise, {name}: <= 2e-4 a row",
               *_study(name, "clean"), _in_images(2e-4, None))
        for name in ("beads", "phantoms", "detector", "damping")
    ),
    *(
        Target(f"noisy images, {name}: <= 2e-3 a row, no run above 0.01",
               *_study(name, "images"), _in_images(2e-3, 1e-2))
        for name in ("beads", "phantoms", "detector", "damping")
    ),
    *(
        Target(f"joint 95 % region covers 93 to 97 %, camera {camera}", f"coverage_{camera}",
               f"{_ROBUST} --coverage 1000 --camera {camera}", _covered)
        for camera in ("demo", "blurred")
    ),
    Target("spoilt data sets: no confident wrong answer, half of them offered", "robustness",
           f"{_ROBUST} --sets 1000", _spoilt),
    Target("the fit alone <= 2 ms", "bench", _BENCH, _speed("solve", 2e-3)),
    Target("360 frames from memory <= 1 s", "bench", _BENCH, _speed("memory", 1.0)),
    Target("360 frames from TIFFs <= 2 s", "bench", _BENCH, _speed("files", 2.0)),
)  # fmt: skip


def collected(folders: Sequence[Path]) -> dict[str, Document]:
    """Read the JSON documents of studies below some folders; of two of one study the file
    that was changed later counts.

    Files that are no JSON or no known document are skipped.

    Returns:
        Study -> document: `EXPERIMENT-FIDELITY`, `coverage_CAMERA`, `robustness` or `bench`.
    """
    out: dict[str, Document] = {}
    files = {f for folder in folders for f in folder.rglob("*.json")}
    for file in sorted(files, key=lambda f: (f.stat().st_mtime, str(f))):
        try:
            document = json.loads(file.read_text("utf-8"))
        except (ValueError, OSError):
            continue
        if not isinstance(document, dict):
            continue
        match document:
            case {
                "experiment": str(experiment),
                "fidelity": str(fidelity),
                "rows": list(),
            }:
                out[f"{experiment}-{fidelity}"] = document
            case {"camera": str(camera), "share_pct": float()}:
                out[f"coverage_{camera}"] = document
            case {"confident_wrong": int(), "sets": int()}:
                out["robustness"] = document
            case {"solve": dict(), "memory": dict(), "files": dict()}:
                out["bench"] = document
    return out


def targets_table(found: Mapping[str, Document]) -> list[tuple[str, str, str, str]]:
    """Make the rows of the table of targets: target, our figures, the thesis's, and
    whether it is met: yes or NO.

    Where the document is missing, they are target, the command that makes it, "", and
    "missing".
    """
    out = []
    for target in TARGETS:
        document = found.get(target.source)
        if document is None:
            out.append((target.text, target.command, "", "missing"))
            continue
        ours, met, thesis = target.read(document)
        out.append((target.text, ours, thesis, "yes" if met else "NO"))
    return out


QUICK: Final = ("points", "noisy")


def run_missing(folder: Path, found: Mapping[str, Document], images: bool) -> None:
    """Run the studies of `flexdt study` whose documents are missing, and write each into
    a folder of its own.

    Args:
        folder: that gets those folders.
        found: documents that there are.
        images: also run those on images, which take long.
    """
    from flexdt_extensions.studies.study import run_study

    for source in dict.fromkeys(
        t.source for t in TARGETS if t.command.startswith("flexdt study")
    ):
        experiment, _, fidelity = source.partition("-")
        if source not in found and (images or fidelity in QUICK):
            print(f"running {source}", file=sys.stderr, flush=True)
            run_study(experiment, fidelity, out=folder / source)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table of targets from the documents in some folders, after running
    missing studies if requested.

    Returns:
        1 if a target is missed or a folder is missing, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--run", choices=("points", "images"), default=None)
    args = parser.parse_args(argv)
    folders: list[Path] = args.folders
    if args.run is not None:
        run_missing(folders[0], collected(folders), args.run == "images")
    for folder in folders:
        if not folder.is_dir():
            print(
                f"{folder}: no such folder; allowed: where studies were written",
                file=sys.stderr,
            )
            return 1
    rows = targets_table(collected(folders))
    print("| target | ours | thesis | met |\n|---|---|---|---|")
    for row in rows:
        print("| " + " | ".join(row) + " |")
    return 1 if any(row[3] == "NO" for row in rows) else 0


if __name__ == "__main__":
    raise SystemExit(main())
