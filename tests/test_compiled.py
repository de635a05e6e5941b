"""What the compiler is told."""

import pytest

from svgf_jax import compiled


@pytest.fixture(autouse=True)
def asked_anew():
    compiled.compiler_options.cache_clear()
    yield
    compiled.compiler_options.cache_clear()


def test_lean_programs_are_asked_for_on_cpus_alone():
    assert compiled.compiler_options("cpu") == compiled.LEAN
    assert compiled.compiler_options("gpu") == {}


def test_a_compiler_that_does_not_know_an_option_does_without(monkeypatch):
    known = {"xla_cpu_prefer_vector_width": 512}
    monkeypatch.setattr(compiled, "LEAN", {"xla_cpu_of_another_year": 1, **known})
    assert compiled.compiler_options("cpu") == known
