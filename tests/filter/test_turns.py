"""What is kept of a stream, to be handed over as a turn when the human has finished."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from edgefilter.dsp.stft import Analyser, StftConfig, Synthesiser
from edgefilter.filter.spatial import SpatialFilter
from edgefilter.filter.turns import BEFORE_S, RECENT_S, WAITING_S, Turns, drop_sound
from edgefilter.types import SAMPLE_RATE, Event, Turn

STFT = StftConfig()
HOP = STFT.hop


def spectra(frames: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = rng.standard_normal((2, frames, STFT.bins)).astype(np.float32)
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def streamed(frames: np.ndarray) -> np.ndarray:
    """What the running filter makes of frames: sample t of it belongs to sample t - HOP of the microphone."""
    voice = Synthesiser(STFT)
    return np.concatenate([voice.push(frame) for frame in frames])


def kept(frames: np.ndarray) -> Turns:
    turns = Turns(STFT, None)
    for frame in frames:
        turns.step(frame, frame, None)
    return turns


def test_a_turn_begins_half_a_second_before_it_was_noticed_however_late_it_is_told() -> None:
    frames = spectra(120)
    begins = []
    for told in (60, 80):
        turns = Turns(STFT, None)
        for at, frame in enumerate(frames):
            turns.step(frame, frame, None)
            if at == told:
                turns.start(told - 60)
        turn = turns.finish()
        begins.append(turn.start)
        np.testing.assert_array_equal(turn.samples, streamed(frames)[turn.start + HOP :][: turn.samples.size])
    assert begins[0] == begins[1]
    assert 60 * HOP - begins[0] == pytest.approx(BEFORE_S * SAMPLE_RATE, abs=2 * HOP)


@pytest.mark.parametrize("hop", [128, 256])
def test_a_turn_from_the_first_frame_on_begins_with_the_recording(hop: int) -> None:
    """Its start was said to be a hop, or three, later than its sound."""
    stft = StftConfig(512, hop, 512)
    analyser, turns = Analyser(stft), Turns(stft, None)
    recording = np.random.default_rng(0).standard_normal(40 * hop).astype(np.float32)
    turns.start()
    for at in range(0, recording.size, hop):
        (frame,) = analyser.push(recording[at : at + hop])
        turns.step(frame, frame, None)
    turn = turns.finish()
    assert turn.start == 0
    np.testing.assert_allclose(turn.samples, recording[: turn.samples.size], atol=1e-5)
    later = turns.recent()
    np.testing.assert_allclose(later.samples, recording[later.start :][: later.samples.size], atol=1e-5)


def test_of_a_longer_turn_the_latest_half_minute_is_kept_as_it_was_streamed() -> None:
    frames = spectra(round(36.0 * SAMPLE_RATE / HOP))
    turns = Turns(STFT, None)
    for at, frame in enumerate(frames):
        turns.step(frame, frame, None)
        if at == 3:
            turns.start()
    turn = turns.finish()
    assert 29.9 * SAMPLE_RATE < turn.samples.size <= 30.0 * SAMPLE_RATE
    np.testing.assert_array_equal(turn.samples, streamed(frames)[turn.start + HOP :][: turn.samples.size])
    assert turn.start + turn.samples.size == (len(frames) - 1) * HOP


@pytest.mark.parametrize("waited", [0, 12])
def test_what_is_handed_over_at_a_beginning_reaches_back_beyond_the_wait(waited: int) -> None:
    frames = spectra(100)
    turn = kept(frames).recent(waited)
    assert turn.samples.size == pytest.approx(RECENT_S * SAMPLE_RATE + waited * HOP, abs=2 * HOP)
    np.testing.assert_array_equal(turn.samples, streamed(frames)[turn.start + HOP :][: turn.samples.size])


def array(frames: int) -> tuple[Turns, SpatialFilter, np.ndarray]:
    """Turns of an array, of which each error is kept with a gain of a half, and the errors (frames, 3, bins)."""
    errors = spectra(3 * frames).reshape(frames, 3, STFT.bins)
    spatial = SpatialFilter(STFT, 3)
    turns = Turns(STFT, spatial)
    turns.start()
    for each in errors:
        turns.step(0.5 * each[0], each[0], each)
    return turns, spatial, errors


def test_an_array_s_turn_is_filtered_anew_by_what_is_known_at_its_end(monkeypatch) -> None:
    turns, spatial, errors = array(40)
    for number in range(3):  # whatever the running filter is by then
        only = np.zeros((3, STFT.bins), np.complex64)
        only[number] = 1.0
        monkeypatch.setattr(spatial, "finished", lambda only=only: only)
        turn = turns.finish()
        expected = streamed(0.5 * errors[:, number])[turn.start + HOP :][: turn.samples.size]
        np.testing.assert_allclose(turn.samples, expected, atol=1e-5)


def test_an_error_that_vanishes_makes_no_bin_louder_than_the_error() -> None:
    turns = Turns(STFT, SpatialFilter(STFT, 2))
    turns.start()
    errors, answer = spectra(2 * 20).reshape(20, 2, STFT.bins), spectra(20, seed=1)
    for at in range(20):
        turns.step(answer[at], 1e-12 * errors[at, 0] if at % 2 else 0 * errors[at, 0], errors[at])
    assert np.isfinite(turns.finish().samples).all()
    assert np.mean(turns.finish().samples ** 2) <= np.mean(streamed(errors[:, 0]) ** 2)


def test_of_turns_that_nobody_asks_for_the_latest_keep_their_sound() -> None:
    third = np.zeros(round(WAITING_S * SAMPLE_RATE / 3) - 1, np.float32)
    events = deque(Event("speech_stopped", at, "", Turn(at, third)) for at in range(5))
    drop_sound(events)
    assert [event.turn is not None for event in events] == [False, False, True, True, True]
    assert [event.sample for event in events] == list(range(5))
