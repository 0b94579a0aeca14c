"""JSON as other programs write it: a byte order mark before it, numbers of any length in it."""

from __future__ import annotations

import json
from typing import Any, Final

from flexdt.twin.input_limits import require_json

BYTE_ORDER_MARK: Final = "\ufeff"


def parse_json(
    text: str,
    kind: type[dict[str, Any]] = dict,
    *,
    file: str = "the document",
    form: str = "json",
) -> Any:
    """Parse a JSON document, after an optional byte order mark; objects become `kind`.

    `kind` gets each object's list of (name, value) pairs. `form`: row of the input
    limits. Raises InputLimitError: too long or too many values; ValueError: no JSON,
    nested too deep, or a whole number of thousands of digits.
    """
    require_json(text, file, form)
    try:
        return json.loads(text.removeprefix(BYTE_ORDER_MARK), object_pairs_hook=kind)
    except json.JSONDecodeError:
        raise
    except RecursionError:
        raise ValueError("it nests too deep") from None
    except ValueError:  # of int, about how its limit is raised
        raise ValueError("it holds a whole number of thousands of digits") from None
