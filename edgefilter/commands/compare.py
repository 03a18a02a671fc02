"""`edgefilter compare`: how far the profile's prediction is from a recording, and where."""

from __future__ import annotations

import argparse
from dataclasses import replace

from edgefilter.commands.display import print_result, progress, report_part
from edgefilter.commands.recordings import load
from edgefilter.report.text import comparison_lines


def main(args: argparse.Namespace) -> None:
    html = report_part("html") if args.report else None
    recording = load(args)
    with progress("comparison"):
        found = recording.compare()
    if args.profile is None:
        found = replace(found, warnings=(*recording.profile.warnings, *found.warnings))
    print_result(args, comparison_lines(found), {"schema": 1, **found.to_dict()})
    if html:
        html.write_page(args.report, html.comparison_page(found, vars(args)))
        print_result(args, [f"report      {args.report}"])
