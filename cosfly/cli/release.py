"""The commands `cosfly release ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import WORKERS, Job, Short, takes

app = typer.Typer(no_args_is_help=True, help="Package captions and frames as a data set that opens with one line.")

Split = Literal["train", "validation", "test"]


@app.command("build", epilog="cosfly release build runs/diverse --out release")
@takes(
    "release",
    f"{WORKERS} resume",
    flights=Short("release.flights", options.GLOB_HELP, list[str], metavar="GLOB"),
    tracks=options.choice_of("release")["tracks"]._replace(setting="release.tracks"),
    frames=Short("release.num_frames", "Frames per track, or all.", words={"all": None}, metavar="N|all"),
)
def release_build(
    job: Job,
    out: Annotated[Path, Option(help="Release directory.")],
    runs: options.Runs = None,
    captions: Annotated[list[Path] | None, Option(help="captions.jsonl of a tree; repeat with --data.")] = None,
    inspected: Annotated[list[Path] | None, Option("--inspect", help="inspect.json of each tree, or none.")] = None,
    data: options.Trees = None,
) -> None:
    """Select frames of one or more runs, join captions, write parquet, data-set card and checksums."""
    from release.package import stage as package
    from release.package.sources import Source

    sources = [Source.of_run(folder) for folder in runs or []]
    if captions or inspected or data or not sources:
        trees = job.trees(data)
        inspections: list[Path | None] = list(inspected) if inspected else [None for _ in trees]
        if not len(trees) == len(captions or []) == len(inspections):
            raise typer.BadParameter(
                "give one --captions and at most one --inspect for each --data, or run directories"
            )
        sources += [Source.of_files(*files) for files in zip(trees, captions or [], inspections, strict=True)]
    job.finish(package.run(job.cfg.release, sources, out, **job.worker_options), out)


@app.command("verify", epilog="cosfly release verify release")
@takes("", WORKERS)
def release_verify(
    job: Job,
    folder: Annotated[Path, Argument(help="Release, run directory, playback tree, export, or the hub's cache.")],
    level: Annotated[
        Literal["structure", "rows", "pixels"],
        Option(help="structure: names, sizes, records, card. rows: also every row. pixels: also all files."),
    ] = "pixels",
    json_file: Annotated[Path | None, Option("--json", help="File for the findings, as JSON.")] = None,
) -> None:
    """Check that a release agrees with its records and with geometry. Exit with 1 if anything is wrong."""
    from caption.run.released import read_released
    from cosfly.pipeline.command_settings import worker_options
    from cosfly.runtime.json_io import write_json
    from release.verify.verify import verify

    report = verify(folder, level=level, reader=read_released, **worker_options(job.cfg))
    typer.echo(str(report))
    if json_file is not None:
        write_json(json_file, report.as_json())
    if not report.is_ok:
        raise typer.Exit(1)


@app.command("stats", epilog="cosfly release stats release --out stats")
@takes()
def release_stats(
    job: Job,
    folder: Annotated[Path, Argument(help="Release directory, or a run directory.")],
    out: Annotated[Path, Option(help="Folder for stats.html, stats.md and stats.json.")],
    pixels: Annotated[int, Option(min=0, help="Frames whose depth and instance pictures are read; 0 for none.")] = 200,
) -> None:
    """Compute the paper's tables from the rows of a release, and draw what it covers."""
    from release.stats import stats

    typer.echo(stats.run(folder, out, pixels=pixels))


@app.command("export", epilog="cosfly release export release --format webdataset --out shards")
@takes("", f"{WORKERS} resume")
def release_export(
    job: Job,
    source: Annotated[Path, Argument(help="Release; for captions also a run directory or captions.jsonl.")],
    out: Annotated[Path, Option(help="Output directory; of captions the file.")],
    format: Annotated[
        Literal["tree", "webdataset", "lerobot", "csv", "jsonl", "sharegpt", "llava"],
        Option(
            help="Playback tree (CosFly-Track v7), WebDataset or LeRobot v3.0; captions alone as a table, JSON lines, "
            "or conversations for LLaMA-Factory or LLaVA."
        ),
    ],
    shard_mb: Annotated[int | None, Option(help="Approximate size of a file of many frames, MB.")] = None,
    language: Annotated[Literal["en", "zh", "both"], Option(help="Captions: languages of the texts.")] = "both",
    frames: Annotated[Literal["all", "last"], Option(help="Conversations: pictures of these frames.")] = "all",
    split: Annotated[Split | None, Option(help="Captions: only this split.")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Captions: replace an existing file.")] = False,
) -> None:
    """Write a release in another format, without loss, or its accepted captions to one file."""
    from cosfly.runtime.config import build

    if format == "tree" or format == "webdataset" or format == "lerobot":
        from release.export import stage as export
        from release.export.contract import ExportConfig

        given = {"format": format} | ({} if shard_mb is None else {"shard_mb": shard_mb})
        cfg = build(ExportConfig, given, "--format, --shard-mb")
        return job.finish(export.run(cfg, source, out, **job.worker_options), out)
    from release.columns import LANGUAGES
    from release.export import captions

    languages = LANGUAGES if language == "both" else [language]
    tally = captions.export(source, out, format, languages=languages, shown=frames, split=split, overwrite=overwrite)
    typer.echo(f"{out}: {tally}")
