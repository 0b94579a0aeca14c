"""Samples: shipped phantoms by name, and uploaded meshes, voxels and scenes.

Uploads appear only when complete and readable. They are stored under DATA/samples and
survive a restart: the bytes in a file named after their content, and beside it a
description, which is written last. Names become file names by percent encoding, so no
name can leave that folder. An upload whose files are damaged is set aside.
"""

from __future__ import annotations

import asyncio
import fnmatch
import hashlib
import math
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from flexdt import phantoms
from flexdt.phantoms import Phantom, PhantomError
from flexdt.protocol.rpc_errors import too_large
from flexdt.runtime.files import own_documents as documents
from flexdt.runtime.files.directory import TEMPORARY, Directory
from flexdt.server.storage.disk_room import DiskRoom
from flexdt.server.storage.mesh_workers import mesh_apart, scene_apart
from flexdt.server.storage.sample_uploads import (
    MAX_UPLOAD_BYTES,
    Incoming,
    Upload,
    UploadHead,
)
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.scanner.state import EMPTY_STAGE

MAX_CACHED_PHANTOMS = 8
"""Number of parsed samples that are cached; meshes may be large."""
DEFAULT_MATERIAL = "abs"


@dataclass(frozen=True)
class ReceivedSample:
    """A complete, readable upload.

    Attributes:
        head: its description.
        raw: its bytes.
        phantom: parsed, of the material it was uploaded with.
        revision: names its content.
        worn: material and phantom of another material, to be on the stage.
    """

    head: UploadHead
    raw: bytes
    phantom: Phantom
    revision: str
    worn: tuple[str, Phantom] | None = None

    @property
    def shown(self) -> str:
        """Identifier of its appearance, as `SampleStore.revision` returns it."""
        return _shown(self.head, self.revision)

    @property
    def standing(self) -> Phantom:
        """The phantom as it will be on the stage."""
        if self.worn is None:
            return self.phantom
        return self.worn[1]


class SampleStore:
    """All samples of one data directory.

    Args:
        folder: where uploads are kept.
        limit: largest upload [bytes].
        most: uploads there may be.
        room: on the disk; None for any.
        memory_limit: of the parsed samples in memory [bytes]; None for any.
        observers: number and bytes of the uploads that observers may have sent.
    """

    def __init__(
        self,
        folder: Directory,
        limit: int = MAX_UPLOAD_BYTES,
        most: int = 10_000,
        room: DiskRoom | None = None,
        memory_limit: int | None = None,
        observers: tuple[int, int] = (100, 1 << 30),
    ) -> None:
        """List the uploads stored in a folder; delete temporary files, and bytes (.bin)
        of no known upload.

        Descriptions that cannot be read are renamed and logged, and their bytes stay. Names
        of shipped phantoms and of the empty stage are skipped. Phantoms are loaded when
        used.

        Args:
            folder: of the uploads.
            limit: of one upload [bytes].
            most: number of uploads.
            room: on the disk; None for any.
            memory_limit: of loaded phantoms [bytes]; None for no limit.
            observers: number and bytes of uploads that came while another client had
                control.
        """
        if memory_limit is None:
            self._memory_limit = math.inf
        else:
            self._memory_limit = memory_limit
        self._folder = folder
        self._limit = limit
        self._most = most
        self._most_of_observers, self._bytes_of_observers = observers
        self._incoming: Incoming = Incoming(folder, 2 * limit, room)
        self._heads: dict[str, UploadHead] = {}
        """Their revisions are those of their files; those of older servers have none."""
        for file in documents.ours(folder):
            without = "an upload cannot be read; without it"
            head = documents.read_or_set_aside(folder, file, _head_of(file), without)
            if (
                head is not None
                and head.name != EMPTY_STAGE
                and not phantoms.is_shipped(head.name)
            ):
                self._heads[head.name] = head
        self._revisions: dict[str, str] = {}
        self._loaded: dict[tuple[str, str | None], Phantom] = {}
        self.standing: Callable[[], tuple[str, str | None]] = lambda: ("", None)
        """Name and material of the sample on the stage. It stays loaded: every state has
        its size, and reading it again may take seconds."""
        self._lock = threading.Lock()
        """Guards the tables: samples are loaded by worker threads and by the event loop."""
        self.turn = asyncio.Lock()
        """Held while an upload is read, so that uploads never take all worker threads."""
        self._replaced: set[str] = set()
        """Files of bytes that no upload has any more."""
        self._settle()

    @property
    def names(self) -> tuple[str, ...]:
        """Shipped phantoms, then uploads."""
        return (*phantoms.phantom_names(), *self._heads)

    @property
    def uploads(self) -> tuple[str, ...]:
        """Complete uploads' names."""
        return tuple(self._heads)

    def head(self, name: str) -> UploadHead | None:
        """Return the description of the upload called `name`, or None for a shipped phantom."""
        return self._heads.get(name)

    def revision(self, name: str) -> str | None:
        """Return a text that names an upload's content and material.

        None for a shipped phantom, and for an upload that has not been read yet.
        """
        with self._lock:
            revision = self._revisions.get(name)
            head = self._heads.get(name)
        if revision is None or head is None:
            return None
        return _shown(head, revision)

    def load(self, name: str, material: str | None = None) -> Phantom:
        """Return the phantom called `name` from the cache, or parse it and cache it;
        blocks.

        `material`: instead of the one a mesh was uploaded with. Raises UnknownNameError:
        no such sample or material; LimitError: a material for a sample that has its own;
        PhantomError: an upload cannot be read any more; if damaged it is removed from the
        list.
        """
        key = (name, material)
        with self._lock:
            head = self._heads.get(name)
            phantom = self._loaded.pop(key, None)
            if phantom is not None:
                self._loaded[key] = phantom  # the newest again: used phantoms stay
                return phantom
        phantom, revision = self._load(head, name, material)
        with self._lock:
            if (
                self._heads.get(name) is head
            ):  # else another file has come under this name
                self._keep(key, phantom, revision)
        return phantom

    def _keep(
        self, key: tuple[str, str | None], phantom: Phantom, revision: str | None
    ) -> None:
        """Cache a phantom, and its revision if given; drop the oldest ones beyond the
        limits.

        The limits are `MAX_CACHED_PHANTOMS` and the memory limit. The new one and that on
        the stage always stay.
        """
        self._loaded[key] = phantom
        if revision is not None:
            self._revisions[key[0]] = revision
        for old in [k for k in self._loaded if k not in (self.standing(), key)]:
            used = sum(map(_bytes_of, self._loaded.values()))
            if len(self._loaded) <= MAX_CACHED_PHANTOMS and used <= self._memory_limit:
                break
            del self._loaded[old]

    def receive(
        self, head: UploadHead, start: int, data: bytes, *, observer: bool = False
    ) -> tuple[int, Upload]:
        """Check an upload's size and name, and write one chunk of it, see `Incoming.receive`.

        A stored name may be replaced even if no further upload is allowed.

        Args:
            head: description of the upload.
            start: place of the chunk [bytes].
            data: the chunk.
            observer: whether another client has control.

        Returns number of bytes received so far, and the upload that they are of.
        Raises RpcError: -32008, larger than allowed; LimitError: a gap before this chunk, too
        many uploads (of observers, too large ones together), a name that is too long, or that of
        a shipped phantom or the empty stage; DatasetWriteError: the disk does not take it.
        """
        if head.total > self._limit:
            raise too_large("an upload", head.total, self._limit)
        if head.name == EMPTY_STAGE or phantoms.is_shipped(head.name):
            what = "a shipped phantom"
            if head.name == EMPTY_STAGE:
                what = "the empty stage"
            raise LimitError(
                f"{head.name!r} is {what}'s name; choose another",
                {"asked": head.name, "taken": [EMPTY_STAGE, *phantoms.phantom_names()]},
            )
        documents.file_stem(head.name)
        if head.name not in self._heads and len(self._heads) >= self._most:
            raise LimitError(
                f"there are {len(self._heads)} uploads, "
                f"{self._most} allowed; sample.delete makes room",
                {"asked": len(self._heads) + 1, "allowed": self._most},
            )
        if observer:
            self.require_observers_room(head)
        return self._incoming.receive(head, start, data)

    def require_observers_room(self, head: UploadHead) -> None:
        """Check that one more upload of an observer is within their number and their bytes.

        Only complete ones count.

        Raises:
            LimitError: it is not; names what there is, and who can change that.
        """
        sent = [other.total for other in self._heads.values() if other.observer]
        count, size = len(sent) + 1, sum(sent) + head.total
        if count <= self._most_of_observers and size <= self._bytes_of_observers:
            return
        raise LimitError(
            f"observers have sent {len(sent)} uploads of {sum(sent)} bytes, and with "
            f"{head.name!r} it would be {count} of {size}; {self._most_of_observers} of "
            f"{self._bytes_of_observers} bytes are allowed. The controller may send more, "
            "and make room by sample.delete",
            {
                "asked": {"uploads": count, "bytes": size},
                "allowed": {
                    "uploads": self._most_of_observers,
                    "bytes": self._bytes_of_observers,
                },
            },
        )

    def parse(
        self, complete: Upload, material: str | None = None, *, observer: bool = False
    ) -> ReceivedSample:
        """Parse a complete upload, which may take seconds; nothing is stored.

        It is removed from the uploads under way. `material`: in which it is on the stage;
        None: not. `observer`: another client has control. Raises PhantomError,
        UnknownNameError; LimitError: observers have sent too much.
        """
        head, raw = self._incoming.take(complete)
        head = head.model_copy(update={"observer": observer})
        if observer:
            self.require_observers_room(head)
        phantom = _parse(head, raw, head.material)
        worn = None
        if material is not None:
            worn = (material, _parse(head, raw, material))
        return ReceivedSample(head, raw, phantom, _revision(head, raw), worn)

    def prepare(self, upload: ReceivedSample) -> None:
        """Write an upload's bytes, before any lock; `store` makes them visible.

        Unless `know` is called, `tidy` deletes the file. Raises DatasetWriteError.
        """
        name = upload.head.name
        file = _bytes_file(name, upload.revision)
        with self._lock:
            head = self._heads.get(name)
            if head is None or head.revision != upload.revision:
                self._replaced.add(file)
        self._folder.keep(file, upload.raw)

    def store(self, changes: documents.Changes, upload: ReceivedSample) -> None:
        """Add the description of a prepared upload to `changes`; the files of the previous
        upload of that name stay until `tidy`.

        Raises:
            DatasetWriteError: the system cannot write.
        """
        head = upload.head
        stem = documents.file_stem(upload.head.name)
        left_out = {"start", "data"} if head.observer else {"start", "data", "observer"}
        document = head.model_dump(by_alias=True, exclude=left_out)
        document["revision"] = upload.revision
        changes.put_json(self._folder, f"{stem}.json", document)

    def know(self, upload: ReceivedSample) -> None:
        """Make a stored upload the current one of its name, and cache its phantoms.

        The files of the previous one are deleted by `tidy`.
        """
        name = upload.head.name
        new = upload.head.model_copy(update={"revision": upload.revision})
        with self._lock:
            self._replace(name, new)
            self._keep((name, None), upload.phantom, upload.revision)
            if upload.worn is not None:
                self._keep((name, upload.worn[0]), upload.worn[1], upload.revision)

    def remove(self, changes: documents.Changes, name: str) -> None:
        """Delete the description of an upload; `tidy` removes its bytes after `forget`.

        Raises:
            DatasetWriteError: the system refuses.
        """
        changes.remove(self._folder, f"{documents.file_stem(name)}.json")

    def forget(self, name: str) -> None:
        """Forget an upload; `tidy` deletes its bytes."""
        with self._lock:
            self._replace(name, None)

    def _replace(self, name: str, new: UploadHead | None) -> None:
        """Register another upload under a name and forget what was loaded under it; with
        the lock held.

        Files of the earlier upload are only marked as replaced.

        Args:
            name: of the sample.
            new: description of the upload; None removes the name.
        """
        old = self._heads.pop(name, None)
        if old is not None:
            self._replaced.add(_bytes_file(name, old.revision))
        if new is not None:
            self._heads[name] = new
            self._replaced.discard(_bytes_file(name, new.revision))
        self._revisions.pop(name, None)
        for key in [k for k in self._loaded if k[0] == name]:
            del self._loaded[key]

    def tidy(self) -> None:
        """Delete the files of uploads that were replaced, forgotten, or prepared in vain; a
        file that cannot be deleted stays.
        """
        with self._lock:
            files = self._replaced
            self._replaced = set()
        for file in files:
            with suppress(OSError):
                self._folder.unlink(file)

    def _settle(self) -> None:
        """Delete temporary files of interrupted writers, and bytes of no known upload,
        from the folder.

        Bytes beside a damaged description that was renamed stay, as do other files, and
        those that cannot be deleted.
        """
        self._folder.sweep([TEMPORARY])
        known = {_bytes_file(name, head.revision) for name, head in self._heads.items()}
        names = self._folder.names()
        for file in fnmatch.filter(names, f"*.{'?' * 16}.bin"):
            damaged = f"{file.split('.')[0]}{documents.ASIDE}.json" in names
            if file not in known and not damaged:
                with suppress(OSError):
                    self._folder.unlink(file)

    def _load(
        self, head: UploadHead | None, name: str, material: str | None
    ) -> tuple[Phantom, str | None]:
        """Load a phantom from the shipped ones or from an upload's file; nothing is cached here.

        Args:
            head: description of the upload; None for a shipped phantom.
            name: of the sample.
            material: of an uploaded mesh; None: that of its description.

        Returns the phantom, and the revision of an upload, else None.
        Raises LimitError: a material for a shipped phantom; UnknownNameError: no such sample;
        PhantomError: an upload that cannot be read.
        """
        if head is None:
            if material is not None:
                raise LimitError(
                    f"{name!r} has its own materials; a material is for uploaded meshes",
                    {"asked": material, "allowed": None},
                )
            try:
                return phantoms.load_phantom(name), None
            except UnknownNameError:
                problem = f"no sample called {name!r}; there are"
                raise UnknownNameError.among(problem, name, self.names) from None
        raw = self._read_bytes(head)
        phantom = _parse(head, raw, head.material if material is None else material)
        return phantom, _revision(head, raw)

    def _read_bytes(self, head: UploadHead) -> bytes:
        """Read the bytes of an upload and compare them with its size and, if it has one,
        its revision.

        A damaged upload is removed from the list, and its files are renamed.

        Args:
            head: description of the upload.

        Raises:
            PhantomError: it cannot be read, or its bytes are not those that were stored.
        """
        stored = head.revision
        file = _bytes_file(head.name, stored)
        try:
            raw = self._folder.read(file, head.total)
            if len(raw) != head.total:
                raise ValueError(f"{len(raw)} bytes, not {head.total}")
            if stored is not None and _revision(head, raw) != stored:
                raise ValueError("its bytes are others than were stored")
        except (OSError, ValueError) as error:
            with self._lock:
                if (
                    self._heads.get(head.name) is head
                ):  # else another has come under this name
                    del self._heads[head.name]
                    for damaged in (file, f"{documents.file_stem(head.name)}.json"):
                        if self._folder.stat(damaged) is not None:
                            without = "an upload cannot be read; without it"
                            documents.set_aside(self._folder, damaged, error, without)
            raise PhantomError(
                f"the upload {head.name!r} cannot be read: {error}"
            ) from None
        return raw


def _bytes_of(phantom: Phantom) -> int:
    """Return the memory of a phantom's attenuation voxels and surface meshes [bytes];
    material labels are not counted.
    """
    voxels = 0
    if phantom.voxels is not None:
        voxels = phantom.voxels.data.nbytes
    return voxels + sum(s.vertices.nbytes + s.faces.nbytes for s in phantom.surfaces)


def _revision(head: UploadHead, raw: bytes) -> str:
    """Hash a content, its bytes and how they are read, to 16 hexadecimal digits; not its name."""
    how = f"{head.kind} {head.format} {head.unit} {head.shape} {head.voxel_mm}"
    if head.kind == "mesh" and head.place != "centred":
        how += f" {head.place}"  # appended: revisions of older servers stay what they are
    content = hashlib.sha256(how.encode() + b"\0")
    content.update(raw)
    return content.hexdigest()[:16]


def _shown(head: UploadHead, revision: str) -> str:
    """Return the content's revision, followed by the material if the upload has one: the
    same content may come in another material.
    """
    if head.material is None:
        return revision
    return f"{revision} {head.material}"


def _parse(head: UploadHead, raw: bytes, material: str | None) -> Phantom:
    """Parse the bytes of an upload: mesh or scene in a worker process, voxels here.

    `material`: of a mesh (None: `DEFAULT_MATERIAL`), or that fills voxels (None:
    attenuation). Raises PhantomError: it cannot be read, voxels of another size, or not
    finite; UnknownNameError.
    """
    match head.kind:
        case "mesh":
            return mesh_apart(
                raw,
                unit=head.unit,
                material=DEFAULT_MATERIAL if material is None else material,
                file_type=head.format,
                name=head.name,
                place=head.place,
            )
        case "scene":
            return scene_apart(raw, name=head.name)
        case "voxels":
            return _voxels(head, raw, material)
        case _:
            assert_never(head.kind)


def _voxels(head: UploadHead, raw: bytes, material: str | None) -> Phantom:
    """Make a phantom of uploaded voxels; arguments and errors as `_parse`."""
    if material is not None:
        phantoms.material(material)
    assert head.shape is not None
    assert head.voxel_mm is not None
    size = 4 * math.prod(head.shape)
    if size != len(raw):
        raise PhantomError(
            f"{head.name}: voxels of shape {list(head.shape)} are {size} bytes, not {len(raw)}",
            {"asked": len(raw), "allowed": size},
        )
    data = np.frombuffer(raw, dtype="<f4").reshape(head.shape)
    if not np.isfinite(data).all():
        raise PhantomError(f"{head.name}: voxels must be finite numbers")
    return phantoms.voxel_phantom(
        data.astype(np.float32), head.voxel_mm, name=head.name, material=material
    )


def _bytes_file(name: str, revision: str | None) -> str:
    """Return the file name of an upload's bytes; earlier servers had one file for each name."""
    if revision is None:
        return f"{documents.file_stem(name)}.bin"
    return f"{documents.file_stem(name)}.{revision}.bin"


def _head_of(file: str) -> Callable[[bytes], UploadHead]:
    """Make the parser of an upload's description, for a file of this name.

    It raises ValueError for a description that would be refused today, or is about
    another sample than the file's name.
    """

    def read(data: bytes) -> UploadHead:
        """Parse a description; raise ValueError if its sample is not the one in the file's name."""
        head = UploadHead.model_validate(documents.read_json(data))
        if file != f"{documents.file_stem(head.name)}.json":
            raise ValueError(f"it is about {head.name!r}")
        return head

    return read


def sample_material(head: UploadHead | None, material: str | None) -> str | None:
    """Choose an uploaded mesh's material: requested, described, or `DEFAULT_MATERIAL`.

    None for a sample that is no mesh.
    """
    if head is None or head.kind != "mesh":
        return None
    if material is None:
        chosen = head.material
    else:
        chosen = material
    if chosen is None:
        return DEFAULT_MATERIAL
    return chosen
