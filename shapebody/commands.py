"""The commands of `python -m shapebody`, as functions whose arguments tyro reads from the shell.

Each is built when it is asked for, by a function that imports no more than it needs and whose
docstring is the command's line in the overview.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from shapebody.arguments import require_integer, require_number, require_output

Engine = Literal["auto", "native", "mjx"]
RobotName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROBOT")]
AgentName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="AGENT")]


def _train(words):
    """train an agent from nothing, on one robot or several"""
    from shapebody.reproduction.scale import scale
    from shapebody.training.config import TrainConfig

    count = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    robots, words = tuple(words[:count]), words[count:]
    if not robots and not {"-h", "--help"} & set(words):
        raise ValueError("train needs a robot: a name in data/robots, or an MJCF or URDF file")
    robots, chosen = robots or ("ROBOT",), _value_of("--scale", words) or scale()
    default = TrainConfig.at_scale(chosen, robots[0], robots=robots)

    def train(
        settings: Annotated[TrainConfig, tyro.conf.arg(name="")] = default,
        hours: float | None = None,
        steps: int | None = None,
        state_only: bool = False,
        replace: bool = False,
        engine: Engine = "auto",
    ):
        """Train an agent on a robot, or on several that share the environments.

        ROBOT is a name in data/robots, or an MJCF or URDF file. A run that is in the agent's folder
        already is continued if its settings are the same. The first options are of this call, the
        others are settings of the run: of PPO, then of the policy, the critic and the task.

        Args:
            settings: of the run.
            hours: stop after this time; run again to continue.
            steps: stop at this many environment steps in all.
            state_only: leave the saved agent as it is; `anneal` makes one later.
            replace: replace the saved agent even if it has more steps or a critic of its own.
            engine: native is MuJoCo in C, mjx is JAX; auto: native on a CPU.
        """
        from shapebody.training.train import train

        agent = train(
            settings,
            max_steps=_steps(steps),
            max_seconds=_seconds(hours),
            engine=engine,
            state_only=state_only,
            replace=replace,
        )
        _tell(agent)

    _prepare()
    return train, words


def _continue(words):
    """continue a training run with the settings that it has"""

    def continue_run(
        agent: AgentName,
        hours: float | None = None,
        steps: int | None = None,
        state_only: bool = False,
        replace: bool = False,
        engine: Engine = "auto",
    ):
        """Continue the training run of an agent: exactly, or a shipped one with new episodes.

        Args:
            agent: name in data/checkpoints, or a folder.
            hours: stop after this time; run again to continue.
            steps: stop at this many environment steps in all.
            state_only: leave the saved agent as it is; `anneal` makes one later.
            replace: replace the saved agent even if it has more steps or a critic of its own.
            engine: that of the run, or auto.
        """
        from shapebody.training.train import continue_run

        _tell(
            continue_run(
                agent,
                max_steps=_steps(steps),
                max_seconds=_seconds(hours),
                engine=engine,
                state_only=state_only,
                replace=replace,
            )
        )

    _prepare()
    return continue_run, words


def _anneal(words):
    """save an agent from an unfinished run, at a falling learning rate"""

    def anneal(
        agent: AgentName,
        steps: int = 1_640_000,
        hours: float | None = None,
        replace: bool = False,
        engine: Engine = "auto",
    ):
        """Save an agent from a copy of its run, after a last part at a falling learning rate.

        Args:
            agent: name in data/checkpoints, or a folder.
            steps: environment steps of that last part.
            hours: stop after this time; run again to continue.
            replace: replace the saved agent even if it has more steps or a critic of its own.
            engine: that of the run, or auto.
        """
        from shapebody.training.train import anneal

        made = anneal(agent, steps, max_seconds=_seconds(hours), engine=engine, replace=replace)
        _tell(made, "not finished: the agent is as it was, the same command continues")

    _prepare()
    return anneal, words


def _policy_evaluation(words):
    """train a new critic for an agent's frozen policy"""
    from shapebody.networks.config import CriticConfig

    sharp = CriticConfig.sharp()

    def policy_evaluation(
        agent: AgentName,
        critic: CriticConfig = sharp,
        steps: int | None = None,
        hours: float | None = None,
        task_of: Literal["evaluation", "training"] = "evaluation",
        engine: Engine = "auto",
    ):
        """Freeze an agent's policy and train a new critic on its rollouts.

        Args:
            agent: name in data/checkpoints, or a folder.
            critic: its sizes; the paper's for agents of scale `full`, where none are given.
            steps: environment steps; 12 % of those of training if not given.
            hours: stop after this time; run again to continue.
            task_of: which task the critic learns: that on which designs are evaluated, or that of
                the policy's training.
            engine: native is MuJoCo in C, mjx is JAX; auto: native on a CPU.
        """
        from shapebody.agent.store import agent_folder, load_agent
        from shapebody.training.policy_evaluation import train_critic

        seconds, known = _seconds(hours), load_agent(agent)
        full = known.metadata.get("scale") == "full" and critic == sharp
        made = train_critic(
            known,
            CriticConfig() if full else critic,
            steps,
            folder=agent_folder(agent),
            max_seconds=seconds,
            engine=engine,
            task_of=task_of,
        )
        if made is known:
            print("not finished: the agent is as it was, the same command continues")
        else:
            count = made.metadata["policy_evaluation"]["steps"]
            print(f"agent {made.name}: a critic of {count:,} steps of policy evaluation")

    _prepare()
    return policy_evaluation, words


def _design(words):
    """search for a better body"""
    from shapebody.arguments import require_choice
    from shapebody.optimizers.search import METHODS

    name = require_choice("--method", _value_of("--method", words) or "vgds", METHODS)
    kind = METHODS[name].config

    def design(
        robot: RobotName,
        settings: Annotated[kind, tyro.conf.arg(name="")] = kind(),  # noqa: B008
        agent: str | None = None,
        method: str = name,
        start: int | None = None,
        seed: int = 0,
        trust_region: float = 100.0,
        freeze: tuple[str, ...] = ("size",),
        out: str | None = None,
    ):
        """Search for a better body of a robot, as its agent's critic judges bodies.

        Args:
            robot: name in data/robots, or an MJCF or URDF file.
            settings: of the search method.
            agent: name in data/checkpoints, or a folder; the agent named as the robot if not given.
            method: vgds, or another name of shapebody.METHODS.
            start: number of a start design; the reference if not given.
            seed: of the search.
            trust_region: weight λ of the soft trust region.
            freeze: parameters that stay as they are, such as size (the scale of the whole body),
                mass or Trunk; none frees all, as in the paper.
            out: write the found body to this MJCF file.
        """
        return _search(robot, settings, agent, method, start, seed, trust_region, freeze, out)

    _prepare()
    return design, words


def _search(robot, settings, agent, method, start, seed, trust_region, freeze, out):
    from shapebody.agent.store import load_agent
    from shapebody.analysis.advice import changes, large_changes
    from shapebody.design.space import DesignSpace
    from shapebody.files import atomic_write
    from shapebody.optimizers.objective import Objective
    from shapebody.optimizers.search import search
    from shapebody.robot.robot import load_robot

    if start is not None:
        require_integer("--start", start, 0)
    freeze = () if freeze == ("none",) else freeze
    robot = load_robot(robot)
    _check_out(out, robot)
    agent = load_agent(robot.name if agent is None else agent)
    _warn_of_another_robot(agent, robot)
    space = DesignSpace(robot)
    f = space.reference if start is None else space.start(start)
    chosen = dict(trust_region=trust_region, seed=seed, frozen=freeze)
    found = search(method, agent, robot, f, **chosen, **dataclasses.asdict(settings))
    print(f"{found.method}: {found.evaluations} critic evaluations, {found.seconds:.1f} s")
    print(f"frozen: {', '.join(freeze) or 'nothing'}")
    objective = Objective.of(agent, robot, trust_region, frozen=freeze)
    print(f"objective {float(objective(f[None])[0]):.2f} -> {found.objective:.2f}")
    print(changes(space, found.design))
    for change in large_changes(space, found.design):
        print(f"shapebody: warning: another robot: {change}", file=sys.stderr)
    if out:
        print(f"wrote {atomic_write(out, space.to_mjcf(found.design))}")


def _evaluate(words):
    """return and tracking error of an agent on a body"""
    from shapebody.evaluation.evaluate import EvaluationConfig

    default = EvaluationConfig()

    def evaluate(
        agent: AgentName,
        settings: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = default,
        robot: str | None = None,
        start: int | None = None,
        seed: int = 0,
        engine: Engine = "auto",
    ):
        """Let an agent's policy walk with a body, and print its return and tracking error.

        Args:
            agent: name in data/checkpoints, or a folder.
            settings: of the evaluation.
            robot: name in data/robots, or a file; the agent's first robot if not given.
            start: number of a start design; the reference if not given.
            seed: seed of the episodes: the same seed, the same episodes.
            engine: native is MuJoCo in C, mjx is JAX; auto: native on a CPU.
        """
        from shapebody.agent.store import load_agent
        from shapebody.design.space import DesignSpace
        from shapebody.evaluation.evaluate import evaluate
        from shapebody.robot.robot import load_robot

        known = load_agent(agent)
        # Its configuration has the files of robots that are not among the shipped ones.
        trained = known.metadata.get("config", {}).get("robots", known.robots)
        body = load_robot(trained[0] if robot is None else robot)
        _warn_of_another_robot(known, body)
        space = DesignSpace(body)
        f = space.reference if start is None else space.start(start)
        print(evaluate(known, body, f, seed=seed, engine=engine, config=settings).summary())

    _prepare()
    return evaluate, words


def _validate(words):
    """what the method sees in a robot file"""

    def validate(
        robot: RobotName,
        out: str | None = None,
    ) -> int:
        """Say what the method sees in a robot file, what it infers, and what looks wrong.

        Args:
            robot: an MJCF or URDF file, or a name in data/robots.
            out: write the completed file to this MJCF file.
        """
        from shapebody.robot.report import validate_robot

        if out is not None:
            require_output("--out", out)
        report = validate_robot(robot)
        print(report)
        if out is not None:
            print(f"\nwrote {report.write(out)}")
        return 0 if report.ok else 1

    return validate, words


COMMANDS = {
    "train": _train,
    "continue": _continue,
    "anneal": _anneal,
    "policy-evaluation": _policy_evaluation,
    "design": _design,
    "evaluate": _evaluate,
    "validate": _validate,
}


# ------------------------------------------------------------------ what they share


def _prepare() -> None:
    from shapebody.runtime import enable_compilation_cache

    enable_compilation_cache()


def _value_of(flag: str, words) -> str | None:
    """The value of an option that decides which others there are, read before the rest."""
    for word, following in zip(words, [*words[1:], None], strict=False):
        if word == flag:
            return following
        if word.startswith(f"{flag}="):
            return word.partition("=")[2]
    return None


def _seconds(hours: float | None) -> float | None:
    return None if hours is None else 3600 * require_number("--hours", hours, 0)


def _steps(steps: int | None) -> int | None:
    return None if steps is None else require_integer("--steps", steps, 1)


def _tell(agent, otherwise: str = "") -> None:
    if agent is not None:
        print(f"agent {agent.name}: {agent.metadata['steps']:,} steps")
    elif otherwise:
        print(otherwise)


def _check_out(out, robot) -> None:
    """Before a search: whether its result can be written."""
    if out is None:
        return
    path = require_output("--out", out)
    if path.exists() and robot.path is not None and path.samefile(robot.path):
        raise ValueError(
            f"--out is {out}, the file of the robot itself, whose reference body would be lost; "
            "give another name"
        )
    if not (folder := Path(path).absolute().parent).is_dir():
        folder.mkdir(parents=True)
        print(f"made the folder {folder}")


def _warn_of_another_robot(agent, robot) -> None:
    """Say so if the robot, or its file, is not one on which the agent was trained."""
    if robot.name not in agent.robots:
        print(
            f"shapebody: warning: agent {agent.name} was trained on {', '.join(agent.robots)}, not "
            f"on {robot.name}; what it says of this robot is a guess",
            file=sys.stderr,
        )
        return
    phases = agent.metadata.get("phases") or [{}]
    known = phases[0].get("robots", {}).get(robot.name, robot.hash)
    if known != robot.hash:
        print(
            f"shapebody: warning: the file of robot {robot.name} is not the one on which agent "
            f"{agent.name} was trained; what it says of other bodies is a guess",
            file=sys.stderr,
        )
