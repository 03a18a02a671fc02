"""What every engine must do inside the stream, whatever it computes. Each check takes a function that makes a new stream."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from edgefilter.stream import Stream
from edgefilter.types import Frame

MakeStream = Callable[[], Stream]


def conversation(n: int = 24_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A robot-like reference in bursts, its echo 900 samples later with a decaying tail, a weak human and a fan. Read-only."""
    rng = np.random.default_rng(seed)
    bursts = np.repeat(rng.uniform(0, 1, n // 800 + 1) > 0.3, 800)[:n]
    ref = (0.2 * rng.standard_normal(n) * bursts).astype(np.float32)
    tail = rng.standard_normal(600) * np.exp(-np.arange(600) / 120)
    tail[0] = 6.0
    echo = np.convolve(np.concatenate((np.zeros(900), ref)), tail)[:n] * 0.1
    human = 0.01 * np.sin(np.arange(n) * 0.3) * (np.arange(n) > n // 2)
    mic = (echo + human + 0.001 * rng.standard_normal(n)).astype(np.float32)
    mic.flags.writeable = ref.flags.writeable = False
    return mic, ref


def run(stream: Stream, mic: np.ndarray, ref: np.ndarray, sizes: list[int] | None = None) -> np.ndarray:
    """All output of one pass, the input cut into blocks of the given sizes over and over."""
    out, at, turn = [], 0, 0
    while at < mic.size:
        size = sizes[turn % len(sizes)] if sizes else mic.size
        out.append(stream.process(mic[at : at + size], ref[at : at + size]))
        at, turn = at + size, turn + 1
    out.append(stream.flush())
    return np.concatenate(out)


def check_any_partition_gives_the_same_bits(make: MakeStream) -> None:
    mic, ref = conversation()
    whole = run(make(), mic, ref)
    for sizes in ([1, 7, 255], [256], [160], [4096], [0, 513, 1, 0, 3001]):
        assert np.array_equal(run(make(), mic, ref, sizes), whole), f"blocks of {sizes} change the output"


def check_length_out_is_length_in(make: MakeStream) -> None:
    for n in (0, 1, 2, 159, 160, 255, 256, 257, 1000, 5001):
        mic, ref = conversation(24_000)
        out = run(make(), mic[:n], ref[:n])
        assert out.shape == (n,) and out.dtype == np.float32


def check_is_finite_on_hard_input(make: MakeStream) -> None:
    n = 12_000
    hard = {
        "silence": np.zeros(n),
        "full-scale square": np.sign(np.sin(np.arange(n) * 0.05)),
        "denormals": np.full(n, 1e-40),
        "one impulse": np.eye(1, n, 3000)[0],
    }
    for name, x in hard.items():
        x = x.astype(np.float32)
        for ref in (x, np.zeros_like(x)):
            assert np.isfinite(run(make(), x, ref)).all(), f"not finite on {name}"


def check_silence_gives_silence(make: MakeStream) -> None:
    nothing = np.zeros(8000, np.float32)
    assert not run(make(), nothing, nothing).any()


def check_declared_latency_is_the_true_one(make: MakeStream) -> None:
    """Sample n is out once n + latency samples are in, for every n, and for some n not a sample earlier."""
    stream = make()
    mic, ref = conversation(6000)
    out, slack = 0, []
    for n in range(mic.size):
        out += stream.process(mic[n : n + 1], ref[n : n + 1]).size
        slack.append(out - (n + 1 - stream.latency))
    assert min(slack[stream.latency :]) == 1, "sample n may use samples up to n + latency - 1 and no later ones"


def check_is_causal_beyond_its_latency(make: MakeStream) -> None:
    mic, ref = conversation()
    at = 15_000
    changed = mic.copy()
    changed[at:] = 0.3
    changed_ref = ref.copy()
    changed_ref[at:] = -0.3
    stream = make()
    before, after = run(stream, mic, ref), run(make(), changed, changed_ref)
    first = at - stream.latency + 1
    assert np.array_equal(before[:first], after[:first]) and not np.array_equal(before, after)


def check_reset_starts_anew(make: MakeStream) -> None:
    mic, ref = conversation()
    stream = make()
    first = run(stream, mic, ref)
    stream.reset()
    assert np.array_equal(run(stream, mic, ref), first)


def check_two_streams_share_an_engine(make: MakeStream) -> None:
    stream = make()
    other = Stream(stream.engine, stream.profile)
    mic, ref = conversation()
    alone = run(make(), mic, ref)
    out = []
    for at in range(0, mic.size, 1000):
        out.append(stream.process(mic[at : at + 1000], ref[at : at + 1000]))
        other.process(ref[at : at + 1000], mic[at : at + 1000])
    assert np.array_equal(np.concatenate((*out, stream.flush())), alone)


def check_step_writes_neither_frame_nor_state(make: MakeStream) -> None:
    engine = make().engine
    rng = np.random.default_rng(4)
    bins = engine.stft.bins

    def spectrum() -> np.ndarray:
        x = (rng.standard_normal(bins) + 1j * rng.standard_normal(bins)).astype(np.complex64)
        x.flags.writeable = False
        return x

    psd = np.ones(bins, np.float32)
    psd.flags.writeable = False
    frames = [Frame(spectrum(), spectrum(), spectrum(), spectrum(), psd, psd) for _ in range(6)]
    states = [engine.initial_state()]
    first = []
    for frame in frames:
        output, state = engine.step(frame, states[-1])
        states.append(state)
        first.append(output.spectrum.copy())
    again = [engine.step(frame, state)[0].spectrum for frame, state in zip(frames, states)]
    assert np.array_equal(first, again), "a state was changed by a later step"


CHECKS = [check for name, check in sorted(globals().items()) if name.startswith("check_")]
