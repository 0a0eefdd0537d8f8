"""Speed of `microid` as ratios to plain peers, measured side by side in one process.

Usage: `python benchmarks/run.py [--quick] [--markdown] [--seed S] [ROW ...]`, with rows `forward`, `gradient`,
`levels`, `fit`, `record`, `plant`, `inverse`, `frequency`, `sensitivity`, `control`, `sweep` and `cold`; all by
default. Times are CPU seconds on one thread. The absolute ones depend on the machine and what else it does; the
ratios are medians of measurements that took turns.
"""

import argparse
import os
import platform
from importlib.metadata import version


def main() -> None:
    # Before NumPy and JAX are imported: they make their thread pools then.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC"):
        os.environ[name] = "1"
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"

    import jax

    jax.config.update("jax_enable_x64", True)

    from _rows import ROWS, Settings
    from _timing import Table

    parser = argparse.ArgumentParser(description="Ratios to plain peers, measured side by side.")
    parser.add_argument("rows", metavar="ROW", nargs="*", help=f"some of {', '.join(ROWS)}; all by default")
    parser.add_argument("--quick", action="store_true", help="shorter inputs, and without the slowest peers")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")
    parser.add_argument("--seed", type=int, default=0, help="of densities, voltages and noise (default 0)")
    options = parser.parse_args()
    unknown = sorted(set(options.rows) - set(ROWS))
    if unknown:
        parser.error(f"there is no row {unknown[0]!r}: choose some of {', '.join(ROWS)}")

    packages = ("jax", "equinox", "optimistix", "numpy", "scipy")
    print(f"Python {platform.python_version()}, {', '.join(f'{name} {version(name)}' for name in packages)}")
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    print(f"{platform.machine()}, {os.cpu_count()} cores, load {load}, one thread, seed {options.seed}\n")
    table = Table(options.markdown)
    table.head()
    for name in options.rows or ROWS:
        ROWS[name](Settings(options.seed, options.quick), table)


if __name__ == "__main__":
    main()
