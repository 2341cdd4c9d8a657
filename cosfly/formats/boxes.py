"""`boxes_3d.json` and `step2_simplified.json`: boxes in the paper's fields (tab:boxes_schema)."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator

from cosfly.formats.columns import FARTHEST_M, LARGEST, rounded
from cosfly.formats.kinds import GROUND_KINDS, KIND_COLORS, KIND_NAMES, KINDS
from cosfly.formats.meshes import Meshes, MeshRef
from cosfly.geometry.axes import axis_aligned_half_extents
from cosfly.runtime.errors import InputError, nearest
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import MISSING, FileFormat, check_schema, dump_json, read_json, validated

BOXES_FORMAT = FileFormat("cosfly.boxes_3d", "1.0", "map")
MAP_MB = 4_096  # 15 million boxes; a file of ten million has 2.7 GB
AXES = "right-handed, metres, x east, y north, z up; degrees"
# Largest distance between a corner in a file and the computed one, per axis: an absolute part, because exporters round
# and rotate in single precision, and a part relative to the coordinate.
CORNER_M, CORNER_SHARE = 0.05, 1e-6
# Fields of a file that a header does not keep: the boxes, and what is computed from them.
COMPUTED = {"schema", "schema_version", "axes", "bounds", "num_boxes", "counts", "boxes"}
UNIT_FIELDS = {"unit", "units", "crs", "epsg", "srs", "coordinate_system", "up_axis", "up"}  # of other tools
VECTORS = ("centers", "half_extents", "rotations_deg")  # fields of a BoxMap, (n, 3)
ARRAYS = (*VECTORS, "kinds", "ids")  # fields of a BoxMap with one row per box

UNKNOWN_LICENCE = "unknown"
OUR_LICENCE = "apache-2.0"  # of maps that cosfly generates
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


def _licence_id(text: str) -> str:
    if not re.fullmatch(r"[a-z0-9][a-z0-9.+-]*", text):
        raise ValueError(
            f"{text[:40]!r} is not a licence identifier such as cc-by-4.0 or apache-2.0; put other text into `credits`"
        )
    return text


LicenceId = Annotated[str, AfterValidator(_licence_id)]


class _Kept(BaseModel):
    """Base of records that keep unknown keys."""

    model_config = ConfigDict(extra="allow", frozen=True, populate_by_name=True)


class MapSource(_Kept):
    """The tool that made a map, and its input file or seed."""

    tool: str = ""
    version: str = ""
    file: str = ""
    seed: int = 0


class SimplifyPass(_Kept):
    """The number of boxes by kind after one pass of step 2; the first entry of a list is the input."""

    name: str = Field(alias="pass")
    counts: dict[str, int]


class MapHeader(_Kept):
    """The header of a map. A file holds only the fields that are set."""

    name: str = "map"
    source: MapSource = MapSource()
    licence: LicenceId = UNKNOWN_LICENCE
    credits: str = ""  # the attribution that the licence requires, in sentences
    ground_z_m: float = Field(0.0, ge=-LARGEST, le=LARGEST)  # height of the ground, which is flat
    extent_sources: dict[str, int] = {}  # number of boxes by the source of their size
    roads: dict[str, float] = {}
    added_boxes: int = 0  # number of boxes that the source does not hold
    derived_ground: int = 0  # number of these that are ground, derived from buildings or streets
    offset_m: dict[str, float] = {}  # added to coordinates of this map, gives those of the source
    num_objects: int | None = None  # of the source, including dropped ones
    dropped_objects: dict[str, int] = {}
    passes: list[SimplifyPass] = []
    simplify: dict[str, Any] = {}  # the settings of step 2


@dataclass(frozen=True)
class BoxMap:
    """A map of boxes, the product of stages 1 and 2."""

    centers: np.ndarray  # (n, 3) float64, m
    half_extents: np.ndarray  # (n, 3) float64, m
    rotations_deg: np.ndarray  # (n, 3) float64: pitch, yaw, roll
    kinds: np.ndarray  # (n,) uint8, values of KINDS
    ids: np.ndarray  # (n,) uint64, unique and stable
    header: MapHeader = field(default_factory=MapHeader)
    meshes: Meshes = field(default_factory=Meshes)  # drawn instead of some boxes; none in simplified maps

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def name(self) -> str:
        return self.header.name

    @property
    def ground_z_m(self) -> float:
        return self.header.ground_z_m

    @property
    def mins(self) -> np.ndarray:
        """(n, 3) low corners of the axis-aligned boxes around the rotated ones, m."""
        return self.centers - axis_aligned_half_extents(self.half_extents, self.rotations_deg)

    @property
    def maxs(self) -> np.ndarray:
        return self.centers + axis_aligned_half_extents(self.half_extents, self.rotations_deg)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and high corner of all boxes together, (3,) m each."""
        return self.mins.min(axis=0), self.maxs.max(axis=0)

    def select(self, index: np.ndarray) -> BoxMap:
        """Return the boxes at an index or mask, header unchanged."""
        return replace(self, **{name: getattr(self, name)[index] for name in ARRAYS})

    def joined(self, other: BoxMap) -> BoxMap:
        """Return these boxes followed by those of another map, under this header."""
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in ARRAYS}
        return replace(self, **both)

    def is_any_of(self, kinds: Collection[int]) -> np.ndarray:
        """Return which boxes have one of the kinds, (n,) bool."""
        return np.isin(self.kinds, np.array(sorted(kinds), dtype=np.uint8))

    def counts(self) -> dict[str, int]:
        """Return the number of boxes by kind name, largest first."""
        numbers, counts = np.unique(self.kinds, return_counts=True)
        order = np.argsort(-counts, kind="stable")
        return {KIND_NAMES[int(numbers[k])]: int(counts[k]) for k in order}


def make_box_map(
    centers: Any, half_extents: Any, rotations_deg: Any, kinds: Any, ids: Any = None, header: MapHeader | None = None
) -> BoxMap:
    """Make a BoxMap from array-like columns; ids default to 1..n."""
    vectors = [np.asarray(rows, dtype=np.float64).reshape(-1, 3) for rows in (centers, half_extents, rotations_deg)]
    ids = np.asarray(np.arange(1, len(vectors[0]) + 1) if ids is None else ids, dtype=np.uint64).reshape(-1)
    kinds = np.asarray(kinds, dtype=np.uint8).reshape(-1)
    return BoxMap(vectors[0], vectors[1], vectors[2], kinds, ids, header or MapHeader())


def check_boxes(box_map: BoxMap, where: str | Path) -> None:
    """Check that numbers are finite, extents not negative, kinds known and ids unique."""
    for name, least, vectors in (
        ("center", -FARTHEST_M, box_map.centers),
        ("extent", 0.0, box_map.half_extents),
        ("rotation", -FARTHEST_M, box_map.rotations_deg),
    ):
        is_valid = ((vectors >= least) & (vectors <= FARTHEST_M)).all(axis=1)  # NaN fails
        if not is_valid.all():
            row = int(np.argmin(is_valid))
            raise InputError(
                "the box has a number that is not finite, too large or negative",
                where=f"{where}: box {box_map.ids[row]}: {name}",
                got=str(vectors[row].tolist()),
                expected=f"numbers from {least:,.0f} to {FARTHEST_M:,.0f}",
            )
    unknown = [int(kind) for kind in np.unique(box_map.kinds) if int(kind) not in KIND_NAMES]
    if unknown:
        expected = f"an id from {min(KIND_NAMES)} to {max(KIND_NAMES)}"
        raise InputError("a box has an unknown semantic id", where=where, got=str(unknown[0]), expected=expected)
    ids, counts = np.unique(box_map.ids, return_counts=True)
    if (counts > 1).any():
        got = str(ids[counts > 1][0])
        raise InputError("two boxes have the same id", where=where, got=got, expected="a different id for each box")


def check_ground(box_map: BoxMap, path: Path) -> None:
    """Check that a map has ground: its height in the header, or a box of a ground kind."""
    if "ground_z_m" not in box_map.header.model_fields_set and not box_map.is_any_of(GROUND_KINDS).any():
        what = "the map has no ground"
        got = "no ground_z_m in the header, and no box of a ground type"
        expected = "the height of the ground in metres"
        fix = "add ground_z_m in metres to the header, or boxes of type Roads, Sidewalks, Terrain or Ground"
        raise InputError(what, where=path, got=got, expected=expected, fix=fix)


class _Box(BaseModel):
    """A box of a file. Fields with a default, except `mesh`, are redundant and compared with the others."""

    model_config = ConfigDict(strict=True, extra="forbid")  # strict: a quoted number is an error

    type: str
    id: int = Field(ge=0, lt=2**64)
    center: Vector
    extent: Vector
    rotation: Vector
    semantic_id: int | None = None
    color: Any = None  # not read: the colour follows from the type
    min: Vector | None = None
    max: Vector | None = None
    mesh: MeshRef | None = None

    @field_validator("type")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in KINDS:
            raise ValueError(f"the box type is unknown{nearest(name, KINDS)}; use a CARLA label such as Buildings")
        return name


class _Boxes(BaseModel):
    boxes: list[_Box]


def write_boxes(path: Path, box_map: BoxMap) -> None:
    """Write boxes in the paper's fields (tab:boxes_schema), one per line; meshes are in `meshes.glb` next to it."""
    check_boxes(box_map, path)
    refs = box_map.meshes.relative_to(path.parent).refs
    # min and max follow from the rounded vectors, as they do for a reader.
    box_map = replace(box_map, **{name: np.round(getattr(box_map, name), 6) for name in VECTORS})
    lines = []
    for box in _records(box_map):
        if box["id"] in refs:
            box["mesh"] = refs[box["id"]].model_dump(exclude_none=True)
        lines.append(dump_json(box))
    # The header is indented; each box takes one line.
    header = dump_json(_header_fields(box_map), indent=1).removesuffix("\n}")
    write_bytes(path, (header + ',\n "boxes": [\n' + ",\n".join(lines) + "\n]}\n").encode())


def _header_fields(box_map: BoxMap) -> dict[str, Any]:
    """Return the fields of a file before the boxes."""
    low, high = box_map.bounds() if len(box_map) else (np.zeros(3), np.zeros(3))
    fields = box_map.header.model_dump(mode="json", by_alias=True, exclude_unset=True)
    last_fields: dict[str, Any] = {name: fields.pop(name) for name in ("passes", "simplify") if name in fields}
    return {
        **BOXES_FORMAT.header,
        **fields,
        "axes": AXES,
        "bounds": {"min": rounded(low), "max": rounded(high)},
        "num_boxes": len(box_map),
        "counts": box_map.counts(),
        **last_fields,
    }


def _records(box_map: BoxMap) -> Iterator[dict[str, Any]]:
    """Yield the boxes as in a file, without their meshes."""
    mins, maxs = box_map.mins, box_map.maxs
    for i, (semantic_id, box_id) in enumerate(zip(box_map.kinds.tolist(), box_map.ids.tolist(), strict=True)):
        kind = KIND_NAMES[semantic_id]
        yield {
            "type": kind,
            "semantic_id": semantic_id,
            "color": KIND_COLORS[kind],
            "id": box_id,
            "center": rounded(box_map.centers[i]),
            "extent": rounded(box_map.half_extents[i]),
            "rotation": rounded(box_map.rotations_deg[i]),
            "min": rounded(mins[i]),
            "max": rounded(maxs[i]),
        }


def read_boxes(path: Path) -> BoxMap:
    """Read `boxes_3d.json`, `step2_simplified.json` or a bare list of boxes, which the paper's exporter writes."""
    if path.suffix.lower() in (".csv", ".geojson"):
        fix = f"convert it to boxes_3d.json: cosfly maps --source boxes --set maps.boxes.path={path} --out DIR"
        raise InputError("this file is a table of boxes, not a map", where=path, fix=fix)
    value = read_json(path, what=BOXES_FORMAT.what, most_mb=MAP_MB)
    header = MapHeader(name=path.stem)
    if isinstance(value, list):
        value = {"boxes": value}
    else:
        check_schema(value, BOXES_FORMAT, path)
        _check_units(value, path)
        header = validated(MapHeader, {key: field for key, field in value.items() if key not in COMPUTED}, path)
    if "boxes" not in value:
        raise InputError(MISSING, where=f"{path}: boxes", expected="a list of boxes")
    boxes = validated(_Boxes, value, path).boxes
    if not boxes:
        raise InputError("the map has no boxes", where=path, fix="export or make this map again")
    box_map = make_box_map(
        [box.center for box in boxes],
        [box.extent for box in boxes],
        [box.rotation for box in boxes],
        [KINDS[box.type] for box in boxes],
        [box.id for box in boxes],
        header,
    )
    refs = {box.id: box.mesh for box in boxes if box.mesh is not None}
    box_map = replace(box_map, meshes=Meshes(refs, path.parent))
    check_boxes(box_map, path)
    mismatch = next(_mismatches(value, boxes, box_map), None)
    if mismatch is not None:
        name, got, expected = mismatch
        raise InputError(
            "the field does not match the other fields of the file",
            where=f"{path}: {name}",
            got=str(got)[:200],
            expected=str(expected)[:200],
            fix="write extent as half the size in metres, and rotation as pitch, yaw and roll in degrees; or correct "
            "this field, which is computed from the others",
        )
    return box_map


def _check_units(value: dict[str, Any], path: Path) -> None:
    for name in UNIT_FIELDS & value.keys():
        if str(value[name]).lower() not in ("m", "metre", "metres", "meter", "meters", "none"):
            what = "the file declares another unit or coordinate system than the format boxes_3d.json has"
            fix = "convert the boxes to metres, z up, and remove this field"
            raise InputError(what, where=f"{path}: {name}", got=value[name], expected=AXES, fix=fix)


def _mismatches(value: dict[str, Any], boxes: list[_Box], box_map: BoxMap) -> Iterator[tuple[str, Any, Any]]:
    """Yield redundant fields that differ from the boxes, as in a file with other axes or units.

    Each result is the field, its value and the expected one.
    """
    for name, computed in {"axes": AXES, "num_boxes": len(box_map), "counts": box_map.counts()}.items():
        if value.get(name, computed) != computed:
            yield name, value[name], computed
    for box in boxes:
        if box.semantic_id not in (None, KINDS[box.type]):
            yield f"box {box.id}: semantic_id", box.semantic_id, KINDS[box.type]
    for name, corners in (("min", box_map.mins), ("max", box_map.maxs)):
        # A corner that the file does not hold is NaN, which compares as equal here.
        file_corners = np.array([getattr(box, name) or [np.nan] * 3 for box in boxes])
        differs = np.abs(file_corners - corners) > CORNER_M + CORNER_SHARE * np.abs(corners)
        for row in np.flatnonzero(differs.any(axis=1)).tolist():
            yield f"box {boxes[row].id}: {name}", file_corners[row].tolist(), rounded(corners[row])
