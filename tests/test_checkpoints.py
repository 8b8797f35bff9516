"""Agents on disk, and exact copies of training state."""

import dataclasses
import json
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tiny import quick_compilation, tiny_agent, tiny_robot

from shapebody.agent.description import HASHED, hash_document
from shapebody.agent.store import agents, load_agent, load_curve, save_agent
from shapebody.design.descriptions import Descriptions
from shapebody.files import atomic_write, data_dir, load_arrays, save_arrays
from shapebody.provenance import provenance


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    return tiny_robot(folder, 2), tiny_robot(folder, 3)


@pytest.fixture(scope="module")
def agent(robots):
    return tiny_agent(*robots, states=5)


@pytest.fixture
def folder(agent, tmp_path):
    return save_agent(agent, tmp_path / "tiny")


def same(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)


# agents


def test_an_agent_comes_back_as_it_was(agent, folder):
    again = load_agent(folder)
    for name in ("name", "robots", "sizes", "policy_config", "critic_config", "hash"):
        assert getattr(again, name) == getattr(agent, name), name
    same(again.policy, agent.policy)
    same(again.critic, agent.critic)
    same(again.states, agent.states)
    np.testing.assert_array_equal(again.state_robots, agent.state_robots)
    assert again.num_states == 10 and again.states.joints.dtype == np.float32
    assert again.metadata["steps"] == 0
    assert again.metadata["versions"]["jax"] == jax.__version__
    assert sorted(path.name for path in folder.iterdir()) == [
        "agent.json",
        "states.npz",
        "weights.safetensors",
    ]
    assert repr(again) == repr(agent) and agent.hash[:12] in repr(agent)


def test_networks_of_an_agent(agent):
    with quick_compilation():
        check_networks(agent)


def check_networks(agent):
    j, f = agent.sizes.joints, agent.sizes.feet
    rng = np.random.default_rng(0)
    fields = {field.name: np.zeros(()) for field in dataclasses.fields(Descriptions)}
    descriptions = Descriptions(
        **fields
        | dict(
            joints=rng.normal(size=(j, 30)).astype(np.float32),
            joint_mask=np.ones(j, np.float32),
            feet=rng.normal(size=(f, 21)).astype(np.float32),
            foot_mask=np.ones(f, np.float32),
            static=rng.normal(size=14).astype(np.float32),
        )
    )
    mean, _ = jax.jit(agent.policy_module.apply)(agent.policy, descriptions, agent.states)
    np.testing.assert_allclose(agent.act(descriptions, agent.states), mean, atol=1e-5)
    values = agent.values(descriptions, agent.states)
    assert values.shape == (10, 2)
    expected = jax.jit(agent.critic_module.apply)(agent.critic, descriptions, agent.states)
    np.testing.assert_allclose(values, expected, atol=1e-5)


def test_an_agent_without_states(agent, folder):
    bare = dataclasses.replace(agent, states=None, state_robots=None)
    save_agent(bare, folder)
    assert not (folder / "states.npz").exists()
    again = load_agent(folder)
    assert again.states is None and again.state_robots is None and again.num_states == 0


def test_jax_arrays_and_numpy_values_in_metadata_are_written(agent, tmp_path):
    metadata = {"seconds": np.float32(1.5), "curve": jnp.arange(3), "config": agent.policy_config}
    changed = dataclasses.replace(
        agent, critic=jax.tree.map(jnp.asarray, agent.critic), metadata=metadata
    )
    again = load_agent(save_agent(changed, tmp_path / "a"))
    assert again.hash == agent.hash
    assert again.metadata["seconds"] == 1.5 and again.metadata["curve"] == [0, 1, 2]
    assert again.metadata["config"]["value_latent"] == agent.policy_config.value_latent
    with pytest.raises(ValueError, match="agent 'tiny': metadata.steps is 'many'; expected"):
        save_agent(dataclasses.replace(agent, metadata={"steps": "many"}), tmp_path / "b")
    for bad in (float("nan"), object()):
        with pytest.raises(ValueError, match="metadata of agent 'tiny'.*JSON"):
            save_agent(dataclasses.replace(agent, metadata={"x": bad}), tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_hash_depends_on_every_weight(agent):
    def nudged(tree):
        leaves, structure = jax.tree.flatten(tree)
        leaves[-1] = leaves[-1] + np.float32(1e-6)
        return jax.tree.unflatten(structure, leaves)

    for role in ("policy", "critic"):
        other = dataclasses.replace(agent, **{role: nudged(getattr(agent, role))})
        assert other.hash != agent.hash
    assert dataclasses.replace(agent, name="other").hash == agent.hash


@pytest.mark.parametrize("what", ["np.savez_compressed", "os.fsync"])
def test_an_interruption_leaves_the_old_agent(agent, folder, monkeypatch, what):
    """While the states are compressed, and while the last file, the description, is written."""
    other = dataclasses.replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    done, calls = {"np.savez_compressed": 0, "os.fsync": 2}[what], []

    def interrupt(*args, **kwargs):
        calls.append(args)
        if len(calls) > done:
            raise KeyboardInterrupt

    monkeypatch.setattr(what.replace("np", "numpy"), interrupt)
    with pytest.raises(KeyboardInterrupt):
        save_agent(other, folder)
    monkeypatch.undo()
    assert load_agent(folder).hash == agent.hash
    assert len(list(folder.iterdir())) == 3
    save_agent(other, folder)
    assert load_agent(folder).hash == other.hash != agent.hash


def test_curve(agent, folder):
    assert not (folder / "curve.csv").exists()
    with pytest.raises(FileNotFoundError, match="no learning curve"):
        load_curve(folder)
    rows = [{"steps": 10, "return": np.float32(1.5)}, {"steps": 20, "std": 0.5}]
    save_agent(agent, folder, curve=rows)
    before = (folder / "curve.csv").read_bytes()
    save_agent(agent, folder)
    assert (folder / "curve.csv").read_bytes() == before
    curve = load_curve(folder)
    np.testing.assert_array_equal(curve["steps"], [10, 20])
    np.testing.assert_array_equal(curve["return"], [1.5, np.nan])
    np.testing.assert_array_equal(curve["std"], [np.nan, 0.5])
    (folder / "curve.csv").write_text("steps,return\n10,many\n")
    with pytest.raises(ValueError, match="not a learning curve .*'many'"):
        load_curve(folder)


def test_settings_that_were_edited_are_noticed(agent, folder):
    """`latent_scale` changes what the networks compute, and no shape."""
    path = folder / "agent.json"
    document = json.loads(path.read_text())
    document["critic_config"]["latent_scale"] *= 2
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="critic_config in .* the file was edited; restore"):
        load_agent(folder)


def test_a_state_bank_with_a_broken_byte_is_refused(folder):
    path = folder / "states.npz"
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 40).astype(int):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            load_agent(folder)  # a byte that no array depends on may change
        except ValueError as error:
            assert "restore the folder" in str(error)


def test_an_interrupt_between_two_files_waits_for_the_last(agent, folder, monkeypatch):
    other = dataclasses.replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    move = os.replace

    def interrupted(*paths):
        signal.raise_signal(signal.SIGINT)
        move(*paths)

    monkeypatch.setattr("os.replace", interrupted)
    # A shell starts what it runs in the background with this signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            save_agent(other, folder)
    finally:
        signal.signal(signal.SIGINT, before)
    monkeypatch.undo()
    assert load_agent(folder).hash == other.hash != agent.hash


def test_names(agent, tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    with pytest.raises(ValueError, match="no agent 'tiny'.*Available agents: none"):
        load_agent("tiny")
    assert save_agent(agent) == tmp_path / "checkpoints" / "tiny"
    save_agent(dataclasses.replace(agent, name="other"))
    assert agents() == ["other", "tiny"]
    assert load_agent("tiny").hash == agent.hash
    with pytest.raises(ValueError, match="did you mean 'tiny'.*other, tiny"):
        load_agent("tinny")
    with pytest.raises(FileNotFoundError, match="nowhere.*does not exist"):
        load_agent("some/nowhere")
    with pytest.raises(FileNotFoundError, match="agent.json does not exist"):
        load_agent(tmp_path)


@pytest.mark.parametrize("name", ["weights.safetensors", "states.npz", "agent.json"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_files_that_are_cut_off(folder, name, share):
    path = folder / name
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=rf"{name} is (cut off|not a valid)"):
        load_agent(folder)


@pytest.mark.parametrize("name", ["weights.safetensors", "states.npz", "agent.json"])
def test_files_that_are_missing(folder, name):
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{name} does not exist"):
        load_agent(folder)


def test_files_that_were_edited(agent, folder):
    original = {path.name: path.read_bytes() for path in folder.iterdir()}

    def restore():
        for name, data in original.items():
            (folder / name).write_bytes(data)

    description = json.loads(original["agent.json"])
    (folder / "agent.json").write_text(json.dumps(description | {"states_hash": None}))
    with pytest.raises(ValueError, match="no state bank, but there is .*states.npz.*restore"):
        load_agent(folder)
    restore()

    weights = folder / "weights.safetensors"
    weights.write_bytes(original[weights.name][:-4] + np.float32(0.123).tobytes())
    with pytest.raises(ValueError, match="weights.safetensors does not match the hash.*restore"):
        load_agent(folder)
    restore()

    with np.load(folder / "states.npz") as file:
        states = dict(file)
    states["general"] = states["general"] + 1
    np.savez(folder / "states.npz", **states)
    with pytest.raises(ValueError, match="states.npz does not match the hash"):
        load_agent(folder)
    restore()

    def edit(change):
        document = json.loads(original["agent.json"])
        change(document)
        configuration = {name: document.get(name) for name in HASHED}
        document["configuration_hash"] = hash_document(configuration)
        (folder / "agent.json").write_text(json.dumps(document))

    def wider(document):
        document["critic_config"]["head_widths"] = [13, 8]

    edit(wider)
    with pytest.raises(ValueError, match=r"critic/.* is float32.*, expected .*and \d+ more"):
        load_agent(folder)
    edit(lambda document: document["sizes"].update(joints=4))
    with pytest.raises(ValueError, match="states.joints.*expected"):
        load_agent(folder)
    edit(lambda document: document["policy_config"].update(unknown=1))
    with pytest.raises(ValueError, match="agent.json is not a valid agent description"):
        load_agent(folder)
    for metadata in (None, {"steps": "many"}):
        edit(lambda document, metadata=metadata: document.update(metadata=metadata))
        with pytest.raises(ValueError, match="agent.json is not a valid agent desc.*metadata"):
            load_agent(folder)
    edit(lambda document: document.pop("robots"))
    with pytest.raises(ValueError, match="agent.json is not a valid agent description.*robots"):
        load_agent(folder)
    edit(lambda document: document.update(format=99))
    with pytest.raises(ValueError, match="format 99, expected 1"):
        load_agent(folder)
    restore()
    assert load_agent(folder).hash == agent.hash


def test_agents_that_do_not_fit_together_are_not_written(agent, tmp_path):
    bad = [
        (dict(robots=()), "names no robots"),
        (dict(policy=agent.critic), "agent 'tiny' does not fit .*policy/"),
        (dict(critic={"params": agent.critic["params"]}), "critic/constants/.* is missing"),
        (dict(state_robots=agent.state_robots + 1), "state_robots.*from 0 to 1"),
        (dict(state_robots=None), "state_robots"),
        (dict(state_robots=agent.state_robots / 2), "integers"),
        (dict(states=jax.tree.map(lambda x: x[:, :1], agent.states)), "states.joints"),
        (
            dict(states=jax.tree.map(lambda x: x[:0], agent.states), state_robots=np.zeros(0, int)),
            "at least one state",
        ),
    ]
    for changes, message in bad:
        with pytest.raises(ValueError, match=message):
            save_agent(dataclasses.replace(agent, **changes), tmp_path / "bad")
    assert not (tmp_path / "bad").exists()


def test_provenance():
    record = provenance()
    assert json.dumps(record)
    assert {"python", "jax", "mujoco", "numpy"} <= set(record["versions"])
    assert record["commit"] is None or len(record["commit"].rstrip("+")) == 40


# files


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = atomic_write(tmp_path / "new" / "x.txt", "old")
    assert path.read_text() == "old"

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        atomic_write(path, b"new")
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["x.txt"]


TREE = {
    "float": np.linspace(0, 1, 7),
    "list": [np.float32(3.5), jnp.arange(6, dtype=jnp.int32).reshape(2, 3)[:, ::2], None],
    "bool": np.array(True),
    "empty": np.zeros((0, 3), np.float32),
    "uint": np.array([2**63 + 1], np.uint64),
    "transposed": np.arange(6.0).reshape(2, 3).T,
    "key": jax.random.PRNGKey(3),
    "numbers": (1, 2.5, True),
}


def test_arrays_come_back_exactly(tmp_path):
    path = save_arrays(tmp_path / "state.safetensors", TREE)
    again = load_arrays(path, TREE)
    same(again, TREE)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(TREE), strict=True):
        assert isinstance(a, jax.Array) == isinstance(b, jax.Array)
        assert np.asarray(a).dtype == np.asarray(b).dtype and np.shape(a) == np.shape(b)
    assert again["numbers"] == (1, 2.5, True) and isinstance(again["numbers"][2], bool)
    shapes = jax.eval_shape(lambda: {"x": jnp.zeros((2, 3))})
    save_arrays(path, {"x": jnp.ones((2, 3))})
    assert isinstance(load_arrays(path, shapes)["x"], np.ndarray)


def test_dataclasses_come_back_exactly(agent, tmp_path):
    path = save_arrays(tmp_path / "x", agent.states)
    again = load_arrays(path, agent.states)
    assert type(again) is type(agent.states)
    same(again, agent.states)


@settings(max_examples=30, deadline=None)
@given(
    value=st.sampled_from(["float32", "float64", "int8", "int64", "uint32", "bool"]).flatmap(
        lambda kind: arrays.arrays(kind, arrays.array_shapes(min_dims=0, min_side=0, max_side=4))
    )
)
def test_any_array_keeps_its_bits(value, tmp_path_factory):
    path = save_arrays(tmp_path_factory.mktemp("x") / "x", {"a": value})
    again = load_arrays(path, {"a": value})["a"]
    assert again.dtype == value.dtype and again.shape == value.shape
    assert again.tobytes() == value.tobytes()


def test_arrays_of_another_state_are_refused(tmp_path):
    path = save_arrays(tmp_path / "state", {"a": np.zeros(3), "b": np.zeros(2)})
    with pytest.raises(ValueError, match=r"state does not fit.*c is missing.*'b' is unknown"):
        load_arrays(path, {"a": np.zeros(3), "c": 1.0})
    with pytest.raises(ValueError, match=r"a is float64\[3\], expected float32\[3\]"):
        load_arrays(path, {"a": np.zeros(3, np.float32), "b": np.zeros(2)})
    with pytest.raises(ValueError, match=r"b is float64\[2\], expected float64\[4\]"):
        load_arrays(path, {"a": np.zeros(3), "b": np.zeros(4)})
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match="state is cut off"):
        load_arrays(path, {"a": np.zeros(3), "b": np.zeros(2)})
    with pytest.raises(FileNotFoundError, match="nothing does not exist"):
        load_arrays(tmp_path / "nothing", {})


def test_leaves_that_cannot_be_written_are_named(tmp_path):
    with pytest.raises(ValueError, match="'a/1' is .*key.*key_data"):
        save_arrays(tmp_path / "x", {"a": [1, jax.random.key(0)]})
    with pytest.raises(ValueError, match="leaf 'name' is str"):
        save_arrays(tmp_path / "x", {"name": "text"})
    assert not (tmp_path / "x").exists()


def test_training_page_states_the_branches():
    """Each comparison of two branches has its figures in TRAINING.md."""
    page = (data_dir() / "checkpoints" / "TRAINING.md").read_text().replace("\n", " ")
    stored = json.loads((data_dir() / "results" / "training_branches.json").read_text())
    for name, part in stored["parts"].items():
        begun, old, new = part["records"]
        steps = ", ".join(f"{one['steps'] / 1e6:.1f}" for one in (old, new))
        begun, old, success = (f"{100 * one['success_c1']:.0f} %" for one in (begun, old, new))
        change, low, high = (100 * x for x in new["over_as_before"]["success_c1"])
        gained = "{:+.1f} [{:+.1f}, {:+.1f}]".format(*new["over_as_before"]["return_c1"])
        row = (
            f"| {steps} | {begun} → {old}, {success} | {change:+.0f} % [{low:+.0f}, {high:+.0f}] |"
        )
        assert f"{row} {gained} |" in page, f"{name}: TRAINING.md should have {row} {gained} |"
