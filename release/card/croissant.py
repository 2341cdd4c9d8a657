"""`croissant.json`: the release in the machine-readable words of MLCommons Croissant 1.0, so that data-set searches and
`mlcroissant` read it.

`render_croissant` makes it of `release.json` alone, as the card is made, so that one which says anything else is found.
Structs become one field a member (`pose/x_m`), pictures are images, depth is the bytes of a `.npy` file.
"""

from __future__ import annotations

import re
from typing import Any

import pyarrow as pa

from cosfly.runtime.json_io import dump_json
from release.columns import CONTRACT, PICTURES, schema
from release.record import ReleaseRecord, shard_pattern

CROISSANT = "croissant.json"
FRAMES = "frames"  # the one record set
# The context that Croissant 1.0 asks for, to the letter.
CONTEXT: dict[str, Any] = {
    "@language": "en", "@vocab": "https://schema.org/", "citeAs": "cr:citeAs", "column": "cr:column",
    "conformsTo": "dct:conformsTo", "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/", "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"}, "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty", "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract", "field": "cr:field", "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet", "format": "cr:format", "includes": "cr:includes", "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath", "key": "cr:key", "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path",
    "recordSet": "cr:recordSet", "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated",
    "replace": "cr:replace", "samplingRate": "cr:samplingRate", "sc": "https://schema.org/",
    "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField", "transform": "cr:transform",
}  # fmt: skip
PARQUET = "application/x-parquet"
TYPES = {
    pa.string(): "sc:Text",
    pa.binary(): "sc:Text",
    pa.int32(): "sc:Integer",
    pa.float64(): "sc:Float",
    pa.bool_(): "sc:Boolean",
}


def render_croissant(record: ReleaseRecord) -> str:
    """Return the text of `croissant.json` for a release.json."""
    names = ", ".join(dict.fromkeys(entry.name for entry in record.maps))
    value = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": re.sub(r"[^\w-]+", "-", record.name).strip("-") or "release",
        "alternateName": record.name,
        "description": f"{record.numbers.frames} rendered frames of a drone that follows a walking person ({names}): "
        f"pictures, poses, and reasons for manoeuvres in two languages. {record.credits} Axes: {CONTRACT['position']}. "
        f"Depth: {CONTRACT['depth']}.",
        "license": record.licence,
        "creditText": " ".join(filter(None, [record.credits, *(entry.credits for entry in record.maps)])),
        "citeAs": f"{record.name}, made by {record.made_by}",
        "version": "1.0.0",
        "distribution": _distribution(record),
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": FRAMES,
                "name": FRAMES,
                "key": {"@id": f"{FRAMES}/sample_id"},
                "field": _fields(record),
            }
        ],
    }
    return dump_json(value, indent=1) + "\n"


def _distribution(record: ReleaseRecord) -> list[dict[str, Any]]:
    """Each shard with its checksum, and the set of all, found by their names beside this file."""
    shards = [
        {
            "@type": "cr:FileObject", "@id": shard.path, "name": shard.path, "contentUrl": shard.path,
            "contentSize": f"{shard.bytes} B", "encodingFormat": PARQUET, "sha256": shard.sha256,
        }
        for shard in record.files
    ]  # fmt: skip
    patterns = [shard_pattern(split, record.content_digest) for split in record.splits.splits]
    return [
        *shards,
        {"@type": "cr:FileSet", "@id": "shards", "name": "shards", "encodingFormat": PARQUET, "includes": patterns},
    ]


def _fields(record: ReleaseRecord) -> list[dict[str, Any]]:
    fields = []
    pictures = {column.name for file, column in PICTURES.items() if file != "depth"}
    for member in schema(record.settings.modalities):
        if member.name in pictures:
            fields.append(_field(member.name, "sc:ImageObject", member.name, path="bytes"))
        elif pa.types.is_struct(member.type):
            fields += [
                _field(f"{member.name}/{part.name}", TYPES[part.type], member.name, path=part.name)
                for part in member.type
            ]
        elif pa.types.is_list(member.type):
            fields.append(_field(member.name, TYPES[member.type.value_type], member.name) | {"repeated": True})
        else:
            fields.append(_field(member.name, TYPES[member.type], member.name))
    return fields


def _field(name: str, data_type: str, column: str, *, path: str | None = None) -> dict[str, Any]:
    source: dict[str, Any] = {"fileSet": {"@id": "shards"}, "extract": {"column": column}}
    if path is not None:
        source["transform"] = {"jsonPath": path}
    return {
        "@type": "cr:Field",
        "@id": f"{FRAMES}/{name}",
        "name": f"{FRAMES}/{name}",
        "dataType": data_type,
        "source": source,
    }
