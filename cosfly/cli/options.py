"""What the commands share: their options, the settings they resolve, and how they tell what they made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cosfly.errors import ConfigError, InputError, nearest

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from cosfly.app.settings import RunConfig
    from cosfly.work.stage_folder import Tally


ConfigFile = Annotated[Path | None, typer.Option("--config", "-c", help="YAML file with the settings of a run.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", "-s", metavar="A.B=C", help="Override one setting; may be repeated.")
]
Seed = Annotated[int | None, typer.Option(help="Seed; every random choice derives from it.")]
Workers = Annotated[int | None, typer.Option(help="Worker processes; 0 takes one per core.")]
Resume = Annotated[
    Literal["never", "if-same", "force"],
    typer.Option(
        help="What to do with a folder that holds work: refuse, continue if the settings are the same, or continue."
    ),
]
Verify = Annotated[
    bool,
    typer.Option("--verify", help="First read every file of the finished stages that are used and compare its sha256."),
]
Out = Annotated[Path, typer.Option(help="Output folder.")]
Map = Annotated[Path, typer.Option("--map", help="Boxes: boxes_3d.json or step2_simplified.json.")]
WeatherPool = Annotated[
    Path | None, typer.Option(help="YAML file with weather presets of yours in the place of those that ship.")
]
TimePool = Annotated[
    Path | None, typer.Option(help="YAML file with times of day of yours in the place of those that ship.")
]
Data = Annotated[
    list[Path] | None,
    typer.Option("--data", help="Playback tree, one; by default that of the run folder one stands in."),
]
Flights = Annotated[
    list[str] | None,
    typer.Option(
        "--flights", metavar="GLOB",
        help="Only flights whose folder in the tree, or one above it, matches: 'Town01/trajectory_17*/ORI', 'Town0[12]'; may be repeated.",
    ),
]  # fmt: skip
Tracks = Annotated[
    Literal["clean", "perturbed", "both"] | None,
    typer.Option("--tracks", help="Only flights of this track. [default: both]"),
]


Trees = Annotated[
    list[Path] | None,
    typer.Option(
        "--data", help="Playback tree, once for each of several; by default that of the run folder one stands in."
    ),
]


Repair = Annotated[
    bool,
    typer.Option(
        "--repair",
        help="First set aside what cannot be used in the folder's journals (FILE.aside); it is done again.",
    ),
]


def resolve(config: Path | None, overrides: list[str] | None, given: Mapping[str, Any] = {}) -> RunConfig:
    """Resolve the settings: defaults, file, --set, then `given`: what options say of single settings; None is not given."""
    from cosfly.app.settings import RunConfig
    from cosfly.reading.limits import use_limits
    from cosfly.work.config import load
    from cosfly.work.store import dump_json

    texts = {
        name: value if isinstance(value, int | float | list) else str(value)
        for name, value in given.items()
        if value is not None
    }
    # As YAML, which JSON is: a colon in a text is only a colon.
    extra = [f"{name}={dump_json(value)}" for name, value in texts.items()]
    cfg = load(RunConfig, _config_path(config), [*(overrides or []), *extra])
    use_limits(cfg.reading)
    return cfg


def set_aside(out: Path, asked: bool) -> None:
    """Do what --repair asks for, before the folder is opened."""
    if asked:
        from cosfly.app.repair import repair

        typer.echo(f"{out}: {repair(out)} lines set aside")


def _config_path(config: Path | None) -> Path | None:
    """A path, or the bare name of a configuration that ships with cosfly."""
    from cosfly.work.config import shipped

    if config is None or config.is_file():
        return config
    is_bare = config.suffix == "" and len(config.parts) == 1
    if is_bare and (packaged := shipped(f"{config}.yaml")).exists():
        return packaged  # whatever folder of this name stands here
    names = sorted(path.stem for path in shipped(".").glob("*.yaml") if path.stem != "glossary")
    if config.is_dir():
        raise ConfigError(
            "a folder, and not that of a run", where=config, got="no run.yaml",
            expected=f"a YAML file, a run folder, or one that ships: {', '.join(names)}",
            fix=f"cosfly list {config} names the runs in it",
        )  # fmt: skip
    if is_bare:
        raise ConfigError(
            f"no such configuration{nearest(str(config), names)}", where=config,
            expected=f"a YAML file, or one that ships: {', '.join(names)}",
        )  # fmt: skip
    return config


def needed(name: str, value: Path | None) -> Path:
    """An option that a stage needs but its subcommands do not: a usage error, exit 2, where it is missing."""
    if value is None:
        raise typer.BadParameter("it must be given", param_hint=f"'{name}'")
    return value


def manner(cfg: RunConfig, resume: Resume) -> dict[str, Any]:
    """How a stage works, whatever it makes: arguments that all stages with workers take."""
    from cosfly.app.settings import manner_of_work

    return manner_of_work(cfg) | {"resume": resume}


def tell_product(product: Path, out: Path, cfg: RunConfig) -> None:
    """Name a stage's product. Too much that failed is an error: whoever calls the next stage must know."""
    from cosfly.work.stage_folder import read_manifest

    typer.echo(product)
    check_failures({out.name: read_manifest(out).counts}, out / "failures.jsonl", cfg)


def check_failures(counts_by_stage: dict[str, Tally], where: Path, cfg: RunConfig) -> None:
    """Raise InputError, after everything was done, where more items failed than the settings accept."""
    failed = {stage: dict(counts.failed) for stage, counts in counts_by_stage.items() if counts.failed}
    if sum(sum(reasons.values()) for reasons in failed.values()) > cfg.max_failed:
        raise InputError(
            "some items failed; the others are done",
            where=where,
            got=str(failed),
            expected=f"at most {cfg.max_failed} (max_failed)",
            fix="mend what the records name and run the same command again: only the failed ones are done again",
        )


def chosen_flights(section: str, flights: list[str] | None, tracks: str | None) -> dict[str, Any]:
    """Give what --flights and --tracks say, as settings of a section."""
    return {
        f"{section}.match": flights or None,
        f"{section}.tracks": {"clean": ["clean"], "perturbed": ["perturbed"], "both": ["clean", "perturbed"]}.get(
            tracks or ""
        ),
    }


def data_folder(data: list[Path] | None) -> Path:
    """The playback tree: given, or that of the run folder one stands in; raises InputError where there is none, or several are given."""
    if data is not None and len(data) > 1:
        raise InputError(
            "this command takes one playback tree", where="--data", got=f"{len(data)}: {', '.join(map(str, data))}",
            fix="run it once for each tree; distill and release take the results of several together",
        )  # fmt: skip
    if data:
        return data[0]
    for candidate in (Path("render"), Path()):
        if (candidate / "manifest.json").exists() and candidate.resolve().name == "render":
            return candidate
    raise InputError(
        "no playback tree", where=Path.cwd(), got="no --data, and this is not a run folder", fix="give --data DIR"
    )


def data_folders(data: list[Path] | None) -> list[Path]:
    """The playback trees: given, or that of the run folder one stands in."""
    return data or [data_folder(None)]


def verify_first(is_wanted: bool, *paths: Path | None) -> None:
    """Hold inputs, and an output folder that holds something already, against their records before anything is done."""
    from cosfly.work import provenance

    if is_wanted:
        provenance.verify(path for path in paths if path is not None and path.exists())


def plain_table(title: str | None, rows: Iterable[Sequence[str | Text]]) -> Table:
    """A table without lines and without a header."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=False, box=None)
    for row in rows:
        table.add_row(*row)
    return table


def tell_checks(checks: Sequence[Any], console: Console, title: str | None = None) -> None:
    """Print what was examined, each with name, state and detail; exit 1 where something that is needed does not work."""
    from rich.text import Text

    colors = {"ok": "green", "optional": "yellow", "warning": "yellow", "missing": "red", "unusable": "red"}
    rows = [(check.name, Text(check.state, colors[check.state]), check.detail) for check in checks]
    console.print(plain_table(title, rows))
    if any(colors[check.state] == "red" for check in checks):
        raise typer.Exit(1)
