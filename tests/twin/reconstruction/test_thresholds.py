"""Each number that decides what is claimed of a volume has a source, in one list."""

from __future__ import annotations

from flexdt.twin.reconstruction.consistency.thresholds import (
    SOURCES,
    Source,
    thresholds,
)


def test_each_number_of_the_code_is_in_the_list_and_no_other() -> None:
    found = list(thresholds())
    listed = {
        (module, name)
        for module, sources in SOURCES.items()
        for names in sources.values()
        for name in names.split()
    }
    assert {(one.module, one.name) for one in found if one.source is None} == set()
    assert listed == {(one.module, one.name) for one in found}
    assert [one.name for one in found if not one.meaning] == []


def test_what_is_said_to_be_assumed_or_from_literature_is_so_in_its_words() -> None:
    for one in thresholds():
        assert ("(assumed" not in one.meaning) or one.source is Source.ASSUMED, one
        if one.source is Source.LITERATURE:
            assert any(f"({year})" in one.meaning for year in range(1960, 2030)), one
