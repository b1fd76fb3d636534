"""The process of a command: it works in a thread, and signals are answered at once.

Python handles signals in the main thread, between two of its instructions. If the main
thread compiled or computed, Ctrl-C would wait for that, or be lost in a callback of
JAX. So it only waits. Files are written under temporary names and renamed, so that a
process may end at any moment.
"""

import contextlib
import gc
import os
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from typing import NoReturn

farewells: list[Callable[[], str]] = []
"""Functions that say what a command has written when a signal ends it."""


class _SignalReceived(BaseException):
    """Raised in the main thread, where nothing but waiting is interrupted."""


def main() -> NoReturn:
    """Run a command; Ctrl-C and SIGTERM end it within two seconds with one sentence."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _receive)
    # Threads of BLAS wait busily for each other at small matrices; large work has its
    # own threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imports, tracing and drawing make many small objects, of which few are in cycles.
    gc.set_threshold(50_000, 20, 100)
    codes = []
    completion = threading.Event()

    def work() -> None:
        codes.append(_exit_code())
        completion.set()

    try:
        threading.Thread(target=work, daemon=True).start()
        # A signal that another thread has received does not wake this one.
        while not completion.wait(0.1):
            pass
    except _SignalReceived as interruption:
        (number,) = interruption.args
        for signal_number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signal_number, lambda *_: os._exit(128 + number))
        # Files that belong together take their places together, for a second at most.
        lock = getattr(sys.modules.get("jaxid.io"), "PLACING", None)
        _ = lock is None or lock.acquire(timeout=1.0)
        if not codes:
            _say(farewells[-1]() if farewells else "stopped: nothing was written")
            codes.append(128 + number)
    _leave(codes[0])


def _receive(number: int, _) -> None:
    raise _SignalReceived(number)


def _exit_code() -> int:
    """Run the command and return its exit code; a bug keeps its traceback."""
    try:
        from .app import main

        main()
    except SystemExit as exit_request:
        return int(exit_request.code or 0)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _say(text: str) -> None:
    # A progress bar has hidden the cursor, and stands in the line.
    clear_sequence = "\x1b[?25h\r\x1b[2K" if sys.stderr.isatty() else ""
    sys.stderr.write(f"{clear_sequence}jaxid: {text}.\n")


def _leave(code: int) -> NoReturn:
    """End the process at once: what runs in a thread is not torn down half-way."""
    # A copy: the command goes on in its own thread.
    for folder in tuple(getattr(sys.modules.get("jaxid.io"), "TEMPORARY", ())):
        shutil.rmtree(folder, ignore_errors=True)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
