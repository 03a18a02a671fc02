"""Before the lag of an utterance is known, what can only be the robot is lowered; nobody else is."""

import numpy as np
import pytest
import soundfile

from edgefilter import enhance
from edgefilter.alignment.aligner import Aligner
from edgefilter.alignment.delay_line import Aligned
from edgefilter.filter.budget import DEMO
from edgefilter.filter.onset_gate import GATE, LONGEST, SETTLE, OnsetGate
from tests.alignment.scene import RATE, fan, hear, known_path, room, run, utterances

HOP = 256
RAMP = 64
"""4 ms."""


def spoken(rng: np.random.Generator, seconds: list[float], pauses: list[float]) -> tuple[np.ndarray, list[int]]:
    """Utterances that begin loud, and their onsets."""
    ref, onsets = utterances(rng, seconds, pauses)
    for onset in onsets:
        ref[onset : onset + RATE // 12] = 0.0
    return 2.0 * ref, onsets


def gated(mic: np.ndarray, ref: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Aligned]]:
    """Whole hops of the microphone, the same behind the gate, (hops, HOP) each, and what the aligner found."""
    path = known_path(h)
    gate = OnsetGate(HOP, float(np.sum(path.echo.impulse_response**2)))
    found = run(Aligner(HOP, path), mic, ref)
    mics, refs = (x[: len(found) * HOP].reshape(-1, HOP) for x in (mic, ref))
    gains = [gate.step(m, r, aligned) for m, r, aligned in zip(mics, refs, found, strict=True)]
    return mics, np.array([m if gain is None else gain * m for m, gain in zip(mics, gains)]), found


@pytest.mark.parametrize("lags", [(3000, 9000), (9000, 2000)])
def test_the_robot_is_lowered_until_its_lag_is_found(lags):
    rng = np.random.default_rng(1)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    mic = hear(ref, [(0, lags[0]), (onsets[1] - 100, lags[1])], h)[0] + fan(rng, ref.size, 0.001)
    mic, out, found = gated(mic, ref, h)
    begun = np.array([aligned.state == "begun" for aligned in found])
    loud = np.square(mic).sum(1)
    explained = np.array([np.dot(aligned.reference, aligned.reference) for aligned in found])
    burst = (loud > 0.1 * loud.max()) & (explained < 0.01 * explained.max()) & begun
    second = np.arange(loud.size) > loud.size // 2
    for part in (second, ~second):
        assert np.any(burst & part)
        assert np.mean(out[burst & part] ** 2) < 0.1 * np.mean(mic[burst & part] ** 2)
    assert np.array_equal(out[~begun, RAMP:], mic[~begun, RAMP:])


def test_one_loud_sample_of_the_reference_does_not_keep_the_gate_open_for_ever():
    rng = np.random.default_rng(1)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    mic = hear(ref, [(0, 3000), (onsets[1] - 100, 9000)], h)[0] + fan(rng, ref.size, 0.001)
    clicked = ref.copy()
    clicked[onsets[0] + RATE] = 1e6
    mic, out, _ = gated(mic, ref, h)
    _, after_click, found = gated(mic.reshape(-1), clicked, h)
    lowered = np.all(out == np.float32(GATE) * mic, axis=1)
    second = np.arange(len(found)) * HOP > onsets[1]
    begun = np.array([aligned.state == "begun" for aligned in found])
    assert np.count_nonzero(lowered & second & begun) > 2
    assert np.array_equal(after_click[lowered & begun], out[lowered & begun])


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_a_human_20_db_below_the_robot_beside_a_muted_loudspeaker_is_untouched(level):
    rng = np.random.default_rng(2)
    h = room(rng, 0.3)
    ref, _ = spoken(rng, [2.0, 2.0], [1.5, 1.0])
    human = utterances(rng, [4.0], [ref.size / RATE])[0][: ref.size]
    human *= level * hear(ref, [(0, 3000)], h)[0].std() / human.std()
    mic, out, found = gated(human + fan(rng, ref.size, 0.001), ref, h)
    assert any(aligned.state == "begun" for aligned in found)
    assert np.array_equal(out, mic)


def test_a_human_as_loud_as_the_robot_beside_a_muted_loudspeaker_loses_a_quarter_second_per_utterance():
    rng = np.random.default_rng(4)
    h = room(rng, 0.3)
    ref, onsets = spoken(rng, [2.0, 2.0], [3.0, 2.0])
    human = utterances(rng, [8.0], [2.0])[0][: ref.size]
    human *= hear(ref, [(0, 3000)], h)[0].std() / human.std()
    mic, out, _ = gated(human, ref, h)
    assert 0 < np.count_nonzero(out != mic) <= len(onsets) * (LONGEST + HOP + 2 * RAMP)


def test_soft_first_sounds_of_a_voice_make_nobody_loud():
    rng = np.random.default_rng(5)
    ref = (1e-4 * rng.standard_normal(2 * RATE)).astype(np.float32)
    mic, out, found = gated(fan(rng, ref.size, 0.005), ref, room(rng, 0.3))
    assert any(aligned.state == "begun" for aligned in found)
    assert np.array_equal(out, mic)


def test_the_gate_shuts_at_once_and_opens_without_a_step():
    gate, ones = OnsetGate(HOP, 1.0), np.ones(HOP, np.float32)
    lost = Aligned(0 * ones, float("nan"), 0.0, 0.0, "begun", False)
    locked = Aligned(ones, 0.0, 0.0, 1.0, "locked", True)
    gains, shuts = [], []
    for aligned in (locked, lost, lost, locked, locked):
        gains.append(gate.step(ones, ones, aligned))
        shuts.append(gate.shuts)
    assert shuts == [False, True, False, False, False]
    assert gains[0] is None and gains[4] is None
    assert np.all(gains[1] == np.float32(GATE)) and np.all(gains[2] == np.float32(GATE))
    opening = np.concatenate((gains[2][-1:], gains[3]))
    assert opening[-1] == 1.0 and np.abs(np.diff(opening)).max() <= 1.01 / RAMP


def test_the_gate_is_shut_from_the_first_sample_on():
    gate, loud = OnsetGate(1, 1.0), np.ones(1, np.float32)
    gain = gate.step(loud, loud, Aligned(0 * loud, float("nan"), 0.0, 0.0, "begun", False))
    assert gate.shut and gain is not None and gain[0] == np.float32(GATE)


@pytest.mark.slow
def test_the_robots_onset_in_the_demo_stays_below_the_human():
    """At 8 s its second utterance begins with another lag.

    It came through 10 dB louder than the human's peak with crnn.
    """
    mic, ref, human = (
        soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference", "human")
    )
    for engine, margin in (("crnn", 0.0), ("ss", 3.0), ("linear", 9.0)):
        out = enhance(mic, ref, DEMO / "profile.npz", engine)
        onset = np.abs(out[int(7.8 * RATE) : int(9.0 * RATE)]).max()
        assert onset < np.abs(human).max() * 10 ** (margin / 20), engine


def test_after_a_lag_was_found_a_voice_is_suspect_for_a_moment():
    gate, ones = OnsetGate(HOP, 1.0), np.ones(HOP, np.float32)
    suspect = []
    for realigned in (False, True, *[False] * 30):
        gate.step(ones, ones, Aligned(ones, 0.0, 0.0, 1.0, "locked", realigned))
        suspect.append(gate.suspect)
    assert not suspect[0] and suspect[1] and sum(suspect) == round(SETTLE / HOP + 0.5) and not gate.shut
