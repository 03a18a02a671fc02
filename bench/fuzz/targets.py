"""What is attacked: each loader with real files to start from, how to damage them, and what must hold of what it accepts."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import soundfile

from bench.fuzz.damage import damaged, damaged_archive, damaged_json
from edgefilter import EgoFilter, Profile
from edgefilter.audio.files import FileSource
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import EFFECTS
from edgefilter.engines.crnn import Crnn
from edgefilter.engines.paper_crnn import PaperCrnn
from edgefilter.filter import budget
from edgefilter.learning.path_learner import PathLearner
from edgefilter.profile.data import LEARNED
from edgefilter.types import SAMPLE_RATE, Frame

ROOT = Path(__file__).parents[2]
NETWORKS = ROOT / "tests" / "data"
LOUDER_DB = 1.0
"""How much louder than the microphone an output may be over a second."""
FILTERED = 40
"""One in so many accepted profiles is also filtered with, which takes a hundred times as long as to load it."""


@dataclass(frozen=True)
class Target:
    """A loader under attack. seeds: real files. mutate: damages one. attempt: loads it and uses what was loaded; raises where that goes wrong.

    share: of all inputs. suffix: of the file. accepted: what attempt returns, whether the file was taken.
    """

    name: str
    share: int
    suffix: str
    seeds: Callable[[], list[bytes]]
    mutate: Callable[[bytes, random.Random], bytes]
    attempt: Callable[[Path, random.Random], None]


class Broken(AssertionError):
    """Something was accepted that then broke a promise."""


def expect(holds: bool, promise: str) -> None:
    """Raise Broken, with what was promised."""
    if not holds:
        raise Broken(promise)


@lru_cache
def profiles() -> list[bytes]:
    """The demo's profile, and three with effects: of all kinds, with arrays, and one that was learned."""
    demo = Profile.load(budget.DEMO / "profile.npz")
    values = {
        effect.name: {p.name: (p.neutral + (p.low if p.neutral == p.high else p.high)) / 2 for p in effect.told}
        for effect in EFFECTS
    }
    chains = [
        [effect for effect in EFFECTS if effect.stage == stage] for stage in dict.fromkeys(e.stage for e in EFFECTS)
    ]
    made = [demo, replace(demo, source=LEARNED)]
    for chain in chains:
        echo = demo.echo
        for effect in chain:
            echo = replace(echo, effects=(*echo.effects, (effect.name, complete(effect, values[effect.name]))))
        made.append(demo.with_echo(echo))
    return [_saved(profile) for profile in made]


def _saved(profile: Profile) -> bytes:
    path = folder() / "seed.npz"
    profile.save(path)
    return path.read_bytes()


_folder: list[Path] = []


@contextmanager
def working_in(path: Path) -> Iterator[None]:
    """Where seeds are made."""
    _folder.append(path)
    try:
        yield
    finally:
        _folder.pop()


def folder() -> Path:
    return _folder[-1]


def mutate_profile(data: bytes, rng: random.Random) -> bytes:
    return damaged(data, rng) if rng.random() < 0.15 else damaged_archive(data, rng)


@lru_cache
def sound() -> tuple[np.ndarray, np.ndarray]:
    """Two seconds of the demo in which the robot speaks: microphone and reference."""
    channels = [soundfile.read(budget.DEMO / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference")]
    at = int(np.argmax(np.abs(channels[1]) > 0.05))
    return tuple(channel[at : at + 2 * SAMPLE_RATE] for channel in channels)


def check_output(mic: np.ndarray, out: np.ndarray) -> None:
    expect(out.size == mic.size, f"{mic.size} samples in, {out.size} out")
    expect(bool(np.isfinite(out).all()), "an output sample is not finite")
    for at in range(0, mic.size - SAMPLE_RATE + 1, SAMPLE_RATE // 8):
        before, after = (float(np.mean(np.square(x[at : at + SAMPLE_RATE], dtype=np.float64))) for x in (mic, out))
        expect(
            after <= 10 ** (LOUDER_DB / 10) * before + 1e-9, f"output louder than the microphone from sample {at} on"
        )


def filter_with(profile: Profile, engine: str, learn: bool) -> None:
    mic, ref = sound()
    ego = EgoFilter(profile, engine, learn=PathLearner(profile) if learn else None)
    check_output(mic, np.concatenate((ego.process(mic, ref), ego.flush())))
    json.dumps(ego.stats(), allow_nan=False)


def attempt_profile(path: Path, rng: random.Random) -> None:
    profile = Profile.load(path)
    if rng.randrange(FILTERED) == 0:
        filter_with(profile, rng.choice(("linear", "ss", "paper-ss-causal")), learn=False)


def attempt_learning(path: Path, rng: random.Random) -> None:
    profile = Profile.load(path)
    expect(isinstance(profile.learned, bool), "learned is no bool")
    if rng.randrange(FILTERED) == 0:
        filter_with(profile, "linear", learn=True)


def caches() -> list[bytes]:
    trouble = budget.keep(ABOUT, {"ss": budget.Figures("ss", "", 16.0, 300, True, 1.0, 2.0, 3.0, 4.0)})
    expect(trouble is None, str(trouble))
    return [budget.timings().read_bytes()]


ABOUT = {"held_to": 1}


def attempt_cache(path: Path, rng: random.Random) -> None:
    """The file is put where the cache is; whatever it holds, the program goes on."""
    kept = budget.timings()
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_bytes(path.read_bytes())
    told: list[str] = []
    for figures in budget.recall(ABOUT, told.append).values():
        budget.fits(figures, 8.0)
    expect(not any("\n" in line for line in told), "more than one line")


@lru_cache
def recordings() -> list[bytes]:
    """A fifth of a second as people have it: rates, channels, codecs."""
    mic, ref = (x[:3200] for x in sound())
    stereo = np.stack((mic, ref), 1)
    forms = (
        *(("WAV", "PCM_16", mic, 16000), ("WAV", "FLOAT", stereo, 48000), ("WAV", "PCM_24", stereo, 44100)),
        *(("WAV", "IMA_ADPCM", mic, 16000), ("WAVEX", "PCM_32", stereo, 8000), ("FLAC", "PCM_16", mic, 16000)),
        *(("OGG", "VORBIS", mic, 16000), ("AIFF", "PCM_16", mic, 22050)),
    )
    files = []
    for form, subtype, samples, rate in forms:
        file = io.BytesIO()
        soundfile.write(file, samples, rate, subtype, format=form)
        files.append(file.getvalue())
    return files


def attempt_audio(path: Path, rng: random.Random) -> None:
    source = FileSource(path, path if rng.random() < 0.2 else None)
    total = 0
    for block in source:
        expect(bool(np.isfinite(block.mic).all() and np.isfinite(block.ref).all()), "a sample is not finite")
        total += block.mic.size
        if total > 600 * SAMPLE_RATE:
            return
    expect(total == source.total, f"{source.total} samples promised, {total} given")


@lru_cache
def networks() -> list[bytes]:
    return [(NETWORKS / name).read_bytes() for name in ("crnn.onnx", "paper_crnn.onnx")]


def attempt_model(path: Path, rng: random.Random) -> None:
    """Load as the engine that the file says it is for, and give it frames."""
    if b"edgefilter-paper" in path.read_bytes():
        paper = PaperCrnn(path)
        rows = [_frame(np.random.default_rng(seed), paper.stft.bins) for seed in range(5)]
        expect(all(np.isfinite(row).all() for row in paper.answer(rows)), "a spectrum is not finite")
        return
    engine = Crnn(path)
    state = engine.initial_state()
    for seed in range(4):
        frame = _frame(np.random.default_rng(seed), engine.stft.bins)
        output, state = engine.step(frame, state)
        expect(bool(np.isfinite(output.spectrum).all()), "a spectrum is not finite")
        expect(0.0 <= (output.speech_probability or 0.0) <= 1.0, f"probability {output.speech_probability}")
        before, after = (float(np.vdot(x, x).real) for x in (frame.mic, output.spectrum))
        expect(
            after <= 10 ** (LOUDER_DB / 10) * before,
            f"a spectrum {after / before:.3g} times as loud as the microphone's",
        )


def _frame(rng: np.random.Generator, bins: int) -> Frame:
    spectra = [(rng.standard_normal(bins) + 1j * rng.standard_normal(bins)).astype(np.complex64) for _ in range(3)]
    powers = rng.random((2, bins)).astype(np.float32)
    mic, reference, echo = spectra
    return Frame(mic, reference, 0.5 * echo, mic - 0.5 * echo, powers[0], powers[1])


TARGETS = (
    Target("profile", 48, ".npz", profiles, mutate_profile, attempt_profile),
    Target("learning", 12, ".npz", profiles, mutate_profile, attempt_learning),
    Target("cache", 12, ".json", caches, damaged_json, attempt_cache),
    Target("audio", 24, ".wav", recordings, damaged, attempt_audio),
    Target("model", 4, ".onnx", networks, damaged, attempt_model),
)
"""Shares in hundredths; a model takes twenty times as long to load as a profile."""
