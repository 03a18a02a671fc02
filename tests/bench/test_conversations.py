"""Simulated conversations are what their meta.json says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench import recordings
from bench.simulate import conversations, microphones
from bench.simulate import simulated_robot as robot
from edgefilter.dsp.metrics import si_sdr
from tests.bench.conftest import RATE, babble, driven, make


def read(folder: Path, name: str) -> np.ndarray:
    return sf.read(folder / f"{name}.flac")[0]


def lag_between(mic: np.ndarray, ref: np.ndarray) -> float:
    """Samples by which ref must be delayed to fit mic.

    Peak of the whitened cross-correlation, interpolated by a parabola.
    """
    size = 1 << (2 * ref.size).bit_length()
    played = np.fft.rfft(ref, size)
    power = np.abs(played) ** 2
    h = np.abs(np.fft.irfft(np.fft.rfft(mic, size) * played.conj() / (power + 1e-2 * power.max())))
    k = int(np.argmax(h[: RATE * 2]))
    left, top, right = h[k - 1], h[k], h[k + 1]
    return k + 0.5 * (left - right) / (left - 2 * top + right)


@pytest.mark.slow
def test_live_conversation_has_the_delays_that_its_meta_says(live: Path) -> None:
    folders = sorted(live.iterdir())
    assert [folder.name for folder in folders] == ["lab_00", "office_01"]
    for folder in folders:
        meta = json.loads((folder / "meta.json").read_text())
        mic, ref = read(folder, "mic"), read(folder, "ref")
        assert 10 <= abs(meta["ppm"]) <= 300 and meta["lag"] != meta["lag2"] and abs(meta["volume_db"]) <= 3
        for at, until, lag in ((0, meta["t_main"], meta["lag"]), (meta["t_main"], meta["start"], meta["lag2"])):
            stop = min(at + 5 * RATE, until)
            segment = np.zeros_like(ref)
            segment[at:stop] = ref[at:stop]
            arriving = np.interp(np.arange(ref.size) * (1 + meta["ppm"] * 1e-6) - lag, np.arange(ref.size), segment)
            # what is left is the delay of the calibration; half a sample for rounding, half for the distortion
            assert lag_between(mic[: stop + lag + RATE // 2], arriving) == pytest.approx(meta["delay"], abs=1)


@pytest.mark.slow
def test_conversation_levels_and_spans(live: Path) -> None:
    for folder in sorted(live.iterdir()):
        meta = json.loads((folder / "meta.json").read_text())
        mic, clean, fan = (read(folder, name) for name in ("mic", "clean", "fan_only"))
        span = slice(meta["start"], meta["end"])
        assert not clean[: meta["start"]].any() and clean[span].any()
        assert mic.size == clean.size == read(folder, "ref").size and fan.size == 8 * RATE
        assert si_sdr(mic[span], clean[span]) == pytest.approx(
            meta["sisdr_mix"], abs=0.05
        )  # 16-bit rounding of the clean human
        fan_db = 10 * np.log10(np.mean(clean[span] ** 2) / np.mean(fan**2))
        assert fan_db == pytest.approx(
            meta["snr_fan"], abs=0.5
        )  # 8 s of narrow-band noise estimate their power to some tenths
        assert np.abs(mic).max() < 1.0


@pytest.mark.slow
def test_an_item_does_not_depend_on_how_many_are_made(clips: Path, live: Path, tmp_path: Path) -> None:
    make(clips, tmp_path / "again", "live", 1)
    for name in ("mic", "ref", "sweep_mic", "fan_only"):
        np.testing.assert_array_equal(read(tmp_path / "again" / "lab_00", name), read(live / "lab_00", name))


def test_folder_without_transcripts_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="transcripts.tsv is missing"):
        conversations.read_clips(tmp_path, (3.0, 12.0))


@pytest.mark.slow
def test_true_lag_puts_both_utterances_where_they_are_heard(live: Path) -> None:
    for folder in sorted(live.iterdir()):
        talk = recordings.Conversation(folder)
        meta, mic, ref = talk.meta, talk.read("mic"), talk.delayed_reference()
        assert (
            abs(recordings.direct_delay(talk.read("sweep_ref"), talk.read("sweep_mic")) - meta["delay"]) <= 1
        )  # the fan
        drifting = np.interp(np.arange(ref.size) * (1 + meta["ppm"] * 1e-6), np.arange(ref.size), ref)
        onset = meta["t_main"] + meta["lag2"]
        for part in (slice(0, meta["t_main"]), slice(onset, meta["end"])):
            # half a sample for rounding of the lag, half for the loudspeaker's distortion
            assert lag_between(mic[part], drifting[part]) == pytest.approx(recordings.MARGIN, abs=1)


@pytest.mark.parametrize("ppm", [-300.0, 10.0, 250.0])
def test_warp_reads_at_the_other_clock(ppm: float) -> None:
    t = np.arange(4 * RATE)
    warped = robot.warp(np.sin(2 * np.pi * 0.31 * t), ppm)
    inside = slice(100, -100)
    np.testing.assert_allclose(
        warped[inside], np.sin(2 * np.pi * 0.31 * t * (1 + ppm * 1e-6))[inside], atol=3e-5
    )  # -90 dB images


def test_the_drive_is_that_of_the_distortion_that_was_asked_for() -> None:
    one, x, room = robot.draw_robot(np.random.default_rng(2)), babble(1.0, 1).astype(np.float64), np.eye(1, 100)[0]
    for wanted_db in (-15.0, -25.0):
        driven, found_db = robot.with_distortion(one, x, room, wanted_db)
        assert found_db == pytest.approx(wanted_db, abs=0.3)
        assert -si_sdr(driven.record(x, room), driven.record(x, room, linear=True)) == found_db


def test_loudspeaker_is_linear_when_barely_driven_and_distorts_when_driven() -> None:
    driver, x = robot.draw_loudspeaker(np.random.default_rng(2)), babble(2.0, 1).astype(np.float64)
    distortion = [
        -si_sdr(replace(driver, drive=drive).play(x), driver.play(x, linear=True)) for drive in (1e-4, 1.0, 4.0)
    ]
    assert (
        distortion[0] < -60 and distortion[0] < distortion[1] - 10 < distortion[2] - 15
    )  # asymmetry grows with the drive, 20 dB a decade at least
    doubled = driver.play(2 * x, linear=True)
    np.testing.assert_allclose(doubled, 2 * driver.play(x, linear=True), atol=1e-9)  # float64 rounding


def scene_signals(seconds: int = 4) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """A voice that pauses every second half second, a human behind it, a fan; and the voice."""
    rng = np.random.default_rng(1)
    loud = np.repeat(rng.uniform(0.03, 0.3, 10 * seconds), RATE // 10) * (np.arange(seconds * RATE) % RATE < RATE // 2)
    voice = loud * rng.standard_normal(seconds * RATE)
    clean, fan = 0.01 * rng.standard_normal(voice.size), 0.001 * rng.standard_normal(voice.size)
    clean[: voice.size // 2] = 0
    signals = {"sweep_ref": voice, "sweep_mic": voice + fan, "fan_only": fan, "mic": voice + clean + fan}
    return signals | {"clean": clean, "fan": fan}, voice


def test_a_processed_microphone_lowers_the_fan_and_changes_the_human_with_all_and_no_linear_filter_follows_it() -> None:
    signals, voice = scene_signals()
    found = microphones.processed(np.random.default_rng(3), signals, voice)
    pause = np.arange(voice.size) % RATE >= 3 * RATE // 4
    before = pause & (np.arange(voice.size) < voice.size // 2) & (np.arange(voice.size) > RATE)
    lowered = np.mean(found["mic"][before] ** 2) / np.mean(signals["mic"][before] ** 2)
    assert 10 * np.log10(lowered) < -3  # 8 to 15 dB of suppression, 3 of which the gain gives back
    device = microphones.Processing(10.0, 0.5, -20.0)
    parts = device.whole(signals["mic"], voice, signals["clean"], signals["fan"])
    np.testing.assert_allclose(parts[0], sum(parts[1:]), atol=1e-9)
    spectra, after = (np.fft.rfft(x.reshape(-1, 800)) for x in (signals["mic"], found["mic"]))
    left = after - spectra * np.sum(after * spectra.conj(), 0) / np.sum(np.abs(spectra) ** 2, 0)
    assert np.sum(np.abs(left) ** 2) > 0.01 * np.sum(np.abs(after) ** 2)  # -20 dB, as loud as the human
    assert np.array_equal(found["sweep_ref"], voice) and not found["clean"][:RATE].any()


def test_a_device_makes_of_blocks_what_it_makes_of_a_whole_recording_and_is_late_by_its_filters() -> None:
    signals, _ = scene_signals()
    mic, device = signals["mic"][:50_000], microphones.Processing(10.0, 0.5, -20.0)  # the last block is cut
    stream, late = microphones.Stream(device), microphones.LATE
    blocks = np.concatenate([stream(mic[at : at + 256])[0] for at in range(0, mic.size, 256)])
    np.testing.assert_allclose(blocks[late:], device.whole(mic)[0][:-late], atol=1e-9)


def test_a_microphone_that_hums_does_so_in_the_calibration_and_the_human_does_not() -> None:
    signals, voice = scene_signals()
    found = microphones.hum(np.random.default_rng(2), signals, voice)
    for name in microphones.RECORDED:
        added = found[name] - signals[name]
        assert -55.1 < 20 * np.log10(abs(added.mean())) < -34.9 and -55.1 < 20 * np.log10(added.std()) < -34.9
        peak = np.abs(np.fft.rfft(added - added.mean())).argmax() * RATE / added.size
        assert min(abs(peak - 50), abs(peak - 60)) < 1
    assert all(np.array_equal(found[name], signals[name]) for name in ("clean", "sweep_ref", "fan"))


def test_motors_move_while_the_robot_speaks_and_are_in_no_calibration() -> None:
    signals, voice = scene_signals(8)
    found = microphones.motors(
        np.random.default_rng(2), signals, np.where(np.arange(voice.size) < 4 * RATE, voice, 0.0)
    )
    moved = found["mic"] - signals["mic"]
    assert not moved[5 * RATE :].any() and moved[: 4 * RATE].any()  # 0.8 s: the longest gesture
    over_db = 10 * np.log10(np.mean(moved[np.abs(moved) > 0] ** 2) / np.mean(voice[voice != 0] ** 2))
    assert -29 < over_db < -13
    assert np.allclose(moved, found["fan"] - signals["fan"])
    assert all(np.array_equal(found[name], signals[name]) for name in ("clean", "sweep_mic", "fan_only"))


@pytest.mark.slow
def test_another_microphone_records_the_same_conversation_and_its_figures_are_its_own(clips: Path) -> None:
    speech, voices = conversations.read_clips(clips, (3.0, 12.0)), conversations.read_voices([clips])
    with driven():
        plain, other = (
            conversations.make_scene(3, 0, "paper", speech, voices, microphone=microphone)
            for microphone in (None, "motors")
        )
    span = slice(plain.meta["start"], plain.meta["end"])
    assert {key for key in plain.meta if plain.meta[key] != other.meta[key]} == {"sisdr_mix"}
    assert np.array_equal(plain.signals["ref"], other.signals["ref"])
    assert other.meta["sisdr_mix"] == si_sdr(other.signals["mic"][span], other.signals["clean"][span])
