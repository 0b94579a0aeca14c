"""Words that commands take: those of the tables that carry them out.

They stand twice, because building the command tree imports no library.
"""

from __future__ import annotations

from typing import Any, get_args

import pytest

from flexdt.clients.cli.commands import data_commands
from flexdt.library.datasets.exchange import ENDINGS, FORMATS
from flexdt.library.reconstruction.reconstruct import ALGORITHMS


@pytest.mark.parametrize(
    ("taken", "known"),
    [
        (data_commands.Algorithm, ALGORITHMS),
        (data_commands.Format, FORMATS),
        (data_commands.Exported, ENDINGS),
    ],
)
def test_a_command_takes_what_there_is(taken: Any, known: Any) -> None:
    assert set(get_args(taken)) == set(known)


def test_every_format_has_its_endings() -> None:
    assert set(FORMATS) == set(ENDINGS) - {"nxtomo"}
