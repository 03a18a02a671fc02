"""`edgefilter serve`: the filter for devices whose microphone is elsewhere, over WebSocket."""

from __future__ import annotations

import argparse
import asyncio
import signal
from pathlib import Path

from edgefilter.commands.display import say
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.budget import allowed_cores
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.integrations.doors import is_own
from edgefilter.integrations.wire import Form
from edgefilter.learning.background import BackgroundLearner
from edgefilter.profile.data import Profile

STREAMS_PER_CORE = 4
"""Clients at a time unless --streams says otherwise: a third of what a core bears by computing time, 0.08 s a second of
`crnn` (docs/serve.md), since those whose hops come at once wait for one another."""


def main(args: argparse.Namespace) -> None:
    try:
        from edgefilter.integrations.serve import Service
    except ModuleNotFoundError as error:
        raise UsageError(f"serve needs {error.name}, which is not installed: pip install '.[serve]'") from None
    token = None if args.token is None else read_token(args.token)
    if token is None and not is_own(args.host):
        raise UsageError(
            f"--host {args.host} lets other machines listen, found no --token: give a file that holds a secret, or leave"
            " --host out"
        )
    profile = Profile.load(args.profile) if args.profile else None
    cores = len(allowed_cores())
    streams = args.streams or STREAMS_PER_CORE * cores

    def make_filter(learns: bool, form: Form) -> EgoFilter:
        learner = BackgroundLearner(profile) if learns else None
        settings = BargeInSettings(args.threshold, confirm_s=args.confirm_s, judge="network", ask_db=form.ask_db)
        return EgoFilter(profile, engine=args.engine, barge_in=settings, learn=learner, output=form.output)

    make_filter(False, Form())  # what cannot be made is said now, and what is slow to load is loaded

    def ready(port: int) -> None:
        whose = "any machine with the token" if token else "this machine"
        say(f"serving ws://{args.host}:{port} to {whose}, {streams} streams at most; Ctrl-C ends it")

    async def run() -> None:
        service = Service(make_filter, streams, cores - 1, token)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, service.stop)
        await service.run(args.host, args.port, ready)

    try:
        asyncio.run(run())
    except OSError as error:
        raise EdgefilterError(
            f"{args.host}:{args.port} cannot be served: {error.strerror or error}; choose another --host or --port"
        ) from None


def read_token(path: str) -> str:
    """The secret in a file; raises UsageError where there is none."""
    try:
        token = Path(path).read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            f"--token {path} cannot be read: {getattr(error, 'strerror', None) or 'it is no text'}"
        ) from None
    if len(token) < 16 or not token.isascii() or not token.isprintable():
        raise UsageError(
            f"--token {path} holds {len(token)} characters, expected 16 or more of ASCII: openssl rand -hex 24"
        )
    return token
