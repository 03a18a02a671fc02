"""Simulated arrays: a channel is as of one microphone, the fan is as measured, and every number of microphones has its row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench import recordings, systems
from bench.recordings import NotHere
from bench.simulate import arrays
from bench.simulate.conversations import read_clips, read_voices, write_item
from edgefilter.dsp.metrics import si_sdr
from edgefilter.types import SAMPLE_RATE as RATE
from tests.bench.conftest import driven


def noise_folder(folder: Path) -> Path:
    """Six recordings of an array's noise on channels 1 to 3: one source, a sample later in each, and each one's own."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    for index in range(6):
        source = rng.standard_normal(RATE + 4)
        own = [source[2 - at : RATE + 2 - at] + 0.3 * rng.standard_normal(RATE) for at in range(3)]
        sf.write(folder / f"{index}.flac", 0.01 * np.stack([rng.standard_normal(RATE), *own], 1), RATE)
    return folder


@pytest.fixture(scope="module")
def covariances(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    return arrays.measured_covariances(noise_folder(tmp_path_factory.mktemp("noise") / "array"))


@pytest.fixture(scope="module")
def made(clips: Path, covariances: tuple, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, dict]:
    """A folder with one conversation of three microphones in a laboratory, its signals and what it says of itself."""
    speech, voices = read_clips(clips, (0.5, 8.0)), read_voices([clips])
    with driven():
        signals, meta = arrays.make(
            1, 0, "paper", "lab", speech, voices, covariances, microphones=3, turns=1, moving=True
        )
    folder = tmp_path_factory.mktemp("arrays")
    write_item(folder / "lab_00", signals, "meta", meta)
    return folder, signals, meta


def coherence(x: np.ndarray) -> np.ndarray:
    """(bins,) of the first two channels of x (n, m)."""
    frames = np.fft.rfft(np.lib.stride_tricks.sliding_window_view(x, 512, axis=0)[::256] * np.hanning(512))
    cross, one, two = (np.mean(frames[:, i] * frames[:, j].conj(), 0) for i, j in ((0, 1), (0, 0), (1, 1)))
    return np.abs(cross) / np.sqrt(one.real * two.real)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_noise_has_the_covariance_that_was_asked_for(covariances: tuple, count: int) -> None:
    rng = np.random.default_rng(1)
    wanted = arrays.with_microphones(covariances[0], count, 5.0)
    assert np.linalg.eigvalsh(wanted).min() > 0 and np.allclose(
        wanted[:, :3, :3], covariances[0][:, :count, :count], rtol=1e-3
    )
    noise = arrays.coloured(rng, wanted, np.ones(1025), 20 * RATE)
    assert noise.shape == (count, 20 * RATE) and np.mean(noise[0] ** 2) == pytest.approx(1.0)
    if count > 1:
        expected = np.abs(wanted[:, 0, 1]) / np.sqrt(wanted[:, 0, 0].real * wanted[:, 1, 1].real)
        assert np.abs(coherence(noise.T)[5:250] - expected[5:250]).mean() < 0.05


def test_parts_of_a_fan_are_less_alike_the_higher_they_sound() -> None:
    rng = np.random.default_rng(2)
    found = [arrays.parts_covariance(rng, arrays.draw_places(rng, 3)) for _ in range(20)]
    alike = np.mean([np.abs(one[:, 0, 1]) / np.sqrt(one[:, 0, 0].real * one[:, 1, 1].real) for one in found], axis=0)
    assert min(np.linalg.eigvalsh(one).min() for one in found) > 0
    assert alike[5:15].mean() > 0.85 > alike[150:250].mean()


@pytest.mark.slow
def test_a_channel_is_what_its_levels_say(made: tuple) -> None:
    _, signals, meta = made
    (turn,) = meta["turns"]
    span = slice(turn["start"], turn["end"])
    mic, clean = signals["mic"][:, 0], signals["clean"][:, 0]
    assert si_sdr(mic[span], clean[span]) == pytest.approx(meta["sisdr_mix"], abs=0.01)
    assert -25 < meta["sisdr_mix"] < -19 and 4.5 <= meta["snr_fan"] <= 10.5
    fan_db = 10 * np.log10(np.mean(clean[span] ** 2) / np.mean(signals["fan_only"][:, 0] ** 2))
    assert fan_db == pytest.approx(meta["snr_fan"], abs=0.5)
    levels = 10 * np.log10(np.mean(signals["mic"] ** 2, axis=0))
    assert signals["mic"].shape[1] == 3 and np.ptp(levels) < 12.0 and np.abs(signals["mic"]).max() < 1.2


@pytest.mark.slow
def test_without_an_echo_the_same_human_and_fan_are_left(clips: Path, covariances: tuple, made: tuple) -> None:
    _, signals, meta = made
    speech, voices = read_clips(clips, (0.5, 8.0)), read_voices([clips])
    settings = {"microphones": 3, "turns": 1, "moving": True}
    with driven():
        silent, told = arrays.make(1, 0, "paper", "lab", speech, voices, covariances, **settings, echo=False)
    for name in ("sweep_ref", "sweep_mic", "fan_only", "clean"):
        assert np.array_equal(silent[name], signals[name])
    assert not silent["ref"].any() and told["turns"] == meta["turns"] and told["snr_fan"] == meta["snr_fan"]
    (turn,) = told["turns"]
    span = slice(turn["start"], turn["end"])
    mic, clean = silent["mic"][span], silent["clean"][span]
    over_fan = 10 * np.log10(np.mean(clean[:, 0] ** 2) / np.mean((mic - clean)[:, 0] ** 2))
    assert over_fan == pytest.approx(meta["snr_fan"], abs=0.5) and told["sisdr_mix"] == pytest.approx(over_fan, abs=0.5)


@pytest.mark.slow
def test_rows_with_several_microphones_run_where_there_are_so_many(made: tuple, live: Path) -> None:
    folder, signals, meta = made
    (clip,) = recordings.conversation_clips(folder)
    rows = systems.catalogue()
    assert np.allclose(clip.mic, signals["mic"][:, 0], atol=1e-4)
    assert clip.text == meta["text"] and clip.span == slice(meta["start"], meta["end"])
    outputs = {name: rows[name].run(clip) for name in ("crnn", "crnn-3", "crnn-3-turns")}
    assert all(output.samples.size == clip.mic.size for output in outputs.values())
    assert not np.array_equal(outputs["crnn"].samples, outputs["crnn-3"].samples)
    with pytest.raises(NotHere, match="3 microphones, expected 4"):
        rows["crnn-4"].run(clip)
    with pytest.raises(NotHere, match="1 microphones, expected 2"):
        rows["crnn-2"].run(next(iter(recordings.conversation_clips(live))))


@pytest.mark.slow
def test_each_turn_is_a_clip_of_its_own(tmp_path: Path, made: tuple) -> None:
    _, signals, meta = made
    later = meta["turns"][0] | {"start": meta["start"] + 100, "text": "another"}
    write_item(tmp_path / "lab_00", signals, "meta", meta | {"turns": [*meta["turns"], later]})
    first, second = recordings.conversation_clips(tmp_path)
    assert (first.room, second.room) == ("lab, first turn", "lab, later turn")
    assert second.text == "another" and second.span.start == first.span.start + 100 and first.name != second.name
