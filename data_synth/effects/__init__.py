"""Effects that a stage can hide: each a plain function from what is at its place in the chain to what it becomes.

A new effect is one function under `data_synth._effect.effect` in any file of this folder: that enters it into the
registry, and its keyword arguments are the keys of its TOML table `[[effects]]`.
"""

import importlib
import pkgutil

from data_synth._effect import REGISTRY

for _found in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_found.name}")

EFFECTS: tuple[str, ...] = tuple(sorted(name for name, entry in REGISTRY.items() if not (entry.outside or entry.own)))
"""Effects that a library of diagnoses knows by these names."""

OUTSIDE: tuple[str, ...] = tuple(sorted(name for name, entry in REGISTRY.items() if entry.outside))
"""Effects that no such library holds: of them a diagnosis should say that they are unexplained."""
