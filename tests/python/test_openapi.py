"""`/openapi.json` for machines: a validator takes it, answers fit what it says of them, and a generated client drives a session.

It was valid to nobody: responses without a description, query parameters in the path, `kappa` outside its own schema.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator
from server import running

from ada_diffuser.options import KINDS

STATE = [0.1, -0.2, 0.3, 0.4]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running(tmp_path_factory.mktemp("server") / "log", "--default-model", "tiny") as address:
        yield address


@pytest.fixture(scope="module")
def spec(address: str) -> dict[str, Any]:
    with urllib.request.urlopen(f"http://{address}/openapi.json") as answer:
        spec: dict[str, Any] = json.load(answer)
    return spec


def call(address: str, method: str, path: str, body: object = None) -> tuple[int, str, Any]:
    """Status, content type and JSON of an answer."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"http://{address}{path}", data, {"content-type": "application/json"}, method=method)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.headers["content-type"], json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, error.headers["content-type"], json.load(error)


def test_it_is_valid(spec: dict[str, Any]) -> None:
    assert [error.message for error in OpenAPIV31SpecValidator(spec).iter_errors()] == []


def test_it_names_every_option(spec: dict[str, Any]) -> None:
    schemas = spec["components"]["schemas"]
    assert set(schemas["OptionsBody"]["properties"]) == set(KINDS)
    assert schemas["ObservationBody"]["properties"]["context"]["items"]["items"]["type"] == "number"


def test_answers_fit_their_schemas(address: str, spec: dict[str, Any]) -> None:
    def ask(method: str, route: str, body: object = None, *, path: str = "") -> Any:
        status, kind, answer = call(address, method, path or route, body)
        responses = spec["paths"][route][method.lower()]["responses"]
        schema = responses[str(status) if str(status) in responses else "default"]["content"][kind]["schema"]
        errors = Draft202012Validator({**schema, "components": spec["components"]}).iter_errors(answer)
        assert [f"{'.'.join(map(str, error.path))}: {error.message}" for error in errors] == [], route
        return answer

    for kappa in ("infinity", 0.25):
        options = {"kappa": kappa, "latent": "sample"}
        opened = ask("POST", "/v1/sessions", {"model": "tiny", "seed": 1, "options": options})
        assert opened["session"]["options"]["kappa"] == kappa
    name = opened["session"]["session_id"]
    session, act = "/v1/sessions/{id}", {"step": 1, "observation": {"state": STATE}, "want_planned_states": True}
    assert ask("POST", f"{session}/act", act, path=f"/v1/sessions/{name}/act")["step"] == 1
    batch = ask("POST", "/v1/act:batch", {"acts": [{**act, "session_id": name}, {**act, "session_id": "no such"}]})
    assert [sorted(result)[0] for result in batch["results"]] == ["response", "error"]
    assert ask("GET", session, path=f"/v1/sessions/{name}")["session"]["committed_step"] == 1
    assert ask("POST", f"{session}/reset", {}, path=f"/v1/sessions/{name}/reset")["session"]["episode"] == 1
    record = ask("GET", f"{session}/export", path=f"/v1/sessions/{name}/export")
    assert ask("POST", "/v1/sessions:import", record)["session"]["episode"] == 1
    assert ask("POST", "/v1/sessions:import", {"record": ""})["field"] == "record"
    assert "tokens.key_file" in ask("POST", f"{session}/seal", path=f"/v1/sessions/{name}/seal")["detail"]
    assert ask("POST", "/v1/sessions:resume", {"token": ""})["field"] == "token"
    assert ask("POST", f"{session}/fork", {"seed": 2}, path=f"/v1/sessions/{name}/fork")["session"]["seed"] == 2
    assert len(ask("GET", "/v1/sessions", path="/v1/sessions?page_size=1&model=tiny")["sessions"]) == 1
    assert ask("GET", "/v1/models")["models"]
    assert ask("GET", "/v1/models/{name}", path="/v1/models/tiny")["model"]["name"] == "tiny"
    assert ask("GET", "/v1/models/{name}", path="/v1/models/x")["reason"] == "MODEL_NOT_FOUND"
    assert ask("POST", "/v1/sessions", {"sed": 1})["field"] == "sed"


def test_a_generated_client_drives_a_session(address: str, spec: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "openapi.json").write_text(json.dumps(spec))
    words = ["generate", "--path", "openapi.json", "--output-path", "generated_ada", "--meta", "none", "--fail-on-warning"]
    # It formats what it wrote with the ruff of this environment.
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    made = subprocess.run([sys.executable, "-m", "openapi_python_client", *words], cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    monkeypatch.syspath_prepend(tmp_path)
    generated, models = importlib.import_module("generated_ada"), importlib.import_module("generated_ada.models")

    def verb(name: str) -> Any:
        (found,) = (tmp_path / "generated_ada/api").glob(f"*/{name}.py")
        return importlib.import_module(f"generated_ada.api.{found.parent.name}.{name}")

    with generated.Client(f"http://{address}") as client:
        body = models.OpenBody(model="tiny", seed=1, options=models.OptionsBody(kappa=models.Unbounded.INFINITY))
        opened = verb("open_session").sync(client=client, body=body)
        assert opened.session.options.kappa == models.Unbounded.INFINITY
        act = models.ActBody(step=1, observation=models.ObservationBody(state=STATE))
        answer = verb("act").sync(opened.session.session_id, client=client, body=act)
        _, _, plain = call(address, "POST", f"/v1/sessions/{opened.session.session_id}/act", act.to_dict())
        assert answer.actions == plain["actions"] and plain["replayed"]
        wrong = verb("get_model").sync("x", client=client)
        assert (wrong.reason, wrong.status) == ("MODEL_NOT_FOUND", 404)
        assert verb("close_session").sync_detailed(opened.session.session_id, client=client).status_code == 204
