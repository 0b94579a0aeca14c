"""The methods' handlers: short functions that translate between wire and twin."""

from flexdt.server.twin.handlers import (  # noqa: F401 (each fills HANDLERS)
    calibration_methods,
    image_methods,
    job_methods,
    motion_methods,
    sample_methods,
    session_methods,
)
from flexdt.server.twin.handlers.handler import HANDLERS

__all__ = ["HANDLERS"]
