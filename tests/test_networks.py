import dataclasses
import functools
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapebody.networks.config import CriticConfig, PolicyConfig
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import (
    FOOT_DESCRIPTION,
    FOOT_OBSERVATION,
    GENERAL,
    INPUT_SIZES,
    JOINT_DESCRIPTION,
    JOINT_OBSERVATION,
    PRIVILEGED,
    STATIC,
    count_parameters,
    initialize,
    standardization,
)
from shapebody.networks.policy import Policy, entropy, log_prob
from shapebody.networks.published import read_published_policy
from shapebody.networks.urma import aggregate, elu

# Wide key layers would only slow these tests down; nothing below depends on the sizes.
SMALL_POLICY = PolicyConfig((12, 8), 3, (16, 8), initial_temperature=0.3, latent_scale=4.0)
SMALL_CRITIC = CriticConfig("direct-design", 3, (12, 8), 5, (6, 4), 3, (16,), 0.3, 0.025, 4.0)
NETWORKS = {
    "policy": Policy(SMALL_POLICY),
    "direct-design": Critic(SMALL_CRITIC),
    "original": Critic(replace(SMALL_CRITIC, kind="original")),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Designs:
    joints: jax.Array
    joint_mask: jax.Array
    feet: jax.Array
    foot_mask: jax.Array
    static: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class States:
    joints: jax.Array
    feet: jax.Array
    general: jax.Array
    privileged: jax.Array


def random_inputs(seed, description_axes=(), axes=(), joints=5, feet=2):
    random = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(random.normal(size=shape), jnp.float32)

    descriptions = Designs(
        joints=normal(*description_axes, joints, JOINT_DESCRIPTION),
        joint_mask=jnp.ones((*description_axes, joints)),
        feet=normal(*description_axes, feet, FOOT_DESCRIPTION),
        foot_mask=jnp.ones((*description_axes, feet)),
        static=normal(*description_axes, STATIC),
    )
    observation = States(
        joints=normal(*axes, joints, JOINT_OBSERVATION),
        feet=normal(*axes, feet, FOOT_OBSERVATION),
        general=normal(*axes, GENERAL),
        privileged=normal(*axes, PRIVILEGED),
    )
    return descriptions, observation


@functools.cache
def random_variables(network, seed=0):
    """Variables in which no parameter is zero, so that none can hide a mistake."""
    variables = initialize(network, jax.random.key(seed))
    random = np.random.default_rng(seed)
    params = jax.tree.map(
        lambda x: np.asarray(x) + np.float32(0.2) * random.normal(size=x.shape).astype("f4"),
        variables["params"],
    )
    return variables | {"params": params}


@functools.cache
def compiled(network, method="__call__"):
    return jax.jit(functools.partial(network.apply, method=method))


def outputs(network, variables, descriptions, observation):
    return jax.tree.leaves(compiled(network)(variables, descriptions, observation))


@pytest.fixture(params=NETWORKS)
def network(request):
    return NETWORKS[request.param]


@pytest.mark.parametrize(
    ("network", "count"),
    [
        (Policy(), 945_430),
        (Critic(), 5_378_312),
        (Policy(PolicyConfig.reduced()), 46_422),
        (Critic(CriticConfig.reduced()), 70_914),
    ],
)
def test_parameter_counts(network, count):
    variables = jax.eval_shape(lambda: initialize(network, jax.random.key(0)))
    assert count_parameters(variables["params"]) == count


def test_original_critic_sees_descriptions_in_its_keys_only():
    shapes = {}
    for kind in ("direct-design", "original"):
        network = NETWORKS[kind]
        variables = jax.eval_shape(lambda network=network: initialize(network, jax.random.key(0)))
        shapes[kind] = variables["params"]["joint_encoder"]["value_kernel"].shape
    assert shapes == {"direct-design": (34, 5), "original": (4, 5)}
    config = CriticConfig.original()
    assert (config.heads, config.joint_value_latent, config.foot_value_latent) == (1, 4, 4)


def test_output_shapes_and_limits():
    descriptions, observation = random_inputs(0, (2, 1), (2, 3))
    policy = NETWORKS["policy"]
    variables = random_variables(policy)
    large = jax.tree.map(lambda x: 100 * x, variables["params"])
    mean, std = outputs(policy, variables | {"params": large}, descriptions, observation)
    assert mean.shape == std.shape == (2, 3, 5)
    assert np.abs(mean).max() == 10.0
    assert std.min() == pytest.approx(0.01) and std.max() == pytest.approx(2.0)
    critic = NETWORKS["direct-design"]
    (values,) = outputs(critic, random_variables(critic), descriptions, observation)
    assert values.shape == (2, 3, 3)
    assert np.abs(values[..., 0] - values[..., 1]).max() > 1e-3


@pytest.mark.parametrize("config", [SMALL_POLICY, PolicyConfig.reduced(log_std_input="softmax")])
def test_initial_actions(config):
    policy = Policy(config)
    variables = initialize(policy, jax.random.key(1))
    mean, std = outputs(policy, variables, *random_inputs(1, (), (50,)))
    np.testing.assert_allclose(std, 1.0, rtol=1e-6)
    assert np.sqrt(np.mean(mean**2)) < 1.0
    assert np.std(mean) > 0.0


def test_initial_std_can_be_chosen():
    policy = Policy(replace(SMALL_POLICY, initial_std=0.5))
    _, std = outputs(policy, initialize(policy, jax.random.key(1)), *random_inputs(1))
    np.testing.assert_allclose(std, 0.5, rtol=1e-6)


def test_padding_changes_nothing(network):
    """What stands in padded slots reaches neither outputs nor gradients."""
    descriptions, observation = random_inputs(2, (2, 1), (2, 3))
    variables = random_variables(network)
    random = np.random.default_rng(9)

    def padded(tree, size):
        def pad(array):
            shape = (*array.shape[:-2], 3, array.shape[-1])
            padding = np.float32(size) * random.normal(size=shape).astype("f4")
            return np.concatenate([array, padding], -2)

        tree = replace(tree, joints=pad(tree.joints), feet=pad(tree.feet))
        if isinstance(tree, Designs):
            none = np.zeros((2, 1, 3), "f4")
            tree = replace(
                tree,
                joint_mask=np.concatenate([tree.joint_mask, none], -1),
                foot_mask=np.concatenate([tree.foot_mask, none], -1),
            )
        return tree

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1), has_aux=True)
    def run(params, descriptions, observation):
        masks = {name: getattr(descriptions, name) for name in ("joint_mask", "foot_mask")}
        descriptions = replace(descriptions, **jax.lax.stop_gradient(masks))
        result = network.apply(variables | {"params": params}, descriptions, observation)
        return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(result)), result

    plain = outputs(network, variables, descriptions, observation)
    zeros, garbage = (
        run(variables["params"], padded(descriptions, size), padded(observation, size))
        for size in (0, 30)
    )
    for a, b in zip(plain, jax.tree.leaves(garbage[1]), strict=True):
        np.testing.assert_allclose(a, b[..., : a.shape[-1]], atol=1e-6)
    for a, b in zip(jax.tree.leaves(zeros), jax.tree.leaves(garbage), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-5)
    (_, gradient), result = garbage
    assert np.any(gradient.joints[..., :5, :]) and not np.any(gradient.joints[..., 5:, :])
    if isinstance(network, Policy):
        mean, std = result
        assert not np.any(mean[..., 5:]) and np.all(std[..., 5:] == 1)
    else:
        assert np.any(gradient.feet[..., :2, :]) and not np.any(gradient.feet[..., 2:, :])


def test_order_of_parts_does_not_matter(network):
    descriptions, observation = random_inputs(3, (2, 1), (2, 3))
    variables = random_variables(network)
    joints, feet = np.array([3, 0, 4, 1, 2]), np.array([1, 0])
    shuffled = (
        replace(
            descriptions,
            joints=descriptions.joints[..., joints, :],
            feet=descriptions.feet[..., feet, :],
        ),
        replace(
            observation,
            joints=observation.joints[..., joints, :],
            feet=observation.feet[..., feet, :],
        ),
    )
    before = outputs(network, variables, descriptions, observation)
    after = outputs(network, variables, *shuffled)
    for a, b in zip(before, after, strict=True):
        expected = a[..., joints] if isinstance(network, Policy) else a
        np.testing.assert_allclose(expected, b, atol=1e-5)


def test_embedding_and_broadcasting(network):
    """embed + act is the whole call, and broadcasting is the same as repeating."""
    variables = random_variables(network)
    # Designs with their own states (training), and every design with every state (search).
    for axes in ((2, 3), (3,)):
        descriptions, observation = random_inputs(4, (2, 1), axes)
        embedding = compiled(network, "embed")(variables, descriptions)
        split = compiled(network, "act")(variables, embedding, descriptions, observation)
        every = [
            jax.tree.map(lambda x, n=n: np.broadcast_to(x, (2, 3) + x.shape[n:]), tree)
            for tree, n in ((descriptions, 2), (observation, len(axes)))
        ]
        whole = outputs(network, variables, *every)
        for a, b in zip(jax.tree.leaves(split), whole, strict=True):
            assert a.shape[:2] == (2, 3)
            np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("kind", ["direct-design", "original"])
def test_value_gradient_against_finite_differences(kind):
    network = NETWORKS[kind]
    variables = random_variables(network)
    inputs = random_inputs(6)
    with jax.enable_x64(True):
        variables, descriptions, state = jax.tree.map(
            lambda x: np.asarray(x, np.float64), (variables, *inputs)
        )

        @jax.jit
        @jax.value_and_grad
        def mean_value(descriptions):
            return jnp.mean(network.apply(variables, descriptions, state))

        _, gradient = mean_value(descriptions)
        random = np.random.default_rng(0)
        for name in ("joints", "feet", "static"):
            start = getattr(descriptions, name)
            direction = random.normal(size=start.shape)
            high, _ = mean_value(replace(descriptions, **{name: start + 1e-6 * direction}))
            low, _ = mean_value(replace(descriptions, **{name: start - 1e-6 * direction}))
            slope = float(high - low) / 2e-6
            expected = float(np.sum(np.asarray(getattr(gradient, name)) * direction))
            assert slope == pytest.approx(expected, rel=1e-6)
            assert abs(slope) > 1e-4


@pytest.mark.parametrize("kind", ["direct-design", "original"])
def test_critic_against_numpy(kind):
    network = NETWORKS[kind]
    variables = random_variables(network)
    descriptions, observation = random_inputs(12)
    params = jax.tree.map(np.asarray, variables["params"])

    def norm(x, layer):
        x = (x - x.mean()) / np.sqrt(x.var() + 1e-6)
        return x * layer["scale"] + layer["bias"]

    def bend(x):
        return np.where(x > 0, x, np.exp(np.minimum(x, 0)) - 1)

    def encode(layers, parts):
        temperature, latent = np.exp(layers["log_temperature"]) + 0.025, 0
        for d, o in zip(*parts, strict=True):
            both = np.concatenate([d, o])
            hidden = bend(
                norm(both @ layers["key_kernel"] + layers["key_bias"], layers["key_norm"])
            )
            last = layers["key_layers_0"]
            key = np.exp(np.tanh(hidden @ last["kernel"] + last["bias"]) / temperature)
            seen = both if kind == "direct-design" else np.asarray(o)
            value = bend(seen @ layers["value_kernel"] + layers["value_bias"])
            latent = latent + 4.0 * np.outer(key / key.sum(), value).ravel()
        return latent

    core = np.concatenate(
        [
            encode(params["joint_encoder"], (descriptions.joints, observation.joints)),
            encode(params["foot_encoder"], (descriptions.feet, observation.feet)),
            observation.general,
            descriptions.static,
            observation.privileged,
        ]
    )
    expected = []
    for head in range(3):
        layers, x = jax.tree.map(lambda x, head=head: x[head], params["heads"]), core
        for name in ("layer_0", "layer_1"):
            kernel = layers[name]["kernel"]
            x = x @ (layers[name]["scale"] * kernel / np.linalg.norm(kernel, axis=0))
            x = x + layers[name]["bias"]
            if name == "layer_0":
                x = bend(norm(x, layers["norm"]))
        expected.append(x[0])
    (values,) = outputs(network, variables, descriptions, observation)
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)


def test_temperature():
    policy = NETWORKS["policy"]
    variables = initialize(policy, jax.random.key(0))

    def temperature(log_temperature):
        variables["params"]["joint_encoder"]["log_temperature"] = log_temperature
        return float(policy.apply(variables, method=lambda m: m.joint_encoder.temperature())[0])

    start = variables["params"]["joint_encoder"]["log_temperature"]
    assert temperature(start) == pytest.approx(0.3)
    assert temperature(jnp.full(1, -50.0)) == pytest.approx(0.025)
    out = outputs(policy, variables, *random_inputs(7, (2, 1), (2, 3)))
    assert all(np.isfinite(x).all() for x in out)


def test_aggregate_and_elu():
    random = np.random.default_rng(0)
    keys, values = random.normal(size=(2, 3, 5, 7)), random.normal(size=(2, 3, 5, 4))
    latent = np.asarray(aggregate(jnp.asarray(keys), jnp.asarray(values)))
    assert latent.shape == (2, 3, 28)
    for k, index in ((0, 0), (2, 3), (6, 1)):
        expected = np.sum(keys[..., k] * values[..., index], axis=-1)
        np.testing.assert_allclose(latent[..., 4 * k + index], expected, rtol=1e-4, atol=1e-5)
    x = jnp.asarray([-30.0, -1.0, -1e-3, 0.0, 1e-3, 5.0])
    np.testing.assert_allclose(elu(x), jax.nn.elu(x), atol=2e-7)
    slopes = [jax.vmap(jax.grad(f))(x) for f in (elu, jax.nn.elu)]
    np.testing.assert_allclose(*slopes, atol=1e-6)


def test_latent_scale_multiplies_the_latent():
    descriptions, observation = random_inputs(8)
    latents = []
    for scale in (1.0, 3.0):
        policy = Policy(replace(SMALL_POLICY, latent_scale=scale))

        def latent(module):
            embedding = module.embed(descriptions)["joints"]
            return module.joint_encoder(embedding, observation.joints, descriptions.joint_mask)[0]

        latents.append(policy.apply(random_variables(policy), method=latent))
    np.testing.assert_allclose(3 * latents[0], latents[1], rtol=1e-5)


def test_standardization():
    random = np.random.default_rng(0)
    descriptions, observation = random_inputs(9, (40,), joints=4)
    scale = np.full(JOINT_DESCRIPTION, 0.1)
    scale[:3] = 0.0, 1e-4, 0.01
    joints = -0.7 + scale * random.normal(size=(40, 4, JOINT_DESCRIPTION))
    joints[:, 3] = 1e6
    mask = np.ones((40, 4))
    mask[:, 3] = 0
    descriptions = replace(descriptions, joints=joints, joint_mask=mask)
    half = [jax.tree.map(lambda x, k=k: x[k], descriptions) for k in (slice(0, 9), slice(9, 40))]
    constants = standardization(*half)
    joint = constants["joint_descriptions"]
    np.testing.assert_allclose(joint["mean"], joints[:, :3].mean((0, 1)), rtol=1e-5)
    assert joint["scale"][0] == 1.0
    assert joint["scale"][1] == pytest.approx(1e-3)
    np.testing.assert_allclose(joint["scale"][2:], joints[:, :3].std((0, 1))[2:], rtol=1e-5)
    np.testing.assert_allclose(
        constants["joint_observations"]["scale"], [0.5 / 6.5, 5 / 180, 0.1, 1.0]
    )

    with pytest.raises(ValueError, match="at least one batch"):
        standardization()


@pytest.mark.parametrize("kind", ["policy", "direct-design"])
def test_constants_standardize_the_inputs(kind):
    network = NETWORKS[kind]
    random = np.random.default_rng(1)
    constants = {
        name: {"mean": random.normal(size=size), "scale": random.uniform(0.5, 2, size=size)}
        for name, size in INPUT_SIZES.items()
    }
    given = initialize(network, jax.random.key(0), constants)["constants"]
    assert given.keys() <= constants.keys()
    descriptions, observation = random_inputs(9, (2, 1), (2, 3))

    def standardized(tree, **names):
        fields = {
            field: (getattr(tree, field) - constants[name]["mean"]) / constants[name]["scale"]
            for field, name in names.items()
        }
        return replace(tree, **{field: np.float32(value) for field, value in fields.items()})

    plain = random_variables(network)
    expected = outputs(
        network,
        plain,
        standardized(
            descriptions, joints="joint_descriptions", feet="foot_descriptions", static="static"
        ),
        standardized(
            observation,
            joints="joint_observations",
            feet="foot_observations",
            general="general",
            privileged="privileged",
        ),
    )
    got = outputs(network, plain | {"constants": given}, descriptions, observation)
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_gaussian_helpers():
    random = np.random.default_rng(0)
    mean, action = random.normal(size=(2, 6, 4))
    std = random.uniform(0.1, 2.0, size=(6, 4))
    mask = np.array([1.0, 1.0, 1.0, 0.0])
    density = np.exp(-0.5 * ((action - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi))
    expected = np.sum(np.log(density)[:, :3], axis=1)
    np.testing.assert_allclose(log_prob(mean, std, action, mask), expected, rtol=1e-5)
    # The mean of -log p over samples is the entropy.
    samples = mean[0] + std[0] * random.normal(size=(200_000, 4))
    estimate = -np.mean(log_prob(mean[0], std[0], samples, mask))
    assert float(entropy(std[0], mask)) == pytest.approx(float(estimate), abs=0.02)


def test_configs_survive_json():
    for config in (PolicyConfig.reduced(), CriticConfig.original(heads=3)):
        copy = type(config)(**json.loads(json.dumps(dataclasses.asdict(config))))
        assert copy == config and hash(copy) == hash(config)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PolicyConfig(key_widths=(64, 64)), "ends with 256 and key_widths with 64"),
        (lambda: PolicyConfig(log_std_input="key"), "log_std_input is 'key'"),
        (lambda: PolicyConfig(initial_std=3.0), "initial_std is 3.0"),
        (lambda: PolicyConfig(initial_temperature=0.01), "initial_temperature is 0.01"),
        (lambda: PolicyConfig(latent_scale=0.0), "latent_scale is 0.0"),
        (lambda: CriticConfig(kind="urma"), "kind is 'urma'"),
        (lambda: CriticConfig(heads=0), "heads is 0"),
        (lambda: CriticConfig(foot_key_widths=()), "foot_key_widths is ()"),
    ],
)
def test_bad_configs(make, message):
    with pytest.raises(ValueError) as error:
        make()
    assert message in str(error.value)


def test_wrong_input_width():
    descriptions, observation = random_inputs(10)
    with pytest.raises(ValueError, match=r"general has shape \(12,\); expected \[\.\.\., 13\]"):
        outputs(
            NETWORKS["policy"],
            initialize(NETWORKS["policy"], jax.random.key(0)),
            descriptions,
            replace(observation, general=observation.general[:12]),
        )


# Published weight format. The expected actions come from plain NumPy on the file's own layers.

LATENT, VALUE = 8, 3
SHAPES = {
    "Dense_0": (34, 12),
    "Dense_1": (12, LATENT),
    "Dense_2": (4, VALUE),
    "Dense_3": (LATENT * VALUE + 27, 20),
    "Dense_4": (20, 16),
    "Dense_5": (16, 12),
    "Dense_6": (12, 10),
    "Dense_7": (10, LATENT),
    "Dense_8": (LATENT, 1),
}


def published_layers():
    random = np.random.default_rng(0)
    layers = {}
    for name, shape in SHAPES.items():
        layers[f"{name}.bias"] = 0.3 * random.normal(size=shape[1])
        layers[f"{name}.kernel"] = random.normal(size=shape) / np.sqrt(shape[0])
    for name, size in (("LayerNorm_0", 12), ("LayerNorm_1", 20)):
        layers[f"{name}.bias"] = 0.3 * random.normal(size=size)
        layers[f"{name}.scale"] = random.uniform(0.5, 1.5, size=size)
    layers["joint_log_softmax_temperature"] = np.array([-2.0])
    return {name: array.astype(np.float32) for name, array in layers.items()}


def write_published(folder, layers, name="robot"):
    index, offset = [], 0
    for layer, array in layers.items():
        index.append(
            {"name": layer, "shape": array.shape, "offset": offset, "size_bytes": array.nbytes}
        )
        offset += array.nbytes
    hyperparameters = {
        "softmax_temperature": 1.0,
        "softmax_temperature_min": 0.025,
        "stability_epsilon": 1e-8,
        "policy_mean_abs_clip": 10.0,
    }
    document = {"layers": index, "hyperparams": hyperparameters}
    (folder / f"{name}.weights.json").write_text(json.dumps(document))
    numbers = b"".join(array.astype("<f4").tobytes() for array in layers.values())
    (folder / f"{name}.weights.bin").write_bytes(numbers)


def published_actions(layers, descriptions, observation):
    def dense(x, index):
        return x @ layers[f"Dense_{index}.kernel"] + layers[f"Dense_{index}.bias"]

    def norm(x, index):
        x = (x - x.mean()) / np.sqrt(x.var() + 1e-6)
        return x * layers[f"LayerNorm_{index}.scale"] + layers[f"LayerNorm_{index}.bias"]

    def bend(x):
        return np.where(x > 0, x, np.exp(np.minimum(x, 0)) - 1)

    temperature = np.exp(layers["joint_log_softmax_temperature"][0]) + 0.025
    latent, keys, log_std = np.zeros(LATENT * VALUE), [], []
    for d, o in zip(descriptions.joints, observation.joints, strict=True):
        hidden = bend(norm(dense(np.concatenate([d, o]), 0), 0))
        bounded = np.tanh(dense(hidden, 1))
        key = np.exp(bounded / temperature)
        key /= key.sum()
        value = bend(dense(np.asarray(o), 2))
        for k in range(LATENT):
            for index in range(VALUE):
                latent[k * VALUE + index] += key[k] * value[index]
        keys.append(key)
        log_std.append(dense(bounded, 8)[0])
    x = np.concatenate([latent, observation.general, descriptions.static])
    x = bend(norm(dense(x, 3), 1))
    for index in (4, 5, 6):
        x = bend(dense(x, index))
    mean = np.array([dense(x, 7) @ key for key in keys])
    return np.clip(mean, -10, 10), np.clip(np.exp(log_std), 0.01, 2)


def test_published_policy(tmp_path):
    layers = published_layers()
    write_published(tmp_path, layers)
    policy, variables, name = read_published_policy(tmp_path)
    assert name == "robot"
    merged = sum(array.size for array in layers.values())
    assert count_parameters(variables["params"]) == merged + 20 + 16 + 12 + 10 + LATENT
    inputs = random_inputs(11)
    mean, std = outputs(policy, variables, *inputs)
    expected_mean, expected_std = published_actions(layers, *inputs)
    np.testing.assert_allclose(mean, expected_mean, atol=2e-5)
    np.testing.assert_allclose(std, expected_std, rtol=2e-5)
    assert np.ptp(mean) > 0.01


def test_published_policy_errors(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no \*\.weights\.json"):
        read_published_policy(tmp_path)
    layers = published_layers()
    write_published(tmp_path, layers, "first")
    write_published(tmp_path, layers, "second")
    with pytest.raises(ValueError, match="first, second"):
        read_published_policy(tmp_path)
    read_published_policy(tmp_path, "second")
    with pytest.raises(FileNotFoundError, match="third"):
        read_published_policy(tmp_path, "third")
    numbers = tmp_path / "first.weights.bin"
    numbers.write_bytes(numbers.read_bytes()[:-8])
    with pytest.raises(ValueError, match="fetch both files again"):
        read_published_policy(tmp_path, "first")
    write_published(tmp_path, {k: v for k, v in layers.items() if k != "Dense_8.bias"}, "first")
    with pytest.raises(ValueError, match="other layers .*Dense_8.bias"):
        read_published_policy(tmp_path, "first")
    write_published(tmp_path, layers | {"Dense_4.kernel": np.zeros((19, 16), "f4")}, "first")
    with pytest.raises(ValueError, match="Dense_4.kernel .* expected 20 rows"):
        read_published_policy(tmp_path, "first")
    write_published(tmp_path, layers | {"Dense_4.bias": np.full(16, np.nan, "f4")}, "first")
    with pytest.raises(ValueError, match="not finite"):
        read_published_policy(tmp_path, "first")
