"""The sentence of an accuracy is short, whatever it has to say; its details say the rest."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection.volume import CAUSES, NOT_BOUNDED, Accuracy, doubt_words
from flexdt.twin.reconstruction.bias import STATED
from flexdt.twin.reconstruction.consistency.cause_table import rounded
from flexdt.twin.reconstruction.consistency.causes import causes_of
from flexdt.twin.reconstruction.known_beam import CORRECTED_BEAM, UNKNOWN_BEAM

MOST_WORDS = 30
VIEWS = ConeVec.circular(
    sod=100.0, sdd=200.0, angles=[0.0, 90.0], shape=(9, 9), pixel=1.0
)
NAMES = sorted(
    {STATED.get(one.name, one.name) for one in causes_of(VIEWS, np.zeros(2), np.zeros(2))}
    | {"rotation", "order", "geometry", "distances"}
    | {*UNKNOWN_BEAM.taken, *CORRECTED_BEAM.taken}
)


def drawn(rng: np.random.Generator) -> Accuracy:
    """One of all that an accuracy may be."""
    taken = rng.permutation(NAMES)[: int(rng.choice([0, 1, 2, len(NAMES)]))].tolist()
    figure = "-0.591 ± 0.012 mm in the course of the scan"
    most = float(10.0 ** rng.uniform(-4, 1))
    return Accuracy(
        0.4 * most,
        most,
        str(rng.choice(list(CAUSES))),
        bool(rng.random() < 0.1),
        str(rng.choice(["", figure])),
        tuple(taken),
        str(rng.choice(["", *CAUSES])),
        figure,
        float(rng.choice([0.0, 1.25])),
        None if rng.random() < 0.2 else float(10.0 ** rng.uniform(-3, 2)),
        str(rng.choice(["", *CAUSES])),
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
        assert ("edges within" in said) == (one.edges_mm is not None)
        assert ("as stated" in said) == bool({*one.taken} - {*UNKNOWN_BEAM.taken})


def test_details_say_what_the_sentence_leaves_out() -> None:
    taken = ("rotation", "one energy", "material", "distances")
    full = Accuracy(
        0.01, 0.02, "gain", False, "+3 %", taken, "axis", "+1 mm", 2.0, 2.1, "axis"
    )
    assert str(full) == (
        "accuracy at one energy: within 2 % in nine of ten uniform regions, edges within "
        "2.1 mm, mainly the gain of views; if rotation and more are as stated"
    )
    assert full.details == (
        "accuracy at one energy: within 2 % in nine of ten uniform regions (1 % in half), mainly "
        "the gain of views (+3 %), then the axis offset (+1 mm), edges within 2.1 mm (the axis "
        "offset), doubled by 2 mm; if rotation, material and distances are as stated"
    )


def test_a_warning_names_causes_and_no_figure() -> None:
    assert doubt_words([]) == []
    assert doubt_words(["cone", "drift"], "axis") == [
        "values may be off and edges doubled: the cone angle, a drift of the flat, the axis "
        "offset; see its accuracy"
    ]
    assert doubt_words(["beyond", "cone"]) == [f"values may be off; {NOT_BOUNDED}"]


@pytest.mark.parametrize(
    ("size", "sigma", "said"),
    [
        (-0.98712, 0.0023, ("-0.9871", "0.0023")),
        (-1.02, 0.002, ("-1.0200", "0.0020")),
        (2.4, 0.3, ("+2.40", "0.30")),
        (1234.4, 45.6, ("+1234", "46")),
        (0.5, 0.0996, ("+0.500", "0.100")),
    ],
)
def test_a_size_and_its_error_have_the_same_decimals(
    size: float, sigma: float, said: tuple[str, str]
) -> None:
    assert rounded(size, sigma) == said
