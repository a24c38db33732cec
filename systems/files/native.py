"""What a user's machine makes once and keeps: the folder where it lies; C++ programs, compiled for its processor."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

from systems.errors import SurromdError

# Linked apart: with -ffast-math GCC before 13 links what has the whole process round small numbers to zero.
_FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp-simd", "-fPIC", "-std=c++17", "-w", "-c")


class CompilerError(SurromdError):
    """This machine has no C++ compiler, or none that compiles the program."""


def cache_folder() -> Path:
    """Where this user's files that can be made again lie: $SURROMD_CACHE, else surromd under $XDG_CACHE_HOME."""
    own = os.environ.get("SURROMD_CACHE")
    if own:
        return Path(own).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "surromd"


def compiled_program(
    source: Path, macros: Mapping[str, float] | None = None, headers: Path | None = None
) -> ctypes.CDLL:
    """Compile `source` with these macros and the `headers` of a folder, else of its own, for this processor, once for
    each version of them, and load it. Raises CompilerError, and OSError where nothing can be kept."""
    compiler = next((c for c in ("g++", "c++") if shutil.which(c)), None)
    if compiler is None:
        raise CompilerError("no C++ compiler (g++) was found")
    flags = (*_FLAGS, *(f"-D{name}={value}" for name, value in (macros or {}).items()))
    # What the compiler says that it is and calls this processor.
    asked = [compiler, "-march=native", "-v", "-E", "-x", "c++", os.devnull]
    said = subprocess.run(asked, capture_output=True, check=False).stderr
    headers = headers or source.parent
    texts = [source.read_bytes(), *(header.read_bytes() for header in sorted(headers.glob("*.h")))]
    key = hashlib.sha256(b"\0".join([*texts, said, repr(flags).encode()])).hexdigest()[:16]
    path = cache_folder() / f"{source.stem}-{key}.so"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            part = Path(folder) / path.name
            compiled = f"{part}.o"
            for step in ([*flags, f"-I{headers}", "-o", compiled, str(source)], ["-shared", "-o", str(part), compiled]):
                done = subprocess.run([compiler, *step], capture_output=True, text=True, check=False)
                if done.returncode:
                    lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
                    raise CompilerError(f"{compiler} could not compile {source.name}: {lines[0]}")
            os.replace(part, path)
    return ctypes.CDLL(str(path))
