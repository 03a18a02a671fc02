"""Every kind of recording: generated conversations, pairs of a real device, humans laid on those without one.

Pairs are files NAME_lpb (what the loudspeaker was sent) and NAME_mic, 16 kHz mono. A name holds who talks: doubletalk,
nearend, farend; without such a word the robot talks alone, as in farend. A table files.tsv beside the files, or beside their
folder, says when: columns name, far_end_alone_s, double_talk_s, near_end_alone_s ("2-14"). DEVICE_00, DEVICE_01, ... are many
recordings of one device: the first half of them is to tune on, the second to report on.
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import soundfile
from tqdm import tqdm

from edgefilter.calibration.calibrate import calibrate
from edgefilter.errors import UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

AUDIO = (".wav", ".flac", ".ogg")
KINDS = ("doubletalk", "farend", "nearend")
SPANS = {"doubletalk": "double_talk_s", "farend": "far_end_alone_s", "nearend": "near_end_alone_s"}
"""Columns of files.tsv with the seconds in which these talk."""
WAKE_WORD = "wake word"
"""Where the note in files.tsv names one, somebody says it while the robot talks."""
LENGTHS_S = 1.0
"""Seconds by which a loopback may differ from its microphone: recorders of real devices stop one after the other."""
UTTERANCE_S = (3.0, 10.0)
"""Length of the humans' utterances: some words, and over before the recording is."""
TAIL_S = 0.5
"""Robot after the human's end, so that no system is scored on its flushing."""
TRIES = 50
"""Places drawn for a human before the one with the most robot is taken."""
ROBOT_SILENT = 0.25
"""No place is taken where the robot has less than this share of its mean power: the SER would mean nothing."""
CALIBRATION = ("sweep_ref", "sweep_mic", "fan_only")
"""Recordings of which a calibration is made, in the order of `calibrate`."""
MARGIN = 32
"""Samples by which a true lag is given too short, so that a canceller's causal filter holds the direct sound's rise."""
Item = TypeVar("Item")


class NotHere(UsageError):
    """What a system needs and this clip, or this machine, does not have."""


class Signals(NamedTuple):
    """The signals of a clip: mic, ref (n,) float32; human (n,) as it is inside mic and its span, where it is known."""

    mic: Samples
    ref: Samples
    human: Samples | None = None
    span: slice = slice(None)


# ---------------------------------------------------------------- generated conversations


@dataclass(frozen=True)
class Conversation:
    """A folder of bench/simulate/conversations.py or arrays.py, read when asked for. turn: which of the human's."""

    folder: Path
    turn: int = 0

    @property
    def name(self) -> str:
        return self.folder.name if len(self.turns) == 1 else f"{self.folder.name}, turn {self.turn + 1}"

    @property
    def turns(self) -> list[dict]:
        """The human's: start, end and text of each."""
        return self.meta.get("turns", [self.meta])

    @property
    def text(self) -> str:
        return self.turns[self.turn]["text"]

    @cached_property
    def meta(self) -> dict:
        return json.loads((self.folder / "meta.json").read_text(encoding="utf-8"))

    def read(self, name: str) -> Samples:
        """Read mic, ref, clean, sweep_ref, sweep_mic or fan_only, (n,); of an array the first microphone."""
        return self.read_all(name)[:, 0].copy()

    def read_all(self, name: str) -> Samples:
        """The same with all microphones, (n, microphones)."""
        samples, rate = soundfile.read(self.folder / f"{name}.flac", dtype="float32", always_2d=True)
        if rate != SAMPLE_RATE:
            raise UsageError(f"{self.folder / name}.flac: {rate} Hz, expected {SAMPLE_RATE} Hz: convert it first")
        return samples

    def array(self, microphones: int) -> tuple[Signals, Profile]:
        """Signals and calibration of the first so many microphones; raises NotHere where there are fewer."""
        there = soundfile.info(self.folder / "mic.flac").channels
        if there < microphones:
            raise NotHere(f"{there} microphones, expected {microphones}")
        mic, sweep, fan = (self.read_all(name)[:, :microphones] for name in ("mic", "sweep_mic", "fan_only"))
        return Signals(mic, self.read("ref")), calibrate(self.read("sweep_ref"), sweep, fan)

    @cached_property
    def fingerprint(self) -> str:
        names = ("mic", "ref", "clean", "sweep_mic", "fan_only")
        return hashlib.sha256(b"".join((self.folder / f"{name}.flac").read_bytes() for name in names)).hexdigest()

    @cached_property
    def profile(self) -> Profile:
        return calibrate(*map(self.read, CALIBRATION))

    @property
    def span(self) -> slice:
        turn = self.turns[self.turn]
        return slice(turn["start"], turn["end"])

    def signals(self) -> Signals:
        return Signals(*map(self.read, ("mic", "ref", "clean")), self.span)

    def delayed_reference(self) -> Samples:
        """The reference with each utterance delayed by its true lag and the converters' delay, less MARGIN, (n,)."""
        ref, at, meta = self.read("ref"), self.meta["t_main"], self.meta
        delay = direct_delay(self.read("sweep_ref"), self.read("sweep_mic")) - MARGIN
        out = np.zeros_like(ref)
        if parts := meta.get("parts"):
            placed = [(ref[part["at"] : part["at"] + part["size"]], part["at"], part["lag"]) for part in parts]
        else:
            placed = [(ref[:at], 0, meta["lag"]), (ref[at:], at, meta.get("lag2", meta["lag"]))]
        for samples, start, lag in placed:
            begin = max(start + lag + delay, 0)
            kept = samples[: max(ref.size - begin, 0)]
            out[begin : begin + kept.size] += kept
        return out


def direct_delay(sweep_ref: Samples, sweep_mic: Samples) -> int:
    """Samples by which the direct sound of the sweep arrives later than played (peak of the whitened correlation)."""
    size = 1 << (2 * sweep_ref.size).bit_length()
    played = np.fft.rfft(sweep_ref, size)
    power = np.abs(played) ** 2
    response = np.fft.irfft(np.fft.rfft(sweep_mic, size) * played.conj() / (power + 1e-3 * power.max()))
    return int(np.argmax(np.abs(response[:SAMPLE_RATE])))


def every(sets: dict[str, list[Item]], n: int = 1, limit: int | None = None) -> list[tuple[str, Item]]:
    return [(name, item) for name, found in sets.items() for item in found[::n][:limit]]


def progress(items: Sequence[Item], unit: str = "recording", name: str | None = None) -> Iterable[Item]:
    """The items, with a bar; in a log it is written once a minute."""
    seconds = 0.1 if sys.stderr.isatty() else 60.0
    return tqdm(items, unit=unit, desc=name, delay=seconds, mininterval=seconds, maxinterval=max(seconds, 10.0))


# ---------------------------------------------------------------- real devices


@dataclass(frozen=True)
class Recording:
    """A pair of files: what the loudspeaker was sent and what the microphone recorded.

    kind: one of KINDS. device: whose recording it is. many: one of a device's many; tuned_on: of their first half. span: samples
    that are taken, None for all. Of several microphones the first is heard.
    """

    name: str
    kind: str
    ref_path: Path
    mic_path: Path
    device: str = ""
    many: bool = False
    tuned_on: bool = False
    span: tuple[int, int] | None = None

    @property
    def seconds(self) -> float:
        return self.signals().mic.size / SAMPLE_RATE

    def signals(self) -> Signals:
        mic, ref = read(self.mic_path, several=True), read(self.ref_path)
        if not mic.size or abs(mic.size - ref.size) > LENGTHS_S * SAMPLE_RATE:
            found = f"{mic.size / SAMPLE_RATE:.2f} s of microphone and {ref.size / SAMPLE_RATE:.2f} s of loopback"
            wanted = f"lengths within {LENGTHS_S:.0f} s of each other: take the files of one recording"
            raise UsageError(f"{self.name}: {found}, expected {wanted}")
        taken = slice(*self.span) if self.span else slice(None)
        return Signals(mic[taken], np.pad(ref, (0, max(mic.size - ref.size, 0)))[: mic.size][taken])


def find_recordings(folder: Path) -> list[Recording]:
    """All pairs of a folder, *_lpb.* and *_mic.*, by name; raises UsageError without any and for half a pair."""
    files = {p.stem: p for p in sorted(folder.glob("*")) if p.suffix in AUDIO and p.stem.endswith(("_lpb", "_mic"))}
    names = sorted({stem[:-4] for stem in files})
    if not names:
        wanted = "expected pairs of loopback and microphone"
        raise UsageError(f"{folder} holds no *_lpb and *_mic files ({', '.join(AUDIO)}), {wanted}")
    for name, ending in product(names, ("_lpb", "_mic")):
        if name + ending not in files:
            wanted = "expected both: add it or remove the other"
            raise UsageError(f"{folder} holds {name} without its {ending} file, {wanted}")
    devices = {name: re.sub(rf"_(\d\d?|({'|'.join(KINDS)}).*)$", "", name) for name in names}
    found, told = [], _told(folder)
    for name in names:
        numbered = [other for other in names if devices[other] == devices[name] and re.search(r"_\d\d$", other)]
        many = name in numbered and len(numbered) > 1
        first_half = many and name in numbered[: (len(numbered) + 1) // 2]
        guess: dict[str, tuple[int, int] | None] = {next((kind for kind in KINDS if kind in name), "farend"): None}
        spans = told.get(name) or guess
        for kind, span in spans.items():
            own = name if len(spans) == 1 else f"{name} {kind}"
            pair = files[f"{name}_lpb"], files[f"{name}_mic"]
            found.append(Recording(own, kind, *pair, devices[name], many, first_half, span))
    return found


def _told(folder: Path) -> dict[str, dict[str, tuple[int, int] | None]]:
    """What files.tsv says of a folder's recordings: the samples in which these talk, double talk with all before it."""
    table = next((path for path in (folder / "files.tsv", folder.parent / "files.tsv") if path.is_file()), None)
    if table is None:
        return {}
    found: dict[str, dict[str, tuple[int, int] | None]] = {}
    with table.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines, delimiter="\t"):
            place, _, name = row["name"].rpartition("/")
            seconds = {
                kind: [float(s) for s in row[column].split("-")] for kind, column in SPANS.items() if row.get(column)
            }
            if WAKE_WORD in (row.get("note") or "") and "farend" in seconds:
                seconds = {"doubletalk": seconds["farend"]}
            if place in ("", folder.name):
                found[name] = {kind: (0 if kind == "doubletalk" else round(start * SAMPLE_RATE), round(end * SAMPLE_RATE))
                               for kind, (start, end) in seconds.items()}  # fmt: skip
    return found


# ---------------------------------------------------------------- humans laid on a robot alone


@dataclass(frozen=True)
class Laid:
    """A human laid on a recording without one.

    at: sample of the recording at which the human begins. before: seconds of robot that are played first. ser: power of
    the human over that of the microphone's recording while the human speaks, dB.
    """

    case: int
    recording: Recording
    at: int
    speech: Path
    text: str
    ser: float
    before: float

    @property
    def name(self) -> str:
        return f"case {self.case} on {self.recording.name}, {self.ser:.3g} dB after {self.before:.3g} s"

    def signals(self) -> Signals:
        echo, ref, _, _ = _echo(self.recording)
        human = read(self.speech).astype(np.float64)
        begin, end = self.at - round(self.before * SAMPLE_RATE), self.at + human.size + round(TAIL_S * SAMPLE_RATE)
        mic, span = echo[begin:end].astype(np.float64), slice(self.at - begin, self.at - begin + human.size)
        laid = np.zeros_like(mic)
        laid[span] = human * np.sqrt(np.mean(mic[span] ** 2) / np.mean(human**2)) * 10 ** (self.ser / 20)
        mic += laid
        # a converter's range holds all of it: turned down together where it would not
        full = max(1.0, float(np.abs(mic).max()))
        return Signals((mic / full).astype(np.float32), ref[begin:end], (laid / full).astype(np.float32), span)


@lru_cache(maxsize=4)
def _echo(recording: Recording) -> Signals:
    return recording.signals()


@dataclass(frozen=True)
class Cells:
    """Every case is laid on at every SER (dB), after every time of robot alone (s)."""

    sers: tuple[float, ...] = (0.0, -10.0, -20.0, -26.0)
    befores: tuple[float, ...] = (5.0,)


def lay(recordings: Sequence[Recording], speech: Path, cells: Cells, cases: int, seed: int) -> list[Laid]:
    """Mix humans into the recordings in turn, `cases` in all; case i of a seed has the same human and onset in every cell."""
    spoken, rng = transcripts(speech), np.random.default_rng(seed)
    order = rng.permutation(len(spoken))
    laid = []
    for case in range(cases):
        recording, one = recordings[case % len(recordings)], spoken[order[case % order.size]]
        at = place(recording, soundfile.info(one.path).frames, max(cells.befores), rng)
        levels = product(cells.befores, cells.sers)
        laid += [Laid(case, recording, at, one.path, one.text, ser, before) for before, ser in levels]
    return laid


def lay_once(
    recording: Recording, speech: Path, cases: int, sers: tuple[float, float], befores: tuple[float, float], seed: int
) -> list[Laid]:
    """So many cases of a human on the whole recording from its beginning, at a SER (dB) and after a time (s) drawn in between.

    Where the recording is short the human begins earlier. The draw depends on the recording's name and the seed alone.
    """
    rng = np.random.default_rng([seed, *recording.name.encode()])
    spoken = transcripts(speech)
    length = _echo(recording).mic.size / SAMPLE_RATE - TAIL_S
    spoken = [one for one in spoken if one.seconds < length - befores[0]] or sorted(spoken, key=lambda s: s.seconds)[:1]
    laid = []
    for case in range(cases):
        one = spoken[rng.integers(len(spoken))]
        human = soundfile.info(one.path).frames
        if human / SAMPLE_RATE > length:
            raise _too_short(recording, length + TAIL_S, human / SAMPLE_RATE + TAIL_S)
        latest = max(min(befores[1], length - human / SAMPLE_RATE), 0.0)
        at = round(rng.uniform(min(befores[0], latest), latest) * SAMPLE_RATE)
        laid.append(Laid(case, recording, at, one.path, one.text, float(rng.uniform(*sers)), at / SAMPLE_RATE))
    return laid


def place(recording: Recording, human: int, before: float, rng: np.random.Generator) -> int:
    """Where a human of so many samples begins: enough robot before it, and the robot not silent meanwhile."""
    power = np.cumsum(np.append(0.0, _echo(recording).mic.astype(np.float64) ** 2))
    low, high = round(before * SAMPLE_RATE), power.size - 1 - human - round(TAIL_S * SAMPLE_RATE)
    if high < low:
        raise _too_short(recording, (power.size - 1) / SAMPLE_RATE, before + human / SAMPLE_RATE + TAIL_S)
    draws = rng.integers(low, high + 1, size=TRIES)
    robot = (power[draws + human] - power[draws]) / human
    good = np.flatnonzero(robot > ROBOT_SILENT * power[-1] / (power.size - 1))
    return int(draws[good[0] if good.size else np.argmax(robot)])


def _too_short(recording: Recording, found: float, needed: float) -> UsageError:
    return UsageError(f"{recording.name}: {found:.1f} s, expected {needed:.1f} s for this human")


class Utterance(NamedTuple):
    path: Path
    speaker: str
    seconds: float
    text: str


def transcripts(folder: Path) -> list[Utterance]:
    """Utterances of a length in UTTERANCE_S with their texts, from transcripts.tsv (path, speaker, seconds, text)."""
    table = folder / "transcripts.tsv"
    if not table.is_file():
        wanted = "expected humans: see bench/README.md"
        raise UsageError(f"{folder} holds no transcripts.tsv (path, speaker, seconds, text), {wanted}")
    with table.open(encoding="utf-8", newline="") as lines:
        rows = [row for row in csv.reader(lines, delimiter="\t", quoting=csv.QUOTE_NONE) if len(row) == 4]
    low, high = UTTERANCE_S
    found = [Utterance(folder / path, who, float(s), text) for path, who, s, text in rows if text.strip()]
    found = [one for one in found if low <= one.seconds <= high]
    if not found:
        said = f"{table} names no utterance of {low:.0f} to {high:.0f} s with a text"
        raise UsageError(f"{said}, expected some: give another folder")
    return found


# ---------------------------------------------------------------- what every system gets


@dataclass
class Clip:
    """One recording as every system gets it.

    set, room: whose table it stands in. speaker, place: the clusters of its intervals. text: what the human says, None
    where nobody knows. voices: other recordings of the same human, for systems that ask for one, each with the span in
    which only they are to be heard. Signals are read when they are asked for first.
    """

    set: str
    room: str
    source: Conversation | Recording | Laid | RobotSilent
    speaker: str = ""
    place: str = ""
    text: str | None = None
    voices: tuple[tuple[Path, slice], ...] = ()
    lent_s: float = 0.0
    _kept: dict[str, tuple[Samples, float]] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        return f"{self.set}/{self.source.name}"

    @property
    def talk(self) -> str:
        """Who talks: one of KINDS."""
        return self.source.kind if isinstance(self.source, Recording) else "doubletalk"

    @cached_property
    def signals(self) -> Signals:
        return self.source.signals()

    @property
    def mic(self) -> Samples:
        return self.signals.mic

    @property
    def ref(self) -> Samples:
        return self.signals.ref

    @property
    def human(self) -> Samples | None:
        return self.signals.human

    @property
    def span(self) -> slice:
        return self.signals.span

    @property
    def profile(self) -> Profile | None:
        """The calibration; None on a real device, of which there is none."""
        return getattr(self.source, "profile", None)

    @cached_property
    def fingerprint(self) -> str:
        """Of everything that a system may get."""
        if known := getattr(self.source, "fingerprint", None):
            return known
        human = b"" if self.human is None else self.human.tobytes()
        return hashlib.sha256(self.mic.tobytes() + self.ref.tobytes() + human).hexdigest()

    def conversation(self, lacks: str) -> Conversation:
        """The source, where it was simulated; else NotHere with what a real device lacks."""
        if not isinstance(self.source, Conversation):
            raise NotHere(lacks)
        return self.source

    def array(self, microphones: int) -> tuple[Signals, Profile]:
        return self.conversation(f"1 microphone, expected {microphones}").array(microphones)

    def known_human(self) -> Samples:
        """The human alone, (n,); raises NotHere where only the mixture was recorded."""
        if self.human is None:
            raise NotHere("the human alone is not known here")
        return self.human

    def delayed_reference(self) -> Samples:
        return self.conversation("the true lag of a real device is not known").delayed_reference()

    def fan(self) -> Samples:
        """The robot's fan as calibrated, as long as the clip: forwards and backwards in turn, without a join to hear."""
        alone = self.conversation("the fan of a real device is not known").read("fan_only")
        return np.resize(np.concatenate((alone, alone[::-1])), self.mic.size)

    def voice(self) -> Samples:
        """Another recording of the human, (n,); raises NotHere where there is none."""
        if not self.voices:
            raise NotHere("no other recording of this human")
        path, span = self.voices[0]
        return read(path)[span]

    def once(self, name: str, make: Callable[[], Samples]) -> Samples:
        """What make gives, from the second time on without asking it; lent_s grows by what that would have taken."""
        if name in self._kept:
            self.lent_s += self._kept[name][1]
        else:
            began = time.perf_counter()
            made = make()
            self._kept[name] = made, time.perf_counter() - began
        return self._kept[name][0]


@dataclass(frozen=True)
class RobotSilent:
    """A simulated conversation in which the robot says nothing: the human, and the fan as it was calibrated."""

    clip: Clip

    @property
    def name(self) -> str:
        return f"{self.clip.source.name}, robot silent"

    @property
    def profile(self) -> Profile | None:
        return self.clip.profile

    def signals(self) -> Signals:
        human = self.clip.known_human()
        return Signals(human + self.clip.fan(), np.zeros_like(human), human, self.clip.span)


def conversation_clips(folder: Path) -> Iterator[Clip]:
    """The conversations of a folder, a clip for each turn of the human; every conversation is in a room of its own."""
    found = [Conversation(path.parent) for path in sorted(folder.glob("*/meta.json"))]
    found = [replace(one, turn=turn) for one in found for turn in range(len(one.turns))]
    for one in found:
        meta = one.meta
        others = [other for other in found if other is not one and other.meta["speaker"] == meta["speaker"]]
        others = [other for other in others if other.text != one.text]
        voices = tuple((other.folder / "clean.flac", other.span) for other in others[:1])
        place_ = f"{folder.resolve().parent.name}/{folder.name}/{one.folder.name}"
        room = meta["room"] if len(one.turns) == 1 else f"{meta['room']}, {'first' if one.turn == 0 else 'later'} turn"
        yield Clip("", room, one, str(meta["speaker"]), place_, one.text, voices)


def find_conversations(folders: Sequence[Path]) -> dict[str, list[Clip]]:
    """Conversations by the name of their set; raises UsageError for a folder without any."""
    sets: dict[str, list[Clip]] = {}
    for folder in folders:
        found = list(conversation_clips(folder))
        if not found:
            wanted = "expected conversations: make some with bench.simulate.conversations"
            raise UsageError(f"{folder} holds no */meta.json, {wanted}")
        name = folder.resolve().name if folder.resolve().name not in sets else str(folder)
        sets[name] = named(found, name)
    return sets


def recorded_clip(recording: Recording) -> Clip:
    return Clip("", f"as recorded, {recording.kind}", recording, "", recording.name)


def laid_clips(laid: Iterable[Laid], speech: Path, room: str) -> Iterator[Clip]:
    spoken = {one.path: one for one in transcripts(speech)}
    for one in laid:
        speaker = spoken[one.speech].speaker
        others = tuple((p, slice(None)) for p, s in spoken.items() if s.speaker == speaker and p != one.speech)
        yield Clip("", room, one, speaker, one.recording.name, one.text, others[:1])


def named(clips: Iterable[Clip], name: str) -> list[Clip]:
    return [replace(clip, set=name) for clip in clips]


def read(path: Path, several: bool = False) -> Samples:
    """Samples of a file, (n,); raises UsageError for another rate, or more channels. several: takes the first of them instead."""
    samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    if rate != SAMPLE_RATE or (samples.shape[1] > 1 and not several):
        found = f"{rate} Hz, {samples.shape[1]} channels"
        raise UsageError(f"{path}: {found}, expected {SAMPLE_RATE} Hz mono: convert it first")
    return samples[:, 0].copy()
