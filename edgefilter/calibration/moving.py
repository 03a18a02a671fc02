"""Calibration of a robot that moves while it talks: the running filter listens to it, and what it learns is kept."""

from __future__ import annotations

from dataclasses import replace

from edgefilter import engines
from edgefilter.dsp.resample import at_16_khz
from edgefilter.errors import CalibrationError, SignalError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import Profile
from edgefilter.profile.while_moving import WhileMoving
from edgefilter.types import SAMPLE_RATE, Samples

NOBODY = BargeInSettings(threshold=1.0 - 1e-9)
"""Nobody else speaks, so whatever sounds human is the robot."""
LEAST_S = 5.0
"""Least seconds of the robot's voice from which the rate of false suspicions is told: one in 5 s is eight times the usual rate."""


def calibrate_moving(
    profile: Profile, recording: Samples, reference: Samples, *, sample_rate: int = SAMPLE_RATE
) -> Profile:
    """Add to a profile what else is heard when the robot talks: motors, say, which go with its voice and are in no reference.

    Parameters
    ----------
    profile : Profile
        The calibrated robot.
    recording : ndarray of float, shape (n,) or (n, channels)
        What its microphones hear while it talks for some seconds and moves as usual, and nobody else speaks; full scale +-1.
    reference : ndarray of float, shape (n,)
        What it says meanwhile, as it is sent to the loudspeaker, on the same sample counter. Of the longer one the rest is not used.
    sample_rate : int
        Of both; they are converted to 16 kHz.

    Returns
    -------
    Profile
        The same with `while_moving`. The mask expects this noise from the first word on, and the robot is suspected of being a
        human as rarely as one without motors.

    Raises
    ------
    CalibrationError
        Where the robot is not found in the recording, or is heard for less than LEAST_S.

    Notes
    -----
    The running filter listens and learns as it does in use (`filter.residual_echo`, `filter.barge_in`), but knows that nobody speaks.

    Examples
    --------
    >>> import soundfile
    >>> from edgefilter.filter.budget import DEMO
    >>> heard, human, said = (soundfile.read(DEMO / f"{name}.flac")[0][:128_000] for name in ("mic", "human", "reference"))
    >>> robot = calibrate_moving(Profile.load(DEMO / "profile.npz"), heard - human, said)
    >>> 5.0 < robot.while_moving.seconds < 8.0
    True
    """
    stream = Stream(engines.create("crnn", profile), profile, barge_in=NOBODY)
    heard, said = at_16_khz(recording, sample_rate), at_16_khz(reference, sample_rate)
    both = min(len(heard), len(said))
    try:
        stream.process(heard[:both], said[:both])
    except SignalError as error:
        raise CalibrationError(f"the recording of the moving robot: {error}") from None
    stage = stream.front.linear_stage
    moments, seconds = stream.barge_in.own.counted
    if stage is None or stage.aligner.stats()["delay_samples"] is None or seconds < LEAST_S:
        raise CalibrationError(
            f"the robot's voice is found in {seconds:.0f} s of the recording of the moving robot, expected at least {LEAST_S:.0f}: let it"
            " talk, with the loudspeaker and microphone that were calibrated"
        )
    learned = WhileMoving.learned(stage.residual.with_voice, stream.engine.stft, moments, seconds)
    return replace(profile, while_moving=learned)
