"""The ring returns what was written, in order, and counts what did not fit."""

import numpy as np

from edgefilter.dsp.ring import Ring


def test_samples_come_out_in_order_across_many_wraps():
    ring, rng = Ring(37), np.random.default_rng(0)
    source = np.arange(5000, dtype=np.float32)
    out, at = [], 0
    while sum(part.size for part in out) < source.size:
        at += ring.write(source[at : at + rng.integers(0, 37 - len(ring) + 1)])
        out.append(ring.read(int(rng.integers(0, 37))))
    assert np.array_equal(np.concatenate(out), source) and ring.lost == 0


def test_what_does_not_fit_is_counted_and_the_oldest_is_kept():
    ring = Ring(10)
    assert ring.write(np.arange(8, dtype=np.float32)) == 8
    assert ring.write(np.arange(8, 13, dtype=np.float32)) == 2
    assert ring.lost == 3 and ring.read(99).tolist() == list(range(10)) and len(ring) == 0


def test_reading_returns_a_copy():
    ring = Ring(4)
    ring.write(np.ones(4, np.float32))
    out = ring.read(4)
    ring.write(np.zeros(4, np.float32))
    assert out.tolist() == [1, 1, 1, 1]
