"""A short film of one episode, as a GIF: the recorded actions played again in an environment that can render; models side by side.

Rendering runs in a process of its own, because MuJoCo reads `MUJOCO_GL` when it is imported and a machine without a screen
may have EGL, OSMesa or neither: `python -m ada_diffuser.rollout.film FILM.gif EPISODE.npz ...`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ada_diffuser import environments
from ada_diffuser.rollout.readout import Reading, Readout
from ada_diffuser.rollout.result import Episode

#: A film larger than this is thinned out and shrunk until it fits.
BYTES_MAX = 6_000_000
WIDTH = 360
CAPTION = 18
FRAME_MS = 50


@dataclass(frozen=True)
class Panel:
    """An episode, and what is written about it."""

    env: str
    episode: Episode
    readout: Readout | str = ""
    #: Above it; nothing is.
    title: str = ""
    #: Those of the environment that it was played in.
    env_options: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def last(cls, reading: Reading, title: str = "") -> Panel:
        """The last episode of an evaluation."""
        trial = reading.result.trial
        return cls(trial.env, reading.result.episodes[-1], reading.readout, title, trial.env_options)

    def save(self, file: Path) -> None:
        """All that the renderer needs."""
        episode = self.episode
        np.savez(
            file,
            title=self.title,
            env=self.env,
            env_options=json.dumps(dict(self.env_options)),
            seed=episode.seed,
            actions=np.array(episode.actions),
            rewards=np.array(episode.rewards),
            contexts=np.array(episode.contexts),
            act_steps=np.array(episode.act_steps),
            seen=self.readout.of(episode) if isinstance(self.readout, Readout) else np.zeros((0, 0)),
        )


def save_film(panels: Sequence[Panel], path: Path) -> str | None:
    """Writes the film of these, side by side; None, or why there is none."""
    with tempfile.TemporaryDirectory() as folder:
        recorded = [Path(folder) / f"{place}.npz" for place in range(len(panels))]
        for panel, file in zip(panels, recorded, strict=True):
            panel.save(file)
        reasons = []
        for backend in _backends():
            reason = _render_apart(recorded, path, backend)
            if reason is None:
                return None
            reasons.append(f"{backend}: {reason}")
        return "; ".join(reasons)


def _backends() -> list[str]:
    chosen = os.environ.get("MUJOCO_GL")
    return [chosen] if chosen else ["egl", "osmesa"]


def _render_apart(recorded: Sequence[Path], path: Path, backend: str) -> str | None:
    command = [sys.executable, "-m", __name__, str(path), *map(str, recorded)]
    environment = {**os.environ, "MUJOCO_GL": backend}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return "no film after 300 s"
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1].strip() if lines else f"ended with status {done.returncode}"


def _frames(record: dict[str, NDArray[np.float32]]) -> Iterator[Image.Image]:
    options = json.loads(str(record["env_options"]))
    env = environments.make(str(record["env"]), episode_steps=len(record["actions"]), **{**options, "render_mode": "rgb_array"})
    if "rgb_array" not in env.metadata.get("render_modes", ()):
        raise ValueError(f"{record['env']} cannot draw itself: rgb_array is none of its render modes")
    env.reset(seed=int(record["seed"]))
    for step, action in enumerate(record["actions"]):
        frame = Image.fromarray(np.asarray(env.render(), np.uint8))
        frame = frame.resize((WIDTH, frame.height * WIDTH // frame.width))
        yield _captioned(frame, record, step)
        env.step(action)
    env.close()


def _captioned(frame: Image.Image, record: dict[str, NDArray[np.float32]], step: int) -> Image.Image:
    """The frame with a line of numbers under it."""
    words = [f"step {step}", f"return {record['rewards'][: step + 1].sum():.1f}"]
    if record["contexts"].size:
        words.append("context " + " ".join(f"{value:.1f}" for value in record["contexts"][step]))
    if record["seen"].size:
        act = int(np.searchsorted(record["act_steps"], step, side="right")) - 1
        words.append("read out " + " ".join(f"{value:.1f}" for value in record["seen"][act]))
    title = str(record["title"])
    above = CAPTION if title else 0
    taller = Image.new("RGB", (frame.width, above + frame.height + CAPTION), "black")
    taller.paste(frame, (0, above))
    draw = ImageDraw.Draw(taller)
    draw.text((6, 3), title, fill="white")
    draw.text((6, above + frame.height + 3), "  |  ".join(words), fill="white")
    return taller


def _beside(panels: Sequence[Iterator[Image.Image]]) -> Iterator[Image.Image]:
    """Frames of several films as one; whose episode is over stands still while the others go on."""
    last: list[Image.Image] = []
    while fresh := [next(panel, None) for panel in panels]:
        if not any(fresh):
            return
        last = [new or old for new, old in zip(fresh, last or fresh, strict=True) if new or old]
        wide = Image.new("RGB", (sum(one.width for one in last), max(one.height for one in last)), "black")
        left = 0
        for one in last:
            wide.paste(one, (left, 0))
            left += one.width
        yield wide


def _write(frames: list[Image.Image], path: Path) -> None:
    """As a GIF within `BYTES_MAX`: every second frame first, then smaller, until it fits."""
    for stride, scale in ((1, 1.0), (2, 1.0), (2, 0.75), (3, 0.6), (4, 0.5), (8, 0.4)):
        size = (int(frames[0].width * scale), int(frames[0].height * scale))
        kept = [frame.resize(size).quantize(64, dither=Image.Dither.NONE) for frame in frames[::stride]]
        kept[0].save(path, format="GIF", save_all=True, append_images=kept[1:], duration=FRAME_MS * stride, loop=0)
        if path.stat().st_size <= BYTES_MAX:
            return


def main() -> int:
    """Renders recorded episodes; the last line on stderr says what is wrong."""
    path, *recorded = map(Path, sys.argv[1:])
    _write(list(_beside([_frames(_read(file)) for file in recorded])), path)
    return 0


def _read(file: Path) -> dict[str, NDArray[Any]]:
    with np.load(file) as stored:
        return {name: stored[name] for name in stored.files}


if __name__ == "__main__":
    sys.exit(main())
