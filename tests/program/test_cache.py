"""Compiled functions that one process stores are found by the next."""

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import jax
import patience
import pytest

from jaxid.errors import InputError
from jaxid.program import jax_compilation_cache as cache
from jaxid.program.jax_compilation_cache import enable_compilation_cache

SCRIPT = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxid.program.jax_compilation_cache import enable_compilation_cache
print(enable_compilation_cache())
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))

@jax.jit
def slow(x):
    for _ in range(60):
        x = jax.numpy.linalg.solve(x @ x + 1.0, x)
    return x

jax.block_until_ready(slow(np.eye(4)))
print(sum("cache_hits" in h for h in hits), sum("cache_misses" in h for h in hits))
"""


@pytest.fixture
def updates(monkeypatch):
    """Collect changes of JAX's settings instead of making them."""
    said = {}
    monkeypatch.setattr(jax.config, "update", said.__setitem__)
    monkeypatch.setattr(cache.compilation_cache, "reset_cache", lambda: None)
    for name in (cache.VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    present = property(lambda _: None)
    monkeypatch.setattr(type(jax.config), "jax_compilation_cache_dir", present)
    return said


def run(folder):
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": root, "JAX_PLATFORMS": "cpu"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", SCRIPT],
        env={**environment, cache.VARIABLE: str(folder)},
        capture_output=True,
        text=True,
        timeout=patience.SECONDS,
        check=True,
    )
    where, counts = done.stdout.splitlines()
    return where, *map(int, counts.split())


def test_the_second_process_compiles_nothing(tmp_path):
    folder = tmp_path / "deep" / "cache" / "compiled"
    where, hits, misses = run(folder.parent)
    assert (where, hits) == (str(folder), 0)
    assert misses > 0
    stored = {f.name for f in folder.glob("*-cache")}
    assert stored
    # A busy machine may store a trivial function too, but nothing stored is compiled
    # again.
    assert run(folder.parent)[1] >= len(stored)
    assert stored <= {f.name for f in folder.iterdir()}


def test_it_can_be_moved_and_turned_off(updates, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert enable_compilation_cache() == tmp_path / "jaxid" / "compiled"
    assert updates["jax_compilation_cache_dir"] == str(tmp_path / "jaxid" / "compiled")
    assert (
        enable_compilation_cache(tmp_path / "other") == tmp_path / "other" / "compiled"
    )
    updates.clear()
    for off in ("", "0", "OFF", "none"):
        monkeypatch.setenv(cache.VARIABLE, off)
        assert enable_compilation_cache() is None
    (tmp_path / "file").write_text("")
    assert enable_compilation_cache(tmp_path / "file" / "cache") is None
    present = property(lambda _: str(tmp_path))
    monkeypatch.setattr(type(jax.config), "jax_compilation_cache_dir", present)
    assert enable_compilation_cache() == tmp_path
    assert not updates


@pytest.mark.usefixtures("updates")
def test_the_least_recently_used_go_first_and_no_other_file(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "MAX_BYTES", 2500)
    place, now = enable_compilation_cache(tmp_path), time.time()
    others = [
        folder / name
        for folder in (tmp_path, place)
        for name in ("thesis.tex", "-cache.zip")
    ]
    for age, path in enumerate([*others, *(place / f"{x}-cache" for x in "edcba")]):
        path.write_bytes(bytes(1000))
        os.utime(path, (now - 1000 * age, now - 1000 * age))
    enable_compilation_cache(tmp_path)
    assert sorted(p.name for p in place.glob("*-cache")) == ["d-cache", "e-cache"]
    assert all(path.exists() for path in others)


@pytest.mark.usefixtures("updates")
@pytest.mark.skipif(not hasattr(os, "getuid"), reason="rights of POSIX")
def test_only_its_owner_can_write_to_it(tmp_path, monkeypatch):
    before = os.umask(0)
    try:
        place = enable_compilation_cache(tmp_path / "deep" / "cache")
    finally:
        os.umask(before)
    made = [place, *place.parents][:3]
    assert [stat.S_IMODE(x.stat().st_mode) for x in made] == [0o700] * 3
    for folder in made[:2]:
        folder.chmod(0o770)
        with pytest.raises(InputError, match="others can write to it"):
            enable_compilation_cache(tmp_path / "deep" / "cache")
        folder.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: place.stat().st_uid + 1)
    with pytest.raises(InputError, match="belongs to somebody else"):
        enable_compilation_cache(tmp_path / "deep" / "cache")
