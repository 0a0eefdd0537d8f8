"""The folder of compiled functions, which run as the user's own code: one that others can change is not used."""

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from fits import DataError
from fits.io._jax_setup import _cache_folder

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="there are no such rights here")


def group_writable(folder):
    folder.chmod(0o770)


def world_writable(folder):
    folder.chmod(0o707)


def open_file(folder):
    folder.chmod(0o755)
    (folder / "below").mkdir()
    (folder / "below" / "code").write_text("")
    (folder / "below" / "code").chmod(0o664)


def open_above(folder):
    folder.parent.chmod(0o777)


def anothers(folder):
    os.chown(folder, 12345, -1)


def anothers_file(folder):
    (folder / "code").write_text("")
    os.chown(folder / "code", 12345, -1)


def linked(folder):
    target = folder.parent / "target"
    folder.rename(target)
    target.chmod(0o770)
    folder.symlink_to(target)


OPEN = [group_writable, world_writable, open_file, open_above, anothers, anothers_file, linked]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder that was used before, stated in the environment."""
    path = tmp_path / "above" / "cache"
    path.mkdir(parents=True)
    path.chmod(0o700)
    monkeypatch.setenv("MICROID_CACHE", str(path))
    assert _cache_folder() == path
    return path


def opened(folder, spoil):
    try:
        spoil(folder)
    except PermissionError:
        pytest.skip("only the superuser gives files away")


@pytest.mark.parametrize("spoil", OPEN)
def test_a_folder_that_others_can_change_is_refused_with_its_remedy(folder, spoil):
    opened(folder, spoil)
    with pytest.raises(
        DataError, match=r"^MICROID_CACHE: .* run as your own code; .*, or name another folder\.$"
    ) as no:
        _cache_folder()
    if "chmod" in str(no.value):
        # As it says.
        command = str(no.value).partition("; run ")[2].partition(",")[0].split()
        subprocess.run(command, check=True)
    else:
        assert f"delete {folder}," in str(no.value)
        folder.unlink() if folder.is_symlink() else shutil.rmtree(folder)
    assert _cache_folder() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("spoil", OPEN)
def test_the_default_folder_is_then_not_used_and_a_note_says_so(tmp_path, monkeypatch, capsys, spoil):
    monkeypatch.delenv("MICROID_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = _cache_folder()
    assert folder == tmp_path / "microid" / "jax"
    opened(folder, spoil)
    assert _cache_folder() is None
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("Note: ")
    assert said.err.count("\n") == 1


def test_new_files_of_lax_users_are_no_trouble(folder):
    """Where new files are the group's by default, nobody of it can reach them."""
    (folder / "code").write_text("")
    (folder / "code").chmod(0o666)
    assert _cache_folder() == folder


def test_the_command_says_it_in_one_sentence(folder, tmp_path):
    group_writable(folder)
    rows = "".join(f"{k},{k % 7},{k % 5}\n" for k in range(60))
    (tmp_path / "x.csv").write_text(f"time_s,voltage_V,displacement_um\n{rows}")
    done = subprocess.run(
        [sys.executable, "-m", "fits", "fit", "x.csv", "--out", "y.json", "--quiet"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"MICROID_CACHE: other users can write to {folder}")
    assert done.stderr.count("\n") == 1
