"""Functions that are handed a value: how many distinct functions of the project get the Scene in `reference`, the
windows in `train`, and the trajectories in `compare`.

A function counts once, when one of its parameters holds the value or a list of such values; its own constructor and
comparisons do not count. Run with another checkout on PYTHONPATH to count there:

    python docs/studies/reference/trace.py [reference | train | compare] [--list]
"""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import systems

ROOT = Path(systems.__file__).parents[1]
PACKAGES = tuple(str(ROOT / name) for name in ("systems", "md_reference", "surrogate"))
# By name: the classes lie in other modules in other checkouts.
VALUES = {
    "reference": ("Scene",),
    "train": ("TrainingFrames", "FrameSets", "MoleculeWindows"),
    "compare": ("Ensemble", "StoredFrames", "Probes"),
}


def receivers(run: Callable[[], object], names: tuple[str, ...]) -> dict[str, set[str]]:
    """Return, by file, the project's functions that got a value of a class of these names while `run` ran."""
    found: dict[str, set[str]] = {}

    def is_one(value: Any) -> bool:
        if isinstance(value, list | tuple | dict) and value:
            return is_one(next(iter(value.values() if isinstance(value, dict) else value)))
        return type(value).__name__ in names and type(value).__module__.split(".")[0] in ("systems", "surrogate")

    def watch(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(PACKAGES) or code.co_name.startswith("<"):
            return
        given = [frame.f_locals.get(name) for name in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]]
        own = code.co_varnames[:1] == ("self",) and given and is_one(given[0])
        if any(map(is_one, given[1:] if own else given)) and not (own and code.co_name.startswith("__")):
            file = str(Path(code.co_filename).relative_to(ROOT))
            found.setdefault(file, set()).add(code.co_qualname)

    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        run()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return found


def main(verb: str, *, listed: bool) -> None:
    """Print the number of functions and files as JSON, and the functions by file if `listed`."""
    import surrogate as sm

    with tempfile.TemporaryDirectory() as folder:
        ref, other = Path(folder) / "ref.h5", Path(folder) / "other.h5"

        def reference(out: Path = ref, seed: int = 1) -> object:
            return sm.reference("alanine-dipeptide", out, time_ps=100.0, save_every_ps=0.1, seed=seed)

        if verb != "reference":
            reference()
        if verb == "compare":
            reference(other, 2)
        runs: dict[str, Callable[[], object]] = {
            "reference": reference,
            "train": lambda: sm.train([ref], Path(folder) / "w.safetensors", arch="lam-slide", budget_s=20.0),
            "compare": lambda: sm.compare(ref, other, Path(folder) / "page.html"),
        }
        found = receivers(runs[verb], VALUES[verb])
    total = sum(map(len, found.values()))
    lines = [json.dumps({"verb": verb, "values": VALUES[verb], "functions": total, "files": len(found)})]
    lines += [" ".join([file, *sorted(functions)]) for file, functions in sorted(found.items()) if listed]
    sys.stdout.write("\n".join([*lines, ""]))


if __name__ == "__main__":
    main(next((a for a in sys.argv[1:] if not a.startswith("-")), "reference"), listed="--list" in sys.argv)
