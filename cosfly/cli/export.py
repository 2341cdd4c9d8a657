"""The commands `cosfly export ...`: parts of a data set for tools of others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

app = typer.Typer(no_args_is_help=True, help="Write parts of a data set for tools of others.")


@app.callback()
def _group() -> None:
    """A group even while it has one command."""


@app.command("captions")
def export_captions(
    source: Annotated[Path, typer.Argument(help="Run folder, captions.jsonl or its folder, or release.")],
    out: Annotated[Path, typer.Option(help="File to write.")],
    format: Annotated[
        Literal["csv", "jsonl", "sharegpt", "llava"],
        typer.Option(help="A table, JSON lines, or conversations as LLaMA-Factory or LLaVA read them."),
    ],
    language: Annotated[Literal["en", "zh", "both"], typer.Option(help="Languages of the texts.")] = "both",
    frames: Annotated[
        Literal["all", "last"],
        typer.Option(help="Pictures of a conversation: of all frames of the window, or of the last one alone."),
    ] = "all",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file where there is one.")] = False,
) -> None:
    """Write the accepted captions to one file; pictures are named relative to the playback tree."""
    from release.columns import LANGUAGES
    from release.export.captions import export

    languages = LANGUAGES if language == "both" else [language]
    told = export(source, out, format, languages=languages, shown=frames, overwrite=overwrite)
    typer.echo(f"{out}: {told}")
