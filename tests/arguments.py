"""What every public function expects of its arguments, for test_arguments.py.

`FUNCTIONS` has an entry per public function, class and method: the kind of each of its parameters.
A kind knows which of the wrong values in `WRONG` happen to be right for it, and a right value for
the calls in which another parameter is wrong. What is not to be called with values that nobody has
looked at is in `UNCHECKED`, with the reason, and modules that are no interface in `INTERNAL`.
"""

import functools
import types
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tiny import tiny_agent, tiny_robot

LONG = "x" * 5000

WRONG = {
    "None": None,
    "True": True,
    "-1": -1,
    "1.5": 1.5,
    "2**40": 2**40,
    "2**70": 2**70,
    "1e300": 1e300,
    "NaN": float("nan"),
    "inf": float("inf"),
    "-inf": -float("inf"),
    "1j": 1j,
    "NumPy NaN": np.float32("nan"),
    "empty": "",
    "dots": "..",
    "a/b": "a/b",
    "long": LONG,
    "long path": f"a/{LONG}",
    "NUL": "a\0b",
    "half a character": "\ud800",
    "unknown home": "~nobody_has_this_name/x",
    "bytes": b"x",
    "Path ..": Path(".."),
    "long Path": Path(LONG),
    "list": [],
    "list of None": [None],
    "list of text": ["a"],
    "ragged": [[1], [1, 2]],
    "dictionary": {},
    "wrong dictionary": {"a": "b"},
    "set": {1},
    "object": object(),
    "class": int,
    "array of text": np.array(["a"]),
    "array of NaN": np.full(3, np.nan),
    "empty array": np.zeros(0),
    "array": np.zeros((2, 3, 4)),
    "array of objects": np.array([None, {}], object),
    "JAX array": jax.numpy.zeros((2, 5)),
}


# ------------------------------------------------------------------ kinds of parameters


@dataclass(frozen=True)
class Kind:
    """Which values are right: labels of `WRONG` in `accepts`, and `right`, a function of a World.

    why: the reason for which odd values are accepted. runs: those of the accepted ones that are
    passed, too, and must not raise (where that costs nothing).
    """

    right: Any
    accepts: frozenset = frozenset()
    why: str = ""
    runs: frozenset = frozenset()

    def also(self, *labels, why: str, runs: bool = False):
        """The same kind, with more values that are accepted."""
        assert set(labels) <= set(WRONG), labels
        running = self.runs | set(labels) if runs else self.runs
        return replace(self, accepts=self.accepts | set(labels), why=why or self.why, runs=running)

    def given(self, right):
        """The same kind with another right value, or function of a World."""
        return replace(self, right=right)

    def value(self, world):
        return self.right(world) if isinstance(self.right, types.FunctionType) else self.right


def labels(test) -> frozenset:
    """Labels of the wrong values that pass a test."""
    found = set()
    for label, value in WRONG.items():
        try:
            found |= {label} if bool(test(value)) else set()
        except (TypeError, ValueError):
            pass
    return frozenset(found)


def integer(least=0, most=2**31 - 1, right=None):
    inside = labels(lambda x: type(x) is int and least <= x <= most)
    return Kind(max(least, 1) if right is None else right, inside)


def number(least=-float("inf"), most=float("inf"), right=1.0, open_at=None):
    def fits(x):
        real = type(x) in (int, float) or isinstance(x, np.floating)
        return real and np.isfinite(float(x)) and least <= x <= most and x != open_at

    return Kind(right, labels(fits))


def choice(right):
    return Kind(right)


def thing(getter):
    """An object of one class: nothing in `WRONG` is one."""
    return Kind(getter)


def optional(kind):
    return kind.also("None", why="None is the default")


def array(*shape, right=None, accepts=(), dtype=np.float32):
    values = np.zeros(shape, dtype) if right is None else right
    return Kind(values, frozenset(accepts))


SEED = integer(0, 2**32 - 1, 0)
FLAG = Kind(False, frozenset({"True"}))
ENGINE = choice("native")
TEXT = Kind("text", labels(lambda x: isinstance(x, str) and len(x) <= 1000))
NAME = Kind("name")
OUTPUT = Kind(
    lambda world: world.folder / "new.file",
    frozenset({"a/b"}),
    "a file in a folder that is made",
)
FOLDER = Kind(
    lambda world: world.folder / "new", frozenset({"dots", "a/b", "Path .."}), "any folder"
)
FUNCTION = Kind(lambda world: len, frozenset({"class"}), "a class can be called")
COUNT, STEPS = integer(1), integer(1, 10**15)

ROBOT = thing(lambda world: world.robot)
AGENT = thing(lambda world: world.agent)
SPACE = thing(lambda world: world.space)
DESIGN = thing(lambda world: world.space.reference)
MODEL = thing(lambda world: world.robot)
QPOS = thing(lambda world: world.robot.home)
ROBOT_FILE = thing(lambda world: world.robot.path)
ROBOT_NAME = ROBOT_FILE.also("a/b", why="the file is read later")
AGENT_FOLDER = thing(lambda world: world.agent_folder)
TASK = thing(lambda world: world.task)
KEY = thing(lambda world: jax.random.PRNGKey(0))
AXES = thing(lambda world: world.axes)
RUNS = thing(lambda world: world.runs).also("list", "empty array", why="no runs: only the starts")
RECORDS = thing(lambda world: world.records)
FRAMES = thing(lambda world: np.zeros((2, 32, 32, 3), np.uint8))
HEIGHT = integer(16, 8192, 64)
ANGLE = number(right=130.0)
FPS = number(0.01, 1000, 25.0)
CONFIDENCE = number(0.01, 0.99, 0.95)
TRUST_REGION = number(0, 1e30, 100.0)


class World:
    """Right values, made when they are first asked for; everything is tiny."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.made = {}

    def __getattr__(self, name):
        made = self.__dict__["made"]
        if name not in made:
            made[name] = _MAKERS[name](self)
        return made[name]

    def of(self, kind):
        """An instance of a class, to call its methods on."""
        return getattr(self, _INSTANCES[kind])


_MAKERS, _INSTANCES = {}, {}


def makes(name, *classes):
    def keep(function):
        _MAKERS[name] = function
        _INSTANCES.update(dict.fromkeys(classes, name))
        return function

    return keep


@makes("robot", "robot.robot.Robot")
def _(world):
    return tiny_robot(world.folder)


@makes("agent", "agent.agent.Agent")
def _(world):
    return tiny_agent(world.robot)


@makes("agent_folder")
def _(world):
    from shapebody.agent.store import save_agent

    return save_agent(world.agent, world.folder / "agent")


@makes("space", "design.space.DesignSpace")
def _(world):
    from shapebody.design.space import DesignSpace

    return DesignSpace(world.robot)


@makes("task")
def _(world):
    from shapebody.task.config import TaskConfig

    return TaskConfig()


@makes("bodies")
def _(world):
    """Embodiments of two designs, without compiling the map."""
    from shapebody.design.phi import MODEL_FIELDS, Embodiment

    model = world.robot.model
    fields = {name: np.stack([getattr(model, name)] * 2) for name in MODEL_FIELDS}
    rest = {
        name: np.zeros(2) for name in Embodiment.__dataclass_fields__ if name not in MODEL_FIELDS
    }
    return Embodiment(**fields, **rest)


@makes("descriptions")
def _(world):
    from shapebody.networks import inputs

    parts = dict(
        joints=np.zeros((2, inputs.JOINT_DESCRIPTION), np.float32),
        joint_mask=np.ones(2),
        feet=np.zeros((2, inputs.FOOT_DESCRIPTION), np.float32),
        foot_mask=np.ones(2),
        static=np.zeros(inputs.STATIC, np.float32),
    )
    return types.SimpleNamespace(**parts)


@makes("observation")
def _(world):
    return jax.tree.map(lambda x: x[0], world.agent.states)


@makes("objective", "optimizers.objective.Objective")
def _(world):
    from shapebody.optimizers.objective import Objective

    return Objective.of(world.agent, world.robot)


@makes("designs_critic", "optimizers.objective.DesignCritic")
def _(world):
    return world.objective.design_critic


@makes("env", "task.env.Locomotion")
def _(world):
    from shapebody.task.env import Locomotion

    return Locomotion(world.robot, 2, "native", threads=1)


@makes("state")
def _(world):
    """A state that nothing looks into: wrong arguments are refused before."""
    from shapebody.task.episode import Episode

    return object.__new__(Episode)


@makes("physics", "physics.native.NativePhysics")
def _(world):
    return world.env.groups[0].physics


@makes("mjx", "physics.mjx.MjxPhysics")
def _(world):
    from shapebody.physics.mjx import MjxPhysics

    return MjxPhysics(world.robot, 2)


@makes("mjx_state")
def _(world):
    from shapebody.physics.mjx import PhysicsState

    return object.__new__(PhysicsState)


@makes("renderer", "show.render.Renderer")
def _(world):
    from shapebody.show.render import Renderer

    return Renderer(world.robot.model, 32, 32, opengl=False)


@makes("scene", "show.scene.Scene")
def _(world):
    from shapebody.show.scene import Scene

    return Scene([])


@makes("axes")
def _(world):
    import matplotlib.figure

    return matplotlib.figure.Figure().subplots()


@makes("evaluation", "evaluation.evaluate.Evaluation")
def _(world):
    from shapebody.evaluation.evaluate import Evaluation

    rows = np.zeros((2, 3), np.float32)
    names = ("robot", "engine", "seed", "coefficient", "task")
    return Evaluation(rows, rows, rows, rows == 0, 1.0, dict.fromkeys(names))


@makes("train_config")
def _(world):
    from shapebody.training.config import TrainConfig

    return TrainConfig.smoke(str(world.robot.path), name="tiny")


@makes("trainer", "training.trainer.Trainer")
def _(world):
    """Without networks and environments."""
    from shapebody.training.trainer import Trainer

    trainer = object.__new__(Trainer)
    trainer.config, trainer.folder = world.train_config, world.folder
    return trainer


@makes("runs")
def _(world):
    from shapebody.reproduction.design_study import Run

    return (Run("vgds", 20.0),)


@makes("records")
def _(world):
    row = {"origin": "start", "trust_region": None, "start": 0, "returns": [1.0, 2.0]}
    row |= {"critic": None, "tracking_error": 0.1, "length": 3.0, "size": [0.0] * 3}
    row |= {"design": 0, "return": 1.0, "method": "none", "over": "start"}
    return [row, {**row, "origin": "reference"}]


@makes("report", "robot.report.Report")
def _(world):
    from shapebody.robot.report import Report

    return Report(world.robot.path, world.robot, (), (), ())


@makes("curve")
def _(world):
    path = world.folder / "curve.csv"
    path.write_text("steps,coefficient\n1,0.5\n2,1\n")
    return path


@makes("cma_es", "optimizers.cma_es.CMAESConfig")
def _(world):
    from shapebody.optimizers.cma_es import CMAESConfig

    return CMAESConfig()


@makes("steps")
def _(world):
    from shapebody.optimizers.loop import Steps

    return Steps(len, len, len)


@functools.cache
def config_right(module, name):
    """The default of a configuration without obligatory fields."""
    import importlib

    return getattr(importlib.import_module(f"shapebody.{module}"), name)()


def config(module, name):
    return thing(lambda world: config_right(module, name))
