"""The echo path with the effects around it: what it starts from, and that it goes on from a state as if nothing had been."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.running import SourceChain
from edgefilter.filter.canceller import COLD, LEARNED, WARM, Canceller
from edgefilter.filter.echo_path import EchoPath, starting_path
from edgefilter.profile import data
from tests.conformance import robot

HOP = 256


def effects(**values: dict[str, float]) -> tuple:
    return tuple((name, complete(find(name), own)) for name, own in values.items())


LIMITER = {"ceiling_db": -26.0, "release_ms": 400.0}


def reference(hops: int) -> np.ndarray:
    rng = np.random.default_rng(2)
    return (0.1 * rng.standard_normal((hops, HOP)) * rng.random((hops, 1))).astype(np.float32)


@pytest.mark.parametrize(("taps", "kept"), [(300, 2048), (2048, 2048), (4000, 4096), (5000, 5120), (20_000, 8192)])
def test_a_path_is_as_long_as_the_profile_s_between_an_eighth_and_half_a_second(taps: int, kept: int) -> None:
    known = robot()
    response = np.resize(known.echo.impulse_response, taps).astype(np.float32)
    profile = replace(known, echo=replace(known.echo, impulse_response=response))
    assert starting_path(profile, HOP).canceller.taps == kept


def test_a_path_adapts_as_well_as_it_is_known() -> None:
    calibrated, taught = robot(), replace(robot(), source=data.LEARNED)
    found = [starting_path(profile, HOP).canceller.adaptation for profile in (None, calibrated, taught)]
    assert found == [COLD, WARM, LEARNED]


@pytest.mark.parametrize("around", [effects(), effects(limiter=LIMITER), effects(limiter=LIMITER, mic_clipping={})])
def test_a_path_that_is_resumed_from_a_state_goes_on_as_the_one_whose_state_it_is(around) -> None:
    ref, rng = reference(160), np.random.default_rng(3)
    response = (0.5 * rng.standard_normal(1024) * np.exp(-np.arange(1024) / 150)).astype(np.float32)
    path = EchoPath(Canceller(HOP, 2048, response), around)
    driven = SourceChain(around)(ref.ravel())
    echo = np.convolve(driven, 0.7 * response)[: ref.size].reshape(ref.shape).astype(np.float32)
    for hop in range(120):
        path.step(echo[hop], ref[hop], True)
    resumed = EchoPath.resumed(path.state(), ref[:121].ravel(), HOP)
    pairs = [(path.step(*hop, True).echo, resumed.step(*hop, True).echo) for hop in zip(echo[120:], ref[120:])]
    goes_on, begins = np.array(pairs).swapaxes(0, 1)
    assert np.abs(goes_on).max() > 0.05
    np.testing.assert_allclose(begins, goes_on, atol=1e-5)


def test_each_microphone_of_an_array_has_a_gain_control_of_its_own() -> None:
    """Beside one another they do what each does alone, though one is turned up in the middle."""
    agc = effects(mic_agc={"gain_db": np.array([0.0, -12.0]), "range_db": 20.0, "time_constant_s": 0.1})
    ref, responses = reference(60), np.zeros((2, 2048), np.float32)
    responses[:, 40] = 0.1, 1.0
    echo = np.stack([response[40] * np.roll(ref.ravel(), 40).reshape(ref.shape) for response in responses], axis=1)
    echo[30:, 1] *= 4.0
    both = EchoPath(Canceller(HOP, 2048, responses, microphones=2), agc)
    alone = [EchoPath(Canceller(HOP, 2048, response), agc) for response in responses]
    for mic, x in zip(echo, ref):
        found = both.step(mic, x, False).echo
        expected = np.stack([path.step(own, x, False).echo for path, own in zip(alone, mic)])
        np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(expected[1]).max() > 20 * np.abs(expected[0]).max()  # ten times as loud, and turned up


def test_a_path_with_an_effect_that_remembers_asks_for_as_much_of_the_past() -> None:
    with_limiter, without = (EchoPath(Canceller(HOP, 2048), around) for around in (effects(limiter=LIMITER), ()))
    assert with_limiter.history >= 16_000 > without.history
