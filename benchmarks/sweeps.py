"""What a sweep costs beside its kernels: chunks, memory, workers and their scheduler.

Usage: `python benchmarks/sweeps.py [--rows N]`. Prints the figures of `benchmarks/sweeps.md`; times are wall clock.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
SWEEP = """
schema = "microid.sweep/1"
kind = "simulate"
seed = 1
[program]
shape = "sine"
samples = {samples}
interval_s = 1e-3
offset_V = 60.0
amplitude_V = 50.0
frequency_Hz = 20.0
[design]
method = "random"
rows = {rows}
[[axis]]
parameter = "mechanics.damping_ratio"
low = 0.01
high = 0.1
[[axis]]
parameter = "mechanics.natural_frequency_Hz"
low = 100.0
high = 400.0
[run]
{run}
"""


def one(rows: int, samples: int, cluster: str | None, run: str) -> dict[str, float]:
    """Run a sweep in this process and say what it took."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from fits.sweeps._run import run_sweep
    from fits.sweeps._spec import parse_sweep

    def named(count: int) -> str:
        return SWEEP.format(rows=count, samples=samples, run=run)

    with tempfile.TemporaryDirectory() as folder:
        first = parse_sweep(named(600), "sweep.toml", lambda _: b"")
        run_sweep(first, f"{folder}/first")
        sweep = parse_sweep(named(rows), "sweep.toml", lambda _: b"")
        began = time.perf_counter()
        outcome = run_sweep(sweep, f"{folder}/out", cluster=cluster)
        taken = time.perf_counter() - began
        began = time.perf_counter()
        run_sweep(sweep, f"{folder}/out", resume=True)
        checked = time.perf_counter() - began
        size = sum(path.stat().st_size for path in Path(folder, "out").rglob("*") if path.is_file())
    peak_MB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    assert outcome.failed == 0
    return {"seconds": taken, "resume_s": checked, "peak_MB": peak_MB, "bytes_per_row": size / rows}


def apart(*arguments: object) -> dict[str, float]:
    """The same in a process of its own."""
    command = [sys.executable, __file__, "--one", json.dumps(arguments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def workers(rows: int = 16384, samples: int = 4000, turns: int = 5) -> list[float]:
    """Time of one local worker over that of two, both started and warm, in turn."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from fits.sweeps._cluster import connected
    from fits.sweeps._run import run_sweep
    from fits.sweeps._spec import parse_sweep

    sweep = parse_sweep(SWEEP.format(rows=rows, samples=samples, run="chunk_rows = 512"), "sweep.toml", lambda _: b"")
    with tempfile.TemporaryDirectory() as folder, connected("local:1") as one, connected("local:2") as two:
        places = {"one": one.scheduler.address, "two": two.scheduler.address}
        taken: dict[str, list[float]] = {name: [] for name in places}
        for turn in range(turns + 1):
            for name, address in places.items():
                began = time.perf_counter()
                run_sweep(sweep, f"{folder}/{name}{turn}", cluster=address)
                taken[name].append(time.perf_counter() - began)
    # The first turn compiles.
    return [alone / both for alone, both in zip(taken["one"][1:], taken["two"][1:], strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description="Costs of a sweep beside its kernels.")
    parser.add_argument("--rows", type=int, default=1_000_000, help="of the largest sweep (default 1e6)")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(*json.loads(options.one))))
        return
    for rows in (1000, 30_000, options.rows):
        found = apart(rows, 16, None, "")
        print(f"memory, {rows:>9,} rows of 16 samples: {found}", flush=True)
    for size in (256, 8192):
        found = apart(32768, 16, None, f"chunk_rows = {size}")
        print(f"chunks of {size}, 32768 rows of 16 samples: {found}", flush=True)
    for cluster in (None, "local:1"):
        found = apart(16384, 1000, cluster, "chunk_rows = 1024")
        print(f"{cluster or 'in process'}, 16384 rows of 1000 samples: {found}", flush=True)
    ratios = workers()
    print(f"two workers over one, in turn: {[round(ratio, 2) for ratio in ratios]}", flush=True)
    found = apart(32768, 16, "local:1", "chunk_rows = 256")
    print(f"local:1, 128 chunks of 256 rows of 16 samples: {found}", flush=True)


if __name__ == "__main__":
    main()
