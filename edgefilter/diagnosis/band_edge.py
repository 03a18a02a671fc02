"""Where a recording's band ends, by its power alone: a codec's noise hides in the waveform what its low-pass takes away."""

from __future__ import annotations

import numpy as np

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.score import FRAMES_PER_CELL, Judge
from edgefilter.diagnosis.trials import Found, Trial
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.types import Samples

INDEPENDENT = 0.6
"""Part of a cell's half-overlapping Hann frames that counts as independent."""


def band_edge(judge: Judge, prediction: Samples, criteria: Criteria) -> float | None:
    """Frequency in Hz above which the voice of prediction (n,) is missing from the recording's power.

    None where it is all there.

    The power over that of the robot's silences, summed over all bands above an edge, is held against the predicted one.
    """
    active = judge.active_cells
    if active.sum() < 10:
        return None
    heard, expected = judge.cells(judge.prepared.measurement.recording), judge.cells(prediction)[active]
    quiet = heard[~active]
    fan = quiet.mean(axis=0) if len(quiet) >= 4 else np.ones(heard.shape[1])
    voice = (heard[active].mean(axis=0) - fan) * judge.freedom
    wanted = expected.mean(axis=0) * judge.freedom
    variance = (fan + expected.mean(axis=0)) ** 2 * judge.freedom / (FRAMES_PER_CELL * INDEPENDENT)
    error = np.sqrt(np.cumsum(variance[::-1])[::-1] * (1.0 / active.sum() + 1.0 / max(len(quiet), 4)))
    there, due = (np.cumsum(x[::-1])[::-1] for x in (voice, wanted))
    for i in np.flatnonzero((there < criteria.edge_gone * due) & (due - there > criteria.edge_sure * error)):
        edge = float(judge.band_hz[i, 0])
        below = (judge.band_hz[:, 0] >= 0.25 * edge) & (judge.band_hz[:, 1] <= 0.7 * edge)
        low, high = criteria.edge_passed
        if below.any() and low <= voice[below].sum() / wanted[below].sum() <= high:
            return edge
    return None


def cut_by_power(found: Found, criteria: Criteria) -> Found | None:
    """The outcome of a search with nothing but a band limit, where the recording's power shows one and the residual falls by it; else None."""
    judge = Judge(found.prepared)
    edge = band_edge(judge, found.base.prediction, criteria)
    if edge is None:
        return None
    absent = [name for name in names() if name not in dict(found.start.effects)]
    cuts = [(name, values) for name in absent if (values := find(name).cutting_above(edge)) is not None]
    for name, values in cuts:
        model = found.start.with_effect(name, values)
        after = judge.of(model)
        step = Trial.of(name, model, found.base, after)
        if step.gain_db > 0.0:
            return Found(found.prepared, found.start, model, found.base, after, (step,), found.notes)
    return None
