"""The voltage at the piezo, as the amplifier's monitor shows it."""

from fits.io._quantity import VOLTAGE, Quantity
from fits.io.columns._base import Column, register

register(
    Column(
        Quantity("drive_monitor", "V", VOLTAGE),
        use="the voltage at the piezo, sampled with the displacement, which shows what the driver does and "
        "nothing of the sensor.",
    )
)
