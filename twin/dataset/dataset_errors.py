"""Errors of data sets, one type for each case that a caller may want to handle.

Every message names the file, the value found and the allowed values; `data["path"]` names
the file.
"""

from __future__ import annotations

from flexdt.twin.errors import MissingFileError, TwinError


class DatasetError(TwinError):
    """Base class of all errors about data sets."""


class DatasetNameError(DatasetError):
    """A name that could lead out of its folder or that a file system may not accept."""


class DatasetFormatError(DatasetError):
    """A file whose content is not of the kind that its name states."""


class DatasetMissingError(DatasetError, MissingFileError):
    """A required file is missing; the message names it."""


class DatasetIndexError(DatasetError, IndexError):
    """A number of a projection that the data set does not have."""


class DatasetWriteError(DatasetError):
    """A file could not be written."""


class DiskFullError(DatasetWriteError):
    """There is no space for a file; no part of it is left behind."""


class DatasetExistsError(DatasetWriteError):
    """A data set of that name exists already."""
