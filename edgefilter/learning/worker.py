"""The learner's process: hops from shared memory through a PathLearner, its lessons back.

    python -m edgefilter.learning.worker FILE

FILE is the shared memory; what to begin with comes on standard input, whose end is the end.
"""

from __future__ import annotations

import os
import pickle
import signal
import struct
import sys
import threading
import time

from edgefilter.errors import EdgefilterError
from edgefilter.learning.path_learner import PathLearner
from edgefilter.learning.shared import HOPS, PAST, SharedHops
from edgefilter.session import peak_memory_mb

NICE = 10
PAUSE_S = 0.02
"""Between two looks at the ring, about a hop."""
MARGIN = 64
"""Hops before the ring's end at which the learner has fallen behind."""


def main() -> None:
    """Run until the other side closes standard input."""
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for the filter, which then closes standard input
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(NICE)
    told = sys.stdin.buffer
    length = told.read(8)
    if len(length) < 8:
        return
    path, hop, profile, remember = pickle.loads(told.read(struct.unpack("<q", length)[0]))
    ring = SharedHops(hop, PAST, sys.argv[1])
    ring.unlink()
    over = threading.Event()

    def wait_for_the_end() -> None:
        told.read()
        over.set()

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    learner = PathLearner(profile, remember)
    learner.start(path, hop)
    at, behind = 0, 0
    while not (over.is_set() and at >= ring.written):
        if ring.written - at > HOPS - MARGIN:
            at, behind = ring.written, behind + 1
            learner.start(path, hop)
        while at < ring.written:
            lesson = learner.hear(ring.read(at))
            at += 1
            if lesson:
                ring.post(lesson)
        used = {"cpu_s": round(time.process_time(), 2), "memory_mb": peak_memory_mb()}
        ring.report({**learner.stats(), **used, "hops": at, "fell_behind": behind})
        over.wait(PAUSE_S)
    try:
        learner.close()
    except EdgefilterError as error:
        print(f"edgefilter: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
