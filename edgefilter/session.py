"""The main job: pull blocks from a source, filter them, push what is finished into a sink, and account for it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from edgefilter.audio.files import Recorder
from edgefilter.audio.protocols import Sink
from edgefilter.dsp.frames import decibels
from edgefilter.errors import EdgefilterError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.timing import peak_memory_mb
from edgefilter.types import SAMPLE_RATE, SET_UP_WRONG, Block, Event, EventKind, Samples, Stats

SILENT_DB = float(decibels(0.0))
"""Level of digital silence, dB of full scale."""
AUDIBLE_DB = -50.0
"""Level of the reference, dB of full scale, above which the robot counts as talking: of the residual that is shown."""


@dataclass
class Progress:
    """What a display may show after each block: samples so far, and levels of the block in dB of full scale.

    residual_db: level of the output relative to the microphone's while only the robot talks, over about the last second;
    None before. load: real-time factor over the same time. robot_s: seconds of robot speech so far.
    """

    samples: int = 0
    lost: int = 0
    mic_db: float = SILENT_DB
    ref_db: float = SILENT_DB
    out_db: float = SILENT_DB
    residual_db: float | None = None
    load: float = 0.0
    robot_s: float = 0.0
    _out_power: float = 0.0
    _mic_power: float = 0.0
    _energies: tuple[float, float] = (0.0, 0.0)

    def note(self, block: Block, out: Samples, human: bool, process_s: float) -> None:
        """Take a block and what the filter made of it in process_s seconds; human: whether a human speaks."""
        count = max(block.ref.size, 1)
        self.samples += block.ref.size
        self.lost += block.lost
        self.mic_db, self.ref_db = level_db(block.mic), level_db(block.ref)
        self.out_db = level_db(out) if out.size else self.out_db
        memory = float(np.exp(-count / SAMPLE_RATE))
        self.load += (1.0 - memory) * (process_s * SAMPLE_RATE / count - self.load)
        if self.ref_db > AUDIBLE_DB and not human and out.size:
            self._out_power += (1.0 - memory) * (10 ** (self.out_db / 10) - self._out_power)
            self._mic_power += (1.0 - memory) * (10 ** (self.mic_db / 10) - self._mic_power)
            self.residual_db = 10 * float(np.log10(self._out_power / self._mic_power))
            mic, left = self._energies
            self._energies = mic + count * 10 ** (self.mic_db / 10), left + count * 10 ** (self.out_db / 10)
        if self.ref_db > AUDIBLE_DB:
            self.robot_s += count / SAMPLE_RATE

    @property
    def lowered_db(self) -> float | None:
        """By how much the microphone was lowered while the robot talked and no human was noticed, dB; None without that."""
        mic, left = self._energies
        return float(decibels(mic) - decibels(left)) if mic else None


UNFOUND_S = 3.0
"""Seconds of a reference that carries sound after which it should have been found: of 27 real recordings whose reference is one
the slowest took 2.3 s."""


@dataclass(frozen=True)
class Verdict:
    """What a run came to.

    removed_db: by how much the robot alone was lowered, None where it was not found; lag_ms: of its voice behind the reference,
    negative where the reference came later, None where it is not known.
    noticed: how often a human was, None where the engine does not judge it. wrong: what was set up wrongly, a sentence each,
    of each kind of event the latest with its time: later on it may have come right.
    """

    removed_db: float | None
    lag_ms: float | None
    noticed: int | None
    wrong: tuple[str, ...]

    @classmethod
    def of(cls, progress: Progress, stats: Stats, noticed: int | None, wrong: list[str]) -> Verdict:
        """The verdict on a run that has ended. noticed: as of the class. wrong: the messages of its events that told of a wrong set-up."""
        alignment = stats["alignment"] or {}
        lag = alignment.get("delay_samples")
        if not wrong and alignment and lag is None and progress.robot_s >= UNFOUND_S:
            wrong = [
                f"the reference carries {progress.robot_s:.0f} s of sound, and nothing of it is found in the microphone: is it from"
                " another recording, or was the loudspeaker muted, or were headphones used?"
            ]
        lag_ms = None if lag is None else 1000 * lag / SAMPLE_RATE
        heard = not alignment or lag is not None
        return cls(progress.lowered_db if heard else None, lag_ms, noticed, tuple(wrong))


@dataclass
class RunReport:
    """What one run did; every figure measured in it. Of events it keeps the latest, without sound: a run may last for weeks."""

    samples_in: int = 0
    samples_out: int = 0
    lost: int = 0
    process_s: float = 0.0
    wall_s: float = 0.0
    interrupted: bool = False
    failure: EdgefilterError | None = None
    filter: dict[str, Any] = field(default_factory=dict)
    verdict: Verdict | None = None
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=1000))

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON."""
        seconds = self.samples_in / SAMPLE_RATE
        return {
            "schema": 1,
            "seconds": seconds,
            "samples_in": self.samples_in,
            "samples_out": self.samples_out,
            "samples_lost": self.lost,
            "process_s": self.process_s,
            "wall_s": self.wall_s,
            "real_time_factor": self.process_s / seconds if seconds else None,
            "peak_memory_mb": peak_memory_mb(),
            "interrupted": self.interrupted,
            "failure": str(self.failure) if self.failure else None,
            "verdict": asdict(self.verdict) if self.verdict else None,
            "events": [{"kind": e.kind, "seconds": e.sample / SAMPLE_RATE, "detail": e.detail} for e in self.events],
            **self.filter,
        }


def level_db(x: Samples) -> float:
    """RMS level of x (n,) in dB of full scale."""
    return float(decibels(float(np.mean(np.square(x, dtype=np.float64))))) if x.size else SILENT_DB


def filter_blocks(
    source: Iterable[Block],
    ego: EgoFilter,
    sink: Sink,
    recorder: Recorder | None = None,
    show: Callable[[Progress], None] = lambda progress: None,
    stopped: Callable[[], bool] = lambda: False,
    tell: Callable[[Event], None] = lambda event: None,
    troubles: Callable[[int, bool], list[Event]] = lambda sample, last: [],
    due: bool = True,
) -> RunReport:
    """Run ego over every block of source until it ends or stopped() says so; always flush into sink what was received.

    A source or sink that fails on the way (a device that vanished, a truncated file, a full disk) ends the run: what
    was received is filtered and flushed as far as the sink still takes it, and the error stands in report.failure.

    show: called after each block. tell: called with each event of the filter, and of source and sink by troubles(sample, last).
    due: whether somebody waits for the sound; for a recording no hop is too late, and no event says that it is.
    """
    report, progress, noticed = RunReport(), Progress(), 0
    wrong: dict[EventKind, str] = {}
    began = time.perf_counter()

    def push(out: Samples) -> None:
        sink.write(out)
        report.samples_out += out.size
        if recorder is not None:
            recorder.write_output(out)

    def tell_events(last: bool) -> None:
        nonlocal noticed
        happened = [event for event in ego.events() if due or event.kind != "overloaded"]
        for event in [*happened, *troubles(report.samples_in, last)]:
            tell(event)
            noticed += event.kind == "speech_started"
            if event.kind in SET_UP_WRONG:
                wrong[event.kind] = f"at {event.sample / SAMPLE_RATE:.1f} s {event.detail}"
            report.events.append(replace(event, turn=None, sound=None))

    try:
        for block in source:
            if recorder is not None:
                recorder.write(block)
            start = time.perf_counter()
            out = ego.process(block.mic, block.ref)
            process_s = time.perf_counter() - start
            report.process_s += process_s
            report.samples_in += block.ref.size
            report.lost += block.lost
            push(out)
            tell_events(last=False)
            progress.note(block, out, ego.human_speaks, process_s)
            show(progress)
            if stopped():
                report.interrupted = True
                break
    except EdgefilterError as error:
        report.failure = error
    try:
        push(ego.flush())
    except EdgefilterError as error:  # a sink that failed before says so again; its first word is the reason
        report.failure = report.failure or error
    tell_events(last=True)
    report.wall_s = time.perf_counter() - began
    stats = ego.stats()
    report.filter = dict(stats)
    report.verdict = Verdict.of(progress, stats, noticed if ego.judges_speech else None, [*wrong.values()])
    return report
