"""Arguments that findings advise are followed, and mend the scan or withhold its numbers."""

from __future__ import annotations

import advice_followed
import pytest


def test_every_advised_argument_is_read_from_its_sentence() -> None:
    said = "moves: --per-frame dO_x,alpha follows it; free dD_z, det_roll too, or give the prior"
    told = [argument for argument, _ in advice_followed.arguments(said)]
    assert told == ["--per-frame dO_x,alpha", "free dD_z,det_roll"]
    assert [
        a for a, _ in advice_followed.arguments("measure it, or give --bead-tolerance")
    ]


@pytest.mark.slow
@pytest.mark.campaign(2)
@pytest.mark.parametrize("kind", advice_followed.ADVISED)
def test_following_the_advice_is_right_or_more_careful(kind: str) -> None:
    for run in advice_followed.followed(kind, 3):
        assert not run.wrong, run
