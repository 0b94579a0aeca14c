"""The study of contradictions in its short form."""

import contradictions
import pytest


@pytest.mark.slow
def test_contradictions_are_refused_said_or_right():
    pytest.importorskip("h5py")
    assert contradictions.main(["--count", "81", "--right", "60", "--seed", "7"]) == 0
