"""The TCP shell: sockets around `protocol.Connection`, requests served in turn."""
