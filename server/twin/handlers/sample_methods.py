"""sample.*: the sample on the stage, and uploads."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from functools import lru_cache

from flexdt.phantoms import Phantom, is_shipped, load_phantom, materials
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods import scanner_messages as p
from flexdt.protocol.rpc_errors import busy
from flexdt.server.storage.sample_uploads import UploadHead
from flexdt.server.storage.stored_samples import sample_material
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers import handler as h
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.scanner.state import EMPTY_STAGE, Sample, StagePlacement

MAX_NAMED_UPLOADS = 50
"""Number of the newest uploads that an error lists."""


@h.answers(p.SAMPLE_SET)
async def set_sample(
    twin: TwinServer, client: h.Client, params: p.SampleSet
) -> p.SampleResult:
    """Put a shipped phantom, an upload or nothing on the stage; without an offset it is
    centered.

    It needs control and an idle twin, after the reading and when it is done. The sample
    is read first, in a thread.

    Returns:
        The sample on the stage, and a warning of motion that was halted.

    Raises:
        UnknownNameError: an upload given as `file`, or a sample, that does not exist.
    """
    if params.name is None:
        name = params.file
    else:
        name = params.name
    assert name is not None
    head = twin.samples.head(name)
    if params.file is not None and head is None:
        raise _unknown_upload(twin, name)
    if params.offset is None:
        offset = StagePlacement()
    else:
        offset = StagePlacement(**params.offset.model_dump())
    if name == EMPTY_STAGE:
        sample = Sample()
    else:
        async with twin.samples.turn:
            await asyncio.to_thread(twin.samples.load, name, params.material)
        sample = Sample(name, offset, params.material)
    ready = h.ensure_idle(twin, client, "sample.set", "a sample")
    ready()
    async with twin.stage_turn:
        warnings = await h.change_stage(twin, sample, twin.scanner.correction, ready)
    return p.SampleResult(sample=twin.sample_state(), warnings=warnings)


@h.answers(p.SAMPLE_LIST)
async def list_samples(
    twin: TwinServer, client: h.Client, params: p.SampleList
) -> p.SampleListResult | Encoded:
    """List the empty stage, shipped phantoms and uploads, in that order, or a part of
    them, and all materials.

    Phantoms have their size [mm], uploads a text with format and bytes. The list is made
    in several turns of the loop; more than `ITEMS_A_TURN` entries are encoded in a
    thread.
    """
    names = [EMPTY_STAGE, *twin.samples.names]
    part = h.page(names, params.start, params.count)
    found = await h.in_turns(part, lambda name: _listed(twin, name))
    samples = [info for info in found if info is not None]
    result = p.SampleListResult(
        samples=samples, total=len(names), materials=list(materials())
    )
    return await h.encoded_apart(client, result, len(samples))


def _listed(twin: TwinServer, name: str) -> p.SampleInfo | None:
    """Describe a sample for the list; None for an upload that is gone meanwhile."""
    if name == EMPTY_STAGE:
        return p.SampleInfo(
            name=name, description="nothing on the stage", size_mm=(0.0, 0.0, 0.0)
        )
    if is_shipped(name):
        return _shipped_info(name)
    head = twin.samples.head(name)
    return None if head is None else _upload_info(head)


@h.answers(p.SAMPLE_MESH)
async def mesh(
    twin: TwinServer, client: h.Client, params: p.SampleMesh
) -> p.SampleMeshResult:
    """Return `count` bytes from `start` of the mesh (binary STL) of the sample on the
    stage, for drawing.

    A part beyond the end is shorter or empty; `total` is the mesh's size [bytes]. The
    mesh of a sample is made once, in a thread.

    Raises:
        LimitError: the stage is empty.
        PhantomError: an upload that cannot be read any more.
        RpcError: -32008, the mesh would be larger than the limit.
    """
    sample = twin.scanner.sample
    if not sample.name:
        raise LimitError("nothing stands on the stage", {"asked": "sample.mesh"})
    revision = twin.samples.revision(sample.name)
    shape = twin.shapes.known(sample.name, revision)
    if shape is None:
        async with (
            twin.samples.turn
        ):  # one at a time, so that a scan always finds a thread
            phantom = await asyncio.to_thread(
                twin.samples.load, sample.name, sample.material
            )
            shape = await asyncio.to_thread(
                twin.shapes.of, sample.name, revision, phantom
            )
    part = shape.stl[params.start : params.start + params.count]
    return p.SampleMeshResult(
        name=shape.name,
        revision=shape.revision,
        total=len(shape.stl),
        start=params.start,
        data=part,
    )


@h.answers(p.SAMPLE_UPLOAD)
async def upload(
    twin: TwinServer, client: h.Client, params: p.SampleUpload
) -> p.UploadResult:
    """Store one chunk of an upload; after the last one parse the sample, store it, and
    log it.

    A complete upload under the name of the sample on the stage replaces that one there.
    An upload that replaces another needs control at each chunk, as `delete` does, and
    for the sample on the stage an idle twin. One by an observer is within a quota.

    Returns:
        The bytes received and `complete`; for a complete upload also the sample, and
        warnings of assumed values and of motion that was halted.
    """
    head = UploadHead.of(params)
    _ensure_replaceable(twin, client, head.name)
    observer = twin.control.is_observer(client.name)
    received, came = await asyncio.to_thread(
        twin.samples.receive, head, params.start, params.data, observer=observer
    )
    if received < head.total:
        return p.UploadResult(name=head.name, received=received, complete=False)
    async with twin.samples.turn, twin.stage_turn:
        _ensure_replaceable(twin, client, head.name)
        stands = twin.scanner.sample
        there = stands.name == head.name
        if head.kind != "mesh":
            stands = replace(stands, material=None)
        material = stands.material if there else None
        observer = twin.control.is_observer(client.name)
        upload = await asyncio.to_thread(
            twin.samples.parse, came, material, observer=observer
        )
        warnings = list(upload.phantom.assumed)

        def take() -> None:
            """Take the upload in; raise first if it would replace one of another's."""
            _ensure_replaceable(twin, client, head.name)
            twin.samples.know(upload)

        try:
            await asyncio.to_thread(twin.samples.prepare, upload)
            if there:
                warnings += await h.change_stage(
                    twin,
                    stands,
                    twin.scanner.correction,
                    lambda: _ensure_replaceable(twin, client, head.name),
                    upload=upload,
                )
            else:
                await twin.state_store.keep(
                    take,
                    files=lambda changes: twin.samples.store(changes, upload),
                )
        # Not of a cancellation: the change that was begun goes on, and needs the bytes.
        except Exception:
            await asyncio.to_thread(twin.samples.tidy)
            raise
        await asyncio.to_thread(twin.samples.tidy)
    twin.tell("info", f"sample {head.name!r} was uploaded", bytes=received)
    return p.UploadResult(
        name=head.name,
        received=received,
        complete=True,
        sample=_sample_info(head.name, upload.phantom, head),
        warnings=warnings,
    )


@h.answers(p.SAMPLE_DELETE)
async def delete(
    twin: TwinServer, client: h.Client, params: p.SampleDelete
) -> p.SampleDeleteResult:
    """Delete an upload and its files, and log it.

    That it is not in use is checked at the request and again when it is done.

    Returns:
        The name and the upload's size [bytes].

    Raises:
        UnknownNameError: there is no such upload.
        LimitError: it is on the stage.
        RpcError: -32003, a scan of it has not ended, or the client has lost control.
    """
    name = params.name
    ready = h.ensure_allowed(twin, client, "sample.delete")
    async with twin.samples.turn, twin.stage_turn:
        head = twin.samples.head(name)
        if head is None:
            raise _unknown_upload(twin, name)
        _ensure_unused(twin, name)

        def take() -> None:
            """Forget the upload; raise if control is lost or it is in use."""
            ready()
            _ensure_unused(twin, name)
            twin.samples.forget(name)

        await twin.state_store.keep(
            take, files=lambda changes: twin.samples.remove(changes, name)
        )
        await asyncio.to_thread(twin.samples.tidy)
    twin.tell("info", f"sample {name!r} was deleted", bytes=head.total)
    return p.SampleDeleteResult(name=name, bytes=head.total)


def _ensure_unused(twin: TwinServer, name: str) -> None:
    """Check that an upload is not on the stage, and then that no scan that has not ended
    shows it.

    Raises:
        LimitError: it is on the stage.
        RpcError: -32003, a scan of it has not ended; names the job.
    """
    if name == twin.scanner.sample.name:
        raise LimitError(
            f"{name!r} stands on the stage and cannot be deleted",
            {"asked": name, "allowed": "sample.set of another one first"},
        )
    job = twin.jobs.showing(name)
    if job is not None:
        raise busy(
            f"{name!r} is in {job.id}, which is {job.phase}, and cannot be deleted",
            {"asked": name, "job": job.id, "allowed": "job.abort"},
        )


def _ensure_replaceable(twin: TwinServer, client: h.Client, name: str) -> None:
    """Check that a file may replace another of its name: with control; on the stage, at
    rest.

    Control is taken where it is free. A scan that has begun with the file there would be
    refused from then on. Raises RpcError: -32003.
    """
    if twin.samples.head(name) is not None:
        before = twin.control.holder
        twin.control.require(client.name, "sample.upload")
        if before != twin.control.holder:
            twin.feed.changed()
    if name == twin.scanner.sample.name:
        h.ensure_idle(twin, client, "sample.upload", "sample.upload")()


@lru_cache(maxsize=64)
def _shipped_info(name: str) -> p.SampleInfo:
    """Describe a shipped phantom, which never changes; making one takes milliseconds."""
    return _sample_info(name, load_phantom(name))


def _sample_info(
    name: str, phantom: Phantom, head: UploadHead | None = None
) -> p.SampleInfo:
    """Describe a sample for the list.

    `head`: of an upload, which gives the kind; None for a shipped phantom.
    """
    return p.SampleInfo(
        name=name,
        kind="phantom" if head is None else head.kind,
        description=phantom.description,
        size_mm=phantom.size_mm,
        uploaded=head is not None,
    )


def _upload_info(head: UploadHead) -> p.SampleInfo:
    """Describe an upload without reading it: name, kind, format and bytes; no size in mm."""
    material = sample_material(head, None)
    of = "" if material is None else f" of {material}"
    what = f"{head.format} {head.kind}{of}, {head.total} bytes"
    return p.SampleInfo(name=head.name, kind=head.kind, description=what, uploaded=True)


def _unknown_upload(twin: TwinServer, name: str) -> UnknownNameError:
    """Make, not raise, the error for an upload that does not exist.

    It names the last `MAX_NAMED_UPLOADS` uploads and the number of older ones, or that
    there are none.
    """
    uploads = list(twin.samples.uploads)[-MAX_NAMED_UPLOADS:]
    older = len(twin.samples.uploads) - len(uploads)
    more = ""
    if older:
        more = f"{older} older ones and "
    there = "nothing has been uploaded yet"
    if uploads:
        there = f"there are: {more}{', '.join(uploads)}"
    return UnknownNameError(
        f"no upload called {name!r}; {there}", {"asked": name, "allowed": uploads}
    )
