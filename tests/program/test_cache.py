"""What one process has compiled the next one finds."""

import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from jaxid.program import cache
from jaxid.program.cache import keep_compiled, user_cache

SCRIPT = """
import time
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxid as jid
print(jid.keep_compiled())
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name))
robot = jid.robots.planar_arm(3, 0.4)
model = jid.Model(robot, (jid.RigidBodies(),))
q = np.ones((5000, 3))
jax.block_until_ready(model.regressor(jid.Motion(q, q, q)))
print(sum("cache_hits" in h for h in hits), sum("cache_misses" in h for h in hits))
"""
ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture
def untouched(monkeypatch):
    """Whatever is set, nothing is changed for the other tests."""
    said = {}
    monkeypatch.setattr(jax.config, "update", said.__setitem__)
    monkeypatch.setattr(cache.compilation_cache, "reset_cache", lambda: None)
    for name in (cache.VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    return said


def run(folder):
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", SCRIPT],
        env={**environment, cache.VARIABLE: str(folder), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    where, counts = done.stdout.splitlines()
    return where, *map(int, counts.split()), done.stderr


def test_the_second_process_compiles_nothing(tmp_path, monkeypatch):
    folder = tmp_path / "deep" / "cache"
    where, hits, misses, _ = run(folder)
    assert where == str(folder)
    assert hits == 0
    assert misses > 0
    stored = {f.name for f in folder.glob("*-cache")}
    assert stored
    _, hits, _, stderr = run(folder)
    # A busy machine may take so long for a trivial operation that this is stored too, but what
    # has been stored once is never compiled again.
    assert hits >= len(stored)
    assert stderr == ""
    assert stored <= {f.name for f in folder.iterdir()}


def test_it_can_be_moved_and_turned_off(untouched, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert keep_compiled() == tmp_path / "jaxid"
    assert untouched["jax_compilation_cache_dir"] == str(tmp_path / "jaxid")
    assert keep_compiled(tmp_path / "other") == tmp_path / "other"
    untouched.clear()
    for off in ("", "0", "OFF", "none"):
        monkeypatch.setenv(cache.VARIABLE, off)
        assert keep_compiled() is None
    assert not untouched


def test_a_cache_that_was_chosen_before_stays(untouched, tmp_path, monkeypatch):
    chosen = property(lambda _: str(tmp_path))
    monkeypatch.setattr(type(jax.config), "jax_compilation_cache_dir", chosen)
    assert keep_compiled() == tmp_path
    assert not untouched


def test_where_nothing_can_be_written_there_is_no_cache(untouched, tmp_path):
    (tmp_path / "file").write_text("")
    assert keep_compiled(tmp_path / "file" / "cache") is None
    assert not untouched


def test_the_oldest_go_first(untouched, tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "MAX_BYTES", 2500)
    now = time.time()
    for age, name in enumerate("edcba"):
        (tmp_path / name).write_bytes(bytes(1000))
        os.utime(tmp_path / name, (now - 1000 * age, now - 1000 * age))
    keep_compiled(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d", "e"]


def test_places_by_platform(monkeypatch, tmp_path):
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setattr(sys, "platform", "linux")
    assert user_cache() == tmp_path / ".cache" / "jaxid"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert user_cache() == tmp_path / "Library" / "Caches" / "jaxid"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "Local"))
    assert user_cache() == tmp_path / "Local" / "jaxid" / "Cache"
