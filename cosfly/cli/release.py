"""The commands `cosfly release ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosfly.cli import options

app = typer.Typer(no_args_is_help=True, help="Package captions and frames as a data set that opens with one line.")


@app.command("build")
def release_build(
    captions: Annotated[Path, typer.Option(help="captions.jsonl")],
    inspected: Annotated[Path, typer.Option("--inspect", help="inspect.json")],
    out: Annotated[Path, typer.Option(help="Release folder.")],
    data: options.Data = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    workers: options.Workers = None,
    resume: options.Resume = "if-same",
) -> None:
    """Select frames, join captions, write parquet, data-set card and checksums."""
    from release import package

    cfg = options.resolve(config, overrides, {"workers": workers})
    given = options.manner(cfg, resume)
    options.tell_product(
        package.run(cfg.release, options.data_folder(data), captions, inspected, out, **given), out, cfg
    )


@app.command("verify")
def release_verify(folder: Annotated[Path, typer.Argument(help="Release folder.")]) -> None:
    """Check structure, checksums, every number of the card, and re-projection. Exit 1 if anything is wrong."""
    from release.validate import verify

    report = verify(folder)
    typer.echo(str(report))
    if not report.is_ok:
        raise typer.Exit(1)
