"""The lab in the browser: a 3-D scene, the live radiograph and every control, over TCP
alone."""
