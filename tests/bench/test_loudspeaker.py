"""The benchmark of loudspeaker models: recordings are aligned, a model finds itself, and what explodes is seen to."""

import numpy as np
import pytest

from bench.measure.loudspeaker import Recording, aligned, erle_db, page, rise_db
from bench.measure.loudspeaker_models import MODELS, fit_model, path_alone
from edgefilter.echo.effects.loudspeaker_laws import driver_terms
from edgefilter.types import PRE_ROLL
from tests.conformance import fan, robot_model, robot_speech


@pytest.mark.parametrize("lag", [0, 700, -40])
def test_the_direct_sound_comes_pre_roll_behind_its_reference(lag):
    x = robot_speech()[:64_000]
    heard = np.roll(x, lag) + 0.01 * fan(x.size)
    reference, microphone = aligned(x, heard)
    assert microphone is heard
    inside = slice(2_000, 60_000)
    np.testing.assert_allclose(reference[inside], np.roll(x, lag - PRE_ROLL)[inside], atol=1e-6)


def test_the_driver_is_found_where_there_is_one_and_products_explode():
    x = robot_speech()
    played = x + np.array([0.5, -0.3, 0.0, 0.2, 0.5, -0.2], np.float32) @ driver_terms(x, 250.0, 0.2)
    gains = []
    for draw in range(
        6
    ):  # a ten-millionth of the sound moves where a fit ends, and so what one draw gains, by up to 1 dB
        heard = robot_model().predict(played) + np.float32(0.1) * fan(x.size)
        heard *= 1.0 + 1e-7 * np.random.default_rng(draw).standard_normal(x.size)
        recording = Recording("one", "a", x, heard.astype(np.float32), 128_000)
        taught = x[: recording.split], recording.microphone[: recording.split]
        alone = erle_db(recording, path_alone(*taught), None)
        found = {name: fit_model(MODELS[name], *taught) for name in ("d x, d^2 x", "driver")}
        gains.append([erle_db(recording, *found[name]) - alone for name in ("d x, d^2 x", "driver")])
    products, driver = np.mean(gains, axis=0)
    # a regular voice leaves more error in the path than real ones, which hides most of either gain
    assert min(gain for _, gain in gains) > 2.0 and driver > 2.8 and driver > products
    rise = {name: rise_db(x, play) for name, (_, play) in found.items()}
    # d x of a reference 20 dB louder is 20 dB more beside it, d^2 x 40; a bent law ends
    assert rise["d x, d^2 x"] > 15.0 and rise["driver"] < 12.0


def test_the_page_states_mean_interval_and_worst_of_each_group():
    rows = [
        {
            "group": "lab",
            "name": str(i),
            "erle_db": 20.0,
            "gain_db": {name: float(i) for name in (*MODELS, "effect, guarded")},
            "rise_db": {},
            "kept": i > 0,
        }
        for i in range(3)
    ]
    text = page(rows)
    assert "| recordings; the effect kept | 3; 2 |" in text and "| path alone, ERLE dB | 20.0 |" in text
    assert "| driver | +1.00 (+0.00 to +2.00), worst +0.00 |" in text
