"""The small data set in the formats of others, written by their own libraries in their exact layouts, camera images and all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from trainer import EPISODES, ROWS, Arrays, arrays, episodes_of

WIDTHS = {"robot0_eef_pos": slice(0, 1), "robot0_gripper_qpos": slice(1, 2), "object": slice(2, 3)}
"""Which columns of the small data set's observations stand for which observation of a robot."""
KEYS = ",".join(WIDTHS)
ENV_ARGS = {"env_name": "Lift", "env_type": 1, "env_kwargs": {"robots": ["Panda"], "control_freq": 20}}
LAST = np.full(3, 99.0)
"""The observation after an episode's last step, which nobody is to see."""


def d4rl_columns() -> Arrays:
    """As D4RL's locomotion has them from version 2 on, and a goal as its mazes have."""
    columns, rng = arrays(), np.random.default_rng(1)
    del columns["infos/context"]
    following = np.vstack([columns["observations"][1:], LAST])
    ends = columns["terminals"] | columns["timeouts"]
    following[ends] = rng.normal(size=(EPISODES, 3))
    return columns | {
        "next_observations": following.astype(np.float32),
        "infos/goal": rng.normal(size=(ROWS, 2)).astype(np.float32),
        "infos/qpos": rng.normal(size=(ROWS, 2)),
        "infos/action_log_probs": rng.normal(size=ROWS).astype(np.float32),
    }


def write_d4rl(path: Path, columns: Arrays) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip" if np.ndim(values) else None)
        file["metadata/algorithm"] = np.bytes_("SAC")
        file["metadata/iteration"], file["infos/nothing"] = 100, h5py.Empty("f4")
        file["metadata/policy/fc0/weight"] = np.zeros((256, 3), np.float32)
    return path


def write_robomimic(path: Path, *, raw: bool = False) -> Path:
    """As `low_dim_v141.hdf5`, or `demo_v141.hdf5` where it is `raw`: numbered, dones on success and at the end, next_obs, masks."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"], data.attrs["env_args"] = ROWS, json.dumps(ENV_ARGS)
        for index, steps in enumerate(episodes_of(arrays())):
            demo = data.create_group(f"demo_{index}")
            demo.attrs["num_samples"], demo.attrs["model_file"] = len(steps["rewards"]), "<mujoco/>"
            demo["actions"], demo["rewards"] = steps["actions"].astype(np.float64), steps["rewards"].astype(np.float64)
            demo["dones"] = steps["terminals"].astype(np.int64)
            demo["states"] = steps["observations"].astype(np.float64)
            if raw:
                continue
            for key, columns in WIDTHS.items():
                values = steps["observations"][:, columns].astype(np.float64)
                demo[f"obs/{key}"], demo[f"next_obs/{key}"] = values, np.vstack([values[1:], LAST[:1]])
            demo["obs/agentview_image"] = np.zeros((len(values), 8, 8, 3), np.uint8)
        file["mask/train"] = np.array([f"demo_{index}".encode() for index in (11, 2, 10, 0)])
        file["mask/empty"] = np.array([], "S6")
    return path


def box(*shape: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)


def minari_buffer(steps: Arrays, observations: Any, **changes: Any) -> EpisodeBuffer:
    """An episode as a recorder fills it; what the environment told at its reset stands before what it told at each step."""
    told = np.vstack([[[-1.0]], steps["infos/context"]])
    infos = {"context": list(told), "goal": {"xy": list(np.hstack([told, told]))}}
    fields = {
        "observations": observations,
        "actions": list(steps["actions"].astype(np.float64)),
        "rewards": list(steps["rewards"].astype(np.float64)),
        "terminations": list(steps["terminals"]),
        "truncations": list(steps["timeouts"]),
        "infos": infos,
    }
    return EpisodeBuffer(**(fields | changes))


def vector_of(steps: Arrays) -> list[np.ndarray]:
    """One more than there are steps."""
    return list(np.vstack([steps["observations"], LAST]).astype(np.float64))


def maze_of(steps: Arrays) -> dict[str, list[np.ndarray]]:
    whole = np.vstack([steps["observations"], LAST])
    return {"observation": list(whole[:, :2]), "achieved_goal": list(whole[:, :2] + 0.5), "desired_goal": list(whole[:, 2:])}


MAZE = gymnasium.spaces.Dict({"observation": box(2), "achieved_goal": box(2), "desired_goal": box(1)})


def make_minari(name: str, buffers: list[EpisodeBuffer], observation: gymnasium.Space, action: gymnasium.Space | None = None) -> Path:
    """In MINARI_DATASETS_PATH; its folder."""
    made = minari.create_dataset_from_buffers(
        name, buffers, env="Pendulum-v1", observation_space=observation, action_space=action or box(2), data_format="hdf5"
    )
    return Path(made.spec.data_path).parent
