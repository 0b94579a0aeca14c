"""The containers' health check: exit code 0 when the process is well.

FLEXDT_HEALTH is the address of its page, FLEXDT_HEALTH_WANTS what that has to say beside
`status`, as words KEY=VALUE.
"""

import json
import os
import sys
import urllib.request

WHERE = os.environ.get("FLEXDT_HEALTH", "http://127.0.0.1:9101/healthz")
WANTED = ["status=ok", *os.environ.get("FLEXDT_HEALTH_WANTS", "").split()]

try:
    with urllib.request.urlopen(WHERE, timeout=4) as page:
        said = json.load(page)
except (OSError, ValueError) as error:
    sys.exit(f"{WHERE}: {error}")
for word in WANTED:
    key, _, value = word.partition("=")
    if str(said.get(key)) != value:
        sys.exit(f"{WHERE}: {key} is {said.get(key)}, not {value}")
