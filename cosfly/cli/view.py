"""The command `cosfly view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosfly.cli.options import Job, choice_of, takes

app = typer.Typer()


@app.command("view", epilog="cosfly view release --out release.html")
@takes("inspect", "", **choice_of("inspect"))
def view(
    job: Job,
    source: Annotated[Path, Argument(help="Map (a file), playback tree, run directory or release.")],
    out: Annotated[Path, Option(help="Page (.html), or of a playback tree a .png or .gif.")],
    paths: Annotated[Path | None, Option(help="With a map: pedestrian trajectories, path.json.")] = None,
    traces: Annotated[list[Path] | None, Option(help="With a map: drone_trace.json; repeat it.")] = None,
    data: Annotated[Path | None, Option(help="With a map: playback tree with the frames of both tracks.")] = None,
    captions: Annotated[Path | None, Option(help="With a playback tree: its captions.jsonl.")] = None,
    frame: Annotated[str | None, Option(help="With a .png: the pictures of this frame, or `best`.")] = None,
    map_: Annotated[Path | None, Option("--map", help="With --frame: boxes_3d.json that was drawn.")] = None,
    picture_px: Annotated[int, Option(min=32, max=1280, help="Width of a frame on a page, px.")] = 320,
    max_mb: Annotated[int, Option(min=1, help="Size of a page, MB; frames are omitted to stay below it.")] = 24,
) -> None:
    """Make a page or a picture of a map, a playback tree, a run or a release; pages work offline."""
    source = job.cfg.opened(source)
    if source.is_file():
        from cosfly.viz import scene_page

        scene_page.run(source, out, paths=paths, traces=traces or [], data=data, picture_px=picture_px, max_mb=max_mb)
    elif out.suffix in (".png", ".gif"):
        from cosfly.formats.boxes import read_boxes
        from cosfly.viz import gallery

        choice = job.cfg.inspect.flights
        if frame is not None:
            box_map = None if map_ is None else read_boxes(map_)
            typer.echo(gallery.four_panels(source, out, frame=None if frame == "best" else frame, box_map=box_map))
        elif out.suffix == ".png":
            gallery.contact_sheet(source, out, choice)
        else:
            gallery.preview_gif(source, out, choice)
    else:
        from release.viewer import page

        page.run(source, out, page.ViewerConfig(picture_px=picture_px, max_mb=max_mb), captions)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:,.1f} MB")
