"""The whole loop on a small robot: what is hidden is named, nothing is named where nothing is, what is added lowers the error."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from edgefilter.diagnosis import select
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import conclude, holds
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import add, compare, diagnose
from edgefilter.diagnosis.result import Diagnosis
from edgefilter.diagnosis.select import search
from edgefilter.diagnosis.straightened import Score, bands
from edgefilter.diagnosis.trials import Found, Trial, Workbench
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.effects import early_path, late_reverb
from edgefilter.echo.effects.bandlimit import band_edge
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.late_reverb import fit_path
from edgefilter.echo.model import EchoModel
from edgefilter.echo.wiener import spectra
from edgefilter.types import PRE_ROLL
from tests.diagnosis.robot_scene import DELAY, FAN, livelier, path, profile, record, voice

SECONDS = 9.0


def fan(seed: int = 3) -> np.ndarray:
    return FAN * np.random.default_rng(seed).standard_normal(round(SECONDS * 16000))


def echo(x: np.ndarray) -> np.ndarray:
    return EchoModel(path()).predict(delayed(x, DELAY - PRE_ROLL)).astype(float)


def names(found: Diagnosis) -> list[str]:
    return [finding.effect for finding in found.ranking]


def test_nothing_is_missing_where_nothing_is_hidden() -> None:
    x = voice(SECONDS)
    # the ordinary: 0.1 dB of gain, a fan 0.4 dB up, a faint squared term 10 dB under the fan
    recording = 1.0116 * echo(x) + 1.047 * fan() + 0.3 * FAN * np.clip(echo(x) ** 2 / np.std(echo(x) ** 2), -3, 3)
    found = diagnose(profile(), recording.astype(np.float32), x)
    assert (found.verdict, names(found), found.evidence) == ("explained", [], "")


@pytest.mark.parametrize(
    ("effect", "change"),
    [
        ("playback_gain", lambda x: echo(x) * 10 ** (-0.9 / 20)),
        (
            "chassis_resonance",
            lambda x: echo(x) + 0.5 * signal.lfilter(*signal.iirpeak(700.0, 50.0, fs=16000), echo(x)),
        ),
        ("bandlimit", lambda x: signal.sosfilt(signal.butter(5, 3400.0, fs=16000, output="sos"), echo(x))),
        ("mic_clipping", lambda x: np.clip(echo(x), -0.06, 0.06)),
        (
            "fan_noise",
            lambda x: (
                echo(x) + 1.5 * signal.sosfilt(signal.butter(2, [300, 900], "band", fs=16000, output="sos"), fan(9)) * 2
            ),
        ),
    ],
)
def test_one_hidden_effect_is_named_alone_and_leaves_nothing(effect: str, change) -> None:
    x = voice(SECONDS)
    found = diagnose(profile(), (change(x) + fan()).astype(np.float32), x)
    assert (found.verdict, names(found)) == ("missing", [effect])
    assert found.remaining_db < 1.0  # the product's promise for linear effects and clipping
    assert found.ranking[0].share > 0.6
    intervals, bounds = found.ranking[0].parameters.values(), {p.name: p for p in find(effect).parameters}
    for name, interval in found.ranking[0].parameters.items():
        assert np.all(np.asarray(interval.low) >= bounds[name].low) and np.all(
            np.asarray(interval.high) <= bounds[name].high
        )
    assert any(np.any(np.asarray(interval.high) > np.asarray(interval.low)) for interval in intervals)
    for interval in intervals:
        assert np.all(np.asarray(interval.low) <= np.asarray(interval.value)) and np.all(
            np.asarray(interval.value) <= np.asarray(interval.high)
        )


@pytest.mark.slow
def test_two_effects_at_once_are_both_found() -> None:
    x = voice(SECONDS)
    clipped = np.clip(echo(x) + 0.6 * signal.lfilter(*signal.iirpeak(1200.0, 30.0, fs=16000), echo(x)), -0.06, 0.06)
    found = diagnose(profile(), (clipped + fan()).astype(np.float32), x)
    assert sorted(names(found)) == ["chassis_resonance", "mic_clipping"]
    assert found.remaining_db < 1.0


def test_a_gain_control_is_found_beside_another_room_without_which_it_does_not_look_like_one() -> None:
    """Its sign is a fan that moves with the gain, and that is only seen where nothing of the voice is left."""
    x = voice(10.0)
    gain = 10 ** (0.15 * np.sin(2 * np.pi * 0.2 * np.arange(x.size) / 16000))
    found = diagnose(profile(), (gain * record(x, EchoModel(livelier()))).astype(np.float32), x)
    assert sorted(names(found)) == ["late_reverb", "mic_agc"]
    assert found.remaining_db < 1.5


@pytest.mark.slow
def test_a_drift_and_a_band_limit_are_told_with_what_they_are() -> None:
    x, truth = voice(SECONDS), {"clock_drift": {"ppm": 80.0}, "bandlimit": {"cutoff_hz": 3300.0}}
    found = diagnose(profile(), record(x, EchoModel(path(), tuple(truth.items()))), x)
    told = {finding.effect: finding.parameters for finding in found.ranking}
    assert found.verdict == "missing" and told.keys() == truth.keys() and found.remaining_db < 0.5
    assert told["clock_drift"]["ppm"].value == pytest.approx(80.0, abs=2.0)
    assert told["bandlimit"]["cutoff_hz"].value == pytest.approx(3300.0, rel=0.05)


@pytest.mark.slow
def test_a_search_that_ends_at_its_most_effects_says_so() -> None:
    x = voice(SECONDS)
    clipped = np.clip(echo(x) + 0.6 * signal.lfilter(*signal.iirpeak(1200.0, 30.0, fs=16000), echo(x)), -0.06, 0.06)
    prepared = prepare(profile(), (clipped + fan()).astype(np.float32), x)
    found = search(prepared, profile().echo, Criteria(most_effects=1))
    assert [note for note in found.notes if note.startswith("the search ended at 1 effects")]


def test_a_turned_volume_is_found_beside_a_fan_that_hides_it() -> None:
    x = voice(SECONDS)
    louder = 2.0 * signal.sosfilt(signal.butter(2, [300, 900], "band", fs=16000, output="sos"), fan(9)) * 2
    found = diagnose(profile(), (0.8 * echo(x) + fan() + louder).astype(np.float32), x)
    assert (found.verdict, sorted(names(found))) == ("missing", ["fan_noise", "playback_gain"])
    assert found.remaining_db < 0.5


@pytest.mark.slow
def test_things_that_slam_now_and_then_are_no_fan() -> None:
    x = voice(SECONDS)
    slams = np.zeros(x.size)
    for at in (1.6, 3.7, 5.65):
        part = slams[round(at * 16000) :][:3200]
        part += (
            40 * FAN * np.random.default_rng(round(at)).standard_normal(part.size) * np.exp(-np.arange(part.size) / 500)
        )
    found = diagnose(profile(), (echo(x) + fan() + slams).astype(np.float32), x)
    assert "fan_noise" not in names(found) and found.verdict == "unexplained"


@pytest.mark.slow
def test_mains_hum_is_not_an_effect_and_is_described() -> None:
    x = voice(SECONDS)
    t = np.arange(x.size) / 16000
    hum = sum(3 * FAN / k * np.sin(2 * np.pi * 50 * k * t + k) for k in (1, 3, 5, 7))
    found = diagnose(profile(), (echo(x) + fan() + hum).astype(np.float32), x)
    assert (found.verdict, names(found)) == ("unexplained", [])
    assert "multiples of 50 Hz" in found.evidence and "silent" in found.evidence


@pytest.mark.slow
def test_what_no_effect_makes_is_unexplained() -> None:
    x = voice(SECONDS)
    ring = echo(x) * (1.0 + 0.15 * np.sin(2 * np.pi * 170 * np.arange(x.size) / 16000))
    found = diagnose(profile(), (ring + fan()).astype(np.float32), x)
    assert (found.verdict, names(found)) == ("unexplained", [])
    assert "follows the robot's voice" in found.evidence


@pytest.mark.slow
def test_a_band_limit_shows_in_the_power_where_a_codecs_noise_hides_it() -> None:
    x, low = voice(SECONDS), signal.butter(12, 4000.0, fs=16000, output="sos")
    passed = signal.sosfiltfilt(low, echo(x))
    noise = signal.sosfiltfilt(low, 0.3 * passed * np.random.default_rng(5).standard_normal(x.size))
    found = diagnose(profile(), (passed + noise + fan()).astype(np.float32), x)
    assert (found.verdict, names(found)) == ("missing", ["bandlimit", "codec"])
    assert found.ranking[0].parameters["cutoff_hz"].value == pytest.approx(
        4000.0, rel=0.15
    )  # edges of bands a sixth of an octave wide
    assert "codec" in found.ranking[1].evidence


def test_a_band_edge_is_not_seen_where_the_volume_was_turned() -> None:
    x, low = voice(SECONDS), signal.butter(12, 4000.0, fs=16000, output="sos")
    turned, cut = 0.4 * echo(x), signal.sosfiltfilt(low, echo(x))
    edges = []
    for heard in (turned, cut):
        prepared = prepare(profile(), (heard + fan()).astype(np.float32), x)
        edges.append(band_edge(spectra(prepared.measurement, prepared.model, 20.0)))
    assert edges == [None, pytest.approx(4000.0, rel=0.05)]


def test_an_added_effect_lowers_the_error_of_another_recording() -> None:
    x, other = voice(SECONDS), voice(8.0, seed=21)
    robot = EchoModel(path()).with_effect("chassis_resonance", {"frequency_hz": 640.0, "q": 35.0, "gain_db": -2.0})
    knowing, before, after = add(profile(), "chassis_resonance", record(x, robot), x)
    assert after.excess_db < 0.5 < 3.0 < before.excess_db
    recording = record(other, robot, seed=22)
    assert compare(knowing, recording, other).excess_db < 0.5 < compare(profile(), recording, other).excess_db - 2.0


def test_the_dictionary_has_the_published_keys_and_is_json() -> None:
    x = voice(SECONDS)
    found = diagnose(profile(), (echo(x) * 0.9 + fan()).astype(np.float32), x)
    said = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert said["schema"] == 2 and set(said["where"]) == {"bands", "times", "levels", "lags"}
    entry = said["ranking"][0]
    assert set(entry) == {
        *("effect", "family", "p_value", "excess_before_db", "excess_after_db", "share", "parameters", "evidence")
    }
    assert found.independence is not None and said["independence"]["of_findings"] == found.independence.to_dict()
    assert entry["family"] == "linear path" and 0.0 < entry["p_value"] <= Criteria().false_rate
    assert entry["parameters"]["gain_db"]["value"] == pytest.approx(-0.915, abs=0.05)
    figures = {name: getattr(found.ranking[0], name) for name in ("excess_before_db", "excess_after_db", "share")}
    for name, value in {**figures, "remaining_db": found.remaining_db, "irreducible_db": found.irreducible_db}.items():
        assert {**said, **entry}[name] == round(value, 4 if name == "share" else 3)  # digits that mean something


@pytest.mark.parametrize(("excess_db", "told"), [(0.75, "explained"), (0.85, "unexplained")])
def test_where_nothing_is_named_up_to_eight_tenths_of_a_decibel_are_left_by_the_fan_of_another_day(excess_db, told):
    prepared = prepare(profile(), record(voice(4.0)), voice(4.0))
    score = replace(prepared.of(prepared.model), excess_db=excess_db)
    found = conclude(prepared, Found(prepared, prepared.model, prepared.model, score, score, ()), Criteria())
    assert (found.verdict, found.ranking) == (told, ())


def test_no_effect_is_chosen_where_none_lowers_the_level():
    bench, score = Workbench(prepare(profile(), record(voice(4.0)), voice(4.0)), Criteria()), verdict(1.0)
    trials = {
        name: Trial(name, {}, EchoModel(path()), score, gain_db)
        for name, gain_db in (("playback_gain", 0.9), ("late_reverb", 1.0))
    }
    assert bench.preferred([]) is None and bench.preferred([replace(trials["late_reverb"], gain_db=-0.1)]) is None
    assert bench.preferred(trials.values()) is trials["playback_gain"]
    assert (
        bench.preferred([replace(trials["playback_gain"], gain_db=0.8), trials["late_reverb"]]) is trials["late_reverb"]
    )


@pytest.mark.parametrize("by_db, chosen", [(0.002, "playback_gain"), (0.05, "limiter")])
def test_an_effect_of_few_numbers_is_chosen_where_it_explains_more_than_by_chance(by_db, chosen):
    bench, score = Workbench(prepare(profile(), record(voice(4.0)), voice(4.0)), Criteria()), verdict(1.0)
    simple, richer = (
        Trial(name, {}, EchoModel(path()), score, gain_db)
        for name, gain_db in (("playback_gain", 10.0), ("limiter", 10.0 + by_db))
    )
    assert bench.preferred([richer, simple]).name == chosen


def test_what_ordinary_recordings_show_more_of_than_is_left_is_not_fitted():
    bench = Workbench(prepare(profile(), record(voice(4.0)), voice(4.0)), Criteria())
    left = replace(verdict(0.3), cells=np.ones((bench.recording.starts.size, bands().freedom.size)))
    bench.score = lambda asked: left  # an ordinary loudspeaker's distortion explains twice as much
    model = bench.recording.model
    assert bench.attempt("speaker_nonlinearity", model) is None
    (row,) = bench.tried(model, model)
    assert (row.name, row.spared, row.alone) == ("speaker_nonlinearity", True, None)


def test_two_effects_that_share_a_fit_make_it_once_beside_one_model(monkeypatch):
    made = []

    def counted(measurement, model):
        made.append(model)
        return fit_path(measurement, model)

    for module in (early_path, late_reverb):
        monkeypatch.setattr(module, "fit_path", counted)
    bench = Workbench(prepare(profile(), record(voice(4.0), EchoModel(path(seed=2))), voice(4.0)), Criteria())
    trials = [bench.attempt(name, bench.recording.model) for name in ("early_path", "late_reverb")]
    assert sum(trial is not None for trial in trials) == 1, "one of the two names for one fit"
    assert len(made) == 1


def verdict(active_db: float) -> Score:
    return Score(
        active_db,
        active_db,
        0.0,
        active_db,
        active_db,
        0.0,
        0.0,
        np.ones((4, 4)),
        np.zeros(16000, np.float32),
    )


@pytest.mark.parametrize(
    "base_db, left_db, held", [(15.0, 2.9, True), (15.0, 3.1, False), (25.0, 3.1, True), (4.0, 2.1, False)]
)
def test_effects_hold_that_leave_less_than_3_db_or_one_percent_and_less_than_half(base_db, left_db, held):
    found = Found(None, EchoModel(path()), EchoModel(path()), verdict(base_db), verdict(left_db), ())
    assert holds(found, Criteria()) is held


@pytest.mark.parametrize("active_db, halved", [(3.95, True), (3.98, False)])
def test_half_of_the_power_over_the_fan_is_gone_from_6_dB_at_3_96(active_db, halved):
    found = prepare(profile(), record(voice(4.0)), voice(4.0))
    bench, model = Workbench(found, Criteria()), EchoModel(path())
    bench.score = lambda asked: verdict(6.0)
    assert bench.halves(Trial("late_reverb", {}, model, verdict(active_db), 0.5), model) is halved


def test_a_step_of_the_search_is_not_lost_where_what_is_simpler_explains_less(monkeypatch: pytest.MonkeyPatch) -> None:
    x = voice(4.0)
    prepared = prepare(profile(), record(np.float32(0.7) * x), x)
    monkeypatch.setattr(select, "backward", lambda bench, start, model, newest: start)
    found = search(prepared, prepared.model, Criteria())
    assert [step.name for step in found.steps] == ["playback_gain"]
