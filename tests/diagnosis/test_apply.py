"""Effects fitted beside each other to a straightened recording, and proven in the running filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis.joint import fit_jointly, fit_straight
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.proof import HeldOut, Proof
from edgefilter.diagnosis.recording import Recording, add, compare, diagnose, prove
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.model import EchoModel
from edgefilter.errors import SignalError, UsageError
from tests.diagnosis.robot_scene import FAN, RESONANCE, office, path, profile, record, voice

DRIFT = {"ppm": 40.0, "offset": 0.0}


@pytest.fixture(scope="module")
def drifting() -> tuple[np.ndarray, np.ndarray]:
    """Recording and reference of a robot in the office whose clocks differ by 40 ppm."""
    x = voice(9.0)
    return record(x, office().with_effect("clock_drift", DRIFT)), x


@pytest.mark.slow
def test_two_effects_are_fitted_beside_each_other() -> None:
    x = voice(8.0)
    robot = EchoModel(path()).with_effect("chassis_resonance", RESONANCE)
    y = record(x, robot.with_effect("playback_gain", {"gain_db": -3.0}))
    knowing, before, after = add(profile(), ["playback_gain", "chassis_resonance"], y, x)
    values = dict(knowing.echo.effects)
    assert values["playback_gain"]["gain_db"] == pytest.approx(-3.0, abs=0.03)
    assert values["chassis_resonance"]["frequency_hz"] == pytest.approx(640.0, rel=0.005)
    assert after.excess_db < 0.5 < 3.0 < before.excess_db
    alone, _, _ = add(profile(), "playback_gain", y, x)
    assert abs(dict(alone.echo.effects)["playback_gain"]["gain_db"] + 3.0) > 0.05  # fitted alone it takes the ring in


@pytest.mark.slow
def test_the_order_of_the_names_changes_nothing_that_is_heard() -> None:
    x = voice(8.0)
    y = record(
        x, EchoModel(path()).with_effect("chassis_resonance", RESONANCE).with_effect("playback_gain", {"gain_db": -3.0})
    )
    names = ["playback_gain", "chassis_resonance"]
    one, other = (add(profile(), order, y, x)[2].excess_db for order in (names, names[::-1]))
    assert one == pytest.approx(other, abs=0.1)


@pytest.mark.slow
def test_reverberation_is_learnt_from_a_recording_whose_clocks_differ(drifting) -> None:
    y, x = drifting
    knowing, before, after = add(profile(), "late_reverb", y, x)
    assert [name for name, _ in knowing.echo.effects] == ["late_reverb"]
    assert any("clock_drift" in text and "40.0 samples in a million" in text for text in after.warnings)
    assert after.excess_db < 1.5 < 10.0 < before.excess_db
    straight, other = record(voice(9.0, seed=8), office(), seed=9), voice(9.0, seed=8)
    assert compare(knowing, straight, other).excess_db < compare(profile(), straight, other).excess_db - 8.0


@pytest.mark.slow
def test_reverberation_learnt_across_a_drift_helps_the_running_filter(drifting) -> None:
    y, x = drifting
    proof, held_out = prove(profile(), "late_reverb", y, x), Recording(y, x, profile()).held_out
    assert proof.erle_before_db == held_out.erle_db(held_out.left(profile()))
    assert proof.erle_after_db > proof.erle_before_db + 3.0
    assert not proof.worse and proof.seconds > 1.5


@pytest.mark.slow
def test_a_jump_is_taken_out_before_another_effect_is_fitted() -> None:
    x = voice(9.0)
    jumped = EchoModel(path()).with_effect("chassis_resonance", RESONANCE)
    y = record(x, jumped.with_effect("delay_jump", {"times_s": 4.3, "samples": 37.0}))
    knowing, _, after = add(profile(), "chassis_resonance", y, x)
    assert [name for name, _ in knowing.echo.effects] == ["chassis_resonance"] and after.excess_db < 0.7
    assert dict(knowing.echo.effects)["chassis_resonance"]["frequency_hz"] == pytest.approx(640.0, rel=0.01)


@pytest.mark.slow
def test_a_turned_volume_is_taken_out_but_beside_a_filter_that_holds_it() -> None:
    x = voice(8.0)
    turned = (
        EchoModel(path()).with_effect("chassis_resonance", RESONANCE).with_effect("playback_gain", {"gain_db": -3.0})
    )
    prepared = prepare(profile(), record(x, turned), x)
    model, straightened = fit_straight(prepared, ["chassis_resonance"])
    assert straightened == ("playback_gain",)
    assert dict(model.effects)["playback_gain"]["gain_db"] == pytest.approx(-3.0, abs=0.05)
    assert fit_straight(prepared, ["late_reverb"])[1] == ()


@pytest.mark.slow
def test_nothing_is_taken_out_of_a_straight_recording() -> None:
    x = voice(8.0)
    prepared = prepare(profile(), record(x, EchoModel(path()).with_effect("chassis_resonance", RESONANCE)), x)
    everywhere = replace(prepared.measurement, fit=prepared.usable)
    model, straightened = fit_straight(prepared, ["chassis_resonance"])
    assert straightened == ()
    alone = prepared.model.fit("chassis_resonance", everywhere)
    assert everywhere.error(model.predict(x)) <= everywhere.error(alone.predict(x)) * 1.001


@pytest.mark.slow
def test_rounds_lower_the_error_of_what_was_fitted_in_turn() -> None:
    x = voice(6.0)
    robot = (
        EchoModel(path()).with_effect("chassis_resonance", RESONANCE).with_effect("playback_gain", {"gain_db": -3.0})
    )
    measurement = prepare(profile(), record(x, robot), x).measurement
    names, in_turn = ["playback_gain", "chassis_resonance"], EchoModel(path())
    for name in names:
        in_turn = in_turn.fit(name, measurement)
    jointly = fit_jointly(measurement, EchoModel(path()), names)
    left = [measurement.error(measurement.predicted(model)[0]) for model in (in_turn, jointly)]
    assert left[1] < 0.97 * left[0]  # most of what is left is the fan


@pytest.fixture(scope="module")
def carried_back() -> tuple[np.ndarray, np.ndarray]:
    """Three fifths of the recording in the office, its volume turned, the rest in the laboratory: what is learnt there is wrong here."""
    x = voice(10.0)
    y = record(x, office())
    back = record(x)
    y[96_000:] = back[96_000:]
    return y, x


@pytest.mark.slow
def test_what_the_held_out_seconds_contradict_is_called_worse(carried_back) -> None:
    y, x = carried_back
    proof = prove(profile(), "late_reverb", y, x)
    assert proof.worse and proof.erle_after_db < proof.erle_before_db - 1.0
    assert proof.without == () and proof.culprit is None
    assert 5.0 < proof.start_s < 7.0


@pytest.mark.slow
def test_of_several_effects_the_one_that_hurts_is_named(carried_back) -> None:
    y, x = carried_back
    proof = prove(profile(), ["late_reverb", "mic_clipping"], y, x)
    assert proof.worse and proof.culprit == "late_reverb"
    assert dict(proof.without)["late_reverb"] == pytest.approx(proof.erle_before_db, abs=0.3)
    assert proof.to_dict()["without"].keys() == {"late_reverb", "mic_clipping"} and proof.to_dict()["worse"] is True


@pytest.mark.slow
def test_the_seconds_of_the_proof_choose_no_name() -> None:
    """The volume is turned down behind the cut alone: names that were chosen on those seconds would pass their proof."""
    x = voice(10.0)
    y = record(x)
    y[100_000:] = record(x, EchoModel(path()).with_effect("playback_gain", {"gain_db": -6.0}))[100_000:]
    assert diagnose(profile(), y, x).ranking
    found = Recording(y, x, profile()).diagnose_proven()
    assert found.ranking == () and found.comparison.recording.size <= 100_000
    assert found.unproven == "nothing lasting was found"


@pytest.mark.slow
def test_a_name_that_fails_its_proof_is_not_given(monkeypatch) -> None:
    x = voice(6.0)
    y = record(x, EchoModel(path()).with_effect("playback_gain", {"gain_db": -3.0}))
    found = Recording(y, x, profile()).diagnose_proven()
    assert [finding.effect for finding in found.ranking] == ["playback_gain"]
    assert found.proof is not None and not found.proof.worse

    def contradict(held, names):
        worse = 4.0 if "playback_gain" in names else 0.0
        without = tuple((name, 12.0) for name in names if len(names) > 1)
        return Proof(names, 3.6, 1.5, 12.0, 12.0 - worse, x, x, without)

    monkeypatch.setattr(HeldOut, "proof", contradict)
    found = Recording(y, x, profile()).diagnose_proven()
    assert "playback_gain" not in [finding.effect for finding in found.ranking]
    (row,) = (row for row in found.tried if row.effect == "playback_gain")
    assert row.verdict == "failed its proof" and "ERLE 12.0 dB without, 8.0 dB with" in row.why


@pytest.mark.slow
def test_a_profile_made_from_the_recording_is_proven_against_a_filter_without_any(drifting) -> None:
    y, x = drifting
    proof = prove(None, "late_reverb", y, x)
    held_out = Recording(y, x, profile()).held_out
    cold = held_out.erle_db(held_out.left(None))
    assert proof.erle_before_db == pytest.approx(cold, abs=1.5)  # the two profiles cut at another pause
    assert proof.erle_after_db > proof.erle_before_db + 3.0


def test_too_little_of_the_robot_cannot_be_held_out() -> None:
    x = voice(1.4)
    with pytest.raises(SignalError, match="too little of the robot alone to hold seconds out"):
        prove(profile(), "playback_gain", record(x), x)


def test_what_is_fitted_for_the_proof_of_a_compressor_has_not_heard_the_loud_end() -> None:
    """Fitted to the loudest 8 s, of which nothing lay ahead of the cut, it was found neutral: as good before as after."""
    x = voice(24.0)
    x[: 15 * 16_000] *= 0.5
    values = {"threshold_db": -40.0, "ratio": 4.0, "attack_ms": 5.0, "release_ms": 150.0}
    proof = prove(profile(), "compression", record(x, EchoModel(path()).with_effect("compression", values)), x)
    assert proof.erle_after_db > proof.erle_before_db + 3.0


def test_an_unknown_name_among_several_is_refused(drifting) -> None:
    y, x = drifting
    with pytest.raises(UsageError, match="unknown effect 'late_reverbs'"):
        add(profile(), ["playback_gain", "late_reverbs"], y, x)


@pytest.mark.slow
def test_a_drift_in_the_profile_is_predicted_whatever_the_lag() -> None:
    """A profile that holds a drift predicted a recording 0.8 s later with a lag that was off by a fraction of a sample."""
    x = voice(9.0)
    known = profile().with_echo(EchoModel(path()).with_effect("clock_drift", {"ppm": 80.0, "offset": 0.0}))
    for lag in (0.0, 13_000.0):
        assert compare(known, record(x, known.echo, lag), x).excess_db < 0.3, lag


HELD = {
    "playback_gain": ({"gain_db": -3.0}, {"gain_db": -8.0}),
    "compression": (
        {"threshold_db": -35.0, "ratio": 2.0, "attack_ms": 5.0, "release_ms": 150.0},
        {"threshold_db": -40.0, "ratio": 4.0, "attack_ms": 5.0, "release_ms": 150.0},
    ),
}
"""Values that the profile has, and those of today."""


@pytest.mark.parametrize("name", HELD)
def test_an_effect_that_the_profile_holds_is_named_where_its_values_are_others_by_now(name: str) -> None:
    """A robot whose volume was turned once is turned again: no other effect is what happened."""
    before, now = HELD[name]
    x = voice(8.0)
    knowing = profile().with_echo(profile().echo.with_effect(name, before))
    diagnosis = diagnose(knowing, record(x, EchoModel(path()).with_effect(name, now)), x)
    (finding,) = diagnosis.ranking
    assert diagnosis.verdict == "missing" and finding.effect == name
    assert finding.evidence.endswith("the profile holds this effect with other values")
    for parameter, value in now.items():
        assert finding.parameters[parameter].value == pytest.approx(value, rel=0.05)


@pytest.mark.parametrize(
    ("name", "before"),
    [
        ("clock_drift", {"ppm": 60.0, "offset": 0.0}),
        ("bandlimit", {"cutoff_hz": 3000.0, "order": 12.0}),
        (
            "late_reverb",
            {"taps": 0.05 * np.random.default_rng(2).standard_normal(6000) * np.exp(-np.arange(6000) / 1500)},
        ),
    ],
)
def test_an_effect_that_the_profile_holds_and_that_is_gone_is_named(name: str, before: Values) -> None:
    """A clock that was changed, a robot that is back in its room: the new values alone do not look like the effect."""
    x = voice(8.0)
    knowing = profile().with_echo(profile().echo.with_effect(name, before))
    diagnosis = diagnose(knowing, record(x), x)
    assert diagnosis.verdict == "missing" and [finding.effect for finding in diagnosis.ranking] == [name]
    told = "with other values" if name == "clock_drift" else "nothing of it"
    assert told in diagnosis.ranking[0].evidence
    assert diagnosis.comparison.excess_db > 15.0 and diagnosis.remaining_db < 3.0


@pytest.mark.parametrize(
    ("name", "values"),
    [("playback_gain", {"gain_db": -4.0}), ("clock_drift", DRIFT), ("compression", HELD["compression"][0])],
)
def test_a_room_that_the_profile_holds_does_not_take_up_what_else_happens(name: str, values: Values) -> None:
    x = voice(10.0)
    knowing = profile().with_echo(office())
    diagnosis = diagnose(knowing, record(x, office().with_effect(name, values)), x)
    assert (diagnosis.verdict, [finding.effect for finding in diagnosis.ranking]) == ("missing", [name])


def test_what_a_path_that_the_recording_has_taught_contains_is_not_claimed() -> None:
    x = voice(6.0)
    y = record(x, office())
    named = {finding.effect for finding in diagnose(self_calibrate(y, x), y, x).ranking}
    assert not any(find(name).absorbed for name in named)


def test_a_fan_that_the_profile_holds_is_named_by_what_it_is_over_the_calibrated_one() -> None:
    rng, x = np.random.default_rng(4), voice(8.0)
    twice = {"spectrum_db": np.full(601, 6.0), "change_db": 6.0}
    knowing = profile().with_echo(profile().echo.with_effect("fan_noise", twice))
    louder = record(x) + (FAN * np.sqrt(10**0.9 - 1.0) * rng.standard_normal(x.size)).astype(np.float32)
    diagnosis = diagnose(knowing, louder, x)
    (finding,) = diagnosis.ranking
    assert finding.effect == "fan_noise" and finding.parameters["change_db"].value == pytest.approx(9.0, abs=0.5)
    better, before, after = add(knowing, "fan_noise", louder, x)
    assert dict(better.echo.effects)["fan_noise"]["change_db"] == pytest.approx(9.0, abs=0.5)
    assert before.excess_db > 2.5 and abs(after.excess_db) < 0.3


def test_an_effect_is_added_to_a_profile_that_holds_the_volume_of_today() -> None:
    x, turned = voice(8.0), {"gain_db": -3.0}
    knowing = profile().with_echo(profile().echo.with_effect("playback_gain", turned))
    ringing = EchoModel(path()).with_effect("playback_gain", turned).with_effect("chassis_resonance", RESONANCE)
    better, before, after = add(knowing, "chassis_resonance", record(x, ringing), x)
    values = dict(better.echo.effects)
    assert values["playback_gain"]["gain_db"] == -3.0 and 2 * abs(after.excess_db) < before.excess_db
    assert values["chassis_resonance"]["frequency_hz"] == pytest.approx(RESONANCE["frequency_hz"], rel=0.01)
