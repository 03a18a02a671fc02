"""The front end, the simulation and the training on tensors, in miniature on a processor."""

import json
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
import torch
from scipy import signal

from edgefilter.dsp.stft import Analyser, StftConfig
from edgefilter.errors import UsageError
from edgefilter.filter.canceller import COLD, LEARNED, WARM, Canceller
from edgefilter.filter.residual_echo import Residual
from export.gpu import speech, train
from export.gpu.front import cancel, expected_powers
from export.gpu.scenes import KINDS, Scenes, _Batch, active_rms, suppress
from export.onnx_export import load
from export.simulate import loudspeaker
from export.simulate.linear_stage import Stage
from export.simulate.microphone import Suppression
from export.simulate.recipe import FIELD
from tests.export.speech import RATE, babble, write_table

ROOT = Path(__file__).parents[2]
HOP, HOPS = 256, 125


@pytest.fixture(scope="module")
def conversations():
    """Two of 2 s: microphone, reference and the path, which distorts; the second robot pauses, a human speaks in both."""
    rng = np.random.default_rng(3)
    n = HOP * HOPS
    reference = np.stack([babble(rng, n / RATE)[:n] for _ in range(2)])
    reference[1, 12000:18000] = 0.0
    path = 0.05 * rng.standard_normal((2, 4000)) * 10 ** (-3 * np.arange(4000) / 4000)
    path[:, :64], path[:, 64] = 0.0, 1.0
    human = 0.1 * np.roll(babble(rng, n / RATE)[:n], 9000)
    sound = reference + 20.0 * reference**2
    echo = np.stack([signal.oaconvolve(x, h)[:n] for x, h in zip(sound, path, strict=True)])
    mic = 0.3 * (echo + human + 1e-4 * rng.standard_normal((2, n)))
    return mic.astype(np.float32), reference, (0.3 * path).astype(np.float32)


def one_by_one(mic, reference, adaptation, path):
    """Echo (n,) and uncertainty (hops, hop + 1) of the running canceller, its volume never turned."""
    canceller = Canceller(HOP, 4096, path, adaptation)
    canceller.volume.follow = lambda mic, echo: 1.0
    canceller.volume._path = "known"
    hops = [canceller.step(*hop) for hop in zip(mic.reshape(-1, HOP), reference.reshape(-1, HOP), strict=True)]
    return np.concatenate([hop.echo for hop in hops]), np.stack([hop.uncertainty for hop in hops])


@pytest.mark.parametrize("adaptation, known", [(COLD, False), (WARM, True), (LEARNED, False)])
def test_the_canceller_of_a_batch_is_the_running_one(conversations, adaptation, known):
    mic, reference, path = conversations
    path = path * np.float32(0.9) if known else None
    tensors = (None if x is None else torch.from_numpy(x) for x in (mic, reference, path))
    mics, references, paths = tensors
    found = cancel(mics, references, HOP, 4096, adaptation, paths)
    for row in range(2):
        echo, uncertainty = one_by_one(mic[row], reference[row], adaptation, path[row] if known else None)
        apart, left = found.echo[row].numpy() - echo, mic[row] - echo
        assert np.sum(left**2) < 0.5 * np.sum(mic[row] ** 2)  # it cancels
        # single precision, and what ages in another order after a pause: measured -57 dB and less
        assert 10 * np.log10(np.sum(apart**2) / np.sum(left**2)) < -45
        loud = uncertainty > 1e-6 * uncertainty.max()
        assert np.abs(10 * np.log10(found.uncertainty[row].numpy()[loud] / uncertainty[loud])).mean() < 0.02


def test_an_echo_that_is_too_loud_is_limited_as_in_the_running_one(conversations):
    mic, reference, path = (x.copy() for x in conversations)
    mic[:, 10000:] *= 0.05  # somebody turned it down
    found = cancel(*map(torch.from_numpy, (mic, reference)), HOP, 4096, WARM, torch.from_numpy(path))
    for row in range(2):
        echo, _ = one_by_one(mic[row], reference[row], WARM, path[row])
        apart, left = found.echo[row].numpy() - echo, mic[row] - echo
        assert 10 * np.log10(np.sum(apart**2) / np.sum(left**2)) < -45


def test_expected_powers_are_those_of_the_running_filter(conversations):
    mic, reference, _ = conversations
    stft = StftConfig()
    echo, uncertainty = one_by_one(mic[0], reference[0], COLD, None)
    analyser, residual = Analyser(stft, 2), Residual(stft)
    frames, wanted = [], []
    for at, expected in enumerate(uncertainty):
        hop = slice(at * HOP, (at + 1) * HOP)
        frames.append(analyser.push(echo[hop], mic[0, hop] - echo[hop]))
        wanted.append([power.copy() for power in residual.step(*frames[-1], expected)])
    spectra, wanted = np.array(frames), np.array(wanted)
    nobody = torch.tensor([False]), torch.ones(1, stft.bins)
    heard, error = (torch.from_numpy(spectra[None, :, channel]) for channel in (0, 1))
    found = expected_powers(heard, error, torch.from_numpy(uncertainty[None]), stft, *nobody)
    for power, right in zip(found, wanted.swapaxes(0, 1), strict=True):
        assert np.abs(10 * np.log10((power[0].numpy() + 1e-15) / (right + 1e-15))).max() < 1e-3  # rounding


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("speech")
    for name in ("human/train", "human/val", "robot/train", "robot/val"):
        write_table(folder / name, ("a", "b"))
    for name, seconds in (("noise", 2.0), ("rir/loudspeaker", 0.1)):
        (folder / name).mkdir(parents=True)
        sf.write(folder / name / "one.flac", babble(np.random.default_rng(1), seconds), RATE)
    return folder


@pytest.fixture(scope="module")
def archive(folders, tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "speech.zip"
    kinds = {kind: [folders / kind] for kind in speech.SHARES}
    speech.pack(kinds, [folders / "rir"], path, 400_000)
    return path


@pytest.fixture(scope="module", autouse=True)
def few_devices():
    """Scenes draw that many when they are made, which takes longer than what most tests look at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("export.gpu.scenes.COLOURS", 8)
        yield


@pytest.fixture(scope="module")
def scenes(archive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unpacked")
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(folder)
    sounds = speech.read(folder, "train", torch.device("cpu"))
    return Scenes(replace(FIELD, seconds=2.0), StftConfig(), sounds, seed=5)


def test_an_archive_keeps_to_its_bytes_and_takes_of_every_speaker(folders, archive, tmp_path):
    with zipfile.ZipFile(archive) as packed:
        table = packed.read("human/train/transcripts.tsv").decode().splitlines()
        names = packed.namelist()
        with packed.open("human/train/00000.ogg") as one:
            assert sf.info(one).subtype == "OPUS"
    assert {line.split("\t")[1] for line in table} == {"a", "b"}
    assert "rir/loudspeaker/one.flac" in names and "noise/00000.ogg" in names
    small = tmp_path / "small.zip"
    kinds = {kind: [folders / kind] for kind in speech.SHARES}
    speech.pack(kinds, [], small, 40_000)
    assert small.stat().st_size < 40_000 + 200 * len(speech.SHARES)  # names besides
    with pytest.raises(UsageError, match="leaves 0 bytes"):
        speech.pack(kinds, [], small, 0)


def test_the_files_of_a_checkout_leave_the_rest_to_speech(tmp_path):
    with pytest.raises(UsageError, match="no checkout"):
        speech.left(tmp_path)
    (tmp_path / "tracked").write_bytes(bytes(1000))
    (tmp_path / "other").write_bytes(bytes(2000))
    for words in (["init", "-q"], ["add", "tracked"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    assert speech.left(tmp_path) == speech.MOST_BYTES - speech.SPARE_BYTES - 1000


@pytest.mark.slow
def test_a_batch_depends_on_seed_and_number_alone(scenes):
    first, second, again = (scenes.render(number, 3) for number in (0, 1, 0))
    for name, signals in first.items():
        assert torch.isfinite(signals.float()).all() and signals.shape[0] == 3
        assert torch.equal(signals, again[name])
    assert not torch.equal(first["mic"], second["mic"])
    assert first["mic"].abs().amax() <= 1.0 and first["noise"].shape == (3, 125, 257)


def test_frames_put_together_are_the_sound(scenes):
    x = torch.randn(2, scenes.samples, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(scenes.sound(scenes.spectra(x)), x, atol=1e-5)  # single precision


@pytest.mark.parametrize("rt60_s", [0.3, 0.8])
def test_a_room_decays_as_fast_as_asked_for(scenes, rt60_s):
    batch = _Batch(scenes, np.random.default_rng(0), 0, 1)
    size, near = np.array([[6.0, 5.0, 2.8]]), np.array([[2.0, 2.0, 1.0]])
    response = batch.response(size, np.array([rt60_s]), near, near + 0.1)[0].numpy()
    left_db = 10 * np.log10(np.cumsum(response[::-1] ** 2)[::-1])
    at = slice(round(0.02 * RATE), round(0.3 * rt60_s * RATE))
    slope = np.polyfit(np.arange(at.start, at.stop) / RATE, left_db[at], 1)[0]
    assert -60 / slope == pytest.approx(rt60_s, rel=0.3)  # Sabine's formula is no closer in such a room
    assert response[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_a_loudspeaker_adds_as_much_as_the_recipe_says(scenes, monkeypatch, kind):
    """Of every kind, and the kinds are those of export/simulate, in its order."""
    assert [distort.__name__[1:] for distort in KINDS] == list(loudspeaker.KINDS)
    monkeypatch.setattr("export.gpu.scenes.KINDS", (KINDS[kind],))
    batch = _Batch(with_recipe(scenes, plain=0.0), np.random.default_rng(kind), 0, 4)
    x = torch.from_numpy(babble(np.random.default_rng(9), 3.0)[: scenes.samples]).repeat(4, 1)
    y = batch.distorted(x)
    added_db = 20 * torch.log10(active_rms(y - x) / active_rms(x))
    loud = added_db > -100  # one or two may be a compressor that is never reached
    low, high = FIELD.distortion_db
    assert torch.isfinite(y).all() and loud.any()
    assert added_db[loud].min() > low - 0.1 and added_db.max() < high + 0.1


def test_suppression_is_that_of_the_simulator():
    suppression = Suppression(3.0, -20.0, 4.0, 10.0, 8, seed=2)
    x = babble(np.random.default_rng(4), 2.0) + 1e-3 * np.random.default_rng(5).standard_normal(2 * RATE)
    x = x.astype(np.float32)
    wanted = suppression.applied(x)[0]
    found = suppress(suppression, [torch.from_numpy(x)])[0].numpy()
    inner = slice(1024, -1024)  # frames at the ends are padded otherwise
    assert np.sum((found - wanted)[inner] ** 2) < 0.03 * np.sum(wanted[inner] ** 2)


@pytest.mark.slow
def test_a_pool_renders_on_and_drops_the_oldest_one_refresh_later(scenes):
    pool = train.Pool(scenes, batch=2, most=3)
    assert pool.names == ["00000000", "00000001"]
    pool.refresh()
    assert pool.names == ["00000001", "00000002", "00000003"]
    pool.crops([("00000000", 0)], 512)  # a crop that was under way
    pool.refresh()
    assert pool.names[0] == "00000003"
    with pytest.raises(KeyError):
        pool.crops([("00000000", 0)], 512)


@pytest.mark.slow
def test_without_a_reference_the_error_is_the_microphone(scenes, monkeypatch):
    lost = Stage(missing_db=np.inf)
    monkeypatch.setattr(type(FIELD.setting), "draw", lambda self, rng, warm: lost)
    batch = with_recipe(scenes, plain=0.0).render(0, 3)
    assert torch.allclose(batch["error"], batch["mic"], atol=1e-6)


def with_recipe(scenes, **changed):
    return Scenes(replace(scenes.recipe, **changed), scenes.stft, scenes.sounds, scenes.seed)


@pytest.mark.slow
def test_the_minutes_of_a_gpu_in_miniature(archive, tmp_path):
    """As a program, on a machine that has little: what it does not need cannot be imported."""
    absent = ("pyroomacoustics", "soxr", "sounddevice", "matplotlib", "jinja2", "dask", "ctranslate2")
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({absent})); from export.gpu import scenes, train;"
        " scenes.COLOURS = 8; sys.exit(train.main())"
    )
    words = ["--speech", str(archive), "--output", str(tmp_path / "out"), "--smoke"]
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4]
    assert lines[0]["si_sdr_error_db"] == lines[1]["si_sdr_error_db"]  # the same conversations
    kept = load(tmp_path / "out" / "weights.pt")
    assert len(kept.training["stages"]) == len(load(train.NEWEST).training["stages"]) + 1
    before, after = (loaded.network.memory.weight_ih_l0 for loaded in (load(train.NEWEST), kept))
    assert not torch.equal(before, after) and torch.allclose(before, after, atol=0.05)  # it went on from there


@pytest.mark.slow
def test_weights_are_kept_by_the_clock_however_long_the_next_validation_takes(archive, tmp_path, monkeypatch):
    monkeypatch.setattr(train, "KEEP_S", 0.0)
    steps = []

    def put(keeper, name):
        kept.__get__(keeper)(name)
        steps.append((name, load(tmp_path / "out" / "weights.pt").training["stages"][-1]["steps"]))

    kept = train.Keeper._put
    monkeypatch.setattr(train.Keeper, "_put", put)
    words = ["--speech", str(archive), "--output", str(tmp_path / "out"), "--smoke", "--steps", "3", "--every", "3"]
    assert train.main(words) == 0
    assert steps == [("between.pt", 0), ("between.pt", 1), ("between.pt", 2), ("last.pt", 3)]


def test_what_is_no_archive_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "speech.zip").write_bytes(b"speech")
    words = ["--speech", str(tmp_path / "speech.zip"), "--output", str(tmp_path / "out")]
    assert train.main(words) == 1
    assert "no archive of speech" in capsys.readouterr().err
