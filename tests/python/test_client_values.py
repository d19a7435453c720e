"""Values as numpy, simulators and loggers hand them over: both faces take the same ones, and refuse the same ones with the same words."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ada_diffuser import ChunkBroker, Client, Executed, InvalidInput, SamplerOptions

FACES = ("grpc", "http")
STATE = np.array([0.1, 0.2, 0.3, 0.4])


def opened(client: Client, **settings: Any) -> tuple[Any, ...]:
    session = client.open_session(**{"seed": 1, **settings})
    return session.seed, session.options, session.summary().ttl_ms


def warmed(client: Client, history: Any) -> bytes:
    return client.open_session(seed=1, history=history).act(STATE).actions.tobytes()


def optioned(client: Client, **options: Any) -> tuple[Any, ...]:
    return opened(client, options=SamplerOptions(**options))


def reset(client: Client, seed: Any) -> int:
    session = client.open_session(seed=1)
    session.reset(seed)
    return session.seed


def acted(client: Client, state: Any = STATE, **told: Any) -> bytes:
    session = client.open_session(seed=1)
    session.act(STATE)
    return session.act(state, **told).actions.tobytes()


def reported(client: Client, reward: Any) -> bytes:
    broker = ChunkBroker(client.open_session(seed=1))
    broker.action(STATE)
    broker.report(reward=reward)
    return broker.action(STATE).tobytes()


SAME: dict[str, tuple[Callable[..., Any], dict[str, Any], dict[str, Any]]] = {
    "seed of numpy": (opened, {"seed": np.int64(7)}, {"seed": 7}),
    "largest seed": (opened, {"seed": np.uint64(2**64 - 1)}, {"seed": 2**64 - 1}),
    "seed in an array": (opened, {"seed": np.array([7])}, {"seed": 7}),
    "ttl_ms": (opened, {"ttl_ms": np.int32(60_000)}, {"ttl_ms": 60_000}),
    "seed of a reset": (reset, {"seed": np.int64(3)}, {"seed": 3}),
    "kappa": (optioned, {"kappa": np.float32(0.1)}, {"kappa": 0.1}),
    "kappa without bound": (optioned, {"kappa": np.array([np.inf])}, {"kappa": math.inf}),
    "eta": (optioned, {"eta": np.array([0.5])}, {"eta": 0.5}),
    "temperature": (optioned, {"temperature": np.array(0.5)}, {"temperature": 0.5}),
    "action_horizon": (optioned, {"action_horizon": np.int64(2)}, {"action_horizon": 2}),
    "sub_steps": (optioned, {"sub_steps": np.array([2], dtype=np.uint8)}, {"sub_steps": 2}),
    "streaming": (optioned, {"streaming": np.bool_(False)}, {"streaming": False}),
    "latent": (optioned, {"latent": np.str_("sample")}, {"latent": "sample"}),
    "picard_window": (optioned, {"picard_window": np.int64(2)}, {"picard_window": 2}),
    "picard_tolerance": (optioned, {"picard_tolerance": np.array([0.2])}, {"picard_tolerance": 0.2}),
    "deadline_ms": (acted, {"deadline_ms": np.int64(60_000)}, {"deadline_ms": 60_000}),
    "planned_states": (acted, {"planned_states": np.bool_(True)}, {"planned_states": True}),
    "nothing_executed": (acted, {"nothing_executed": np.bool_(True)}, {"nothing_executed": True}),
    "reward in an array": (acted, {"reward": np.array([0.5])}, {"reward": 0.5}),
    "reward in a matrix": (acted, {"reward": np.array([[0.5]])}, {"reward": 0.5}),
    "reward of success": (acted, {"reward": np.bool_(True)}, {"reward": 1.0}),
    "executed reward": (acted, {"executed": [Executed(reward=np.array([0.5]))]}, {"executed": [Executed(reward=0.5)]}),
    "reported reward": (reported, {"reward": np.array([0.5], dtype=">f8")}, {"reward": 0.5}),
    "history": (warmed, {"history": (Executed(STATE, np.ones(2), np.array([1])),)}, {"history": [Executed(STATE.tolist(), [1, 1], 1)]}),
}

REFUSED: dict[str, tuple[Callable[..., Any], dict[str, Any], str]] = {
    "negative seed": (opened, {"seed": -1}, "seed"),
    "large seed": (opened, {"seed": 2**64}, "seed"),
    "seed with a fraction": (opened, {"seed": 7.5}, "seed"),
    "seed of a flag": (opened, {"seed": True}, "seed"),
    "seed of two": (opened, {"seed": np.array([1, 2])}, "seed"),
    "seed of a text": (opened, {"seed": "7"}, "seed"),
    "seed of a reset": (reset, {"seed": -1}, "seed"),
    "ttl_ms": (opened, {"ttl_ms": 1.5}, "ttl_ms"),
    "model of a number": (opened, {"model": 5}, "model"),
    "model of half a letter": (opened, {"model": "\ud83d"}, "model"),
    "options of a dict": (opened, {"options": {"eta": 1.0}}, "options"),
    "kappa": (optioned, {"kappa": math.nan}, "options.kappa"),
    "kappa beyond float32": (optioned, {"kappa": 1e300}, "options.kappa"),
    "temperature": (optioned, {"temperature": math.inf}, "options.temperature"),
    "streaming": (optioned, {"streaming": 1}, "options.streaming"),
    "latent": (optioned, {"latent": "median"}, "options.latent"),
    "sub_steps": (optioned, {"sub_steps": -1}, "options.sub_steps"),
    "candidates": (optioned, {"candidates": 1.0}, "options.candidates"),
    "candidates without a guide": (optioned, {"candidates": 2}, "options.candidates"),
    "guidance_scale without a guide": (optioned, {"guidance_scale": 0.5}, "options.guidance_scale"),
    "told_return": (optioned, {"told_return": math.inf}, "options.told_return"),
    "told_return that is not taken": (optioned, {"told_return": 0.5}, "options.told_return"),
    "told_goal": (optioned, {"told_goal": (0.5, math.nan)}, "options.told_goal[1]"),
    "told_goal of a number": (optioned, {"told_goal": 0.5}, "options.told_goal"),
    "told_goal that is not taken": (optioned, {"told_goal": np.array([0.5])}, "options.told_goal"),
    "told_goal of nothing": (optioned, {"told_goal": ()}, "options.told_goal"),
    "context": (acted, {"context": [[0.5, 0.5], [0.5, math.nan]]}, "observation.context[1][1]"),
    "context of a cube": (acted, {"context": np.zeros((1, 1, 1))}, "observation.context"),
    "context of texts": (acted, {"context": [["a"]]}, "observation.context"),
    "context that is not taken": (acted, {"context": [0.5]}, "observation.context"),
    "deadline_ms": (acted, {"deadline_ms": 12.5}, "deadline_ms"),
    "state of texts": (acted, {"state": ["0.1"] * 4}, "observation.state"),
    "state of complex numbers": (acted, {"state": STATE.astype(complex)}, "observation.state"),
    "masked state": (acted, {"state": np.ma.array(STATE, mask=[0, 1, 0, 0])}, "observation.state"),
    "state of another length": (acted, {"state": STATE[:3]}, "observation.state"),
    "reward": (acted, {"reward": "bad"}, "observation.reward"),
    "reward of a table": (acted, {"reward": np.zeros((2, 2))}, "observation.reward"),
    "reward that is none": (acted, {"reward": math.nan}, "observation.executed[0].reward"),
    "executed": (acted, {"executed": [0.5]}, "observation.executed[0]"),
    "nothing_executed": (acted, {"nothing_executed": "no"}, "observation.nothing_executed"),
    "reported reward": (reported, {"reward": math.nan}, "reward"),
    "history": (warmed, {"history": [Executed(reward=1), (STATE, [1, 1], 1)]}, "history[1]"),
    "state of a history": (warmed, {"history": [Executed(reward=1), Executed(np.append(STATE[1:], np.nan))]}, "history[1].state[3]"),
    "short state of a history": (warmed, {"history": [Executed(reward=1), Executed(STATE[1:])]}, "history[1].state"),
    "action of a history": (warmed, {"history": [Executed(action=[0.1])]}, "history[0].action"),
    "reward of a history": (warmed, {"history": [Executed(reward="good")]}, "history[0].reward"),
    "history of nothing": (warmed, {"history": [Executed(reward=1), Executed()]}, "history[1]"),
}


@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize("face", FACES)
def test_numpy_scalars_and_arrays_of_one_element_are_numbers(address: str, face: str, name: str) -> None:
    """`seed=np.int64(7)` was a TypeError of the JSON writer over REST and right over gRPC; `reward=np.array([.5])` was one over both."""
    call, of_numpy, plain = SAME[name]
    with Client(f"{face}://{address}") as client:
        assert call(client, **of_numpy) == call(client, **plain)


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_value_is_the_same_error_on_both_faces(address: str, name: str) -> None:
    """`seed=-1` was a ValueError over gRPC and InvalidInput over REST, `streaming=1` right over one of them and wrong over the other."""
    call, bad, field = REFUSED[name]
    told = []
    for face in FACES:
        with Client(f"{face}://{address}") as client, pytest.raises(InvalidInput) as caught:
            call(client, **bad)
        told.append((caught.value.reason, str(caught.value)))
        assert caught.value.field == field
    assert told[0] == told[1]


def test_what_was_sent_is_not_what_the_caller_makes_of_it_later(address: str) -> None:
    """A float32 state was sent as it lay in the caller's array: one that simulators fill anew in place became another on the retry."""
    state = STATE.astype(np.float32)
    with Client(f"http://{address}") as client, client.open_session() as session:
        call = session.next_call(ChunkBroker(session).observation(state))
        state[:] = 0
        assert call.state.tolist() == STATE.astype(np.float32).tolist()
