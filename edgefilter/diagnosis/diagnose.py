"""Find out which physical effects the profile lacks, from a recording of the robot alone."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from edgefilter.diagnosis.advice import advice, asks
from edgefilter.diagnosis.candidates import candidates
from edgefilter.diagnosis.closer_look import look_closer
from edgefilter.diagnosis.compare import Comparison, compare, describe, independence_of
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.findings import evidence_of, findings_of
from edgefilter.diagnosis.joint import fit_jointly
from edgefilter.diagnosis.laws import law_of, with_laws
from edgefilter.diagnosis.leftover import left_in_words, leftover
from edgefilter.diagnosis.precision import precision
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.proof import listed, with_fitted
from edgefilter.diagnosis.recording import Recording, share_of
from edgefilter.diagnosis.result import Diagnosis, Finding, Interval, Verdict, in_order
from edgefilter.diagnosis.select import search
from edgefilter.diagnosis.trials import Found
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

__all__ = ["Diagnosis", "Finding", "Interval", "add", "diagnose"]
PROMISE_DB = 0.5
"""What is written may leave so much more than the diagnosis did, as it says, before it is asked why: intervals are as wide."""


def diagnose(
    profile: Profile,
    recording: Samples,
    reference: Samples,
    *,
    sample_rate: int = SAMPLE_RATE,
    progress: Callable[[str], None] | None = None,
    criteria: Criteria | None = None,
    without: Collection[str] = (),
) -> Diagnosis:
    """Find out which physical effects a profile lacks, from a recording of the robot alone.

    Parameters
    ----------
    profile : Profile
        What is known of the robot.
    recording : ndarray of float, shape (m,)
        The robot alone at its microphone, from some seconds up, full scale +-1.
    reference : ndarray of float, shape (n,)
        What it said, as sent to the loudspeaker.
    sample_rate : int
        Of both; they are converted to 16 kHz.
    progress : callable, optional
        Called with a short text before each trial.
    criteria : Criteria, optional
        When an effect is named.
    without : collection of str, optional
        Names of effects that are not tried.

    Returns
    -------
    Diagnosis
        The verdict, and the effects whose presence the data supports, strongest first, with parameters and intervals.

    Raises
    ------
    SignalError
        Where the recording does not contain the reference.

    Notes
    -----
    Stepwise selection: every effect is fitted on half of the recording, in blocks of half a second, and tested on the
    other half (docs/diagnosis.md).

    Examples
    --------
    The robot's volume was turned down by 1.9 dB.

    >>> import numpy as np
    >>> from edgefilter import calibrate, generate_sweep
    >>> rng = np.random.default_rng(0)
    >>> def fan(n):
    ...     return 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> sweep = generate_sweep()
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> heard = 0.4 * np.roll(said, 300) + fan(said.size)
    >>> found = diagnose(profile, heard, said)
    >>> found.verdict, found.ranking[0].effect, round(found.ranking[0].parameters["gain_db"].value, 1)
    ('missing', 'playback_gain', -1.9)
    """
    prepared = prepare(profile, recording, reference, sample_rate=sample_rate)
    criteria = criteria or Criteria()
    found = search(prepared, prepared.model, criteria, progress, without)
    return conclude(prepared, found, criteria, progress, without)


def add(
    profile: Profile,
    names: str | Sequence[str],
    recording: Samples,
    reference: Samples,
    *,
    sample_rate: int = SAMPLE_RATE,
) -> tuple[Profile, Comparison, Comparison]:
    """Fit one or several effects to a recording, beside each other, and write them into a new profile.

    Parameters
    ----------
    profile : Profile
        Stays as it is.
    names : str or sequence of str
        Of the effects, as a diagnosis prints them.
    recording, reference, sample_rate
        As of `diagnose`.

    Returns
    -------
    Profile
        With the effects.
    Comparison, Comparison
        Before and after, both of the straightened recording; its warnings say what was straightened.

    Raises
    ------
    UsageError
        For an unknown effect.
    SignalError
        Where the recording does not contain the reference.

    Notes
    -----
    Clocks that drift, jumps and a turned volume are followed by the running filter itself and would spoil the fit of
    anything else, so they are taken out of the recording first, unless they are among the names; the profile does not
    get them. Each effect is fitted with the others in place, in turn, until the error no longer falls.

    Fitted to all of the recording: that predicts other recordings of the robot better than the fit to half of it by
    on which `diagnose` tests. So the comparison after, of this recording, is of samples that the fit has used; `prove`
    says what the effects are worth on others. An event (a jump, a moment's move) is kept with the recording in which it
    happened: of any other the profile predicts what it did before.

    Examples
    --------
    >>> import numpy as np
    >>> from edgefilter import calibrate, generate_sweep
    >>> rng = np.random.default_rng(0)
    >>> def fan(n):
    ...     return 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> sweep = generate_sweep()
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> heard = 0.4 * np.roll(said, 300) + fan(said.size)
    >>> better, before, after = add(profile, "playback_gain", heard, said)
    >>> [name for name, _ in better.echo.effects], after.excess_db < before.excess_db - 6
    (['playback_gain'], True)
    """
    prepared = prepare(profile, recording, reference, sample_rate=sample_rate)
    knowing, model, straightened = with_fitted(profile, prepared, listed(names))
    if not straightened:
        after = compare(knowing, recording, reference, sample_rate=sample_rate)
        return knowing, describe(prepared, prepared.model), after
    values, straight = dict(model.effects), prepared.model
    for name in straightened:
        straight = straight.with_effect(name, values[name])
    was = prepared.of(prepared.model).excess_db
    now = compare(knowing, recording, reference, sample_rate=sample_rate).excess_db
    told = tuple(f"{name} is taken out first: {find(name).sentence(values[name])}" for name in straightened)
    told += (f"with that left in, as compare has it: {was:.1f} dB over the noise floor before, {now:.1f} dB after",)
    told_of = replace(prepared, warnings=(*told, *prepared.warnings))
    return knowing, describe(told_of, straight), describe(told_of, model)


def settle(
    profile: Profile, found: Diagnosis, names: Sequence[str], recording: Samples, reference: Samples
) -> tuple[Profile, Comparison, Diagnosis]:
    """The profile with those findings of a diagnosis, its comparison, and the diagnosis with the figures of that profile.

    recording, reference: what was diagnosed, at 16 kHz. The findings are fitted once more, to all of the recording; where
    that leaves more than PROMISE_DB over what the diagnosis did, its own values are written. The diagnosis stays as it is
    where not all of its findings are among the names.
    """
    prepared = prepare(profile, recording, reference)
    start, values = prepared.model, dict(found.model.effects)
    for name in names:
        start = start.with_effect(name, values[name])
    everywhere = replace(prepared.measurement, fit=prepared.usable)
    choices: list[tuple[Comparison, Profile]] = []
    for model in (fit_jointly(everywhere, start, names), start):
        echo, values = profile.echo, dict(model.effects)
        for name in names:
            echo = echo.with_effect(name, values[name])
        choices.append((compare(profile.with_echo(echo), recording, reference), profile.with_echo(echo)))
        if choices[-1][0].excess_db <= found.remaining_db + PROMISE_DB:
            break
    after, knowing = min(choices, key=lambda choice: choice[0].excess_db)
    if {finding.effect for finding in found.ranking} != set(names):
        return knowing, after, found
    return knowing, after, _as_written(found, prepared, dict(knowing.echo.effects), after)


def _as_written(found: Diagnosis, prepared: Recording, values: Mapping[str, Values], after: Comparison) -> Diagnosis:
    """The diagnosis with the values of a profile that holds all its findings, and what each leaves then."""
    before = replace(describe(prepared, prepared.model), warnings=found.comparison.warnings)
    model, excess_db = prepared.model, before.excess_db
    findings: dict[str, Finding] = {}
    for finding in in_order(found.ranking):
        name, whole = finding.effect, before.excess_db
        model = model.with_effect(name, values[name])
        last = len(findings) == len(found.ranking) - 1
        left_db = after.excess_db if last else prepared.of(model).excess_db
        share = max(share_of(whole, left_db) - share_of(whole, excess_db), 0.0)
        findings[name] = replace(
            finding,
            excess_before_db=excess_db,
            excess_after_db=left_db,
            share=share,
            parameters={key: interval.at(values[name][key]) for key, interval in finding.parameters.items()},
            evidence=evidence_of(name, values[name], prepared.model, finding.evidence),
            values=values[name],
        )
        excess_db = left_db
    return replace(
        found,
        comparison=before,
        ranking=tuple(findings[finding.effect] for finding in found.ranking),
        remaining_db=after.excess_db,
        model=model,
        precision=found.precision.at(values),
        written=after,
    )


def conclude(
    prepared: Recording,
    found: Found,
    criteria: Criteria,
    progress: Callable[[str], None] | None = None,
    without: Collection[str] = (),
) -> Diagnosis:
    """The diagnosis that a search leads to; without: names of free laws that are not tried either."""
    comparison = describe(prepared, found.start, found.base)
    searched, found = found, with_laws(found, criteria, progress, without)
    left = leftover(found)
    believed = bool(found.steps) and _believed(found, criteria)
    quiet = found.base.excess_db < criteria.explained_db and not prepared.human
    verdict: Verdict = "missing" if found.steps and holds(found, criteria) else "explained" if quiet else "unexplained"
    part = share_of(
        found.base.excess_db, found.final.excess_db
    )  # enough to be named beside something that none explains
    partly = part >= criteria.half and explained_level(found) >= criteria.part_level
    if not believed and (quiet or not partly):
        shown = {step.name: step.values for step in found.steps if find(step.name).shows_in_silence}
        found = found.with_only(shown)  # silences and voice both show it
    unpredictable = any(find(step.name).adds_noise for step in found.steps)
    remaining = found.final.excess_db
    findings, doubts = findings_of(found, progress)
    tried = candidates(searched, [finding.effect for finding in findings])
    return Diagnosis(
        verdict=verdict,
        comparison=replace(comparison, warnings=(*comparison.warnings, *found.notes, *doubts)),
        ranking=findings,
        evidence=left_in_words(found, left, remaining, criteria.explained_db),
        remaining_db=remaining,
        irreducible_db=(
            max(remaining, found.final.irreducible_db, 0.0) if unpredictable and verdict == "missing" else 0.0
        ),
        model=found.model,
        tried=tried,
        independence=independence_of(found.recording, found.model, found.final)
        if findings
        else comparison.independence,
        precision=precision(found, findings),
        advice=(*advice(tried), *asks(tried)),
        closer_look=look_closer(found) if verdict == "unexplained" else None,
        law=law_of(found),
    )


def holds(found: Found, criteria: Criteria) -> bool:
    """Whether the effects that a model has beyond its start are what happened, and all that did."""
    return _believed(found, criteria) and not _much_left(found, criteria)


def _believed(found: Found, criteria: Criteria) -> bool:
    """Whether the findings leave next to nothing, or explain so much that they are what happened."""
    much = found.final.excess_db < criteria.half * found.base.excess_db
    return found.final.excess_db < criteria.explained_db or (much and explained_level(found) >= criteria.half)


def _much_left(found: Found, criteria: Criteria) -> bool:
    """Whether the findings leave so much, also of the samples that they were fitted to, that something else is there besides.

    What they leave of the others alone is how well a recording of that length teaches them.
    """
    silent = float(np.clip(found.final.silent_db, -0.5, 0.5))
    left = min(found.final.fitted_db, found.final.active_db) - silent
    return left > criteria.much_db and share_of(found.base.excess_db, found.final.excess_db) < criteria.nearly_all


def explained_level(found: Found) -> float:
    """Part of the level over the robot's silences that is gone, 0 to 1: of many cells rather than of the loudest."""
    above = found.base.over_db - found.final.floor_db
    gone = found.base.over_db - found.final.over_db
    return float(np.clip(gone / above, 0.0, 1.0)) if above > 0.0 else 0.0
