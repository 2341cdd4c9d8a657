"""The commands `cosfly release ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli.options import (
    ConfigFile,
    DataOption,
    Overrides,
    ResumeMode,
    ResumeOption,
    Workers,
    data_folder,
    manner,
    resolve,
    tell_product,
)

app = typer.Typer(no_args_is_help=True, help="Package captions and frames as a data set that opens with one line.")


@app.command("build")
def release_build(
    captions: Annotated[Path, typer.Option(help="captions.jsonl")],
    inspected: Annotated[Path, typer.Option("--inspect", help="inspect.json")],
    out: Annotated[Path, typer.Option(help="Release folder.")],
    data: DataOption = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    workers: Workers = None,
    resume: ResumeOption = ResumeMode.if_same,
) -> None:
    """Select frames, join captions, write parquet, data-set card and checksums."""
    import release.package

    cfg = resolve(config, overrides, None, workers)
    tell_product(
        release.package.run(cfg.release, data_folder(data), captions, inspected, out, **manner(cfg, resume)), out, cfg
    )


@app.command("verify")
def release_verify(folder: Annotated[Path, typer.Argument(help="Release folder.")]) -> None:
    """Check structure, checksums, every number of the card, and re-projection. Exit 1 if anything is wrong."""
    import release.validate

    report = release.validate.verify(folder)
    typer.echo(str(report))
    if not report.is_ok:
        raise typer.Exit(1)
