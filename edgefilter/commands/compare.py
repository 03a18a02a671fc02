"""`edgefilter compare`: how far the profile's prediction is from a recording, and where."""

from __future__ import annotations

import argparse
from dataclasses import replace

from edgefilter.commands.display import report_part, write_json
from edgefilter.commands.material import load
from edgefilter.diagnosis.compare import compare
from edgefilter.report.text import comparison_lines


def main(args: argparse.Namespace) -> int:
    html = report_part("html") if args.report else None
    profile, recording, reference = load(args)
    found = compare(profile, recording, reference)
    if args.profile is None:
        found = replace(found, warnings=(*profile.warnings, *found.warnings))
    if args.json:
        write_json({"schema": 1, **found.to_dict()}, args.json)
    if args.json != "-":
        print("\n".join(comparison_lines(found)))
    if html:
        html.write_page(args.report, html.comparison_page(found, vars(args)))
        if args.json != "-":
            print(f"report      {args.report}")
    return 0
