"""`edgefilter diagnose`: which physical effects the profile lacks, on the evidence of a recording."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from tqdm import tqdm

from edgefilter.commands.display import report_part, write_json
from edgefilter.commands.material import load
from edgefilter.diagnosis.diagnose import Diagnosis, diagnose
from edgefilter.report.text import add_command, diagnosis_lines


def main(args: argparse.Namespace) -> int:
    html = report_part("html") if args.report else None
    profile, recording, reference = load(args)
    with _bar() as progress:
        found = diagnose(profile, recording, reference, progress=progress)
    if args.profile is None:
        found = replace(
            found, comparison=replace(found.comparison, warnings=(*profile.warnings, *found.comparison.warnings))
        )
    if args.json:
        write_json(found.to_dict(), args.json)
    if args.json != "-":
        print("\n".join([*diagnosis_lines(found, args.profile is not None), *_next_step(found, args)]))
    if html:
        html.write_page(args.report, html.diagnosis_page(profile, found, recording, reference, vars(args)))
        if args.json != "-":
            print(f"report      {args.report}")
    return 0


def _next_step(found: Diagnosis, args: argparse.Namespace) -> list[str]:
    if not found.ranking:
        return []
    return [f"next        {add_command(found.ranking[0].effect, vars(args))}"]


@contextmanager
def _bar() -> Iterator[Callable[[str], None]]:
    """What is being tried and for how long, on a terminal."""
    with tqdm(bar_format="{elapsed} {desc}", leave=False, disable=None, file=sys.stderr) as bar:
        yield bar.set_description_str
