"""What other libraries print is kept from the standard output, which belongs to results."""

import io
import os
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

_here = threading.local()
_lock = threading.Lock()
_watching = 0


class _Watched:
    """A standard output that lets through what other threads print.

    One for good, which keeps the plain one too: `print` of another thread may still hold what was `sys.stdout` a moment ago, and
    Python before 3.14 does not count that as a use.
    """

    plain: Any = None

    def write(self, text: str) -> int:
        kept = getattr(_here, "kept", None)
        if kept is not None:
            kept.append(text)
        elif self.plain is not None:
            return self.plain.write(text)
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.plain, name)


_watched: Any = _Watched()


@contextmanager
def kept() -> Generator[list[str]]:
    """A list that receives what this thread would print inside; several threads may be inside at once."""
    global _watching
    with _lock:
        if _watching == 0 and sys.stdout is not _watched:
            _watched.plain, sys.stdout = sys.stdout, _watched
        _watching += 1
    before, _here.kept = getattr(_here, "kept", None), []
    try:
        yield _here.kept
    finally:
        _here.kept = before
        with _lock:
            _watching -= 1
            if _watching == 0 and sys.stdout is _watched:
                sys.stdout = _watched.plain


def set_results_apart() -> None:
    """Let what C code prints on the standard output go to the standard error: for a program, at its start.

    The decoder of HTJ2K prints its warnings there. `sys.stdout` leads where it led.
    """
    try:
        plain = os.dup(sys.stdout.fileno())
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    except (AttributeError, OSError, ValueError):  # one of them is closed, or no file
        return
    old = sys.stdout
    kept = os.fdopen(plain, "wb")
    sys.stdout = io.TextIOWrapper(
        kept, encoding=old.encoding, errors=old.errors, line_buffering=getattr(old, "line_buffering", False)
    )
