"""The images' steps without a container engine.

    python docker/try_steps.py [twin projector ...]
    debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm ROOT
    python docker/try_steps.py --root ROOT            # as root: the steps run inside ROOT

Reads the Dockerfile, copies what it copies (and nothing else of the repository), runs its
install steps (in a scratch folder, or changed into ROOT), starts each image's entry point as
the image's user where it may, and waits for its health check. What it cannot tell: whether the
base image is there and what else the engine does. Exit code 0 when all are healthy.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
UID = 10001
STARTED_WITHIN_S = 900.0
STATE = "/var/lib/flexdt"


@dataclass(frozen=True)
class Place:
    """Where the steps are tried: `folder` stands for the image's /, truly so if it is a
    root."""

    folder: Path
    is_root: bool

    def of(self, path: str) -> Path:
        """Where a path of the image is out here."""
        return self.folder / path.lstrip("/")

    def run(
        self, words: Sequence[str], cwd: str, user: bool, **more: Any
    ) -> subprocess.Popen[bytes]:
        """Start a command as the image would, as its user if `user` and that is possible."""
        if not self.is_root:
            return subprocess.Popen(
                list(words), cwd=self.of(cwd), **more, **(_as_user() if user else {})
            )

        def enter() -> None:
            os.chroot(self.folder)
            os.chdir(cwd)
            if user:
                os.setgroups([])
                os.setgid(UID)
                os.setuid(UID)

        return subprocess.Popen(list(words), preexec_fn=enter, **more)


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


def build(steps: list[tuple[str, str]], place: Place) -> None:
    """Run the build stage, with /opt and /src inside `place`."""
    source = place.of("/src")
    if source.exists():
        shutil.rmtree(source)
    source.mkdir(parents=True)
    for word, rest in steps:
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
            command = (
                rest if place.is_root else rest.replace("/opt/", f"{place.folder}/opt/")
            )
            if place.is_root:
                command = re.sub(r"^python ", "python3 ", command)  # Debian's name for it
            print(f"+ {command}", flush=True)
            done = place.run(
                command.split(), "/src", False, stdout=subprocess.DEVNULL
            ).wait()
            if done:
                raise SystemExit(f"{command!r} ended with code {done}")


def _as_user() -> dict[str, Any]:
    """Another user, where this one may become it and the interpreter can be reached by
    others."""
    python = Path(sys.executable).resolve()
    reached = all(folder.stat().st_mode & 0o001 for folder in python.parents)
    return (
        {"user": UID, "group": UID, "extra_groups": []}
        if os.getuid() == 0 and reached
        else {}
    )


def start(name: str, stages: dict[str, list[tuple[str, str]]], place: Place, more: list[str],
          health: str) -> tuple[subprocess.Popen[bytes], float]:  # fmt: skip
    """Start an image's entry point; return the process and seconds until its health check
    passed."""
    home = f"{STATE}/{name}"  # the images have one each; here they share a file system
    for path in (home, f"{home}/data"):
        place.of(path).mkdir(parents=True, exist_ok=True)
        if place.is_root or _as_user():
            os.chown(place.of(path), UID, UID)
    entry = next(json.loads(rest) for word, rest in stages[name] if word == "ENTRYPOINT")
    inside = "" if place.is_root else str(place.folder)
    words = [w.replace(STATE, f"{inside}{home}") for w in entry]
    env = {
        "PATH": f"{inside}/opt/flexdt/bin:{os.environ['PATH']}", "HOME": f"{inside}{home}",
        "FLEXDT_CACHE": f"{inside}{home}/kernels", "PYTHONDONTWRITEBYTECODE": "1",
        "FLEXDT_HEALTH": health,
    }  # fmt: skip
    env |= dict(rest.split("=", 1) for word, rest in stages[name] if word == "ENV")
    words[0] = f"{inside}/opt/flexdt/bin/{words[0]}"
    process = place.run([*words, *more], home, True, env=env, stdout=subprocess.DEVNULL)
    begun = time.monotonic()
    while time.monotonic() - begun < STARTED_WITHIN_S:
        if process.poll() is not None:
            raise SystemExit(f"{name} ended with code {process.returncode}")
        check = subprocess.run([sys.executable, str(HERE / "healthy.py")], env=env, check=False,
                               stderr=subprocess.DEVNULL)  # fmt: skip
        if check.returncode == 0:
            return process, time.monotonic() - begun
        time.sleep(0.5)
    process.kill()
    raise SystemExit(f"{name} is not healthy after {STARTED_WITHIN_S:.0f} s")


@contextlib.contextmanager
def prepared(root: Path | None) -> Iterator[Place]:
    """Prepare the place as an engine would: names, certificates, /proc and /dev."""
    if root is None:
        with tempfile.TemporaryDirectory(prefix="flexdt-image-") as folder:
            Path(folder).chmod(0o755)
            yield Place(Path(folder), False)
        return
    if os.getuid() != 0:
        raise SystemExit("--root needs the rights of root")
    for file in ("/etc/resolv.conf", "/etc/hosts", "/etc/ssl/certs/ca-certificates.crt"):
        if Path(file).exists():
            shutil.copy(file, root / file.lstrip("/"))
    mounted = []
    for folder in ("/proc", "/dev"):
        if (
            subprocess.run(
                ["mount", "--bind", folder, str(root / folder[1:])], check=False
            ).returncode
            == 0
        ):
            mounted.append(str(root / folder[1:]))
    try:
        yield Place(root.resolve(), True)
    finally:
        for folder in reversed(mounted):
            subprocess.run(["umount", folder], check=False)


def main() -> int:
    """Build, start, check, stop."""
    options = argparse.ArgumentParser(
        description=__doc__.partition("\n\n")[0] if __doc__ else None
    )
    options.add_argument("images", nargs="*", default=[])
    options.add_argument(
        "--root", type=Path, help="a debootstrap root to run the steps in"
    )
    chosen = options.parse_args()
    stages = instructions()
    with prepared(chosen.root) as place:
        build(stages["build"], place)
        token = place.of("/token")
        token.write_text("only-for-this-trial-of-the-steps\n")
        secret = "/token" if place.is_root else str(token)
        extra = {
            "projector": (["--port", "56001", "--token-file", secret], 9201),
            "twin": (["--port", "56000", "--token-file", secret, "--projector",
                      "127.0.0.1:56001", "--projector-token-file", secret], 9202),
            "viewer": (["--port", "56080", "--twin", "127.0.0.1:56000", "--token-file",
                        secret], 9203),
        }  # fmt: skip
        running = []
        try:
            for name in chosen.images or ["projector", "twin", "viewer"]:
                more, port = extra[name]
                more = [*more, "--http-port", str(port)]
                health = f"http://127.0.0.1:{port}/healthz"
                process, took = start(name, stages, place, more, health)
                running.append((name, process))
                who = (
                    "as the image's user"
                    if place.is_root or _as_user()
                    else "as this user"
                )
                print(f"{name}: healthy after {took:.1f} s, {who}", flush=True)
        finally:
            for name, process in reversed(running):
                process.send_signal(signal.SIGTERM)
                print(f"{name} ended with code {process.wait(30)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
