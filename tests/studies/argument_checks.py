"""Mistakes in calls: what `twin/signatures.py`, pydantic's `validate_call` and neither answer.

    python tests/studies/argument_checks.py [WAY]

Each way runs in a process of its own, where nothing else checks arguments. The mistakes and the
right calls are those of `tests/face/test_mistakes.py`. validate_call gets every help: names
resolved as `signatures.py` resolves them, arrays tested by the same function, its errors made
one sentence.
docs/decisions/0022-own-argument-checks.md quotes it.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import os
import subprocess
import sys
import textwrap
import time
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import partial, wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

ROOT: Final = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np  # noqa: E402
from code_lines import code_lines  # noqa: E402

from flexdt.twin import signatures  # noqa: E402

CALLS: Final = 2000
"""In a measurement of the time that a call takes."""
REPEATS: Final = 7
"""Measurements, of which the shortest counts."""
ALLOWED: Final = ("allowed", "must be", "did you mean")
"""Words of a sentence that says what is allowed, as the test has them."""
NEEDED: Final = (
    "translated",
    "resolved",
    "sentence",
    "by_pydantic",
    "_as_array",
    "_as_instance",
)
"""Functions of this module that flexdt would need with validate_call."""
REPLACED: Final = (
    "Kind",
    "kinds",
    "checked",
    "kind_of",
    "_is_number",
    "_is_list",
    "PLAIN",
)
"""What of `twin/signatures.py` they would stand for."""
IMPORTS: Final = {
    "flexdt.ConeVec": "import flexdt; flexdt.ConeVec",
    "flexdt.ConeVec and validate_call":
        "import flexdt; flexdt.ConeVec; from pydantic import validate_call",
}  # fmt: skip
Arguments = tuple[tuple[Any, ...], dict[str, Any]]
Check = Callable[[tuple[Any, ...], dict[str, Any]], Arguments]
"""Arguments of a call -> those that the function gets; raises `ArgumentError`."""
OWN_WRAPPER: Final = signatures._checked
"""What `public` wraps a function with, before this study puts another in its place."""


# -- the ways --------------------------------------------------------------------------------


def by_nothing(function: Callable[..., Any], text: str) -> Check:
    """Let all arguments through."""
    return lambda given, named: (given, named)


def by_signatures(function: Callable[..., Any], text: str) -> Check:
    """Check by `twin/signatures.py`."""
    known = signatures.Known(function, text)
    known.kinds  # noqa: B018  (read here, as validate_call does)
    return lambda given, named: (given, known.checked(given, named))


def by_pydantic_alone(function: Callable[..., Any], text: str) -> Check:
    """Check by validate_call as it comes; its "should be" counts as "must be".

    Args:
        function: whose arguments they are.
        text: its documentation, which is not used.

    Returns:
        The check; it raises `signatures.ArgumentError`.
    """
    from pydantic import ConfigDict, ValidationError, validate_call

    def arguments(*given: Any, **named: Any) -> Arguments:
        return given, named

    shown: Any = wraps(function)(arguments)
    shown.__signature__ = inspect.signature(function)
    validated: Any = validate_call(config=ConfigDict(arbitrary_types_allowed=True))(shown)

    def check(given: tuple[Any, ...], named: dict[str, Any]) -> Arguments:
        """Return the arguments as pydantic passes them on; ArgumentError with its text if
        they do not fit.
        """
        try:
            found: Arguments = validated(*given, **named)
        except ValidationError as error:
            raise signatures.ArgumentError(
                str(error).replace("should be", "must be")
            ) from None
        return found

    return check


def by_pydantic(*, strict: bool) -> Callable[[Callable[..., Any], str], Check]:
    """Check by validate_call, in lax or strict mode."""
    from pydantic import ConfigDict, ValidationError, validate_call

    config = ConfigDict(arbitrary_types_allowed=True, strict=strict)

    def made(function: Callable[..., Any], text: str) -> Check:
        """Make the check of one function; `text` is its documentation."""
        known = signatures.Known(function, text)
        validated: Any = validate_call(config=config)(resolved(function))

        def check(given: tuple[Any, ...], named: dict[str, Any]) -> Arguments:
            """Return the arguments as pydantic passes them on; ArgumentError with a
            sentence if they do not fit.
            """
            try:
                found: Arguments = validated(*given, **named)
            except ValidationError as error:
                said = sentence(function, known._name_for(given), error, (given, named))
                raise signatures.ArgumentError(said) from None
            return found

        return check

    return made


def resolved(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function with the same parameters that returns its arguments; annotations are
    objects.

    Texts of annotations are evaluated among the function's own names.
    """
    numpy_types = types.SimpleNamespace(
        ArrayLike=signatures.Array, NDArray=signatures.Array
    )
    names = signatures.Names(function.__globals__, npt=numpy_types)

    def arguments(*given: Any, **named: Any) -> Arguments:
        return given, named

    parameters = [
        one.replace(annotation=translated(
            eval(one.annotation, {}, names) if isinstance(one.annotation, str) else one.annotation
        ))
        for one in inspect.signature(function).parameters.values()
    ]  # fmt: skip
    shown: Any = arguments
    shown.__name__, shown.__qualname__ = function.__name__, function.__qualname__
    shown.__signature__ = inspect.Signature(parameters)
    shown.__annotations__ = {
        p.name: p.annotation
        for p in parameters
        if p.annotation is not inspect.Parameter.empty
    }
    return arguments


def translated(annotation: Any) -> Any:
    """An annotation with what pydantic cannot test replaced by what it can."""
    from pydantic import AfterValidator

    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is signatures.Array or getattr(origin, "__name__", "") == "ndarray":
        return Annotated[Any, AfterValidator(_as_array)]
    if annotation is signatures.PathLike:
        return os.PathLike
    if origin in (typing.Union, types.UnionType):
        return typing.Union[tuple(map(translated, parts))]  # noqa: UP007  (made of a tuple)
    if origin in (tuple, list, Sequence, Mapping):
        return origin[tuple(part if part is ... else translated(part) for part in parts)]
    if isinstance(annotation, type) and is_dataclass(
        annotation
    ):  # validate_call would look into its fields
        return Annotated[Any, AfterValidator(partial(_as_instance, annotation))]
    if getattr(annotation, "_is_protocol", False):
        return Any
    return annotation


def _as_array(value: Any) -> Any:
    if not signatures._is_numbers(value):
        raise ValueError("an array of numbers")
    return value


def _as_instance(kind: type, value: Any) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"a {kind.__name__}")
    return value


def sentence(
    function: Callable[..., Any], where: str, error: Any, call: Arguments
) -> str:
    """What pydantic says of the first argument that does not hold, as one sentence.

    An unknown argument comes before all others.

    Args:
        function: whose arguments they are.
        where: its name for the user.
        error: pydantic's.
        call: the arguments given.
    """
    takes = inspect.signature(function).parameters
    found = error.errors(include_url=False)
    unknown = (one for one in found if one["type"] == "unexpected_keyword_argument")
    first = next(unknown, found[0])
    at = first["loc"][0] if first["loc"] else ""
    name = [*takes][at] if isinstance(at, int) and at < len(takes) else str(at)
    if first["type"] == "unexpected_keyword_argument":
        names = [one for one in takes if one not in ("self", "cls")]
        return f"{where} has no argument {name!r}; allowed: {', '.join(names)}"
    said = [
        one["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        for one in found
        if one["loc"][:1] == first["loc"][:1]
    ]
    words = " or ".join(dict.fromkeys(said))
    value = {**dict(zip(takes, call[0], strict=False)), **call[1]}.get(name)
    return f"{where}: {name} is {signatures._value_words(value)}; allowed: {words}"


WAYS: Final[dict[str, Callable[[], Callable[[Callable[..., Any], str], Check]]]] = {
    "neither": lambda: by_nothing,
    "signatures.py": lambda: by_signatures,
    "validate_call alone": lambda: by_pydantic_alone,
    "validate_call, helped": lambda: by_pydantic(strict=False),
    "validate_call, helped, strict": lambda: by_pydantic(strict=True),
}


# -- one way, in a process of its own --------------------------------------------------------


class Checks:
    """Stands for `signatures._checked`, with another way; builds each check when it is first
    used.

    Attributes:
        build_s: processor time that building took.
        built: how many were built.
        failed: functions whose check could not be built, and why.
    """

    def __init__(self, way: Callable[[Callable[..., Any], str], Check]) -> None:
        self.way = way
        self.build_s, self.built = 0.0, 0
        self.failed: dict[str, str] = {}

    def built_check(self, function: Callable[..., Any], text: str) -> Check:
        """The check of a function; lets all through where it cannot be built."""
        begun = time.process_time()
        try:
            made = self.way(function, text)
        except Exception as error:
            self.failed[function.__qualname__] = f"{type(error).__name__}: {error}".split(
                "\n"
            )[0]
            made = by_nothing(function, text)
        self.build_s += time.process_time() - begun
        self.built += 1
        return made

    def __call__(self, function: Callable[..., Any], text: str) -> Callable[..., Any]:
        """The function with its check."""
        made: list[Check] = []

        def check(given: tuple[Any, ...], named: dict[str, Any]) -> Arguments:
            if not made:
                made.append(self.built_check(function, text))
            return made[0](given, named)

        @wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            args, kwargs = check(given, named)
            return function(*args, **kwargs)

        call.check = check  # type: ignore[attr-defined]
        call.names = {*inspect.signature(function).parameters}  # type: ignore[attr-defined]
        return call


def measured(way: str) -> dict[str, Any]:
    """What a way answers, refuses and costs; it stays in place of the own checks for the
    process.

    Args:
        way: one of WAYS.

    Returns:
        Counts, times and texts, for JSON.
    """
    checks = Checks(WAYS[way]())
    signatures._checked = checks  # type: ignore[assignment]
    from tests.face import test_mistakes as mistakes

    kinds, whole = dict[str, list[int]](), 0
    unanswered, parts = list[str](), list[str]()
    for mistake in mistakes._drawn():
        wrong = mistakes._answer(mistake)
        count = kinds.setdefault(mistake.kind, [0, 0])
        count[0] += not wrong
        count[1] += 1
        if wrong:
            unanswered.append(f"{mistake}: {wrong}"[:160])
        else:
            text = told(mistakes.RIGHT[mistake.where][0], mistake)
            whole += four_parts(mistake, text)
            if not four_parts(mistake, text):
                parts.append(f"{mistake}: {text}"[:160])
    tried, refused = 0, list[str]()
    for name, answer in right_calls(mistakes.RIGHT):
        tried += 1
        refused += [f"{name}: {answer}"] if answer else []
    return {
        "answered": sum(count[0] for count in kinds.values()), "four parts": whole, "kinds": kinds,
        "unanswered": unanswered, "in part": parts, "right calls": tried, "refused": refused,
        "build_ms": 1e3 * checks.build_s, "built": checks.built, "failed": checks.failed,
        "calls": call_times(way),
    }  # fmt: skip


def told(call: Callable[..., Any], mistake: Any) -> str:
    """The text of the error, or of the warnings."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            call(*mistake.given, **mistake.named)
        except Exception as error:
            return str(error)
    return " ".join(str(one.message) for one in heard)


def four_parts(mistake: Any, text: str) -> bool:
    """Whether a text names function, argument, what was given and what is allowed."""
    function = (
        mistake.where.rpartition(".")[2] in text or mistake.where.split(".")[0] in text
    )
    allowed = any(word in text for word in ALLOWED)
    if mistake.kind == "another order":
        return function and allowed and " is " in text
    name = mistake.about.split("=")[0].split(" ")[0]
    if mistake.kind == "another name":
        return function and allowed and repr(name) in text
    value = mistake.named.get(name)
    forms = {repr(value)[:20], f"a {type(value).__name__}", f"an {type(value).__name__}",
             str(np.shape(value))}  # fmt: skip
    forms |= {f"{value:g}"} if isinstance(value, float) else set()
    return function and allowed and name in text and any(form in text for form in forms)


def right_calls(right: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Right calls, and the same with equal values of other types -> the refusal, if it is
    one."""
    for where, (call, named) in right.items():
        inner: Any = getattr(
            call, "__init__" if isinstance(call, type) else "__func__", call
        )
        check = getattr(inner, "check", None)
        if check is None or not named.keys() <= inner.names:
            continue
        made: tuple[Any, ...] = (object.__new__(call),) if isinstance(call, type) else ()
        first = (call.__self__,) if hasattr(call, "__self__") else made
        forms = [("as it is", dict(named))]
        for name, value in named.items():
            forms += [
                (f"{name}={other!r} ({type(other).__name__})", {**named, name: other})
                for other in equal(value)
            ]
        for form, given in forms:
            try:
                check(first, given)
            except Exception as error:
                yield (
                    f"{where}, {form}",
                    f"{type(error).__name__}: {error}".split("\n")[0][:160],
                )
            else:
                yield f"{where}, {form}", ""


def equal(value: Any) -> list[Any]:
    """The same value as the types that users of numpy and pathlib have."""
    if isinstance(value, bool):
        return [np.bool_(value)]
    if isinstance(value, int):
        return [np.int64(value), np.uint16(value)]
    if isinstance(value, float):
        whole = [int(value), np.int64(value)] if value.is_integer() else []
        return [np.float64(value), np.float32(value), np.array(value), *whole]
    if isinstance(value, tuple) and all(isinstance(one, int | float) for one in value):
        return [list(value), np.array(value)]
    return []


def call_times(way: str) -> dict[str, float]:
    """Time that a check adds to a call [us], by kind of arguments."""

    def scalars(a: float, b: int = 2, *, c: str = "x", d: float | None = None) -> None:
        """Take four scalars."""

    def arrays(a: signatures.Array, b: signatures.Array | float) -> None:
        """Take two arrays."""

    def numbers(a: Sequence[float]) -> None:
        """Take a list."""

    image, listed = np.zeros((4, 60, 80)), [float(i) for i in range(10_000)]
    cases: dict[str, tuple[Any, Arguments]] = {
        "four scalars": (scalars, ((1.5,), {"b": 3, "c": "y"})),
        "two arrays": (arrays, ((image, image), {})),
        "10 000 numbers": (numbers, ((listed,), {})),
    }
    found = {}
    for name, (function, (given, named)) in cases.items():
        own = way == "signatures.py"
        # The own wrapper also remembers types that were allowed once.
        checked = OWN_WRAPPER(function, "") if own else Checks(WAYS[way]())(function, "")
        calls = CALLS // 20 if name == "10 000 numbers" else CALLS
        times = [_time(call, given, named, calls) for call in (checked, function)]
        found[name] = 1e6 * (times[0] - times[1])
    return found


def _time(
    call: Callable[..., Any], given: tuple[Any, ...], named: Any, calls: int
) -> float:
    """Shortest mean processor time of a call [s]."""
    call(*given, **named)
    shortest = float("inf")
    for _ in range(REPEATS):
        begun = time.process_time()
        for _ in range(calls):
            call(*given, **named)
        shortest = min(shortest, (time.process_time() - begun) / calls)
    return shortest


# -- all ways, side by side ------------------------------------------------------------------


def import_times() -> Iterator[tuple[str, float, bool]]:
    """Shortest processor time of imports [ms], and whether they load pydantic."""
    for name, statement in IMPORTS.items():
        code = (f"import time, sys; t = time.process_time(); {statement}; "
                "print(1e3 * (time.process_time() - t), 'pydantic' in sys.modules)")  # fmt: skip
        runs = [
            subprocess.run(
                [sys.executable, "-c", code], capture_output=True, text=True, check=True
            )
            for _ in range(REPEATS)
        ]
        times = [run.stdout.split() for run in runs]
        yield name, min(float(ms) for ms, _ in times), times[0][1] == "True"


def lines_of(file: Path, names: Sequence[str]) -> int:
    """Code lines of these functions, methods, classes and constants of a module."""
    text = file.read_text("utf-8")
    return sum(
        code_lines(textwrap.dedent(ast.get_source_segment(text, node, padded=True) or ""))
        for node in ast.walk(ast.parse(text))
        if getattr(node, "name", getattr(getattr(node, "target", None), "id", None))
        in names
    )


def main() -> None:
    """Measure one way as JSON, or all of them as a report."""
    parser = argparse.ArgumentParser(
        description="Mistakes in calls, answered in several ways."
    )
    parser.add_argument("way", nargs="?", choices=[*WAYS])
    way = parser.parse_args().way
    if way is not None:
        with TemporaryDirectory() as folder:
            os.chdir(folder)
            print(json.dumps(measured(way)))
        return
    for way in WAYS:
        done = subprocess.run(
            [sys.executable, __file__, way], capture_output=True, text=True, check=False
        )
        if done.returncode:
            *_, why = (
                line for line in done.stderr.splitlines() if "ArgumentError: " in line
            )
            print(
                f"\n{way}: refuses calls that flexdt itself makes: {why.split(': ', 1)[1]}"
            )
            continue
        found = json.loads(done.stdout.splitlines()[-1])
        kinds = ", ".join(f"{kind} {a} of {b}" for kind, (a, b) in found["kinds"].items())
        print(f"\n{way}: {found['answered']} of 150 mistakes get a sentence ({kinds});")
        print(
            f"  {found['four parts']} name function, argument, the given and the allowed"
        )
        print(f"  refused of {found['right calls']} right calls: {len(found['refused'])}")
        print(f"  {found['built']} checks built in {found['build_ms']:.0f} ms;", end=" ")
        print(
            "added to a call:",
            ", ".join(f"{n} {us:.2f} us" for n, us in found["calls"].items()),
        )
        for title in ("unanswered", "in part", "refused"):
            print(*(f"    {title}: {line}" for line in found[title]), sep="\n")
        print(
            *(f"    not built: {n}: {why}" for n, why in found["failed"].items()),
            sep="\n",
        )
    for name, ms, loaded in import_times():
        print(
            f"import of {name}: {ms:.0f} ms; pydantic is {'' if loaded else 'not '}loaded"
        )
    own = ROOT / "twin" / "signatures.py"
    print(
        f"code lines of twin/signatures.py: {code_lines(own.read_text('utf-8'))};",
        end=" ",
    )
    print(f"validate_call would stand for {lines_of(own, REPLACED)}", end=" ")
    print(f"and need {lines_of(Path(__file__), NEEDED)}")


if __name__ == "__main__":
    main()
