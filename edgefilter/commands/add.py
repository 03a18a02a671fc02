"""`edgefilter add`: fit effects to a recording, prove them in the running filter, and write a profile that has them."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np

from edgefilter.commands.display import print_result, progress
from edgefilter.commands.recordings import load
from edgefilter.diagnosis.compare import Comparison
from edgefilter.diagnosis.proof import Proof
from edgefilter.diagnosis.recording import PROMISE_DB, Recording
from edgefilter.diagnosis.result import Diagnosis
from edgefilter.echo.effect import Effect
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Values
from edgefilter.echo.running import reach
from edgefilter.errors import EdgefilterError, SignalError
from edgefilter.profile.data import Profile
from edgefilter.report.text import UNITS, decibels, figure, joined, proof_line


def main(args: argparse.Namespace) -> None:
    names = tuple(dict.fromkeys(args.effect))
    for name in names:
        find(name)
    recording = load(args)
    with progress("fit, and proof in the running filter"):
        fitted = fit(recording, names, force=args.force)
    fitted.profile.save(args.output)
    lines = [*fitted.lines(), f"written to {args.output}"]
    print_result(args, lines, {"schema": 2, **fitted.to_dict(), "output": args.output})


class Refused(EdgefilterError):
    """What was fitted would make the running filter worse, so that nothing was written."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A profile with effects, the comparisons before and after, and the proof; unproven: why there is none.

    found: the diagnosis that named them, with the figures of that profile where this has all that it named. promised_db:
    what it left of half of the recording, with the effects fitted to the other half.
    """

    names: tuple[str, ...]
    dropped: tuple[str, ...]
    profile: Profile
    before: Comparison
    after: Comparison
    proof: Proof | None
    unproven: str = ""
    found: Diagnosis | None = None
    promised_db: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        values = dict(self.profile.echo.effects)
        return {
            "effects": {name: _figures(find(name), values[name]) for name in self.names},
            "dropped": list(self.dropped),
            "excess_before_db": self.before.excess_db,
            "excess_after_db": self.after.excess_db,
            "noise_floor_db": self.after.noise_floor_db,
            "proof": self.proof.to_dict() if self.proof else None,
            **({} if self.promised_db is None else {"promised_db": self.promised_db}),
        }

    def facts(self) -> list[tuple[str, str, str]]:
        """For the top of the page: term, value, explanation."""
        facts = []
        if self.found is None or self.found.written is None:
            what = f"over the noise floor, with {joined(self.names) or 'nothing added'}"
            facts.append(("Written", f"{decibels(self.after.excess_db)} dB", what))
        if proof := self.proof:
            erle = f"{decibels(proof.erle_before_db)} to {decibels(proof.erle_after_db)} dB"
            what = f"of the robot taken away, on {proof.seconds:.1f} s that no fit has heard"
            facts.append(("Running filter", erle, what))
        return facts

    def lines(self, verbose: bool = True) -> list[str]:
        """For the terminal: the excess before and after, the proof, what to beware of; verbose: the values, and how they came about."""
        values = dict(self.profile.echo.effects)
        added = joined(self.names) or "nothing"
        before_db, after_db = self.before.excess_db, self.after.excess_db
        lines = [
            f"{added} added: {decibels(before_db)} dB over the noise floor before, {decibels(after_db)} dB after,"
            " fitted to all of the recording"
        ]
        if verbose:
            if self.promised_db is not None:
                left = decibels(self.promised_db)
                lines.append(f"promised    fitted to half of it they left {left} dB of the other half")
            for name in self.names:
                lines += _values(name, values[name], len(self.names) > 1)
            lines += [f"{'recording':<12}{text}" for text in self.before.warnings]
        lines.append(proof_line(self.proof, self.unproven))
        lines += [
            f"{'dropped':<12}{name}: the running filter removes less of the robot with it" for name in self.dropped
        ]
        kept = "happened in this recording and is kept with it: of others the profile predicts what it did before"
        lines += [f"NOTE        {name} {kept}" for name in self.names if find(name).event]
        lines += [f"NOTE        {name}: {note}" for name in self.names if (note := reach(find(name), values[name]))]
        if self.promised_db is not None and after_db > self.promised_db + PROMISE_DB:
            missing = f"{joined(self.dropped)} is not in it" if self.dropped else "no fit to all of it explains as much"
            lines.append(
                f"NOTE        the profile that is written leaves more of the robot's voice unexplained than the diagnosis did: {missing}"
            )
        shown = round(before_db, 1), round(after_db, 1)  # a fan that is softer than it was has less than none
        if self.names and shown[1] >= shown[0] and abs(shown[1]) >= abs(shown[0]):
            what = "this effect does" if len(self.names) == 1 else "these effects do"
            lines.append(f"WARNING     the error did not fall: {what} not explain the recording")
        return lines


def fit(recording: Recording, names: tuple[str, ...], *, force: bool, found: Diagnosis | None = None) -> Fitted:
    """The effects fitted to the recording on top of its profile, and proven.

    found: the diagnosis that named them: then an effect that makes the filter worse is left out where the others help.
    Raises Refused where the filter would be worse, unless force.
    """
    proofs: tuple[Proof, ...] = ()
    unproven = "there is nothing to prove"
    try:
        if (names or not recording.known) and found and not force:
            proofs = recording.held_out.until_kept(names)
        elif names or not recording.known:
            proofs = (recording.prove(names),)
    except SignalError as error:
        if not force:
            raise
        unproven = str(error)
    proof, unproven = (proofs[-1], "") if proofs else (None, unproven)
    dropped = tuple(earlier.culprit for earlier in proofs[:-1] if earlier.culprit)
    names = tuple(name for name in names if name not in dropped)
    if proof and proof.worse and not force:
        raise Refused(_refusal(proof))
    if found and recording.known and names:
        knowing, after, told = recording.settle(found, names)
        before = found.comparison if told is found else told.comparison
        return Fitted(names, dropped, knowing, before, after, proof, unproven, told, found.remaining_db)
    return Fitted(names, dropped, *recording.add(names), proof, unproven, found)


def _figures(effect: Effect, values: Values) -> dict[str, Any]:
    told = {p.name: {"value": np.asarray(values[p.name]).tolist(), "unit": p.unit} for p in effect.told}
    return {"this_recording_only": effect.event, "at_run_time": reach(effect, values), "parameters": told}


def _values(name: str, values: Values, named: bool) -> list[str]:
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
