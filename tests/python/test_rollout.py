"""What a rollout makes of its episodes: statistics, the readout, the picture, the film, the command lines."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from ada_diffuser import SamplerOptions, environments
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.commands import parse_settings, server_url
from ada_diffuser.commands import rollout as rollout_command
from ada_diffuser.messages import Missing, Model, Timings, Trained
from ada_diffuser.rollout import ActLog, Episode, Evaluation, Trial
from ada_diffuser.rollout.film import Panel, save_film
from ada_diffuser.rollout.plot import save_plot
from ada_diffuser.rollout.readout import Reading, Readout, fit, read
from ada_diffuser.rollout.report import markdown, table
from ada_diffuser.rollout.seeds import by_recipe


def played(env_name: str, seed: int, steps: int = 20) -> Episode:
    """An episode of random actions, with latents that hold the context and something else."""
    env = environments.make(env_name)
    observation, _ = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    episode = Episode(seed)
    for step in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        episode.states.append(np.asarray(observation, np.float32))
        observation, reward, _, _, facts = env.step(action)
        episode.actions.append(action)
        episode.rewards.append(float(reward))
        episode.contexts.append(facts["context"])
        episode.act_steps.append(step)
        mixed = [3 * facts["context"][0] - 1, rng.normal()]
        episode.latents.append(np.array(mixed, np.float32))
    env.close()
    return episode


def finished(env_name: str, episodes: list[Episode]) -> Evaluation:
    acts = ActLog()
    acts.call_ms, acts.acts, acts.evaluations, acts.timings = [1.0, 3.0], 2, 9, [Timings(1000, 2000, 3000, 6000)]
    box = np.ones(1, np.float32)
    options = SamplerOptions(streaming=True, kappa=float("inf"))
    trained = Trained((1,), (1,), Missing(state=False, action=False, reward=False))
    model = Model("fake", "ab" * 32, True, 1, 1, 8, 4, 1, 2, 10, -box, box, options, True, trained)
    return Evaluation(Trial(env_name, episodes=len(episodes)), model, options, episodes, acts, 1.0)


def named(name: str, env_name: str, episodes: list[Episode]) -> Reading:
    """Of a model with this name."""
    result = finished(env_name, episodes)
    return read(replace(result, model=replace(result.model, name=name)))


def test_statistics() -> None:
    episodes = [Episode(0, rewards=[-1.0, -2.0]), Episode(1, rewards=[-6.0]), Episode(2, rewards=[-12.0], failed=True)]
    result = finished("point-wind-s", episodes)
    assert result.mean_return == -7.0 and result.median_return == -6.0 and result.failures == 1
    assert result.standard_error == pytest.approx(np.std([3, 6, 12], ddof=1) / np.sqrt(3))
    assert result.latency_ms(50) == 2.0 and result.server_ms("commit", 50) == 3.0 and result.evaluations_per_act == 4.5
    stored = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert stored["returns"] == [-3.0, -6.0, -12.0] and stored["failed_seeds"] == [2]
    assert stored["options"]["kappa"] == "infinity"


def test_what_acts_cost_and_were_worth_is_kept_when_episodes_are_joined() -> None:
    one = ActLog([1.0], 2, 0, 9, [Timings(1, 2, 3, 6)], 4, [-1.0])
    both = one.joined(ActLog([2.0], 1, 1, 3, [Timings(4, 5, 6, 15)], 3, [-4.0, -7.0]))
    assert (both.acts, both.replayed, both.evaluations, both.passes, both.values) == (3, 1, 12, 7, [-1.0, -4.0, -7.0])
    result = replace(finished("point-wind-s", [Episode(0, rewards=[-1.0])]), acts=both)
    assert result.mean_value == -4.0 and result.passes_per_act == pytest.approx(7 / 3)
    assert finished("point-wind-s", [Episode(0, rewards=[-1.0])]).mean_value is None


def test_the_readout_finds_a_linear_context_and_nothing_in_noise() -> None:
    episodes = [played("cheetah-wind-s", seed) for seed in range(4)]
    read = fit(episodes)
    assert isinstance(read, Readout) and read.r2 > 0.999 and read.first_shown == 2
    assert np.allclose(read.of(episodes[3])[:, 0], [context[0] for context in episodes[3].contexts], atol=0.05)
    for episode in episodes:
        episode.latents = [latent[1:] for latent in episode.latents]
    noise = fit(episodes)
    assert isinstance(noise, Readout) and noise.r2 < 0.2


def test_a_readout_that_cannot_be_says_why() -> None:
    episodes = [played("cheetah-vel-e", seed, steps=3) for seed in (0, 1)]
    assert "two episodes" in str(fit(episodes[:1]))
    assert "nothing to tell apart" in str(fit([episodes[0], episodes[1]]))
    without = [Episode(0, latents=[np.zeros(0, np.float32)]), Episode(1, latents=[np.zeros(0, np.float32)])]
    assert "no latent" in str(fit(without))


def test_the_table_and_the_markdown_hold_the_numbers() -> None:
    result = finished("point-wind-s", [Episode(0, rewards=[-1.0]), Episode(1, rewards=[-3.0])])
    text = table([Reading(result, "no readout, because", None)])
    for words in ("-2.00 ± 1.00", "0 of 2", "p50 2.00 ms, p99 2.98 ms", "4.50", "no readout, because", "kappa=inf"):
        assert words in text
    assert "above the first" not in text
    off = SamplerOptions(eta=0.0, candidates=1, pick_temperature=0.5, guidance_scale=2.0, guidance_samples=3, latent="mean")
    text = table([Reading(replace(result, options=off), "", None)])
    assert "guidance_scale=2, guidance_samples=3\n" in text, "what does nothing is not told"
    rows = markdown([result], ["kappa", "streaming"]).splitlines()
    assert len(rows) == 3 and len({row.count("|") for row in rows}) == 1
    assert rows[2].startswith("| point-wind-s | fake | inf | true | -2.00 ± 1.00 | -2.00 | 0/2 | 4.50 |")


def test_training_seeds_of_a_recipe_get_a_standard_error_of_their_own() -> None:
    """A fourth training seed lay 15 points off a printed +- 1.7: that was the error over episodes, and the table did not say so."""
    returns = {"point-seed0": [-10.0, -14.0], "point-seed1": [-20.0, -22.0], "point-seed2": [-30.0, -36.0], "other": [-1.0, -1.0]}
    results = []
    for name, values in returns.items():
        result = finished("point-wind-s", [Episode(i, rewards=[value]) for i, value in enumerate(values)])
        results.append(replace(result, model=replace(result.model, name=name)))
    (group,) = by_recipe(results)
    assert group.recipe == "point" and group.mean_return == -22.0
    assert group.standard_error == pytest.approx(np.std([-20, -24], ddof=1) / np.sqrt(2))
    assert group.standard_error_training == pytest.approx(np.std([-12, -21, -33], ddof=1) / np.sqrt(3))
    stored = json.loads(json.dumps(group.as_json(), allow_nan=False))
    assert stored["training_seeds"] == ["point-seed0", "point-seed1", "point-seed2"] and stored["mean_returns"] == [-12, -21, -33]
    assert (stored["standard_error"], stored["standard_error_training_seeds"]) == (2.0, pytest.approx(6.082763))
    rows = markdown(results, []).splitlines()
    assert len(rows) == 7 and len({row.count("|") for row in rows}) == 1
    assert rows[6].startswith("| point-wind-s | point, 3 training seeds | -22.00 ± 2.00 | ± 6.08 | -21.00 | 0/6 |")
    assert not by_recipe(results[:1]) and "training" not in markdown(results[:1], [])


def test_other_settings_are_other_groups() -> None:
    def one(seed: int, kappa: float) -> Evaluation:
        result = finished("point-wind-s", [Episode(0, rewards=[-1.0])])
        options = SamplerOptions(kappa=kappa)
        return replace(result, model=replace(result.model, name=f"a-seed{seed}"), trial=replace(result.trial, options=options))

    groups = by_recipe([one(seed, kappa) for kappa in (0.0, float("inf")) for seed in (0, 1)])
    assert [group.as_json()["options"] for group in groups] == [{"kappa": 0.0}, {"kappa": "infinity"}]
    assert not by_recipe([one(0, 0.0), one(0, 0.0)]), "the same model twice is no second training"


@pytest.mark.parametrize("env", ["cheetah-wind-s", "point-wind-s"])
def test_the_picture_is_drawn_and_the_same_each_time(tmp_path: Path, env: str) -> None:
    episodes = [played(env, seed) for seed in range(3)]
    reading = Reading(finished(env, episodes), fit(episodes), None)
    for name in ("a.png", "b.png"):
        save_plot([reading], tmp_path / name)
    with Image.open(tmp_path / "a.png") as picture:
        assert min(picture.size) > 500 and len(set(picture.convert("L").tobytes())) > 10
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_the_point_film_has_a_frame_a_step(tmp_path: Path) -> None:
    episodes = [played("point-wind-s", seed) for seed in range(2)]
    assert save_film([Panel("point-wind-s", episodes[1], fit(episodes))], tmp_path / "film.gif") is None
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 20 and film.info["loop"] == 0


def test_models_on_the_same_episodes_stand_side_by_side(tmp_path: Path) -> None:
    """In the table with the difference, episode by episode; in the plot; in the film, where one whose episode is over waits."""
    knowing = named("knowing", "point-wind-s", [played("point-wind-s", seed) for seed in range(4)])
    blind = [played("point-wind-s", seed, steps=12) for seed in range(4)]
    for place, (episode, other) in enumerate(zip(blind, knowing.result.episodes, strict=True)):
        episode.latents = [np.zeros(0, np.float32)] * 12
        episode.rewards = [0.0] * 11 + [other.total - (1.0 if place % 2 else 3.0)]
    both = [knowing, named("blind", "point-wind-s", blind)]
    rows = [line.split("  ") for line in table(both).splitlines()]
    cells = {row[0].strip(): [cell.strip() for cell in row[1:] if cell.strip()] for row in rows}
    assert cells["above the first"] == ["-2.00 ± 0.58"] and cells["model"] == ["knowing@abababababab", "blind@abababababab"]
    assert list(cells).index("above the first") == list(cells).index("median return") + 1
    assert cells["context readout"][1] == "this model has no latent to read out" and cells["context readout"][0].startswith("R²")

    for name, shown in (("both", both), ("turned", both[::-1]), ("one", both[:1])):
        save_plot(shown, tmp_path / f"{name}.png")
    assert len({(tmp_path / f"{name}.png").read_bytes() for name in ("both", "turned", "one")}) == 3

    panels = [Panel.last(one, one.result.model.name) for one in both]
    assert save_film(panels, tmp_path / "both.gif") is None and save_film([Panel.last(knowing)], tmp_path / "one.gif") is None
    with Image.open(tmp_path / "both.gif") as film, Image.open(tmp_path / "one.gif") as one:
        assert film.n_frames == 20 and film.width == 2 * one.width and film.height > one.height, "a line more, with the names"
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    moved = [np.abs(frame.astype(int) - frames[11]).mean(axis=(0, 2)) for frame in frames]  # by column; each frame has a palette of its own
    left, right = np.array(moved)[:, : one.width].mean(axis=1), np.array(moved)[:, one.width :].mean(axis=1)
    assert left[-1] > 10 * right[-1] and right[0] > 10 * right[-1]


def test_a_film_shows_the_environment_with_its_options(tmp_path: Path) -> None:
    episode = played("point-wind-s", 1)
    for name, options in (("plain", {}), ("same", {"omega": 0.2}), ("other", {"omega": 2.0})):
        assert save_film([Panel("point-wind-s", episode, env_options=options)], tmp_path / name) is None
    plain, same, other = ((tmp_path / name).read_bytes() for name in ("plain", "same", "other"))
    assert plain == same != other
    assert "omegas" in str(save_film([Panel("point-wind-s", episode, env_options={"omegas": 1})], tmp_path / "none"))


@pytest.mark.parametrize("env", ["cheetah-wind-s", "cheetah-dir-e", "ant-dir-e"])
def test_the_film_of_a_body_is_made_or_its_absence_explained(tmp_path: Path, env: str) -> None:
    path = tmp_path / "film.gif"
    reason = save_film([Panel(env, played(env, 3))], path)
    if reason is None:
        with Image.open(path) as film:
            assert film.n_frames == 20
    else:
        assert "egl:" in reason and not path.exists()


def test_a_renderer_that_does_not_exist_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "crayons")
    reason = save_film([Panel("cheetah-wind-s", played("cheetah-wind-s", 3, steps=2))], tmp_path / "film.gif")
    assert reason is not None and "crayons" in reason


def test_command_line_words() -> None:
    assert server_url("127.0.0.1:1", None) == "grpc://127.0.0.1:1"
    assert server_url("http://h:1", None) == "http://h:1"
    assert server_url("http://h:1", "grpc") == "grpc://h:1"
    for wrong in (["kappa"], ["kappa=1", "kappa=2"]):
        with pytest.raises(ValueError, match="kappa"):
            parse_settings(wrong)
    grid = list(evaluate_command.combinations(["kappa=0,inf", "streaming=true,false"]))
    assert len(set(grid)) == 4 and grid[0] == SamplerOptions(kappa=0.0, streaming=True)
    assert list(evaluate_command.combinations([])) == [SamplerOptions()]


def test_failures_end_with_status_1_and_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    nobody = ["--url", "127.0.0.1:1", "--wait", "0"]
    cases = [
        (rollout_command.main, ["--env", "cheetah-wind-s", *nobody]),
        (rollout_command.main, ["--env", "cheetah-wind-s", "--option", "kapa=1"]),
        (rollout_command.main, ["--env", "cheetah-wind-s", "--episodes", "0"]),
        (evaluate_command.main, ["--env", "cheetah-wind-s", "--set", "kappa=x"]),
        (evaluate_command.main, ["--env", "cheetah-wind-s", *nobody]),
    ]
    for main, words in cases:
        assert main(words) == 1
        error = capsys.readouterr().err
        assert error.startswith("ada-") and error.count("\n") == 1, error
