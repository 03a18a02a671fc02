"""What was learned, as a profile: made from the path in use and the fan in the robot's silences, kept in a file."""

from __future__ import annotations

import datetime
from dataclasses import replace

import numpy as np
from scipy import fft

from edgefilter.calibration.from_recording import bands_over_fan, fan_in_silences
from edgefilter.dsp.psd import floored
from edgefilter.echo.measurement import whiten
from edgefilter.echo.model import EchoModel
from edgefilter.filter.echo_path import EchoPath
from edgefilter.learning.tape import Tape
from edgefilter.profile.data import DISTORTION_ORDERS, GRID_FFT, LEARNED, MAX_TAPS, Profile


def learned_profile(base: Profile | None, path: EchoPath, tape: Tape) -> Profile:
    """The profile of a robot that was heard on that tape, through that path.

    base: what the filter began with; its fields that only a calibration can measure are kept.
    """
    canceller = path.canceller
    response = canceller.impulse_response()
    mic, reference, _ = tape.signals()
    noise_psd = floored(fan_in_silences(mic, tape.silent())[0]).astype(np.float32)
    today = datetime.datetime.now(datetime.timezone.utc).date().isoformat()
    if base is not None:
        echo = replace(base.echo, effects=path.effects).with_running_response(response, canceller.volume.gain)
        echo = replace(echo, impulse_response=echo.impulse_response[:MAX_TAPS])
        return replace(base, echo=echo, noise_psd=noise_psd, created=today, source=LEARNED)
    echo = EchoModel(response, path.effects)
    bands, snr = bands_over_fan(whiten(echo.predict(reference), noise_psd))
    return Profile(
        echo=echo,
        delay=tape.delay,
        response=np.abs(fft.rfft(response, 16 * GRID_FFT))[::16].astype(np.float32),
        noise_psd=noise_psd,
        band_hz=bands,
        band_snr_db=snr,
        distortion_db=np.zeros(len(DISTORTION_ORDERS)),
        created=today,
        source=LEARNED,
    )
