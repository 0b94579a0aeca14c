"""What the compose file and the systemd unit hold: limits, rights, and who may read the token."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import yaml

HOME = Path(__file__).resolve().parents[2] / "docker"
UNITS = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}


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
    assert kept <= 0.8 * size(services["projector"]["mem_limit"]), "volumes leave room to compute"


def test_the_token_is_for_the_containers_user_alone() -> None:
    """World-readable, any user of the machine could move the scanner."""
    text = (HOME / "compose.yaml").read_text()
    uid = re.search(r"--uid (\d+)", (HOME / "Dockerfile").read_text())
    assert uid is not None
    advice = " ".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
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
    assert found["OOMPolicy"] == "continue", "one process that is too large must not end the others"
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
    assert set(families) == {"AF_INET", "AF_INET6", "AF_UNIX"}  # AF_UNIX: viser behind the viewer
    assert "MemoryDenyWriteExecute" not in found, "kernels are compiled at run time"


def test_the_workflow_builds_every_image_of_the_dockerfile() -> None:
    workflows = HOME.parent / ".github" / "workflows"
    job = yaml.safe_load((workflows / "images.yml").read_text())["jobs"]["image"]
    stages = re.findall(r"^FROM base AS (\w+)$", (HOME / "Dockerfile").read_text(), re.MULTILINE)
    assert sorted(job["strategy"]["matrix"]["target"]) == sorted(stages)
    (build,) = [s["with"] for s in job["steps"] if "build-push" in s.get("uses", "")]
    assert build["file"] == "docker/Dockerfile"
    assert (HOME.parent / build["file"]).is_file()
    assert "untried" in job["name"]
