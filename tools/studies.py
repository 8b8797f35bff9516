"""Bring the stored studies up to date with the shipped agents, computing only what is stale.

    python -m tools.studies                  # all three robots; minutes to hours
    python -m tools.studies golem            # one of them
    python -m tools.studies --list           # only say what is stale, and how long it once took

A study in data/results names its agent by a hash. It is stale if the shipped agent of that name is
another one now, and incomplete if parts of it are missing. Stopped, the same call goes on. Then the
notebooks that load these studies have to be executed (`make notebooks`), and the tests of studies
and claims say which numbers of README, cards and notebooks are no longer true. Bayesian
optimization needs the extra `bo`; without it, a study that is computed anew lacks that part.
"""

import time
from collections.abc import Callable
from typing import Annotated, NamedTuple

import tyro

from shapebody.agent.store import load_agent
from shapebody.files import data_dir
from shapebody.reproduction import design_study, paper, results, scale, value_studies
from shapebody.reproduction.pictures import before_after
from shapebody.robot.robot import load_robot
from shapebody.runtime import enable_compilation_cache

SHOWN = "unitree_go2"
"""The robot of README's picture, whose searches from the reference notebook 06 shows."""


class Study(NamedTuple):
    """One file of data/results."""

    file: str
    parts: tuple[str, ...]
    """Names of the parts that belong into it."""
    settings: dict | None
    """What single parts depend on, as `results.result_in_parts` takes it."""
    agent: object
    """The agent that the whole file depends on, None if it does not."""
    compute: Callable[[bool, dict], object]
    """Computes what is missing, or all of it: (recompute, settings of the stored study)."""

    def state(self) -> str:
        """ "current", "incomplete", "stale" or "missing"."""
        path = results.result_path(self.file)
        if not path.exists():
            return "missing"
        known = results.stored_parts(self.file, self.agent, self.settings, **self.stored())
        if not set(known) & set(self.parts):
            return "stale"
        return "current" if set(self.parts) <= set(known) else "incomplete"

    def stored(self) -> dict:
        """The settings of the stored study, empty if there is none."""
        path = results.result_path(self.file)
        return results.stored_result(path)["provenance"]["config"] if path.exists() else {}

    def minutes(self) -> float:
        """How long the stored study took to compute, 0 if there is none."""
        path = results.result_path(self.file)
        return results.stored_result(path)["provenance"]["seconds"] / 60 if path.exists() else 0.0


def studies(name: str) -> list[Study]:
    """The studies of the shipped agent of a robot, in the order in which they are computed."""
    robot, agent = load_robot(name), load_agent(scale.agent_name(name))
    budget, setting = scale.budget(), scale.study_setting()
    short = {} if setting["iterations"] is None else {"iterations": setting["iterations"]}
    random = dict(
        designs=budget.random_designs, episodes=budget.random_episodes, horizon=budget.horizon
    )

    def of_designs(file: str, runs, **changes) -> Study:
        runs = design_study.installed(list(dict.fromkeys(runs)))
        parts = "starts and reference", *map(design_study.part_name, runs)
        settings = design_study.search_settings(runs, **short)

        def compute(recompute, stored):
            episodes = max(setting["episodes"], stored.get("episodes", 0))
            options = {**setting, "episodes": episodes, **changes, "progress": True}
            if recompute:  # the rest is then missing, so that an interruption loses one part
                design_study.design_study(agent, robot, runs[:1], recompute=True, **options)
            design_study.design_study(agent, robot, runs, **options)

        return Study(file, parts, settings, agent, compute)

    def of_all(file: str, function, options: dict) -> Study:
        def compute(recompute, stored):
            both = {**options, **stored}
            results.result(file, lambda: function(agent, robot, **both), agent, recompute, **both)

        return Study(file, ("all",), None, agent, compute)

    runs = (*design_study.TRUST_REGION_RUNS, *design_study.METHOD_RUNS)
    if name == SHOWN:
        runs = (*design_study.SINGLE_ROBOT_RUNS, *runs)
    size = {key: setting[key] for key in ("starts", "episodes", "horizon")} | short
    return [
        Study(
            f"yardstick_{name}",
            ("shipped",),
            {"shipped": {"policy": agent.policy_hash}},
            None,
            lambda recompute, stored: value_studies.policy_yardstick(
                robot, agent, recompute=recompute, **stored
            ),
        ),
        of_all(f"value_against_return_{name}", value_studies.value_against_return, random),
        of_designs(f"design_study_{name}", runs),
        of_designs(
            f"design_study_{name}_starts_from_10", design_study.FRESH_RUNS, first_start=10, seed=1
        ),
        of_all(f"size_share_{name}", value_studies.size_share, size),
    ]


def main(
    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    list: bool = False,
) -> None:
    """Compute stale studies again.

    Args:
        robots: names; all trained ones by default.
        list: only say what is stale.
    """
    enable_compilation_cache()
    for name in robots or scale.trained_robots(paper.ROBOTS):
        for study in studies(name):
            state, minutes = study.state(), study.minutes()
            took = f", took {minutes:.0f} min" if minutes else ""
            print(f"{study.file}: {state}{took}", flush=True)
            if list or state == "current":
                continue
            began = time.perf_counter()
            study.compute(state == "stale", study.stored())
            print(f"    computed in {(time.perf_counter() - began) / 60:.1f} min", flush=True)
            if study.file == f"design_study_{SHOWN}":
                picture = data_dir() / "results" / "before_after.png"
                before_after(load_agent(name), load_robot(name), picture)


if __name__ == "__main__":
    tyro.cli(main)
