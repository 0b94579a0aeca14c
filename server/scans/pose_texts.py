"""Poses of a trajectory as text, so that 200 000 of them are two strings and no million objects."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

Poses = list[dict[str, float]]


@dataclass(frozen=True)
class PoseList:
    """Poses, each axis -> value [mm or deg].

    Attributes:
        text: JSON, one pose after the other; equal poses have equal texts.
        listing: what a data set's script says of them, a comment line each.
    """

    text: bytes
    listing: bytes = field(compare=False, repr=False)

    @classmethod
    def of(cls, poses: Iterable[Mapping[str, float]]) -> PoseList:
        """These poses."""
        each = [json.dumps(dict(p)) for p in poses]
        listing = "\r\n".join([*(f"# pose {i}: {p}" for i, p in enumerate(each)), ""])
        return cls(f"[{', '.join(each)}]".encode(), listing.encode())

    def decoded(self) -> Poses:
        """As lists and dictionaries."""
        poses: Poses = json.loads(self.text)
        return poses
