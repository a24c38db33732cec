"""The installed command killed outright (`kill -9`) at random moments, and gone on with: is it the same file?

    python docs/studies/reference/kills.py [--trials 14] [--command surromd] [--seed 0]

Each kind of run is made once undisturbed. Then, `--trials` times, it is started anew, killed with all that descends
from it after a random part of that time, and started again with `--resume` until it ends. Printed is a table: exact
(all that the finished file holds is that of the undisturbed run), refused (one line, nothing changed), lost (anything
else).
"""

from __future__ import annotations

import argparse
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

REPOSITORY = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(REPOSITORY))

from systems.trajectory.codec import open_trajectory  # noqa: E402

MD = ["reference", "alanine-dipeptide", "--time", "40ps", "--save-every", "100fs", "--equilibrate", "2ps", "--platform",
      "Reference", "--seed", "3", "--quiet"]  # fmt: skip
ROLLOUT = ["rollout", "alanine-dipeptide", "--weights", "alanine-dipeptide", "--time", "2ns", "--precision", "fp32",
           "--seed", "1", "--quiet"]  # fmt: skip
KINDS = {
    "reference .h5": ([*MD, "-o", "a.h5"], ["a.h5"]),
    "reference .dcd": ([*MD, "-o", "a.dcd"], ["a.dcd"]),
    "reference x 2": ([*MD, "--replicas", "2", "-o", "a.h5"], ["a_r0.h5", "a_r1.h5"]),
    "rollout .h5": ([*ROLLOUT, "-o", "a.h5"], ["a.h5"]),
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


def start(command: list[str], folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                            start_new_session=True)  # fmt: skip


def trial(command: list[str], names: list[str], truth: list[bytes], after_s: float) -> tuple[str, bool]:
    """Return the outcome, and whether the run was still going when it was killed."""
    folder = Path(tempfile.mkdtemp(prefix="surromd-kills-"))
    try:
        process = start(command, folder)
        time.sleep(after_s)
        alive = process.poll() is None
        if alive:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        before = {path: path.read_bytes() for path in folder.iterdir()}
        again = start([*command, "--resume"], folder)
        _, said = again.communicate()
        if again.returncode:
            same = {path: path.read_bytes() for path in folder.iterdir()} == before
            return ("refused" if same and len(said.splitlines()) == 1 else f"lost: {said.strip()}"), alive
        return ("exact" if whole([folder / name for name in names]) == truth else "lost: other frames"), alive
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
        span_s, truth = time.monotonic() - began, whole([folder / name for name in names])
        shutil.rmtree(folder)
        counts, killed = Counter[str](), 0
        for _ in range(args.trials):
            outcome, alive = trial([args.command, *words], names, truth, rng.uniform(0.1, 1.0) * span_s)
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
