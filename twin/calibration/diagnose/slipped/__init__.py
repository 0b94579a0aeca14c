"""Beads that move against each other during a scan: a part that slips, or beads that are loose.

Such a motion leaves residuals that are correlated from frame to frame, as slow errors of spots
do, so it is not judged with the other causes, which count correlated residuals as few. Beads are
displaced in the phantom from a frame on, at once or evenly to the last frame, or, if that is
not beyond doubt, by a random walk along one way of each. With and without that, the residuals
are judged beside the same rivals (causes of the residuals, motion of everything, errors that
repeat with the turn, beads that stand elsewhere in all frames) and with the same errors of
spots, uncorrelated or slow.
"""

from flexdt.twin.calibration.diagnose.slipped.judge import with_loose_beads
from flexdt.twin.calibration.diagnose.slipped.piece import Piece
from flexdt.twin.calibration.diagnose.slipped.trial import Verdict

__all__ = ["Piece", "Verdict", "with_loose_beads"]
