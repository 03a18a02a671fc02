"""What a robot gains that stops, or lowers its voice, when the filter notices that somebody interrupts it.

Interruptions: --count conversations of bench/simulate/conversations.py, kinds paper and live in turn. The loop is
closed: from REACTION_S after the event speech_started the robot says nothing more (or 10 dB less), the rest of its speech
is never played, the microphone is recorded anew with what is left of it, and the filter runs over that; what was handed
to the loudspeaker before is still heard, for as long as that robot's playback lags. Compared with: open loop (the
robot talks on), a microphone that is muted while the robot speaks, an oracle that has silence at the human's first
sound. The recogniser gets the output of each of them over the span in which the human speaks.

Backchannels: the same scenes, with a short word or a cough in the place of the interruption. False stops: the robot
alone for --minutes of its speech (--alone: folders of its clips), each minute another robot in another room, half of them
with loudspeakers of strong distortion and half without a calibration, and recordings of a real loudspeaker (--real) that
nothing was tuned on. --ask-db: by how much the robot lowers its voice while the filter asks for it; a simulated loudspeaker
then distorts less, a microphone that processes its sound (--microphone) processes the lower voice, and a recording is
lowered as a whole. --sound: a file for each calibrated robot that is interrupted, what it plays on the left and what its
microphone hears on the right. Rows are kept in --cache as they are made: a run that was cut off, or is asked for more
minutes, goes on there.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path

import jiwer
import numpy as np

from bench import provenance, results
from bench.cache import Cache
from bench.closed_loop import Output, Robot, listen, recorded
from bench.metrics import (
    IN_TIME_S,
    THRESHOLDS,
    counted,
    delays_s,
    first_sound,
    in_time,
    later,
    mean,
    noticed,
    per_hour,
    replay,
    starts,
)
from bench.recogniser import Recogniser, normalise, word_errors
from bench.recordings import CALIBRATION, find_recordings, progress
from bench.simulate.conversations import Scene, make_scene, read_clips, read_voices
from bench.simulate.microphones import Processing
from bench.simulate.monologues import STARTS, Monologue, make_monologue
from bench.simulate.simulated_robot import softened
from edgefilter.calibration.calibrate import calibrate
from edgefilter.filter.barge_in import BargeIn, BargeInSettings
from edgefilter.types import SAMPLE_RATE, Samples

KINDS = ("paper", "live")
Hear = Callable[..., Output]
"""Runs `listen` on a scene's microphone, through its device, and the reference, with one engine."""
REACTION_S, FADE_S = 0.05, 0.02
"""From the event until the robot's player is told, and how long its fade takes."""
DUCK_DB = -10.0
HOLDS_S = (0.3, 0.5, 0.7, 0.9)
"""How long speech has to last to be told from a backchannel: the columns of that table."""
PAUSE_S = 0.2
"""Silence after which speech has ended, where its length is to be told."""
TAIL_S = 0.3
"""A muted microphone opens so long after the robot's last sample, for the room."""
SHORT_S = (0.3, 0.5)
"""Length of a backchannel."""
COUGH_DB = 3.0
"""A cough against the human's mean power."""
MONOLOGUE_S = 60.0
"""Of robot speech, before the next robot begins in the next room."""
AUDIBLE = 1e-3
"""A second of a real recording counts as robot speech where the reference has at least this share of the power of its loudest second, -30 dB."""
POLICIES = {
    "muted": "microphone muted while the robot speaks",
    "open": "open loop: the robot talks on",
    "duck": "closed loop: 10 dB lower from the event on",
    "stop": "closed loop: stopped by the event",
    "oracle": "oracle: silent at the human's first sound",
    "alone": "the human alone, no fan, no robot",
}
SHORT = {"word": "a word of 0.3-0.5 s", "cough": "a cough"}


def measure(
    scene: Scene, engine: str, recogniser: Recogniser | None, ask_db: float, file: Path | None = None,
    device: Processing | None = None,
) -> dict:  # fmt: skip
    """Ready for JSON: when the interruption is noticed, calibrated and cold, wrong words under each of POLICIES, how long backchannels last.

    device: the processing behind the scene's microphone.
    """
    signals, meta = scene.signals, scene.meta
    ref, onset = signals["ref"], first_sound(signals["clean"].astype(np.float32))
    sweep, *recorded = (signals[name] for name in CALIBRATION)
    recorded = [device.whole(x)[0] for x in recorded] if device else recorded
    profile = calibrate(*(x.astype(np.float32) for x in (sweep, *recorded)))
    late = meta.get("lag2", meta["lag"]) + meta["delay"]  # of the second utterance, which is interrupted
    softer = scene.echo(10 ** (-ask_db / 20) * ref) if ask_db else None
    robot = Robot(softened(scene.echo(ref), softer, ask_db), late, ask_db, device=device)
    silent = robot._replace(echo=np.zeros_like(robot.echo), ask_db=0.0)
    hear = partial(listen, profile=profile, engine=engine, robot=silent)
    talk = hear(signals["mic"], ref, robot=robot._replace(file=file))
    row = {name: meta[name] for name in ("room", "voice", "speaker", "text", "sisdr_mix")}
    row["calibrated"] = when(talk, onset)
    row["cold"] = when(hear(signals["mic"], ref, profile=None, robot=robot), onset)
    row["short"] = {kind: when(backchannel(scene, kind, hear, onset), onset) for kind in SHORT}
    if recogniser:
        row["words"] = policies(scene, talk, hear, onset, recogniser)
    return row


def when(talk: Output, onset: int) -> dict:
    """When the human was noticed, at the default threshold and at each of THRESHOLDS, and how long speech lasted."""
    found = noticed(talk.events, onset)
    at_each = [in_time(noticed(replay(talk.probability, talk.hop, at), onset)) for at in THRESHOLDS]
    return {**found, "in_time": in_time(found), "in_time_at": at_each, "lasts": lasts(talk, onset)}


def lasts(talk: Output, onset: int) -> list[bool] | None:
    """Whether speech is still on after each of HOLDS_S from its first beginning behind the onset; None without one."""
    rule = BargeIn(talk.hop / SAMPLE_RATE, replace(BargeInSettings(), min_silence_s=PAUSE_S))
    speaking = []
    for probability in talk.probability:
        rule.note(probability)
        speaking.append(rule.speaking)
    begun = next((i for i, on in enumerate(speaking) if on and (i + 1) * talk.hop >= onset), None)
    if begun is None:
        return None
    hops = [round(seconds * SAMPLE_RATE / talk.hop) for seconds in HOLDS_S]
    return [all(speaking[begun : begun + n + 1]) for n in hops]


def backchannel(scene: Scene, kind: str, hear: Hear, onset: int) -> Output:
    """The filter over the scene with the human's first syllables alone, or with noise that bursts and dies away."""
    rng = np.random.default_rng(scene.meta["seed"])
    clean = scene.signals["clean"]
    n = round(rng.uniform(*SHORT_S) * SAMPLE_RATE)
    if kind == "word":
        fade = np.minimum(1.0, np.arange(n)[::-1] / (0.05 * SAMPLE_RATE))
        sound = clean[onset : onset + n] * fade[: clean.size - onset]
    else:
        level = np.sqrt(np.mean(clean[scene.meta["start"] : scene.meta["end"]] ** 2))
        times = np.arange(n) / SAMPLE_RATE
        sound = rng.standard_normal(n) * (np.exp(-times / 0.05) + 0.5 * (times > 0.15) * np.exp(-(times - 0.15) / 0.08))
        sound = np.convolve(sound, [0.5, 1.0, 0.5], "same")
        sound *= level * 10 ** (COUGH_DB / 20) / np.sqrt(np.mean(sound**2))
    mic = scene.signals["mic"] - clean
    mic[onset : onset + n] += sound[: clean.size - onset]
    return hear(mic, scene.signals["ref"])


def policies(scene: Scene, talk: Output, hear: Hear, onset: int, recogniser: Recogniser) -> dict[str, dict]:
    """Words under each policy; with an event the recording is made anew from there on."""
    start = next((e.sample for e in talk.events if e.kind == "speech_started"), None)
    after = None if start is None else start + round(REACTION_S * SAMPLE_RATE)
    turned = {"stop": (after, 0.0), "duck": (after, 10 ** (DUCK_DB / 20)), "oracle": (silent_at(scene, onset), 0.0)}
    outs = {"open": talk.samples, "muted": muted(scene)}
    for name, (at, gain) in turned.items():
        ref = scene.signals["ref"] if at is None else lowered(scene.signals["ref"], at, gain)
        outs[name] = talk.samples if at is None else hear(scene.mic(ref), ref).samples
    outs["alone"] = scene.signals["clean"].astype(np.float32)
    span = slice(scene.meta["start"], scene.meta["end"])
    share = SAMPLE_RATE / (span.stop - span.start)
    heard = {name: recogniser.transcribe(out[span].astype(np.float32)) for name, out in outs.items()}
    return {name: words(scene.meta["text"], said, share) for name, said in heard.items()}


def lowered(ref: np.ndarray, at: int, gain: float) -> np.ndarray:
    """The reference (n,) with so much of its amplitude from a sample on, behind a short fade."""
    fade = np.clip((np.arange(ref.size) - at) / (FADE_S * SAMPLE_RATE), 0.0, 1.0)
    return ref * (1.0 + (gain - 1.0) * fade)


def silent_at(scene: Scene, onset: int) -> int:
    """The sample of the reference whose sound is in the microphone when the human begins, less the fade."""
    meta = scene.meta
    return max(0, onset - meta.get("lag2", meta["lag"]) - meta["delay"] - round(FADE_S * SAMPLE_RATE))


def muted(scene: Scene) -> Samples:
    """The microphone, silent from the beginning of each of the robot's utterances until its room has calmed down."""
    meta, mic = scene.meta, scene.signals["mic"].astype(np.float32)
    for lag, first in ((meta["lag"], True), (meta.get("lag2", meta["lag"]), False)):
        said = [(i, j) for _, i, j in meta["said"] if (i < meta["t_main"]) == first]
        begin, end = said[0][0] + lag + meta["delay"], said[-1][1] + lag + meta["delay"]
        mic[begin : end + round(TAIL_S * SAMPLE_RATE)] = 0.0
    return mic


def words(text: str, recognised: str, first_share: float) -> dict:
    """Errors in % of the whole, and of the words that lie in the first part of the text's letters: about the first second."""
    whole = word_errors(text, recognised)
    spoken = normalise(text).split()
    letters = np.cumsum([len(word) for word in spoken])
    first = min(max(1, int(np.searchsorted(letters, first_share * letters[-1], side="right"))), len(spoken))
    errors = early_errors(spoken, normalise(recognised).split(), first)
    return {"recognised": recognised, "whole": 100 * whole.capped, "first": 100 * min(1.0, errors / first)}


def early_errors(spoken: Sequence[str], recognised: Sequence[str], first: int) -> int:
    """Errors at the first words of a text, what was invented before and between them included.

    >>> early_errors("could you please stop".split(), "good you stop now".split(), 2)
    1
    """
    if not recognised:
        return first
    errors = 0
    for chunk in jiwer.process_words(" ".join(spoken), " ".join(recognised)).alignments[0]:
        if chunk.type == "insert":
            errors += (chunk.hyp_end_idx - chunk.hyp_start_idx) * (chunk.ref_start_idx < first)
        elif chunk.type != "equal":
            errors += max(0, min(chunk.ref_end_idx, first) - chunk.ref_start_idx)
    return errors


def monologues(
    folders: list[Path], minutes: float, seed: int, engine: str, ask_db: float, microphone: str | None, kept: Cache, of: object
) -> list[dict]:  # fmt: skip
    """A row for each robot that talks alone, until all have spoken for so many minutes; a voice that is used again goes on where it stopped."""
    voices = read_voices(folders) if folders else {}
    order = np.random.default_rng(seed)
    clips = {name: [found[i] for i in order.permutation(len(found))] for name, found in voices.items()}
    names, rows, taken = sorted(clips), [], Counter[str]()
    length = min(MONOLOGUE_S, 60 * minutes)
    for index in progress(range(math.ceil(60 * minutes / length) if names and minutes > 0 else 0), "monologue"):
        voice = names[index % len(names)]
        own = islice(cycle(clips[voice]), taken[voice], None)

        def made(index: int = index, voice: str = voice, own: object = own) -> dict:
            return monologue(make_monologue(seed, index, voice, own, length, ask_db, microphone), engine, ask_db)

        rows.append(kept.get(made, of, "robot alone", index, length))
        taken[voice] += len(rows[-1]["said"])
    return rows


def monologue(made: Monologue, engine: str, ask_db: float) -> dict:
    profile = calibrate(*made.calibration) if made.start == "calibrated" else None
    talk = listen(made.mic, made.ref, profile, engine, Robot(made.echo, made.late, ask_db, device=made.device))
    said = [[f"{clip.path.parent.name}/{clip.path.stem}", seconds] for clip, seconds in made.said]
    of = {key: getattr(made, key) for key in ("room", "distortion", "start", "voice")}
    return of | {"said": said} | stops(talk, sum(seconds for _, seconds in said))


def real_minutes(folder: Path, engine: str, ask_db: float) -> list[dict]:
    """A row for each recording of a robot alone that nothing was tuned on. While the filter asks, the whole recording is lowered."""
    rows = []
    for recording in progress([r for r in find_recordings(folder) if r.kind == "farend" and not r.tuned_on]):
        signals = recording.signals()
        seconds = signals.ref[: signals.ref.size // SAMPLE_RATE * SAMPLE_RATE].reshape(-1, SAMPLE_RATE)
        power = np.mean(seconds.astype(np.float64) ** 2, axis=1)
        speech_s = float(np.sum(power > AUDIBLE * power.max()))
        row = {"room": "real", "distortion": "real", "start": "cold", "voice": "real-recorded"}
        row["said"] = [[recording.name, speech_s]]
        robot = recorded(signals.mic, signals.ref, ask_db) if ask_db else None
        rows.append(row | stops(listen(signals.mic, signals.ref, None, engine, robot), speech_s))
    return rows


def stops(talk: Output, speech_s: float) -> dict:
    """How often the robot was stopped by itself, and how often it would have been at each of THRESHOLDS."""
    at_each = [starts(replay(talk.probability, talk.hop, at)) for at in THRESHOLDS]
    asked = sum(event.kind == "voice_gain" and float(event.detail) < 1.0 for event in talk.events)
    suspected = sum(event.kind == "speech_suspected" for event in talk.events)
    return {
        "speech_s": speech_s,
        "stops": starts(talk.events),
        "stops_at": at_each,
        "suspected": suspected,
        "asked": asked,
    }


def run(options: argparse.Namespace) -> str:
    engine = options.engine or "crnn"
    data = {"HUMAN": [options.speech], "ROBOT": options.voices, "ALONE": options.alone}
    data |= {"RECORDINGS": [options.real]} if options.real else {}
    made_with = provenance.stamp(data, [engine], {"WHISPER": options.whisper})
    recogniser = Recogniser(options.whisper, Cache(options.cache)) if options.whisper else None
    kept = Cache(options.cache, "barge_in")
    sources = [entry["sha256"] for entry in made_with["data"]]
    microphone = options.microphone
    of = (engine, options.ask_db, microphone, options.seed, made_with["judged"], sources,
          recogniser.identity if recogniser else None)  # fmt: skip
    speech, voices = read_clips(options.speech, (3.0, 12.0)), read_voices(options.voices)
    rows = []
    if options.sound:
        options.sound.mkdir(parents=True, exist_ok=True)
    for index in progress(range(options.count), "conversation"):

        def made(index: int = index) -> dict:
            beside = None if microphone == "processed" else microphone
            scene = make_scene(options.seed, index, KINDS[index // 2 % 2], speech, voices, microphone=beside)
            drawn, mic = np.random.default_rng([options.seed, index, 1]), scene.signals["mic"]
            device = None if microphone == beside else Processing.draw(drawn, mic)
            file = options.sound and options.sound / f"{index}.wav"
            return measure(scene, engine, recogniser, options.ask_db, file, device)

        rows.append(kept.get(made, of, "conversation", index))
    alone = monologues(options.alone, options.minutes, options.seed, engine, options.ask_db, microphone, kept, of)
    alone += real_minutes(options.real, engine, options.ask_db) if options.real else []
    points = {start: curve([row[start] for row in rows], alone, start) for start in STARTS}
    lines = {start: ([p["per_hour"] for p in of], [100 * p["in_time"] for p in of]) for start, of in points.items()}
    panel = results.panel(f"threshold {THRESHOLDS[0]} to {THRESHOLDS[-1]}", "false stops an hour of robot speech",
                          f"noticed within {IN_TIME_S} s, %", lines, "o-", ylim=(0, 102))  # fmt: skip
    notes = f"Engine `{engine}`, default threshold. Humans 20-28 dB below the robot that talks meanwhile."
    if options.ask_db:
        notes += f" The robot asks: it lowers its voice by {options.ask_db:g} dB when the filter suspects a human."
        notes += " Of a recorded robot the whole recording becomes softer."
    part = "_".join(("barge_in", *filter(None, [microphone])))
    title = "Barge-in in closed loop" + (f", microphone: {microphone}" if microphone else "")
    return results.write(
        options.output, part, title, made_with, tables(rows, alone, points),
        [results.plot(part, [panel])], notes, engine=engine, conversations=rows, alone=alone, curve=points,
    )  # fmt: skip


def tables(rows: Sequence[Mapping], alone: Sequence[Mapping], points: Mapping[str, Sequence[Mapping]]) -> list[dict]:
    """The tables: who was noticed, wrong words, backchannels, false stops, and both by the threshold of the probability."""
    p50, p90, holds = ("p50, s", 2), ("p90, s", 2), [f"still on {seconds} s later" for seconds in HOLDS_S]
    made = [
        results.table("barge-in", "Interruptions noticed",
                      ["filter", "n", (f"within {IN_TIME_S} s, %", 0), p50, p90, "speech was on already", "never"],
                      [[start, *noticing([row[start] for row in rows])] for start in STARTS]),
        results.table("backchannels", "Backchannels", ["", "n", "an event", f"within {IN_TIME_S} s", *holds],
                      [["an interruption", *lasting([row["calibrated"] for row in rows])],
                       *([what, *lasting([row["short"][kind] for row in rows])] for kind, what in SHORT.items())],
                      "The robot talks on whatever happens and is calibrated; 0.2 s of silence end an event. The words are cut from the humans' first"
                      " syllables, the coughs are bursts of noise: stand-ins, not recordings of either."),
        results.table("false-stops", "False stops",
                      ["loudspeaker, filter", "robots", ("minutes of speech", 1), ("distinct", 1), "voices", "stops", ("an hour", 1),
                       "suspected", "asked"],
                      [[name, *false_stops(part)] for name, part in groups(alone).items() if part],
                      "Suspected, but not asked: the robot was silent, or its lowered voice would have reached the microphone too late."),
        results.table("threshold", "By the threshold of the probability, simulated robots",
                      ["filter", "threshold", (f"within {IN_TIME_S} s, %", 0), ("false stops an hour", 1)],
                      [[start, point["threshold"], 100 * point["in_time"], point["per_hour"]]
                       for start, found in points.items() for point in found]),
    ]  # fmt: skip
    if rows and "words" in rows[0]:
        found = {text: [row["words"][name] for row in rows] for name, text in POLICIES.items()}
        cells = [[text, mean(of, "whole"), mean(of, "first")] for text, of in found.items()]
        columns = ["", ("whole, %", 0), ("first second, %", 0)]
        text = f"Calibrated, {len(rows)} interruptions; mean of the utterances' rates, each at most 100 %."
        made.insert(1, results.table("words", "Words of the interruption wrong", columns, cells, text))
    return made


def noticing(found: Sequence[Mapping]) -> list:
    """n, share in time, delays, how many early (speech was on already), how many never noticed."""
    delays = delays_s(found)
    p50, p90 = (later(delays, share) for share in (0.5, 0.9))
    share = counted(one["in_time"] for one in found)
    return [len(found), share, p50, p90, len(found) - len(delays), sum(map(math.isinf, delays))]


def lasting(found: Sequence[Mapping]) -> list[int]:
    """Counts: all, those with an event, those with one in time, and those whose event is still on so long after it began, for each of HOLDS_S."""
    begun = [one["lasts"] for one in found if one["lasts"] is not None]
    still = [sum(one[i] for one in begun) for i in range(len(HOLDS_S))]
    return [len(found), len(begun), sum(one["in_time"] for one in found), *still]


def groups(alone: Sequence[Mapping]) -> dict[str, list[Mapping]]:
    """Robots alone by distortion and start, by what made their voice, and all."""
    found: dict[str, list[Mapping]] = {}
    for row in alone:
        for name in (f"{row['distortion']}, {row['start']}", f"of these {synthesiser(row['voice'])}"):
            found.setdefault(name, []).append(row)
    return dict(sorted(found.items())) | {"all": list(alone)}


def synthesiser(voice: str) -> str:
    """What made a voice: the name before the first hyphen; of Kokoro's voices there is none."""
    return voice.partition("-")[0] if "-" in voice else "neural"


def false_stops(rows: Sequence[Mapping]) -> list:
    """Robots, minutes of speech and of distinct speech, voices, stops, those an hour with the exact Poisson interval, suspicions, asked."""
    hours, count = sum(row["speech_s"] for row in rows) / 3600, sum(row["stops"] for row in rows)
    distinct_s = sum({name: seconds for row in rows for name, seconds in row["said"]}.values())
    return [len(rows), 60 * hours, distinct_s / 60, len({row["voice"] for row in rows}), count, per_hour(count, hours),
            *(sum(row[what] for row in rows) for what in ("suspected", "asked"))]  # fmt: skip


def curve(found: Sequence[Mapping], alone: Sequence[Mapping], start: str) -> list[dict]:
    """A point for each of THRESHOLDS, of simulated robots."""
    own = [row for row in alone if row["start"] == start and row["room"] != "real"]
    hours = sum(row["speech_s"] for row in own) / 3600
    rates = np.sum([row["stops_at"] for row in own], axis=0) / hours if own else np.full(len(THRESHOLDS), np.nan)
    shares = np.mean([one["in_time_at"] for one in found], axis=0)
    points = zip(THRESHOLDS, shares, rates, strict=True)
    return [{"threshold": at, "in_time": float(share), "per_hour": float(rate)} for at, share, rate in points]
