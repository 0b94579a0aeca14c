"""The sentence of an accuracy is short, whatever it has to say; its details say the rest."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.projection.volume import CAUSES, NOT_BOUNDED, Accuracy, doubt_words
from flexdt.twin.reconstruction.bias import STATED
from flexdt.twin.reconstruction.consistency.causes import causes_of
from flexdt.twin.reconstruction.known_beam import CORRECTED_BEAM, UNKNOWN_BEAM

MOST_WORDS = 30
NAMES = sorted(
    {STATED.get(one.name, one.name) for one in causes_of(np.zeros(2))}
    | {"rotation", "order", "geometry", "distances"}
    | {*UNKNOWN_BEAM.taken, *CORRECTED_BEAM.taken}
)


def drawn(rng: np.random.Generator) -> Accuracy:
    """One of all that an accuracy may be."""
    taken = rng.permutation(NAMES)[: int(rng.choice([0, 1, 2, len(NAMES)]))].tolist()
    figure = "-0.591 ± 0.0123 px in the course of the scan"
    most = float(10.0 ** rng.uniform(-4, 1))
    return Accuracy(
        0.4 * most,
        most,
        str(rng.choice(list(CAUSES))),
        bool(rng.random() < 0.1),
        str(rng.choice(["", figure])),
        tuple(taken),
        str(rng.choice(["", f"the axis offset ({figure})"])),
        float(rng.choice([0.0, 1.25])),
        edges=None if rng.random() < 0.2 else float(10.0 ** rng.uniform(-3, 2)),
    )


@pytest.mark.parametrize("seed", range(4))
def test_every_sentence_has_at_most_30_words(seed: int) -> None:
    rng = np.random.default_rng([seed, 78])
    for one in [drawn(rng) for _ in range(2000)]:
        said = str(one)
        assert len(said.split()) <= MOST_WORDS, said
        if one.cut_off:
            continue
        assert CAUSES[one.cause] in said
        assert ("edges within" in said) == (one.edges is not None)
        assert ("as stated" in said) == bool({*one.taken} - {*UNKNOWN_BEAM.taken})


def test_details_say_what_the_sentence_leaves_out() -> None:
    taken = ("rotation", "one energy", "material", "distances")
    full = Accuracy(
        0.01, 0.02, "axis", False, "+3 px", taken, "the axis offset (x)", 6.0, 6.1
    )
    assert str(full) == (
        "accuracy at one energy: within 2 % in nine of ten uniform regions, edges within "
        "6.1 pixels, mainly the axis offset; if rotation and more are as stated"
    )
    assert full.details == (
        "accuracy at one energy: within 2 % in nine of ten uniform regions (1 % in half), mainly "
        "the axis offset (+3 px), then the axis offset (x), edges doubled by 6 pixels; if "
        "rotation, material and distances are as stated"
    )


def test_a_warning_names_causes_and_no_figure() -> None:
    assert doubt_words([]) == []
    assert doubt_words(["cone", "drift"], "axis") == [
        "values may be off and edges doubled: the cone angle, a drift of the flat, the axis "
        "offset; see its accuracy"
    ]
    assert doubt_words(["beyond", "cone"]) == [f"values may be off; {NOT_BOUNDED}"]
