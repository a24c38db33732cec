"""What a network computes on: CPU or GPU, fp32 or bf16, cores, and memory kept for reuse."""

from __future__ import annotations

import ctypes
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import NamedTuple

import torch

from systems.errors import InputError

# fp32 or bf16: which of the two this processor multiplies faster, found by multiplying, once a process. With AMX or
# avx512_bf16 products in bf16 take a quarter to a fifteenth of the time, without them 1.3 to 7 times as long. No other
# work on the machine moves one across the limit between, so that a seed keeps its meaning on a machine.

# By so much products must be faster before the casts about them pay.
_PAYS = 1.25
# A layer of the shipped weights, times a batch: (rows, columns in, columns out).
_PRODUCT = (64, 256, 1792)
_ROUNDS = 7
# Steps that are timed on each number of cores, and after how many it is asked again.
_TIMED_STEPS, _STEPS_BETWEEN = 8, 500


class Precision(NamedTuple):
    """What a network is evaluated in, and why: `reason` goes into records and is said to the user."""

    bf16: bool
    reason: str

    @property
    def name(self) -> str:
        return "bf16" if self.bf16 else "fp32"


def choose_precision(wanted: str, *, suits: bool = True) -> Precision:
    """Return the precision for a CPU: as `wanted`, or under 'auto' bf16 where its products are faster. `suits`: whether
    bf16 suits the model at all. Raises InputError for an unknown name, and for bf16 where it does not."""
    if wanted not in ("auto", "fp32", "bf16"):
        raise InputError(f"precision {wanted!r} is unknown; choose auto, fp32 or bf16.")
    if wanted == "bf16" and not suits:
        raise InputError("bf16 is too coarse for this model's forces or positions; leave `precision` out.")
    if wanted != "auto":
        return Precision(wanted == "bf16", "as asked for")
    if not suits:
        return Precision(False, "this model runs in fp32 only")
    fp32, bf16 = product_speed()
    return Precision(bf16 >= _PAYS * fp32, f"products in bf16 are {bf16 / fp32:.2g} times as fast as in fp32 here")


def bf16_pays(device_type: str) -> bool:
    """True where a network is trained faster in bf16: on GPUs that have it, and on CPUs by `choose_precision`."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return choose_precision("auto").bf16


@cache
def product_speed() -> tuple[float, float]:
    """Return the speed of products of a batch and a layer in fp32 and in bf16, GFLOP/s: the best of some ms each, by
    turns."""
    rows, n_in, n_out = _PRODUCT
    pairs = {
        dtype: (torch.ones(rows, n_in, dtype=dtype), torch.ones(n_out, n_in, dtype=dtype))
        for dtype in (torch.float32, torch.bfloat16)
    }
    best = dict.fromkeys(pairs, float("inf"))
    with torch.inference_mode():
        for _ in range(_ROUNDS + 1):  # the first compiles the kernels and is never the best
            for dtype, (x, weight) in pairs.items():
                started = time.perf_counter()
                torch.nn.functional.linear(x, weight)
                best[dtype] = min(best[dtype], time.perf_counter() - started)
    gflop = 2e-9 * rows * n_in * n_out
    return gflop / best[torch.float32], gflop / best[torch.bfloat16]


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Inside, torch computes on `number` cores; afterwards on as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class StepThreads:
    """Has the steps of a loop computed on as many cores as they are fastest on: one, two or four, at most `most`; timed
    from time to time, since other programs come and go."""

    def __init__(self, most: int) -> None:
        self._numbers = [n for n in (1, 2, 4) if n <= max(most, 1)]
        self._spent_s: dict[int, list[float]] = {}
        self._step, self._began = 0, 0.0

    def next_step(self) -> int:
        """Begin a step, and return on how many cores. A median: a validation between two steps does not count."""
        now, trial = time.perf_counter(), len(self._numbers) * _TIMED_STEPS
        if len(self._numbers) > 1 and 0 < self._step <= trial:
            self._spent_s.setdefault(torch.get_num_threads(), []).append(now - self._began)
        if self._step < trial:
            torch.set_num_threads(self._numbers[self._step // _TIMED_STEPS])
        elif self._step == trial and len(self._numbers) > 1:
            torch.set_num_threads(min(self._spent_s, key=lambda n: statistics.median(self._spent_s[n])))
        self._step += 1
        if self._step == trial + _STEPS_BETWEEN:
            self._step, self._spent_s = 0, {}
        self._began = now
        return torch.get_num_threads()


# Memory that is freed is kept for the next chunk or training step, where the C library (glibc) lets a program do so:
# pages made and zeroed anew take a tenth to a quarter of a rollout's time in a batch, a tenth of a training step's.

# malloc.h: the parameters, and the greatest size that glibc takes for the second.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT_BYTES, _LARGEST_BYTES = 512 * 2**20, 32 * 2**20


@cache
def keep_freed_memory() -> bool:
    """Let this process keep up to 512 MB that it frees; return whether the C library took the setting."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        say = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(say(_MMAP_THRESHOLD, _LARGEST_BYTES) and say(_TRIM_THRESHOLD, _KEPT_BYTES))


def choose_device(name: str) -> str:
    """Return the torch device for 'auto', 'cpu' or 'cuda'. Raises InputError for one that is unknown or not there."""
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"the device {name!r} is unknown; choose auto, cpu or cuda.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("there is no CUDA device here; leave `device` out.")
    return "cuda" if name != "cpu" and torch.cuda.is_available() else "cpu"
