"""Memory that the running filter and the learner's process share: a ring of hops there, lessons back, no lock, no waiting.

One side writes a place and then counts it, the other reads the count and then the place; neither ever waits.
"""

from __future__ import annotations

import json
import os
import pickle
import tempfile
from pathlib import Path

import numpy as np

from edgefilter.filter.learner import Heard, Lesson
from edgefilter.types import SAMPLE_RATE

HOPS = 1024
"""Hops that the ring holds, 16 s: longer than a fit takes beside a busy filter."""
PAST = SAMPLE_RATE
"""Samples of the aligned reference that a learner wants after a switch of the delay."""
SWITCHES = 16
"""Of the latest hops in which the delay was switched, the ring holds the past under the new one."""
LETTER = 1 << 21
"""Bytes of a lesson at most, 2 MiB."""
REPORT = 4096
"""Bytes of the learner's own figures."""
FIELDS = ("written", "posted", "length", "taken", "reported", "report_length")


class SharedHops:
    """The ring, in a file that both processes map. hop: samples. past: samples of Heard.past.

    The one who creates it gives no name; the other opens it by that of the first.
    """

    def __init__(self, hop: int, past: int, name: str | None = None) -> None:
        self._hop, self._past = hop, past
        layout = {
            "count": ((len(FIELDS),), np.int64),
            "sound": ((HOPS, 3, hop), np.float32),
            "delay": ((HOPS,), np.float64),
            "located": ((HOPS, 2), np.uint8),
            "switched": ((SWITCHES,), np.int64),
            "past": ((SWITCHES, past), np.float32),
            "letter": ((LETTER,), np.uint8),
            "report": ((REPORT,), np.uint8),
        }
        starts = np.cumsum(
            [0] + [-(-int(np.prod(shape)) * np.dtype(kind).itemsize // 64) * 64 for shape, kind in layout.values()]
        )
        if name is None:
            handle, name = tempfile.mkstemp(prefix="edgefilter-", dir=memory_folder())
            os.truncate(handle, int(starts[-1]))
            os.close(handle)
        self.name = name
        whole = np.memmap(name, np.uint8, "r+", shape=(int(starts[-1]),))
        self._part = {
            field: whole[start : start + int(np.prod(shape)) * np.dtype(kind).itemsize].view(kind).reshape(shape)
            for start, (field, (shape, kind)) in zip(starts, layout.items(), strict=False)
        }
        self._count = self._part["count"]
        if not self._count[0]:
            self._part["switched"][:] = -1

    def unlink(self) -> None:
        """Take the name away; both sides keep the memory."""
        Path(self.name).unlink(missing_ok=True)

    @property
    def written(self) -> int:
        """Hops so far."""
        return int(self._count[0])

    def write(self, heard: Heard) -> None:
        """Append a hop."""
        at = int(self._count[0])
        place = at % HOPS
        sound = self._part["sound"][place]
        sound[0], sound[1], sound[2] = heard.mic, heard.reference, heard.innovation
        self._part["delay"][place] = heard.delay
        self._part["located"][place] = heard.located, heard.idle
        if heard.past is not None:
            slot = int(np.argmin(self._part["switched"]))
            self._part["past"][slot] = heard.past[-self._past :]
            self._part["switched"][slot] = at
        self._count[0] = at + 1

    def read(self, at: int) -> Heard:
        """Hop number `at`, of the latest HOPS; the arrays are copies."""
        place = at % HOPS
        mic, reference, innovation = self._part["sound"][place].copy()
        slot = np.flatnonzero(self._part["switched"] == at)
        past = self._part["past"][int(slot[0])].copy() if slot.size else None
        located, idle = map(bool, self._part["located"][place])
        return Heard(mic, reference, innovation, located, idle, past, float(self._part["delay"][place]))

    def post(self, lesson: Lesson) -> None:
        """Lay a lesson down; one that was not taken yet is replaced."""
        data = np.frombuffer(pickle.dumps(lesson, protocol=5), np.uint8)
        if data.size > LETTER:
            return
        self._count[2] = 0  # whoever looks now finds nothing
        self._part["letter"][: data.size] = data
        self._count[2] = data.size
        self._count[1] += 1

    def take(self) -> Lesson | None:
        """The lesson that came since the last one was taken."""
        count = self._count
        posted, length = int(count[1]), int(count[2])
        if posted == count[3] or not length:
            return None
        count[3] = posted
        return pickle.loads(self._part["letter"][:length].tobytes())

    def report(self, figures: dict[str, object]) -> None:
        """Lay the learner's figures down."""
        data = np.frombuffer(json.dumps(figures).encode(), np.uint8)[:REPORT]
        self._count[5] = 0
        self._part["report"][: data.size] = data
        self._count[5] = data.size

    def figures(self) -> dict[str, object]:
        """The learner's latest figures."""
        length = int(self._count[5])
        try:
            return json.loads(self._part["report"][:length].tobytes()) if length else {}
        except ValueError:  # they are being written at this moment
            return {}


def memory_folder() -> str | None:
    """Where files are memory, on Linux; elsewhere wherever temporary files are."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
