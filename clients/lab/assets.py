"""TIFF files as Bluesky assets: one image in each file, numbered, announced as a stream resource.

The documents follow bluesky's own convention for image sequences (mimetype
`multipart/related;type=image/tiff`, a `template`, one frame in each chunk), so its consolidators
and Tiled find the files.
"""

from __future__ import annotations

from pathlib import PurePath
from typing import Final
from urllib.parse import quote

from ophyd_async.core import SignalR, StreamResourceDataProvider, StreamResourceInfo

MIMETYPE: Final = "multipart/related;type=image/tiff"


def folder_uri(folder: PurePath) -> str:
    """The URI of a folder, with the slash at its end that relative names need."""
    return f"file://localhost{quote(folder.as_posix())}/"


def tiff_stream(
    data_key: str,
    folder: PurePath,
    template: str,
    shape: tuple[int, int],
    written: SignalR[int],
) -> StreamResourceDataProvider:
    """What announces files as they appear.

    Args:
        data_key: under which the images stand in a plan's data.
        folder: that holds them, absolute.
        template: of their names: `scan_{:06d}.tif`.
        shape: (rows, columns) of an image.
        written: counts complete files.
    """
    uri = folder_uri(folder)
    resource = StreamResourceInfo(
        data_key=data_key,
        shape=shape,
        chunk_shape=(1, *shape),
        dtype_numpy="<u2",
        parameters={"template": template, "join_method": "concat"},
        source=uri,
    )
    return StreamResourceDataProvider(uri, [resource], MIMETYPE, written)
