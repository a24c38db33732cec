"""Devices of a training: one CPU or GPU, or several started by torchrun, by Lightning Fabric.

    torchrun [...] -m surrogate.cli.main train REF... -o model.safetensors [...]

Every process draws its own batch; gradients are averaged, so that the whole batch is the setting's times their number.
The first process alone validates and writes.
"""

from __future__ import annotations

import logging
import os
from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from systems.errors import InputError

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def choose_device(name: str) -> str:
    """Return the torch device for 'auto', 'cpu' or 'cuda': of torchrun's processes each its own GPU.

    Raises InputError for one that is unknown or not there.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"the device {name!r} is unknown; choose auto, cpu or cuda.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("there is no CUDA device here; leave `device` out.")
    if name == "cpu" or not torch.cuda.is_available():
        return "cpu"
    local = os.environ.get("LOCAL_RANK")
    return "cuda" if local is None else f"cuda:{local}"


def is_first_process() -> bool:
    """True in the process that writes: the only one, or torchrun's first."""
    return os.environ.get("RANK", "0") == "0"


def wait_for_all() -> None:
    """Return when every process has come here: what the first one wrote before is then there for all."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.barrier()


@lru_cache(maxsize=4)
def open_fabric(device_type: str, bf16: bool) -> Fabric:
    """Return a launched Fabric of this process, joined with torchrun's others where there are any."""
    from lightning_fabric import Fabric

    # On import it sets itself to tell of its precision and processes, through a handler of its own.
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    n_processes = int(os.environ.get("WORLD_SIZE", "1"))
    here = int(os.environ.get("LOCAL_WORLD_SIZE", str(n_processes)))
    fabric = Fabric(
        accelerator=device_type,
        devices=here,
        num_nodes=n_processes // here,
        strategy="ddp" if n_processes > 1 else "auto",
        precision="bf16-mixed" if bf16 else "32-true",
    )
    fabric.launch()
    return fabric


def average_gradients(fabric: Fabric, module: nn.Module, spent_s: float) -> float:
    """Average the gradients over all processes, in place, and return the time that the first one has spent.

    One message of all numbers: these models are small, and their losses do not go through one `forward`.
    """
    if fabric.world_size == 1:
        return spent_s
    grads = [p.grad for p in module.parameters() if p.grad is not None]
    clock = grads[0].new_tensor([spent_s if fabric.is_global_zero else 0.0])
    flat = fabric.all_reduce(torch.cat([clock, *(g.flatten() for g in grads)]), reduce_op="mean")
    assert isinstance(flat, Tensor)
    parts = flat[1:].split([g.numel() for g in grads])
    torch._foreach_copy_(grads, [part.view_as(g) for part, g in zip(parts, grads, strict=True)])
    return float(flat[0]) * fabric.world_size
