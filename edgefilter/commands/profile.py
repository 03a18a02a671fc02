"""`edgefilter profile show`: what a profile holds, as text, as JSON, as a picture."""

from __future__ import annotations

import argparse

import numpy as np

from edgefilter.commands.display import print_result, report_part
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.data import Profile
from edgefilter.profile.text import describe


def main(args: argparse.Namespace) -> None:
    plots = report_part("plots") if args.plot else None
    profile = Profile.load(args.profile)
    print_result(args, [describe(profile)], summary(profile))
    if plots:
        plots.plot_profile(profile, args.plot)
        print_result(args, [f"drawn to {args.plot}"])


def summary(profile: Profile) -> dict[str, object]:
    """The figures of a profile, ready for JSON."""
    return {
        "schema": 1,
        "microphones": profile.microphones,
        "taps": int(profile.echo.impulse_response.size),
        "delay_samples": profile.delay,
        "effects": [
            {"effect": name, "parameters": {key: np.asarray(value).tolist() for key, value in values.items()}}
            for name, values in profile.echo.effects
        ],
        "bands": [
            {"low_hz": float(low), "high_hz": float(high), "snr_db": float(snr)}
            for (low, high), snr in zip(profile.band_hz, profile.band_snr_db)
        ],
        "distortion_db": {str(order): float(level) for order, level in enumerate(profile.distortion_db, start=2)},
        "levels": [] if profile.approximation is None else levels(profile.approximation),
        "while_moving": profile.while_moving
        and {name: getattr(profile.while_moving, name) for name in ("level_db", "moments", "seconds")},
        "warnings": list(profile.warnings),
        "created": profile.created,
        "source": profile.source,
    }


def levels(approximation: LinearApproximation) -> list[dict[str, float]]:
    """For each level of the multisines: dB of full scale, and what a linear path leaves, dB over the linear part."""
    named = {
        "left_db": approximation.over_linear_db("noise", "even", "odd"),
        "noise_db": approximation.over_linear_db("noise"),
        "even_db": approximation.over_linear_db("even"),
        "odd_db": approximation.over_linear_db("odd"),
        "least_db": approximation.least_db,
    }
    return [
        {"played_db": float(level), **{name: float(figures[i]) for name, figures in named.items()}}
        for i, level in enumerate(approximation.level_db)
    ]
