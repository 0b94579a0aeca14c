"""Simulated machines that write scripts and logs of scans, byte by byte.

Kinematics and times are those of this file; nothing of flexdt is used. Times follow families that
a fit does not know.
"""

from __future__ import annotations

import math
import random
import struct
from dataclasses import dataclass, field

FAMILIES = ("lognormal", "bimodal", "drifting")
DAILY = "daily"
COMPARED = ("gamma", "waiting", "tails", "weibull")
"""Families that variants of the method were compared by, beside `FAMILIES`."""
UNSEEN = ("uniform", "loglogistic", "triangular", "pareto")
"""Families by which nothing was chosen: they were drawn after the last change."""
TIMES = {  # kind: least and greatest median of a machine [s]
    "xrayon": (0.5, 3.0),
    "ready": (4.0, 30.0),
    "xrayoff": (1.0, 5.0),
    "already off": (0.1, 0.8),
    "camera": (0.02, 0.2),
    "motor": (0.004, 0.05),
    "image": (0.02, 0.1),
    "save": (0.03, 1.0),
    "write": (0.4, 2.0),
    "move": (0.1, 0.6),
    "standing": (0.05, 0.3),
    "other": (0.0004, 0.002),
}
AXES = ("ver_tube", "ver_det", "tra_obj", "tra_det", "mag_det", "mag_obj", "rot_obj")


@dataclass
class Rig:
    """A simulated machine: what it really does, and where it stands."""

    rng: random.Random
    family: str
    limits: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)
    rates: dict[str, list[float]] = field(default_factory=dict)
    at: dict[str, float] = field(default_factory=dict)
    times: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    clock_ms: int = 30_000_000
    lines: int = 0
    day: float = 1.0

    def __post_init__(self) -> None:
        """Draw the limits, rates and places of all axes and the times of all commands."""
        rng = self.rng
        for axis in AXES:
            low, high = -rng.uniform(100, 400), rng.uniform(500, 1500)
            speed, acceleration = rng.uniform(20, 100), rng.uniform(20, 200)
            self.limits[axis] = (low, high, 2 * speed, 2 * acceleration)
            self.rates[axis] = [speed, acceleration]
            self.at[axis] = rng.uniform(0, 300)
        for kind, (least, most) in TIMES.items():
            middle = math.exp(rng.uniform(math.log(least), math.log(most)))
            self.times[kind] = (middle, rng.uniform(0.05, 0.5), rng.uniform(0.05, 0.4))

    def overhead(self, kind: str) -> float:
        """Draw the seconds that a command of a kind takes beside its motion, by the rig's
        family.

        Each call counts as a line of the log; a drifting rig slows with them.
        """
        middle, width, share = self.times[kind]
        self.lines += 1
        noise = math.exp(self.rng.gauss(0.0, 0.03))
        if self.family == "lognormal":
            return middle * math.exp(self.rng.gauss(0.0, width))
        if self.family == "bimodal":
            slow = self.rng.random() < share
            return middle * noise * (1.0 + 5.0 * width if slow else 1.0)
        if self.family == DAILY:
            return middle * noise * self.day
        if self.family == "gamma":
            return middle * self.rng.gammavariate(width**-2, width**2)
        if self.family == "waiting":  # a fixed part, and an exponential one
            return middle * (1.0 - width + self.rng.expovariate(1.0 / width))
        if self.family == "tails":  # Student's t of three degrees, in the logarithm
            normal, square = (
                self.rng.gauss(0.0, 1.0),
                self.rng.gammavariate(1.5, 2.0 / 3.0),
            )
            return middle * math.exp(min(5.0, 0.6 * width * normal / math.sqrt(square)))
        if self.family == "weibull":
            return middle * self.rng.weibullvariate(1.0, 1.2 / width)
        if self.family == "uniform":
            return middle * self.rng.uniform(1.0 - width, 1.0 + width)
        if self.family == "loglogistic":
            chance = self.rng.uniform(1e-6, 1.0 - 1e-6)
            return middle * (chance / (1.0 - chance)) ** (0.6 * width)
        if self.family == "triangular":
            return middle * self.rng.triangular(1.0 - width, 1.0 + 2.0 * width, 1.0)
        if self.family == "pareto":
            return (
                middle * (1.0 - 0.5 * width) * self.rng.paretovariate(1.0 + 1.0 / width)
            )
        return middle * noise * (1.0 + 2.0 * width * self.lines / 300.0)

    def reply(self, axis: str, target: float) -> bytes:
        """A motor's status after a move, in the scanner's bytes."""
        low, high, speed, acceleration = self.limits[axis]
        set_speed, set_acceleration = self.rates[axis]
        head = (target, target, set_speed, 0.0, set_acceleration, high, low, 0.4, speed, 0.001,
                acceleration, 0.0, set_speed, set_acceleration, 0.0, 0.0, 24.0)  # fmt: skip
        tail = b"\1\1\1\0\0\1\1" + struct.pack(">2d", high, low) + bytes(108)
        return struct.pack(">17d", *head) + tail


def travel(distance: float, speed: float, acceleration: float) -> float:
    """Time of a move from rest to rest."""
    distance = abs(distance)
    if distance * acceleration >= speed * speed:
        return distance / speed + speed / acceleration
    return 2.0 * math.sqrt(distance / acceleration)


class Scan:
    """One scan of a rig: writes its script and its log."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.log = b""
        self.exposure, self.averages, self.frames = 0.1, 1, 1

    def put(self, words: str, kind: str, length: float = 0.0, reply: bytes = b"") -> None:
        """Write a line with its time, and let the clock go on by it.

        Args:
            words: component, command and arguments with | between them.
            kind: of the overhead.
            length: seconds beside it.
            reply: the scanner's bytes.
        """
        component, command, *rest = words.split("|")
        first, second = (*rest, "", "")[:2]
        own = round(1000.0 * (length + self.rig.overhead(kind)))
        minutes, ms = divmod(self.rig.clock_ms, 60_000)
        hours, minutes = divmod(minutes, 60)
        moment = f"{hours % 24:02d}:{minutes:02d}:{ms // 1000:02d}.{ms % 1000:03d}"
        script = "\t".join(
            (component, command, first, second, "ACK", "", str(2 * own), str(own))
        )
        self.log += script.encode() + b"\t" + reply + f"\t{moment}\r\n".encode()
        self.rig.clock_ms += own

    def move(self, axis: str, target: float) -> None:
        """Move an axis and write its line; a move to where it stands takes the overhead
        of "standing".
        """
        target = round(target, 3)
        time = travel(target - self.rig.at[axis], *self.rig.rates[axis])
        kind = "move" if target != self.rig.at[axis] else "standing"
        self.rig.at[axis] = target
        self.put(
            f"{axis}|move absolute|{target}", kind, time, self.rig.reply(axis, target)
        )

    def set_rate(self, axis: str, which: int, value: float) -> None:
        value = round(min(value, 0.99 * self.rig.limits[axis][2 + which]), 4)
        self.rig.rates[axis][which] = value
        self.put(f"{axis}|set {('speed', 'acceleration')[which]}|{value}", "motor")

    def camera(self, averages: int, frames: int = 1) -> None:
        self.averages, self.frames = averages, frames
        self.put(f"camera|set number of averages|{averages}", "camera")
        self.put(f"camera|set number of frames|{frames}", "camera")

    def image(self, name: str) -> None:
        self.put("camera|take image", "image", self.exposure * self.averages)
        self.put(f"camera|save image|{name}", "save")

    def run(self) -> bytes:
        """Write a drawn scan, from the settings to the last pause; the log."""
        rng, rig = self.rig.rng, self.rig
        if rig.family == DAILY:
            rig.day = math.exp(rng.gauss(0.0, 0.2))
        self.exposure = round(rng.uniform(0.02, 0.5), 3)
        self.put("scanner|pause|0", "other")
        self.put("camera|set mode|2_HW2SW1LOW", "camera")
        self.put(f"camera|set exposure|{1000 * self.exposure:g}", "camera")
        for axis in AXES[:-1]:
            self.move(axis, rig.at[axis] if rng.random() < 0.4 else rng.uniform(0, 400))
        self.put("tube|xrayoff", "xrayoff")
        self.put("scanner|keep xrayon|FALSE", "other")
        self.camera(rng.randrange(1, 20))
        self.image("di0.tif")
        self.put("tube|xrayon", "xrayon")
        self.put("tube|REPEAT UNTIL TRUE status_XReady_get", "ready")
        for _ in range(rng.randrange(1, 4)):
            aside = rng.choice(AXES[:-1])
            back = rig.at[aside]
            self.camera(rng.randrange(1, 20))
            self.move(aside, rng.uniform(0, 400))
            self.image("io0.tif")
            self.move(aside, back)
            self.move(aside, back)
            pause = rng.choice((500, 2000, 20000))
            self.put(f"scanner|pause|{pause}", "other", pause / 1000.0)
            self.put("scanner|write settings file", "write")
            self.set_rate("rot_obj", 0, rng.uniform(20, 60))
            self.set_rate("rot_obj", 1, rng.uniform(20, 60))
            self.move("rot_obj", rng.uniform(0, 360))
            self.camera(1, rng.randrange(2, 6))
            self.put("camera|take and save image sequence|scan_|0", "image",
                     self.exposure * self.frames)  # fmt: skip
        self.put("tube|xrayoff", "xrayoff")
        self.put("tube|xrayoff", "already off")
        self.put("scanner|pause|100", "other", 0.1)
        return self.log
