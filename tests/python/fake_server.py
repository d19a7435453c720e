"""A double of the server for faults that a real one shows only by chance: the step protocol and both faces, small.

An act's actions are `step + executed rewards`, so a test sees what arrived; its latent is the number of acts of earlier episodes that it
looks back on, or of steps that its session was opened with, and a half; with a guide its value is minus its step. Faults are scripted: each
act takes the next one.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import grpc
import numpy as np

from ada_diffuser.v1 import agent_pb2, agent_pb2_grpc, models_pb2, models_pb2_grpc

CODES = {
    "QUEUE_FULL": (grpc.StatusCode.RESOURCE_EXHAUSTED, 429),
    "DRAINING": (grpc.StatusCode.UNAVAILABLE, 503),
    "DEADLINE_COMPUTE": (grpc.StatusCode.DEADLINE_EXCEEDED, 504),
    "STEP_OUT_OF_ORDER": (grpc.StatusCode.ABORTED, 409),
    "STEP_PAYLOAD_MISMATCH": (grpc.StatusCode.FAILED_PRECONDITION, 422),
    "ENGINE_PANIC": (grpc.StatusCode.INTERNAL, 500),
    "POISON_STEP": (grpc.StatusCode.FAILED_PRECONDITION, 422),
    "SESSION_NOT_FOUND": (grpc.StatusCode.NOT_FOUND, 404),
    "STORE_UNAVAILABLE": (grpc.StatusCode.UNAVAILABLE, 503),
    "STORE_FULL": (grpc.StatusCode.RESOURCE_EXHAUSTED, 507),
    "STATE_CORRUPT": (grpc.StatusCode.DATA_LOSS, 500),
    "TOO_LARGE": (grpc.StatusCode.RESOURCE_EXHAUSTED, 413),
    "REQUEST_INVALID": (grpc.StatusCode.INVALID_ARGUMENT, 400),
}


@dataclass
class Refusal(Exception):
    reason: str
    committed_step: int | None = None
    retry_after_ms: int | None = None
    error_id: str = ""


@dataclass
class Session:
    committed: int = 0
    last: tuple[object, list[float]] | None = None
    #: Acts of the episodes before, or steps of the history.
    kept: int = 0


@dataclass
class Core:
    """Sessions and scripted faults. `before` faults refuse, the fault "lost" commits and then answers UNAVAILABLE."""

    faults: list[Refusal | str] = field(default_factory=list)
    sessions: dict[str, Session] = field(default_factory=dict)
    #: Sessions so far.
    opened: int = 0
    #: Every act that arrived: (session, step, observation).
    seen: list[tuple[str, int, object]] = field(default_factory=list)
    #: Every reset that arrived: (session, seed, whether the history is kept), and whether it may be.
    resets: list[tuple[str, int | None, bool]] = field(default_factory=list)
    keeps_history: bool = True
    #: Acts that a batch may hold, and the length of each batch that arrived.
    batch_len_max: int = 256
    batches: list[int] = field(default_factory=list)
    #: What the model says of itself beyond `MODEL`.
    traits: dict = field(default_factory=dict)
    #: Options of each session that was opened, as the face has them.
    options: list[object] = field(default_factory=list)
    #: Histories of each session that was opened, as JSON has them.
    histories: list[list[dict]] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def open(self, history: list[dict]) -> str:
        with self.lock:
            self.histories.append(history)
            if history and not self.keeps_history:
                raise Refusal("REQUEST_INVALID")
            name, self.opened = f"s{self.opened}", self.opened + 1
            self.sessions[name] = Session(kept=len(history))
            return name

    def reset(self, name: str, seed: int | None, keep_history: bool) -> None:
        self.resets.append((name, seed, keep_history))
        if keep_history and not self.keeps_history:
            raise Refusal("REQUEST_INVALID")
        old = self.sessions[name]
        self.sessions[name] = Session(kept=old.kept + old.committed if keep_history else 0)

    def batch(self, length: int) -> None:
        self.batches.append(length)
        if length > self.batch_len_max:
            raise Refusal("TOO_LARGE")

    def act(self, name: str, step: int, observation: dict) -> tuple[list[float], bool]:
        """The action, and whether it is a replay."""
        with self.lock:
            self.seen.append((name, step, observation))
            fault = self.faults.pop(0) if self.faults else None
            if isinstance(fault, Refusal):
                raise fault
            if name not in self.sessions:
                raise Refusal("SESSION_NOT_FOUND")
            session = self.sessions[name]
            if step == session.committed and session.last:
                if session.last[0] != observation:
                    raise Refusal("STEP_PAYLOAD_MISMATCH", session.committed)
                return session.last[1], True
            if step != session.committed + 1:
                raise Refusal("STEP_OUT_OF_ORDER", session.committed)
            rewards = sum(done.get("reward", 0.0) for done in observation.get("executed", []))
            session.committed, session.last = step, (observation, [step + rewards, observation["state"][0]])
            if fault == "lost":
                raise Refusal("DRAINING")
            return session.last[1], False


MODEL = {
    **{"name": "fake", "digest": "0" * 64, "is_default": True, "state_dim": 2, "action_dim": 2, "plan_horizon": 4},
    **{"block_len": 2, "obs_horizon": 1, "latent_dim": 1, "level_max": 5, "refined": True},
    **{"action_low": [-1.0, -1.0], "action_high": [1.0, 1.0], "sampler": {"kappa": 1.0, "latent": "mean"}},
    "trained": {"action_horizons": [3], "sub_steps": [1], "missing": {"state": False, "action": False, "reward": True}, "sessions": True},
}


def _chunk(core: Core, name: str, step: int, action: list[float], replayed: bool) -> dict:
    timings, kept = {"queue_us": 1, "compute_us": 2, "commit_us": 3, "total_us": 6}, core.sessions[name].kept
    return {
        **({"value": -float(step), "value_spread": 0.5} if core.traits.get("guide") else {}),
        "passes": 2,
        **{"session_id": name, "step": step, "replayed": replayed, "actions": [action, action, action]},
        **{"latent_mean": [kept + 0.5], "latent_log_var": [-1.0], "predicted_state": [0.0, 0.0], "evaluations": 3},
        **{"start": "warm", "renoised_rungs": 0, "timings": timings, "model": "fake", "model_digest": "0" * 64, "degraded": False},
    }


def _session(name: str, committed: int) -> dict:
    numbers = {"seed": 1, "episode": 0, "age_ms": 0, "idle_ms": 0, "ttl_ms": 1, "state_bytes": 0}
    words = {"session_id": name, "model": "fake", "model_digest": "0" * 64, "options": {"kappa": "infinity"}}
    return {**numbers, **words, "committed_step": committed, "latent_mean": [], "latent_log_var": [], "busy": False}


class GrpcFake(agent_pb2_grpc.AgentServicer, models_pb2_grpc.ModelsServicer):
    """The gRPC face of the double."""

    def __init__(self, core: Core) -> None:
        self.core = core

    def List(self, request, context):  # noqa: N802
        return models_pb2.ListModelsResponse(models=[_model(self.core)])

    def Get(self, request, context):  # noqa: N802
        return models_pb2.GetModelResponse(model=_model(self.core))

    def OpenSession(self, request, context):  # noqa: N802
        self.core.options.append(request.options)
        try:
            name = self.core.open([_step(done) for done in request.history])
        except Refusal as refusal:
            self._refuse(refusal, context)
        session = agent_pb2.Session(session_id=name, seed=request.seed, options=request.options)
        return agent_pb2.OpenSessionResponse(session=session, model=_model(self.core))

    def ResetSession(self, request, context):  # noqa: N802
        try:
            self.core.reset(request.session_id, request.seed if request.HasField("seed") else None, request.keep_history)
        except Refusal as refusal:
            self._refuse(refusal, context)
        return agent_pb2.ResetSessionResponse(session=agent_pb2.Session(session_id=request.session_id, seed=request.seed))

    def GetSession(self, request, context):  # noqa: N802
        session = agent_pb2.Session(session_id=request.session_id, committed_step=self.core.sessions[request.session_id].committed)
        return agent_pb2.GetSessionResponse(session=session)

    def CloseSession(self, request, context):  # noqa: N802
        self.core.sessions.pop(request.session_id, None)
        return agent_pb2.CloseSessionResponse()

    def Act(self, request, context):  # noqa: N802
        try:
            return self._act(request)
        except Refusal as refusal:
            self._refuse(refusal, context)

    def _refuse(self, refusal: Refusal, context) -> None:
        trailers = [("ada-reason", refusal.reason)]
        if refusal.committed_step is not None:
            trailers.append(("ada-committed-step", str(refusal.committed_step)))
        if refusal.retry_after_ms is not None:
            trailers.append(("grpc-retry-pushback-ms", str(refusal.retry_after_ms)))
        if refusal.error_id:
            trailers.append(("ada-error-id", refusal.error_id))
        context.set_trailing_metadata(trailers)
        context.abort(CODES[refusal.reason][0], "refused")

    def ActBatch(self, request, context):  # noqa: N802
        try:
            self.core.batch(len(request.acts))
        except Refusal as refusal:
            self._refuse(refusal, context)
        results = []
        for act in request.acts:
            result = agent_pb2.ActResult(session_id=act.session_id, step=act.step)
            try:
                result.response.CopyFrom(self._act(act))
            except Refusal as refusal:
                code = CODES[refusal.reason][0].value[0]
                result.error.CopyFrom(agent_pb2.Error(code=code, reason=refusal.reason, message="refused"))
                if refusal.retry_after_ms is not None:
                    result.error.retry_after_ms = refusal.retry_after_ms
            results.append(result)
        return agent_pb2.ActBatchResponse(results=results)

    def _act(self, request):
        executed = [{"reward": done.reward} if done.HasField("reward") else {} for done in request.observation.executed]
        observation = {"state": list(request.observation.state), "executed": executed}
        if request.observation.HasField("context"):
            told = request.observation.context
            observation["context"] = [list(told.values[row * told.columns :][: told.columns]) for row in range(told.rows)]
        action, replayed = self.core.act(request.session_id, request.step, observation)
        chunk = _chunk(self.core, request.session_id, request.step, action, replayed)
        actions = agent_pb2.Matrix(values=action * 3, rows=3, columns=2)
        return agent_pb2.ActResponse(**{**chunk, "actions": actions, "start": "START_WARM"})


def _step(done: agent_pb2.Executed) -> dict:
    vectors = {name: list(getattr(done, name).values) for name in ("state", "action") if done.HasField(name)}
    return {**vectors, **({"reward": done.reward} if done.HasField("reward") else {})}


def _model(core: Core) -> models_pb2.Model:
    told = [{**one, "kind": f"TOLD_KIND_{one['kind'].upper()}"} for one in core.traits.get("told", [])]
    special = {"sampler": models_pb2.SamplerOptions(kappa=1.0, latent="LATENT_MODE_MEAN"), "told": told}
    if context := core.traits.get("context"):
        special["context"] = {**context, "future": f"TRUE_FUTURE_{context['future'].upper()}"}
    return models_pb2.Model(**{**MODEL, **core.traits, **special})


def _in_few_digits(value: object) -> object:
    """As a server in float32 spells it: in as many digits as tell it there."""
    if isinstance(value, list):
        return [_in_few_digits(one) for one in value]
    return float(str(np.float32(value))) if isinstance(value, float) else value


class HttpFake(BaseHTTPRequestHandler):
    """The REST face of the double; `core` is set on a subclass."""

    protocol_version = "HTTP/1.1"
    core: Core

    def do_GET(self) -> None:
        if self.path == "/v1/models":
            return self._answer(200, {"models": [{**MODEL, **self.core.traits}]})
        name = self.path.split("/")[3]
        return self._answer(200, {"session": _session(name, self.core.sessions[name].committed)})

    def do_DELETE(self) -> None:
        self.core.sessions.pop(self.path.split("/")[3], None)
        self._answer(204, None)

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if self.path == "/v1/sessions":
            options = body.get("options", {})
            self.core.options.append(options)
            try:
                session = _session(self.core.open(body.get("history", [])), 0)
            except Refusal as refusal:
                status = CODES[refusal.reason][1]
                return self._answer(status, {"status": status, "reason": refusal.reason, "detail": "refused"})
            session["options"] |= {name: _in_few_digits(value) for name, value in options.items()}
            return self._answer(201, {"session": session, "model": {**MODEL, **self.core.traits}})
        if self.path == "/v1/act:batch":
            try:
                self.core.batch(len(body["acts"]))
            except Refusal as refusal:
                status = CODES[refusal.reason][1]
                return self._answer(status, {"status": status, "reason": refusal.reason, "detail": "refused"})
            return self._answer(200, {"results": [self._result(act) for act in body["acts"]]})
        name, verb = self.path.split("/")[3:5]
        if verb == "reset":
            self.core.reset(name, body.get("seed"), body.get("keep_history", False))
            return self._answer(200, {"session": _session(name, 0)})
        result = self._result({"session_id": name, **body})
        if "error" in result:
            return self._answer(result["error"]["status"], result["error"])
        return self._answer(200, result["response"])

    def _result(self, act: dict) -> dict:
        known = {"session_id": act["session_id"], "step": act["step"]}
        try:
            action, replayed = self.core.act(act["session_id"], act["step"], act["observation"])
        except Refusal as refusal:
            facts = {name: value for name, value in vars(refusal).items() if value not in (None, "")}
            return {**known, "error": {"status": CODES[refusal.reason][1], "detail": "refused", **facts}}
        return {**known, "response": _chunk(self.core, act["session_id"], act["step"], action, replayed)}

    def _answer(self, status: int, body: dict | None) -> None:
        text = b"" if body is None else json.dumps(body).encode()
        self.send_response(status)
        if body is not None:
            self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@contextmanager
def serving(core: Core, face: str) -> Iterator[str]:
    """The double on a free port; its url."""
    if face == "grpc":
        server = grpc.server(futures.ThreadPoolExecutor(4))
        fake = GrpcFake(core)
        agent_pb2_grpc.add_AgentServicer_to_server(fake, server)
        models_pb2_grpc.add_ModelsServicer_to_server(fake, server)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        try:
            yield f"grpc://127.0.0.1:{port}"
        finally:
            server.stop(None).wait()
        return
    handler = type("Handler", (HttpFake,), {"core": core})
    web = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    web.daemon_threads = True
    thread = threading.Thread(target=web.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{web.server_address[1]}"
    finally:
        web.shutdown()
        web.server_close()
