"""What `add` and `diagnose --apply` share: effects are proven in the running filter, fitted, written and told of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from edgefilter.diagnosis.compare import Comparison, compare
from edgefilter.diagnosis.diagnose import PROMISE_DB, Diagnosis, add, settle
from edgefilter.diagnosis.proof import Proof, proofs_until_kept, prove
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.catalogue import names as names_known
from edgefilter.echo.running import reach
from edgefilter.errors import EdgefilterError, SignalError
from edgefilter.profile.data import Profile
from edgefilter.report.text import UNITS, figure, joined, proof_line
from edgefilter.types import Samples


class Refused(EdgefilterError):
    """What was fitted would make the running filter worse, so that nothing was written."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A profile with effects, the comparisons before and after, and the proof; unproven: why there is none.

    promised_db: what the diagnosis that named them has shown to be left, where there was one. compared_db: before and after
    as `compare` has it, where something was taken out of the recording first that the filter follows and no profile gets.
    """

    names: tuple[str, ...]
    dropped: tuple[str, ...]
    profile: Profile
    before: Comparison
    after: Comparison
    proof: Proof | None
    unproven: str = ""
    promised_db: float | None = None
    compared_db: tuple[float, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        values = dict(self.profile.echo.effects)
        effects = {}
        for name in self.names:
            effect = find(name)
            told = {p.name: {"value": np.asarray(values[name][p.name]).tolist(), "unit": p.unit} for p in effect.told}
            effects[name] = {
                "this_recording_only": effect.event,
                "at_run_time": reach(effect, values[name]),
                "parameters": told,
            }
        return {
            "effects": effects,
            "dropped": list(self.dropped),
            "excess_before_db": self.before.excess_db,
            "excess_after_db": self.after.excess_db,
            "compared_db": list(self.compared_db) if self.compared_db else None,
            "promised_db": self.promised_db,
            "noise_floor_db": self.after.noise_floor_db,
            "proof": self.proof.to_dict() if self.proof else None,
        }

    def lines(self) -> list[str]:
        """For the terminal: the excess before and after, the values, the proof, what to beware of."""
        values = dict(self.profile.echo.effects)
        added = joined(self.names) or "nothing"
        before_db, after_db = self.before.excess_db, self.after.excess_db
        lines = [f"{added} added: {before_db:.1f} dB over the noise floor before, {after_db:.1f} dB after"]
        for name in self.names:
            lines += _values(name, values[name], len(self.names) > 1)
        lines += [f"{'recording':<12}{text}" for text in self.before.warnings]
        if self.compared_db:
            was, now = self.compared_db
            lines.append(f"{'compare':<12}with that left in: {was:.1f} dB before, {now:.1f} dB after")
        lines.append(proof_line(self.proof, self.unproven))
        lines += [f"{'dropped':<12}{name}: with it the running filter would be worse" for name in self.dropped]
        lines += [
            f"NOTE        {name} happened in this recording and is kept with it: of others the profile predicts what it"
            " did before"
            for name in self.names
            if find(name).event
        ]
        lines += [f"NOTE        {name}: {note}" for name in self.names if (note := reach(find(name), values[name]))]
        if self.promised_db is not None and after_db > self.promised_db + PROMISE_DB:
            why = f"without {joined(self.dropped)}" if self.dropped else "a fit to all of the recording ends elsewhere"
            lines.append(
                f"NOTE        the diagnosis left {self.promised_db:.1f} dB, what is written {after_db:.1f} dB: {why}"
            )
        if self.names and round(after_db, 1) >= round(before_db, 1):  # as they are shown
            what = "this effect does" if len(self.names) == 1 else "these effects do"
            lines.append(f"WARNING     the error did not fall: {what} not explain the recording")
        return lines


def fit(
    profile: Profile | None,
    start: Profile,
    names: tuple[str, ...],
    recording: Samples,
    reference: Samples,
    *,
    force: bool,
    found: Diagnosis | None = None,
) -> Fitted:
    """The effects fitted to the recording on top of start, and proven against profile.

    start: the profile, or one made from the recording where there is none. found: the diagnosis that names come from; then an
    effect that makes the filter worse is left out where the others help, and its comparison is the one before. Raises Refused where the
    filter would be worse, unless force.
    """
    proofs: tuple[Proof, ...] = ()
    unproven = "there is nothing to prove"
    try:
        if names or profile is None:
            proofs = (
                proofs_until_kept(profile, names, recording, reference)
                if found and not force
                else (prove(profile, names, recording, reference),)
            )
    except SignalError as error:
        if not force:
            raise
        unproven = str(error)
    proof, unproven = (proofs[-1], "") if proofs else (None, unproven)
    dropped = tuple(earlier.culprit for earlier in proofs[:-1] if earlier.culprit)
    names = tuple(name for name in names if name not in dropped)
    if proof and proof.worse and not force:
        raise Refused(_refusal(proof))
    if found and profile:
        knowing, after = settle(profile, found, names, recording, reference)
        return Fitted(names, dropped, knowing, found.comparison, after, proof, unproven, found.remaining_db)
    knowing, before, after = add(start, names, recording, reference)
    compared = tuple(compare(each, recording, reference).excess_db for each in (start, knowing))
    straight = np.allclose(compared, (before.excess_db, after.excess_db), atol=0.05)
    return Fitted(
        names, dropped, knowing, before, after, proof, unproven, None, None if straight else (compared[0], compared[1])
    )


def long_paths() -> list[str]:
    """Names of the effects that lengthen a path: a profile made from a recording has one of a quarter of a second."""
    return [name for name in names_known() if find(name).lengthens]


def _values(name: str, values: Any, named: bool) -> list[str]:
    lines = []
    for p in find(name).told:
        value = np.asarray(values[p.name])
        shown = f"{value.size} values" if value.size > 6 else ", ".join(figure(v) for v in value.ravel())
        lines.append(f"  {f'{name} ' if named else ''}{p.name} = {shown} {UNITS.get(p.unit, p.unit)}".rstrip())
    return lines


def _refusal(proof: Proof) -> str:
    what = joined(proof.effects) or "a profile made from this recording"
    others = f"; without {proof.culprit} it is {dict(proof.without)[proof.culprit]:.1f} dB" if proof.culprit else ""
    return (
        f"{what} would make the running filter worse: ERLE {proof.erle_before_db:.1f} dB before,"
        f" {proof.erle_after_db:.1f} dB after, on {proof.seconds:.1f} s of the robot that the fit has not"
        f" seen{others}; nothing is written (--force writes it)"
    )
