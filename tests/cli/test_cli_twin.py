"""Commands that talk to a twin, against real servers: results, JSON documents, exit codes."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
import trimesh

from flexdt.clients.cli.command_tree import run
from flexdt.clients.client.twin_methods import FINAL_STATES
from flexdt.clients.launch.processes import Servers
from tests.support.phantom_texts import BEAD_FILE, SCENE_FILE

Answer = tuple[int, str, str]
Flexdt = Callable[..., Answer]
Document = Callable[..., Any]

SCRIPT = (
    "camera\tset mode\tHW2SW1High\t\tACK\t\t\r\n"
    "camera\tset exposure\t20\t\tACK\t\t\r\n"
    "camera\tset ROI\t900 700 999 779\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\di000000.tif\t\tACK\t\t\r\n"
    "tube\txrayon\t\t\tACK\t\t\r\n"
    "tra_obj\tmove absolute\t-150\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\io000000.tif\t\tACK\t\t\r\n"
    "tra_obj\tmove absolute\t0\t\tACK\t\t\r\n"
    "scanner\twrite settings file\t\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\scan_000000.tif\t\tACK\t\t\r\n"
    "rot_obj\tmove absolute\t90\t\tACK\t\t\r\n"
    "camera\ttake image\t\t\tACK\t\t\r\n"
    "camera\tsave image\tE:\\x\\scan_000001.tif\t\tACK\t\t\r\n"
)


@pytest.fixture
def script(tmp_path: Path) -> Path:
    path = tmp_path / "scan.txt"
    path.write_bytes(SCRIPT.encode())
    return path


@pytest.mark.slow
def test_state_as_text_and_as_json(flexdt: Flexdt, document: Document) -> None:
    code, out, _ = flexdt("state")
    assert code == 0
    assert all(word in out for word in ("rot_obj", "SOD", "magnification", "safety"))
    state = document("state")
    for key in ("axes", "tube", "camera", "sample", "geometry", "safety", "job", "correction",
                "clock"):  # fmt: skip
        assert key in state
    assert state["axes"]["mag_obj"]["limits"] == [70.0, 996.0]


def test_move_waits_for_arrival(flexdt: Flexdt, document: Document) -> None:
    code, out, _ = flexdt("move", "tra_obj=-12.5", "rot_obj=30")
    assert code == 0
    assert "arrived" in out
    axes = document("state")["axes"]
    assert axes["tra_obj"]["position"] == pytest.approx(-12.5, abs=1e-12)
    assert axes["rot_obj"]["position"] == pytest.approx(30.0, abs=1e-12)
    assert not axes["tra_obj"]["moving"]


def test_move_relative(flexdt: Flexdt, document: Document) -> None:
    assert flexdt("move", "mag_obj=600")[0] == 0
    assert document("move", "--relative", "mag_obj=-7.25")["duration_s"] > 0
    assert document("state")["axes"]["mag_obj"]["position"] == pytest.approx(592.75)


@pytest.mark.slow
def test_a_stop_ends_the_waiting_of_a_move_that_does_not_arrive(
    flexdt: Flexdt, document: Document, servers: Servers
) -> None:
    flexdt("move", "mag_obj=600")
    flexdt("clock", "1")
    where = ("--server", "{}:{}".format(*servers.address))
    words = [sys.executable, "-m", "flexdt.clients.cli", "move", "mag_obj=900", *where]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 60
        while not document("state")["axes"]["mag_obj"]["moving"]:
            assert process.poll() is None
            assert time.monotonic() < deadline
        flexdt("stop")
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (4, "")
    assert "and not at 900" in err
    assert document("state")["axes"]["mag_obj"]["position"] < 900
    assert flexdt("clock", "max")[0] == 0  # nobody has control any more


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["move", "mag_obj=5000"], 3, "mag_obj target 5000 mm is outside [70, 996] mm"),
        (["move", "warp=1"], 1, "warp"),
        (["move", "mag_obj"], 2, "AXIS=VALUE"),
        (["move"], 2, "Missing argument"),
        (["jog", "warp", "-1", "--for", "0.1"], 1, "warp"),
        (["jog", "rot_obj", "-500", "--for", "0.1"], 3, "rot_obj"),
        (["jog", "rot_obj", "fast"], 2, "not a number"),
        (["sample", "nothing-like-it"], 1, "nothing-like-it"),
        (["sample", "nothere.stl"], 1, "flexdt: nothere.stl: no such file\n"),
        (["sample", "no/where"], 1, "flexdt: no/where: no such file\n"),
        (["sample", __file__], 1, ".py: not a sample's file; allowed: .stl"),
        (["clock", "0"], 2, "positive"),
        (["job", "status", "job-none"], 1, "job-none"),
        (["snap", "x.bmp"], 2, ".tif or .png"),
        (["snap", "x.tif", "--kind", "photo"], 2, "photo"),
        (["snap", "/nowhere/at/all/x.tif"], 1, "does not exist"),
    ],
)
def test_refusals(flexdt: Flexdt, words: list[str], code: int, says: str) -> None:
    found, out, err = flexdt(*words)
    assert (found, out) == (code, "")
    assert says in err


def test_jog_with_a_negative_velocity(flexdt: Flexdt, document: Document) -> None:
    assert document("clock", "1")["speed_up"] == 1.0
    assert flexdt("move", "rot_obj=0")[0] == 0
    code, out, _ = flexdt("jog", "rot_obj", "-20", "--for", "0.3")
    assert code == 0
    assert "braking" in out
    assert document("state")["axes"]["rot_obj"]["position"] < -0.5
    assert document("clock", "max")["speed_up"] == "max"


def test_stop_estop_reset(flexdt: Flexdt, document: Document) -> None:
    assert flexdt("stop")[0] == 0
    assert document("estop")["safety"]["estop"] is True
    code, out, err = flexdt("move", "tra_obj=1")
    assert (code, out) == (4, "")
    assert "E-stop" in err or "stop" in err.lower()
    assert document("reset")["safety"]["estop"] is False
    assert flexdt("move", "tra_obj=1")[0] == 0


@pytest.mark.slow
def test_a_mesh_file_is_sent_and_put_on_the_stage(
    flexdt: Flexdt, document: Document, tmp_path: Path
) -> None:
    file = tmp_path / "brick.GLB"
    trimesh.creation.box((0.01, 0.02, 0.03)).export(file, file_type="glb")
    on = document("sample", str(file), "--material", "aluminium")["sample"]
    assert (on["name"], on["material"]) == ("brick", "aluminium")
    assert on["size_mm"] == pytest.approx([10.0, 20.0, 30.0], rel=1e-5)  # glTF's metres
    on = document("sample", str(file), "--unit", "inch")["sample"]
    assert on["size_mm"] == pytest.approx([0.254, 0.508, 0.762], rel=1e-5)
    code, _, err = flexdt("sample", "lego", "--unit", "cm")
    assert (code, "mesh file" in err) == (2, True)
    file.write_bytes(b"glTF")
    code, _, err = flexdt("sample", str(file))
    assert (code, "not a readable GLB file" in err) == (1, True)
    assert flexdt("sample", "normal-3")[0] == 0


def test_uploads_and_corrections_are_deleted_unless_they_are_in_use(
    flexdt: Flexdt, document: Document, tmp_path: Path
) -> None:
    file = tmp_path / "gone soon.stl"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(file)
    name = document("sample", str(file))["sample"]["name"]
    code, _, err = flexdt("delete", "sample", name)
    assert (code, "stands on the stage" in err) == (3, True)
    assert flexdt("sample", "normal-3")[0] == 0
    assert document("delete", "sample", name) == {
        "name": name,
        "bytes": file.stat().st_size,
    }
    assert name not in {one["name"] for one in document("sample")["samples"]}
    code, _, err = flexdt("delete", "sample", name)
    assert (code, f"no upload called {name!r}" in err) == (1, True)
    code, _, err = flexdt("delete", "correction", "never made")
    assert (code, "no correction called 'never made'" in err) == (1, True)


def test_sample_and_snap(flexdt: Flexdt, document: Document, tmp_path: Path) -> None:
    listed = document("sample")["samples"]
    assert {"lego", "normal", "chiral"} <= {s["name"] for s in listed}
    assert document("sample", "normal-3")["sample"]["name"] == "normal-3"
    counts, lines, png = (tmp_path / n for n in ("c.tif", "l.tif", "p.png"))
    info = document("snap", str(counts))
    assert (info["dtype"], info["shape"]) == ("uint16", [760, 956])
    assert len(info["cone_vec"]) == 12
    assert tifffile.imread(counts).dtype == np.uint16
    assert flexdt("snap", str(lines), "--kind", "line_integral", "--binning", "4")[0] == 0
    image = tifffile.imread(lines)
    assert (image.dtype, image.shape) == (np.float32, (190, 239))
    assert image.max() > 0.5
    plain = ("snap", str(png), "--kind", "line_integral", "--binning", "4", "--no-marks")
    assert flexdt(*plain)[0] == 0
    shown = cv2.imread(str(png), cv2.IMREAD_UNCHANGED)
    assert (shown.dtype, shown.shape) == (np.uint8, (190, 239))
    dense = image > np.percentile(image, 99)
    assert shown[dense].mean() < shown[~dense].mean() - 50


def test_run_a_script_to_its_data_set(
    flexdt: Flexdt, document: Document, script: Path, data_dir: Path
) -> None:
    last = document("run", str(script), "--out", "cli-run", "--sample", "normal-3")
    assert (last["state"], last["frames_done"]) == ("done", 2)
    folder = data_dir / "cli-run"
    assert (folder / "script.txt").read_bytes() == script.read_bytes()
    assert tifffile.imread(folder / "scan_000001.tif").shape == (40, 50)
    jobs = document("job", "list")["jobs"]
    assert jobs[-1]["job"] == last["job"]
    assert "done" in flexdt("job", "status", last["job"])[1]
    assert document("job", "forget", last["job"])["jobs"] == [last["job"]]
    flexdt("job", "forget", "all")
    assert all(
        j["state"] in ("running", "paused") for j in document("job", "list")["jobs"]
    )


def test_a_run_takes_a_samples_file(
    flexdt: Flexdt, document: Document, script: Path, tmp_path: Path
) -> None:
    part = tmp_path / "own-part.stl"
    trimesh.creation.box(extents=(2, 3, 4)).export(part)
    last = document("run", str(script), "--out", "of-a-file", "--sample", str(part))
    assert last["state"] == "done"
    assert document("state")["sample"]["name"] == "own-part"
    code, _, err = flexdt("run", str(script), "--sample", str(tmp_path / "gone.stl"))
    assert (code, "gone.stl: no such file" in err) == (1, True)
    flexdt("sample", "lego")


def test_detached_run_can_be_watched_and_aborted(
    flexdt: Flexdt, document: Document, script: Path
) -> None:
    script.write_bytes(SCRIPT.encode() + b"scanner\tpause\t3600000\t\tACK\t\t\r\n")
    job = document("run", str(script), "--detach", "--speed-up", "1")["job"]
    deadline = time.monotonic() + 60
    while (
        document("job", "status", job)["state"] == "queued"
    ):  # what is queued cannot be paused
        assert time.monotonic() < deadline
    code, out, err = flexdt("move", "tra_obj=3")
    assert (code, out) == (4, ""), err
    assert document("job", "pause", job)["state"] in ("paused", "running")
    assert document("job", "abort", job)["state"] in ("aborted", "paused", "running")
    code, _, err = flexdt("job", "resume", job)
    assert code in (0, 1, 4)
    assert "Traceback" not in err
    document(
        "job", "abort", job
    )  # an aborted scan can be taken up again, so end it for good
    while document("job", "status", job)["state"] not in FINAL_STATES:
        assert time.monotonic() < deadline
    for verb in ("abort", "pause"):
        refused = f"flexdt: nothing to {verb}: no job is queued, running or paused\n"
        assert flexdt("job", verb) == (4, "", refused)


@pytest.mark.slow
def test_ctrl_c_leaves_the_scan_running(
    document: Document, script: Path, servers: Servers
) -> None:
    script.write_bytes(SCRIPT.encode() + b"scanner\tpause\t3600000\t\tACK\t\t\r\n")
    address = "{}:{}".format(*servers.address)
    words = [
        "run",
        str(script),
        "--speed-up",
        "1",
        "--server",
        address,
        "--out",
        "left-alone",
    ]
    with subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        deadline = time.monotonic() + 60
        while True:
            named = [
                j for j in document("job", "list")["jobs"] if j["name"] == "left-alone"
            ]
            status = named[-1] if named else {}
            if status.get("state") == "running":
                break
            if time.monotonic() > deadline:
                process.kill()
                pytest.fail(f"the job never ran: {status}")
            time.sleep(0.05)
        assert process.stderr is not None
        assert (
            "warning" in process.stderr.readline()
        )  # it has the answer, and follows the job
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=90)
    assert (process.returncode, out) == (130, "")
    assert f"detached; {status['job']} goes on" in err
    assert "Traceback" not in err
    assert document("job", "status", status["job"])["state"] == "running"
    document("job", "abort", status["job"])


def test_an_invalid_script_is_refused_with_positions(
    flexdt: Flexdt, script: Path
) -> None:
    script.write_bytes(b"camera set exposure fast ACK\r\ntra_obj move sideways 3 ACK\r\n")
    code, out, err = flexdt("run", str(script))
    assert (code, out) == (1, "")
    assert err.count(f"{script}:1:") == 1
    assert err.count(f"{script}:2:") == 1
    assert "script:" not in err
    assert err.endswith(f"flexdt: {script} was refused; nothing was started\n")


@pytest.mark.parametrize(("volts", "code"), [("1000", 3), ("-1", 1)])
def test_run_and_check_leave_with_the_same_code(
    flexdt: Flexdt, script: Path, volts: str, code: int
) -> None:
    script.write_bytes(
        SCRIPT.replace("tube\txrayon\t", f"tube\tset kV\t{volts}").encode()
    )
    assert flexdt("run", str(script))[0] == code
    assert run(["check", str(script)]) == code


def test_a_parameter_that_does_not_fit_is_one_line(flexdt: Flexdt) -> None:
    code, out, err = flexdt("tube", "--kv", "-1")
    assert (code, out) == (1, "")
    assert err == "flexdt: tube.set: kV: allowed: at least 0.001\n"
    _, _, err = flexdt("tube", "--kv", "-1", "--power", "-2")
    assert err.splitlines()[1:] == ["flexdt: power_W: allowed: at least 1e-06"]


def test_names_that_cannot_be_say_what_can(
    flexdt: Flexdt, script: Path, data_dir: Path
) -> None:
    code, _, err = flexdt("sample", "../x")
    assert (code, err) == (1, "flexdt: ../x: no such file\n")
    for words in (("sample", "x\a"), ("run", str(script), "--out", "a/b")):
        code, _, err = flexdt(*words)
        assert code == 1
        assert "may hold anything but /, \\ and control characters" in err
    (data_dir / "notes.txt").write_text("mine")
    code, _, err = flexdt("run", str(script), "--out", "notes.txt")
    assert (code, "it is no folder" in err) == (1, True)
    (data_dir / "photographs").mkdir()
    code, _, err = flexdt("run", str(script), "--out", "photographs")
    assert (code, "no scan of this twin has begun" in err) == (1, True)
    assert "Errno" not in err


def test_no_connection_exits_4(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        assert run(["state", "--server", f"127.0.0.1:{port}"]) == 4
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1


def test_json_with_an_error_leaves_standard_output_empty(flexdt: Flexdt) -> None:
    code, out, _ = flexdt("move", "mag_obj=5000", "--json")
    assert (code, out) == (3, "")


def test_tube_and_camera_are_set_and_shown(flexdt: Flexdt, document: Document) -> None:
    assert document("tube", "--kv", "60", "--power", "20", "--on")["kV"] == 60
    assert document("tube")["on"] is True
    assert flexdt("tube", "--kv", "900")[0] == 3
    assert document("tube", "--off")["on"] is False
    assert document("camera", "--exposure", "50")["exposure_ms"] == 50
    assert document("camera", "--roi", "40 8 1943 1527")["roi"] == [40, 8, 1943, 1527]
    whole = ("--roi", "32", "8", "1943", "1527")
    assert document("camera", "--mode", "HW2SW2High", *whole)["shape"] == [380, 478]
    assert document("camera", "--mode", "HW2SW1High", "--exposure", "100")["shape"] == [
        760,
        956,
    ]
    assert flexdt("camera", "--mode", "best")[0] == 3


def test_a_snapshot_with_x_rays_off_shows_the_sample_or_says_it_is_dark(
    flexdt: Flexdt, tmp_path: Path
) -> None:
    import cv2

    flexdt("tube", "--off")
    flexdt("sample", "lego")
    flexdt("camera", "--mode", "HW2SW1High", "--roi", "32", "8", "1943", "1527")
    assert flexdt("move", "mag_obj=600", "mag_det=1000", "tra_obj=0.5", "ver_tube=26.3",
                  "ver_det=20", "tra_tube=0", "tra_det=25.3")[0] == 0  # fmt: skip
    png, tif = tmp_path / "view.png", tmp_path / "view.tif"
    assert flexdt("snap", str(png), "--no-marks")[0] == 0
    picture = cv2.imread(str(png), cv2.IMREAD_GRAYSCALE)
    assert picture[0, 0] == 255  # air is bright
    assert picture.min() == 0  # a bead is dark
    code, _, err = flexdt("snap", str(tif))
    assert code == 0
    assert "X-rays are off" in err


def test_a_snapshot_shows_in_colour_what_is_wrong_with_the_exposure(
    flexdt: Flexdt, document: Document, tmp_path: Path
) -> None:
    import cv2

    flexdt("sample", "lego")
    flexdt("camera", "--mode", "HW2SW1High", "--roi", "32", "8", "1943", "1527")
    at = ("mag_obj=600", "mag_det=1000", "tra_obj=0.5", "ver_tube=26.3", "ver_det=20", "tra_tube=0",
          "tra_det=25.3")  # fmt: skip
    assert flexdt("move", *at)[0] == 0
    png = tmp_path / "view.png"

    def shot(*options: str) -> tuple[str, np.ndarray]:
        code, out, _ = flexdt("snap", str(png), *options)
        assert code == 0
        return out, cv2.imread(str(png), cv2.IMREAD_UNCHANGED)

    flexdt("tube", "--kv", "90", "--power", "50")
    flexdt("camera", "--exposure", "150")
    out, picture = shot()
    assert "red: saturated" in out
    assert picture[0, 0].tolist() == [48, 48, 255]  # air, blue first
    dense = (picture[:, :, 0] == picture[:, :, 2]).mean()
    assert 0.01 < dense < 0.9  # the sample is grey
    grey = shot("--no-marks")[1]
    assert grey.shape == picture.shape[:2]
    flexdt("camera", "--exposure", "1")
    flexdt("tube", "--power", "10")
    out, picture = shot()
    assert "blue: starved" in out
    blue = (picture == (255, 112, 48)).all(axis=2)
    assert 0.001 < blue.mean() < 0.5
    assert grey[blue].mean() < grey[~blue].mean()
    flags = document("snap", str(png))["flags"]
    assert flags["starved"] == pytest.approx(blue.mean(), rel=0.2)
    # In the corner of the panel alone the sample is cut off: yellow on that edge.
    flexdt("camera", "--exposure", "100", "--roi", "900", "700", "1099", "899")
    flexdt("tube", "--power", "50")
    out, picture = shot()
    assert "yellow: edge" in out
    yellow = (picture == (0, 200, 255)).all(axis=2)
    assert yellow[0].any()
    assert not yellow[10:-10, 10:-10].any()
    flexdt("camera", "--roi", "32", "8", "1943", "1527")


def test_a_warning_is_called_one_once(flexdt: Flexdt, tmp_path: Path) -> None:
    script = tmp_path / "far.txt"
    script.write_bytes(
        SCRIPT.replace("set ROI\t900 700 999 779", "set exposure\t20").encode()
    )
    flexdt("run", str(script), "--speed-up", "max", "--out", "warned")
    _, out, err = flexdt("job", "status")
    told = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert told, out + err
    assert all("warning" not in line.removeprefix("warning: ") for line in told), told


@pytest.mark.parametrize("pace", ["1000", "max", "20"])
@pytest.mark.parametrize("seconds", [0.5, 12.0])
def test_a_jog_lasts_so_many_seconds_of_the_twins_clock(
    flexdt: Flexdt, document: Document, pace: str, seconds: float
) -> None:
    flexdt("clock", "max")
    flexdt("move", "rot_obj=0")
    flexdt("clock", pace)
    begun = time.monotonic()
    assert flexdt("jog", "rot_obj", "-5", "--for", str(seconds))[0] == 0
    passed = time.monotonic() - begun
    flexdt("clock", "max")
    turned = -document("state")["axes"]["rot_obj"]["target"]
    if seconds < 10 or pace == "max":  # within one lease, or where the clock waits
        assert turned == pytest.approx(5 * seconds, abs=0.1)
    else:  # a renewal comes when it comes, late on a busy machine
        assert 0.5 * 5 * seconds <= turned <= 5 * max(1.5 * seconds, passed * float(pace))


def test_a_jog_into_the_end_of_the_travel_ends(
    flexdt: Flexdt, document: Document
) -> None:
    flexdt("clock", "max")
    limit = document("state")["axes"]["ver_det"]["limits"][1]
    flexdt("move", f"ver_det={limit - 20}")
    assert flexdt("jog", "ver_det", "5", "--for", "60")[0] == 0
    assert document("state")["axes"]["ver_det"]["position"] == pytest.approx(
        limit, abs=1e-6
    )
    flexdt("move", "ver_det=20")


def test_a_jog_into_a_contact_says_so_and_what_stops_the_next_is_an_error(
    flexdt: Flexdt, document: Document
) -> None:
    flexdt("clock", "max")
    flexdt("move", "mag_obj=600", "mag_det=750", "rot_obj=0")
    code, _, err = flexdt("jog", "mag_det", "-20", "--for", "60")
    assert code == 3
    assert "would collide: the jog ends before, at mag_det=" in err
    assert document("state")["safety"]["clearance_mm"] >= 1.0
    flexdt("reset")
    assert flexdt("move", "mag_det=1059")[0] == 0


@pytest.mark.parametrize("seconds", ["-1", "0", "nan", "inf", "x"])
def test_a_jog_for_no_time_is_a_usage_error(flexdt: Flexdt, seconds: str) -> None:
    code, out, err = flexdt("jog", "rot_obj", "5", "--for", seconds)
    assert (code, out) == (2, "")
    assert "--for" in err


def test_counts_in_the_dark_are_not_judged(flexdt: Flexdt, tmp_path: Path) -> None:
    flexdt("tube", "--off")
    code, out, err = flexdt("snap", str(tmp_path / "dark.png"), "--kind", "counts")
    assert code == 0
    assert "dark image" in err
    assert len(out.splitlines()) == 1


def test_nothing_is_called_nothing(flexdt: Flexdt) -> None:
    assert flexdt("sample", "empty")[1] == "on the stage: nothing\n"
    flexdt("sample", "lego")


@pytest.mark.slow
def test_phantom_and_scene_files_stand_on_the_stage(
    flexdt: Callable[..., Answer], document: Callable[..., Any], tmp_path: Path
) -> None:
    """What `phantom make` writes, a bead file, and a scene with a mesh beside it."""
    made, beads, scene = (
        tmp_path / n for n in ("made.json", "beads.toml", "assembly.toml")
    )
    assert run(["phantom", "make", str(made), "--like", "tall", "--beads", "3"]) == 0
    beads.write_text(BEAD_FILE)
    trimesh.creation.box(extents=(2, 3, 4)).export(tmp_path / "handle.stl")
    scene.write_text(SCENE_FILE)
    for file in (made, beads, scene):
        now = document("sample", str(file))
        assert now["sample"]["name"] == file.stem
        listed = {one["name"]: one for one in document("sample")["samples"]}
        assert (listed[file.stem]["kind"], listed[file.stem]["uploaded"]) == (
            "scene",
            True,
        )
        assert document("state")["sample"]["name"] == file.stem
        assert flexdt("snap", str(tmp_path / f"{file.stem}.tif"))[0] == 0
    scene.write_text(SCENE_FILE.replace("handle.stl", "gone.stl"))
    code, _, err = flexdt("sample", str(scene))
    assert code == 1
    assert "gone.stl" in err
    assert flexdt("sample", str(beads), "--material", "steel")[0] == 2
    assert flexdt("sample", "empty")[0] == 0
