"""`edgefilter compare`: how far the profile's prediction is from a recording, and where."""

from __future__ import annotations

import argparse
from dataclasses import replace

from edgefilter.commands.display import print_result, progress, report_part
from edgefilter.commands.recordings import load
from edgefilter.report.text import MORE, comparison_lines, comparison_summary, files_given


def main(args: argparse.Namespace) -> None:
    html = report_part("html") if args.report else None
    recording = load(args)
    with progress("comparison"):
        found = recording.compare()
    if args.profile is None:
        found = replace(found, warnings=(*recording.profile.warnings, *found.warnings))
    lines = comparison_lines(found) if args.verbose else [*comparison_summary(found), MORE]
    print_result(args, lines, {"schema": 1, **found.to_dict()})
    if html:
        html.write_page(args.report, html.comparison_page(found, vars(args)))
        print_result(args, [f"report      {args.report}"])
    print_result(args, [f"next        edgefilter diagnose {files_given(vars(args))}"])
