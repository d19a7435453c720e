"""The gRPC face: generated stubs <-> plain data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import grpc
import numpy as np

from ada_diffuser.errors import AdaError, Cancelled, Detail, UnexpectedAnswer, from_detail
from ada_diffuser.faces.liveness import CONNECT_S, PROOF_S, SILENT_S
from ada_diffuser.faces.proxy import Proxy
from ada_diffuser.messages import (
    ActCall,
    Chunk,
    ExecutedValues,
    ForkCall,
    Missing,
    Model,
    OpenCall,
    Returns,
    SamplerOptions,
    SessionSummary,
    Start,
    Timings,
    Told,
    Trained,
    TrueContext,
)
from ada_diffuser.options import MODE, NUMBERS, Kind
from ada_diffuser.v1 import agent_pb2, agent_pb2_grpc, models_pb2, models_pb2_grpc
from ada_diffuser.values import Floats

#: gRPC must not retry by itself (the client does), and must find a restarted server again within a quarter of a second: left alone it
#: waits for up to two minutes between connections, and calls fail meanwhile without trying one. Channels must not share connections: after
#: a fork a new channel would be given the parent's.
_CHANNEL_OPTIONS = [
    ("grpc.use_local_subchannel_pool", 1),
    ("grpc.enable_retries", 0),
    ("grpc.max_receive_message_length", 64 << 20),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 250),
    # Of a connection that does not come to stand; the name is historical.
    ("grpc.min_reconnect_backoff_ms", int(CONNECT_S * 1000)),
    ("grpc.keepalive_time_ms", int(SILENT_S * 1000)),
    ("grpc.keepalive_timeout_ms", int(PROOF_S * 1000)),
    # Of a ping of another kind, which gRPC measures the path with: while it waits for that one it sends no other.
    ("grpc.http2.ping_timeout_ms", int(PROOF_S * 1000)),
    # Also while there is no call: the next one then finds a new connection, and not a dead one.
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_pings_without_data", 0),
]

_STARTS: dict[int, Start] = {
    agent_pb2.START_COLD: "cold",
    agent_pb2.START_WARM: "warm",
    agent_pb2.START_RENOISED: "renoised",
}


class GrpcFace:
    """One channel; safe to use from many threads."""

    def __init__(self, target: str, proxy: Proxy | None = None) -> None:
        self._proxy = proxy
        options = [*_CHANNEL_OPTIONS, ("grpc.enable_http_proxy", int(proxy is not None))]
        self._channel = grpc.insecure_channel(target, options=options)
        self._agent = agent_pb2_grpc.AgentStub(self._channel)  # type: ignore[no-untyped-call]
        self._models = models_pb2_grpc.ModelsStub(self._channel)  # type: ignore[no-untyped-call]

    def open_session(self, call: OpenCall, timeout_s: float) -> tuple[SessionSummary, Model]:
        request = agent_pb2.OpenSessionRequest(
            model=call.model,
            seed=call.seed,
            options=_options_out(call.options),
            ttl_ms=call.ttl_ms,
            request_id=call.request_id,
            history=map(_executed, call.history),
        )
        return _opened(self._call(self._agent.OpenSession, request, timeout_s))

    def export_session(self, session_id: str, timeout_s: float) -> bytes:
        request = agent_pb2.ExportSessionRequest(session_id=session_id)
        record: bytes = self._call(self._agent.ExportSession, request, timeout_s).record
        return record

    def import_session(self, record: bytes, ttl_ms: int | None, request_id: str, timeout_s: float) -> tuple[SessionSummary, Model]:
        request = agent_pb2.ImportSessionRequest(record=record, ttl_ms=ttl_ms, request_id=request_id)
        return _opened(self._call(self._agent.ImportSession, request, timeout_s))

    def seal_session(self, session_id: str, timeout_s: float) -> bytes:
        token: bytes = self._call(self._agent.SealSession, agent_pb2.SealSessionRequest(session_id=session_id), timeout_s).token
        return token

    def resume_session(self, token: bytes, timeout_s: float) -> tuple[SessionSummary, Model]:
        return _opened(self._call(self._agent.ResumeSession, agent_pb2.ResumeSessionRequest(token=token), timeout_s))

    def fork_session(self, call: ForkCall, timeout_s: float) -> tuple[SessionSummary, Model]:
        request = agent_pb2.ForkSessionRequest(
            session_id=call.session_id,
            seed=call.seed,
            ttl_ms=call.ttl_ms,
            request_id=call.request_id,
            step=call.step,
            episode=call.episode,
        )
        return _opened(self._call(self._agent.ForkSession, request, timeout_s))

    def act(self, call: ActCall, timeout_s: float) -> Chunk:
        return _chunk(self._call(self._agent.Act, _act_request(call), timeout_s))

    def act_batch(self, calls: Sequence[ActCall], timeout_s: float) -> list[Chunk | AdaError]:
        request = agent_pb2.ActBatchRequest(acts=[_act_request(call) for call in calls])
        return [_result(result) for result in self._call(self._agent.ActBatch, request, timeout_s).results]

    def reset_session(
        self, session_id: str, seed: int | None, keep_history: bool, request_id: str, episode: int, timeout_s: float
    ) -> SessionSummary:
        request = agent_pb2.ResetSessionRequest(
            session_id=session_id, seed=seed, keep_history=keep_history, request_id=request_id, episode=episode
        )
        return _summary(self._call(self._agent.ResetSession, request, timeout_s).session)

    def get_session(self, session_id: str, timeout_s: float) -> SessionSummary:
        request = agent_pb2.GetSessionRequest(session_id=session_id)
        return _summary(self._call(self._agent.GetSession, request, timeout_s).session)

    def list_sessions(self, model: str, page_size: int, page_token: str, timeout_s: float) -> tuple[list[SessionSummary], str]:
        view = agent_pb2.SESSION_VIEW_FULL
        request = agent_pb2.ListSessionsRequest(model=model, page_size=page_size, page_token=page_token, view=view)
        answer = self._call(self._agent.ListSessions, request, timeout_s)
        return [_summary(session) for session in answer.sessions], answer.next_page_token

    def close_session(self, session_id: str, timeout_s: float) -> None:
        self._call(self._agent.CloseSession, agent_pb2.CloseSessionRequest(session_id=session_id), timeout_s)

    def models(self, timeout_s: float) -> list[Model]:
        answer = self._call(self._models.List, models_pb2.ListModelsRequest(), timeout_s)
        return [_model(model) for model in answer.models]

    def model(self, name: str, timeout_s: float) -> Model:
        return _model(self._call(self._models.Get, models_pb2.GetModelRequest(model=name), timeout_s).model)

    def close(self) -> None:
        self._channel.close()

    def _call(self, verb: Callable[..., Any], request: Any, timeout_s: float) -> Any:
        try:
            return verb(request, timeout=timeout_s)
        except grpc.RpcError as error:
            raise _error_of_call(error, self._proxy) from None
        except ValueError as error:  # the channel was closed under this call
            raise Cancelled(str(error)) from None


def _error_of_call(error: grpc.RpcError, proxy: Proxy | None) -> AdaError:
    call = cast(grpc.Call, error)
    trailers = {key: value for key, value in call.trailing_metadata() or () if isinstance(value, str)}
    reason = trailers.get("ada-reason", "")
    by_proxy = f" ({proxy})" if proxy is not None and not reason else ""
    detail = Detail(
        message=(call.details() or "") + by_proxy,
        reason=reason,
        field=trailers.get("ada-field", ""),
        committed_step=_number(trailers.get("ada-committed-step")),
        retry_after_ms=_number(trailers.get("grpc-retry-pushback-ms")),
        error_id=trailers.get("ada-error-id", ""),
    )
    return from_detail(detail, grpc_code=call.code().value[0])


def _number(word: str | None) -> int | None:
    return int(word) if word is not None and word.isdigit() else None


def _error_of_result(error: agent_pb2.Error) -> AdaError:
    detail = Detail(
        message=error.message,
        reason=error.reason,
        field=error.field,
        committed_step=error.committed_step if error.HasField("committed_step") else None,
        retry_after_ms=error.retry_after_ms if error.HasField("retry_after_ms") else None,
        error_id=error.error_id,
    )
    return from_detail(detail, grpc_code=error.code)


def _act_request(call: ActCall) -> agent_pb2.ActRequest:
    request = agent_pb2.ActRequest(
        session_id=call.session_id, step=call.step, episode=call.episode, want_planned_states=call.want_planned_states
    )
    if call.deadline_ms is not None:
        request.deadline_ms = call.deadline_ms
    request.observation.state.extend(call.state.tolist())
    request.observation.nothing_executed = call.nothing_executed
    request.observation.executed.extend(map(_executed, call.executed))
    if call.context is not None:
        rows, columns = call.context.shape
        request.observation.context.CopyFrom(agent_pb2.Matrix(values=call.context.ravel().tolist(), rows=rows, columns=columns))
    return request


def _executed(step: ExecutedValues) -> agent_pb2.Executed:
    out = agent_pb2.Executed()
    if step.state is not None:
        out.state.values.extend(step.state.tolist())
    if step.action is not None:
        out.action.values.extend(step.action.tolist())
    if step.reward is not None:
        out.reward = step.reward
    return out


_SPELL: dict[Kind, Callable[[Any], Any]] = {
    MODE: lambda mode: f"LATENT_MODE_{mode.upper()}",
    NUMBERS: lambda values: models_pb2.Vector(values=values),
}
_READ: dict[Kind, Callable[[Any], Any]] = {
    MODE: lambda mode: "sample" if mode == models_pb2.LATENT_MODE_SAMPLE else "mean",
    NUMBERS: lambda vector: tuple(vector.values),
}


def _options_out(options: SamplerOptions) -> models_pb2.SamplerOptions:
    return models_pb2.SamplerOptions(**options.sent(_SPELL))


def _options_in(options: models_pb2.SamplerOptions) -> SamplerOptions:
    return SamplerOptions.received({field.name: value for field, value in options.ListFields()}, _READ)


def _floats(values: Any) -> Floats:
    return np.array(values, dtype=np.float32)


def _matrix(matrix: agent_pb2.Matrix) -> Floats:
    if len(matrix.values) != matrix.rows * matrix.columns:
        raise UnexpectedAnswer(f"a matrix of {matrix.rows} x {matrix.columns} holds {len(matrix.values)} values")
    return _floats(matrix.values).reshape(matrix.rows, matrix.columns)


def _result(result: agent_pb2.ActResult) -> Chunk | AdaError:
    if result.WhichOneof("result") == "response":
        return _chunk(result.response)
    return _error_of_result(result.error)


def _chunk(answer: agent_pb2.ActResponse) -> Chunk:
    timings = answer.timings
    return Chunk(
        session_id=answer.session_id,
        step=answer.step,
        replayed=answer.replayed,
        actions=_matrix(answer.actions),
        planned_states=_matrix(answer.planned_states) if answer.HasField("planned_states") else None,
        latent_mean=_floats(answer.latent_mean),
        latent_log_var=_floats(answer.latent_log_var),
        predicted_state=_floats(answer.predicted_state),
        evaluations=answer.evaluations,
        start=_STARTS.get(answer.start, "cold"),
        renoised_rungs=answer.renoised_rungs,
        timings=Timings(timings.queue_us, timings.compute_us, timings.commit_us, timings.total_us),
        model=answer.model,
        model_digest=answer.model_digest,
        degraded=answer.degraded,
        passes=answer.passes,
        value=answer.value if answer.HasField("value") else None,
        value_spread=answer.value_spread if answer.HasField("value_spread") else None,
    )


def _model(model: models_pb2.Model) -> Model:
    return Model(
        name=model.name,
        digest=model.digest,
        is_default=model.is_default,
        state_dim=model.state_dim,
        action_dim=model.action_dim,
        plan_horizon=model.plan_horizon,
        block_len=model.block_len,
        obs_horizon=model.obs_horizon,
        latent_dim=model.latent_dim,
        level_max=model.level_max,
        action_low=_floats(model.action_low),
        action_high=_floats(model.action_high),
        sampler=_options_in(model.sampler),
        refined=model.refined,
        trained=_trained(model.trained),
        told=tuple(_told(told) for told in model.told),
        returns=Returns(model.returns.mean, model.returns.std) if model.HasField("returns") else None,
        guide=model.guide,
        context=_true_context(model.context) if model.HasField("context") else None,
    )


def _told(told: models_pb2.Told) -> Told:
    return Told("goal" if told.kind == models_pb2.TOLD_KIND_GOAL else "return", tuple(told.columns))


def _true_context(context: models_pb2.TrueContext) -> TrueContext:
    return TrueContext(context.dim, "known" if context.future == models_pb2.TRUE_FUTURE_KNOWN else "held")


def _trained(trained: models_pb2.Trained) -> Trained:
    missing = Missing(trained.missing.state, trained.missing.action, trained.missing.reward)
    return Trained(tuple(trained.action_horizons), tuple(trained.sub_steps), missing, trained.sessions)


def _opened(answer: agent_pb2.OpenSessionResponse) -> tuple[SessionSummary, Model]:
    return _summary(answer.session), _model(answer.model)


def _summary(session: agent_pb2.Session) -> SessionSummary:
    return SessionSummary(
        session_id=session.session_id,
        handle=session.handle,
        model=session.model,
        model_digest=session.model_digest,
        seed=session.seed,
        committed_step=session.committed_step,
        episode=session.episode,
        options=_options_in(session.options),
        latent_mean=_floats(session.latent_mean),
        latent_log_var=_floats(session.latent_log_var),
        age_ms=session.age_ms,
        idle_ms=session.idle_ms,
        ttl_ms=session.ttl_ms,
        state_bytes=session.state_bytes,
        busy=session.busy,
    )
