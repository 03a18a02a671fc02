"""Public echo cancellers cancel, aligned with their input; one that is missing says so in one line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from bench import peers
from edgefilter.dsp.metrics import erle
from edgefilter.errors import UsageError
from tests.bench.conftest import RATE, babble


def echo_scene() -> tuple[np.ndarray, np.ndarray]:
    """mic and ref of 12 s in which the robot speaks alone, 25 ms late, over a decaying path of 60 ms."""
    ref = babble(12.0, 7)
    rng = np.random.default_rng(8)
    path = np.concatenate([np.zeros(400), [0.5], 0.1 * rng.standard_normal(1000) * np.exp(-np.arange(1000) / 200)])
    mic = np.convolve(ref, path)[: ref.size] + 1e-4 * rng.standard_normal(ref.size)
    return mic.astype(np.float32), ref


@pytest.mark.parametrize(
    ("peer", "least_db"),
    [(peers.speexdsp, 10.0), (peers.speexdsp_suppressed, 20.0), (peers.aec3, 20.0), (peers.echoff, 20.0)],
)
def test_peer_cancels_an_echo_without_human(peer, least_db: float) -> None:
    mic, ref = echo_scene()
    out = peer(mic, ref)
    assert out.shape == mic.shape and out.dtype == np.float32
    last = slice(-4 * RATE, None)
    assert erle(mic[last], out[last]) > least_db  # a linear filter alone reaches less than one with suppression
    assert erle(mic[last], peer(mic, np.zeros_like(ref))[last]) < 3.0  # it is the reference that does it


@pytest.mark.parametrize("peer", [peers.speexdsp, peers.aec3, peers.echoff, peers.voiceclean])
def test_peer_output_is_aligned_with_the_input(peer) -> None:
    human = babble(6.0, 9)[: 6 * RATE - 477]
    out = peer(human, np.zeros_like(human))
    assert out.size == human.size
    lags = signal.correlate(out, human, "full")
    assert abs(int(np.argmax(lags)) - (human.size - 1)) <= 1  # a high-pass moves the peak by a fraction of a sample


def test_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(peers.ctypes, "CDLL", missing)
    with pytest.raises(UsageError, match="apt-get install libspeexdsp1"):
        peers.speexdsp(*echo_scene())
