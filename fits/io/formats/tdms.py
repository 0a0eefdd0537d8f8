"""TDMS files of LabVIEW: channels in groups, with their units and the interval of their waveforms."""

import io
import logging
from collections import defaultdict
from dataclasses import replace

from fits.io._extras import need
from fits.io._table import Found, Table, gathered
from fits.io.formats._base import Format, register


def open_tdms(path: str, data: bytes) -> Table:
    """Read all channels of numbers and times of one length."""
    # What it says of damage goes to stderr, where a command has one sentence.
    need("nptdms.log", "io").log_manager.set_level(logging.CRITICAL)
    file = need("nptdms", "io").TdmsFile.read(io.BytesIO(data))
    found, intervals = list[Found](), defaultdict[int, set[float]](set)
    for group in file.groups():
        for channel in group.channels():
            about = channel.properties
            unit = about.get("unit_string") or about.get("NI_UnitDescription")
            found.append(((group.name, channel.name), channel[:], unit if isinstance(unit, str) else None))
            intervals[len(channel)].add(float(about.get("wf_increment") or 0.0))
    table = gathered(path, "a TDMS file", found)
    # That of the channels that were taken, if they have one in common.
    of_these = intervals[len(next(iter(table.arrays.values())))]
    interval_s = of_these.pop() if len(of_these) == 1 else 0.0
    return replace(table, interval_s=interval_s if interval_s > 0 else None)


register(Format("a TDMS file", (".tdms",), (b"TDSm",), open_tdms))
