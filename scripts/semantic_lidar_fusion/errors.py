# SPDX-License-Identifier: MIT
"""The exceptions that a command reports in one line; every other one shows its trace."""


class SemanticLidarFusionError(Exception):
    """Base of all errors whose cause lies outside this package."""


class DataError(SemanticLidarFusionError):
    """A file or message that is missing, damaged or against its format."""


class ConfigError(SemanticLidarFusionError):
    """A class set, rig file or option that breaks a rule; the text lists every problem."""


class MissingDependencyError(SemanticLidarFusionError):
    """A module that this interpreter cannot import."""


def cannot_write(path: str, error: OSError) -> DataError:
    """What to raise where a file cannot be written: names the file and the system's reason."""
    return DataError("%s: cannot be written (%s)" % (path, error.strerror or error))
