"""Measures of the source code, for looking at: one module a measure, `make house` prints all.

No measure fails and none is a limit. A figure that rose since the last release is a place to
read.
"""
