"""Speed of the parts: python benchmarks/run.py [names...] [--out FILE]

Every benchmark runs in a process of its own, on an otherwise idle machine if the numbers are to
mean anything. Prints a table and writes it, with the machine and the versions, as JSON.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

ROBOT = "unitree_go2"
ENVIRONMENTS = 256


def best(function, repeats=3):
    """Shortest wall time of several calls, in seconds: the least disturbed one."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times)


def import_time():
    """In a fresh process, interpreter start excluded: the package, and all its public names."""

    def run(code):
        return best(lambda: subprocess.run([sys.executable, "-c", code], check=True), 5)

    everything = "import shapebody as sb; [getattr(sb, name) for name in sb.__all__]"
    idle = run("pass")
    return {
        "import shapebody": (run("import shapebody") - idle, "s"),
        "import of everything in it": (run(everything) - idle, "s"),
    }


def engine():
    """C MuJoCo alone: random designs, random targets, 4 substeps per control step."""
    import jax
    import numpy as np

    from shapebody.design.space import DesignSpace
    from shapebody.physics.native import NativePhysics
    from shapebody.robot.robot import load_robot

    robot = load_robot(ROBOT)
    space = DesignSpace(robot)
    physics = NativePhysics(robot, ENVIRONMENTS)
    designs = np.stack([space.start(i) for i in range(ENVIRONMENTS)])
    embodiments = jax.tree.map(np.asarray, jax.jit(jax.vmap(space))(designs))
    ids = np.arange(ENVIRONMENTS)
    physics.set_designs(ids, embodiments)
    rng = np.random.default_rng(0)
    controls = robot.nominal + 0.1 * rng.normal(size=(50, ENVIRONMENTS, robot.num_actuators))

    def steps():
        for control in controls:
            physics.step(control)

    steps()
    write = best(lambda: physics.set_designs(ids, embodiments)) / ENVIRONMENTS
    return {
        "C engine alone": (50 * ENVIRONMENTS / best(steps), "control steps/s"),
        "write a design into C": (1e6 * write, "microseconds"),
    }


def _environment(engine, count, length):
    import jax

    from shapebody.robot.robot import load_robot
    from shapebody.task.env import Locomotion

    def act(params, key, descriptions, observation):
        return 0.3 * jax.random.normal(key, observation.joints.shape[:-1]), ()

    env = Locomotion(load_robot(ROBOT), count, engine=engine)
    began = time.perf_counter()
    state = env.reset(jax.random.PRNGKey(0), spread=True)
    state, trajectory = env.rollout(act, None, state, jax.random.PRNGKey(1), length)
    jax.block_until_ready(trajectory.reward)
    first = time.perf_counter() - began
    holder = [state]

    def run():
        holder[0], trajectory = env.rollout(act, None, holder[0], jax.random.PRNGKey(2), length)
        jax.block_until_ready(trajectory.reward)

    return count * length / best(run), first


def environment():
    """The whole environment on C MuJoCo with random actions, resets to new designs included.

    The engine's own share is timed inside it, because the same bodies in the same motion are what
    the rest of the environment has to be compared with: bodies that fall and restart cost more
    than the standing ones of the benchmark "engine".
    """
    from shapebody.physics.native import NativePhysics

    step, inside = NativePhysics.step, []

    def timed(self, *arguments, **options):
        began = time.perf_counter()
        result = step(self, *arguments, **options)
        inside.append(time.perf_counter() - began)
        return result

    NativePhysics.step = timed
    length = 64
    speed, first = _environment("native", ENVIRONMENTS, length)
    runs = [sum(inside[i : i + length]) for i in range(length, len(inside), length)]
    return {
        "environment, C engine": (speed, "control steps/s"),
        "C engine inside it": (ENVIRONMENTS * length / min(runs), "control steps/s"),
        "environment, first call": (first, "s"),
    }


def fifty():
    """Training on all shipped robots at once, with the reduced networks: speed and memory."""
    import resource

    from shapebody.robot.robot import robots
    from shapebody.training.config import TrainConfig
    from shapebody.training.trainer import Trainer

    config = TrainConfig.reduced(
        ROBOT, robots=tuple(robots()), name="fifty", num_envs=400, minibatch_size=3200
    )
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        trainer = Trainer(config, folder)
        trainer.start()
        trainer.run(max_steps=2 * config.batch, progress=False)
        first = time.perf_counter() - began
        began = time.perf_counter()
        trainer.run(max_steps=12 * config.batch, progress=False)
        speed = 10 * config.batch / (time.perf_counter() - began)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    if sys.platform == "darwin":
        memory /= 2**10  # bytes there, kilobytes elsewhere
    return {
        "training on 50 robots, 400 at once": (speed, "environment steps/s"),
        "training on 50 robots, start and 2 iterations": (first, "s"),
        "training on 50 robots, memory": (memory, "GiB"),
    }


def mjx():
    """The whole environment on MJX, one jitted scan."""
    import jax

    cpu = jax.default_backend() == "cpu"
    count, length = (64, 16) if cpu else (4096, 64)
    speed, first = _environment("mjx", count, length)
    device = jax.devices()[0].device_kind
    return {
        f"environment, MJX on {device}, {count} at once": (speed, "control steps/s"),
        "environment, MJX, first call": (first, "s"),
    }


def training():
    """Training end to end at scale reduced: actor and learner together."""
    from shapebody.training.config import TrainConfig
    from shapebody.training.trainer import Trainer

    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(TrainConfig.reduced(ROBOT), folder)
        trainer.start()
        trainer.run(max_steps=4 * trainer.config.batch, progress=False)
        began, first = time.perf_counter(), trainer.steps
        trainer.run(max_steps=first + 40 * trainer.config.batch, progress=False)
        speed = (trainer.steps - first) / (time.perf_counter() - began)
    return {"training, reduced": (speed, "environment steps/s")}


def search():
    """VGDS with the shipped agent, after compilation."""
    import numpy as np

    from shapebody.agent.store import load_agent
    from shapebody.design.space import DesignSpace
    from shapebody.optimizers.search import search
    from shapebody.robot.robot import load_robot

    robot, agent = load_robot(ROBOT), load_agent(ROBOT)
    space = DesignSpace(robot)
    starts = np.stack([space.start(i) for i in range(10)])
    rows = {}
    for label, f in [("one design", starts[0]), ("ten designs", starts)]:
        search("vgds", agent, robot, f)
        rows[f"VGDS, {label}"] = (best(lambda f=f: search("vgds", agent, robot, f)), "s")
    return rows


def baselines():
    """Every other method from ten starts in one call, without compilation, for all robots of the
    single-robot experiments. BO, where BoTorch is installed, for one of them: it takes minutes."""
    import numpy as np

    from shapebody.agent.store import load_agent
    from shapebody.design.space import DesignSpace
    from shapebody.optimizers.search import search
    from shapebody.reproduction import paper
    from shapebody.reproduction.design_study import METHOD_RUNS, installed
    from shapebody.reproduction.scale import trained_robots
    from shapebody.robot.robot import load_robot

    rows = {}
    for name in trained_robots(paper.ROBOTS):
        robot, agent = load_robot(name), load_agent(name)
        space = DesignSpace(robot)
        starts = np.stack([space.start(i) for i in range(10)])
        where = "" if name == ROBOT else f", {name}"
        for run in installed(METHOD_RUNS):
            if run.method == "vgds" and name == ROBOT:
                continue  # the benchmark "search" has it
            if run.method == "bo" and name != ROBOT:
                continue
            found = search(run.method, agent, robot, starts)
            seconds = found.seconds - found.compile_seconds
            rows[f"{run.method}, ten designs{where}"] = (seconds, "s")
    return rows


def with_ratios(rows):
    """Rows with the speed of the environment over that of the C engine, as far as both are there.

    A ratio's commit is that of its two rows, or both of them.
    """
    whole = "environment, C engine"
    names = ("C engine alone", "C engine inside it")
    rows = {k: v for k, v in rows.items() if k not in [f"environment / {name}" for name in names]}
    for name in names:
        if {name, whole} <= rows.keys():
            commits = [rows[label].get("commit") or "unknown" for label in (whole, name)]
            rows[f"environment / {name}"] = {
                "value": rows[whole]["value"] / rows[name]["value"],
                "unit": "",
                "benchmark": "environment",
                "commit": " and ".join(dict.fromkeys(commits)),
            }
    return rows


BENCHMARKS = {
    "import": import_time,
    "engine": engine,
    "environment": environment,
    "training": training,
    "fifty": fifty,
    "search": search,
    "baselines": baselines,
    "mjx": mjx,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*BENCHMARKS, []], help="default: all")
    parser.add_argument("--out", default="benchmarks/results.json")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        from shapebody.runtime import enable_compilation_cache

        enable_compilation_cache()
        print(json.dumps(BENCHMARKS[options.names[0]]()))
        return
    from shapebody.reproduction.results import result_provenance

    source = result_provenance(robot=ROBOT, environments=ENVIRONMENTS)
    for name in options.names or BENCHMARKS:
        environment = dict(os.environ)
        if name in ("training", "fifty"):
            flags = environment.get("XLA_FLAGS", "")
            environment["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
        command = [sys.executable, __file__, name, "--child"]
        output = subprocess.run(
            command, env=environment, check=True, stdout=subprocess.PIPE, text=True
        ).stdout
        rows = {}
        for label, (value, unit) in json.loads(output.splitlines()[-1]).items():
            rows[label] = {"value": value, "unit": unit, "benchmark": name}
            rows[label]["commit"] = source["commit"]
            print(f"{label:52s} {value:12,.2f} {unit}", flush=True)
        rows = _written(options.out, name, rows, source)
    for label, row in rows.items():
        if label.startswith("environment / "):
            print(f"{label:52s} {row['value']:12.2f}")


def _written(path, name, rows, source):
    """Put the rows of a benchmark into the file; those of others stay. Returns all rows."""
    if os.path.exists(path):
        with open(path) as file:
            old = json.load(file)["rows"].items()
        rows = {k: row for k, row in old if row.get("benchmark", "import") != name} | rows
    rows = with_ratios(rows)
    with open(path + ".tmp", "w") as file:
        json.dump({"rows": rows, "provenance": source}, file, indent=1)
    os.replace(path + ".tmp", path)
    return rows


if __name__ == "__main__":
    main()
