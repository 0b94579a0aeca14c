"""The examples of the wire in other languages: bash and C++ are run, MATLAB's lines are
sent."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
import uuid
from pathlib import Path

import numpy as np
import pytest
import tifffile

from flexdt.clients import TwinClient
from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers
from flexdt.library.reconstruction.volume_files import read_volume

pytestmark = [pytest.mark.timeout(300), pytest.mark.slow]

WIRE = Path(__file__).resolve().parents[2] / "examples" / "wire"


def words(servers: Servers) -> list[str]:
    host, port = servers.address
    return [host, str(port)]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_the_shell_example_gets_the_projection(servers: Servers, tmp_path: Path) -> None:
    done = subprocess.run(
        ["bash", str(WIRE / "client.sh"), *words(servers)],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows, columns = map(
        int, re.findall(r"rows x columns = (\d+) x (\d+)", done.stdout)[0]
    )
    assert float(re.findall(r"took ([\d.]+) s", done.stdout)[0]) > 1.0
    pixels = np.fromfile(tmp_path / "projection.raw", "<f4").reshape(rows, columns)
    with TwinClient(*servers.address) as twin:
        assert twin.state().axes["rot_obj"].position == 90.0
        np.testing.assert_array_equal(pixels, twin.projection(binning=4).image)


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_the_shell_example_says_what_the_server_refused(
    tmp_path: Path, servers: Servers
) -> None:
    text = (WIRE / "client.sh").read_text("utf-8").replace("normal-5", "no such thing")
    (tmp_path / "wrong.sh").write_text(text, "utf-8")
    done = subprocess.run(
        ["bash", "wrong.sh", *words(servers)],
        cwd=tmp_path, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1
    assert "no such thing" in done.stderr


@pytest.mark.skipif(
    shutil.which("g++") is None, reason="no g++ here to compile the example with"
)
def test_the_cpp_example_compiles_and_gets_the_projection(
    servers: Servers, tmp_path: Path
) -> None:
    program = tmp_path / "client"
    subprocess.run(
        ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-o", program, WIRE / "client.cpp"],
        check=True, timeout=120,
    )  # fmt: skip
    done = subprocess.run(
        [program, *words(servers)], capture_output=True, text=True, timeout=120
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    shown = re.fullmatch(r"(\d+) x (\d+), mean (\S+), largest (\S+)\n", done.stdout)
    assert shown is not None
    with TwinClient(*servers.address) as twin:
        image = twin.projection(binning=4).image
    assert (int(shown[1]), int(shown[2])) == image.shape
    assert float(shown[3]) == pytest.approx(float(image.mean(dtype=np.float64)), rel=1e-4)
    assert float(shown[4]) == pytest.approx(float(image.max()), rel=1e-4)

    nobody = subprocess.run(
        [program, "127.0.0.1", "1"], capture_output=True, text=True, timeout=60
    )
    assert (nobody.returncode, nobody.stderr) == (1, "no server at 127.0.0.1:1\n")


def test_what_the_matlab_example_sends_is_understood(servers: Servers) -> None:
    """Its calls, as `jsonencode` writes them, answered with the fields it reads."""
    text = (WIRE / "client.m").read_text("utf-8")
    targets = dict(re.findall(r"'(\w+_obj)', (\d+)", text))
    assert targets == {"tra_obj": "0", "mag_obj": "600", "rot_obj": "45"}
    calls = re.findall(r"call\(twin, '([\w.]+)'", text)
    assert calls == ["session.hello", "sample.set", "axes.move", "projection.get"]
    params = [
        {"protocol": "1.0", "client": "MATLAB"},
        {"name": "normal-5"},
        {"targets": {k: int(v) for k, v in targets.items()}, "wait": True},
        {"kind": "line_integral", "binning": 4},
    ]
    results = []
    with (
        socket.create_connection(servers.address, timeout=60) as link,
        link.makefile("rwb") as io,
    ):
        for i, (method, given) in enumerate(zip(calls, params, strict=True), 1):
            line = {"jsonrpc": "2.0", "id": i, "method": method, "params": given}
            io.write(json.dumps(line, separators=(",", ":")).encode() + b"\n")
            io.flush()
            answer = json.loads(io.readline())
            assert "error" not in answer, answer
            results.append(answer["result"])
    assert results[2]["duration_s"] > 0
    for field in re.findall(r"answer\.(\w+)", text):
        if field not in ("error", "result"):
            assert field in results[3], field


def scanned(done: subprocess.CompletedProcess[str], volume: Path) -> None:
    """What a trajectory example leaves is a data set that `flexdt reconstruct` takes."""
    assert done.returncode == 0, done.stderr
    *warnings, said, folder = done.stdout.splitlines()
    assert all(line.startswith("warning: ") for line in warnings)
    assert said == "done: 24 of 24 projections"
    words = ["--out", str(volume), "--voxel", "1", "--shape", "40,40,40"]
    assert run(["reconstruct", folder, *words]) == 0
    read_reference(Path(folder))
    data = read_volume(volume).data
    inside, corner = data[10:30, 10:30, 10:30].max(), np.abs(data[:4, :4, :4]).max()
    assert inside > 4 * corner > 0


def read_reference(folder: Path) -> None:
    """The flat is an empty beam: counts of no sample, brighter than the dark everywhere."""
    dark, flat, first = (
        tifffile.imread(folder / f"{name}.tif").astype(float)
        for name in ("di000000", "io000000", "scan_000000")
    )
    assert flat.min() > dark.max()
    assert flat.max() < 2**14 - 1
    assert (first - dark).min() < 0.9 * (
        flat - dark
    ).min()  # the sample is in the projections only


def test_the_python_example_ends_in_a_volume(servers: Servers, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-I", WIRE / "trajectory.py", *words(servers), f"py-{uuid.uuid4().hex}"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    scanned(done, tmp_path / "volume.tif")


@pytest.mark.skipif(
    shutil.which("g++") is None, reason="no g++ here to compile the example with"
)
def test_the_cpp_trajectory_ends_in_a_volume(servers: Servers, tmp_path: Path) -> None:
    program, source = tmp_path / "trajectory", WIRE / "trajectory.cpp"
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(["g++", *flags, "-o", program, source], check=True, timeout=120)
    done = subprocess.run(
        [program, *words(servers), f"cpp-{uuid.uuid4().hex}"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    scanned(done, tmp_path / "volume.tif")


def test_what_the_matlab_trajectory_sends_is_understood(servers: Servers) -> None:
    """Its poses as `jsonencode` writes a struct array; the fields of answers that it reads."""
    text = (WIRE / "trajectory.m").read_text("utf-8")
    poses = [{"rot_obj": i * 15, "mag_obj": 600, "tra_obj": 0} for i in range(24)]
    assert re.findall(r"'(\w+_obj)', (\w+)", text) == [
        ("rot_obj", "angles"), ("mag_obj", "600"), ("tra_obj", "0")
    ]  # fmt: skip
    with TwinClient(*servers.address) as twin:
        twin.set_camera(mode="HW4SW1High")
        job = twin.submit_trajectory(poses, 20.0, f"m-{uuid.uuid4().hex}")
        status = twin.wait_job(job.job)
    for name in re.findall(r"job\.(job|dataset)\b", text):
        assert getattr(job, name)
    for name in re.findall(r"status\.(?!result)(\w+)", text):
        assert hasattr(status, name) or name == "status"
