"""ASTRA's own vectors, as it writes them and as others keep them, through the text and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_scans import PITCH, SHAPE, worst

from flexdt.twin.exchange.number_tables import read_vectors_text, vectors_text
from flexdt.twin.geometry.poses import Poses

astra = pytest.importorskip(
    "astra", reason="astra-toolbox is not installed", exc_type=ImportError
)


def test_astras_cone_is_a_geometry_for_images_upside_down() -> None:
    """Its `cone` has v upwards: read with rows up it is our circle, angle for angle."""
    angles = np.linspace(0.3, 5.9, 7)
    cone = astra.create_proj_geom("cone", PITCH, PITCH, *SHAPE, angles, 600.0, 450.0)
    vectors = astra.functions.geom_2vec(cone)["Vectors"]
    theirs = "\n".join(" ".join(map(repr, row)) for row in vectors.tolist())
    text = vectors_text(read_vectors_text(theirs))
    read = replace(read_vectors_text(text), shape=SHAPE).rows_up()
    ours = Poses(
        np.zeros((1, 3)), np.array([[0.0, 600, 0]]), np.array([[0.0, 1050, 0]]),
        np.array([[PITCH, 0, 0]]), np.array([[0, 0, -PITCH]]), angles,
    ).cone_vec()  # fmt: skip
    assert worst(read.cone_vec.rows, ours.rows) < 1e-9


def test_astra_takes_what_we_write() -> None:
    geometry = read_vectors_text("0 -600 0  0 450 0  .7 0 0  0 0 -.7")
    made = astra.create_proj_geom("cone_vec", *SHAPE, geometry.cone_vec.rows)
    assert np.array_equal(made["Vectors"], geometry.cone_vec.rows)
    assert (made["DetectorRowCount"], made["DetectorColCount"]) == SHAPE
