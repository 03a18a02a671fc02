"""SIGINT and SIGTERM, which are one request: to end in good order."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TWICE_S = 0.5
"""Seconds after which a second signal counts: timeout(1) signals a program and its group, which is one request."""


@contextmanager
def on_signal(end: Callable[[], None]) -> Iterator[list[int]]:
    """The first SIGINT or SIGTERM calls end; the list then holds it. A later one raises KeyboardInterrupt.

    Python hands signals to the main thread alone: in another one nothing changes.
    """
    caught: list[int] = []
    first_at = 0.0
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def handle(number: int, _frame: object) -> None:
        nonlocal first_at
        if not caught:
            first_at = time.monotonic()
            caught.append(number)
            end()
        elif time.monotonic() - first_at > TWICE_S:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
