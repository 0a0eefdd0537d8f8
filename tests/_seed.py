"""Seeds of tests: fixed by default, so that a red test is a fault and not chance."""

import os
import secrets
import zlib


def seed_of(name: str) -> int:
    """Give the seed of a test, and print it.

    By default it is made from the test's name and the same in every run. ``MICROID_SEED=fresh`` draws a new one, as
    studies do; a number replays that one.
    """
    asked = os.environ.get("MICROID_SEED", "")
    if asked == "fresh":
        value = secrets.randbelow(2**31)
    elif asked:
        value = int(asked)
    else:
        value = zlib.crc32(name.encode()) >> 1
    print(f"replay with MICROID_SEED={value}")
    return value
