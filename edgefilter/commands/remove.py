"""`edgefilter remove`: write a profile without one of its effects."""

from __future__ import annotations

import argparse
from dataclasses import replace

from edgefilter.commands.display import write_json
from edgefilter.errors import UsageError
from edgefilter.profile.data import Profile


def main(args: argparse.Namespace) -> int:
    profile = Profile.load(args.profile)
    held = [name for name, _ in profile.echo.effects]
    if args.effect not in held:
        raise UsageError(
            f"{args.profile} holds no effect '{args.effect}', it holds {', '.join(held) or 'none'}: name one of those"
        )
    lighter = replace(profile, echo=profile.echo.without_effect(args.effect))
    lighter.save(args.output)
    left = [name for name, _ in lighter.echo.effects]
    if args.json:
        write_json({"schema": 1, "effect": args.effect, "effects_left": left, "output": args.output}, args.json)
    if args.json != "-":
        print(f"{args.effect} removed, {', '.join(left) or 'no effect'} left; written to {args.output}")
    return 0
