"""Files that are cut off, altered, made to do harm, or written by two at once.

Whatever happens to a stored file, reading it gives what was stored or one kind of error that names
the file; and whatever happens to a writer, the file is the old one or the new one.
"""

import copy
import errno
import fcntl
import io
import json
import os
import re
import signal
import threading
import tracemalloc
import zipfile
from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny import quick_compilation, tiny_agent, tiny_robot

from shapebody import files, stored
from shapebody.agent import description, store
from shapebody.agent.store import load_agent, load_curve, save_agent
from shapebody.configuration import to_json
from shapebody.reproduction import results as reproduction_results
from shapebody.training import config as training_config
from shapebody.training import policy_evaluation, progress, run_state
from shapebody.training import trainer as training_trainer

FAULTS = (ValueError, FileNotFoundError)
VALUES = (None, True, "x", "", -1, 0, 1.5, 10**30, 1e308, [], {}, ["x"], {"x": 1}, [[1]])
"""Of the wrong type, or out of all ranges, for most fields."""


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    return tiny_robot(folder, 2), tiny_robot(folder, 3)


@pytest.fixture(scope="module")
def agent(robots):
    return replace(tiny_agent(*robots, states=5), metadata=METADATA)


METADATA = {
    "steps": 64,
    "scale": "smoke",
    "config": to_json(training_config.TrainConfig.smoke("legs_2", robots=("legs_2", "legs_3"))),
    "phases": [{"from_step": 0, "config": {}, "robots": {"legs_2": "0"}}],
    "policy_evaluation": {"steps": 5, "config": {}},
}
ROWS = [{name: 128.0 * i for name in progress.CURVE} | {"steps": 128 * i} for i in range(1, 5)]


@pytest.fixture
def folder(agent, tmp_path):
    return save_agent(agent, tmp_path / "tiny", ROWS)


def damaged(data: bytes, places: int):
    """Variants of a file: cut off, with a flipped byte, with a byte too many, and replaced."""
    generator = np.random.default_rng(len(data))
    for place in np.unique(np.linspace(0, len(data) - 1, places).astype(int)):
        yield data[:place]
        flip = bytes([data[place] ^ int(generator.integers(1, 256))])
        yield data[:place] + flip + data[place + 1 :]
    yield from (data + b"\0", data * 2, b"", b"\0" * 100, b"\xff\xfe\xfd", b"[" * 100_000)


def altered(document, path=()):
    """Variants of a JSON document: each value replaced by each of VALUES, and each key missing."""
    inside = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in list(inside):
        for other in (*VALUES, "missing"):
            whole = copy.deepcopy(document)
            if other == "missing":
                del whole[key]
            else:
                whole[key] = other
            yield whole, (*path, key, other)
        if isinstance(value, dict | list):
            for part, place in altered(value, (*path, key)):
                whole = copy.deepcopy(document)
                whole[key] = part
                yield whole, place


# agents


@pytest.mark.parametrize("name", ["weights.safetensors", "states.npz", "agent.json", "curve.csv"])
def test_an_agent_of_damaged_files_is_the_agent_or_an_error(agent, folder, name):
    data = (folder / name).read_bytes()
    refused = 0
    for variant in damaged(data, 60):
        (folder / name).write_bytes(variant)
        try:
            assert load_agent(folder).hash == agent.hash
            assert load_curve(folder)["steps"].ndim == 1
        except FAULTS as error:
            assert str(folder) in str(error), error
            refused += 1
    assert refused > 20
    (folder / name).unlink()
    (folder / name).mkdir()
    with pytest.raises(ValueError, match=f"{name} is not a regular file|no state bank, but"):
        load_agent(folder), load_curve(folder)


def test_wrong_values_in_a_description(agent, folder):
    """Also with hashes that fit, as whoever edits on purpose would write them."""
    path = folder / "agent.json"
    document = json.loads(path.read_text())
    document["metadata"] = METADATA | {"config": {"robots": ["legs_2"]}}
    loaded = 0
    for variant, place in list(altered(document))[::3]:
        own = {name: variant.get(name) for name in description.HASHED}
        if place[0] != "configuration_hash":
            variant["configuration_hash"] = description.hash_document(own)
        path.write_text(json.dumps(variant))
        try:
            other = load_agent(folder)
        except FAULTS as error:
            assert str(folder) in str(error), (place, error)
        else:
            # What can be loaded can be saved, and trained on or refused with a reason.
            save_agent(other, folder.parent / "again")
            loaded += 1
            if "config" in place or "scale" in place:
                with pytest.raises(FAULTS, match=r"[a-z]{3}.*[;:]"):
                    policy_evaluation.train_critic(
                        other, other.critic_config, folder=folder.parent / "again"
                    )
    assert loaded > 10


@pytest.mark.parametrize("place", ["agent.json", "training.json", "x.json"])
def test_deep_nesting(folder, place, monkeypatch):
    for depth in (stored.DEPTH_LIMIT + 1, 900, 100_000):
        text = '{"metadata":' + "[" * depth + "]" * depth + "}"
        (folder / place).write_text(text)
        with pytest.raises(ValueError, match=re.escape(str(folder / place)) + " is"):
            stored.read_json(folder / place, "restore it")
        if place == "agent.json":
            with pytest.raises(ValueError, match="agent.json is .*restore the folder"):
                load_agent(folder)


def npy(shape, data=b"", kind="<f4") -> bytes:
    file = io.BytesIO()
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + data


def test_what_would_fill_the_memory_is_refused_before_it_is_expanded(agent, folder):
    """Zip bombs, and headers with shapes that no file holds."""
    sizes = agent.sizes
    shapes = {name: rest for name, (rest, _) in store.state_shapes(sizes).items()}
    weights, states = folder / "weights.safetensors", folder / "states.npz"
    whole = {path: path.read_bytes() for path in (weights, states)}

    def archive(count, filling, compression=zipfile.ZIP_DEFLATED):
        with zipfile.ZipFile(states, "w", compression, compresslevel=1) as file:
            for name, rest in shapes.items():
                kind = "<i4" if name == "state_robots" else "<f4"
                with file.open(name + ".npy", "w") as entry:
                    entry.write(npy((count, *rest), kind=kind))
                    for _ in range(filling if name == "joints" else 0):
                        entry.write(bytes(2**20))

    def header(text: str, length=None):
        data = text.encode()
        length = len(data) if length is None else length
        weights.write_bytes(length.to_bytes(8, "little") + data + bytes(1000))

    one = '{"policy/a": {"dtype": "F32", "shape": [%s], "data_offsets": [0, %d]}}'
    attacks = [
        lambda: archive(2**24, 300),
        lambda: archive(2**40, 1),
        lambda: archive(5, 100),
        lambda: archive(-1, 1),
        lambda: archive(5, 100, zipfile.ZIP_BZIP2),
        lambda: header("{}", 2**62),
        lambda: header("{" * 500),
        lambda: header(one % (2**40, 2**42)),
        lambda: header(one % (f"{2**62}, {2**62}", 1000)),
        lambda: header(one % (f"0, {2**70}", 0)),
        lambda: header(one % (-250, 1000)),
        lambda: header('{"policy/a": 1}'),
    ]
    for number, attack in enumerate(attacks):
        for path, data in whole.items():
            path.write_bytes(data)
        attack()
        tracemalloc.start()
        with pytest.raises(ValueError, match="(weights|states).*restore the folder"):
            load_agent(folder)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**24, f"attack {number}: {peak:,} bytes"


NAMES = (
    "../../x",
    "/etc/x",
    "",
    ".",
    "..",
    "a/b",
    "a\\b",
    "x\0y",
    "a" * 5000,
    "~x",
    " x",
    "é" * 150,
)


@pytest.mark.parametrize("name", [*NAMES, None, 3, ["x"]])
def test_a_name_leads_nowhere_else(agent, folder, monkeypatch, name):
    data = folder.parent / "deep" / "data"
    (data / "checkpoints").mkdir(parents=True)
    monkeypatch.setenv("SHAPEBODY_DATA", str(data))
    before = sorted(folder.parent.rglob("*"))
    document = json.loads((folder / "agent.json").read_text()) | {"name": name}
    (folder / "agent.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="agent.json is not a valid.*name.*restore"):
        load_agent(folder)
    with pytest.raises(ValueError, match="name.* is .*expected the name of a file"):
        save_agent(replace(agent, name=name))
    with pytest.raises(ValueError, match="name.* is .*expected the name of a file"):
        training_config.TrainConfig.smoke("unitree_go2", name=name)
    with pytest.raises(ValueError, match="name"):
        policy_evaluation.train_critic(replace(agent, name=name), agent.critic_config)
    assert sorted(folder.parent.rglob("*")) == before


def test_a_copy_is_known_by_its_folder(agent, tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    save_agent(agent)
    (tmp_path / "checkpoints" / "tiny").rename(tmp_path / "checkpoints" / "mine")
    assert load_agent("mine").name == "mine"
    # Nor does a critic go to an agent that only has the same name.
    other = tiny_agent(*[tiny_robot(tmp_path, n) for n in (2, 3)], states=5, seed=1)
    save_agent(other)
    with pytest.raises(ValueError, match="has another policy than agent 'tiny'.*folder="):
        policy_evaluation.train_critic(agent, agent.critic_config)


# writers that are killed


def killed_at(number: int, call) -> bool:
    """Run `call` in a process that ends at once at its n-th system call; False if it has fewer."""
    process = os.fork()
    if process == 0:
        count = 0

        def wrapped(function):
            def counted(*arguments, **named):
                nonlocal count
                count += 1
                if count == number:
                    os._exit(9)
                return function(*arguments, **named)

            return counted

        try:
            for name in ("replace", "fsync", "unlink", "rmdir", "mkdir", "open", "close"):
                setattr(os, name, wrapped(getattr(os, name)))
            call()
        except BaseException:
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    assert code in (0, 9), code
    return code == 9


@pytest.mark.filterwarnings("ignore:.*fork.*")
@pytest.mark.parametrize("states", [True, False])
def test_a_kill_leaves_the_old_agent_or_the_new_one(agent, tmp_path, states):
    other = replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    if not states:
        other = replace(other, states=None, state_robots=None)
    new = {path.name: path.read_bytes() for path in save_agent(other, tmp_path / "b").iterdir()}
    removed = () if states else ("states.npz",)
    folder, seen, number = tmp_path / "tiny", set(), 1
    while True:
        save_agent(agent, folder)
        if not killed_at(number, lambda: files.replace_together(folder, new, removed)):
            break
        found = load_agent(folder)
        assert found.num_states == (other if found.hash == other.hash else agent).num_states
        seen.add(found.hash)
        number += 1
    assert seen == {agent.hash, other.hash} and number > 10
    assert load_agent(folder).hash == other.hash
    names = {path.name for path in folder.iterdir()}
    assert names == set(new), "nothing is left of the killed ones"


def test_an_agent_in_the_middle_of_a_save_can_be_read_without_writing(agent, folder, tmp_path):
    other = replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    pending = folder / files.PENDING
    save_agent(other, pending)
    for name in ("weights.safetensors", "states.npz"):
        os.replace(pending / name, folder / name)
        with files.locked(folder / "agent"):  # by the one who saves
            assert load_agent(folder).hash == other.hash
        assert pending.exists()
        break
    assert load_agent(folder).hash == other.hash
    assert not pending.exists()


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_temporary_files_of_killed_writers_go_and_others_stay(tmp_path):
    path = tmp_path / "x.json"
    number = 1
    while killed_at(number, lambda: files.atomic_write(path, "new")):
        assert not path.exists() or path.read_text() == "new"
        number += 1
    alive = tmp_path / ".x.json.0123abcd.tmp"
    other = tmp_path / ".y.json.0123abcd.tmp"
    other.touch()
    with open(alive, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        files.atomic_write(path, "newer")
        assert sorted(tmp_path.iterdir()) == [alive, other, path]
    files.atomic_write(path, "newest")
    assert sorted(tmp_path.iterdir()) == [other, path] and path.read_text() == "newest"


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_lock_ends_with_its_process(tmp_path):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with files.alone_in(tmp_path):
            os.write(writer, b"x")
            signal.pause()
    os.read(reader, 1)
    with pytest.raises(ValueError, match="another training run is at work in"):
        with files.alone_in(tmp_path):
            pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with files.alone_in(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_what_was_there(agent, folder, monkeypatch):
    before = {path: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.setattr(os, "fsync", full_disk)
    other = replace(agent, policy=jax.tree.map(lambda x: 2 * x, agent.policy))
    with pytest.raises(OSError, match=f"{folder} cannot be written: No space left"):
        save_agent(other, folder)
    with pytest.raises(OSError, match=f"{folder}/x cannot be written: .*; make room"):
        files.save_arrays(folder / "x", np.zeros(3))
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


# results


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    monkeypatch.setenv("SHAPEBODY_SCALE", "reduced")
    return tmp_path / "results"


def compute():
    return [{"a": 1.0, "b": "x"}, {"a": float("nan"), "b": "y"}]


def test_damaged_results(results, agent):
    whole = reproduction_results.result("x", compute, agent, starts=2)
    path = results / "x.json"
    data = path.read_bytes()
    texts = [json.dumps(x).encode() for x, _ in altered(json.loads(data))]
    for variant in (*damaged(data, 12), *texts[::4]):
        path.write_bytes(variant)
        assert isinstance(reproduction_results.stored_config("x", agent), dict | None)
        for read in (
            lambda: reproduction_results.result("x", compute, agent, starts=2),
            lambda: reproduction_results.stored_parts("x", agent, starts=2),
            lambda: reproduction_results.stored_result(path),
        ):
            path.write_bytes(variant)
            try:
                read()
            except ValueError as error:
                assert str(path) in str(error)
        path.write_bytes(variant)
        anew = reproduction_results.result("x", compute, agent, recompute=True, starts=2)
        assert str(anew["records"]) == str(whole["records"])
        assert reproduction_results.stored_parts("x", agent, starts=2)[-1:] == ["all"]
        assert [file.name for file in results.iterdir()] == ["x.json"]


def test_two_writers_lose_no_parts(results, agent):
    begin = threading.Barrier(3)

    def work(letter):
        begin.wait()
        parts = {f"{letter}{i}": compute for i in range(8)}
        reproduction_results.result_in_parts("x", parts, agent, starts=2)

    threads = [threading.Thread(target=work, args=letter) for letter in "abc"]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    names = {f"{letter}{i}" for letter in "abc" for i in range(8)}
    assert set(json.loads((results / "x.json").read_text())["parts"]) == names
    assert [path.name for path in results.iterdir()] == ["x.json"]


def test_a_full_disk_leaves_the_results(results, agent, monkeypatch):
    reproduction_results.result("x", compute, agent, starts=2)
    before = (results / "x.json").read_bytes()
    monkeypatch.setattr(os, "fsync", full_disk)
    for starts in (2, 3):
        with pytest.raises(OSError, match="x.json cannot be written: No space left"):
            reproduction_results.result("x", compute, agent, recompute=True, starts=starts)
        assert [path.name for path in results.iterdir()] == ["x.json"]
        assert (results / "x.json").read_bytes() == before


# runs


def test_a_damaged_learning_curve_does_not_stop_a_run(tmp_path, capsys):
    path = tmp_path / "training.csv"
    path.write_text(files.curve_text(ROWS))
    whole = path.read_bytes()
    for variant in (*damaged(whole, 60), whole.replace(b"steps", b"stips")):
        path.write_bytes(variant)
        progress.Curve(path, steps=384)
        columns, kept = path.read_text().splitlines(), tmp_path / "training.damaged.csv"
        assert columns[0].split(",") == progress.CURVE and len(columns) <= 4
        assert all(float(cell) >= 0 or cell for line in columns[1:] for cell in line.split(","))
        assert kept.exists() == ("was damaged" in capsys.readouterr().out)
        if kept.exists():
            assert kept.read_bytes() == variant
            kept.unlink()


@pytest.fixture(scope="module")
def config(robots):
    robot = robots[0]
    return training_config.TrainConfig.smoke(
        str(robot.path), num_envs=16, minibatch_size=64, epochs=1, total_steps=128 * 8
    )


@pytest.fixture(scope="module")
def run(config, tmp_path_factory):
    """A run of one iteration, and its trainer, which the tests give other folders."""
    with quick_compilation():
        trainer = training_trainer.Trainer(config, tmp_path_factory.mktemp("run"))
        trainer.start()
        trainer.run(max_steps=config.batch, progress=False)
        yield trainer


def files_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_run_of_damaged_files_goes_on_as_it_was_or_not_at_all(run, config):
    whole = files_of(run.folder)
    assert {run_state.STATE, run_state.PHASES, run_state.CURVE} == set(whole)
    run.start()
    before = [np.asarray(x) for x in jax.tree.leaves(run.everything())]
    trainer = copy.copy(run)
    phases = json.loads(whole["training.json"])
    for name in ("training.safetensors", "training.json"):
        variants = list(damaged(whole[name], 20))
        if name == "training.json":
            variants += [json.dumps(x).encode() for x, place in altered(phases) if len(place) < 6][
                ::2
            ]
        for variant in variants:
            (run.folder / name).write_bytes(variant)
            try:
                assert run_state.run_engine(run.folder, "auto")
                trainer.start()
            except FAULTS as error:
                assert name in str(error) or "the run in" in str(error), error
            else:
                after = [np.asarray(x) for x in jax.tree.leaves(trainer.everything())]
                for a, b in zip(before, after, strict=True):
                    np.testing.assert_array_equal(a, b)
        (run.folder / name).unlink()
        if name == "training.json":
            with pytest.raises(FileNotFoundError, match="training.json.*restore it, or delete"):
                trainer.start()
        (run.folder / name).write_bytes(whole[name])
    assert run.start()


def test_a_trainer_that_started_earlier_does_not_replace_a_newer_state(run, config, tmp_path):
    early, late = copy.copy(run), copy.copy(run)
    for trainer in (early, late):
        trainer.folder, trainer.known = tmp_path / "run", None
    late.save()
    for call in (early.save, lambda: early.run(progress=False)):
        with pytest.raises(ValueError, match="run.* has changed since .*start"):
            call()
    assert early.start()
    early.save()
    with pytest.raises(ValueError, match="has changed since"):
        late.save()
    with late.alone():
        assert late.start()
        for call in (early.save, lambda: early.run(progress=False)):
            with pytest.raises(ValueError, match="another training run is at work"):
                call()
        late.save()


def test_another_working_directory_trains_the_same_robot(run, robots, tmp_path, monkeypatch):
    """A file is stored by its absolute path; where it has moved, its hash must be the same."""

    def environment(robots, *_, **__):  # compiled once
        env = copy.copy(run.env)
        env.robots = tuple(robots)
        return env

    def trainer(*robots):
        config = replace(run.config, robots=robots, standardize=False)
        return training_trainer.Trainer(config, tmp_path / "run")

    monkeypatch.setattr("shapebody.training.trainer.Locomotion", environment)
    here, there = tmp_path / "here", tmp_path / "there"
    for place in (here, there):
        place.mkdir()
    text = robots[0].path.read_text()
    other = text.replace('mass="2"', 'mass="3"')
    (here / "legs_2.xml").write_text(text)
    (there / "legs_2.xml").write_text(other)
    monkeypatch.chdir(here)
    first = trainer("legs_2.xml")
    absolute = str(here / "legs_2.xml")
    assert first.config.robots == (absolute,)
    first.start()
    first.save()
    agent = first.agent()
    assert agent.metadata["config"]["robots"] == [absolute]
    monkeypatch.chdir(there)
    assert trainer(absolute).start()
    with pytest.raises(ValueError, match="legs_2 has changed since the run in run began"):
        trainer("legs_2.xml").start()
    (here / "legs_2.xml").rename(there / "legs_2.xml")
    assert trainer("legs_2.xml").start()
    (there / "legs_2.xml").write_text(other)
    agent.metadata["config"]["robots"] = [str(there / "legs_2.xml")]
    with pytest.raises(ValueError, match="file of robot legs_2 has changed since agent"):
        policy_evaluation.train_critic(agent, agent.critic_config, folder=tmp_path / "agent")


def test_a_robot_whose_simulation_always_fails_stops_the_training(run, tmp_path, monkeypatch):
    trainer = copy.copy(run)
    trainer.folder, trainer.known = tmp_path / "run", None
    rollout = run.env.rollout

    def failing(*arguments):
        state, one = rollout(*arguments)
        none = np.zeros_like(np.asarray(one.finite))
        return state, replace(one, finite=none, terminated=~none, truncated=none)

    monkeypatch.setattr(type(run.env), "rollout", lambda self, *arguments: failing(*arguments))
    trainer.start()
    begun = trainer.steps
    with pytest.raises(ValueError, match="simulation of robot 'legs_2' fails in every.*validate"):
        trainer.run(progress=False)
    assert trainer.steps <= begun + 2 * run.config.batch
    monkeypatch.setattr("shapebody.task.env.Locomotion.with_task", lambda self, task: self)
    assert trainer.state_bank() is None
    assert trainer.save_agent(tmp_path / "agent").states is None
    assert load_agent(tmp_path / "agent").num_states == 0
    with pytest.raises(ValueError, match="state_bank is 100000000; expected an integer from 1"):
        training_trainer.Trainer(replace(run.config, state_bank=10**8), tmp_path / "run")
