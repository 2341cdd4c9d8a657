"""The common parts of the commands: `command` adds a command and resolves its settings; a Job runs it; tables."""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast

import typer
from typer import Option

from cosfly.runtime.errors import ConfigError, InputError, counts_text, nearest

if TYPE_CHECKING:
    from rich.console import RenderableType

    from cosfly.pipeline.settings import RunConfig
    from cosfly.runtime.run_dir import Tally

log = logging.getLogger(__name__)

Out = Annotated[Path, Option(help="Output directory.")]
Map = Annotated[Path, Option("--map", help="Map of boxes: boxes_3d.json or step2_simplified.json.")]
MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="Map of boxes: step2_simplified.json.")]
Simplified = Annotated[Path, Option(help="Simplified map: step2_simplified.json.")]
Traces = Annotated[Path, Option(help="Drone trajectories: drone_trace.json.")]
_TREES_HELP = "Playback tree; repeat it for several."
Trees = Annotated[list[Path] | None, Option("--data", help=_TREES_HELP)]
Runs = Annotated[list[Path] | None, typer.Argument(help="Run directories of `cosfly run`, all taken together.")]
Bystanders = Annotated[Path | None, Option("--others", help="Bystanders: others.json, next to path.json.")]


def each_run(runs: list[Path] | None) -> list[Path]:
    """Return run directories of one map each: those of its towns for a run of several towns."""
    from cosfly.formats.places import folder_name
    from cosfly.runtime.config import read_yaml

    folders = list[Path]()
    for run in runs or []:
        towns = read_yaml(run / "run.yaml").get("towns") if (run / "run.yaml").is_file() else None
        names = map(str, towns) if isinstance(towns, dict) else ()
        folders += [run / folder_name(name) for name in names] or [run]
    return folders


def _parameter(name: str, kind: Any, option: Any) -> Parameter:
    return Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, option])


class SettingOption(NamedTuple):
    """An option that sets a setting."""

    setting: str  # with its sections, such as `plan.altitude_max_m`
    help: str
    kind: Any = str  # type of the option
    values: Mapping[str, Any] = {}  # text of the option: value of the setting; other texts are the value themselves
    default: str | bool = False  # shown in the help
    metavar: str | None = None

    def parameter(self, name: str) -> Parameter:
        names = [f"--{name}"] if self.kind is bool else []  # without --no-NAME
        option = Option(*names, help=self.help, show_default=self.default, metavar=self.metavar)
        return _parameter(name, self.kind | None, option)


GLOB_HELP = "Only tracks whose folder, or one above it, matches: 'Town01/trajectory_17*/ORI', 'Town0[12]'; repeat it."
ENGINE_HELP = "Where workers run: in processes of this machine, or on the nodes of a Ray cluster."
ADDRESS_HELP = "Head node for --engine ray, or auto; by default $RAY_ADDRESS, or a cluster on this machine."
CONFIG_HELP = "Settings: a YAML file, a shipped configuration, or a run directory."
COMMON_SETTINGS = {
    "seed": SettingOption("seed", "Seed; every random choice derives from it.", int),
    "workers": SettingOption("workers", "Worker processes; 0: one per core, or with Ray as many as fit.", int),
    "engine": SettingOption("engine", ENGINE_HELP, Literal["local", "ray"], default="local"),
    "address": SettingOption("ray.address", ADDRESS_HELP, metavar="HOST:PORT"),
}
COMMON_OPTIONS = [  # these set no setting
    _parameter("config", Path | None, Option("--config", "-c", help=CONFIG_HELP)),
    _parameter("overrides", list[str] | None, Option("--set", "-s", metavar="A.B=C", help="Set a setting; repeat it.")),
    _parameter("town", str | None, Option(help="Town of the configuration whose settings and seed are used.")),
]
# Names of common options, for `command`.
WORKERS = "workers engine address"
STAGE = f"town seed {WORKERS}"  # of a stage whose items workers process


def track_options(
    section: str, match: str = "flights.match", tracks: str = "flights.tracks"
) -> dict[str, SettingOption]:
    """Return the options --flights and --tracks, which set two settings of a section."""
    values = {"clean": ["clean"], "perturbed": ["perturbed"], "both": ["clean", "perturbed"]}
    kind = Literal["clean", "perturbed", "both"]
    return {
        "flights": SettingOption(f"{section}.{match}", GLOB_HELP, list[str], metavar="GLOB"),
        "tracks": SettingOption(f"{section}.{tracks}", "Only this track.", kind, values, "both"),
    }


@dataclass(frozen=True)
class Job:
    """The resolved settings of a command."""

    cfg: RunConfig

    def call(self, target: str, *arguments: Any, **keywords: Any) -> Any:
        """Import a function and call it with the arguments, and with the common arguments that it takes.

        The common arguments are `seed`, `workers` and `watch`. The function gets each of them that is in its
        signature, or all if it takes any keyword; `keywords` replace them. A command imports its stage by this call,
        so that the help of the command line loads no stage.

        Args:
            target: `module:function`, or `module` for its `run`.
        """
        from cosfly.pipeline.command_settings import worker_options

        module, _, name = target.partition(":")
        function = getattr(importlib.import_module(module), name or "run")
        common = {"seed": self.cfg.seed, **worker_options(self.cfg)}
        parameters = signature(function).parameters
        if not any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters.values()):
            common = {key: value for key, value in common.items() if key in parameters}
        return function(*arguments, **common | keywords)

    def run(self, target: str, *arguments: Any, **keywords: Any) -> None:
        """Run a stage, whose last argument is its output directory, and finish."""
        self.finish(self.call(target, *arguments, **keywords), arguments[-1])

    def tree(self, data: list[Path] | None) -> Path:
        """Return the one playback tree of --data."""
        trees = self.trees(data)
        if len(trees) > 1:
            what = "the command takes one directory of rendered tracks, but --data names several"
            fix = "run the command once for each directory"
            raise InputError(what, where="--data", got=f"{len(trees)}: {', '.join(map(str, trees))}", fix=fix)
        return trees[0]

    def trees(self, data: list[Path] | None) -> list[Path]:
        """Return the playback trees of --data."""
        if not data:
            raise InputError("--data is missing", fix="add --data DIR with the directory of rendered tracks")
        return data

    def finish(self, product: Path, out: Path) -> None:
        """Print a stage's product; raise InputError if too many items failed."""
        from cosfly.runtime.run_dir import read_manifest

        typer.echo(product)
        manifest = read_manifest(out)
        self.check_failures({manifest.stage: manifest.counts}, out / "failures.jsonl")

    def check_failures(self, counts_by_stage: Mapping[str, Tally], where: Path) -> None:
        """Raise InputError if more items failed than the settings accept; all work is done before."""
        failed = {stage: counts.failed for stage, counts in counts_by_stage.items() if counts.failed}
        num_failed = sum(counts.total() for counts in failed.values())
        if num_failed > self.cfg.max_failed:
            fix = "remove the causes that failures.jsonl names, and run the command again for the failed items"
            if any(stage.endswith("caption") for stage in failed):
                fix += "; for refused captions see quarantine.jsonl, and run cosfly caption --retry-failed"
            raise InputError(
                "some items failed; all others are complete",
                where=where,
                got="; ".join(f"{stage}: {counts_text(counts)}" for stage, counts in failed.items()),
                expected=f"at most {self.cfg.max_failed} failed items",
                fix=f"{fix}; to accept them, pass --set max_failed={num_failed}",
            )


class StageGroup(typer.core.TyperGroup):
    """The command of a stage, with subcommands that do not need the stage's own options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] in self.commands:
            for parameter in self.params:
                parameter.required = False
        return super().parse_args(ctx, args)


app = typer.Typer(
    help="Make data sets from 3D maps that teach a vision-language model to follow a person from the air.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
groups: dict[str, typer.Typer] = {}


def add_group(name: str, text: str = "") -> None:
    """Add a group of commands. A group without a help text is a command itself: the first that is added to it."""
    if text:
        group = typer.Typer(help=text, no_args_is_help=True)
    else:
        group = typer.Typer(cls=StageGroup, invoke_without_command=True)
    groups[name] = group
    app.add_typer(group, name=name)


Command = Callable[..., None]


def command(
    example: str, sections: str = "", common: str = "", **options: SettingOption
) -> Callable[[Command], Command]:
    """Add a function as the command of its name, and resolve its settings; the function takes a Job first.

    The command of a group does nothing if one of its subcommands is called.

    Args:
        example: A command line, with the group's name if the command is in one.
        sections: The sections of the settings that the command uses, separated by blanks; `*` for all.
        common: Names in COMMON_SETTINGS and COMMON_OPTIONS, separated by blanks. Every command has `config` and
            `overrides`.
        options: Further options that set a setting; the function does not get them.
    """
    common_names = {"config", "overrides", *common.split()}

    def add(function: Command) -> Command:
        _, *own_parameters = signature(function, eval_str=True).parameters.values()
        own_names = [parameter.name for parameter in own_parameters]
        added_names = common_names - {*own_names}  # `config` is an argument of some commands
        setting_options = options | {name: option for name, option in COMMON_SETTINGS.items() if name in added_names}

        @functools.wraps(function)
        def called(context: typer.Context, **values: Any) -> None:
            if context.invoked_subcommand is not None:
                return
            settings = _set_by_options(setting_options, values)
            used_sections = None if sections == "*" else sections.split()
            cfg = resolve(values["config"], values["overrides"], settings, used_sections)
            if "town" in common_names:
                cfg = _town_of(cfg, values["town"])
            try:
                function(Job(cfg), **{name: _opened(cfg, values[name]) for name in own_names})
            except EOFError as error:  # click would print "Aborted." alone
                raise RuntimeError("a file or the input ends too early") from error

        # Typer reads the options from the signature.
        called.__signature__ = Signature([  # type: ignore[attr-defined]
            Parameter("context", Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context),
            *(parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in own_parameters),
            *(option.parameter(name) for name, option in setting_options.items()),
            *(parameter for parameter in COMMON_OPTIONS if parameter.name in added_names),
        ])  # fmt: skip
        called.__annotations__ = {}
        return _add_command(called, function.__name__.replace("_", "-"), example)

    return add


def _add_command(called: Command, name: str, example: str) -> Command:
    """Add a function to the group that its example names, or as the command of this group itself, or to the app."""
    group = groups.get(example.split()[1], app)
    if group.info.invoke_without_command is True and group.registered_callback is None:
        return group.callback(epilog=example)(called)
    return group.command(name, epilog=example)(called)


def _set_by_options(options: Mapping[str, SettingOption], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return setting -> value for the options that the user gave."""
    settings = {}
    for name, option in options.items():
        value = values[name]
        if value is None or value == []:
            continue
        settings[option.setting] = option.values.get(value, value) if isinstance(value, str) else value
    return settings


def _opened(cfg: RunConfig, value: Any) -> Any:
    """Return a path, or a list of paths, whose links are followed if the settings say so."""
    if isinstance(value, list):
        return [_opened(cfg, item) for item in value]
    return cfg.opened(value) if isinstance(value, Path) else value


def resolve(
    config: Path | None,
    overrides: Sequence[str] | None,
    settings: Mapping[str, Any] = {},
    sections: Sequence[str] | None = None,
) -> RunConfig:
    """Resolve settings: defaults, then the file, then --set, then options.

    Args:
        settings: Setting -> value of its option.
        sections: The sections that the command uses; None for all. The others are neither loaded nor checked.
    """
    from cosfly.pipeline.command_settings import SECTIONS, CommandConfig, config_with
    from cosfly.runtime.config import apply_overrides, build, config_file, read_yaml, source_text
    from cosfly.runtime.json_io import dump_json

    assigned = list(overrides or [])
    for name, value in settings.items():
        # Values are read as YAML, and JSON is YAML: quoted, a colon in a text is only a colon.
        assigned.append(f"{name}={dump_json(str(value) if isinstance(value, Path) else value)}")
    file = config_file(config)
    source = source_text(file, bool(assigned))
    data = apply_overrides(read_yaml(file) if file else {}, assigned)
    allowed = {*CommandConfig.model_fields, *(sections or ())}
    assigned_names = {text.partition("=")[0].partition(".")[0] for text in assigned}
    if sections is not None and not data.get("towns") and assigned_names <= allowed:
        used = {name: value for name, value in data.items() if name in allowed or name not in SECTIONS}
        with contextlib.suppress(ConfigError):  # the model of all settings reports it, with the nearest name
            return cast("RunConfig", build(config_with(sections), used, source))
    from cosfly.pipeline.settings import RunConfig

    return build(RunConfig, data, source)


def _town_of(cfg: RunConfig, name: str | None) -> RunConfig:
    """Return the settings of a town; without a name, the settings that all towns share."""
    names = ", ".join(cfg.towns)
    if name in cfg.towns:
        return cfg.of_town(name)
    if name is not None:
        raise ConfigError(
            f"the configuration has no town of this name{nearest(name, cfg.towns)}",
            where="--town",
            got=name,
            expected=f"one of {names}" if names else "a configuration with towns",
        )
    if cfg.towns:
        log.warning("no --town is given, so the settings that the towns %s share are used", names)
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
        is_answer: The table is the command's answer, on stdout; else it goes to stderr, as log lines do.
    """
    from rich.measure import Measurement
    from rich.table import Table

    from cosfly.runtime.console import answer_console, console

    style = style if head else {"box": None}
    table = Table(title=title, title_justify="left", show_header=bool(head), **style)
    rows = list(rows)
    for index, name in enumerate(head):
        cells = [str(row[index]) for row in rows]
        is_left = index == 0 or name in left
        unbroken = name.split()  # a heading and a name break at spaces alone, and a number nowhere
        if index == 0:
            unbroken += " ".join(cells).split()
        elif not is_left:
            unbroken += cells
        min_width = max(map(len, unbroken), default=0)
        table.add_column(name, justify="left" if is_left else "right", overflow="fold", min_width=min_width)
    for row in rows:
        table.add_row(*row)
    target = answer_console if is_answer else console
    least_width = Measurement.get(target, target.options.update(max_width=1000), table).minimum
    target.print(table, width=max(target.width, least_width), crop=False)  # perhaps wider than the terminal


def print_checks(checks: Iterable[Any], title: str | None = None, *, is_answer: bool = False) -> None:
    """Print checks with name, state and detail; exit with 1 if something required does not work."""
    from rich.text import Text

    colors = {"ok": "green", "optional": "yellow", "warning": "yellow", "missing": "red", "unusable": "red"}
    checks = list(checks)
    rows = [(check.name, Text(check.state, colors[check.state]), check.detail) for check in checks]
    print_table((), rows, title, is_answer=is_answer)
    if any(colors[check.state] == "red" for check in checks):
        raise typer.Exit(1)
