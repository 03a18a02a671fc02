"""Before the lag of an utterance is known, what can only be the robot is taken for it; nobody else is."""

import numpy as np
import pytest
import soundfile

from edgefilter import EgoFilter, enhance
from edgefilter.alignment.aligner import Aligned, Aligner
from edgefilter.alignment.lag_search import MOST_LAG_S
from edgefilter.alignment.utterances import LONGEST, RECENT, FirstSounds
from edgefilter.filter.budget import DEMO
from tests.alignment.scene import RATE, fan, hear, known_path, room, run, speech_like, utterances

HOP = 256


def spoken(rng: np.random.Generator, seconds: list[float], pauses: list[float]) -> tuple[np.ndarray, list[int]]:
    """Utterances that begin loud, and their onsets."""
    ref, onsets = utterances(rng, seconds, pauses)
    for onset in onsets:
        ref[onset : onset + RATE // 12] = 0.0
    return 2.0 * ref, onsets


def told(mic: np.ndarray, ref: np.ndarray, h: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, list[Aligned]]:
    """Power of each whole hop, whether it may hold the robot at any lag, and what the aligner found.

    h: of a calibrated robot, None for one without a profile.
    """
    found = run(Aligner(HOP, None if h is None else known_path(h)), mic, ref)
    power = np.square(mic[: len(found) * HOP].reshape(-1, HOP)).sum(1)
    return power, np.array([aligned.at_any_lag for aligned in found]), found


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("lags", [(3000, 9000), (9000, 2000)])
def test_the_robot_is_recognised_until_its_lag_is_found(lags, calibrated):
    rng = np.random.default_rng(1)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    mic = hear(ref, [(0, lags[0]), (onsets[1] - 100, lags[1])], h)[0] + fan(rng, ref.size, 0.001)
    power, anywhere, found = told(mic, ref, h if calibrated else None)
    begun = np.array([aligned.state == "begun" for aligned in found])
    explained = np.array([np.dot(aligned.reference, aligned.reference) for aligned in found])
    burst = (power > 0.1 * power.max()) & (explained < 0.01 * explained.max()) & begun
    second = np.arange(power.size) > power.size // 2
    for part in (second, ~second):
        assert np.any(burst & part)
        assert np.sum(power[burst & part & ~anywhere]) < 0.1 * np.sum(power[burst & part])
    assert not np.any(anywhere & ~begun)


def test_one_loud_sample_of_the_reference_makes_the_robot_loud_for_a_moment_only():
    rng = np.random.default_rng(1)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    mic = hear(ref, [(0, 3000), (onsets[1] - 100, 9000)], h)[0] + fan(rng, ref.size, 0.001)
    clicked = ref.copy()
    clicked[onsets[0] + RATE] = 1e6
    _, anywhere, _ = told(mic, ref, h)
    _, after_click, found = told(mic, clicked, h)
    second = np.arange(len(found)) * HOP > onsets[1]
    begun = np.array([aligned.state == "begun" for aligned in found])
    assert np.count_nonzero(anywhere & second & begun) > 2
    assert np.array_equal(after_click[anywhere & begun], anywhere[anywhere & begun])


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_a_human_20_db_below_a_calibrated_robot_whose_loudspeaker_is_muted_is_untouched(level):
    rng = np.random.default_rng(2)
    h = room(rng, 0.3)
    ref, _ = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    human = utterances(rng, [4.0], [ref.size / RATE])[0][: ref.size]
    human *= level * hear(ref, [(0, 3000)], h)[0].std() / human.std()
    _, anywhere, found = told(human + fan(rng, ref.size, 0.001), ref, h)
    assert any(aligned.state == "begun" for aligned in found)
    assert not anywhere.any()


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_human_as_loud_as_a_robot_in_headphones_loses_the_first_utterance_at_most(calibrated):
    rng = np.random.default_rng(4)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [1.0, 2.0, 2.0], [3.0, 3.0, 3.0])
    human = utterances(rng, [11.0], [2.0])[0][: ref.size]
    human *= hear(ref, [(0, 3000)], h)[0].std() / human.std()
    _, anywhere, _ = told(human, ref, h if calibrated else None)
    at = np.flatnonzero(anywhere) * HOP
    assert at.size and at.max() < onsets[0] + (MOST_LAG_S + 0.4) * RATE
    assert at.max() < onsets[1] - 1000


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_human_as_loud_as_the_robot_who_begins_with_it_loses_a_quarter_second(calibrated):
    rng = np.random.default_rng(4)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    mic, _ = hear(ref, [(0, 16000)], h)
    human = utterances(rng, [4.0], [1.0])[0][: ref.size - onsets[1]]
    mic[onsets[1] : onsets[1] + human.size] += human * mic.std() / human.std()
    _, anywhere, found = told(mic, ref, h if calibrated else None)
    assert found[onsets[1] // HOP - 10].state in ("locked", "idle")
    assert np.count_nonzero(anywhere[onsets[1] // HOP :]) * HOP <= LONGEST + HOP


def test_the_noise_of_a_loopback_is_no_robot_until_a_voice_rises_above_it():
    """A real recording without any robot begins so: the human was lost for two seconds."""
    rng = np.random.default_rng(7)
    noise = (3e-4 * rng.standard_normal(4 * RATE)).astype(np.float32)
    human = utterances(rng, [4.0], [0.0])[0][: noise.size]
    _, anywhere, found = told(human, noise, None)
    assert found[20].state == "begun" and not anywhere.any()
    voice = np.concatenate((np.zeros(RATE, np.float32), speech_like(rng, 3.0)))
    mic = hear(voice, [(0, 3000)], room(rng, 0.3))[0] + fan(rng, voice.size, 0.0005)
    power, anywhere, found = told(mic, voice + noise, None)
    at = int(np.argmax([aligned.state == "locked" for aligned in found]))
    heard = power[:at] > 0.1 * power.max()
    assert heard.any() and anywhere[:at][heard].all() and not anywhere[: RATE // HOP - 1].any()


@pytest.mark.parametrize("gap", [slice(0, RATE), slice(0, 1), slice(RATE, RATE + 3 * HOP + 5)])
def test_where_the_noise_of_a_loopback_was_digitally_silent_a_human_loses_no_more_than_a_quarter_second(gap):
    """After one such hop anything was a voice for good, and two seconds were lost."""
    rng = np.random.default_rng(7)
    noise = (3e-4 * rng.standard_normal(5 * RATE)).astype(np.float32)
    noise[gap.start : max(gap.stop, HOP)] = 0.0  # as a device that starts, or that has nothing to deliver once
    human = utterances(rng, [5.0], [0.0])[0][: noise.size]
    _, anywhere, found = told(human, noise, None)
    assert any(aligned.state == "begun" for aligned in found) and not anywhere[(gap.stop + LONGEST) // HOP + 2 :].any()


def test_soft_first_sounds_of_a_calibrated_voice_make_nobody_loud():
    rng = np.random.default_rng(5)
    ref = (1e-4 * rng.standard_normal(2 * RATE)).astype(np.float32)
    _, anywhere, found = told(fan(rng, ref.size, 0.005), ref, room(rng, 0.3))
    assert any(aligned.state == "begun" for aligned in found)
    assert not anywhere.any()


def test_from_the_first_sample_on_and_until_nothing_is_waited_for():
    first, loud = FirstSounds(1, np.ones(1)), np.ones(1, np.float32)
    told = [first.step(waits * loud, 0 * loud, 0.0, "begun", waits) for waits in (True, False, True)]
    assert told == [True, False, True]
    assert not first.step(loud, loud, 0.0, "locked", False)
    assert not first.step(loud, loud, 1.0, "begun", True)  # the present delay explains it


@pytest.mark.parametrize("silent", [RECENT // HOP - 2, RECENT // HOP + 2])
def test_who_was_as_loud_a_moment_before_the_utterance_began_is_another(silent):
    first, loud, nothing = FirstSounds(HOP, np.ones(1)), np.ones(HOP, np.float32), np.zeros(HOP, np.float32)
    for sound in (loud, *[nothing] * silent):
        first.step(sound, nothing, 0.0, "idle", False)
    assert first.step(loud, nothing, 0.0, "begun", True) == (silent * HOP > RECENT)


@pytest.mark.parametrize(("engine", "least_db"), [("crnn", 20.0), ("ss", 15.0), ("linear", 10.0)])
def test_the_first_sounds_of_a_robot_that_nobody_knows_are_lowered(engine, least_db):
    """Its first words came through as they were, 0 to 10 dB lower with crnn, until the lag was found."""
    rng = np.random.default_rng(6)
    ref, _ = spoken(rng, [2.0], [1.0])
    mic = hear(ref, [(0, 3000)], room(rng, 0.3))[0] + fan(rng, ref.size, 0.0005)
    ego, states, out = EgoFilter(engine=engine), [], []
    for at in range(0, ref.size - HOP + 1, HOP):
        out.append(ego.process(mic[at : at + HOP], ref[at : at + HOP]))
        states.append(ego.stats()["alignment"]["state"])
    done = np.concatenate([*out, ego.flush()])
    power, left = (np.square(x[: len(states) * HOP].reshape(-1, HOP)).sum(1) for x in (mic, done))
    waiting = np.cumsum(np.array(states) == "locked") == 0
    loud = waiting & (power > 0.05 * power.max())
    assert np.count_nonzero(loud) > 2
    assert 10 * np.log10(power[loud].sum() / left[loud].sum()) > least_db


@pytest.mark.slow
def test_the_robots_onset_in_the_demo_stays_below_the_human():
    """At 8 s its second utterance begins with another lag.

    It came through 10 dB louder than the human's peak with crnn.
    """
    mic, ref, human = (
        soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference", "human")
    )
    for engine, margin in (("crnn", 0.0), ("ss", 3.0), ("linear", 9.0)):
        out = enhance(mic[: 9 * RATE], ref[: 9 * RATE], DEMO / "profile.npz", engine=engine)
        onset = np.abs(out[int(7.8 * RATE) :]).max()
        assert onset < np.abs(human).max() * 10 ** (margin / 20), engine
