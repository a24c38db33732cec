"""The installed command killed outright (`kill -9`) at random moments, and gone on with: is it the same file?

    python docs/studies/reference/kills.py [--trials 14] [--command surromd] [--seed 0]

Each kind of run is made once undisturbed. Then, `--trials` times, it is started anew, killed with all that descends
from it after a random part of that time, and started again with `--resume` until it ends. Printed is a table: exact
(all that the finished file holds is that of the undisturbed run), refused (one line, nothing changed), lost (anything
else). Of `surromd run`, which the clock ends, exact means that it ends evaluated, and with every frame up to the last
checkpoint before it was killed; a line says in which stage that was, and what was spent of the budget in the end.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(REPOSITORY))

from systems.trajectory.checkpoint import frames_in, read_checkpoint  # noqa: E402
from systems.trajectory.codec import open_trajectory  # noqa: E402

MD = ["reference", "alanine-dipeptide", "--time", "40ps", "--save-every", "100fs", "--equilibrate", "2ps", "--platform",
      "Reference", "--seed", "3", "--quiet"]  # fmt: skip
ROLLOUT = ["rollout", "alanine-dipeptide", "--weights", "alanine-dipeptide", "--time", "2ns", "--precision", "fp32",
           "--seed", "1", "--quiet"]  # fmt: skip
RUN = ["run", "alanine-dipeptide", "-o", "run", "--quiet", "--resume"]
# The files of a finished run; none where they are not to be those of another one.
KINDS: dict[str, tuple[list[str], list[str]]] = {
    "reference .h5": ([*MD, "-o", "a.h5"], ["a.h5"]),
    "reference .dcd": ([*MD, "-o", "a.dcd"], ["a.dcd"]),
    "reference x 2": ([*MD, "--replicas", "2", "-o", "a.h5"], ["a_r0.h5", "a_r1.h5"]),
    "rollout .h5": ([*ROLLOUT, "-o", "a.h5"], ["a.h5"]),
    "run, MD": ([*RUN, "--way", "md", "--budget", "60s"], []),
    "run, surrogate": ([*RUN, "--way", "surrogate", "--budget", "80s"], []),
}


def whole(paths: list[Path]) -> list[bytes]:
    """All that finished files hold, but for times of day and seconds spent."""
    found = []
    for path in paths:
        with open_trajectory(path) as reader:
            assert reader.record["completed"] is True, f"{path} is not complete"
            scalars = [values.tobytes() for _, values in sorted(reader.scalars.items())]
            found.append(b"".join([reader.read().tobytes(), reader.time_ps.tobytes(), *scalars]))
    return found


def frames(folder: Path) -> dict[str, Any]:
    """Return the positions in each trajectory of a run's folder, as far as its checkpoint, if there is one, stands."""
    found = {}
    for path in sorted(folder.glob("run/*/*.h5")):
        if frames_in(path):
            with open_trajectory(path) as reader:
                found[path.name] = reader.read()
    for path in folder.glob("run/*/*.checkpoint"):
        files = read_checkpoint(path)[0]["files"]
        stem, _, first = path.name.removesuffix(".h5.checkpoint").partition("_r")
        for k, entry in enumerate(files):
            name = f"{stem}_r{int(first) + k}.h5" if first else f"{stem}.h5"
            if name in found:
                found[name] = found[name][: entry["n_frames"]]
    return found


def record(folder: Path) -> dict[str, Any]:
    path = folder / "run" / "run.json"
    return dict(json.loads(path.read_text())) if path.exists() else {}


def stage(folder: Path) -> str:
    """Return what a run was doing when it was killed."""
    found = record(folder)
    if not found.get("decision"):
        return "measuring" if found else "preparing"
    ended = {entry["name"] for entry in found["stages"]}
    return next((entry["name"] for entry in found["decision"]["stages"] if entry["name"] not in ended), "done")


def evaluated(folder: Path, kept: dict[str, Any]) -> str:
    """Return what came of a run that was gone on with; `kept`: its frames when it was killed."""
    found, now = record(folder), frames(folder)
    for name, positions in kept.items():
        if len(now.get(name, ())) < len(positions) or (now[name][: len(positions)] != positions).any():
            return f"lost: {name} had {len(positions)} frames, now {len(now.get(name, ()))}"
    if not found["outcome"] or not (folder / "run" / "report.html").is_file():
        return "lost: no report"
    return "exact"


def start(command: list[str], folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                            start_new_session=True)  # fmt: skip


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def trial(command: list[str], names: list[str], reference: list[bytes], after_s: float) -> tuple[str, bool]:
    """Return the outcome, and whether the run was still going when it was killed."""
    folder = Path(tempfile.mkdtemp(prefix="surromd-kills-"))
    try:
        process = start(command, folder)
        time.sleep(after_s)
        alive = process.poll() is None
        if alive:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        before = contents(folder)
        kept, killed_in = ({}, "") if names else (frames(folder), stage(folder))
        again = start([*command, "--resume"], folder)
        _, said = again.communicate()
        if not names:
            spent = record(folder).get("spent_s", 0.0)
            sys.stdout.write(f"    after {after_s:.0f} s, {killed_in}; {spent:.0f} s in the end\n")
        if again.returncode:
            same = contents(folder) == before
            return ("refused" if same and len(said.splitlines()) == 1 else f"lost: {said.strip()}"), alive
        if not names:
            return evaluated(folder, kept), alive
        return ("exact" if whole([folder / name for name in names]) == reference else "lost: other frames"), alive
    except Exception as error:
        return f"lost: {type(error).__name__}: {error}", True
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=14, help="of each kind")
    parser.add_argument("--command", default=str(Path(sys.executable).with_name("surromd")))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=tuple(KINDS))
    args = parser.parse_args()
    rng, lost = random.Random(args.seed), 0
    sys.stdout.write(f"{'kind':<16}{'trials':>7}{'killed':>8}{'exact':>7}{'refused':>9}{'lost':>6}\n")
    for kind in args.kind or KINDS:
        words, names = KINDS[kind]
        folder = Path(tempfile.mkdtemp(prefix="surromd-kills-"))
        began = time.monotonic()
        subprocess.run([args.command, *words], cwd=folder, check=True)
        span_s, reference = time.monotonic() - began, whole([folder / name for name in names])
        shutil.rmtree(folder)
        counts, killed = Counter[str](), 0
        for _ in range(args.trials):
            least = 0.1 if names else 0.02
            outcome, alive = trial([args.command, *words], names, reference, rng.uniform(least, 1.0) * span_s)
            counts[outcome.partition(":")[0]] += 1
            killed += alive
            if outcome.startswith("lost"):
                sys.stdout.write(f"    {outcome}\n")
        lost += counts["lost"]
        sys.stdout.write(f"{kind:<16}{args.trials:>7}{killed:>8}{counts['exact']:>7}{counts['refused']:>9}"
                         f"{counts['lost']:>6}\n")  # fmt: skip
        sys.stdout.flush()
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
