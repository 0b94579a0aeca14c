"""Building blocks of commands and file formats in other distributions, such as flexdt's
extensions.

A command is a function whose parameters' defaults are its options; it yields lines for people
and, once, the document of `--json`. The entry point group `flexdt.commands` gives it a name:

    [project.entry-points."flexdt.commands"]
    study = "my_package.study_command:study"

A dot in the name stands for a group: `phantom.design` is `flexdt phantom design`.
"""

import argparse
from typing import NoReturn

from flexdt.clients.cli.commands.process_commands import become
from flexdt.clients.cli.console import note, size, table, warn
from flexdt.clients.cli.option_values import assignments, names, numbers, position, triple
from flexdt.clients.cli.options import (
    Answer,
    Free,
    Jobs,
    Json,
    MachineName,
    ProfileName,
    Scheduler,
    Twin,
    argument,
    option,
)
from flexdt.library.failure import CommandError
from flexdt.library.optional.extras import package
from flexdt.library.reconstruction.volume_files import volume_writer
from flexdt.library.reconstruction.volume_formats import VoxelPlaces
from flexdt.message_words import problem_words, reason_of
from flexdt.runtime.files.dataset_folder import tiff_bytes
from flexdt.runtime.files.whole_files import free_bytes, write_whole
from flexdt.runtime.process_settings import rays_a_side

__all__ = [
    "Answer",
    "CommandError",
    "Free",
    "Jobs",
    "Json",
    "MachineName",
    "OneLine",
    "ProfileName",
    "Scheduler",
    "Twin",
    "VoxelPlaces",
    "argument",
    "assignments",
    "become",
    "free_bytes",
    "names",
    "note",
    "numbers",
    "option",
    "package",
    "position",
    "problem_words",
    "rays_a_side",
    "reason_of",
    "size",
    "table",
    "tiff_bytes",
    "triple",
    "volume_writer",
    "warn",
    "write_whole",
]


class OneLine(argparse.ArgumentParser):
    """A parser of `argparse` that reports a wrong option in one line, without the page of
    all options."""

    def error(self, message: str) -> NoReturn:
        """Exit with code 2 and one line."""
        self.exit(2, f"{self.prog}: {message}\n")
