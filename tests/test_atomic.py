import errno
import gzip
import os
import pickle
import stat
from pathlib import Path

import numpy as np
import pytest

from fits.io._atomic import atomic_path, atomic_write_text, write_csv
from fits.io._errors import DataError
from fits.io._file_set import check_file, usable_folder
from fits.io._record import Record


def test_text_and_bytes_are_written_as_they_are(tmp_path):
    atomic_write_text(tmp_path / "a.txt", "5 µm\r\nend\n")
    with atomic_path(tmp_path / "b.bin") as temporary:
        temporary.write_bytes(b"\x00\xff")
    assert (tmp_path / "a.txt").read_bytes() == b"5 \xc2\xb5m\r\nend\n"
    assert (tmp_path / "b.bin").read_bytes() == b"\x00\xff"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.bin"]


def test_temporary_file_lies_beside_the_target_and_keeps_its_suffix(tmp_path):
    target = tmp_path / "figure.v2.png"
    with atomic_path(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        temporary.write_bytes(b"x")
        assert not target.exists()
    assert target.read_bytes() == b"x"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
@pytest.mark.parametrize("old", [None, b"old"])
def test_an_exception_leaves_the_folder_as_it_was(tmp_path, error, old):
    target = tmp_path / "a.json"
    if old is not None:
        target.write_bytes(old)

    def interrupted():
        with atomic_path(target) as temporary:
            temporary.write_bytes(b"half")
            raise error

    with pytest.raises(error):
        interrupted()
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([] if old is None else [old])


def test_modes_links_and_long_names(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    atomic_write_text(tmp_path / "a.txt", "")
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)
    (tmp_path / "link.txt").symlink_to(tmp_path / "a.txt")
    atomic_write_text(tmp_path / "link.txt", "through")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "a.txt").read_text() == "through"
    atomic_write_text(tmp_path / ("n" * 251 + ".txt"), "long")  # the longest name that a folder holds


@pytest.mark.parametrize(
    ("where", "words"),
    [("folder", "found a folder"), ("no/such/a.txt", "does not exist"), ("file/a.txt", "does not exist")],
)
def test_impossible_targets_are_refused_in_one_sentence(tmp_path, where, words):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError) as caught:
        atomic_write_text(tmp_path / where, "text")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / where}: ")
    assert words in message
    assert message.count("\n") == 0
    assert message.endswith(".")


@pytest.mark.parametrize("protected", ["folder", "file"])
def test_write_protection_is_respected(tmp_path, monkeypatch, protected):
    # Simulated, because the superuser may write anywhere.
    (tmp_path / "a.txt").write_text("old")
    locked = tmp_path if protected == "folder" else tmp_path / "a.txt"
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != locked)

    def mkdir(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    if protected == "folder":
        monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(DataError, match="cannot be written to" if protected == "folder" else "write-protected"):
        atomic_write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="there is no such folder here")
def test_a_place_that_takes_no_files_is_refused_before_the_work():
    """Also where rights would allow it, as for the superuser."""
    with pytest.raises(DataError, match=r"^/proc/a: the folder /proc cannot be written to \(.+\); choose another"):
        check_file("/proc/a")
    with pytest.raises(DataError, match=r"^/proc/a: expected a folder that can be written to"):
        usable_folder("/proc/a")


def test_a_full_disk_is_one_sentence_and_other_errors_pass(tmp_path):
    def write(error):
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(DataError, match=r"a\.txt: cannot be written \(No space left on device\); free the disk"):
        write(OSError(28, "No space left on device"))
    with pytest.raises(FileNotFoundError):
        write(FileNotFoundError(2, "No such file", "other.txt"))
    assert list(tmp_path.iterdir()) == []


def test_write_csv_writes_shortest_exact_numbers(tmp_path):
    columns = {"time_s": np.array([0.0, 0.1]), "n": np.array([1, 2]), "odd, name": np.array([1e-300, -1 / 3])}
    expected = 'time_s,n,"odd, name"\n0.0,1,1e-300\n0.1,2,-0.3333333333333333\n'
    write_csv(tmp_path / "a.csv", columns)
    assert (tmp_path / "a.csv").read_text() == expected
    write_csv(tmp_path / "a.csv.gz", columns)
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()).decode() == expected
    with pytest.raises(ValueError, match="zip"):
        write_csv(tmp_path / "b.csv", {"a": np.zeros(2), "b": np.zeros(3)})
    assert not (tmp_path / "b.csv").exists()


def test_record_is_read_only_sliced_and_pickled():
    time_s = np.arange(6.0)
    record = Record(time_s, time_s + 10.0, None, {"current_A": time_s * 2.0}, "a.csv", ("Odd.",))
    time_s[0] = 99.0  # the record has its own copy
    assert record.time_s[0] == 0.0
    assert (len(record), record.duration_s) == (6, 5.0)
    with pytest.raises(ValueError, match="read-only"):
        record.voltage_V[0] = 1.0
    with pytest.raises(TypeError):
        record.extra["x"] = time_s
    with pytest.raises(TypeError, match="forwards"):
        record[::-1]
    for part in (record[2:4], pickle.loads(pickle.dumps(record))[2:4]):
        assert part.time_s.tolist() == [2.0, 3.0]
        assert part.voltage_V.tolist() == [12.0, 13.0]
        assert part.extra["current_A"].tolist() == [4.0, 6.0]
        assert part.displacement_um is None
        assert (part.source, part.warnings) == ("a.csv", ("Odd.",))
        assert not part.time_s.flags.writeable
    with pytest.raises(ValueError, match="voltage_V has shape"):
        Record(time_s, np.zeros(5), None)
