"""The path and the loudspeaker's laws from one recording of the robot, each with the other in place: no calibration needed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from edgefilter.dsp.psd import periodograms
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.late_reverb import SLOWER, decaying, reverberation_time
from edgefilter.echo.effects.loudspeaker_fit import Laws, fit_laws
from edgefilter.echo.effects.speaker_nonlinearity import SpeakerNonlinearity, as_values
from edgefilter.echo.measurement import whiten
from edgefilter.echo.wiener import convolve_from, fit_filter
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

TAPS = 8000
"""0.5 s."""
FIRST_RT60_S, USUAL_RT60_S = 0.5, 0.4
"""Decay that is expected before anything is known, and where the first path shows none."""
ROUNDS = 2
WHITENING = 1200
"""Samples by which whitening widens a response to either side, at most."""


def fit_path_and_loudspeaker(
    reference: Samples, recording: Samples, weights: Samples | None = None, taps: int = TAPS
) -> tuple[Samples, dict[str, float | Array]]:
    """The path from reference to recording, and the values of speaker_nonlinearity ahead of it, fitted in turns.

    Parameters
    ----------
    reference
        (n,) float32, aligned, so that the direct sound comes PRE_ROLL samples later in the recording.
    recording
        (n,) float32, the robot, alone where the weights are not 0.
    weights
        (n,) 0 to 1: how much a sample counts. None: all alike.
    taps
        Of the path.

    Returns
    -------
    tuple
        The impulse response (taps,) float32 and the effect's values: neutral ones where no law of the loudspeaker holds
        on samples that it was not fitted to.
    """
    w = np.ones(recording.size, np.float32) if weights is None else np.asarray(weights, np.float32)
    effect = SpeakerNonlinearity()
    values = complete(effect, {})
    laws: Laws | None = None
    response, noise = refined_path(reference, recording, w, first_path(reference, recording, w, taps))
    for turn in range(ROUNDS):
        if laws is not None or turn == 0:
            hear = hearing(response, noise)
            laws = fit_laws(reference, whiten(recording, noise), w, hear(reference), hear, laws)
        values = complete(effect, as_values(laws) if laws is not None else {})
        response, noise = refined_path(effect.apply(reference, values, SAMPLE_RATE), recording, w, response)
    return response.astype(np.float32), values


def first_path(x: Samples, y: Samples, weights: Samples, taps: int) -> Array:
    """A path, both signals flattened by the recording's spectrum, with a decay that any room may have, (taps,)."""
    heard = _psd(y, weights)
    flat, target = whiten(x, heard), whiten(y, heard)
    gain = float(np.mean(np.square(target))) / max(float(np.mean(np.square(flat))), 1e-30)
    prior = 0.05 * gain * 10 ** (-6.0 * np.arange(taps) / SAMPLE_RATE / FIRST_RT60_S)
    return fit_filter(flat, target, weights, taps, 0, prior, steps=40)


def refined_path(x: Samples, y: Samples, weights: Samples, response: Array) -> tuple[Array, Samples]:
    """The path (taps,) once more, with the decay and the noise that an earlier one shows, and that noise's PSD."""
    noise = _psd(y - convolve_from(x, response, 0), weights)
    rt60_s = reverberation_time(response[PRE_ROLL:]) or USUAL_RT60_S
    prior = decaying(response, SLOWER * rt60_s)
    return fit_filter(whiten(x, noise), whiten(y, noise), weights, response.size, 0, prior, steps=60), noise


def hearing(response: Array, noise: Samples) -> Callable[[Samples], Samples]:
    """What a path (taps,) and the whitening by a PSD (601,) make of a signal (n,), in one convolution."""
    through = whiten(np.pad(response.astype(np.float32), WHITENING), noise)
    return lambda sound: convolve_from(sound, through, WHITENING)


def _psd(x: Samples, weights: Samples) -> Samples:
    """PSD of x (n,) where the weights are not 0, those samples set side by side, (601,)."""
    return np.mean(periodograms(x[weights > 0.0], 1200), axis=0).astype(np.float32)
