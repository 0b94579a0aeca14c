"""A frame that repeats the one before is told from one after a turn by what the scan itself
shows of turns: drawn bodies that move across small images, written out here."""

from __future__ import annotations

import numpy as np

from flexdt.twin.calibration.diagnose.frame_numbers import FrameNumbers, named_turn
from flexdt.twin.calibration.repeated_frames import find_repeated

ROWS, COLUMNS = 24, 48


def frames(rng: np.random.Generator, count: int, bodies: int, noise: float) -> np.ndarray:
    """Images (count, ROWS, COLUMNS) of soft balls that turn about the middle column."""
    radius = rng.uniform(0, 16, bodies)
    start = rng.uniform(0, 2 * np.pi, bodies)
    row, wide = rng.uniform(2, ROWS - 2, bodies), rng.uniform(1.5, 4, bodies)
    down, across = np.mgrid[:ROWS, :COLUMNS]
    out = np.zeros((count, ROWS, COLUMNS))
    for view in range(count):
        at = COLUMNS / 2 + radius * np.cos(start + 2 * np.pi * view / count)
        for c, r, w in zip(at, row, wide, strict=True):
            out[view] += np.exp(-((across - c) ** 2 + (down - r) ** 2) / (2 * w * w))
    return out + rng.normal(0, noise, out.shape)


def even(count: int) -> np.ndarray:
    return np.full(count, 2 * np.pi / count)


def test_turned_frames_are_none_and_a_second_exposure_is_found() -> None:
    rng = np.random.default_rng(12)
    found = 0
    for _ in range(8):
        count, noise = int(rng.integers(60, 120)), float(rng.choice([0.003, 0.01, 0.03]))
        views = frames(rng, count, int(rng.integers(2, 12)), noise)
        assert find_repeated(views.astype(np.float32), even(count))[0] == []
        at = int(rng.integers(2, count - 2))
        again = np.insert(views, at, views[at - 1], axis=0)[:count]
        again[at] = views[at - 1] + rng.normal(0, noise * 2**0.5, (ROWS, COLUMNS))
        told = find_repeated(again.astype(np.float32), even(count))[0]
        assert told in ([], [at]), (told, at)
        found += told == [at]
    assert found >= 5


def test_an_exact_copy_is_found_in_any_noise_and_only_where_the_stage_turned() -> None:
    rng = np.random.default_rng(13)
    views = frames(rng, 90, 5, 1.0).astype(np.float32)
    views[40] = views[39]
    assert find_repeated(views, even(90))[0] == [40]
    gaps = even(90)
    gaps[39] = 0.0
    assert find_repeated(views, gaps)[0] == []


def test_a_body_that_turns_back_repeats_nothing() -> None:
    """Where it turns back the frames about one are equal but for noise."""
    rng = np.random.default_rng(14)
    for _ in range(4):
        views = frames(rng, 120, 1, 0.004).astype(np.float32)
        assert find_repeated(views, even(120))[0] == []


def test_objects_at_rest_and_air_repeat_nothing() -> None:
    rng = np.random.default_rng(15)
    still = frames(rng, 1, 4, 0.0) + rng.normal(0, 0.01, (80, ROWS, COLUMNS))
    assert find_repeated(still.astype(np.float32), even(80))[0] == []
    assert find_repeated(np.zeros((80, ROWS, COLUMNS), np.float32), even(80)) == ([], [])


def test_a_missing_frame_before_a_repeated_one_is_found() -> None:
    rng = np.random.default_rng(16)
    views = frames(rng, 121, 8, 0.002)
    views = np.delete(views, 30, axis=0)
    views[70] = views[69] + rng.normal(0, 0.003, (ROWS, COLUMNS))
    assert find_repeated(views.astype(np.float32), even(120)) == ([70], [30])


def test_a_doubled_frame_is_named_as_far_as_frames_tell() -> None:
    """Frame 11 repeats frame 10 and is not used, as an exact copy, or shows the phantom."""
    shift = np.where(np.arange(36) < 12, 0, -1)
    fits = np.arange(36) != 11
    copied = FrameNumbers(shift, fits).judged("scan")
    assert copied is not None
    assert "one of frames 11 to 12 shows the angle of the one before again" in copied.text
    seen = FrameNumbers(np.where(np.arange(36) < 11, 0, -1), fits | True).judged("scan")
    assert seen is not None
    assert "frame 11 shows the angle of frame 10 again" in seen.text
    lost = FrameNumbers(-shift, fits).judged("scan")
    assert lost is not None
    assert "a frame is lost between frames 10 and 12" in lost.text


def test_two_frames_in_exchange_are_neither_lost_nor_doubled() -> None:
    """Frames 4 and 5 show each other's angles; three in a ring are renumbered."""
    shift = np.zeros(12, dtype=np.int64)
    shift[4:6] = 1, -1
    fits = np.ones(12, dtype=bool)
    for last in (12, 6):
        exchanged = FrameNumbers(shift[:last], fits[:last]).judged("scan")
        assert exchanged is not None
        assert exchanged.code == "frames_inconsistent"
        assert (
            "frame 4 shows what frame 5 should; frame 5 shows what frame 4"
            in exchanged.text
        )
    shift[4:7] = 1, 1, -2
    assert FrameNumbers(shift, fits).renumbered


def test_a_whole_step_too_many_or_too_few_is_a_lost_or_a_doubled_frame() -> None:
    for sense in (1.0, -1.0):
        angles = sense * np.radians(10.0 * np.arange(36))
        for steps, words in ((1, "1 frame is lost"), (-2, "2 frames are doubled")):
            code, text = named_turn(sense * 10.0 * steps, angles)
            assert code == "frame_numbers"
            assert words in text
        assert named_turn(sense * 4.0, angles)[0] == "angle_step"
