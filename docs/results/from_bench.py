"""Make a table of the manual of what a benchmark wrote: `python docs/results/from_bench.py NAME FILE.json`.

NAME is `reference_speed` (FILE of `python docs/studies/reference/md_speed.py -o FILE`), `cost_error` or
`effective_samples` (FILE of `surromd bench cost-error`) or `peptide_lags` (FILE lag.json of
`python docs/studies/training/peptide_gates.py lag`). The table goes to docs/results/tables/NAME.json with the machine
that the benchmark names, and replaces the one there.
"""

from __future__ import annotations

import json
import math
import sys
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path
from typing import Any

TABLES = Path(__file__).resolve().parent / "tables"


def reference_speed(measured: dict[str, Any]) -> dict[str, Any]:
    """Return the table of our OpenMM set-up against the plain one: speeds of all cores together and their ratio."""
    by_case: dict[tuple[int, str], dict[str, Any]] = {}
    for row in measured["rows"]:
        by_case.setdefault((row["n_atoms"], row["case"]), {})[row["solvent"]] = row
    solvents = list(dict.fromkeys(row["solvent"] for row in measured["rows"]))
    rows = []
    for (n_atoms, case), found in sorted(by_case.items()):
        cells = [f"{n_atoms:,} ({case})"]
        for solvent in solvents:
            row = found.get(solvent)
            cells += ["", ""] if row is None else [f"{significant(row['ns_per_day']['ours'])}", spread(row["ratio"])]
        rows.append(cells)
    heads = [head for solvent in solvents for head in (f"{solvent}: ours, ns/day", "ratio")]
    return {
        "command": "python docs/studies/reference/md_speed.py",
        "machine": f"{measured['machine']['name']}, {measured['machine']['cores_used']} cores used",
        "note": f"Medians of {measured['rounds']} rounds, least and greatest in brackets; time step 2 fs.",
        "columns": ["atoms", *heads],
        "rows": rows,
    }


def cost_error(measured: dict[str, Any]) -> dict[str, Any]:
    """Return the table of run time against error: the settings that no other of the same weights is better than."""
    config, md = measured["config"], measured["md"]
    names = list(dict.fromkeys(row["weights"] for row in measured["rows"]))
    rows = []
    for row in _unbeaten(measured["rows"]):
        solver, _, rest = row["label"].partition(" ")
        same = row["md_of_same_seconds"]
        valid = [row[key]["value"] for key in ("valid_half_angstrom_%", "bonds_20_percent_%")]
        rows.append(
            [
                f"{row['weights']}: `{solver}`, {rest}" if len(names) > 1 else f"`{solver}`, {rest}",
                significant(row["cpu_s_per_ns"]["mean"]),
                interval(row["jsd"]),
                f"> {md['errors'][0]:.2f}" if same is None else f"{same:.2f}",
                row["equivalent_time"]["words"],
                f"{row['times_faster']:.1f}",
                " / ".join(f"{value:.2f}" for value in valid),
            ]
        )
    heads = [
        "solver, steps",
        "s/ns",
        "distance",
        "MD, same seconds",
        "equivalent MD time",
        "times faster",
        "0.5 Å / 20 %",
    ]
    return {
        "command": _asked(measured),
        "machine": measured["machine"]["name"],
        "note": f"{1e-3 * config['time_ps']:g} ns at each setting, against two held-out runs of "
        f"{1e-3 * md['length_ps']:g} ns, which are {md['replicate_baseline']:.3f} apart; "
        f"{config['threads']} thread(s). Settings that another of the same weights beats in time and distance are "
        "left out.",
        "columns": heads,
        "rows": rows,
    }


def effective_samples(measured: dict[str, Any]) -> dict[str, Any]:
    """Return the table of effective samples a processor second, of MD and of the same settings as `cost_error`."""
    md, slow = measured["md"], measured["md"]["slowest"]
    ns = 1e-3 * min(measured["config"]["time_ps"], md["lengths_ps"][-1])
    near = math.exp(_between(math.log(1e3 * ns), [math.log(x) for x in md["lengths_ps"]], md["errors"]))
    rates = {cost["label"]: 1e3 / cost["cpu_s_per_ns"]["mean"] / (2.0 * slow["tau_ps"]) for cost in md["cost"]}
    best = max(rates[cost["label"]] for cost in md["cost"] if cost["way"] != "simd")
    rows = [[name, significant(rate), significant(rate / best), f"{near:.3f}"] for name, rate in rates.items()]
    for row in (row for row in _unbeaten(measured["rows"]) if row.get("effective_per_s")):
        rate = row["effective_per_s"]
        rows.append(
            [f"{row['weights']}, {row['label']}", significant(rate), significant(rate / best), interval(row["jsd"])]
        )
    return {
        "command": _asked(measured),
        "machine": measured["machine"].get("about", measured["machine"]["name"]),
        "note": f"Simulated time over 2 max(τ, τ of MD) of {slow['name']} ({slow['tau_ps']:.1f} ps in MD), a processor "
        f"second; distances of φ/ψ maps after {ns:g} ns.",
        "columns": ["what", "effective samples/s", "over OpenMM at its fastest", "distance"],
        "rows": rows,
    }


def _unbeaten(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the settings that were evaluated and that no other of the same weights beats in time and distance."""
    done = [(row["weights"], row["cpu_s_per_ns"]["mean"], row["jsd"]["value"], row) for row in rows if "jsd" in row]
    return [
        row
        for name, seconds, distance, row in done
        if not any(n == name and s < seconds and d < distance for n, s, d, _ in done)
    ]


def _asked(measured: dict[str, Any]) -> str:
    """Return the command of a benchmark of run time against error."""
    names = dict.fromkeys(f"--weights {row['weights']}" for row in measured["rows"])
    lag_ps, ns = measured["config"]["lag_ps"], 1e-3 * measured["config"]["time_ps"]
    lag = [f"--lag {lag_ps:g}ps"] if lag_ps else []
    steps = [f"--steps {n}" for n in sorted({row["steps"] for row in measured["rows"] if "steps" in row})]
    return " ".join(["surromd bench cost-error HELD1 HELD2", *names, *lag, f"--time {ns:g}ns", *steps])


def _between(x: float, known: list[float], errors: list[float]) -> float:
    """Return the logarithm of the error at `x`, linear between those known."""
    at = min(max(bisect_left(known, x), 1), len(known) - 1)
    share = (x - known[at - 1]) / (known[at] - known[at - 1])
    return (1 - share) * math.log(errors[at - 1]) + share * math.log(errors[at])


def peptide_lags(measured: dict[str, Any]) -> dict[str, Any]:
    """Return the table of a model of peptides started from held-out frames, at each lag."""
    rows = [
        [
            f"{row['lag_ps']:g}",
            row["source"],
            f"{100 * row['valid']:.2f}",
            f"{row['jsd']:.3f}",
            *(f"{row[key]:.2f} ± {(1 - row[key] ** 2) / row['starts'] ** 0.5:.2f}" for key in ("psi", "phi")),
        ]
        for row in measured["rows"]
    ]
    steps, halves = measured["ten steps against one"], measured["halves of MD"]
    return {
        "command": "python docs/studies/training/peptide_gates.py lag FOLDER --train REF... --test REF...",
        "machine": "none is timed here",
        "note": f"Ten steps of 10 ps lie {steps:.3f} from one of 100 ps in the joint φ/ψ map, two halves of MD from "
        f"the same starts {halves:.3f} (Chapman and Kolmogorov's test).",
        "columns": ["lag, ps", "frames of", "valid, %", "joint φ/ψ JSD", "cos ψ one lag later", "cos φ one lag later"],
        "rows": rows,
    }


def significant(speed: float) -> str:
    """Return a speed with four digits at most: 122,100, 59.7."""
    return f"{float(f'{speed:.4g}'):,.0f}" if speed >= 1000 else f"{speed:.3g}"


def spread(ratio: list[float]) -> str:
    """Return a median with the least and the greatest."""
    return f"{ratio[0]:.1f} [{ratio[1]:.1f}, {ratio[2]:.1f}]"


def interval(found: dict[str, Any]) -> str:
    """Return a value with its 95 % interval, where it has one."""
    if found["low"] is None or found["high"] is None:
        return f"{found['value']:.3f}"
    return f"{found['value']:.3f} [{found['low']:.3f}, {found['high']:.3f}]"


KINDS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "reference_speed": reference_speed,
    "cost_error": cost_error,
    "effective_samples": effective_samples,
    "peptide_lags": peptide_lags,
}


def table_text(record: dict[str, Any]) -> str:
    """Return a table's JSON, a row a line."""
    others = [(key, value) for key, value in record.items() if key != "rows"]
    head = [f' "{key}": {json.dumps(value, ensure_ascii=False)}' for key, value in others]
    rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in record["rows"])
    return "{\n" + ",\n".join(head) + f',\n "rows": [\n{rows}\n ]\n}}\n'


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in KINDS:
        sys.exit(f"usage: python docs/results/from_bench.py {{{','.join(KINDS)}}} FILE.json")
    made = KINDS[sys.argv[1]](json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")))
    (TABLES / f"{sys.argv[1]}.json").write_text(table_text(made), encoding="utf-8")
