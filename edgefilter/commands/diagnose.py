"""`edgefilter diagnose`: which physical effects the profile lacks, on the evidence of a recording, and a profile that has them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from edgefilter.commands.display import print_result, progress, report_part
from edgefilter.commands.fitting import Fitted, Refused, fit, long_paths
from edgefilter.commands.recordings import load
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import Diagnosis, diagnose
from edgefilter.diagnosis.proven import diagnose_proven
from edgefilter.diagnosis.write_effect import write_effect
from edgefilter.errors import EdgefilterError, SignalError, UsageError
from edgefilter.profile.data import Profile
from edgefilter.report.text import add_command, diagnosis_lines, in_order
from edgefilter.types import Samples


def main(args: argparse.Namespace) -> int:
    if args.force and not args.apply:
        raise UsageError("found --force without --apply, which is what it is for: give both or leave it out")
    if args.prove and args.profile is None:
        raise UsageError(
            "found --prove without --profile: a profile made from the recording has used the seconds of the proof"
        )
    html = report_part("html") if args.report else None
    profile, recording, reference = load(args)
    with progress("diagnosis") as step:
        judge = diagnose_proven if args.prove else diagnose
        criteria = Criteria(false_rate=args.false_rate)
        found = judge(profile, recording, reference, progress=step, criteria=criteria)
        if args.profile is None:
            warnings = (*profile.warnings, *found.comparison.warnings)
            found = replace(found, comparison=replace(found.comparison, warnings=warnings))
        applied, refused = _apply(profile, found, recording, reference, args, step) if args.apply else (None, None)
    more = {"applied": {**applied.to_dict(), "output": args.apply}} if applied else {}
    told = [*applied.lines(), f"written to {args.apply}"] if applied else _next_step(found, args)
    if args.apply and not applied and not refused:
        told = [f"nothing was found that a profile can hold: {args.apply} is not written"]
    print_result(args, [*diagnosis_lines(found, args.profile is not None), *told], {**found.to_dict(), **more})
    if args.write_effect:
        with progress("effect of your own"):
            law = write_effect(args.write_effect, profile, found, recording, reference)
        print_result(args, [f"own effect  {args.write_effect}: {law}", f"next        {_own_command(args)}"])
    if html:
        with progress("page of the diagnosis"):
            outcome = (applied.after, applied.proof) if applied else ()
            page = html.diagnosis_page(profile, found, recording, reference, vars(args), *outcome)
            html.write_page(args.report, page)
        print_result(args, [f"report      {args.report}"])
    if refused:
        raise refused
    return 0


def _apply(
    profile: Profile,
    found: Diagnosis,
    recording: Samples,
    reference: Samples,
    args: argparse.Namespace,
    step: Callable[[str], None],
) -> tuple[Fitted | None, EdgefilterError | None]:
    """The profile with all that was found, written; or why it was not: the diagnosis is printed all the same.

    Neither where nothing was found: a profile that has not changed is not written.

    A profile made from the recording gets the whole length of the room's response, from all of the recording.
    """
    step("fit of what was found, and proof in the running filter")
    names = [finding.effect for finding in in_order(found.ranking)]
    start = None if args.profile is None else profile
    if start is None:
        names += long_paths()
    if not names:
        return None, None
    try:
        applied = fit(start, profile, tuple(names), recording, reference, force=args.force, found=found)
    except (Refused, SignalError) as error:
        return None, error
    applied.profile.save(args.apply)
    return applied, None


def _own_command(args: argparse.Namespace) -> str:
    own = {**vars(args), "effects": [*(args.effects or ()), args.write_effect]}
    return add_command([Path(args.write_effect).stem], own)


def _next_step(found: Diagnosis, args: argparse.Namespace) -> list[str]:
    if not found.ranking or args.apply:
        return []
    return [f"next        {add_command([finding.effect for finding in in_order(found.ranking)], vars(args))}"]
