"""Where a training step spends its time: what `python -m export.train ... --times` prints.

Steps on untrained weights, timed by torch's profiler. A layer's time is that of its operations and of their gradients,
which bear the same number. What the data's thread needs for a batch stands beside them, since that runs meanwhile.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import nn
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import ProfilerActivity, profile, record_function

from export.crops import Batches
from export.network import FrameNorm
from export.tasks import Task
from export.trainer import optimisers

WARM, TIMED = 3, 8
"""Steps before the clock runs, since the first ones choose algorithms and take memory, and steps that are timed."""
LAYERS: dict[str, tuple[type[nn.Module], ...]] = {
    "convolutions": (nn.Conv2d,),
    "recurrent layers": (nn.GRU, nn.LSTM),
    "normalisation": (FrameNorm, nn.BatchNorm2d),
    "other linear layers": (nn.Linear,),
}
NETWORK, LOSS, OPTIMISER = "features, bands, activations, mask", "loss and the rest", "optimiser"
ROWS = (*LAYERS, NETWORK, LOSS, OPTIMISER)
BACKWARD = "autograd::engine::evaluate_function"


def measure(task: Task, batches: Batches) -> dict[str, float]:
    """Milliseconds a step by row, of a whole "step", and of a "batch" on the data's thread."""
    network = task.network()
    tools = optimisers(network, 1e-3)
    began = time.perf_counter()
    drawn = [batches.draw(step) for step in range(WARM + TIMED)]
    batch_ms = 1e3 * (time.perf_counter() - began) / len(drawn)

    def steps(taken: Sequence[dict[str, torch.Tensor]]) -> float:
        began = time.perf_counter()
        for batch in taken:
            terms, _ = task.loss(network, batch)
            network.zero_grad(set_to_none=True)
            terms["total"].backward()
            with record_function(OPTIMISER):
                for tool in tools:
                    tool.step()
        return 1e3 * (time.perf_counter() - began) / len(taken)

    steps(drawn[:WARM])
    step_ms = steps(drawn[WARM:])
    _mark(network)
    with profile(activities=[ProfilerActivity.CPU]) as told:
        steps(drawn[WARM:])
    found = by_row(told.events())
    return {row: found[row] / sum(found.values()) * step_ms for row in ROWS} | {"step": step_ms, "batch": batch_ms}


def _mark(network: nn.Module) -> None:
    """Make the profiler see which layer an operation belongs to."""
    open_now: list[record_function] = []

    def watch(module: nn.Module, row: str) -> None:
        module.register_forward_pre_hook(lambda *_: open_now.append(record_function(row).__enter__()))
        module.register_forward_hook(lambda *_: open_now.pop().__exit__(None, None, None))

    watch(network, NETWORK)
    for module in network.modules():
        for row, kinds in LAYERS.items():
            if isinstance(module, kinds):
                watch(module, row)


def by_row(events: Sequence[FunctionEvent]) -> Counter[str]:
    """Microseconds by row: an operation's own row, or that of the operation whose gradient it is."""
    own = [next((up.name for up in _upward(event) if up.name in ROWS), None) for event in events]
    rows = {event.sequence_nr: row for event, row in zip(events, own, strict=True) if row and event.sequence_nr >= 0}
    found: Counter[str] = Counter()
    for event, row in zip(events, own, strict=True):
        if row is None:
            gradient = next((up for up in _upward(event) if up.name.startswith(BACKWARD)), None)
            row = rows.get(gradient.sequence_nr, LOSS) if gradient else LOSS
        found[row] += event.self_cpu_time_total
    return found


def _upward(event: FunctionEvent | None) -> Iterator[FunctionEvent]:
    """The event and what it is part of."""
    while event is not None:
        yield event
        event = event.cpu_parent


def table(found: Mapping[str, float]) -> str:
    """The rows as text, with their shares of the step."""
    width = max(map(len, ROWS))
    lines = [f"{row:{width}}  {found[row]:7.1f} ms  {100 * found[row] / found['step']:5.1f} %" for row in ROWS]
    lines.append(f"{'a step':{width}}  {found['step']:7.1f} ms")
    return "\n".join([*lines, f"{'its batch, meanwhile':{width}}  {found['batch']:7.1f} ms"])
