"""The machine that a benchmark's figures hold for."""

from __future__ import annotations

import os
from typing import Any


def machine_facts() -> dict[str, Any]:
    """Return its name, the load that was there before, what it has for bf16 ('none': neither AMX nor avx512_bf16) and
    what its matrix products take on torch's threads; JSON-able."""
    from md_reference.run.machine import machine_name
    from surrogate.training.devices import product_speed

    speed = product_speed()
    return {
        "name": machine_name(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "threads": speed.threads,
        "bf16": speed.unit or "none",
        "fp32_gflops": speed.fp32_gflops,
        "bf16_gflops": speed.bf16_gflops,
        "about": f"{machine_name()}; bf16: {speed.describe()}",
    }
