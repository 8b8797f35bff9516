"""The paper's numbers, and the studies beside which ours stand."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "critic_ablation",
        "design_study",
        "gains",
        "paper",
        "pictures",
        "results",
        "robot_catalog",
        "scale",
        "value_studies",
    ],
)
