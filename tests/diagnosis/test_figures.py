"""Figures that a diagnosis quotes mean what its page says, and a fit that fails is one line."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgefilter.alignment.belief import believe
from edgefilter.diagnosis.precision import precision
from edgefilter.diagnosis.prepare import utterance_lags
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.straightened import share_of
from edgefilter.echo.effects.catalogue import register
from edgefilter.echo.effects.playback_gain import PlaybackGain
from edgefilter.echo.model import EchoModel
from edgefilter.errors import SignalError, UsageError
from edgefilter.types import SAMPLE_RATE
from tests.diagnosis.robot_scene import path, profile, record, voice


@pytest.mark.parametrize(
    ("before", "after", "share"), [(1.0, 0.5, 0.5), (4.0, 1.0, 0.75), (30.0, 0.0, 1.0), (1.0, 3.0, 0.0)]
)
def test_the_explained_share_is_that_of_the_power_over_the_fan(before, after, share):
    """before, after: power of what the robot's model leaves, in units of the fan's."""
    assert share_of(*(10 * np.log10(1.0 + power) for power in (before, after))) == pytest.approx(share)


def test_where_nothing_was_over_the_fan_nothing_is_explained():
    assert share_of(0.0, 0.0) == share_of(-1.0, -2.0) == 0.0


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("singular matrix"), FloatingPointError("overflow"), ZeroDivisionError("by zero")]
)
def test_an_explanation_that_cannot_be_fitted_is_one_line_that_names_it(error):
    class Unfit(PlaybackGain):
        name = "unfit"

        def fit(self, measurement, model):
            raise error

    register(Unfit())
    x = voice(2.0)
    with pytest.raises(SignalError, match="late_reverb\\+unfit cannot be fitted to the recording") as caught:
        Recording(record(x, EchoModel(path())), x, profile()).probe([("late_reverb", "unfit")])
    assert str(error) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("error", [FloatingPointError("overflow"), UsageError("ratio is 1e9, expected 1 to 50")])
def test_a_number_beside_which_the_effect_cannot_be_applied_has_the_scatter_of_the_thirds_alone_and_ends_nothing(error):
    def fails(*arguments):
        raise error

    fits = iter([-2.1, -2.0, -1.8])
    part = SimpleNamespace(fitted=lambda name, model: {"gain_db": next(fits)})
    found = SimpleNamespace(
        steps=(SimpleNamespace(name="playback_gain", values={"gain_db": -2.0}),),
        recording=SimpleNamespace(usable=np.ones(SAMPLE_RATE, bool), fitted_to=lambda fit: part),
        in_noise=SimpleNamespace(measurement=None),
        model=SimpleNamespace(with_effect=fails, without_effect=lambda name: None),
    )
    known, intervals, doubts = precision(found)
    (number,) = known.numbers
    assert number.source == "thirds" and not doubts
    interval = intervals["playback_gain"]["gain_db"]
    assert -2.5 < interval.low < -2.1 and -1.8 < interval.high < -1.5


@pytest.mark.parametrize("later", [-1000, 0, 1000])
def test_each_utterance_of_a_player_that_starts_anew_has_its_own_lag(later):
    rng, second = np.random.default_rng(3), SAMPLE_RATE
    said = np.zeros(10 * second, np.float32)
    for begin in (1, 6):
        said[begin * second : (begin + 3) * second] = 0.1 * rng.standard_normal(3 * second)
    heard = 1e-4 * rng.standard_normal(said.size)
    heard[100 : 5 * second] += said[: 5 * second - 100]
    heard[5 * second :] += np.roll(said, 100 + later)[5 * second :]
    heard = heard.astype(np.float32)
    found = utterance_lags(said, said, heard, believe(heard, said), 100.0)
    assert [round(lag) for _, _, lag in found] == ([100] if later == 0 else [100, 100 + later])
    assert found[0][0] == 0 and found[-1][1] == said.size
    assert all(6 * second - 1000 < first <= 6 * second for first, _, _ in found[1:])
