"""Minutes live over virtual devices while everything happens that happens to a robot: what was noticed, lost and understood.

A day of bench/simulate/robot_day.py (a robot that is carried from room to room, turned down, and gets a clock and a lag
of its own) is what two virtual devices give, loopback and microphone, each on a private sound server, and
`edgefilter run` listens to them with a calibration of its first room. Meanwhile the microphone is pulled out and put
back, and other programs take every core. The figures: events, samples by what befell them, hops that came late, and word
errors of each interruption, by what was going on.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench import provenance, results
from bench.cache import Cache
from bench.live import virtual_sound
from bench.live.soak import late
from bench.metrics import IN_TIME_S, first_sound
from bench.recogniser import Recogniser, word_errors
from bench.recordings import read
from bench.simulate.conversations import read_clips
from bench.simulate.robot_day import Day, make_day
from edgefilter.calibration.calibrate import calibrate
from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE, Samples

CLIP_S = (1.0, 15.0)
UNPLUGGED_AT, UNPLUGGED_S = 0.42, 6.0
"""When the microphone goes, as a part of the whole, and for how long."""
BUSY_AT, BUSY_UNTIL, BUSY_PER_CORE = 0.6, 0.7, 2
"""When, as parts of the whole, other programs compute, and how many."""
PIECE_S = 0.01
"""Of sound, that is handed to a device at once."""
AFTER_S = 3.0
"""Sound that is played before the filter is given up on."""
FOUND_WITHIN_S = 10.0
"""How far a sentence may lie from where it is looked for in what was recorded."""
SOUNDS = ("human alone", "microphone", "output")
OFTEN = 12
"""Events of a kind that comes more often are counted only."""


@dataclass(frozen=True)
class Mishap:
    """What happened, and from when to when, seconds on the recording's clock before anything is lost."""

    name: str
    begin_s: float
    end_s: float


class Device:
    """A microphone that gives a recording as the clock goes on, on a sound server of its own, which can go and come back.

    Silence until it is told when the recording begins. A writer that comes too late makes up for it: a busy machine
    delays what is given and loses none of it, as with a sound card.
    """

    def __init__(self, name: str, samples: Samples) -> None:
        self._name = name
        self._samples = np.round(32767 * samples).astype("<i2")
        self._folder = Path(tempfile.mkdtemp(prefix="pulse"))
        self._begins: int | None = None
        self.plug_in()

    def play(self, at_s: float) -> None:
        """From that moment of time.monotonic() on."""
        self._begins = round(at_s * SAMPLE_RATE)

    def plug_in(self) -> None:
        self.server = virtual_sound.start_server(self._folder, (), (self._name,))
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()

    def unplug(self) -> None:
        """The device is gone, and what it would have given."""
        self.server.stop()
        self._writer.join()

    def _write(self) -> None:
        with suppress(BrokenPipeError), open(self._folder / self._name, "wb", buffering=0) as pipe:
            done = round(time.monotonic() * SAMPLE_RATE)
            while True:
                now = round(time.monotonic() * SAMPLE_RATE)
                pipe.write(self._between(done, now).tobytes())
                done = now
                time.sleep(PIECE_S)

    def _between(self, first: int, last: int) -> np.ndarray:
        """What it gives between two samples of the clock, silence where the recording has nothing."""
        given = np.zeros(last - first, "<i2")
        if self._begins is not None:
            before = max(self._begins - first, 0)
            piece = self._samples[max(first - self._begins, 0) : max(last - self._begins, 0)]
            given[before : before + piece.size] = piece
        return given

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *exc: object) -> None:
        self.unplug()
        shutil.rmtree(self._folder, ignore_errors=True)


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """So many programs that only compute, of another session: Linux shares the cores out by sessions first."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def live(day: Day, engine: str, folder: Path) -> list[Mishap]:
    """Play the day to `edgefilter run`, which records into FOLDER/kept, and do to it what is to be done."""
    calibrate(*day.calibration).save(folder / "profile.npz")
    seconds = day.mic.size / SAMPLE_RATE
    command = [sys.executable, "-m", "edgefilter.cli", "run", "--input", "robot_mic", "--reference", "loopback"]
    command += ["--engine", engine, "--profile", folder / "profile.npz", "--record", folder / "kept", "--quiet"]
    command += ["--output", folder / "out.wav", "--json", folder / "stats.json", "--seconds", round(seconds + AFTER_S)]
    with Device("loopback", day.ref) as loopback, Device("robot_mic", day.mic) as microphone:
        loopback.server.add(microphone.server)
        environment = loopback.server.environment
        process = subprocess.Popen(list(map(str, command)), env=environment, stderr=subprocess.PIPE, text=True)
        try:
            while not (folder / "kept/mic.wav").exists() and process.poll() is None:
                time.sleep(0.05)
            began = time.monotonic()
            for device in (loopback, microphone):
                device.play(began)
            happened = mishaps(microphone, began, seconds)
            said = process.communicate()[1]
            if process.returncode:
                raise UsageError(f"edgefilter run failed: {said}")
            return happened
        finally:
            process.kill()


def mishaps(microphone: Device, began: float, seconds: float) -> list[Mishap]:
    """The microphone away for a while, then every core busy for a while."""

    def wait(until_s: float) -> float:
        time.sleep(max(0.0, began + until_s - time.monotonic()))
        return time.monotonic() - began

    gone = wait(UNPLUGGED_AT * seconds)
    microphone.unplug()
    wait(gone + UNPLUGGED_S)
    microphone.plug_in()
    back = time.monotonic() - began
    busy = wait(BUSY_AT * seconds)
    with busy_cores(BUSY_PER_CORE * (os.cpu_count() or 1)):
        free = wait(BUSY_UNTIL * seconds)
    return [Mishap("microphone away", gone, back), Mishap("cores busy", busy, free)]


def located(sound: Samples, mic: Samples, about: int) -> int:
    """Where in mic (n,) a sound (m,) begins, near sample `about`; by whitened cross-correlation."""
    reach = round(FOUND_WITHIN_S * SAMPLE_RATE)
    first = max(0, about - reach)
    part = mic[first : about + sound.size + reach]
    size = part.size + sound.size
    spectrum = np.fft.rfft(part, size) * np.conj(np.fft.rfft(sound, size))
    whitened = spectrum / (np.abs(spectrum) + 1e-3 * np.abs(spectrum).mean())
    return first + int(np.argmax(np.fft.irfft(whitened, size)[: part.size]))


def sentences(
    day: Day, folder: Path, events: Sequence[Mapping], happened: Sequence[Mishap], recogniser: Recogniser | None
) -> list[dict]:
    """Each interruption: when, during what, when it was noticed, and words wrong in the microphone and in the output."""
    mic, out = (read(folder / f"kept/{name}.wav") for name in ("mic", "output"))
    starts = [event["time"] for event in events if event["kind"] == "speech_started"]
    found, moved = [], 0
    for text, place in day.told:
        begin_s, end_s = place.start / SAMPLE_RATE, place.stop / SAMPLE_RATE
        at = located(day.mic[place], mic, place.start + moved)
        moved = at - place.start
        onset = (at + first_sound(day.clean[place])) / SAMPLE_RATE
        noticed = min((time_s - onset for time_s in starts if time_s >= onset - 0.1), default=None)
        during = [m.name for m in happened if m.begin_s < end_s and begin_s < m.end_s]
        stage = day.stages[int(np.searchsorted(day.begins, place.start, "right")) - 1]
        row = {"begin_s": begin_s, "text": text, "during": ", ".join(during) or stage, "noticed_s": noticed}
        if recogniser:
            row["recognised"] = recogniser.transcribe(out[at : at + place.stop - place.start])
            said = (recogniser.transcribe(day.clean[place]), recogniser.transcribe(day.mic[place]), row["recognised"])
            row["wrong"] = {name: word_errors(text, words).capped for name, words in zip(SOUNDS, said, strict=True)}
            row["words"] = word_errors(text, "").words
        found.append(row)
    return found


def run(options: argparse.Namespace) -> str:
    engine = options.engine or "auto"
    data = {"ROBOT": options.voices, "HUMAN": [options.speech]}
    made_with = provenance.stamp(data, [engine], {"WHISPER": options.whisper})
    clips = [clip for folder in options.voices for clip in read_clips(folder, CLIP_S)]
    day = make_day(options.seed, options.minutes, clips, read_clips(options.speech, CLIP_S))
    recogniser = Recogniser(options.whisper, Cache(options.cache)) if options.whisper else None
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        happened = live(day, engine, folder)
        stats = json.loads((folder / "stats.json").read_text())
        if stats.get("model"):
            stats["model"]["file"] = Path(stats["model"]["file"]).name
        events = [json.loads(line) for line in (folder / "kept/events.jsonl").read_text().splitlines()]
        told = sentences(day, folder, events, happened, recogniser)
    doings = [(at / SAMPLE_RATE, stage) for stage, at in zip(day.stages, day.begins, strict=True)]
    doings += [(m.begin_s, f"{m.name}, {m.end_s - m.begin_s:.0f} s") for m in happened]
    found = {"load_average": load, "doings": sorted(doings), "stats": stats, "events": events, "sentences": told}
    title = f"Live: {day.mic.size / SAMPLE_RATE / 60:.0f} minutes over virtual devices, with mishaps"
    notes = f"Load average before {load:.1f}. A simulated robot, given in real time by loopback and microphone of private sound servers."
    return results.write(options.output, "trial", title, made_with, tables(found), notes=notes, **found)


def tables(found: Mapping) -> list[dict]:
    """What was done, what the run counted, words by what was going on, every interruption, other events."""
    stats, told = found["stats"], found["sentences"]
    counts = [["samples in, out", f"{stats['samples_in']}, {stats['samples_out']}"]]
    counts += [[key.replace("_", " "), value] for key, value in stats["source"].items() if value]
    counts += [*map(list, late(stats["deadline"]).items()), ["engine at the end", stats["engine"]]]
    kept = [event for event in found["events"] if not event["kind"].startswith("speech")]
    often = Counter(event["kind"] for event in kept)
    rare = [[clock(e["time"]), e["kind"], e.get("detail", "")] for e in kept if often[e["kind"]] <= OFTEN]
    rare += [[f"{count} times", kind, ""] for kind, count in often.items() if count > OFTEN]
    names = [*dict.fromkeys(one["during"] for one in told), "all"]
    wrong = [(f"{sound}, words wrong, %", 0) for sound in SOUNDS]
    each = [[clock(one["begin_s"]), *map(one.get, ("noticed_s", "during", "text", "recognised"))] for one in told]
    return [
        results.table("trial-done", "What was done to it", ["at", "what"], [[clock(at), what] for at, what in found["doings"]]),
        results.table("trial-counts", "What the run counted", ["", ""], counts),
        results.table("trial", "The human, by what was going on",
                      ["during", "interruptions", f"noticed within {IN_TIME_S:g} s", *wrong],
                      [_by(name, [one for one in told if name in ("all", one["during"])]) for name in names]),
        results.table("trial-sentences", "Every interruption",
                      ["at", ("noticed after, s", 2), "during", "said", "recognised"], each),
        results.table("trial-events", "Events, those of speech left out", ["at", "event", ""], rare),
    ]  # fmt: skip


def _by(name: str, told: Sequence[Mapping]) -> list:
    """A row: how many, how many noticed in time, and words wrong, each sentence weighing as many words as it has."""
    soon = sum(one["noticed_s"] is not None and one["noticed_s"] <= IN_TIME_S for one in told)
    known = [one for one in told if "wrong" in one]
    words = [one["words"] for one in known]
    errors = ([one["wrong"][sound] for one in known] for sound in SOUNDS)
    wrong = [100 * float(np.average(of, weights=words)) if known else None for of in errors]
    return [name, len(told), f"{soon} of {len(told)}", *wrong]


def clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{seconds % 60:04.1f}"
