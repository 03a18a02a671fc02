"""`edgefilter add`: fit effects to a recording and write a profile that has them."""

from __future__ import annotations

import argparse

from edgefilter.commands.display import print_result, progress
from edgefilter.commands.fitting import fit
from edgefilter.commands.recordings import load
from edgefilter.echo.effects.catalogue import find


def main(args: argparse.Namespace) -> int:
    names = tuple(dict.fromkeys(args.effect))
    for name in names:
        find(name)
    profile, recording, reference = load(args)
    with progress("fit, and proof in the running filter"):
        fitted = fit(profile, profile, names, recording, reference, force=args.force)
    fitted.profile.save(args.output)
    lines = [*fitted.lines(), f"written to {args.output}"]
    print_result(args, lines, {"schema": 2, **fitted.to_dict(), "output": args.output})
    return 0
