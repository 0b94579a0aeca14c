"""protocol/openrpc.json and SPEC.md's table of parameters are what the models say.

`python tests/protocol/test_openrpc_file.py` writes both anew.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

from flexdt.protocol import METHODS
from flexdt.protocol.methods import openrpc_document
from flexdt.protocol.methods.image_messages import ProjectionGet
from flexdt.protocol.methods.scanner_messages import SampleUpload
from flexdt.protocol.state_model import JobPhase

PROTOCOL = Path(__file__).parents[2] / "protocol"
SPEC = (PROTOCOL / "SPEC.md").read_text("utf-8")
HEAD = "| method | parameters |\n|---|---|\n"


def text() -> str:
    return json.dumps(openrpc_document(), indent=1) + "\n"


def table() -> str:
    rows = []
    for name, method in METHODS.items():
        fields = method.params.model_fields
        words = [
            f"`{key}`" + ("" if f.is_required() else "?") for key, f in fields.items()
        ]
        rows.append(f"| `{name}` | {', '.join(words) or 'none'} |\n")
    return "".join(rows)


def test_the_openrpc_file_is_current() -> None:
    assert (PROTOCOL / "openrpc.json").read_text("utf-8") == text()


def test_the_table_of_parameters_is_current() -> None:
    assert SPEC.split(HEAD)[1].split("\n\n")[0] + "\n" == table()


def test_states_of_jobs_and_kinds_of_images_are_named() -> None:
    [states] = re.findall(r"A job is (.*?)\.", SPEC)
    assert re.findall(r"`(\w+)`", states) == list(get_args(JobPhase))
    [kinds] = re.findall(r"`kind` of an image: (.*?)\.\n", SPEC, re.DOTALL)
    choices = get_args(ProjectionGet.model_fields["kind"].annotation)
    assert re.findall(r"`(\w+)` \(", kinds) == list(choices)
    [uploads] = re.findall(r"`kind` of an upload: (.*?)\.\n", SPEC, re.DOTALL)
    assert re.findall(r"`(\w+)`", uploads) == list(
        get_args(SampleUpload.model_fields["kind"].annotation)
    )


if __name__ == "__main__":
    (PROTOCOL / "openrpc.json").write_text(text(), "utf-8")
    before, after = SPEC.split(HEAD)
    rest = after.split("\n\n", 1)[1]
    (PROTOCOL / "SPEC.md").write_text(f"{before}{HEAD}{table()}\n{rest}", "utf-8")
