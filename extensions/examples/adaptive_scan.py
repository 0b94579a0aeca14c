"""A bead scan that ends itself: submitted here, watched here, and as short as the sigmas allow.

    flexdt up --truth truth.toml &              # or any twin; a truth file is optional
    python extensions/examples/adaptive_scan.py tau_x=0.0002,tau_z=0.0002

Angles follow the golden section of a turn, so the scan may end anywhere: whatever was taken
until then is spread over the turn. `flexdt calibrate` then makes of the data set what was asked
for.
"""

from __future__ import annotations

import sys

from flexdt.clients import TwinClient
from flexdt.extending import assignments
from flexdt_extensions.watch import watch

FRAMES = 90
GOLDEN_DEG = 222.4922


def main() -> None:
    """Scan the LEGO phantom at the twin of this machine until the wanted sigmas are reached.

    At most 90 frames, at golden angles, are exposed; each is fitted as it comes. The first
    argument of the command line gives the wanted sigmas (name=value, by commas). Prints the
    sigmas after each fit, then the job's state and its frames.
    """
    wanted = assignments((sys.argv[1:] or ["tau_x=0.0002,tau_z=0.0002"])[0].split(","))
    with TwinClient() as twin:
        twin.set_sample("lego")
        twin.set_tube(power_W=20.0)
        twin.move({"mag_obj": 600.0, "mag_det": 1000.0}, wait=True)
        poses = [{"rot_obj": round(i * GOLDEN_DEG % 360.0, 3)} for i in range(FRAMES)]
        job = twin.submit_trajectory(poses, 100.0, speed_up=1.0).job
        found = watch(twin, "lego", wanted, job, tell=lambda state: print(state.sigmas()))
        print(
            found.job.state,
            "after",
            found.frames,
            "of",
            FRAMES,
            "frames:",
            dict(found.sigmas),
        )


if __name__ == "__main__":
    main()
