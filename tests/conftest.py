"""Settings shared by all tests."""

import gc

import jax
import pytest
from tiny import quick_compilation, tiny_agent, tiny_robot

from shapebody.runtime import enable_compilation_cache

enable_compilation_cache()


@pytest.fixture(scope="module", autouse=True)
def release_programs():
    """Forget compiled programs after each file: hundreds of memory maps belong to each, and Linux
    ends a process that has more than 65,530."""
    yield
    jax.clear_caches()
    gc.collect()


@pytest.fixture(scope="module")
def quick():
    """For a whole file: programs are little optimized, which compiles them sooner."""
    with quick_compilation():
        yield


@pytest.fixture(scope="session")
def robot(tmp_path_factory):
    """A trunk on two legs of one joint."""
    return tiny_robot(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="session")
def agent(robot):
    """An agent of random networks for that robot."""
    return tiny_agent(robot)
