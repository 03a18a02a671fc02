"""Loudspeaker distortion: its terms are those of a moving coil, its fit keeps what holds, and nothing explodes."""

import numpy as np
import pytest
from scipy import integrate

from edgefilter.dsp.membrane import MOTION_Q, motion
from edgefilter.echo.effect import complete, vanishes
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.speaker_nonlinearity import fit_laws
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.running import SourceChain
from edgefilter.errors import UsageError
from tests.conformance import EFFECT_CASES, fan, robot_alone, robot_model, robot_speech

DISTORT = catalogue.find("speaker_nonlinearity")
CASE = EFFECT_CASES["speaker_nonlinearity"]
DRIVER, AMPLIFIER = ("force_factor", "stiffness", "damping"), ("even", "odd")


def added(x: np.ndarray, values: dict) -> np.ndarray:
    """What the effect adds to x (n,)."""
    return DISTORT.apply(x, complete(DISTORT, values), 16_000) - x


def test_two_tones_through_even_give_their_sum_and_difference():
    t = np.arange(16_000) / 16_000
    x = (0.3 * np.sin(2 * np.pi * 1000 * t) + 0.3 * np.sin(2 * np.pi * 1700 * t)).astype(np.float32)
    # far below the knee s is x / knee: 0.5 * (a + b)^2, products at 700 and 2700 Hz of 0.5 * 0.3^2, octaves of half
    spectrum = np.abs(np.fft.rfft(added(x, {"even": 4.0, "knee": 8.0}))) / 8000
    np.testing.assert_allclose(spectrum[[700, 2700, 2000, 3400]], [0.045, 0.045, 0.0225, 0.0225], rtol=1e-2)
    assert np.delete(spectrum, [0, 700, 2700, 2000, 3400]).max() < 1e-4


def test_membrane_moves_below_its_resonance_and_is_fastest_at_it():
    t = np.arange(16_000) / 16_000

    def levels(hz: float) -> np.ndarray:
        return np.std(motion(np.sin(2 * np.pi * hz * t).astype(np.float32), 250.0)[:, 4000:12000], axis=1) * np.sqrt(2)

    np.testing.assert_allclose(levels(250.0), MOTION_Q, rtol=0.01)  # both are Q at the resonance, from the equation
    assert levels(20.0)[0] == pytest.approx(1.0, abs=0.02) and levels(20.0)[1] < 0.1
    assert (levels(4000.0) < 0.1).all()


def test_a_silent_excerpt_holds_no_law():
    rng = np.random.default_rng(2)
    x = (0.1 * rng.standard_normal(64_000)).astype(np.float32)
    x[32_000:] = 0.0
    target = x + 1e-2 * rng.standard_normal(x.size).astype(np.float32)
    with np.errstate(all="raise"):
        assert fit_laws(x, target, np.ones_like(x), x, np.copy, excerpt=slice(32_000, 64_000)) is None


def test_terms_are_those_of_the_equation_of_motion():
    """A membrane whose stiffness rises with displacement, solved step by step: the effect's first order is most of it."""
    rate, w, growth = 16_000, 2 * np.pi * 250.0, 0.3
    n = 1600
    t = np.arange(n) / rate
    x = (0.5 * np.sin(2 * np.pi * 180 * t) + 0.3 * np.sin(2 * np.pi * 410 * t)).astype(np.float32)

    def moved(growth: float) -> np.ndarray:
        def law(at: float, state: np.ndarray) -> list[float]:
            d, v = state
            drive = 0.5 * np.sin(2 * np.pi * 180 * at) + 0.3 * np.sin(2 * np.pi * 410 * at)
            s = d / np.hypot(1.0, d)
            return [v, w * w * (drive - (1.0 + growth * s * s) * d) - w / MOTION_Q * v]

        return integrate.solve_ivp(law, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10).y[0]

    exact = moved(growth) - moved(0.0)
    ours = motion(added(x, {"stiffness": np.array([0.0, growth]), "excursion": 1.0}), 250.0)[0]
    # the second order is of the size of growth times the first
    assert np.std(ours - exact) < 0.3 * np.std(exact) and np.std(exact) > 0.01


@pytest.mark.parametrize("parts", [DRIVER, AMPLIFIER])
def test_fit_finds_the_part_that_bends_and_leaves_the_other_neutral(parts):
    truth = {name: value for name, value in CASE.items() if name in (*parts, "excursion", "knee")}
    measurement, model = robot_alone("speaker_nonlinearity", truth, gain_db=0.0)
    found = DISTORT.fit(measurement, model)
    expected, ours = added(measurement.reference, truth), added(measurement.reference, found)
    lost = measurement.whiten(model.predict(ours)) - measurement.whiten(model.predict(expected))
    heard = measurement.whiten(model.predict(expected))
    # the faint cubic distortion of robot_alone and the scale of the laws, which is not searched finely
    assert np.mean(lost**2) < 0.1 * np.mean(heard**2)
    assert not any(np.any(found[name]) for name in (*DRIVER, *AMPLIFIER) if name not in parts)


@pytest.mark.slow
def test_level_is_that_of_the_distortion_at_the_microphone():
    values = {"odd": -0.3, "knee": 0.3}
    measurement, model = robot_alone("speaker_nonlinearity", values, gain_db=0.0)
    linear = measurement.whiten(model.predict(measurement.reference))
    distorted = measurement.whiten(model.predict(added(measurement.reference, values)))
    distorted -= np.dot(distorted, linear) / np.dot(linear, linear) * linear
    expected = 10 * np.log10(np.mean(distorted**2) / np.mean(linear**2))
    # by the fan's error and that of the law's shape
    assert DISTORT.fit(measurement, model)["level_db"] == pytest.approx(expected, abs=1.0)


def test_what_the_reference_does_not_explain_is_no_distortion():
    x, model = robot_speech(), robot_model()
    other = 0.5 * model.predict(np.ascontiguousarray(x[::-1]))
    measurement = Measurement(x, model.predict(x) + other + fan(x.size), robot_alone()[0].noise_psd)
    assert vanishes(DISTORT, DISTORT.fit(measurement, model))


@pytest.mark.slow
@pytest.mark.parametrize("louder_db", [20.0, 60.0])
def test_a_reference_that_is_louder_than_the_fit_does_not_make_the_distortion_explode(louder_db):
    measurement, model = robot_alone("speaker_nonlinearity", CASE)
    x, found = measurement.reference, DISTORT.fit(measurement, model)
    louder = (x * 10 ** (louder_db / 20)).astype(np.float32)
    loudest = np.abs(added(x, found)).max() / np.abs(x).max()
    worst = np.abs(added(louder, found)).max() / np.abs(louder).max()
    # a cube would be 40 or 120 dB over the voice's own rise; the bent laws end within 10 dB of what the fit has seen
    assert 0.01 < loudest and worst < 3.2 * loudest


def test_no_value_within_the_bounds_adds_more_than_in_proportion():
    largest = {name: np.array([4.0, 4.0]) for name in (*DRIVER, *AMPLIFIER)} | {"excursion": 1e-4, "knee": 1e-4}
    x = robot_speech()[:32_000]
    moved = np.abs(motion(x, 250.0)).max(axis=1)
    # each of ten weights of 4 meets |x|, the displacement or the velocity once
    assert np.abs(added(x, largest)).max() <= 8.0 * (3.0 * np.abs(x).max() + moved.sum()) * (1 + 1e-5)


def test_values_of_the_polynomial_that_this_effect_was_are_refused_by_name():
    with pytest.raises(UsageError, match="no parameter 'saturation': it takes force_factor, stiffness, damping"):
        complete(DISTORT, {"saturation": 0.0, "odd": -0.5})


@pytest.mark.parametrize("sizes", [[256], [1, 700, 13]])
def test_driven_hop_by_hop_is_the_same_as_at_once(sizes):
    x = robot_speech()[:20_000]
    knocks = {"threshold": 0.01, "resonance_hz": 250.0, "outward": np.array([0.0, 0.01, -0.02])}
    distortion = CASE
    model = (
        robot_model()
        .with_effect("speaker_nonlinearity", distortion)
        .with_effect("rattle", knocks)
        .with_effect("playback_gain", {"gain_db": 2.0})
    )
    whole = x
    for effect, values in catalogue.chain(model.effects):
        whole = effect.apply(whole, values, 16_000)
    driver, at, out = SourceChain(model.effects), 0, []
    while at < x.size:
        size = sizes[len(out) % len(sizes)]
        out.append(driver(x[at : at + size]))
        at += size
    # the membrane's ringing beyond MOTION_TAPS is 87 dB down, where the laws let a third of it through
    np.testing.assert_allclose(np.concatenate(out), whole, atol=1e-5)
    assert np.std(whole - x) > 1e-2


def test_driver_goes_on_after_its_past_was_rewritten():
    x, model = (
        robot_speech()[:8192],
        robot_model().with_effect("speaker_nonlinearity", CASE),
    )
    driver = SourceChain(model.effects)
    driver(np.full(256, 0.3, np.float32))
    history = driver.restart(x[:4096])
    again = [driver(x[at : at + 256]) for at in range(4096, x.size, 256)]
    whole = SourceChain(model.effects)(x)
    np.testing.assert_allclose(history, whole[:4096], atol=1e-6)
    np.testing.assert_allclose(np.concatenate(again), whole[4096:], atol=1e-6)
