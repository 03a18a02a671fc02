"""Training on two processes is training on one with both batches."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from export import train
from export.crops import Batches, Shape
from export.items import Items
from export.tasks import EdgeTask
from export.trainer import Plan, Trainer

ROOT = Path(__file__).parents[2]
OPTIONS = argparse.Namespace(
    hop=32,
    channels=(4, 4, 4, 4),
    hidden=8,
    norm="layer",
    erb=0,
    suppression=6.0,
    si_sdr=0.004,
    recogniser=None,
    recogniser_weight=0.0,
    fan_kept=0.0,
    fan_recognised=1.0,
    second_alone=False,
    like=None,
    full_precision=True,
)
WORDS = "--hop 32 --channels 4 4 4 4 --hidden 8 --full-precision --steps 3 --every 3 --batch 2 --seconds 0.5".split()


@pytest.mark.slow
def test_two_processes_step_along_the_mean_of_their_gradients(tmp_path):
    folders = argparse.Namespace(data=tmp_path / "d", validation=tmp_path / "v", hop=32)
    train.smoke(folders)
    places = ["--data", tmp_path / "d", "--validation", tmp_path / "v", "--output", tmp_path / "run"]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["-m", "export.train", *map(str, places), *WORDS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    found = torch.load(tmp_path / "run" / "last.pt", weights_only=True)["resume"]
    assert found["step"] == 3 and len((tmp_path / "run" / "log.jsonl").read_text().splitlines()) == 1

    task = EdgeTask(OPTIONS)
    plan, shape = Plan(steps=3, rate=1.5e-3, seed=1, every=3, patience=0), Shape(2, 0.5, long_every=0)
    alone = Trainer(task, plan, shape, tmp_path / "alone")
    before = {name: value.clone() for name, value in alone.network.state_dict().items()}
    items = Items(tmp_path / "d")
    both = [Batches(items, task.stft, shape, 1, rank) for rank in range(2)]
    for step in range(3):
        gradients = []
        for batches in both:
            alone.network.zero_grad()
            task.loss(alone.network, batches.draw(step))[0]["total"].backward()
            gradients.append([parameter.grad.clone() for parameter in alone.network.parameters()])
        for parameter, first, second in zip(alone.network.parameters(), *gradients, strict=True):
            parameter.grad = (first + second) / 2
        torch.nn.utils.clip_grad_norm_(alone.network.parameters(), 1.0)
        for optimiser in alone.optimisers:
            for group in optimiser.param_groups:
                group["lr"] = plan.rate_at(step)
            optimiser.step()
    for name, wanted in alone.network.state_dict().items():
        # Adam divides by the gradient's size: rounding of a gradient near zero shows in full
        assert torch.allclose(found["running"][name], wanted, atol=2e-5), name
    moved = max(float((value - found["running"][name]).abs().max()) for name, value in before.items())
    assert moved > 2e-4
