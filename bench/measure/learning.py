r"""What learning brings while the filter runs, and what it costs: a day, a curve, the hops.

    python -m bench.measure.learning day --voices ROBOT/test --speech HUMAN/test --minutes 60 --output PATH
    python -m bench.measure.learning curve --voices ROBOT/test --rooms 16 --output PATH
    python -m bench.measure.learning cost --engines linear,crnn --seconds 30 --output PATH     (machine left alone)

day: minutes of robot speech through five changes of room, volume, place and clocks, human interrupting, engine
`linear`, uncalibrated and calibrated, each with and without learning: what is left over time, and by how much any
second is louder with learning. curve: what is left over seconds of robot speech in a room: cold, calibrated elsewhere,
calibrated here, learning from nothing, and the day after with what was learned here or elsewhere. cost: milliseconds of
a paced hop with a learner in another process and without, in turns, and what that process takes. The first two run
recordings as files, with the learner in the same process, so that they take minutes (of one core: 0.6 for each minute
of a day's speech, 1 for each room of the curve). --voices may name several folders, such as of other synthesizers.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from bench import results_writer
from bench.measure import learning_cost, learning_curve, learning_day
from edgefilter.errors import EdgefilterError


def day(options: argparse.Namespace) -> str:
    made_with = results_writer.stamp({"ROBOT": options.voices, "HUMAN": [options.speech]}, ["linear"])
    found = learning_day.measure(options.voices, options.speech, options.minutes, options.seed)
    learning_day.draw(found, options.output)
    page = learning_day.markdown(found, options.output.name)
    return results_writer.write(options.output, made_with, "A day with learning", page, found)


def curve(options: argparse.Namespace) -> str:
    made_with = results_writer.stamp({"ROBOT": options.voices}, ["linear"])
    found = learning_curve.measure(options.voices, options.rooms, options.seconds, options.seed)
    learning_curve.draw(found, options.output)
    page = learning_curve.markdown(found, options.output.name)
    return results_writer.write(options.output, made_with, "Learning over seconds of robot speech", page, found)


def cost(options: argparse.Namespace) -> str:
    engines = options.engines.split(",")
    made_with = results_writer.stamp({}, engines)
    found = learning_cost.measure(engines, options.seconds, options.rounds)
    learning_cost.draw(found, options.output)
    page = learning_cost.markdown(found, options.output.name)
    return results_writer.write(options.output, made_with, "What learning costs", page, found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = parser.add_subparsers(dest="program", required=True)
    for program, about in ((day, "minutes and changes"), (curve, "seconds and rooms"), (cost, "milliseconds")):
        one = programs.add_parser(program.__name__, help=about)
        one.set_defaults(program=program)
        one.add_argument("--output", type=Path, required=True, help="without suffix; .json, .md and .png are written")
        if program is cost:
            one.add_argument("--engines", default="linear,crnn", metavar="A,B,...")
            one.add_argument("--seconds", type=float, default=30.0, help="of sound in a round (default: %(default)s)")
            one.add_argument("--rounds", type=int, default=4, help="of each engine (default: %(default)s)")
            continue
        one.add_argument("--voices", type=Path, nargs="+", required=True, metavar="DIR", help="the robot's")
        one.add_argument("--seed", type=int, default=1)
        if program is day:
            one.add_argument("--speech", type=Path, required=True, metavar="DIR", help="human speech")
            one.add_argument("--minutes", type=float, default=60.0, help="of robot speech (default: %(default)s)")
        else:
            one.add_argument("--rooms", type=int, default=16, help="at least two (default: %(default)s)")
            one.add_argument("--seconds", type=float, default=24.0, help="of robot speech (default: %(default)s)")
    options = parser.parse_args()
    try:
        print(options.program(options))
    except (EdgefilterError, OSError) as error:
        print(f"learning: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
