"""What all tests share: float64, and the measured data where they are.

With `JAXID_CHECK_SHAPES=1` shapes and types of all arguments are checked at run time,
which takes about half of the time of a run: `benchmarks/run.py --check` does so before
a release.
"""

import gc
import os
import tempfile

# The workers of one run share what they compile; the user's cache is left alone.
os.environ["JAXID_CACHE_DIR"] = "off"
# Each worker has one core; threads of linear algebra on the cores of other workers cost
# much time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests run most of what they compile once: optimising it would take longer. With 0 here
# it is optimised as for users, which `benchmarks/run.py --check` does.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# As in commands: tracing makes many small objects, of which few are in cycles.
gc.set_threshold(50_000, 20, 100)
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    COMPILED = tempfile.TemporaryDirectory(prefix="jaxid-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = COMPILED.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

from jaxtyping import install_import_hook

if os.environ.get("JAXID_CHECK_SHAPES"):
    install_import_hook("jaxid", "beartype.beartype")

from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run, and no clock: a busy machine is no bug.
settings.register_profile("jaxid", deadline=None, derandomize=True)
settings.load_profile("jaxid")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of measured robots beside the project, which is not part of it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("measured data (../shared/data beside the project) are not here")
    return folder


@pytest.fixture(scope="session", autouse=True)
def warnings_of_mujoco():
    """Fail if a simulation of MuJoCo was unstable, which it would write into a file."""
    try:
        import mujoco
    except ImportError:
        yield
        return
    warnings = []
    mujoco.set_mju_user_warning(warnings.append)
    yield
    mujoco.set_mju_user_warning(None)
    assert not warnings
