"""One contender, hop by hop, in a process of its own; prints the milliseconds of every hop and stage as JSON.

    python -m bench.measure.latency_hops --contender ss --seconds 8 --paced --cores 2

Contenders are the engines, each in the whole path, and the peers speexdsp, speexdsp-suppressed and aec3. The sound is
the bundled conversation (simulated robot). Warm-up hops are left out. Threads are set by the caller's environment
(OMP_NUM_THREADS).
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import soundfile

import edgefilter
from bench.measure import peers
from edgefilter import engines
from edgefilter.dsp.stft import StftConfig
from edgefilter.filter.budget import held_to
from edgefilter.filter.learner import Learner
from edgefilter.filter.stream import Stream
from edgefilter.learning.background import BackgroundLearner
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE

DEMO = Path(edgefilter.__file__).parent / "demo_data"
PEERS = ("speexdsp", "speexdsp-suppressed", "aec3")
WARM_UP_S = 0.5


@dataclass
class Contender:
    """What is timed: a function of one hop of both channels, and the times of its stages."""

    hop: int
    step: Callable[[np.ndarray, np.ndarray], object]
    dtype: type = np.float32
    stages: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def edge(name: str, taps: int | None, hop: int | None, learner: Learner | None = None) -> Contender:
    """An engine in the whole path, started from the bundled profile, with another tail or hop or a learner where asked."""
    profile = Profile.load(DEMO / "profile.npz")
    if taps:
        response = profile.echo.impulse_response
        profile = profile.with_impulse_response(np.pad(response, (0, max(taps - response.size, 0)))[:taps])
    stft = StftConfig() if hop is None else StftConfig(n_fft=2 * hop, hop=hop, window_length=2 * hop)
    engine = engines.create(name, profile, stft)
    stream = Stream(engine, profile, learner=learner)
    contender = Contender(engine.stft.hop, stream.process)
    front = stream.front
    parts = [("alignment", front.aligner, "step")]
    if stage := front.linear_stage:
        parts += [("canceller", stage.canceller, "step"), ("residual", stage.residual, "step")]
    parts += (
        ("analysis", front._analyser, "push"),
        ("engine", engine, "step"),
        ("overlap-add", stream._synthesiser, "push"),
    )
    for stage, owner, method in parts:
        if owner is not None:
            setattr(owner, method, _timed(getattr(owner, method), contender.stages[stage]))
    return contender


def peer(name: str, stack: ExitStack) -> Contender:
    """A public canceller at its own frame length, called as its own samples say."""
    if name == "aec3":
        return Contender(peers.AEC3_FRAME, peers.aec3_frames())
    step = stack.enter_context(peers.speexdsp_frames(suppress=name == "speexdsp-suppressed"))
    out = np.zeros(peers.FRAME, np.int16)
    return Contender(peers.FRAME, lambda near, far: step(near, far, out), np.int16)


def _timed(inner: Callable, times: list[float]) -> Callable:
    def timed(*arguments: object) -> object:
        start = time.perf_counter()
        result = inner(*arguments)
        times.append(1000 * (time.perf_counter() - start))
        return result

    return timed


def scene(hop: int, dtype: type) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The bundled conversation, hop by hop, over and over."""
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype=np.dtype(dtype).name)[0] for name in ("mic", "reference"))
    while True:
        for at in range(0, mic.size - hop + 1, hop):
            yield np.ascontiguousarray(mic[at : at + hop]), np.ascontiguousarray(ref[at : at + hop])


def measure(contender: Contender, seconds: float, paced: bool) -> list[float]:
    """Milliseconds of each hop of so many seconds of audio, after the warm-up.

    Paced: each begins when a device would deliver it.
    """
    sound = scene(contender.hop, contender.dtype)
    period = contender.hop / SAMPLE_RATE if paced else 0.0
    for _ in range(round(WARM_UP_S * SAMPLE_RATE / contender.hop)):
        contender.step(*next(sound))
    for times in contender.stages.values():
        times.clear()
    took: list[float] = []
    began = time.perf_counter()
    for number in range(round(seconds * SAMPLE_RATE / contender.hop)):
        hop = next(sound)
        time.sleep(max(0.0, began + number * period - time.perf_counter()))
        start = time.perf_counter()
        contender.step(*hop)
        took.append(1000 * (time.perf_counter() - start))
    return took


def peak_memory_mb(pid: int) -> float:
    """Largest resident memory of a process so far, MB (Linux; getrusage would count the parent's at the fork)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contender", required=True)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--paced", action="store_true")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--taps", type=int)
    parser.add_argument("--hop", type=int)
    parser.add_argument("--learning", action="store_true", help="with a learner in another process")
    args = parser.parse_args()
    with ExitStack() as stack:
        stack.enter_context(held_to(args.cores))
        learner = BackgroundLearner() if args.learning else None
        contender = (
            peer(args.contender, stack)
            if args.contender in PEERS
            else edge(args.contender, args.taps, args.hop, learner)
        )
        took = measure(contender, args.seconds, args.paced)
        if learner:
            learner.close()
    times = {stage: [round(ms, 5) for ms in values] for stage, values in contender.stages.items()}
    print(
        json.dumps(
            {
                "hop": contender.hop,
                "took": [round(ms, 5) for ms in took],
                "stages": times,
                "learned": learner.stats() if learner else None,
                "peak_memory_mb": peak_memory_mb(os.getpid()),
            }
        )
    )


if __name__ == "__main__":
    main()
