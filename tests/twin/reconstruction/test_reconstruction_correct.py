"""Rings and beam hardening, each against something that knows the answer."""

from __future__ import annotations

import numpy as np
import pytest
from circular_scans import ball, circle

from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import LimitError
from flexdt.twin.physics.chain import Chain, weights_of
from flexdt.twin.physics.detector import Detector
from flexdt.twin.reconstruction import Grid, fdk, hardening, ring_errors

ALUMINIUM = Substance.of("aluminium", "Al", 2.7)


def test_hardening_is_undone():
    """Independent of the correction's table: a finer sum over the spectrum at other
    thicknesses."""
    signal, _ = weights_of(Chain(Detector()), 90.0)
    thickness = np.array([0.0, 0.37, 1.9, 7.3, 23.0])
    measured = -np.log(
        np.exp(-np.outer(thickness, ALUMINIUM.attenuation())) @ signal / signal.sum()
    )
    correct = hardening(ALUMINIUM, 90.0, 50.25)
    mu = float(np.interp(50.25, tables().energy_keV, ALUMINIUM.attenuation()))
    np.testing.assert_allclose(correct(measured), thickness * mu, rtol=2e-3, atol=1e-5)
    small = correct(np.array([-0.001, 0.001], np.float32))
    assert small[0] == pytest.approx(-small[1], rel=0.02)
    assert (
        correct(np.array([30.0], np.float32))[0]
        > correct(np.array([20.0], np.float32))[0]
    )


def test_rings_go_and_the_object_stays():
    """No two of the wrong columns are as far from the axis, where they would be the
    object's."""
    scan = circle(120)
    clean = ball(scan, (40, 130))
    wrong = np.zeros((40, 130), np.float32)
    wrong[:, [40, 61, 62, 96]] = [0.01, -0.008, 0.006, 0.012]
    found = ring_errors(iter(clean + wrong), 64.5, width=5)
    assert np.abs(ring_errors(iter(clean), 64.5)).max() < 1e-4
    rest = np.abs(found - wrong)
    assert np.quantile(rest, 0.95) < 0.004
    assert np.quantile(rest[:, [40, 61, 62, 96]], 0.95) < 0.004
    like = Grid((8, 60, 60), 0.5, (0.0, 0.0, 3.0)).blank()
    truth = fdk(clean, scan, like).data
    ringed = np.abs(fdk(clean + wrong, scan, like).data - truth).mean()
    corrected = np.abs(fdk(clean + wrong - found, scan, like).data - truth).mean()
    assert corrected < 0.5 * ringed
    with pytest.raises(LimitError):
        ring_errors(iter([]))
