"""What no listed effect explains: the family whose free law does, with held-out error, in words, and as an effect of the user's own."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage, signal

from edgefilter import add, compare, load_effect
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import findings_of
from edgefilter.diagnosis.laws import Curve, Law, law_of, with_laws
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.recording import diagnose
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effects import catalogue
from edgefilter.echo.model import EchoModel
from edgefilter.echo.running import stream_form
from edgefilter.report.text import heading
from edgefilter.types import SAMPLE_RATE
from tests.diagnosis.robot_scene import livelier, profile, record, voice

X = voice(6.0)
LEVEL = np.sqrt(signal.lfilter([0.005], [1.0, -0.995], X**2) + 1e-9)
"""Of the voice, smoothed over 12 ms."""
HIDDEN = {
    "static nonlinearity": np.maximum(X, 0.25 * X),  # half of each wave
    "dynamics": X * np.clip((LEVEL / 0.1) ** 0.8, 0.0, 1.0),  # an expander: 8 dB per 10 dB below -20 dBFS
    "modulation": X * (1.0 + 0.5 * np.sin(2 * np.pi * 5.0 * np.arange(X.size) / SAMPLE_RATE)),
    "time": ndimage.map_coordinates(  # a clock that is pulled to and fro, 1.5 samples in 5 s
        X, [np.arange(X.size) - 1.5 * np.sin(2 * np.pi * 0.2 * np.arange(X.size) / SAMPLE_RATE)], order=5
    ),
    "dynamics ahead": X
    * ndimage.uniform_filter1d(  # a limiter that looks 5 ms ahead
        np.minimum(1.0, 0.05 / np.maximum(ndimage.maximum_filter1d(np.abs(X), 160), 1e-9)), 160
    ),
    "linear path": signal.lfilter([1.0] + 60 * [0.0] + [0.7], [1.0], X),
}


def searched(family: str, seconds: float = 6.0) -> Found:
    """A search that has named nothing."""
    x = X[: round(seconds * SAMPLE_RATE)]
    prepared = prepare(profile(), record(HIDDEN[family][: x.size].astype(np.float32)), x)
    score = prepared.of(prepared.model)
    return Found(prepared, prepared.model, prepared.model, score, score, ())


@functools.cache
def lawful(family: str, seconds: float = 6.0) -> Law:
    """The law that is found where nothing was named."""
    found = searched(family, seconds)
    law = law_of(with_laws(found, Criteria()))
    assert (
        law is not None and law.family == family.removesuffix(" ahead") and law.excess_db < 0.4 * found.base.excess_db
    )
    assert law.curve.share > 0.4
    return law


def numbers(law: Law) -> list[float]:
    """Those in its words."""
    return [float(number) for number in re.findall(r"[-+]?[0-9]+(?:[.][0-9]+)?", law.words)]


@pytest.fixture
def load(tmp_path: Path) -> Callable[[Law, str], str]:
    """Write a law and load it."""

    def loaded(law: Law, name: str) -> str:
        path = tmp_path / f"{name}.py"
        path.write_text(law.file(name), encoding="utf-8")
        assert len(path.read_text().splitlines()) < 60
        return load_effect(path)

    return loaded


@pytest.mark.slow
@pytest.mark.parametrize("family", [family for family in HIDDEN if "ahead" not in family])
def test_add_takes_the_law_that_is_written_and_the_error_falls(family: str, load) -> None:
    y, law = record(HIDDEN[family].astype(np.float32)), lawful(family)
    name = load(law, f"my_{family.split()[0]}")
    knowing, before, after = add(profile(), name, y, X)
    assert after.excess_db < 0.4 * before.excess_db
    assert compare(knowing, y, X).excess_db == pytest.approx(
        after.excess_db, abs=0.3
    )  # with the volume that add takes out


def test_the_running_filter_uses_it_hop_by_hop_as_on_the_whole(load) -> None:
    effect = catalogue.find(load(lawful("dynamics"), "my_expander"))
    values, x = lawful("dynamics").values, X[: 4 * SAMPLE_RATE]
    make = stream_form(effect, values)
    run = make()
    hops = np.concatenate([run(x[at : at + 256]) for at in range(0, x.size, 256)])
    np.testing.assert_allclose(hops, effect.apply(x, values, SAMPLE_RATE), atol=1e-6)


def test_the_law_is_said_in_words() -> None:
    expander, words = numbers(lawful("dynamics")), lawful("dynamics").words
    assert "a gain that rises" in words and expander[0] == pytest.approx(8.0, abs=1.0) and expander[2] < -20.0
    assert "5 times a second" in lawful("modulation").words
    assert numbers(lawful("modulation"))[:2] == pytest.approx([-6.0, 3.5], abs=0.5)
    least, most = numbers(lawful("time"))[:2]
    assert most - least == pytest.approx(3.0, abs=0.6), "wherever the middle is taken for none"


def test_the_two_halves_of_a_curve_are_told_against_its_middle_and_it_goes_on_as_it_ends() -> None:
    law = lawful("static nonlinearity", 3.0)
    assert law.effect == "free_curve"
    upper, lower = 20 * np.log10(np.array([1.0, 0.25]) / 0.625)
    assert numbers(law) == pytest.approx([upper, lower], abs=0.2)
    for peak, gain in ((law.curve.x[-1], 1.0), (law.curve.x[0], 0.25)):
        inside, end, beyond, furthest = catalogue.find(law.effect).apply(
            np.float32(peak) * np.float32([0.7, 1.0, 2.0, 4.0]), law.values, SAMPLE_RATE
        )
        assert end == pytest.approx(gain * peak, rel=0.03)
        assert [beyond - end, furthest - end] == pytest.approx((end - inside) / 0.3 * np.array([1.0, 3.0]), rel=0.01)


def test_a_gain_over_the_level_is_told_where_it_is_steepest() -> None:
    law = lawful("dynamics", 3.0)
    level, gain_db = np.array(law.curve.x), np.array(law.curve.y_db)
    steepness = 10.0 * np.diff(gain_db) / np.diff(level)
    at = int(np.argmax(np.abs(steepness)))
    rise, per, around, attack_ms, _ = numbers(law)
    assert (rise, per) == (pytest.approx(steepness[at], abs=0.06), 10.0) and rise == pytest.approx(8.0, abs=1.5)
    assert around == pytest.approx((level[at] + level[at + 1]) / 2.0, abs=0.6) and 3.0 < attack_ms < 40.0


def test_a_limiter_that_holds_the_sound_back_is_told_by_how_much_its_gain_comes_before_the_sound(load) -> None:
    law = lawful("dynamics ahead")
    *_, ahead_ms = numbers(law)
    assert "a gain that falls" in law.words and "before the sound" in law.words and 1.0 <= ahead_ms <= 5.0
    assert "before the sound" not in lawful("dynamics").words, "an expander that looks at what was"
    name, wanted = load(law, "my_limiter"), HIDDEN["dynamics ahead"]
    _, before, after = add(profile(), name, record(wanted.astype(np.float32)), X)
    assert after.excess_db < 0.3 * before.excess_db
    run, at_once = (stream_form(catalogue.find(name), law.values)() for _ in range(2))
    hops, samples = (
        np.concatenate([heard(X[at : at + size]) for at in range(0, X.size, size)])
        for heard, size in ((run, 256), (at_once, 16))
    )
    off, blind = (np.sum((y - wanted) ** 2) for y in (hops, samples))
    assert off < 0.8 * blind, "a hop holds some of what comes"


def test_a_gain_that_moves_with_time_is_told_over_its_period() -> None:
    law = lawful("modulation", 3.0)
    assert numbers(law) == pytest.approx([20 * np.log10(0.5), 20 * np.log10(1.5), 5.0], abs=0.4)
    assert np.diff(law.curve.x) == pytest.approx(0.2 / 64, rel=0.01) and law.curve.x[0] == 0.0


def test_a_filter_is_told_where_it_gives_most_and_least() -> None:
    law = lawful("linear path", 3.0)
    milliseconds, most_db, most_hz, least_db, least_hz = numbers(law)
    assert (milliseconds, most_db, least_db) == (16.0, pytest.approx(4.6, abs=0.3), pytest.approx(-10.5, abs=1.0))
    phases = 2 * np.pi * 61 / SAMPLE_RATE * np.array([most_hz, least_hz])  # an echo 61 samples later
    assert np.cos(phases) == pytest.approx([1.0, -1.0], abs=0.1)


def test_a_lag_that_moves_is_told_by_its_extremes() -> None:
    law = lawful("time", 3.0)
    assert numbers(law) == pytest.approx([min(law.curve.y_db), max(law.curve.y_db)], abs=0.006)
    assert law.curve.x == (0.0, 1.0, 2.0, 3.0), "to the end of the recording"


@pytest.mark.parametrize(
    ("family", "event"), [("static nonlinearity", False), ("linear path", False), ("modulation", True)]
)
def test_what_is_of_one_recording_is_written_as_an_event_of_it(family: str, event: bool, load) -> None:
    law = lawful(family, 3.0)
    effect = catalogue.find(load(law, "found"))
    assert (effect.event, "this recording" in effect.run_note) == (event, event)
    assert (effect.family, effect.stage) == (family, catalogue.find(law.effect).stage)


def test_a_law_beside_what_is_named_has_to_explain_a_part_of_what_that_leaves() -> None:
    found, law = searched("modulation", 3.0), lawful("modulation", 3.0)
    part = law.gain_db / (found.base.over_db - found.base.floor_db)
    for factor, told in ((0.99, True), (1.01, False)):
        assert (law_of(with_laws(found, replace(Criteria(), part=factor * part))) is not None) is told


def test_a_law_in_place_of_a_name_that_leaves_much_says_what_it_is_most_like_and_is_added() -> None:
    y = record(HIDDEN["dynamics ahead"].astype(np.float32))
    found = searched("dynamics ahead")
    start = found.model.fit("compression", found.recording.measurement)
    score = found.recording.of(start)
    named = replace(found, model=start, final=score, steps=(Trial.of("compression", start, found.base, score),))
    better = with_laws(named, Criteria())
    (step,) = better.steps
    assert step.name == "free_gain" and list(better.like) == ["free_gain"]
    name, share = better.like["free_gain"]
    assert name == "compression"
    assert share == pytest.approx(named.steps[0].gain_db / step.gain_db), (
        "of what the law brings, what the name's numbers do"
    )
    (finding,) = findings_of(better, {})
    assert (finding.effect, finding.name) == ("free_gain", "compression")
    assert heading(finding) == f"Compression, {100 * share:.0f} % of a gain by level"
    knowing, before, after = add(profile(), "free_gain", y, X)
    assert after.excess_db < 0.4 * before.excess_db and np.ndim(dict(knowing.echo.effects)["free_gain"]["gain_db"]) == 1


def test_a_law_that_failed_its_proof_is_not_tried_again() -> None:
    found = searched("modulation", 3.0)
    names = [effect.name for effect in catalogue.EFFECTS if effect.free]
    assert with_laws(found, Criteria(), without=names) is found


@pytest.mark.slow
def test_what_is_explained_gets_no_law_and_what_is_not_one_that_is_a_finding() -> None:
    turned = diagnose(profile(), record(np.float32(0.7) * X), X)
    assert turned.verdict == "missing" and turned.law is None and turned.to_dict()["law"] is None
    shaken = diagnose(profile(), record(HIDDEN["modulation"].astype(np.float32)), X)
    assert shaken.verdict == "unexplained", (
        "it acts ahead of the path: the truth itself behind that leaves 7.4 of 19.7 dB"
    )
    assert [one.effect for one in shaken.ranking] == ["free_modulation"]
    assert (
        shaken.law is not None and shaken.law.beside == () and shaken.remaining_db < 0.4 * shaken.comparison.excess_db
    )
    told = shaken.to_dict()["law"]
    assert (told["family"], told["effect"]) == ("modulation", "free_modulation")
    assert told["gain_db"] == round(shaken.law.gain_db, 3)


def test_where_no_voice_is_there_to_fit_to_there_is_no_law() -> None:
    prepared = searched("dynamics").recording
    mute = replace(prepared, measurement=replace(prepared.measurement, fit=np.zeros(X.size, bool)))
    score = mute.of(mute.model)
    assert law_of(with_laws(Found(mute, mute.model, mute.model, score, score, ()), Criteria())) is None


def test_a_curve_is_written_with_as_many_digits_as_mean_something() -> None:
    curve = Curve("gain by level", "dB", (1 / 3,), (2 / 3,), 1 / 7)
    assert curve.to_dict() == {
        **{"name": "gain by level", "x_unit": "dB", "x": [0.333], "y_db": [0.67], "share": 0.1429, "y_unit": "dB"}
    }


@pytest.mark.slow
def test_an_equaliser_ahead_of_what_bends_the_voice_is_told_from_one_behind() -> None:
    x = voice(6.0)
    bell, high = (
        signal.lfilter(*signal.butter(1, band, "band", fs=SAMPLE_RATE), x) for band in ((700, 1400), (2500, 5000))
    )
    coloured = x + 2.0 * bell - 0.6 * high
    peak = np.abs(coloured).max() / 3.0
    found = diagnose(profile(), record((peak * np.tanh(coloured / peak)).astype(np.float32)), x)
    assert [finding.name for finding in found.ranking] == ["equaliser", "speaker_nonlinearity"]
    assert found.ranking[0].effect == "free_filter_ahead" and found.ranking[0].like.share > 0.9
    assert "a filter of 8 ms" in found.ranking[0].evidence
    assert found.comparison.excess_db > 20.0 and found.remaining_db < 1.0  # with the equaliser behind: 15


@pytest.mark.slow
def test_an_equaliser_ahead_of_what_bends_the_voice_is_found_though_another_room_has_taken_it_up() -> None:
    """The response of the room holds any filter, and the products that tell where it is show in one place alone: a codec was named."""
    x = voice(16.0)
    bell, high = (signal.lfilter(*signal.iirpeak(hz, q, fs=SAMPLE_RATE), x) for hz, q in ((400.0, 0.8), (2500.0, 1.2)))
    coloured = x + 1.5 * bell - 0.5 * high
    heard = record((np.tanh(8.0 * coloured) / 8.0).astype(np.float32), EchoModel(livelier()))
    found = diagnose(profile(), heard, x)
    assert sorted(finding.name for finding in found.ranking) == ["equaliser", "late_reverb", "speaker_nonlinearity"]
    assert found.comparison.excess_db > 20.0 and found.remaining_db < 1.0


def test_what_a_name_is_of_a_law_counts_after_what_the_law_made_superfluous_is_dropped() -> None:
    found = searched("dynamics ahead")
    named = found.with_only(
        {
            "playback_gain": {"gain_db": -1.0},
            "compression": found.recording.fitted(
                "compression", found.model.with_effect("playback_gain", {"gain_db": -1.0})
            ),
        }
    )
    better = with_laws(named, Criteria())
    assert [step.name for step in better.steps] == ["free_gain"]
    name, share = better.like["free_gain"]
    known_db = next(step.gain_db for step in named.steps if step.name == name)
    assert share == pytest.approx(known_db / (known_db + named.final.level_db - better.final.level_db), abs=1e-9)
