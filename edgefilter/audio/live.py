"""Live audio: two devices as a source of blocks, one as a sink."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from edgefilter.audio.channels import Channels
from edgefilter.audio.device import find, input_port, output_port
from edgefilter.audio.pairing import MAX_WAIT, TOLERANCE, Pairing
from edgefilter.audio.port import START_S, InputPort, SpokenReference, pause
from edgefilter.audio.protocols import Sink, Source
from edgefilter.audio.pulse import Named
from edgefilter.audio.steady import SteadyInput
from edgefilter.errors import DeviceError
from edgefilter.types import MOST_MICROPHONES, SAMPLE_RATE, Block, Samples


class LiveSource(Source):
    """Microphone and reference devices as blocks on the microphone's sample counter, until stop().

    patience_s: how long a device may be away; silence stands in meanwhile, by the clock, and it is opened again as soon
    as that can be done. Raises DeviceError, after everything received has been delivered, when a device is away for
    longer. reference None: silence. channels: those of the microphone device that are microphones, in place of
    their mean, and the one that is the reference, in place of a second device with a second clock.
    """

    live = True

    def __init__(
        self,
        mic: Named,
        reference: Named | SpokenReference = None,
        patience_s: float = 0.0,
        channels: Channels | None = None,
    ) -> None:
        self._both = channels is not None and channels.reference is not None
        self._mic = SteadyInput(_opener(mic, channels), patience_s)
        opened = self._mic.port.wanted
        self.microphones = 1 if opened is None else len(opened) - self._both
        self._reference = None if reference is None else SteadyInput(_opener(reference), patience_s)
        self._pairing, self._followed, self._drift = Pairing(), (0, 0), 0
        self.notes = [f"microphone: {self._mic.port.device}", *self._mic.port.notes]
        there = self._mic.port.device.inputs
        if opened is None and 1 < there <= MOST_MICROPHONES:
            self.notes.append(
                f"the microphone has {there} channels and is one: name those of an array, or all, with --mic-channels"
            )
        if self._reference is not None:
            how = "what is played on " if isinstance(reference, SpokenReference) else ""
            self.notes += [f"reference: {how}{self._reference.port.device}", *self._reference.port.notes]
            output, monitor, _ = self._reference.port.device.pulse_name.partition(".monitor")
            self.monitored = output if monitor else ""

    def __enter__(self) -> LiveSource:
        try:
            for each in self._inputs():
                each.open()
        except DeviceError:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        for each in self._inputs():
            each.close()
        self.notes += _incomplete("input", self.stats())

    def _inputs(self) -> list[SteadyInput]:
        """The reference first, so that it is there when the microphone starts."""
        return [self._mic] if self._reference is None else [self._reference, self._mic]

    def stats(self) -> dict[str, int]:
        """Samples at 16 kHz that were lost, filled or moved; callbacks marked as overrun; devices lost and found again.

        lost: samples of the recording that lack one or both. Each is counted once: what both devices lost, as in a machine
        that slept, and reference that never came, which is filled or inserted as silence. An overrun may hide an unknown
        number of samples.
        """
        counts = {"reference_filled": self._pairing.filled, "reference_inserted": self._pairing.inserted}
        replaced = {"microphone": 0, "reference": sum(counts.values())}
        counts["reference_dropped"] = self._pairing.skipped
        times: dict[str, int] = {}
        for name, each in (("microphone", self._mic), ("reference", self._reference)):
            counts[f"{name}_lost"] = each.lost + max(each.missed - replaced[name], 0) if each else 0
            counts[f"{name}_away"] = each.filled if each else 0
            times |= {f"{name}_{what}": getattr(each, what, 0) for what in ("overruns", "gone", "back")}
        missing = [sum(counts[key] for key in counts if key.startswith(name)) for name in replaced]
        return {"lost": max(missing), **counts, **times}

    def __iter__(self) -> Iterator[Block]:
        start = reported = 0
        failure: DeviceError | None = None
        self._synchronise()
        while not self._stopped:
            count = self._receive()
            try:
                for each in self._inputs():
                    each.check()
            except DeviceError as error:
                failure = error
                count = len(self._pairing.mic)
            if count:
                mic, ref = self._pairing.pair(count)
                before, reported = reported, self.stats()["lost"]
                yield Block(mic, ref, start, reported - before)
                start += count
            if failure is not None:
                raise failure
            if not count:
                pause()

    def _receive(self) -> int:
        """Take what came of both devices; how many samples of the microphone can be paired."""
        mic, silence = self._mic.take(), 0
        ref = np.zeros(len(mic), np.float32)
        if self._both:
            mic, ref = mic[:, :-1] if self.microphones > 1 else mic[:, 0], mic[:, -1]
        if self._reference is not None:
            before = self._reference.filled
            ref = self._reference.take()
            silence = self._reference.filled - before
        self._pairing.hear(mic)
        self._pairing.play(ref, silence)
        held = self._reference is not None and any(each.doubts for each in self._inputs())
        if self._reference is not None and not held:
            self._follow(self._reference)
        waiting = len(self._pairing.mic)
        return max(0 if held else min(waiting, self._pairing.known), waiting - MAX_WAIT)

    def _follow(self, reference: SteadyInput) -> None:
        """Keep the reference in step with the microphone, by what either of them lost and by how far their clocks have drifted."""
        drift = reference.drifted - self._mic.drifted
        if abs(drift - self._drift) > TOLERANCE:
            self._drift = drift
        now = self._mic.missed, reference.missed + self._drift
        heard, played = (new - old for new, old in zip(now, self._followed))
        self._followed, ahead = now, heard - played
        if ahead > 0:
            self._pairing.skip(ahead)
        elif heard < 0:
            self._pairing.put_back(-ahead)
        else:
            self._pairing.move(ahead)

    def _synchronise(self) -> None:
        """Wait until both devices run steadily, and begin with what arrives then: a stream may stall right after its start.

        The reference is emptied last: one that is too old would come before its echo, one that is too new only adds delay.
        """
        ports = [each.port for each in self._inputs()]
        while not self._stopped and any(port.inlet.received / port.rate < MAX_WAIT / SAMPLE_RATE for port in ports):
            for port in ports:
                port.check_alive(port.inlet.received, START_S)
            pause()
        for port in reversed(ports):
            port.take()


def _opener(
    device: Named | SpokenReference, channels: Channels | None = None
) -> Callable[[], InputPort | SpokenReference]:
    """A function that opens a device as an input, also again after it was lost; a `SpokenReference` is not opened: the same one is returned."""
    if isinstance(device, SpokenReference):
        return lambda: device
    return partial(input_port, find(device, "input"), channels=channels)


def _incomplete(what: str, stats: dict[str, int]) -> list[str]:
    """A note about the counters of what went wrong that are not zero, none where all are."""
    counts = {name: count for name, count in stats.items() if count and name not in ("lost", "written")}
    words = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())
    return [f"live {what} was not complete: {words}"] if words else []


class LiveSink(Sink):
    """A loudspeaker or virtual device that first plays `latency` samples of silence, so that sound lags the input evenly.

    Two callbacks of 20 ms more of silence come before it as a reserve against jitter. wait: hold the writer up when
    enough is queued (right for a file as source); otherwise, with a live source, what is too much is dropped and
    counted: more than a source holds back at most while it waits for the reference, and delivers at once. An underrun
    plays silence, is counted, and ends when the reserve is there again. Raises DeviceError when the device stops.
    """

    def __init__(self, device: Named, latency: int = 0, wait: bool = True) -> None:
        self._port = output_port(device, latency, 2 * TOLERANCE / SAMPLE_RATE)
        self._lead = round(latency * self._port.rate / SAMPLE_RATE) + self._port.margin
        self._most = self._lead + round((MAX_WAIT + TOLERANCE) / SAMPLE_RATE * self._port.rate)
        self._wait, self._open = wait, False
        self.notes = [f"output: {self._port.device}", *self._port.notes]
        self.dropped = 0

    def __enter__(self) -> LiveSink:
        self._port.outlet.ring.write(np.zeros(self._lead, np.float32))
        return self

    def write(self, samples: Samples) -> None:
        """Queue samples (n,); the device starts with the first ones."""
        loud = int(np.count_nonzero(np.abs(samples) > 1.0))
        self.clipped += loud
        self._queue(self._port.convert(np.clip(samples, -1.0, 1.0) if loud else samples))
        self.written += samples.size
        if not self._open and samples.size:
            self._port.open()
            self._open = True
        if self._open:
            self._port.check_alive(self._port.outlet.calls, START_S)

    def _queue(self, data: Samples) -> None:
        ring = self._port.outlet.ring
        piece = self._port.rate // 10
        for at in range(0, data.size, piece):
            if self._wait and self._open:
                self._port.wait_until(self._most)
            elif len(ring) > self._most:
                self.dropped += data.size - at
                return
            ring.write(data[at : at + piece])

    def stats(self) -> dict[str, int]:
        """Samples written (16 kHz), clipped; dropped, missing (at the device's rate); underruns: callbacks with too little."""
        outlet = self._port.outlet
        lost = {"missing": outlet.missing, "dropped": self.dropped + outlet.ring.lost}
        return {**super().stats(), "underruns": max(outlet.underruns, self._port.flags), **lost}

    def __exit__(self, *exc: object) -> None:
        try:
            if exc[0] is None and self._open:
                self._port.outlet.draining = True
                self._queue(self._port.convert(np.zeros(0, np.float32), last=True))
                self._port.wait_until(0)
        finally:
            self._port.close(drain=exc[0] is None)
            self.notes += _incomplete("output", self.stats())
