"""Where a training step spends its time: what `python -m export.train ... --times` prints."""

from __future__ import annotations

import time

from torch.profiler import ProfilerActivity, profile, record_function

from export.crops import Batches
from export.tasks import Task
from export.trainer import optimisers

WARM, TIMED = 3, 8
"""Steps before the clock runs, since the first ones choose algorithms and take memory, and steps that are timed."""


def table(task: Task, batches: Batches) -> str:
    """Milliseconds that the loading thread needs for a batch beside the training, and torch's table of a step's operations."""
    network = task.network()
    tools = optimisers(network, 1e-3)
    began = time.perf_counter()
    drawn = [batches.draw(step) for step in range(WARM + TIMED)]
    batch_ms = 1e3 * (time.perf_counter() - began) / len(drawn)

    def step(batch: dict) -> None:
        with record_function("forward and loss"):
            terms, _ = task.loss(network, batch)
        network.zero_grad(set_to_none=True)
        terms["total"].backward()
        for tool in tools:
            tool.step()

    for batch in drawn[:WARM]:
        step(batch)
    with profile(activities=[ProfilerActivity.CPU]) as told:
        for batch in drawn[WARM:]:
            step(batch)
    operations = told.key_averages().table(sort_by="self_cpu_time_total", row_limit=20)
    return f"a batch, drawn meanwhile: {batch_ms:.1f} ms; {TIMED} steps:\n{operations}"
