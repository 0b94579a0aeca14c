"""`flexdt.machine`: `flexdt.machines.machine` with checked arguments.

Apart from it, since the command line's help loads that module and nothing of the core.
"""

from __future__ import annotations

from flexdt import machines
from flexdt.twin.signatures import public

machine = public(machines.machine)
