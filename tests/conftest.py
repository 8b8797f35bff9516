"""Settings shared by all tests."""

from shapebody.runtime import enable_compilation_cache

enable_compilation_cache()
