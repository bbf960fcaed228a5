"""Parser, error messages, exit codes and progress bars of the commands."""

import argparse
import contextlib
import errno
import os
import select
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from jaxdrones import user_code
from jaxdrones.checks import UnexpectedKeyword
from jaxdrones.cli import machine
from jaxdrones.errors import UserError
from jaxdrones.visualization import plots

DIVERGED, MISTAKE, FAULT, INTERRUPTED, PIPE_CLOSED = 1, 2, 70, 130, 141
EXIT_CODES = """exit codes:
    0  done
    1  diverged flight or training, lost commands, success below `eval --fail-below`, or a problem found by `doctor`
    2  invalid arguments, or an error in your file, with a message of one line
   70  internal error, with its traceback: please report it
  130  interrupted
  141  stdout was closed, for example by `head`"""

_AGAIN = 0.05  # s after which a lost Ctrl-C is repeated
_MAX_MESSAGE = 1000  # characters
_DEBUG = {"JAX_DEBUG_NANS", "JAX_DEBUG_INFS"}


class Parser(argparse.ArgumentParser):
    """Parser without abbreviations, with error messages of one line, and exit codes in its help."""

    commands: Mapping[str, argparse.ArgumentParser]
    """Parser of each command, by name."""

    def __init__(self, **kwargs):
        super().__init__(**{"allow_abbrev": False} | kwargs)

    def format_help(self):  # noqa: D102
        return f"{super().format_help()}\n{EXIT_CODES}\n"

    def error(self, message):  # noqa: D102
        self.exit(print_error(f"{shortened(message)}; see {self.prog} --help"))


def print_error(message: str, code: int = MISTAKE) -> int:
    """Write an error message of one line to stderr; return the exit code."""
    print(f"jaxdrones: {'' if code == INTERRUPTED else 'error: '}{shortened(message)}", file=sys.stderr)
    return code


@contextlib.contextmanager
def lasting_interrupts():
    """Context in which SIGTERM acts like Ctrl-C, and a Ctrl-C that Python drops (in garbage collection) is repeated."""
    before, timers = sys.unraisablehook, []
    is_main = threading.current_thread() is threading.main_thread()
    terminate = signal.signal(signal.SIGTERM, signal.default_int_handler) if is_main else None

    def interrupt_again(dropped):
        if dropped.exc_type is not KeyboardInterrupt:
            return before(dropped)
        main = threading.main_thread().ident, signal.SIGINT
        timers.append(threading.Timer(_AGAIN, signal.pthread_kill, main))  # which also ends the wait for a lock
        timers[-1].start()

    sys.unraisablehook = interrupt_again
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, terminate)
        sys.unraisablehook = before
        for timer in timers:
            timer.cancel()


def print_failure(error: BaseException, debug: bool) -> int:
    """Write the error of a command to stderr, always with its traceback if `debug`; return the exit code.

    A user's mistake or an error in a user's file is one line. Everything else is an internal error. Nothing is written
    if the reader of stdout has ended, as `head` does.
    """
    if isinstance(error, BrokenPipeError) and _is_stdout_closed():
        return PIPE_CLOSED
    if debug:
        traceback.print_exception(error)
    in_callback = isinstance(error, jax.errors.JaxRuntimeError) and "KeyboardInterrupt" in str(error)
    if isinstance(error, KeyboardInterrupt) or in_callback:
        return print_error("interrupted", INTERRUPTED)
    if blamed := user_code.blame(error):
        return print_error(blamed + "; --debug shows the traceback" * (not debug))
    if isinstance(error, SystemExit):  # of the parser, which has printed its message
        raise error
    if message := _explained(error):
        return print_error(message)
    if not debug:
        traceback.print_exception(error)
    what = f"{type(error).__name__}: {error}; this is a fault of jaxdrones, please report it"
    return print_error(f"{what} with the lines above and what `jaxdrones doctor` prints", FAULT)


def _is_stdout_closed() -> bool:
    """Whether the reader of stdout has ended; the rest of the output is then discarded."""
    poll = select.poll()
    try:
        poll.register(sys.stdout.fileno(), 0)  # errors alone, which are always reported
    except OSError:  # stdout is not a file
        return False
    if not poll.poll(0):
        return False
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)
    return True


def _explained(error: BaseException) -> str | None:
    """Message of an error outside this library; `None` for a possible internal error."""
    if isinstance(error, UserError | UnexpectedKeyword):
        return str(error)
    if isinstance(error, ImportError) and not (error.name or "").startswith("jaxdrones"):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}; choose another --output" if error.filename else str(error)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "there is not enough memory; give fewer worlds, drones or episodes"
    in_program = type(error).__name__ == "InternalFloatingPointError"  # which JAX raises for a compiled program
    if (in_program or isinstance(error, FloatingPointError)) and _DEBUG.intersection(os.environ):
        found = f"there is {error.args[1]} in {error.args[0]}" if in_program else error
        return f"{found}; {' and '.join(sorted(_DEBUG.intersection(os.environ)))} made this an error"
    try:
        machine.devices()
    except UserError as missing:
        return str(missing)
    return None


def until_interrupted(fly: Callable[[], Any], *lost: type[Exception]) -> tuple[str, int] | None:
    """Run a flight; message and exit code of one that was interrupted or lost, to be printed after its results."""
    try:
        fly()
    except KeyboardInterrupt:
        return "interrupted", INTERRUPTED
    except lost as error:
        return str(error), DIVERGED
    return None


def print_warning(message: str) -> None:
    """Write a warning of one line to stderr."""
    print(f"jaxdrones: warning: {shortened(message)}", file=sys.stderr)


def shortened(message: str) -> str:
    """Message on one line, with the middle of a very long one elided."""
    line = " ".join(message.split("\n"))
    return line if len(line) <= _MAX_MESSAGE else f"{line[: _MAX_MESSAGE // 2]} ... {line[-_MAX_MESSAGE // 2 :]}"


def folder(text: str) -> Path:
    """Path of an option; an empty one, for example from an unset variable, is an error."""
    if not text:
        raise argparse.ArgumentTypeError("the path is empty; name one, or leave the option out")
    return Path(text)


def run_folder(task: str, ending: str = "") -> Path:
    """Default folder of a run: `runs/hover`, or `runs/moving_box` for the task `my_task.py:moving_box`."""
    return Path("runs") / (task.rpartition(":")[2] + ending)


def check_options(options: argparse.Namespace) -> None:
    """Raise unless the options that are given are in the `ranges` of their command."""
    for name, check in getattr(options, "ranges", {}).items():
        if getattr(options, name) is not None:
            check(name, getattr(options, name))


def check_writable(*files: Path | None) -> None:
    """Raise unless these files can be written, pictures with matplotlib; create their folders."""
    for file in filter(None, files):
        if file.suffix in plots.SUFFIXES:
            plots.check_matplotlib()
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
        probe = file.with_name(f".{file.name}.probe")
        try:
            probe.touch()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(file)) from error
        probe.unlink()


def bar(total: int | None, what: str, unit: str, initial: int = 0):
    """Context with a progress bar on stderr, silent without a terminal; with `None` without tqdm."""
    try:
        from tqdm import tqdm
    except ImportError:
        return contextlib.nullcontext()
    look = dict(leave=False, disable=None, file=sys.stderr, dynamic_ncols=True)
    return tqdm(total=total, desc=what, unit=unit, initial=initial, **look)
