"""Shape Your Body: search for robot designs along the gradient of a design-conditioned critic.

The public names are listed in `__init__.pyi`. Each is imported from its module on first use, so
that `import shapebody` is quick and starts no JAX backend.

To read the method, take these modules in order; each needs only what came before:

    design.parameters      the entries of a design, block by block
    design.phi             Φ, from a design to a body
    design.descriptions    what the networks are told of a body
    task.rewards           the reward terms T1 to T23
    task.observations      what policy and critic observe
    task.curriculum        the coefficient c, and when it moves
    task.episode           one control step and one episode, as pure functions
    networks.urma          one network for any number of joints and feet
    networks.policy        the policy
    networks.critic        the direct-design critic of eq. (3)
    training.losses        PPO: advantages and losses
    training.update        one PPO update
    optimizers.objective   the mean value over a bank of states, less the trust-region penalty
    optimizers.vgds        value-gradient design search
    evaluation.evaluate    what a body is worth: returns of the frozen policy
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
