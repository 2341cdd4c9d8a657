"""The commands `cosfly release ...` and `cosfly view`."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from cosfly.cli import options
from cosfly.cli.options import WORKERS, Job, SettingOption, command, track_options
from cosfly.runtime.errors import InputError

options.add_group("release", "Package captions and frames as a data set that opens with one line.")
SELECTION = "Frames of each track: a uniform stride, runs that keep windows of captions whole, or all."


@command(
    "cosfly release build runs/diverse --out release",
    "release",
    f"{WORKERS}",
    **track_options("release", "flights", "tracks"),
    frames=SettingOption("release.num_frames", "Largest number of frames per track.", int, metavar="N"),
    selection=SettingOption("release.selection", SELECTION, Literal["stride", "windows", "all"]),
)
def build(
    job: Job,
    out: Annotated[Path, Option(help="Release directory.")],
    runs: options.Runs = None,
    captions: Annotated[list[Path] | None, Option(help="captions.jsonl of a tree; repeat with --data.")] = None,
    inspected: Annotated[list[Path] | None, Option("--inspect", help="inspect.json of each tree, or none.")] = None,
    data: options.Trees = None,
) -> None:
    """Select frames of one or more runs, join captions, write parquet, data-set card and checksums."""
    from release.build.sources import Source

    sources = [Source.of_run(folder) for folder in options.each_run(runs)]
    if captions or inspected or data or not sources:
        trees = job.trees(data)
        inspections: list[Path | None] = list(inspected) if inspected else [None for _ in trees]
        if not len(trees) == len(captions or []) == len(inspections):
            problem = "pass one --captions and at most one --inspect for each --data, or pass run directories"
            raise typer.BadParameter(problem)
        sources += [Source.of_files(*files) for files in zip(trees, captions or [], inspections, strict=True)]
    job.run("release.build.stage", job.cfg.release, sources, out)


LEVELS = "structure: names, sizes, records, card. rows: also every row. pixels: also all files."


@command("cosfly release verify release", common=WORKERS)
def verify(
    job: Job,
    folder: Annotated[Path, Argument(help="Release, run directory, or a snapshot in the hub's cache.")],
    level: Annotated[Literal["structure", "rows", "pixels"], Option(help=LEVELS)] = "pixels",
    json_file: Annotated[Path | None, Option("--json", help="File for the findings, as JSON.")] = None,
) -> None:
    """Check that a release agrees with its records and with geometry. Exit with 1 if anything is wrong."""
    from caption.stage.released import read_released
    from cosfly.runtime.json_io import write_json

    report = job.call("release.verify.verify:verify", folder, level=level, reader=read_released)
    typer.echo(str(report))
    if json_file is not None:
        write_json(json_file, report.as_json())
    if not report.is_ok:
        raise typer.Exit(1)


@command("cosfly release stats release --out stats")
def stats(
    job: Job,
    folder: Annotated[Path, Argument(help="Release directory, or a run directory.")],
    out: Annotated[Path, Option(help="Folder for stats.html and stats.json.")],
) -> None:
    """Draw the tables of a release, as the paper has them."""
    typer.echo(job.call("release.card.tables", folder, out))


FORMATS = (
    "tree: CosFly-Track v7; lerobot: LeRobot v3.0; webdataset: tar shards; coco: boxes and masks of people; chat: "
    "conversations for TRL, transformers and ms-swift; sharegpt: for LLaMA-Factory."
)
Format = Literal["tree", "lerobot", "webdataset", "coco", "chat", "sharegpt"]


@command("cosfly release export release --format webdataset --out shards")
def export(
    job: Job,
    source: Annotated[Path, Argument(help="Release, or run directory with a release.")],
    out: Annotated[Path, Option(help="Output directory.")],
    format: Annotated[Format, Option(help=FORMATS)],
    modalities: Annotated[str, Option(help="Pictures: rgb,depth,instance; LeRobot has rgb alone by default.")] = "",
    video: Annotated[bool, Option("--video", help="LeRobot: mp4 instead of PNG, with loss; needs PyAV.")] = False,
    language: Annotated[Literal["en", "zh", "both"], Option(help="Conversations: languages.")] = "both",
    frames: Annotated[Literal["all", "last"], Option(help="Conversations: pictures of these frames.")] = "all",
) -> None:
    """Write a release in another format."""
    from cosfly.runtime.config import build
    from release.columns import LANGUAGES
    from release.export.stage import ExportConfig

    languages = LANGUAGES if language == "both" else [language]
    chosen = [name for name in modalities.split(",") if name]
    choice = {"format": format, "modalities": chosen, "video": video, "languages": languages, "frames": frames}
    job.run("release.export.stage", build(ExportConfig, choice, "options"), source, out)


@command("cosfly view runs/quickstart --out view.html", "inspect", "", **track_options("inspect"))
def view(
    job: Job,
    source: Annotated[Path, Argument(help="Map (a file), playback tree or run directory.")],
    out: Annotated[Path, Option(help="Page (.html), or of a playback tree a .png or .gif.")],
    paths: Annotated[Path | None, Option(help="With a map: pedestrian trajectories, path.json.")] = None,
    traces: Annotated[list[Path] | None, Option(help="With a map: drone_trace.json; repeat it.")] = None,
    data: Annotated[Path | None, Option(help="With a map: playback tree with the frames of both tracks.")] = None,
    captions: Annotated[Path | None, Option(help="With a playback tree: its captions.jsonl.")] = None,
    frame: Annotated[str | None, Option(help="With a .png: the pictures of this frame, or `best`.")] = None,
    map_: Annotated[Path | None, Option("--map", help="With --frame: boxes_3d.json that was drawn.")] = None,
    picture_px: Annotated[int, Option(min=32, max=1280, help="Width of a frame on a page, px.")] = 320,
) -> None:
    """Make a page or a picture of a map, a playback tree or a run; pages work offline."""
    from release.record import RECORD

    for dataset in (source, source / "dataset"):
        if (dataset / RECORD).is_file():
            raise InputError(
                "a release has no page", where=dataset, expected="a map, a playback tree or a run directory",
                fix=f'load the release with datasets.load_dataset("{dataset}"), or pass the run that it was built from',
            )  # fmt: skip
    if source.is_file():
        job.call(
            "cosfly.viz.scene_page", source, out, paths=paths, traces=traces or [], data=data, picture_px=picture_px
        )
    elif out.suffix in (".png", ".gif"):
        from cosfly.formats.boxes import read_boxes
        from cosfly.viz import gallery

        choice = job.cfg.inspect.flights
        if frame is not None:
            if map_ is None:
                raise typer.BadParameter("--frame needs the map that was drawn, boxes_3d.json", param_hint="'--map'")
            chosen = None if frame == "best" else frame
            typer.echo(gallery.four_panels(source, out, box_map=read_boxes(map_), frame=chosen))
        elif out.suffix == ".png":
            gallery.contact_sheet(source, out, choice)
        else:
            gallery.preview_gif(source, out, choice)
    else:
        job.call("cosfly.viz.viewer", source, out, captions, picture_px=picture_px)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:,.1f} MB")
