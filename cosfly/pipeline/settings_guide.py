"""The settings explained: each with its value, what it may be and what it means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from cosfly.runtime.errors import ConfigError, nearest
from cosfly.runtime.json_io import dump_json

KINDS = {"integer": "whole number", "number": "number", "string": "text", "boolean": "true or false", "null": "null"}
BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


@dataclass(frozen=True)
class Setting:
    """One setting, or a group of settings.

    Attributes:
        name: With its sections: `plan.altitude_max_m`.
        value: JSON-able; None for a group.
        kind: What it may be, in words; empty for a group.
        meaning: Its description.
    """

    name: str
    value: Any
    kind: str
    meaning: str

    @property
    def is_group(self) -> bool:
        return not self.kind


def explain(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Return all settings in order, a group before its members; or those of one section, or one setting."""
    schema = type(cfg).model_json_schema()
    settings = list(_explain(schema, schema["$defs"], cfg.model_dump(mode="json"), ""))
    if section is None:
        return settings
    found = [s for s in settings if s.name == section or s.name.startswith(f"{section}.")]
    if not found:
        raise ConfigError(
            f"no such section or setting{nearest(section, [setting.name for setting in settings])}",
            got=section,
            expected="for instance plan or plan.muco, after the name of a file or of a shipped configuration",
        )
    return found


def changed(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Return the settings that are not the defaults; raises as `explain`."""
    defaults = {setting.name: setting.value for setting in explain(type(cfg)())}
    return [one for one in explain(cfg, section) if not one.is_group and one.value != defaults.get(one.name)]


def _explain(
    group: Mapping[str, Any], models: Mapping[str, Any], values: Mapping[str, Any], above: str
) -> Iterator[Setting]:
    for name, field in group["properties"].items():
        meaning, model = field.get("description", ""), models.get(field.get("$ref", "").rpartition("/")[2], {})
        if "properties" in model:
            yield Setting(above + name, None, "", meaning)
            yield from _explain(model, models, values[name], f"{above}{name}.")
        else:
            yield Setting(above + name, values[name], _kind_of(field, models), meaning)


def _kind_of(field: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """Return what a setting may be: `number > 0`, `one of a, b`, `list of texts`, `text, as a, b`."""
    if "examples" in field:
        rest = {name: value for name, value in field.items() if name != "examples"}
        return f"{_kind_of(rest, models)}, as {', '.join(map(str, field['examples']))}"
    if "$ref" in field:
        return _kind_of(models[field["$ref"].rpartition("/")[2]], models)
    if "anyOf" in field:
        return ", or ".join(_kind_of(part, models) for part in field["anyOf"])
    if "enum" in field:
        return f"one of {', '.join(map(str, field['enum']))}"
    if "const" in field:
        return str(field["const"])
    kind = field.get("type")
    if kind == "array":
        parts = field.get("prefixItems") or [field.get("items", {})]
        return f"list of: {', '.join(_kind_of(part, models) for part in parts)}"
    if kind == "object":
        rule = field.get("additionalProperties")
        return "mapping of names to: " + (_kind_of(rule, models) if isinstance(rule, dict) and rule else "values")
    if kind == "string" and field.get("format") == "path":
        return "path"
    if kind not in KINDS:
        return "value"
    bounds = [f"{sign} {field[bound]}" for bound, sign in BOUNDS.items() if bound in field]
    if "multipleOf" in field:
        bounds.append(f"a multiple of {field['multipleOf']}")
    return " ".join([KINDS[kind], " and ".join(bounds)]).strip()


def nested(settings: list[Setting]) -> dict[str, Any]:
    """Return the values group within group, as a configuration file holds them."""
    values: dict[str, Any] = {}
    for setting in settings:
        *above, last = setting.name.split(".")
        group = values
        for name in above:
            group = group.setdefault(name, {})
        group[last] = {} if setting.is_group else setting.value
    return values


def as_lines(settings: list[Setting]) -> Iterator[str]:
    """Yield lines for a terminal: `name = value`, then what it means and what it may be."""
    for setting in settings:
        if setting.is_group:
            yield f"\n{setting.name}: {setting.meaning}"
        else:
            yield f"  {setting.name} = {dump_json(setting.value)}"
            yield f"      {setting.meaning} [{setting.kind}]"
