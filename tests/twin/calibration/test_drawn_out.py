"""A scan whose exposures draw most shadows out is calibrated, or told to be that."""

from __future__ import annotations

import arcs_drawn
import pytest


@pytest.mark.slow
@pytest.mark.campaign
def test_an_exposure_of_more_than_a_step_is_followed_where_half_the_shadows_are_long() -> (
    None
):
    one = arcs_drawn.told(24, 1.2, 1.5)
    assert one.offered, one.said
    assert one.codes == {"exposure_arc"}
    assert one.found == pytest.approx(one.share, rel=0.01)
    assert one.worst < 4.0
