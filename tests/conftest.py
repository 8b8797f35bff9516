"""Settings shared by all tests."""

import gc

import jax
import pytest

from shapebody.runtime import enable_compilation_cache

enable_compilation_cache()


@pytest.fixture(scope="module", autouse=True)
def release_programs():
    """Forget compiled programs after each file: hundreds of memory maps belong to each, and Linux
    ends a process that has more than 65,530."""
    yield
    jax.clear_caches()
    gc.collect()
