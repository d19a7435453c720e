"""`ada-evaluate --readout`: what a latent says of the true context, on latents for which that is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ada_diffuser import SamplerOptions
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.messages import Missing, Model, Trained
from ada_diffuser.rollout import ActLog, Episode, Evaluation, Trial
from ada_diffuser.rollout.clusters import Clusters, adjusted_rand_index, cluster, kmeans
from ada_diffuser.rollout.plot import save_latents
from ada_diffuser.rollout.readout import AgeError, Readout, fit, read
from ada_diffuser.rollout.report import readout_table

#: The latent at a step, from the context and a generator.
Latent = Callable[[int, np.ndarray, np.random.Generator], object]


def episodes(latent: Latent, count: int = 20, steps: int = 120, chunk: int = 1, spreads: tuple[float, ...] = (3.0,)) -> list[Episode]:
    """White contexts with these standard deviations, and a latent at the first step of each chunk."""
    made = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        contexts = [(rng.normal(size=len(spreads)) * spreads + 5).astype(np.float32) for _ in range(steps)]
        acts = list(range(0, steps, chunk))
        latents = [np.asarray(latent(step, contexts[step], rng), np.float32) for step in acts]
        made.append(Episode(seed, rewards=[0.0] * steps, contexts=contexts, act_steps=acts, latents=latents))
    return made


def errors(latent: Latent, **shape: object) -> dict[tuple[int, int], AgeError]:
    """By age, of episodes with these latents."""
    read_out = fit(episodes(latent, **shape))  # type: ignore[arg-type]
    assert isinstance(read_out, Readout)
    return {error.age: error for error in read_out.by_age()}


def evaluated(latent: Latent, name: str = "their-seed3", kappa: float = 0.0) -> Evaluation:
    played, box = episodes(latent), np.ones(1, np.float32)
    options = SamplerOptions(streaming=True, kappa=kappa)
    trained = Trained((1,), (1,), Missing(state=False, action=False, reward=False))
    model = Model(name, "ab" * 32, True, 1, 1, 8, 4, 1, 2, 10, -box, box, options, True, trained)
    return Evaluation(Trial("cheetah-wind-s", episodes=len(played)), model, options, played, ActLog([1.0], 1, 0, 1), 1.0)


def knows(step: int, context: np.ndarray, rng: np.random.Generator) -> object:
    return [2 * context[0] - 7, rng.normal()]


def guesses(step: int, context: np.ndarray, rng: np.random.Generator) -> object:
    return rng.normal(size=2)


def test_a_latent_that_is_the_context_knows_all_and_noise_nothing() -> None:
    known, guessed = errors(knows), errors(guesses)
    assert list(known) == [(0, 120), (0, 10), (10, 30), (30, 80), (80, 120), (50, 120)]
    assert all(error.mse < 1e-4 and error.episodes == 10 for error in known.values())
    assert guessed[0, 120].mse == pytest.approx(1, abs=0.02) and guessed[80, 120].mse == pytest.approx(1, abs=0.2)


def test_half_of_the_variance_known_is_half_of_the_error() -> None:
    """Context plus noise as strong: the best linear map leaves half."""
    half = errors(lambda step, context, rng: [context[0] + 3 * rng.normal()])[0, 120]
    assert half.mse == pytest.approx(0.5, abs=0.04)
    # The squared error of 1200 acts, Gaussian with variance one half: over episodes and over acts its mean is as uncertain.
    assert half.standard_error == pytest.approx(0.5 * np.sqrt(2 / 1200), rel=0.5)


def test_ages_are_told_apart() -> None:
    """A filter that needs ten steps: what it knows afterwards is not hidden in the mean over the episode."""

    def late(step: int, context: np.ndarray, rng: np.random.Generator) -> object:
        return context if step >= 10 else rng.normal(size=1) * 3 + 5

    for chunk in (1, 4):
        found = errors(late, chunk=chunk, count=60)
        first = found[0, 10].mse
        assert first > 1 and max(found[age].mse for age in ((10, 30), (30, 80), (80, 120), (50, 120))) < 0.05 * first
        acts = {
            age: len(range(0, 120, chunk)) if age == (0, 120) else sum(age[0] <= act < age[1] for act in range(0, 120, chunk))
            for age in found
        }
        bands = [(0, 10), (10, 30), (30, 80), (80, 120)]
        assert found[0, 120].mse == pytest.approx(sum(acts[age] * found[age].mse for age in bands) / acts[0, 120])


def test_the_age_is_the_step_of_the_act_in_a_chunk_too() -> None:
    """With chunks of 4 the third act is at step 8 and the fourth at 12: only these latents may count in their band."""

    def from_twelve(step: int, context: np.ndarray, rng: np.random.Generator) -> object:
        return context if step >= 12 else [5.0]

    found = errors(from_twelve, chunk=4)
    assert found[0, 10].mse > 0.7 and found[10, 30].mse < 1e-3
    assert list(errors(knows, chunk=4, steps=8)) == [(0, 8)], "no band without an act"
    assert [error.age for error in errors(knows, chunk=50, steps=60).values()] == [(0, 60), (0, 10), (30, 60), (50, 60)]


def test_each_dimension_of_the_context_counts_alike() -> None:
    """A great one that is known does not hide a small one that is not; one that never changes does not count."""
    found = errors(lambda step, context, rng: [context[0], rng.normal()], spreads=(100.0, 0.1, 0.0))
    assert found[0, 120].mse == pytest.approx(0.5, abs=0.02)


def test_the_standard_error_is_over_episodes() -> None:
    """Two shown episodes, one known and one not: 0.5 +- 0.5 of what the unknown one is off, whatever the number of their acts."""

    def one_of_two(known: int) -> Readout:
        played = episodes(knows, count=4)
        for latent in played[known].latents:
            latent[0] = 3  # the mean context
        found = fit(played)
        assert isinstance(found, Readout) and found.first_shown == 2
        return found

    (error,) = one_of_two(3).by_age(((0, None),))
    assert error.episodes == 2 and error.mse == pytest.approx(0.5, abs=0.1)
    assert error.standard_error == pytest.approx(error.mse, rel=1e-3)
    assert one_of_two(3).r2 == pytest.approx(1 - error.mse)


def test_rows_say_where_they_are_from() -> None:
    reading = read(evaluated(knows))
    rows = json.loads(json.dumps(reading.as_json(), allow_nan=False))["readout"]
    assert rows[1].pop("mse") < 1e-4 and rows[1].pop("r2") > 0.9999 and rows[1].pop("standard_error") < 1e-4
    told = {"environment": "cheetah-wind-s", "model": "their-seed3", "seed": 3, "where": "own_rollouts", "evidence": "filter"}
    assert rows[1] == {**told, "age": [0, 10], "episodes": 10}
    refined = read(evaluated(knows, name="other", kappa=float("inf"))).rows()[0]
    assert refined["evidence"] == "refined" and refined["seed"] is None
    blind = evaluated(lambda *_: [])
    none = read(blind)
    assert none.rows() == [] and none.clusters is None and "no latent" in none.as_json()["no_readout"]
    lines = readout_table([reading, none], ["kappa"]).splitlines()
    assert len(lines) == 4 and len({line.count("|") for line in lines}) == 1
    assert "steps 80 to 119" in lines[0] and lines[2].startswith("| cheetah-wind-s | their-seed3 | 0 | filter | 0.000 ± 0.000 |")
    assert "no latent" in lines[3]


def test_the_rand_index_and_purity_have_their_known_values() -> None:
    a, b = np.array([0, 0, 1, 1]), np.array([0, 0, 1, 2])
    assert adjusted_rand_index(a, b) == pytest.approx(4 / 7) == adjusted_rand_index(b, a)
    assert adjusted_rand_index(a, a[::-1]) == 1 and adjusted_rand_index(a, np.array([0, 1, 0, 1])) == pytest.approx(-0.5)
    one_group = Clusters(np.zeros((4, 2)), (1.0, 0.0), bins=a, groups=np.zeros(4, np.int64))
    assert one_group.purity == 0.5 and one_group.adjusted_rand_index == 0
    assert replace(one_group, groups=b).purity == 1, "smaller groups are as pure"
    rng = np.random.default_rng(0)
    assert abs(adjusted_rand_index(rng.integers(5, size=5000), rng.integers(5, size=5000))) < 0.01


def test_groups_of_latents_are_held_against_bins_of_the_context() -> None:
    rng = np.random.default_rng(1)
    contexts = rng.normal(size=(1000, 1))
    level = np.searchsorted(np.quantile(contexts[:, 0], [0.2, 0.4, 0.6, 0.8]), contexts[:, 0], side="right")
    corners = 20 * rng.normal(size=(5, 3))
    found = cluster(corners[level] + rng.normal(size=(1000, 3)), contexts)
    assert np.array_equal(found.bins, level) and found.adjusted_rand_index == 1 and found.purity == 1
    assert sum(found.shares) <= 1 and found.shares[0] >= found.shares[1] > 0
    noise = cluster(rng.normal(size=(1000, 3)), contexts)
    assert abs(noise.adjusted_rand_index) < 0.02 and noise.purity < 0.3
    line = cluster(contexts, np.hstack([0.01 * rng.normal(size=(1000, 1)), contexts]))
    assert line.plane.shape == (1000, 2) and line.shares == (1, 0) and np.array_equal(line.bins, level), "binned along what varies"
    speeds = cluster(corners[:2][(level > 2).astype(int)], np.where(level > 2, 2.5, 1.0)[:, None])
    assert speeds.as_json() == {"groups": 2, "acts": 1000, "adjusted_rand_index": 1.0, "purity": 1.0}, "two speeds are two bins"


def test_kmeans_ends_where_each_point_is_nearest_to_its_own_groups_mean() -> None:
    points = np.random.default_rng(2).normal(size=(300, 4))
    groups = kmeans(points, 5)
    means = np.stack([points[groups == group].mean(axis=0) for group in range(5)])
    assert np.array_equal(np.linalg.norm(points[:, None] - means, axis=2).argmin(axis=1), groups)
    assert np.array_equal(kmeans(points, 5), groups)
    assert set(kmeans(np.ones((10, 2)), 3)) == {0}


def test_the_latents_are_drawn_and_the_same_each_time(tmp_path: Path) -> None:
    readings = [read(evaluated(knows)), read(evaluated(guesses))]
    for name in ("a.png", "b.png"):
        save_latents(readings, tmp_path / name)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size[1] > 900 and len(set(picture.convert("L").tobytes())) > 10
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with pytest.raises(ValueError, match="no latent"):
        save_latents([replace(readings[0], readout="no latent", clusters=None)], tmp_path / "c.png")


def test_the_command_reads_the_latents_of_its_own_episodes(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored, picture = tmp_path / "a.json", tmp_path / "new/a.png"
    words = ["--env", "point-wind-s", "--models", "tiny", "--url", address, "--episodes", "4", "--episode-steps", "15"]
    assert evaluate_command.main([*words, "--set", "kappa=0,0.1", "--readout", "--json", str(stored), "--plot", str(picture)]) == 0
    told = capsys.readouterr()
    assert told.out.count("| point-wind-s | tiny |") == 4 and "| latent | steps 0 to 14 |" in told.out and f"plot: {picture}" in told.out
    entries = json.loads(stored.read_text())
    assert [[row["age"] for row in entry["readout"]] for entry in entries] == [[[0, 15], [0, 10], [10, 15]]] * 2
    assert [entry["readout"][0]["evidence"] for entry in entries] == ["filter", "refined"] and entries[0]["clusters"]["acts"] == 60
    assert picture.exists()
    assert evaluate_command.main([*words, "--json", str(stored)]) == 0
    assert "readout" not in json.loads(stored.read_text())[0]
