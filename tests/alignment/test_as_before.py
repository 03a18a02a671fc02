"""Delays and states, hop by hop, of hard scenes: as they were before."""

import numpy as np
import pytest

from edgefilter.alignment.aligner import Aligner
from tests.alignment.scene import fan, hear, known_path, room, run, speech_like, utterances
from tests.as_before import levels_db, same_as_before


def told(aligner: Aligner, mic: np.ndarray, ref: np.ndarray) -> dict:
    """Of every fourth hop its figures, the level of what is delivered, and the figures at the end."""
    hops = run(aligner, mic, ref)
    return {
        "delay": [hop.delay for hop in hops[::4]],
        "state": [str(hop.state) for hop in hops[::4]],
        "confidence": [hop.confidence for hop in hops[::4]],
        "ppm": [hop.ppm for hop in hops[::4]],
        "flags": [10 * hop.realigned + hop.at_any_lag for hop in hops[::4]],
        "reference": levels_db(np.concatenate([hop.reference for hop in hops])),
        "stats": aligner.stats(),
    }


@pytest.mark.parametrize("knows", [True, False])
def test_utterances_of_other_lags_beside_a_human(knows: bool) -> None:
    rng = np.random.default_rng(7)
    ref, onsets = utterances(rng, [2.5, 1.5, 2.0], [1.0, 1.8, 1.0])
    mic, _ = hear(ref, list(zip(onsets, [4000, 900, 16500], strict=True)), room(rng, 0.5))
    human = speech_like(rng, mic.size / 16000)
    mic = mic + 0.7 * human * np.std(mic) / np.std(human) + fan(rng, mic.size)
    profile = known_path(room(rng, 0.25)) if knows else None
    same_as_before(f"alignment_utterances_{'known' if knows else 'unknown'}", told(Aligner(256, profile), mic, ref))


@pytest.mark.parametrize("seed", range(4))
def test_short_words_in_noise_whose_lags_are_far_apart(seed: int) -> None:
    """Players of another level each, between a whisper and too loud."""
    rng = np.random.default_rng([17, seed])
    ref, onsets = utterances(rng, [0.4, 0.8, 0.3, 1.5], [1.6, 1.6, 1.6, 1.6])
    mic, _ = hear(ref, list(zip(onsets, rng.uniform(0, 20_000, 4).round(), strict=True)), room(rng, 0.6))
    mic = np.clip((0.05, 0.3, 1.0, 4.0)[seed] * mic, -0.9, 0.9) + fan(rng, mic.size, 0.003)
    same_as_before(f"alignment_words_{seed}", told(Aligner(256), mic.astype(np.float32), ref))


@pytest.mark.parametrize("ppm", [0.0, 180.0])
def test_clocks_that_drift_and_a_buffer_that_is_lost(ppm: float) -> None:
    rng = np.random.default_rng(11)
    ref = speech_like(rng, 9.0)
    mic, _ = hear(ref, [(0, 2500), (80_000, 2660)], room(rng, 0.3), ppm)
    mic = mic + fan(rng, mic.size, 0.004)
    same_as_before(f"alignment_drift_{ppm:.0f}", told(Aligner(160), mic, ref))


@pytest.mark.parametrize("knows", [True, False])
def test_utterances_that_are_not_heard(knows: bool) -> None:
    """The third of five alone, and the last one; a human talks meanwhile."""
    rng = np.random.default_rng(19)
    ref, onsets = utterances(rng, [1.2, 0.6, 2.0, 1.5, 2.0], [1.0] * 5)
    heard = np.zeros(ref.size, np.float32)
    for at in (2, 4):
        stop = onsets[at + 1] if at < 4 else ref.size
        heard[onsets[at] : stop] = ref[onsets[at] : stop]
    mic, _ = hear(heard, [(0, 3300), (onsets[4], 3700)], room(rng, 0.4))
    mic = mic + 0.2 * speech_like(rng, mic.size / 16000) + fan(rng, mic.size)
    profile = known_path(room(rng, 0.25)) if knows else None
    same_as_before(f"alignment_unheard_{'known' if knows else 'unknown'}", told(Aligner(256, profile), mic, ref))


def test_an_array_of_three() -> None:
    rng = np.random.default_rng(13)
    paths = [np.roll(room(rng, 0.3), shift) for shift in (0, 2, 5)]
    ref, onsets = utterances(rng, [2.0, 2.0], [1.0, 1.0])
    lags = list(zip(onsets, [3000, 5200], strict=True))
    mics = np.stack([hear(ref, lags, path)[0] + fan(rng, ref.size) for path in paths])
    aligner = Aligner(256, known_path(*paths))
    aligner.hear_by(range(3))
    same_as_before("alignment_array", told(aligner, mics, ref))
