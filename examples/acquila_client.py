"""Drives the scanner, or its twin, over the scanner software's own ZeroMQ interface.

    flexdt up --gateway-port 50000 --data data
    python examples/acquila_client.py [HOST] [PORT_OUT] [PORT_IN]

Needs pyzmq and nothing of flexdt: the same program drives the real scanner. Takes a dark, a
flat and a short scan in motion.
"""

import itertools
import json
import sys
import time

import zmq


class Acquila:
    """Commands out, replies in: RCV at once, FDB while it takes, then ACK or ERR."""

    def __init__(
        self, host: str = "127.0.0.1", out: int = 50000, into: int = 50001
    ) -> None:
        """Connect to the gateway and wait half a second, as ZeroMQ drops messages before
        both sides know each other.

        Args:
            host: of the gateway.
            out: port on which the gateway publishes replies.
            into: port on which it takes commands.
        """
        context = zmq.Context.instance()
        self.replies = context.socket(zmq.SUB)
        self.replies.subscribe(b"")
        self.replies.connect(f"tcp://{host}:{out}")
        self.commands = context.socket(zmq.PUB)
        self.commands.connect(f"tcp://{host}:{into}")
        self.numbers = itertools.count(time.time_ns() % 2**48)
        time.sleep(0.5)  # ZeroMQ drops messages before both sides know each other

    def send(
        self, component: str, command: str, arg1: object = "", arg2: object = ""
    ) -> int:
        """Send a command without waiting for a reply.

        Args:
            component: such as `rot_obj` or `camera`.
            command: to it.
            arg1, arg2: of the command; sent as text.

        Returns:
            Its UUID, to be passed to `wait`.
        """
        uuid = next(self.numbers)
        event = {
            "component": component, "comp_phys": "", "command": command, "arg1": str(arg1),
            "arg2": str(arg2), "reply": "", "reply type": "", "comp_type": "other",
            "tick count": time.monotonic_ns() // 1_000_000, "UUID": uuid,
        }  # fmt: skip
        self.commands.send_string(json.dumps(event))
        return uuid

    def wait(self, uuid: int, seconds: float = 120.0) -> str:
        """Wait for a command's end, and print its feedback on the way.

        Args:
            uuid: of the command; replies to others are dropped.
            seconds: longest wait.

        Returns:
            The reply of ACK.

        Raises:
            RuntimeError: the command ended with ERR; names its reason.
            TimeoutError: there was no end in time.
        """
        deadline = time.monotonic() + seconds
        while self.replies.poll(max(0, int(1000 * (deadline - time.monotonic())))):
            event = json.loads(self.replies.recv_string())
            if event["UUID"] != uuid:
                continue
            if event["reply type"] == "FDB":
                print("   ", event["command"], event["reply"])
            if event["reply type"] == "ERR":
                raise RuntimeError(
                    f"{event['component']} {event['command']}: {event['reply']}"
                )
            if event["reply type"] == "ACK":
                return str(event["reply"])
        raise TimeoutError(f"no reply to {uuid}")

    def do(self, *words: object) -> str:
        """Send a command and wait for its end."""
        reply = self.wait(self.send(*words))  # type: ignore[arg-type]
        print(*words, "->", reply or "done")
        return reply

    def close(self) -> None:
        """Leave."""
        self.commands.close()
        self.replies.close()


def main(argv: list[str]) -> None:
    """Set tube, camera and motors, save a dark and a flat image, and scan 19 images while
    the stage turns.

    `argv` may have the host, then the gateway's two ports.
    """
    host = argv[0] if argv else "127.0.0.1"
    scanner = Acquila(host, *(int(port) for port in argv[1:3]))
    do = scanner.do
    do("scanner", "set output path", r"E:\data\example")
    for command, value in (("set kV", 90), ("set power", 50)):
        do("tube", command, value)
    do("camera", "set ROI", "800 620 1199 939")
    do("camera", "set exposure", 50)
    do("camera", "set number of averages", 1)
    for axis, value in (("mag_det", 1000), ("mag_obj", 585), ("tra_obj", -140)):
        do(axis, "move absolute", value)
    do("tube", "xrayoff")
    do("camera", "take image")
    do("camera", "save image", r"E:\data\example\di000000.tif")
    do("tube", "xrayon")
    while do("tube", "status_XReady_get") != "TRUE":
        time.sleep(0.5)
    do("camera", "take image")
    do("camera", "save image", r"E:\data\example\io000000.tif")
    do("tra_obj", "move absolute", 0.5405)

    # A scan in motion: 19 images, one every 20 degrees, the first at 0.
    frames, exposure_s, averages, acceleration = 19, 0.05, 10, 22.5
    speed = 360 / (frames - 1) / (exposure_s * averages)
    run_up = speed**2 / (2 * acceleration) + 4 * exposure_s * averages * speed
    do("rot_obj", "set speed", 45)
    do("rot_obj", "set acceleration", acceleration)
    do("rot_obj", "move absolute", -run_up)
    do("rot_obj", "set speed", speed)
    do("camera", "set number of frames", frames)
    do("camera", "set number of averages", averages)
    do("scanner", "write settings file")
    turning = scanner.send("rot_obj", "move absolute", 360 + run_up, 0.0)
    do("camera", "take and save image sequence", r"E:\data\example\scan_", 0)
    print("rot_obj stands at", scanner.wait(turning))
    do("tube", "xrayoff")
    scanner.close()


if __name__ == "__main__":
    main(sys.argv[1:])
