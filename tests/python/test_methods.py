"""Each method that ships trains for seconds, is served by the real server, and flies an environment through both faces, cold and streaming,
with the same bytes. What it is worth is not the question here."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from server import ROOT, running

from ada_diffuser import Client, Executed, InvalidInput, SamplerOptions
from ada_diffuser.commands.collect import main as collect
from ada_diffuser.rollout import Trial, evaluate
from ada_diffuser.rollout.warm_start import WarmStart

TRAINER = Path(os.environ.get("ADA_TRAINER", ROOT / "target/release/ada-trainer"))
RECIPE = ROOT / "models/point-wind-s/recipe.toml"
METHODS = sorted((ROOT / "models/methods").glob("*.toml"))
#: By the kind that a method asks for, if it does.
TINY_NETWORKS = {
    "encoder_decoder": 'model.plan.backbone={kind="encoder_decoder",width=16,depth=1,heads=2,encoder_depth=1,dropout=0.1}',
    "mlp": 'model.plan.backbone={kind="mlp",width=16,depth=1,dropout=0.1}',
    "": 'model.plan.backbone={kind="dit",width=16,depth=1,heads=2}',
}
TINY = [
    "losses.denoise.batch=4",
    "stages.denoise.steps=4",
    "stages.denoise.learning_rate.warm_up=1",
    "checkpoint_every=100",
]
TINY_SKILLS = [
    *(f"stages.{stage}.{key}" for stage in ("skills", "values") for key in ("steps=4", "learning_rate.warm_up=1")),
    "losses.double_q.candidates=2",
]
TINY_LATENT = ["losses.elbo.batch=4", "stages.identify.steps=4", "stages.identify.learning_rate.warm_up=1", "stages.identify.gate="]


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of checkpoints, one a method, and `plain`, the recipe itself; of data in sessions, so that each may keep a history."""
    folder = tmp_path_factory.mktemp("methods")
    data = folder / "data.h5"
    assert collect(["--env", "point-wind-s", "--episodes", "12", "--session-episodes", "2", "--quiet", "--out", str(data)]) == 0
    for method in [None, *METHODS]:
        name = method.stem if method else "plain"
        text = method.read_text(encoding="utf-8") if method else ""
        network = next(network for kind, network in TINY_NETWORKS.items() if f'backbone" = {{ kind = "{kind}' in text or not kind)
        keys = [network, *TINY, *([] if '"losses.elbo"' in text else TINY_LATENT), *(TINY_SKILLS if "losses.skill" in text else [])]
        words = [word for key in keys for word in ("--set", key)]
        chosen = ["--with", str(method)] if method else []
        command = [str(TRAINER), "run", str(RECIPE), "--data", str(data), "--out", str(folder / "models" / name), *chosen, *words]
        subprocess.run(command, check=True, capture_output=True, cwd=folder, timeout=120)
    return folder / "models"


@pytest.fixture(scope="module")
def address(checkpoints: Path) -> Iterator[str]:
    with running(checkpoints.parent / "log", "--models", str(checkpoints), "--default-model", "plain") as address:
        yield address


@pytest.mark.parametrize("method", ["plain", *(method.stem for method in METHODS)])
def test_a_method_flies(method: str, checkpoints: Path, address: str) -> None:
    with Client(f"grpc://{address}") as grpc, Client(f"http://{address}") as http:
        model = grpc.model(method)
        modes = [False, True] if model.sampler.streaming is not None and _ladder(checkpoints, method) else [False]
        for streaming in modes:
            options = SamplerOptions(streaming=streaming)
            trial = Trial("point-wind-s", method, episodes=2, seed=7, vector=2, options=options, episode_steps=12)
            results = [evaluate(client, trial) for client in (grpc, http)]
            actions = [np.array([episode.actions for episode in result.episodes]) for result in results]
            assert actions[0].shape == (2, 12, 2) and np.isfinite(actions[0]).all()
            assert (np.abs(actions[0]) <= 1.0).all() and np.array_equal(actions[0], actions[1])


@pytest.mark.parametrize("method", ["metadiffuser", "lilac", "plain"])
def test_a_method_begins_warm(method: str, checkpoints: Path, address: str) -> None:
    """The warm-start transitions of MetaDiffuser: handed over at the open they are what a session has that lived them, by both faces."""
    recorded = [WarmStart.load(checkpoints.parent / "data.h5", episode) for episode in (3, 4)]
    state = np.array([0.5, -0.5, 0.1, 0.0], np.float32)
    told = []
    for face in ("grpc", "http"):
        with Client(f"{face}://{address}") as client:

            def act(history: Sequence[Executed], client: Client = client) -> tuple[bytes, bytes]:
                with client.open_session(method, seed=9, history=history) as session:
                    chunk = session.act(state)
                    return chunk.actions.tobytes(), chunk.latent_mean.tobytes()

            with client.open_session(method, seed=1) as session:
                assert session.model.trained.sessions
                session.act(state, recorded[0].steps)
                session.reset(seed=9, keep_history=True)
                chunk = session.act(state)
            warm = [act(start.steps) for start in recorded]
            assert warm[0] == (chunk.actions.tobytes(), chunk.latent_mean.tobytes()) and len({*warm, act(())}) == 3
            flown = evaluate(client, Trial("point-wind-s", method, episodes=2, seed=7, vector=2, episode_steps=6, warm_start=recorded[0]))
            told.append((warm, flown.returns.tolist()))
    assert told[0] == told[1]


@pytest.mark.parametrize("method", ["diffuser", "oracle", "dynamite"])
def test_a_method_that_looks_back_on_nothing_says_so(method: str, checkpoints: Path, address: str) -> None:
    """Of a belief of the last step the border is all that it sees of another episode."""
    with Client(f"http://{address}") as client, pytest.raises(InvalidInput, match="looks back") as refused:
        client.open_session(method, history=WarmStart.load(checkpoints.parent / "data.h5").steps)
    assert refused.value.field == "history"


def _ladder(checkpoints: Path, method: str) -> bool:
    config = json.loads((checkpoints / method / "config.json").read_text(encoding="utf-8"))
    return config["method"]["plan"]["schedule"]["kind"] == "ladder"


def test_what_a_method_takes_is_told(address: str) -> None:
    """Candidates and guidance of one that has a guide, returns of one that is told them, the truth of an oracle; the others refuse."""
    with Client(f"http://{address}") as client:

        def act(method: str, options: SamplerOptions, **observation: object) -> np.ndarray:
            with client.open_session(method, seed=1, options=options) as session:
                return session.act(np.array([0.5, -0.5, 0.1, 0.0], np.float32), **observation).actions  # type: ignore[arg-type]

        cold = {"streaming": False}
        plain = act("guided", SamplerOptions(**cold, guidance_scale=0.0))
        assert not np.array_equal(plain, act("guided", SamplerOptions(**cold, guidance_scale=50.0)))
        assert not np.array_equal(plain, act("computed-return", SamplerOptions(**cold)))
        with client.open_session("guided", seed=1, options=SamplerOptions(**cold, candidates=8, temperature=1.0)) as session:
            chunk = session.act(np.zeros(4, np.float32))
            assert chunk.value is not None and chunk.value_spread > 0.0 and chunk.evaluations == 8 * chunk.passes
        with client.open_session("ldcq", seed=1) as session:
            chunks = [session.act(np.zeros(4, np.float32)) for _ in range(11)]
            assert [chunk.evaluations for chunk in chunks] == [640, *([0] * 9), 640], "a skill lasts for ten steps"
            assert [chunk.value is None for chunk in chunks] == [False, *([True] * 9), False]
        told = {scale: act("told-return", SamplerOptions(**cold, told_return=-0.1, free_guidance_scale=scale)) for scale in (0.0, 1.0, 3.0)}
        assert not np.array_equal(told[0.0], told[1.0]) and not np.array_equal(told[1.0], told[3.0])
        goals = [act("told-goal", SamplerOptions(**cold, told_goal=goal)) for goal in ((-1.0, 0.0), (1.0, 0.0))]
        assert not np.array_equal(*goals)
        truth = [act("oracle", SamplerOptions(**cold), context=[[wind, 0.0]]) for wind in (-4.0, 4.0)]
        assert not np.array_equal(*truth)
        for method, options, field in [
            ("plain", {"guidance_scale": 1.0}, "options.guidance_scale"),
            ("plain", {"candidates": 2, "streaming": False}, "options.candidates"),
            ("plain", {"told_return": 1.0}, "options.told_return"),
            ("told-return", {"told_goal": [1.0]}, "options.told_goal"),
            ("told-goal", {"told_goal": [1.0]}, "options.told_goal"),
            ("told-goal", {"free_guidance_scale": 1.2}, "options.free_guidance_scale"),
            ("guided", {"candidates": 2, "streaming": True}, "options.candidates"),
        ]:
            with pytest.raises(InvalidInput) as refused:
                client.open_session(method, options=SamplerOptions(**options))
            assert refused.value.field == field
        for method, observation in [("oracle", {}), ("plain", {"context": [[1.0, 0.0]]})]:
            with pytest.raises(InvalidInput) as refused:
                act(method, SamplerOptions(**cold), **observation)
            assert refused.value.field.startswith("observation.context")
