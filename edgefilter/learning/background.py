"""Learning in another process: the running filter sends its hops there and takes the updates that come back."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import weakref
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from edgefilter.echo.user_effects import loaded_files
from edgefilter.filter.echo_path import FilteredHop, PathState, PathUpdate
from edgefilter.learning.history import NOTHING_LEARNED, RECENT_S
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE

GOODBYE_S = 20.0
"""How long a learner's process may take to end, s: a fit and the writing of a file, on a slow machine."""
TOGETHER = 16
"""Hops that are sent at once, and news that come after as many: the other process wakes four times a second, and not at each hop."""
LENGTH = struct.Struct("<q")
"""Before each message of the learner's process: its bytes."""


class Beginning(NamedTuple):
    """To the learner's process: a stream begins. What comes back of it bears its number. effect_files: of the user's own effects."""

    stream: int
    path: PathState
    hop: int
    profile: Profile | None
    remember: Path | None
    effect_files: tuple[Path, ...]


class News(NamedTuple):
    """From the learner's process: what it says of itself, and a update where there is one."""

    stream: int
    stats: dict[str, object]
    update: PathUpdate | None


class BackgroundLearner:
    """A PathLearner in a process of low priority, for `EgoFilter(learn=...)`.

    Parameters
    ----------
    profile, remember
        As of `PathLearner`.

    Notes
    -----
    A hop costs the running filter a copy of three arrays; a quarter of a second of them go into a pipe at once, and it
    never waits. Where the other process falls behind by 15 s, it begins anew; where it ends, or cannot be started, the
    filter goes on without updates. `stats` tells of both.

    Examples
    --------
    >>> import edgefilter
    >>> learner = edgefilter.BackgroundLearner()
    >>> ego = edgefilter.EgoFilter(engine="linear", learn=learner)
    >>> learner.close()
    """

    def __init__(self, profile: Profile | None = None, remember: Path | None = None) -> None:
        self._profile, self._remember = profile, remember
        self._worker: _Worker | None = None
        self._update: PathUpdate | None = None
        self._stats: dict[str, object] = dict(NOTHING_LEARNED)
        self._stream = 0

    @property
    def pid(self) -> int | None:
        """Of the other process; None where there is none."""
        return self._worker.process.pid if self._worker else None

    def start(self, path: PathState, hop: int) -> None:
        """A stream begins: what was learned of one before is forgotten."""
        self.close()
        self._path, self._hop, self._stream = path, hop, 0
        self._stats = dict(NOTHING_LEARNED)
        with suppress(OSError):  # no memory for another process, or no interpreter: the filter goes on without
            self._worker = _Worker()
            self._finalizer = weakref.finalize(self, self._worker.end)
            self._begin()

    def observe(self, hop: FilteredHop) -> PathUpdate | None:
        """Send hops to the other process, some together, and look whether a update has come."""
        if self._worker is None:
            return None
        if len(self._worker.unsent) > RECENT_S * SAMPLE_RATE / self._hop:
            self._worker.forget()
            self._stream += 1
            self._begin()
        self._worker.send(hop)
        if len(self._worker.unsent) >= TOGETHER:
            self._take(self._worker.exchange())
        update, self._update = self._update, None
        return update

    def stats(self) -> dict[str, object]:
        """What the other process has told of itself, and whether it lives."""
        if self._worker:
            self._take(self._worker.exchange())
        running = self._worker is not None and self._worker.process.poll() is None
        return {**self._stats, "fell_behind": self._stream, "process": "running" if running else "ended"}

    def close(self) -> None:
        """End the other process; it writes down what it is to remember first."""
        if self._worker:
            self._finalizer.detach()
            self._take(self._worker.end())
            self._worker = self._update = None

    def _begin(self) -> None:
        assert self._worker is not None
        beginning = Beginning(self._stream, self._path, self._hop, self._profile, self._remember, loaded_files())
        self._worker.send(beginning)

    def _take(self, all_news: list[News]) -> None:
        for news in all_news:
            if news.stream == self._stream:
                self._stats, self._update = news.stats, news.update or self._update
                self._path = news.update.path if news.update else self._path


class _Worker:
    """The learner's process and the pipes to it, for which nobody ever waits but at the end. unsent: messages, or the rest of one."""

    def __init__(self) -> None:
        # what this process imports from but the working directory, where anybody's numpy.py may lie; -m would look there
        path = [*filter(None, sys.path), str(Path(__file__).parents[2])]
        code = f"import sys; sys.path[:] = {path!r}; from edgefilter.learning.worker import main; main()"
        more = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        more["MALLOC_MMAP_THRESHOLD_"] = "262144"  # glibc: what a fit took goes back to the system after it
        self.process = subprocess.Popen(
            [sys.executable, "-c", code],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **more},
            start_new_session=True,
        )
        assert self.process.stdin is not None and self.process.stdout is not None
        self._to, self._from = self.process.stdin, self.process.stdout
        for pipe in (self._to, self._from):
            os.set_blocking(pipe.fileno(), False)
        self.unsent: deque[memoryview] = deque()
        self._received = bytearray()

    def send(self, message: Beginning | FilteredHop) -> None:
        """Queue a message for the next exchange."""
        self.unsent.append(memoryview(pickle.dumps(message, protocol=5)))

    def forget(self) -> None:
        """Drop all that is queued but the first message, of which a part may be written already."""
        while len(self.unsent) > 1:
            self.unsent.pop()

    def exchange(self) -> list[News]:
        """Write as much of the queue as the pipe takes; return the messages that have come, each as a whole."""
        try:
            while self.unsent and (written := self._to.write(self.unsent[0])):
                self.unsent[0] = self.unsent[0][written:]
                if not self.unsent[0]:
                    self.unsent.popleft()
            while data := self._from.read(1 << 16):
                self._received += data
        except OSError:  # the process has ended
            self.process.poll()  # which else would stay in the system's table as one that nobody has asked about
            self.unsent.clear()
        return self._whole()

    def end(self) -> list[News]:
        """Close the pipe, which ends the process, and return its last messages."""
        try:
            self._received += self.process.communicate(b"".join(self.unsent), GOODBYE_S)[0]
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
        self.unsent.clear()
        return self._whole()

    def _whole(self) -> list[News]:
        found = []
        while len(self._received) >= LENGTH.size:
            stop = LENGTH.size + LENGTH.unpack_from(self._received)[0]
            if len(self._received) < stop:
                break
            found.append(pickle.loads(self._received[LENGTH.size : stop]))
            del self._received[:stop]
        return found
