"""Public functions and classes: what their signatures say, said to the caller.

`public` compares the arguments of a call with the annotations of the signature, so that a
misspelled keyword, two arguments in the wrong order or a value of another type is one sentence
that says what was given and what is allowed. Values are checked by what is called, as before.
"""

from __future__ import annotations

import builtins
import inspect
import re
import types
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache, wraps
from numbers import Real
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NamedTuple,
    ParamSpec,
    Protocol,
    TypeVar,
)

from flexdt.twin.errors import (
    FileError,
    GeometryError,
    LimitError,
    TwinError,
    nearest_name,
    shape_words,
)

P = ParamSpec("P")
Result = TypeVar("Result")
Thing = TypeVar("Thing", bound=Callable[..., Any])

NAMES: Final = (("voxel", "voxel_mm"), ("center", "center_mm"), ("geometry", "cone_vec"))
"""Names of one thing (docs/conventions.md): where a signature has one, the other is
deprecated."""
REAL_KINDS: Final = "biuf"
"""Kinds of numpy's types that hold real numbers or truth values."""
MAX_SHOWN_CHARS: Final = 60
"""Characters of a value that a message repeats."""
PLAIN_TYPES: Final = frozenset({bool, int, float, type(None)})
"""Types of values that have no content."""
MAX_KNOWN_TYPES: Final = 256
"""Types of arguments that are remembered."""
MAX_CHECKED_MEMBERS: Final = 100
"""Members of a list that are compared with the annotation: mistakes stand at the beginning."""


CALLED: Final = "__flexdt_called__"
"""Attribute of a function with the name by which users call it, where that is another."""


class ArgumentError(GeometryError, LimitError, TypeError):
    """An argument that a function does not have, or of a type that it does not take.

    Who handles the errors that these functions raise for wrong values handles this one, too.
    """


class PathLike(Protocol):
    """A path as an object, such as one of `pathlib`."""

    def __fspath__(self) -> str:
        """As text."""


File = str | PathLike
"""A path, as text or as an object of `pathlib`."""


class Array:
    """Stands for what numpy calls ArrayLike, a union of which texts are a part."""

    def __class_getitem__(cls, member: object) -> type[Array]:
        """Return the class itself, so that `Array[...]` is allowed in annotations."""
        return cls


if typing.TYPE_CHECKING:
    from numpy.typing import ArrayLike

    Numbers = ArrayLike
else:
    Numbers = Array
"""ArrayLike in a union that a module names: evaluated, numpy's own has its inner names."""


class Kind(NamedTuple):
    """What an annotation allows: in words, and as a test."""

    words: tuple[str, ...]
    holds: Callable[[Any], bool]


def with_arguments_of(
    other: Callable[P, object],
) -> Callable[[Callable[..., Result]], Callable[P, Result]]:
    """Make a decorator that gives a function the shown signature of `other`, for `help`
    and type checkers; its own result type stays.

    Calls are not checked; the function itself is changed and returned.
    """

    def typed(function: Callable[..., Result]) -> Callable[P, Result]:
        """Give the function the other's parameters, with its own result, and return it itself.

        Only the signature that is shown changes; calls are not checked.
        """
        result = inspect.signature(function).return_annotation
        shown = inspect.signature(other).replace(return_annotation=result)
        function.__signature__ = shown  # type: ignore[attr-defined]
        return function

    return typed


def with_options_of(declared: type) -> Callable[[Thing], Thing]:
    """Make a decorator that replaces a function's `**options` by the keys of a TypedDict,
    keyword-only and None by default.

    They appear in its shown signature, and their descriptions in its docstring, in place
    of the line `options: OPTIONS` of its arguments. The function itself is changed; calls
    are not checked.

    Args:
        declared: the TypedDict, whose docstring has a last section `Args:`.
    """
    descriptions = inspect.cleandoc(declared.__doc__ or "").partition("Args:\n")[2]
    hints = typing.get_type_hints(declared)
    keyword = inspect.Parameter.KEYWORD_ONLY
    more = [
        inspect.Parameter(n, keyword, default=None, annotation=h)
        for n, h in hints.items()
    ]

    def declaring(function: Thing) -> Thing:
        """Replace `**options` in the function's shown signature and docstring; return the
        function.
        """
        signature = inspect.signature(function)
        named = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        function.__signature__ = signature.replace(parameters=[*named, *more])  # type: ignore[attr-defined]
        text = inspect.cleandoc(function.__doc__ or "")
        function.__doc__ = text.replace("    options: OPTIONS", descriptions.rstrip())
        return function

    return declaring


def called(name: str) -> Callable[[Thing], Thing]:
    """Make a decorator that says by which name users call a function, for messages; it stands
    below `public`.
    """

    def naming(function: Thing) -> Thing:
        """Keep the name with the function, and return it."""
        setattr(function, CALLED, name)
        return function

    return naming


def public(thing: Thing) -> Thing:
    """Make calls of a function, or of a class and its methods, check their arguments
    (decorator).

    Public methods of a class, class and static methods too, and its own `__init__` are
    replaced in place; the class is returned. Calls may be made under the deprecated names
    of `NAMES`.

    Args:
        thing: function, which is wrapped, or class, whose public methods are replaced.

    Raises:
        ArgumentError: when called with arguments that the signature does not allow.

    Example:
        >>> @public
        ... def scaled(value: float, by: int = 2) -> float:
        ...     return value * by
        >>> for wrong in ({"value": "1.5"}, {"value": 1.5, "bye": 3}):
        ...     try:
        ...         scaled(**wrong)
        ...     except ArgumentError as error:
        ...         print(error)
        scaled: value is '1.5'; allowed: a number
        scaled has no argument 'bye' (did you mean 'by'?); allowed: value, by
    """
    text = inspect.getdoc(thing) or ""
    if not isinstance(thing, type):
        return _checked(thing, text)
    for name, member in list(vars(thing).items()):
        if name == "__init__" or not name.startswith("_"):
            if isinstance(member, classmethod | staticmethod):
                inside = member.__func__
                setattr(
                    thing,
                    name,
                    type(member)(_checked(inside, inspect.getdoc(inside) or "")),
                )
            elif inspect.isfunction(member):
                description = text
                if name != "__init__":
                    description = inspect.getdoc(member) or ""
                setattr(thing, name, _checked(member, description))
    return thing


def _checked(function: Thing, text: str) -> Thing:
    """Wrap a function so that the arguments of each call are checked (`Known.checked`).

    Args:
        function: to be wrapped; its signature is read at the first call.
        text: docstring that describes its arguments.
    """
    known = Known(function, text)

    @wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        """Check the arguments of a call, rename deprecated ones, then call the function
        and return its result.

        Types that were allowed together before are not checked again, where types alone
        decide. What the system says of a file becomes a `FileError`.
        """
        # Types that have been allowed together once are not looked at again.
        types_of = (*map(_type, given), *named, *map(_type, named.values()))
        if None in types_of or types_of not in known.allowed:
            checked = known.checked(given, named)
            if checked.keys() == named.keys():
                known.allowed.add(types_of)
            named = checked
        try:
            return function(*given, **named)
        except OSError as error:
            if isinstance(error, TwinError) or error.filename is None:
                raise
            raise FileError.of(error) from None

    return call  # type: ignore[return-value]


def _type(value: Any) -> Any:
    """Return what decides whether a value is allowed: its type, for an array (dtype,
    ndim), for a tuple those of its members; None where the content decides, too.

    That is so for mappings, lists, texts, arrays of one dimension and masked arrays.
    """
    kind = type(value)
    if kind in PLAIN_TYPES:
        return kind
    if kind is tuple:
        inner = tuple(map(_type, value[:MAX_CHECKED_MEMBERS]))
        return None if None in inner else inner
    # A type has a hash, whatever mypy says of its metaclass.
    if _has_content(kind) or hasattr(value, "mask"):  # type: ignore[arg-type]
        return None
    dimensions = getattr(value, "ndim", None)
    if dimensions is None:
        return kind
    return None if dimensions == 1 else (value.dtype, dimensions)


@lru_cache(MAX_KNOWN_TYPES)
def _has_content(kind: type) -> bool:
    """Return whether values of a type are mappings, lists, tuples or texts, whose content
    decides; asking abstract classes at every call would cost more than all else here."""
    return issubclass(kind, Mapping | list | tuple | str)


class Known:
    """The signature of a function, read when it is first called.

    Attributes:
        allowed: types of arguments that were allowed, where types alone decide.
    """

    def __init__(self, function: Callable[..., Any], text: str) -> None:
        """Take a function and the docstring that describes it; no combination of types is
        allowed yet.
        """
        self.function = function
        self.text = text
        self.allowed: set[tuple[Any, ...]] = set()
        called = getattr(function, CALLED, function.__qualname__)
        self.qualname = called.split("<locals>.")[-1]

    @cached_property
    def signature(self) -> inspect.Signature:
        """Names, defaults and annotations."""
        return inspect.signature(self.function)

    @cached_property
    def kinds(self) -> dict[str, Kind]:
        """Kind of value allowed for each argument whose annotation states one; others are
        left out.

        Annotations given as texts are evaluated with the names of the function's module.
        """
        names = Names(
            self.function.__globals__,
            npt=types.SimpleNamespace(ArrayLike=Array, NDArray=Array),
        )
        kinds = {}
        for name, parameter in self.signature.parameters.items():
            annotation = parameter.annotation
            kinds[name] = kind_of(
                eval(annotation, {}, names) if isinstance(annotation, str) else annotation
            )
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def checked(self, given: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
        """Check the arguments of a call against names and annotations.

        `*` arguments are not compared with their annotation; each of `**` is.

        Args:
            given: positional arguments.
            named: keyword arguments.

        Returns:
            The keyword arguments, under the names that the signature has; values
            unchanged.

        Raises:
            ArgumentError: arguments that the signature does not allow.
        """
        where = self._name_for(given)
        named = self._renamed(where, named)
        try:
            bound = self.signature.bind(*given, **named).arguments
        except TypeError as error:
            raise ArgumentError.instead(
                f"{where}: {error}",
                [*map(_value_words, given[self._own() :]), *named],
                self._names(),
            ) from None
        for name, value in bound.items():
            kind = self.kinds.get(name)
            form = self.signature.parameters[name].kind
            members = value
            if form is not inspect.Parameter.VAR_KEYWORD:
                members = {name: value}
            if kind is None or form is inspect.Parameter.VAR_POSITIONAL:
                continue
            for label, one in members.items():
                if not kind.holds(one):
                    raise self._mistake(where, name, label, one, bound)
        return named

    def _name_for(self, given: tuple[Any, ...]) -> str:
        """Name the function as its caller does: a method by the class of its first
        argument, if that has the method's class as a base.

        Otherwise by the name it was defined with; `.__init__` is left out.

        Args:
            given: positional arguments of the call.
        """
        owner, dot, method = self.qualname.rpartition(".")
        if given and isinstance(given[0], type):
            called = given[0]
        else:
            called = type(next(iter(given), None))
        known = any(base.__name__ == owner for base in called.__mro__)
        name = f"{called.__name__ if known else owner}{dot}{method}"
        return name.removesuffix(".__init__")

    def _own(self) -> int:
        """Return how many first arguments the language gives: `self` or `cls`."""
        return int(next(iter(self.signature.parameters), "") in ("self", "cls"))

    def _names(self) -> list[str]:
        """List the names of the function's parameters without `self` and `cls`."""
        return [name for name in self.signature.parameters if name not in ("self", "cls")]

    def _renamed(self, where: str, named: dict[str, Any]) -> dict[str, Any]:
        """Rename deprecated keyword arguments (`NAMES`), with a DeprecationWarning, and
        refuse unknown ones.

        Functions with `**` arguments take all names unchanged. A deprecated name beside
        its new one is refused.

        Args:
            where: name of the function, for messages.
            named: keyword arguments.

        Returns:
            The keyword arguments under the signature's names.

        Raises:
            ArgumentError: a name that the function does not take; suggests the nearest
                one.
        """
        takes = self.signature.parameters
        if any(one.kind is inspect.Parameter.VAR_KEYWORD for one in takes.values()):
            return named
        renamed = {}
        for name, value in named.items():
            other = next(
                (b for pair in NAMES for a, b in (pair, pair[::-1]) if a == name), ""
            )
            if name in takes:
                renamed[name] = value
            elif other in takes and other not in named:
                text = f"{where}: {name} is called {other} here"
                warnings.warn(text, DeprecationWarning, stacklevel=4)
                renamed[other] = value
            else:
                near = nearest_name(name, self._names(), named)
                hint = ""
                if near is not None:
                    hint = f" (did you mean {near!r}?)"
                problem = f"{where} has no argument {name!r}{hint}"
                raise ArgumentError.instead(problem, name, self._names())
        return renamed

    def _mistake(
        self, where: str, name: str, label: str, value: object, values: Mapping[str, Any]
    ) -> ArgumentError:
        """Make the error for an argument of a type that is not allowed; returned, not
        raised.

        It quotes the first sentence of the argument's description. It asks if two
        arguments are swapped, or, for a value of our own, if its attribute of that name
        is meant.

        Args:
            where: name of the function.
            name: parameter.
            label: name under which the value was given.
            value: that is not allowed.
            values: all arguments of the call.
        """
        *first, last = self.kinds[name].words
        words = last
        if first:
            words = f"{', '.join(first)} or {last}"
        takes = self.signature.parameters
        places = [
            n for n in self._names() if takes[n].kind is takes[n].POSITIONAL_OR_KEYWORD
        ]
        swapped = [
            other
            for other in places
            if name in places and other in values
            if self.kinds[name].holds(values[other])
            and (other not in self.kinds or self.kinds[other].holds(value))
        ]
        hint = ""
        if swapped:
            hint = f"; are {label} and {swapped[-1]} in the wrong order?"
        elif type(value).__module__.startswith("flexdt") and name in dir(value):
            hint = f"; its .{name} may be meant"
        described = re.search(
            rf"^ +(?:\w+, )*{name}(?:, \w+)*: (.*(?:\n {{8}}.*)*)", self.text, re.M
        )
        more = ""
        if described:
            sentence = " ".join(described[1].split()).split(". ")[0].rstrip(".")
            sentence = re.sub(r"\((\w+),\)", r"of \1", sentence)
            more = f" ({sentence})"
        problem = f"{where}: {label} is {_value_words(value)}"
        return ArgumentError.instead(
            problem, repr(value)[:100], words + more + hint, argument=label
        )


class Names(dict[str, Any]):
    """What annotations name: the names of the function's module; those that only type checkers
    import are anything.
    """

    def __missing__(self, name: str) -> Any:
        """Return the builtin of that name, or Any if there is none."""
        return getattr(builtins, name, Any)


def kind_of(annotation: Any) -> Kind | None:
    """Find the kind of value that an annotation allows.

    An annotated type also allows a mapping, a protocol whatever has its methods, an array
    whatever an array of numbers can be made of; a union with a member that allows
    anything does, too.

    Args:
        annotation: of a parameter, evaluated.

    Returns:
        The kind, with its words and its test; None where the annotation allows anything,
        or is not understood.

    Example:
        >>> kind_of(float | None).words, kind_of(tuple[int, int]).holds((3, 4.5))
        (('a number', 'None'), False)
    """
    origin = typing.get_origin(annotation)
    form = _FORMS.get(origin)
    if form is not None:
        return form(typing.get_args(annotation))
    if annotation is Array or getattr(origin, "__name__", "") == "ndarray":
        return Kind(("an array of numbers",), _is_numbers)
    wanted = origin or annotation
    anything = (Any, object, inspect.Parameter.empty)
    if wanted in (*PLAIN, *anything) or not isinstance(wanted, type):
        return PLAIN.get(wanted)
    if getattr(wanted, "_is_protocol", False):
        return _kind_of_protocol(wanted)
    return Kind((_type_words(wanted),), lambda v: isinstance(v, wanted))


def _kind_of_protocol(protocol: type) -> Kind:
    """Make the kind of values that have all methods of a protocol, `__init__` aside."""
    members = vars(protocol).items()
    methods = [n for n, m in members if inspect.isfunction(m) and n != "__init__"]
    return Kind((_type_words(protocol),), lambda v: all(hasattr(v, n) for n in methods))


def _kind_of_annotated(parts: Sequence[Any]) -> Kind:
    """Make the kind of an annotated type, which its owner also makes of its JSON."""
    wanted = parts[0]
    return Kind((_type_words(wanted),), lambda v: isinstance(v, (wanted, Mapping)))


def _kind_of_union(parts: Sequence[Any]) -> Kind | None:
    """Make the kind of values that one of the members allows; None if one allows anything."""
    inner = [kind_of(part) for part in parts]
    kinds = [kind for kind in inner if kind is not None]
    if len(kinds) < len(inner):
        return None
    words = tuple(dict.fromkeys(word for kind in kinds for word in kind.words))
    return Kind(words, lambda v: any(k.holds(v) for k in kinds))


def _kind_of_literal(parts: Sequence[Any]) -> Kind:
    """Make the kind of these values, each of its own type: True is not 1."""
    words = tuple(map(repr, parts))
    return Kind(words, lambda v: v in [p for p in parts if type(p) is type(v)])


def _kind_of_tuple(parts: Sequence[Any]) -> Kind:
    """Make the kind of a tuple: a list of members in order, or any number of one kind
    where `...` follows it.
    """
    if ... in parts:
        return _kind_of_list(parts)
    inner = [kind_of(part) for part in parts]
    members = [_member_words(kind) for kind in inner]
    if len(set(members)) == 1:
        words = f"{_COUNTS.get(len(members), len(members))} values, each {members[0]}"
    else:
        words = f"values in this order: {', '.join(members)}"
    return Kind((words,), lambda v: _is_list(v, inner))


_COUNTS: Final = {1: "one", 2: "two", 3: "three", 4: "four"}


def _kind_of_list(parts: Sequence[Any]) -> Kind:
    """Make the kind of a list of any length, whose members are of the kind of the first part."""
    inner = [kind_of(parts[0])]
    words = f"a list, each member {_member_words(inner[0])}"
    return Kind((words,), lambda v: _is_list(v, inner, several=True))


def _member_words(kind: Kind | None) -> str:
    """Return the words of a kind of members, joined by "or"; "anything" for None."""
    return "anything" if kind is None else " or ".join(kind.words)


def _kind_of_mapping(_parts: Sequence[Any]) -> Kind:
    """Make the kind of a mapping; its keys and values may be anything."""
    return Kind(("a dictionary",), lambda v: isinstance(v, Mapping))


def _kind_of_callable(_parts: Sequence[Any]) -> Kind:
    """Make the kind of a function; its arguments and result may be anything."""
    return Kind(("a function",), callable)


_FORMS: Final[Mapping[Any, Callable[[Sequence[Any]], Kind | None]]] = {
    Annotated: _kind_of_annotated,
    typing.Union: _kind_of_union,
    types.UnionType: _kind_of_union,
    Literal: _kind_of_literal,
    tuple: _kind_of_tuple,
    list: _kind_of_list,
    Sequence: _kind_of_list,
    Mapping: _kind_of_mapping,
    Callable: _kind_of_callable,
}
"""Origin of an annotation with members -> function that makes its kind of the members."""


def _is_number(value: Any) -> bool:
    """Return whether a value is one real number: a scalar (or array of no dimension) with
    `__float__` that is no truth value."""
    alone = getattr(value, "ndim", 0) == 0 and hasattr(value, "__float__")
    return alone and not isinstance(value, bool) and getattr(value, "dtype", "") != "bool"


def _is_truth(value: Any) -> bool:
    """Return whether a value is one truth value, Python's or numpy's."""
    alone = getattr(value, "ndim", 0) == 0
    return isinstance(value, bool) or (alone and getattr(value, "dtype", "") == "bool")


def _is_numbers(value: Any) -> bool:
    """Return whether an array of numbers can be made of a value; memory on a device
    counts unread.

    Truth values in arrays and lists are numbers, one by itself is not; texts, complex
    numbers, masked values and lists of different lengths are not.
    """
    import numpy as np

    if _masks(value):
        return False
    kind = (
        "O"
        if isinstance(value, bool)
        else getattr(getattr(value, "dtype", None), "kind", None)
    )
    if kind is None and isinstance(
        value, Real | str | bytes | list | tuple | Mapping | None
    ):
        try:
            kind = np.asarray(value).dtype.kind
        except ValueError:  # lists of different lengths
            kind = "O"
    if kind is None:
        forms = (
            "__array__",
            "__array_interface__",
            "__cuda_array_interface__",
            "__dlpack__",
        )
        return any(hasattr(value, form) for form in (*forms, "__getitem__"))
    return kind in REAL_KINDS


def _masks(value: Any) -> bool:
    """Return whether a value is a masked array of numpy with at least one masked element."""
    import numpy as np

    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def _is_list(value: Any, kinds: Sequence[Kind | None], *, several: bool = False) -> bool:
    """Return whether a value is a list, or the like with a length, whose members are of
    these kinds.

    Texts, bytes, mappings and scalars are not. Only the first `MAX_CHECKED_MEMBERS` are
    compared.

    Args:
        value: any.
        kinds: of the members, in order; None allows anything.
        several: whether any number of members of the one kind is allowed; else their
            number is that of `kinds`.
    """
    if not (hasattr(value, "__len__") and hasattr(value, "__iter__")):
        return False
    alone = isinstance(value, str | bytes | Mapping) or getattr(value, "ndim", 1) == 0
    if several and not alone:
        kinds = [*kinds] * len(value)
    return (
        not alone
        and len(value) == len(kinds)
        and all(
            kind is None or kind.holds(one)
            for kind, one in zip(kinds[:MAX_CHECKED_MEMBERS], value, strict=False)
        )
    )


def _type_words(kind: type) -> str:
    """Return a type's name with its article, such as "an int"; "a path" for path-like
    objects.
    """
    name = "path"
    if kind.__name__ != "PathLike":
        name = kind.__name__
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def _value_words(value: object) -> str:
    """Format a value for a message: an array by its shape, and by its type if that is no
    real number; a short plain value itself, any other by the name of its type.

    Short is at most `MAX_SHOWN_CHARS`; plain are numbers, texts, lists, tuples, mappings
    and None.
    """
    shape = getattr(value, "shape", None)
    if shape is not None and hasattr(value, "dtype"):
        described = f"an array of shape {shape_words(shape)}"
        if _masks(value):
            return f"{described} with masked values"
        if getattr(value.dtype, "kind", "f") == "c":
            return f"{described} of {value.dtype}"
        return described
    text = repr(value)
    plain = isinstance(value, Real | str | bytes | list | tuple | Mapping | None)
    if plain and len(text) <= MAX_SHOWN_CHARS:
        return text
    return _type_words(type(value))


PLAIN: Final = {
    None: Kind(("None",), lambda v: v is None),
    types.NoneType: Kind(("None",), lambda v: v is None),
    float: Kind(("a number",), _is_number),
    int: Kind(("a whole number",), lambda v: _is_number(v) and hasattr(v, "__index__")),
    bool: Kind(("True or False",), _is_truth),
    str: Kind(("a text",), lambda v: isinstance(v, str)),
}
