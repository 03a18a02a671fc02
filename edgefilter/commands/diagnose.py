"""`edgefilter diagnose`: which physical effects the profile lacks, on the evidence of a recording, and a profile that has them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from edgefilter.audio.files import whole
from edgefilter.commands.add import Fitted, Refused, fit
from edgefilter.commands.display import interject, print_result, progress, report_part
from edgefilter.commands.recordings import load, load_array
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.proof import lasts
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.result import Diagnosis, in_order
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.catalogue import names as known_effects
from edgefilter.errors import EdgefilterError, SignalError, UsageError
from edgefilter.profile.array import ArrayCalibration
from edgefilter.report.text import (
    LINES,
    MORE,
    add_command,
    diagnosis_lines,
    first_sight_line,
    next_command,
    summary_lines,
)


def main(args: argparse.Namespace) -> None:
    if args.force and not args.apply:
        raise UsageError("found --force without --apply, which is what it is for: give both or leave it out")
    if args.prove and args.profile is None:
        raise UsageError(
            "found --prove without --profile: a profile made from the recording has used the seconds of the proof"
        )
    html = report_part("html") if args.report else None
    doubts: dict[int, str] = {}
    array: ArrayCalibration | None = None
    if args.mic_channels is None:
        if args.channel is not None:
            raise UsageError("found --channel without --mic-channels, which names the microphones: give both")
        recording = load(args)
    else:
        recording, array, doubts = load_array(args)
        print_result(args, [f"channel {number}: {what}" for number, what in doubts.items()])
    with progress("diagnosis") as step:
        criteria = Criteria(false_rate=args.false_rate)
        seen = recording.at_first_sight(criteria)
        interject(first_sight_line(seen))
        diagnosed = recording.diagnose_proven if args.prove else recording.diagnose
        found = diagnosed(progress=step, criteria=criteria)
        if not recording.known:
            warnings = (*recording.profile.warnings, *found.comparison.warnings)
            found = replace(found, comparison=replace(found.comparison, warnings=warnings))
        applied, refused = None, None
        if args.apply:
            applied, refused = _apply(recording, found, args, step, array)
    more: dict[str, object] = {"channels": {str(number): what for number, what in doubts.items()}} if doubts else {}
    if applied:
        more["applied"] = {**applied.to_dict(), "output": args.apply}
    told: list[str] = []
    if applied:
        found = applied.found or found
        told = [*applied.lines(args.verbose), f"written to {args.apply}"]
    elif args.apply and not refused:
        told = [f"nothing was found to add: {args.apply} is not written"]
    following = next_command(found, vars(args), args.apply if applied else None)
    if args.write_effect:
        own, following = _written(args, found, following)
        told.append(own)
    calibrated = recording.known
    if args.verbose:
        lines = [*diagnosis_lines(found, calibrated), *told]
    else:
        lines = [*summary_lines(found, calibrated, LINES - 2 - len(told)), *told, MORE]
        if not (args.prove or args.apply) and any(lasts(finding.effect) for finding in found.ranking):
            lines[-1] += f"; {'--prove' if calibrated else '--apply P2.npz'}: what it costs in the running filter"
    more["at_first_sight"] = {family: round(gain_db, 2) for family, gain_db in seen.items()}
    print_result(args, lines, {**found.to_dict(), **more})
    if html:
        with progress("page of the diagnosis"):
            outcome, proof = (applied.facts(), applied.proof) if applied else ((), found.proof)
            html.write_page(args.report, html.diagnosis_page(recording, found, vars(args), outcome, proof))
        print_result(args, [f"report      {args.report}"])
    if refused:
        raise refused
    print_result(args, [f"next        {following}"])


def _apply(
    recording: Recording,
    found: Diagnosis,
    args: argparse.Namespace,
    step: Callable[[str], None],
    array: ArrayCalibration | None,
) -> tuple[Fitted, None] | tuple[None, EdgefilterError | None]:
    """Write the profile with all effects that were found; return the fit, and the error that prevented writing.

    One of the two is None, or both where nothing was found. The error is returned, not raised, so that the diagnosis is printed in
    any case. A profile made from the recording has an impulse response of a quarter of a second; it is lengthened to the
    room's. array: calibration of the other microphones, which get the same effects on their own paths.
    """
    step("fit of what was found, and proof in the running filter")
    names = [finding.effect for finding in in_order(found.ranking)]
    if not recording.known:
        names += [name for name in known_effects() if name not in names and _lengthens(recording, found, name)]
    if recording.known and not names:
        return None, None
    try:
        applied = fit(recording, tuple(names), force=args.force, found=found)
    except (Refused, SignalError) as error:
        return None, error
    replace(applied.profile, array=array or applied.profile.array).save(args.apply)
    return applied, None


def _lengthens(recording: Recording, found: Diagnosis, name: str) -> bool:
    """Whether that effect adds to the impulse response what the recording shows beside what was found."""
    effect, others = find(name), found.model.without_effect(name)
    added = effect.stage == "response" and not effect.event
    return added and not vanishes(effect, recording.straightened.fitted(name, others))


def _written(args: argparse.Namespace, found: Diagnosis, following: str) -> tuple[str, str]:
    """The free law of the diagnosis as an effect of the user's own; what to say of it, and the command that follows then."""
    if found.law is None:
        return f"no law explains much more than what is named: {args.write_effect} is not written", following
    path = Path(args.write_effect)
    with whole(path, "the effect") as file:
        file.write(found.law.file(path.stem).encode())
    own = {**vars(args), "effects": [*(args.effects or ()), args.write_effect]}
    return f"own effect  {path}", add_command([*found.law.beside, path.stem], own)
