"""The learner's process: hops from standard input through a PathLearner, updates to standard output (see background.py)."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from typing import BinaryIO

from edgefilter.echo.user_effects import load_effect
from edgefilter.filter.echo_path import PathUpdate
from edgefilter.filter.timing import peak_memory_mb
from edgefilter.learning.background import LENGTH, TOGETHER, Beginning, News
from edgefilter.learning.path_learner import PathLearner


def main() -> None:
    """Run until the other side closes standard input."""
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for the filter, whose end ends our standard input
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a user's effect prints is no message
    try:
        learn(answers)
    except Exception as error:
        sys.exit(f"edgefilter: learning has ended: {type(error).__name__}: {' '.join(str(error).split())}")


def learn(answers: BinaryIO) -> None:
    """Take each message as it comes; at the end keep what is to be remembered."""
    learner, stream, hops = PathLearner(), 0, 0

    def tell(update: PathUpdate | None = None) -> None:
        used = {"cpu_s": round(time.process_time(), 2), "memory_mb": peak_memory_mb(), "hops": hops}
        data = pickle.dumps(News(stream, {**learner.stats(), **used}, update), protocol=5)
        answers.write(LENGTH.pack(len(data)) + data)
        answers.flush()

    while True:
        try:
            message = pickle.load(sys.stdin.buffer)
        except (EOFError, pickle.UnpicklingError):  # the end, or the middle of a message where the filter was killed
            break
        if isinstance(message, Beginning):
            for file in message.effect_files:
                load_effect(file)
            learner, stream, hops = PathLearner(message.profile, message.remember), message.stream, 0
            learner.start(message.path, message.hop)
            continue
        update = learner.observe(message)
        hops += 1
        if update or hops % TOGETHER == 0:
            tell(update)
    learner.close()
    tell()
