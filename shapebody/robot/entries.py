"""Entries of a compiled robot file: its state "home", numbers and texts of <custom>."""

import mujoco
import numpy as np

_OBJ = mujoco.mjtObj


def home_qpos(model: mujoco.MjModel) -> np.ndarray:
    """float64[nq], a copy of the positions of "home", which the model must have."""
    return np.array(model.key_qpos[mujoco.mj_name2id(model, _OBJ.mjOBJ_KEY, "home")])


def custom_numeric(model: mujoco.MjModel, name: str) -> np.ndarray | None:
    """float64[n], the numbers of an entry of <custom>; None without an entry of that name."""
    index = mujoco.mj_name2id(model, _OBJ.mjOBJ_NUMERIC, name)
    if index < 0:
        return None
    start = model.numeric_adr[index]
    return np.array(model.numeric_data[start : start + model.numeric_size[index]])


def custom_text(model: mujoco.MjModel, name: str, default: str) -> str:
    """The text of an entry of <custom>; `default` without an entry of that name."""
    index = mujoco.mj_name2id(model, _OBJ.mjOBJ_TEXT, name)
    if index < 0:
        return default
    start = model.text_adr[index]
    return bytes(model.text_data[start : start + model.text_size[index]]).decode().rstrip("\0")
