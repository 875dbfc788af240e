# SPDX-License-Identifier: MIT
"""What all commands share: one-line errors, exit codes and the progress bar.

A command is its parser, one library call and its output. It imports numpy, ROS and the like only
after parsing, so that `--help` works everywhere.
"""

import argparse
import os
import sys
from typing import Callable, Iterable, Iterator, Optional, TypeVar

from semantic_lidar_fusion.errors import MissingDependencyError, SemanticLidarFusionError

T = TypeVar("T")


def run(main: Callable[[], Optional[int]]) -> None:
    """Runs a command and leaves the interpreter: 0 on success, 1 with one line for known errors,
    130 when interrupted; an unknown error shows its trace (and 1)."""
    name = os.path.basename(sys.argv[0])
    try:
        code = main() or 0
        sys.stdout.flush()
    except SemanticLidarFusionError as error:
        print("%s: error: %s" % (name, error), file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        print("%s: interrupted" % name, file=sys.stderr)
        code = 130
    except BrokenPipeError:
        # The reader of our output has left; Python must not try to flush to it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    sys.exit(code)


def positive(text: str) -> int:
    """The type of an argument that is a whole number of at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return value


def require(*modules: str) -> None:
    """Imports modules; raises MissingDependencyError in one line that names the interpreter."""
    for module in modules:
        try:
            __import__(module)
        except ImportError as error:
            raise MissingDependencyError(
                "%s cannot import %s (%s); source the workspace's setup.bash, or use the system's "
                "Python, e.g. /usr/bin/python3" % (sys.executable, module, error)
            ) from error


def warn(text: str) -> None:
    """One line on stderr."""
    print("%s: warning: %s" % (os.path.basename(sys.argv[0]), text), file=sys.stderr)


def progress(items: Iterable[T], total: Optional[int] = None, label: str = "") -> Iterator[T]:
    """Passes `items` on, with a bar on stderr if that is a terminal and tqdm is installed."""
    if sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            pass
        else:
            return iter(tqdm(items, total=total, desc=label, unit="msg", leave=False))
    return iter(items)
