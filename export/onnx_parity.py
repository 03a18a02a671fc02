"""Whether an exported file computes what its network computes, over many chained frames, and how long it takes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from edgefilter.engines.onnx_session import open_session
from edgefilter.errors import ModelError
from export.paper_network import PaperCrnn

TOLERANCE = 1e-4
"""Largest difference of any output or state; spectra have a size of about 1, states of at most about 1."""
LEAST_DB = 20.0
"""Least signal-to-error ratio of an edge network's int8 variant on frames of noise; on speech it is 20 dB better."""
FRAMES = 1000
WARM_UP = 50
"""Frames that torch runs first, so that the comparison starts from a state as it is in use."""


def edge(network: nn.Module, path: Path, frames: int | None = None) -> float:
    """Largest difference over chained frames (FRAMES unless told) and in the final state.

    Raises ModelError where it exceeds TOLERANCE.
    """
    apart = max(
        float(np.max(np.abs(ours - found)))
        for wanted, answers in _chained(network, path, FRAMES if frames is None else frames)
        for ours, found in zip(wanted, answers, strict=True)
    )
    return _accept(apart, path)


def paper(network: PaperCrnn, path: Path) -> float:
    """Largest difference of the mask, over clips of another length than the traced one.

    Raises ModelError above TOLERANCE.
    """
    return _accept(_paper_difference(network, path), path)


def int8(network: nn.Module, path: Path) -> str:
    """How far int8 weights, which are meant to differ, bring a file from its network.

    Raises ModelError for an edge network below LEAST_DB.
    """
    if isinstance(network, PaperCrnn):
        return f"{_paper_difference(network, path):.1e} from torch at most"
    ratio = _edge_ratio_db(network, path, FRAMES // 5)
    if not ratio >= LEAST_DB:
        raise ModelError(
            f"the exported {path.name} is {ratio:.0f} dB above its error, expected at least {LEAST_DB:.0f} dB: not"
            " written"
        )
    return f"{ratio:.0f} dB above its error on noise"


def seconds(network: nn.Module, path: Path, repeats: int = 5) -> float:
    """Median time for a clip of one second, or for a hundred frames."""
    session = open_session(path)
    if isinstance(network, PaperCrnn):
        inputs = _named(session, _clip(network, 100, 0))
    else:
        inputs = _named(session, [*_frame(network, np.random.default_rng(0)), *network.initial_state()])
    times = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        for _ in range(1 if isinstance(network, PaperCrnn) else 100):
            session.run(None, inputs)
        times.append(time.perf_counter() - began)
    return statistics.median(times[1:])


def _accept(apart: float, path: Path) -> float:
    if not apart <= TOLERANCE:
        raise ModelError(
            f"the exported {path.name} is {apart:.1e} from the network, expected at most {TOLERANCE:.0e}: not written"
        )
    return apart


def _edge_ratio_db(network: nn.Module, path: Path, frames: int) -> float:
    """Power of the network's spectra over that of the file's error, in dB."""
    power = error = 0.0
    for wanted, answers in _chained(network, path, frames):
        power += float(np.sum(wanted[0] ** 2))
        error += float(np.sum((answers[0] - wanted[0]) ** 2))
    return 10.0 * float(np.log10(power / (error + 1e-30)))


@torch.no_grad()
def _chained(network: nn.Module, path: Path, frames: int) -> Iterator[tuple[list[np.ndarray], list[np.ndarray]]]:
    """Both spectra, probability and states of network and file, frame after frame, each going on from its own states."""
    session = open_session(path)
    rng = np.random.default_rng(0)
    state = network.initial_state()
    for _ in range(WARM_UP):
        *_, state = network.step(*_frame(network, rng), state)
    if not any(tensor.any() for tensor in state):
        raise ModelError("the network's state stays zero: a parity test from there proves nothing")
    theirs = [tensor.numpy() for tensor in state]
    for _ in range(frames):
        spectra = _frame(network, rng)
        *found, state = network.step(*spectra, state)
        answers = session.run(None, _named(session, [*spectra, *theirs]))
        theirs = answers[len(found) :]
        yield [tensor.numpy() for tensor in (*found, *state)], answers


def _frame(network: nn.Module, rng: np.random.Generator) -> list[Tensor]:
    """Four spectra (1, bins, 2) whose levels go up and down over 60 dB, as speech does, and two powers (1, bins) likewise.

    Error is the difference of mic and echo.
    """
    bins = network.config.n_fft // 2 + 1
    mic, reference, echo = 10.0 ** rng.uniform(-3, 0, (3, 1, 1, 1)) * rng.standard_normal((3, 1, bins, 2))
    noise, residual = 10.0 ** rng.uniform(-6, 0, (2, 1, 1)) * rng.standard_normal((2, 1, bins)) ** 2
    inputs = (mic - echo, mic, reference, echo, noise, residual)
    return [torch.from_numpy(x.astype(np.float32)) for x in inputs]


@torch.no_grad()
def _paper_difference(network: PaperCrnn, path: Path) -> float:
    session = open_session(path)
    worst = 0.0
    for frames, seed in ((1, 0), (37, 1), (120, 2)):
        clip = _clip(network, frames, seed)
        found = session.run(None, _named(session, clip))[0]
        worst = max(worst, float(np.max(np.abs(network(*clip).numpy() - found))))
    return worst


def _clip(network: PaperCrnn, frames: int, seed: int) -> list[Tensor]:
    rng = np.random.default_rng(seed)
    return [
        torch.from_numpy(x) for x in np.abs(rng.standard_normal((2, 1, frames, network.config.bins))).astype(np.float32)
    ]


def _named(session: object, values: list) -> dict[str, np.ndarray]:
    """Values by the names of the session's inputs, in order."""
    return {slot.name: np.asarray(value) for slot, value in zip(session.get_inputs(), values, strict=True)}
