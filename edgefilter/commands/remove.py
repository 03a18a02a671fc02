"""`edgefilter remove`: write a profile without one of its effects."""

from __future__ import annotations

import argparse

from edgefilter.commands.display import print_result
from edgefilter.errors import UsageError
from edgefilter.profile.data import Profile


def main(args: argparse.Namespace) -> None:
    profile = Profile.load(args.profile)
    held = [name for name, _ in profile.echo.effects]
    if args.effect not in held:
        raise UsageError(
            f"{args.profile} holds no effect '{args.effect}', it holds {', '.join(held) or 'none'}: name one of those"
        )
    without = profile.with_echo(profile.echo.without_effect(args.effect))
    without.save(args.output)
    left = [name for name, _ in without.echo.effects]
    line = f"{args.effect} removed, {', '.join(left) or 'no effect'} left; written to {args.output}"
    print_result(args, [line], {"schema": 1, "effect": args.effect, "effects_left": left, "output": args.output})
