"""Defects of the diagnosis, each by its symptom."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from edgefilter.cli import main
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.precision import precision
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import Recording, add, compare, diagnose
from edgefilter.diagnosis.straightened import bands
from edgefilter.diagnosis.trials import Found, Workbench
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.effect import Effect, Parameter
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.catalogue import find, register
from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import Profile
from edgefilter.report.html import compare_variants
from edgefilter.types import PRE_ROLL
from tests.diagnosis.robot_scene import DELAY, FAN, path, profile, record, voice

RATE = 16000


def gained(recording: np.ndarray, gain_db: np.ndarray) -> np.ndarray:
    """recording (n,) behind a gain of 40 knots a second."""
    n = np.arange(recording.size) * 40 / RATE
    return (recording * 10 ** (np.interp(n, np.arange(gain_db.size), gain_db) / 20)).astype(np.float32)


@pytest.mark.slow
def test_one_recording_has_one_excess_in_compare_add_diagnose_and_report_when_the_profile_holds_a_microphone_gain() -> (
    None
):
    x, gain_db = voice(6.0), 6 * np.hanning(320)
    plain = profile()
    robot = plain.with_echo(plain.echo.with_effect("mic_agc", {"gain_db": gain_db, "knots_hz": 40.0}))
    recording = gained(record(x, plain.echo.with_effect("playback_gain", {"gain_db": -2.0})), gain_db)
    compared = compare(robot, recording, x).excess_db
    _, before, _ = add(robot, "playback_gain", recording, x)
    found = diagnose(robot, recording, x)
    assert [finding.effect for finding in found.ranking] == ["playback_gain"]
    shown = compare_variants(Recording(recording, x, robot).straightened, found.model, found.ranking)
    assert compared > 1.0
    told = (before.excess_db, found.comparison.excess_db, found.ranking[0].excess_before_db, shown[(False,)].excess_db)
    assert told == pytest.approx((compared,) * 4, abs=1e-6)
    assert shown[(True,)].excess_db == pytest.approx(found.remaining_db, abs=1e-6)


def test_a_rattle_in_the_profile_counts_in_compare_as_it_does_in_diagnose() -> None:
    x = voice(6.0)
    knocks = {"threshold": 0.02, "power": 1e-3, "decay_ms": 4.0}
    robot = profile().with_echo(profile().echo.with_effect("rattle", knocks))
    recording = record(x)
    assert compare(robot, recording, x).excess_db == pytest.approx(
        diagnose(robot, recording, x).comparison.excess_db, abs=1e-9
    )
    assert compare(robot, recording, x).excess_db < compare(profile(), recording, x).excess_db


def test_a_fan_of_digital_zeros_gives_figures_and_no_infinities() -> None:
    x = voice(4.5)
    robot = replace(profile(), noise_psd=np.zeros(601, np.float32))
    clean = np.round(EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)) * 2**15) / 2**15
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = compare(robot, clean.astype(np.float32), x)
        said = diagnose(robot, clean.astype(np.float32), x)
    figures = json.dumps(found.to_dict(), allow_nan=False), json.dumps(said.to_dict(), allow_nan=False)
    assert all("Infinity" not in text for text in figures)
    assert np.isfinite(found.excess_db) and -110.0 < found.noise_floor_db < -90.0  # rounding to 16 bit is at -101 dB
    # what differs by rounding alone is no excess; the path's tolerance (-38 dB of the voice) is another matter
    assert [finding.effect for finding in said.ranking if finding.effect == "fan_noise"] == []


@pytest.mark.slow
def test_the_words_name_a_band_of_the_scorer() -> None:
    x = voice(6.0)
    clean = EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL))
    tone = signal.sosfilt(signal.butter(4, [1500, 2000], "band", fs=RATE, output="sos"), clean)
    ring = tone * np.sin(2 * np.pi * 170 * np.arange(x.size) / RATE)
    recording = (clean + 0.5 * ring + FAN * np.random.default_rng(3).standard_normal(x.size)).astype(np.float32)
    found = diagnose(profile(), recording, x)
    places = {f"strongest around {low:.0f} to {high:.0f} Hz" for low, high in bands().hz}
    assert found.verdict == "unexplained" and any(place in found.evidence for place in places), found.evidence


class Fragile(Effect):
    """A delay of one sample, mixed in, and how much of it is told once more; its fit fails as asked."""

    name, stage, title, complexity = "fragile", "path", "a fragile thing", 0
    parameters = (Parameter("amount", "1", 0.0, -1.0, 1.0), Parameter("read_off", "1", 0.0, -1.0, 1.0))
    failures: list[Exception] = []

    def apply(self, x, values, sample_rate):
        return (x + values["amount"] * np.append(0, x[:-1])).astype(np.float32)

    def fit(self, measurement, model):
        if self.failures:
            raise self.failures.pop()
        predicted, white = measurement.predicted(model)[1], measurement.white_recording
        late = np.append(0, predicted[:-1]) * measurement.weights
        amount = float(np.clip(np.dot(white - predicted, late) / np.dot(late, late), -1, 1))
        return {"amount": amount, "read_off": amount}


@pytest.fixture
def fragile(monkeypatch) -> Fragile:
    effect = Fragile()
    monkeypatch.setattr(Fragile, "failures", [])
    register(effect)
    return effect


@pytest.mark.parametrize(("failing", "known"), [(1, True), (3, False)])
def test_an_interval_fit_that_fails_does_not_kill_a_finished_diagnosis(fragile, failing, known) -> None:
    x = voice(6.0)
    prepared = prepare(profile(), record(x, EchoModel(path()).with_effect("fragile", {"amount": 0.4})), x)
    bench = Workbench(prepared, Criteria())
    step = bench.attempt("fragile", prepared.model)
    found = Found(prepared, prepared.model, step.model, bench.score(prepared.model), step.score, (step,))
    fragile.failures.extend([np.linalg.LinAlgError("Singular matrix")] * failing)
    _, intervals, doubts = precision(found)
    moved, interval = intervals["fragile"].values()
    assert 0.3 < moved.low < moved.high < min(0.5, moved.low + 0.01), "known without a further fit"
    assert len(doubts) == failing and "Singular matrix" in doubts[0] and "fragile" in doubts[0]
    assert (interval.low > 0.3 and interval.high < 0.5) if known else (interval.low, interval.high) == (-1.0, 1.0)


def test_a_fit_that_fails_is_a_note_in_the_diagnosis_and_no_python_warning(fragile) -> None:
    x = voice(4.5)
    fragile.failures.extend([np.linalg.LinAlgError("Singular matrix")] * 50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = diagnose(profile(), record(x, EchoModel(path()).with_effect("playback_gain", {"gain_db": -3.0})), x)
    assert [finding.effect for finding in found.ranking] == ["playback_gain"]
    assert [
        text
        for text in found.to_dict()["warnings"]
        if "fragile could not be fitted" in text and "Singular matrix" in text
    ]


def test_a_search_says_what_it_has_found_so_far() -> None:
    x, said = voice(4.5), []
    clipped = np.clip(0.5 * record(x), -0.01, 0.01)
    diagnose(profile(), clipped, x, progress=said.append, criteria=Criteria(most_effects=2))
    assert said[0].startswith("trying") and "so far" not in said[0]
    assert any(re.fullmatch(r"trying \w+; so far [\w ]+: -?\d+\.\d dB left", text) for text in said)


def test_a_search_that_is_cut_short_says_so() -> None:
    x = voice(4.5)
    found = diagnose(
        profile(),
        record(
            x, EchoModel(path()).with_effect("late_reverb", {"taps": np.r_[np.zeros(900), 0.3, np.zeros(300), 0.2]})
        ),
        x,
        criteria=Criteria(most_fits=3),
    )
    assert any("search was stopped after" in text for text in found.comparison.warnings)
    assert found.verdict in ("missing", "unexplained")


JUMP = {"times_s": 4.3, "samples": 37.0}


def test_a_jump_is_not_replayed_in_another_recording() -> None:
    x, other = voice(6.5), voice(6.5, seed=21)
    jumped, later = record(x, EchoModel(path()).with_effect("delay_jump", JUMP)), record(other, seed=22)
    knowing, before, after = add(profile(), "delay_jump", jumped, x)
    assert after.excess_db < 0.5 < 3.0 < before.excess_db
    assert (
        compare(knowing, jumped, x).excess_db == after.excess_db
    )  # the recording in which it happened is still explained
    assert compare(knowing, later, other).excess_db == compare(profile(), later, other).excess_db < 0.5
    assert diagnose(knowing, later, other).verdict == "explained"


@pytest.mark.slow
def test_a_jump_stays_with_its_recording_through_the_files_and_add_says_so(tmp_path, capsys) -> None:
    import soundfile as sf

    x = voice(6.5)
    jumped = record(x, EchoModel(path()).with_effect("delay_jump", JUMP))
    for name, samples in (("mic", jumped), ("ref", x), ("other", record(x, seed=5))):
        sf.write(tmp_path / f"{name}.wav", samples, RATE, "PCM_16")
    profile().save(tmp_path / "robot.npz")

    def run(command: str, recording: str, robot: str, *more: str) -> str:
        files = [
            "--profile",
            tmp_path / robot,
            "--recording",
            tmp_path / recording,
            "--reference",
            tmp_path / "ref.wav",
        ]
        assert main([*command.split(), *map(str, (*files, *more))]) == 0
        return capsys.readouterr().out

    out = run("add delay_jump", "mic.wav", "robot.npz", "--output", str(tmp_path / "knowing.npz"))
    happened, at_run_time = [line for line in out.splitlines() if line.startswith("NOTE")]
    assert "delay_jump happened in this recording" in happened and "fingerprint" not in out
    assert "the running filter" in at_run_time
    assert Profile.load(tmp_path / "knowing.npz").echo.effects[0][1]["recording"] > 0
    told = {
        name: json.loads(run("compare", f"{name}.wav", "knowing.npz", "--json", "-"))["excess_db"]
        for name in ("mic", "other")
    }
    assert told["mic"] < 0.5 and told["other"] < 0.5
    out = run("add playback_gain", "mic.wav", "robot.npz", "--output", str(tmp_path / "gain.npz"))
    assert "NOTE" not in out


@pytest.mark.parametrize("name", [effect.name for effect in catalogue.EFFECTS])
def test_what_lasts_has_no_recording_and_what_happens_has_one(name: str) -> None:
    moment = find(name).event or find(name).stage == "noise"  # when the fan changed
    assert ("recording" in {p.name for p in find(name).parameters}) is moment
    assert "recording" not in {p.name for p in find(name).told}


def coloured(x: np.ndarray) -> np.ndarray:
    """x (n,) with another loudspeaker's colour: a broad change by 3 dB within 2 ms, no reverberation."""
    taps = np.zeros(40)
    taps[[0, 7, 19, 33]] = 1.0, 0.3, -0.2, 0.15
    return signal.lfilter(taps, [1.0], x)


@pytest.mark.slow
def test_another_colour_of_the_loudspeaker_is_not_called_late_reverberation() -> None:
    x = voice(6.0)
    clean = coloured(EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)))
    found = diagnose(profile(), (clean + FAN * np.random.default_rng(3).standard_normal(x.size)).astype(np.float32), x)
    assert "late_reverb" not in [finding.effect for finding in found.ranking]
    assert found.comparison.excess_db > 3.0


@pytest.mark.slow
def test_a_room_that_sounds_longer_is_called_late_reverberation() -> None:
    x, rng = voice(6.0), np.random.default_rng(8)
    tail = np.arange(RATE // 2)
    room = np.concatenate((np.zeros(60), 0.01 * rng.standard_normal(tail.size) * np.exp(-6.9 * tail / (0.6 * RATE))))
    clean = EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)).astype(float)
    heard = clean + signal.fftconvolve(clean, room)[: x.size]
    found = diagnose(profile(), (heard + FAN * rng.standard_normal(x.size)).astype(np.float32), x)
    assert [finding.effect for finding in found.ranking] == ["late_reverb"]
