"""What every test may rely on, however the suite itself was started."""

from __future__ import annotations

import signal

# A shell that starts the suite in the background ignores SIGINT, and every process started from
# here would inherit that; the tests of Ctrl-C need it to arrive.
signal.signal(signal.SIGINT, signal.default_int_handler)
