r"""Minutes live over virtual devices while everything happens that happens to a robot: what was noticed, lost and heard.

    OMP_NUM_THREADS=1 python -m bench.measure.live_trial --voices ROBOT/test --speech HUMAN/test --whisper WHISPER \
        --output bench/results/live_trial                                               (needs PulseAudio)

A day of `bench.simulate.robot_day` (a robot that is carried from room to room, turned down, and gets a clock and a lag of
its own) is what two virtual devices hear, loopback and microphone, each on a private sound server, and `edgefilter run`
listens to them with a calibration of its first room. Meanwhile the microphone is pulled out and put back, and other
programs take every core. The figures: the event log, samples by what befell them, hops that came late, and word errors
of each interruption, by what was going on.
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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile

from bench import results_writer
from bench.measure import live_trial_report, virtual_sound
from bench.measure.real_barge_in import first_sound
from bench.measure.recogniser import Recogniser, word_errors
from bench.simulate.conversations import read_clips
from bench.simulate.robot_day import Day, make_day
from edgefilter.calibration.calibrate import calibrate
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE, Samples

CLIP_S = (1.0, 15.0)
UNPLUGGED_AT, UNPLUGGED_S = 0.42, 6.0
"""When the microphone goes, as a part of the whole, and for how long."""
HOG_AT, HOG_UNTIL, HOGS_PER_CORE = 0.6, 0.7, 2
PIECE_S = 0.01
"""Of sound, that is handed to a device at once."""
AFTER_S = 3.0
"""Sound that is played before the filter is given up on."""
FOUND_WITHIN_S = 10.0
"""How far a sentence may lie from where it is looked for in what was recorded."""


@dataclass(frozen=True)
class Mishap:
    """What happened, and from when to when, seconds on the recording's clock before anything is lost."""

    name: str
    begin_s: float
    end_s: float


class Device:
    """A microphone that hears a recording as the clock goes on, on a sound server of its own, which can go and come back.

    Silence until it is told when the recording begins. A writer that comes too late makes up for it: a busy machine
    delays what is heard and loses none of it, as with a sound card.
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
        """The device is gone, and what it would have heard."""
        self.server.stop()
        self._writer.join()

    def _write(self) -> None:
        with suppress(BrokenPipeError), open(self._folder / self._name, "wb", buffering=0) as pipe:
            done = round(time.monotonic() * SAMPLE_RATE)
            while True:
                now = round(time.monotonic() * SAMPLE_RATE)
                pipe.write(self._heard(done, now).tobytes())
                done = now
                time.sleep(PIECE_S)

    def _heard(self, first: int, last: int) -> np.ndarray:
        """What is heard between two samples of the clock, silence where the recording has nothing."""
        heard = np.zeros(last - first, "<i2")
        if self._begins is not None:
            before = max(self._begins - first, 0)
            piece = self._samples[max(first - self._begins, 0) : max(last - self._begins, 0)]
            heard[before : before + piece.size] = piece
        return heard

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *exc: object) -> None:
        self.unplug()
        shutil.rmtree(self._folder, ignore_errors=True)


@contextmanager
def hogs(count: int) -> Iterator[None]:
    """So many programs that only compute, of another session: Linux shares the cores out by sessions first."""
    command = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def live(day: Day, engine: str, folder: Path) -> list[Mishap]:
    """Play the day to `edgefilter run`, which records into FOLDER/kept, and do to it what is to be done."""
    calibrate(*day.calibration).save(folder / "profile.npz")
    seconds = day.mic.size / SAMPLE_RATE
    command = [sys.executable, "-m", "edgefilter.cli", "run", "--input", "robot_mic", "--reference", "loopback"]
    command += ["--engine", engine]
    command += ["--profile", str(folder / "profile.npz"), "--record", str(folder / "kept"), "--quiet"]
    command += ["--output", str(folder / "out.wav"), "--json", str(folder / "stats.json")]
    command += ["--seconds", f"{seconds + AFTER_S:.0f}"]
    with Device("loopback", day.ref) as loopback, Device("robot_mic", day.mic) as microphone:
        loopback.server.add(microphone.server)
        run = subprocess.Popen(command, env=loopback.server.environment, stderr=subprocess.PIPE, text=True)
        try:
            while not (folder / "kept/mic.wav").exists() and run.poll() is None:
                time.sleep(0.05)
            began = time.monotonic()
            for device in (loopback, microphone):
                device.play(began)
            happened = mishaps(microphone, began, seconds)
            said = run.communicate()[1]
            if run.returncode:
                raise SystemExit(f"{' '.join(command)} failed: {said}")
            return happened
        finally:
            run.kill()


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
    busy = wait(HOG_AT * seconds)
    with hogs(HOGS_PER_CORE * (os.cpu_count() or 1)):
        free = wait(HOG_UNTIL * seconds)
    return [Mishap("microphone away", gone, back), Mishap("cores busy", busy, free)]


def located(clean: Samples, mic: Samples, about: int) -> int:
    """Where in mic (n,) the sound clean (m,) begins, near sample `about`; by cross-correlation."""
    reach = round(FOUND_WITHIN_S * SAMPLE_RATE)
    first = max(0, about - reach)
    part = mic[first : about + clean.size + reach]
    size = part.size + clean.size
    spectrum = np.fft.rfft(part, size) * np.conj(np.fft.rfft(clean, size))
    whitened = spectrum / (np.abs(spectrum) + 1e-3 * np.abs(spectrum).mean())
    return first + int(np.argmax(np.fft.irfft(whitened, size)[: part.size]))


def sentences(day: Day, folder: Path, happened: list[Mishap], recogniser: Recogniser | None) -> list[dict]:
    """Each interruption: when, during what, when it was noticed, and words wrong in the microphone and in the output."""
    mic, out = (soundfile.read(folder / f"kept/{name}.wav", dtype="float32")[0] for name in ("mic", "output"))
    events = [json.loads(line) for line in (folder / "kept/events.jsonl").read_text().splitlines()]
    starts = [event["time"] for event in events if event["kind"] == "speech_started"]
    found, moved = [], 0
    for text, place in day.told:
        begin_s = place.start / SAMPLE_RATE
        at = located(day.mic[place], mic, place.start + moved)
        moved = at - place.start
        onset = (at + first_sound(day.clean[place])) / SAMPLE_RATE
        noticed = min((time_s - onset for time_s in starts if time_s >= onset - 0.1), default=None)
        during = [m.name for m in happened if m.begin_s < place.stop / SAMPLE_RATE and begin_s < m.end_s]
        stage = day.stages[int(np.searchsorted(day.begins, place.start, "right")) - 1]
        row = {"begin_s": begin_s, "text": text, "stage": stage, "during": during, "noticed_s": noticed}
        if recogniser:
            row["heard"] = recogniser.transcribe(out[at : at + place.stop - place.start])
            sounds = {"output": row["heard"], "microphone": recogniser.transcribe(day.mic[place])}
            sounds["human alone"] = recogniser.transcribe(day.clean[place])
            row["wrong"] = {name: word_errors(text, heard).capped for name, heard in sounds.items()}
            row["words"] = word_errors(text, "").words
        found.append(row)
    return found


def measure(args: argparse.Namespace) -> dict:
    """Ready for JSON."""
    voices = [clip for folder in args.voices for clip in read_clips(folder, CLIP_S)]
    day = make_day(args.seed, args.minutes, voices, read_clips(args.speech, CLIP_S))
    recogniser = Recogniser(args.whisper, args.cache / "transcripts.jsonl") if args.whisper else None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        load = os.getloadavg()[0]
        happened = live(day, args.engine, folder)
        stats = json.loads((folder / "stats.json").read_text())
        if stats.get("model"):
            stats["model"]["file"] = Path(stats["model"]["file"]).name
        stages = [
            {"name": stage, "begin_s": at / SAMPLE_RATE} for stage, at in zip(day.stages, day.begins, strict=True)
        ]
        return {
            "minutes": day.mic.size / SAMPLE_RATE / 60,
            "load_average_before": load,
            "mishaps": [vars(mishap) for mishap in happened],
            "stages": stages,
            "stats": stats,
            "events": [json.loads(line) for line in (folder / "kept/events.jsonl").read_text().splitlines()],
            "sentences": sentences(day, folder, happened, recogniser),
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, nargs="+", required=True, metavar="DIR", help="of the robot")
    parser.add_argument("--speech", type=Path, required=True, metavar="DIR", help="humans, with a transcripts.tsv")
    parser.add_argument("--minutes", type=float, default=8.0, help="of robot speech; pauses make it a quarter longer")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--whisper", type=Path, metavar="DIR", help="recogniser's folder; without it no word errors")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    parser.add_argument("--output", type=Path, help="without suffix; .json, .md and .png are written")
    args = parser.parse_args()
    data = {"ROBOT": args.voices, "HUMAN": [args.speech]}
    try:
        made_with = results_writer.stamp(data, [args.engine], {"WHISPER": args.whisper})
        found = measure(args)
    except (EdgefilterError, OSError) as error:
        print(f"live_trial: {error}", file=sys.stderr)
        return 1
    if args.output:
        live_trial_report.draw(found, args.output)
    page = live_trial_report.markdown(found, args.output.name if args.output else "live_trial")
    print(results_writer.write(args.output, made_with, live_trial_report.title(found), page, found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
