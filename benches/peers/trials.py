"""What is measured against what, and the targets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from processes import MAKE_RANDOM, TIME_ACTS, TIME_DENOISERS, NotMeasured, ada_server, peer, python_server, run

# Figures of one turn: by mode (eager, jit, ...), then by name.
Figures = dict[str, dict[str, float]]
Side = Callable[[], Figures]
Kind = Literal["times faster", "times more", "share", "times at most", "at most"]

NARROW, WIDE = "32,64,64,64", "32,64,128,256"
CLIENTS, IDLE, CHURN = 32, 10_000, 1_000
# An episode of HalfCheetah's planner as tokens of a transformer.
DIT_LEN = 42
GROUPS = ("forward", "train", "serve", "act", "memory", "churn")
# Actions of two programs that do the same, of 16 evaluations in f32, normalized.
ALIKE = 1e-3


@dataclass(frozen=True)
class Settings:
    """How long to measure."""

    models: Path
    seconds: float
    net_seconds: float
    modes: str
    runs: int
    face: str


@dataclass(frozen=True)
class Goal:
    """One row of the table: a figure of a trial, and what it should reach.

    `times faster`: theirs / ours, at least; `times more`: ours / theirs, at least; `share`: theirs / ours in percent, at least;
    `times at most`: ours / theirs; `at most`: ours alone.
    """

    text: str
    figure: str
    unit: str
    kind: Kind
    target: float

    def score(self, theirs: float | None, ours: float) -> float:
        """What is held against the target."""
        if self.kind == "at most":
            return ours
        if theirs is None:
            raise NotMeasured("nothing to compare with")
        return {"times faster": theirs / ours, "share": 100 * theirs / ours}.get(self.kind, ours / theirs)

    def reached(self, score: float) -> bool:
        """Whether that is enough."""
        return score <= self.target if self.kind.endswith("at most") else score >= self.target

    def show(self, score: float) -> str:
        """A score or the target, with its sign."""
        return {"share": f"{score:.0f} %", "at most": f"{score:.0f} {self.unit}"}.get(self.kind, f"{score:.3g}x")


@dataclass(frozen=True)
class Trial:
    """Two sides that are measured by turns; `prepare` starts what they need and leaves its end to the stack."""

    group: str
    name: str
    goals: tuple[Goal, ...]
    prepare: Callable[[Settings, ExitStack], tuple[Side, Side]]


def trials() -> list[Trial]:
    """All of them, in the order of the table."""
    return [*_forward(), *_train(), *_serve(), *_act(), _memory(), _churn()]


@dataclass(frozen=True)
class Net:
    """A denoiser and how it is run."""

    text: str
    net: str
    widths: str
    len: int
    batch: int
    threads: int

    def flags(self) -> list[object]:
        """The flags that both sides share."""
        sizes = ["--widths", self.widths] if self.net == "unet" else []
        return ["--net", self.net, *sizes, "--len", self.len, "--batch", self.batch, "--threads", self.threads]

    def name(self) -> str:
        """In words."""
        return f"{self.text}, batch {self.batch}, {self.threads} thread{'s' if self.threads > 1 else ''}"


def _nets(batch: int, threads: int) -> list[Net]:
    return [
        Net("U-Net narrow", "unet", NARROW, 16, batch, threads),
        Net("U-Net wide", "unet", WIDE, 16, batch, threads),
        Net("DiT 256x2, 42 tokens", "dit", "", DIT_LEN, batch, threads),
    ]


def _policy(batch: int, threads: int) -> Net:
    return Net("transformer of diffusion policy 256x2, 16 positions", "dp", "", 16, batch, threads)


def _ours(net: Net, what: str, settings: Settings) -> Figures:
    line = run(TIME_DENOISERS, *net.flags(), "--what", what, "--seconds", settings.net_seconds)[0]
    return {"bare products" if what == "bound" else "ada": {"ms": float(line["ms"])}}


def _theirs(net: Net, what: str, settings: Settings) -> Figures:
    modes = ["--modes", settings.modes] if what == "time" else []
    lines = peer("torch_denoisers.py", what, *net.flags(), "--runs", settings.runs, *modes)
    return {str(line["mode"]): {"ms": float(line["ms"])} for line in lines if "ms" in line}


def _forward() -> Iterator[Trial]:
    for nets, targets in ((_nets(1, 1), (12, 12, 2.5)), (_nets(32, 2), (6, 4.5, 2.2))):
        for net, target in zip(nets, targets, strict=True):
            goal = Goal(f"forward {net.name()}", "ms", "ms", "times faster", target)
            yield Trial(
                "forward", goal.text, (goal,), lambda s, _, net=net: (lambda: _theirs(net, "time", s), lambda: _ours(net, "forward", s))
            )
    for net, target in ((_policy(1, 1), 3.0), (_policy(32, 2), 2.2)):
        goal = Goal(f"forward {net.name()}", "ms", "ms", "times faster", target)
        yield Trial(
            "forward", goal.text, (goal,), lambda s, _, net=net: (lambda: _theirs(net, "time", s), lambda: _ours(net, "forward", s))
        )
    wide = _nets(32, 1)[1]
    goal = Goal(f"forward {wide.name()}: share of the bare products", "ms", "ms", "share", 75)
    yield Trial("forward", goal.text, (goal,), lambda s, _: (lambda: _ours(wide, "bound", s), lambda: _ours(wide, "forward", s)))


def _train() -> Iterator[Trial]:
    for net, target in zip(_nets(64, 2), (4, 3, 2), strict=True):
        goal = Goal(f"training step {net.name()}", "ms", "ms", "times faster", target)
        yield Trial("train", goal.text, (goal,), lambda s, _, net=net: (lambda: _theirs(net, "train", s), lambda: _ours(net, "train", s)))


def _figures(report: dict[str, Any]) -> dict[str, float]:
    latency = report["latency_ms"]
    return {"acts/s": report["acts_per_s"], "p50": latency["p50"], "p99": latency["p99"]}


def _their_figures(report: dict[str, Any]) -> dict[str, float]:
    return {"acts/s": report["acts_per_s"], "p50": report["p50_ms"], "p99": report["p99_ms"]}


def _against_python(evaluations: int, clients: int) -> Callable[[Settings, ExitStack], tuple[Side, Side]]:
    """Our server and the Python one, both kept running; the one that is not asked sleeps."""

    def prepare(settings: Settings, stack: ExitStack) -> tuple[Side, Side]:
        ours, theirs = stack.enter_context(ada_server(settings.models)), stack.enter_context(python_server(evaluations))
        common = ("--clients", clients, "--seconds", settings.seconds)
        streaming = f"streaming={'true' if evaluations == 1 else 'false'}"

        def ask_ours() -> Figures:
            report = ours.load(*common, "--face", settings.face, "--set", streaming)
            if abs(report["evaluations_per_act"] - evaluations) > 0.01:
                raise NotMeasured(f"our act took {report['evaluations_per_act']:.2f} evaluations, not {evaluations}")
            return {settings.face: _figures(report)}

        return (lambda: {"jit": _their_figures(theirs.load(*common))}), ask_ours

    return prepare


def _serve() -> Iterator[Trial]:
    cold, streaming = "plan of 16 evaluations", "streaming act of 1 evaluation"
    goals = (Goal(f"{cold}, 1 client, p50", "p50", "ms", "times faster", 10),)
    yield Trial("serve", f"{cold}, 1 client", goals, _against_python(16, 1))
    goals = (Goal(f"{cold}, {CLIENTS} clients", "acts/s", "acts/s", "times more", 20),)
    yield Trial("serve", f"{cold}, {CLIENTS} clients", goals, _against_python(16, CLIENTS))
    rate = Goal(f"{streaming}, {CLIENTS} clients", "acts/s", "acts/s", "times more", 10)
    tail = Goal(f"{streaming}, {CLIENTS} clients, p99", "p99", "ms", "times faster", 10)
    yield Trial("serve", f"{streaming}, {CLIENTS} clients", (rate, tail), _against_python(1, CLIENTS))


@dataclass(frozen=True)
class Act:
    """A cold act of one session, sampled as neither `serve` nor `forward` is."""

    text: str
    # Of its checkpoint, beside those of the narrow U-Net without latents.
    flags: tuple[str, ...]
    # Of its session, and of their function.
    options: tuple[str, ...]
    evaluations: int
    # Times faster.
    target: float = 8.0
    # Their program.
    script: str = "torch_acts.py"
    temperature: float = 0.5


VALUE = ("--guide-widths", "32,64")
ACTS = (
    Act("guided act, 16 evaluations, a value gradient in each", VALUE, ("guidance_scale=1.5",), 16),
    Act("free-guided act, 16 evaluations of 2 rows", ("--told-return",), ("told_return=1", "free_guidance_scale=1.2"), 32),
    Act("act of 64 candidates, 16 evaluations of 64 rows", VALUE, ("candidates=64",), 1024),
    Act("act of IDQL, 5 evaluations of 64 rows", ("--net", "idql"), ("candidates=64",), 320, 10.0, "torch_idql.py", 1.0),
)


def _act() -> Iterator[Trial]:
    for act in ACTS:
        goal = Goal(f"{act.text}, 1 client, p50", "p50", "ms", "times faster", act.target)
        yield Trial("act", goal.text, (goal,), lambda s, stack, act=act: _against_a_function(act, s, stack))


def _against_a_function(act: Act, settings: Settings, stack: ExitStack) -> tuple[Side, Side]:
    """Our server, asked by one client over the wire, against a function of PyTorch in the process that times it, on the same weights. What
    our act takes without a server around it (`alone`) stands beside, and what both act on without noise must be the same.
    """
    models = Path(stack.enter_context(TemporaryDirectory()))
    run(MAKE_RANDOM, "--out", models / "acting", "--widths", NARROW, "--latent-dim", 0, *act.flags)
    server = stack.enter_context(ada_server(models, "acting"))
    options = [word for option in (*act.options, f"temperature={act.temperature}") for word in ("--set", option)]
    common = ("--model", models / "acting", *options, "--seconds", settings.seconds)
    theirs: list[dict[str, Any]] = []

    def ask_theirs() -> Figures:
        theirs[:] = [line for line in peer(act.script, *common, "--modes", settings.modes) if "ms" in line]
        return {str(line["mode"]): {"p50": float(line["ms"])} for line in theirs}

    def ask_ours() -> Figures:
        ours = run(TIME_ACTS, *common)[0]
        for line in theirs:
            if not _alike(line, ours):
                raise NotMeasured(f"PyTorch ({line['mode']}) acts otherwise: {line['action']}, not {ours['action']}")
        client = ("--clients", 1, "--seconds", settings.seconds, "--face", settings.face)
        report = server.load(*client, *options, "--set", "streaming=false")
        if abs(report["evaluations_per_act"] - act.evaluations) > 0.01:
            raise NotMeasured(f"our act took {report['evaluations_per_act']:.2f} evaluations, not {act.evaluations}")
        return {settings.face: {**_figures(report), "alone": float(ours["ms"])}}

    return ask_theirs, ask_ours


def _alike(theirs: dict[str, Any], ours: dict[str, Any]) -> bool:
    """Whether the actions are the same, and the values where both tell one."""
    pairs = list(zip(theirs["action"], ours["action"], strict=True))
    if theirs["value"] is not None and ours["value"] is not None:
        pairs.append((theirs["value"], ours["value"]))
    return all(math.isclose(a, b, rel_tol=ALIKE, abs_tol=ALIKE) for a, b in pairs)


def _memory() -> Trial:
    def prepare(settings: Settings, _: ExitStack) -> tuple[Side, Side]:
        def ask() -> Figures:
            # A fresh server every time: memory that was once used is not all given back.
            with ada_server(settings.models) as server:
                memory = server.load("--idle-sessions", IDLE, "--seconds", 0.5, "--server-pid", server.pid)["memory_mb"]
                return {"above an empty server": {"MB": memory["idle"] - memory["before"]}}

        return dict, ask

    goal = Goal(f"memory of {IDLE:,} idle sessions", "MB", "MB", "at most", 200)
    return Trial("memory", goal.text, (goal,), prepare)


def _churn() -> Trial:
    def prepare(settings: Settings, stack: ExitStack) -> tuple[Side, Side]:
        server = stack.enter_context(ada_server(settings.models))
        # Sessions come a hundred a second at most: more would be a load of its own.
        seconds = max(settings.seconds, CHURN / 100)

        def ask(mode: str, *churn: object) -> Figures:
            report = server.load("--clients", CLIENTS, "--seconds", seconds, "--face", settings.face, *churn)
            if churn and report["churned"] != CHURN:
                raise NotMeasured(f"{report['churned']} sessions came and went, not {CHURN}")
            return {mode: _figures(report)}

        return (lambda: ask("ours, undisturbed")), (lambda: ask("disturbed", "--churn", CHURN))

    goal = Goal(f"p99 of {CLIENTS} streaming clients while {CHURN:,} other sessions come and go", "p99", "ms", "times at most", 2)
    return Trial("churn", goal.text, (goal,), prepare)
