"""Fit one record in a process of its own: what the first fit costs, and how much memory.

Usage: `python _first_fit.py FILE.npz`, with arrays `voltage_V` and `displacement_um`. Prints one line of JSON.
"""

import json
import resource
import sys
import time
from pathlib import Path


def main(file: str) -> None:
    start_s, start_cpu_s = time.perf_counter(), time.process_time()

    import jax
    import numpy as np

    from fits import Record, fit

    imported_s = time.perf_counter() - start_s
    jax.config.update("jax_enable_x64", True)
    with np.load(file) as arrays:
        voltage_V, displacement_um = arrays["voltage_V"], arrays["displacement_um"]
    record = Record(np.arange(float(len(voltage_V))), voltage_V, displacement_um)
    fit([record], holdout=0.0, initial="negative")
    first_s, first_cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    print(json.dumps({"import_s": imported_s, "first_s": first_s, "first_cpu_s": first_cpu_s, "peak_GB": _peak_GB()}))


def _peak_GB() -> float:
    # On Linux a process inherits its parent's ru_maxrss; the high-water mark of its own memory starts afresh.
    status = Path("/proc/self/status")
    if status.exists():
        marks = [line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM:")]
        return int(marks[0]) * 1024 / 1e9
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


if __name__ == "__main__":
    main(sys.argv[1])
