"""Shape Your Body: search for robot designs along the gradient of a design-conditioned critic.

The names below are the public interface. Each is imported from its module on first use, so that
``import shapebody`` is quick and starts no JAX backend.

``robots`` and ``search`` are functions here and also names of modules. As attributes of the package
they are always the functions; the modules are reached by ``from shapebody.robots import ...``.
"""

import importlib
import sys
import types

__version__ = "0.1.0"

_MODULE_OF = {
    "Robot": "robots",
    "load_robot": "robots",
    "robots": "robots",
    "validate_robot": "validation",
    "DesignSpace": "design",
    "Embodiment": "design",
    "describe": "descriptions",
    "Policy": "networks",
    "PolicyConfig": "networks",
    "Critic": "networks",
    "CriticConfig": "networks",
    "load_published_policy": "published",
    "Locomotion": "locomotion",
    "TaskConfig": "locomotion",
    "TrainConfig": "ppo",
    "train": "ppo",
    "Agent": "checkpoints",
    "load_agent": "checkpoints",
    "save_agent": "checkpoints",
    "SearchResult": "search",
    "search": "search",
    "Evaluation": "evaluation",
    "EvaluationConfig": "evaluation",
    "evaluate": "evaluation",
    "scale": "experiments",
    "Recording": "recording",
    "record_episode": "recording",
    "start_notebook": "runtime",
}

# Modules that notebooks use as such: shapebody.video.show_video(...).
_MODULES = ("experiments", "explorer", "plots", "studies", "video")

__all__ = sorted([*_MODULE_OF, *_MODULES])


def __getattr__(name):
    if name in _MODULE_OF:
        value = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    import difflib

    close = difflib.get_close_matches(name, __all__, n=3)
    hint = f"; did you mean {' or '.join(close)}?" if close else f"; it has {', '.join(__all__)}"
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")


def __dir__():
    return sorted({*globals(), *__all__})


class _Package(types.ModuleType):
    def __setattr__(self, name, value):
        # Importing a submodule sets it as an attribute of the package, which would hide the
        # function of the same name from then on.
        if isinstance(value, types.ModuleType) and _MODULE_OF.get(name) == name:
            value = getattr(value, name, value)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
