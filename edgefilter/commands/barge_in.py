"""What a run does when the human interrupts: a command, the robot's speech stopped or lowered."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable

from edgefilter.audio.speech import SpokenReference
from edgefilter.filter.barge_in import INTERRUPTIONS
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import Progress
from edgefilter.types import SAMPLE_RATE, Event

LOWERED = {"stop": 0.0, "duck": 10 ** (-10 / 20)}
"""Gain of the robot's speech while the human speaks, by the word of --barge-in."""
PATIENCE_S = 2.0
"""How long a command may still run when the run has ended."""
MOST_AT_ONCE = 8
"""Commands that may run at the same time: those that never end must not fill the machine."""


class BargeInCommand:
    """Runs a shell command at each interruption, in a thread of its own, so that the sound does not wait for it.

    The command finds what happened in EDGEFILTER_EVENT, EDGEFILTER_TIME (seconds of the microphone) and
    EDGEFILTER_DETAIL. Its standard input is empty, and what it prints goes to standard error. Whatever goes wrong is
    one line, given to say, and the run goes on.
    """

    def __init__(self, command: str, say: Callable[[str], None]) -> None:
        self._command, self._say = command, say
        self._threads: list[threading.Thread] = []
        self._running: set[subprocess.Popen[bytes]] = set()

    def __enter__(self) -> BargeInCommand:
        return self

    def hear(self, event: Event) -> None:
        """Start the command if the event is an interruption."""
        if event.kind not in INTERRUPTIONS:
            return
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        if len(self._threads) >= MOST_AT_ONCE:
            self._complain(f"not run, {MOST_AT_ONCE} earlier ones have not ended")
            return
        thread = threading.Thread(target=self._run, args=(event,), daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # the system has no thread left
            self._complain(f"cannot be run ({error})")
        else:
            self._threads.append(thread)

    def _run(self, event: Event) -> None:
        told = {"EVENT": event.kind, "TIME": f"{event.sample / SAMPLE_RATE:.3f}", "DETAIL": event.detail}
        environment = {**os.environ, **{f"EDGEFILTER_{name}": value for name, value in told.items()}}
        try:
            process = subprocess.Popen(
                self._command, shell=True, stdin=subprocess.DEVNULL, stdout=2, env=environment, start_new_session=True
            )
        except (OSError, ValueError) as error:
            self._complain(f"cannot be run ({error})")
            return
        self._running.add(process)
        code = process.wait()
        self._running.discard(process)
        if code:
            self._complain(f"ended with {code}")

    def _complain(self, what: str) -> None:
        self._say(f"--on-barge-in: {what}: {self._command}")

    def __exit__(self, *exc: object) -> None:
        """Wait a little for the commands that still run, then end them."""
        until = time.monotonic() + PATIENCE_S
        for thread in self._threads:
            thread.join(max(until - time.monotonic(), 0.0))
        for process in list(self._running):
            self._complain(f"killed, since it ran {PATIENCE_S:.0f} s longer than the filter")
            if hasattr(os, "killpg"):  # the shell's children, too; start_new_session made it the first of its group
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


class Lowering:
    """Ends the robot's speech at an interruption, or lowers it by 10 dB for as long as the human speaks.

    how: a word of LOWERED.
    """

    def __init__(self, speech: SpokenReference, how: str) -> None:
        self._speech, self._how = speech, how

    def hear(self, event: Event) -> None:
        """Take an event of the filter."""
        if event.kind in INTERRUPTIONS:
            self._speech.fade(LOWERED[self._how])
        elif event.kind == "speech_stopped" and self._how == "duck":
            self._speech.fade(1.0)


class Availability:
    """Says, each time it begins, that the engine at work tells no speech probability, so that no human is noticed."""

    def __init__(self, ego: EgoFilter, say: Callable[[str], None]) -> None:
        self._ego, self._say, self._there = ego, say, True

    def show(self, block: Progress) -> None:
        """Look after a block."""
        there = self._ego.speech_probability is not None or block.samples < self._ego.hop
        if self._there and not there:
            self._say(
                f"barge-in is unavailable: engine {self._ego.engine_name} does not tell whether somebody speaks; take"
                " another with --engine"
            )
        self._there = there
