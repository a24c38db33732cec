"""fp32 or bf16: which of the two this processor multiplies faster, found by multiplying, once a process.

Processors are of two kinds. With AMX or avx512_bf16 products in bf16 take a quarter to a fifteenth of the time, without
them (or where ONEDNN_MAX_CPU_ISA forbids them) 1.3 to 7 times as long. No other work on the machine moves one across
the limit between, so that a seed keeps its meaning on a machine. And on how many cores it multiplies (`torch_threads`).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import torch

from systems.errors import InputError

# By so much products must be faster before the casts about them pay.
_PAYS = 1.25
# A layer of the shipped weights, times a batch: (rows, columns in, columns out).
_PRODUCT = (64, 256, 1792)
_ROUNDS = 7
# Steps that are timed on each number of cores, and after how many it is asked again.
_TIMED_STEPS, _STEPS_BETWEEN = 8, 500
_UNITS = (("AMX", "_is_amx_tile_supported"), ("avx512_bf16", "_is_avx512_bf16_supported"))


@dataclass(frozen=True)
class Precision:
    """What a network is evaluated in, and why: `reason` goes into records and is said to the user."""

    bf16: bool
    reason: str

    @property
    def name(self) -> str:
        return "bf16" if self.bf16 else "fp32"


@dataclass(frozen=True)
class ProductSpeed:
    """Speed of matrix products on this processor, a batch through a layer, in GFLOP/s; `unit` as `bf16_unit` has it."""

    unit: str
    fp32_gflops: float
    bf16_gflops: float
    threads: int

    @property
    def ratio(self) -> float:
        return self.bf16_gflops / self.fp32_gflops

    def describe(self) -> str:
        """Return 'avx512_bf16; products on 1 thread: fp32 70 GFLOP/s, bf16 310 GFLOP/s (4.4 times as fast)'."""
        threads = f"{self.threads} thread{'s' if self.threads > 1 else ''}"
        return (
            f"{self.unit or 'neither AMX nor avx512_bf16'}; products on {threads}: fp32 "
            f"{self.fp32_gflops:.3g} GFLOP/s, bf16 {self.bf16_gflops:.3g} GFLOP/s ({self.ratio:.2g} times as fast)"
        )


def choose_precision(wanted: str, *, suits: bool = True) -> Precision:
    """Return the precision for a CPU: as `wanted`, or under 'auto' bf16 where its products are faster.

    `suits`: whether bf16 suits the model at all (`Surrogate.bf16_by_default`). Raises InputError for an unknown name.
    """
    if wanted not in ("auto", "fp32", "bf16"):
        raise InputError(f"precision {wanted!r} is unknown; choose auto, fp32 or bf16.")
    if wanted != "auto":
        return Precision(wanted == "bf16", "as asked for")
    if not suits:
        return Precision(False, "this model is exact in fp32 alone")
    speed = product_speed()
    through = f" through {speed.unit}" if speed.unit else ""
    if speed.ratio >= _PAYS:
        return Precision(True, f"products in bf16{through} are {speed.ratio:.2g} times as fast as in fp32 here")
    return Precision(False, f"products in bf16 are {speed.ratio:.2g} times as fast as in fp32 here")


def bf16_pays(device_type: str) -> bool:
    """True where a network is trained faster in bf16: on GPUs that have it, and on CPUs by `choose_precision`."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return choose_precision("auto").bf16


@cache
def product_speed() -> ProductSpeed:
    """Measure products in both precisions by turns, some ms of each; the best of each counts."""
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
    fp32, bf16 = gflop / best[torch.float32], gflop / best[torch.bfloat16]
    return ProductSpeed(bf16_unit(), fp32, bf16, torch.get_num_threads())


def bf16_unit() -> str:
    """Return what this processor has for bf16: 'AMX', 'avx512_bf16', or '' where torch knows of nothing."""
    for name, question in _UNITS:
        asked = getattr(torch.cpu, question, None)
        if asked is not None and asked():
            return name
    return ""


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
    """Has the steps of a loop computed on as many cores as they are fastest on: one, two or four, at most `most`. It
    is found out by timing, and again from time to time, since other programs come and go."""

    def __init__(self, most: int) -> None:
        self._numbers = [n for n in (1, 2, 4) if n <= max(most, 1)]
        self._spent_s: dict[int, list[float]] = {}
        self._step, self._began = 0, 0.0

    def next_step(self) -> int:
        """Say that a step begins, and return on how many cores. What takes long between steps now and then (a
        validation) does not count."""
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
