"""Streams per core: what the benchmark counts as an answer in time, against a real service."""

from __future__ import annotations

import asyncio
import os

import numpy as np
import pytest

from bench import serve


@pytest.mark.slow
def test_every_hop_of_every_client_is_answered_and_timed() -> None:
    core = min(os.sched_getaffinity(0))
    with serve.service("linear", core) as (address, process):
        took = asyncio.run(serve.clients(address, 2, 256, 0.5, np.random.default_rng(0)))
        assert os.sched_getaffinity(process) == {core}
        assert serve.processor_s(process) > 0
    # the last hop's answer comes with the rest, when the client has ended
    assert 2 * 30 <= len(took) <= 2 * 33 and 0 < min(took)


def test_in_time_is_the_last_number_of_streams_whose_slowest_hundredth_comes_within_a_hop() -> None:
    rows = [{"engine": "linear", "streams": n, "p99": p99} for n, p99 in ((1, 3.0), (2, 9.0), (4, 15.9), (6, 16.1))]
    assert serve.in_time(rows, "linear") == 4
    assert serve.in_time(rows[3:], "linear") == 0
