"""Numbers of the paper "Shape Your Body", for tables and figures "paper | ours".

Values in `ROBOT_TABLE`, `TRUST_REGION`, `CRITIC_ABLATION`, `COUNTERFACTUAL`, `PARAMETERS`,
`LAYERS` and `PPO` are printed in the paper. `SINGLE_ROBOT`, `TRAINING_SETS` and `RL_CODESIGN` were
read off its figures by eye, each to about ±`READING_ERROR`. ΔR is R(f*) - R(f_init), the mean over
ten starts; returns are undiscounted sums over an episode.
"""

from shapebody.arguments import require_number, require_text

ROBOTS = ("unitree_go2", "mit_humanoid", "golem")
"""The robots of the single-robot experiments, by their names in data/robots."""

DESIGN_DIMENSIONS = {"unitree_go2": 358, "mit_humanoid": 514, "golem": 688}
"""d_design (Section 4.1)."""

READING_ERROR = 0.3
"""Return; of the values read off figures."""

PARAMETERS = {"critic": 5_378_312, "policy": 945_430}
"""Learned parameters (Appendix B)."""

LAYERS = (
    ("joint encoder", "64, 64", "256, 256"),
    ("joint value latent", "32", "4"),
    ("foot encoder", "32, 32", "–"),
    ("foot value latent", "32", "–"),
    ("head", "512, 256, 128, 128, 128, 1", "512, 256, 256, 256, 256"),
    ("number of heads", "3", "1"),
)
"""Layer widths: (block, critic, policy) (Appendix B)."""

PPO = {
    "rollout_length": 64,
    "minibatch_size": 16_384,
    "epochs": 10,
    "learning_rate": (1.5e-3, 3e-4),
    "discount": 0.99,
    "gae_lambda": 0.7,
    "clip_range": 0.1,
    "entropy_coefficient": 0.005,
    "max_gradient_norm": 3.0,
    "kl_threshold": 0.5,
    "num_envs": 4096,
    "total_steps": 1_000_000_000,
}
"""Hyperparameters of the single-robot run, named as the fields of `TrainConfig` (Appendix A)."""

POLICY = {"initial_std": 1.0, "mean_limit": 10.0, "std_limits": (0.01, 2.0)}
"""Settings of the action distribution, named as the fields of `PolicyConfig` (Appendix A)."""

SINGLE_ROBOT = {
    "unitree_go2": {
        "GC-PFO": 20.6,
        "VGDS": 20.60,
        "f_ref": 18.4,
        "CEM": 17.4,
        "ARS": 16.2,
        "DE": 14.6,
        "CMA-ES": 14.5,
        "BO": 14.4,
        "PSO": 14.0,
        "TuRBO": 8.8,
        "Random": 1.0,
    },
    "mit_humanoid": {
        "f_ref": 30.2,
        "VGDS": 28.84,
        "GC-PFO": 28.5,
        "PSO": 23.2,
        "DE": 21.9,
        "ARS": 21.2,
        "CEM": 19.5,
        "BO": 16.7,
        "CMA-ES": 14.5,
        "TuRBO": 14.0,
        "Random": 11.3,
    },
    "golem": {
        "f_ref": 18.1,
        "VGDS": 16.85,
        "GC-PFO": 15.0,
        "BO": 8.6,
        "ARS": 5.2,
        "PSO": 4.3,
        "CEM": 3.7,
        "TuRBO": 3.5,
        "DE": 3.1,
        "CMA-ES": 3.0,
        "Random": -0.9,
    },
}
"""ΔR by robot and method at λ = 100, read off the figure of Section 4.1 (VGDS: Appendix D)."""

LAMBDAS = (0, 5, 10, 20, 50, 100, 150, 200, 300)
TRUST_REGION = {
    "unitree_go2": (-18.93, 14.51, 14.30, 14.18, 13.93, 20.60, 14.18, 14.12, 13.87),
    "mit_humanoid": (2.21, 29.08, 29.77, 30.39, 30.95, 28.84, 31.15, 31.20, 30.97),
    "golem": (0.50, 6.03, 9.94, 9.73, 14.08, 16.85, 15.63, 16.46, 17.27),
}
"""ΔR of VGDS by robot at the penalty coefficients `LAMBDAS` (Appendix D)."""

TRAINING_SETS = {
    "unitree_go2": {
        "VGDS": (24.1, 25.6),
        "GC-PFO": (24.4, 25.0),
        "f_ref": (23.3, 23.6),
        "ARS": (20.5, 21.8),
        "CEM": (20.5, 20.3),
        "CMA-ES": (16.0, 16.9),
        "TuRBO": (13.0, 15.4),
        "DE": (16.4, 15.3),
        "BO": (11.5, 15.0),
        "PSO": (11.9, 14.5),
        "Random": (9.9, 8.5),
    },
    "mit_humanoid": {
        "VGDS": (13.8, 20.5),
        "GC-PFO": (13.8, 18.1),
        "f_ref": (14.2, 17.0),
        "DE": (0.9, 12.9),
        "CEM": (4.5, 12.7),
        "ARS": (2.5, 10.4),
        "PSO": (3.8, 10.2),
        "BO": (6.6, 8.7),
        "CMA-ES": (2.2, 7.7),
        "TuRBO": (1.6, 6.5),
        "Random": (1.2, 1.9),
    },
    "golem": {
        "VGDS": (13.6, 5.2),
        "f_ref": (0.7, 5.1),
        "DE": (0.6, 2.2),
        "GC-PFO": (2.2, 1.6),
        "ARS": (0.7, 1.1),
        "CEM": (1.6, 0.5),
        "PSO": (1.4, 0.4),
        "CMA-ES": (1.5, 0.0),
        "BO": (1.0, -0.1),
        "TuRBO": (1.7, -0.1),
        "Random": (0.3, -0.3),
    },
}
"""ΔR by robot and method, trained on (the other robots of its class, all 50 robots); read off."""

CRITIC_ABLATION = (
    ("original", 1, 4, 10.39),
    ("original", 3, 4, 13.57),
    ("original", 3, 8, 12.59),
    ("original", 3, 16, 10.22),
    ("direct-design", 3, 4, 6.41),
    ("direct-design", 3, 8, 9.12),
    ("direct-design", 3, 16, 10.98),
    ("direct-design", 3, 32, 17.76),
    ("direct-design", 3, 64, 14.35),
)
"""(critic, heads, value latent, ΔR) on an early Unitree Go2 task (Appendix B)."""

COUNTERFACTUAL = {
    "unitree_go2": {
        "Initial": 22.9,
        "+ Joint axis": 24.1,
        "+ Foot geometry": 22.2,
        "+ Velocity limit": 24.6,
        "+ Combined": 25.1,
        "f_star": 42.0,
    },
    "mit_humanoid": {
        "Initial": 5.8,
        "+ Gains": 12.5,
        "+ Nominal pos.": 6.5,
        "+ Gains + nominal pos.": 13.5,
        "f_star": 31.1,
    },
    "golem": {
        "Initial": 12.4,
        "+ Action scale": 14.1,
        "+ PD gains": 10.4,
        "+ Nominal pos.": 13.2,
        "+ Combined": 13.3,
        "f_star": 20.3,
    },
}
"""Returns of one start with groups of parameters taken from f* (Section 4.3)."""

RL_CODESIGN = {
    "unitree_go2": {
        "VGDS": 42.0,
        "Stackelberg PPO": 38.3,
        "Transform2Act": 36.5,
        "BodyGen": 33.0,
        "FEACRL": 24.5,
        "Schaff2019": 23.2,
    },
    "mit_humanoid": {
        "VGDS": 31.1,
        "Stackelberg PPO": 30.2,
        "BodyGen": 27.8,
        "Transform2Act": 26.7,
        "FEACRL": 26.5,
        "Schaff2019": 17.9,
    },
    "golem": {
        "VGDS": 20.0,
        "Schaff2019": 16.3,
        "Transform2Act": 15.8,
        "BodyGen": 14.5,
        "FEACRL": 13.0,
        "Stackelberg PPO": 13.4,
    },
}
"""Final returns after 10⁹ environment steps (Section 4.1, read off; the number of starts is not
given)."""

SPEARMAN = {"all": 0.40, "mit_humanoid": 0.50, "unitree_go2": 0.60, "golem": 0.83}
"""Rank correlation of predicted value and return over 17 partially modified designs (Appendix,
design analysis)."""

TRAINING_HOURS = (7, 9)
"""Hours for a single-robot agent (Section 4.1)."""
SEARCH_MINUTES = (1, 2)
"""Minutes of VGDS per design (Section 4.1)."""
MEAN_CHANGE = (0.027, 0.042)
"""Range of the mean |change| per design dimension over the analysed designs; no dimension ended
beyond ±0.9 (Appendix, design analysis)."""
GOLEM_CONTROL_SHIFT = {"action_scale": -12.2, "p_gain": -4.1, "d_gain": 4.4}
"""Percent (Appendix, design analysis)."""


def trust_region_gain(robot: str, trust_region: float) -> float | None:
    """The paper's ΔR of VGDS for a robot at a penalty coefficient λ; None where it has none."""
    require_text("robot", robot)
    require_number("trust_region", trust_region, 0)
    if robot not in TRUST_REGION or trust_region not in LAMBDAS:
        return None
    return TRUST_REGION[robot][LAMBDAS.index(trust_region)]


ROBOT_TABLE = {
    "unitree_a1": (20.0, 0.5, 0.25, 12, 358),
    "unitree_go1": (20.0, 0.5, 0.25, 12, 358),
    "unitree_go2": (20.0, 0.5, 0.3, 12, 358),
    "unitree_b2": (80.0, 2.0, 0.5, 12, 358),
    "anymal_b": (80.0, 2.0, 0.5, 12, 358),
    "anymal_c": (80.0, 2.0, 0.5, 12, 358),
    "barkour_v0": (20.0, 0.5, 0.25, 12, 358),
    "barkour_vb": (30.0, 0.5, 0.25, 12, 358),
    "silver_badger": (20.0, 0.5, 0.25, 13, 385),
    "honey_badger": (20.0, 0.5, 0.25, 12, 358),
    "bittle": (25.0, 0.5, 0.6, 8, 250),
    "aibo": (20.0, 0.5, 0.25, 17, 493),
    "solo12": (20.0, 0.5, 0.25, 12, 358),
    "spot": (80.0, 2.0, 0.5, 12, 358),
    "spot_mini": (20.0, 0.5, 0.25, 12, 358),
    "bolt": (15.0, 0.3, 0.2, 6, 190),
    "open_duck_mini": (6.5, 0.5, 0.5, 16, 460),
    "mini_pi": (20.0, 0.5, 0.3, 12, 352),
    "qmini": (15.0, 1.0, 0.4, 10, 298),
    "tron1": (40.0, 1.0, 0.5, 6, 190),
    "unitree_h1": (60.0, 2.0, 0.75, 19, 541),
    "unitree_g1": (45.0, 1.0, 0.5, 23, 985),
    "talos": (80.0, 2.0, 0.75, 30, 1020),
    "robotis_op3": (21.0, 0.5, 0.6, 20, 568),
    "nao_v5": (30.0, 1.0, 0.7, 22, 1102),
    "adam_lite": (80.0, 2.0, 0.75, 25, 703),
    "agibot_x1": (45.0, 1.0, 0.7, 29, 811),
    "apptronik_apollo": (100.0, 2.0, 0.75, 30, 890),
    "atlas": (80.0, 2.0, 0.75, 27, 783),
    "berkeley_humanoid": (20.0, 0.6, 0.5, 12, 352),
    "berkeley_humanoid_lite": (20.0, 0.5, 0.3, 22, 661),
    "booster_t1": (25.0, 0.6, 0.5, 23, 649),
    "elf2": (35.0, 0.7, 0.5, 25, 703),
    "engineai_sa01": (55.0, 1.5, 0.5, 12, 352),
    "fourier_gr1t2": (80.0, 2.0, 0.75, 34, 946),
    "fourier_gr2v3": (80.0, 2.0, 0.75, 29, 811),
    "fourier_n1": (70.0, 2.0, 0.7, 23, 649),
    "kbot_v1": (40.0, 2.0, 0.5, 20, 594),
    "kbot_v2": (50.0, 1.0, 0.5, 20, 594),
    "mit_humanoid": (30.0, 0.5, 0.5, 18, 514),
    "northwestern_humanoid": (20.0, 0.6, 0.5, 10, 298),
    "poppy_humanoid": (20.0, 0.5, 0.3, 25, 703),
    "sigmaban": (21.0, 0.5, 0.5, 20, 568),
    "star1": (80.0, 2.0, 0.75, 31, 1177),
    "valkyrie": (100.0, 2.0, 0.75, 26, 730),
    "zbot": (10.0, 0.5, 0.4, 20, 594),
    "crab": (20.0, 0.5, 0.5, 18, 526),
    "custom_hexapod": (30.0, 0.5, 0.6, 18, 526),
    "tom_hexapod": (25.0, 0.5, 0.5, 18, 526),
    "golem": (25.0, 0.5, 0.5, 24, 688),
}
"""The 50 robots (Appendix A): name: (p-gain, d-gain, σ_robot, n_u, d_design)."""
