"""The client against a double with scripted faults: retries keep the step, errors have their types, batches settle one by one."""

from __future__ import annotations

import math
import pickle
import re
import time
from collections.abc import Iterator

import grpc
import numpy as np
import pytest
from fake_server import Core, Refusal, serving
from server import ROOT

from ada_diffuser import (
    AdaError,
    ChunkBroker,
    Client,
    DeadlineExceeded,
    Executed,
    InvalidInput,
    NotFound,
    Observation,
    Overloaded,
    PayloadMismatch,
    PoisonStep,
    RetryPolicy,
    ServerFault,
    StepConflict,
    TooLarge,
    Unavailable,
    retry,
)
from ada_diffuser.errors import Detail, ModelGone, SessionGone, StateCorrupt, StoreFull, UnexpectedAnswer, from_detail
from ada_diffuser.faces import connect

FAST = RetryPolicy(attempts=4, base_s=0.01, cap_s=0.02, budget_s=5.0)
STATE = [0.25, -1.5]


@pytest.fixture
def core() -> Core:
    return Core()


@pytest.fixture(params=["grpc", "http"])
def client(core: Core, request: pytest.FixtureRequest) -> Iterator[Client]:
    with serving(core, request.param) as url, Client(url, retry=FAST) as client:
        yield client


def test_acts_count_up_and_carry_what_was_said(client: Client, core: Core) -> None:
    with client.open_session(seed=1) as session:
        first = session.act(STATE)
        second = session.act(STATE, reward=[0.5, 2.0])
        third = session.act(STATE, [Executed(reward=4.0)])
    assert [first.step, second.step, third.step] == [1, 2, 3]
    assert [chunk.actions[0, 0] for chunk in (first, second, third)] == [1.0, 4.5, 7.0]
    assert first.actions.shape == (3, 2) and first.actions.dtype == np.float32
    assert first.planned_states is None and first.start == "warm" and first.timings.total_us == 6
    assert not core.sessions, "the context manager closes the session"


@pytest.mark.parametrize(
    "fault",
    [
        "lost",
        *(Refusal("DRAINING", retry_after_ms=5), Refusal("STORE_UNAVAILABLE", retry_after_ms=5)),
        *(Refusal("QUEUE_FULL"), Refusal("DEADLINE_COMPUTE")),
    ],
)
def test_a_failed_act_is_sent_again_with_the_same_step_and_observation(client: Client, core: Core, fault: Refusal | str) -> None:
    with client.open_session() as session:
        session.act(STATE)
        core.faults = [fault]
        chunk = session.act([3.0, 4.0], reward=1.0)
    assert chunk.step == session.committed_step == 2
    assert chunk.replayed == (fault == "lost"), "a lost answer is answered again, not computed again"
    first, again = core.seen[-2:]
    assert first == again


def test_retries_are_bounded_and_leave_the_session_where_it_was(client: Client, core: Core) -> None:
    with client.open_session() as session:
        core.faults = [Refusal("QUEUE_FULL")] * FAST.attempts
        with pytest.raises(Overloaded):
            session.act(STATE)
        assert session.committed_step == 0 and len(core.seen) == FAST.attempts
        assert session.act(STATE).step == 1


def test_the_servers_wish_is_waited_for(client: Client, core: Core) -> None:
    with client.open_session() as session:
        core.faults = [Refusal("QUEUE_FULL", retry_after_ms=300)]
        started = time.monotonic()
        session.act(STATE)
    assert time.monotonic() - started >= 0.3


def test_a_wish_beyond_the_budget_leaves_time_for_a_last_call(core: Core) -> None:
    """A server that asked for more than the budget was not asked again at all, though it was back long before the end of it."""
    policy = RetryPolicy(base_s=0.01, budget_s=1.0)
    for face in ("grpc", "http"):
        with serving(core, face) as url, Client(url, retry=policy) as client:
            session = client.open_session()
            core.faults = [Refusal("DRAINING", retry_after_ms=60_000)]
            assert session.act(STATE).step == 1, "it was back in time"
            core.faults = [Refusal("DRAINING", retry_after_ms=60_000)] * 3
            started = time.monotonic()
            with pytest.raises(Unavailable, match=r"refused \(tried 2 times in 0\.[0-9] s\)") as caught:
                session.act(STATE)
            assert caught.value.retry_after_ms == 60_000 and time.monotonic() - started < 1.2
            core.faults = []


@pytest.mark.parametrize(
    ("refusal", "kind"),
    [
        (Refusal("STEP_OUT_OF_ORDER", committed_step=7), StepConflict),
        (Refusal("STEP_PAYLOAD_MISMATCH", committed_step=7), PayloadMismatch),
        (Refusal("SESSION_NOT_FOUND"), SessionGone),
        (Refusal("STATE_CORRUPT", error_id="e-1"), StateCorrupt),
        (Refusal("STORE_FULL"), StoreFull),
        (Refusal("ENGINE_PANIC", error_id="e-1"), ServerFault),
        (Refusal("POISON_STEP", error_id="e-2"), PoisonStep),
        (Refusal("TOO_LARGE"), TooLarge),
    ],
)
def test_an_error_has_its_type_and_fields_and_is_not_retried(client: Client, core: Core, refusal: Refusal, kind: type[AdaError]) -> None:
    with client.open_session() as session:
        core.faults = [refusal]
        with pytest.raises(kind) as caught:
            session.act(STATE)
    assert type(caught.value) is kind
    assert caught.value.reason == refusal.reason
    assert (caught.value.committed_step, caught.value.error_id) == (refusal.committed_step, refusal.error_id)
    assert len(core.seen) == 1


def test_after_a_conflict_the_session_catches_up(client: Client, core: Core) -> None:
    with client.open_session() as session:
        core.sessions[session.session_id].committed = 5
        with pytest.raises(StepConflict) as caught:
            session.act(STATE)
        assert caught.value.committed_step == 5 == session.catch_up()
        assert session.act(STATE).step == 6


def test_a_batch_sends_again_only_what_failed(client: Client, core: Core) -> None:
    sessions = [client.open_session() for _ in range(3)]
    core.faults = ["lost", Refusal("ENGINE_PANIC"), Refusal("QUEUE_FULL")]
    first, second, third = client.act_batch([(session, Observation(STATE)) for session in sessions])
    assert not isinstance(first, AdaError) and first.replayed
    assert isinstance(second, ServerFault)
    assert not isinstance(third, AdaError) and not third.replayed
    assert [name for name, _, _ in core.seen] == ["s0", "s1", "s2", "s0", "s2"]
    assert [session.committed_step for session in sessions] == [1, 0, 1]


def test_a_session_cannot_stand_twice_in_a_batch(client: Client) -> None:
    session = client.open_session()
    with pytest.raises(ValueError, match="twice"):
        client.act_batch([(session, Observation(STATE))] * 2)


@pytest.mark.parametrize("rewards", [None, np.array([1.0, 2.0]), [[0.5, 0.5], None]])
def test_a_batch_takes_arrays_as_an_act_does(client: Client, core: Core, rewards: object) -> None:
    """`act` took arrays, and a vectorised simulator, which has nothing else, had to make N observations of its arrays."""
    sessions = [client.open_session() for _ in range(2)]
    states = np.array([[0.5, 1.5], [2.5, 3.5]])
    client.act_batch(sessions, states)
    client.act_batch(list(zip(sessions, states, strict=True)))
    answers = client.act_batch(sessions, states, rewards=rewards)
    told = [0.0, 0.0] if rewards is None else [1.0, 2.0] if isinstance(rewards, np.ndarray) else [1.0, 0.0]
    assert [answer.actions[0].tolist() for answer in answers] == [[3.0 + told[0], 0.5], [3.0 + told[1], 2.5]]  # type: ignore[union-attr]
    assert core.batches == [2, 2, 2]


def test_a_wrong_array_of_a_batch_is_named(client: Client, core: Core) -> None:
    sessions = [client.open_session() for _ in range(2)]
    for states, rewards, field in (
        (np.zeros((3, 2)), None, "states"),
        (np.zeros((2, 2)), [1.0], "rewards"),
        (np.array([[0.0, 0.0], [0.0, np.nan]]), None, "acts[1].observation.state[1]"),
        (np.zeros((2, 2)), [1.0, np.inf], "acts[1].observation.executed[0].reward"),
    ):
        with pytest.raises(InvalidInput) as caught:
            client.act_batch(sessions, states, rewards=rewards)
        assert caught.value.field == field
    with pytest.raises(ValueError, match="states"):
        client.act_batch(sessions)
    assert not core.seen


def test_a_batch_beyond_the_servers_limit_is_split(client: Client, core: Core) -> None:
    """More simulators than that got TOO_LARGE: the limit is a setting of the server that no client can ask for."""
    core.batch_len_max = 4
    sessions = [client.open_session() for _ in range(11)]
    states = np.arange(22.0).reshape(11, 2)
    answers = client.act_batch(sessions, states)
    assert [answer.actions[0, 1] for answer in answers] == states[:, 0].tolist()  # type: ignore[union-attr]
    assert core.batches == [11, 5, 2, 2, 2, 2, 2, 1]
    core.batches.clear()
    core.faults = [Refusal("QUEUE_FULL")]
    assert all(answer.step == 2 for answer in client.act_batch(sessions, states))  # type: ignore[union-attr]
    assert core.batches == [2, 2, 2, 2, 2, 1, 1], "what it takes is remembered, and only what failed is sent again"


def test_an_act_too_large_by_itself_is_the_error_of_that_act(client: Client, core: Core) -> None:
    core.batch_len_max = 0
    sessions = [client.open_session() for _ in range(2)]
    assert [type(answer) for answer in client.act_batch(sessions, np.zeros((2, 2)))] == [TooLarge, TooLarge]
    core.batch_len_max = 2
    assert all(not isinstance(answer, AdaError) for answer in client.act_batch(sessions, np.zeros((2, 2))))
    assert core.batches == [2, 1, 1, 2]


def test_a_newer_observation_after_a_lost_answer_is_told_the_way_on(core: Core) -> None:
    """A control loop does not wait: it goes on with what it sees now. The server then says what is wrong, but not what to do."""
    with serving(core, "http") as url, Client(url, retry=RetryPolicy(attempts=1)) as client, client.open_session() as session:
        core.faults = ["lost"]
        with pytest.raises(Unavailable):
            session.act(STATE)
        with pytest.raises(PayloadMismatch, match=r"act with its observation again, or call session\.catch_up\(\).*nothing_executed"):
            session.act([9.0, 9.0])
        assert session.catch_up() == 1
        assert session.act([9.0, 9.0], nothing_executed=True).step == 2


@pytest.mark.parametrize(
    ("state", "executed", "field"),
    [
        ([0.0, math.nan], (), "observation.state[1]"),
        ([0.0, 1e39], (), "observation.state[1]"),
        ([[0.0]], (), "observation.state"),
        (["x"], (), "observation.state"),
        ([0.0], [Executed(), Executed(action=[math.inf])], "observation.executed[1].action[0]"),
        ([0.0], [Executed(reward=math.inf)], "observation.executed[0].reward"),
    ],
)
def test_what_json_could_not_spell_is_refused_before_it_is_sent(
    client: Client, core: Core, state: list[float], executed: list[Executed], field: str
) -> None:
    with client.open_session() as session, pytest.raises(InvalidInput) as caught:
        session.act(state, executed)
    assert (caught.value.field, caught.value.reason) == (field, "OBSERVATION_INVALID")
    assert not core.seen


def test_nobody_there_is_unavailable() -> None:
    for face in ("grpc", "http"):
        with Client(f"{face}://127.0.0.1:1", retry=RetryPolicy(attempts=2, base_s=0.01)) as client, pytest.raises(Unavailable):
            client.models()


def test_the_broker_hands_out_and_reports(client: Client, core: Core) -> None:
    with client.open_session() as session:
        broker = ChunkBroker(session)
        for step in range(4):
            action = broker.action([float(step), 0.0])
            assert action.shape == (2,)
            broker.report(reward=step + 1.0)
        assert session.committed_step == 2 and not broker.due
        broker.replan()
        broker.action([9.0, 0.0])
    told = [observation["executed"] for _, _, observation in core.seen]  # type: ignore[index]
    rewards = [[done["reward"] for done in executed] for executed in told]
    assert rewards == [[], [1.0, 2.0, 3.0], [4.0]]


def test_the_broker_tells_states_and_other_actions(core: Core) -> None:
    with serving(core, "http") as url, Client(url) as client, client.open_session() as session:
        broker = ChunkBroker(session)
        for step in range(3):
            broker.action([float(step), 0.5])
        broker.report(action=[0.125, 0.25])
        broker.action([3.0, 0.5])
    first, second, third = core.seen[1][2]["executed"]  # type: ignore[index]
    assert "state" not in first, "it is the state of the observation before"
    assert (second["state"], third["state"]) == ([1.0, 0.5], [2.0, 0.5])
    assert third["action"] == [0.125, 0.25] and first["action"] == [1.0, 0.0]


def test_a_reset_starts_over(client: Client) -> None:
    with client.open_session() as session:
        broker = ChunkBroker(session)
        broker.action(STATE)
        broker.reset(seed=5)
        assert session.committed_step == 0 and broker.due
        assert broker.action(STATE)[0] == 1.0


class Clock:
    """`time` as the module of retries sees it."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.mark.parametrize("takes_s", [0.0, 0.5, 2.0, 30.0])
@pytest.mark.parametrize("wish_ms", [None, 300, 60_000])
@pytest.mark.parametrize("error", [DeadlineExceeded, Unavailable])
def test_a_request_takes_no_longer_than_its_budget(
    monkeypatch: pytest.MonkeyPatch, error: type[AdaError], wish_ms: int | None, takes_s: float
) -> None:
    """Six calls were the bound, and the budget began with the failure of the first one: a refused connection was given up after 1.2 s,
    and one that hung after 60, with a budget of 30."""
    clock, timeouts = Clock(), []
    monkeypatch.setattr(retry, "time", clock)
    policy = RetryPolicy(base_s=0.1, cap_s=1.0, budget_s=5.0)

    def call(timeout_s: float) -> None:
        timeouts.append(timeout_s)
        clock.sleep(min(takes_s, timeout_s))
        raise error(Detail("no answer", retry_after_ms=wish_ms))

    with pytest.raises(error):
        policy.run(call, 3.0)
    assert timeouts[0] == 3.0 and max(timeouts) <= 3.0
    assert policy.budget_s - 1.0 <= clock.now_s <= policy.budget_s + 1e-6, "neither later nor much sooner"
    if takes_s == 0.0 and wish_ms is None:
        assert len(timeouts) > (15 if error is Unavailable else 4), "who is away is looked for more often than who is busy"


def test_a_budget_of_hours_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wait that doubles with each call is no number any more after a thousand of them."""
    clock, calls = Clock(), []
    monkeypatch.setattr(retry, "time", clock)

    def call(timeout_s: float) -> None:
        calls.append(timeout_s)
        raise Unavailable("nobody there")

    with pytest.raises(Unavailable, match=rf"nobody there \(tried \d+ times in {3600:.1f} s\)|tried \d+ times in 3599"):
        RetryPolicy(budget_s=3600.0).run(call, 30.0)
    assert len(calls) > 10_000


def test_a_number_of_attempts_bounds_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, calls = Clock(), []
    monkeypatch.setattr(retry, "time", clock)

    def call(timeout_s: float) -> None:
        calls.append(timeout_s)
        raise Unavailable("nobody there")

    for attempts in (1, 4):
        calls.clear()
        with pytest.raises(Unavailable) as caught:
            RetryPolicy(attempts=attempts).run(call, 30.0)
        assert len(calls) == attempts
        assert ("tried 4 times" in str(caught.value)) == (attempts == 4)


def test_a_policy_is_one() -> None:
    for wrong in ({"attempts": 0}, {"budget_s": -1.0}, {"budget_s": 0}, {"base_s": math.nan}, {"cap_s": math.inf}, {"away_cap_s": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            RetryPolicy(**wrong)  # type: ignore[arg-type]


def test_an_error_names_a_thing_once() -> None:
    """`OBSERVATION_INVALID: observation.state: observation.state: has 3 values`, and `internal error (e-1): error id e-1`."""
    wrong = InvalidInput(Detail("observation.state: has 3 values", "OBSERVATION_INVALID", "observation.state"))
    assert str(wrong) == "OBSERVATION_INVALID: observation.state: has 3 values"
    assert str(InvalidInput(Detail("has 3 values", field="states"))) == "states: has 3 values"
    assert str(ServerFault(Detail("internal error (e-1)", "INTERNAL", error_id="e-1"))) == "INTERNAL: internal error (e-1)"
    assert str(ServerFault(Detail("broken", error_id="e-1"))) == "broken: error id e-1"


def test_urls() -> None:
    for url in ("ftp://a:1", "grpc://a", "127.0.0.1:7777", "http://a:1/x"):
        with pytest.raises(ValueError, match="host"):
            connect(url)


def test_errors_without_a_reason_go_by_code_or_status() -> None:
    assert type(from_detail(Detail("no route"), grpc_code=14)) is Unavailable
    assert type(from_detail(Detail("bad gateway"), http_status=502)) is Unavailable
    assert type(from_detail(Detail("?"), http_status=418)) is UnexpectedAnswer
    gone = from_detail(Detail("old", "SESSION_EXPIRED"), http_status=410)
    assert type(gone) is SessionGone and isinstance(gone, NotFound)
    model = from_detail(Detail("old", "MODEL_GONE"), http_status=410)
    assert type(model) is ModelGone and isinstance(model, NotFound), "by its reason, not by its status"
    assert pickle.loads(pickle.dumps(gone)).reason == "SESSION_EXPIRED"


ERROR_TABLE = re.compile(r'^ +\(Self::.*, (\d+), (\d+), "([A-Z_]+)"\),$', re.MULTILINE)
OF_THE_FACES = re.compile(r'Problem::new\([^"]*"([A-Z_]+)"')


def test_every_reason_of_the_server_is_in_the_tables_and_has_a_class() -> None:
    """New reasons came to clients as `UnexpectedAnswer`, or as the class of an HTTP status that they shared with others."""
    sources = {path: path.read_text() for path in (ROOT / "src/serve").rglob("*.rs")}
    rows = [row.split("|") for row in (ROOT / "clients/http/README.md").read_text().splitlines() if row.startswith("| `")]
    documented = {reason: (row[2], row[3]) for row in rows for reason in re.findall(r"`([A-Z_]+)`", row[1])}
    classes = re.findall(r"^\| .*", (ROOT / "clients/python/README.md").read_text(), re.MULTILINE)
    table = ERROR_TABLE.findall(sources[ROOT / "src/serve/error.rs"])
    assert len({reason for _, _, reason in table}) >= 26, "the table was found"
    for code, status, reason in table:
        name = next(one.name for one in grpc.StatusCode if one.value[0] == int(code))
        assert name in documented[reason][0] and status in documented[reason][1], reason
        kinds = {type(from_detail(Detail("?", reason))), type(from_detail(Detail("?", reason), http_status=int(status)))}
        (kind,) = kinds
        assert kind is not UnexpectedAnswer, reason
        assert any(f"`{kind.__name__}`" in row.split("|")[1] for row in classes), kind
        assert reason in (kind.__doc__ or "") or f"{reason.split('_')[0]}_*" in (kind.__doc__ or ""), (reason, kind)
    faces = {reason for text in sources.values() for reason in OF_THE_FACES.findall(text)}
    assert faces and faces <= documented.keys(), faces - documented.keys()


def test_an_answer_of_another_shape_is_named() -> None:
    """A wrong port answers with something: the caller's program gets a typed error and no KeyError."""
    from http.server import BaseHTTPRequestHandler, HTTPServer
    from threading import Thread

    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "2")
            self.end_headers()
            self.wfile.write(b"{}")

        def log_message(self, *_: object) -> None:
            """Says nothing."""

    with HTTPServer(("127.0.0.1", 0), Other) as web:
        Thread(target=web.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        with Client(f"http://127.0.0.1:{web.server_address[1]}") as client, pytest.raises(UnexpectedAnswer):
            client.models()
        web.shutdown()
