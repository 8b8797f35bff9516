"""The kinds of all parameters of all public functions, for test_arguments.py.

`FUNCTIONS` has an entry per public function, class and method; `UNCHECKED` those that are called
with what others have looked at, with the reason; `INTERNAL` the modules that are no interface. A
new public function without an entry fails the test.
"""

import numpy as np
import pandas as pd
from arguments import (
    AGENT,
    AGENT_FOLDER,
    ANGLE,
    AXES,
    CONFIDENCE,
    COUNT,
    DESIGN,
    ENGINE,
    FLAG,
    FOLDER,
    FPS,
    FRAMES,
    FUNCTION,
    HEIGHT,
    KEY,
    MODEL,
    NAME,
    OUTPUT,
    QPOS,
    RECORDS,
    ROBOT,
    ROBOT_FILE,
    ROBOT_NAME,
    RUNS,
    SEED,
    SPACE,
    STEPS,
    TASK,
    TEXT,
    TRUST_REGION,
    WRONG,
    array,
    choice,
    config,
    integer,
    labels,
    number,
    optional,
    thing,
)

from shapebody.task.trajectory import Trajectory
from shapebody.training.update import Learner

INTERNAL = {
    "commands": "the command line, see the test of its words",
    "agent.description": "reads and writes agent.json, for `agent.store`",
    "training.portable": "writes and reads states of `training.trainer`",
    "training.progress": "shows and records what `training.trainer` hands over",
    "training.replacing": "looks at folders of `training.train`",
    "training.run_state": "looks at folders of `training.trainer` and `training.train`",
    "configuration": "types of settings: the checks themselves",
    "arguments": "the checks themselves: every test here is one of them",
    "design.export": "writes embodiments of `design.space`, which has looked at the design",
    "design.parameters": "tables of a robot, called by `design.space`",
    "robot.assets": "finds and drops meshes, for `robot.importing`",
    "robot.completion": "completes compiled models, for `robot.robot`",
    "robot.entries": "reads compiled models, for `robot.robot`",
    "robot.feet": "reads compiled models, for `robot.robot` and `robot.completion`",
    "robot.finite": "looks at numbers of files, for `robot.importing` and `robot.robot`",
    "robot.foot_completion": "completes compiled models, for `robot.completion`",
    "robot.foot_shapes": "shapes of feet, for `robot.importing` and `robot.foot_completion`",
    "robot.geometry": "measures models that others have looked at",
    "robot.guard": "looks at files that `find` has found, for `robot.robot`",
    "robot.home": "completes compiled models, for `robot.completion`",
    "robot.importing": "reads files that `find` has found",
    "robot.servos": "completes compiled models, for `robot.completion`",
    "robot.simulation": "completes compiled models, for `robot.robot`",
    "robot.spec_edits": "edits MuJoCo's specifications, for `robot.completion`",
    "robot.standing": "simulates robots that `robot.report` has loaded",
    "robot.survey": "looks at the text of files, for `robot.guard`",
    "robot.urdf": "imports files that `find` has found, for `robot.importing`",
    "robot.urdf_checks": "looks at the text of files, for `robot.urdf`",
    "rotations": "formulas inside compiled code",
    "show.diagrams": "drawings of the notebooks, without data",
    "show.study_plots": "figures of records that `reproduction` computed, for the notebooks",
    "show.software_renderer": "draws models that `show.render` has looked at",
    "stored": "reads files whose paths others have looked at",
    "task.batch": "environments of `task.env`, which has looked at the arguments",
    "task.curriculum": "formulas inside compiled code, called by `task.env`",
    "task.episode": "one episode inside compiled code, called by `task.env`",
    "task.mjx_rollout": "loops of `task.env`, which has looked at the arguments",
    "task.native_rollout": "loops of `task.env`, which has looked at the arguments",
    "task.observations": "formulas inside compiled code, called by `task.env`",
    "task.randomization": "formulas inside compiled code, called by `task.env`",
    "task.sensors": "formulas inside compiled code, called by `task.env`",
    "task.trajectory": "what `task.env` returns",
    "task.whole_episodes": "plays what `evaluate` and `yardstick` have looked at",
}

RESULT = "a result: the package makes it, no user does"
FORMULA = "a formula inside compiled code, where values cannot be looked at"
INSIDE = "called through a network's `apply`, which looks at the inputs"
METHOD = "called by `search`, which has looked at everything"
ON_MODEL = "one of the checks of a compiled model, called by `robot.robot.examine`"
UNCHECKED = {
    "agent.agent.Agent": "looked at by `check_agent`, which saving and loading call",
    "design.descriptions.Descriptions": RESULT,
    "design.mirror.Mirrored": RESULT,
    "design.mirror.mirrored": FORMULA,
    "design.mirror.reversed_joints": FORMULA,
    "design.nominal_pose.Pose": RESULT,
    "design.nominal_pose.Pose.relative": FORMULA,
    "design.nominal_pose.nominal_pose": "called by `describe`, which looks at the robot",
    "training.chunks.mapped": "called by `training.update`",
    "training.chunks.number_of_chunks": "called by `training.update`",
    "training.chunks.summed": "called by `training.update`",
    "design.descriptions.Normalizer": "a row of NORMALIZERS",
    "design.descriptions.Normalizer.__call__": FORMULA,
    "design.kinematics.Frames": RESULT,
    "design.kinematics.body_kinematics": "called by `describe` and `kinematics`",
    "design.kinematics.take_columns": FORMULA,
    "design.phi.Embodiment": RESULT,
    "design.phi.Reference": "made by `reference_of`",
    "design.phi.reference_of": "called by `DesignSpace` with a robot",
    "evaluation.evaluate.Evaluation": RESULT,
    "evaluation.statistics.Gain": RESULT,
    "evaluation.statistics.float_or_array": "takes what was computed here",
    "reproduction.design_study.evaluation_config": "`EvaluationConfig` looks at the arguments",
    "reproduction.design_study.part_name": "takes a run that `design_study` has looked at",
    "reproduction.design_study.require_counts": "a check itself",
    "reproduction.design_study.search_settings": "takes runs that `design_study` has looked at",
    "design.space.DesignSpace.as_float32": "a check itself, called by `Objective` and `validate`",
    "reproduction.scale.Budget": "a row of BUDGETS",
    "task.rewards.Moment": RESULT,
    "task.rewards.Term": "a row of TERMS",
    "task.rewards.reward_terms": FORMULA,
    "networks.urma.Core": INSIDE,
    "networks.critic.Critic.act": INSIDE,
    "networks.critic.Critic.embed": INSIDE,
    "networks.critic.Critic.value": INSIDE,
    "networks.urma.PartEncoder": INSIDE,
    "networks.urma.PartEncoder.embed": INSIDE,
    "networks.policy.Policy.act": INSIDE,
    "networks.policy.Policy.embed": INSIDE,
    "networks.urma.WeightNormDense": INSIDE,
    "networks.inputs.Standardized": INSIDE,
    "networks.inputs.identity": "takes an entry of INPUT_SIZES",
    "networks.inputs.join": FORMULA,
    "networks.urma.aggregate": FORMULA,
    "networks.urma.elu": FORMULA,
    "networks.policy.entropy": FORMULA,
    "networks.policy.log_prob": FORMULA,
    "networks.policy.mean_action_policy": "called with the configuration of an agent",
    "networks.inputs.require_inputs": "a check itself, called by `Agent.act` and `Agent.values`",
    "physics.protocol.EngineOutput": RESULT,
    "physics.engine.simulator": "called by `Locomotion`, which has looked at the engine's name",
    "physics.protocol.home_sensordata": "called by the engines with the model of `prepare`",
    "physics.mjx.PhysicsState": RESULT,
    "training.update.Learner": RESULT,
    "training.trainer.Trainer.agent": "takes what `state_bank` returned",
    "evaluation.recording.Recording": RESULT,
    "robot.robot.Robot": RESULT,
    "robot.robot.examine": "takes a path of `find`",
    "robot.checks.tilt": "takes the keyframe of a compiled model",
    "optimizers.loop.Scored": RESULT,
    "optimizers.loop.Search": RESULT,
    "optimizers.loop.Steps": "a method of one's own: what it does is up to its functions",
    "optimizers.loop.last_finite": METHOD,
    "optimizers.loop.score": METHOD,
    "optimizers.loop.start_key": METHOD,
    "optimizers.loop.values_and_gradients": METHOD,
    "optimizers.gc_pfo.move": METHOD,
    "optimizers.objective.mean_value": "called by `Objective`, inside compiled code",
    "optimizers.search.Method": "a row of METHODS",
    "optimizers.search.SearchResult": RESULT,
    "optimizers.objective.DesignCritic": "made by `design_critic`",
    "optimizers.objective.DesignCritic.__call__": "called by `Objective`, inside compiled code",
    "optimizers.objective.Objective": "made by `Objective.of`",
    "robot.report.Report": RESULT,
}
UNCHECKED |= {
    "show.plots.legend_beside": "takes axes that the caller has drawn in",
    "show.plots.panels": "called by the figures of studies",
    "show.tables.Folded": "made by the tables of notebooks",
    "optimizers.loop.initial_population": METHOD,
    "show.opengl.say_once": "prints one of this package's messages",
    "show.render.model_of": "a check itself",
    "show.render.require_camera": "a check itself",
    "show.render.require_qpos": "a check itself",
    "show.tables.Table": RESULT,
    "show.tables.interval": "writes down what `paired_gain` and `gains` return",
    "training.config.as_robots": "a check itself, called by `TrainConfig`",
    "training.config.located": "takes a robot of a `TrainConfig`",
    "training.config.robot_name": "a check itself, called by `TrainConfig`",
    "agent.agent.flat_states": "takes an agent that `check_agent` has looked at",
    "agent.agent.flat_weights": "takes an agent that `check_agent` has looked at",
    "agent.agent.hash_arrays": "takes what `flat_weights` or `flat_states` returned",
    "agent.store.expected_weights": "takes configurations, which are checked when made",
    "agent.store.state_shapes": "takes `Sizes`, which are checked when made",
    "reproduction.critic_ablation.critic_tasks": "`compare_critics` looks at the arguments",
    "training.policy_evaluation.evaluation_config": "called by `train_critic`, which has looked",
    "training.rollout.collect_states": "called by `Trainer.state_bank`",
    "training.train.run_or_interrupt": "takes a `Trainer`, which looks at the rest",
    "training.trainer.Trainer.alone": "takes nothing",
    "training.update.Batch": RESULT,
    "training.yardstick.Measured": RESULT,
    "training.yardstick.curve_columns": "called by `Trainer.run`",
    "training.yardstick.due": "called by `Trainer.run`",
    "training.diagnosis.Diagnosis": RESULT,
    "training.critics.CriticScores": RESULT,
    "training.critics.CriticsTrainer": "made by `train_critics`",
    "training.critics.CriticsTrainer.everything": "takes nothing",
    "agent.agent.require_critic": "a check itself",
    "training.diagnosis.Diagnosis.sentence": "takes nothing",
    "training.rollout.require_state_bank": "a check itself, called by `Trainer`",
    "training.trainer.Trainer.diagnosis": "takes nothing",
    "training.update.require_variables": "a check itself, called by `init_learner`",
}
UNCHECKED |= dict.fromkeys(
    (
        f"training.losses.{name}"
        for name in (
            "approximate_kl clipped_share command_changes entropy_bonus importance_weight moments "
            "normalized policy_ratio step_weights surrogate_loss value_loss"
        ).split()
    ),
    FORMULA,
)
UNCHECKED |= dict.fromkeys(
    (
        f"training.update.{name}"
        for name in (
            "apply_at_steps constants critic_loss descend gradient_step gradient_steps "
            "learned_policy learning_rate minibatch_rows optimizer policy_loss prepare"
        ).split()
    ),
    FORMULA,
)
UNCHECKED |= dict.fromkeys(
    (
        f"training.rollout.{name}"
        for name in (
            "Actor Actor.begin Actor.repeat Actor.reset Actor.result Actor.resume Actor.wait "
            "Failures Failures.add"
        ).split()
    ),
    "works inside `training.trainer.Trainer`",
)
UNCHECKED |= dict.fromkeys(
    (
        f"files.{name}"
        for name in "current curve_text locked names_path replace_together settle".split()
    ),
    "called by `checkpoints` and `experiments`, which have looked at the path",
)
UNCHECKED |= dict.fromkeys(
    (
        f"robot.checks.check_{name}"
        for name in (
            "actuators custom feet home joints loops masses poses ranges spheres tree"
        ).split()
    ),
    ON_MODEL,
)
UNCHECKED |= dict.fromkeys(
    (f"robot.report.warn_{x}" for x in "feet friction limits plausibility torque".split()),
    "one of the checks of a robot, called by `validate_robot`",
)
UNCHECKED |= dict.fromkeys(
    (
        "optimizers.bayesian.bo optimizers.ars.ars optimizers.cma_es.cma_es "
        "optimizers.gc_pfo.gc_pfo optimizers.cem.cem optimizers.de.de optimizers.pso.pso "
        "optimizers.random_search.random optimizers.turbo.turbo "
        "optimizers.vgds.penalty_only optimizers.vgds.vgds"
    ).split(),
    METHOD,
)
UNCHECKED |= dict.fromkeys(
    (
        f"task.rewards.{name}"
        for name in (
            "t1_xy_velocity_tracking t2_yaw_velocity_tracking t3_alive_clipped "
            "t4_alive_unclipped t5_z_velocity t6_imu_acceleration t7_roll_pitch_velocity "
            "t8_roll_pitch_position t9_joint_nominal_deviation t10_joint_position_limit "
            "t11_joint_velocity_limit t12_joint_velocity t13_joint_acceleration "
            "t14_joint_torque t15_positive_power t16_action_rate t17_action_smoothness "
            "t18_self_collision t19_base_height t20_foot_air_time t21_symmetric_air "
            "t22_foot_slip t23_foot_z_velocity"
        ).split()
    ),
    FORMULA,
)

EVALUATED = dict(episodes=integer(1, 10**6), horizon=integer(1, 10**6), seed=SEED)
STUDY = dict(
    agent=AGENT,
    robot=ROBOT,
    runs=RUNS,
    starts=integer(1, 10**6),
    episodes=integer(1, 10**6),
    horizon=integer(1, 10**6),
    seed=integer(0, 10**6, 0),
    iterations=optional(integer(1, 10**6)),
    first_start=integer(0, 10**6, 0),
    recompute=FLAG,
)
CAMERA = dict(azimuth=ANGLE, elevation=ANGLE)
SIZE = dict(height=HEIGHT, width=HEIGHT)
DISTANCE = optional(number(1e-300, right=1.0))
PLAYED = dict(frames=FRAMES, fps=FPS)
WIDTH = optional(integer(1, 100_000))
NAMES = optional(thing(lambda world: ["unitree_go2"]))
SECONDS = optional(number(0))
CALL = dict(progress=FLAG, max_seconds=SECONDS, engine=ENGINE)
RESUMED = dict(folder=optional(FOLDER), **CALL)
RUN = NAME
CRITICS = thing(lambda world: {"a": world.agent})
STATES = optional(thing(lambda world: world.agent.states))
STATE = thing(lambda world: world.state)
BODIES = thing(lambda world: world.bodies)
CALLED = dict(policy=FUNCTION, params=thing(lambda world: {}).also(*WRONG, why="the policy's own"))
CALLED |= dict(state=STATE, key=KEY)
DESCRIBED = thing(lambda world: world.descriptions)
ENTRIES = ("array of NaN", "empty array")
EMPTY_IDS = ("list", "empty array")
FINITE = number()
JSON = choice({})
FROZEN = thing(lambda world: ("size",)).also("list", "empty array", why="nothing is frozen")
CONFIG_COUNT = integer(1, 10**6)
POSITIVE = number(1e-300)
ITERATIONS = dict(iterations=CONFIG_COUNT)
STD = dict(initial_std=POSITIVE)
WIDTHS = array(2, right=(8, 8))
WIDTH_1 = integer(1, 65536, 4)
TEMPERATURES = dict(
    # One has to be above the other.
    initial_temperature=number(0.03, right=1.0),
    minimum_temperature=number(0, 0.9, 0.025),
    latent_scale=POSITIVE,
)
PROBABILITY = number(0, 1, 0.5)
AT_LEAST_0 = number(0)

TASK_FIELDS = dict(
    horizon=integer(1, 10**400),
    command_limit=optional(POSITIVE),
    action_delay=optional(integer(0, 1)),
    design_radius=array(2, right=(0.0, 1.0)),
    repeat_after_fall=PROBABILITY,
    velocity_bound=optional(POSITIVE),
    fixed_coefficient=FLAG,
    curriculum_levels=integer(1, 10**400),
    curriculum_success=choice("tracking"),
    curriculum_length=integer(1, 10**400),
)
TASK_FIELDS |= dict.fromkeys(
    "command_change command_all_zero command_single_zero delay_probability mixed_delay "
    "push_probability push_add".split(),
    PROBABILITY,
)
TASK_FIELDS |= dict.fromkeys(
    "command_dead_zone noise_joint_position noise_joint_velocity noise_angular_velocity "
    "noise_gravity initial_yaw initial_tilt initial_joint_factor initial_joint_offset "
    "push_per_mass push_limit termination_height curriculum_error curriculum_return".split(),
    AT_LEAST_0,
)

FUNCTIONS = {
    "analysis.advice.whole_body": dict(space=SPACE, f=DESIGN),
    "analysis.advice.changes": dict(space=SPACE, f=DESIGN, groups=integer(1, 10**6)),
    "analysis.advice.large_changes": dict(space=SPACE, f=DESIGN, limit=AT_LEAST_0),
    "analysis.advice.objections": dict(
        walked=thing(lambda world: world.evaluation),
        stood=thing(lambda world: world.evaluation),
        row=integer(0, 1),
        reference=integer(0, 1),
    ),
    "reproduction.robot_catalog.gallery": dict(names=NAMES, rows=integer(1, 1000), **SIZE),
    "reproduction.robot_catalog.group_scene": dict(names=NAMES, rows=integer(1, 1000)),
    "reproduction.robot_catalog.random_bodies": dict(
        robot=ROBOT, designs=integer(1, 10**5), control_steps=integer(1, 10**6), seed=SEED
    ),
    "reproduction.robot_catalog.robot_table": dict(names=NAMES),
    "agent.agent.Agent.act": dict(
        descriptions=DESCRIBED, observation=thing(lambda world: world.observation)
    ),
    "agent.agent.Agent.values": dict(
        descriptions=DESCRIBED, observation=thing(lambda world: world.observation)
    ),
    "agent.store.agent_folder": dict(
        name_or_folder=AGENT_FOLDER.also("Path ..", why="a folder; load_agent looks into it")
    ),
    "agent.store.agents": {},
    "agent.store.check_agent": dict(agent=AGENT),
    "agent.store.chosen_folder": dict(folder=optional(FOLDER).given(None), name=NAME),
    "agent.store.load_agent": dict(name_or_folder=AGENT_FOLDER),
    "agent.store.load_curve": dict(name_or_folder=AGENT_FOLDER),
    "provenance.provenance": {},
    "agent.agent.require_agent": dict(agent=AGENT),
    "agent.store.save_agent": dict(
        agent=AGENT,
        folder=optional(FOLDER),
        curve=optional(thing(lambda world: [])).also(
            "list", "empty array", why="a curve without rows"
        ),
    ),
    "reproduction.critic_ablation.compare_critics": dict(
        critics=CRITICS,
        robot=ROBOT,
        trust_regions=array(1, right=(20.0,), accepts=("list", "empty array")),
        starts=integer(1, 10**6),
        first_start=integer(0, right=0),
        **EVALUATED,
    ),
    "reproduction.critic_ablation.critic_correlations": dict(
        critics=CRITICS, robot=ROBOT, records=RECORDS
    ),
    "reproduction.critic_ablation.critic_gains": dict(records=RECORDS),
    "reproduction.critic_ablation.variants": {},
    "reproduction.critic_ablation.critic_ablation": dict(
        agent=AGENT, critics=CRITICS, robot=ROBOT, progress=FLAG
    ),
    "design.descriptions.Sizes": dict(
        joints=integer(1, 10**4), feet=integer(1, 10**4), spheres=integer(0, 10**4)
    ),
    "design.descriptions.Sizes.of": dict(robots=ROBOT),
    "design.descriptions.describe": dict(
        robot=ROBOT, sizes=optional(thing(lambda world: world.agent.sizes)), mirror=FLAG
    ),
    "design.mirror.mirror_signs": dict(robot=ROBOT),
    "design.kinematics.kinematics": dict(robot=ROBOT),
    "design.descriptions.symmetric_feet": dict(robot=ROBOT),
    "design.space.DesignSpace": dict(
        robot=ROBOT, axes_seed=SEED, published_axes_of=optional(DESIGN).given(None)
    ),
    "design.space.DesignSpace.__call__": dict(f=DESIGN),
    "design.space.DesignSpace.frozen": dict(names=FROZEN),
    "design.space.DesignSpace.start": dict(
        seed=integer(0, 2**63, 0).also("2**40", why="a start design has a number, not a seed")
    ),
    "design.space.DesignSpace.to_mjcf": dict(f=DESIGN),
    "design.space.DesignSpace.to_model": dict(f=DESIGN),
    "design.space.DesignSpace.validate": dict(f=DESIGN),
    "design.phi.phi": dict(reference=thing(lambda world: world.space.reference_robot), f=DESIGN),
    "design.axes.published_axes": dict(robot=ROBOT, f=DESIGN),
    "design.axes.published_axes_seed": dict(
        f=DESIGN.also(
            "list",
            "array",
            "JAX array",
            "empty array",
            "True",
            "-1",
            "1.5",
            "2**40",
            why="any numbers have a sum",
        )
    ),
    "design.axes.rotation_axes": dict(
        generator=thing(lambda world: np.random.default_rng(0)),
        joint_axes=array(2, 3, right=np.eye(3)),
        num_bodies=integer(1, 10**6),
    ),
    "evaluation.evaluate.Evaluation.interval": dict(confidence=CONFIDENCE, seed=SEED),
    "evaluation.evaluate.Evaluation.summary": {},
    "evaluation.evaluate.EvaluationConfig": dict(
        episodes=integer(1, 10**6),
        coefficient=PROBABILITY,
        task=TASK,
        num_envs=integer(1, 10**6),
    ),
    "evaluation.statistics.bootstrap_interval": dict(
        values=array(3, accepts=("array", "JAX array")),
        baseline=optional(array(3)),
        confidence=CONFIDENCE,
        resamples=integer(1, 10**6),
        seed=SEED,
    ),
    "evaluation.evaluate.evaluate": dict(
        agent=AGENT,
        robot=ROBOT,
        designs=DESIGN,
        episodes=optional(integer(1, 10**6)),
        seed=SEED,
        engine=ENGINE,
        config=optional(config("evaluation.evaluate", "EvaluationConfig")),
        progress=FLAG,
    ),
    "evaluation.statistics.paired_gain": dict(
        after=array(3),
        before=array(3),
        confidence=CONFIDENCE,
        resamples=integer(1, 10**6),
        seed=SEED,
    ),
    "reproduction.scale.agent_name": dict(robot=NAME),
    "reproduction.pictures.before_after": dict(
        agent=AGENT,
        robot=ROBOT,
        path=OUTPUT,
        start=integer(0, 2**63, 0),
        trust_region=TRUST_REGION,
    ),
    "reproduction.scale.budget": {},
    "reproduction.results.result_provenance": dict(agent=optional(AGENT), seconds=SECONDS),
    "evaluation.statistics.rank_correlation": dict(
        x=array(4, right=[1.0, 2.0, 3.0]),
        y=array(4, right=[1.0, 2.0, 3.0]),
        resamples=integer(2, 10**6),
        seed=SEED,
    ),
    "reproduction.results.frame": dict(
        records=RECORDS.also("list", "empty array", why="a table without rows")
    ),
    "reproduction.results.result": dict(
        name=NAME, compute=FUNCTION, agent=optional(AGENT), recompute=FLAG
    ),
    "reproduction.results.result_in_parts": dict(
        name=NAME,
        parts=thing(lambda world: {"a": len}),
        agent=optional(AGENT),
        recompute=FLAG,
        progress=FLAG,
        settings=optional(JSON).also("dictionary", "wrong dictionary", why="settings by part"),
    ),
    "reproduction.results.result_path": dict(name=NAME),
    "reproduction.scale.scale": {},
    "reproduction.scale.scales_table": {},
    "reproduction.results.stored_config": dict(name=NAME, agent=optional(AGENT)),
    "reproduction.results.stored_parts": dict(
        name=NAME,
        agent=optional(AGENT),
        settings=optional(JSON).also("dictionary", "wrong dictionary", why="settings by part"),
    ),
    "reproduction.results.stored_result": dict(path=thing(lambda world: world.curve)),
    "reproduction.scale.study_setting": {},
    "reproduction.scale.trained_robots": dict(
        robots=thing(lambda world: []).also(
            "list", "list of text", "empty array", "array of text", runs=True, why="robots by name"
        )
    ),
    "evaluation.statistics.verdict": dict(low=number(right=-1e301), high=number(right=1e301)),
    "show.scene.Scene": dict(
        commands=thing(lambda world: []).also("list", "empty array", why="an empty scene"),
        height=HEIGHT,
    ),
    "show.scene.Scene.save": dict(path=OUTPUT),
    "show.scene.Scene.static_html": {},
    "show.scene.animate_designs": dict(
        space=SPACE,
        trajectory=thing(lambda world: np.zeros((2, world.space.dim))),
        seconds=number(0.01, 3600),
        frames=integer(2, 10**4),
        height=HEIGHT,
    ),
    "show.scene.show_design": dict(
        robot_or_space=SPACE,
        f=optional(DESIGN),
        qpos=optional(QPOS),
        spheres=FLAG,
        height=HEIGHT,
    ),
    "files.alone_in": dict(
        folder=thing(lambda world: world.folder).also("dots", "Path ..", why="a folder")
    ),
    "files.atomic_write": dict(
        path=OUTPUT, data=TEXT.also("long", "long path", "bytes", why="any text or bytes")
    ),
    "files.load_arrays": dict(
        path=thing(lambda world: world.curve),
        like=thing(lambda world: {}).also(*WRONG, why="any structure; the file has to fit it"),
    ),
    "files.read_curve": dict(path=thing(lambda world: world.curve)),
    "files.save_arrays": dict(
        path=OUTPUT,
        pytree=thing(lambda world: {}).also(
            *labels(lambda x: isinstance(x, int | float) or np.asarray(x).dtype.kind == "f"),
            "None",
            "list",
            "list of None",
            "ragged",
            "dictionary",
            "JAX array",
            "NumPy NaN",
            why="any numbers and arrays",
        ),
    ),
    "task.config.TaskConfig": TASK_FIELDS,
    "task.config.TaskConfig.ancestors": {},
    "task.config.TaskConfig.evaluation": {},
    "task.env.Locomotion": dict(
        robots=ROBOT,
        num_envs=integer(1, 2**20),
        engine=ENGINE,
        config=optional(TASK),
        sizes=optional(thing(lambda world: world.agent.sizes)),
        auto_reset=FLAG,
        threads=integer(0, 4096),
        physics_options=optional(thing(lambda world: {})).also("dictionary", why="no options"),
        mirror=FLAG,
    ),
    "task.env.Locomotion.descriptions": dict(
        robot=integer(0, 0, 0), designs=thing(lambda world: world.space.reference[None])
    ),
    "task.env.Locomotion.physics_arrays": {},
    "task.env.Locomotion.reset": dict(
        key=optional(KEY),
        designs=optional(DESIGN),
        coefficient=PROBABILITY,
        spread=FLAG,
        keys=optional(thing(lambda world: np.zeros((2, 2), np.uint32))),
    ),
    "task.env.Locomotion.restart": dict(
        state=STATE,
        rows=array(1, right=[0]).also("list", "empty array", why="no rows"),
        keys=thing(lambda world: np.zeros((1, 2), np.uint32)),
        designs=optional(DESIGN),
        coefficient=PROBABILITY,
        streak=integer(-(2**31), 2**31 - 1, 0),
    ),
    "task.env.Locomotion.restore": dict(state=STATE, arrays=thing(lambda world: [{}])),
    "task.env.Locomotion.rollout": dict(**CALLED, length=integer(1, 10**6)),
    "task.env.Locomotion.step": dict(
        **CALLED, running=optional(thing(lambda world: np.ones(2, bool)))
    ),
    "task.env.Locomotion.with_task": dict(config=TASK),
    "task.rewards.combine": dict(
        terms=array(23), coefficient=PROBABILITY.also(*WRONG, why=FORMULA)
    ),
    "networks.critic.Critic": dict(config=config("networks.config", "CriticConfig")),
    "networks.config.CriticConfig": dict(
        kind=choice("original"),
        heads=WIDTH_1,
        joint_key_widths=WIDTHS,
        joint_value_latent=WIDTH_1,
        foot_key_widths=WIDTHS,
        foot_value_latent=WIDTH_1,
        head_widths=WIDTHS,
        **TEMPERATURES,
    ),
    "networks.config.CriticConfig.original": {},
    "networks.config.CriticConfig.reduced": {},
    "networks.config.CriticConfig.sharp": {},
    "networks.policy.Policy": dict(config=config("networks.config", "PolicyConfig")),
    "networks.config.PolicyConfig": dict(
        key_widths=WIDTHS,
        value_latent=WIDTH_1,
        core_widths=WIDTHS,
        initial_std=number(0.5, 1.9, 1.0),
        log_std_input=choice("tanh"),
        mean_limit=POSITIVE,
        std_limits=array(2, right=(0.5, 1.9)),
        **TEMPERATURES,
    ),
    "networks.config.PolicyConfig.reduced": {},
    "networks.inputs.count_parameters": dict(
        params=thing(lambda world: world.agent.policy["params"]).also(
            "NumPy NaN",
            "array of text",
            "array of NaN",
            "empty array",
            "array",
            "array of objects",
            "JAX array",
            why="any arrays are counted",
        )
    ),
    "networks.inputs.initialize": dict(
        network=thing(lambda world: world.agent.policy_module),
        key=KEY,
        constants=optional(thing(lambda world: None)),
    ),
    "networks.inputs.standardization": dict(
        descriptions=DESCRIBED, floor=POSITIVE, constant=AT_LEAST_0
    ),
    "reproduction.paper.trust_region_gain": dict(robot=TEXT, trust_region=AT_LEAST_0),
    "files.data_dir": {},
    "physics.protocol.prepare": dict(
        robot=ROBOT,
        solver_iterations=optional(integer(1, 10**4)),
        line_search=optional(integer(1, 10**4)),
    ),
    "physics.engine.resolved": dict(engine=ENGINE),
    "physics.mjx.MjxPhysics": dict(
        robot=ROBOT,
        num_envs=integer(1, 2**20),
        substeps=integer(1, 10**4),
        solver_iterations=integer(1, 10**4).also("None", why="the model's number"),
        line_search=integer(1, 10**4).also("None", why="the model's number"),
    ),
    "physics.mjx.MjxPhysics.init": dict(
        embodiments=BODIES, qpos=QPOS, qvel=thing(lambda world: np.zeros(world.robot.model.nv))
    ),
    "physics.mjx.MjxPhysics.reset": dict(
        state=thing(lambda world: world.mjx_state),
        mask=thing(lambda world: np.ones(2, bool)),
        embodiments=BODIES,
        qpos=QPOS,
        qvel=thing(lambda world: np.zeros(world.robot.model.nv)),
    ),
    "physics.mjx.MjxPhysics.step": dict(
        state=thing(lambda world: world.mjx_state), ctrl=thing(lambda world: np.zeros((2, 2)))
    ),
    "physics.mjx.MjxPhysics.velocity": dict(state=thing(lambda world: world.mjx_state)),
    "physics.mjx.MjxPhysics.with_velocity": dict(
        state=thing(lambda world: world.mjx_state),
        qvel=thing(lambda world: np.zeros(world.robot.model.nv)),
    ),
    "physics.native.NativePhysics": dict(
        robot=ROBOT,
        num_envs=integer(1, 2**20),
        threads=integer(0, 4096),
        substeps=integer(1, 10**4),
        solver_iterations=optional(integer(1, 10**4)),
        line_search=optional(integer(1, 10**4)),
    ),
    "physics.native.NativePhysics.get_model": dict(env=integer(0, 1, 0)),
    "physics.native.NativePhysics.restore": dict(state=thing(lambda world: world.physics.state())),
    "physics.native.NativePhysics.set_designs": dict(ids=array(right=[0, 1]), embodiments=BODIES),
    "physics.native.NativePhysics.set_state": dict(
        ids=array(right=[0, 1]).also("list", "empty array", why="no simulations"),
        qpos=QPOS,
        qvel=thing(lambda world: np.zeros(world.robot.model.nv)),
    ),
    "physics.native.NativePhysics.state": {},
    "physics.native.NativePhysics.step": dict(
        ctrl=thing(lambda world: np.zeros((2, 2))),
        qpos=optional(thing(lambda world: np.stack([world.robot.home] * 2))),
        qvel=optional(thing(lambda world: np.zeros((2, world.robot.model.nv)))),
        running=optional(thing(lambda world: np.zeros(2, bool))),
    ),
    "show.tables.agents_table": dict(
        agents=thing(lambda world: []).also("list", "empty array", why="an empty table")
    ),
    "show.plots.intervals": dict(
        labels=thing(lambda world: ["a"]).also("list of text", "array of text", why="labels"),
        values=thing(lambda world: [(0.0, -1.0, 1.0)]).also("list of None", why="an empty row"),
        colours=thing(lambda world: []).also("list", "empty array", why="the default colours"),
        ax=optional(AXES),
    ),
    "show.plots.learning_curve": dict(
        path=thing(lambda world: world.curve),
        y=choice("coefficient"),
        x=choice("steps"),
        ax=optional(AXES).given(lambda world: world.axes),
        smooth=integer(1, 10**6),
    ),
    "show.tables.paper_table": dict(
        rows=thing(lambda world: [("a", 1, 2)]).also("list", "empty array", why="an empty table"),
        digits=integer(0, 17),
        caption=TEXT.also("long", "long path", why="a caption may be long"),
        note=TEXT,
    ),
    "show.tables.table": dict(
        rows=thing(lambda world: [("a",)]).also("list", "empty array", why="an empty table"),
        header=thing(lambda world: ["a"]).also(
            "list of None",
            "list of text",
            "ragged",
            "array of text",
            "array of NaN",
            "array",
            "array of objects",
            "JAX array",
            why="titles are made texts",
        ),
        digits=integer(0, 17),
        caption=TEXT.also("long", "long path", why="a caption may be long"),
    ),
    "show.plots.use_style": {},
    "training.config.TrainConfig": dict(
        name=NAME,
        robots=thing(lambda world: "robot").also(
            "a/b", "list of text", "array of text", why="names or paths, read later"
        ),
        scale=choice("smoke"),
        seed=SEED,
        policy=config("networks.config", "PolicyConfig"),
        critic=config("networks.config", "CriticConfig"),
        standardize=FLAG,
        num_envs=integer(1, 2**24, 4096),
        rollout_length=integer(2**14, 2**24, 64),
        total_steps=STEPS,
        minibatch_size=integer(64, 2**18, 64),
        epochs=integer(1, 2**24),
        learning_rate=array(2, right=(1e-3, 1e-4)),
        discount=PROBABILITY,
        gae_lambda=PROBABILITY,
        value_lambda=optional(PROBABILITY),
        cut_at_commands=FLAG,
        clip_range=POSITIVE,
        entropy_coefficient=AT_LEAST_0,
        max_gradient_norm=POSITIVE,
        average_half_life=optional(POSITIVE),
        mirror_coefficient=AT_LEAST_0,
        mirrored_critic=FLAG,
        average_proximal=FLAG,
        kl_threshold=POSITIVE.also("inf", why="no threshold"),
        task=TASK,
        learn_policy=FLAG,
        mean_actions=FLAG,
        state_bank=integer(1, 2**24),
        yardstick_interval=optional(integer(1, 10**15)),
    ),
    "training.config.TrainConfig.at_scale": dict(scale=choice("smoke"), robot=ROBOT_NAME),
    "training.config.TrainConfig.full": dict(robot=ROBOT_NAME),
    "training.config.TrainConfig.reduced": dict(robot=ROBOT_NAME),
    "training.config.TrainConfig.smoke": dict(robot=ROBOT_NAME),
    "training.trainer.Trainer": dict(
        config=thing(lambda world: world.train_config),
        folder=optional(FOLDER),
        engine=ENGINE,
        policy=optional(thing(lambda world: world.agent.policy)),
    ),
    "training.trainer.Trainer.last_iteration": dict(
        max_steps=optional(integer(0, 10**15)).also("2**40", why="more than all steps", runs=True)
    ),
    "training.trainer.Trainer.run": dict(
        max_steps=optional(integer(0, 10**15)),
        max_seconds=SECONDS,
        progress=FLAG,
        curve_interval=optional(COUNT),
    ),
    "training.trainer.Trainer.save": {},
    "training.trainer.Trainer.save_portable": {},
    "training.trainer.Trainer.save_agent": dict(folder=optional(FOLDER)),
    "training.trainer.Trainer.everything": {},
    "training.trainer.Trainer.start": dict(
        changeable=thing(lambda world: ()).also("list", "empty array", why="nothing may differ")
    ),
    "training.trainer.Trainer.state_bank": dict(rollouts=integer(1, 10**5)),
    "training.losses.advantages": dict(
        reward=array(2, 3),
        value=array(2, 3),
        last_value=array(2),
        terminated=array(2, 3, dtype=bool),
        truncated=array(2, 3, dtype=bool),
        discount=PROBABILITY.also(*WRONG, why=FORMULA),
        gae_lambda=PROBABILITY.also(*WRONG, why=FORMULA),
    ),
    "training.train.anneal": CALL
    | dict(name_or_folder=RUN, steps=STEPS, last_rate=AT_LEAST_0, replace=FLAG),
    "training.rollout.make_policy_function": dict(
        policy=thing(lambda world: world.agent.policy_module), mean_actions=FLAG
    ),
    "training.train.continue_run": CALL
    | dict(
        name_or_folder=RUN,
        overrides=optional(thing(lambda world: {})).also("dictionary", why="no overrides"),
        max_steps=optional(STEPS),
        state_only=FLAG,
        replace=FLAG,
    ),
    "training.update.init_learner": dict(
        config=thing(lambda world: world.train_config),
        policy=thing(lambda world: world.agent.policy),
        critic=thing(lambda world: world.agent.critic),
    ),
    "training.update.ppo_update": dict(
        config=thing(lambda world: world.train_config),
        learner=thing(lambda world: object.__new__(Learner)),
        trajectory=thing(lambda world: object.__new__(Trajectory)),
        key=KEY,
    ),
    "training.train.train": dict(
        config=thing(lambda world: world.train_config),
        max_steps=optional(STEPS),
        state_only=FLAG,
        replace=FLAG,
        **RESUMED,
    ),
    "training.yardstick.yardstick": dict(
        config=config("networks.config", "PolicyConfig"),
        policy=thing(lambda world: world.agent.policy),
        robots=ROBOT,
        coefficient=PROBABILITY,
        bodies=integer(1, 2**20),
        engine=ENGINE,
    ),
    "training.diagnosis.diagnose": dict(
        config=config("networks.config", "PolicyConfig"),
        policy=thing(lambda world: world.agent.policy),
        robot=ROBOT,
        engine=ENGINE,
    ),
    "training.policy_evaluation.train_critic": dict(
        agent=AGENT,
        critic=config("networks.config", "CriticConfig"),
        steps=optional(STEPS),
        task_of=choice("training"),
        **RESUMED,
    ),
    "networks.published.read_published_policy": dict(
        folder=thing(lambda world: world.folder), name=optional(NAME)
    ),
    "agent.published.load_published_policy": dict(
        folder=thing(lambda world: world.folder),
        name=optional(NAME),
        robots=optional(thing(lambda world: [world.robot])),
    ),
    "training.critics.train_critics": dict(
        agent=AGENT,
        critics=thing(lambda world: {"one": world.agent.critic_config}),
        steps=optional(STEPS),
        seeds=integer(1, 1000),
        **RESUMED,
    ),
    "training.critics.held_out_scores": dict(
        agent=AGENT,
        critics=thing(lambda world: {"one": world.agent}),
        bodies=integer(1, 100_000),
        moments=integer(1, 100_000),
        seed=SEED,
        engine=ENGINE,
    ),
    "evaluation.recording.record_episode": dict(
        agent=AGENT,
        robot=ROBOT,
        design=optional(DESIGN),
        seconds=number(0.02),
        command=optional(array(3)),
        seed=SEED,
        coefficient=PROBABILITY,
        task=optional(TASK),
    ),
    "robot.robot.Robot.pose": dict(nominal=array(2)),
    "robot.robot.find": dict(name_or_path=ROBOT_FILE),
    "robot.robot.load_robot": dict(name_or_path=ROBOT_FILE),
    "robot.robot.require_robot": dict(robot=ROBOT),
    "robot.robot.robots": {},
    "runtime.cache_folder": {},
    "runtime.enable_compilation_cache": {},
    "runtime.keep_memory": {},
    "show.notebook.start_notebook": {},
    "optimizers.bayesian.BOConfig": dict(
        initial_points=integer(2, 10**6, 2),
        restarts=CONFIG_COUNT,
        raw_samples=CONFIG_COUNT,
        steps=CONFIG_COUNT,
        **ITERATIONS,
    ),
    "optimizers.ars.ARSConfig": dict(
        directions=CONFIG_COUNT,
        perturbation_std=POSITIVE,
        learning_rate=POSITIVE,
        top_fraction=number(1e-300, 1, 0.5),
        **ITERATIONS,
    ),
    "optimizers.cma_es.CMAESConfig": dict(
        particles=optional(integer(2, 10**6, 4)), **ITERATIONS, **STD
    ),
    "optimizers.cma_es.CMAESConfig.population": dict(dim=COUNT),
    "optimizers.loop.cores": {},
    "optimizers.loop.iterate": dict(
        objective=thing(lambda world: world.objective).also(*WRONG, why="the caller's own"),
        starts=array(1, 3, accepts=("JAX array",)),
        key=KEY,
        config=choice(None).also(*WRONG, why="the caller's own"),
        steps=thing(lambda world: world.steps),
        evaluations=integer(0, right=0),
    ),
    "optimizers.search.search": dict(
        method=choice("vgds"),
        agent=AGENT,
        robot=ROBOT,
        f=DESIGN,
        trust_region=TRUST_REGION,
        reference=optional(DESIGN),
        seed=SEED,
        batch_size=COUNT,
        states=STATES,
        frozen=FROZEN,
    ),
    "optimizers.objective.DesignCritic.descriptions": dict(designs=DESIGN),
    "optimizers.objective.Objective.__call__": dict(designs=DESIGN, states=STATES),
    "optimizers.objective.Objective.batch": dict(key=KEY),
    "optimizers.objective.Objective.hold": dict(designs=DESIGN),
    "optimizers.objective.Objective.of": dict(
        agent=AGENT,
        robot=ROBOT,
        trust_region=TRUST_REGION,
        reference=optional(DESIGN),
        states=STATES,
        batch_size=COUNT,
        frozen=FROZEN,
    ),
    "optimizers.objective.Objective.penalty": dict(designs=DESIGN),
    "optimizers.objective.Objective.value": dict(designs=DESIGN, states=STATES),
    "optimizers.state_bank.bank": dict(agent=AGENT, robot=ROBOT),
    "optimizers.objective.design_critic": dict(
        robot=ROBOT, config=config("networks.config", "CriticConfig")
    ),
    "optimizers.state_bank.trim": dict(states=thing(lambda world: world.agent.states), robot=ROBOT),
    "optimizers.gc_pfo.GCPFOConfig": dict(
        regions=CONFIG_COUNT,
        particles=integer(2, 10**6, 2),
        step_size=POSITIVE,
        temperature=POSITIVE,
        epsilon=POSITIVE,
        **ITERATIONS,
    ),
    "optimizers.cem.CEMConfig": dict(
        particles=CONFIG_COUNT,
        elite_fraction=number(1e-300, 1, 0.5),
        minimum_std=POSITIVE,
        **ITERATIONS,
        **STD,
    ),
    "optimizers.de.DEConfig": dict(
        particles=integer(4, 10**6, 4),
        weight=number(0, 2),
        crossover=PROBABILITY,
        initial_std=optional(POSITIVE),
        **ITERATIONS,
    ),
    "optimizers.pso.PSOConfig": dict(
        particles=CONFIG_COUNT,
        inertia=AT_LEAST_0,
        cognitive=AT_LEAST_0,
        social=AT_LEAST_0,
        initial_std=optional(POSITIVE),
        **ITERATIONS,
    ),
    "optimizers.random_search.RandomConfig": dict(candidates=CONFIG_COUNT, **ITERATIONS),
    "optimizers.turbo.TuRBOConfig": dict(
        candidates=CONFIG_COUNT,
        # Between the smallest and the largest one.
        radius=number(0.005, 0.5, 0.1),
        minimum_radius=number(1e-300, 0.1, 0.005),
        maximum_radius=number(0.1, right=0.5),
        shrink=number(1e-300, 1, 0.7),
        expand=number(1, right=1.3),
        **ITERATIONS,
    ),
    "optimizers.vgds.VGDSConfig": dict(learning_rate=POSITIVE, max_update=POSITIVE, **ITERATIONS),
    "reproduction.design_study.Run": dict(
        method=choice("vgds").also(*WRONG, why="looked at by the studies"),
        trust_region=choice(1.0).also(*WRONG, why="looked at by the studies"),
        origin=choice("start").also(*WRONG, why="looked at by the studies"),
    ),
    "reproduction.design_study.available": STUDY,
    "reproduction.design_study.design_study": STUDY | dict(progress=FLAG),
    "reproduction.gains.gain": dict(
        rows=thing(lambda world: pd.DataFrame(world.records)),
        method=choice("none"),
        over=choice("start"),
        trust_region=optional(choice(1.0)),
    ),
    "reproduction.gains.gains": dict(records=RECORDS, quantity=choice("return")),
    "reproduction.design_study.installed": dict(runs=RUNS),
    "reproduction.value_studies.published_policy": dict(
        robot=ROBOT,
        agent=AGENT,
        folder=optional(thing(lambda world: world.folder)),
        starts=integer(1, 10**6),
        episodes=integer(1, 10**6),
    ),
    "reproduction.value_studies.policy_yardstick": dict(
        robot=ROBOT,
        agent=AGENT,
        folder=optional(thing(lambda world: world.folder)),
        bodies=integer(1, 10**6),
        recompute=FLAG,
    ),
    "reproduction.value_studies.size_share": dict(
        agent=AGENT,
        robot=ROBOT,
        starts=integer(1, 10**6),
        iterations=optional(integer(1, 10**6)),
        **EVALUATED,
    ),
    "reproduction.value_studies.value_against_return": dict(
        agent=AGENT, robot=ROBOT, designs=integer(1, 10**6), progress=FLAG, **EVALUATED
    ),
    "robot.report.Report.write": dict(path=OUTPUT),
    "robot.report.validate_robot": dict(
        name_or_path=ROBOT_FILE.also(
            "dots", "a/b", "Path ..", why="the report says that there is no file", runs=True
        )
    ),
    "show.render.Renderer": dict(model=MODEL, spheres=FLAG, smooth=FLAG, opengl=FLAG, **SIZE),
    "show.render.Renderer.centre": {},
    "show.render.Renderer.close": {},
    "show.render.Renderer.distance": dict(lookat=array(3), **CAMERA),
    "show.render.Renderer.picture": dict(
        qpos=QPOS, lookat=optional(array(3)), distance=DISTANCE, **CAMERA
    ),
    "show.render.Renderer.place": dict(qpos=QPOS),
    "show.video.body_grid": dict(
        bodies=thing(lambda world: [world.robot]),
        qpos=optional(thing(lambda world: [world.robot.home])),
        labels=optional(thing(lambda world: ["a"])).also(
            "list of text", "array of text", why="one label"
        ),
        columns=optional(COUNT),
        **SIZE,
        **CAMERA,
    ),
    "show.video.encode_video": PLAYED,
    "show.video.ffmpeg": {},
    "show.video.film_strip": dict(frames=FRAMES, count=integer(1, 1000)),
    "show.opengl.find_opengl": {},
    "show.render.render_frame": dict(body=ROBOT, qpos=optional(QPOS), spheres=FLAG, **SIZE),
    "show.video.render_rollout": dict(
        body=ROBOT,
        qpos=thing(lambda world: world.robot.home[None]),
        fps=FPS,
        step_seconds=number(1e-6, 1000, 0.02),
        distance=DISTANCE,
        spheres=FLAG,
        **SIZE,
        **CAMERA,
    ),
    "show.render.require_size": SIZE,
    "show.video.save_video": dict(path=OUTPUT, **PLAYED),
    "show.video.show_image": dict(
        picture=thing(lambda world: np.zeros((32, 32, 3), np.uint8)),
        width=WIDTH,
        colours=optional(integer(2, 256, 8)),
    ),
    "show.video.show_video": PLAYED | dict(width=WIDTH),
    "show.video.side_by_side": dict(
        clips=FRAMES,
        labels=optional(thing(lambda world: ["a"])).also(
            "list of text", "array of text", why="one label"
        ),
    ),
    "show.video.video_html": PLAYED | dict(width=WIDTH),
    "show.video.with_label": dict(frames=FRAMES, text=TEXT),
}
