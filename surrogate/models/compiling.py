"""A model's networks compiled by torch: faster chunks, after a minute of compiling."""

from __future__ import annotations

import copy
import os
import shutil
from typing import TypeVar

import torch
from torch import nn

from surrogate.models.interface import Surrogate
from systems.errors import InputError

_Model = TypeVar("_Model", bound=nn.Module)


def with_compiled_parts(model: _Model) -> _Model:
    """Return a copy whose networks are compiled when they are first called, for arrays of one shape.

    Raises InputError where there is no C++ compiler.
    """
    if not any(shutil.which(name) for name in (os.environ.get("CXX") or "g++", "clang++")):
        raise InputError("compiling needs a C++ compiler (g++ or clang++), which is not on the PATH; leave it out.")
    copied = copy.deepcopy(model)
    # A model that wraps another one (such as heavy atoms with hydrogens placed): the inner one's networks.
    within = next((child for child in copied.children() if isinstance(child, Surrogate)), copied)
    if isinstance(within, Surrogate) and within.integrates:
        within.compile_forces()
        return copied
    lists = [child for child in within.children() if isinstance(child, nn.ModuleList)]
    parents: list[nn.Module] = [within, *lists]
    for parent in parents:
        for name, child in list(parent.named_children()):
            if child not in lists:
                setattr(parent, name, torch.compile(child, dynamic=False))
    return copied
