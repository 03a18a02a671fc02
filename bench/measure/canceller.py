"""The linear stage: warm against cold start, what it does to the human, and a human as loud as the robot.

    OMP_NUM_THREADS=1 python -m bench.measure.canceller --conversations DIR --output bench/results/canceller

DIR holds conversations as bench.simulate.conversations makes them. Three questions, each answered over all of them:
warm/cold: error over microphone, dB, by seconds of robot speech, with and without the calibrated profile; human: SI-SDR
of out(robot + human + fan) - out(robot + fan) against the human, that is, what the filter makes of the human alone (a
lower bound: two runs adapt differently, and where the one without a human happens to end elsewhere, the difference
counts as distortion); loud: the same recordings with the human raised to the robot's level: residual echo while both
talk, against that with no human.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure import picture
from bench.measure.conversation import Conversation, every, find_conversations, progress
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.errors import EdgefilterError
from edgefilter.filter.enhance import enhance
from edgefilter.types import SAMPLE_RATE

ACTIVE = 1e-6
"""Mean square of the reference above which a tenth of a second counts as robot speech."""
STEP = SAMPLE_RATE // 10
LONGEST_S = 5.0
SHOWN_S = (0.5, 1.0, 2.0, 4.0)
ROOMS = ("lab", "office")
DOUBLE_TALK = {
    "human_si_sdr_db": "the human through `linear` against the human, SI-SDR",
    "human_ss_si_sdr_db": "the human through `ss` against the human, SI-SDR",
    "erle_without_human_db": "ERLE while nobody interrupts",
    "erle_with_human_db": "ERLE while the human interrupts, 20-26 dB lower",
    "erle_with_loud_human_db": "ERLE while a human as loud as the robot interrupts",
    "loud_human_si_sdr_db": "that loud human in the output, SI-SDR (0 dB before)",
}


def curve(mic: np.ndarray, error: np.ndarray, begin: int) -> np.ndarray:
    """Error over microphone, dB, for each tenth of a second of echo after begin.

    (LONGEST_S * 10,), nan beyond its end.
    """
    out = np.full(int(LONGEST_S * 10), np.nan)
    blocks = [
        slice(at, at + STEP)
        for at in range(begin, mic.size - STEP, STEP)
        if np.mean(mic[at : at + STEP] ** 2) > ACTIVE * 10
    ]
    for index, block in enumerate(blocks[: out.size]):
        out[index] = -erle(mic[block], error[block])
    return out


def measure(talk: Conversation) -> dict[str, object]:
    """Figures of one conversation."""
    meta, profile, span = talk.meta, talk.profile, talk.span
    mic, ref, clean = (talk.read(name) for name in ("mic", "ref", "clean"))
    alone = mic - clean
    heard = slice(0, meta["t_main"])
    begin = int(meta["lag"] + profile.delay + np.argmax(np.abs(ref) > 0.003))
    robot_db, human_db = (10 * np.log10(np.mean(x[span] ** 2)) for x in (alone, clean))
    louder = clean * np.float32(10 ** ((robot_db - human_db) / 20))
    quiet, normal, loud = (enhance(x, ref, profile, "linear") for x in (alone, mic, alone + louder))
    masked = enhance(mic, ref, profile, "ss") - enhance(alone, ref, profile, "ss")
    return {
        "name": f"{talk.folder.parent.name}/{talk.folder.name}",
        "room": meta["room"],
        "warm": curve(mic[heard], quiet[heard], begin).tolist(),
        "cold": curve(mic[heard], enhance(mic, ref, None, "linear")[heard], begin).tolist(),
        "human_si_sdr_db": si_sdr((normal - quiet)[span], clean[span]),
        "human_ss_si_sdr_db": si_sdr(masked[span], clean[span]),
        "erle_without_human_db": erle(alone[span], quiet[span]),
        "erle_with_human_db": erle(alone[span], (normal - clean)[span]),
        "erle_with_loud_human_db": erle(alone[span], (loud - louder)[span]),
        "loud_human_si_sdr_db": si_sdr(loud[span], louder[span]),
    }


def draw(rows: list[dict[str, object]], output: Path) -> None:
    """Error over microphone by seconds of robot speech."""
    figure, (axis,) = picture.panels(1, 1, (8, 4))
    for room, colour in (("lab", "#33658a"), ("office", "#b3412b")):
        for start, style in (("warm", "-"), ("cold", "--")):
            of = np.array([row[start] for row in rows if row["room"] == room])
            axis.plot(
                np.arange(of.shape[1]) / 10 + 0.1,
                np.nanmedian(of, axis=0),
                style,
                color=colour,
                label=f"{room}, {start} start",
            )
    axis.set(xlabel="seconds of robot speech", ylabel="error over microphone, dB (median)", xlim=(0, LONGEST_S))
    axis.grid(alpha=0.3)
    axis.legend()
    picture.save(figure, output, dpi=110)


def markdown(rows: list[dict[str, object]], name: str) -> str:
    """Both tables; name: of the picture, without suffix."""
    lines = [
        f"{len(rows)} simulated conversations.",
        "",
        "Error over microphone after seconds of robot speech, dB, median:",
        "",
    ]
    cells = []
    for room in ROOMS:
        for start in ("warm", "cold"):
            of = np.nanmedian([row[start] for row in rows if row["room"] == room], axis=0)
            cells.append([room, start, *(f"{of[round(s * 10) - 1]:.1f}" for s in SHOWN_S)])
    lines += results_writer.table(["room", "start", *(f"{s:.1f} s" for s in SHOWN_S)], cells)
    lines += [
        "",
        (
            "Double talk, dB, median (least). The first two rows are differences of two runs that adapt differently, so"
            " lower"
        ),
        "bounds:",
        "",
    ]
    cells = []
    for key, text in DOUBLE_TALK.items():
        found = [[row[key] for row in rows if row["room"] == room] for room in ROOMS]
        cells.append([text, *(f"{np.median(of):.1f} ({min(of):.1f})" for of in found)])
    return "\n".join(
        [*lines, *results_writer.table(["", *ROOMS], cells), "", f"![error over microphone]({name}.png)", ""]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, required=True, nargs="+")
    parser.add_argument("--output", type=Path, required=True, help="without suffix; .json, .md and .png are written")
    args = parser.parse_args()
    try:
        found = every(find_conversations(args.conversations))
        if missing := set(ROOMS) - {talk.meta["room"] for _, talk in found}:
            raise EdgefilterError(
                f"no conversation in the {', '.join(sorted(missing))}, expected both {' and '.join(ROOMS)}"
            )
        made_with = results_writer.stamp({"conversations": args.conversations}, ["linear", "ss"])
        rows = [measure(talk) for _, talk in progress(found)]
    except (EdgefilterError, OSError) as error:
        print(f"canceller: {error}", file=sys.stderr)
        return 1
    draw(rows, args.output)
    print(
        results_writer.write(
            args.output, made_with, "The linear stage", markdown(rows, args.output.name), {"rows": rows}
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
