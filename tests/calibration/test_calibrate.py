"""Calibration against simulated robots whose path, fan and distortion are known."""

import re

import numpy as np
import pytest
from scipy import signal

from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.sweep import generate_sweep, sweep_law
from edgefilter.errors import CalibrationError
from edgefilter.profile.data import GRID_HZ, Profile
from edgefilter.profile.text import describe
from edgefilter.types import PRE_ROLL
from tests.calibration.robot_room import FAN_RMS, fan, room


def record(played, path, delay=300, rms=FAN_RMS, extra=None):
    heard = np.concatenate((np.zeros(max(delay, 0)), signal.oaconvolve(played, path)))[max(-delay, 0) :][: played.size]
    heard = heard + fan(heard.size, rms=rms)
    return (heard if extra is None else heard + extra).astype(np.float32)


@pytest.fixture(scope="module")
def sweep():
    return generate_sweep()


@pytest.fixture(scope="module")
def quiet():
    return fan(96000, seed=2).astype(np.float32)


@pytest.fixture(scope="module")
def robot(sweep, quiet):
    return calibrate(sweep, record(sweep, room()), quiet)


def error_db(profile, path):
    """Energy of the difference to the true path over the path's, 100 to 7500 Hz, dB."""
    estimate = profile.echo.impulse_response.astype(float)
    truth = np.zeros(16000)
    truth[PRE_ROLL : PRE_ROLL + path.size] = path
    n = 32768
    band = slice(int(100 / 16000 * n), int(7500 / 16000 * n))
    difference = np.fft.rfft(estimate, n)[band] - np.fft.rfft(truth, n)[band]
    return 10 * np.log10(np.sum(np.abs(difference) ** 2) / np.sum(np.abs(np.fft.rfft(truth, n)[band]) ** 2))


def test_impulse_response_is_the_true_one_and_clean_calibrations_carry_no_warning(robot):
    assert robot.delay == 300 and robot.warnings == ()
    assert np.argmax(np.abs(robot.echo.impulse_response)) == PRE_ROLL
    # the fan alone allows about -55 dB here; a wrong tap, sign or gain costs more than the 10 dB of margin
    assert error_db(robot, room()) < -45


@pytest.mark.parametrize("delay", [-60, -1, 0, 1, 700, 20000])
def test_constant_offset_between_sweep_and_recording(sweep, quiet, delay):
    longer = np.pad(sweep, (0, 16000))
    profile = calibrate(longer, record(longer, room(), delay), quiet)
    assert profile.delay == delay and error_db(profile, room()) < -45


def test_inverted_loudspeaker_keeps_its_sign(sweep, quiet):
    assert error_db(calibrate(sweep, record(sweep, -room()), quiet), -room()) < -45


def test_prediction_of_speechlike_sound_leaves_little_more_than_the_fan(robot):
    rng = np.random.default_rng(9)
    voice = 0.1 * signal.lfilter([1, -1], [1, -0.9], rng.standard_normal(48000))
    heard = record(voice, room(), delay=PRE_ROLL)
    rest = heard - robot.echo.predict(voice.astype(np.float32))
    # fan is -40 dB of the echo; the calibration may add at most as much again (3 dB)
    assert 10 * np.log10(np.mean(rest[8000:] ** 2) / FAN_RMS**2) < 3


def test_tail_is_kept_as_long_as_the_room_sounds(sweep, quiet):
    long = calibrate(np.pad(sweep, (0, 16000)), record(np.pad(sweep, (0, 16000)), room(1.2, taps=20000)), quiet)
    short = calibrate(sweep, record(sweep, room(0.15)), quiet)
    assert short.echo.impulse_response.size == 6400 and 9000 < long.echo.impulse_response.size <= 16000
    for profile in (long, short):
        assert abs(profile.echo.impulse_response[-1]) < 1e-6


def test_regularisation_does_not_amplify_the_fan_where_the_path_is_deaf(sweep, quiet):
    deaf = signal.sosfilt(signal.butter(8, [1000, 4000], "bandpass", fs=16000, output="sos"), room())
    recording = record(sweep, deaf, rms=0.01)
    profile = calibrate(sweep, recording, 10 * quiet)
    path, n = profile.echo.impulse_response, 1 << 18
    start = int(profile.delay) - PRE_ROLL
    plain = np.fft.irfft(np.fft.rfft(recording, n) / np.fft.rfft(sweep, n), n)[start : start + path.size]
    band = slice(6000, 7500)  # Hz, of a 1 Hz grid; the path is 50 dB down there
    ours, divided = (np.sum(np.abs(np.fft.rfft(x, 16000)[band]) ** 2) for x in (path, plain))
    assert 10 * np.log10(ours / divided) < -10


def test_the_papers_response_is_the_magnitude_of_the_path(sweep, quiet):
    smooth = 0.5 * signal.firwin2(129, [0, 300, 1000, 3000, 8000], [0.2, 1.0, 1.0, 0.4, 0.1], fs=16000)
    expected = np.abs(signal.freqz(smooth, worN=GRID_HZ, fs=16000)[1])
    profile = calibrate(sweep, record(sweep, smooth), quiet)
    inside = (GRID_HZ > 60) & (GRID_HZ < 7800)
    level = 20 * np.log10(profile.response[inside] / expected[inside])
    # a 75 ms frame resolves 27 Hz, and |X| of sine plus fan is biased by the fan's share: both below 0.7 dB here
    assert np.max(np.abs(level)) < 0.7


def test_fan_psd_and_snr_follow_the_fan(sweep, quiet, robot):
    power = robot.noise_psd.sum() * 16000 / 1200
    assert abs(10 * np.log10(power / FAN_RMS**2)) < 0.3  # 6 s of noise: 0.1 dB
    louder = calibrate(sweep, record(sweep, room(), rms=10 * FAN_RMS), 10 * quiet)
    # ten times the fan is 20 dB less in each band; 2 dB for the fan's own fluctuation in the narrowest
    np.testing.assert_allclose(robot.band_snr_db - louder.band_snr_db, 20, atol=2)


def test_harmonic_distortion_per_order(sweep, quiet):
    """x + a x^2 + b x^3 on a tone of amplitude A: order 2 is a A / 2, order 3 is b A^2 / 4 of the fundamental."""
    bent = sweep + 0.2 * sweep**2 + 0.4 * sweep**3
    profile = calibrate(sweep, record(bent, np.array([0.5]), rms=1e-5), quiet * 0.01)
    amplitude = 0.35
    fundamental = 1 + 0.4 * amplitude**2 * 3 / 4
    expected = 20 * np.log10(np.array([0.2 * amplitude / 2, 0.4 * amplitude**2 / 4]) / fundamental)
    # the band's ends are cut: 0.5 dB
    np.testing.assert_allclose(profile.distortion_db[:2], expected, atol=0.5)
    assert (profile.distortion_db[2:] < -60).all()  # none was put in; order 2 leaves 35 dB less next to it


def test_clean_path_shows_no_distortion(robot):
    assert (robot.distortion_db < -50).all()


def warned(profile, pattern):
    text = "\n".join(profile.warnings)
    assert re.search(pattern, text), text
    assert f"WARNING     {profile.warnings[0]}" in describe(profile)


def test_clipping_is_named_with_its_frequencies(sweep, quiet):
    loud = record(sweep, np.array([1.0]) @ np.array([[1.0]]))
    peaked = (
        signal.oaconvolve(loud, signal.firwin(257, [700, 1400], pass_zero=False, fs=16000), "same") * 2 + loud * 0.5
    )
    warned(
        calibrate(sweep, np.clip(2 * peaked, -1, 1).astype(np.float32), quiet),
        r"^clipped: \d+ samples at 1.00 of full scale, [5-7]\d\d-1[3-7]\d\d Hz",
    )
    warned(calibrate(sweep, np.clip(peaked, -0.5, 0.5).astype(np.float32), quiet), "clipped: .* at 0.50 of full scale")


def test_too_quiet_and_low_snr_bands(sweep, quiet):
    warned(
        calibrate(sweep, record(sweep, 0.01 * room(), rms=1e-5), 0.01 * quiet),
        "too quiet: the recording peaks at -[45]\\d dB",
    )
    hidden = (
        signal.oaconvolve(fan(150000, seed=8), signal.firwin(513, [400, 800], pass_zero=False, fs=16000))[: sweep.size]
        * 300
    )
    noisy = (
        signal.oaconvolve(fan(150000, seed=9), signal.firwin(513, [400, 800], pass_zero=False, fs=16000))[:96000] * 300
    )
    profile = calibrate(sweep, record(sweep, room(), extra=hidden), (quiet + noisy).astype(np.float32))
    warned(profile, r"low signal-to-noise ratio, below 10 dB, in (355|447)-(708|891) Hz \(")


def test_recording_that_ends_early(sweep, quiet):
    warned(calibrate(sweep, record(sweep, room())[:100000], quiet), r"too short: .* \d+-\d+ Hz is missing")
    with pytest.raises(CalibrationError, match="ends before the sweep reaches 1 kHz"):
        calibrate(sweep, record(sweep, room())[:40000], quiet)


def test_a_voice_during_the_sweep_or_in_the_fan(sweep, quiet):
    rng = np.random.default_rng(4)
    burst = np.zeros(sweep.size)
    burst[60000:70000] = 0.08 * rng.standard_normal(10000)
    warned(
        calibrate(sweep, record(sweep, room(), extra=burst), quiet),
        r"something else than the sweep sounds in 0.[257]\d? s .*from 3.75 s on",
    )
    spoken = quiet.copy()
    spoken[30000:40000] += 0.005 * rng.standard_normal(10000).astype(np.float32)
    warned(calibrate(sweep, record(sweep, room()), spoken), "noise recording is not steady")


def test_robot_in_the_noise_recording(sweep, quiet):
    recording = record(sweep, room())
    warned(calibrate(sweep, recording, (quiet + 0.3 * recording[:96000])), "noise recording contains the sweep")


def test_early_arrivals_beyond_the_pre_roll_are_reported(sweep, quiet):
    path = np.concatenate((np.zeros(PRE_ROLL + 40), room()))
    path[0] = 0.15
    warned(calibrate(sweep, record(sweep, path), quiet), "arrives more than \\d+ samples before")


def test_short_and_silent_noise(sweep, quiet):
    warned(calibrate(sweep, record(sweep, room()), quiet[:16000]), "only 1.0 s long")
    warned(calibrate(sweep, record(sweep, room()), np.zeros(64000, np.float32)), "noise recording is silent")
    with pytest.raises(CalibrationError, match="0.06 s long, expected at least 0.5 s"):
        calibrate(sweep, record(sweep, room()), quiet[:1000])


def test_wrong_files(sweep, quiet):
    rng = np.random.default_rng(0)
    tone = np.sin(np.arange(120000) * 0.3).astype(np.float32)
    wrong = {
        "noise": 0.1 * rng.standard_normal(120000).astype(np.float32),
        "tone": tone,
        "backwards": sweep[::-1].copy(),
        "fan": fan(120000).astype(np.float32),
    }
    for name, recording in wrong.items():
        with pytest.raises(CalibrationError, match="does not contain the sweep") as caught:
            calibrate(sweep, recording, quiet)
        assert "\n" not in str(caught.value), name
    with pytest.raises(CalibrationError, match="is silent"):
        calibrate(sweep, np.zeros(120000, np.float32), quiet)
    stepped = np.sin(2 * np.pi * np.cumsum(np.repeat(np.arange(0, 1600, 13), 1600)) / 16000).astype(np.float32)
    for reference in (tone, wrong["noise"], sweep[::-1].copy(), stepped):
        with pytest.raises(CalibrationError, match="not an exponential sweep"):
            calibrate(reference, record(sweep, room()), quiet)
    with pytest.raises(CalibrationError, match="peaks at 0"):
        calibrate(np.zeros(120000, np.float32), record(sweep, room()), quiet)


def test_not_finite_integer_and_stereo_input(sweep, quiet):
    broken = record(sweep, room())
    broken[777] = np.nan
    with pytest.raises(CalibrationError, match="the sweep recording holds nan at sample 777"):
        calibrate(sweep, broken, quiet)
    with pytest.raises(CalibrationError, match="the noise recording has dtype int16"):
        calibrate(sweep, record(sweep, room()), np.zeros(64000, np.int16))
    with pytest.raises(CalibrationError, match="the sweep reference has shape"):
        calibrate(np.stack((sweep, sweep)), record(sweep, room()), quiet)


def test_callers_arrays_are_left_alone_and_the_result_is_repeatable(sweep, quiet, robot):
    arrays = [sweep.copy(), record(sweep, room()), quiet.copy()]
    for array in arrays:
        array.flags.writeable = False
    again = calibrate(*arrays)
    assert again.echo.impulse_response.tobytes() == robot.echo.impulse_response.tobytes()


def test_sweep_law_is_that_of_the_generated_sweep():
    for seconds in (2.0, 6.0, 10.0):
        law = sweep_law(generate_sweep(seconds, amplitude=0.1))
        assert abs(law.low_hz - 40) < 1.5
        assert abs(law.rate / (seconds * 16000 / np.log(7990 / 40)) - 1) < 0.02  # 1 % from rounding f1 T


def test_profile_survives_the_file_and_its_description_has_the_figures(robot, tmp_path):
    robot.save(tmp_path / "p.npz")
    text = describe(Profile.load(tmp_path / "p.npz"))
    assert text == describe(robot)
    assert "direct sound at 300 samples (18.8 ms)" in text and "nothing doubtful" in text
    assert f"{robot.band_snr_db[10]:.1f} dB" in text
