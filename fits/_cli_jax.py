"""JAX as the command needs it: double precision, and compiled functions kept between calls."""

import os
from pathlib import Path

import jax

# Functions that compile faster than this are not worth a file.
_KEPT_S = 0.3


def start_jax() -> None:
    """Configure JAX; call it before any computation."""
    jax.config.update("jax_enable_x64", True)
    folder = _cache_folder()
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _KEPT_S)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _cache_folder() -> Path | None:
    """Make the folder for compiled functions; None where there is none or it cannot be written to."""
    stated = os.environ.get("MICROID_CACHE")
    if stated in ("", "0", "off"):
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(stated).expanduser() if stated else Path(base) / "microid" / "jax"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None
