"""An environment is one class: whatever drives environments asks it, and knows none of them by name or type."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

import ada_diffuser
from ada_diffuser import environments
from ada_diffuser.commands.collect import main as collect
from ada_diffuser.dataset import load_episodes
from ada_diffuser.experts import formula_of, recipe_for
from ada_diffuser.experts.policy import LinearPolicy
from ada_diffuser.experts.training import ExpertRecipe, _Course
from ada_diffuser.rollout import Episode
from ada_diffuser.rollout.film import Panel, save_film

MINE = '''
import numpy as np
from gymnasium import spaces

from ada_diffuser.environments import ArsSettings, HiddenTask, Search


class Push(HiddenTask):
    """A number to be kept at 0 against a hidden push."""

    episode_steps, action_noise = 6, (0.25,)
    observation_space, action_space = spaces.Box(-9, 9, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, strength=1.0, wanted=(0.5, 1.0), render_mode=None):
        self.strength, self.wanted, self.render_mode = strength, wanted, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.push = 0.0, float(self.np_random.choice(self.wanted))
        return self.seen(), {"context": self.context}

    def step(self, action):
        self.x += self.strength * float(action[0]) - self.push
        return self.seen(), -abs(self.x), False, False, {"context": self.context}

    def seen(self):
        return np.array([self.x, 1.0], np.float32)

    @property
    def context(self):
        return np.array([self.push], np.float32)

    def render(self):
        return np.full((40, 60, 3), 7, np.uint8)


class Formula(Push, name="formula", id="mine/Formula-v0"):
    def expert_action(self, observation, context):
        """(push - x) / strength

        and more words."""
        return (context - observation[:1]) / self.strength

    def failed(self, episode_return):
        return episode_return < 100


class Searched(Push, name="searched", id="mine/Searched-v0"):
    search = Search(searches=1, ars=ArsSettings(iterations=2, directions=3, top=1), holds="wanted", varies={"strength": 0.5})

    @property
    def search_targets(self):
        return self.wanted


class Forgot(Push, name="forgot", id="mine/Forgot-v0"):
    search_targets = (1.0,)


class Again(Formula, name="again", id="mine/Again-v0"):
    """A subclass takes back the formula: its expert is searched for."""

    expert_action = None
'''


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A module `mine` in the working directory."""
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("mine", None)
    for name in [name for name, id in environments.NAMES.items() if id.startswith("mine/")]:
        del gym.registry[environments.NAMES.pop(name)]


def test_a_formula_of_ones_own_class_flies_with_its_options_noise_failures_and_length(mine, capsys):
    """Where no search was wanted, the point mass's pilot flew whatever environment it was."""
    flags = ["--env", "mine:mine/Formula-v0", "--episodes", "3", "--quiet", "--option", "strength=2"]
    assert collect(["--out", "a.h5", *flags, "--action-noise", "0"]) == 0
    quiet = load_episodes(Path("a.h5"))
    assert np.allclose(quiet.actions, (quiet.context - quiet.observations[:, :1]) / 2, atol=1e-6) and not quiet.rewards.any()
    assert collect(["--out", "a.h5", *flags]) == 0
    card = json.loads(Path("a.card.json").read_text())
    assert card["expert"] == {"kind": "analytic", "law": "(push - x) / strength"}
    assert (card["steps"], card["action_noise"], card["returns"]["failures"]) == (18, [0.25], 3)
    assert not Path("a.expert.npz").exists()
    capsys.readouterr()


def test_a_search_is_what_the_class_says_and_flags_come_first(mine, capsys):
    """The option that holds a context was called `targets`, and the one that varies in practice `gain`, in a file far away."""
    flags = ["--env", "mine:mine/Searched-v0", "--episodes", "2", "--quiet", "--out", "a.h5"]
    assert collect(flags) == 0
    recipe = json.loads(Path("a.card.json").read_text())["expert"]["recipe"]
    assert recipe["targets"] == [0.5, 1.0] and recipe["judge_noise"] == [0.25] and recipe["seeds"] == 1
    assert recipe["ars"] == {"iterations": 2, "directions": 3, "top": 1, "step": 0.02, "noise": 0.03}
    assert collect([*flags, "--expert-searches", "2", "--expert-iterations", "1"]) == 0
    recipe = json.loads(Path("a.card.json").read_text())["expert"]["recipe"]
    assert (recipe["seeds"], recipe["ars"]["iterations"], recipe["ars"]["directions"]) == (2, 1, 3)
    capsys.readouterr()


def test_practice_holds_a_context_and_varies_an_option_and_judging_does_not_vary(mine):
    course = _Course(ExpertRecipe("mine:mine/Searched-v0", {"strength": 2.0}, 0, targets=(0.5, 1.0)), slot=1)
    assert course.env.wanted == (1.0,) and course.steps == 6 and course.shape == (1, 2)
    policy = LinearPolicy(np.zeros(course.shape), np.zeros(2), np.ones(2))
    seen = []
    for seed in range(20):
        course.practise(policy, seed)
        seen.append(course.env.strength)
    assert min(seen) >= 1 and max(seen) <= 3 and max(seen) - min(seen) > 1
    course.judge(policy, np.arange(2), (0.0,))
    assert course.env.strength == 2.0


def test_a_class_that_forgets_something_hears_of_it_and_one_may_take_a_formula_back(mine):
    with pytest.raises(ValueError, match="which option holds"):
        recipe_for(environments.make("mine:forgot"), {}, 0)
    again = environments.make("mine:again")
    assert formula_of(again) is None and recipe_for(again, {}, 0).seeds == 3
    assert not environments.failed(environments.make("searched"), -1e9), "an environment that says nothing of failure has none"


def test_the_film_is_what_the_class_draws(mine):
    env = environments.make("mine:formula")
    env.reset(seed=1)
    episode = Episode(1, actions=[np.zeros(1, np.float32)] * 4, rewards=[0.0] * 4, contexts=[np.ones(1, np.float32)] * 4)
    assert save_film([Panel("mine:mine/Formula-v0", episode)], mine / "film.gif") is None
    with Image.open(mine / "film.gif") as film:
        assert film.n_frames > 0 and film.convert("RGB").getpixel((5, 5)) == (7, 7, 7)


PACKAGE = Path(ada_diffuser.__file__).parent
DRIVERS = [path for path in sorted(PACKAGE.rglob("*.py")) if not {"environments", "v1"} & set(path.relative_to(PACKAGE).parts)]


@pytest.mark.parametrize("path", DRIVERS, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_other_module_knows_an_environment(path):
    """By its class, its module, or its name as a value; words for people may give examples."""
    classes = {gym.spec(id).entry_point.rpartition(":") for id in environments.NAMES.values()}
    known = {word for module, _, name in classes for word in (module.rpartition(".")[2], name)}
    known |= {*environments.NAMES, *environments.NAMES.values(), "HiddenTask"}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Name(id=word) | ast.Attribute(attr=word) | ast.alias(name=word) | ast.Constant(value=str(word)):
                assert word not in known, f"{path.name}:{node.lineno} knows {word}"
            case ast.ImportFrom(module=str(word)):
                assert not known & set(word.split(".")), f"{path.name}:{node.lineno} imports from {word}"
