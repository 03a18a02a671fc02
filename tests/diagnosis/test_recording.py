"""One recording is straightened once for every question; the likelihood: noise that is expected is neither free nor forbidden."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis import recording as asked
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import Recording, add, compare, diagnose
from edgefilter.dsp.psd import total_power
from edgefilter.echo.model import EchoModel
from tests.diagnosis.robot_scene import profile, record, voice


@pytest.fixture(scope="module")
def noisy():
    """A robot with noise that its fan is not, as loud as ten fans and of their colour; that recording, and that noise as a model says it."""
    x, robot = voice(6.0), profile()
    noise = np.random.default_rng(7).standard_normal(x.size) * np.sqrt(9.0 * total_power(robot.noise_psd))
    prepared = prepare(robot, (record(x) + noise).astype(np.float32), x)
    prepared = replace(prepared, measurement=replace(prepared.measurement, noise_psd=robot.noise_psd), ordinary=())
    psd = robot.noise_psd.astype(float)
    variance = np.full(x.size, 9.0 * total_power(robot.noise_psd), np.float32)
    return prepared, prepared.model, variance, psd / (np.sum(psd) * 8000 / (psd.size - 1))


@dataclass(frozen=True, eq=False)
class Noisy(EchoModel):
    """A model that says of itself what noise it adds."""

    sources: tuple = ()

    def unpredictable(self, reference):
        return self.sources


def scored(noisy, times):
    recording, model, variance, colour = noisy
    sources = ((times * variance, colour),) if times else ()
    return recording.of(Noisy(model.impulse_response, sources=sources))


def test_noise_that_is_there_explains_and_more_or_less_of_it_explains_less(noisy):
    levels = {times: scored(noisy, times).level_db for times in (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)}
    assert min(levels, key=levels.get) == 1.0
    assert levels[0.0] > levels[0.1] > levels[0.3] > levels[1.0] < levels[3.0] < levels[10.0]


def test_noise_that_is_expected_costs_half_of_its_decibels(noisy):
    right = scored(noisy, 1.0)
    assert right.level_db == pytest.approx(5.0, abs=0.4) and right.over_db == pytest.approx(0.0, abs=0.4)
    far = scored(noisy, 0.0)
    assert far.level_db == far.over_db == pytest.approx(10 * np.log10(11 / 2), abs=0.4)


@pytest.mark.parametrize(("louder_db", "gain_db"), [(6.0, 1.0), (-10.0, 2.4)])
def test_another_fan_is_paid_or_charged_half_of_its_decibels(louder_db, gain_db):
    """Of a robot that keeps silent: what the level is with the calibrated fan, and with the one that is heard."""
    x, robot = voice(6.0), profile()
    fan = 10 ** (louder_db / 20) * record(0.0 * x)
    prepared = prepare(robot, record(x) - record(0.0 * x) + fan, x)
    prepared = replace(prepared, measurement=replace(prepared.measurement, noise_psd=robot.noise_psd))
    recording, changed = prepared, prepared.model.with_effect("fan_noise", {"spectrum_db": louder_db})
    before, after = recording.of(prepared.model), recording.of(changed)
    assert after.over_db == pytest.approx(0.0, abs=0.3) and after.silent_db == pytest.approx(0.0, abs=0.3)
    assert before.silent_db == pytest.approx(louder_db, abs=0.3)
    assert before.level_db - after.level_db == pytest.approx(gain_db, abs=0.3)


def test_a_fan_is_expected_as_it_was_until_it_changes():
    x, robot = voice(8.0), profile()
    gain = np.where(np.arange(x.size) < x.size // 2, 1.0, 4.0).astype(np.float32)
    prepared = prepare(robot, record(x) + (gain - 1.0) * record(0.0 * x), x)
    model = prepared.model.with_effect("fan_noise", {"spectrum_db": 20 * np.log10(4.0), "from_s": 4.0})
    score = prepared.of(model)
    assert np.ptp(10 * np.log10(score.cells.mean(axis=1))) < 3.0 and abs(score.over_db) < 0.5
    assert abs(score.excess_db) < 0.5 and abs(score.silent_db) < 0.5


def test_a_gain_behind_the_microphone_is_expected_on_the_fan_as_well():
    x, robot = voice(6.0), profile()
    gain = 10 ** (np.interp(np.arange(x.size), [0, x.size], [6.0, -12.0]) / 20).astype(np.float32)
    prepared = prepare(robot, gain * record(x), x)
    curve = np.interp(np.arange(0.0, 6.1, 0.25), [0.0, 6.0], [6.0, -12.0])
    model, recording = prepared.model.with_effect("mic_agc", {"gain_db": curve}), prepared
    turned = model.passed(np.ones(x.size, np.float32), x)
    assert turned == pytest.approx(gain, rel=0.02)
    score = recording.of(model)
    assert np.ptp(10 * np.log10(score.cells.mean(axis=1))) < 3.0 and abs(score.over_db) < 0.5
    assert score.level_db < recording.of(prepared.model).level_db - 2.0


def test_a_recording_is_straightened_once_for_all_that_is_asked_of_it(monkeypatch) -> None:
    """Two further profiles hold the effect, and their clock may be another: what these leave is of a recording of their own."""
    straightened = []
    monkeypatch.setattr(asked, "prepare", lambda *of: straightened.append(of[0]) or prepare(*of))
    x, robot = voice(8.0), profile()
    y = record(x, robot.echo.with_effect("playback_gain", {"gain_db": -3.0}))
    recording = Recording(y, x, robot)
    compared, found, proof = recording.compare(), recording.diagnose(), recording.prove("playback_gain")
    assert [finding.effect for finding in found.ranking] == ["playback_gain"] and not proof.worse
    assert len(recording.probe([("playback_gain",), ("compression",)]).explanations) == 2
    assert straightened == [robot]
    added, settled = recording.add("playback_gain"), recording.settle(found, ["playback_gain"])
    assert straightened == [robot, added[0], settled[0]]
    assert compared.to_dict() == compare(robot, y, x).to_dict() and found.to_dict() == diagnose(robot, y, x).to_dict()
    again = add(robot, "playback_gain", y, x)
    assert [one.to_dict() for one in added[1:]] == [one.to_dict() for one in again[1:]]


def test_a_recording_without_a_profile_makes_one_of_itself() -> None:
    x = voice(6.0)
    recording = Recording(record(x), x)
    assert not recording.known and recording.profile.learned
    assert recording.compare().excess_db < 2.0  # six seconds teach a path to so much
    assert Recording(record(x), x, recording.profile).known


@pytest.mark.slow
def test_a_profile_made_of_the_recording_has_not_heard_the_seconds_of_the_proof(monkeypatch) -> None:
    heard = []
    monkeypatch.setattr(asked, "self_calibrate", lambda *of: heard.append(of[0].size) or self_calibrate(*of))
    x = voice(10.0)
    recording = Recording(record(x), x)
    found = recording.diagnose_proven()
    assert heard == [recording.mic.size, recording.held_out.cut] and found.comparison.recording.size <= heard[1]
