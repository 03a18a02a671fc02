"""Learning in another process: the running filter leaves its hops in shared memory and finds lessons there."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import weakref
from pathlib import Path

from edgefilter.filter.echo_path import PathState
from edgefilter.filter.learner import Heard, Lesson
from edgefilter.learning.shared import PAST, SharedHops
from edgefilter.profile.data import Profile

LEAST_CORES = 2
GOODBYE_S = 20.0
"""How long a learner's process may take to end."""


class BackgroundLearner:
    """A PathLearner in a process of low priority, for `EgoFilter(learn=...)`.

    Parameters
    ----------
    profile, remember
        As of `PathLearner`.

    Notes
    -----
    A hop costs the running filter a copy of three arrays into shared memory. Where the process falls behind by 16 s, or
    ends, the filter goes on without lessons, and `stats` says so.

    Examples
    --------
    >>> import edgefilter
    >>> learner = edgefilter.BackgroundLearner()
    >>> ego = edgefilter.EgoFilter(engine="linear", learn=learner)
    >>> learner.close()
    """

    past = PAST

    def __init__(self, profile: Profile | None = None, remember: Path | None = None) -> None:
        self._profile, self._remember = profile, remember
        self._ring: SharedHops | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, path: PathState, hop: int) -> None:
        """A stream begins: what was learned of one before is forgotten."""
        self.close()
        self._ring = SharedHops(hop, self.past)
        command = [sys.executable, "-m", "edgefilter.learning.worker", self._ring.name]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, env=environment, start_new_session=True)
        self._finalizer = weakref.finalize(self, _end, self._process, self._ring)
        send(self._process, (path, hop, self._profile, self._remember))

    def hear(self, heard: Heard) -> Lesson | None:
        """Leave the hop for the other process, and look whether a lesson has come."""
        if self._ring is None:
            return None
        self._ring.write(heard)
        return self._ring.take()

    def stats(self) -> dict[str, object]:
        """What the other process has told of itself, and whether it lives."""
        running = self._process is not None and self._process.poll() is None
        return {**(self._ring.figures() if self._ring else {}), "process": "running" if running else "ended"}

    def close(self) -> None:
        """End the other process; it writes down what it is to remember first."""
        if self._ring is not None:
            self._finalizer()
            self._process = None


def send(process: subprocess.Popen[bytes], message: object) -> None:
    """Write a message to the process, its length first."""
    data = pickle.dumps(message, protocol=5)
    assert process.stdin is not None
    process.stdin.write(struct.pack("<q", len(data)) + data)
    process.stdin.flush()


def _end(process: subprocess.Popen[bytes], ring: SharedHops) -> None:
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(GOODBYE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    ring.unlink()


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
