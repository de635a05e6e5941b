"""Strict by default: dtype and rank promotion are errors, float64 is on (tests choose their dtypes themselves)."""

import atexit
import gc
import os
import runpy
import shutil
import tempfile
from pathlib import Path

import jax
import pytest
from compiling import compile_quickly

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

compile_quickly()  # `compiling.AS_USERS` takes it back
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp()  # what commands keep is not the user's
atexit.register(shutil.rmtree, os.environ["XDG_CACHE_HOME"], ignore_errors=True)
runpy.run_path(str(Path(__file__).parent / "offline" / "sitecustomize.py"))  # nor do tests ask the network

DATA = Path(__file__).parents[2] / "shared" / "data"

# What takes longest begins first, so that two workers end together (with --no-loadscope-reorder).
LONGEST = (
    "test_gradients",
    "test_tune_fit",
    "test_cli",
    "test_claims",
    "test_adaptation",
    "test_pipeline_oracle",
    "test_mutants",
)


def pytest_collection_finish():
    """Tracing makes many objects and little garbage: looked for seldom, it takes three quarters of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def pytest_collection_modifyitems(items):
    rank = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real path-traced sequences."""
    if not DATA.is_dir():
        pytest.skip(f"the real sequences are not here ({DATA}); the bundled sample's tests run all the same")
    return DATA
