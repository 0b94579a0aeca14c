"""The Python clients of the twin server, blocking and asynchronous."""
