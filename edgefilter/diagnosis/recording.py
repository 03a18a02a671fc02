"""A recording of the robot alone, straightened once: compare it with a profile, diagnose it, add effects, prove them, ask."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis.compare import Comparison, describe
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import as_written, conclude
from edgefilter.diagnosis.first_sight import at_first_sight
from edgefilter.diagnosis.joint import fit_jointly
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.probe import Inquiry
from edgefilter.diagnosis.proof import HeldOut, Proof, lasts, listed, with_fitted
from edgefilter.diagnosis.result import Candidate, Diagnosis
from edgefilter.diagnosis.select import search
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.diagnosis.trials import Workbench
from edgefilter.dsp.resample import at_16_khz
from edgefilter.echo.effect import first
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.catalogue import names as known_effects
from edgefilter.errors import SignalError
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

PROMISE_DB = 0.5
"""Rise of the excess, dB, over what the diagnosis left, that the refit to all of the recording may bring: intervals are as wide."""

CLOCKS = 1.0
"""Samples by which the clocks drift apart in a recording at least: a microphone that moves by 2 cm shifts the lag as much. A
recording of 27 s in which it moved by 1 cm was told to drift by 1 ppm."""


class Added(NamedTuple):
    """A profile with effects that were fitted to a recording, and the comparisons with it before and after."""

    profile: Profile
    before: Comparison
    after: Comparison


class Recording:
    """A recording of the robot alone and what it said, beside what a profile predicts of it.

    It is straightened when it is first asked something, and once: a constant lag of up to 3 s is taken out, and what others
    say is marked. `mic`, `reference`: at 16 kHz. `profile`: the one given (`known`), or one made from the recording.

    Parameters
    ----------
    mic : ndarray of float, shape (m,)
        The robot alone at its microphone, from some seconds up, full scale +-1.
    reference : ndarray of float, shape (n,)
        What it said, as sent to the loudspeaker.
    profile : Profile, optional
        What is known of the robot. None: a provisional profile is made from the recording.
    sample_rate : int
        Of both; they are converted to 16 kHz.

    Raises
    ------
    SignalError
        Where the samples are unusable; by every method, where the recording does not contain the reference.

    Examples
    --------
    >>> import numpy as np
    >>> from edgefilter import Recording, calibrate, generate_sweep
    >>> rng, sweep = np.random.default_rng(0), generate_sweep()
    >>> fan = lambda n: 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> recording = Recording(0.4 * np.roll(said, 300) + fan(said.size), said, profile)  # 1.9 dB softer than it was
    >>> found = recording.diagnose()
    >>> found.verdict, found.ranking[0].effect, round(found.ranking[0].parameters["gain_db"].value, 1)
    ('missing', 'playback_gain', -1.9)
    >>> recording.prove("playback_gain").worse
    False
    """

    def __init__(
        self, mic: Samples, reference: Samples, profile: Profile | None = None, *, sample_rate: int = SAMPLE_RATE
    ) -> None:
        self.mic, self.reference = at_16_khz(mic, sample_rate), at_16_khz(reference, sample_rate)
        self._given, self.profile = profile, profile or self_calibrate(self.mic, self.reference)

    @property
    def known(self) -> bool:
        """Whether the profile was given, and not made from the recording."""
        return self._given is not None

    @cached_property
    def straightened(self) -> Straightened:
        """On the sample counter of the prediction, with the samples to fit and those to test on."""
        return prepare(self.profile, self.mic, self.reference)

    @cached_property
    def held_out(self) -> HeldOut:
        """Cut in two, for a proof. Raises SignalError where it is too short for that."""
        return HeldOut(self._given, self.straightened, self.mic, self.reference)

    def compare(self) -> Comparison:
        """Say how far the profile's prediction is from the recording, and where, with the clocks' drift taken out; as the function `compare`."""
        prepared, start = self.straightened, self.straightened.model
        bench = Workbench(prepared, Criteria())
        lags = (
            bench.attempt(name, start)
            for name in known_effects()
            if find(name).followed and find(name).family == "time"
        )
        best = bench.preferred(trial for trial in lags if trial and bench.worth(trial, start))
        if best is None or find(best.name).event:
            return self._as_it_is()
        ppm, offset = (first(best.values, name) for name in ("ppm", "offset"))
        if 1e-6 * abs(ppm) * prepared.usable.size < CLOCKS:
            return self._as_it_is()
        found = describe(prepared, best.model, best.score)
        return replace(found, drift_ppm=-ppm, offset_samples=found.offset_samples + offset)

    def _as_it_is(self) -> Comparison:
        """Compare with the clocks' drift left in, as a diagnosis begins."""
        return describe(self.straightened, self.straightened.model)

    def at_first_sight(self, criteria: Criteria | None = None) -> dict[str, float]:
        """Say after a second or two of computing which families of effects the profile lacks, and by how many dB each lowers the residual.

        Parameters
        ----------
        criteria : Criteria, optional
            `false_rate`: of recordings without any effect, the share in which a family may be told.

        Returns
        -------
        dict of str to float
            The largest first; empty where none is seen. `diagnose` names the effects, those as well that a larger one hides.
        """
        return at_first_sight(self.straightened, criteria or Criteria())

    def diagnose(
        self,
        *,
        progress: Callable[[str], None] | None = None,
        criteria: Criteria | None = None,
        without: Collection[str] = (),
    ) -> Diagnosis:
        """Find out which physical effects the profile lacks: `diagnose`."""
        criteria, prepared = criteria or Criteria(), self.straightened
        found = search(prepared, prepared.model, criteria, progress, without)
        return conclude(prepared, found, criteria, progress, without)

    def diagnose_proven(
        self, *, progress: Callable[[str], None] | None = None, criteria: Criteria | None = None
    ) -> Diagnosis:
        """Diagnose the first part, without the effects that the running filter contradicts on the rest.

        Parameters
        ----------
        progress, criteria
            As of `diagnose`.

        Returns
        -------
        Diagnosis
            With the proof of all lasting effects on the voice together, or why there is none.

        Notes
        -----
        The first three fifths of the robot's voice are diagnosed, the running filter then takes the rest (`prove`). Where
        it is worse, the diagnosis is made anew without the effect that does most harm: another one may take its place. Not
        proven are events, which do not come again, and changes of the stationary noise. Where a recording is too short to
        be cut, all of it is diagnosed and nothing proven.
        """
        disproved: dict[str, Proof] = {}
        early, too_short = self, ""
        try:
            stop = self.held_out.cut
            early = Recording(self.mic[:stop], self.reference[:stop], self._given)
        except SignalError as error:
            too_short = str(error)
        while True:
            found = early.diagnose(progress=progress, criteria=criteria, without=disproved)
            names = tuple(finding.effect for finding in found.ranking if lasts(finding.effect))
            if too_short or not names:
                return _told(found, disproved, unproven=too_short if names else "nothing lasting was found")
            if progress:
                progress("the running filter without and with what was found")
            proof = self.held_out.proof(names)
            if not proof.worse:
                return _told(found, disproved, proof)
            disproved[proof.culprit or names[0]] = proof

    def add(self, names: str | Sequence[str]) -> Added:
        """Fit effects, beside each other, and write them into a new profile: `add`."""
        prepared = self.straightened
        knowing, model, straightened = with_fitted(self.profile, prepared, listed(names))
        before, after = self._as_it_is(), Recording(self.mic, self.reference, knowing)._as_it_is()
        if not straightened:
            return Added(knowing, before, after)
        values = dict(model.effects)
        straight = prepared.model.with_effects(straightened, values)
        told = tuple(f"{name} is taken out first: {find(name).sentence(values[name])}" for name in straightened)
        left = f"{before.excess_db:.1f} dB over the noise floor before, {after.excess_db:.1f} dB after"
        told += (f"with that left in: {left}",)
        told_of = replace(prepared, warnings=(*told, *prepared.warnings))
        return Added(knowing, describe(told_of, straight), describe(told_of, model))

    def settle(self, found: Diagnosis, names: Sequence[str]) -> tuple[Profile, Comparison, Diagnosis]:
        """Write findings of a diagnosis into a new profile.

        They are fitted once more, to all of the recording; where that leaves more than PROMISE_DB over what the diagnosis did,
        its own values are written.

        Parameters
        ----------
        found : Diagnosis
            Of this recording.
        names : sequence of str
            Of those of its effects that are written.

        Returns
        -------
        Profile, Comparison, Diagnosis
            With the findings; of that profile; with its figures, or as it was where not all of its findings are written.
        """
        prepared = self.straightened
        start = prepared.model.with_effects(names, dict(found.model.effects))
        everywhere = replace(prepared.measurement, fit=prepared.usable)
        choices: list[tuple[Comparison, Profile]] = []
        for model in (fit_jointly(everywhere, start, names), start):
            knowing = self.profile.with_echo(self.profile.echo.with_effects(names, dict(model.effects)))
            choices.append((Recording(self.mic, self.reference, knowing)._as_it_is(), knowing))
            if choices[-1][0].excess_db <= found.remaining_db + PROMISE_DB:
                break
        after, knowing = min(choices, key=lambda choice: choice[0].excess_db)
        if {finding.effect for finding in found.ranking} != set(names):
            return knowing, after, found
        return knowing, after, as_written(found, prepared, dict(knowing.echo.effects), after)

    def prove(self, names: str | Sequence[str]) -> Proof:
        """Say whether the running filter is better with effects, on seconds that their fit has not seen: `prove`."""
        return self.held_out.proof(listed(names))

    def probe(self, explanations: Sequence[tuple[str, ...]]) -> Inquiry:
        """Fit several explanations, to ask which sound would tell them apart.

        Parameters
        ----------
        explanations : sequence of tuple of str
            The effects of each; two that predict the same are one.

        Returns
        -------
        Inquiry
            `sounds` to play, the best first; `hear` and `answer` judge what was recorded of them; `ask` does all that.

        Raises
        ------
        UsageError
            For an event, which no other recording can tell of.
        """
        return Inquiry(self.profile, self.straightened, explanations, self.reference)


def compare(profile: Profile, recording: Samples, reference: Samples, *, sample_rate: int = SAMPLE_RATE) -> Comparison:
    """Say how far the profile's prediction of the robot's own voice is from a recording of it, and where.

    Parameters
    ----------
    profile, recording, reference, sample_rate
        As of `Recording`.

    Returns
    -------
    Comparison
        Excess over the noise floor in all, by frequency, time, level and lag.

    Notes
    -----
    Excess is the power of recording minus prediction, whitened by the fan's power spectral density, over the power of the fan:
    0 dB where the fan alone is left. Before that a constant lag, a drift of the clocks and changes of path and fan that are ordinary
    from day to day are compensated.

    Examples
    --------
    >>> import numpy as np
    >>> from edgefilter import calibrate, compare, generate_sweep
    >>> rng, sweep = np.random.default_rng(0), generate_sweep()
    >>> fan = lambda n: 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> compare(profile, 0.4 * np.roll(said, 300) + fan(said.size), said).excess_db > 20
    True
    """
    return Recording(recording, reference, profile, sample_rate=sample_rate).compare()


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
    profile, recording, reference, sample_rate
        As of `Recording`.
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

    Notes
    -----
    Stepwise selection: every effect is fitted on half of the recording, in blocks of half a second, and tested on the
    other half (docs/diagnosis_statistics.md).

    Examples
    --------
    >>> import numpy as np
    >>> from edgefilter import calibrate, diagnose, generate_sweep
    >>> rng, sweep = np.random.default_rng(0), generate_sweep()
    >>> fan = lambda n: 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> diagnose(profile, 0.4 * np.roll(said, 300) + fan(said.size), said).ranking[0].effect
    'playback_gain'
    """
    recorded = Recording(recording, reference, profile, sample_rate=sample_rate)
    return recorded.diagnose(progress=progress, criteria=criteria, without=without)


def add(
    profile: Profile,
    names: str | Sequence[str],
    recording: Samples,
    reference: Samples,
    *,
    sample_rate: int = SAMPLE_RATE,
) -> Added:
    """Fit one or several effects to a recording, beside each other, and write them into a new profile.

    Parameters
    ----------
    profile, recording, reference, sample_rate
        As of `Recording`; the profile stays as it is.
    names : str or sequence of str
        Of the effects, as a diagnosis prints them.

    Returns
    -------
    Added
        `profile` with the effects; the comparisons `before` and `after`, both of the straightened recording, whose warnings say
        what was straightened.

    Raises
    ------
    UsageError
        For an unknown effect.

    Notes
    -----
    Clocks that drift, jumps and a turned volume are followed by the running filter itself and would spoil the fit of
    anything else, so they are taken out of the recording first, unless they are among the names; the profile does not
    get them. Each effect is fitted with the others in place, in turn, until the error no longer falls, and to all of the
    recording: `diagnose` fits to half of it and tests on the other, which predicts other recordings of the robot less well.
    So the comparison after is of samples that the fit has used; `prove` says what the effects are worth on others. An event
    (a jump, a moment's move) is kept with the recording in which it happened: of any other the profile predicts what it
    did before.

    Examples
    --------
    >>> import numpy as np
    >>> from edgefilter import add, calibrate, generate_sweep
    >>> rng, sweep = np.random.default_rng(0), generate_sweep()
    >>> fan = lambda n: 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> found = add(profile, "playback_gain", 0.4 * np.roll(said, 300) + fan(said.size), said)
    >>> [name for name, _ in found.profile.echo.effects], found.after.excess_db < found.before.excess_db - 6
    (['playback_gain'], True)
    """
    return Recording(recording, reference, profile, sample_rate=sample_rate).add(names)


def prove(
    profile: Profile | None,
    names: str | Sequence[str],
    recording: Samples,
    reference: Samples,
    *,
    sample_rate: int = SAMPLE_RATE,
) -> Proof:
    """Say whether the running filter is better with effects than without them, on seconds that their fit has not seen.

    Parameters
    ----------
    profile, recording, reference, sample_rate
        As of `Recording`.
    names : str or sequence of str
        Of the effects; of none only where no profile was given: then the filter without a profile is held against
        one with a profile made from the recording and the effects.

    Returns
    -------
    Proof
        ERLE before and after.

    Raises
    ------
    UsageError
        For an unknown effect.
    SignalError
        Also where there is too little of the robot to hold seconds out.

    Notes
    -----
    The effects are fitted, as `add` does it, to the first three fifths of the robot's voice. A filter that begins with
    the rest, engine "linear", then runs over it with the profile before and after. Where somebody else talks is left
    out.

    Examples
    --------
    >>> import numpy as np
    >>> from edgefilter import calibrate, generate_sweep, prove
    >>> rng, sweep = np.random.default_rng(0), generate_sweep()
    >>> fan = lambda n: 1e-3 * rng.standard_normal(n).astype(np.float32)
    >>> profile = calibrate(sweep, 0.5 * np.roll(sweep, 300) + fan(sweep.size), fan(64_000))
    >>> said = (0.2 * rng.standard_normal(80_000) * np.repeat(rng.uniform(size=25) > 0.3, 3200)).astype(np.float32)
    >>> heard = 0.5 * np.roll(said, 300) + 0.2 * np.roll(said, 900) + fan(said.size)
    >>> proof = prove(profile, "early_path", heard, said)
    >>> proof.worse, proof.erle_after_db > proof.erle_before_db + 3
    (False, True)
    """
    return Recording(recording, reference, profile, sample_rate=sample_rate).prove(names)


def _told(found: Diagnosis, disproved: dict[str, Proof], proof: Proof | None = None, unproven: str = "") -> Diagnosis:
    """The diagnosis with its proof and a row for each effect that failed one."""
    rows = []
    for name, failed in disproved.items():
        why = f"with {' and '.join(failed.effects)} the running filter is worse on {failed.seconds:.1f} s that the fit has"
        why += f" not seen: ERLE {failed.erle_before_db:.1f} dB without, {failed.erle_after_db:.1f} dB with"
        rows.append(Candidate(name, "failed its proof", why))
    return replace(found, tried=(*found.tried, *rows), proof=proof, unproven=unproven)
