"""The images' steps without a container engine: `python docker/try_steps.py [twin projector ...]`.

Reads the Dockerfile, copies what it copies (and nothing else of the repository), runs its install
steps into a scratch folder, starts each image's entry point as the image's user where it may, and
waits for its health check. What it cannot tell: whether the base image is there and what else the
engine does. Exit code 0 when all are healthy.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
UID = 10001
STARTED_WITHIN_S = 900.0


def instructions() -> dict[str, list[tuple[str, str]]]:
    """Stage -> its (instruction, arguments)."""
    text = re.sub(r"\\\n", " ", (HERE / "Dockerfile").read_text())
    stages: dict[str, list[tuple[str, str]]] = {}
    name = ""
    for line in text.splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "FROM":
            name = rest.rpartition(" AS ")[2]
            stages[name] = []
        elif word and not word.startswith("#"):
            stages[name].append((word, rest.strip()))
    return stages


def build(stages: dict[str, list[tuple[str, str]]], scratch: Path) -> None:
    """The build stage, with /opt and /src inside `scratch`."""
    source = scratch / "src"
    source.mkdir()
    for word, rest in stages["build"]:
        if word == "COPY":
            *what, where = rest.split()
            for item in what:
                target = source / where / (item if len(what) > 1 else "")
                if (ROOT / item).is_dir():
                    shutil.copytree(
                        ROOT / item, target, ignore=shutil.ignore_patterns("__pycache__")
                    )
                else:
                    shutil.copy(ROOT / item, target)
        elif word == "RUN":
            command = rest.replace("/opt/", f"{scratch}/opt/")
            print(f"+ {command}", flush=True)
            subprocess.run(command.split(), cwd=source, check=True, stdout=subprocess.DEVNULL)


def as_user() -> dict[str, object]:
    """Another user, where this one may become it and the interpreter can be reached by others."""
    python = Path(sys.executable).resolve()
    reached = all(folder.stat().st_mode & 0o001 for folder in python.parents)
    return {"user": UID, "group": UID, "extra_groups": []} if os.getuid() == 0 and reached else {}


def start(name: str, stages: dict[str, list[tuple[str, str]]], scratch: Path, more: list[str],
          env: dict[str, str]) -> tuple[subprocess.Popen[bytes], float]:  # fmt: skip
    """An image's entry point; returns the process and seconds until its health check passed."""
    home = scratch / "var" / name
    (home / "data").mkdir(parents=True)
    if as_user():
        for path in (home, home / "data"):
            os.chown(path, UID, UID)
    entry = next(json.loads(rest) for word, rest in stages[name] if word == "ENTRYPOINT")
    words = [w.replace("/var/lib/flexdt", str(home)) for w in entry]
    full = {
        "PATH": f"{scratch}/opt/flexdt/bin:{os.environ['PATH']}", "HOME": str(home),
        "NUMBA_CACHE_DIR": str(home / "numba"), "PYTHONDONTWRITEBYTECODE": "1", **env,
    }  # fmt: skip
    words[0] = f"{scratch}/opt/flexdt/bin/{words[0]}"
    process = subprocess.Popen([*words, *more], cwd=home, env=full, stdout=subprocess.DEVNULL,
                               **as_user())  # type: ignore[call-overload]  # fmt: skip
    begun = time.monotonic()
    while time.monotonic() - begun < STARTED_WITHIN_S:
        if process.poll() is not None:
            raise SystemExit(f"{name} ended with code {process.returncode}")
        check = subprocess.run([sys.executable, str(HERE / "healthy.py")], env=full, check=False,
                               stderr=subprocess.DEVNULL)  # fmt: skip
        if check.returncode == 0:
            return process, time.monotonic() - begun
        time.sleep(0.5)
    process.kill()
    raise SystemExit(f"{name} is not healthy after {STARTED_WITHIN_S:.0f} s")


def main() -> int:
    """Build, start, check, stop."""
    wanted = sys.argv[1:] or ["projector", "twin", "viewer"]
    stages = instructions()
    with tempfile.TemporaryDirectory(prefix="flexdt-image-") as folder:
        scratch = Path(folder)
        scratch.chmod(0o755)
        build(stages, scratch)
        token = scratch / "token"
        token.write_text("only-for-this-trial-of-the-steps\n")
        extra = {
            "projector": (["--port", "56001", "--token-file", str(token)], 9201),
            "twin": (["--port", "56000", "--token-file", str(token), "--projector",
                      "127.0.0.1:56001", "--projector-token-file", str(token)], 9202),
            "viewer": (["--port", "56080", "--twin", "127.0.0.1:56000", "--token-file",
                        str(token)], 0),
        }  # fmt: skip
        running = []
        try:
            for name in wanted:
                more, port = extra[name]
                env = {"FLEXDT_HEALTH": "tcp:56080"}
                if port:
                    more = [*more, "--http-port", str(port)]
                    env = {"FLEXDT_HEALTH": f"http://127.0.0.1:{port}/healthz"}
                process, took = start(name, stages, scratch, more, env)
                running.append(process)
                who = "as another user" if as_user() else "as this user"
                print(f"{name}: healthy after {took:.1f} s, {who}", flush=True)
        finally:
            for process in reversed(running):
                process.send_signal(signal.SIGTERM)
                print(f"ended with code {process.wait(30)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
