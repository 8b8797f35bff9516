"""Wrong arguments of everything public: an error of ours, or accepted on purpose."""

import errno
import importlib
import inspect
import linecache
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
from argument_table import FUNCTIONS, INTERNAL, UNCHECKED
from arguments import WRONG, World
from tiny import quick_compilation

import shapebody
from shapebody import arguments as _arguments
from shapebody import files

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
    values = [getattr(shapebody, name) for name in shapebody.__all__]
    home = {
        f"{value.__module__.removeprefix('shapebody.')}.{value.__name__}"
        for value in values
        if inspect.isfunction(value) or inspect.isclass(value)
    }
    assert home <= {*FUNCTIONS, *UNCHECKED}


def test_a_function_without_an_entry_is_noticed(monkeypatch):
    from shapebody.reproduction import paper

    def fresh():
        pass

    fresh.__module__ = paper.__name__
    monkeypatch.setattr(paper, "fresh", fresh, raising=False)
    assert "reproduction.paper.fresh" in public() and not known("reproduction.paper.fresh", None)


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
    words = (name, name.removesuffix("s"), short, _arguments.shown(value), *WORDS.get(name, ()))
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
    "bodies": ("body",),
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


# ------------------------------------------------------------------ the command line


COMMANDS = {
    "train": "hours steps engine name scale seed num-envs learning-rate policy.key-widths",
    "continue": "AGENT hours steps engine",
    "anneal": "AGENT steps hours engine",
    "policy-evaluation": "AGENT steps hours engine task-of critic.heads",
    "design": "ROBOT agent method start seed trust-region freeze out iterations",
    "evaluate": "AGENT robot start seed engine episodes coefficient task.horizon",
    "validate": "ROBOT out",
}
"""Arguments by command; those in capitals have no flag."""


def test_the_table_of_commands_is_whole():
    """Settings of configurations are samples; what the commands add to them is all here."""
    from shapebody import commands

    assert COMMANDS.keys() == commands.COMMANDS.keys()
    for name, make in commands.COMMANDS.items():
        command, _ = make(["unitree_go2"])
        own = [x for x in inspect.signature(command).parameters if x not in ("settings", "critic")]
        flags = {x.replace("_", "-") for x in own} - {"state-only", "replace"}
        assert flags <= {word.lower() for word in COMMANDS[name].split()}, name


WRONG_WORDS = [
    "",
    "..",
    "a/b",
    "x" * 5000,
    f"a/{'x' * 5000}",
    "~nobody_has_this_name/x",
    "\ud800",
] + ["nan", "inf", "-inf", "-1", "1.5", str(2**40), str(2**70), "1e300", "None", "b'x'"]
FINE_WORDS = {
    "seed": (),
    "steps": (str(2**40), "None"),  # so many steps can be asked for
    "hours": ("None", "1.5", "1e300", str(2**40), str(2**70)),
    "trust-region": ("1.5", "1e300", str(2**40), str(2**70)),
    "start": (str(2**40), "None"),
    "episodes": (),
    "freeze": (),
    "out": (
        "a/b",
        "-1",
        "-inf",
        "nan",
        "inf",
        "1.5",
        "1e300",
        "None",
        "b'x'",
        str(2**40),
        str(2**70),
    ),
}
"""Values that are right: numbers are also names of files."""
FINE_WORDS["name"] = tuple(word for word in FINE_WORDS["out"] if "/" not in word)


@pytest.mark.parametrize(
    "command, argument",
    [(command, argument) for command, words in COMMANDS.items() for argument in words.split()],
)
def test_wrong_words_on_the_command_line(command, argument, world, monkeypatch, capsys):
    """It says what was wrong, and no traceback."""
    from shapebody.__main__ import main
    from shapebody.optimizers import search

    def worked(*arguments, **options):
        raise AssertionError("this reached the work")

    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr("shapebody.training.trainer.Locomotion", worked)
    monkeypatch.setattr("shapebody.evaluation.evaluate._environment", worked)
    monkeypatch.setitem(search.METHODS, "vgds", search.METHODS["vgds"]._replace(function=worked))
    robot, agent = str(world.robot.path), str(world.agent_folder)
    positional = "ROBOT" if command in ("train", "design", "validate") else "AGENT"
    words = [command] + [{"ROBOT": robot, "AGENT": agent}[positional]] * (argument != positional)
    if command == "design" and argument != "agent":
        words += ["--agent", agent]
    for word in WRONG_WORDS:
        if word in FINE_WORDS.get(argument, ()):
            continue
        given = [word] if argument == positional else [f"--{argument}", word]
        try:
            status = main([*words, *given])
        except SystemExit as stopped:  # of the library, which names the argument
            status = stopped.code
        told = capsys.readouterr()
        said = told.err if command != "validate" else told.err + told.out
        assert status in (1, 2), (word, said)
        assert "Traceback" not in said and said.strip(), word
        assert len(said) < 3000 or status == 2, (word, len(said))


# ------------------------------------------------------------------ homeless, and a full disk


def test_without_a_home_folder(tmp_path):
    """HOME is not set, and the system does not know the user: nothing crashes, the cache is off."""
    code = """
import os, pathlib, pwd
def nobody(*_):
    raise KeyError("no such user")
pwd.getpwuid = pwd.getpwnam = nobody
import shapebody
from shapebody import runtime
assert runtime.enable_compilation_cache() is None
assert len(shapebody.robots()) == 50
for call in (shapebody.load_robot, shapebody.load_agent):
    try:
        call("~/x.xml")
    except ValueError as error:
        assert "home folder is unknown" in str(error), error
from shapebody.__main__ import main
assert main(["validate", "~/x.xml"]) == 1
print("fine")
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | {"PYTHONPATH": str(PACKAGE.parent), "MPLCONFIGDIR": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.stdout.endswith("fine\n"), done.stderr


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


WRITERS = {
    "save_agent": lambda world, path: shapebody.save_agent(world.agent, path),
    "Report.write": lambda world, path: world.report.write(path),
    "Scene.save": lambda world, path: world.scene.save(path),
    "save_arrays": lambda world, path: files.save_arrays(path, {"a": 1.0}),
    "atomic_write": lambda world, path: files.atomic_write(path, "text"),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_is_named(writer, world, tmp_path, monkeypatch):
    path = tmp_path / "here"
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="cannot be written: No space left on device") as caught:
        WRITERS[writer](world, path)
    assert str(path) in str(caught.value) and caught.value.errno == errno.ENOSPC
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


def test_a_result_on_a_full_disk_is_named(world, tmp_path, monkeypatch):
    from shapebody import files
    from shapebody.reproduction import results

    for name in ("results", "checkpoints"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    monkeypatch.setattr(results, "result_provenance", lambda *_, **__: {"seconds": 1.0})
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="cannot be written") as caught:
        results.result("trial", lambda: [{"a": 1}])
    assert str(files.data_dir() / "results" / "trial.json") in str(caught.value)


def test_a_folder_that_cannot_be_made_is_named(world, tmp_path):
    (tmp_path / "file").write_text("")
    for writer in WRITERS.values():
        with pytest.raises(OSError, match="cannot be written") as caught:
            writer(world, tmp_path / "file" / "here")
        assert str(tmp_path / "file") in str(caught.value)


def test_the_command_line_tells_of_a_full_disk(world, tmp_path, monkeypatch, capsys):
    from shapebody.__main__ import main

    monkeypatch.setattr(os, "fsync", full)
    out = str(tmp_path / "out.xml")
    assert main(["validate", str(world.robot.path), "--out", out]) == 1
    error = capsys.readouterr().err
    assert (
        error.startswith(f"shapebody: {out} cannot be written: No space") and "Trace" not in error
    )


# ------------------------------------------------------------------ the checks


def test_what_is_shown_is_short():
    class Silent:
        def __repr__(self):
            raise RuntimeError

    assert _arguments.shown("x" * 5000).endswith("(5,000 characters)")
    assert _arguments.shown(Silent()) == "an object of class Silent"
    for value in WRONG.values():
        assert len(_arguments.shown(value)) < 120


@pytest.mark.parametrize("name", ["unitree_go2", "my robot (1)", "größe", "x" * 200, "a+b"])
def test_names_that_are_fine(name):
    assert _arguments.require_name("name", name) == name


def test_right_values_come_back():
    import jax
    import numpy as np

    assert _arguments.require_integer("n", np.int32(3)) == 3
    assert _arguments.require_seed("seed", 2**32 - 1) == 2**32 - 1
    assert _arguments.require_number("x", np.float32(0.5), 0, 1) == 0.5
    assert _arguments.require_number("x", 3, above=2) == 3
    assert _arguments.require_flag("flag", np.True_) is True
    assert _arguments.require_list("list", range(2)) == [0, 1]
    for key in (jax.random.key(0), jax.random.PRNGKey(0)):
        assert _arguments.require_key("key", key) is key
        keys = jax.random.split(key, 3)
        assert _arguments.require_key("keys", keys, (3,)) is keys
    for array, shape in (([1, 2], (2,)), (np.zeros((4, 2, 3)), ("...", 2, 3)), ([[1]], ("n", 1))):
        assert _arguments.require_array("array", array, shape).shape == np.shape(array)
    assert _arguments.require_path("path", "a/b") == Path("a/b")


def test_checks_of_shapes_work_on_traced_arrays():
    import jax
    import numpy as np

    from shapebody.training.losses import advantages

    rows = np.zeros((2, 3), np.float32)
    never = rows > 1
    jitted = jax.jit(lambda x: advantages(x, x, x[:, 0], never, never, 0.9, 0.9))
    assert jitted(rows).shape == rows.shape
    with pytest.raises(ValueError, match="last_value has shape"):
        jax.jit(lambda x: advantages(x, x, x[0], never, never, 0.9, 0.9))(rows)
