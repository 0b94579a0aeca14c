"""Words of messages of all interfaces: what a value must be, and which name was meant.

Both the wire and the core use it, so it imports nothing of either. What pydantic finds is said
in flexdt's words, by the table `NEEDED` of its kinds of problems.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, Final

SUGGESTION: Final = "did you mean"
"""Words before the proposal of a name."""
LONGEST_NAME: Final = 80
"""Characters of a name that is compared with others."""


TRANSLATIONS: Final[Mapping[str, tuple[str, ...]]] = {
    # TIGRE
    "dso": ("sod",), "dsd": ("sdd",), "ndetector": ("shape",), "ddetector": ("pixel",),
    "nvoxel": ("shape",), "dvoxel": ("voxel_mm", "voxel"), "offorigin": ("center_mm", "center"),
    "offdetector": ("offset",), "rotdetector": ("tilts",), "cor": ("offset",),
    "niter": ("iterations",),
    # ASTRA and tomosipo
    "distanceoriginsource": ("sod",), "distanceorigindetector": ("sdd",), "srcorigdist": ("sod",),
    "srcobjdist": ("sod",), "srcdetdist": ("sdd",), "sourceorigin": ("sod",),
    "origindet": ("sdd",), "detectorspacingx": ("pixel",), "detectorspacingy": ("pixel",),
    "detspacingx": ("pixel",), "detspacingy": ("pixel",), "detectorrowcount": ("shape",),
    "detectorcolcount": ("shape",), "detrowcount": ("shape",), "detcolcount": ("shape",),
    "projectionangles": ("angles",), "projgeom": ("geometry", "cone_vec"),
    "volgeom": ("like", "grid"), "vectors": ("rows", "cone_vec"),
    # RTK
    "sid": ("sod", "sdd"), "sourcetoisocenterdistance": ("sod",),
    "sourcetodetectordistance": ("sdd",), "gantryangle": ("angles",), "gantryangles": ("angles",),
    "firstangle": ("angles",), "projectionoffsetx": ("offset",), "projectionoffsety": ("offset",),
    "inplaneangle": ("tilts",), "outofplaneangle": ("tilts",), "nproj": ("angles",),
    "spacing": ("pixel", "voxel_mm", "voxel"), "dimension": ("shape",), "hann": ("window",),
    # CIL
    "sourceposition": ("sod",), "detectorposition": ("sdd",), "numpixels": ("shape",),
    "pixelsize": ("pixel",), "numvoxels": ("shape",), "voxelsize": ("voxel_mm", "voxel"),
    "acquisitiongeometry": ("geometry", "cone_vec"), "imagegeometry": ("like", "grid"),
    "filter": ("window", "filters"), "alpha": ("weight",), "maxiteration": ("iterations",),
    # LEAP
    "numangles": ("angles",), "phis": ("angles",), "numrows": ("shape",), "numcols": ("shape",),
    "pixelheight": ("pixel",), "pixelwidth": ("pixel",), "centerrow": ("offset",),
    "centercol": ("offset",), "tau": ("offset",), "voxelwidth": ("voxel_mm", "voxel"),
    "voxelheight": ("voxel_mm", "voxel"), "numiter": ("iterations",), "helicalpitch": ("rise",),
    # makers' files, and what is common
    "sad": ("sod",), "fod": ("sod",), "fdd": ("sdd",), "srctoobject": ("sod",),
    "srctodetector": ("sdd",), "objecttosource": ("sod",), "cameratosource": ("sdd",),
    "objectsource": ("sod",), "numprojections": ("angles", "images", "frames"),
    "projections": ("angles", "images", "frames"), "voltage": ("kV",), "current": ("power_W",),
    "niterations": ("iterations",), "iters": ("iterations",), "lambda": ("weight",),
    "regularisation": ("weight",), "regularization": ("weight",), "method": ("algorithm",),
}  # fmt: skip
"""Word of another program (TIGRE, ASTRA, RTK, CIL, LEAP, a maker's file) in small letters
without `_` and `-` -> ours, the likeliest first."""


def _plain(name: str) -> str:
    """Return a name in small letters, without what separates its parts."""
    return name.lower().translate({ord(c): None for c in "_- "})


def nearest_name(
    asked: str, names: Sequence[str], given: Container[str] = ()
) -> str | None:
    """Return the name that is meant by `asked`: one that another program's word stands for
    (`TRANSLATIONS`), or the one that is most like it; None if none is near, or `asked` is
    longer than `LONGEST_NAME`.

    Case does not matter; of names that differ in case only, the first.

    Args:
        asked: what was given.
        names: that are allowed; of a name with a unit, such as SOD_mm, the unit counts not
            for translations.
        given: names that the caller has given beside it: none of them is meant.

    Example:
        >>> nearest_name("Axes.Move", ["axes.move", "axes.home"])
        'axes.move'
        >>> nearest_name("ssd", ["sod", "sdd"], {"sod"}), nearest_name("DSO", ["sod", "sdd"])
        ('sdd', 'sod')
    """
    if len(asked) > LONGEST_NAME:
        return None
    left = [name for name in names if name not in given]
    plain = {_plain(name): name for name in reversed(left)}
    plain |= {
        _plain(n.removesuffix("_mm")): n for n in reversed(left) if n.endswith("_mm")
    }
    for ours in TRANSLATIONS.get(_plain(asked), ()):
        if _plain(ours) in plain:
            return plain[_plain(ours)]
    by_small = {name.lower(): name for name in reversed(left)}
    near = get_close_matches(asked.lower(), by_small, 1)
    return by_small[near[0]] if near else None


NEEDED: Final[Mapping[str, str]] = {
    "missing": "is missing",
    "extra_forbidden": "there is no such name",
    "int_type": "allowed: a whole number",
    "int_parsing": "allowed: a whole number",
    "int_parsing_size": "allowed: a whole number, not as long",
    "int_from_float": "allowed: a whole number",
    "float_type": "allowed: a number",
    "float_parsing": "allowed: a number",
    "finite_number": "allowed: a finite number",
    "bool_type": "allowed: true or false",
    "bool_parsing": "allowed: true or false",
    "string_type": "allowed: a text",
    "string_unicode": "allowed: a text of Unicode",
    "string_too_short": "allowed: at least {min_length} characters",
    "string_too_long": "allowed: at most {max_length} characters",
    "string_pattern_mismatch": "allowed: a text of the form {pattern}",
    "literal_error": "allowed: {expected}",
    "enum": "allowed: {expected}",
    "greater_than": "allowed: above {gt}",
    "greater_than_equal": "allowed: at least {ge}",
    "less_than": "allowed: below {lt}",
    "less_than_equal": "allowed: at most {le}",
    "multiple_of": "allowed: a multiple of {multiple_of}",
    "too_short": "{actual_length} of them; allowed: at least {min_length}",
    "too_long": "{actual_length} of them; allowed: at most {max_length}",
    "list_type": "allowed: a list",
    "tuple_type": "allowed: a list",
    "set_type": "allowed: a list",
    "dict_type": "allowed: a table of names and values",
    "mapping_type": "allowed: a table of names and values",
    "model_type": "allowed: a table of names and values",
    "model_attributes_type": "allowed: a table of names and values",
    "dataclass_type": "allowed: a table of names and values",
    "bytes_type": "allowed: bytes",
    "none_required": "allowed: nothing",
    "json_invalid": "it is no JSON",
    "union_tag_invalid": "allowed: {expected_tags}",
    "union_tag_not_found": "the kind is missing",
    "recursion_loop": "it contains itself",
}
"""Kind of problem of pydantic -> what is said of it, with the members of its context."""


def problem_words(problem: Mapping[str, Any]) -> str:
    """Say in one clause what is wrong with a value that pydantic refuses.

    Args:
        problem: an entry of `ValidationError.errors()`.

    Example:
        >>> problem_words({"type": "greater_than", "ctx": {"gt": 0}, "msg": "Input ..."})
        'allowed: above 0'
    """
    said = NEEDED.get(problem["type"])
    if said is None:
        return str(problem["msg"]).removeprefix("Value error, ")
    context = {
        name: f"{value:g}" if isinstance(value, float) else value
        for name, value in problem.get("ctx", {}).items()
    }
    return said.format(**context)


def reason_of(error: BaseException, otherwise: str = "") -> str:
    """Return why a file or a connection is not to be had: the system's words, else a
    library's.

    What the system raises has words, number and name apart; what libraries and flexdt
    raise as OSError often has one text alone. So no message takes `strerror` as it is.

    Args:
        error: an OSError, or what may come beside one.
        otherwise: where the error has no words, or is no OSError; "" is its type's name.

    Example:
        >>> reason_of(OSError(28, "No space left on device", "a.tif"))
        'No space left on device'
        >>> reason_of(OSError("bad signature")), reason_of(TimeoutError())
        ('bad signature', 'TimeoutError')
    """
    said = getattr(error, "strerror", None)  # ZeroMQ's errors have one, too
    if not said and isinstance(error, OSError):
        said = str(error).partition("\n")[0]
    return said or otherwise or type(error).__name__
