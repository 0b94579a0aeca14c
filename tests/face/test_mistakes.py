"""150 mistakes drawn over the signatures of the public face: each gets a sentence, not a
traceback.

What counts as a mistake comes from the text of the signatures and from right calls, not from
what checks them: a value of another type, an array of another shape, a number in another unit
or of none, two arguments in the wrong order, a misspelt name.
"""

from __future__ import annotations

import inspect
import random
import re
import string
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.signatures import public

SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=4, shape=(6, 8), pixel=0.5)
GRID = fx.Grid((4, 4, 4), 0.5)
IMAGES = np.full((4, 6, 8), 0.1, np.float32)
COUNTS = np.full((4, 6, 8), 500)
VOLUME = fx.Volume(np.full((4, 4, 4), 0.02), 0.5)
BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 1, "material": "pmma"}
DATA = fx.DataSet.from_arrays(
    COUNTS, SCAN, dark=np.zeros((6, 8)), flat=np.full((6, 8), 1000)
)
BENCH = {"sod": 100.0, "sdd": 200.0, "angles": 4, "pixel": 0.5, "shape": (6, 8)}
SOLVER = {"projections": IMAGES, "cone_vec": SCAN, "like": GRID}
RIGHT: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "ConeVec": (fx.ConeVec, {"rows": SCAN.rows, "detector_shape": (6, 8)}),
    "ConeVec.circular": (fx.ConeVec.circular, {**BENCH, "offset": (0.0, 1.0), "height": 1.0}),
    "ConeVec.helical": (fx.ConeVec.helical, {**BENCH, "rise": 2.0, "turns": 2.0}),
    "ConeVec.from_astra": (fx.ConeVec.from_astra, {"geometry": SCAN.rows, "shape": (6, 8)}),
    "ConeVec.of_shape": (SCAN.of_shape, {"shape": (6, 8)}),
    "ConeVec.project_points": (SCAN.project_points, {"points": np.zeros((5, 3))}),
    "ConeVec.binned": (SCAN.binned, {"factor": 2}),
    "ConeVec.load": (fx.ConeVec.load, {"file": "scan.json", "format": "rtk", "pixel": 0.5}),
    "DataSet.from_arrays": (fx.DataSet.from_arrays, {
        "counts": COUNTS, "geometry": SCAN, "flat": np.full((6, 8), 1000), "name": "mine"}),
    "DataSet.line_integrals": (DATA.line_integrals, {"index": 1}),
    "DataSet.reconstruct": (DATA.reconstruct, {"algorithm": "fdk", "voxel": 0.5, "every": 1}),
    "DataSet.calibrate": (DATA.calibrate, {"phantom": "lego", "free": ["dO_x"], "radius": 3.0}),
    "DataSet.align": (DATA.align, {"per_frame": False}),
    "DataSet.save": (DATA.save, {"folder": "somewhere"}),
    "Detector": (fx.Detector, {"bits": 14, "blur_mm": 0.1, "scintillator": "CsI@4.51"}),
    "find_convention": (fx.find_convention, {"images": IMAGES, "geometry": SCAN}),
    "Grid": (fx.Grid, {"shape": (4, 4, 4), "voxel_mm": 0.5, "center_mm": (0.0, 0.0, 0.0)}),
    "LocalTwin": (fx.LocalTwin, {"data": "x", "sample": "lego", "machine": "flexray"}),
    "Operator": (fx.Operator, {"geometry": SCAN, "like": GRID, "shape": (6, 8)}),
    "Operator.norm": (fx.Operator(SCAN, GRID).norm, {"tolerance": 0.01}),
    "Rigid": (fx.Rigid, {"turn": np.eye(3), "shift": np.zeros(3)}),
    "Rigid.translate": (fx.Rigid.translate, {"x": 1.0, "y": 2.0}),
    "Rigid.rotate": (fx.Rigid.rotate, {"axis": "z", "angle_deg": 90.0}),
    "Tube": (fx.Tube, {"kV": 90.0, "power_W": 50.0, "filters": [("Al@2.70", 0.5)]}),
    "TwinClient": (fx.TwinClient, {"host": "127.0.0.1", "port": 1, "timeout_s": 5.0}),
    "Volume": (fx.Volume, {"data": VOLUME.data, "voxel_mm": 0.5, "center_mm": (0.0, 0.0, 0.0)}),
    "Volume.like": (VOLUME.like, {"data": VOLUME.data}),
    "Volume.load": (fx.Volume.load, {"file": "volume.tif"}),
    "Volume.save": (VOLUME.save, {"file": "volume.tif"}),
    "align": (fx.align, {"data": DATA, "per_frame": False}),
    "back": (fx.back, SOLVER),
    "calibrate": (fx.calibrate, {"data": DATA, "phantom": "lego", "radius": 3.0}),
    "cgls": (fx.cgls, {**SOLVER, "iterations": 2}),
    "expose": (fx.expose, {"sample": "normal-5", "kV": 90.0, "images": 10, "sod": 600.0}),
    "fdk": (fx.fdk, {**SOLVER, "window": "hann"}),
    "forward": (fx.forward, {"volume": VOLUME, "cone_vec": SCAN, "shape": (6, 8)}),
    "machine": (fx.machine, {"word": "flexray"}),
    "open": (fx.open, {"folder": "nowhere", "ignore_document": False}),
    "phantoms.beads": (fx.phantoms.beads, {"name_or_dims": "normal", "beads": 5}),
    "phantoms.shepp_logan": (fx.phantoms.shepp_logan, {"size_mm": 50.0}),
    "plan": (fx.plan, {"script": "rot_obj move absolute 90 ACK", "machine": "flexray"}),
    "project": (fx.project, {"sample": VOLUME, "geometry": SCAN, "shape": (6, 8)}),
    "read_tiffs": (fx.read_tiffs, {"folder": "nowhere", "geometry": SCAN, "flat": "white*"}),
    "reconstruct": (fx.reconstruct, {"data": DATA, "algorithm": "fdk", "voxel": 0.5,
                                     "shape": (4, 4, 4), "center": (0.0, 0.0, 0.0)}),
    "simulate": (fx.simulate, {"sample": BALL, "geometry": SCAN, "noise": 1, "exposure_ms": 9.0}),
    "sirt": (fx.sirt, {**SOLVER, "iterations": 2}),
    "tv": (fx.tv, {**SOLVER, "iterations": 2, "weight": 0.01}),
}  # fmt: skip
"""A right call of each name; the values are what the mistakes are made of."""
NO_CALLS = {"AsyncTwinClient", "NotBuiltError", "TwinError", "__version__"}
OTHERS: Mapping[str, object] = {
    "str": "10", "float": 2.5, "None": None, "Sequence[str]": ["a", "b"], "Mapping": {"a": 1},
    "nothing of the kind": object(),
}  # fmt: skip
"""The word in an annotation that allows it -> a value."""
ALIASES = {"Data": "DataSet | str", "File": "str", "ArrayLike": "Array | float", "Shape2": "tuple",
           "FloatArray": "Array | float", "Float32Array": "Array | float"}  # fmt: skip
SIGNED = {"height", "rise", "offset", "x", "y", "z", "angle_deg", "exposure_ms"}
"""Numbers that may be negative, or of any size."""
IN_ALL = 150


class Mistake(NamedTuple):
    where: str
    kind: str
    about: str
    given: tuple[Any, ...]
    named: dict[str, Any]

    def __str__(self) -> str:
        return f"{self.where}: {self.kind}, {self.about}"


def _others(annotation: str, right: object) -> list[object]:
    """Values of types that the text of an annotation does not have."""
    text = re.sub(r"\w+", lambda word: ALIASES.get(word[0], word[0]), annotation)
    words = set(re.findall(r"[\w]+(?:\[str\])?", text))
    if words & {"object", "Any"}:
        return []
    return [value for name, value in OTHERS.items() if name not in words]


def _types() -> Iterator[Mistake]:
    for where, (call, right) in RIGHT.items():
        for name, parameter in inspect.signature(call).parameters.items():
            if name in right:
                for other in _others(str(parameter.annotation), right[name]):
                    wrong = {**right, name: other}
                    yield Mistake(
                        where, "another type", f"{name}={other!r}"[:60], (), wrong
                    )


def _shapes() -> Iterator[Mistake]:
    for where, (_, right) in RIGHT.items():
        for name, value in right.items():
            wrong: list[Any] = []
            if isinstance(value, tuple):
                wrong = [value[:-1], (*value, 1)]
            elif isinstance(value, np.ndarray) and value.shape[-1] == 12:
                wrong = [value[:, :-1], value[None], np.zeros((3, 12))][
                    : 3 - (where == "ConeVec")
                ]
            elif isinstance(value, np.ndarray):
                wrong = [value[None, None], value[..., :0]]
            for other in wrong:
                about = f"{name} of shape {np.shape(other)}"
                yield Mistake(where, "another shape", about, (), {**right, name: other})


def _units() -> Iterator[Mistake]:
    for where, (_, right) in RIGHT.items():
        for name, value in right.items():
            if isinstance(value, float):
                # A geometry alone has no scale: it is looked at where it meets a sample.
                most = 1 if name in SIGNED else 2 if where.startswith("ConeVec") else 3
                for other in (np.nan, -value, 1e9 * value)[:most]:
                    wrong = {**right, name: other}
                    yield Mistake(where, "another unit", f"{name}={other:g}", (), wrong)
    metres = fx.ConeVec(SCAN.rows / 1000, (6, 8))
    aside = fx.ConeVec.circular(
        sod=100, sdd=200, angles=4, shape=(6, 8), pixel=0.5, offset=(90, 0)
    )
    near = fx.ConeVec.circular(sod=1.5, sdd=2000, angles=4, shape=(6, 8), pixel=0.5)
    small = {**BALL, "radius": 1e-3}
    for where in ("simulate", "project"):
        for about, sample, geometry in (
            ("metres for millimetres", BALL, metres), ("the sample in metres", small, SCAN),
            ("object outside every view", BALL, aside), ("magnification above 1000", BALL, near),
        ):  # fmt: skip
            wrong = {"sample": sample, "geometry": geometry}
            yield Mistake(where, "another unit", about, (), wrong)


def _orders() -> Iterator[Mistake]:
    for where, (call, right) in RIGHT.items():
        places = [
            right[name]
            for name, parameter in inspect.signature(call).parameters.items()
            if parameter.kind is parameter.POSITIONAL_OR_KEYWORD and name in right
        ]
        for i in range(len(places) - 1):
            if type(places[i]) is not type(places[i + 1]):
                swapped = [*places[:i], places[i + 1], places[i], *places[i + 2 :]]
                about = f"places {i} and {i + 1}"
                yield Mistake(where, "another order", about, tuple(swapped), {})


def _names(draw: random.Random) -> Iterator[Mistake]:
    for where, (call, right) in RIGHT.items():
        for name in inspect.signature(call).parameters:
            if name not in right:
                continue
            at = draw.randrange(len(name))
            letter = draw.choice(string.ascii_lowercase)
            wrong = draw.choice(
                [name[:at] + name[at + 1 :], name[:at] + letter + name[at:], name + "s",
                 name.upper(), name[:at] + name[at:][::-1]]
            )  # fmt: skip
            if wrong and wrong not in inspect.signature(call).parameters:
                named = {wrong if n == name else n: value for n, value in right.items()}
                yield Mistake(where, "another name", f"{wrong} for {name}", (), named)


def _drawn() -> list[Mistake]:
    draw = random.Random(39)
    kinds = (_types(), _shapes(), _units(), _orders(), _names(draw))
    pools = [draw.sample(pool, len(pool)) for pool in map(list, kinds)]
    each = IN_ALL // len(pools)
    some = [mistake for pool in pools for mistake in pool[:each]]
    rest = [mistake for pool in pools for mistake in pool[each:]]
    return [*some, *draw.sample(rest, IN_ALL - len(some))]


def _answer(mistake: Mistake) -> str:
    """What is wrong with the answer to a mistake; nothing where it is a sentence."""
    call = RIGHT[mistake.where][0]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            call(*mistake.given, **mistake.named)
        except fx.TwinError as error:
            text = str(error)
            known = "allowed" in text or "did you mean" in text or "must be" in text
            return "" if known else f"does not say what is allowed: {text}"
        except Exception as error:
            return f"{type(error).__name__}: {error}"
    said = [str(w.message) for w in told if "are all lengths in mm?" in str(w.message)]
    return "" if said and mistake.kind == "another unit" else "accepted"


def test_the_right_calls_cover_every_name() -> None:
    missing = {
        name for name in fx.__all__ if not any(r.split(".")[0] == name for r in RIGHT)
    }
    assert missing == NO_CALLS


def test_mistakes_drawn_over_the_signatures_get_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    drawn = _drawn()
    failed = {str(m): answer for m in drawn if (answer := _answer(m))}
    listed = "\n".join(f"{mistake}: {answer}" for mistake, answer in failed.items())
    print(f"{len(drawn) - len(failed)} of {len(drawn)} mistakes get a sentence\n{listed}")
    assert len(drawn) == IN_ALL
    assert len(failed) <= 0.05 * IN_ALL, listed


def test_numpy_s_scalars_are_taken_as_python_s() -> None:
    def given(
        yes: bool, whole: int, number: float, none: bool | None = None
    ) -> tuple[Any, ...]:
        return yes, whole, number, none

    told: Callable[..., tuple[Any, ...]] = public(given)
    for kind in (np.int8, np.uint16, np.int64):
        for real in (np.float32, np.float64, kind):
            for yes in (np.True_, np.array(True), True):
                assert told(yes, kind(3), real(2), yes) == (True, 3, 2.0, True)
    for wrong in ((np.array([True]), 1, 1.0), (np.int8(1), 1, 1.0), (True, np.float64(1), 1.0),
                  (True, np.True_, 1.0), (True, 1, np.True_)):  # fmt: skip
        with pytest.raises(fx.TwinError, match=r"given: .* is .*; allowed: "):
            told(*wrong)
