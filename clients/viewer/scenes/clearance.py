"""The present clearance between parts that may not touch, for warnings and highlights.

The twin states it with every state; it sweeps each motion before it starts all the same.
"""

from __future__ import annotations

from dataclasses import dataclass

from flexdt.protocol.state_model import SafetyState

CLOSE_MM = 20.0


@dataclass(frozen=True)
class Near:
    """The nearest pair of parts that may not touch."""

    mm: float | None
    pair: tuple[str, ...]

    @classmethod
    def of(cls, safety: SafetyState) -> Near:
        """What a state says of it."""
        return cls(safety.clearance_mm, tuple(safety.pair or ()))

    @property
    def close(self) -> bool:
        """Whether the clearance is small enough for a warning."""
        return self.mm is not None and self.mm < CLOSE_MM

    def document(self) -> dict[str, object]:
        """For pages."""
        return {"mm": self.mm, "pair": list(self.pair), "close": self.close}
