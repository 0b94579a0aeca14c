"""Two long studies: scans spoilt on purpose, and the coverage of the joint 95 % region.

`python tests/studies/robustness.py --sets 1000 --out DIR` writes `robustness.json` and
prints a table of kinds (`--kinds scanner_off held_right`: of these); run again after an
interruption, it continues where it stopped. So does `--coverage 1000 [--camera demo]`, which
writes `coverage_demo.json`. The scans are made and judged by `spoilt_scans` and
`ellipsoid_coverage`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import bead_model
from flexdt_extensions.executors import executor

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from ellipsoid_coverage import CAMERAS, Draw, draw
from spoilt_scans import WRONG_SIGMAS, Outcome, corrupt, judge
from ways_of_spoiling import KINDS

PHANTOMS = ("lego", "normal-5", "normal-4", "square-5")
"""Scanned in turn; with three beads or fewer it is undecidable which of them is off."""
OTHER = "compact-4"
SURVIVABLE = (
    "control", "frames_missing", "frames_dark", "half_dark", "frames_repeated", "bead_lost",
    "bead_moved", "bead_tolerance", "extra_beads", "foreign_box", "other_body", "out_of_view",
    "vibration", "shifted_halfway", "source_drift", "low_dose", "blurred", "gradient",
    "dead_pixels", "angle_slip", "angle_jitter", "angle_scale", "held_parameter", "held_right",
    "scanner_off", "detector_off",
)  # fmt: skip
"""Kinds whose truth can still be found, at least when they are mild: drawn twice as often, as
it is only there that a wrong answer can be a confident one."""


def cases(
    sets: int, kinds: Sequence[str] = tuple(KINDS)
) -> Iterator[tuple[str, int, str]]:
    """List (kind, seed, phantom) of each data set."""
    order = [k for k in kinds for _ in range(2 if k in SURVIVABLE else 1)]
    for i in range(sets):
        yield order[i % len(order)], i, PHANTOMS[(i // len(order) + i) % len(PHANTOMS)]


def run_case(case: tuple[str, int, str]) -> tuple[str, Outcome]:
    """Make, spoil, calibrate and judge one data set.

    Args:
        case: kind, seed and name of the phantom.

    Returns:
        The phantom's name, and the outcome.
    """
    kind, seed, name = case
    phantom = load_phantom(name)
    spoilt = corrupt(
        kind, seed, bead_model(phantom), phantom.scene, load_phantom(OTHER).scene
    )
    return name, judge(kind, seed, spoilt)[0]


def run(
    sets: int, jobs: int | None = None, tell: bool = False, keep: Path | None = None,
    kinds: Sequence[str] = tuple(KINDS),
) -> dict[str, object]:  # fmt: skip
    """Calibrate spoilt data sets in several processes and count the outcomes.

    Args:
        sets: number of data sets.
        jobs: processes; None is one for each core.
        tell: print progress.
        keep: file to which each outcome is added as it comes; those that it holds are not
            run again.
        kinds: ways of spoiling, taken in turn.

    Returns:
        Document of `summary`: counts, one row a kind, and every confident wrong answer with
        its seed.
    """
    work = list(cases(sets, kinds))
    kept = {} if keep is None else _kept(keep)
    known = {i: kept[i] for kind, i, _ in work if i in kept and kept[i][1].kind == kind}
    outcomes = [known[i] for i in range(sets) if i in known]
    rest = [case for case in work if case[1] not in known]
    with executor(jobs, None) as pool:
        results = (
            map(run_case, rest) if pool is None else pool.map(run_case, rest, chunksize=4)
        )
        for name, outcome in results:
            outcomes.append((name, outcome))
            if keep is not None:
                with keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"phantom": name, **asdict(outcome)}) + "\n")
            if tell and len(outcomes) % 50 == 0:
                wrong = sum(o.wrong for _, o in outcomes)
                print(
                    f"{len(outcomes)}/{sets}: {wrong} confident wrong answers", flush=True
                )
    outcomes.sort(key=lambda o: o[1].seed)
    return summary([o for _, o in outcomes], [n for n, _ in outcomes])


def _kept(file: Path) -> dict[int, tuple[str, Outcome]]:
    """Read the outcomes of an earlier, interrupted run, by seed; {} without a file."""
    out = {}
    if file.is_file():
        for line in file.read_text("utf-8").splitlines():
            row = json.loads(line)
            name = row.pop("phantom")
            row["findings"] = tuple(row["findings"])
            out[row["seed"]] = (name, Outcome(**row))
    return out


def summary(outcomes: Sequence[Outcome], phantoms: Sequence[str]) -> dict[str, object]:
    """Count outcomes in all and by kind, and list the confidently wrong ones.

    Args:
        outcomes: of all data sets.
        phantoms: name of each one's phantom.

    Returns:
        The document: counts, `rows` of the kinds that occur, and `wrong`.
    """
    rows = []
    for kind in KINDS:
        some = [o for o in outcomes if o.kind == kind]
        if not some:
            continue
        found: dict[str, int] = {}
        for o in some:
            for code in o.findings:
                found[code] = found.get(code, 0) + 1
        offered = [o for o in some if not o.refused]
        rows.append(
            {
                "kind": kind,
                "sets": len(some),
                "refused": sum(o.refused for o in some),
                "wrong": sum(o.wrong for o in some),
                "worst_sigma": max((o.worst for o in offered), default=None),
                "mae": sum(o.mae for o in offered) / len(offered) if offered else None,
                "findings": dict(sorted(found.items(), key=lambda f: -f[1])),
            }
        )
    return {
        "sets": len(outcomes),
        "refused": sum(o.refused for o in outcomes),
        "offered": sum(not o.refused for o in outcomes),
        "confident_wrong": sum(o.wrong for o in outcomes),
        "wrong_sigmas": WRONG_SIGMAS,
        "rows": rows,
        "wrong": [
            {
                "kind": o.kind,
                "seed": o.seed,
                "phantom": name,
                "sigmas": o.worst,
                "mae": o.mae,
            }
            for o, name in zip(outcomes, phantoms, strict=True)
            if o.wrong
        ],
    }


def kinds_table(document: Mapping[str, Any]) -> list[str]:
    """Make a Markdown table, one line a kind: data sets, refused, offered, wrong, largest
    error offered [sigma], and the four most frequent findings.
    """
    lines = [
        "| kind | data sets | refused | offered | wrong | largest error offered (sigma) "
        "| found |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in document["rows"]:
        worst = "" if row["worst_sigma"] is None else f"{row['worst_sigma']:.1f}"
        found = ", ".join(
            f"{code} {count}" for code, count in list(row["findings"].items())[:4]
        )
        lines.append(
            f"| {row['kind']} | {row['sets']} | {row['refused']} | "
            f"{row['sets'] - row['refused']} "
            f"| {row['wrong']} | {worst} | {found} |"
        )
    return lines


def coverage_case(task: tuple[int, str]) -> Draw:
    """Simulate and calibrate one scan of the LEGO phantom; `task` is seed and camera."""
    seed, camera = task
    phantom = load_phantom("lego")
    return draw(seed, bead_model(phantom), phantom.scene, CAMERAS[camera])


def coverage(
    seeds: int, camera: str, jobs: int | None = None, keep: Path | None = None
) -> dict[str, object]:
    """Calibrate simulated scans and count how often the truth is inside the 95 % regions;
    print progress every 100 scans.

    Args:
        seeds: number of scans.
        camera: of CAMERAS.
        jobs: processes; None is one for each core.
        keep: file of draws that are not repeated, and to which each new one is added.

    Returns:
        `seeds`, `camera`, `offered` (calibrations with a result), and of these `inside_95`,
        `share_pct` and `intervals_pct` (mean share of single intervals that hold the truth)
        [%]; `findings` (code -> number), and `worst_distance`, the largest
        squared Mahalanobis distance.
    """
    draws: list[Draw] = []
    if keep is not None and keep.is_file():
        for line in keep.read_text("utf-8").splitlines():
            row = json.loads(line)
            draws.append(Draw(**{**row, "warnings": tuple(row["warnings"])}))
    known = {d.seed for d in draws}
    work = [(i, camera) for i in range(seeds) if i not in known]
    with executor(jobs, None) as pool:
        results = (
            map(coverage_case, work) if pool is None else pool.map(coverage_case, work)
        )
        for result in results:
            draws.append(result)
            if keep is not None:
                with keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(result)) + "\n")
            if len(draws) % 100 == 0:
                held = sum(d.inside for d in draws)
                print(f"{len(draws)}/{seeds}: {held} inside", flush=True)
    draws = [d for d in draws if d.seed < seeds]
    offered = [d for d in draws if d.offered]
    found: dict[str, int] = {}
    for d in draws:
        for code in d.warnings:
            found[code] = found.get(code, 0) + 1
    return {
        "seeds": seeds,
        "camera": camera,
        "offered": len(offered),
        "inside_95": sum(d.inside for d in offered),
        "share_pct": 100.0 * sum(d.inside for d in offered) / max(len(offered), 1),
        "intervals_pct": 100.0 * sum(d.intervals for d in offered) / max(len(offered), 1),
        "findings": found,
        "worst_distance": max((d.distance2 for d in offered), default=None),
    }


def _positive(word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"{word!r}; allowed: a whole number from 1 up")
    return int(word)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, or with `--coverage` that of coverage, and print and store its
    document.

    Returns:
        1 if any answer is confidently wrong, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=_positive, default=1000)
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), default=tuple(KINDS))
    parser.add_argument("--jobs", type=_positive, default=None)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--coverage", type=_positive, default=None)
    parser.add_argument("--camera", choices=sorted(CAMERAS), default="demo")
    args = parser.parse_args(argv)
    if args.coverage is not None:
        keep = None
        if args.out is not None:
            args.out.mkdir(parents=True, exist_ok=True)
            keep = args.out / f"coverage_{args.camera}.jsonl"
        covered = coverage(args.coverage, args.camera, args.jobs, keep)
        _store(args.out, f"coverage_{args.camera}.json", covered)
        print(covered)
        return 0
    keep = None
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        keep = args.out / "outcomes.jsonl"
    document = run(args.sets, args.jobs, tell=True, keep=keep, kinds=args.kinds)
    _store(args.out, "robustness.json", document)
    print("\n".join(kinds_table(document)))
    print({k: document[k] for k in ("sets", "refused", "offered", "confident_wrong")})
    return 1 if document["confident_wrong"] else 0


def _store(out: Path | None, name: str, document: dict[str, object]) -> None:
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
