r"""How the filter holds on recordings of real devices, without a calibration, beside public echo cancellers.

    OMP_NUM_THREADS=1 python -m bench.measure.real RECORDINGS --split report --speech HUMAN --noise FANS \\
        --whisper WHISPER --output bench/results/real

RECORDINGS holds pairs NAME_lpb (what the loudspeaker was sent) and NAME_mic, 16 kHz mono, WAV, FLAC or OGG. Those that
match --echo-only hold the robot alone; the others' names say who talks: doubletalk, farend, nearend.

- pairs: AECMOS for echo and human; ERLE where the robot is alone, SI-SDR against the microphone where the human is.
- laid: humans of --speech laid on the recordings of the robot alone, at several levels against the echo (--ser), after
  several seconds of robot alone (--before), without and with a fan of --noise.
- alone: the recordings of the robot alone, whole: ERLE by second, and every speech_started is false.

Everywhere: by how much the output is louder than the microphone over any second. The first half of the recordings
without a human, by name, is to tune on (--split tune), the second to report; the few other pairs are in both. The same
seed gives the same figures.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tqdm import tqdm

from bench import results_writer
from bench.measure import real_report
from bench.measure.real_scores import Recognition, aecmos, score
from bench.measure.real_streams import ECHO_ONLY, ROBOT_ALONE, Cells, Laid, Recording, chosen, find_recordings, lay
from bench.measure.real_systems import DEFAULT, UNOBTAINABLE, code_version
from bench.measure.score_cache import ScoreCache, key_of
from edgefilter.errors import EdgefilterError, UsageError

PARTS = ("pairs", "laid", "alone")
Task = tuple[str, "Recording | Laid", "Recognition | None"]


class Scores:
    """Rows by system, code, stream and recogniser in a JSON-lines file, appended to at once; without a path none."""

    def __init__(self, path: Path | None) -> None:
        self._cache = ScoreCache(path)

    def get(self, task: Task) -> dict | None:
        return self._cache.get(self._key(task))

    def keep(self, task: Task, row: dict) -> None:
        if "absent" not in row:
            self._cache.keep(self._key(task), row)

    def _key(self, task: Task) -> str:
        system, stream, recognition = task
        files = sorted(Path(__file__).parent.glob("real*.py"))
        code = [
            system,
            _version(system),
            *(path.read_text(encoding="utf-8") for path in files),
            repr(stream),
            repr(recognition),
        ]
        return key_of(code)


@cache
def _version(system: str) -> str:
    return code_version(system)


def _score(task: Task) -> dict:
    return score(*task)


def run(tasks: list[Task], jobs: int, scores: Scores) -> list[dict]:
    """A row for each task, in their order."""
    rows = [scores.get(task) for task in tasks]
    open_ = [index for index, row in enumerate(rows) if row is None]
    made = _made([tasks[index] for index in open_], jobs)
    for index, row in zip(
        open_, tqdm(made, total=len(open_), unit="stream", disable=not sys.stderr.isatty()), strict=True
    ):
        rows[index] = row
        scores.keep(tasks[index], row)
    return [{"system": task[0], **row} for task, row in zip(tasks, rows, strict=True)]


def _made(tasks: list[Task], jobs: int) -> Iterator[dict]:
    if jobs == 1:
        yield from map(_score, tasks)
        return
    with multiprocessing.get_context().Pool(jobs) as pool:
        yield from pool.imap(_score, tasks)


def streams(options: argparse.Namespace) -> list[Recording | Laid]:
    """What is asked for, in order; raises UsageError where nothing is left."""
    recordings = chosen(find_recordings(options.recordings, options.echo_only), options.split, options.only)
    alone = [recording for recording in recordings if recording.kind == ECHO_ONLY]
    found: list[Recording | Laid] = []
    if "pairs" in options.parts:
        found += [recording for recording in recordings if recording.kind != ECHO_ONLY]
    if "laid" in options.parts:
        if options.speech is None or not alone:
            missing = (
                "no --speech"
                if options.speech is None
                else f"no recording of the robot alone ({options.echo_only}, {options.only})"
            )
            raise UsageError(
                f"found {missing}, expected both to lay humans on the robot: give them, or leave laid out of --parts"
            )
        cells = Cells(options.ser, options.before, options.fan_db)
        found += lay(alone, options.speech, options.noise, cells, options.cases, options.seed)
    if "alone" in options.parts:
        found += alone
    if not found:
        raise UsageError(f"{options.recordings} holds nothing for --parts {','.join(options.parts)}: ask for others")
    return found


def numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def names(text: str) -> list[str]:
    return text.split(",")


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, metavar="RECORDINGS")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="PATH", help="PATH.json, .md and .png are written"
    )
    parser.add_argument(
        "--systems", type=names, default=[*DEFAULT, *UNOBTAINABLE], metavar="A,B,...", help="default: %(default)s"
    )
    parser.add_argument("--parts", type=names, default=[*PARTS], metavar="A,B,...", help="default: %(default)s")
    parser.add_argument(
        "--split", choices=("tune", "report", "all"), default="all", help="half of the recordings without a human"
    )
    parser.add_argument(
        "--echo-only",
        default=ROBOT_ALONE,
        metavar="PATTERN",
        help="names of the recordings without a human (default: %(default)s)",
    )
    parser.add_argument(
        "--only", default="*", metavar="PATTERN", help="of those, the ones to use (default: all of the split)"
    )
    parser.add_argument("--speech", type=Path, metavar="DIR", help="humans, with a transcripts.tsv")
    parser.add_argument("--noise", type=Path, metavar="DIR", help="fans; without it no cells with a fan")
    parser.add_argument(
        "--fan-db",
        type=float,
        default=Cells.noise_db,
        metavar="DB",
        help="fan against the recording's mean power (default: %(default)s)",
    )
    parser.add_argument(
        "--ser", type=numbers, default=Cells.sers, metavar="DB,...", help="human against echo (default: 0,-10,-20,-26)"
    )
    parser.add_argument(
        "--before", type=numbers, default=Cells.befores, metavar="S,...", help="robot alone before (default: 0,5,20)"
    )
    parser.add_argument("--cases", type=int, default=8, metavar="N", help="humans in each cell (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--whisper", type=Path, metavar="DIR", help="recogniser's folder; without it no word errors")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes at a time (default: %(default)s)")
    parser.add_argument(
        "--cache", type=Path, metavar="DIR", help="keep rows here and take those of the same code and streams from here"
    )
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.parts) - set(PARTS)):
        parser.error(f"unknown part {', '.join(unknown)}, expected some of {', '.join(PARTS)}")
    return options


def stamp(options: argparse.Namespace) -> dict:
    data = {"RECORDINGS": options.recordings, "HUMAN": options.speech, "FANS": options.noise}
    return results_writer.stamp(
        {what: [path] for what, path in data.items() if path}, options.systems, {"WHISPER": options.whisper}
    )


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    transcripts = (options.cache or Path.home() / ".cache" / "edgefilter-bench") / "transcripts.jsonl"
    recognition = Recognition(options.whisper, transcripts) if options.whisper else None
    try:
        found = streams(options)
        made_with = stamp(options)
        tasks = [
            (system, stream, recognition if isinstance(stream, Laid) else None)
            for stream in found
            for system in options.systems
        ]
        rows = run(tasks, options.jobs, Scores(options.cache / "real.jsonl" if options.cache else None))
        absent = {row["system"]: row["absent"] for row in rows if "absent" in row}
        if not aecmos():
            absent["AECMOS"] = "needs the packages speechmos and librosa: pip install speechmos librosa"
        rows = [row for row in rows if "absent" not in row]
        page, content = real_report.report(rows, options.systems, absent)
        print(
            results_writer.write(
                options.output, made_with, "Recordings of real devices, without a calibration", page, content
            )
        )
        real_report.picture(rows, options.systems, options.output)
    except (EdgefilterError, OSError) as error:
        print(f"real: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
