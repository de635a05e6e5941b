"""Strict by default: dtype and rank promotion are errors, float64 is on (tests choose their dtypes themselves)."""

from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real path-traced sequences."""
    if not DATA.is_dir():
        pytest.skip(f"the real sequences are not here ({DATA}); the bundled sample's tests run all the same")
    return DATA
