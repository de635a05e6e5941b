"""What the compiler is told."""

import pytest

from svgf_jax import compiled


@pytest.fixture(autouse=True)
def asked_anew():
    compiled.compiler_options.cache_clear()
    yield
    compiled.compiler_options.cache_clear()


def test_wide_vectors_are_asked_for_on_cpus_alone():
    assert compiled.compiler_options("cpu") == compiled.WIDE
    assert compiled.compiler_options("gpu") == {}


def test_a_compiler_that_does_not_know_the_option_does_without(monkeypatch):
    monkeypatch.setattr(compiled, "WIDE", {"xla_cpu_of_another_year": 1})
    assert compiled.compiler_options("cpu") == {}
