r"""Is it better, than what, on what, and where not: one command from recordings to a table and a page.

    OMP_NUM_THREADS=1 python -m bench FOLDER [FOLDER ...] --asr-model WHISPER --output DIR

Below each FOLDER: conversations as bench.simulate.conversations makes them, and pairs NAME_lpb and NAME_mic of real
devices; humans of --speech are laid on those that match --echo-only. Every system gets every clip; DIR/evaluation.json,
.md and .html say what came out. Scores are kept in --cache under clip, code, models and recognisers: a run that was cut
off goes on where it stopped, and a new row computes nothing but itself. The same seed gives the same figures, computing
times excepted. --scheduler: the workers of a Dask cluster that see the same files, in place of processes here.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from bench import results_writer
from bench.evaluate import page, slices, systems, table, worst
from bench.evaluate.clips import Laying, find_clips
from bench.evaluate.figures import Results
from bench.evaluate.judge import Setup
from bench.evaluate.systems import System
from bench.evaluate.work import evaluate
from bench.measure.conversation import progress
from bench.measure.real import names, numbers
from bench.measure.real_streams import Cells
from bench.measure.recogniser import find_model
from edgefilter.engines import ENGINES
from edgefilter.errors import EdgefilterError
from edgefilter.report.html import write_page

TITLE = "Evaluation"


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--systems", type=names, default=[], metavar="A,B,...", help="rows by name (default: all)")
    parser.add_argument("--network", type=named_file, action="append", default=[], metavar="NAME=FILE.onnx")
    parser.add_argument(
        "--asr-model",
        action="append",
        default=[],
        metavar="NAME|FOLDER",
        help="recogniser, or pocketsphinx; may be given several times; the first decides (default: none, no word errors)",
    )
    parser.add_argument("--speech", type=Path, metavar="DIR", help="humans to lay on real recordings")
    parser.add_argument(
        "--echo-only", default=Laying.echo_only, metavar="PATTERN", help="real recordings without a human"
    )
    parser.add_argument("--ser", type=numbers, default=Cells.sers, metavar="DB,...", help="human against echo, laid")
    parser.add_argument("--before", type=numbers, default=(5.0,), metavar="S,...", help="robot alone before, laid")
    parser.add_argument("--cases", type=int, default=8, metavar="N", help="humans laid at each level")
    parser.add_argument("--seed", type=int, default=0, help="of the humans that are laid")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th clip of each set")
    parser.add_argument("--worst", type=int, default=worst.COUNT, metavar="N", help="clips that the page lets hear")
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N", help="default: all cores"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    return parser.parse_args(arguments)


def named_file(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if not path:
        raise argparse.ArgumentTypeError(f"'{text}', expected NAME=FILE.onnx")
    return name, Path(path)


def stamp(options: argparse.Namespace, recognisers: dict[str, Path], here: Sequence[System]) -> dict:
    data = {"recordings": options.folders} | ({"HUMAN": [options.speech]} if options.speech else {})
    return results_writer.stamp(data, ENGINES, recognisers | {row.name: row.model for row in here if row.model})


def run(options: argparse.Namespace) -> str:
    """The page in Markdown, after all files are written."""
    recognisers = dict(find_model(model) for model in options.asr_model)
    cells = Cells(options.ser, options.before)
    laying = Laying(options.speech, options.echo_only, cells, options.cases, options.seed)
    clips = find_clips(options.folders, laying, options.every)
    networks = dict(options.network)
    here, absent = systems.present(systems.chosen(options.systems, networks))
    absent = {title: why.replace(f"{results_writer.ROOT}/", "") for title, why in absent.items()}
    made_with = stamp(options, recognisers, here)
    setup = Setup(options.cache, recognisers, networks)
    results = Results(clips, here, evaluate(clips, here, setup, options.jobs, options.scheduler), list(recognisers))
    groups = table.content(results)
    content = {"groups": groups, "absent": absent}
    content |= {"slices": slices.slices(results), "conclusions": slices.conclusions(results)}
    failures = [worst.show(results, index) for index in progress(worst.worst(results, options.worst), "worst clip")]
    options.output.mkdir(parents=True, exist_ok=True)
    write_page(options.output / "evaluation.html", page.page(results, content, failures, made_with))
    told = [{key: value for key, value in failure.items() if key != "pieces"} for failure in failures]
    text = table.markdown(results, content)
    everything = {**content, "worst": told, "clips": clip_rows(results)}
    return results_writer.write(options.output / "evaluation", made_with, TITLE, text, everything)


def clip_rows(results: Results) -> list[dict]:
    """What the JSON file holds of each clip; what was heard of it stays in the cache, being long."""
    found = []
    for clip, row in zip(results.clips, results.rows, strict=True):
        told = {"set": clip.set, "room": clip.room, "clip": clip.name, "speaker": clip.speaker, "facts": row["facts"]}
        for system in results.systems:
            one = dict(row[system.name])
            if "words" in one:
                one["words"] = {
                    name: {key: count for key, count in words.items() if key != "heard"}
                    for name, words in one["words"].items()
                }
            told[system.name] = one
        found.append(told)
    return found


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    try:
        print(run(options))
    except (EdgefilterError, OSError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
