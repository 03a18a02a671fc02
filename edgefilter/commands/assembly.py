"""The filter of a run: engine, profile and learner, as they were asked for or measured."""

from __future__ import annotations

import argparse
from pathlib import Path

from edgefilter.commands.display import say
from edgefilter.engines import HAVE_LINEAR_STAGE
from edgefilter.errors import UsageError
from edgefilter.filter.budget import DEFAULT_MS, Choice, choose, forget
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.learner import Learner
from edgefilter.learning.background import BackgroundLearner, cores
from edgefilter.profile.data import Profile

UNCALIBRATED = (
    "no profile: uncalibrated, the room is learnt from the robot's first seconds ('edgefilter calibrate' measures it"
    " beforehand)"
)


def make_filter(args: argparse.Namespace, live: bool) -> tuple[EgoFilter, Choice | None]:
    """The filter with the engine that was asked for, or with the one that the measurement chose.

    Live, or where a budget is given, "auto" is measured; a recording has no deadline and gets the strongest engine at
    once. Live, an engine that was chosen or that has a budget may be replaced by cheaper ones while it runs.
    """
    if args.remeasure:
        forget()
    choice, engine, reason, budget_ms = None, args.engine, "asked for", args.budget_ms
    profile = starting_profile(args)
    if engine == "auto" and not args.model and (live or budget_ms):
        choice = choose(budget_ms or DEFAULT_MS, profile, say=say)
        engine, reason, budget_ms = choice.engine, choice.reason, choice.budget_ms
    learner = make_learner(args, live, profile)
    ego = EgoFilter(profile, engine, budget_ms if live else None, reason, args.model, learn=learner)
    if profile is None and ego.engine_name in HAVE_LINEAR_STAGE:
        say(UNCALIBRATED)
    return ego, choice


def starting_profile(args: argparse.Namespace) -> Profile | None:
    """What was learned before, where there is such a file; else the calibration, where one was given."""
    if args.learn and Path(args.learn).exists():
        return Profile.load(args.learn)
    return Profile.load(args.profile) if args.profile else None


def make_learner(args: argparse.Namespace, live: bool, profile: Profile | None) -> Learner | None:
    """A learner in another process for a live run, in this one for a recording; none where it would take the filter's core."""
    if args.no_learn:
        return None
    remember = Path(args.learn) if args.learn else None
    if not live:
        from edgefilter.learning.path_learner import PathLearner

        return PathLearner(profile, remember)
    if cores() == 1:
        say("one core only: loudspeaker and room are not learned while running")
        return None
    return BackgroundLearner(profile, remember)


def check_request(args: argparse.Namespace, ego: EgoFilter, live: bool) -> None:
    """Raise UsageError for what was asked of a filter that cannot do it."""
    names = ", ".join(HAVE_LINEAR_STAGE)
    if ego.waits_for_end and live:
        raise UsageError(
            f"engine {ego.engine_name} needs the whole recording before it answers: give --input FILE or take another"
            " engine"
        )
    if args.save_profile and not ego.can_adapt:
        needed = f"give --profile and an engine with a linear stage ({names})"
        raise UsageError(f"--save-profile writes back an adapted path: {needed}")
    if args.learn and ego.stats()["linear_stage"] is None:
        raise UsageError(
            f"--learn keeps what a linear stage has learned, which {ego.engine_name} lacks: take one of {names}"
        )
