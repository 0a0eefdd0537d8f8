"""The command `python -m data_synth SCENARIO OUT [--seed S]`."""

import argparse
import sys
from collections.abc import Sequence

from data_synth import ScenarioError, load_scenario, scenario_names, simulate, write


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate a scenario and write its records; 0, or 2 after a sentence on stderr."""
    parser = argparse.ArgumentParser(prog="python -m data_synth", description="Measure on a virtual bench.")
    parser.add_argument(
        "scenario", metavar="SCENARIO", help=f"path to a .toml file, or one of {', '.join(scenario_names())}"
    )
    parser.add_argument("out", metavar="OUT", help="folder for the CSV files and truth.json")
    parser.add_argument("--seed", type=int, help="where all randomness starts, in the place of the scenario's")
    options = parser.parse_args(arguments)
    try:
        bench = simulate(load_scenario(options.scenario), options.seed)
        files = write(bench, options.out)
    except ScenarioError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"seed {bench.seed}")
    for file in files:
        print(file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
