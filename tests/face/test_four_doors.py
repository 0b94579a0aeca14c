"""200 mistakes at each of four doors: Python, command line, wire and page.

They are drawn from what is published (`docs/reference/surface.txt`, `protocol/openrpc.json`, the
schemas of the page's methods), not from the tables that refuse them. An answer is one sentence
that names what was mistaken, without names of the code, Python's syntax or other libraries'
words.
"""

from __future__ import annotations

import inspect
import json
import random
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.protocol import METHODS, RpcError, parse_params
from tests.face import test_mistakes

ROOT = Path(__file__).resolve().parents[2]
SURFACE = (ROOT / "docs" / "reference" / "surface.txt").read_text("utf-8").splitlines()
WIRE = json.loads((ROOT / "protocol" / "openrpc.json").read_text("utf-8"))
IN_ALL = 200
SHARE = 0.95
"""Of the mistakes that must be answered by a sentence with the right cause."""
FOREIGN = re.compile(
    r"Traceback|Input should|pydantic|numpy|NoneType|<class|object at 0x|__\w+__|dtype"
    r"|validation error|Extra inputs|Field required|positional argument|\(\w*,\)"
    r"|internal error|Errno|\bNone,|load_dataset|_checked|BadParameter"
)
"""What is of the code, of Python's syntax or of other libraries."""
STRANGERS = {
    "sod": ("DSO", "src_orig_dist", "SourceToIsocenterDistance", "srcToObject", "FOD"),
    "sdd": ("DSD", "src_det_dist", "SourceToDetectorDistance", "SrcToDetector", "FDD"),
    "angles": ("phis", "GantryAngle", "numAngles"),
    "pixel": ("dDetector", "pixelWidth", "pixel_size"),
    "shape": ("nDetector", "numRows", "num_pixels"),
    "iterations": ("niter", "numIter", "max_iteration"),
}
"""Ours -> words of TIGRE, ASTRA, tomosipo, RTK, LEAP, CIL and makers' files for it."""


class Mistake(NamedTuple):
    where: str
    kind: str
    call: Callable[[], object]
    cause: tuple[str, ...]
    """Texts, one of which an answer with the right cause has."""
    never: tuple[str, ...] = ()
    """Suggestions that would be wrong."""


def misspelt(name: str, draw: random.Random) -> str:
    """Exchange two neighbours, leave one letter out, or double one."""
    at = draw.randrange(max(1, len(name) - 1))
    swapped = name[:at] + name[at : at + 2][::-1] + name[at + 2 :]
    ways = [swapped, name[:at] + name[at + 1 :], name[:at] + name[at] + name[at:]]
    return draw.choice([way for way in ways if way not in ("", name)] or [name + "x"])


def judged(mistake: Mistake, text: str | None) -> str:
    """What is wrong with an answer; nothing where it is one sentence with the right cause."""
    if text is None:
        return "accepted"
    if "\n" in text.strip():
        return f"more than one line: {text}"
    if (found := FOREIGN.search(text)) is not None:
        return f"{found[0]!r} in: {text}"
    if not any(cause in text for cause in mistake.cause):
        return f"none of {mistake.cause} in: {text}"
    if any(
        f"did you mean {q}{n}" in text for n in mistake.never for q in ("", "'", "--")
    ):
        return f"suggests what was given: {text}"
    return ""


def verdict(drawn: list[Mistake], answer: Callable[[Mistake], str | None]) -> None:
    assert len(drawn) == IN_ALL
    failed = {}
    for number, mistake in enumerate(drawn):
        if fault := judged(mistake, answer(mistake)):
            failed[f"{number} {mistake.where}: {mistake.kind}"] = fault
    listed = "\n".join(f"{where}: {fault}" for where, fault in failed.items())
    print(f"{IN_ALL - len(failed)} of {IN_ALL}\n{listed}")
    assert len(failed) <= (1 - SHARE) * IN_ALL, listed
    foreign = [
        fault for fault in failed.values() if " in: " in fault and fault[0] in "'\""
    ]
    assert foreign == [], listed


# Python


def parameters(line: str) -> list[str]:
    inside = line.partition("(")[2].rstrip(")")
    return [
        one.partition("=")[0].strip() for one in inside.split(",") if one.strip() != "*"
    ]


def solvers() -> dict[str, set[str]]:
    """Solver -> parameters, by the lines of the surface."""
    lines = (line for line in SURFACE if re.match(r"fx\.(fdk|sirt|cgls|tv)\(", line))
    return {line[3:].partition("(")[0]: set(parameters(line)) for line in lines}


def in_python(draw: random.Random) -> Iterator[Mistake]:
    taken = {where: right for where, right in test_mistakes.RIGHT.items() if right[1]}
    data = test_mistakes.DATA
    while True:
        where = draw.choice([*taken])
        call, right = taken[where]
        name = draw.choice([*right])
        kind = draw.choice(["misspelt", "missing", "pair", "file", "stranger", "type"])
        if kind == "misspelt":
            wrong = misspelt(name, draw)
            named = {wrong if n == name else n: v for n, v in right.items()}
            never = tuple(n for n in right if n != name)
            yield Mistake(where, kind, partial(call, **named), (repr(wrong),), never)
        elif kind == "missing":
            given = draw.sample([*right], draw.randrange(len(right)))
            line = next((one for one in SURFACE if one.startswith(f"fx.{where}(")), "")
            needed = [p for p in line.partition("(")[2].rstrip(")").split(", ")
                      if p and "=" not in p and "*" not in p and p not in given]  # fmt: skip
            if needed:
                named = {n: right[n] for n in given}
                cause = tuple(repr(n) for n in needed)
                yield Mistake(where, kind, partial(call, **named), cause)
        elif kind == "pair":
            by_name = solvers()
            algorithm = draw.choice([*by_name])
            option = draw.choice(["iterations", "weight", "window"])
            if option not in by_name[algorithm]:
                value = {"iterations": 2, "weight": 0.1, "window": "hann"}[option]
                yield Mistake(
                    f"reconstruct {algorithm}", kind,
                    partial(data.reconstruct, algorithm, **{option: value}),
                    (f"{option}: {algorithm}",),
                )  # fmt: skip
        elif kind == "file":
            word = f"gone-{draw.randrange(1000)}"
            ways: Mapping[str, Callable[[], object]] = {
                "open": partial(fx.open, word),
                "Volume.load": partial(fx.Volume.load, f"{word}.tif"),
                "ConeVec.load": partial(fx.ConeVec.load, f"{word}.json"),
                "plan": partial(fx.plan, f"{word}.txt"),
                "machine": partial(fx.machine, f"{word}.toml"),
                "calibrate": partial(fx.calibrate, data, f"{word}.toml"),
                "read_tiffs": partial(fx.read_tiffs, word, data.geometry),
                "simulate": partial(fx.simulate, f"{word}.stl", data.geometry),
                "expose": partial(fx.expose, f"{word}.stl"),
                "reconstruct": partial(fx.reconstruct, word),
            }
            door = draw.choice([*ways])
            yield Mistake(door, kind, ways[door], (word,))
        elif kind == "stranger":
            ours = draw.choice([n for n in STRANGERS if n in right] or ["sod"])
            if ours in right:
                theirs = draw.choice(STRANGERS[ours])
                named = {theirs if n == ours else n: v for n, v in right.items()}
                cause = (f"did you mean {ours!r}",)
                yield Mistake(where, kind, partial(call, **named), cause)
        else:
            named = {**right, name: object()}
            others = test_mistakes._others(  # whether the annotation allows anything
                str(inspect.signature(call).parameters[name].annotation), 0
            )
            if others:
                yield Mistake(where, kind, partial(call, **named), (f"{name} is",))


def some(mistakes: Iterator[Mistake]) -> list[Mistake]:
    return [next(mistakes) for _ in range(IN_ALL)]


@pytest.mark.slow
def test_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    missing: list[Exception] = []

    def answer(mistake: Mistake) -> str | None:
        try:
            mistake.call()
        except fx.TwinError as error:
            if mistake.kind == "file":
                missing.append(error)
            return str(error)
        except Exception as error:
            return f"Traceback {type(error).__name__}: {error}"
        return None

    verdict(some(in_python(random.Random(83))), answer)
    assert missing
    assert all(isinstance(error, FileNotFoundError) for error in missing)


# The command line


def commands() -> dict[str, tuple[list[str], list[str]]]:
    """Command -> its options and its arguments, by the surface."""
    found = {}
    for line in SURFACE:
        words = line.split()
        if words[:1] == ["flexdt"]:
            path = [w for w in words[1:] if w[0] != "-" and not w.isupper()]
            options = [w.partition("|")[0] for w in words[1:] if w[:2] == "--"]
            found[" ".join(path)] = options, [w for w in words[1:] if w.isupper()]
    return {path: parts for path, parts in found.items() if path and parts[0]}


NOT_RUN = {"up", "twin", "projector", "viewer", "gateway", "demo", "bench"}


def on_the_command_line(draw: random.Random) -> Iterator[Mistake]:
    known = {path: parts for path, parts in commands().items() if path not in NOT_RUN}
    while True:
        path = draw.choice([*known])
        options, arguments = known[path]
        kind = draw.choice(["misspelt", "stranger", "pair", "file", "number"])
        words = path.split()
        if kind == "misspelt":
            wrong = "--" + misspelt(draw.choice(options)[2:], draw)
            if not any(option.startswith(wrong) for option in options):
                given = [*words, *("gone" for _ in arguments), f"{wrong}=1"]
                yield Mistake(path, kind, partial(run, given), (wrong,))
        elif kind == "stranger":
            ours = draw.choice([n for n in STRANGERS if f"--{n}" in options] or [""])
            if ours:
                theirs = draw.choice(STRANGERS[ours])
                given = [*words, *("gone" for _ in arguments), f"--{theirs}=1"]
                yield Mistake(
                    path, kind, partial(run, given), (f"did you mean --{ours}",)
                )
        elif kind == "pair":
            by_name = solvers()
            algorithm = draw.choice([*by_name])
            option = draw.choice(["iterations", "weight"])
            if option not in by_name[algorithm]:
                given = ["reconstruct", "gone", "--out=v.tif", f"--algorithm={algorithm}",
                         f"--{option}=2"]  # fmt: skip
                cause = (f"--{option}: {algorithm}",)
                yield Mistake("reconstruct", kind, partial(run, given), cause)
        elif kind == "file":
            word = f"gone-{draw.randrange(1000)}"
            given = draw.choice([
                ["reconstruct", word, "--out=v.tif"], ["check", f"{word}.txt"],
                ["calibrate", word, "--phantom=lego"], ["align", word], ["describe", word],
                ["expose", f"--sample={word}.stl"], ["machine", "check", f"{word}.toml"],
                ["import", f"{word}.json", "--format=rtk", "--out=g.json"],
                ["export", word, "--format=rtk", "--out=g.xml"],
            ])  # fmt: skip
            yield Mistake(" ".join(given[:1]), kind, partial(run, given), (word,))
        else:
            option = draw.choice(
                ["--binning", "--every", "--iterations", "--voxel", "--kv"]
            )
            value = draw.choice(["many", "1,5", "--", "ten"])
            given = ["reconstruct", "gone", "--out=v.tif", f"{option}={value}"]
            yield Mistake("reconstruct", kind, partial(run, given), (option,))


@pytest.mark.slow
def test_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLEXDT_CONFIG", str(tmp_path / "config.toml"))
    (tmp_path / "config.toml").write_text("")

    def answer(mistake: Mistake) -> str | None:
        if mistake.call() == 0:
            return None
        lines = capsys.readouterr().err.splitlines()
        return "\n".join(line for line in lines if not line.startswith("Try '"))

    verdict(some(on_the_command_line(random.Random(84))), answer)


# The wire and the page


def of_schemas(
    schemas: Mapping[str, Mapping[str, Any]],
    ask: Callable[[str, Mapping[str, object]], object],
    draw: random.Random,
) -> Iterator[Mistake]:
    """Draw mistakes from JSON schemas of parameters (method -> name -> schema)."""
    named = {method: fields for method, fields in schemas.items() if fields}
    while True:
        method = draw.choice([*named])
        fields = named[method]
        name = draw.choice([*fields])
        kind = draw.choice(["misspelt", "type", "missing", "bounds"])
        if kind == "misspelt":
            wrong = misspelt(name, draw)
            if wrong not in fields:
                given: dict[str, object] = {wrong: 1}
                yield Mistake(method, kind, partial(ask, method, given), (wrong,))
        elif kind == "type":
            given = {name: {"what": [None]}}
            if fields[name].get("type") in (
                "integer",
                "number",
                "string",
                "boolean",
                "array",
            ):
                yield Mistake(method, kind, partial(ask, method, given), (name,))
        elif kind == "missing":
            needed = [n for n, schema in fields.items() if schema.get("needed")]
            if needed:
                yield Mistake(method, kind, partial(ask, method, {}), tuple(needed))
        else:
            low, high = fields[name].get("minimum"), fields[name].get("maximum")
            if low is not None or high is not None:
                given = {name: low - 1 if low is not None else high + 1}
                yield Mistake(method, kind, partial(ask, method, given), (name,))


def refusal(mistake: Mistake) -> str | None:
    try:
        mistake.call()
    except RpcError as error:
        return error.message
    except Exception as error:
        return f"Traceback {type(error).__name__}: {error}"
    return None


def test_wire() -> None:
    schemas = {
        method["name"]: {
            p["name"]: {**p["schema"], "needed": p.get("required", False)}
            for p in method["params"]
        }
        for method in WIRE["methods"]
    }

    def ask(method: str, given: Mapping[str, object]) -> object:
        return parse_params(METHODS[method], given)

    verdict(some(of_schemas(schemas, ask, random.Random(85))), refusal)


def test_page() -> None:
    from flexdt.clients.viewer.page_methods import METHODS as PAGE
    from flexdt.protocol import Method
    from flexdt.protocol.fields import Nothing

    schemas = {}
    for name, (model, _) in PAGE.items():
        schema = model.model_json_schema()
        needed = schema.get("required", ())
        schemas[name] = {
            field: {**inner, "needed": field in needed}
            for field, inner in schema.get("properties", {}).items()
        }

    def ask(method: str, given: Mapping[str, object]) -> object:
        return parse_params(Method(method, PAGE[method][0], Nothing, method), given)

    verdict(some(of_schemas(schemas, ask, random.Random(86))), refusal)


# Values that nobody foresaw, at every argument of every right call

VALUES: tuple[object, ...] = (
    -1, 0, float("nan"), float("inf"), "", "abc", [], {}, True, 1e30, (1, 2, 3, 4),
    np.zeros((2, 2)), b"x", [None], {"a": 1},
)  # fmt: skip
INNER = re.compile(r"(?<!\w)_\w|bead_phantom|open_data|room_like")
"""Private names, and functions by which nobody calls."""
LONG = {"iterations", "turns"}
"""A number of these may be large, and then takes long."""


@pytest.mark.parametrize("where", sorted(test_mistakes.RIGHT))
@pytest.mark.daily(12)
def test_no_value_leads_to_the_code(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(warnings, "warn", lambda *_, **__: None)  # of what is accepted
    call, right = test_mistakes.RIGHT[where]
    draw = random.Random(where)
    for name in right:
        for value in draw.sample(VALUES, 5):
            if name in LONG and value == 1e30:
                continue
            try:
                call(**{**right, name: value})
            except fx.TwinError as error:
                shown = str(error).replace(repr(value), "")
                assert not FOREIGN.search(shown), (name, value, shown)
                assert not INNER.search(shown), (name, value, shown)
