"""`edgefilter add`: fit effects to a recording and write a profile that has them."""

from __future__ import annotations

import argparse

from edgefilter.commands import fitting
from edgefilter.commands.display import write_json
from edgefilter.commands.material import load
from edgefilter.echo.effects.catalogue import find

SCHEMA = 2
"""Of the JSON: 1 knew of one effect only."""


def main(args: argparse.Namespace) -> int:
    names = tuple(dict.fromkeys(args.effect))
    for name in names:
        find(name)
    profile, recording, reference = load(args)
    fitted = fitting.fit(profile, profile, names, recording, reference, force=args.force)
    fitted.profile.save(args.output)
    if args.json:
        write_json({"schema": SCHEMA, **fitted.to_dict(), "output": args.output}, args.json)
    if args.json != "-":
        print("\n".join([*fitted.lines(), f"written to {args.output}"]))
    return 0
