"""Which errors a user can mend, and how they read in one sentence."""

import dis
import errno

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that has no room for a result."""


def is_for_the_user(error: Exception) -> bool:
    """Whether it comes from a file, or was raised by name in this package: not from a bug."""
    if isinstance(error, OSError):
        return True
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    # The package, not the module: that is called `__main__` where it is run with `python -m`.
    package = "" if trace is None else trace.tb_frame.f_globals.get("__package__") or ""
    if trace is None or package.partition(".")[0] != "jaxid":
        return False
    # NumPy's own errors have no frame below ours: only a `raise` statement is a sentence.
    return trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


def sentence(error: Exception) -> str:
    """What an error says, with the file that it is about."""
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        where = f"`{error.filename}`: " if error.filename else ""
        return (
            f"{where}{error.strerror}: nothing was written; make room, or choose another folder "
            "with -o."
        )
    if isinstance(error, OSError) and error.strerror:
        where = f"`{error.filename}`: " if error.filename else ""
        return f"{where}{error.strerror}."
    return str(error)
