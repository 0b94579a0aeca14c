"""Lists of words that the wire and the core both have, as neither may import the other."""

from __future__ import annotations

from typing import get_args

import pytest

from flexdt.phantoms.files.mesh_files import FORMATS
from flexdt.protocol import state_model
from flexdt.protocol.methods import calibration_messages, image_messages, scanner_messages
from flexdt.server.twin.state_views import SAFETY_NAMES
from flexdt.twin.dataset.flexdt_json import FrameKind
from flexdt.twin.length_units import UNITS_MM
from flexdt.twin.scanner.joining import StopPath
from flexdt.twin.scanner.state import SafetyName
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.scan_request import Kind


@pytest.mark.parametrize(
    ("wire", "core"),
    [
        pytest.param(get_args(scanner_messages.LengthUnit), tuple(UNITS_MM), id="units"),
        pytest.param(get_args(image_messages.ScanKind), get_args(Kind), id="scans"),
        pytest.param(
            get_args(calibration_messages.ImageKind), get_args(FrameKind), id="frames"
        ),
        pytest.param(get_args(state_model.StopPath), get_args(StopPath), id="stops"),
        pytest.param(tuple(SAFETY_NAMES), get_args(SafetyName), id="safety"),
    ],
)
def test_the_wire_has_the_words_of_the_core(
    wire: tuple[str, ...], core: tuple[str, ...]
) -> None:
    assert len(core) >= 3
    assert set(wire) == set(core)


def test_frames_of_data_sets_are_images_of_scripts_that_are_saved() -> None:
    assert set(get_args(FrameKind)) == set(get_args(ImageKind)) - {"preview"}


def test_every_mesh_format_may_be_uploaded() -> None:
    assert len(FORMATS) >= 3
    assert set(FORMATS) == set(get_args(scanner_messages.MeshFormat))
