"""The settings explained: each with its value, what it may be and what it means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from cosfly.runtime.errors import ConfigError, nearest
from cosfly.runtime.json_io import dump_json


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        name: with its sections: `plan.altitude_max_m`.
        value: JSON-able; None also of a group.
        kind: what it may be, in words; empty of a group of settings.
        meaning: its description.
    """

    name: str
    value: Any
    kind: str
    meaning: str

    @property
    def is_group(self) -> bool:
        return not self.kind


def explain(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Explain all settings in order, a group before what stands in it; or one section, or one setting."""
    schema = type(cfg).model_json_schema()
    settings = list(_explain(schema, schema["$defs"], cfg.model_dump(mode="json"), ""))
    if section is None:
        return settings
    found = [s for s in settings if s.name == section or s.name.startswith(f"{section}.")]
    if not found:
        raise ConfigError(
            f"no such section or setting{nearest(section, [setting.name for setting in settings])}",
            got=section,
            expected="for instance plan or plan.muco; a file, or a configuration that ships, comes before it",
        )
    return found


def changed(cfg: BaseModel, section: str | None = None) -> list[Setting]:
    """Explain those settings that are not the defaults; raises as `explain`."""
    defaults = {setting.name: setting.value for setting in explain(type(cfg)())}
    return [one for one in explain(cfg, section) if not one.is_group and one.value != defaults.get(one.name)]


def _explain(
    group: Mapping[str, Any], models: Mapping[str, Any], values: Mapping[str, Any], above: str
) -> Iterator[Setting]:
    for name, field in group["properties"].items():
        model = _model_of(field, models)
        meaning = field.get("description", "")
        if model is None:
            yield Setting(above + name, values[name], _kind_of(field, models), meaning)
        else:
            yield Setting(above + name, None, "", meaning)
            yield from _explain(model, models, values[name], f"{above}{name}.")


def _model_of(field: Mapping[str, Any], models: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the schema of a group of settings, None of a single one."""
    model = models.get(field.get("$ref", "").rpartition("/")[2])
    return model if model is not None and "properties" in model else None


_KINDS = {"integer": "whole number", "number": "number", "string": "text", "boolean": "true or false", "null": "null"}
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def _kind_of(field: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """Return what a setting may be: `number > 0`, `one of a, b`, `list of texts`, `text, as a, b`."""
    if "examples" in field:
        names = {name: value for name, value in field.items() if name != "examples"}
        return f"{_kind_of(names, models)}, as {', '.join(map(str, field['examples']))}"
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
        parts = field.get("prefixItems")
        return "list of: " + (
            ", ".join(_kind_of(p, models) for p in parts) if parts else _kind_of(field.get("items", {}), models)
        )
    if kind == "object":
        rule = field.get("additionalProperties")
        return "mapping of names to: " + (_kind_of(rule, models) if isinstance(rule, dict) and rule else "values")
    if kind == "string" and field.get("format") == "path":
        return "path"
    if kind not in _KINDS:
        return "value"
    bounds = [f"{sign} {field[bound]}" for bound, sign in _BOUNDS.items() if bound in field]
    if "multipleOf" in field:
        bounds.append(f"a multiple of {field['multipleOf']}")
    return " ".join([_KINDS[kind], " and ".join(bounds)]).strip()


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
    """Write settings for a terminal: `name = value`, then what it means and what it may be."""
    for setting in settings:
        if setting.is_group:
            yield f"\n{setting.name}: {setting.meaning}"
        else:
            yield f"  {setting.name} = {dump_json(setting.value)}"
            yield f"      {setting.meaning} [{setting.kind}]"
