"""Several microphones through the whole path: what they share with one, what they are refused for, and what a turn is."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from edgefilter import EgoFilter, PathLearner, calibrate, enhance, generate_sweep
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.errors import CalibrationError, SignalError
from edgefilter.filter.barge_in import BargeIn
from edgefilter.filter.canceller import Canceller
from edgefilter.filter.stream import Stream
from edgefilter.filter.turns import Turns, overlap_add
from edgefilter.profile.data import Profile
from edgefilter.types import Frame, Output
from tests.conformance import conversation
from tests.filter.array_scene import PATHS, RATE, calibration, fan, noise, talk


class Told(SpectralSubtraction):
    """`ss` that is told when the human speaks."""

    name = "told"

    def __init__(self, begin: int, end: int) -> None:
        super().__init__()
        self._span, self._hop = (begin // self.stft.hop, end // self.stft.hop), 0

    def step(self, frame: Frame, state: np.ndarray) -> tuple[Output, np.ndarray]:
        output, state = super().step(frame, state)
        self._hop += 1
        return Output(output.spectrum, 0.999 if self._span[0] <= self._hop < self._span[1] else 0.001), state


@functools.cache
def heard(microphones: int) -> tuple[np.ndarray, list]:
    """What comes of the first so many microphones where it is known when the human speaks, and what happened."""
    mic, ref, _ = talk()
    stream = Stream(Told(3 * RATE, 5 * RATE), calibration(microphones))
    out = np.concatenate((stream.process(mic if microphones > 1 else mic[:, 0], ref), stream.flush()))
    return out, list(stream.events)


@pytest.mark.parametrize("warm", [False, True])
def test_the_canceller_does_in_each_microphone_what_it_does_in_one(warm: bool) -> None:
    mic, ref, _ = talk()
    paths = np.array(PATHS[:3], np.float32) if warm else None
    alone = [Canceller(taps=1024, impulse_response=None if paths is None else paths[at]) for at in range(3)]
    together = Canceller(taps=1024, impulse_response=paths, microphones=3)
    for at in range(0, 40000 - 256, 256):
        hop = np.ascontiguousarray(mic[at : at + 256].T)
        found = together.step(hop, ref[at : at + 256])
        first = alone[0].step(hop[0], ref[at : at + 256])
        assert np.array_equal(found.error[0], first.error) and np.array_equal(found.echo[0], first.echo)
        assert np.array_equal(found.uncertainty[0], first.uncertainty)
    assert np.array_equal(together.impulse_response()[0], alone[0].impulse_response())
    assert np.all(np.sum(found.error**2, axis=1) < 0.1 * np.sum(hop**2, axis=1))


def test_one_channel_as_a_column_is_the_signal_itself() -> None:
    mic, ref = conversation(20000)
    assert np.array_equal(enhance(mic[:, None], ref, engine="ss"), enhance(mic, ref, engine="ss"))


@pytest.mark.slow
def test_any_partition_of_an_array_gives_the_same_bits() -> None:
    mic, ref = (x[5 * RATE // 2 : 9 * RATE // 2] for x in talk()[:2])
    profile, whole = calibration(3), []
    for sizes in ([mic.shape[0]], [1, 255, 256, 300, 4096, 7]):
        ego, out, at = EgoFilter(profile, engine="ss"), [], 0
        while at < len(ref):
            for size in sizes:
                out.append(ego.process(mic[at : at + size], ref[at : at + size]))
                at += size
        whole.append(np.concatenate((*out, ego.flush())))
    assert whole[0].shape == ref.shape and np.array_equal(*whole)


def test_three_microphones_leave_less_than_one() -> None:
    span = slice(round(3.2 * RATE), round(4.8 * RATE))
    human = talk()[2][span]

    def snr(out: np.ndarray) -> float:
        gain = out.dot(human) / human.dot(human)
        return 10 * np.log10(gain**2 * np.sum(human**2) / np.sum((out - gain * human) ** 2))

    assert snr(heard(3)[0][span]) > snr(heard(1)[0][span]) + 3.0


def test_engines_without_a_linear_stage_hear_the_first_microphone() -> None:
    mic, ref, _ = talk()
    assert np.array_equal(enhance(mic, ref, engine="bypass"), enhance(mic[:, 0], ref, engine="bypass"))


def test_other_microphones_than_were_calibrated_are_one_line() -> None:
    mic, ref, _ = talk()
    with pytest.raises(SignalError, match="mic has 2 channels and the profile 3, expected as many: choose"):
        EgoFilter(calibration(3), engine="ss").process(mic[:, :2], ref)
    with pytest.raises(SignalError, match="mic has 1 channels and the profile 3"):
        EgoFilter(calibration(3), engine="ss").process(mic[:, 0], ref)
    ego = EgoFilter(engine="ss")
    ego.process(mic[:1000], ref[:1000])
    with pytest.raises(SignalError, match="mic has 2 channels after 3, expected the same number until the end"):
        ego.process(mic[1000:2000, :2], ref[1000:2000])
    with pytest.raises(SignalError, match=r"shape \(10, 9\), expected .* 1 to 8 channels"):
        ego.process(np.zeros((10, 9), np.float32), ref[:10])
    bad = mic[1000:2000].copy()
    bad[5, 2] = np.nan
    with pytest.raises(SignalError, match="mic, channel 2, holds nan at sample 5"):
        ego.process(bad, ref[1000:2000])


def test_what_was_announced_before_the_first_block_is_still_waited_for() -> None:
    mic, ref, _ = talk()
    ego = EgoFilter(engine="ss")
    ego.announce(ref)
    ego.process(mic[:2000], np.zeros(2000, np.float32))
    assert ego.stats()["alignment"]["announced"] == 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda x: 0.0 * x, "silent"),
        (lambda x: 10.0 * x, "20 dB louder"),
        (lambda x: 0.05 * x, "26 dB softer"),
        (lambda x: np.sqrt(np.mean(x**2)) * noise(x.size, 9), "hears the robot otherwise"),
        (lambda x: np.clip(2.0 * x / np.abs(x).max(), -1.0, 1.0), "clipped"),
        (lambda x: 0.5 * talk()[1][: x.size], "what is played"),
    ],
)
def test_a_microphone_that_is_no_part_of_the_array_is_left_out(change, reason) -> None:
    mic, ref = (x[: 3 * RATE] for x in talk()[:2])
    mic = mic.copy()
    mic[:, 1] = change(mic[:, 1])
    if reason == "clipped":  # beside others that are nearly as loud, and are not
        mic[:, ::2] *= np.float32(0.9 / np.abs(mic[:, ::2]).max())
    ego = EgoFilter(calibration(3), engine="ss")
    ego.process(mic, ref)
    stats = ego.stats()["array"]
    assert stats["microphones"] == 3 and list(stats["left_out"]) == ["1"] and reason in stats["left_out"]["1"]


@pytest.mark.slow
def test_equal_channels_count_as_one_and_another_takes_the_place_of_the_first() -> None:
    mic, ref = (x[: 3 * RATE] for x in talk()[:2])
    twice, silent = mic.copy(), mic.copy()
    twice[:, 2], silent[:, 0] = mic[:, 0], 0.0
    for heard, expected in ((twice, (0, {"2": "the same as channel 0"})), (silent, (1, {"0": "silent"}))):
        ego = EgoFilter(calibration(3), engine="ss")
        out = np.concatenate((ego.process(heard, ref), ego.flush()))
        stats = ego.stats()["array"]
        assert (stats["reference"], stats["left_out"]) == expected
        assert np.mean(out[2 * RATE : 3 * RATE] ** 2) < 0.05 * np.mean(mic[2 * RATE : 3 * RATE, 0] ** 2)
    assert EgoFilter(engine="ss").stats()["array"] is None


@pytest.mark.parametrize(
    ("order", "left_out"),
    [([0, 2, 1], {"1": 2, "2": 1}), ([1, 0, 2], {"0": 1, "1": 0}), ([0, 1, 2], {}), ([1, 2, 0], {"1": 2, "2": 0})],
)
def test_channels_that_were_exchanged_since_the_calibration_are_left_out_by_name(order, left_out) -> None:
    mic, ref = (x[: 3 * RATE] for x in talk()[:2])
    ego = EgoFilter(calibration(3), engine="ss")
    ego.process(mic[:, order], ref)
    found = ego.stats()["array"]["left_out"]
    told = {at: f"exchanged: it hears the robot as channel {other} was calibrated to" for at, other in left_out.items()}
    assert found == told


@pytest.mark.parametrize("factor", [1e-4, 0.05, 10.0])
def test_a_first_microphone_that_is_left_out_has_set_the_volume_of_no_other(factor: float) -> None:
    mic, ref, _ = talk()
    mic = mic.copy()
    mic[:, 0] *= factor
    ego = EgoFilter(calibration(3), engine="linear", keep_channels=True)
    ego.process(mic[: 2 * RATE], ref[: 2 * RATE])
    assert list(ego.stats()["array"]["left_out"]) == ["0"]
    assert abs(ego.stats()["linear_stage"]["gain_db"]) < 1.0
    span = slice(round(1.1 * RATE), round(1.9 * RATE))
    left = np.mean(ego.robot_removed()[span, 1:] ** 2, axis=0)
    assert np.all(left < 0.05 * np.mean(mic[span, 1:] ** 2, axis=0))


@pytest.mark.parametrize("level", [1.0, 3e-4])
def test_a_loopback_beside_one_microphone_is_the_one_that_is_left_out(level: float) -> None:
    mic, ref = (x[: 3 * RATE] for x in talk()[:2])
    ego = EgoFilter(engine="ss")
    both = level * np.stack((20.0 * np.roll(ref, 40), mic[:, 0]), axis=1)
    ego.process(both.astype(np.float32), ref)
    assert ego.stats()["array"]["left_out"] == {"0": "what is played, not a microphone"}


def test_where_another_microphone_takes_the_place_of_the_first_the_delay_stays_what_it_is() -> None:
    mic, ref, _ = talk()
    mic = mic.copy()
    mic[:, :2] = 0.0  # the third hears the robot two samples later, by a path on the first one's clock
    ego = EgoFilter(calibration(3), engine="linear", keep_channels=True)
    ego.process(mic[: 3 * RATE], ref[: 3 * RATE])
    assert ego.stats()["array"] == {"microphones": 3, "reference": 2, "left_out": {"0": "silent", "1": "silent"}}
    assert ego.stats()["alignment"]["delay_samples"] == pytest.approx(calibration(3).delay, abs=0.2)
    last = slice(2 * RATE, 3 * RATE - 256)
    assert np.mean(ego.robot_removed()[last, 2] ** 2) < 0.02 * np.mean(mic[last, 2] ** 2)


def test_a_turn_that_is_told_late_begins_no_later() -> None:
    at_once, late, told = Turns(StftConfig(), None), Turns(StftConfig(), None), BargeIn(0.016)
    frames = np.stack([np.fft.rfft(noise(512, seed) * StftConfig().analysis_window) for seed in range(60)])
    for at, frame in enumerate(frames):
        for turns in (at_once, late):
            turns.step(frame, frame, None)
        if at == 40:
            at_once.start()
        if told.note(0.99 if at >= 40 else 0.0, wait=10) == "speech_started":
            assert at == 50
            late.start(told.waited)
    assert at_once.finish()[0] == late.finish()[0] > 0
    assert np.array_equal(at_once.finish()[1], late.finish()[1])


def test_a_turn_of_one_microphone_is_what_was_streamed() -> None:
    out, events = heard(1)
    (turn,) = [event.turn for event in events if event.turn]
    assert np.array_equal(turn.samples, out[turn.start : turn.start + turn.samples.size])
    assert turn.start <= 2.7 * RATE and turn.start + turn.samples.size >= 5 * RATE


def test_beginning_and_end_bring_what_was_streamed_from_300_ms_before_speech_was_suspected_or_had_stopped() -> None:
    out, events = heard(1)
    suspected, *told = [event for event in events if event.kind.startswith("speech")]
    assert suspected.sound is None and [event.kind for event in told] == ["speech_started", "speech_stopped"]
    assert told[0].sample > suspected.sample
    for event, before in zip(told, (suspected.sample, told[1].sample), strict=True):
        end = event.sound.start + event.sound.samples.size
        assert end == event.sample - 256 and 0.3 * RATE <= before - 256 - event.sound.start < 0.3 * RATE + 256
        assert np.array_equal(event.sound.samples, out[event.sound.start : end])


def test_a_turn_of_an_array_lies_where_it_was_streamed() -> None:
    out, events = heard(3)
    (turn,) = [event.turn for event in events if event.turn]
    streamed = out[turn.start : turn.start + turn.samples.size]
    span = slice(round(3.2 * RATE) - turn.start, round(4.8 * RATE) - turn.start)
    alike = turn.samples[span].dot(streamed[span])
    assert alike > 0.95 * np.linalg.norm(turn.samples[span]) * np.linalg.norm(streamed[span])
    assert not np.array_equal(turn.samples, streamed)


def test_frames_add_up_to_the_signal() -> None:
    stft, x = StftConfig(), noise(512 + 9 * 256, 11).astype(np.float32)
    frames = np.stack([np.fft.rfft(x[at : at + 512] * stft.analysis_window) for at in range(0, x.size - 511, 256)])
    np.testing.assert_allclose(overlap_add(frames, stft)[256:-256], x[256:-256], atol=1e-5)


def test_a_profile_keeps_all_microphones(tmp_path) -> None:
    profile = calibration(3)
    profile.save(tmp_path / "robot.npz")
    again = Profile.load(tmp_path / "robot.npz")
    assert again.microphones == 3 and calibration(1).microphones == 1
    assert np.array_equal(again.array.responses, profile.array.responses)
    assert np.array_equal(again.array.noise, profile.array.noise)
    # the second microphone hears the direct sound a sample later
    peaks = [int(np.argmax(np.abs(path))) for path in profile.running_responses()]
    assert np.diff(peaks).tolist() == [1, 1]


def test_the_calibrated_covariance_is_that_of_the_fan() -> None:
    stft = StftConfig()
    covariance = calibration(3).array.noise_covariance(stft)
    x = 1e-3 * fan(64000, 3, 4)
    frames = np.stack([np.fft.rfft(x[at : at + 512].T * stft.analysis_window) for at in range(0, 63000, 256)])
    measured = np.einsum("tif,tjf->ijf", frames, frames.conj()) / len(frames)
    inside = slice(4, 250)
    level = measured[0, 0, inside].real.mean()
    assert np.abs((covariance - measured)[..., inside]).mean() < 0.15 * level
    assert np.allclose(covariance[0, 0].real, calibration(3).noise_bins(stft), rtol=1e-4)


def test_a_calibration_says_what_is_doubtful_about_a_channel() -> None:
    sweep = generate_sweep()
    heard = np.stack([np.convolve(sweep, path)[: sweep.size] for path in PATHS[:3]], 1) + 1e-3 * fan(sweep.size, 3, 3)
    quiet = 1e-3 * fan(64000, 3, 4)
    heard[:, 2], quiet[:, 2] = heard[:, 0], quiet[:, 0]
    heard[:, 1] *= 5.0
    quiet[:, 1] *= 5.0
    said = "; ".join(calibrate(sweep, heard.astype(np.float32), quiet.astype(np.float32)).warnings)
    assert "channel 1: the fan is 14 dB louder" in said and "channel 2: the same sound as channel 0" in said
    heard[:, 1] = 0.0
    with pytest.raises(CalibrationError, match="channel 1 of the sweep recording is silent"):
        calibrate(sweep, heard.astype(np.float32), quiet.astype(np.float32))
    with pytest.raises(CalibrationError, match="has 3 channels and the noise recording 2"):
        calibrate(sweep, heard.astype(np.float32), quiet[:, :2].astype(np.float32))


@pytest.mark.slow
def test_an_array_learns_and_its_profile_is_adapted_in_all_microphones() -> None:
    mic, ref, _ = talk()
    profile = calibration(3)
    ego = EgoFilter(profile, engine="linear", learn=PathLearner(profile))
    ego.process(0.5 * mic, ref)
    adapted = ego.adapted_profile()
    assert adapted.microphones == 3
    before, after = (np.linalg.norm(one.running_responses()[:, :1000], axis=1) for one in (profile, adapted))
    np.testing.assert_allclose(after / before, 0.5, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("microphones", [1, 3])
def test_each_microphone_is_given_with_the_robot_removed_where_asked(microphones: int) -> None:
    mic, ref = (x[: 5 * RATE] for x in talk()[:2])
    mics = mic[:, :microphones] if microphones > 1 else mic[:, 0]
    ego = EgoFilter(calibration(microphones), engine="linear", keep_channels=True)
    parts = []
    for at in range(0, ref.size, 5000):
        ego.process(mics[at : at + 5000], ref[at : at + 5000])
        parts.append(ego.robot_removed())
    removed = np.concatenate(parts)
    assert removed.shape == (ref.size // 256 * 256, microphones) and ego.robot_removed().shape == (0, microphones)
    second = slice(RATE, 2 * RATE)
    before = np.mean(np.reshape(mics, (ref.size, -1))[second] ** 2, axis=0)
    assert np.all(np.mean(removed[second] ** 2, axis=0) < 0.02 * before)
    human = slice(round(3.2 * RATE), round(4.8 * RATE))  # in its place: what is left there is the human
    alike = [np.corrcoef(one, np.roll(talk()[2], -2 * at)[human])[0, 1] for at, one in enumerate(removed[human].T)]
    assert min(alike) > 0.9
    quiet = EgoFilter(calibration(microphones), engine="linear")
    quiet.process(mics[:5000], ref[:5000])
    assert quiet.robot_removed().size == 0
