"""Recordings of ada-server (`--record DIR`), replayed over the wire: the same observations to a running server, the same answers?

    recording = Recording.load("acts.jsonl")  # what `ada-server replay --export FILE` prints
    with Client("grpc://127.0.0.1:7777") as client:
        print(replay(client, recording))

Here each act travels, so that another machine and another version can be asked. Where neither matters `ada-server replay FILE` is
faster, and does what cannot be asked for over the wire: an act that a deadline hurried is done again as it was.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ada_diffuser.client import Client, Session
from ada_diffuser.errors import AdaError, InvalidInput, NotFound
from ada_diffuser.messages import Chunk, Executed, SamplerOptions
from ada_diffuser.options import BOUND, NUMBERS
from ada_diffuser.values import Floats

#: Begins a recording as the server writes it.
MAGIC = b"ADAR"

#: Why an act was not held against its answer, by the word in `Replay.not_compared`.
REASONS = {
    "no_model": "their model is not served",
    "gap": "acts before them are missing",
    "hurried": "a deadline had hurried them, or one before them, which cannot be asked for: `ada-server replay` does it",
    "after_difference": "their session had gone another way",
    "bad_session": "their session was refused by the server",
}


@dataclass(frozen=True)
class Recording:
    """The entries of one recording, in their order, as `ada-server replay --export` prints them: `{"act": {...}}`."""

    header: Mapping[str, Any]
    entries: list[Mapping[str, Any]]

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """From a file of JSON lines. ValueError where it is none, or says nothing that could be sent."""
        path = Path(path)
        with path.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                raise ValueError(f"{path}: is as the server wrote it; `ada-server replay --export {path}` makes JSON lines of it")
        with path.open(encoding="utf-8") as lines:
            return cls.read(lines, str(path))

    @classmethod
    def read(cls, lines: Iterable[str], name: str = "recording") -> Recording:
        """The same of its lines; `name` begins what ValueError says."""
        entries: list[Mapping[str, Any]] = []
        for number, line in enumerate(lines, 1):
            try:
                entry = json.loads(line)
            except json.JSONDecodeError as error:
                raise ValueError(f"{name}:{number}: is no JSON: {error}") from None
            if not isinstance(entry, dict) or len(entry) != 1:
                raise ValueError(f"{name}:{number}: is no entry of a recording")
            entries.append(entry)
        header = entries[0].get("header") if entries else None
        if not isinstance(header, dict):
            raise ValueError(f"{name}: does not begin with a header: it is no export of a recording")
        if not header.get("observations"):
            raise ValueError(f"{name}: observations were withheld when it was made, so that nothing can be sent")
        return cls(header, entries[1:])

    @property
    def acts(self) -> int:
        """How many acts there are."""
        return sum("act" in entry for entry in self.entries)


@dataclass(frozen=True)
class Difference:
    """An answer that is not as it was recorded."""

    #: Name of the session in the recording.
    session: str
    episode: int
    step: int
    #: Where in the answer, e.g. `actions[0][2]`; `act` where there was none.
    field: str
    expected: str
    found: str

    def __str__(self) -> str:
        place = f"session {self.session}, episode {self.episode}, step {self.step}"
        return f"{place}: {self.field} was {self.expected}, and is {self.found}"


@dataclass
class Replay:
    """What came of it."""

    acts: int = 0
    equal: int = 0
    different: int = 0
    #: By the words of `REASONS`.
    not_compared: Counter[str] = field(default_factory=Counter)
    first: Difference | None = None

    @property
    def verdict(self) -> str:
        """`equal`, `different` or `incomplete`: none differs, but not all were compared, or there was none."""
        if self.different:
            return "different"
        return "equal" if self.acts and self.equal == self.acts else "incomplete"

    def as_json(self) -> dict[str, Any]:
        return {"verdict": self.verdict, **asdict(self), "not_compared": dict(self.not_compared)}

    def __str__(self) -> str:
        lines = [f"{self.verdict}: of {self.acts} acts {self.equal} are equal bit for bit, {self.different} are not"]
        lines += [f"  {count} not compared: {REASONS[why]}" for why, count in self.not_compared.items()]
        lines += [f"  the first that differs: {self.first}"] if self.first else []
        return "\n".join(lines)


def replay(client: Client, recording: Recording, progress: Callable[[int], object] = lambda acts: None) -> Replay:
    """Sends every act to the server, in sessions of its own with the same seeds and options, and compares its answers with those recorded.

    A session that did not begin in the recording is imported as it stood there. All are closed at the end. `progress` is called with
    the number of acts just done. Raises the `AdaError` of a server that is gone; what it refuses is a difference.
    """
    done, lanes = Replay(), dict[str, _Lane]()
    served = {model.digest: model.name for model in client.models()}
    try:
        for kind, entry in _known(recording.entries):
            if kind == "stands":
                lane = lanes.setdefault(entry["session"], _Lane(client))
                lane.stand(entry, served)
            elif kind == "reset":
                lanes.setdefault(entry["session"], _Lane(client)).reset(entry)
            else:
                lanes.setdefault(entry["session"], _Lane(client)).act(entry, done)
                progress(1)
    finally:
        for lane in lanes.values():
            lane.close()
    return done


def _known(entries: Iterable[Mapping[str, Any]]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for entry in entries:
        for kind, value in entry.items():
            if kind in ("stands", "act", "reset"):
                yield kind, value


class _Lane:
    """A session of the recording and the one that takes its place."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._session: Session | None = None
        #: Why its acts cannot be compared; None: they can.
        self._why: str | None = "gap"
        #: The recorded session's episode and step.
        self._at = (0, 0)

    def stand(self, entry: Mapping[str, Any], served: Mapping[str, str]) -> None:
        self.close()
        self._at = (entry["episode"], entry["step"])
        name = served.get(entry["model_digest"])
        if name is None:
            self._why = "no_model"
            return
        try:
            if entry["record"] is None:
                options = SamplerOptions.received(entry["options"], _SPELLED)
                self._session = self._client.open_session(f"{name}@{entry['model_digest']}", seed=entry["seed"], options=options)
            else:
                self._session = self._client.import_session(base64.b64decode(entry["record"], validate=True))
            self._why = None
        except (InvalidInput, NotFound):
            self._why = "bad_session"

    def reset(self, entry: Mapping[str, Any]) -> None:
        if self._why is None and self._session is not None:
            if self._at[0] + 1 != entry["episode"]:
                self._why = "gap"
                return
            try:
                self._session.reset(entry["seed"], keep_history=entry["keep_history"])
                self._at = (entry["episode"], 0)
            except (InvalidInput, NotFound):
                self._why = "bad_session"

    def act(self, entry: Mapping[str, Any], done: Replay) -> None:
        done.acts += 1
        if self._why is None and self._at != (entry["episode"], entry["step"] - 1):
            self._why = "gap"
        if self._why is None and entry["haste"] is not None:
            self._why = "hurried"
        if self._why is not None or self._session is None:
            done.not_compared[self._why or "gap"] += 1
            return
        seen, answer = entry["seen"]["observation"], entry["answer"]["answer"]
        executed = [Executed(step["state"], step["action"], step["reward"]) for step in seen["executed"]]
        try:
            chunk = self._session.act(
                seen["state"],
                executed,
                nothing_executed=seen["nothing_executed"],
                context=seen["context"],
                planned_states=True,
            )
            found = _first_difference(answer, chunk)
        except AdaError as error:
            if error.retryable:
                raise
            found = ("act", "answered", str(error))
        self._at = (entry["episode"], entry["step"])
        if found is None:
            done.equal += 1
            return
        done.different += 1
        self._why = "after_difference"
        if done.first is None:
            done.first = Difference(entry["session"], entry["episode"], entry["step"], *found)

    def close(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            # It expires by itself.
            with suppress(AdaError):
                session.close()


#: Options as an export spells them.
_SPELLED: dict[Any, Callable[[Any], Any]] = {BOUND: lambda value: math.inf if value == "infinity" else float(value), NUMBERS: tuple}


def _first_difference(answer: Mapping[str, Any], chunk: Chunk) -> tuple[str, str, str] | None:
    """Field, recorded and found value of the first that differs, bit by bit."""
    start = answer["start"]
    word, rungs = (start.lower(), 0) if isinstance(start, str) else ("renoised", start["Renoised"])
    planned = chunk.planned_states
    digest = hashlib.sha256(b"" if planned is None else planned.astype("<f4").tobytes()).digest()
    plain: list[tuple[str, Any, Any]] = [
        ("degraded", answer["degraded"], chunk.degraded),
        ("start", (word, rungs), (chunk.start, chunk.renoised_rungs)),
        ("evaluations", answer["evaluations"], chunk.evaluations),
        ("passes", answer["passes"], chunk.passes),
    ]
    numbers: list[tuple[str, ArrayLike, Floats]] = [
        ("latent_mean", answer["latent_mean"], chunk.latent_mean),
        ("latent_log_var", answer["latent_log_var"], chunk.latent_log_var),
        ("predicted_state", answer["predicted_state"], chunk.predicted_state),
        *(
            (name, [] if answer[name] is None else [answer[name]], np.array([] if found is None else [found], np.float32))
            for name, found in (("value", chunk.value), ("value_spread", chunk.value_spread))
        ),
    ]
    found = _off("actions", answer["actions"], chunk.actions)
    found = found or next(((name, repr(was), repr(now)) for name, was, now in plain if was != now), None)
    found = found or next((off for name, was, now in numbers if (off := _off(name, was, now))), None)
    lengths = (answer["planned_len"], 0 if planned is None else len(planned))
    if found is None and lengths[0] != lengths[1]:
        return ("planned_states.len", str(lengths[0]), str(lengths[1]))
    expected = base64.b64decode(answer["planned_digest"])
    return found or (None if expected == digest else ("planned_states (digest)", expected.hex(), digest.hex()))


def _off(name: str, was: ArrayLike, now: Floats) -> tuple[str, str, str] | None:
    """The first number that has other bits: to `==` 0 and -0 are the same."""
    expected = np.asarray(was, np.float32)
    if expected.size == now.size == 0:
        return None
    if expected.shape != now.shape:
        return (f"{name}.shape", str(expected.shape), str(now.shape))
    bad = np.argwhere(expected.view(np.uint32) != np.ascontiguousarray(now, np.float32).view(np.uint32))
    if not bad.size:
        return None
    at = tuple(bad[0])
    return (name + "".join(f"[{i}]" for i in at), _number(expected[at]), _number(now[at]))


def _number(value: np.float32) -> str:
    """With its bits: two that differ in the last one may look alike."""
    return f"{value} (0x{int(np.float32(value).view(np.uint32)):08x})"
