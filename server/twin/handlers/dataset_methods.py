"""dataset.*, calibration.fit and .align: scans that were made, as their folders say."""

from __future__ import annotations

from pathlib import Path

from flexdt.protocol.fields import Params
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods import dataset_messages as p
from flexdt.protocol.methods.calibration_messages import CALIBRATION_ALIGN, CALIBRATION_FIT
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, answers


@answers(p.DATASET_LIST, p.DATASET_GET, p.DATASET_FRAME, CALIBRATION_FIT, CALIBRATION_ALIGN)
async def answer(twin: TwinServer, client: Client, params: Params) -> Encoded:
    """What a worker process reads of the data directory."""
    job = twin.jobs.current
    running = "" if job is None else Path(job.folder).name
    return await twin.past_scans.ask(params, running, client.peer.codec)
