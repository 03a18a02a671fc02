"""`edgefilter diagnose`: which physical effects the profile lacks, on the evidence of a recording, and a profile that has them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from tqdm import tqdm

from edgefilter.commands.display import report_part, write_json
from edgefilter.commands.fitting import Fitted, Refused, fit, long_paths
from edgefilter.commands.material import load
from edgefilter.diagnosis.diagnose import Diagnosis, diagnose
from edgefilter.diagnosis.proven import diagnose_proven
from edgefilter.errors import EdgefilterError, SignalError, UsageError
from edgefilter.profile.data import Profile
from edgefilter.report.text import add_command, diagnosis_lines, in_order
from edgefilter.types import Samples


def main(args: argparse.Namespace) -> int:
    if args.force and not args.apply:
        raise UsageError("found --force without --apply, which is what it is for: give both or leave it out")
    if args.prove and args.profile is None:
        raise UsageError(
            "found --prove without --profile: one made from the recording has heard the seconds of the proof"
        )
    html = report_part("html") if args.report else None
    profile, recording, reference = load(args)
    with _bar() as progress:
        found = (diagnose_proven if args.prove else diagnose)(profile, recording, reference, progress=progress)
    if args.profile is None:
        found = replace(
            found, comparison=replace(found.comparison, warnings=(*profile.warnings, *found.comparison.warnings))
        )
    applied, refused = _apply(profile, found, recording, reference, args) if args.apply else (None, None)
    if args.json:
        more = {"applied": {**applied.to_dict(), "output": args.apply}} if applied else {}
        write_json({**found.to_dict(), **more}, args.json)
    if args.json != "-":
        told = [*applied.lines(), f"written to {args.apply}"] if applied else _next_step(found, args)
        print("\n".join([*diagnosis_lines(found, args.profile is not None), *told]))
    if html:
        html.write_page(args.report, html.diagnosis_page(profile, found, recording, reference, vars(args)))
        if args.json != "-":
            print(f"report      {args.report}")
    if refused:
        raise refused
    return 0


def _apply(
    profile: Profile, found: Diagnosis, recording: Samples, reference: Samples, args: argparse.Namespace
) -> tuple[Fitted, None] | tuple[None, EdgefilterError]:
    """The profile with all that was found, written; or why it was not: the diagnosis is told all the same.

    One made from the recording gets the whole length of the room's response, and from all of the recording.
    """
    names = [finding.effect for finding in in_order(found.ranking)]
    start = None if args.profile is None else profile
    if start is None:
        names += long_paths()
    try:
        applied = fit(start, profile, tuple(names), recording, reference, force=args.force, drop=True)
    except (Refused, SignalError) as error:
        return None, error
    applied.profile.save(args.apply)
    return applied, None


def _next_step(found: Diagnosis, args: argparse.Namespace) -> list[str]:
    if not found.ranking or args.apply:
        return []
    return [f"next        {add_command([finding.effect for finding in in_order(found.ranking)], vars(args))}"]


@contextmanager
def _bar() -> Iterator[Callable[[str], None]]:
    """What is being tried and for how long, on a terminal."""
    with tqdm(bar_format="{elapsed} {desc}", leave=False, disable=None, file=sys.stderr) as bar:
        yield bar.set_description_str
