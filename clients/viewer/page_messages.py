"""Messages that a page's scenes may send to viser, each validated field by field and
encoded again.

Only the kinds of a list get through (`ALLOWED`), by viser's names for them.
"""

from __future__ import annotations

import logging
import struct
from typing import Annotated, Final, Literal

import msgpack
from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import Field, ValidationError

from flexdt.protocol.fields import Params
from flexdt.runtime.log import log

LARGEST_SIDE: Final = 4096
"""Largest side of a picture of a view [px]."""
MAX_SMALL: Final = 4096
"""Largest size of any message but a picture [bytes]."""
SHOWN_LETTERS: Final = 40
Length = Annotated[float, Ge(-1e6), Le(1e6)]
Part = Annotated[float, Ge(-2), Le(2)]
Triple = Annotated[tuple[Length, Length, Length], Field(strict=False)]
Turn = Annotated[tuple[Part, Part, Part, Part], Field(strict=False)]
Pixels = Annotated[float, Ge(1), Le(100_000)]
Name = Annotated[str, MaxLen(200)]
Modifier = Literal[
    "cmd/ctrl",
    "alt",
    "shift",
    "cmd/ctrl+alt",
    "cmd/ctrl+shift",
    "alt+shift",
    "cmd/ctrl+alt+shift",
]


class ViewerCameraMessage(Params):
    """Where a frame looks from [m]."""

    wxyz: Turn
    position: Triple
    fov: Annotated[float, Gt(0), Le(3.2)]
    near: Annotated[float, Gt(0), Le(1e6)]
    far: Annotated[float, Gt(0), Le(1e9)]
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class TransformControlsDragStartMessage(Params):
    """A drag of a handle begins."""

    name: Name
    owner: Name = ""


class TransformControlsUpdateMessage(TransformControlsDragStartMessage):
    """A handle is dragged [m]."""

    wxyz: Turn
    position: Triple


class TransformControlsDragEndMessage(TransformControlsDragStartMessage):
    """A drag of a handle ends."""


class SceneNodeClickMessage(Params):
    """A part is clicked; the ray [m] and the place in the frame (0 to 1) are not used."""

    name: Name
    instance_index: Annotated[int, Ge(0), Le(2**31)] | None = None
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: Annotated[tuple[Length, Length], Field(strict=False)]
    modifier: Modifier | None = None
    owner: Name = ""


class GetRenderResponseMessage(Params):
    """A picture that the viewer has requested."""

    payload: bytes
    render_uuid: Name


ALLOWED: Final[dict[str, type[Params]]] = {
    model.__name__: model
    for model in (
        ViewerCameraMessage,
        TransformControlsDragStartMessage,
        TransformControlsUpdateMessage,
        TransformControlsDragEndMessage,
        SceneNodeClickMessage,
        GetRenderResponseMessage,
    )
}
"""Allowed messages of a page's scenes, by viser's names, each checked field by field."""


class Unwanted(ValueError):
    """A message that pages may not send to viser; its text is short, for the log."""


def admitted(raw: str | bytes) -> bytes:
    """Validate a page's message and encode it again for viser.

    Pictures must be PNGs of at most `LARGEST_SIDE` pixels a side, or empty; other
    messages have at most `MAX_SMALL` bytes.

    Args:
        raw: as received.

    Raises:
        Unwanted: text, no message, a kind that is not in `ALLOWED`, too long, or with an
            unknown or wrong field; names it.
    """
    if isinstance(raw, str):
        raise Unwanted("text")
    try:
        fields = msgpack.unpackb(raw)
        kind = fields.pop("type")
        model = ALLOWED.get(kind)
    except (ValueError, msgpack.UnpackException, AttributeError, LookupError, TypeError):
        raise Unwanted("no message") from None
    if model is None:
        raise Unwanted(f"{str(kind)[:SHOWN_LETTERS]!a}")
    if model is not GetRenderResponseMessage and len(raw) > MAX_SMALL:
        raise Unwanted(f"a {kind} that is too long")
    try:
        read = model.model_validate(fields)
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"]))
        raise Unwanted(f"a {kind} with a wrong {where[:SHOWN_LETTERS]!a}") from None
    if isinstance(read, GetRenderResponseMessage) and not _small_picture(read.payload):
        raise Unwanted(f"a {kind} that is no PNG of at most {LARGEST_SIDE} pixels a side")
    return bytes(msgpack.packb({**read.model_dump(), "type": kind}))


def _small_picture(data: bytes) -> bool:
    """Check that a PNG's header states sides of at most `LARGEST_SIDE` pixels; empty
    bytes report a failure and pass. The content is not decoded.

    Sides of 0 fail.
    """
    if not data:
        return True
    if (
        len(data) < 24
        or not data.startswith(b"\x89PNG\r\n\x1a\n")
        or data[12:16] != b"IHDR"
    ):
        return False
    return all(0 < side <= LARGEST_SIDE for side in struct.unpack(">II", data[16:24]))


class MessageFilter:
    """Passes pages' messages on to viser; each reason to drop one is logged once.

    Attributes:
        dropped: messages so far.
    """

    MAX_LOGGED: Final = 100

    def __init__(self) -> None:
        self.dropped = 0
        self._logged: set[str] = set()

    def admit(self, raw: str | bytes) -> bytes | None:
        """Validate a browser's message for viser and return it; None drops it.

        Counts the dropped; each different problem is logged once, at most `MAX_LOGGED`.
        The result is encoded again, not the bytes received.
        """
        try:
            return admitted(raw)
        except Unwanted as error:
            self.dropped += 1
            problem = str(error)
        if problem not in self._logged and len(self._logged) < self.MAX_LOGGED:
            self._logged.add(problem)
            log("a scene's message was dropped", logging.WARNING, message=problem)
        return None
