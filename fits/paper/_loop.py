"""Controllers against the virtual bench of `data_synth`: NumPy on one side, compiled steps on the other."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from data_synth import PaperBench
from microid.control import AbstractController


@dataclass(frozen=True, eq=False)
class PaperRun:
    """What happened on the benches, each of shape `(benches, n)` but for the reference, `(n,)`.

    The displacement is the true one at the sample, and the command is held from there to the next.
    """

    reference_um: np.ndarray
    displacement_um: np.ndarray
    reading_um: np.ndarray
    command_V: np.ndarray

    def last(self, samples: int) -> "PaperRun":
        """The end of it."""
        runs = self.displacement_um, self.reading_um, self.command_V
        return PaperRun(self.reference_um[-samples:], *(values[:, -samples:] for values in runs))


@functools.cache
def _compiled(controllers: Any, states: Any) -> Callable[..., Any]:
    """One step of controllers and states of these structures, from and to their bare arrays.

    Calls of compiled functions are many here, and modules take longer to take apart than a step takes.
    """

    @jax.jit
    def advance(held: Any, before: Any, signals: Any) -> tuple[Any, Any]:
        def one(held: Any, before: Any, signals: Any) -> tuple[Any, Any]:
            controller = jax.tree.unflatten(controllers, held)
            state, command = controller.step(jax.tree.unflatten(states, before), signals[0], signals[1], signals[2])
            return jax.tree.leaves(state), command

        return jax.vmap(one)(held, before, signals)

    return advance


def stacked(make: Callable[[int], AbstractController], count: int) -> AbstractController:
    """Controllers that differ in their numbers only, as one whose arrays have a first axis more."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(make(k) for k in range(count)))


def run_feedback(
    controllers: AbstractController,
    bench: PaperBench,
    reference_um: np.ndarray,
    feedforward_V: np.ndarray,
    shown_um: np.ndarray | None = None,
) -> PaperRun:
    """Run closed loops on benches side by side; the controllers come from `stacked`.

    The reference has shape `(n,)`; feedforward, and the reference as the controllers are shown it if that differs,
    have shape `(benches, n)`.
    """
    shown = np.broadcast_to(reference_um, feedforward_V.shape) if shown_um is None else shown_um
    states, form = jax.tree.flatten(eqx.filter_jit(eqx.filter_vmap(lambda one: one.init()))(controllers))
    held, kind = jax.tree.flatten(controllers)
    advance = _compiled(kind, form)
    now = bench.reset()
    visited, commands = [], []
    for wanted, lead in zip(shown.T, feedforward_V.T, strict=True):
        states, command = advance(held, states, np.stack([wanted, now[1], lead], axis=1))
        visited.append(now)
        commands.append(np.asarray(command))
        now = bench.step(commands[-1])
    displacement_um, reading_um = (np.stack(values, axis=1) for values in zip(*visited, strict=True))
    return PaperRun(reference_um, displacement_um, reading_um, np.stack(commands, axis=1))
