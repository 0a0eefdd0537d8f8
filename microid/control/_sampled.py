"""A stage between two samples of a controller."""

import abc
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Hold, LinearSystem
from microid._param import _as_inexact
from microid._part import AbstractHysteresis, _links
from microid._stage import Stage, Start
from microid.control._hysteresis_step import _step_form


class AbstractPlant(eqx.Module):
    """What a controller acts upon: a state, and one step per sample."""

    @abc.abstractmethod
    def init(self, start: Start) -> tuple[Any, Float[Array, ""]]:
        """State and displacement in um at rest under `start.rest_V`, 0 V by default."""

    @abc.abstractmethod
    def step(self, state: Any, command_V: Float[Array, ""]) -> tuple[Any, Float[Array, ""]]:
        """State and displacement in um one interval later, right before the command changes again."""


class _LinearStep(eqx.Module):
    """A linear system from one sample to the next; its state is the last input and the deviation from rest."""

    step_matrix: Float[Array, "n n"]
    push: Float[Array, " n"]
    read: Float[Array, " n"]
    gain: Float[Array, ""]
    offset: Float[Array, ""]

    @classmethod
    def of(
        cls, system: LinearSystem, interval_s: Float[Array, ""], hold: Hold, settling_s: Float[Array, ""] | None
    ) -> Self:
        if system.order == 0:
            return cls(system.rate_per_s, system.rest, system.read, system.gain, system.offset)
        matrix, push = (x[..., 0] for x in system.advance(interval_s[None], hold, settling_s))
        # What a held input changes at once, the interval then lets decay.
        push = matrix @ push if hold == "zero" else push
        return cls(matrix, push, system.read, system.gain, system.offset)

    def init(self, before: Float[Array, ""], start: None) -> tuple[Any, Float[Array, ""]]:
        return (before, (jnp.zeros_like(before),) * self.read.shape[0]), self.offset + self.gain * before

    def step(self, state: Any, value: Float[Array, ""]) -> tuple[Any, Float[Array, ""]]:
        before, z = state
        move = value - before
        # Scalars: matrices of this size cost more to call than to multiply.
        z = tuple(
            sum((self.step_matrix[i, j] * z[j] for j in range(len(z))), start=-self.push[i] * move)
            for i in range(len(z))
        )
        level = self.offset + self.gain * value
        return (value, z), sum((self.read[i] * z[i] for i in range(len(z))), start=level)


class SampledStage(AbstractPlant):
    """A stage under a command that is held between samples.

    The linear parts are exact, by matrix exponentials that are computed once. A hysteresis sees the voltage at the
    samples and at the stage's `substeps` between them, as in `Stage` with `hold="zero"`; the displacements are those
    that such a stage gives for the whole record.

    Attributes
    ----------
    interval_s
        Between two samples.
    """

    interval_s: Float[Array, ""]
    _links: tuple[Any, ...]
    _substeps: int = eqx.field(static=True)

    def __init__(self, stage: Stage, interval_s: Float[Array, ""] | float):
        """Sample a stage.

        Parameters
        ----------
        stage
            Made of linear parts, and of a `Preisach` or a `PrandtlIshlinskii` if there is a hysteresis.
        interval_s
            Between two samples.

        Raises
        ------
        ValueError
            If a part has no form for single samples.
        """
        self.interval_s = _as_inexact(interval_s)
        self._substeps = stage.substeps
        links: list[Any] = []
        hold: Hold = "zero"
        settling_s = None
        names = {id(part): name for name, part in zip(stage.names, stage.parts, strict=True)}
        for link in _links(stage.parts):
            if isinstance(link, LinearSystem):
                links.append(_LinearStep.of(link, self.interval_s / stage.substeps, hold, settling_s))
                if link.order:
                    settling_s = -1 / link.rate_per_s[0, 0] if link.order == 1 and hold == "zero" else None
                    hold = "first"
            elif isinstance(link, AbstractHysteresis):
                links.append(_step_form(names[id(link)], link))
            else:
                raise ValueError(
                    f"{names[id(link)]!r} is a {type(link).__name__}, which has no form for single samples: "
                    "take it out of the stage"
                )
        self._links = tuple(links)

    def init(self, start: Start) -> tuple[Any, Float[Array, ""]]:
        """State and displacement in um at rest; see `AbstractPlant.init`."""
        value = jnp.zeros_like(self.interval_s) if start.rest_V is None else start.rest_V
        states = []
        for link in self._links:
            state, value = link.init(value, None if isinstance(link, _LinearStep) else start.memory)
            states.append(state)
        return tuple(states), value

    def step(self, state: Any, command_V: Float[Array, ""]) -> tuple[Any, Float[Array, ""]]:
        """State and displacement in um one interval later; see `AbstractPlant.step`."""

        def once(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            states, value = [], command_V
            for link, old in zip(self._links, carry[0], strict=True):
                new, value = link.step(old, value)
                states.append(new)
            return tuple(states), value

        return (
            lax.fori_loop(0, self._substeps, once, (state, command_V)) if self._substeps > 1 else once(0, (state, 0))
        )
