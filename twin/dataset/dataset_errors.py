"""What can be wrong with a data set, one type for each thing a caller may want to handle.

Every message says which file, what was found and what is allowed; `data["path"]` names the file.
"""

from __future__ import annotations

from flexdt.twin.errors import TwinError


class DatasetError(TwinError):
    """Base of all errors about data sets."""


class DatasetNameError(DatasetError):
    """A name that could lead outside its folder or that a file system would trip over."""


class DatasetFormatError(DatasetError):
    """A file that does not hold what its name says."""


class DatasetMissingError(DatasetError):
    """A file that should be there and is not; names it."""


class DatasetWriteError(DatasetError):
    """A file could not be written."""


class DiskFullError(DatasetWriteError):
    """There is no room for a file; nothing of it is left behind."""


class DatasetExistsError(DatasetWriteError):
    """A data set of that name is there already."""
