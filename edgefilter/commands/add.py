"""`edgefilter add`: fit an effect to a recording and write a profile that has it."""

from __future__ import annotations

import argparse

import numpy as np

from edgefilter.commands.display import write_json
from edgefilter.commands.material import load
from edgefilter.diagnosis.diagnose import add
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.running import reach
from edgefilter.report.words import UNITS, figure

LEAST_FALL_DB = 0.05
"""By less the figures that are shown do not differ."""


def main(args: argparse.Namespace) -> int:
    effect = find(args.effect)
    profile, recording, reference = load(args)
    fitted, before, after = add(profile, args.effect, recording, reference)
    fitted.save(args.output)
    values = dict(fitted.echo.effects)[args.effect]
    at_run_time = reach(effect, values)
    if args.json:
        figures = {
            "schema": 1,
            "effect": args.effect,
            "excess_before_db": before.excess_db,
            "excess_after_db": after.excess_db,
        }
        figures["this_recording_only"] = effect.event
        figures["at_run_time"] = at_run_time
        parameters = {p.name: {"value": np.asarray(values[p.name]).tolist(), "unit": p.unit} for p in effect.told}
        write_json(
            {**figures, "noise_floor_db": before.noise_floor_db, "parameters": parameters, "output": args.output},
            args.json,
        )
    if args.json != "-":
        print(
            f"{args.effect} added: {before.excess_db:.1f} dB over the noise floor before, {after.excess_db:.1f} dB"
            " after"
        )
        for p in effect.told:
            value = np.asarray(values[p.name])
            shown = f"{value.size} values" if value.size > 6 else ", ".join(figure(v) for v in value.ravel())
            print(f"  {p.name} = {shown} {UNITS.get(p.unit, p.unit)}".rstrip())
        if effect.event:
            print(
                f"NOTE        {args.effect} happened in this recording and is kept with it: of others the profile"
                " predicts what it did before"
            )
        if at_run_time:
            print(f"NOTE        {at_run_time}")
        if after.excess_db > before.excess_db - LEAST_FALL_DB:
            print("WARNING     the error did not fall: this effect does not explain the recording")
        print(f"written to {args.output}")
    return 0
