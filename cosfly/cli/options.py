"""What the commands share: `takes`, which gives them their common options; types of options; tables."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from cosfly.runtime.errors import ConfigError, InputError, nearest

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from cosfly.pipeline.settings import RunConfig
    from cosfly.runtime.run_dir import Resume, Tally

log = logging.getLogger(__name__)

Out = Annotated[Path, Option(help="Output folder.")]
Map = Annotated[Path, Option("--map", help="Boxes: boxes_3d.json or step2_simplified.json.")]
Trees = Annotated[
    list[Path] | None,
    Option("--data", show_default="that of this run folder", help="Playback tree; repeat it where several are taken."),
]


# --- the decorator ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sets:
    """Stands beside an option that is short for a setting. words: an option's word -> the setting's value."""

    path: str
    words: Mapping[str, Any] = field(default_factory=dict)

    def value_of(self, given: Any) -> Any:
        return self.words.get(given, given) if isinstance(given, str) else given


TrackOption = Literal["clean", "perturbed", "both"]
TRACKS = {"clean": ["clean"], "perturbed": ["perturbed"], "both": ["clean", "perturbed"]}
GLOB_HELP = "Only flights whose folder, or one above it, matches: 'Town01/trajectory_17*/ORI', 'Town0[12]'; repeat it."
TRACKS_HELP = "Only flights of this track."
RESUME_HELP = "A folder that holds work: refuse it, or continue if settings and inputs are the same."
ENGINE_HELP = "Where the workers are: processes of this machine, or on the nodes of a Ray cluster."
ADDRESS_HELP = "Head node of --engine ray, or auto; none: $RAY_ADDRESS, or a cluster of this machine."
SHARED: dict[str, tuple[Any, Any, Any]] = {  # name -> type, option and default, in the order of the help
    "flights": (list[str] | None, Option(metavar="GLOB", help=GLOB_HELP), None),
    "tracks": (TrackOption | None, Option(show_default="both", help=TRACKS_HELP), None),
    "config": (Path | None, Option("--config", "-c", help="YAML file with the settings of a run."), None),
    "overrides": (
        list[str] | None,
        Option("--set", "-s", metavar="A.B=C", help="Override a setting; repeat it."),
        None,
    ),
    "town": (
        str | None,
        Option(help="A town of the configuration: its settings and seed."),
        None,
    ),
    "seed": (int | None, Option(help="Seed; every random choice derives from it."), None),
    "workers": (int | None, Option(help="Worker processes; 0 takes one per core."), None),
    "engine": (Literal["local", "ray"] | None, Option(show_default="local", help=ENGINE_HELP), None),
    "address": (str | None, Option(metavar="HOST:PORT", help=ADDRESS_HELP), None),
    "resume": (Literal["never", "if-same"], Option(help=RESUME_HELP), "if-same"),
}
SET_BY = {
    "flights": Sets("match"),
    "tracks": Sets("tracks", TRACKS),
    "address": Sets("ray.address"),
    **{name: Sets(name) for name in ("seed", "workers", "engine")},
}
WORKERS = ("workers", "engine", "address")
STAGE = ("town", "seed", *WORKERS, "resume")  # of a stage that does items by workers


@dataclass(frozen=True)
class Job:
    """What the common options of a command say: the settings as they are resolved, and how to work. overrides: --set,
    as it was told."""

    cfg: RunConfig
    overrides: Sequence[str] = ()
    resume: Resume = "if-same"

    @property
    def worker_options(self) -> dict[str, Any]:
        """How a stage works, whatever it makes: arguments that all stages with workers take."""
        from cosfly.pipeline.settings import worker_options

        return worker_options(self.cfg) | {"resume": self.resume}

    def tree(self, data: list[Path] | None) -> Path:
        """Return the playback tree: given, or that of the run folder one stands in; InputError where there is not
        one."""
        trees = self.trees(data)
        if len(trees) > 1:
            what, got = "this command takes one playback tree", f"{len(trees)}: {', '.join(map(str, trees))}"
            fix = "run it once for each tree; distill and release take the results of several together"
            raise InputError(what, where="--data", got=got, fix=fix)
        return trees[0]

    def trees(self, data: list[Path] | None) -> list[Path]:
        """Return the playback trees: given, or that of the run folder one stands in."""
        if data:
            return data
        for candidate in (Path("render"), Path()):
            if (candidate / "manifest.json").exists() and candidate.resolve().name == "render":
                return [self.cfg.opened(candidate)]
        got = "no --data, and this is not a run folder"
        raise InputError("no playback tree", where=Path.cwd(), got=got, fix="give --data DIR")

    def finish(self, product: Path, out: Path) -> None:
        """Name a stage's product. Too much that failed is an error: whoever calls the next stage must know."""
        from cosfly.runtime.run_dir import read_manifest

        typer.echo(product)
        self.check_failures({out.name: read_manifest(out).counts}, out / "failures.jsonl")

    def check_failures(self, counts_by_stage: Mapping[str, Tally], where: Path) -> None:
        """Raise InputError, after everything was done, where more items failed than the settings accept."""
        failed = {stage: dict(counts.failed) for stage, counts in counts_by_stage.items() if counts.failed}
        if sum(sum(reasons.values()) for reasons in failed.values()) > self.cfg.max_failed:
            what, expected = "some items failed; the others are done", f"at most {self.cfg.max_failed} (max_failed)"
            fix = "mend what the records name and run the same command again: only the failed ones are done again"
            raise InputError(what, where=where, got=str(failed), expected=expected, fix=fix)


def takes(*names: str, flights: str | None = None) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a command the options of a configuration and the named ones of SHARED; its function takes a Job first.

    An option of its own with `Sets` beside its type is a setting; one that is called as a shared one stands for it.
    Of a command with further commands below it, nothing is done where one of those is called.

    Args:
        flights: section of the settings that --flights and --tracks choose in; None: the command has neither.
    """
    names = ("config", "overrides", *names, *(("flights", "tracks") if flights else ()))

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        _, *own = signature(function, eval_str=True).parameters.values()
        own = [one.replace(kind=Parameter.KEYWORD_ONLY) for one in own]
        taken = {one.name for one in own}
        shared = {name: option for name, option in SHARED.items() if name in names and name not in taken}
        sets = {
            one.name: found
            for one in own
            for found in getattr(one.annotation, "__metadata__", ())
            if isinstance(found, Sets)
        }
        for name in shared.keys() & SET_BY.keys():
            is_choice = name in ("flights", "tracks")
            sets[name] = replace(SET_BY[name], path=f"{flights}.{SET_BY[name].path}") if is_choice else SET_BY[name]

        @functools.wraps(function)
        def command(context: typer.Context, **given: Any) -> None:
            if context.invoked_subcommand is not None:
                return
            chosen = {name: one for name, one in sets.items() if given[name] not in (None, [])}
            extra = {one.path: one.value_of(given[name]) for name, one in chosen.items()}
            worker_options = {name: given[name] for name in ("resume",) if name in given}
            cfg = resolve(given["config"], given.get("overrides"), extra)
            town = _town_of(cfg, given["town"]) if "town" in shared else cfg
            job = Job(town, given.get("overrides") or (), **worker_options)
            function(job, **{name: _opened(job.cfg, given[name]) for name in taken})

        parameters = [
            Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])
            for name, (kind, option, default) in shared.items()
        ]
        context = Parameter("context", Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)
        command.__signature__ = Signature([context, *own, *parameters])  # type: ignore[attr-defined]
        command.__annotations__ = {}
        return command

    return decorate


def _opened(cfg: RunConfig, given: Any) -> Any:
    """Return a path, or a list of them, as the settings have links followed; anything else as it is."""
    if isinstance(given, list):
        return [_opened(cfg, one) for one in given]
    return cfg.opened(given) if isinstance(given, Path) else given


class StageGroup(typer.core.TyperGroup):
    """A stage's command that has further commands below it: what the stage needs is not needed by those."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] in self.commands:
            for parameter in self.params:
                parameter.required = False
        return super().parse_args(ctx, args)


def stage_group(text: str) -> typer.Typer:
    """Make the group of a stage, whose callback is the stage itself."""
    return typer.Typer(cls=StageGroup, invoke_without_command=True, help=text)


# --- settings and inputs ----------------------------------------------------------------------------------------------


def resolve(config: Path | None, overrides: list[str] | None, given: Mapping[str, Any] = {}) -> RunConfig:
    """Resolve the settings: defaults, file, --set, then `given`: what options say of single settings."""
    from cosfly.pipeline.settings import RunConfig
    from cosfly.runtime.config import config_file, load
    from cosfly.runtime.json_io import dump_json

    # As YAML, which JSON is: a colon in a text is only a colon.
    extra = [f"{name}={dump_json(str(value) if isinstance(value, Path) else value)}" for name, value in given.items()]
    return load(RunConfig, config_file(config), [*(overrides or []), *extra])


def _town_of(cfg: RunConfig, name: str | None) -> RunConfig:
    """Return the settings of a town; where none is named, what towns have in common, which is none of them."""
    names = ", ".join(cfg.towns)
    if name is None:
        if cfg.towns:
            what = "%s has towns; these are the settings and the seed of none. As `cosfly run` makes one: --town, of %s"
            log.warning(what, cfg.name, names)
        return cfg
    if name not in cfg.towns:
        what, expected = f"there is no such town{nearest(name, cfg.towns)}", names or "a configuration with towns"
        raise ConfigError(what, where="--town", got=name, expected=expected)
    return cfg.of_town(name)


# --- on the terminal --------------------------------------------------------------------------------------------------


def tell_table(
    console: Console,
    head: Sequence[str],
    rows: Iterable[Sequence[RenderableType]],
    *,
    title: str | None = None,
    left: Sequence[str] = (),
    **style: Any,
) -> None:
    """Print a table. head: names of the columns, or none; all stand right but the first column and `left`."""
    from rich.table import Table

    style = style if head else {"box": None}
    table = Table(title=title, title_justify="left", show_header=bool(head), **style)
    for number, name in enumerate(head):
        table.add_column(name, justify="right" if number and name not in left else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def tell_checks(checks: Sequence[Any], console: Console, title: str | None = None) -> None:
    """Print what was examined: name, state, detail; exit 1 where something that is needed does not work."""
    from rich.text import Text

    colors = {"ok": "green", "optional": "yellow", "warning": "yellow", "missing": "red", "unusable": "red"}
    rows = [(check.name, Text(check.state, colors[check.state]), check.detail) for check in checks]
    tell_table(console, (), rows, title=title)
    if any(colors[check.state] == "red" for check in checks):
        raise typer.Exit(1)
