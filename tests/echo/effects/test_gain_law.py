"""A gain that follows the level: found from what a voice tells of it, and only there."""

import numpy as np

from edgefilter.echo.effects.mic_agc import STEP, follow

STEPS = 600


def control(level_db, slope=0.4, attack_s=0.15, release_s=1.5):
    """The gain in dB of each step, written as one recursion, starting at rest."""
    gain, out = -slope * level_db[0], []
    for level in level_db:
        wanted = -slope * level
        seconds = attack_s if wanted < gain else release_s
        gain += (1 - np.exp(-STEP / 16_000 / seconds)) * (wanted - gain)
        out.append(gain)
    return np.array(out)


def scene(gain_db):
    rng = np.random.default_rng(2)
    voice = 5 * np.repeat(10 ** (level() / 20), STEP) * rng.standard_normal(STEPS * STEP)
    heard = np.repeat(10 ** (gain_db / 20), STEP) * voice + rng.standard_normal(voice.size)
    return voice, heard, (np.arange(voice.size) // 8000 % 2 == 0).astype(np.float32)


def level():
    return np.repeat(np.random.default_rng(7).uniform(-15, 5, STEPS // 12), 12)


def test_the_gain_is_followed_through_stretches_that_were_not_seen():
    truth = control(level())
    law = follow(level(), *scene(truth))
    error = law.curve_db - truth
    assert np.std(error) < 0.25 and np.std(truth) > 1.0
    assert law.misfit < 0.1 * law.plain


def test_a_gain_that_does_not_follow_the_level_obeys_no_law():
    law = follow(level(), *scene(2.0 * np.sin(np.arange(STEPS) / 37.0)))
    assert law.misfit > 0.5 * law.plain


def test_too_little_voice_tells_nothing():
    assert follow(level(), *(x * s for x, s in zip(scene(np.zeros(STEPS)), (1e-3, 1.0, 1.0), strict=True))) is None
