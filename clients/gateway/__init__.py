"""The scanner software's own socket interface on top of the twin: its programs run
unchanged."""
