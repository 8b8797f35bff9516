"""Shape Your Body: search for robot designs along the gradient of a design-conditioned critic.

The public names are listed in `__init__.pyi`. Each is imported from its module on first use, so
that `import shapebody` is quick and starts no JAX backend.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
