"""The twin server's methods, a module a topic: parameters, results, and the methods themselves.

`METHODS` is the one table from which handlers, clients and the OpenRPC document follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from flexdt.protocol.method import AnyMethod, Method
from flexdt.protocol.methods import calibration_messages as calibration
from flexdt.protocol.methods import dataset_messages as datasets
from flexdt.protocol.methods import document_messages as documents
from flexdt.protocol.methods import image_messages as images
from flexdt.protocol.methods import job_messages as jobs
from flexdt.protocol.methods import motion_messages as motion
from flexdt.protocol.methods import sample_messages as samples
from flexdt.protocol.methods import session_messages as session
from flexdt.protocol.methods import setting_messages as settings
from flexdt.protocol.rpc_errors import method_not_found

TOPICS: Final = (
    session, motion, settings, samples, images, jobs, datasets, calibration, documents,
)  # fmt: skip

METHODS: Final[Mapping[str, AnyMethod]] = {
    found.name: found
    for topic in TOPICS
    for found in vars(topic).values()
    if isinstance(found, Method)
}
"""Every method of the twin server, by name."""


def find(name: str, methods: Mapping[str, AnyMethod] = METHODS) -> AnyMethod:
    """The method called `name`.

    Raises:
        RpcError: -32601, listing the methods.
    """
    if name not in methods:
        raise method_not_found(name, methods)
    return methods[name]
