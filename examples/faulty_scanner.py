"""A scanner with faults, for `flexdt follow`: it publishes three moves and then goes away.

    python examples/faulty_scanner.py 50123 &
    flexdt follow tcp://127.0.0.1:50123 --for 12

It needs pyzmq and nothing of flexdt. Every message has a tick of its own, as in the last pages
of the interface's description; `flexdt follow` goes by the UUID. The first move is sound; the
second is of a motor of half the speed; the third ends 0.4 mm from its target, and its reply
states another limit.
"""

from __future__ import annotations

import json
import struct
import sys
import time

import zmq

FEEDBACK_S = 0.8
ACCELERATION = 50.0
LOWER = {"tra_obj": -234.0, "mag_obj": 70.0}
MOVES = (
    # axis, from, to, speed, where it ends, upper limit that it states [mm]
    ("tra_obj", 0.0, 30.0, 50.0, 30.0, 194.0),
    ("mag_obj", 600.0, 400.0, 25.0, 400.0, 996.0),
    ("tra_obj", 30.0, 60.0, 50.0, 60.4, 180.0),
)


def event(axis: str, target: float, uuid: int, what: str, reply: str = "") -> str:
    """Make one message of the scanner's interface, as JSON.

    Args:
        axis: that moves.
        target: of the move [mm].
        uuid: of the command.
        what: reply type: "" for the command itself, RCV, FDB or ACK.
        reply: text of the reply.
    """
    return json.dumps(
        {
            "component": axis, "comp_phys": "", "command": "move absolute", "arg1": str(target),
            "arg2": "", "reply": reply, "reply type": what, "comp_type": "motor",
            "tick count": int(time.time() * 1000) % 2**32, "UUID": uuid,
        }
    )  # fmt: skip


def main(port: int) -> None:
    """Wait for a subscription, then publish the moves of MOVES with their feedback, in
    real time, and end.

    Args:
        port: of 127.0.0.1.
    """
    socket = zmq.Context().socket(zmq.XPUB)
    socket.bind(f"tcp://127.0.0.1:{port}")
    socket.recv()  # a subscription
    for uuid, (axis, start, target, speed, ends_at, upper) in enumerate(MOVES, 1):
        socket.send_string(event(axis, target, uuid, ""))
        socket.send_string(event(axis, target, uuid, "RCV"))
        ramp, way = speed / ACCELERATION, 1 if target > start else -1
        duration, begun = abs(target - start) / speed + ramp, time.monotonic()
        while time.monotonic() - begun < duration - FEEDBACK_S:
            time.sleep(FEEDBACK_S)
            t = time.monotonic() - begun
            left = max(0.0, duration - t)
            if t < ramp:
                gone = 0.5 * ACCELERATION * t**2
            elif left < ramp:
                gone = abs(target - start) - 0.5 * ACCELERATION * left**2
            else:
                gone = speed * (t - ramp / 2)
            socket.send_string(
                event(axis, target, uuid, "FDB", f"{start + way * gone:.10f}")
            )
        time.sleep(max(0.0, begun + duration - time.monotonic()))
        head = (ends_at, target, 50.0, 0, 50.0, upper, LOWER[axis], 0, 50.0, 0, 125.0)
        cluster = struct.pack(">17d", *head, *[0.0] * 6) + bytes(7)
        cluster += struct.pack(">2d", upper, LOWER[axis]) + bytes(108)
        socket.send_string(event(axis, target, uuid, "ACK", cluster.decode("latin-1")))
        time.sleep(0.5)


if __name__ == "__main__":
    main(int(sys.argv[1]))
