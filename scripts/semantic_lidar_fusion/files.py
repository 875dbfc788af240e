# SPDX-License-Identifier: MIT
"""Files of users to read, and files to write whole or not at all."""

import atexit
import contextlib
import fcntl
import os
import secrets
import stat
from typing import IO, Iterator

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import DataError, cannot_write

_ENDING = ".partial"


def open_file(path: str) -> IO[bytes]:
    """A regular file, open for reading in binary; DataError for all else.

    A pipe or a device would keep the command waiting, or have no end."""
    try:
        file = open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb")
    except OSError as error:
        raise DataError("%s: %s" % (path, error.strerror or error)) from error
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise DataError("%s: must be a file" % path)
    return file


class AtomicFile:
    """A new file beside `path` that becomes `path` when committed, and vanishes otherwise.

    Its name is its own and no link is followed. It is locked while it is written, so that the next
    writer of `path` knows what a killed one has left, and removes it."""

    def __init__(self, path: str):
        """Makes the file; DataError if it cannot be written."""
        folder, name = os.path.split(os.path.abspath(path))
        if not os.path.isdir(folder):
            raise DataError("%s: the folder %s does not exist" % (path, folder))
        if os.path.isdir(path):
            raise DataError("%s: is a folder" % path)
        if os.path.exists(path) and not os.path.isfile(path):
            raise DataError("%s: is a pipe or a device; must be a file" % path)
        self.path = path
        _remove_leftovers(folder, name)
        self.temporary = os.path.join(folder, _prefix(name) + secrets.token_hex(8) + _ENDING)
        self._lock = -1
        # A signal may come where no context has been entered yet that would clean up.
        atexit.register(self.discard)
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            self._lock = os.open(self.temporary, flags, 0o666)
        except OSError as error:
            raise cannot_write(path, error) from error
        with contextlib.suppress(OSError):  # some file systems have no locks
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

    @contextlib.contextmanager
    def opening(self) -> Iterator[None]:
        """For a writer's constructor: the file vanishes if the block fails or is interrupted.
        DataError if it cannot be written."""
        try:
            yield
        except BaseException as error:
            self.discard()
            if isinstance(error, OSError):
                raise cannot_write(self.path, error) from error
            raise

    def commit(self) -> None:
        os.replace(self.temporary, self.path)
        self._unlock()

    def discard(self) -> None:
        """Removes the file unless it is committed."""
        with contextlib.suppress(FileNotFoundError):
            os.remove(self.temporary)
        self._unlock()

    def _unlock(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1
        atexit.unregister(self.discard)


def _prefix(name: str) -> str:
    return ".%s." % name[:200]


def _remove_leftovers(folder: str, name: str) -> None:
    """Removes and names what killed runs have left of a file. A running one holds its lock."""
    try:
        names = os.listdir(folder)
    except OSError:
        return
    for entry in names:
        code = entry[len(_prefix(name)) : -len(_ENDING)]
        if entry != _prefix(name) + code + _ENDING or len(code) != 16:
            continue
        path = os.path.join(folder, entry)
        with contextlib.suppress(OSError):
            lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.remove(path)
                cli.warn("%s: removed; a run that was killed has left it" % path)
            finally:
                os.close(lock)


def write_text(path: str, text: str) -> None:
    """Writes a text file whole or not at all; DataError if it cannot be written."""
    file = AtomicFile(path)
    try:
        with open(file.temporary, "w", encoding="utf-8") as stream:
            stream.write(text)
        file.commit()
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        file.discard()
