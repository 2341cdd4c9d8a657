"""Shared parts of the commands: `command`, which adds common options and resolves settings; option types; tables."""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast

import typer
from typer import Option

from cosfly.runtime.errors import ConfigError, InputError, nearest, plain

if TYPE_CHECKING:
    from rich.console import RenderableType

    from cosfly.pipeline.settings import RunConfig
    from cosfly.runtime.run_dir import Resume, Tally

log = logging.getLogger(__name__)

Out = Annotated[Path, Option(help="Output directory.")]
Map = Annotated[Path, Option("--map", help="Map of boxes: boxes_3d.json or step2_simplified.json.")]
MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="Map of boxes: step2_simplified.json.")]
Simplified = Annotated[Path, Option(help="Simplified map: step2_simplified.json.")]
Traces = Annotated[Path, Option(help="Drone trajectories: drone_trace.json.")]
_TREES_HELP = "Playback tree; repeat it for several."
Trees = Annotated[list[Path] | None, Option("--data", show_default="render of this run directory", help=_TREES_HELP)]
Runs = Annotated[list[Path] | None, typer.Argument(help="Run directories of `cosfly run`, all taken together.")]
Bystanders = Annotated[Path | None, Option("--others", help="Bystanders: others.json, next to path.json.")]


def _parameter(name: str, kind: Any, option: Any, default: Any = None) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])


class Short(NamedTuple):
    """An option that sets a setting. words: word of the option -> value of the setting; None: the value itself."""

    setting: str
    help: str
    kind: Any = str
    words: Mapping[str, Any] = {}
    default: str | bool = False  # in the help
    metavar: str | None = None

    def parameter(self, name: str) -> Parameter:
        names = [f"--{name}"] if self.kind is bool else []
        option = Option(*names, help=self.help, show_default=self.default, metavar=self.metavar)
        return _parameter(name, self.kind | None, option)


GLOB_HELP = "Only tracks whose folder, or one above it, matches: 'Town01/trajectory_17*/ORI', 'Town0[12]'; repeat it."
ENGINE_HELP = "Where workers run: in processes of this machine, or on the nodes of a Ray cluster."
ADDRESS_HELP = "Head node for --engine ray, or auto; none: $RAY_ADDRESS, or a cluster on this machine."
RESUME_HELP = "With existing work in the output directory: refuse, or resume if settings and inputs agree."
SHARED = {
    "seed": Short("seed", "Seed; every random choice derives from it.", int),
    "workers": Short("workers", "Worker processes; 0 takes one per core.", int),
    "engine": Short("engine", ENGINE_HELP, Literal["local", "ray"], default="local"),
    "address": Short("ray.address", ADDRESS_HELP, metavar="HOST:PORT"),
}
WORKERS = "workers engine address"
STAGE = f"town seed {WORKERS} resume"  # of a stage that processes items by workers
PLAIN = [  # options that are no settings
    _parameter("config", Path | None, Option("--config", "-c", help="YAML file with the settings of a run.")),
    _parameter("overrides", list[str] | None, Option("--set", "-s", metavar="A.B=C", help="Set a setting; repeat it.")),
    _parameter("town", str | None, Option(help="Town of the configuration whose settings and seed are used.")),
    _parameter("resume", Literal["never", "if-same"], Option(help=RESUME_HELP), "if-same"),
]


def choice_of(section: str, match: str = "flights.match", tracks: str = "flights.tracks") -> dict[str, Short]:
    """Return the options --flights and --tracks of two settings of a section."""
    words = {"clean": ["clean"], "perturbed": ["perturbed"], "both": ["clean", "perturbed"]}
    kind = Literal["clean", "perturbed", "both"]
    return {
        "flights": Short(f"{section}.{match}", GLOB_HELP, list[str], metavar="GLOB"),
        "tracks": Short(f"{section}.{tracks}", "Only this track.", kind, words, "both"),
    }


@dataclass(frozen=True)
class Job:
    """The resolved settings of a command, and how to work.

    overrides: the values of --set. given: settings that an option of the command set.
    """

    cfg: RunConfig
    overrides: Sequence[str] = ()
    resume: Resume = "if-same"
    given: Collection[str] = ()

    def call(self, place: str, *arguments: Any, **more: Any) -> Any:
        """Call a function, `module` for its `run` or `module:function`, with those of the keyword arguments seed,
        resume, workers and watch that it takes."""
        from cosfly.pipeline.command_settings import worker_options

        module, _, name = place.partition(":")
        function = getattr(importlib.import_module(module), name or "run")
        taken = signature(function).parameters.values()
        takes_all = any(one.kind is Parameter.VAR_KEYWORD for one in taken)
        options = {"seed": self.cfg.seed, "resume": self.resume, **worker_options(self.cfg)}
        names = options if takes_all else {one.name for one in taken} & options.keys()
        return function(*arguments, **{name: options[name] for name in names} | more)

    def run(self, module: str, *arguments: Any, **more: Any) -> None:
        """Run a stage, whose last argument is its output directory, and finish."""
        self.finish(self.call(module, *arguments, **more), arguments[-1])

    def tree(self, data: list[Path] | None) -> Path:
        """Return the one playback tree that is given, or that of the current run directory."""
        tree, *others = self.trees(data)
        if others:
            what, got = "this command takes one playback tree", f"{len(others) + 1}: {', '.join(map(str, data or ()))}"
            fix = "run it once for each tree; distill and release take the results of several together"
            raise InputError(what, where="--data", got=got, fix=fix)
        return tree

    def trees(self, data: list[Path] | None) -> list[Path]:
        """Return the playback trees that are given, or that of the current run directory."""
        if data:
            return data
        for candidate in (Path("render"), Path()):
            if (candidate / "manifest.json").exists() and candidate.resolve().name == "render":
                return [self.cfg.opened(candidate)]
        got = "no --data, and the current directory is not a run directory"
        raise InputError("there is no playback tree", where=Path.cwd(), got=got, fix="add --data DIR")

    def finish(self, product: Path, out: Path) -> None:
        """Print a stage's product; raise InputError where too many items failed."""
        from cosfly.runtime.run_dir import read_manifest

        typer.echo(product)
        self.check_failures({out.name: read_manifest(out).counts}, out / "failures.jsonl")

    def check_failures(self, counts_by_stage: Mapping[str, Tally], where: Path) -> None:
        """Raise InputError, after all work is done, where more items failed than the settings accept."""
        failed = {stage: dict(counts.failed) for stage, counts in counts_by_stage.items() if counts.failed}
        if sum(sum(reasons.values()) for reasons in failed.values()) > self.cfg.max_failed:
            what, expected = "some items failed; the others are done", f"at most {self.cfg.max_failed} (max_failed)"
            fix = "fix what the records name and run the same command again: only the failed ones are done again"
            raise InputError(what, where=where, got=str(failed), expected=expected, fix=fix)


class _Root(typer.core.TyperGroup):
    """The root command: explains an invalid value of an option in plain words."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            from pydantic import ValidationError

            if isinstance(error.__cause__, ValidationError):
                detail = error.__cause__.errors()[0]
                got = "" if detail["type"] == "value_error" else f", got {detail['input']!r}"
                error.message = f"{plain(error.message)}{got}"
            raise


class StageGroup(typer.core.TyperGroup):
    """A stage's command with further commands below it, which do not need the stage's own options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] in self.commands:
            for parameter in self.params:
                parameter.required = False
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_Root,
    help="Make data sets from 3D maps that teach a vision-language model to follow a person from the air.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
groups: dict[str, typer.Typer] = {}


def add_group(name: str, text: str = "") -> None:
    """Add a group of commands; one without a text is a command itself, the first that is added."""
    kind: dict[str, Any] = {"cls": StageGroup, "invoke_without_command": True}
    groups[name] = typer.Typer(**({"help": text, "no_args_is_help": True} if text else kind))
    app.add_typer(groups[name], name=name)


Command = Callable[..., None]


def command(example: str, sections: str = "", names: str = "", **short: Short) -> Callable[[Command], Command]:
    """Add a function as the command of its name, and resolve its settings; the function takes a Job first.

    The command of a group does nothing where a command below it is called.

    Args:
        example: A command line, with the group's name if the command is in one.
        sections: The sections of the settings that the command uses, separated by blanks; `*` for all.
        names: Common options, of PLAIN and SHARED, separated by blanks; `config` and `overrides` are always there.
        short: Further options that set a setting; the function does not get them.
    """
    listed = {"config", "overrides", *names.split()}

    def add(function: Command) -> Command:
        _, *own = signature(function, eval_str=True).parameters.values()
        taken = [one.name for one in own]
        shorts = short | {name: one for name, one in SHARED.items() if name in listed and name not in taken}

        @functools.wraps(function)
        def called(context: typer.Context, **given: Any) -> None:
            if context.invoked_subcommand is not None:
                return
            extra = {}
            for name, one in shorts.items():
                if (value := given[name]) not in (None, []):
                    extra[one.setting] = one.words.get(value, value) if isinstance(value, str) else value
            cfg = resolve(given["config"], given["overrides"], extra, None if sections == "*" else sections.split())
            cfg = _town_of(cfg, given["town"]) if "town" in listed else cfg
            job = Job(cfg, given["overrides"] or (), given.get("resume", "if-same"), extra)
            function(job, **{name: _opened(cfg, given[name]) for name in taken})

        called.__signature__ = Signature([  # type: ignore[attr-defined]
            Parameter("context", Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context),
            *(one.replace(kind=Parameter.KEYWORD_ONLY) for one in own),
            *(one.parameter(name) for name, one in shorts.items()),
            *(one for one in PLAIN if one.name in listed and one.name not in taken),
        ])  # fmt: skip
        called.__annotations__ = {}
        group = groups.get(example.split()[1], app)
        if group.info.invoke_without_command is True and group.registered_callback is None:
            return group.callback(epilog=example)(called)
        return group.command(function.__name__.replace("_", "-"), epilog=example)(called)

    return add


def _opened(cfg: RunConfig, given: Any) -> Any:
    """Return a path, or a list of paths, whose links are followed if the settings say so."""
    if isinstance(given, list):
        return [_opened(cfg, one) for one in given]
    return cfg.opened(given) if isinstance(given, Path) else given


def resolve(
    config: Path | None,
    overrides: Sequence[str] | None,
    given: Mapping[str, Any] = {},
    sections: Sequence[str] | None = None,
) -> RunConfig:
    """Resolve settings: defaults, then the file, then --set, then options.

    Args:
        given: Setting -> value of its option.
        sections: The sections that the command uses; None for all. The others are neither loaded nor checked.
    """
    from cosfly.pipeline.command_settings import SECTIONS, CommandConfig, config_with
    from cosfly.runtime.config import apply_overrides, build, config_file, read_yaml
    from cosfly.runtime.json_io import dump_json

    # As YAML, which JSON is: a colon in a text is only a colon.
    extra = [f"{name}={dump_json(str(value) if isinstance(value, Path) else value)}" for name, value in given.items()]
    assigned, file = [*(overrides or []), *extra], config_file(config)
    source = " with ".join([*([str(file)] if file else []), *(["--set"] if assigned else [])])
    data = apply_overrides(read_yaml(file) if file else {}, assigned)
    known = {*CommandConfig.model_fields, *(sections or ())}
    names = {word.partition("=")[0].partition(".")[0] for word in assigned}
    if sections is not None and not data.get("towns") and names <= known:
        used = {name: value for name, value in data.items() if name in known or name not in SECTIONS}
        with contextlib.suppress(ConfigError):  # the model of all settings names the nearest one
            return cast("RunConfig", build(config_with(sections), used, source))
    from cosfly.pipeline.settings import RunConfig

    return build(RunConfig, data, source)


def _town_of(cfg: RunConfig, name: str | None) -> RunConfig:
    """Return the settings of a town; without a name, the settings that all towns share."""
    names = ", ".join(cfg.towns)
    if name in cfg.towns:
        return cfg.of_town(name)
    if name is not None:
        what, expected = f"there is no such town{nearest(name, cfg.towns)}", names or "a configuration with towns"
        raise ConfigError(what, where="--town", got=name, expected=expected)
    if cfg.towns:
        log.warning("%s has towns; choose one with --town, of %s: the shared settings are used", cfg.name, names)
    return cfg


def print_lines(lines: Iterable[str]) -> None:
    """Print lines of a command's answer, however long."""
    from cosfly.runtime.console import answer_console

    for line in lines:
        answer_console.print(line, soft_wrap=True)


def print_table(
    head: Sequence[str],
    rows: Iterable[Sequence[RenderableType]],
    title: str | None = None,
    left: Sequence[str] = (),
    *,
    is_answer: bool = False,
    **style: Any,
) -> None:
    """Print a table.

    Args:
        head: Names of the columns, or none; `left` and the first column are left-aligned.
        is_answer: It is the command's answer, on stdout; else it goes to stderr, as log lines do.
    """
    from rich.table import Table

    from cosfly.runtime.console import answer_console, console

    style = style if head else {"box": None}
    table = Table(title=title, title_justify="left", show_header=bool(head), **style)
    for number, name in enumerate(head):
        table.add_column(name, justify="right" if number and name not in left else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    (answer_console if is_answer else console).print(table)


def print_checks(checks: Iterable[Any], title: str | None = None, *, is_answer: bool = False) -> None:
    """Print checks with name, state and detail; exit with 1 where something required does not work."""
    from rich.text import Text

    colors = {"ok": "green", "optional": "yellow", "warning": "yellow", "missing": "red", "unusable": "red"}
    checks = list(checks)
    rows = [(check.name, Text(check.state, colors[check.state]), check.detail) for check in checks]
    print_table((), rows, title, is_answer=is_answer)
    if any(colors[check.state] == "red" for check in checks):
        raise typer.Exit(1)
