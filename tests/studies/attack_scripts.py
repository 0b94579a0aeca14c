"""Attacks by scripts and commands: errors, vast plans, long queues, moves of those who may not."""

from __future__ import annotations

import os

from attack_ground import Ground, attack, code_of, eventually, refused
from lab import Wire, fly_script, twin


@attack("a script with ten errors")
def ten_errors(g: Ground) -> str:
    text = "\r\n".join(["mag_obj\tfly\t3\t\tACK\t\t"] * 10)
    error = refused(g.wire(), "script.submit", text=text)
    assert error.code == -32005
    assert len({p["line"] for p in error.data}) == 10
    return "-32005 with ten lines and columns; nothing moves"


@attack("scripts that plan half a terabyte, a billion frames, or a time without an end")
def vast_scripts(g: Ground) -> str:
    wire = g.wire()
    before = wire.call("state.get")["axes"]
    long = fly_script(360_001, roi="0 0 1943 1535")
    report = wire.call("script.check", text=long)
    assert report["frames"] == 360_001
    assert report["bytes"] > 360_001 * 10**6
    disk = os.statvfs(g.data)
    if disk.f_bavail * disk.f_frsize < report["bytes"]:
        error = refused(wire, "script.submit", text=long, name="vast")
        assert error.code == -32001, error
    for text in (
        "camera\tset number of frames\t999999999\t\tACK\t\t\r\n"
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t\r\n",
        "camera\tset exposure\t1e300\t\tACK\t\t\r\n",
        "mag_obj\tmove absolute\t1e308\t\tACK\t\t\r\n",
        "mag_obj\tset speed\t1e-300\t\tACK\t\t\r\nmag_obj\tmove absolute\t500\t\tACK\t\t\r\n",
    ):
        report = wire.call("script.check", text=text)
        assert not report["ok"], text
        assert report["problems"]
        assert refused(wire, "script.submit", text=text, name="vast").code in (-32005, -32001)
    assert not (g.data / "vast").exists()
    assert wire.call("state.get")["axes"] == before
    return "-32001 for the disk, -32005 with their problems; nothing moves"


@attack("200 jobs in a queue of 50")
def many_jobs(g: Ground) -> str:
    """On a twin of its own with `max_jobs=50`, whose clock hardly runs."""
    options = ("--limit", "max_jobs=50", "--speed-up", "0.001")
    server = twin(g.projector.port, g.root / "queue", *options)
    try:
        wire = Wire(server.port)
        jobs = [wire.call("script.submit", text=fly_script(3), name="first")["job"]]
        wire.wait(jobs[0], "running")
        turned_away = 0
        for i in range(199):
            answer = wire.ask("script.submit", text=fly_script(3), name=f"queued{i}")
            if "error" in answer:
                assert code_of(answer) == -32003, answer
                turned_away += 1
            else:
                assert not turned_away, "one was taken after another had been refused"
                jobs.append(answer["result"]["job"])
        assert (len(jobs), turned_away) == (51, 149)
        folders = [p for p in (g.root / "queue").iterdir() if p.name.startswith("queued")]
        assert len(folders) <= 50
        for job in reversed(jobs):
            wire.call("job.abort", job=job)
        for job in jobs:
            wire.wait(job, "aborted")
        assert wire.call("script.submit", text=fly_script(3), name="later")["job"]
    finally:
        server.end()
    return "one runs, 50 wait (`max_jobs`, 1000 by default), 149 get -32003; all can be aborted"


@attack("anybody may stop, nobody but the controller may move")
def control(g: Ground) -> str:
    first, second = g.wire(), g.wire()
    first.call("session.control", action="force")
    assert refused(second, "axes.move", targets={"mag_obj": 300}).code == -32003
    second.call("axes.stop")
    second.call("safety.estop")
    assert refused(first, "axes.move", targets={"mag_obj": 300}).code == -32003
    first.call("safety.reset")
    first.close()
    move = {"targets": {"mag_obj": 301}, "wait": True}
    eventually(lambda: "result" in second.ask("axes.move", **move), "control is not free")
    return "-32003; stop and E-stop work for anyone; control is free when its connection ends"
