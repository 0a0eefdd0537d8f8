"""What a feedback controller is: a state, and one step per sample."""

import abc
from typing import TYPE_CHECKING, Any, Self

import equinox as eqx
from jaxtyping import Array, Complex, Float


class AbstractController(eqx.Module):
    """A discrete feedback controller that adds its voltage to a feedforward.

    The paper's Eq. (23), (24) and (32) leave the feedforward out of the total control (erratum 28). Here a controller
    is given it at every step: only who knows the whole command can keep it within its limits without winding up.

    Attributes
    ----------
    interval_s
        Between two samples.
    """

    if TYPE_CHECKING:
        # A checker takes abstract fields for fields of a dataclass and complains of their order.
        @property
        def interval_s(self) -> Float[Array, ""]: ...
    else:
        interval_s: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def init(self, rest_um: Float[Array, ""] | float = 0.0, feedback_V: Float[Array, ""] | float = 0.0) -> Any:
        """State before the first sample, at rest.

        Parameters
        ----------
        rest_um
            Where the stage stood, which was also the reference.
        feedback_V
            What the controller added to the feedforward to keep it there.
        """

    @abc.abstractmethod
    def step(
        self,
        state: Any,
        reference_um: Float[Array, ""],
        measured_um: Float[Array, ""],
        feedforward_V: Float[Array, ""] | float = 0.0,
    ) -> tuple[Any, Float[Array, ""]]:
        """Choose the command until the next sample.

        Parameters
        ----------
        state
            From `init` or the step before.
        reference_um, measured_um
            Wanted and measured displacement.
        feedforward_V
            What the command would be without feedback.

        Returns
        -------
        state, command_V
            The next state, and the whole command, feedforward included.
        """


class AbstractLinearController(AbstractController):
    """A controller that is linear but for its limits, so that the loop has margins."""

    @abc.abstractmethod
    def transfer(self, z: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Feedback per error, in V/um, at points of the z-plane; without limits."""

    @abc.abstractmethod
    def _unlimited(self) -> Self:
        """The same without limits."""

    @abc.abstractmethod
    def _driven(self, state: Any) -> Any:
        """State in which what nothing is ever added to is zero: it is a constant, and no pole of the loop."""
