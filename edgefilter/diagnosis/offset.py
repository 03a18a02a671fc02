"""By how much a whole recording lags behind what a profile predicts."""

from __future__ import annotations

import numpy as np
from scipy import fft

from edgefilter.dsp.fractional_delay import delayed
from edgefilter.dsp.lag import correlation_near, highest, likely_cross, top
from edgefilter.echo.lag_track import track_lag
from edgefilter.echo.recording import MAX_OFFSET
from edgefilter.errors import SignalError
from edgefilter.types import SAMPLE_RATE, Samples

STANDS_OUT = 12.0
"""Times the root mean square of all lags that the true one reaches."""
TRACK = SAMPLE_RATE
"""Samples of one window of the lag track."""
TRACK_REACH = 1600
"""Samples by which the lag may move away from that of the whole recording and still be followed."""


def starting_offset(predicted: Samples, recording: Samples) -> float:
    """Samples by which recording (n,) lags behind predicted (n,) at its beginning, both whitened.

    Over the whole of it where the lag is constant; where it moves (drift, jumps, a changed path), over the first
    seconds in which it holds still, so that what happens later is left in the residual. Raises SignalError where no lag
    stands out.
    """
    whole = find_offset(predicted, recording)
    track = track_lag(delayed(predicted, whole), recording, None, TRACK, TRACK_REACH)
    clear = track.correlation > 0.5 * track.correlation.max(initial=0.0)
    if np.count_nonzero(clear) < 4:
        return whole
    starts, lags = track.starts[clear], whole + track.lag[clear]
    first, middle = float(np.median(lags[:3])), float(np.median(lags))
    if np.quantile(np.abs(lags - middle), 0.8) < 0.06 and abs(first - middle) < 0.06:
        return whole
    moved = np.flatnonzero(np.abs(lags - first) > 0.3)
    stop = int(starts[moved[0] if moved.size else -1]) + TRACK
    stop = max(min(stop - TRACK // 2, int(starts[0]) + 4 * TRACK), int(starts[0]) + TRACK)
    still = slice(max(int(starts[0]) - TRACK // 2, 0), stop)
    part, n = delayed(predicted, first)[still], fft.next_fast_len(2 * (still.stop - still.start), real=True)
    return first + top(likely_cross(part, recording[still], n), n, 0.0)


def find_offset(predicted: Samples, recording: Samples) -> float:
    """Samples, to a few thousandths, by which recording (n,) lags behind predicted (n,): the highest peak of their correlation.

    Raises SignalError where no lag stands out.
    """
    n = fft.next_fast_len(2 * recording.size, real=True)
    cross = likely_cross(predicted, recording, n)
    lag, height = highest(correlation_near(cross, n, min(int(MAX_OFFSET * SAMPLE_RATE), recording.size - 1)))
    if height < STANDS_OUT:
        raise SignalError(
            "the recording does not contain the reference at any lag up to 3 s: are both of the same utterance?"
        )
    return top(cross, n, float(lag))
