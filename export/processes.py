"""Several processes that train one network together, as torchrun starts them."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass

import torch
from torch import distributed, nn


@dataclass(frozen=True)
class Processes:
    """Each draws crops of its own; gradients are the mean over all. rank 0 validates and writes."""

    rank: int = 0
    world: int = 1

    @classmethod
    def join(cls) -> Processes:
        """As torchrun started them; one where it did not."""
        if not distributed.is_torchelastic_launched():
            return cls()
        if not distributed.is_initialized():
            distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        return cls(distributed.get_rank(), distributed.get_world_size())

    @property
    def device(self) -> torch.device:
        """Where this one computes: a GPU of its own where there is one."""
        return torch.device("cuda", self.rank) if torch.cuda.is_available() else torch.device("cpu")

    def share(self, network: nn.Module) -> None:
        """Replace each gradient by its mean over all processes."""
        if self.world == 1:
            return
        parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
        flat = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in parameters])
        distributed.all_reduce(flat)
        for parameter, part in zip(parameters, (flat / self.world).split([p.numel() for p in parameters])):
            parameter.grad = part.view(parameter.shape).clone(memory_format=torch.preserve_format)

    def agree(self, decided: bool, device: torch.device) -> bool:
        """What rank 0 decided, in all of them."""
        if self.world == 1:
            return decided
        told = torch.tensor(float(decided), device=device)
        distributed.broadcast(told, 0)
        return bool(told)

    def leave(self) -> None:
        """End this process where it is one of several, all being written: torch's threads may abort an interpreter that ends."""
        if self.world > 1:
            distributed.barrier()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)
