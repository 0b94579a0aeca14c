"""The library (not the servers) without what Windows lacks.

A stand-in for a system that is not at hand: modules and functions that Python has on POSIX
alone are taken away once the third-party libraries are loaded, and folders cannot be opened.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TAKE_AWAY = """
import asyncio, concurrent.futures.process, multiprocessing.popen_spawn_posix, subprocess, tempfile
import os, shutil, signal, socket, sys
import cv2, fcl, numba, numpy, platformdirs, pydantic, scipy.ndimage, scipy.optimize, tifffile
import trimesh

MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog")

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(name)

for name in MODULES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Absent())
for module, names in {
    os: "fork killpg getpgid setsid sched_getaffinity getuid geteuid getgid statvfs O_DIRECTORY "
        "O_NOFOLLOW O_CLOEXEC O_NONBLOCK fchmod chown posix_fallocate uname getloadavg mkfifo "
        "pread pwrite sysconf nice",
    signal: "SIGKILL SIGHUP SIGUSR1 SIGUSR2 SIGALRM SIGCHLD SIGPIPE SIGQUIT",
    socket: "AF_UNIX",
}.items():
    for name in names.split():
        delattr(module, name)
os.supports_dir_fd = os.supports_fd = os.supports_follow_symlinks = frozenset()
opened = os.open

def files_only(path, flags, *mode, dir_fd=None):
    assert dir_fd is None
    if os.path.isdir(path):
        raise PermissionError(13, "no folders here", path)
    return opened(path, flags, *mode)

os.open = files_only
# Python asks the disk in Windows' own way there.
shutil.disk_usage = lambda path: shutil._ntuple_diskusage(2 << 40, 1 << 40, 1 << 40)
"""

TASKS = """
import flexdt as fx

scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=24, shape=(95, 120), pixel=1.1968)
data = fx.simulate("lego", scan, tube=fx.Tube(kV=90), noise=1)
data.save("lego-scan")
again = fx.open("lego-scan")
volume = again.reconstruct("fdk", voxel=1.0)
volume.save("lego.nrrd")
trimesh.creation.icosphere(radius=5.0).export("ball.stl")
ball = fx.simulate("ball.stl", scan, material="pmma", noise=1)
report = fx.plan(sys.argv[1]).check()
print(len(again), volume.data.shape == fx.Volume.load("lego.nrrd").data.shape, len(ball),
      report.ok)
"""


@pytest.mark.slow
def test_the_library_needs_nothing_that_windows_lacks(tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "examples" / "scripts" / "step-72.txt"
    done = subprocess.run(
        [sys.executable, "-c", TAKE_AWAY + TASKS, str(script)], cwd=tmp_path, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["24", "True", "24", "True"]
