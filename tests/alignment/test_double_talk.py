"""A human talks from the first second on: drift is no jump, a look that errs costs no certainty, states are what they say."""

import numpy as np
import pytest
from scipy import signal

from edgefilter.alignment.aligner import Aligner
from edgefilter.alignment.delay_tracker import DRIFTED, STRIDE, DelayMeasurement, DriftFilter
from tests.alignment.scene import (
    RATE,
    double_talk,
    fan,
    hear,
    known_path,
    room,
    run,
    speech_like,
    utterances,
)

CLOSE = 16  # the requirement: +-1 ms


def look(offset, evidence=30.0, explained=0.1, gain=0.3):
    """What the meter says in double talk: sure of its peak, which explains little of the microphone."""
    ratio = 2.5
    return DelayMeasurement(offset, 0.05**2, evidence / ratio, ratio, explained, gain, 0.3)


def see(drift, delay, evidence=30.0):
    """Take the next look, which sees this delay, and return by how much it has jumped: what is less is the drift."""
    drift.advance(STRIDE)
    found = look(delay - drift.delay, evidence)
    where = drift.where_seen(found, found.gain, far=False)
    if where == "there" or (where == "jumped" and abs(found.offset) < DRIFTED):
        drift.correct(found)
        return 0.0
    return found.offset if where == "jumped" else 0.0


def follow(seen, evidence):
    """What is believed after a lag of 1000 and then 16 looks a second, each seeing the delay of `seen`; none sees a jump."""
    drift = DriftFilter()
    drift.restart(1000.0, 3.0)
    assert not any([see(drift, delay, weight) for delay, weight in zip(seen, evidence, strict=True)])
    return drift


def test_first_looks_that_err_alike_are_no_drift_which_jumps_then_have_to_undo():
    rng = np.random.default_rng(1)
    seen = 1000.0 + 0.04 * rng.standard_normal(80)
    seen[:5] += (0.0, 0.3, 0.5, 0.7, 0.8)  # while the response is learnt: taken at its word, a slope of 200 ppm
    drift = follow(seen, np.full(80, 30.0))
    assert abs(drift.delay - 1000.0) < 0.2 and abs(drift.slope) < 10e-6  # 10 ppm: 0.2 samples in a second


@pytest.mark.parametrize("ppm", [40.0, -300.0])
def test_a_weak_first_look_at_a_reflection_gives_no_slope_that_later_looks_refute(ppm):
    seen = 1000.0 - ppm * 1e-6 * STRIDE * np.arange(1, 65)
    evidence = np.full(64, 32.0)
    seen[0] -= 2.5
    evidence[0] = 17.6
    drift = follow(seen, evidence)
    assert abs(drift.delay - seen[-1]) < 0.3 and abs(drift.slope + ppm * 1e-6) < 10e-6


def test_drift_that_builds_up_unseen_while_the_human_is_louder_is_no_jump():
    slope, truth, drift, jumps = 150e-6, 1000.0, DriftFilter(), []
    drift.restart(truth, 0.3)
    for second in range(14):
        for number in range(16):
            truth += slope * STRIDE
            bias = 0.25 * (-1) ** second  # looks of one sentence err alike
            if number < 6:
                jumps.append(see(drift, truth + bias))
            else:
                drift.advance(STRIDE)
    assert not any(jumps)
    assert abs(drift.delay - truth) < 1.0 and abs(drift.slope - slope) < 30e-6


def test_a_look_that_contradicts_what_is_believed_is_followed_once_it_is_taken():
    drift = DriftFilter()
    drift.restart(1000.0, 0.3)
    for _ in range(160):
        drift.advance(STRIDE)
        drift.correct(look(1000.0 - drift.delay))
    drift.advance(STRIDE)
    assert drift.surprise(look(1.4)) > 5.0
    drift.correct(look(1.4))
    assert abs(drift.delay - 1001.4) < 0.1  # of 1.4; insisting on its 10 s of looks, it would go a tenth of the way


def test_a_jump_just_after_a_look_says_nothing_of_the_clocks_and_one_after_a_pause_does():
    def deviation_after(pause):
        """Of the delay, 10 s after the jump in which nothing is seen."""
        drift = DriftFilter()
        drift.restart(1000.0, 0.3)
        for _ in range(160):
            drift.advance(STRIDE)
            drift.correct(look(1000.0 - drift.delay))
        drift.advance(pause)
        drift.step(look(3.0))
        drift.advance(10 * RATE)
        return drift.deviation

    assert deviation_after(STRIDE) < 0.4  # 3 samples in 64 ms are no clocks
    assert deviation_after(2 * RATE) == pytest.approx(15.0, abs=0.1)  # in 2 s they are 94 ppm


@pytest.mark.parametrize(("level_db", "ppm"), [(-10, 150.0), (-10, -300.0), (0, -150.0), (26, 300.0)])
@pytest.mark.parametrize("profile", [True, False])
def test_beside_a_human_from_the_first_second_every_utterance_stays_within_a_millisecond(level_db, ppm, profile):
    rng = np.random.default_rng(30)
    scene = double_talk(rng, [speech_like(rng, 4), speech_like(rng, 4)], speech_like(rng, 14), level_db, ppm)
    aligner = Aligner(256, known_path(room(rng, 0.25)) if profile else None)
    hops = run(aligner, scene.mic, scene.ref)
    error = np.abs(np.array([a.delay for a in hops]) - scene.truth[255::256][: len(hops)])
    for begin, end in scene.heard:
        late = slice((begin + 2 * RATE) // 256, end // 256)
        assert np.all(error[late] < CLOSE)
        moves = np.diff([a.delay for a in hops[late]])
        assert np.abs(moves).max() < 1.5  # samples in a hop: what looks correct, less than any jump


def test_states_tell_an_utterance_that_begins_from_one_that_is_lost_and_one_that_never_came():
    rng = np.random.default_rng(31)
    ref, onsets = utterances(rng, [3, 6], [1.5, 3])
    lag = 4000
    mic, _ = hear(ref, [(0, lag)], room(rng, 0.3))
    mic[onsets[1] :] = 0.0  # muted before its second utterance
    hops = run(Aligner(256), mic + fan(rng, mic.size), ref)
    states = np.array([a.state for a in hops])

    def at(seconds: float, start: int = 0) -> str:
        return states[int((start + seconds * RATE) // 256)]

    assert states[0] == "idle" and at(0.1, onsets[0]) == "begun" and np.isnan(hops[onsets[0] // 256 + 6].delay)
    assert at(1.0, onsets[0] + lag) == "locked" and at(-0.2, onsets[1]) == "idle"
    assert at(0.1, onsets[1]) == "begun" and not np.isnan(hops[onsets[1] // 256 + 6].delay)
    assert at(2.5, onsets[1]) == "unfound"  # it may be 1.6 s late, and a quarter of a second of it has to be heard


def test_a_robot_that_is_not_seen_for_a_moment_is_lost_not_begun():
    rng = np.random.default_rng(32)
    ref, _ = utterances(rng, [6], [1])
    mic, _ = hear(ref, [(0, 4000)], room(rng, 0.3))
    hidden = slice(3 * RATE, 4 * RATE)
    mic[hidden] = 3.0 * np.std(mic) * rng.standard_normal(RATE).astype(np.float32)
    hops = run(Aligner(256), mic + fan(rng, mic.size), ref)
    states = [a.state for a in hops[hidden.start // 256 : 5 * RATE // 256]]
    assert "lost" in states and set(states) <= {"locked", "lost"} and states[-1] == "locked"
    assert all(
        abs(a.delay - hops[hidden.start // 256].delay) < 1.0 for a in hops[hidden.start // 256 : 5 * RATE // 256]
    )


@pytest.mark.parametrize("lost", [0, 160], ids=["all there", "loses 10 ms a second"])
def test_the_reference_of_a_robot_that_moves_away_while_it_talks_is_withheld_only_if_it_loses_samples(lost):
    """Then the lag has grown again."""
    rng = np.random.default_rng(0)
    ref, near = speech_like(rng, 8.0), room(rng, 0.3)
    diffuse = rng.standard_normal(8000) * np.exp(-np.arange(8000) / 1500)
    diffuse *= 0.2 * np.sqrt(np.sum(near**2) / np.sum(diffuse**2))  # 14 dB softer, no sharp arrival
    at_first, later = (np.convolve(ref, response) for response in (near, diffuse))
    mic = np.concatenate((np.zeros(900), at_first[:64000], later[64000 : ref.size - 900]))
    kept = np.arange(ref.size) % 16000 >= lost
    hops = run(Aligner(256), (mic + fan(rng, mic.size, 5e-4)).astype(np.float32)[: kept.sum()], ref[kept])[270:]
    assert any(hop.state == "lost" for hop in hops) and all(hop.reference.any() for hop in hops) == (not lost)


def test_a_robot_that_is_hidden_is_lost_after_three_looks_two_hops_apart():
    rng = np.random.default_rng(32)
    ref, _ = utterances(rng, [8], [1])
    mic, _ = hear(ref, [(0, 4000)], room(rng, 0.3))
    hidden = slice(4 * RATE, 6 * RATE)
    mic[hidden] = np.std(mic[2 * RATE : 4 * RATE]) * rng.standard_normal(2 * RATE).astype(np.float32)
    hops = run(Aligner(256), mic + fan(rng, mic.size), ref)
    first = hidden.start // 256
    lost = [a.state for a in hops].index("lost")
    confidence = np.array([a.confidence for a in hops[first : lost + 1]])
    missed = np.flatnonzero(np.isclose(np.diff(np.log(confidence / (1.0 - confidence))), -0.5))  # of the log odds
    assert len(missed) == 3 and np.all(np.diff(missed) == 2) and first + 1 + missed[-1] == lost


def delayed(ref, delay):
    """The reference (n,), heard at the delay of each sample (n,)."""
    fine = signal.resample_poly(ref, 8, 1)
    return np.interp((np.arange(ref.size) - delay) * 8, np.arange(fine.size), fine, left=0.0, right=0.0)


def after_a_pause(jump: float, slope: float = 0.0):
    """The hops after 2 s unseen in which the delay has moved by jump samples, from 1000 on, and the aligner's stats."""
    rng, back = np.random.default_rng(2), 4 * RATE
    ref = speech_like(rng, 6.0)
    since = np.arange(ref.size) - back
    mic = 0.5 * delayed(ref, 1000.0 + np.where(since < 0, 0.0, jump + slope * since)) + fan(rng, ref.size)
    mic[back - 2 * RATE : back] = 3.0 * np.std(mic) * rng.standard_normal(2 * RATE)
    aligner = Aligner(256)
    return run(aligner, mic.astype(np.float32), ref)[back // 256 :], aligner.stats()


def test_a_small_jump_after_a_pause_may_be_the_clocks_which_are_then_followed_at_once():
    hops, stats = after_a_pause(4.0, 125e-6)
    assert stats["jumps"] == 1
    assert all(abs(hop.ppm + 125.0) < 20.0 for hop in hops[RATE // 2 // 256 :])


def test_a_large_jump_after_a_pause_is_a_buffer_and_says_nothing_of_the_clocks():
    hops, stats = after_a_pause(12.0)
    assert stats["jumps"] == 1
    assert all(abs(hop.ppm) < 3.0 for hop in hops)  # what jitter allows


def test_an_error_of_a_sample_after_a_pause_is_followed_and_no_jump():
    hops, stats = after_a_pause(1.3)
    assert stats["jumps"] == 0 and stats["realignments"] == 1
    assert all(abs(hop.delay - 1001.3) < 0.2 for hop in hops[RATE // 2 // 256 :])


def test_somebody_far_louder_than_the_robot_has_been_hides_it_and_says_nothing_of_its_delay():
    """Neither a jump, however clear its peak, nor a robot that is lost."""
    ref = speech_like(np.random.default_rng(3), 5.0)
    mic, later = 0.5 * delayed(ref, 1000.0), 0.5 * delayed(ref, 1300.0)
    loud, soft = 2 * RATE, 4 * RATE
    mic[loud:soft], mic[soft:] = 10 * later[loud:soft], later[soft:]
    aligner = Aligner(256)

    def after(begin, end):
        run(aligner, mic[begin:end].astype(np.float32), ref[begin:end])
        return aligner.stats()

    counts = "jumps", "searches", "confidence"
    before, hidden = after(0, loud + 12 * 256), after(loud + 12 * 256, soft)
    assert before["state"] == hidden["state"] == "locked"
    assert [hidden[name] for name in counts] == [before[name] for name in counts]
    assert after(soft, ref.size)["jumps"] == 1
