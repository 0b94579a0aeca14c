"""The containers' health check: exit code 0 when the process answers.

FLEXDT_HEALTH is an address that answers 200, or `tcp:PORT` for one that only has to listen.
"""

import os
import socket
import sys
import urllib.request

WHERE = os.environ.get("FLEXDT_HEALTH", "http://127.0.0.1:9101/healthz")

try:
    if WHERE.startswith("tcp:"):
        socket.create_connection(("127.0.0.1", int(WHERE[4:])), timeout=4).close()
    else:
        urllib.request.urlopen(WHERE, timeout=4).close()
except OSError as error:
    sys.exit(f"{WHERE}: {error}")
