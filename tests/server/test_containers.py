"""What the compose file and the systemd unit hold: limits, rights, and who may read the
token."""

from __future__ import annotations

import configparser
import http.server
import itertools
import json
import os
import re
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

HOME = Path(__file__).resolve().parents[2] / "docker"
UNITS = {
    "k": 1 << 10,
    "m": 1 << 20,
    "g": 1 << 30,
    "KiB": 1 << 10,
    "MiB": 1 << 20,
    "GiB": 1 << 30,
}


def size(text: str) -> int:
    found = re.fullmatch(r"(\d+)([a-zA-Z]+)", text)
    assert found is not None, text
    return int(found[1]) * UNITS[found[2]]


def test_every_service_of_compose_has_limits_and_no_rights() -> None:
    services = yaml.safe_load((HOME / "compose.yaml").read_text())["services"]
    assert set(services) == {"projector", "twin", "viewer"}
    for name, service in services.items():
        assert size(service["mem_limit"]) <= 8 << 30, name
        assert 64 <= service["pids_limit"] <= 1024, name
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["secrets"] == ["token"]
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ()))
        (scratch,) = service["tmpfs"]
        assert "size=" in scratch, "what is written there counts as memory"
    words = services["projector"]["command"]
    kept = size(words[words.index("--memory-limit") + 1])
    assert kept <= 0.8 * size(services["projector"]["mem_limit"]), (
        "volumes leave room to compute"
    )


def stages() -> dict[str, list[tuple[str, str]]]:
    """Stage of the Dockerfile -> its (instruction, arguments), those of its base first."""
    found: dict[str, list[tuple[str, str]]] = {}
    name = ""
    for line in re.sub(r"\\\n", " ", (HOME / "Dockerfile").read_text()).splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            found[name] = [*found.get(base, [])]
        elif word and not word.startswith("#"):
            found[name].append((word, rest.strip()))
    return found


def environment(steps: list[tuple[str, str]]) -> dict[str, str]:
    pairs = [pair for word, rest in steps if word == "ENV" for pair in rest.split()]
    return dict(pair.split("=", 1) for pair in pairs)


def mounts(
    name: str, service: dict[str, Any], image: list[tuple[str, str]]
) -> dict[str, str]:
    """Path in a container -> what an engine mounts there: a named volume, `tmpfs`, or the
    anonymous volume of an image's VOLUME, which is another one after `compose down`."""
    found = {path: "anonymous" for word, path in image if word == "VOLUME"}
    found |= {word.split(":")[0]: "tmpfs" for word in service.get("tmpfs", ())}
    return found | {
        path: volume for volume, path in (v.split(":") for v in service["volumes"])
    }


def written(service: dict[str, Any], image: list[tuple[str, str]]) -> set[str]:
    """Paths that a service writes to: those among its words, its kernels' folder, and /tmp."""
    entry = next(json.loads(rest) for word, rest in image if word == "ENTRYPOINT")
    words = [part for word in (*entry, *service["command"]) for part in word.split("=")]
    paths = {
        word
        for word in words
        if word.startswith("/") and not word.startswith("/run/secrets/")
    }
    return {*paths, environment(image)["FLEXDT_CACHE"], "/tmp"}


def lying_in(path: str, found: dict[str, str]) -> str | None:
    """What is mounted at the path, or at the nearest folder above it; None: the image's own
    root, which is read-only."""
    at = [where for where in found if path == where or path.startswith(f"{where}/")]
    return found[max(at, key=len)] if at else None


def test_every_path_that_is_written_lies_in_a_named_volume() -> None:
    """So `docker compose down` loses nothing."""
    document, images = yaml.safe_load((HOME / "compose.yaml").read_text()), stages()
    for name, service in document["services"].items():
        image = images[service["build"]["target"]]
        found = mounts(name, service, image)
        for path in written(service, image):
            volume = lying_in(path, found)
            if path == "/tmp":
                assert volume == "tmpfs"
            else:
                assert volume in document["volumes"], f"{name}: {path} lies in {volume}"
    # What the model finds, as the files were once: a volume one level above the image's own.
    twin = {**document["services"]["twin"], "volumes": ["twin:/var/lib/flexdt"]}
    found = mounts("twin", twin, images["twin"])
    assert lying_in("/var/lib/flexdt/data", found) == "anonymous"
    assert lying_in("/var/lib/flexdt/settings", found) == "twin"
    assert lying_in("/opt/flexdt", found) is None


def test_folders_of_volumes_are_the_users() -> None:
    """A new named volume takes over the owner of the image's folder."""
    for name, steps in stages().items():
        user = ""
        for word, rest in steps:
            user = rest if word == "USER" else user
            if word == "VOLUME":
                made = [s for w, s in steps if w == "RUN" and rest in s]
                assert user == "flexdt", name
                assert made, f"{name}: nothing makes {rest} before it is a volume"


def test_images_hold_their_kernels_and_the_extras_of_their_options() -> None:
    images = stages()
    assert images["build"][-1] == ("RUN", "/opt/flexdt/bin/flexdt kernels share")
    for name in ("projector", "twin", "viewer"):
        assert ("VOLUME", environment(images[name])["FLEXDT_CACHE"]) in images[name]
    (install,) = [s for w, s in images["build"] if w == "RUN" and "pip install" in s]
    extras = set(re.findall(r"[a-z]+", install.rpartition("[")[2]))
    options = tomllib.loads((HOME.parent / "pyproject.toml").read_text())["project"]
    assert extras <= set(options["optional-dependencies"])
    assert {"gateway", "io"} <= extras


def test_monitoring_reaches_every_page_of_the_stack() -> None:
    """A page listens beyond its container, and its port is published from a network that
    can."""
    document, images = yaml.safe_load((HOME / "compose.yaml").read_text()), stages()
    published = dict[str, str]()
    for name, service in document["services"].items():
        entry = next(json.loads(r) for w, r in images[name] if w == "ENTRYPOINT")
        options = dict(itertools.pairwise(entry))
        assert options["--http-host"] == options["--host"] == "0.0.0.0"
        for port in service["ports"]:
            host, outside, inside = port.split(":")
            if inside == options["--http-port"]:
                published[f"{host}:{outside}"] = name
        reached = [n for n in service["networks"] if not (document["networks"][n] or {})]
        assert reached, (
            f"{name} is on internal networks alone: no port of it can be published"
        )
    text = (HOME / "monitoring" / "prometheus.yaml").read_text()
    wanted = {
        t: job
        for job, t in re.findall(r'job_name: flexdt-(\w+)\n.*targets: \["(.*?)"\]', text)
    }
    assert published == wanted


@pytest.mark.parametrize(
    ("page", "wants", "code"),
    [
        ('{"status": "ok"}', "", 0),
        ('{"status": "failed"}', "", 1),
        ('{"status": "ok", "twin": "connected"}', "twin=connected", 0),
        ('{"status": "ok", "twin": "not connected"}', "twin=connected", 1),
        ("no JSON", "", 1),
    ],
)
def test_a_container_is_healthy_when_its_page_says_so(
    page: str, wants: str, code: int
) -> None:
    class Page(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(page.encode())

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        where = f"http://127.0.0.1:{server.server_port}/healthz"
        env = os.environ | {"FLEXDT_HEALTH": where, "FLEXDT_HEALTH_WANTS": wants}
        done = subprocess.run([sys.executable, str(HOME / "healthy.py")], env=env, check=False,
                              capture_output=True, text=True, timeout=60)  # fmt: skip
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert environment(stages()["viewer"])["FLEXDT_HEALTH_WANTS"] == "twin=connected"


def test_the_token_is_for_the_containers_user_alone() -> None:
    """World-readable, any user of the machine could move the scanner."""
    text = (HOME / "compose.yaml").read_text()
    uid = re.search(r"--uid (\d+)", (HOME / "Dockerfile").read_text())
    assert uid is not None
    advice = " ".join(
        line.lstrip("# ") for line in text.splitlines() if line.startswith("#")
    )
    assert f"chown {uid[1]}:{uid[1]} docker/token" in advice
    assert "chmod 400 docker/token" in advice
    assert "umask 077" in advice, "nor may it be read before"
    for mode in re.findall(r"chmod (\d+)", text):
        assert int(mode, 8) & 0o077 == 0


def unit() -> dict[str, str]:
    parser = configparser.ConfigParser(strict=True, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(HOME / "flexdt.service")
    return dict(parser["Service"])


def test_the_unit_has_limits_and_no_rights() -> None:
    found = unit()
    for name in ("MemoryHigh", "MemoryMax"):
        assert 50 <= int(found[name].removesuffix("%")) <= 90
    assert 256 <= int(found["TasksMax"]) <= 4096
    assert found["OOMPolicy"] == "continue", (
        "one process that is too large must not end the others"
    )
    assert found["UMask"] == "0077"
    assert found["StateDirectoryMode"] == "0700"
    assert found["CapabilityBoundingSet"] == found["AmbientCapabilities"] == ""
    assert found["ProtectSystem"] == "strict"
    assert found["SystemCallFilter"] == "@system-service"
    on = ("NoNewPrivileges", "PrivateTmp", "PrivateDevices", "ProtectHome", "ProtectKernelTunables",
          "ProtectKernelModules", "ProtectKernelLogs", "ProtectControlGroups", "ProtectClock",
          "ProtectHostname", "RestrictNamespaces", "RestrictRealtime", "RestrictSUIDSGID",
          "LockPersonality", "RemoveIPC")  # fmt: skip
    assert {name: found[name] for name in on} == dict.fromkeys(on, "yes")
    families = found["RestrictAddressFamilies"].split()
    assert set(families) == {
        "AF_INET",
        "AF_INET6",
        "AF_UNIX",
    }  # AF_UNIX: viser behind the viewer
    assert "MemoryDenyWriteExecute" not in found, "kernels are compiled at run time"


def test_the_workflow_builds_every_image_of_the_dockerfile() -> None:
    workflows = HOME.parent / ".github" / "workflows"
    job = yaml.safe_load((workflows / "images.yml").read_text())["jobs"]["image"]
    stages = re.findall(
        r"^FROM base AS (\w+)$", (HOME / "Dockerfile").read_text(), re.MULTILINE
    )
    assert sorted(job["strategy"]["matrix"]["target"]) == sorted(stages)
    (build,) = [s["with"] for s in job["steps"] if "build-push" in s.get("uses", "")]
    assert build["file"] == "docker/Dockerfile"
    assert (HOME.parent / build["file"]).is_file()
    assert "untried" in job["name"]
