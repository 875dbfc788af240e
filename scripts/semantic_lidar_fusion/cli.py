# SPDX-License-Identifier: MIT
"""What all commands share: one-line errors, exit codes and the progress bar.

A command is its parser, one library call and its output. It imports numpy, ROS and the like only
after parsing, so that `--help` works everywhere.
"""

import argparse
import os
import signal
import sys
import traceback
import warnings
from types import FrameType
from typing import Callable, Iterable, Iterator, List, Optional, TypeVar

from semantic_lidar_fusion.errors import MissingDependencyError, SemanticLidarFusionError
from semantic_lidar_fusion.texts import plain_text

T = TypeVar("T")

# Lines hold names of files and texts of messages, which may hold anything.
_LONGEST_LINE = 4000


class Ended(BaseException):
    """A signal that asks for the end; raised wherever the program is, so that temporary files go."""

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number


def _end(number: int, frame: Optional[FrameType]) -> None:
    raise Ended(number)


def _take_signals() -> None:
    """SIGTERM and SIGHUP end the program as Ctrl-C does; what nohup ignores stays ignored."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


def _open_standard_streams() -> None:
    """A standard stream that the caller has closed becomes /dev/null: a file that is opened later
    must not get its number, and with it what is printed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdin = sys.stdin or open(os.devnull)
    sys.stdout = sys.stdout or open(os.devnull, "w")
    sys.stderr = sys.stderr or open(os.devnull, "w")


def _forget_stdout() -> None:
    """Nobody takes what is still in its buffer; Python must not try again when it leaves."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _say(text: str) -> None:
    """One line on stderr, which may itself be closed or full."""
    name = os.path.basename(sys.argv[0])
    line = plain_text(" ".join(text.split()), _LONGEST_LINE)
    try:
        print("%s: %s" % (name, line), file=sys.stderr, flush=True)
    except (OSError, ValueError):
        pass


def _where(error: BaseException) -> str:
    """The last place of this package that an error passed: file:line."""
    places = traceback.extract_tb(error.__traceback__)
    package = os.path.dirname(os.path.abspath(__file__))
    ours = [p for p in places if p.filename.startswith(package) and p.filename != __file__]
    ours = ours or places
    return "%s:%d" % (os.path.basename(ours[-1].filename), ours[-1].lineno or 0)


def replay_parser(description: Optional[str]) -> argparse.ArgumentParser:
    """The parser of a command that replay.launch starts, with the rig and its changes."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--rig", metavar="FILE", required=True, help="the rig file of the replay")
    parser.add_argument(
        "--overrides",
        metavar="TEXT",
        default="",
        help="changes to the rig file, key=value, separated by blanks",
    )
    return parser


def node_arguments() -> List[str]:
    """The command's own arguments, without the __name:=... and __log:=... that roslaunch adds."""
    return [argument for argument in sys.argv[1:] if not argument.startswith("__")]


def run(main: Callable[[], Optional[int]]) -> None:
    """Runs a command and leaves the interpreter: 0 on success, 1 with one line for errors, 128 + its
    number after a signal. An error that nobody foresaw is one line too, with its place; its trace is
    shown where the variable SLF_TRACEBACK is set."""
    _open_standard_streams()
    _take_signals()
    if not os.environ.get("SLF_TRACEBACK"):
        # numpy's, of an overflow in numbers that the next check refuses with a line of its own.
        warnings.simplefilter("ignore", RuntimeWarning)
    try:
        if "--version" in sys.argv[1:]:
            from semantic_lidar_fusion.installation import version

            print("%s %s" % (os.path.basename(sys.argv[0]), version()))
            code = 0
        else:
            code = main() or 0
        sys.stdout.flush()
    except SemanticLidarFusionError as error:
        _say("error: %s" % error)
        code = 1
    except KeyboardInterrupt:
        _say("interrupted")
        code = 130
    except Ended as ended:
        _say("ended by %s" % signal.Signals(ended.number).name)
        code = 128 + ended.number
    except BrokenPipeError:
        _forget_stdout()
        code = 141
    except OSError as error:
        what = error.filename if error.filename is not None else "stdout"
        _say("error: %s: %s" % (what, error.strerror or error))
        _forget_stdout()
        code = 1
    except MemoryError:
        _say("error: not enough memory")
        code = 1
    except Exception as error:
        if os.environ.get("SLF_TRACEBACK"):
            traceback.print_exc()
        _say(
            "error: unexpected %s at %s: %s (SLF_TRACEBACK=1 shows the trace)"
            % (type(error).__name__, _where(error), error)
        )
        code = 1
    sys.exit(code)


def positive(text: str) -> int:
    """The type of an argument that is a whole number of at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be positive")
    return value


def address(text: str) -> str:
    """The type of an argument that is the address of a Dask scheduler, for argparse."""
    if not text.strip():
        raise argparse.ArgumentTypeError("must be an address, such as tcp://10.0.0.5:8786")
    return text


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
