"""Bluesky's RunEngine drives the twin: a step scan, a fly scan, and the documents they make.

    flexdt up --data my-scans --speed-up max      # in another terminal
    python extensions/examples/bluesky_scans.py 127.0.0.1 55000 --images camera-images

Needs the extra `lab`. Prints each document's kind and what matters in it, and the TIFF files
that the stream documents point at.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import bluesky.plan_stubs as bps
import bluesky.plans as bp
from bluesky import RunEngine
from bluesky.run_engine import call_in_bluesky_event_loop
from bluesky.simulators import check_limits
from ophyd_async.core import StaticPathProvider, UUIDFilenameProvider, init_devices

from flexdt.twin.machine.camera import Roi
from flexdt.twin.script import ScanRequest
from flexdt_extensions.bluesky import FlyScan, LimitsExceeded, TwinLab
from flexdt_extensions.bluesky.flyer import fly_scan

SMALL = Roi(800, 620, 1199, 939)


class Assets:
    """A RunEngine callback: which files the stream documents point at, per data key."""

    def __init__(self) -> None:
        """Start without files, counts or known resources."""
        self.files: dict[str, list[Path]] = {}
        self.counts: Counter[str] = Counter()
        self._resources: dict[str, Mapping[str, Any]] = {}

    def __call__(self, name: str, document: Mapping[str, Any]) -> None:
        """Count a document by its name; keep a stream resource, and list the files that a
        stream datum points at under its resource's data key.

        Other documents are only counted. A resource that is no series of TIFF images fails an
        assertion; a datum needs its resource before it.
        """
        self.counts[name] += 1
        if name == "stream_resource":
            assert document["mimetype"] == "multipart/related;type=image/tiff"
            self._resources[document["uid"]] = document
        if name == "stream_datum":
            resource = self._resources[document["stream_resource"]]
            found = self.files.setdefault(resource["data_key"], [])
            found.extend(_files(resource, document["indices"]))


def _files(resource: Mapping[str, Any], indices: Mapping[str, int]) -> Iterator[Path]:
    """Yield the paths of images start <= i < stop of a stream resource: a URI, a template."""
    folder = Path(unquote(urlsplit(resource["uri"]).path))
    for i in range(indices["start"], indices["stop"]):
        yield folder / resource["parameters"]["template"].format(i)


def main(host: str, port: int, images: Path) -> None:
    """Run a step scan and the twin's own fly scan by Bluesky, and print where the images are.

    A scan beyond the limits is checked first, which must be refused before anything moves.

    Args:
        host: of the twin.
        port: of the twin.
        images: folder for the images of the step scan; made if it is not there.
    """
    engine = RunEngine({})
    assets = Assets()
    engine.subscribe(assets)
    where = StaticPathProvider(UUIDFilenameProvider(), images.absolute())
    with init_devices():
        lab = TwinLab(where, host, port)
    turn, near = lab.axis("rot_obj"), lab.axis("mag_obj")

    # What would not work is found before anything moves.
    try:
        check_limits(bp.scan([lab.camera], near, 500.0, 2000.0, 4))
    except LimitsExceeded as error:
        print(f"refused: {error}")

    def step_scan() -> Iterator[Any]:
        """Set tube, region and exposure, move to 600 mm and 0 degrees, then take 4 images
        from 0 to 90 degrees.
        """
        yield from bps.mv(lab.tube.kV, 90.0, lab.tube.power_W, 20.0, lab.tube.on, True)
        yield from bps.mv(
            lab.camera.roi, "800 620 1199 939", lab.camera.exposure_ms, 100.0
        )
        yield from bps.mv(near, 600.0, turn, 0.0)
        yield from bp.scan([lab.camera, lab.tube], turn, 0.0, 90.0, 4)

    engine(step_scan())
    print(f"step scan: {len(assets.files['lab-camera'])} images, {dict(assets.counts)}")

    # The twin's own smooth scan: one turn, images taken in motion, written by the server.
    wish = ScanRequest(kind="fly", frames=13, exposure_ms=50.0, averages=8, roi=SMALL)
    engine(fly_scan(lab.scan, FlyScan(wish, seed=1)))
    files = assets.files["lab-scan"]
    print(f"fly scan: {len(files)} images in {files[0].parent}")
    call_in_bluesky_event_loop(lab.close())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("host", nargs="?", default="127.0.0.1")
    parser.add_argument("port", nargs="?", type=int, default=55000)
    parser.add_argument("--images", type=Path, default=Path("camera-images"))
    given = parser.parse_args()
    main(given.host, given.port, given.images)
