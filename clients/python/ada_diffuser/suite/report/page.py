"""report/README.md: the suites one after the other, tables first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ada_diffuser.commands.outputs import save_text
from ada_diffuser.suite.report import figures, tables
from ada_diffuser.suite.report.results import Results
from ada_diffuser.suite.suite import Suite

_HEAD = """\
# What was measured

`ada-suite report` writes this page and its pictures from the finished cells, small JSON files that `ada-suite run` leaves; whatever is
changed here is lost the next time. [clients/python](../clients/python/README.md#suites) explains both.
"""

#: Draws one picture; False where there is nothing to draw.
Draw = Callable[[Results, Path], bool]


def write(suites: Sequence[Suite], cells: Path, out: Path, *, only_begun: bool) -> list[Path]:
    """Writes the page and its pictures; returns their paths. The same cells give the same bytes.

    ValueError where no suite has a finished cell; with `only_begun` those that have none are left out.
    """
    loaded = [Results.load(suite, cells) for suite in suites]
    shown = [results for results in loaded if results.there or not only_begun]
    if not any(results.there for results in shown):
        raise ValueError(f"there is no finished cell in {cells}: `ada-suite run SUITE.toml` makes them")
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    text = "\n".join([_HEAD, *(_section(results, out, written) for results in shown)])
    save_text(text, out / "README.md")
    return [out / "README.md", *written]


def _section(results: Results, out: Path, written: list[Path]) -> str:
    suite = results.suite
    if not results.there:
        return f"## {suite.title}\n\nSuite `{suite.name}`: nothing is finished.\n"
    parts = [f"## {suite.title}", f"Suite `{suite.name}`. {tables.scale(results)}"]
    for mode in results.modes:
        parts += [tables.returns(results, mode), tables.differences(results, mode), tables.order(results, mode)]
    parts += [tables.cost(results), tables.knowledge(results)]
    for name, title, draw in _pictures(results):
        path = out / f"{suite.name}-{name}.png"
        if draw(results, path):
            written.append(path)
            parts.append(f"![{name}]({path.name})\n*{title}*")
    return "\n\n".join(part for part in parts if part) + "\n"


def _pictures(results: Results) -> list[tuple[str, str, Draw]]:
    """Name, title, and what draws it."""
    count = f"{len(results.suite.seeds)} training seeds, {results.suite.episodes} episodes"
    found: list[tuple[str, str, Draw]] = [
        (
            "returns",
            f"Returns: {count}; bars are standard errors over training seeds, dots single ones, stars the paper's numbers",
            figures.returns,
        ),
        ("probe", f"Error of a linear probe by the tokens that it is shown: {count}; dashed the ceiling of the raw tokens", figures.probe),
        ("latents", "Latents on their two principal axes, coloured by the context: acts of the first training seed", figures.latents),
        ("plans", "How far plans are from what happened, by the step ahead; and plans of one episode beside it", figures.plans),
        ("cost", f"What is earned for how many evaluations an act: {count}", figures.cost),
    ]
    varied = dict.fromkeys((one.family, one.varied[0]) for one in results.methods if one.varied)
    for family, key in varied:
        title = f"{family}: return and error of the latent by `{key}`; {count}; bars are standard errors over training seeds"
        name = f"{family}-{key}"
        found.append((name, title, lambda results, path, family=family, key=key: figures.varied(results, family, key, path)))
    return found
