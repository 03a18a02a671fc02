"""Find out which physical effects the profile lacks, from a recording of the robot alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from edgefilter.compare import Comparison, describe
from edgefilter.conclude import conclude
from edgefilter.echo.effect import find
from edgefilter.findings import Diagnosis, Finding, Interval
from edgefilter.judge import Judge
from edgefilter.prepare import expected_noise, prepare
from edgefilter.profile import Profile
from edgefilter.search import search
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

    The comparison after says how well a fit to half of the recording, in blocks, predicts the other half; what is written is fitted to
    all of it, which predicts other recordings better.
    """
    prepared = prepare(profile, recording, reference, sample_rate=sample_rate)
    judge, measurement = Judge(prepared), prepared.measurement
    before = describe(prepared, judge.correct(prepared.prediction))
    judged = profile.with_echo(profile.echo.fit(name, measurement))
    written = profile.with_echo(profile.echo.fit(name, replace(measurement, fit=prepared.usable)))
    now = replace(prepared, measurement=replace(measurement, noise_psd=expected_noise(judged))) if find(name).stage == "noise" else prepared
    verdict = Judge(now).judge(judged.echo.predict(measurement.reference))
    return written, before, replace(describe(now, verdict.prediction), excess_db=verdict.excess_db)
