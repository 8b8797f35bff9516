"""Wrong arguments of everything public: an error of ours, or accepted on purpose."""

import importlib
import inspect
import linecache
import os
import pkgutil
from pathlib import Path

import pytest
from argument_table import FUNCTIONS, INTERNAL, UNCHECKED
from arguments import WRONG, World
from tiny import quick_compilation

import shapebody
from shapebody import checks

PACKAGE = Path(shapebody.__file__).parent


def modules():
    """Name within the package and module, for all but the internal ones and the command line."""
    for found in pkgutil.walk_packages(shapebody.__path__, "shapebody."):
        name = found.name.removeprefix("shapebody.")
        if name != "__main__" and name not in INTERNAL:
            yield name, importlib.import_module(found.name)


def own_methods(kind):
    """Public methods that a class defines itself; `__call__` is one."""
    for name, value in vars(kind).items():
        function = getattr(value, "__func__", value)
        if inspect.isfunction(function) and (not name.startswith("_") or name == "__call__"):
            if function.__module__.startswith("shapebody"):
                yield name, function


def public():
    """Every public function, class and method of the package: name -> (function, its class)."""
    found = {}
    for module_name, module in modules():
        for name, value in vars(module).items():
            if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
                continue
            path = f"{module_name}.{name}"
            if inspect.isclass(value):
                if issubclass(value, BaseException):
                    continue
                found[path] = value, None
                for method, function in own_methods(value):
                    found[f"{path}.{method}"] = function, value
            elif callable(value):
                found[path] = value, None
    return found


PUBLIC = public()


def is_network(kind):
    return "flax" in getattr(kind.__mro__[1], "__module__", "") or "setup" in vars(kind)


def known(path, owner):
    """Whether the table knows a function; networks' methods run inside `apply`."""
    inside = owner is not None and is_network(owner) and path.rsplit(".", 1)[1] in INSIDE
    return path in FUNCTIONS or path in UNCHECKED or inside


INSIDE = ("__call__", "setup", "temperature", "standardize", "declare")


def test_the_table_knows_every_public_function():
    unknown = [path for path, (_, owner) in PUBLIC.items() if not known(path, owner)]
    assert not unknown, f"give them entries in argument_table.py: {unknown}"
    gone = [path for path in (*FUNCTIONS, *UNCHECKED) if path not in PUBLIC]
    assert not gone, f"they are in argument_table.py and nowhere else: {gone}"
    assert all(UNCHECKED.values()) and not FUNCTIONS.keys() & UNCHECKED.keys()
    interface = {f"{module}.{name}" for name, module in shapebody._MODULE_OF.items()}
    home = {
        f"{getattr(shapebody, name).__module__.removeprefix('shapebody.')}.{name}"
        for name in shapebody._MODULE_OF
    }
    assert len(home) == len(interface) and home <= {*FUNCTIONS, *UNCHECKED}
    assert not {*shapebody._MODULES} & {*INTERNAL}


@pytest.mark.parametrize("path", FUNCTIONS)
def test_the_table_knows_every_parameter(path):
    function, _ = PUBLIC[path]
    given = {
        name
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is not parameter.VAR_KEYWORD and name not in ("self", "cls")
    }
    if inspect.isclass(function) and is_network(function):
        given -= {"parent", "name"}  # of every module of flax
    assert set(FUNCTIONS[path]) == given


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    before = Path.cwd()
    os.chdir(folder)  # relative paths among the wrong values lead here
    with pytest.MonkeyPatch.context() as patch, quick_compilation():
        patch.delenv("SHAPEBODY_SCALE", raising=False)
        yield World(folder)
    os.chdir(before)


def call(path, world, values):
    """Call a function of the table with values by name."""
    function, owner = PUBLIC[path]
    parameters = inspect.signature(function).parameters
    listed, named = [], {}
    for name, value in values.items():
        kind = parameters[name].kind
        if kind is inspect.Parameter.VAR_POSITIONAL:
            listed.append(value)
        else:
            named[name] = value
    if owner is not None:
        attribute = inspect.getattr_static(owner, path.rsplit(".", 1)[1])
        if isinstance(attribute, classmethod):
            listed.insert(0, owner)
        elif not isinstance(attribute, staticmethod):
            listed.insert(0, world.of(path.rsplit(".", 1)[0]))
    result = function(*listed, **named)
    if hasattr(result, "__enter__") and path == "files.alone_in":
        with result:
            pass


def complaint(error, name, value) -> str:
    """What is wrong with an error; empty if it is one of ours that helps."""
    frame = error.__traceback__
    while frame.tb_next is not None:
        frame = frame.tb_next
    file = frame.tb_frame.f_code.co_filename
    line = linecache.getline(file, frame.tb_lineno).strip()
    where = f"{file}:{frame.tb_lineno}: {line}: {type(error).__name__}: {str(error)[:300]}"
    if not Path(file).is_relative_to(PACKAGE) or not line.startswith("raise"):
        return f"raised elsewhere: {where}"
    text = str(error)
    short = str(value)[:40] if isinstance(value, str | Path) else repr(value)[:40]
    words = (name, name.removesuffix("s"), short, checks.shown(value), *WORDS.get(name, ()))
    if not any(word and word in text for word in words):
        return f"names neither argument nor value: {where}"
    if len(text) > 2500:
        return f"{len(text)} characters: {where}"
    return ""


WORDS = {
    "f": ("design",),
    "design": ("design",),
    "name_or_path": ("robot",),
    "name_or_folder": ("agent",),
    "published_axes_of": ("design",),
    "seed": ("start design",),
    "start": ("start design",),
    "robot_or_space": ("design f", "body"),
    "model": ("body",),
    "states": ("observation",),
    "reference": ("design",),
    "trajectory": ("design",),
    "descriptions": ("static",),
    "rows": ("row", "cell", "gain of"),
    "ids": ("designs of",),
    "reward": ("value",),
    "method": ("gain of",),
    "records": ("reference",),
    "over": ("gain of",),
    "y": ("column",),
    "x": ("column", "paired", "two lists"),
    "names": ("parameters", "robot"),
    "frozen": ("parameters",),
    "policy": ("agent",),
    "files": ("path",),
    "pytree": ("leaf",),
    "critics": ("agent",),
    "runs": ("a run",),
}


@pytest.mark.parametrize("path", [path for path in FUNCTIONS if FUNCTIONS[path]])
def test_wrong_arguments(path, world, capsys):
    kinds, wrong = FUNCTIONS[path], []
    right = {name: kind.value(world) for name, kind in kinds.items()}
    for name, kind in kinds.items():
        assert not kind.accepts or kind.why or kind.accepts.issubset(WRONG)
        for label, value in WRONG.items():
            accepted = label in kind.accepts
            if accepted and label not in kind.runs:
                continue
            try:
                call(path, world, right | {name: value})
            except Exception as error:
                problem = f"raised {error!r}" if accepted else complaint(error, name, value)
            else:
                problem = "" if accepted else "no error"
            if problem:
                wrong.append(f"{name} = {label}: {problem}")
    assert not wrong, "\n".join(wrong)
