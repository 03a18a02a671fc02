"""How far the linear stage is from the best linear filter while a human talks over the robot.

    python -m bench.measure.oracle RECORDINGS --speech HUMAN/test --conversations PAPER --output bench/results/oracle

Real: humans laid on recordings of a loudspeaker, without a profile, as in bench/measure/real.py. Simulated: conversations
with one constant lag, with their profile. What engine `linear` leaves of the robot in the human's span is its output less
the human. The oracle is the filter of TAPS that leaves least of that very span, the human unheard: no filter that has to
learn can do as well. Both are compared above LOW_HZ, since the running filter takes rumble out. Half a minute a case.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy import fft, signal
from scipy.sparse.linalg import LinearOperator, lsmr

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations
from bench.measure.real_streams import ECHO_ONLY, ROBOT_ALONE, Cells, chosen, find_recordings, lay
from edgefilter import enhance
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE, Samples

TAPS = 6400
"""0.4 s, as many as the running filter has without a profile."""
LOW_HZ = 100.0
RIDGE = 1e-4
"""Damping over the norm of the reference, so that frequencies without sound do not decide."""
STEPS = 300
"""Iterations of the least-squares solver; 100 more change the oracle by less than 0.1 dB on speech."""


def oracle_rest(echo: Samples, ref: Samples, span: slice) -> Samples:
    """What the filter of TAPS that fits echo (n,) in the span best leaves of it there; ref (n,) up to TAPS ahead of it."""
    first = span.start - TAPS + 1
    known = np.concatenate((np.zeros(max(-first, 0)), ref[max(first, 0) : span.stop].astype(np.float64)))
    wanted = echo[span].astype(np.float64)
    size = fft.next_fast_len(known.size + TAPS)
    spectrum = fft.rfft(known, size)

    def heard(taps: np.ndarray) -> np.ndarray:
        return fft.irfft(spectrum * fft.rfft(taps.ravel(), size), size)[TAPS - 1 : known.size]

    def correlated(rest: np.ndarray) -> np.ndarray:
        padded = np.concatenate((np.zeros(TAPS - 1), rest.ravel()))
        return fft.irfft(np.conj(spectrum) * fft.rfft(padded, size), size)[:TAPS]

    known_at = LinearOperator((wanted.size, TAPS), matvec=heard, rmatvec=correlated, dtype=np.float64)
    taps = lsmr(known_at, wanted, damp=RIDGE * float(np.linalg.norm(known)), atol=0.0, btol=0.0, maxiter=STEPS)[0]
    return (wanted - heard(taps)).astype(np.float32)


def erle_db(echo: Samples, rest: Samples) -> float:
    """Echo over what is left of it, above LOW_HZ."""
    high = signal.butter(4, LOW_HZ, "high", fs=SAMPLE_RATE, output="sos")
    before, after = (np.mean(np.square(signal.sosfiltfilt(high, x))) for x in (echo, rest))
    return float(10 * np.log10(before / after))


def judge(mic: Samples, ref: Samples, human: Samples, span: slice, out: Samples, delayed: Samples) -> dict[str, float]:
    """ERLE in the span of the running filter's output and of the oracle on the delayed reference, dB."""
    echo = mic - human
    mine = erle_db(echo[span], (out - human)[span])
    return {"linear_db": mine, "oracle_db": erle_db(echo[span], oracle_rest(echo, delayed, span))}


def real(options: argparse.Namespace) -> list[dict]:
    found = chosen(find_recordings(options.recordings, options.echo_only), options.split, options.echo_only)
    recordings = [recording for recording in found if recording.kind == ECHO_ONLY]
    cells = Cells(sers=(10.0, 0.0, -10.0, -20.0), befores=(5.0,))
    rows = []
    for laid in lay(recordings, options.speech, None, cells, options.cases, options.seed):
        mic, ref, human, span = laid.signals()
        judged = judge(mic, ref, human, span, enhance(mic, ref, None, "linear"), ref)
        rows.append({"kind": "real", "name": laid.name, "ser": laid.ser, **judged})
    return rows


def simulated(conversations: Iterable[Conversation]) -> list[dict]:
    rows = []
    for talk in conversations:
        mic, ref, human = (talk.read(name) for name in ("mic", "ref", "clean"))
        out = enhance(mic, ref, talk.profile, "linear")
        found = judge(mic, ref, human, talk.span, out, talk.delayed_reference())
        rows.append({"kind": f"simulated {talk.meta['room']}", "name": talk.folder.name, "ser": None, **found})
    return rows


def page(rows: list[dict]) -> str:
    """A line for each kind and level: means, and the distance's mean and worst."""
    cells = []
    for kind, ser in sorted({(r["kind"], r["ser"]) for r in rows}, key=str):
        some = [r for r in rows if (r["kind"], r["ser"]) == (kind, ser)]
        mine, best = (np.array([r[key] for r in some]) for key in ("linear_db", "oracle_db"))
        level = "" if ser is None else f"{ser:g}"
        cells.append([kind, level, len(some), *(f"{x:.1f}" for x in (mine.mean(), best.mean(), (best - mine).mean()))])
        cells[-1].append(f"{(best - mine).max():.1f}")
    columns = [
        "recordings",
        "human over robot, dB",
        "cases",
        "ERLE `linear`, dB",
        "oracle",
        "oracle ahead by",
        "at most",
    ]
    return "\n".join(results_writer.table(columns, cells))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder of NAME_lpb and NAME_mic")
    parser.add_argument("--speech", type=Path, required=True, metavar="HUMAN")
    parser.add_argument("--conversations", type=Path, nargs="*", default=[], metavar="PAPER")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth conversation")
    parser.add_argument("--echo-only", default=ROBOT_ALONE, help="recordings of the robot alone (default: %(default)s)")
    parser.add_argument("--split", default="report", choices=("tune", "report", "all"))
    parser.add_argument("--cases", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, required=True, metavar="PATH", help="PATH.json and PATH.md are written")
    options = parser.parse_args()
    try:
        data = {"RECORDINGS": [options.recordings], "HUMAN": [options.speech]}
        talks = (
            [talk for _, talk in every(find_conversations(options.conversations), options.every)]
            if options.conversations
            else []
        )
        made_with = results_writer.stamp(data | ({"conversations": options.conversations} if talks else {}), ["linear"])
        rows = real(options) + simulated(talks)
    except (EdgefilterError, OSError) as error:
        print(f"oracle: {error}", file=sys.stderr)
        return 1
    print(
        results_writer.write(
            options.output, made_with, "The linear stage and the best linear filter", page(rows), {"rows": rows}
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
