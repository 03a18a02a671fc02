"""Those who look on while a run goes: the display, the logs, the record, and whoever acts when the human interrupts."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from edgefilter.audio.protocols import Source
from edgefilter.audio.speech import SpokenReference
from edgefilter.commands.barge_in import Availability, BargeInCommand, Lowering
from edgefilter.commands.display import display, interject, say_event
from edgefilter.commands.event_log import EventLog
from edgefilter.commands.record import Record
from edgefilter.errors import EdgefilterError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.session import Progress
from edgefilter.types import Event


class Watch:
    """Tells all of them of each block and each event, those who act first; a context manager around the run.

    notes: what the user was told before it. record: where the sound is to be kept, if anywhere.
    """

    def __init__(
        self,
        args: argparse.Namespace,
        ego: EgoFilter,
        source: Source,
        speech: SpokenReference | None,
        notes: list[str],
    ) -> None:
        self._args, self._ego, self._source, self._speech, self._notes = args, ego, source, speech, notes
        self._stack = ExitStack()
        self._hearing: list[Callable[[Event], None]] = []
        self._showing: list[Callable[[Progress], None]] = []
        self._logs: list[EventLog] = []
        self.record: Record | None = None

    def __enter__(self) -> Watch:
        args = self._args
        with ExitStack() as stack:
            if args.barge_in and self._speech:
                self._hearing.append(Lowering(self._speech, args.barge_in).hear)
            if args.on_barge_in:
                self._hearing.append(stack.enter_context(BargeInCommand(args.on_barge_in, interject)).hear)
            if args.barge_in or args.on_barge_in:
                self._showing.append(Availability(self._ego, interject).show)
            if args.record:
                self.record = Record(args.record, self._ego.profile)
                stack.enter_context(self.record)
                self._logs.append(self.record.log)
            if args.log_json:
                self._logs.append(EventLog(args.log_json))
            self._showing.append(stack.enter_context(display(self._source, self._ego, args.quiet)))
            self._stack = stack.pop_all()
        for log in self._logs:
            log.write(
                "started",
                0,
                engine=self._ego.engine_name,
                latency_ms=self._ego.stats()["latency_ms"],
                notes=self._notes,
            )
            self._hearing.append(log.hear)
        self._hearing.append(partial(say_event, live=self._source.live))
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def hear(self, event: Event) -> None:
        """An event of the filter or of the two ends."""
        for hear in self._hearing:
            hear(event)

    def show(self, progress: Progress) -> None:
        """A block has been filtered."""
        for show in self._showing:
            show(progress)

    def finish(self, figures: dict[str, object]) -> None:
        """Write what only the end knows; raises the first reason why something of it, or before, could not be written."""
        failure: EdgefilterError | None = None
        told = (
            "samples_in",
            "samples_out",
            "samples_lost",
            "interrupted",
            "failure",
            "alignment",
            "learning",
            "deadline",
        )
        for log in self._logs:
            log.write("ended", int(str(figures["samples_in"])), **{name: figures[name] for name in told})
            log.close()
            failure = failure or log.failure
        if self.record:
            self.record.finish(figures)
        if failure:
            raise failure
