"""Stage 1: a map of boxes. Each source is a module with `load(its settings, seed) -> BoxMap`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap, check_ground, write_boxes
from cosfly.formats.meshes import MESHES_FILE
from cosfly.maps import boxfile, carla_export, cityjson, simworld, synthetic, unrealcv_export
from cosfly.maps.box_rows import BoxesConfig
from cosfly.maps.boxlist import check_not_empty
from cosfly.maps.carla_export import CarlaMapConfig
from cosfly.maps.cityjson import CityJsonConfig
from cosfly.maps.simworld import SimWorldConfig
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.unrealcv_export import UnrealCvMapConfig
from cosfly.runtime.config import Config
from cosfly.runtime.io import LinkedPath, write_bytes
from cosfly.runtime.run_dir import StageFolder, Tally
from cosfly.viz.topview import TopView, draw_map, draw_scale, png_bytes

PICTURE_PX = 1200  # longer side of the overview picture

SOURCES: dict[str, Callable[[Any, int], BoxMap]] = {
    "synthetic": synthetic.load, "simworld": simworld.load, "cityjson": cityjson.load,
    "boxes": boxfile.load, "carla": carla_export.load, "unrealcv": unrealcv_export.load,
}  # fmt: skip


class MapsConfig(Config):
    """Where the map comes from."""

    source: Literal["synthetic", "simworld", "cityjson", "boxes", "carla", "unrealcv"] = Field(
        "synthetic", description="source of the map"
    )
    synthetic: SyntheticConfig = Field(SyntheticConfig(), description="the seeded town")
    simworld: SimWorldConfig = Field(SimWorldConfig(), description="a SimWorld world with asset sizes")
    cityjson: CityJsonConfig = Field(CityJsonConfig(), description="a CityJSON city model")
    boxes: BoxesConfig = Field(BoxesConfig(), description="boxes of your own: JSON, CSV or GeoJSON")
    carla: CarlaMapConfig = Field(CarlaMapConfig(), description="the town of a running CARLA server")
    unrealcv: UnrealCvMapConfig = Field(UnrealCvMapConfig(), description="the level of a running UnrealCV server")

    @property
    def licence(self) -> str:
        """The licence of the chosen source, for the map's header."""
        return getattr(self, self.source).licence

    def recorded(self) -> dict[str, Any]:
        """Return the settings that count for resumption: those of the chosen source, not of the others."""
        other_sources = SOURCES.keys() - {self.source}
        return {name: value for name, value in super().recorded().items() if name not in other_sources}


def load_map(cfg: MapsConfig, *, seed: int = 0, follow_links: bool = False) -> BoxMap:
    """Read or build the map of the chosen source; its meshes are read when they are drawn.

    follow_links: also read meshes through links that lead out of the map's folder.
    """
    settings = getattr(cfg, cfg.source)
    box_map = SOURCES[cfg.source](settings, seed)
    check_not_empty(box_map, ", ".join(map(str, settings.inputs().values())) or cfg.source)
    if not follow_links or box_map.meshes.folder is None:
        return box_map
    return replace(box_map, meshes=replace(box_map.meshes, folder=LinkedPath(box_map.meshes.folder)))


def run(cfg: MapsConfig, out: Path, *, seed: int = 0, follow_links: bool = False) -> Path:
    """Read the source's files, if it has any; write `boxes_3d.json` and the overview `map.png`."""
    inputs = getattr(cfg, cfg.source).inputs()
    stage = StageFolder.open(out, "maps", config=cfg, inputs=inputs, seed=seed)
    product = out / "boxes_3d.json"
    if stage.is_complete:
        return product
    box_map = load_map(cfg, seed=seed, follow_links=follow_links)
    check_ground(box_map, next(iter(inputs.values()), product))
    write_boxes(product, box_map)
    outputs = [product, out / "map.png"]
    if box_map.meshes.refs:
        outputs.append(out / MESHES_FILE)
    if cfg.source == "unrealcv":
        outputs += unrealcv_export.write_objects(box_map, out)
    view = TopView.around(np.stack(box_map.bounds()), PICTURE_PX)
    picture = draw_map(box_map, view)
    draw_scale(picture, view)
    write_bytes(out / "map.png", png_bytes(picture))
    dropped = box_map.header.dropped_objects
    num_objects = box_map.header.num_objects or len(box_map)
    tally = Tally(input=num_objects, kept=num_objects - sum(dropped.values()), dropped=dropped)
    stage.finish(outputs, tally, num_boxes=len(box_map), counts_by_kind=box_map.counts())
    return product
