"""Gymnasium environments on the twin: plan a scan, or choose how to reconstruct it.

    import gymnasium
    env = gymnasium.make("flexdt_extensions.learning:flexdt/NextAngle-v0")

Importing this package registers the environments (Gymnasium's own way; the part before the
colon makes it import the package). The extra `learn` installs Gymnasium; agents are the user's
own.
"""

from __future__ import annotations

from typing import Any, Final

try:
    import gymnasium
except ImportError as error:  # pragma: no cover - tested in a process without the extra
    raise ImportError(
        "flexdt_extensions.learning needs Gymnasium, which is not installed: "
        "pip install 'flexdt-extensions[learn]'"
    ) from error

_HERE: Final = "flexdt_extensions.learning"
ENVIRONMENTS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "flexdt/NextAngle-v0": (f"{_HERE}.scanning:ScanEnv", {"action": "angle"}),
    "flexdt/NextAngleDiscrete-v0": (f"{_HERE}.scanning:ScanEnv", {"action": "discrete"}),
    "flexdt/NextPose-v0": (f"{_HERE}.scanning:ScanEnv", {"action": "pose"}),
    "flexdt/NextAngleQuality-v0": (
        f"{_HERE}.scanning:ScanEnv",
        {"action": "discrete", "task": "quality", "observation": "projection"},
    ),
    "flexdt/Reconstruction-v0": (f"{_HERE}.reconstructing:ReconstructionEnv", {}),
}
"""Registered id -> class of the environment and its arguments."""

for _name, (_entry, _options) in ENVIRONMENTS.items():
    if _name not in gymnasium.registry:
        _vector = None
        if _options.get("action") == "discrete":
            _vector = f"{_HERE}.vector_scanning:ScanVectorEnv"
        gymnasium.register(
            id=_name,
            entry_point=_entry,
            vector_entry_point=_vector,
            kwargs=_options,
        )

__all__ = ["ENVIRONMENTS"]
