"""PID controller beside a table that learns to do its work (Eq. 31-33)."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from microid._param import array, param
from microid.control._base import AbstractController, ControlledPlant, ControlTask, Setting, register
from microid.control.pid import PID

_Scalar = Float[Array, ""] | float
# Knuth's multiplicative hashing: 2**32 over the golden ratio.
_SPREAD = 2654435761
# A table holds this share of the reference's voltage, and its range is wider than the reference's by these.
_TABLE, _ASIDE, _FASTER = 0.5, 0.02, 1.02


class _State(eqx.Module):
    pid: Any
    weights_V: Float[Array, "c cells"]
    before_um: Float[Array, ""]
    rest_V: Float[Array, ""]


def _lower_um(task: ControlTask) -> float:
    reference = task.reference_um()
    return float(reference.min() - _ASIDE * max(np.ptp(reference), 1e-9))


def _upper_um(task: ControlTask) -> float:
    reference = task.reference_um()
    return float(reference.max() + _ASIDE * max(np.ptp(reference), 1e-9))


def _fastest_um_per_s(task: ControlTask) -> float:
    return float(_FASTER * np.abs(np.diff(task.reference_um())).max() / task.interval_s + 1e-9)


def _limit_V(task: ControlTask) -> float:
    return _TABLE * max(float(np.ptp(task.static_V())), 1e-6)


@register
class CMACPID(AbstractController):
    r"""Cerebellar model articulation controller in parallel with a PID controller.

    .. math:: u = u_{ff} + u_n + u_p, \qquad u_n = \sum_{i=1}^{c} w_i, \qquad
        w_i \leftarrow w_i + \eta\, (u - u_{ff} - u_n) / c

    The sum runs over the `c` cells that the quantised inputs address, one in each of `c` tables shifted against each
    other by one quantum (Albus 1975). So inputs one quantum apart share all cells but one. The inputs are the
    reference and its rate, of which the paper says nothing: by the rate, rising and falling branches of a hysteresis
    are told apart. The table learns what the PID controller had to add (Eq. 33), until nothing is left to add.

    `c` of Eq. (31) and `χ` of Eq. (33) are both the generalisation (erratum 31); Eq. (33), whose index `i` is free,
    holds for every addressed cell (erratum 32); the feedforward is part of the command and not learnt (erratum 28).
    `u` is the command as the limits leave it, so the table learns nothing beyond them.

    Differentiable in the PID controller's gains, the learning rate and the readings; not in the reference as far as
    it addresses cells, nor in the ranges: addresses are whole numbers.

    Attributes
    ----------
    pid
        Its limits are those of the whole command.
    lower_um, upper_um
        Range of the reference; beyond it, the outermost cells answer.
    fastest_um_per_s
        Range of its rate to either side.
    learning_rate
        `η`, of 0 to 2: at 1 a cell forgets all it held for the present input.
    limit_V
        The table never adds more than this to either side: each weight stays within its `c`-th part.
    levels
        Quanta of the reference and of its rate; with one of the rate, the rate is not looked at.
    generalisation
        Number `c` of cells per input.
    memory
        Cells per table, into which addresses are hashed; by default as many as there are addresses.
    """

    settings: ClassVar[tuple[Setting, ...]] = (
        *PID.settings,
        Setting("learning_rate", default=0.1),
        Setting("limit_V", "V", lower=0.0, default=_limit_V),
        Setting("lower_um", "um", default=_lower_um, varies=False),
        Setting("upper_um", "um", default=_upper_um, varies=False),
        Setting("fastest_um_per_s", "um/s", lower=1e-9, default=_fastest_um_per_s, varies=False),
    )
    own: ClassVar[tuple[str, ...]] = ("learning_rate",)
    learns: ClassVar[bool] = True
    pid: PID
    lower_um: Float[Array, ""] = array()
    upper_um: Float[Array, ""] = array()
    fastest_um_per_s: Float[Array, ""] = array()
    learning_rate: Float[Array, ""] = param(unit="1", scale=0.1, lower=0.0, upper=2.0)
    limit_V: Float[Array, ""] = array()
    levels: tuple[int, int] = eqx.field(static=True, default=(128, 2))
    generalisation: int = eqx.field(static=True, default=8)
    memory: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        """Refuse tables without cells."""
        if min(*self.levels, self.generalisation, 1 if self.memory is None else self.memory) < 1:
            raise ValueError(
                f"levels, generalisation and memory must be 1 or more, got {self.levels}, {self.generalisation} "
                f"and {self.memory}"
            )

    @classmethod
    def of(cls, pid: PID, numbers: Mapping[str, Any], plant: ControlledPlant | None) -> Self:
        """Put an empty table beside a PID controller."""
        return cls(pid, **numbers)

    def linear(self) -> PID:
        """Its PID controller, as the table is empty at first."""
        return self.pid

    @property
    def interval_s(self) -> Float[Array, ""]:
        """Between two samples."""
        return self.pid.interval_s

    @property
    def cells(self) -> int:
        """Number of cells per table."""
        across, along = self._shape
        return across * along if self.memory is None else self.memory

    @property
    def _shape(self) -> tuple[int, int]:
        first, second = ((count + self.generalisation - 2) // self.generalisation + 1 for count in self.levels)
        return first, second

    def init(self, rest_um: _Scalar = 0.0, feedback_V: _Scalar = 0.0) -> _State:
        """State at rest: that of the PID controller, an empty table, the last reference and the feedback.

        That feedback stays a constant beside the two, so that the table does not learn what held the stage before.
        """
        empty = jnp.zeros((self.generalisation, self.cells), self.limit_V.dtype)
        zero = jnp.zeros_like(self.limit_V)
        return _State(self.pid.init(rest_um), empty, zero + rest_um, zero + feedback_V)

    def addresses(self, reference_um: Float[Array, ""], rate_um_per_s: Float[Array, ""]) -> Int[Array, " c"]:
        """The cell that an input addresses in each table, shape `(c,)`."""
        across = _quantum(reference_um, self.lower_um, self.upper_um, self.levels[0])
        along = _quantum(rate_um_per_s, -self.fastest_um_per_s, self.fastest_um_per_s, self.levels[1])
        shift = jnp.arange(self.generalisation, dtype=jnp.int32)
        address = (across + shift) // self.generalisation * self._shape[1] + (along + shift) // self.generalisation
        if self.memory is None:
            return address
        mixed = address.astype(jnp.uint32) * jnp.uint32(_SPREAD)
        # The high bits are the mixed ones.
        return ((mixed >> 16) % jnp.uint32(self.memory)).astype(jnp.int32)

    def step(
        self,
        state: _State,
        reference_um: Float[Array, ""],
        measured_um: Float[Array, ""],
        feedforward_V: _Scalar = 0.0,
    ) -> tuple[_State, Float[Array, ""]]:
        """Choose the command, then learn from what the PID controller added; see `AbstractController.step`."""
        rate = (reference_um - state.before_um) / self.interval_s
        place = jnp.arange(self.generalisation, dtype=jnp.int32), self.addresses(reference_um, rate)
        weights = state.weights_V[place]
        known = feedforward_V + state.rest_V + jnp.sum(weights)
        pid, command = self.pid.step(state.pid, reference_um, measured_um, known)
        most = self.limit_V / self.generalisation
        learnt = jnp.clip(weights + self.learning_rate * (command - known) / self.generalisation, -most, most)
        return _State(pid, state.weights_V.at[place].set(learnt), reference_um, state.rest_V), command


def _quantum(
    value: Float[Array, ""], lower: Float[Array, ""], upper: Float[Array, ""], levels: int
) -> Int[Array, ""]:
    share = lax.stop_gradient((value - lower) / (upper - lower))
    return jnp.clip(jnp.floor(share * levels), 0, levels - 1).astype(jnp.int32)
