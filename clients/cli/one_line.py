"""A parser of `argparse` whose errors are one line, for programs of other distributions."""

from __future__ import annotations

import argparse
from typing import NoReturn


class OneLine(argparse.ArgumentParser):
    """Reports a wrong option in one line, without the page of all options."""

    def error(self, message: str) -> NoReturn:
        """End the program with exit code 2 and one line."""
        self.exit(2, f"{self.prog}: {message}\n")
