"""SPEC.md's conversations are what a twin answers, byte by byte, and the scan ends in a volume.

`python tests/protocol/test_spec_conversation.py` records it anew into SPEC.md.
"""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import flexdt
from flexdt.clients.cli.command_tree import run
from flexdt.library.reconstruction.volume_files import read_volume
from flexdt.phantoms import lego_phantom
from flexdt.protocol.image import decode
from flexdt.runtime.files.directory import open_data
from flexdt.server.network.tcp import serve
from flexdt.server.twin.application import TwinSession
from flexdt.server.twin.core import TwinServer
from flexdt.testing.in_process import DirectProjector
from flexdt.twin.dataset.flexdt_json import parse_document
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.scanner.state import Sample

SPEC = Path(__file__).parents[2] / "protocol" / "SPEC.md"
READER = Path(__file__).parents[1] / "support" / "independent_reader.py"
VERSION = "flexdt X.Y.Z"
"""In place of the version, which is another one with each release."""
INSTANCE = "5d41402abc4b2a76"
"""In place of the name of a server's run, which is made up."""


def talk(name: str) -> list[str]:
    [block] = re.findall(rf"```{name}\n(.*?)```", SPEC.read_text("utf-8"), re.DOTALL)
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
        answer = b'"state":"queued"'
        while re.search(rb'"state":"(queued|running)"', answer):
            writer.write(line.encode() + b"\n")
            while b'"event"' in (
                answer := await asyncio.wait_for(reader.readline(), 120)
            ):
                pass
        here = writer.get_extra_info("sockname")[1]
        out.append(answer.replace(f":{here}#".encode(), b":50412#"))
    writer.close()
    await server.close()
    await twin.stop()
    return out


def recorded(asked: list[str], folder: str) -> list[str]:
    got = asyncio.run(answers(Path(folder), asked))
    version = f"flexdt {flexdt.__version__}"
    texts = [line.decode().rstrip("\n") for line in got]
    texts = [re.sub(r'(?<="real_time_factor":)[\d.]+', "50.0", text) for text in texts]
    texts = [re.sub(r'(?<="instance":")[0-9a-f]{16}', INSTANCE, text) for text in texts]
    return [t.replace(version, VERSION).replace(folder, "/data") for t in texts]


def check(name: str, folder: Path) -> set[str]:
    """The methods of a conversation whose answers are those of a twin with `folder`."""
    lines = talk(name)
    asked = [line[3:] for line in lines if line.startswith("-> ")]
    stated = [line[3:] for line in lines if line.startswith("<- ")]
    assert len(asked) + len(stated) == len(lines)
    methods = {json.loads(line)["method"] for line in asked}
    for want, got in zip(stated, recorded(asked, str(folder)), strict=True):
        # Values of pixels may end in other digits on another processor; nothing else may.
        image, other = json.loads(want)["result"], json.loads(got)["result"]
        if "dtype" in image:
            np.testing.assert_allclose(decode(other), decode(image), rtol=1e-4, atol=1e-6)
            want, got = (
                s.replace(i["data"], "") for s, i in ((want, image), (got, other))
            )
        assert got == want
    return methods


def test_the_conversation_is_what_the_twin_answers(tmp_path: Path) -> None:
    methods = check("talk", tmp_path)
    assert {"axes.move", "geometry.get", "projection.get", "script.submit"} <= methods


def test_the_scan_of_the_conversation_ends_in_a_volume(tmp_path: Path) -> None:
    """And a reader that imports nothing of the package has the same geometry from its texts."""
    assert "trajectory.submit" in check("talk scan", tmp_path)
    scan, out = tmp_path / "turned", tmp_path / "volume.tif"
    words = ["--out", str(out), "--voxel", "0.5", "--shape", "110,80,80"]
    assert run(["reconstruct", str(scan), *words]) == 0
    data = read_volume(out).data
    at = np.round(lego_phantom().beads / 0.5 + np.array([39.5, 39.5, 54.5])).astype(int)
    beads = [data[z - 1 : z + 2, y - 1 : y + 2, x - 1 : x + 2].max() for x, y, z in at]
    assert min(beads) > np.quantile(data, 0.999)
    reader = [sys.executable, "-I", str(READER), str(scan)]
    theirs = json.loads(subprocess.run(reader, capture_output=True, check=True).stdout)
    ours = parse_document((scan / "flexdt.json").read_text()).cone_vec().rows
    np.testing.assert_allclose(theirs["motors"], ours, rtol=1e-6, atol=1e-3)


if __name__ == "__main__":
    for name in ("talk", "talk scan"):
        asked = [line[3:] for line in talk(name) if line.startswith("-> ")]
        with tempfile.TemporaryDirectory() as folder:
            got = recorded(asked, folder)
        block = "\n".join(f"-> {q}\n<- {a}" for q, a in zip(asked, got, strict=True))
        SPEC.write_text(
            re.sub(
                rf"```{name}\n.*?```",
                lambda _, block=block, name=name: f"```{name}\n{block}\n```",
                SPEC.read_text("utf-8"),
                flags=re.DOTALL,
            ),
            "utf-8",
        )
