"""Coverage-guided fuzzing of everything that reads a stranger's bytes.

    pip install 'flexdt[test]'        # atheris, where it has a wheel
    python tests/studies/fuzz_atheris.py framing|rpc|script|settings|xre|document|each [OPTIONS]

Options are libFuzzer's, for example `-max_total_time=60`. A target that raises anything but its own
errors, or hangs, stops with the input that did it; nothing but statistics means that all was well.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable

import atheris

with atheris.instrument_imports(include=["flexdt.protocol", "flexdt.twin"]):
    from flexdt.protocol import (
        METHODS,
        Batch,
        Connection,
        Malformed,
        Request,
        RpcError,
        frames,
        parse_params,
    )
    from flexdt.twin.dataset.document import parse_document
    from flexdt.twin.dataset.errors import DatasetError
    from flexdt.twin.dataset.settings_text import parse_scan_settings
    from flexdt.twin.dataset.xre import parse_xre
    from flexdt.twin.machine import builtin_machine, builtin_profile
    from flexdt.twin.script.check import check_script

MACHINE = builtin_machine("flexray")
PROFILE = builtin_profile(MACHINE.default_profile)
METHOD_LIST = sorted(METHODS)


def framing(data: bytes) -> None:
    """Bytes to messages, whole and in two pieces: the same messages either way."""
    whole, split = Connection(max_message=4096), Connection(max_message=4096)
    cut = len(data) // 2
    first = whole.receive_data(data)
    second = split.receive_data(data[:cut]) + split.receive_data(data[cut:])
    if not any(isinstance(m, Malformed) for m in first):
        assert repr(first) == repr(second)
    for message in first:
        whole.send(message if not isinstance(message, Malformed) else message.reply)
    frames.unpack(memoryview(data))


def rpc(data: bytes) -> None:
    """A document to a method's parameters."""
    if not data:
        return
    name = METHOD_LIST[data[0] % len(METHOD_LIST)]
    line = b'{"jsonrpc":"2.0","id":1,"method":"' + name.encode() + b'","params":' + data[1:]
    for message in Connection().receive_data(line.replace(b"\n", b" ") + b"}\n"):
        for item in message.items if isinstance(message, Batch) else [message]:
            if isinstance(item, Request) and item.method in METHODS:
                with contextlib.suppress(RpcError):
                    parse_params(METHODS[item.method], item.params)


def script(data: bytes) -> None:
    """A script to its report."""
    check_script(data[:2000], MACHINE, PROFILE).to_dict()


def settings(data: bytes) -> None:
    """The scanner's first text."""
    with contextlib.suppress(DatasetError):
        parse_scan_settings(data.decode("utf-8", "replace"))


def xre(data: bytes) -> None:
    """The scanner's second text."""
    with contextlib.suppress(DatasetError):
        parse_xre(data.decode("utf-8", "replace"))


def document(data: bytes) -> None:
    """flexdt.json."""
    with contextlib.suppress(DatasetError):
        parse_document(data.decode("utf-8", "replace"))


TARGETS: dict[str, Callable[[bytes], None]] = {
    f.__name__: f for f in (framing, rpc, script, settings, xre, document)
}


def each(data: bytes) -> None:
    """All of them in one process: the first byte chooses."""
    if data:
        list(TARGETS.values())[data[0] % len(TARGETS)](data[1:])


if __name__ == "__main__":
    target = {**TARGETS, "each": each}[sys.argv.pop(1)]
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
