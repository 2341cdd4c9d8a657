"""Explanations of settings: value, allowed values and meaning of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from pydantic import BaseModel

from cosfly.runtime.errors import ConfigError, nearest
from cosfly.runtime.json_io import dump_json

KINDS = {"integer": "whole number", "number": "number", "string": "text", "boolean": "true or false", "null": "null"}
BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
BOUNDS |= {"multipleOf": "a multiple of"}


class Setting(NamedTuple):
    """One setting, or a group of settings."""

    name: str  # with its sections, such as `plan.altitude_max_m`
    value: Any  # can be written as JSON; None for a group
    kind: str  # the allowed values in words; empty for a group
    meaning: str


def explain(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Return all settings in order, a group before its members; or those of one section, or one setting."""
    schema = type(cfg).model_json_schema()
    settings = list(_explain(schema, schema["$defs"], cfg.model_dump(mode="json"), ""))
    if section is None:
        return settings
    selected = [s for s in settings if s.name == section or s.name.startswith(f"{section}.")]
    if not selected:
        raise ConfigError(
            f"there is no section or setting of this name{nearest(section, [setting.name for setting in settings])}",
            got=section,
            expected="a section such as plan, a setting such as plan.muco, or the file or name of a configuration",
        )
    return selected


def changed(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Return the settings that differ from their defaults; raises the errors of `explain`."""
    defaults = {setting.name: setting.value for setting in explain(type(cfg)())}
    settings = explain(cfg, section)
    return [setting for setting in settings if setting.kind and setting.value != defaults.get(setting.name)]


def _explain(
    group: Mapping[str, Any], models: Mapping[str, Any], values: Mapping[str, Any], above: str
) -> Iterator[Setting]:
    for name, field in group["properties"].items():
        meaning = field.get("description", "")
        model = models.get(field.get("$ref", "").rpartition("/")[2], {})
        if "properties" in model:
            yield Setting(above + name, None, "", meaning)
            yield from _explain(model, models, values[name], f"{above}{name}.")
        else:
            yield Setting(above + name, values[name], _kind_of(field, models), meaning)


def _kind_of(field: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """Return the allowed values in words: `number > 0`, `one of a, b`, `list of: text`, `text, as a, b`."""
    field = {**models.get(field.get("$ref", "").rpartition("/")[2], {}), **field}
    kind = field.get("type", "")
    values = field.get("additionalProperties")  # of a mapping
    if "anyOf" in field:
        words = ", or ".join(_kind_of(part, models) for part in field["anyOf"])
    elif "enum" in field:
        words = f"one of {', '.join(map(str, field['enum']))}"
    elif "const" in field:
        words = str(field["const"])
    elif kind == "array":
        parts = field.get("prefixItems") or [field.get("items", {})]
        words = f"list of: {', '.join(_kind_of(part, models) for part in parts)}"
    elif kind == "object":
        words = "mapping of names to: " + (
            _kind_of(values, models) if isinstance(values, dict) and values else "values"
        )
    elif field.get("format") == "path":
        words = "path"
    else:
        bounds = " and ".join(f"{sign} {field[bound]}" for bound, sign in BOUNDS.items() if bound in field)
        words = f"{KINDS.get(kind, 'value')} {bounds}".strip()
    return f"{words}, as {', '.join(map(str, field['examples']))}" if "examples" in field else words


def nested(settings: list[Setting]) -> dict[str, Any]:
    """Return the values as nested groups, as in a configuration file."""
    values: dict[str, Any] = {}
    for setting in settings:
        *above, last = setting.name.split(".")
        group = values
        for name in above:
            group = group.setdefault(name, {})
        group[last] = setting.value if setting.kind else {}
    return values


def as_lines(settings: list[Setting]) -> Iterator[str]:
    """Yield lines for a terminal: `name = value`, then the meaning and the allowed values."""
    for setting in settings:
        if setting.kind:
            yield f"  {setting.name} = {dump_json(setting.value)}\n      {setting.meaning} [{setting.kind}]"
        else:
            yield f"\n{setting.name}: {setting.meaning}"
