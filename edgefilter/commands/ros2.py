"""`edgefilter ros2`: the filter as a node of ROS 2; `edgefilter ros2 extract`: its recordings as WAV files."""

from __future__ import annotations

import argparse
import os
import signal
from pathlib import Path

from edgefilter.audio.channels import Channels
from edgefilter.commands.display import print_result, say
from edgefilter.errors import UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.ego_filter import EgoFilter


def main(args: argparse.Namespace) -> None:
    try:
        (_extract if args.word == "extract" else _node)(args)
    except ModuleNotFoundError as error:
        raise UsageError(f"ros2 needs {error.name}, which is not installed: pip install '.[ros2]'") from None


def _extract(args: argparse.Namespace) -> None:
    from edgefilter.integrations.bags import extract

    topics = {"mic": args.mic, "reference": args.reference}
    folder = Path(args.output)
    seconds = extract(Path(args.recording), topics, folder, args.rate, args.channels)
    lines = [f"{folder / name}.wav: {length:.1f} s of {topics[name]}" for name, length in seconds.items()]
    print_result(args, lines, {"schema": 1, "seconds": seconds})


def _node(args: argparse.Namespace) -> None:
    from edgefilter.integrations.ros2 import Node, Topics

    named = os.environ.get("ROS_DOMAIN_ID") or "0"
    if args.domain is None and not named.isdecimal():
        raise UsageError(f"ROS_DOMAIN_ID is '{named}', expected a number: set it, or give --domain")
    domain = int(named) if args.domain is None else args.domain
    settings = BargeInSettings(args.threshold, confirm_s=args.confirm_s, judge="network", ask_db=args.ask_db)
    ego = EgoFilter(args.profile, engine=args.engine, barge_in=settings)
    names = args.mic, args.reference, args.silenced, args.human
    array = Channels.named(args.mic_channels, args.reference_channel)
    topics = Topics(*names, args.rate, args.channels, args.reference_channels, array)
    node = Node(ego, topics, domain)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: node.stop())
    say(f"node /edgefilter, domain {domain}: {args.mic} and {args.reference} in, {args.human} out; Ctrl-C ends it")
    node.run(say)
