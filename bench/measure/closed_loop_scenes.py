"""One interruption under every policy, and the same scene with a backchannel in its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jiwer
import numpy as np

from bench.measure.real_barge_in import THRESHOLDS, first_sound, in_time, noticed, replay
from bench.measure.recogniser import Recogniser, normalise, word_errors
from bench.simulate.conversations import Scene
from edgefilter import EgoFilter
from edgefilter.calibration.calibrate import calibrate
from edgefilter.filter.barge_in import BargeIn, BargeInSettings
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Event, Samples

REACTION_S, FADE_S = 0.05, 0.02
"""From the event until the robot's player is told, and how long its fade takes."""
DUCK_DB = -10.0
HOLDS_S = (0.3, 0.5, 0.7, 0.9)
"""How long speech has to last to be told from a backchannel: the rows of that table."""
PAUSE_S = 0.2
"""Silence after which speech has ended, where its length is to be told."""
TAIL_S = 0.3
"""A muted microphone opens so long after the robot's last sample, for the room."""
SHORT_S = (0.3, 0.5)
"""Length of a backchannel."""
COUGH_DB = 3.0
"""A cough against the human's mean power."""


class Talk(NamedTuple):
    """What one run of the filter gave: samples, events of speech, the probability after each hop, None where nobody judges."""

    out: Samples
    events: list[Event]
    probability: list[float | None]
    hop: int


def listen(mic: Samples, ref: Samples, profile: Profile | None, engine: str) -> Talk:
    """The filter over a recording, hop by hop."""
    ego, probability, done = EgoFilter(profile, engine), [], []
    mic, ref = mic.astype(np.float32), ref.astype(np.float32)
    for at in range(0, mic.size, ego.hop):
        done.append(ego.process(mic[at : at + ego.hop], ref[at : at + ego.hop]))
        probability.append(ego.speech_probability)
    events = [event for event in ego.events() if event.kind.startswith("speech")]
    return Talk(np.concatenate((*done, ego.flush())), events, probability, ego.hop)


def measure(scene: Scene, engine: str, recogniser: Recogniser | None) -> dict:
    """Ready for JSON: noticed with a calibration and without, words under each policy, backchannels."""
    signals, meta = scene.signals, scene.meta
    ref, onset = signals["ref"], first_sound(signals["clean"].astype(np.float32))
    profile = calibrate(*(signals[name].astype(np.float32) for name in ("sweep_ref", "sweep_mic", "fan_only")))
    talk = listen(signals["mic"], ref, profile, engine)
    row = {name: meta[name] for name in ("room", "voice", "speaker", "text", "sisdr_mix")}
    row["calibrated"] = judged(talk, onset)
    row["cold"] = judged(listen(signals["mic"], ref, None, engine), onset)
    row["short"] = {name: short(scene, name, profile, engine, onset) for name in ("word", "cough")}
    if recogniser:
        row["heard"] = policies(scene, talk, profile, engine, onset, recogniser)
    return row


def judged(talk: Talk, onset: int) -> dict:
    """When the human was noticed, at the default threshold and at each of THRESHOLDS, and how long speech lasted."""
    found = noticed(talk.events, onset)
    at_each = [in_time(noticed(replay(talk.probability, talk.hop, at), onset)) for at in THRESHOLDS]
    return {**found, "in_time": in_time(found), "in_time_at": at_each, "lasts": lasts(talk, onset)}


def lasts(talk: Talk, onset: int) -> list[bool] | None:
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


def short(scene: Scene, kind: str, profile: Profile, engine: str, onset: int) -> dict:
    """What is noticed of a backchannel: the human's first syllables, or noise that bursts and dies away."""
    rng = np.random.default_rng(scene.meta["seed"])
    clean = scene.signals["clean"]
    sound = np.zeros_like(clean)
    n = round(rng.uniform(*SHORT_S) * SAMPLE_RATE)
    level = np.sqrt(np.mean(clean[scene.meta["start"] : scene.meta["end"]] ** 2))
    if kind == "word":
        fade = np.minimum(1.0, np.arange(n)[::-1] / (0.05 * SAMPLE_RATE))
        sound[onset : onset + n] = (clean[onset : onset + n] * fade[: clean.size - onset])[: clean.size - onset]
    else:
        times = np.arange(n) / SAMPLE_RATE
        burst = rng.standard_normal(n) * (np.exp(-times / 0.05) + 0.5 * (times > 0.15) * np.exp(-(times - 0.15) / 0.08))
        burst = np.convolve(burst, [0.5, 1.0, 0.5], "same")
        burst *= level * 10 ** (COUGH_DB / 20) / np.sqrt(np.mean(burst**2))
        sound[onset : onset + n] = burst[: clean.size - onset]
    talk = listen(scene.signals["mic"] - clean + sound, scene.signals["ref"], profile, engine)
    found = noticed(talk.events, onset)
    return {**found, "in_time": in_time(found), "lasts": lasts(talk, onset)}


def policies(
    scene: Scene, talk: Talk, profile: Profile, engine: str, onset: int, recogniser: Recogniser
) -> dict[str, dict]:
    """Words under each policy; with an event the recording is made anew from there on."""
    start = next((e.sample for e in talk.events if e.kind == "speech_started"), None)
    after = None if start is None else start + round(REACTION_S * SAMPLE_RATE)
    mics = {"stop": (after, 0.0), "duck": (after, 10 ** (DUCK_DB / 20)), "oracle": (silent_at(scene, onset), 0.0)}
    outs = {"open": talk.out, "muted": muted(scene)}
    for name, (at, gain) in mics.items():
        ref = scene.signals["ref"] if at is None else lowered(scene.signals["ref"], at, gain)
        outs[name] = talk.out if at is None else listen(scene.mic(ref), ref, profile, engine).out
    outs["alone"] = scene.signals["clean"].astype(np.float32)
    span = slice(scene.meta["start"], scene.meta["end"])
    share = SAMPLE_RATE / (span.stop - span.start)
    return {
        name: words(scene.meta["text"], recogniser.transcribe(out[span].astype(np.float32)), share)
        for name, out in outs.items()
    }


def lowered(ref: np.ndarray, at: int, gain: float) -> np.ndarray:
    """Ref (n,) with so much of its amplitude from a sample on, behind a short fade."""
    fade = np.clip((np.arange(ref.size) - at) / (FADE_S * SAMPLE_RATE), 0.0, 1.0)
    return ref * (1.0 + (gain - 1.0) * fade)


def silent_at(scene: Scene, onset: int) -> int:
    """The sample of the reference whose sound is heard when the human begins, less the fade."""
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
    """Errors of the whole, and of the words that lie in the first part of the text's letters: about the first second."""
    whole = word_errors(text, recognised)
    spoken = normalise(text).split()
    letters = np.cumsum([len(word) for word in spoken])
    first = max(1, int(np.searchsorted(letters, first_share * letters[-1], side="right")))
    errors = early_errors(spoken, normalise(recognised).split(), min(first, len(spoken)))
    return {
        "recognised": recognised,
        "errors": whole.errors,
        "words": whole.words,
        "first_errors": errors,
        "first_words": min(first, len(spoken)),
    }


def early_errors(spoken: Sequence[str], recognised: Sequence[str], first: int) -> int:
    """Errors at the first words of a text, what was invented before and between them included.

    >>> early_errors("could you please stop".split(), "good you stop now".split(), 2)
    1
    """
    if not recognised:
        return first
    found = jiwer.process_words(" ".join(spoken), " ".join(recognised))
    errors = 0
    for chunk in found.alignments[0]:
        if chunk.type == "insert":
            errors += (chunk.hyp_end_idx - chunk.hyp_start_idx) * (chunk.ref_start_idx < first)
        elif chunk.type != "equal":
            errors += max(0, min(chunk.ref_end_idx, first) - chunk.ref_start_idx)
    return errors
