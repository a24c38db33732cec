"""The checksum that files of tensors state: what the disk or a copy has changed is noticed when they are read."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch


def tensor_checksum(text: str, tensors: Mapping[str, torch.Tensor]) -> str:
    """Return the SHA-256 of a file's record and of its tensors with their names, types and shapes, in hexadecimal."""
    found = hashlib.sha256(text.encode())
    for name, tensor in sorted(tensors.items()):
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()
