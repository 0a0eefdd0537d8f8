"""Sources of plug-ins that `test_plugins.py` drops into place."""

DENSITY = '''
    """A density that is the same everywhere."""
    from typing import ClassVar, Self
    import jax.numpy as jnp
    from jaxtyping import Array, Float, PRNGKeyArray
    from microid._param import array, param, static
    from microid.densities._base import AbstractDensity, register

    @register
    class FlatDensity(AbstractDensity):
        """One number."""
        family: ClassVar[str] = "flat"
        weight_um: Float[Array, ""] = param(unit="um", scale=10.0, lower=0.0)
        lower_V: Float[Array, ""] = array()
        upper_V: Float[Array, ""] = array()
        levels: int = static()

        def nodes_um_per_V2(self):
            area = (self.upper_V - self.lower_V) ** 2 / 2
            return self.weight_um / area * jnp.tril(jnp.ones((self.levels, self.levels)))

        @classmethod
        def start(cls, lower_V, upper_V, levels, stroke_um, key):
            return cls(jnp.asarray(stroke_um), lower_V, upper_V, levels)
'''
LAW = '''
    """A spring: no hysteresis at all."""
    import jax.numpy as jnp
    from jaxtyping import Array, Float
    from microid._param import param
    from microid._part import AbstractHysteresis
    from microid.hysteresis._base import register

    @register
    class Spring(AbstractHysteresis):
        """Proportional."""
        slope_um_per_V: Float[Array, ""] = param(unit="um/V", scale=0.1, lower=0.0)
        offset_um: Float[Array, ""] = param(unit="um", scale=10.0, default=0.0)

        def __call__(self, voltage_V, start=None):
            return self.slope_um_per_V * voltage_V + self.offset_um
'''
EFFECT = '''
    """A sensor that shows so many times the displacement."""
    from typing import ClassVar
    import jax.numpy as jnp
    from jaxtyping import Array, Float
    from microid._param import param
    from microid._part import Signal
    from microid.effects._base import AbstractEffect, Place, View, register

    @register
    class WrongGain(AbstractEffect):
        """A factor."""
        name: ClassVar[str] = "wrong_gain"
        takes: ClassVar[str] = "um"
        gives: ClassVar[str] = "um"
        place: ClassVar[Place] = "sensor"
        strength: ClassVar[tuple[str, ...]] = ("excess",)
        fingerprint: ClassVar[str] = "The residual is proportional to the displacement."
        confusions: ClassVar[tuple[str, ...]] = ()
        experiment: ClassVar[str] = "A reference sensor."
        source: ClassVar[str] = "a test"
        view: ClassVar[View] = "position"
        column: ClassVar[str] = "gauge_um: a second sensor."
        excess: Float[Array, ""] = param(unit="1", scale=1e-2)

        @classmethod
        def probes(cls, scales, inner):
            return ((cls(jnp.asarray(1e-3)),),)

        def run(self, time_s, signal, start=None):
            grow = 1 + self.excess
            return Signal(grow * signal.values, grow * signal.before, signal.hold)
'''
COLUMN = '''
    """Humidity of the air."""
    from fits.io._quantity import Quantity
    from fits.io.columns._base import Column, register

    def recognised(name, values, record):
        return name.lower().startswith("hum")

    def cleaned(values, record):
        return values - values[0]

    register(Column(Quantity("humidity", "pct", {"pct": 0, "permille": -1}), "", recognised, cleaned))
'''
