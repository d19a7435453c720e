"""What goes with some models alone, from the caller to the wire and back: options, what is told, the true context, what a plan is worth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from fake_server import Core, serving

from ada_diffuser import ChunkBroker, Client, Observation, Returns, SamplerOptions, Told, TrueContext
from ada_diffuser.options import KINDS, several, word
from ada_diffuser.v1 import models_pb2

STATE = [0.25, -1.5]


@pytest.fixture
def core() -> Core:
    return Core()


@pytest.fixture(params=["grpc", "http"])
def client(core: Core, request: pytest.FixtureRequest) -> Iterator[Client]:
    with serving(core, request.param) as url, Client(url) as client:
        yield client


def test_options_from_words() -> None:
    words = {"streaming": "False", "kappa": "inf", "latent": "sample", "sub_steps": "2", "told_goal": "[0.5, -1]", "told_return": "-1.5"}
    wanted = SamplerOptions(streaming=False, kappa=math.inf, latent="sample", sub_steps=2, told_goal=(0.5, -1.0), told_return=-1.5)
    assert SamplerOptions.parse(words) == wanted and hash(wanted)
    assert SamplerOptions.parse({name: word(value) for name, value in wanted.given().items()}) == wanted
    for wrong in ({"kapa": "1"}, {"streaming": "1"}, {"sub_steps": "x"}, {"latent": "median"}, {"told_goal": "0.5"}, {"told_goal": "[x]"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            SamplerOptions.parse(wrong)


def test_a_comma_within_brackets_parts_nothing() -> None:
    assert several("0, 0.1,inf") == ["0", "0.1", "inf"] and several("[0.5,0.1], [1,0]") == ["[0.5,0.1]", "[1,0]"]
    assert several("[1]") == ["[1]"] and several("a,[1,2],b") == ["a", "[1,2]", "b"]


EVERY_OPTION: dict[str, Any] = {
    **{"streaming": False, "action_horizon": 2, "sub_steps": 3, "eta": 0.7, "temperature": 0.3, "kappa": math.inf, "latent": "sample"},
    **{"guidance_scale": 2.1, "guidance_samples": 4, "free_guidance_scale": 1.3, "told_return": -1.7, "told_goal": (0.1, 0.2)},
    **{"candidates": 64, "pick_temperature": 0.9, "picard_window": 5, "picard_tolerance": 0.05},
}


def test_every_option_travels_there_and_back(client: Client, core: Core) -> None:
    """Numbers come back as float32 has them, by both faces; each field of the message is one of the client, and the other way round."""
    assert set(EVERY_OPTION) == set(KINDS) == {field.name for field in models_pb2.SamplerOptions.DESCRIPTOR.fields}
    with client.open_session(options=SamplerOptions(**EVERY_OPTION)) as session:
        back = session.options.given()
    floats = {name: np.float32(value).tolist() for name, value in EVERY_OPTION.items() if isinstance(value, float)}
    assert back == {**EVERY_OPTION, **floats, "told_goal": tuple(np.float32([0.1, 0.2]).tolist())}
    with client.open_session(options=SamplerOptions(told_goal=())):
        nothing = core.options[-1]
    told = nothing.HasField("told_goal") if isinstance(nothing, models_pb2.SamplerOptions) else "told_goal" in nothing  # type: ignore[operator]
    assert told, "a goal without values is not the absence of one"


def test_what_a_model_is_told_is_said(client: Client, core: Core) -> None:
    (plain,) = client.models()
    assert (plain.told, plain.returns, plain.guide, plain.context) == ((), None, False, None)
    core.traits = {
        "told": [{"kind": "return", "columns": []}, {"kind": "goal", "columns": [0, 2]}],
        "returns": {"mean": -0.7, "std": 0.1},
        "guide": True,
        "context": {"dim": 3, "future": "known"},
    }
    (model,) = client.models()
    assert model.told == (Told("return"), Told("goal", (0, 2))) and model.guide
    assert model.returns == Returns(*np.float32([-0.7, 0.1]).tolist()) and model.context == TrueContext(3, "known")
    core.traits["context"] = {"dim": 1, "future": "held"}
    assert client.models()[0].context == TrueContext(1, "held")


def test_an_act_tells_the_context_and_hears_what_it_is_worth(client: Client, core: Core) -> None:
    with client.open_session() as session:
        chunk = session.act(STATE)
        assert (chunk.passes, chunk.value, chunk.value_spread) == (2, None, None)
        core.traits = {"guide": True}
        chunk = session.act(STATE, context=[[0.1, 2.0], [3.0, 4.0]])
        assert (chunk.value, chunk.value_spread) == (-2.0, 0.5)
        session.act(STATE, context=np.array([0.1, 2.0]))
        client.act_batch([(session, Observation(STATE, context=[[5.0]]))])
        broker = ChunkBroker(session)
        broker.action(STATE, context=[6.0])
        broker.action(STATE, context="not looked at")  # type: ignore[arg-type]
    told = [observation.get("context") for _, _, observation in core.seen]  # type: ignore[attr-defined]
    tenth = np.float32(0.1).tolist()
    assert told == [None, [[tenth, 2.0], [3.0, 4.0]], [[tenth, 2.0]], [[5.0]], [[6.0]]]


@pytest.mark.parametrize("face", ["grpc", "http"])
def test_rows_at_once_are_told_apart_from_forwards(address: str, face: str) -> None:
    with Client(f"{face}://{address}") as client:
        one_by_one, at_once = (
            client.open_session(seed=5, options=SamplerOptions(streaming=False, picard_window=window)).act([0.1, -0.2, 0.3, 0.4])
            for window in (1, 4)
        )
    assert one_by_one.passes == one_by_one.evaluations == 8 and at_once.passes <= 8 < at_once.evaluations
    assert at_once.value is None and at_once.value_spread is None
