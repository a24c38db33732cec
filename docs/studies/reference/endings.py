"""Every verb ended by a signal at ten moments: what is still running, which folders are left, and what it said.

    python docs/studies/reference/endings.py [--verb plan ...] [--signal TERM] [--moments 10] [--longest 40] [--json
    OUT]

Each verb first runs undisturbed, for `--longest` seconds at most; then it is started ten times more and gets the signal
after 1/20, 3/20, ... of that time. What descends from it is found by a mark in its environment, whatever its parent,
group or session; it has its own folder for temporary files, its own cache and a working folder. Counted a moment after
its end: processes, entries among the temporary files, temporary files in the working folder, tracebacks. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[3]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests" / "helpers")]

from process_table import processes_with  # noqa: E402

SURROMD = [sys.executable, "-m", "surrogate.cli.main"]
# So long what was started may take to hear of it.
_GRACE_S = 5.0
# So long the verb itself may take to end, on a machine on which others work too.
_PATIENCE_S = 180.0

CAMPAIGN = """
scenes = ["alanine-dipeptide", "ethanol"]
replicas = 2
time = "40ps"
save_every = "100fs"
equilibrate = "1ps"
platform = "Reference"
out = "c"
"""
TINY = """
[model.autoencoder]
latent_dim = 8
width = 32
head_dim = 16
random_identifiers = 0.0
[model.approximator]
chunk_frames = 2
width = 32
n_layers = 1
n_heads = 2
auxiliary_frames = 1
"""
# Paracetamol with a longer chain, which no table ships: AM1-BCC charges take some tens of seconds.
LARGE = "smiles:CCCCCCCC(=O)Nc1ccc(O)cc1"
VERBS: dict[str, list[str]] = {
    "systems": ["systems", "aspirin"],
    "info": ["info", "{data}/ref.h5"],
    "plan": ["plan", LARGE],
    "reference, charges": ["reference", LARGE, "--time", "5ps", "-o", "x.h5"],
    "reference": ["reference", "alanine-dipeptide", "--time", "2ns", "-o", "x.h5"],
    "reference x 2": ["reference", "alanine-dipeptide", "--time", "1ns", "--replicas", "2", "-o", "x.h5"],
    "campaign": ["campaign", "{data}/c.toml", "-o", "c", "--workers", "2"],
    "windows": ["windows", "{data}/ref.h5", "-o", "w.h5"],
    "train": ["train", "{data}/ref.h5", "-o", "w.safetensors", "--steps", "400", "--config", "{data}/tiny.toml"],
    "rollout": ["rollout", "alanine-dipeptide", "--weights", "alanine-dipeptide", "--time", "20ns", "--replicas", "4",
                "-o", "r.h5"],
    "compare": ["compare", "{data}/ref.h5", "{data}/ref.h5", "-o", "report.html"],
    "stress": ["stress", "alanine-dipeptide", "--quick"],
    "demo": ["demo"],
}  # fmt: skip


@dataclass
class Ending:
    """One run that got a signal: when, its exit status (None: it had ended before), the seconds until its end, the
    commands still running, the files and folders left, and whether it showed a traceback."""

    after_s: float
    status: int | None
    took_s: float
    processes: list[str]
    left: list[str]
    traceback: bool
    said: str


def start(verb: str, place: Path, data: Path) -> tuple[subprocess.Popen[str], str]:
    """Start a verb in folders of its own under `place`; return it and its mark."""
    for name in ("tmp", "work", "cache"):
        (place / name).mkdir(parents=True)
    mark = f"SURROMD_ENDING={place}"
    environment = os.environ | {
        "SURROMD_ENDING": str(place),
        "TMPDIR": str(place / "tmp"),
        "SURROMD_CACHE": str(place / "cache"),
        "PYTHONPATH": str(REPOSITORY),
    }
    command = [*SURROMD, *(word.format(data=data) for word in VERBS[verb])]
    with open(place / "said", "w") as said:
        return subprocess.Popen(command, cwd=place / "work", env=environment, stdout=said, stderr=said, text=True), mark


def end(verb: str, number: signal.Signals, after_s: float, data: Path) -> Ending:
    """Start a verb, send it the signal after some seconds, and say what is left of it."""
    place = Path(tempfile.mkdtemp(prefix="surromd-endings-"))
    try:
        process, mark = start(verb, place, data)
        early = False
        try:
            process.wait(after_s)
            early = True
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        began = time.monotonic()
        try:
            process.wait(_PATIENCE_S)
            status: int | None = process.returncode
        except subprocess.TimeoutExpired:
            status = -999
        took_s = time.monotonic() - began
        deadline = time.monotonic() + _GRACE_S
        while (_left(place) or processes_with(mark)) and time.monotonic() < deadline:
            time.sleep(0.05)
        processes = processes_with(mark)
        said = (place / "said").read_text(errors="replace")
        ending = Ending(after_s, None if early else status, took_s, list(processes.values()), _left(place),
                        "Traceback" in said, " ".join(said.splitlines()[-1:]))  # fmt: skip
        for pid in processes:
            os.kill(pid, signal.SIGKILL)
        process.wait()
        return ending
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _left(place: Path) -> list[str]:
    """Return what should be gone: anything among the temporary files, but for the cache that torch keeps there on
    purpose, and files begun and not finished elsewhere."""
    found = [p.relative_to(place) for p in (place / "tmp").rglob("*") if not _of_torch(p.relative_to(place))]
    for folder in ("work", "cache"):
        unfinished = (p for p in (place / folder).rglob("*") if p.suffix == ".new" or p.name.startswith(".surromd-"))
        found += [p.relative_to(place) for p in unfinished]
    return sorted(map(str, found))


def _of_torch(path: Path) -> bool:
    return path.parts[1].startswith("torchinductor_")


def undisturbed_s(verb: str, longest_s: float, data: Path) -> float:
    """Return the wall time of a verb that nobody disturbs, `longest_s` at most."""
    place = Path(tempfile.mkdtemp(prefix="surromd-endings-"))
    try:
        process, mark = start(verb, place, data)
        began = time.monotonic()
        try:
            process.wait(longest_s)
            if process.returncode:
                raise SystemExit(f"{verb}: {(place / 'said').read_text()}")
        except subprocess.TimeoutExpired:
            process.terminate()
        length_s = time.monotonic() - began
        process.wait()
        deadline = time.monotonic() + _GRACE_S
        while processes_with(mark) and time.monotonic() < deadline:
            time.sleep(0.05)
        return length_s
    finally:
        shutil.rmtree(place, ignore_errors=True)


def make_data(folder: Path) -> None:
    """Write what the verbs read: a reference trajectory, a campaign, small settings of a model."""
    (folder / "c.toml").write_text(CAMPAIGN)
    (folder / "tiny.toml").write_text(TINY)
    command = [*SURROMD, "reference", "alanine-dipeptide", "--time", "100ps", "--save-every", "100fs", "--quiet"]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    subprocess.run([*command, "-o", str(folder / "ref.h5")], check=True, env=environment)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--verb", action="append", choices=tuple(VERBS), help="only this; may be repeated")
    parser.add_argument("--signal", action="append", choices=("TERM", "HUP", "INT", "KILL"), help="TERM unless told")
    parser.add_argument("--moments", type=int, default=10)
    parser.add_argument("--longest", type=float, default=40.0, help="seconds of a verb within which it is ended")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    rows: list[dict[str, object]] = []
    bad = 0
    sys.stdout.write(
        f"{'verb':<20}{'signal':<8}{'span s':>7}{'ended':>8}{'before':>8}{'processes':>11}{'files':>7}"
        f"{'tracebacks':>12}{'longest s':>11}  exit codes\n"
    )
    with tempfile.TemporaryDirectory(prefix="surromd-endings-") as name:
        data = Path(name)
        make_data(data)
        for verb in args.verb or VERBS:
            span_s = undisturbed_s(verb, args.longest, data)
            for word in args.signal or ["TERM"]:
                moments = [span_s * (k + 0.5) / args.moments for k in range(args.moments)]
                endings = [end(verb, signal.Signals[f"SIG{word}"], at, data) for at in moments]
                told = [e for e in endings if e.status is not None]
                processes, files = sum(bool(e.processes) for e in endings), sum(bool(e.left) for e in endings)
                tracebacks = sum(e.traceback for e in endings)
                bad += processes + files + tracebacks
                longest_s = max((e.took_s for e in told), default=0.0)
                sys.stdout.write(
                    f"{verb:<20}{word:<8}{span_s:>7.1f}{len(told):>8}{len(endings) - len(told):>8}{processes:>11}"
                    f"{files:>7}{tracebacks:>12}{longest_s:>11.1f}  {sorted({e.status or 0 for e in told})}\n"
                )
                for e in endings:
                    if e.processes or e.left or e.traceback or e.status == -999:
                        sys.stdout.write(
                            f"    after {e.after_s:.1f} s: {e.status}, {e.processes}, {e.left[:6]}, {e.said}\n"
                        )
                sys.stdout.flush()
                rows.append({"verb": verb, "signal": word, "span_s": span_s, "endings": [asdict(e) for e in endings]})
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1))
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
