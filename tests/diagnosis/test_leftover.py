"""What is left without the robot, in words: tones, the mains, sounds of its own, and what follows the voice."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from edgefilter.diagnosis.leftover import Leftover, left_in_words, leftover
from edgefilter.dsp.tones import SECOND

RATE = 16_000
FAN = 1e-3
SECONDS = 12


def words(left: Leftover, human=(), active_db: float = 0.0, remaining_db: float = 3.0) -> str:
    found = SimpleNamespace(recording=SimpleNamespace(human=human), final=SimpleNamespace(active_db=active_db))
    return left_in_words(found, left, remaining_db, floor_db=2.0)


def left(mains_hz=0.0, tone_share=0.0, quiet_mean_db=0.0, swing_db=0.0) -> Leftover:
    tones = np.array([440.0, 700.0, 1200.0, 2000.0, 3000.0])
    return Leftover(tones, mains_hz, tone_share, quiet_mean_db, swing_db)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (left(), "a residual spread over the whole recording"),
        (left(quiet_mean_db=float("nan")), "a residual spread over the whole recording"),
        (left(quiet_mean_db=0.9, swing_db=9.0), "a residual spread over the whole recording"),
        (left(quiet_mean_db=1.1, swing_db=5.9), "sound of its own while the robot is silent"),
        (left(quiet_mean_db=1.1, swing_db=6.1), "sound of its own while the robot is silent, coming and going"),
        (left(tone_share=0.4), "a residual spread over the whole recording"),
        (left(tone_share=0.6, quiet_mean_db=9.0), "tones at 440, 700, 1200, 2000 Hz"),
        (left(50.0, 0.4, 9.0), "tones at multiples of 50 Hz, also while the robot is silent"),
        (left(50.0, 0.2), "a residual spread over the whole recording"),
    ],
)
def test_what_is_left_is_named_by_what_it_is_most(what, said):
    assert words(what) == f"what no effect of the catalogue explains: {said}"


def test_what_sounds_in_the_robots_silences_does_not_follow_its_voice():
    assert "follows" not in words(left(quiet_mean_db=2.5), active_db=3.0)


def test_a_human_is_told_of_also_where_nothing_else_is_left():
    said = "somebody talks at 1.2 to 3.4 s, 5.0 to 6.1 s, left out of all figures"
    human = ((1.24, 3.4), (5.0, 6.06))
    assert words(left(), human, remaining_db=1.9) == said and words(left(), remaining_db=1.9) == ""
    assert words(left(), remaining_db=2.0)
    assert words(left(quiet_mean_db=5.0), human).endswith(said)


def fan(seconds: float = SECONDS) -> np.ndarray:
    return FAN * np.random.default_rng(0).standard_normal(round(seconds * RATE)).astype(np.float32)


def inspect(residual: np.ndarray, silent_from_s: float = 6.0) -> Leftover:
    """What is left of a robot that speaks until then, with a white fan."""
    n = residual.size
    heard = SimpleNamespace(
        noise_psd=np.full(601, 2 * FAN**2 / RATE, np.float32),
        usable=np.ones(n, bool),
        active=np.arange(n) < silent_from_s * RATE,
        measurement=SimpleNamespace(recording=residual),
    )
    model, final = SimpleNamespace(microphone_gain=np.ones), SimpleNamespace(prediction=np.zeros(n, np.float32))
    return leftover(SimpleNamespace(in_noise=heard, model=model, final=final))


def tones(size: int, *hertz: float) -> np.ndarray:
    """Each half as strong as the one before."""
    at = np.arange(size) / RATE
    return sum(3e-3 * 0.5**k * np.sin(2 * np.pi * hz * at) for k, hz in enumerate(hertz)).astype(np.float32)


@pytest.mark.parametrize(
    ("hertz", "mains"),
    [
        ((150, 100, 250), 50.0),
        ((180, 120, 360), 60.0),
        ((331, 447), 0.0),
        ((150,), 0.0),
        ((150, 100), 50.0),
        ((331, 150, 100), 0.0),
        ((149, 101.4), 0.0),
    ],
)
def test_tones_are_found_loudest_first_with_the_mains_they_belong_to(hertz, mains):
    noise = fan()
    found = inspect(noise + tones(noise.size, *hertz))
    assert found.tones_hz.tolist() == pytest.approx(hertz, abs=1.0) and found.mains_hz == mains  # half a bin
    # the louder half of chance lies over the fan, too: a tenth of the power here
    assert found.tone_share > 0.7


@pytest.mark.parametrize(("hertz", "found"), [(18.5, []), (19.5, [19.53125])])
def test_below_19_hz_it_is_no_tone(hertz, found):
    noise = fan()
    assert inspect(noise + tones(noise.size, hertz)).tones_hz.tolist() == found


@pytest.mark.parametrize("hertz", [439.9, 440.0])
def test_a_tone_between_two_bins_is_one_tone_as_a_whole(hertz):
    found = inspect(300.0 * tones(12 * RATE, hertz) + fan())
    assert found.tones_hz[0] == pytest.approx(hertz, abs=0.6) and found.tone_share > 0.999


def test_a_fan_has_no_tones_nor_have_two_seconds():
    noise, most = fan(), 2 * SECOND
    assert inspect(noise[:most] + tones(most, 440)).tones_hz.size == 1
    for heard in (noise, (noise + tones(noise.size, 440))[: most - 1]):
        found = inspect(heard)
        assert found.tones_hz.size == 0 and (found.mains_hz, found.tone_share) == (0.0, 0.0)


def test_what_the_silences_hold_over_the_fan_is_told_in_db():
    """Twice the fan's power in the first half of the silences, ten times in the second."""
    noise = fan()
    noise[: 6 * RATE] *= 100.0
    noise[6 * RATE : 9 * RATE + 1600] *= np.float32(np.sqrt(2.0))
    noise[9 * RATE + 1600 :] *= np.float32(np.sqrt(10.0))
    found = inspect(noise)
    assert found.quiet_mean_db == pytest.approx(10 * np.log10((31 * 2 + 29 * 10) / 60), abs=0.2)
    assert found.swing_db == pytest.approx(10 * np.log10(5.0), abs=0.6)


@pytest.mark.parametrize(("silent_s", "told"), [(0.4, False), (0.5, True)])
def test_of_less_than_half_a_second_of_silence_nothing_is_told(silent_s, told):
    noise = fan()
    found = inspect(noise, SECONDS - silent_s)
    assert np.isfinite(found.quiet_mean_db) == told
    assert found.swing_db > 0.0 if told else found.swing_db == 0.0
