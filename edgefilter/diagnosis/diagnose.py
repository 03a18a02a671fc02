"""Find out which physical effects the profile lacks, from a recording of the robot alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from edgefilter.diagnosis.compare import Comparison, compare, describe
from edgefilter.diagnosis.conclude import conclude
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.result import Diagnosis, Finding, Interval
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.select import search
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

__all__ = ["Diagnosis", "Finding", "Interval", "add", "diagnose"]


def diagnose(
    profile: Profile,
    recording: Samples,
    reference: Samples,
    *,
    sample_rate: int = SAMPLE_RATE,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Say which effects recording (m,) of the robot playing reference (k,) shows that the profile lacks.

    progress: called with a short text before each trial. Raises SignalError where the recording does not contain the reference.
    """
    prepared = prepare(profile, recording, reference, sample_rate=sample_rate)
    found = search(prepared, profile.echo, progress)
    return conclude(prepared, found, progress)


def add(
    profile: Profile, name: str, recording: Samples, reference: Samples, *, sample_rate: int = SAMPLE_RATE
) -> tuple[Profile, Comparison, Comparison]:
    """Fit the effect of that name to a recording and write it into a new profile; the comparisons are those before and after.

    Fitted to all of the recording: that predicts other recordings of the robot better than the fit to half of it by which diagnose()
    judges. So the comparison after, of this recording, is of samples that the fit has used.
    """
    prepared = prepare(profile, recording, reference, sample_rate=sample_rate)
    before = describe(prepared, Judge(prepared).correct(prepared.prediction))
    fitted = profile.with_echo(profile.echo.fit(name, replace(prepared.measurement, fit=prepared.usable)))
    return fitted, before, compare(fitted, recording, reference, sample_rate=sample_rate)
