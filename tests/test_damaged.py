"""Damaged files: a loader refuses one in one line, and what it takes keeps the filter's promises.

EDGEFILTER_EXAMPLES says how many of each kind are tried, a million over a night; a find is shrunk and said by hypothesis.
"""

import io
import json
import os
import zipfile
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
import soundfile
from hypothesis import HealthCheck, given, settings

from edgefilter import EgoFilter, Profile
from edgefilter.audio.files import FileSource
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import EFFECTS
from edgefilter.engines.crnn import Crnn
from edgefilter.engines.paper_crnn import PaperCrnn
from edgefilter.errors import EdgefilterError
from edgefilter.filter import budget
from edgefilter.filter.budget import DEMO
from edgefilter.types import SAMPLE_RATE, Frame
from tests.program import ROOT

pytestmark = pytest.mark.slow
tried = settings(
    max_examples=int(os.environ.get("EDGEFILTER_EXAMPLES", 20)), deadline=10_000, derandomize=True, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
MIC, REF = (soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0][:SAMPLE_RATE] for name in ("mic", "reference"))
WORDS = (b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xc0\x7f", b"\x80" * 9 + b"\x01", b"{", b"]")
NUMBERS = (
    0,
    1,
    -1,
    0.5,
    1e-300,
    1e300,
    -1e300,
    2**31,
    2**63,
    -(2**63),
    10**400,
    float("nan"),
    float("inf"),
    16000,
    601,
)
VALUES = (*NUMBERS, "", "\0", "x" * 5000, "../../etc/passwd", None, True, [], {}, [[[]]], {"array": "response"})


@st.composite
def damaged(draw, content):
    """The bytes with 1 to 8 changes, half of them where headers are: words put in, pieces cut out or doubled, the end cut off."""
    content = bytearray(content)
    for _ in range(draw(st.integers(1, 8))):
        at = draw(st.integers(0, min(len(content), 256)) | st.integers(0, len(content)))
        size = draw(st.sampled_from((1, 2, 4, 16, 64, 1000)))
        kind = draw(st.sampled_from(("word", "cut", "double", "end", "turn")))
        if kind == "word":
            word = draw(st.sampled_from(WORDS) | st.binary(min_size=1, max_size=4))
            content[at : at + len(word)] = word
        elif kind == "cut":
            del content[at : at + size]
        elif kind == "double":
            content[at:at] = content[at : at + size]
        elif kind == "end":
            del content[at:]
        elif at < len(content):
            content[at] ^= 1 << draw(st.integers(0, 7))
    return bytes(content)


def places(value):
    """Every (container, key) in a JSON value."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [(value, key) for key in keys] + [place for key in keys for place in places(value[key])]


@st.composite
def other_json(draw, text):
    """JSON in which a value somewhere is another, or a key is gone."""
    whole = json.loads(text)
    inside, key = draw(st.sampled_from(places(whole)))
    if isinstance(inside, dict) and draw(st.booleans()):
        del inside[key]
    else:
        inside[key] = draw(st.sampled_from(VALUES))
    return json.dumps(whole).encode()


@st.composite
def other_archive(draw, content):
    """An .npz of which a member is another array, or other JSON, with sound checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    array = np.load(io.BytesIO(members[name]))
    if name == "header.npy":
        array = np.frombuffer(draw(other_json(array.tobytes())), np.uint8)
    elif draw(st.booleans()):
        with np.errstate(all="ignore"):
            array = (array * 10.0 ** draw(st.integers(-40, 40))).astype(array.dtype)
    else:
        array = np.resize(array, draw(st.sampled_from(((0,), (1,), (601,), (2, 601), (70000,), (5, 5, 5)))))
    file, packed = io.BytesIO(), io.BytesIO()
    np.save(file, array)
    with zipfile.ZipFile(packed, "w") as archive:
        for each, its in (members | {name: file.getvalue()}).items():
            archive.writestr(each, its)
    return packed.getvalue()


def taken(load, path, content):
    """What a loader makes of the content; None where it refuses it, in one line."""
    path.write_bytes(content)
    try:
        return load(path)
    except EdgefilterError as error:
        assert str(error).isprintable() and 0 < len(str(error)) < 1200
        return None


def profile_of(stage, folder):
    """The demonstration's profile with all effects of a stage, half of the way to their bounds."""
    profile = Profile.load(DEMO / "profile.npz")
    for effect in (one for one in EFFECTS if one.stage == stage):
        values = {p.name: (p.neutral + (p.low if p.neutral == p.high else p.high)) / 2 for p in effect.told}
        effects = (*profile.echo.effects, (effect.name, complete(effect, values)))
        profile = profile.with_echo(replace(profile.echo, effects=effects))
    profile.save(folder / "seed.npz")
    return (folder / "seed.npz").read_bytes()


@pytest.mark.parametrize("stage", sorted({effect.stage for effect in EFFECTS}))
def test_a_profile(stage, tmp_path):
    seed = profile_of(stage, tmp_path)

    @tried
    @given(content=other_archive(seed) | damaged(seed))
    def check(content):
        profile = taken(Profile.load, tmp_path / "damaged.npz", content)
        if profile is None:
            return
        ego = EgoFilter(profile, engine="linear")
        out = np.concatenate((ego.process(MIC, REF), ego.flush()))
        assert out.size == MIC.size and np.isfinite(out).all()
        assert np.mean(out**2) <= 10**0.1 * np.mean(MIC**2), "1 dB louder than the microphone"
        json.dumps(ego.stats(), allow_nan=False)

    check()


FORMS = (
    ("WAV", "PCM_16"),
    ("WAV", "FLOAT"),
    ("WAV", "IMA_ADPCM"),
    ("FLAC", "PCM_16"),
    ("OGG", "VORBIS"),
    ("AIFF", "PCM_16"),
)


@pytest.mark.parametrize(("form", "subtype"), FORMS)
def test_a_recording(form, subtype, tmp_path):
    file = io.BytesIO()
    soundfile.write(file, MIC[:3200], 22_050, subtype, format=form)

    def read(path):
        source = FileSource(path)
        return source.total, list(source) if source.total < 600 * SAMPLE_RATE else []

    @tried
    @given(content=damaged(file.getvalue()))
    def check(content):
        total, blocks = taken(read, tmp_path / "damaged.wav", content) or (0, [])
        assert all(np.isfinite(block.mic).all() for block in blocks)
        assert not blocks or sum(block.mic.size for block in blocks) == total

    check()


def frames(bins, count=3):
    rng = np.random.default_rng(0)
    for _ in range(count):
        mic, reference, echo = rng.standard_normal((3, bins, 2)).astype(np.float32).view(np.complex64)[..., 0]
        powers = rng.random((2, bins)).astype(np.float32)
        yield Frame(mic, reference, echo, mic - echo, *powers)


@pytest.mark.parametrize("name", ["crnn", "paper_crnn"])
def test_a_model(name, tmp_path):
    def answers(path):
        if name == "paper_crnn":
            paper = PaperCrnn(path)
            return list(paper.answer(list(frames(paper.stft.bins))))
        engine, out = Crnn(path), []
        state = engine.initial_state()
        for frame in frames(engine.stft.bins):
            output, state = engine.step(frame, state)
            assert 0.0 <= output.speech_probability <= 1.0
            assert np.vdot(output.spectrum, output.spectrum).real <= 10**0.1 * np.vdot(frame.mic, frame.mic).real
            out.append(output.spectrum)
        return out

    @tried
    @given(content=damaged((ROOT / f"tests/data/{name}.onnx").read_bytes()))
    def check(content):
        assert all(np.isfinite(answer).all() for answer in taken(answers, tmp_path / "damaged.onnx", content) or [])

    check()


def test_what_was_measured_of_engines(tmp_path, monkeypatch):
    """Whatever the file holds, the program goes on."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    about = {"held_to": 1}
    assert not budget.keep(about, {"ss": budget.Figures("ss", "", 16.0, 300, True, 1.0, 2.0, 3.0, 4.0)})
    seed = budget.timings().read_bytes()

    @tried
    @given(content=other_json(seed) | damaged(seed))
    def check(content):
        budget.timings().write_bytes(content)
        said = []
        for figures in budget.recall(about, said.append).values():
            budget.fits(figures, 8.0)
        assert all(line.isprintable() for line in said)

    check()
