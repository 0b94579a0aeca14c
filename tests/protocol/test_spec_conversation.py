"""SPEC.md's conversation is what a twin answers, byte by byte.

`python tests/protocol/test_spec_conversation.py` records it anew into SPEC.md.
"""

from __future__ import annotations

import asyncio
import json
import re
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from direct_projector import DirectProjector

import flexdt
from flexdt.protocol.image import decode
from flexdt.runtime.files.directory import open_data
from flexdt.server.network.tcp import serve
from flexdt.server.twin.application import TwinSession
from flexdt.server.twin.core import TwinServer
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.scanner.state import Sample

SPEC = Path(__file__).parents[2] / "protocol" / "SPEC.md"
VERSION = "flexdt X.Y.Z"
"""In place of the version, which is another one with each release."""


def talk() -> list[str]:
    [block] = re.findall(r"```talk\n(.*?)```", SPEC.read_text("utf-8"), re.DOTALL)
    return str(block).strip().splitlines()


async def answers(root: Path, asked: list[str]) -> list[bytes]:
    """What a twin answers to each line, over a socket."""
    machine = builtin_machine()
    twin = TwinServer(
        machine, profile_of(machine), DirectProjector(), open_data(root), speed_up="max"
    )
    await twin.start(Sample("lego"))
    server = await serve(lambda peer: TwinSession(twin, peer))
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    out = []
    for line in asked:
        writer.write(line.encode() + b"\n")
        while b'"event"' in (answer := await asyncio.wait_for(reader.readline(), 120)):
            pass
        here = writer.get_extra_info("sockname")[1]
        out.append(answer.replace(f":{here}#".encode(), b":50412#"))
    writer.close()
    await server.close()
    await twin.stop()
    return out


def recorded(asked: list[str]) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        got = asyncio.run(answers(Path(folder), asked))
    version = f"flexdt {flexdt.__version__}"
    texts = [line.decode().rstrip("\n") for line in got]
    return [t.replace(version, VERSION).replace(folder, "/data") for t in texts]


def test_the_conversation_is_what_the_twin_answers() -> None:
    lines = talk()
    asked = [line[3:] for line in lines if line.startswith("-> ")]
    stated = [line[3:] for line in lines if line.startswith("<- ")]
    assert len(asked) + len(stated) == len(lines)
    methods = {json.loads(line)["method"] for line in asked}
    assert {"axes.move", "geometry.get", "projection.get", "script.submit"} <= methods
    for want, got in zip(stated, recorded(asked), strict=True):
        # Values of pixels may end in other digits on another processor; nothing else may.
        image, other = json.loads(want)["result"], json.loads(got)["result"]
        if "dtype" in image:
            np.testing.assert_allclose(decode(other), decode(image), rtol=1e-4, atol=1e-6)
            want, got = (s.replace(i["data"], "") for s, i in ((want, image), (got, other)))
        assert got == want


if __name__ == "__main__":
    asked = [line[3:] for line in talk() if line.startswith("-> ")]
    block = "\n".join(f"-> {q}\n<- {a}" for q, a in zip(asked, recorded(asked), strict=True))
    text = SPEC.read_text("utf-8")
    SPEC.write_text(
        re.sub(r"```talk\n.*?```", lambda _: f"```talk\n{block}\n```", text, flags=re.DOTALL),
        "utf-8",
    )
