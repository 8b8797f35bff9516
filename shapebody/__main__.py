"""Command line: python -m shapebody train | anneal | sharpen | design | evaluate | validate."""

import argparse
import os
import sys

# Actor and learner share the cores of a CPU; XLA's own thread pool would get in their way.
# It must be said before JAX starts.
_FLAG = "--xla_cpu_multi_thread_eigen=false"

_REPLACE = "replace the saved agent even if it has more steps, or a critic made by sharpen"


def parser() -> argparse.ArgumentParser:
    """The commands and their options."""
    parser = argparse.ArgumentParser(prog="python -m shapebody", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    train = commands.add_parser("train", help="train an agent, or continue its training")
    train.add_argument("robots", nargs="+", help="names in data/robots, or MJCF files")
    train.add_argument("--name", help="name of the agent (default: the robot's)")
    train.add_argument("--scale", choices=("smoke", "reduced", "full"), help="default: reduced")
    train.add_argument("--hours", type=float, help="stop after this time; run again to continue")
    train.add_argument("--steps", type=int, help="stop at this many environment steps in all")
    train.add_argument(
        "--state-only", action="store_true", help="leave the saved agent as it is; anneal later"
    )
    train.add_argument("--replace", action="store_true", help=_REPLACE)

    anneal = commands.add_parser(
        "anneal", help="save an agent from an unfinished run, after a last part at a falling rate"
    )
    anneal.add_argument("agent")
    anneal.add_argument("--steps", type=int, default=1_640_000, help="of that part")
    anneal.add_argument("--hours", type=float, help="stop after this time; run again to continue")
    anneal.add_argument("--replace", action="store_true", help=_REPLACE)

    sharpen = commands.add_parser(
        "sharpen", help="policy evaluation: a new critic for an agent's frozen policy"
    )
    sharpen.add_argument("agent")
    sharpen.add_argument("--steps", type=int, help="12 %% of those of training if not given")
    sharpen.add_argument("--hours", type=float, help="stop after this time; run again to continue")

    sharpen.add_argument(
        "--task-of",
        choices=("evaluation", "training"),
        default="evaluation",
        help="which task the critic learns: that of the evaluation of designs (default), or that "
        "of the policy's training",
    )

    design = commands.add_parser("design", help="search for a better body")
    design.add_argument("robot", help="name in data/robots, or an MJCF file")
    design.add_argument("--agent", help="default: the agent named as the robot")
    design.add_argument("--method", default="vgds")
    design.add_argument("--start", type=int, help="start design number (default: the reference)")
    design.add_argument("--seed", type=int, default=0)
    design.add_argument("--trust-region", type=float, default=100.0, help="lambda (default 100)")
    design.add_argument(
        "--freeze",
        nargs="*",
        default=["size"],
        metavar="NAME",
        help="parameters that stay as they are (default: size, the scale of the whole body; "
        "alone, it frees all, as in the paper)",
    )
    design.add_argument("--out", help="write the found body to this MJCF file")

    evaluate = commands.add_parser("evaluate", help="return and tracking error of an agent")
    evaluate.add_argument("agent")
    evaluate.add_argument("--robot", help="default: the agent's first robot")
    evaluate.add_argument("--start", type=int, help="start design number (default: the reference)")
    evaluate.add_argument("--episodes", type=int, default=200)
    evaluate.add_argument("--seed", type=int, default=0, help="of the episodes")

    validate = commands.add_parser("validate", help="what the method sees in a robot file")
    validate.add_argument("robot", help="an MJCF or URDF file, or a name in data/robots")
    validate.add_argument("--out", help="write the completed file to this MJCF file")

    for command in (train, anneal, sharpen, evaluate):
        command.add_argument("--engine", choices=("auto", "native", "mjx"), default="auto")

    return parser


def main(arguments=None) -> int:
    """Run a command; returns its exit status. Errors are one line on stderr."""
    options = parser().parse_args(arguments)
    if options.command in ("train", "anneal", "sharpen"):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_FLAG}".strip()
    try:
        if options.command == "validate":
            return _validate(options)
        from shapebody.runtime import enable_compilation_cache

        enable_compilation_cache()
        {
            "train": _train,
            "anneal": _anneal,
            "sharpen": _sharpen,
            "design": _design,
            "evaluate": _evaluate,
        }[options.command](options)
    except (ValueError, OSError, ImportError) as error:
        print(f"shapebody: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("shapebody: interrupted", file=sys.stderr)
        return 130
    return 0


def _train(options):
    from shapebody.reproduction.scale import scale
    from shapebody.training.config import TrainConfig
    from shapebody.training.run_state import as_continued
    from shapebody.training.train import train

    changes = {"robots": tuple(options.robots)}
    if options.name is not None:
        changes["name"] = options.name
    config = TrainConfig.at_scale(options.scale or scale(), options.robots[0], **changes)
    config, seconds = as_continued(config), _seconds(options)
    agent = train(
        config,
        max_steps=options.steps,
        max_seconds=seconds,
        engine=options.engine,
        state_only=options.state_only,
        replace=options.replace,
    )
    if agent is not None:
        print(f"agent {agent.name}: {agent.metadata['steps']:,} steps")


def _seconds(options) -> float | None:
    """--hours in seconds."""
    from shapebody.arguments import require_number

    return None if options.hours is None else 3600 * require_number("--hours", options.hours, 0)


def _anneal(options):
    from shapebody.training.train import anneal

    agent = anneal(
        options.agent,
        options.steps,
        max_seconds=_seconds(options),
        engine=options.engine,
        replace=options.replace,
    )
    if agent is None:
        print("not finished: the agent is as it was, the same command continues")
    else:
        print(f"agent {agent.name}: {agent.metadata['steps']:,} steps")


def _sharpen(options):
    from shapebody.agent.store import agent_folder, load_agent
    from shapebody.networks.config import CriticConfig
    from shapebody.training.policy_evaluation import train_critic

    seconds, agent = _seconds(options), load_agent(options.agent)
    full = agent.metadata.get("scale") == "full"
    sharper = train_critic(
        agent,
        CriticConfig() if full else CriticConfig.sharp(),
        options.steps,
        folder=agent_folder(options.agent),
        max_seconds=seconds,
        engine=options.engine,
        task_of=options.task_of,
    )
    if sharper is agent:
        print("not finished: the agent is as it was, the same command continues")
    else:
        steps = sharper.metadata["policy_evaluation"]["steps"]
        print(f"agent {sharper.name}: a critic of {steps:,} steps of policy evaluation")


def _design(options):
    import numpy as np

    from shapebody.agent.store import load_agent
    from shapebody.analysis.advice import large_changes
    from shapebody.design.space import DesignSpace
    from shapebody.files import atomic_write
    from shapebody.optimizers.objective import Objective
    from shapebody.optimizers.search import search
    from shapebody.robot.robot import load_robot

    robot = load_robot(options.robot)
    _check_out(options.out, robot)
    agent = load_agent(robot.name if options.agent is None else options.agent)
    _warn_of_another_robot(agent, robot)
    space = DesignSpace(robot)
    f = space.reference if options.start is None else space.start(options.start)
    frozen, weight = tuple(options.freeze), options.trust_region
    found = search(
        options.method, agent, robot, f, trust_region=weight, seed=options.seed, frozen=frozen
    )
    print(f"{found.method}: {found.evaluations} critic evaluations, {found.seconds:.1f} s")
    print(f"frozen: {', '.join(frozen) or 'nothing'}")
    objective = Objective.of(agent, robot, weight, frozen=frozen)
    print(f"objective {float(objective(f[None])[0]):.2f} -> {found.objective:.2f}")
    for label, index in space.groups.items():
        change = float(np.sqrt(np.mean(found.design[index] ** 2)))
        print(f"  {label:32s} RMS change from the reference {change:.3f}")
    for change in large_changes(space, found.design):
        print(f"shapebody: warning: another robot: {change}", file=sys.stderr)
    if options.out:
        print(f"wrote {atomic_write(options.out, space.to_mjcf(found.design))}")


def _check_out(out, robot) -> None:
    """Before a search: whether its result can be written."""
    from shapebody.arguments import require_output

    if out is None:
        return
    path = require_output("--out", out)
    if path.exists() and robot.path is not None and path.samefile(robot.path):
        raise ValueError(
            f"--out is {out}, the file of the robot itself, whose reference body would be lost; "
            "give another name"
        )
    path.absolute().parent.mkdir(parents=True, exist_ok=True)


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


def _validate(options) -> int:
    from shapebody.arguments import require_output
    from shapebody.robot.report import validate_robot

    if options.out is not None:
        require_output("--out", options.out)
    report = validate_robot(options.robot)
    print(report)
    if options.out is not None:
        print(f"\nwrote {report.write(options.out)}")
    return 0 if report.ok else 1


def _evaluate(options):
    from shapebody.agent.store import load_agent
    from shapebody.design.space import DesignSpace
    from shapebody.evaluation.evaluate import evaluate
    from shapebody.robot.robot import load_robot

    agent = load_agent(options.agent)
    # Its configuration has the files of robots that are not among the shipped ones.
    trained = agent.metadata.get("config", {}).get("robots", agent.robots)
    robot = load_robot(trained[0] if options.robot is None else options.robot)
    _warn_of_another_robot(agent, robot)
    space = DesignSpace(robot)
    f = space.reference if options.start is None else space.start(options.start)
    score = evaluate(
        agent, robot, f, episodes=options.episodes, seed=options.seed, engine=options.engine
    )
    print(score.summary())


if __name__ == "__main__":
    sys.exit(main())
