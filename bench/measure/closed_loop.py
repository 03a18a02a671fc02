r"""What a robot gains that stops, or lowers its voice, when the filter notices that somebody interrupts it.

    python -m bench.measure.closed_loop --speech HUMAN/test --voices ROBOT/test --count 24 --whisper WHISPER \
        --alone-voices ROBOT/test SYNTHESIZERS --minutes 60 --real RECORDINGS --output bench/results/closed_loop

Interruptions: conversations of bench.simulate.conversations, kinds paper and live in turn. The loop is closed: from
REACTION_S after the event speech_started the robot says nothing more (or 10 dB less), the rest of its speech is never
played, the microphone is recorded anew with what is left of it, and the filter runs over that; what was handed to the
loudspeaker before is still heard, as late as that robot's playback lags. Beside it: open loop (the robot talks on), a
microphone that is muted while the robot speaks, an oracle that has silence at the human's first sound. The recogniser
gets the human's span of what each of them leaves.

Backchannels: the same scenes, with a short word or a cough in the place of the interruption. False stops: the robot
alone for --minutes of its speech, in new rooms all the time, half of them with loudspeakers of strong distortion and
half without a calibration, and the recordings of one real loudspeaker (--real). Writes OUTPUT.json, .md and .png. Rows
are kept in --cache as they are made: a run that was cut off, or is asked for more minutes, goes on where it stopped.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from bench import results_writer
from bench.measure import closed_loop_report as report
from bench.measure.closed_loop_alone import monologues, real_minutes
from bench.measure.closed_loop_scenes import measure
from bench.measure.conversation import progress
from bench.measure.kept_rows import KeptRows
from bench.measure.recogniser import Recogniser
from bench.simulate.conversations import make_scene, read_clips, read_voices
from edgefilter.engines import HAVE_LINEAR_STAGE
from edgefilter.errors import EdgefilterError

KINDS = ("paper", "live")


def main() -> int:
    options = parse()
    data = {"HUMAN": [options.speech], "ROBOT": options.voices, "ALONE": options.alone_voices}
    data |= {"RECORDINGS": [options.real]} if options.real else {}
    try:
        made_with = results_writer.stamp(
            {what: folders for what, folders in data.items() if folders},
            [options.engine],
            {"WHISPER": options.whisper},
        )
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl") if options.whisper else None
        kept = KeptRows(options.cache / "closed_loop.jsonl", made_with, options.seed, options.engine)
        speech, voices = read_clips(options.speech, (3.0, 12.0)), read_voices(options.voices)
        rows = []
        for index in progress(range(options.count), "conversation"):
            kind = KINDS[index // 2 % 2]
            row = kept.get(
                f"conversation {index}",
                lambda i=index, k=kind: measure(
                    make_scene(options.seed, i, k, speech, voices), options.engine, recogniser
                ),
            )
            rows.append({"index": index, "kind": kind, **row})
        alone = monologues(options.alone_voices, options.minutes, options.seed, options.engine, kept)
        alone += real_minutes(options.real, options.engine) if options.real else []
    except (EdgefilterError, OSError) as error:
        print(f"closed_loop: {error}", file=sys.stderr)
        return 1
    content = {"engine": options.engine, "rows": rows, "alone": alone}
    content["summary"] = report.summarise(rows, alone)
    page = report.markdown(content, f"{options.output.name}.png")
    print(results_writer.write(options.output, made_with, "Barge-in in closed loop", page, content))
    report.draw(content["summary"]["curve"], options.output)
    return 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speech", type=Path, required=True, metavar="DIR", help="humans, with a transcripts.tsv")
    parser.add_argument("--voices", type=Path, nargs="+", required=True, metavar="DIR", help="the robot's voices")
    parser.add_argument("--count", type=int, default=24, help="conversations (default: %(default)s)")
    parser.add_argument(
        "--alone-voices", type=Path, nargs="*", default=[], metavar="DIR", help="voices for the robot alone"
    )
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="robot speech alone, about 10 s each (default: %(default)s)"
    )
    parser.add_argument("--real", type=Path, metavar="DIR", help="recordings of a real loudspeaker alone")
    parser.add_argument("--engine", choices=HAVE_LINEAR_STAGE, default="crnn", help="default: %(default)s")
    parser.add_argument("--whisper", type=Path, metavar="DIR", help="recogniser's folder; without it no word errors")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
