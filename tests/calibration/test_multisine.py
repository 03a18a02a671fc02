"""Calibration by multisines against simulated loudspeakers whose distortion is known, and what the profile is then good for.

All of it is simulated: no recording of a robot that was made without them holds multisines.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from scipy import fft, signal

from bench.simulate.simulated_robot import draw_loudspeaker
from edgefilter import Profile, calibrate, cli, diagnose, enhance, generate_sweep
from edgefilter.audio.files import FileSink
from edgefilter.calibration.multisine import BAND_HZ, SPEECH_DB, calibrate_multisine, generate_multisine, multisine_law
from edgefilter.diagnosis.recording import compare
from edgefilter.dsp.psd import total_power
from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import CalibrationError
from edgefilter.filter.residual_echo import LEAKAGE, Residual
from edgefilter.profile.data import GRID_HZ
from edgefilter.profile.text import describe
from tests.alignment.scene import at_another_clock
from tests.calibration.robot_room import fan, room
from tests.diagnosis.robot_scene import voice

FAN_RMS = 3e-4
PLAYED = generate_multisine()
QUIET = fan(96000, seed=2, rms=FAN_RMS).astype(np.float32)
MULTISINES = 120_000
SPEECH = Path(__file__).parents[2] / "edgefilter/demo_data/reference.flac"


def heard_through(path, sound, delay=300, rms=FAN_RMS):
    heard = np.concatenate((np.zeros(delay), signal.oaconvolve(sound, path)))[: sound.size]
    return (heard + fan(sound.size, rms=rms)).astype(np.float32)


def bent(x, square, cube):
    x = x.astype(np.float64)
    return x + square * x**2 + cube * x**3


def response_db(path):
    return 20 * np.log10(np.abs(signal.freqz(path, worN=GRID_HZ, fs=16000)[1]))


@pytest.fixture(scope="module")
def even():
    return calibrate_multisine(PLAYED, heard_through(room(), bent(PLAYED, 0.5, 0.0)), QUIET)


@pytest.fixture(scope="module")
def speaker():
    """The bench's moving coil with its force factor and suspension, driven as hard as a small robot's is."""
    return replace(draw_loudspeaker(np.random.default_rng(3)), drive=1.5)


@pytest.fixture(scope="module")
def recorded(speaker):
    return heard_through(room(), speaker.play(PLAYED.astype(np.float64)))


@pytest.fixture(scope="module")
def robot(recorded):
    return calibrate_multisine(PLAYED, recorded, QUIET)


def test_a_purely_even_distortion_is_found_even_and_as_strong_as_it_is(even):
    """a x^2 of a Gaussian x of power s has the power 2 a^2 s^2 beside its mean."""
    found = even.approximation
    power = 10 ** (found.level_db / 10)
    expected = 10 * np.log10(2 * 0.5**2 * power)
    np.testing.assert_allclose(found.over_linear_db("even"), expected, atol=1.0)
    # four realisations of 1500 lines are nearly Gaussian; an odd part as strong as this would be 25 dB higher
    assert (found.over_linear_db("odd")[1:] < expected[1:] - 20).all()
    assert even.warnings == ()


def test_a_purely_odd_distortion_is_found_odd_and_the_linear_gain_follows_the_level():
    """b x^3 of a Gaussian x of power s is 3 b s x and, beside it, of power 6 b^2 s^3 (Bussgang 1952)."""
    path = 0.5 * signal.firwin2(129, [0, 300, 1000, 3000, 8000], [0.2, 1.0, 1.0, 0.4, 0.1], fs=16000)
    cube = 2.0
    profile = calibrate_multisine(PLAYED, heard_through(path, bent(PLAYED, 0.0, cube)), QUIET)
    found = profile.approximation
    power = 10 ** (found.level_db / 10)
    grown = 1 + 3 * cube * power
    np.testing.assert_allclose(found.over_linear_db("odd")[1:], odd_db(cube, power)[1:], atol=2.0)
    assert (found.over_linear_db("even")[1:] < odd_db(cube, power)[1:] - 20).all()
    inside = (GRID_HZ > 150) & (GRID_HZ < 2000)  # above, speech has little and the softest level sinks into the fan
    for gain, more in zip(found.gain, grown, strict=True):
        error = 20 * np.log10(gain[inside] / more) - response_db(path)[inside]
        # 0.2 dB for the fan and the distortion in 60 Hz of lines; at the loudest level `more` is 1.8 dB
        assert np.max(np.abs(error)) < 0.5 and abs(np.mean(error)) < 0.2


def odd_db(cube, power):
    """Of the path's echo: behind a path the same, but for its colour, which is why it is 2 dB that are asked for."""
    return 10 * np.log10(6 * cube**2 * power**2 / (1 + 3 * cube * power) ** 2)


def test_the_noise_is_the_fan_at_every_level(even):
    for density in even.approximation.noise:
        assert abs(10 * np.log10(total_power(density) / FAN_RMS**2)) < 0.5
        middle = (GRID_HZ > 100) & (GRID_HZ < 4000)
        ratio = 10 * np.log10(density[middle] / even.noise_psd[middle])
        assert np.std(ratio) < 1.0  # 60 Hz of two periods and four realisations: 120 degrees of freedom, 0.6 dB


def left_of_noise_db(speaker, level_db, seconds=20):
    """What no linear filter explains of Gaussian noise with the spectrum of the multisines, dB over what it does: 1 - coherence."""
    n = seconds * 16000
    hz = fft.rfftfreq(n, 1 / 16000)
    shape = 10 ** (np.polynomial.Polynomial(SPEECH_DB)(np.log10(np.maximum(hz, 1))) / 20)
    shape[(hz < BAND_HZ[0]) | (hz > BAND_HZ[1])] = 0.0
    x = fft.irfft(shape * fft.rfft(np.random.default_rng(1).standard_normal(n)))
    x *= 10 ** (level_db / 20) / x.std()
    y = speaker.play(x)
    (_, pxx), (_, pyy), (_, pxy) = (signal.csd(a, b, 16000, nperseg=4096) for a, b in ((x, x), (y, y), (x, y)))
    explained = np.abs(pxy) ** 2 / np.maximum(pxx.real, 1e-20)
    return 10 * np.log10(np.sum(pyy.real - explained) / np.sum(explained))


@pytest.mark.slow
def test_the_distortion_of_the_bench_loudspeaker_is_that_which_noise_shows(speaker, recorded):
    """Without a room, whose colour would weigh the distortion."""
    sound = heard_through(np.array([0.15]), speaker.play(PLAYED.astype(np.float64)))
    found = calibrate_multisine(PLAYED, sound, QUIET).approximation
    for at in (1, 2):
        truth = left_of_noise_db(speaker, float(found.level_db[at]))
        assert truth < -10  # weakly nonlinear, as the method supposes
        assert abs(found.over_linear_db("even", "odd")[at] - truth) < 2


@pytest.mark.slow
def test_clocks_that_drift_are_straightened_and_said(even):
    recording = at_another_clock(heard_through(room(), bent(PLAYED, 0.5, 0.0)), 60)
    profile = calibrate_multisine(PLAYED, recording, QUIET)
    for name in ("even", "noise"):
        straight, drifted = (p.approximation.over_linear_db(name)[-1] for p in (even, profile))
        assert abs(straight - drifted) < 1.0, name  # left as it is, 60 ppm put -15 dB on the even lines
    assert any("clocks of player and recorder are 60 ppm apart" in text for text in profile.warnings)


def test_what_is_left_is_printed_for_each_volume(even):
    left = even.approximation.over_linear_db("noise", "even", "odd")
    softer = f"6 dB softer {left[1]:.0f}, 12 dB softer {left[0]:.0f}"
    assert f"at this volume the path leaves {left[2]:.0f} dB; {softer}" in describe(even)


def test_the_page_shows_what_is_printed(robot):
    page = (Path(__file__).parents[2] / "docs/calibrate.md").read_text(encoding="utf-8")
    lines = describe(robot).splitlines()
    first = next(at for at, line in enumerate(lines) if line.startswith("left of"))
    assert "\n".join(lines[first : first + 5]) in page


def test_the_reference_is_recognised_at_any_level_and_place():
    moved = np.pad(0.1 * PLAYED, (5000, 100)).astype(np.float32)
    law = multisine_law(moved)
    assert (law.start, law.first) == (13_000, MULTISINES + 5000)
    with pytest.raises(CalibrationError, match=r"\(7.5 s long\) is not the sweep with multisines of 25.4 s"):
        multisine_law(generate_sweep())
    with pytest.raises(CalibrationError, match="is not the sweep with multisines"):
        multisine_law(PLAYED[::-1].copy())


def test_wrong_recordings_are_one_line(recorded):
    other = recorded.copy()
    other[MULTISINES + 300 :] = fan(other.size - MULTISINES - 300, rms=0.01)
    slow = np.interp(np.arange(0, recorded.size, 44100 / 48000), np.arange(recorded.size), recorded)
    wrong = {
        "holds the sweep but not the multisines behind it": other,
        "ends before the multisines do, expected at least 25.9 s": recorded[:350_000],
        "does not contain the sweep": slow.astype(np.float32),
        "silent": np.zeros_like(recorded),
    }
    for said, recording in wrong.items():
        with pytest.raises(CalibrationError, match=said) as caught:
            calibrate_multisine(PLAYED, recording, QUIET)
        assert "\n" not in str(caught.value)


def test_a_recording_that_clips_or_that_somebody_talks_in_is_doubted(recorded):
    talked = recorded.copy()
    talked[200_000:300_000] += fan(100_000, seed=9, rms=0.01).astype(np.float32)
    limit = 0.6 * float(np.abs(recorded[MULTISINES:]).max())
    for recording, said in ((np.clip(recorded, -limit, limit), "clipped: .* multisines"), (talked, "something else")):
        warnings = calibrate_multisine(PLAYED, recording, QUIET).warnings
        assert any(re.search(said, text) for text in warnings), warnings


def test_the_profile_keeps_it_in_its_file_and_goes_without_as_before(robot, tmp_path):
    robot.save(tmp_path / "p.npz")
    kept = Profile.load(tmp_path / "p.npz")
    assert describe(kept) == describe(robot)
    for name, array in robot.approximation.arrays().items():
        assert kept.approximation.arrays()[name].tobytes() == array.tobytes()
    assert "at this volume" not in describe(replace(robot, approximation=None))


def test_the_expected_residual_starts_from_the_distortion(robot):
    stft = StftConfig()
    echo = np.full(stft.bins, 1.0 + 0j, np.complex64)
    quiet = np.zeros(stft.bins, np.float32)

    def first(profile):
        return Residual(stft, profile).step(echo, 0 * echo, quiet)[1].mean()

    plain = first(replace(robot, approximation=None))
    known = replace(robot.approximation, even=5 * robot.approximation.even)
    assert known.share > 3 * LEAKAGE  # so the two are not the same by chance
    assert first(replace(robot, approximation=known)) / plain == pytest.approx(known.share / LEAKAGE, rel=1e-3)


def test_ss_leaves_no_more_of_the_robot_than_with_a_sweep_alone(speaker, robot):
    said = 2 * voice(6.0)
    mic = heard_through(room(), speaker.play(said.astype(np.float64)))
    sweep = generate_sweep()
    swept = calibrate(sweep, heard_through(room(), speaker.play(sweep.astype(np.float64))), QUIET)
    left = [
        10 * np.log10(np.mean(enhance(mic, said, profile, engine="ss")[:48_000] ** 2)) for profile in (swept, robot)
    ]
    assert left[1] < left[0] + 0.1  # 0.1 dB: the fan differs by as much


def test_the_loudspeakers_own_distortion_is_no_finding_and_a_stronger_one_is(speaker, robot):
    """On speech, behind a fan that is 6 dB louder than elsewhere here: the distortion is 5 dB above it."""
    said = soundfile.read(SPEECH, frames=128_000, dtype="float32")[0]
    robot = replace(robot, noise_psd=4 * robot.noise_psd)

    def heard(drive):
        moved = replace(speaker, drive=drive * speaker.drive)
        return heard_through(room(), moved.play(said.astype(np.float64)), rms=2 * FAN_RMS)

    own = heard(1.0)
    assert compare(replace(robot, approximation=None), own, said).excess_db > 3.0
    found = diagnose(robot, own, said)
    assert found.comparison.excess_db < 0.3
    assert found.verdict == "explained" and not found.ranking
    assert compare(robot, heard(4.0), said).excess_db > 3.0


def test_the_command_writes_the_sound_and_makes_a_profile_of_its_recording(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", "--multisine", "--excitation", "play.wav", "--level-db", "-9.12"]) == 0
    for name, samples in (("heard.wav", recorded), ("fan.wav", QUIET)):
        with FileSink(tmp_path / name, float32=True) as sink:
            sink.write(samples)
    files = ["--sweep-reference", "play.wav", "--sweep-recording", "heard.wav", "--noise-recording", "fan.wav"]
    assert cli.main(["calibrate", "--multisine", *files, "--output", "robot.npz"]) == 0
    told = capsys.readouterr().out
    assert "27 s of sound to be played written to play.wav" in told and "at this volume the path leaves" in told
    assert Profile.load("robot.npz").approximation.level_db[-1] == pytest.approx(-14.0, abs=0.1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--excitation", "s.wav", "--live"], "leave --live out"),
        (["--excitation", "s.wav", "--output", "p.npz"], "not allowed with"),
        (["--multisine", "--excitation", "s.wav", "--level-db", "-3"], "expected at most -6"),
        (["--multisine", "--live"], "--output --excitation is required"),
    ],
)
def test_words_that_contradict_each_other_are_one_line(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", *words]) == 2
    line = capsys.readouterr().err
    assert said in line and line.count("\n") == 1 and not list(tmp_path.iterdir())
