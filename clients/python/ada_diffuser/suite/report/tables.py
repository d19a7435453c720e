"""Tables of a suite in Markdown, each with a caption that says its scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import itemgetter

from ada_diffuser.rollout.report import rows_of
from ada_diffuser.suite.report.results import Estimate, Group, Results, own_error, probe_error
from ada_diffuser.suite.suite import Method, Mode, Suite

#: Standard errors from which on a difference is called one.
CLEAR = 3.0
#: What was not measured.
NOTHING = "-"


def number(value: float, size: float | None = None) -> str:
    """In as many digits as a reader wants of a number of this size."""
    size = abs(value) if size is None else size
    return f"{value:.1f}" if size >= 10 else f"{value:.2f}" if size >= 1 else f"{value:.3f}"


def estimate(value: Estimate | None) -> str:
    """`-18.7 ± 0.3 ± 0.4`: over training seeds, over episodes where there is such a thing."""
    if value is None:
        return NOTHING
    errors = [value.over_seeds] if value.over_episodes is None else [value.over_seeds, value.over_episodes]
    size = max(abs(value.mean), *(error or 0.0 for error in errors))
    return " ± ".join([number(value.mean, size), *(NOTHING if error is None else number(error, size) for error in errors)])


def scale(results: Results) -> str:
    """How much was done, and where."""
    suite = results.suite
    seeds = ", ".join(map(str, suite.seeds))
    data = {}
    for file in results.files:
        data[file["environment"]] = (
            f"{file['environment']} {_count(file['data']['episodes'])} episodes, {_count(file['data']['steps'])} steps"
        )
    machines = dict.fromkeys(
        f"{one['cpu']}, {one['vectors']}, {one['cores']} cores, {one['cells_at_once']} cells at a time"
        for one in (file["machine"] for file in results.files)
    )
    there = (
        "" if results.there == results.wanted else f" {results.there} of {results.wanted} measurements are there; the others are {NOTHING}."
    )
    if results.stale:
        there += f" {results.stale} were measured before the suite, a recipe or the data was changed; `ada-suite run` does them again."
    budget = "".join(
        f" All methods of {name} have `{'`, `'.join(suite.environments[name].keys)}`."
        for name in results.environments
        if suite.environments[name].keys
    )
    return (
        f"Training seeds {seeds}; {suite.episodes} episodes each, environment seeds from {suite.first_seed} on, the same for all methods. "
        f"Data: {'; '.join(data.values())}.{budget} Machine: {'; '.join(machines)}.{there}"
    )


def returns(results: Results, mode: Mode) -> str:
    """Methods x environments, with the paper's numbers beside."""
    suite = results.suite

    def cell(group: Group | None) -> str:
        if group is None:
            return NOTHING
        few = "" if len(group.files) == len(suite.seeds) else f", {len(group.files)} of {len(suite.seeds)} seeds"
        said = "".join(f"<br>{name} {estimate(one)}" for name, one in group.measures.items())
        return f"{estimate(group.estimate)}{said}<br>{number(group.median)}, {group.failures} of {group.returns.size} failed{few}"

    heads, rows = ["method"], [[method.name] for method in results.methods]
    for environment in results.environments:
        heads.append(environment)
        for row, method in zip(rows, results.methods, strict=True):
            row.append(cell(results.group(environment, method.name, mode)))
        if paper := suite.paper.get(environment):
            heads.append("the paper's")
            for row, method in zip(rows, results.methods, strict=True):
                row.append(str(paper.get(method.name, NOTHING)))
    paper_told = (
        " The paper's numbers come of other data and experts: what can be compared is the order."
        if len(heads) > len(results.environments) + 1
        else ""
    )
    caption = (
        f"Return, {mode}: mean over {_seeds(results)} and {suite.episodes} episodes ± standard error over training seeds ± over episodes; "
        f"below it the median, and how many failed.{_said(results)}{paper_told}"
    )
    return _captioned(caption, heads, rows)


def _said(results: Results) -> str:
    """What stands between return and median."""
    names = dict.fromkeys(name for group in results.groups.values() for name in group.measures)
    score = " (score: 0 and 100 are the random and the expert return of D4RL)" if "score" in names else ""
    return f" Between them what an environment says of its episodes, with the same two errors: {', '.join(names)}{score}." if names else ""


def differences(results: Results, mode: Mode) -> str | None:
    """What each method earns more than the reference, episode by episode; None without a reference that was measured."""
    reference = results.suite.reference
    others = [method for method in results.methods if method.name != reference]
    if reference is None or not any(results.group(name, reference, mode) for name in results.environments):
        return None

    def cell(environment: str, method: Method) -> str:
        mine, theirs = results.group(environment, method.name, mode), results.group(environment, reference, mode)
        return estimate(mine.less(theirs)) if mine and theirs else NOTHING

    rows = [[method.name, *(cell(name, method) for name in results.environments)] for method in others]
    caption = (
        f"Return less that of {reference}, {mode}, seed by training seed and episode by episode: {_seeds(results)}, "
        f"{results.suite.episodes} episodes; ± standard error of the difference over training seeds ± over episodes."
    )
    return _captioned(caption, ["method", *results.environments], rows)


def order(results: Results, mode: Mode) -> str | None:
    """The same in words: who is above the reference and who below it, and where the paper has it otherwise; None as for the differences."""
    reference = results.suite.reference
    lines = []
    for environment in results.environments:
        theirs = results.group(environment, reference, mode) if reference else None
        if theirs is None:
            continue
        mine = {method.name: results.group(environment, method.name, mode) for method in results.methods if method.name != reference}
        gaps = {name: gap for name, group in mine.items() if group and (gap := group.less(theirs))}
        sides: dict[str, list[str]] = {"above": [], "not told apart from": [], "below": []}
        for name, gap in gaps.items():
            side = "above" if gap.in_errors > CLEAR else "below" if gap.in_errors < -CLEAR else "not told apart from"
            worse, of = mine[name].worse_than(theirs)
            less = f"; less in {worse} of {of} episodes" if side == "not told apart from" else ""
            seeds = of // results.suite.episodes
            few = f"; {seeds} of {_seeds(results)}" if seeds < len(results.suite.seeds) else ""
            sides[side].append(f"{name} ({gap.mean:+.1f}; {abs(gap.in_errors):.1f}{less}{few})")
        told = [f"{side} {', '.join(names)}" for side, names in sides.items() if names]
        if told:
            lines.append(f"- {environment}: {'; '.join(told)}.{_against_the_paper(results.suite, environment, gaps)}")
    if not lines:
        return None
    caption = (
        f"In words, {mode}: who is above {reference}, who cannot be told apart from it (within {CLEAR:.0f} standard errors) and who is "
        "below; in brackets by how much, and how many standard errors of the difference that is, those over training seeds and over "
        "episodes pooled. A single episode that flies off makes a mean and its errors: so it is also told in how many of them less was "
        "earned."
    )
    return f"*{caption}*\n\n" + "\n".join(lines)


def _against_the_paper(suite: Suite, environment: str, gaps: Mapping[str, Estimate]) -> str:
    """Which of them the paper has on the other side of the reference, or on a side where here is none."""
    paper = suite.paper.get(environment, {})
    base = paper.get(suite.reference or "")
    if not isinstance(base, int | float):
        return ""
    known = {name: float(value) - base for name in gaps if isinstance(value := paper.get(name), int | float)}
    if not known:
        return ""
    other = [name for name, gap in known.items() if gaps[name].in_errors * gap < 0 and abs(gaps[name].in_errors) > CLEAR]
    unclear = [name for name in known if abs(gaps[name].in_errors) <= CLEAR]
    said = [f"The other way round in the paper: {', '.join(other)}."] if other else []
    said += [f"Apart in the paper and not here: {', '.join(unclear)}."] if unclear else []
    return f" **{' '.join(said)}**" if said else " As in the paper."


def cost(results: Results) -> str:
    """What training and an act cost."""
    heads = ["environment", "method", "parameters", "training steps", "training, s"]
    heads += [f"{what}, {mode}" for mode in results.modes for what in ("evaluations an act", "p50 of an act, ms")]
    rows = []
    for environment, method, group in _shown(results):
        file = group.files[0]
        row = [environment, method.name, f"{file['parameters']:,}", " + ".join(f"{steps:,}" for steps in file["steps"].values())]
        row.append(estimate(group.each(itemgetter("train_seconds"))))
        for mode in results.modes:
            there = results.group(environment, method.name, mode)
            row += [estimate(there.each(itemgetter(name)) if there else None) for name in ("evaluations_per_act", "p50_ms")]
        rows.append(row)
    caption = (
        f"Cost: mean over {_seeds(results)} ± standard error over them. A training's wall time is of one core; the time of an act is "
        "that of one session alone over gRPC on loopback, beside the other cells at work."
    )
    return _captioned(caption, heads, rows)


def knowledge(results: Results) -> str | None:
    """What the latents tell of the context; None where nothing was probed or read."""
    numbers: list[tuple[str, Callable[[Group], Estimate | None]]] = [
        ("held-out data", lambda group: group.each(probe_error)),
        ("ceiling there", lambda group: group.each(lambda file: probe_error(file, "ceiling"))),
        ("own episodes", lambda group: group.each(own_error)),
        ("Rand index", lambda group: group.each(lambda file: file["readout"] and file["readout"]["adjusted_rand_index"])),
        ("purity", lambda group: group.each(lambda file: file["readout"] and file["readout"]["purity"])),
    ]
    rows = []
    for environment, method, group in _shown(results):
        found = [estimate(number(group)) for _, number in numbers]
        if any(text != NOTHING for text in found):
            rows.append([environment, method.name, group.files[0]["mode"], *found])
    if not rows:
        return None
    caption = (
        f"What the latents tell of the true context: {_seeds(results)} ± standard error over them; squared error of a linear map over the "
        f"context's variance, 0 knows all and 1 nothing; on data held out of training, and on the {results.suite.episodes} episodes that "
        "were played (fitted on one half of them); groups by k-means against bins of the context."
    )
    return _captioned(caption, ["environment", "method", "mode", *(name for name, _ in numbers)], rows)


def _shown(results: Results) -> list[tuple[str, Method, Group]]:
    """By environment and method, streaming where there is that."""
    pairs = [(environment, method) for environment in results.environments for method in results.methods]
    return [(environment, method, group) for environment, method in pairs if (group := results.any_mode(environment, method.name))]


def _seeds(results: Results) -> str:
    count = len(results.suite.seeds)
    return f"{count} training seed{'s' if count > 1 else ''}"


def _count(value: int | None) -> str:
    return "an unknown number of" if value is None else f"{value:,}"


def _captioned(caption: str, heads: list[str], rows: list[list[str]]) -> str:
    return f"*{caption}*\n\n{rows_of(heads, rows)}"
