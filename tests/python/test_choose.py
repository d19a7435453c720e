"""`ada-evaluate --choose`: the rule on made-up episodes, what the race spares, and the command on the real programs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from server import BINARY, ROOT, gone

from ada_diffuser import Client, SamplerOptions
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.messages import Missing, Model, Trained
from ada_diffuser.rollout import ActLog, Episode, Evaluation, Trial, evaluate
from ada_diffuser.rollout.choice import Choice, Facts, Setting, decide, grid, race, word
from ada_diffuser.rollout.report import choice_table

#: Returns of one setting by seed, the seeds lost, and its evaluations an act.
Truth = tuple[Callable[[int], float], set[int], float]
FACTS = Facts(
    {"streaming": "true", "kappa": "0.03", "temperature": "0", "latent_jump": "0.6", "cold_distance": "1.5"},
    streams=True,
    latent=True,
    refined=True,
)


def setting(name: str) -> Setting:
    """`cold`, or streaming with this jump."""
    return Setting.parse({"streaming": "false"} if name == "cold" else {"streaming": "true", "latent_jump": name})


class Player:
    """Plays made-up settings and counts."""

    def __init__(self, truths: dict[str, Truth]) -> None:
        self.truths = {setting(name): truth for name, truth in truths.items()}
        self.played: dict[Setting, list[int]] = {one: [] for one in self.truths}

    def play(self, one: Setting, offset: int, episodes: int) -> Evaluation:
        returns, lost, evaluations = self.truths[one]
        seeds = range(5000 + offset, 5000 + offset + episodes)
        self.played[one] += seeds
        played = [Episode(seed, rewards=[returns(seed)], failed=seed in lost) for seed in seeds]
        box = np.ones(1, np.float32)
        trained = Trained((1,), (1,), Missing(state=False, action=False, reward=False))
        model = Model("0", "ab" * 32, True, 1, 1, 8, 4, 1, 2, 10, -box, box, SamplerOptions(), True, trained)
        acts = ActLog([1.0], 100 * episodes, 0, round(100 * episodes * evaluations))
        return Evaluation(Trial("point-wind-s", episodes=episodes, seed=seeds[0]), model, one.options, played, acts, 1.0)


def chosen(truths: dict[str, Truth], episodes: int = 48) -> tuple[Choice, dict[str, str], Player]:
    """By the race; each setting's verdict by name; and what was played."""
    player = Player(truths)
    choice = decide(race(list(player.truths), episodes, player.play))
    return choice, {name: choice.verdict(one) for name, one in zip(truths, choice.tried, strict=True)}, player


def hard(seed: int) -> float:
    """Episodes differ much: half of them are worth -20, half -100."""
    return -20.0 if seed % 2 else -100.0


def wobble(size: float, shift: float) -> Callable[[int], float]:
    """So far from `hard` on average, up and down by `size` from episode to episode."""
    return lambda seed: hard(seed) + shift + size * (1 if seed // 2 % 2 else -1)


def test_streaming_is_chosen_where_it_is_within_one_standard_error_and_cheaper() -> None:
    # The standard error of the difference over 48 episodes is 7 / sqrt(47).
    choice, verdicts, _ = chosen({"cold": (hard, set(), 16), "1": (wobble(7, -0.9), set(), 1.4), "0.3": (wobble(7, 0.5), set(), 1.8)})
    assert verdicts == {"cold": "reference", "1": "chosen", "0.3": "dearer"}
    gap = choice.gap(choice.chosen)
    assert gap.mean == pytest.approx(0.9) and gap.error == pytest.approx(7 / np.sqrt(47))
    assert "0.90 below cold's best (-60.00 at 16.00 evaluations an act, 0 lost)" in choice.reason()


def test_what_is_a_little_below_in_every_episode_is_below() -> None:
    """Both means have a standard error of 5.8, and 2 points less would pass; but every episode is 2 points less, give or take 1."""
    choice, verdicts, _ = chosen({"cold": (hard, set(), 16), "1": (wobble(7, -2), set(), 1.4), "0.3": (wobble(1, -0.1), set(), 1.8)})
    assert verdicts == {"cold": "reference", "1": "below", "0.3": "chosen"}
    assert choice.chosen.result.standard_error > 5


def test_the_cheapest_that_loses_episodes_is_not_chosen() -> None:
    """The shipped settings lost 11 of 50 episodes of a fourth training seed, at -117 +- 16 against -53 +- 3 cold."""
    lost = set(range(5030, 5034))
    choice, verdicts, _ = chosen({"cold": (hard, {5001}, 16), "1": (wobble(7, 0.5), lost, 1.4), "0.3": (wobble(7, 0), {5002}, 1.8)})
    assert verdicts == {"cold": "reference", "1": "loses more", "0.3": "chosen"}
    heavy = {"cold": (hard, set(), 16.0), "1": (lambda seed: hard(seed) - 290 * (seed % 5 == 0), set(range(5000, 5050, 5)), 1.4)}
    choice, verdicts, _ = chosen(heavy, 50)
    assert verdicts == {"cold": "chosen", "1": "below"} or verdicts == {"cold": "chosen", "1": "far below"}
    assert choice.reason().startswith("cold's best") and "1 of 2 settings qualify, and no other" in choice.reason()


def test_a_tenth_of_an_evaluation_is_no_difference() -> None:
    _, verdicts, _ = chosen({"cold": (hard, set(), 16), "1": (wobble(7, -0.5), set(), 1.42), "0.3": (wobble(7, -0.2), set(), 1.5)})
    assert verdicts == {"cold": "reference", "1": "qualifies", "0.3": "chosen"}


def test_the_race_spares_what_cannot_be_chosen_and_chooses_the_same() -> None:
    truths: dict[str, Truth] = {
        "cold": (hard, set(), 16),
        "inf": (wobble(7, -40), set(), 1.1),
        "2": (wobble(7, -2), set(), 1.2),
        "1": (wobble(7, -0.5), set(), 1.5),
        "0.3": (wobble(7, 0.2), set(), 2.5),
    }
    choice, verdicts, player = chosen(truths)
    assert verdicts == {"cold": "reference", "inf": "far below", "2": "below", "1": "chosen", "0.3": "dearer"}
    assert [len(seeds) for seeds in player.played.values()] == [48, 12, 48, 48, 12]
    assert all(seeds == list(range(5000, 5000 + len(seeds))) for seeds in player.played.values()), "each episode once, in order"
    whole = decide(race(list(player.truths), 7, player.play))
    assert {one.episodes for one in whole.tried} == {7}, "a quarter of seven could tell nothing"
    everything = decide([replace(one, result=player.play(one.setting, 0, 48)) for one in choice.tried])
    assert everything.chosen.setting == choice.chosen.setting
    rows = choice_table(choice).splitlines()
    assert len(rows) == 7 and len({row.count("|") for row in rows}) == 1 and "**chosen**" in rows[5]
    assert rows[2].startswith("| false |  | 48 | -60.00 ± ")


def test_the_grid_holds_the_checkpoints_own_values_and_what_it_can_do() -> None:
    settings = grid({}, FACTS)
    assert len(settings) == len(set(settings)) == 3 * 2 + 3 * 2 * 4 * 2, "cold settings do not differ by when a window is dropped"
    assert not any(one.options.streaming or one.restart for one in settings[:6]) and all(one.options.streaming for one in settings[6:])
    assert {one.options.kappa for one in settings} == {0, 0.1, 0.03}
    assert {one.options.kappa for one in grid({}, replace(FACTS, refined=False))} == {0}
    blind = grid({}, replace(FACTS, latent=False))
    assert {(one.options.kappa, dict(one.restart).get("latent_jump")) for one in blind} == {(0.03, None), (0.03, 0.6)}
    assert len(grid({}, replace(FACTS, streams=False))) == 6
    given = grid({"kappa": "inf", "temperature": "0", "latent_jump": "0.3, inf", "cold_distance": "1.5", "eta": "0,1"}, FACTS)
    assert len(given) == 2 + 4 and given[-1].overrides()[-2:] == ["restart.cold_distance=1.5", "restart.latent_jump=inf"]
    nats = grid({**dict.fromkeys(("kappa", "temperature", "cold_distance"), "1"), "latent_jump": "inf", "latent_kl": "0.3, inf"}, FACTS)
    assert [one.overrides()[-1] for one in nats[1:]] == ["restart.latent_kl=0.3", "restart.latent_kl=inf"] and len(nats) == 3
    assert "sampler.kappa=inf" in given[0].overrides() and "sampler.streaming=false" in given[0].overrides()
    for words, names in [
        ({"streaming": "true"}, "cold is the reference"),
        ({"latent_jump": "-1"}, "latent_jump"),
        ({"latent_jump": "nan"}, "latent_jump"),
        ({"latent_kl": "-0.1"}, "latent_kl"),
        ({"jump": "1"}, "no such option: jump"),
        ({"action_horizon": "1,2"}, "one action_horizon"),
    ]:
        with pytest.raises(ValueError, match=names):
            grid(words, FACTS)
    assert word(float(np.float32(0.6))) == "0.6"


def test_what_the_trainer_says_of_a_checkpoint_is_understood() -> None:
    told = subprocess.run(
        [BINARY.with_name("ada-trainer"), "inspect", "--json", ROOT / "models/cheetah-vel-e"], capture_output=True, check=True
    )
    facts = Facts.of(json.loads(told.stdout)["config"])
    assert facts.streams and facts.latent and facts.refined
    assert (facts.own["latent_jump"], facts.own["kappa"], facts.own["streaming"], facts.own["latent"]) == ("0.6", "0.1", "true", "mean")
    assert facts.own["latent_kl"] == "inf", "what is not named is off"


def test_episodes_in_parts_are_the_same_as_in_one(address: str) -> None:
    with Client(f"grpc://{address}") as client:
        trial = Trial("point-wind-s", "tiny", 5, 5000, 5, SamplerOptions(temperature=1.0), episode_steps=12)
        whole = evaluate(client, trial)
        parts = evaluate(client, replace(trial, episodes=2)).joined(evaluate(client, replace(trial, episodes=3, seed=5002)))
    assert np.array_equal(parts.returns, whole.returns) and parts.trial == trial
    assert (parts.acts.acts, parts.acts.evaluations) == (whole.acts.acts, whole.acts.evaluations)
    with pytest.raises(ValueError, match="next seeds"):
        whole.joined(whole)


def choose(*words: str) -> list[str]:
    return [
        "--env",
        "point-wind-s",
        "--choose",
        str(ROOT / "models/tiny"),
        "--programs",
        str(BINARY.parent),
        "--episode-steps",
        "6",
        *words,
    ]


SMALL = ["--episodes", "3", "--set", "kappa=0", "--set", "temperature=0", "--set", "latent_jump=0.5,inf", "--set", "cold_distance=1.25"]


def test_the_command_chooses_tells_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    out = tmp_path / "new/chosen"
    out.parent.mkdir()
    words = choose(*SMALL, "--env-option", "sigma=0.5", "--json", str(tmp_path / "a.json"), "--write", str(out))
    assert evaluate_command.main(words) == 0
    told = capsys.readouterr()
    assert told.out.count("\n| ") == 3 and "**chosen**" in told.out
    stored = json.loads((tmp_path / "a.json").read_text())
    assert stored["env_options"] == {"sigma": 0.5}
    assert stored["seed"] == 5000 and len(stored["settings"]) == 3 and all(len(one["returns"]) == 3 for one in stored["settings"])
    assert stored["command"] in told.out and stored["reason"] in told.out
    assert [one["verdict"] for one in stored["settings"]].count("chosen") == 1
    assert stored["settings"][2]["setting"]["latent_jump"] == "infinity"
    inspected = subprocess.run([BINARY.with_name("ada-trainer"), "inspect", "--json", out], capture_output=True, check=True)
    in_force = json.loads(inspected.stdout)["config"]["defaults"]
    for key in stored["chosen"]:
        section, name = key.split("=")[0].split(".")
        value = in_force[section][name]
        assert key.endswith(f"={word(float('inf') if value is None else value)}")
    assert "sampler.temperature=0" in stored["chosen"] and in_force["sampler"]["temperature"] == 0
    assert not list((tmp_path / "temporary").iterdir()), "the variants are gone"


def test_settings_are_checked_before_the_first_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    for words, names in [
        (choose("--set", "sub_steps=1,7"), "sub_steps"),
        (choose("--set", "kapa=1"), "kapa"),
        (choose("--episodes", "1"), "at least 2 episodes"),
        (choose("--models", "tiny"), "--models"),
        (choose("--env-option", "sigmas=1"), "sigmas"),
        (choose("--readout"), "two commands"),
        (choose("--write", str(tmp_path / "file")), "is a file"),
        ([*choose(), "--choose", str(tmp_path)], "ada-trainer inspect:"),
        ([*choose(), "--programs", str(tmp_path)], "there is no ada-trainer"),
        (["--env", "point-wind-s", "--write", "x"], "--write belongs to --choose"),
        (["--env", "point-wind-s", "--plot", "x.png"], "--plot belongs to --readout"),
    ]:
        assert evaluate_command.main(words) == 1
        told = capsys.readouterr()
        assert names in told.err and told.err.count("\n") == 1 and told.out == "", told


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_no_server_is_left_when_the_command_is_ended(tmp_path: Path, number: signal.Signals) -> None:
    """It runs in a session of its own, so that nobody else would end it; nor could a command that was killed."""
    programs, temporary, pid = tmp_path / "programs", tmp_path / "temporary", tmp_path / "pid"
    programs.mkdir()
    temporary.mkdir()
    (programs / "ada-trainer").symlink_to(BINARY.with_name("ada-trainer"))
    (programs / "ada-server").write_text(f'#!/bin/sh\necho $$ >{pid}\nexec {BINARY} "$@"\n')
    (programs / "ada-server").chmod(0o755)
    command = [sys.executable, "-m", "ada_diffuser.commands.evaluate", *choose("--episodes", "500"), "--programs", str(programs)]
    with subprocess.Popen(command, env={**os.environ, "TMPDIR": str(temporary)}, stderr=subprocess.PIPE, text=True) as running:
        assert running.stderr is not None
        assert running.stderr.readline().startswith("episodes 0 to 124"), "it plays"
        os.kill(int(pid.read_text()), 0)
        running.send_signal(number)
        assert running.wait(60) == (143 if number == signal.SIGTERM else -signal.SIGKILL)
    gone(int(pid.read_text()))
    assert number == signal.SIGKILL or not list(temporary.iterdir())
