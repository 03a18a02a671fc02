"""A whole recording at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.learner import Learner
from edgefilter.profile.data import Profile
from edgefilter.types import Samples


def enhance(
    mic: Samples,
    ref: Samples,
    profile: Profile | str | Path | None = None,
    engine: str = "auto",
    model: str | Path | None = None,
    learn: Learner | None = None,
) -> Samples:
    """Filter a whole recording with its reference, by the same stream as live.

    Parameters
    ----------
    mic : ndarray of float, shape (n,) or (n, channels)
        What the microphone heard, or two to eight microphones on one clock; full scale +-1, 16 kHz.
    ref : ndarray of float, shape (n,)
        What the robot said, on the same sample counter.
    profile, engine, model, learn
        As of `EgoFilter`.

    Returns
    -------
    ndarray of float32, shape (n,)
        The human, aligned with the input.

    Raises
    ------
    SignalError
        For another shape or dtype, unequal lengths, or samples that are not finite or beyond 1e6.
    UsageError, ProfileError, ModelError
        As of `EgoFilter`.

    Examples
    --------
    >>> import numpy as np
    >>> robot = 0.1 * np.random.default_rng(0).standard_normal(48_000)
    >>> heard = np.convolve(robot, [0.0] * 500 + [0.5, 0.2])[:48_000]
    >>> left = enhance(heard, robot, engine="linear")[-16_000:]
    >>> bool(np.mean(left**2) < 0.01 * np.mean(heard[-16_000:] ** 2))
    True
    """
    ego = EgoFilter(profile, engine, model=model, learn=learn)
    return np.concatenate((ego.process(mic, ref), ego.flush()))
