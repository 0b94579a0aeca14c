"""Data sets of the data directory for clients: listed, described over time, their images.

Everything is read in worker processes with limits on time and memory, so that no folder,
however large, damaged or slow, holds the loop or ends the server. Links are not followed.
Results are kept until their folder changes.
"""

from __future__ import annotations

import math
import os
import stat
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, assert_never

import numpy as np
import numpy.typing as npt

from flexdt.message_words import reason_of
from flexdt.protocol import Codec, image
from flexdt.protocol.connection import MAX_ANSWER, answer_bytes, encoded
from flexdt.protocol.fields import ImageValue, Params
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods import calibration_messages as p
from flexdt.protocol.methods.calibration_messages import CalibrationAlign, CalibrationFit
from flexdt.protocol.rpc_errors import too_large
from flexdt.runtime.files import dataset_folder as files
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.reading_within import confined, opened
from flexdt.runtime.wire_errors import from_root
from flexdt.runtime.workers import Workers
from flexdt.server.storage import dataset_fits
from flexdt.twin.dataset import dataset_errors as ds
from flexdt.twin.dataset.file_names import DOCUMENT, SCRIPT, plain_name
from flexdt.twin.dataset.flexdt_json import (
    DatasetDocument,
    FrameEntry,
    FrameKind,
    SampleRecord,
    parse_document,
)
from flexdt.twin.dataset.normalise import LineIntegrals, binned_mean
from flexdt.twin.dataset.provenance import shortened
from flexdt.twin.errors import LimitError, TwinError, shape_words
from flexdt.twin.findings import Severity
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.input_limits import LIMITS
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.plausibility import Operation, examine

MAX_WORKERS: Final = 2
"""Number of worker processes."""
MEMORY_BYTES: Final = 3 << 30
MAX_WORK_S: Final = 30.0
MAX_SETS: Final = 2000
"""Largest number of folders that are listed, the newest first; older ones are counted."""
LIST_S: Final = 4.0
"""Time limit for a list [s]; the rest is read at the next request."""
MEASURE_S: Final = 10.0
"""Time limit for computing mean counts [s]."""
MAX_DOCUMENT_BYTES: Final = LIMITS[DOCUMENT].file_bytes
"""Largest flexdt.json [bytes]."""
MAX_LISTED_DOCUMENT_BYTES: Final = 64 << 20
"""Largest flexdt.json that is read for a list [bytes]."""
MAX_SCRIPT_BYTES: Final = 4 << 20
"""Largest script [bytes]."""


@dataclass(frozen=True)
class TwinContext:
    """Facts about the twin that a data set does not hold.

    Attributes:
        running: name of the data set that is being written; "" for none.
        machine, profile: the twin's own, as documents.
    """

    running: str
    machine: Mapping[str, Any]
    profile: Mapping[str, Any]


class PastScans:
    """Answers `dataset.*`, `calibration.fit` and `.align`; the caller closes it.

    Args:
        root: the data directory.
        machine, profile: the twin's own.
    """

    def __init__(self, root: Path, machine: Machine, profile: Profile) -> None:
        """Set up the listing of data sets below `root`, with worker processes that start on
        demand: `MAX_WORKERS`, and one with longer limits for calibration and alignment.

        Args:
            root: the data directory.
            machine, profile: of the twin, with which data sets are compared.
        """
        self._root = root
        self._machine = machine.model_dump(mode="json", by_alias=True)
        self._profile = profile.model_dump(mode="json")
        self._workers = Workers(MAX_WORKERS, MEMORY_BYTES, MAX_WORK_S)
        self._fitters = Workers(
            1, dataset_fits.MAX_MEMORY_BYTES, dataset_fits.MAX_SECONDS
        )

    async def ask(self, params: Params, running: str, codec: Codec) -> Encoded:
        """Answer a request in a worker process; calibration and alignment have a worker
        of their own with longer limits.

        Args:
            params: of the method.
            running: name of the data set that is being written; "" for none.
            codec: of the answer.

        Returns:
            The encoded answer.

        Raises:
            RpcError: -32602, there is no such data set or image, or it is damaged;
                -32008, it is larger, or takes longer to read, than is allowed.
        """
        context = TwinContext(running, self._machine, self._profile)
        slow = isinstance(params, CalibrationFit | CalibrationAlign)
        workers = self._fitters if slow else self._workers
        return Encoded(tuple(await workers.ask(work, self._root, params, context, codec)))

    def close(self) -> None:
        """End the processes of listing and fitting."""
        self._workers.close()
        self._fitters.close()


def work(root: Path, asked: Params, context: TwinContext, codec: Codec) -> list[bytes]:
    """Answer a request in the worker and encode the answer; only files below `root` are read.

    Args:
        root: data directory.
        asked: parameters; their type chooses the method.
        context: facts about the twin.
        codec: of the answer.

    Returns the pieces of the encoded answer.
    Raises DatasetMissingError: a file that cannot be read; TwinError, RpcError: of the method.
    """
    try:
        directory = Directory(root)
        with directory, confined(directory):
            result = _ANSWERS[type(asked)](directory, asked, context, codec)
    except TwinError:  # a missing data set is an OSError, too
        raise
    except OSError as error:  # it has gone meanwhile, or the disk fails
        name = getattr(asked, "name", "the data directory")
        raise ds.DatasetMissingError(
            f"{name} cannot be read: {reason_of(error)}"
        ) from None
    return list(encoded(result, codec).pieces)


class _LruCache:
    """Cache of the last `most` results by key."""

    def __init__(self, most: int) -> None:
        """Make an empty cache of at most `most` values."""
        self._most = most
        self._made = dict[Hashable, Any]()

    def __contains__(self, key: Hashable) -> bool:
        """Return whether a value is cached; that is no use of it."""
        return key in self._made

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return the value of `key`, or make and keep it; it becomes the latest used.

        Beyond the limit the least recently used value is dropped.
        """
        value = self._made[key] = self._made.pop(key) if key in self._made else make()
        if len(self._made) > self._most:
            del self._made[next(iter(self._made))]
        return value


# Unlike those of `lru_cache`, they can be searched: a list has `LIST_S` to read the rest.
_INFOS = _LruCache(MAX_SETS)
_THUMBNAILS = _LruCache(1000)


# A data set's folder
# ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _UndocumentedFrame:
    """An image with a known file, and perhaps settings from the scanner's texts."""

    file: str
    kind: FrameKind
    time_s: None = None
    exposure_ms: float | None = None
    averages: int | None = None
    mode: str | None = None
    roi: tuple[int, int, int, int] | None = None
    xrays_on: bool = True
    cone_vec: list[float] | None = None
    positions: Mapping[str, float] = field(default_factory=dict)


_Images = tuple[FrameEntry | _UndocumentedFrame, ...]


@dataclass(frozen=True, eq=False)
class _Scan:
    """A data set's folder as it was read; the last few are cached, with derived values.

    Attributes:
        folder: its files.
        images: of all kinds, in the order taken.
        document: flexdt.json; None without one, or without one of use.
        texts: without a document, the data set of the scanner's texts (a `DataSet`).
        problem: why there is no document.
        key: changes with the folder.
    """

    folder: files.Folder
    images: _Images = ()
    document: DatasetDocument | None = None
    texts: Any = None
    problem: str = ""
    key: tuple[object, ...] = ()

    @property
    def beam(self) -> tuple[float | None, float | None]:
        """kV and W of the projections, by the document, else by the scanner's texts; else
        None, None.
        """
        if self.document:
            settings = self.document.tube
        else:
            settings = self.texts and self.texts.settings
        if settings:
            return (settings.kV, settings.power_W)
        return (None, None)


def _place(root: Directory, name: str) -> tuple[Path, tuple[object, ...]]:
    """Find a data set's folder.

    The key is made of the name, and of inode, time and size of the folder and of its document,
    if there is one.

    `root`: data directory; `name`: of the data set.
    Returns its path, and a key that changes with its files and its document.
    Raises DatasetMissingError: no such data set; DatasetNameError: the name is not a plain one.
    """
    about = root.stat(plain_name(name, "data set"))
    if about is None or not stat.S_ISDIR(about.st_mode):
        raise ds.DatasetMissingError(
            f"no data set {name!r} in the data directory", {"asked": name}
        )
    parts = [s for s in (about, root.folder(name).stat(DOCUMENT)) if s is not None]
    return root.path / name, (
        name,
        *((s.st_ino, s.st_mtime_ns, s.st_size) for s in parts),
    )


def _scan(folder: files.Folder, most: int) -> _Scan:
    """Read a folder's document, or without a usable one the scanner's texts, or without
    those the list of images.

    `problem` of the result says why the document was not used. Of a bare list only files,
    kinds and that darks are without X-rays are known.

    Args:
        folder: of a data set.
        most: largest size of the document [bytes].

    Raises:
        DatasetError: there is no usable document, no projection of flexdt's names and no
            geometry that `DataSet.save` wrote.
    """
    try:
        if folder.document is None:
            raise ds.DatasetMissingError(
                f"there is no {DOCUMENT}: poses and settings are not known"
            )
        document = parse_document(files.read_text(folder.path / DOCUMENT, most), DOCUMENT)
        return _Scan(folder, tuple(document.frames), document)
    except ds.DatasetError as error:
        if not folder.projections and folder.geometry is None:
            raise
        texts = _texts(folder)
        problem = error.message
    bare = [_UndocumentedFrame(f, "dark", xrays_on=False) for f in folder.darks]
    bare += [_UndocumentedFrame(f, "flat") for f in folder.flats]
    if texts is None:
        bare += [_UndocumentedFrame(f, "projection") for f in folder.projections.values()]
        return _Scan(folder, tuple(bare), problem=problem)
    s = texts.settings
    if s is not None:
        shown = {"exposure_ms": s.exposure_ms, "mode": s.mode}
    else:
        shown = {}
    if s is not None and s.averages:
        shown["averages"] = round(s.averages)
    if s is not None and s.roi is not None:
        shown["roi"] = s.roi.edges
    bare += [
        _UndocumentedFrame(
            frame.file,
            "projection",
            **shown,
            cone_vec=row,
            positions={
                name: float(at[frame.index]) for name, at in texts.positions.items()
            },
        )
        for frame, row in zip(texts.frames, texts.cone_vec.rows.tolist(), strict=True)
    ]
    return _Scan(
        folder, tuple(bare), None, texts, f"there is no {DOCUMENT}: its texts are read"
    )


def _texts(folder: files.Folder) -> Any:
    """Read the scanner's own texts of a folder without a document, as a `DataSet`.

    Returns:
        The data set; None if the folder has a document, or no texts that can be read.
    """
    from flexdt.library.reading.folders import load_dataset  # heavy: only workers need it

    if folder.document:
        return None
    try:
        return load_dataset(folder.path)
    except TwinError:
        return None


def _opened(root: Directory, name: str) -> _Scan:
    return _kept_scan(*_place(root, name))


@lru_cache(4)
def _kept_scan(path: Path, key: tuple[object, ...]) -> _Scan:
    """Read a folder; the last four are cached by their keys."""
    return replace(_scan(files.list_folder(path), MAX_DOCUMENT_BYTES), key=key)


def _info(path: Path, modified: float, scan: _Scan) -> p.DatasetInfo:
    """Summarise a data set as a row of the list; nothing is read here.

    With a document it is complete only if all its files are there. Without one, values
    come from the scanner's texts, or are unknown; the problem is cut to 500 characters.

    Args:
        path: of the data set.
        modified: its time of modification [s].
        scan: its content.
    """
    folder = scan.folder
    document = scan.document
    kV, power_W = scan.beam
    if document is None:
        present = len(folder.projections)
        texts = scan.texts
        changes = {}
        if texts is not None and (settings := texts.settings) is not None:
            changes = {
                "state": "complete" if texts.complete else "incomplete",
                "reason": texts.reason,
                "started": settings.started and settings.started.isoformat(),
                "sample": settings.sample_name or "",
                "operator": settings.operator or "",
                "machine": settings.scanner_name,
                "mode": settings.mode,
                "shape": texts.shape,
                "exposure_ms": settings.exposure_ms,
                "projections": len(texts),
                "kV": kV,
                "power_W": power_W,
            }
        info = p.DatasetInfo(
            name=path.name,
            modified=modified,
            projections=present,
            present=present,
            problem=scan.problem[:500],
        )
        return info.model_copy(update=changes)
    lost = folder.lost([f.file for f in document.frames])
    taken = document.files("projection")
    detector = document.detector
    named = document.machine.get("name")
    return p.DatasetInfo(
        name=path.name,
        modified=modified,
        started=document.started.isoformat(),
        duration_s=document.duration_s,
        state="complete" if document.complete and not lost else "incomplete",
        reason=(document.complete and lost) or document.reason,
        projections=len(taken),
        present=sum(f in folder.names for f in taken),
        machine=str(named)[:100],
        sample=document.sample.name,
        operator=document.operator,
        kV=kV,
        power_W=power_W,
        exposure_ms=detector.exposure_ms,
        mode=detector.mode,
        shape=(detector.rows, detector.cols),
        saturated=document.saturated,
    )


# dataset.list
# -------------------------------------------------------------------------------------


def _list(
    root: Directory, asked: p.DatasetList, context: TwinContext, codec: Codec
) -> p.DatasetListResult:
    """Answer dataset.list: the data sets that match the search, newest first.

    All words must be in name, state, sample, operator, machine, mode, start or settings,
    whatever the case. Of at most `MAX_SETS` folders summaries are read or cached; those
    for which `LIST_S` was too short are listed as not read yet. Others are skipped.
    Returns `count` rows from `start` on, the numbers that match and are unread, and
    `left_out`: folders beyond `MAX_SETS` or with a bad name.
    """
    folders, left_out = _folders(root)
    words = asked.search.lower().split()
    until = time.monotonic() + LIST_S
    found = []
    unread = 0
    for modified, name in folders:
        info, late = _row_until(until, root, name, modified)
        if info is None:
            continue
        info = _as_it_runs(info, context)
        if _matches(info, words):
            unread += late
            found.append(info)
    shown = found[asked.start : asked.start + asked.count]
    if asked.thumbnail:
        shown = [
            _with_thumbnail(root, info, asked.thumbnail, until + LIST_S) for info in shown
        ]
    return p.DatasetListResult(
        datasets=shown, total=len(found), unread=unread, left_out=left_out
    )


def _folders(root: Directory) -> tuple[list[tuple[float, str]], int]:
    """List the `MAX_SETS` newest folders of the data directory that are not hidden.

    Returns:
        Time of modification [s] and name of each, newest first, and the number of folders
        beyond these or with a bad name.
    """
    folders = []
    left_out = 0
    with root.entries() as entries:
        for entry in entries:
            try:
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith("."):
                    plain_name(entry.name)
                    folders.append(
                        (entry.stat(follow_symlinks=False).st_mtime, entry.name)
                    )
            except ds.DatasetNameError:
                left_out += 1
            except OSError:  # it has gone meanwhile
                continue
    folders.sort(reverse=True)
    return folders[:MAX_SETS], left_out + len(folders[MAX_SETS:])


def _row_until(
    until: float, root: Directory, name: str, modified: float
) -> tuple[p.DatasetInfo | None, bool]:
    """Summarise the data set in a folder; one that is not in the cache is read only until a
    time.

    `until`: monotonic time [s]; `root`: data directory; `name`: of the folder; `modified`: its
    time of modification [s].
    Returns the summary, None for a folder that holds no data set or has gone, and whether it was
    too late to read it.
    """
    try:
        path, key = _place(root, name)
        if key not in _INFOS and time.monotonic() > until:
            late = p.DatasetInfo(name=name, modified=modified, problem="not read yet")
            return late, True
        return _INFOS.get(key, lambda: _list_row(path, modified)) or None, False
    except ds.DatasetError:
        return None, False  # it has gone meanwhile, or is no data set


def _matches(info: p.DatasetInfo, words: Sequence[str]) -> bool:
    """Return whether each of the words, in lower case, is in a text of a summary."""
    texts = (
        info.name,
        info.state,
        info.sample,
        info.operator,
        info.machine,
        info.mode,
        info.started,
        f"{info.kV or 0:g}kV {info.exposure_ms or 0:g}ms {info.power_W or 0:g}W",
    )
    return all(any(word in str(text).lower() for text in texts) for word in words)


def _as_it_runs(info: p.DatasetInfo, context: TwinContext) -> p.DatasetInfo:
    """Return a summary with state "running" and no reason if the twin writes that data
    set now, else unchanged.
    """
    running = info.name == context.running
    if running:
        return info.model_copy(update={"state": "running", "reason": ""})
    return info


def _list_row(path: Path, modified: float) -> p.DatasetInfo | str:
    """Read and summarize a data set; what cannot be read is the problem in the summary.

    Documents above `MAX_LISTED_DOCUMENT_BYTES` are not read. Paths in the problem are relative
    to the data directory.

    `path`: of its folder; `modified`: its time of modification [s].
    Returns the summary; "" for a folder that holds no data set.
    """
    folder = files.list_folder(path)
    if folder.document is None and folder.geometry is None and not folder.projections:
        return ""
    try:
        scan = _scan(folder, MAX_LISTED_DOCUMENT_BYTES)
    except (TwinError, MemoryError) as error:
        problem = str(from_root(str(error), path.parent))
        scan = _Scan(folder, problem=problem or "it takes too much memory")
    return _info(path, modified, scan)


def _with_thumbnail(
    root: Directory, info: p.DatasetInfo, side: int, until: float
) -> p.DatasetInfo:
    """Add a thumbnail of the middle projection to a summary, made now or cached.

    After `until` only cached ones are added.

    Args:
        root: data directory.
        info: the summary.
        side: largest side of the thumbnail [pixels].
        until: monotonic time after which no thumbnail is made [s].

    Returns:
        The summary, with a thumbnail if there is one.
    """

    def make() -> ImageValue | str:
        """Read the middle projection and shrink it to an 8-bit image of at most `side`
        pixels a side.

        It is binned, or sampled if one side has fewer pixels than the factor. Gray values
        run from the 0.5 % to the 99.5 % quantile.

        Returns:
            The image; "" if there is no projection or it cannot be read.
        """
        folder = files.list_folder(path)
        images = list(folder.projections.values())
        if not images and folder.geometry is not None and (saved := _texts(folder)):
            images = [frame.file for frame in saved.frames if frame.present]
        if not images:
            return ""
        try:
            pixels = files.read_image(path / images[len(images) // 2])
        except ds.DatasetError:
            return ""
        factor = math.ceil(max(pixels.shape) / side)
        narrow = min(pixels.shape) < factor
        if narrow:
            small = pixels[::factor, ::factor]
        else:
            small = binned_mean(pixels, factor)
        low, high = np.percentile(small, (0.5, 99.5))
        grey = np.clip((small - low) * (255.0 / max(float(high - low), 1e-6)), 0, 255)
        return ImageValue(**image.encode(grey.astype(np.uint8)))  # type: ignore[arg-type]

    try:
        path, key = _place(root, info.name)
        if (side, key) not in _THUMBNAILS and time.monotonic() > until:
            return info
        thumbnail = _THUMBNAILS.get((side, key), make)
    except ds.DatasetError:
        return info
    return info.model_copy(update={"thumbnail": thumbnail or None})


# dataset.get
# --------------------------------------------------------------------------------------


def _get(
    root: Directory, asked: p.DatasetGet, context: TwinContext, codec: Codec
) -> p.DatasetResult:
    """Answer dataset.get: summary, poses over time at chosen images, warnings, and the
    other requested parts.

    The images are at most `points`, evenly spread. Script and measurements are read only
    if requested.

    Args:
        root: data directory.
        asked: name and parts.
        context: jobs and machine of the twin.
        codec: of the connection, not used.

    Returns:
        Per chosen image index, file, kind, whether it is there, time [s] (None for all
        unless all have one) and positions (None where unknown).

    Raises:
        DatasetError: no such data set, or one that cannot be read.
    """
    scan = _opened(root, asked.name)
    folder = scan.folder
    images = scan.images
    about = root.stat(asked.name)
    info = _info(folder.path, 0.0 if about is None else about.st_mtime, scan)
    info = _as_it_runs(info, context)
    last = len(images) - 1
    at = np.unique(
        np.linspace(0, last, min(asked.points, last + 1)).round().astype(int)
    ).tolist()
    chosen = [images[i] for i in at]
    motors = list(chosen[-1].positions if chosen else ())
    times = [frame.time_s for frame in chosen if frame.time_s is not None]
    return p.DatasetResult(
        info=info,
        made=_made(scan.document),
        images=len(images),
        indices=at,
        files=[frame.file for frame in chosen],
        kinds=[frame.kind for frame in chosen],
        present=[frame.file in folder.names for frame in chosen],
        times_s=times if chosen and len(times) == len(chosen) else None,
        positions={
            name: [frame.positions.get(name) for frame in chosen] for name in motors
        },
        same_machine=_same_machine(scan, context),
        script=_script(folder) if asked.script else None,
        warnings=_doubts(scan, info.shape),
        provenance=_stated(scan),
        **(_measure(scan, tuple(at)) if asked.measure else {}),
    )


def _made(document: DatasetDocument | None) -> p.ScannedSample:
    """Tell the sample of a scan's document, where it stood, and the correction in force."""
    sample = SampleRecord() if document is None else document.sample
    correction = None if document is None else document.correction
    name = None if correction is None else correction.name
    return p.ScannedSample.model_validate(sample.identity() | {"correction": name})


def _stated(scan: _Scan) -> list[p.StatedValue]:
    """List the values of another program's file with their uses; [] without one."""
    values = scan.texts.provenance if scan.texts is not None else ()
    return [
        p.StatedValue(
            field=one.field,
            value=shortened(one.value),
            use=one.use.value,
            consequence=one.consequence,
        )
        for one in values
    ]


def _doubts(scan: _Scan, shape: tuple[int, int] | None) -> list[str]:
    """List the warnings of a data set's texts, or else contradictions in the geometry of
    its projections.

    Notes are left out. The list is empty if no projection has a geometry; a geometry that
    cannot be examined gives its error.

    Args:
        scan: the data set.
        shape: of its projections, (rows, cols).
    """
    if scan.texts is not None:
        root = scan.folder.path.parent
        return [str(from_root(doubt, root)) for doubt in scan.texts.warnings]
    rows = [one.cone_vec for one in scan.images if one.kind == "projection"]
    known = [row for row in rows if row is not None]
    if not known:
        return []
    try:
        found = examine(Operation.OPEN, ConeVec(np.array(known)), shape)
    except TwinError as error:
        return [str(error)]
    return [one.text for one in found if one.severity is not Severity.NOTE]


def _same_machine(scan: _Scan, context: TwinContext) -> bool:
    """Return whether the twin has the machine and the profile that a data set states.

    Compared are profile, axes, geometry, fixed parts, components and detector (not the
    tube).
    """
    document = scan.document
    texts = scan.texts
    if document:
        machine = document.machine
        profile = document.profile
    else:
        machine = {}
        profile = None
    if texts is not None and texts.profile is not None and texts.positions:
        machine = texts.machine.model_dump(mode="json", by_alias=True)
        profile = texts.profile.model_dump(mode="json")
    parts = ("axes", "geometry", "fixed", "components", "detector")
    own = context.machine
    return profile == context.profile and all(own.get(k) == machine.get(k) for k in parts)


def _script(folder: files.Folder) -> str:
    """Read the script of a data set.

    Bytes that are not UTF-8 become replacement characters.

    Raises:
        DatasetMissingError: there is none in the listing.
        RpcError: -32008, it is larger than `MAX_SCRIPT_BYTES`.
    """
    if SCRIPT not in folder.names:
        raise ds.DatasetMissingError(
            f"{folder.path.name}: no script lies with this data set"
        )
    with opened(folder.path / SCRIPT) as file:
        if (size := os.fstat(file.fileno()).st_size) > MAX_SCRIPT_BYTES:
            raise too_large("the script of a data set", size, MAX_SCRIPT_BYTES)
        return file.read().decode("utf-8", "replace")


def _measure(scan: _Scan, at: tuple[int, ...]) -> dict[str, Any]:
    """Compute mean counts and, with a document, clearances of images.

    Means not begun within `MEASURE_S` are None; they come with the next request, as those
    computed are cached.

    Args:
        scan: the data set.
        at: indices of images.

    Returns:
        "counts", and with a document "clearance_mm" [mm] and "clearance_of". A value is
        None where it is late or missing; if the scene cannot be built, all clearances are
        None and "clearance_of" has the reason.
    """
    until = time.monotonic() + MEASURE_S
    counts: list[float | None] = []
    for i in at:
        try:
            path = scan.folder.path / _existing_file(scan.folder, scan.images[i].file)
            counts.append(None if time.monotonic() > until else _mean(path, scan.key))
        except ds.DatasetError:
            counts.append(None)
    if scan.document is None:
        return {"counts": counts}
    try:
        near, what = _clearances(scan, at)
    except (TwinError, ValueError, KeyError) as error:
        near = None
        what = f"not known: {error}"[:300]
    return {"counts": counts, "clearance_mm": near, "clearance_of": what}


@lru_cache(16 * 2000)
def _mean(path: Path, key: tuple[object, ...]) -> float:
    """Compute the mean count of an image; cached."""
    return float(files.read_image(path).mean())


@lru_cache(4)
def _clearances(scan: _Scan, at: tuple[int, ...]) -> tuple[list[float | None], str]:
    """Compute the smallest clearance at images' poses [mm]; the last four results are
    cached.

    The sample counts as a cylinder on the axis if both its sizes are known, else it is
    left out.

    Args:
        scan: with its document.
        at: indices of images.

    Returns:
        Clearances [mm], None where nothing is near, and a description of the scene.
    """
    from flexdt.twin.collision.collision_scene import build_scene
    from flexdt.twin.collision.convex_solids import UprightCylinder
    from flexdt.twin.collision.first_contact import clearance

    document = scan.document
    assert document is not None
    machine = document.machine_of()
    sample = document.sample
    pieces: tuple[UprightCylinder, ...] = ()
    what = "the machine without a sample, whose size is not known"
    if sample.diameter_mm > 0 and sample.height_mm > 0:
        # It contains the sample at every angle, so the sample is nowhere nearer.
        pieces = (
            UprightCylinder((0.0, 0.0, 0.0), 0.5 * sample.diameter_mm, sample.height_mm),
        )
        what = "the machine and the cylinder around the sample"
    correction = document.correction_in_force()
    offsets = NOMINAL
    if correction is not None:
        offsets = correction.parameters
    scene = build_scene(machine, document.profile_of(), pieces, offsets)
    found = [clearance(scene, scan.images[i].positions).mm for i in at]
    return [mm if math.isfinite(mm) else None for mm in found], what


# dataset.frame
# ------------------------------------------------------------------------------------


def _frame(
    root: Directory, asked: p.DatasetFrame, context: TwinContext, codec: Codec
) -> p.DatasetFrameResult:
    """Answer dataset.frame: one image, normalized and binned as requested.

    Line integrals are of projections only. Counts are rounded after binning. With a
    document the image must have its shape.

    Args:
        root: data directory.
        asked: image, kind and binning.
        context: jobs and machine of the twin.
        codec: of the connection, which limits the size.

    Raises:
        LimitError: no such image, a binning that leaves nothing, or line integrals of an
            image that is no projection.
        DatasetMissingError: no such data set, its file is gone, or it has no flat images
            for line integrals.
        RpcError: -32008, too large for the connection.
    """
    scan = _opened(root, asked.name)
    folder = scan.folder
    document = scan.document
    images = scan.images
    if asked.index >= len(images):
        raise LimitError(
            f"{asked.name} has {len(images)} images; there is no image {asked.index}",
            {"asked": asked.index, "allowed": [0, len(images) - 1]},
        )
    frame = images[asked.index]
    shape = None
    if document and isinstance(frame, FrameEntry):
        shape = document.shape_of(frame)
    counts = files.read_image(folder.path / _existing_file(folder, frame.file), shape)
    if asked.binning > min(counts.shape):
        raise LimitError(
            f"binning {asked.binning} leaves nothing of {shape_words(counts.shape)} pixels"
        )
    small: npt.NDArray[np.generic]
    match asked.kind:
        case "counts":
            mean = binned_mean(counts.astype(np.float32), asked.binning)
            small = np.rint(mean).astype(np.uint16)
        case "line_integral":
            if frame.kind != "projection":
                raise LimitError(
                    f"{frame.file} is a {frame.kind} image: it has no line integrals"
                )
            rows, cols = counts.shape
            integrals = _line_integrals_of(scan, (rows, cols))(counts)
            small = binned_mean(integrals.astype(np.float32), asked.binning)
        case _:
            assert_never(asked.kind)
    before = sum(f.kind == "projection" for f in images[: asked.index])
    kV, power_W = scan.beam
    size = answer_bytes(small.nbytes, codec)
    if size > (limit_bytes := MAX_ANSWER[codec] - (1 << 16)):  # beside the pixels
        raise too_large("an image (ask for a binned one)", size, limit_bytes)
    return p.DatasetFrameResult(
        **image.encode(small),  # type: ignore[arg-type]
        name=asked.name,
        index=asked.index,
        file=frame.file,
        image=frame.kind,
        projection=before if frame.kind == "projection" else None,
        kind=asked.kind,
        time_s=frame.time_s,
        exposure_ms=frame.exposure_ms,
        positions=dict(frame.positions) or None,
        cone_vec=frame.cone_vec,
        tube={"kV": kV, "power_W": power_W, "on": frame.xrays_on},
        camera={
            "exposure_ms": frame.exposure_ms,
            "mode": frame.mode,
            "averages": frame.averages,
            "roi": list(frame.roi) if frame.roi else None,
        },
    )


def _existing_file(folder: files.Folder, file: str) -> str:
    """Check that the folder's listing has a file, and return its name.

    Raises:
        DatasetMissingError: it has not.
    """
    if file not in folder.names:
        raise ds.DatasetMissingError(
            f"{folder.path.name}: {file} is not there", {"path": file}
        )
    return file


@lru_cache(4)
def _line_integrals_of(scan: _Scan, shape: tuple[int, int]) -> LineIntegrals:
    """Make the conversion of a data set's counts to line integrals, from its mean dark
    and flat images; the last four are cached.

    Without dark images the dark is 0.

    Args:
        scan: whose dark and flat images are averaged.
        shape: (rows, cols) of its images.

    Raises:
        DatasetMissingError: there is no flat image.
    """
    folder = scan.folder
    dark, flat = (
        folder.paths([f.file for f in scan.images if f.kind == kind])
        for kind in ("dark", "flat")
    )
    if not flat:
        name = folder.path.name
        raise ds.DatasetMissingError(
            f"{name} has no flat image: there are no line integrals"
        )
    light = files.mean_image(flat, shape)
    if dark:
        lost = files.mean_image(dark, shape)
    else:
        lost = np.zeros_like(light)
    return LineIntegrals.of(lost, light)


_ANSWERS: Final[Mapping[type[Params], Callable[..., object]]] = {
    p.DatasetList: _list,
    p.DatasetGet: _get,
    p.DatasetFrame: _frame,
    CalibrationFit: dataset_fits.fit,
    CalibrationAlign: dataset_fits.align,
}
