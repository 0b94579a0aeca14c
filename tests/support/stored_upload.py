"""An upload made whole as the server makes it, without a server."""

from __future__ import annotations

from flexdt.phantoms import Phantom
from flexdt.runtime.files.own_documents import Changes
from flexdt.server.storage.stored_samples import SampleStore


def completed(store: SampleStore, name: str) -> Phantom:
    """Read and keep an upload of which all bytes have come."""
    upload = store.parse(store._incoming._open[name])
    with Changes() as changes:
        store.prepare(upload)
        store.store(changes, upload)
    store.know(upload)
    store.tidy()
    return upload.phantom
