"""What is attacked: each loader with real files to start from, how to damage them, and what must hold of what it accepts."""

from __future__ import annotations

import io
import json
import random
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import soundfile

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

    share: of all inputs. suffix: of the file. seeds gets a folder that it may write into.
    """

    name: str
    share: int
    suffix: str
    seeds: Callable[[Path], list[bytes]]
    mutate: Callable[[bytes, random.Random], bytes]
    attempt: Callable[[Path, random.Random], None]


class Broken(AssertionError):
    """Something was accepted that then broke a promise."""


def expect(holds: bool, promise: str) -> None:
    if not holds:
        raise Broken(promise)


@lru_cache
def profiles(folder: Path) -> list[bytes]:
    """The demo's profile, and three with effects: of all kinds, with arrays, and one that was learned."""
    demo = Profile.load(budget.DEMO / "profile.npz")
    made = [demo, replace(demo, source=LEARNED)]
    for stage in dict.fromkeys(effect.stage for effect in EFFECTS):
        echo = demo.echo
        for effect in (one for one in EFFECTS if one.stage == stage):
            values = {p.name: (p.neutral + (p.low if p.neutral == p.high else p.high)) / 2 for p in effect.told}
            echo = replace(echo, effects=(*echo.effects, (effect.name, complete(effect, values))))
        made.append(demo.with_echo(echo))
    seeds = []
    for profile in made:
        profile.save(folder / "seed.npz")
        seeds.append((folder / "seed.npz").read_bytes())
    return seeds


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
        most = 10 ** (LOUDER_DB / 10) * before + 1e-9
        expect(after <= most, f"output louder than the microphone from sample {at} on")


def filter_with(profile: Profile, engine: str, learn: bool) -> None:
    mic, ref = sound()
    ego = EgoFilter(profile, engine=engine, learn=PathLearner(profile) if learn else None)
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


def caches(folder: Path) -> list[bytes]:
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


def recordings(folder: Path) -> list[bytes]:
    """A fifth of a second as people have it: rates, channels, codecs."""
    mic, ref = (x[:3200] for x in sound())
    stereo = np.stack((mic, ref), 1)
    files = []
    for form, subtype, samples, rate in (
        *(("WAV", "PCM_16", mic, 16000), ("WAV", "FLOAT", stereo, 48000), ("WAV", "PCM_24", stereo, 44100)),
        *(("WAV", "IMA_ADPCM", mic, 16000), ("WAVEX", "PCM_32", stereo, 8000), ("FLAC", "PCM_16", mic, 16000)),
        *(("OGG", "VORBIS", mic, 16000), ("AIFF", "PCM_16", mic, 22050)),
    ):
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


def networks(folder: Path) -> list[bytes]:
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
        louder = f"a spectrum {after / before:.3g} times as loud as the microphone's"
        expect(after <= 10 ** (LOUDER_DB / 10) * before, louder)


def _frame(rng: np.random.Generator, bins: int) -> Frame:
    spectra = [(rng.standard_normal(bins) + 1j * rng.standard_normal(bins)).astype(np.complex64) for _ in range(3)]
    powers = rng.random((2, bins)).astype(np.float32)
    mic, reference, echo = spectra
    return Frame(mic, reference, 0.5 * echo, mic - 0.5 * echo, powers[0], powers[1])


LARGE = (1e-300, 1e300, -1e300, 2**31, 2**63, -(2**63), 10**400, float("nan"), float("inf"))
NUMBERS = (0, 1, -1, 0.5, *LARGE, 16000, 601)
VALUES = (*NUMBERS, "", "\0", "x" * 5000, "../../etc/passwd", None, True, [], {}, [[[]]], {"array": "response"})
WORDS = (b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xc0\x7f", b"\x80" * 9 + b"\x01", b"{", b"]")


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The bytes with 1 to 8 changes: bits turned, words put in, pieces cut out, doubled or moved, the end cut off."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        if not content:
            break
        # half of the changes hit the first 256 bytes, where headers are
        at = rng.randrange(min(len(content), 256) if rng.random() < 0.5 else len(content))
        size = rng.choice((1, 2, 4, 16, 64, 1000))
        kind = rng.randrange(7)
        if kind == 0:
            content[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            content[at] = rng.randrange(256)
        elif kind == 2:
            word = rng.choice(WORDS)
            content[at : at + len(word)] = word
        elif kind == 3:
            del content[at : at + size]
        elif kind == 4:
            content[at:at] = content[at : at + size]
        elif kind == 5:
            there = rng.randrange(len(content))
            content[there : there + size] = content[at : at + size]
        else:
            del content[at + 1 :]
    return bytes(content)


def damaged_json(text: bytes, rng: random.Random) -> bytes:
    """JSON text in which a value somewhere is another, a key is gone or new; sometimes damaged as bytes."""
    if rng.random() < 0.2:
        return damaged(text, rng)
    whole = json.loads(text)
    places = list(_places(whole))
    for _ in range(rng.choice((1, 1, 2, 5))):
        inside, key = rng.choice(places)
        deed = rng.randrange(8)
        if isinstance(inside, dict) and deed == 0:
            inside.pop(key, None)
        elif isinstance(inside, dict) and deed == 1:
            inside[rng.choice(("surprise", "values", "array", ""))] = rng.choice(VALUES)
        elif key in inside if isinstance(inside, dict) else key < len(inside):
            inside[key] = _changed(inside[key], rng)
    return json.dumps(whole).encode()


def _places(value: object) -> list[tuple[object, object]]:
    """Every (container, key) in a JSON value."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [(value, key) for key in keys] + [place for key in keys for place in _places(value[key])]


def _changed(value: object, rng: random.Random) -> object:
    if isinstance(value, int | float) and abs(value) < 2**63 and not isinstance(value, bool) and rng.random() < 0.5:
        return rng.choice((value * rng.uniform(-3, 3), value + rng.choice((-1, 1)), value * 10.0 ** rng.randint(-9, 9)))
    return rng.choice(VALUES)


def damaged_archive(data: bytes, rng: random.Random) -> bytes:
    """An .npz of which one or two members are other arrays, other JSON or other bytes, packed so that its checksums agree."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(rng.choice((1, 1, 2))):
        at = rng.randrange(len(members))
        name, content = members[at]
        kind = rng.randrange(10)
        if kind == 0:
            members[at] = (name, damaged(content, rng))
        elif kind == 1:
            members.append((rng.choice((name, "more.npy", "effect_0_0.npy", "../x.npy")), content))
        elif kind == 2:
            members[at] = (name, members[rng.randrange(len(members))][1])
        else:
            try:
                array = np.load(io.BytesIO(content), allow_pickle=False)
            except Exception:  # it was damaged by the change before
                continue
            file = io.BytesIO()
            np.save(file, _other(name, array, rng), allow_pickle=False)
            members[at] = (name, file.getvalue())
    packed = io.BytesIO()
    way = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(packed, "w", way) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a name comes twice is meant
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content)
    return packed.getvalue()


def _other(name: str, array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Another array in place of this one: other values, shape, type; of the header, other JSON."""
    if name == "header.npy" and array.dtype == np.uint8 and array.ndim == 1 and array.size:
        try:
            return np.frombuffer(damaged_json(array.tobytes(), rng), np.uint8)
        except (ValueError, IndexError):  # it was damaged before
            return array[: rng.randrange(array.size)]
    kind = rng.randrange(6)
    if kind == 0 and array.dtype.kind != "c":
        with np.errstate(all="ignore"):
            return array.astype(rng.choice(("<f8", "<f4", "<f2", "<i8", "|u1", "|b1", "<c8")))
    if kind == 1:
        return array.reshape(-1)[: rng.randrange(array.size + 1)]
    if kind == 2:
        return np.resize(array, rng.choice(((0,), (1,), (601,), (2, 601), (128,), (70000,), (5, 5, 5))))
    changed = np.array(array, ndmin=1)
    if not changed.size or changed.dtype.kind not in "fiu":
        return changed
    with np.errstate(all="ignore"):
        if kind == 3 or array.dtype.itemsize == 1:
            changed = (changed * 10.0 ** rng.randint(-40, 40)).astype(array.dtype)
        else:
            places = [rng.randrange(changed.size) for _ in range(rng.choice((1, 3, 100)))]
            value = rng.choice([number for number in NUMBERS if abs(number) < 2**31 or number != number])
            changed.reshape(-1)[places] = value if array.dtype.kind == "f" else 7
    return changed.reshape(array.shape)


TARGETS = (
    Target("profile", 48, ".npz", profiles, mutate_profile, attempt_profile),
    Target("learning", 12, ".npz", profiles, mutate_profile, attempt_learning),
    Target("cache", 12, ".json", caches, damaged_json, attempt_cache),
    Target("audio", 24, ".wav", recordings, damaged, attempt_audio),
    Target("model", 4, ".onnx", networks, damaged, attempt_model),
)
"""Shares in hundredths; a model takes twenty times as long to load as a profile."""
