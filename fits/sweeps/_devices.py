"""Which device computes a block: blocks go round all local ones."""

from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray


def on_cpu() -> bool:
    """Whether the devices are CPUs."""
    return jax.default_backend() == "cpu"


def device_count() -> int:
    """Number of local devices."""
    return jax.local_device_count()


def device_of(rows: NDArray[np.int64]) -> Any:
    """The local device that computes a block, which its first row chooses."""
    devices = jax.local_devices()
    return devices[int(rows[0]) // max(1, len(rows)) % len(devices)]
